"""Verbs that a program has an arm moved by: the end of their standard input, and the word `stop`, stop it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from cli.conftest import COARSE, Ident, quick_arm

from ident_service.motion.command_channel import is_control_file_in_use
from ident_service.registry.state_folder import control_path

pytestmark = pytest.mark.slow


def piped(state: Path, said: bytes | None, *words: object) -> tuple[int, dict[str, object]]:
    """A command whose standard input says something and ends, or says nothing and stays open if None."""
    with subprocess.Popen(
        [sys.executable, "-m", "ident_service", *map(str, words), "--json", "--state", str(state)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        if said is not None:
            process.stdin.write(said)
            process.stdin.flush()
            if not said.endswith(b"stop\n"):
                process.stdin.close()
        document = json.loads(process.stdout.read())
        process.stdin.close()
        return process.wait(60), document


def test_a_preflight_and_a_run_end_with_their_input(state: Path, tmp_path: Path) -> None:
    arm = quick_arm(tmp_path, *COARSE)
    # Somebody who says stop first has no torque sent at all.
    code, document = piped(state, b"stop\n", "check", arm, "--confirm", "planar2", "--lease-from-stdin")
    assert code == 3
    checks = document["ticket"]["checks"]  # type: ignore[index]
    gravity = next(check for check in checks if check["code"] == "gravity")
    assert gravity["verdict"] == "failed"
    assert "a stop was requested" in gravity["reason"]
    # In virtual time silence of a program that is there is no reason to stop.
    code, document = piped(state, None, "check", arm, "--confirm", "planar2", "--lease-from-stdin")
    assert (code, document["ticket"]["verdict"]) == (0, "passed")  # type: ignore[index]
    for said in (b"\n", b"\n\nstop\n"):
        code, document = piped(state, said, "run", arm, "--lease-from-stdin")
        if code == 3:  # while the way was planned
            assert "before the arm was energised" in document["error"]["message"]  # type: ignore[index]
            continue
        assert code == 1
        assert document["report"]["state"] == "stopped"  # type: ignore[index]
        assert json.loads((Path(str(document["folder"])) / "ended.json").read_text())["state"] == "stopped"
    assert not is_control_file_in_use(control_path(state, "planar2"))


def test_where_nothing_moves_there_is_no_lease(ident: Ident) -> None:
    ended = ident("recover", "planar2", "--lease-from-stdin")
    assert ended.code == 2
    assert "--leave-limit" in ended.err


def test_no_daemon_does_what_is_the_terminals(ident: Ident) -> None:
    ended = ident("import", "run", "--server", "http://127.0.0.1:1")
    assert ended.code == 2
    assert "larger than a request may be" in ended.err
    for words in (("run", "planar2", "--can-log"), ("home", "planar2", "--can-log"), ("simulate", "--out", "x")):
        ended = ident(*words, "--server", "http://127.0.0.1:1")
        assert (
            ended.code,
            f"{words[-1] if words[-1] != 'x' else '--out'} cannot be sent to a daemon" in ended.err,
        ) == (2, True)
    ended = ident("jobs", "list")
    assert ended.code == 2
    assert "ident serve" in ended.err
