"""How long a stop takes when everything else waits: from the first byte of the request until the arm has the word.

`python -m benchmarks.stops`, about a minute. Ten clients stop an arm each, at once, again and again. Meanwhile another
process keeps the registry's write lock, a description is being checked without a pause, forty viewers follow the stream
of all events, and a thousand connections have sent half a request; one that the daemon closes is opened again after one
to three seconds. The daemon has 1,024 descriptors. The time is that of the arms: one process that holds their control
files and looks at them every millisecond, as the control loop looks once a cycle. `$IDENT_BENCH_ROUNDS` (20) says how
often.
"""

from __future__ import annotations

import gc
import http.client
import json
import os
import random
import resource
import selectors
import signal
import socket
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from bisect import insort
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from benchmarks.harness import Row, table, write
from ident_service.config.load import shipped_arms
from ident_service.motion.command_channel import ControlFile
from ident_service.registry.database import FILE
from ident_service.registry.state_folder import control_path

ROUNDS = int(os.environ.get("IDENT_BENCH_ROUNDS", "20"))
CLIENTS, VIEWERS, HALF_OPEN, DESCRIPTORS = 10, 40, 1000, 1024
TARGET = "< 100"
_HALF = b"POST /api/v1/jobs HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Le"
_PATIENCE = 30.0  # s


@dataclass(frozen=True)
class Measured:
    """Holds what a measurement saw.

    Attributes:
        obeyed: from request to the arm's word, of every stop [s].
        answered: until the client had its answer, likewise [s].
        log_bytes: that the daemon wrote.
        checked: descriptions that were checked meanwhile.
        watched: pieces of news that all viewers were told.
    """

    obeyed: list[float]
    answered: list[float]
    log_bytes: int
    checked: int
    watched: int


def measure(folder: Path, rounds: int = ROUNDS, *, quiet: bool = False) -> Measured:
    """Stop ten arms at once, `rounds` times.

    Args:
        folder: for the state folder and the log.
        rounds: how often.
        quiet: whether nothing else goes on, for comparison.
    """
    state, log = folder / "state", folder / "serve.log"
    obeyed, answered = list[float](), list[float]()
    with _daemon(state, log) as address, _part("arms", str(state), str(rounds)) as arms, ExitStack() as load:
        halves = checks = viewers = None
        if not quiet:
            other = sqlite3.connect(state / FILE, isolation_level=None)
            load.callback(other.close)
            other.execute("BEGIN IMMEDIATE")
            halves = load.enter_context(_part("halves", *address))
            token = (state / "token").read_text().strip()
            viewers = load.enter_context(_part("viewers", *address, token))
            checks = load.enter_context(_part("checks", *address, token))
            for part in (viewers, halves, checks):
                _line(part)
            time.sleep(2.0)
        for _ in range(rounds):
            _line(arms)  # they can be stopped now
            sent, done = _stops(address)
            seen = json.loads(_line(arms))
            obeyed += [(seen[k] - sent[k]) * 1e-9 if seen[k] else _PATIENCE for k in range(CLIENTS)]
            answered += [(done[k] - sent[k]) * 1e-9 for k in range(CLIENTS)]
        checked = 0 if checks is None else int(_said(checks))
        watched = 0 if viewers is None else int(_said(viewers))
    return Measured(obeyed, answered, log.stat().st_size, checked, watched)


def _stops(address: tuple[str, str]) -> tuple[list[int], list[int]]:
    """Stop ten arms at once; tell when each was sent and answered [ns of the monotonic clock]."""
    sent, done, together = [0] * CLIENTS, [0] * CLIENTS, threading.Barrier(CLIENTS)

    def stop(number: int) -> None:
        together.wait()
        sent[number] = time.monotonic_ns()
        link = http.client.HTTPConnection(address[0], int(address[1]), timeout=_PATIENCE)
        with suppress(OSError, http.client.HTTPException):
            link.request("POST", f"/api/v1/arms/{_name(number)}/stop")
            link.getresponse().read()
        done[number] = time.monotonic_ns()
        link.close()

    threads = [threading.Thread(target=stop, args=(number,)) for number in range(CLIENTS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return sent, done


def _name(number: int) -> str:
    return f"arm{number}"


@contextmanager
def _daemon(state: Path, log: Path) -> Iterator[tuple[str, str]]:
    """Serve with few descriptors on a free port; yield host and port."""
    words = ["serve", "--port", "0", "--state", str(state)]

    def few() -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (DESCRIPTORS, DESCRIPTORS))

    with (
        log.open("wb") as said,
        subprocess.Popen(
            [sys.executable, "-m", "ident_service", *words], stdout=said, stderr=said, preexec_fn=few
        ) as daemon,
    ):
        try:
            while not (state / "serve.url").exists():
                if daemon.poll() is not None:
                    raise RuntimeError(f"the daemon ended with {daemon.returncode}")
                time.sleep(0.05)
            parts = urlsplit((state / "serve.url").read_text().strip())
            yield str(parts.hostname), str(parts.port)
        finally:
            daemon.send_signal(signal.SIGTERM)


@contextmanager
def _part(*words: str) -> Iterator[subprocess.Popen[str]]:
    """Start a process that does one of the parts below; it is killed at the end if it lives still."""
    with subprocess.Popen(
        [sys.executable, "-m", __name__ if __name__ != "__main__" else "benchmarks.stops", *words],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def _line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None  # noqa: S101 - asked for
    if not (line := process.stdout.readline()):
        raise RuntimeError("a part of the measurement ended early")
    return line


def _said(process: subprocess.Popen[str]) -> str:
    """End the input of a part, and read its last word."""
    return process.communicate(timeout=_PATIENCE)[0].split()[-1]


# --- the parts, each a process of its own


def arms(state: str, rounds: str) -> None:
    """Hold ten control files and say when each has heard its stop [ns of the monotonic clock, 0 for never]."""
    gc.disable()
    for _ in range(int(rounds)):
        with ExitStack() as taken:
            held = [
                taken.enter_context(ControlFile.take(control_path(Path(state), _name(k)), None)) for k in range(CLIENTS)
            ]
            print("ready", flush=True)
            seen, until = [0] * CLIENTS, time.monotonic() + _PATIENCE
            while not all(seen) and time.monotonic() < until:
                now = time.monotonic_ns()
                seen = [was or (now if controls.stop else 0) for was, controls in zip(seen, held, strict=True)]
                time.sleep(0.001)
            print(json.dumps(seen), flush=True)


def halves(host: str, port: str) -> None:
    """Keep a thousand half requests open, as far as the daemon lets us; each is opened again after one to three."""
    resource.setrlimit(resource.RLIMIT_NOFILE, (2 * HALF_OPEN, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
    selector, again = selectors.DefaultSelector(), [0.0] * HALF_OPEN
    opened = False
    while True:
        now = time.monotonic()
        while again and again[0] <= now:
            again.pop(0)
            link = socket.socket()
            link.settimeout(_PATIENCE)
            with suppress(OSError):
                link.connect((host, int(port)))
                link.sendall(_HALF)
            link.setblocking(False)
            selector.register(link, selectors.EVENT_READ)
        if not opened and not again:
            opened = True
            print("ready", flush=True)
        for key, _ in selector.select(0.05):
            selector.unregister(key.fileobj)
            assert isinstance(key.fileobj, socket.socket)  # noqa: S101 - ours
            key.fileobj.close()
            insort(again, time.monotonic() + random.uniform(1.0, 3.0))  # noqa: S311 - no secret


def checks(host: str, port: str, token: str) -> None:
    """Have a description checked again and again; say how often, when standard input ends."""
    body = json.dumps({"description": shipped_arms()["sixaxis"].read_text()})
    headers = {"Authorization": f"Bearer {token}", "Content-Type": "application/json"}
    count, lost, ending = 0, 0, threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), ending.set()), daemon=True).start()
    while not ending.is_set():
        link = http.client.HTTPConnection(host, int(port), timeout=_PATIENCE)
        try:
            link.request("POST", "/api/v1/descriptions/check", body, headers)
            answer = link.getresponse()
            content = answer.read()
        except (OSError, http.client.HTTPException):  # its line had to go for one of the half requests
            lost += 1
            continue
        finally:
            link.close()
        if answer.status != 200:
            raise RuntimeError(f"the check was answered with {answer.status}: {content!r}")
        if count == 0:
            print("ready", flush=True)
        count += 1
    print(lost, count, flush=True)


def viewers(host: str, port: str, token: str) -> None:
    """Follow the stream of all events forty times; say how many were told, when standard input ends."""
    head = f"GET /api/v1/events HTTP/1.1\r\nHost: {host}\r\nAuthorization: Bearer {token}\r\n\r\n".encode()
    selector, told, ending = selectors.DefaultSelector(), 0, threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), ending.set()), daemon=True).start()
    for _ in range(VIEWERS):
        link = socket.create_connection((host, int(port)), _PATIENCE)
        link.sendall(head)
        link.recv(1)
        link.setblocking(False)
        selector.register(link, selectors.EVENT_READ)
    print("ready", flush=True)
    while not ending.is_set():
        for key, _ in selector.select(0.1):
            assert isinstance(key.fileobj, socket.socket)  # noqa: S101 - ours
            data = key.fileobj.recv(65536)
            if not data:
                raise RuntimeError("the daemon has cut the line of a viewer")
            told += data.count(b"event: ")
    print(told, flush=True)


def _rows(name: str, seconds: list[float], target: str | None) -> list[Row]:
    ordered = sorted(seconds)
    return [
        Row(f"{name}, median", 1e3 * statistics.median(ordered), "ms"),
        Row(f"{name}, 99 %", 1e3 * ordered[int(0.99 * (len(ordered) - 1))], "ms"),
        Row(f"{name}, worst of {len(ordered)}", 1e3 * ordered[-1], "ms", target),
    ]


def main() -> None:
    gc.disable()  # of the clients: a collection of theirs is not the daemon's
    rows = []
    for quiet in (True, False):
        with tempfile.TemporaryDirectory() as folder:
            measured = measure(Path(folder), quiet=quiet)
        name = "nothing else" if quiet else "all at once"
        rows += _rows(f"{name}: obeyed by the arm", measured.obeyed, TARGET)
        rows += _rows(f"{name}: answered", measured.answered, None)
        rows.append(Row(f"{name}: log", measured.log_bytes / 1e3, "kB"))
    rows.append(Row("descriptions checked meanwhile", measured.checked, ""))
    rows.append(Row("events told to viewers meanwhile", measured.watched, ""))
    print(table(rows))
    print(f"written to {write(rows, Path(__file__).parent / 'results', 'stops')}")


PARTS = {"arms": arms, "halves": halves, "checks": checks, "viewers": viewers}

if __name__ == "__main__":
    if len(sys.argv) > 1:
        PARTS[sys.argv[1]](*sys.argv[2:])
    else:
        main()
