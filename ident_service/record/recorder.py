"""Keeps the disk away from the motion loop: a thread writes what the loop puts into a bounded queue.

Samples are handed over in batches, because waking a thread costs more than keeping a sample. A batch is at most 64
samples or 40 ms of sample time, so that together with a chunk less than 0.2 s is lost to a kill -9. In lock step, time
stands still while the recorder writes, and there is no thread at all.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from ident_service.errors import RecordingError
from ident_service.record.writer import RecordingWriter, Vector

_BATCH_SAMPLES: Final = 64
_BATCH_NS: Final = 40_000_000

_Job = tuple[Callable[..., None], tuple[Any, ...]]


class Recorder:
    """A context manager around a RecordingWriter: entering opens it (and starts the thread), leaving finishes it.

    Attributes:
        overruns: how often `put` or `event` found the queue full; zero in lock step.
    """

    def __init__(self, writer: RecordingWriter, *, lock_step: bool, batches: int = 128) -> None:
        """Take over `writer`, which nobody else may use until the context is left.

        Args:
            writer: not entered yet.
            lock_step: whether time waits for the recorder (a clock's `lock_step`).
            batches: length of the queue, without lock step; at 1 kHz a batch is 41 samples.
        """
        self.overruns = 0
        self._writer = writer
        self._lock_step = lock_step
        self._queue: queue.Queue[list[_Job] | None] = queue.Queue(batches)
        self._batch: list[_Job] = []
        self._batch_start_ns = 0
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)

    def __enter__(self) -> Self:
        """Open the file; raises what RecordingWriter raises."""
        self._writer.__enter__()
        if not self._lock_step:
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close; a second error after a first one becomes a note on the first."""
        try:
            self.close(complete=kind is None)
        except RecordingError as second:
            if error is None:
                raise
            error.add_note(f"the recording failed too: {second}")

    @property
    def error(self) -> str:
        """Why nothing is recorded any more, empty as long as something is."""
        return "" if self._error is None else str(self._error)

    def put(
        self,
        stamp_ns: int,
        position: Vector,
        velocity: Vector | None,
        torque: Vector,
        reference_position: Vector,
        reference_velocity: Vector,
        cycle: int,
        lateness_ns: int,
        compute_ns: int,
        valid: NDArray[np.bool_],
        age: NDArray[np.int64],
        lost: int,
    ) -> bool:
        """Record one cycle; the arguments are those of `RecordingWriter.sample`, and arrays are copied.

        In lock step this returns when the sample is written. Otherwise it never waits and never drops: a sample that
        found the queue full is kept for the next call, but `False` tells the loop that the disk does not follow and
        that it must bring the arm to a stop.

        Returns:
            Whether the recorder keeps up.

        Raises:
            RecordingError: this (in lock step) or an earlier sample could not be written.
        """
        if self._lock_step:
            motion = (position, velocity, torque, reference_position, reference_velocity)
            rest = (cycle, lateness_ns, compute_ns, valid, age, lost)
            return self._write_through(self._writer.sample, (stamp_ns, *motion, *rest))
        arrays = (
            np.array(position, dtype=np.float64),
            None if velocity is None else np.array(velocity, dtype=np.float64),
            np.array(torque, dtype=np.float64),
            np.array(reference_position, dtype=np.float64),
            np.array(reference_velocity, dtype=np.float64),
        )
        timing = (cycle, lateness_ns, compute_ns, np.array(valid), np.array(age), lost)
        return self._put(stamp_ns, (self._writer.sample, (stamp_ns, *arrays, *timing)), now=False)

    def event(self, stamp_ns: int, level: int, message: str) -> bool:
        """Record one event behind the samples put so far; arguments and result as for the writer and for `put`."""
        if self._lock_step:
            return self._write_through(self._writer.event, (stamp_ns, level, message))
        return self._put(stamp_ns, (self._writer.event, (stamp_ns, level, message)), now=True)

    def close(self, *, complete: bool = True) -> None:
        """Write all that was put and finish the file; does nothing the second time.

        Raises:
            RecordingError: a sample could not be written, or the file cannot be finished.
        """
        if self._thread.is_alive():
            # The thread takes from the queue until it sees the end, even after an error: these cannot block for good.
            self._queue.put(self._batch)
            self._queue.put(None)
            self._thread.join()
            self._batch = []
        try:
            self._writer.finish(complete=complete and self._error is None)
        finally:
            self._raise_error()

    def _put(self, stamp_ns: int, job: _Job, *, now: bool) -> bool:
        self._raise_error()
        if not self._batch:
            self._batch_start_ns = stamp_ns
        self._batch.append(job)
        if not now and len(self._batch) < _BATCH_SAMPLES and stamp_ns - self._batch_start_ns < _BATCH_NS:
            return True
        try:
            self._queue.put_nowait(self._batch)
        except queue.Full:
            self.overruns += 1
            return False
        self._batch = []
        return True

    def _run(self) -> None:
        while (batch := self._queue.get()) is not None:
            for write, arguments in batch:
                self._write(write, arguments)
                # A whole batch in one go would hold the interpreter for a cycle's worth of time.
                time.sleep(0)

    def _write_through(self, write: Callable[..., None], arguments: tuple[Any, ...]) -> bool:
        self._raise_error()
        self._write(write, arguments)
        self._raise_error()
        return True

    def _write(self, write: Callable[..., None], arguments: tuple[Any, ...]) -> None:
        if self._error is not None:
            return
        try:
            write(*arguments)
        except Exception as error:  # noqa: BLE001 - whatever it is, the loop's thread has to hear of it
            self._error = error

    def _raise_error(self) -> None:
        if self._error is None:
            return
        if isinstance(self._error, RecordingError):
            raise self._error
        raise RecordingError(self._writer.path, f"recording failed: {self._error}") from self._error
