"""Records that tests of the ring and of the recorder's process share, and the other processes of these tests.

`python ring_actors.py ROLE ...`: `writer FD PAUSE`, `reader FD STALL`, `recording PATH PACE LOCK_STEP`,
`split PATH` (a parent that only starts the recorder) and `remote PATH COUNT PACE FDS...` (its writer).
"""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import astuple
from pathlib import Path

import numpy as np

from ident_service.recordings.cycle import Cycle
from ident_service.recordings.recorder import RecorderProcess
from ident_service.recordings.ring_buffer import EventRecord, Record, RingReader, RingWriter
from ident_service.recordings.ring_sink import RingSink, SinkEnds

JOINTS = ("shoulder", "elbow", "wrist_roll")
STEP_NS = 1_000_000


def record(n: int, joints: int = 3) -> Record:
    """What is written as record `n`: of every kind, and different in every byte that can differ."""
    if n % 7 == 6:
        return EventRecord(n * STEP_NS, 10 + n % 40, f"event {n} " + "ä" * (n % 50))
    q = np.arange(joints) * 0.1 + n
    velocity = None if n % 3 == 0 else q * 2.0
    valid = (np.arange(joints) + n) % 2 == 0
    measured = None if n % 4 == 0 else np.where(valid, -q, np.nan) if valid.any() else -q
    return Cycle(
        *(n * STEP_NS, q, velocity, -q, q * 3.0, q * 4.0),
        *(n, n % 11, n % 13, valid, np.arange(joints) + n, n // 2, measured),
    )


def store(writer: RingWriter | RingSink | RecorderProcess, n: int, joints: int = 3) -> object:
    """Put record `n`."""
    made = record(n, joints)
    return writer.put(made) if isinstance(made, Cycle) else writer.event(*made)


def same(one: Record, other: Record) -> bool:
    """Whether two records are equal to the bit."""
    return type(one) is type(other) and all(
        a.dtype == b.dtype and a.tobytes() == b.tobytes()
        if isinstance(a, np.ndarray) and isinstance(b, np.ndarray)
        else a == b and type(a) is type(b)
        for a, b in zip(one, other, strict=True)
    )


def writer(fd: str, pause: str) -> None:
    ring = RingWriter(int(fd))
    while True:
        store(ring, ring.written)
        if float(pause):
            time.sleep(float(pause))


def reader(fd: str, stall: str) -> None:
    """Read until the end of standard input, then what is left, and say what was found."""
    wrong = 0
    with RingReader(int(fd)) as ring:
        over = False
        while True:
            found = ring.read()
            if found is not None:
                wrong += not same(found, record(ring.cursor - 1))
                if float(stall) and ring.returned % 100 == 0:
                    time.sleep(float(stall))
            elif over:
                break
            else:
                over = bool(select.select([0], [], [], 0.001)[0])
        print(json.dumps({"returned": ring.returned, "lost": ring.lost, "cursor": ring.cursor, "wrong": wrong}))


def recording(path: str, pace: str, lock_step: str) -> None:
    with RecorderProcess(path, JOINTS, "<robot/>", 0, None, {"run": "ä"}, lock_step=lock_step == "True") as recorder:
        print(recorder.pid, flush=True)
        stream(recorder, 1 << 30, float(pace))


def split(path: str, count: str) -> None:
    with RecorderProcess(path, JOINTS, "<robot/>", 0, None, {"run": "ä"}, lock_step=False, local=False) as recorder:
        fds = [str(fd) for fd in astuple(recorder.ends)]
        command = [sys.executable, __file__, "remote", path, count, "0.001", *fds]
        with subprocess.Popen(command, pass_fds=astuple(recorder.ends)) as motion:
            print(recorder.pid, motion.pid, flush=True)
            motion.wait()


def remote(path: str, count: str, pace: str, *fds: str) -> None:
    sink = RingSink(SinkEnds(*map(int, fds)), path, lock_step=False)
    stream(sink, 20, 0.0)
    print("streaming", flush=True)
    stream(sink, int(count), float(pace), 20)
    sink.close()
    sink.release()


def stream(sink: RingSink | RecorderProcess, count: int, pace: float, first: int = 0) -> None:
    begin = time.monotonic()
    for n in range(first, count):
        if pace:
            time.sleep(max(0.0, begin + (n - first) * pace - time.monotonic()))
        store(sink, n)


def command(role: str, *arguments: object) -> list[str]:
    """How to start an actor."""
    return [sys.executable, str(Path(__file__)), role, *map(str, arguments)]


def inode(fd: int) -> int:
    return os.fstat(fd).st_ino


def holders(number: int) -> set[int]:
    """Processes that have the ring with this inode mapped or open."""
    return {int(process.name) for process in Path("/proc").glob("[0-9]*") if _holds(process, number)}


def _holds(process: Path, number: int) -> bool:
    with suppress(OSError):
        for line in (process / "maps").read_text(encoding="utf-8").splitlines():
            if "ident-ring" in line and line.split()[4] == str(number):
                return True
        for fd in (process / "fd").iterdir():
            with suppress(OSError):
                if "ident-ring" in str(fd.readlink()) and fd.stat().st_ino == number:
                    return True
    return False


if __name__ == "__main__":
    roles = {"writer": writer, "reader": reader, "recording": recording, "split": split, "remote": remote}
    roles[sys.argv[1]](*sys.argv[2:])
