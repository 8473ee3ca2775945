"""The two pages about the daemon hold: commands are commands, requests are requests, programs run."""

from __future__ import annotations

import base64
import json
import re
import shlex
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from daemon.conftest import Asked, quick_text
from daemon.served import daemon_thread
from daemon.test_uploads import COLUMNS
from daemon.test_uploads import table as table
from standardwebhooks.webhooks import Webhook

from ident_service.cli import parser

ROOT = Path(__file__).resolve().parents[2]
PAGES = ("service.md", "programming.md")


BENCH = "format: ident-arm\nversion: 1\nname: bench\nkinematics: {urdf: bench.urdf}\n"
BENCH_URDF = (
    '<robot name="bench"><link name="base"/><link name="beam"><inertial><mass value="1"/>'
    '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    '<joint name="axis" type="revolute"><parent link="base"/><child link="beam"/><axis xyz="0 0 1"/>'
    '<limit lower="-1" upper="1" effort="10" velocity="2"/></joint></robot>'
)


def text(page: str) -> str:
    return (ROOT / "docs" / page).read_text(encoding="utf-8")


def blocks(page: str, language: str = "") -> list[str]:
    return re.findall(rf"(?ms)^```{language}\n(.*?)^```$", text(page))


def commands() -> Iterator[list[str]]:
    """The words of each `ident ...` in a block, without what a shell makes of the rest."""
    for block in blocks("service.md", "sh"):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line.replace(" &", ""), comments=True)
            while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
                words.pop(0)
            if words[:3] == ["sudo", "-u", "ident"]:
                words = words[4:]
                words[0] = Path(words[0]).name
            if words[:1] == ["ident"]:
                yield words[1:]
            elif words[:2] == ["podman", "run"]:
                yield words[words.index("ident", words.index("--volume") + 4) + 1 :]


@pytest.mark.slow
def test_every_command_is_understood() -> None:
    found = list(commands())
    assert len(found) > 20
    for words in found:
        assert parser().parse_args(words).word, words
    assert {words[0] for words in found} >= {"serve", "backup", "restore", "tokens", "runs", "prune", "stop"}


@pytest.mark.slow
def test_every_request_file_and_target_is_there(daemon: Asked) -> None:
    known = [re.sub(r"\{\w+\}", "*", path) for path in daemon.get("/api/v1/openapi.json").json()["paths"]]
    patterns = [re.compile(re.escape(path).replace(r"\*", "[^/]+") + "$") for path in [*known, "/api/v1/openapi.json"]]
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    asked = 0
    for page in PAGES:
        for path in re.findall(r"/api/v1/[\w./-]*[\w]", text(page)):
            assert any(one.match(path) for one in patterns), (page, path)
            asked += 1
        for target in re.findall(r"`make ([a-z-]+)`", text(page).replace("\n", " ")):
            assert re.search(rf"(?m)^{target}:", makefile), target
        for file in re.findall(r"`((?:configs|docs|tools)/[\w./-]+|Containerfile)`", text(page)):
            assert (ROOT / file).exists(), file
    assert asked > 15


@pytest.mark.campaign
@pytest.mark.timeout(500)
def test_the_programs_run(
    table: Path, state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "monday.csv").write_bytes(table.read_bytes())
    (tmp_path / "columns.yaml").write_text(COLUMNS)
    (tmp_path / "bench.yaml").write_text(BENCH)
    (tmp_path / "bench.urdf").write_text(BENCH_URDF)
    body = json.dumps({"type": "arm.due", "timestamp": "2026-11-01T06:00:00Z", "data": {"id": 1, "arm": "planar2"}})
    secret, now = "whsec_" + base64.b64encode(b"0123456789abcdef").decode(), datetime.now(UTC)
    headers = {"webhook-id": "msg_1", "webhook-timestamp": str(int(now.timestamp()))}
    headers["webhook-signature"] = Webhook(secret).sign("msg_1", now, body)
    programs = blocks("programming.md", "python")
    assert len(programs) == 6
    with daemon_thread(state) as client:
        client.add_arm(quick_text())
        token = (state / "token").read_text().strip()
        names: dict[str, Any] = {"url": client.url, "token": token}
        names |= {"secret": secret, "body": body.encode(), "headers": headers}
        for program in programs:
            # The same arm at a quarter of the rate, with motions half as long.
            program = program.replace('"planar2"', '"quick"')
            exec(compile(program, "programming.md", "exec"), dict(names))  # noqa: S102 - our own page
        kinds = [job.kind for job in client.jobs()]
    assert kinds == ["identify", "identify", "run", "check", "simulate"]
    said = capsys.readouterr().out
    assert "done " in said
    assert "bench ['axis']" in said
    assert "20200101T000000Z-nothing" in said
    assert "job ended" in said
    assert "arm.due planar2" in said
