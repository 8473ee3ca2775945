"""Medians of repeated calls, and a table of them."""

from __future__ import annotations

import json
import os
import platform
import resource
import statistics
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path


@dataclass(frozen=True)
class Row:
    """One figure: what, how much, in what unit, against which target (None: for information)."""

    name: str
    value: float
    unit: str
    target: str | None = None


def median_seconds(call: Callable[[], object], repeats: int = 7, warmups: int = 1) -> float:
    """Median wall time of `call` [s] after some calls that do not count."""
    for _ in range(warmups):
        call()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def cpu_seconds(words: Sequence[str]) -> tuple[float, str]:
    """Return the processor seconds of a command with all its children, and what it printed; one BLAS thread."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(words, check=True, capture_output=True, text=True, env=environment)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, done.stdout


def table(rows: list[Row]) -> str:
    """Rows for people."""
    lines = [f"{'figure':64s} {'value':>12s} {'unit':14s} target"]
    lines += [f"{row.name:64s} {row.value:12.4g} {row.unit:14s} {row.target or ''}" for row in rows]
    return "\n".join(lines) + "\n"


def write(rows: list[Row], folder: Path, name: str = "benchmarks") -> Path:
    """Rows for programs, in `<name>.json`."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.json"
    document = {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": f"{platform.machine()}, Python {platform.python_version()}",
        "rows": [asdict(row) for row in rows],
    }
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    return path
