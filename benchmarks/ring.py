"""The ring and the recorder's process: what a cycle pays for being recorded, and whether all of it arrives.

About half a minute: `python -m benchmarks.ring`. The machine is used as it is, without real-time privileges.
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.harness import Row, table, write
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.mcap_reader import McapRecording
from ident_service.recordings.recorder import RecorderProcess
from ident_service.recordings.ring_buffer import RingReader, RingWriter, create_ring

_JOINTS = 7
_SECONDS = float(os.environ.get("IDENT_BENCH_RING_SECONDS", "60"))
_PERIOD_NS = 1_000_000


def measure() -> list[Row]:
    """All figures."""
    with tempfile.TemporaryDirectory() as folder:
        return [*_ring(), *_full_speed(Path(folder) / "fast.mcap"), *_stream(Path(folder) / "stream.mcap")]


def _samples(count: int) -> list[Cycle]:
    q = np.arange(_JOINTS, dtype=np.float64)
    valid, age = np.ones(_JOINTS, np.bool_), np.zeros(_JOINTS, np.int64)
    return [
        Cycle(k * _PERIOD_NS, np.sin(q + k * 1e-3), None, np.cos(q + k * 1e-3), q, q, k, 0, 0, valid, age, 0)
        for k in range(count)
    ]


def _ring() -> list[Row]:
    """The ring alone, in one process, hot."""
    fd = create_ring(_JOINTS)
    writer, samples, seconds = RingWriter(fd), _samples(4096), []
    with RingReader(fd) as reader:
        put_ns = []
        for _ in range(20):
            for sample in samples:
                begin = time.perf_counter_ns()
                writer.put(sample)
                put_ns.append(time.perf_counter_ns() - begin)
            begin = time.perf_counter_ns()
            while reader.read() is not None:
                pass
            seconds.append((time.perf_counter_ns() - begin) * 1e-9)
        rows = [
            *_percentiles("ring: put of one 7-joint sample, hot", np.array(put_ns), "< 10 median"),
            Row("ring: reader, records a second", len(samples) / float(np.median(seconds)), "1/s"),
            Row("ring: lost while measuring these", reader.lost, "records", "0"),
        ]
    writer.memory.close()
    os.close(fd)
    return rows


def _full_speed(path: Path) -> list[Row]:
    """In lock step, as a simulation would put that computes nothing: the speed of ring, recorder and disk."""
    samples = _samples(20_000)
    with _recorder(path, lock_step=True) as recorder:
        begin = time.perf_counter()
        for sample in samples:
            recorder.put(sample)
    seconds = time.perf_counter() - begin
    return [Row("recorder: samples a second into the file, lock step", len(samples) / seconds, "1/s")]


def _stream(path: Path) -> list[Row]:
    """At 1 kHz in real time, with the recorder running beside."""
    samples = _samples(round(_SECONDS * 1e9 / _PERIOD_NS))
    put_ns, behind = np.zeros(len(samples), np.int64), 0
    with _recorder(path, lock_step=False) as recorder:
        begin = time.monotonic_ns()
        for k, sample in enumerate(samples):
            time.sleep(max(0, begin + k * _PERIOD_NS - time.monotonic_ns()) * 1e-9)
            start = time.perf_counter_ns()
            behind += not recorder.put(sample)
            put_ns[k] = time.perf_counter_ns() - start
        closing = time.perf_counter()
    seconds = time.perf_counter() - closing
    if recorder.report is None:
        raise RuntimeError("the recorder said nothing about its end")
    found = sum(len(block.stamp_ns) for block in McapRecording(path).blocks())
    name = f"recorder: {_SECONDS:g} s at 1 kHz"
    return [
        *_percentiles(f"{name}: put, woken from sleep each time", put_ns, None),
        Row(f"{name}: samples put", len(samples), "samples"),
        Row(f"{name}: put but not in the file", len(samples) - found, "samples", "0"),
        Row(f"{name}: lost in the ring", recorder.report.lost, "records", "0"),
        Row(f"{name}: answers that it is behind", behind, "", "0"),
        Row(f"{name}: finishing the file", seconds, "s"),
    ]


def _percentiles(name: str, nanoseconds: np.ndarray, target: str | None) -> list[Row]:
    median, most = np.percentile(nanoseconds, [50, 99.9]) * 1e-3
    return [Row(f"{name}, median", float(median), "us", target), Row(f"{name}, 99.9 %", float(most), "us")]


def _recorder(path: Path, *, lock_step: bool) -> RecorderProcess:
    names = [f"joint_{k + 1}" for k in range(_JOINTS)]
    return RecorderProcess(path, names, "<robot/>", 0, lock_step=lock_step)


if __name__ == "__main__":
    found = measure()
    print(table(found))
    print(f"written to {write(found, Path(__file__).parent / 'results', 'ring')}")
