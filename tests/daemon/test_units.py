"""The unit files, read by systemd itself, with a command that is there in the place of the installed one."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from ident_service.daemon.connections import raise_connection_limit

UNITS = Path(__file__).parents[2] / "configs" / "systemd"
NAMES = ("ident.service", "ident-motion.socket", "ident-motion@.service")
# Of 10: what `systemd-analyze security` may find open at most.
EXPOSURE = {"ident.service": 2.0, "ident-motion@.service": 3.0}
_PREFIX = "/opt/ident/bin/"

ANALYZE = shutil.which("systemd-analyze")
needs_systemd = pytest.mark.skipif(ANALYZE is None, reason="no systemd-analyze: install the system's package systemd")


@pytest.fixture
def units(tmp_path: Path) -> Path:
    """Copies that name commands below the test's own folder."""
    commands = tmp_path / "bin"
    commands.mkdir()
    for name in ("ident", "python"):
        (commands / name).write_text("#!/bin/sh\n")
        (commands / name).chmod(0o755)
    folder = tmp_path / "units"
    folder.mkdir()
    for name in NAMES:
        text = (UNITS / name).read_text(encoding="utf-8")
        (folder / name).write_text(text.replace(_PREFIX, f"{commands}/"), encoding="utf-8")
    return folder


def analyze(*words: object) -> tuple[int, str]:
    """Exit code and what is said, on either stream."""
    done = subprocess.run(
        [str(ANALYZE), *map(str, words)], capture_output=True, text=True, check=False, timeout=60, env={"LC_ALL": "C"}
    )
    return done.returncode, done.stdout + done.stderr


def verified(folder: Path) -> tuple[int, str]:
    """What systemd says of our three units, and of no other."""
    return analyze("verify", "--man=no", "--recursive-errors=no", *sorted(folder.iterdir()))


@needs_systemd
def test_systemd_finds_no_mistake_in_the_units(units: Path) -> None:
    assert verified(units) == (0, "")


@needs_systemd
@pytest.mark.parametrize(
    ("name", "good", "bad", "said"),
    [
        ("ident.service", "WatchdogSec=30", "WatchdogSeconds=30", "WatchdogSeconds"),
        ("ident.service", "KillMode=mixed", "KillMode=gently", "gently"),
        ("ident-motion@.service", "LimitRTPRIO=90", "LimitRTPRIO=high", "high"),
        ("ident-motion.socket", "Accept=yes", "Accept=perhaps", "perhaps"),
        ("ident.service", "ExecStart=", "ExecStart=/nowhere", "not executable"),
    ],
)
def test_systemd_finds_mistakes_that_are_made(units: Path, name: str, good: str, bad: str, said: str) -> None:
    text = (units / name).read_text(encoding="utf-8")
    assert good in text
    (units / name).write_text(text.replace(good, bad), encoding="utf-8")
    assert said in verified(units)[1]


@needs_systemd
@pytest.mark.parametrize("name", EXPOSURE)
def test_what_is_left_open_is_little(units: Path, name: str) -> None:
    code, said = analyze("security", "--offline=true", "--no-pager", units / name)
    if "offline" in said and code != 0:
        pytest.skip("this systemd-analyze reads the exposure of loaded units only: version 250 reads files")
    found = re.search(r"Overall exposure level for \S+: ([0-9.]+)", said)
    assert found is not None, said
    assert float(found[1]) <= EXPOSURE[name], said


def test_the_daemon_can_reach_the_socket_of_motions() -> None:
    socket, daemon = ((UNITS / name).read_text(encoding="utf-8") for name in ("ident-motion.socket", "ident.service"))
    (path,) = re.findall(r"^ListenStream=(.+)$", socket, re.M)
    assert f"--motion-socket {path}" in daemon
    # The manager makes the folder as root: who is to go through needs the right of others.
    (mode,) = re.findall(r"^DirectoryMode=(.+)$", socket, re.M)
    assert int(mode, 8) & 0o001
    (owner,) = re.findall(r"^SocketUser=(.+)$", socket, re.M)
    assert f"\nUser={owner}\n" in daemon
    assert "SocketMode=0600" in socket


def test_the_daemons_unit_has_descriptors_for_all_its_connections_and_as_many_to_spare() -> None:
    (limit,) = re.findall(r"^LimitNOFILE=(\d+)$", (UNITS / "ident.service").read_text(encoding="utf-8"), re.MULTILINE)
    assert int(limit) >= 2 * raise_connection_limit()
