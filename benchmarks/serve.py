"""How long after the start of `ident serve` a browser has its first page: whole, with the style and script it loads.

`python -m benchmarks.serve`, about a minute. Each start is a process of its own, with the files warm; the clock runs
from before the process is made until the last byte came. Looked at are the page that asks for a token, of a state
folder that does not exist yet, and the lists of arms and of runs, of a daemon that has served for long. A browser that
is refused asks again every two milliseconds.
"""

from __future__ import annotations

import http.client
import os
import re
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from benchmarks.harness import Row, table, write
from ident_service.config.load import load_arm
from ident_service.operations.commissioning import simulate
from ident_service.registry import jobs
from ident_service.registry.arms import register_shipped_arms
from ident_service.registry.database import Database
from ident_service.registry.runs import RUNS, index_run

STARTS = int(os.environ.get("IDENT_BENCH_STARTS", "9"))
RUNS_KEPT, JOBS_KEPT = 200, 500
TARGET = "< 1.5"
_ARM = "planar2"
_PATIENCE = 60.0  # s
_ASSETS = re.compile(rb'(?:href|src)="(/static/[^"]+)"')


def measure(folder: Path) -> list[Row]:
    """All figures."""
    aged = folder / "aged"
    first_page(aged, "/login")
    fill(aged, folder / "once")
    rows: list[Row] = []
    for name, page, states in (
        ("no state folder yet", "/login", [folder / f"fresh{k}" for k in range(1 + STARTS)]),
        (f"{RUNS_KEPT} runs, {JOBS_KEPT} jobs, arms listed", "/", [aged] * (1 + STARTS)),
        (f"{RUNS_KEPT} runs, {JOBS_KEPT} jobs, runs listed", "/runs", [aged] * (1 + STARTS)),
    ):
        times = [first_page(state, page) for state in states][1:]
        for word, value in (("minimum", min(times)), ("median", statistics.median(times)), ("maximum", max(times))):
            rows.append(Row(f"{name}: {word} of {STARTS}", value, "s", TARGET))
    return rows


def fill(state: Path, made: Path) -> None:
    """Runs and jobs of a daemon that has served for long; one run was made, the others are its files once more."""
    simulate(load_arm(_ARM), made)
    with Database(state) as db:
        register_shipped_arms(db)
        for k in range(RUNS_KEPT):
            run = f"{_ARM}-20250101-{k:06d}"
            place = state / RUNS / run
            place.mkdir(parents=True)
            for path in made.rglob("*"):
                if path.is_dir():
                    (place / path.relative_to(made)).mkdir(parents=True, exist_ok=True)
                else:
                    (place / path.relative_to(made)).parent.mkdir(parents=True, exist_ok=True)
                    (place / path.relative_to(made)).hardlink_to(path)
            index_run(db, state, run)
        for k in range(JOBS_KEPT):
            job, run = f"job-{k:06d}", f"{_ARM}-20250101-{k % RUNS_KEPT:06d}"
            kind = "simulate" if k < RUNS_KEPT else "report"
            jobs.add_job(db, job, kind, _ARM, {"kind": kind}, [kind, _ARM], "owner", motion=False, run_id=run)
            jobs.mark_started(db, job, "")
            jobs.mark_ended(db, job, "done", "", 0)


def first_page(state: Path, page: str) -> float:
    """Seconds from the start of a daemon to the whole of a page; the daemon is ended afterwards."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    token = state / "token"
    headers = {} if page == "/login" else {"Authorization": f"Bearer {token.read_text().strip()}"}
    words = ["serve", "--port", str(port), "--state", str(state)]
    begin = time.perf_counter()
    with subprocess.Popen(
        [sys.executable, "-m", "ident_service", *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as daemon:
        try:
            content = _asked(daemon, port, page, headers, begin + _PATIENCE)
            for asset in dict.fromkeys(_ASSETS.findall(content)):
                _asked(daemon, port, asset.decode(), headers, begin + _PATIENCE)
            seconds = time.perf_counter() - begin
        finally:
            daemon.send_signal(signal.SIGTERM)
    if not content.rstrip().endswith(b"</html>") or daemon.returncode != 0:
        raise RuntimeError(f"{page}: half a page, or the daemon ended with {daemon.returncode}")
    return seconds


def _asked(daemon: subprocess.Popen[bytes], port: int, path: str, headers: dict[str, str], until: float) -> bytes:
    """What is answered with 200, asked for until somebody listens."""
    while True:
        link = http.client.HTTPConnection("127.0.0.1", port, timeout=_PATIENCE)
        with suppress(ConnectionRefusedError):
            link.request("GET", path, headers=headers)
            answer = link.getresponse()
            content = answer.read()
            link.close()
            if answer.status != 200:
                raise RuntimeError(f"{path}: answered with {answer.status}")
            return content
        if daemon.poll() is not None or time.perf_counter() > until:
            raise RuntimeError(f"{path}: nobody listens; the daemon: {daemon.poll()}")
        time.sleep(0.002)


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        rows = measure(Path(folder))
    print(table(rows))
    print(f"written to {write(rows, Path(__file__).parent / 'results', 'serve')}")


if __name__ == "__main__":
    main()
