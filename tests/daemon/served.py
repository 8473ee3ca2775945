"""The daemon as a process of its own, or as a thread of this one, and how it is asked there."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import uvicorn

from ident_service.client import IdentClient
from ident_service.daemon.app import create_app
from ident_service.daemon.dependencies import Service
from ident_service.daemon.settings import Settings


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


LEASES: Final = 15.0
"""How much longer than usual a service waits for a renewal: machines that run tests stall."""


@dataclass(frozen=True)
class Reached:
    """A service that listens."""

    url: str
    service: Service
    token: str


@contextmanager
def daemon_thread(state: Path) -> Iterator[IdentClient]:
    """Yield a client of the owner of a daemon in this process, where the daemon's own is not what is tested."""
    with listening(state) as reached, IdentClient(reached.url, reached.token) as client:
        yield client


@contextmanager
def listening(state: Path) -> Iterator[Reached]:
    """A service on a state folder and a free port of this machine."""
    link = socket.socket()
    link.bind(("127.0.0.1", 0))
    app = create_app(Settings(state, port=link.getsockname()[1], lease_factor=LEASES))
    config = uvicorn.Config(app, log_config=None, access_log=False, ws="none", http="h11", timeout_graceful_shutdown=3)
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [link]})
    thread.start()
    try:
        while not server.started:
            assert thread.is_alive()
            time.sleep(0.01)
        service = app.state.service
        token = (state / "token").read_text().strip()
        yield Reached(f"http://127.0.0.1:{link.getsockname()[1]}", service, token)
    finally:
        server.should_exit = True
        thread.join(60)
        link.close()
