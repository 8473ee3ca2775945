"""A program that is forked from the tests does what it does when it is started."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from helpers.forks import ForkedProcess, ForkServer, served_by

from ident_service.client import IdentClient

IDENT = [sys.executable, "-P", "-m", "ident_service"]


@pytest.fixture(scope="module")
def served() -> Iterator[type[ForkedProcess]]:
    """A process that a server of this module forks."""
    server = ForkServer()
    yield served_by(server)
    server.close()


def each(served: type[ForkedProcess], *words: str, **more: Any) -> list[tuple[int, bytes, bytes]]:
    """Exit code, output and errors of a command, started, forked, and forked by a server."""
    ended = []
    for start in (subprocess.Popen, ForkedProcess, served):
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
def test_a_command_ends_and_says_the_same(words: tuple[str, ...], served: type[ForkedProcess], tmp_path: Path) -> None:
    (tmp_path / "arm.yaml").write_text("extends: planar2\n")
    started, forked, by_a_server = each(served, *words, cwd=tmp_path, env={**os.environ, "NO_COLOR": "1"})
    assert forked == by_a_server == started
    assert started[1] + started[2]


@pytest.mark.parametrize("by_a_server", [False, True])
def test_only_what_is_passed_on_is_there_and_signals_are_a_new_programs(
    by_a_server: bool, served: type[ForkedProcess], tmp_path: Path
) -> None:
    """The recorder's process waits for its request on a socket; what it has open besides is its own."""
    kept, other = os.open(tmp_path, os.O_RDONLY), os.open(tmp_path, os.O_RDONLY)
    before, mask = signal.signal(signal.SIGTERM, lambda *_: None), os.umask(0o027)
    try:
        process = (served if by_a_server else ForkedProcess)(
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
        assert os.path.samestat(os.fstat(kept), Path(f"/proc/{process.pid}/fd/{kept}").stat())
        status = Path(f"/proc/{process.pid}/status").read_text()
        assert f"PPid:\t{os.getpid()}\n" in status
        assert "Umask:\t0027\n" in status
        assert other not in held
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=60)
        assert process.returncode == -signal.SIGTERM
    finally:
        signal.signal(signal.SIGTERM, before)
        os.umask(mask)
        os.close(kept)
        os.close(other)


@pytest.mark.slow
def test_a_daemon_is_forked_by_a_server_alone(served: type[ForkedProcess], tmp_path: Path) -> None:
    """Its own programs come from a server that it has from before its threads; it ends in order."""
    state = tmp_path / "state"
    with served([*IDENT, "serve", "--port", "0", "--state", str(state)], stdin=subprocess.DEVNULL) as process:
        until = time.monotonic() + 60.0
        while not (state / "serve.url").exists() or not (state / "serve.url").read_text():
            assert process.poll() is None
            assert time.monotonic() < until
            time.sleep(0.02)
        with IdentClient((state / "serve.url").read_text().strip(), (state / "token").read_text().strip()) as client:
            assert client.compute("base", arm="planar2").state == "done"
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
    assert zombies() == []


def zombies() -> list[int]:
    """Children of this process that have ended and nobody has waited for."""
    found = []
    for status in Path("/proc").glob("[0-9]*/status"):
        with suppress(OSError):
            text = status.read_text()
            if f"PPid:\t{os.getpid()}\n" in text and "State:\tZ" in text:
                found.append(int(status.parent.name))
    return found
