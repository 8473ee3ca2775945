"""A program that is forked from the tests does what it does when it is started."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from helpers.forks import ForkedProcess

IDENT = [sys.executable, "-P", "-m", "ident_service"]


def both(*words: str, **more: Any) -> list[tuple[int, bytes, bytes]]:
    """Exit code, output and errors of a command, started and forked."""
    ended = []
    for start in (subprocess.Popen, ForkedProcess):
        pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | more
        with start([*IDENT, *words], **pipes) as process:
            out, err = process.communicate(timeout=60)
        ended.append((process.returncode, out, err))
    return ended


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [("--version",), ("base-parameters", "arm.yaml"), ("verify", "nowhere", "--json"), ("runs", "show"), ()],
)
def test_a_command_ends_and_says_the_same(words: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "arm.yaml").write_text("extends: planar2\n")
    started, forked = both(*words, cwd=tmp_path, env={**os.environ, "NO_COLOR": "1"})
    assert forked == started
    assert started[1] + started[2]


def test_only_what_is_passed_on_is_there_and_signals_are_a_new_programs(tmp_path: Path) -> None:
    """The recorder's process waits for its request on a socket; what it has open besides is its own."""
    kept, other = os.open(tmp_path, os.O_RDONLY), os.open(tmp_path, os.O_RDONLY)
    before = signal.signal(signal.SIGTERM, lambda *_: None)
    try:
        process = ForkedProcess(
            [sys.executable, "-m", "ident_service.motion.process"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=(kept,),
            env={"IDENT_STATE": "x"},
            start_new_session=True,
        )
        assert os.getsid(process.pid) == process.pid
        held = {int(one.name) for one in Path(f"/proc/{process.pid}/fd").iterdir()}
        assert {0, 1, 2, kept} <= held
        assert other not in held
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=60)
        assert process.returncode == -signal.SIGTERM
    finally:
        signal.signal(signal.SIGTERM, before)
        os.close(kept)
        os.close(other)
