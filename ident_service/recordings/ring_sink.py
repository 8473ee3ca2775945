"""Put the motion loop's records into the ring, and report whether they are still being recorded.

`put` copies the record, looks at words that the recorder keeps in the ring's memory and, now and then, asks the kernel
whether the recorder lives. It answers False in real time, and goes on writing into the ring, when

* the recorder has said that it failed (a full disk) or that it ended;
* the recorder's process is gone, or has not read the ring for two seconds;
* more than a share of the ring waits to be taken.

In lock step time stands still meanwhile, so that `put` may wait: for the third, until the recorder has made room, woken
by an event counter. The first two, or a wait without end, raise there instead of returning False. Which
samples reach the file is thus the same every time; the loop and the disk still work side by side.
"""

from __future__ import annotations

import os
import select
import struct
import time
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Final

from ident_service.errors import RecordingError, RecordingNotWritten
from ident_service.recordings import ring_buffer as at
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.ring_buffer import RingWriter, State

SHARE: Final = 0.5
SILENCE_NS: Final = 2_000_000_000
PATIENCE: Final = 30.0

_LOOK_EVERY: Final = 16  # records between two questions to the kernel
_DIED: Final = "the recorder's process died"


@dataclass(frozen=True)
class SinkEnds:
    """Hold the file descriptors that a sink needs, in whatever process; `astuple` lists them for `pass_fds`.

    Attributes:
        ring: the ring's memory.
        recorder: pidfd of the recorder's process.
        work: event counter that wakes the recorder.
        room: event counter on which the recorder wakes a waiting sink.
    """

    ring: int
    recorder: int
    work: int
    room: int

    def close(self) -> None:
        """Close all descriptors in this process."""
        for fd in astuple(self):
            os.close(fd)


class RingSink:
    """Implement the motion loop's sink (`motion/run.py`, `Sink`) on a ring that a recorder process drains.

    Attributes:
        overruns: how often `put` or `event` answered False.
        writer: of the ring.
    """

    def __init__(
        self,
        ends: SinkEnds,
        path: Path | str,
        *,
        lock_step: bool,
        share: float = SHARE,
        patience: float = PATIENCE,
    ) -> None:
        """Attach to the ring as its writer.

        Args:
            ends: ends of the connection to the recorder, which is running; they stay the caller's, and open as long as
                this is used.
            path: of the recording, for messages.
            lock_step: whether time waits for the recorder (a clock's `lock_step`).
            share: share of the ring that may wait to be taken, 0 to 1; 0 in lock step waits for every single record.
            patience: how long to wait for a recorder that takes nothing [s]; in lock step.

        Raises:
            UsageError: not a ring, or one that has a writer.
        """
        self.writer = RingWriter(ends.ring)
        self.overruns = 0
        self._path = Path(path)
        self._ends = ends
        self._lock_step = lock_step
        self._patience = patience
        self._words = self.writer.memory.words
        self._most = int(share * self.writer.memory.slots)
        self._gone = ""
        self._recorder = select.poll()
        self._recorder.register(ends.recorder, select.POLLIN)
        self._room = select.poll()
        self._room.register(ends.recorder, select.POLLIN)
        self._room.register(ends.room, select.POLLIN)

    @property
    def error(self) -> str:
        """Return why the recorder takes no more records, as it reported or since it was found dead; else empty."""
        if self._words[at.STATE] == State.FAILED:
            return self.writer.memory.text()
        return self._gone

    def put(self, cycle: Cycle) -> bool:
        """Put one cycle into the ring, then return whether the recorder keeps up; in lock step wait until it does.

        The cycle's arrays are copied. Out of lock step this never waits.

        Returns:
            Whether the recording keeps up; in lock step always True.

        Raises:
            RecordingError: a value that does not fit the ring; in lock step also a recorder that failed or died.
        """
        try:
            self.writer.put(cycle)
        except (ValueError, struct.error) as error:
            raise RecordingError(self._path, f"recording failed: {error}") from error
        return self._wait() if self._lock_step else self._keeps_up()

    def event(self, stamp_ns: int, level: int, message: str) -> bool:
        """Put one event into the ring, then return whether the recorder keeps up; in lock step wait until it does."""
        try:
            self.writer.event(stamp_ns, level, message)
        except struct.error as error:
            raise RecordingError(self._path, f"recording failed: {error}") from error
        return self._wait() if self._lock_step else self._keeps_up()

    def close(self, *, complete: bool = True) -> None:
        """Mark the ring as closed and wake the recorder; does not wait for it, and does nothing the second time."""
        if self.writer.close(finished=complete):
            os.eventfd_write(self._ends.work, 1)

    def release(self) -> None:
        """Unmap the ring's memory; nothing can be put or asked any more."""
        self.writer.memory.close()

    def _keeps_up(self) -> bool:
        """Check that the recorder is running, alive and near enough to the writer."""
        words, written = self._words, self.writer.written
        if written % _LOOK_EVERY == 0 and self._recorder.poll(0):
            self._gone = _DIED
        kept = (
            words[at.STATE] == State.RUNNING
            and not self._gone
            and written - words[at.CURSOR] <= self._most
            and words[at.WRITER_HEARTBEAT] - words[at.RECORDER_HEARTBEAT] <= SILENCE_NS
        )
        if not kept:
            self.overruns += 1
        return kept

    def _wait(self) -> bool:
        """Wait until few enough records are waiting to be taken; returns True.

        Raises:
            RecordingNotWritten: the recorder failed or died, or took nothing for longer than our patience.
        """
        words, written = self._words, self.writer.written
        if written % _LOOK_EVERY == 0 and self._recorder.poll(0):
            self._gone = _DIED
        deadline = time.monotonic() + self._patience
        cursor = words[at.CURSOR]
        while True:
            if words[at.STATE] != State.RUNNING or self._gone:
                raise RecordingNotWritten(self._path, self.error or "the recorder has ended")
            if written - words[at.CURSOR] <= self._most:
                return True
            if words[at.CURSOR] != cursor:
                cursor, deadline = words[at.CURSOR], time.monotonic() + self._patience
            if (left := deadline - time.monotonic()) <= 0:
                raise RecordingNotWritten(self._path, f"the recorder has taken nothing for {self._patience:g} s")
            os.eventfd_write(self._ends.work, 1)
            for fd, _ in self._room.poll(left * 1e3):
                if fd == self._ends.room:
                    os.eventfd_read(self._ends.room)
                else:
                    self._gone = _DIED
