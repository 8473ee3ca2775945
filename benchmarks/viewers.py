"""What ten viewers of the live page cost the motion process: the loop's own histograms with them and without.

`python -m benchmarks.viewers`, about eight minutes on a machine that does nothing else. A daemon runs a simulated arm
in real time, its plant in a process of its own, again and again, by turns without a viewer and with ten: nine processes
that read the stream of the page, and a browser where Chromium can be had. Viewers have other machines in life. Here
they share this one: they get the lowest priority, and where there is more than one core, all but the last, which the
motion process asks for; what the daemon does for them is left to run where it likes. `$IDENT_BENCH_PAIRS` (5) and
`$IDENT_BENCH_RATE` (200 Hz) change what is run.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import Row, table, write
from ident_service.client import IdentClient
from ident_service.errors import MotionRefused
from ident_service.recordings.mcap_reader import read_cycles

PAIRS = int(os.environ.get("IDENT_BENCH_PAIRS", "5"))
RATE = int(os.environ.get("IDENT_BENCH_RATE", "200"))
VIEWERS = 10
ARM = "watched"
_DRIVER = "{time: real, process: separate, watchdog: 0.5, deadline: 2.0}"
_TRIES = 3
_SHARES = (("median", 0.5), ("99 %", 0.99), ("99.9 %", 0.999), ("worst", 1.0))
_KINDS = ("without", "with")


@dataclass(frozen=True)
class Ran:
    """One run: the motion process' report, what its cycles wrote down [us], (cycles,), and runs before that faulted."""

    report: dict[str, Any]
    lateness: np.ndarray
    compute: np.ndarray
    faulted: int


def measure(folder: Path) -> tuple[list[Row], str]:
    """All figures, and what they say in words."""
    state = folder / "state"
    with _daemon(state) as (url, token):
        client = IdentClient(url, token)
        description = f"extends: planar2\nname: {ARM}\ncontrol: {{rate: {RATE}}}\ndriver: {_DRIVER}\n"
        client.post("/api/v1/arms", {"description": description})
        _followed(client, "check", [])
        runs: dict[str, list[Ran]] = {kind: [] for kind in _KINDS}
        seen = []
        for pair in range(PAIRS):
            # The first of a pair is not always the same.
            for kind in _KINDS if pair % 2 == 0 else _KINDS[::-1]:
                ran, counts = _run(client, state, url, token, VIEWERS if kind == "with" else 0)
                runs[kind].append(ran)
                seen += counts
                print(f"pair {pair + 1}, {kind} viewers: {_said(ran)}", flush=True)
        client.close()
    return _figures(runs, seen), _words(runs)


def _run(client: IdentClient, state: Path, url: str, token: str, viewers: int) -> tuple[Ran, list[int]]:
    """One run that reached its end, and what each viewer saw."""
    for faulted in range(_TRIES):
        with _watching(url, token, viewers) as watching:
            job, counts = _followed(client, "run", watching)
        if job["state"] == "done":
            if viewers and min(counts) == 0:
                raise RuntimeError(f"a viewer saw nothing: {counts}")
            place = state / "runs" / job["run"]
            parts = list(read_cycles(place / "run.mcap"))
            lateness, compute = (
                np.concatenate([getattr(part, name) for part in parts]) * 1e-3 for name in ("lateness_ns", "compute_ns")
            )
            return Ran(json.loads((place / "ended.json").read_text()), lateness, compute, faulted), counts
        print(f"{viewers} viewers, run again: {job['state']}: {job['detail']}")
        for fault in client.get(f"/api/v1/arms/{ARM}")["faults"]:
            client.post(f"/api/v1/arms/{ARM}/faults/{fault['code']}/ack")
    raise RuntimeError(f"no run of {_TRIES} reached its end; this machine does not keep {RATE} Hz")


def _followed(
    client: IdentClient, kind: str, watching: Sequence[subprocess.Popen[str]]
) -> tuple[dict[str, Any], list[int]]:
    """A motion, confirmed and with its lease renewed until it has ended; what each viewer saw."""
    client.get("/healthz")  # a line that lay idle is made anew for what only reads
    word = client.post(f"/api/v1/arms/{ARM}/challenge")["challenge"]
    asked = {"job": {"kind": kind, "arm": ARM}, "confirm": {"name": ARM, "challenge": word}}
    job = client.post("/api/v1/jobs", asked)["id"]
    for viewer in watching:
        assert viewer.stdin is not None  # noqa: S101 - asked for
        viewer.stdin.write(f"{job}\n")
        viewer.stdin.flush()
    while (now := client.get(f"/api/v1/jobs/{job}"))["state"] in ("queued", "running"):
        with suppress(MotionRefused):  # it does not run yet, or has just ended
            client.post(f"/api/v1/jobs/{job}/lease")
        time.sleep(0.4)
    if kind != "run" and now["state"] != "done":
        raise RuntimeError(f"{kind}: {now['state']}: {now['detail']}")
    return now, [int(viewer.communicate(timeout=60)[0] or 0) for viewer in watching]


@contextmanager
def _daemon(state: Path) -> Iterator[tuple[str, str]]:
    """A daemon on a free port: where, and its owner's token."""
    words = ["serve", "--port", "0", "--state", str(state)]
    with subprocess.Popen(
        [sys.executable, "-m", "ident_service", *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as daemon:
        try:
            while not (state / "serve.url").exists():
                if daemon.poll() is not None:
                    raise RuntimeError(f"the daemon ended with {daemon.returncode}")
                time.sleep(0.05)
            yield (state / "serve.url").read_text().strip(), (state / "token").read_text().strip()
        finally:
            daemon.send_signal(signal.SIGTERM)


@contextmanager
def _watching(url: str, token: str, count: int) -> Iterator[list[subprocess.Popen[str]]]:
    """Viewers that are loaded and wait for a job; killed at the end if they live still."""
    chromium = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
    browser = [chromium] if chromium and find_spec("playwright") else []
    viewers = [
        subprocess.Popen(
            [sys.executable, "-m", "benchmarks.viewer", url, *(browser if number == 0 else [])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "IDENT_TOKEN": token},
            preexec_fn=_aside,
            start_new_session=True,
        )
        for number in range(count)
    ]
    try:
        for viewer in viewers:
            assert viewer.stdout is not None  # noqa: S101 - asked for
            if viewer.stdout.readline() != "ready\n":
                raise RuntimeError("a viewer does not start")
        yield viewers
    finally:
        for viewer in viewers:
            if viewer.poll() is None:
                os.killpg(viewer.pid, signal.SIGKILL)
            viewer.wait()


def _aside() -> None:
    """The lowest priority, and not on the core that a motion process asks for."""
    os.nice(19)
    if others := sorted(os.sched_getaffinity(0))[:-1]:
        os.sched_setaffinity(0, others)


def _said(ran: Ran) -> str:
    late, compute = ran.report["lateness"], ran.report["compute"]
    return (
        f"{late['count']} cycles, {_missed(ran)} missed; lateness 99.9 % below {late['p999_below_us']:g} us, worst "
        f"{late['worst_us']:.0f} us; computing 99.9 % below {compute['p999_below_us']:g} us, worst "
        f"{compute['worst_us']:.0f} us; {ran.report['real_time']}"
    )


def _missed(ran: Ran) -> int:
    """Cycles that began a whole period late or more."""
    return int((ran.lateness >= 1e6 / RATE).sum())


def _values(runs: list[Ran], which: str, share: float) -> np.ndarray:
    """A quantile of each run [us], shape (runs,)."""
    return np.array([np.quantile(getattr(ran, which), share) for ran in runs])


def _figures(runs: dict[str, list[Ran]], seen: list[int]) -> list[Row]:
    rows = []
    for kind in _KINDS:
        rows.append(Row(f"{kind} viewers: cycles", sum(ran.report["lateness"]["count"] for ran in runs[kind]), ""))
        rows.append(Row(f"{kind} viewers: begun a period late or more", sum(map(_missed, runs[kind])), "cycles"))
        rows.append(
            Row(f"{kind} viewers: runs besides, that a fault ended", sum(ran.faulted for ran in runs[kind]), "")
        )
        warned = sum(ran.report["warnings"].get("late_cycle", 0) for ran in runs[kind])
        rows.append(Row(f"{kind} viewers: counted as late by the guard", warned, "cycles"))
    rows.append(Row("fewest pieces, or rows of a browser, that a viewer saw", min(seen), ""))
    for which, name in (("lateness", "lateness"), ("compute", "computing")):
        for word, share in _SHARES:
            without, with_ = (_values(runs[kind], which, share) for kind in _KINDS)
            mean, error = _difference(with_ - without)
            rows.append(Row(f"{name}, {word}: without viewers, mean of {PAIRS} runs", float(without.mean()), "us"))
            rows.append(Row(f"{name}, {word}: with {VIEWERS}", float(with_.mean()), "us"))
            if without.mean() > 0.0:
                rows.append(Row(f"{name}, {word}: with over without", float(with_.mean() / without.mean()), "ratio"))
            rows.append(Row(f"{name}, {word}: difference", mean, "us"))
            rows.append(Row(f"{name}, {word}: its standard error over pairs", error, "us"))
    return rows


def _difference(pairs: np.ndarray) -> tuple[float, float]:
    return float(pairs.mean()), float(pairs.std(ddof=1) / np.sqrt(len(pairs))) if len(pairs) > 1 else float("nan")


def _words(runs: dict[str, list[Ran]]) -> str:
    """The histograms of all runs, and what they say."""
    lines = []
    for which in ("lateness", "compute"):
        documents = {kind: [ran.report[which] for ran in runs[kind]] for kind in _KINDS}
        counts = {kind: np.sum([one["counts"] for one in documents[kind]], axis=0) for kind in _KINDS}
        edges = [*(f"<= {edge}" for edge in documents["with"][0]["edges_us"]), "more"]
        lines.append(f"{which} in us: cycles without viewers, with {VIEWERS}")
        lines += [
            f"  {edge:>9s} {before:9d} {after:9d}"
            for edge, before, after in zip(edges, counts["without"], counts["with"], strict=True)
            if before or after
        ]
        told = []
        for word, share in _SHARES[:3]:
            without, with_ = (_values(runs[kind], which, share) for kind in _KINDS)
            mean, error = _difference(with_ - without)
            if mean and not abs(mean) <= 2.0 * error:
                told.append(f"{word} by {mean:+.1f} +- {error:.1f} us")
        changed = (
            f"viewers change the {', the '.join(told)}" if told else "no quantile changes beyond its doubt (2 sigma)"
        )
        lines.append(f"  {which}: {changed}")
    return "\n".join(lines)


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        rows, words = measure(Path(folder))
    print(f"\n{words}\n")
    print(table(rows))
    print(f"written to {write(rows, Path(__file__).parent / 'results', 'viewers')}")


if __name__ == "__main__":
    main()
