"""What tests of the recorder's process share: a recorder, a pace, other processes, and what a torn file must hold."""

from __future__ import annotations

import os
import select
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from record_samples import read_all
from ring_actors import JOINTS, command, record, store

from ident_service.recordings import ring_buffer as ring_memory
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.mcap_reader import McapRecording
from ident_service.recordings.recorder import RecorderProcess
from ident_service.recordings.ring_buffer import RingReader
from ident_service.recordings.ring_sink import RingSink

URDF = "<robot/>"
WHAT = (JOINTS, URDF, 5, {"arm.yaml": bytes(range(256))}, {"run": "ä"})


def process(path: Path, *, lock_step: bool = False, **options: object) -> RecorderProcess:
    return RecorderProcess(path, *WHAT, lock_step=lock_step, **options)  # type: ignore[arg-type]


def paced(sink: RecorderProcess | RingSink, numbers: range, pace: float = 1e-3) -> list[bool]:
    """Put records at a fixed rate; what was answered."""
    begin, answers = time.monotonic(), []
    for n in numbers:
        time.sleep(max(0.0, begin + (n - numbers.start) * pace - time.monotonic()))
        answers.append(bool(store(sink, n)))
    return answers


def await_stream(parent: subprocess.Popen[str]) -> None:
    """Return when the writer that a parent started has put something, and a little later."""
    assert parent.stdout is not None
    assert parent.stdout.readline() == "streaming\n"
    time.sleep(0.2)


def caught_up(recorder: RecorderProcess) -> None:
    with RingReader(recorder.ends.ring) as watch:
        words = watch.memory.words
        deadline = time.monotonic() + 20.0
        while words[ring_memory.CURSOR] < words[ring_memory.WRITTEN]:
            assert time.monotonic() < deadline
            time.sleep(0.001)


def cycles(count: int) -> list[Cycle]:
    return [made for made in map(record, range(count)) if isinstance(made, Cycle)]


def check_prefix(path: Path, recorder_torn: bool) -> int:
    """The file reads, holds the first records and nothing else; how many of the samples."""
    recording = McapRecording(path)
    assert recording.torn == recorder_torn
    assert recording.metadata["complete"] == "false"
    assert recording.metadata["run"] == "ä"
    block = read_all(recording)
    count = len(block.stamp_ns)
    expected = cycles(count * 7 // 6 + 7)[:count]
    assert block.stamp_ns.tolist() == [made.stamp_ns for made in expected]
    assert np.array_equal(block.position, [made.position for made in expected])
    assert np.array_equal(block.torque, [made.torque for made in expected])
    return count


@contextmanager
def actor(role: str, *arguments: object) -> Iterator[tuple[subprocess.Popen[str], list[int]]]:
    """Another process, and the process ids that it says in its first line."""
    started = subprocess.Popen(command(role, *arguments), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        assert started.stdout is not None
        yield started, [int(pid) for pid in started.stdout.readline().split()]
    finally:
        started.kill()
        started.communicate()


@contextmanager
def ending(pid: int) -> Iterator[None]:
    """Inside, something happens of which a process that is not our child ends."""
    pidfd = os.pidfd_open(pid)
    try:
        yield
        assert select.select([pidfd], [], [], 20.0)[0], f"process {pid} is left behind"
    finally:
        os.close(pidfd)
