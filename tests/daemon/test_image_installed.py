"""The image's command works from what the recipe copies, with no checkout beside it."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from daemon.test_image import ROOT, Machine, asked, instructions, last
from daemon.test_image import machine as machine

pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]


def installed(place: Path) -> Path:
    """Lay out what the recipe's stage `build` has as the wheel does; no file of the checkout but these."""
    copied = {
        source
        for name, words in instructions()
        if name == "COPY" and not words.startswith("--from")
        for source in words.split()[:-1]
    }
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    for source, target in ({one: one for one in wheel["packages"]} | wheel["force-include"]).items():
        assert source in copied
        shutil.copytree(ROOT / source, place / target, ignore=shutil.ignore_patterns("__pycache__"))
    return place


@pytest.mark.campaign
def test_the_images_command_needs_no_checkout(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    site = installed(machine.place / "site")
    machine.environment["PYTHONPATH"] = str(site)
    said = subprocess.run(
        [sys.executable, "-c", "import ident_service; print(ident_service.__file__)"],
        env=machine.environment,
        cwd=machine.place,
        check=True,
        capture_output=True,
        text=True,
    )
    assert said.stdout.startswith(str(site))
    pem, key = machine.certificate()
    changed = {"/etc/ident/tls.pem": pem, "/etc/ident/tls.key": key}
    words = [changed.get(word, word) for word in json.loads(last("CMD"))]
    process = machine.start(["-m", "ident_service", *words, "--port", "0"])
    monkeypatch.setenv("SSL_CERT_FILE", pem)
    with asked(machine, process, "https", "localhost") as client:
        assert len(client.arms()) == len(list((ROOT / "configs").glob("*.yaml")))
        page = client.content("/api/docs").decode()
        for file in re.findall(r'(?:src|href)="(/static/[^"]+)"', page):
            assert client.content(file), file
        simulated = client.compute("simulate", arm="planar2", seed=1)
        assert client.compute("report", run=simulated.run).state == "done"
