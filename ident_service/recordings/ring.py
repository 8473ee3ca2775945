"""Implement a ring buffer in shared memory: one writer that never waits, readers that notice which records they missed.

Record n goes into slot `n mod slots`. The writer stores, in this order: the slot's sequence `2 n + 1`; its content;
the sequence `2 n + 2`; the count of records written, `n + 1`. A reader whose cursor is n loads the sequence, copies the
content, loads the sequence again, and believes the copy when both were `2 n + 2` and the checksum, which covers n,
fits.

========================= ===================================================================================
sequence                  what the reader makes of it
========================= ===================================================================================
`2 n + 2`, twice          record n, if the checksum fits; tried again a few times if not, then lost
above `2 n + 2`           overrun: the writer is a lap ahead; the cursor jumps to what still exists
below, n not yet written  nothing there; ask again
below, n long written     the writer was torn out of `put` (by a signal's exception) and went on: lost
========================= ===================================================================================

So at any time `cursor = records returned + records lost`. A writer that dies between any two stores leaves the slot's
sequence odd, or the record whole: nothing wrong can be read, and only the record in the making is missing. What is
assumed of the machine stands in `ring_memory.py`, the bytes of a slot in `ring_slot.py`. The two processes, and what
they tell each other beside the records, are `ring_sink.py`'s and `recorder_process.py`'s business.
"""

from __future__ import annotations

import os
import time
import zlib
from types import TracebackType
from typing import Final, Self

import numpy as np

from ident_service.errors import UsageError
from ident_service.recordings import ring_memory as at
from ident_service.recordings import ring_slot as slot
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.ring_memory import Closed, RingMemory, State
from ident_service.recordings.ring_slot import Record

SLOTS: Final = 8192  # eight seconds at 1 kHz; 4 MiB for up to eight joints

_RETRIES: Final = 16


def create_ring(joints: int, slots: int = SLOTS) -> int:
    """Create an empty ring; see `create_memory` for the file descriptor that it returns and the errors it raises."""
    return at.create_memory(joints, slots, slot.slot_bytes(joints))


class RingWriter:
    """Write records to a ring as its only writer.

    Attributes:
        memory: the ring's.
        written: records so far.
    """

    def __init__(self, fd: int) -> None:
        """Attach to a ring as its writer.

        Args:
            fd: of the ring; stays the caller's.

        Raises:
            UsageError: not a ring, or a ring that has a writer.
        """
        self.memory = RingMemory(fd, writable=True)
        if other := self.memory.words[at.WRITER_PID]:
            self.memory.close()
            raise UsageError(f"the ring has a writer already, process {other}")
        self.written = 0
        joints = self.memory.joints
        self._words, self._content = self.memory.words, self.memory.content
        self._words[at.WRITER_HEARTBEAT] = time.monotonic_ns()
        self._words[at.WRITER_PID] = os.getpid()
        # A record is put together here, so that it stands in shared memory half done for one copy only.
        self._stage = bytearray(self.memory.slot_bytes - 8)
        vectors = np.frombuffer(self._stage, np.float64, slot.VECTORS * joints, slot.AT_VECTORS)
        vectors = vectors.reshape(slot.VECTORS, joints)
        self._position, self._velocity, self._torque, self._q_reference, self._dq_reference, self._measured = vectors
        behind = slot.AT_VECTORS + 8 * slot.VECTORS * joints
        self._age = np.frombuffer(self._stage, np.int64, joints, behind)
        self._valid = np.frombuffer(self._stage, np.bool_, joints, behind + 8 * joints)
        self._shape = (joints,)
        self._cycle_bytes = slot.cycle_bytes(joints)
        whole = memoryview(self._stage)
        self._cycle_body = whole[slot.BODY : slot.BODY + self._cycle_bytes]
        self._cycle = whole[: slot.BODY + self._cycle_bytes]

    def put(self, cycle: Cycle) -> None:
        """Write one cycle; its arrays are copied.

        Raises:
            ValueError: an array of another shape.
            struct.error: an integer beyond 64 bits.
        """
        stamp_ns, position, velocity, torque, reference_position, reference_velocity = cycle[:6]
        number, lateness_ns, compute_ns, valid, age, lost, measured = cycle[6:]
        if not (
            self._shape == position.shape == torque.shape == reference_position.shape == reference_velocity.shape
            and self._shape == valid.shape == age.shape
            and (velocity is None or velocity.shape == self._shape)
            and (measured is None or measured.shape == self._shape)
        ):
            given = (position, velocity, torque, reference_position, reference_velocity, valid, age, measured)
            shapes = ", ".join(str(array.shape) for array in given if array is not None)
            raise ValueError(f"arrays of shapes {shapes} but the ring has {self._shape[0]} joints")
        self._position[:] = position
        if velocity is not None:
            self._velocity[:] = velocity
        self._torque[:] = torque
        self._measured[:] = np.nan if measured is None else measured
        self._q_reference[:] = reference_position
        self._dq_reference[:] = reference_velocity
        self._valid[:] = valid
        self._age[:] = age
        stage = self._stage
        kind = slot.CYCLE if velocity is None else slot.CYCLE_WITH_VELOCITY
        slot.HEAD.pack_into(stage, slot.BODY, self.written, kind, 0, stamp_ns)
        slot.TIMING.pack_into(stage, slot.AT_TIMING, number, lateness_ns, compute_ns, lost)
        slot.CHECK.pack_into(stage, 0, zlib.crc32(self._cycle_body), self._cycle_bytes)
        self._publish(self._cycle)

    def event(self, stamp_ns: int, level: int, message: str) -> None:
        """Write one event; a message that does not fit the slot is cut and ends in `[cut]`.

        Raises:
            struct.error: an integer beyond its bits.
        """
        data = slot.message_bytes(message, len(self._stage) - slot.AT_MESSAGE)
        body = slot.HEAD.pack(self.written, slot.EVENT, level, stamp_ns) + data
        self._publish(slot.CHECK.pack(zlib.crc32(body), len(body)) + body)

    def close(self, *, finished: bool) -> bool:
        """Tell the readers that this was the last record; the records stay readable.

        Args:
            finished: False when the motion ended early, in an exception for example.

        Returns:
            False the second time, which changes nothing.
        """
        if self._words[at.CLOSED] != Closed.OPEN:
            return False
        self._words[at.CLOSED] = Closed.FINISHED if finished else Closed.ENDED_EARLY
        return True

    def _publish(self, content: memoryview | bytes) -> None:
        number, words = self.written, self._words
        sequence = self.memory.word_of(number)
        begin = 8 * sequence + 8
        words[sequence] = 2 * number + 1
        self._content[begin : begin + len(content)] = content
        # Counted before it can be seen: an exception that a signal throws in here must not lead to a second record n.
        self.written = number + 1
        words[sequence] = 2 * number + 2
        words[at.WRITTEN] = number + 1
        words[at.WRITER_HEARTBEAT] = time.monotonic_ns()


class RingReader:
    """Read records of a ring with a cursor of its own; a context manager.

    Attributes:
        memory: the ring's; writable only for the recorder.
        cursor: number of the next record; `returned + lost` when it began at 0.
        returned: records that `read` gave.
        lost: records that it could not give.
    """

    def __init__(self, fd: int, *, recorder: bool = False, from_now: bool = False) -> None:
        """Attach to a ring, at its first record.

        Args:
            fd: of the ring; stays the caller's.
            recorder: whether this is the reader whose progress the motion loop watches (`ring_sink.py`).
            from_now: begin behind what has been written so far.

        Raises:
            UsageError: not a ring, or a second recorder.
        """
        self.memory = RingMemory(fd, writable=recorder)
        self._words, self._content = self.memory.words, self.memory.content
        self._recorder = recorder
        if recorder:
            if other := self._words[at.RECORDER_PID]:
                self.memory.close()
                raise UsageError(f"the ring has a recorder already, process {other}")
            self._words[at.RECORDER_PID] = os.getpid()
            self.beat()
            self._words[at.STATE] = State.RUNNING
        self.cursor = self._words[at.WRITTEN] if from_now else 0
        self.returned = 0
        self.lost = 0

    def __enter__(self) -> Self:
        """Return this reader."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Detach."""
        self.memory.close()

    @property
    def closed(self) -> Closed:
        """Return whether the writer has written its last record; load this before the `read` that is to be the last."""
        return Closed(self._words[at.CLOSED])

    @property
    def writer_pid(self) -> int:
        """Return the process id of the writer, 0 before there is one."""
        return self._words[at.WRITER_PID]

    @property
    def writer_heartbeat_ns(self) -> int:
        """Return the monotonic time of the writer's last record [ns]."""
        return self._words[at.WRITER_HEARTBEAT]

    def read(self) -> Record | None:
        """Return the next record that still exists, None while there is none; never waits."""
        words, torn = self._words, 0
        while True:
            number = self.cursor
            word = self.memory.word_of(number)
            expected = 2 * number + 2
            sequence = words[word]
            if sequence < expected:
                # Loaded once more after the count: a record that the count includes has its sequence by then.
                if words[at.WRITTEN] <= number:
                    return None
                if words[word] < expected:
                    self._skip_to(number + 1)
            elif sequence > expected:
                # With a quarter of the ring between them, the writer does not catch up with the next read at once.
                oldest = words[at.WRITTEN] - self.memory.slots
                self._skip_to(max(number + 1, oldest + self.memory.slots // 4))
            else:
                begin = 8 * word + 8
                content = self._content[begin : begin + self.memory.slot_bytes - 8]
                if words[word] == expected:
                    record = slot.decode(content, number, self.memory.joints)
                    if record is not None:
                        self.cursor = number + 1
                        self.returned += 1
                        return record
                    torn += 1
                    if torn >= _RETRIES:
                        self._skip_to(number + 1)
                        torn = 0

    def taken(self) -> None:
        """Tell the motion loop, as the recorder, that everything before the cursor has been processed."""
        self._words[at.CURSOR] = self.cursor

    def beat(self) -> None:
        """Renew the recorder's heartbeat."""
        self._words[at.RECORDER_HEARTBEAT] = time.monotonic_ns()

    def end(self, error: str | None = None) -> None:
        """Announce, as the recorder, that no record will be taken any more, and why if something failed."""
        if error is not None:
            self.memory.set_text(error)
        self._words[at.STATE] = State.ENDED if error is None else State.FAILED

    def _skip_to(self, number: int) -> None:
        self.lost += number - self.cursor
        self.cursor = number
