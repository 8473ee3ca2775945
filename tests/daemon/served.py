"""The daemon as a process of its own, and how it is asked there."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ident_service.client import IdentClient


def started(state: Path, *words: str, **environment: str) -> subprocess.Popen[bytes]:
    """`ident serve` on a free port; its log goes beside the state folder."""
    state.mkdir(parents=True, exist_ok=True)
    with (state.parent / "serve.log").open("ab") as log:
        return subprocess.Popen(
            [sys.executable, "-m", "ident_service", "serve", "--port", "0", "--state", str(state), *words],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env={**os.environ, **environment},
        )


def url_of(process: subprocess.Popen[bytes], state: Path, seconds: float = 60.0) -> str:
    """Where it listens, as soon as it does."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        with suppress(OSError):
            if url := (state / "serve.url").read_text().strip():
                return url
        assert process.poll() is None, (state.parent / "serve.log").read_text()
        time.sleep(0.02)
    raise AssertionError("the daemon did not begin to answer")


@contextmanager
def daemon_process(
    state: Path, *words: str, **environment: str
) -> Iterator[tuple[subprocess.Popen[bytes], IdentClient]]:
    """A daemon and a client of its owner; killed at the end if it lives still."""
    (state / "serve.url").unlink(missing_ok=True)
    process = started(state, *words, **environment)
    try:
        client = IdentClient(url_of(process, state), (state / "token").read_text().strip())
        try:
            yield process, client
        finally:
            client.close()
    finally:
        if process.poll() is None:
            process.kill()
        process.wait()
