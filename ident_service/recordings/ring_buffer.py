"""Pass records through shared memory: one writer who never waits, readers who notice when they were overrun.

The memory is anonymous (`memfd_create`) and passed by file descriptor, so that it vanishes with the last process that
has it, however that ends. It is sealed against growing and shrinking: it cannot be cut off under a reader. All words
are unsigned 64-bit in the machine's order, since both sides run on one machine.

====== ===== ===================================================== =============
offset bytes what                                                  stored by
====== ===== ===================================================== =============
0      8     magic `IDNTRING`                                      creator, once
8      8     version of this layout                                creator, once
16     8     number of joints                                      creator, once
24     8     number of slots                                       creator, once
32     8     bytes of a slot, a multiple of 64                     creator, once
40     8     bytes of it all                                       creator, once
48     8     CRC-32 of bytes 0..47                                 creator, once
64     8     records written so far                                writer
72     8     heartbeat: monotonic time of the last record [ns]     writer
80     8     its process id, 0 before there is a writer            writer
88     8     `Closed`: 0 open, 1 finished, 2 ended early           writer
128    8     cursor: records taken so far                          recorder
136    8     `State`: 0 none, 1 running, 2 failed, 3 ended         recorder
144    8     its process id                                        recorder
152    8     heartbeat: monotonic time of its last look [ns]       recorder
160    8     bytes of the text                                     recorder
256    1024  why it failed, UTF-8                                  recorder
4096   ...   the slots, one behind the other      writer
====== ===== ===================================================== =============

Every word has one owner, who stores it whole: an aligned 8-byte copy, which CPython makes of `memoryview[i] = n`, is
one store on every 64-bit machine. That stores of one process are seen by another in the order they were made is a
promise of x86-64 (and of the interpreter, whose calls no compiler reorders). Where a machine does not give it, a late
word makes a reader wait or lose a record; a wrong record it never gets, because that hangs on a checksum alone.

====== ========= ==============================================================================
offset bytes     what
====== ========= ==============================================================================
0      8         sequence: `2 n + 1` while record n is being written, `2 n + 2` once it is there
8      4         CRC-32 of the bytes from 16 on
12     4         how many bytes that are
16     8         number n of the record, from 0
24     4         kind: 1 a cycle with velocity, 2 a cycle without, 3 an event
28     4         level of an event
32     8         stamp [ns]
40     4 x 8     a cycle's: number, lateness [ns], compute time [ns], frames lost
72     7 x 8 J   position, velocity, torque, reference position, reference velocity, measured torque (NaN: none),
                 position by joint encoders (NaN: none)
...    8 J       age
...    J         valid
40     ...       an event's: message in UTF-8
====== ========= ==============================================================================

J is the number of joints. The checksum covers the number, so that a record of an earlier lap cannot pass for a later
one, and no mixture of two for either.

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
sequence odd, or the record whole: nothing wrong can be read, and only the record in the making is missing.
`ring_sink.py` and `recorder.py` say what the two processes tell each other besides.
"""

from __future__ import annotations

import enum
import fcntl
import mmap
import os
import struct
import time
import zlib
from contextlib import suppress
from typing import Final, NamedTuple, Self

import numpy as np

from ident_service.errors import UsageError
from ident_service.recordings.cycle import Cycle

HEADER_BYTES: Final = 4096
MAX_JOINTS: Final = 64
MAX_SLOTS: Final = 1 << 20
LEAST_SLOTS: Final = 4

# Indices of words.
WRITTEN: Final = 8
WRITER_HEARTBEAT: Final = 9
WRITER_PID: Final = 10
CLOSED: Final = 11
CURSOR: Final = 16
STATE: Final = 17
RECORDER_PID: Final = 18
RECORDER_HEARTBEAT: Final = 19
_TEXT_BYTES: Final = 20
_TEXT: Final = 256
_TEXT_MOST: Final = 1024

_FIXED: Final = struct.Struct("=8s5Q")
_MAGIC: Final = b"IDNTRING"
_VERSION: Final = 2
_SEALS: Final = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL


class Closed(enum.IntEnum):
    """Name the states of the writer's end."""

    OPEN = 0
    FINISHED = 1
    ENDED_EARLY = 2


class State(enum.IntEnum):
    """Name the states of the recorder."""

    NONE = 0
    RUNNING = 1
    FAILED = 2
    ENDED = 3


def create_memory(joint_count: int, slot_count: int, slot_bytes: int) -> int:
    """Create a ring's shared memory, allocated and empty; return its file descriptor, for the caller to close.

    Args:
        joint_count: number of joints in every record, 1 to 64.
        slot_count: number of records that fit, 4 to 2**20.
        slot_bytes: size of one slot [bytes].

    Returns:
        Its file descriptor, which the caller closes and which no child inherits unless it is passed.

    Raises:
        UsageError: a count beyond its bounds.
        OSError: not enough memory.
    """
    if not (1 <= joint_count <= MAX_JOINTS and LEAST_SLOTS <= slot_count <= MAX_SLOTS):
        raise UsageError(
            f"joints={joint_count}, slots={slot_count} but a ring has 1 to {MAX_JOINTS} joints "
            f"and {LEAST_SLOTS} to {MAX_SLOTS} slots"
        )
    size = HEADER_BYTES + slot_count * slot_bytes
    fixed = _FIXED.pack(_MAGIC, _VERSION, joint_count, slot_count, slot_bytes, size)
    fd = os.memfd_create("ident-ring", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        # Memory that is only promised would be missed as a bus error in the middle of a motion.
        os.posix_fallocate(fd, 0, size)
        os.pwrite(fd, fixed + struct.pack("=Q", zlib.crc32(fixed)), 0)
        fcntl.fcntl(fd, fcntl.F_ADD_SEALS, _SEALS)
    except BaseException:
        os.close(fd)
        raise
    return fd


class RingMemory:
    """Map a ring's memory into one process.

    Attributes:
        joints: number of joints in every record.
        slots: number of slots.
        slot_bytes: size of one slot [bytes].
        words: the memory as 64-bit words.
        content: the memory as bytes.
    """

    def __init__(self, fd: int, *, writable: bool) -> None:
        """Map the memory; its layout is read from its header.

        Args:
            fd: file descriptor from `create_memory`, in whatever process; stays the caller's.
            writable: False for a reader who leaves no trace.

        Raises:
            UsageError: not the memory of a ring, or of another version's.
        """
        try:
            seals = fcntl.fcntl(fd, fcntl.F_GET_SEALS)
            head = os.pread(fd, _FIXED.size + 8, 0)
            size = os.fstat(fd).st_size
        except OSError as error:
            raise UsageError(f"file descriptor {fd} is not the memory of a ring: {error.strerror}") from error
        if seals & _SEALS != _SEALS or len(head) < _FIXED.size + 8 or head[:8] != _MAGIC:
            raise UsageError(f"file descriptor {fd} is not the memory of a ring: it does not begin like one")
        _, version, *numbers = _FIXED.unpack_from(head)
        if version != _VERSION:
            raise UsageError(f"file descriptor {fd} is a ring of version {version}, this software knows {_VERSION}")
        if head[-8:] != struct.pack("=Q", zlib.crc32(head[:-8])) or numbers[-1] != size:
            raise UsageError(f"file descriptor {fd} is not the memory of a ring: its header is damaged")
        self.joints: int
        self.slots: int
        self.slot_bytes: int
        self.joints, self.slots, self.slot_bytes, _ = numbers
        protection = mmap.PROT_READ | (mmap.PROT_WRITE if writable else 0)
        # Populated now, or every page would fault once in the middle of a motion.
        self.content = mmap.mmap(fd, size, mmap.MAP_SHARED | mmap.MAP_POPULATE, protection)
        self._bytes = memoryview(self.content)
        self.words = self._bytes.cast("Q")

    def slot_word_index(self, record_number: int) -> int:
        """Return the index of the 8-byte word that the slot of record `record_number` begins with."""
        return (HEADER_BYTES + record_number % self.slots * self.slot_bytes) >> 3

    def set_text(self, text: str) -> None:
        """Store the reason of a failure in the ring, cut to fit; the state that announces it is set later."""
        data = text.encode("utf-8", "backslashreplace")[:_TEXT_MOST]
        self.content[_TEXT : _TEXT + len(data)] = data
        self.words[_TEXT_BYTES] = len(data)

    def text(self) -> str:
        """Return the stored reason of a failure, empty if there is none."""
        length = min(self.words[_TEXT_BYTES], _TEXT_MOST)
        return self.content[_TEXT : _TEXT + length].decode("utf-8", "replace")

    def close(self) -> None:
        """Release the mapping; does nothing the second time."""
        with suppress(ValueError):
            self.words.release()
            self._bytes.release()
            self.content.close()


CYCLE_WITH_VELOCITY: Final = 1
CYCLE: Final = 2
EVENT: Final = 3

# Offsets in a slot's content, which is what follows its sequence.
BODY: Final = 8
CHECK: Final = struct.Struct("=II")
HEAD: Final = struct.Struct("=QIIq")
TIMING: Final = struct.Struct("=4q")
AT_TIMING: Final = BODY + HEAD.size
AT_VECTORS: Final = AT_TIMING + TIMING.size
AT_MESSAGE: Final = AT_TIMING
VECTORS: Final = 7

_LEAST_BYTES: Final = 512  # room for a sentence even where an arm has one joint
_CUT: Final = b" [cut]"


class EventRecord(NamedTuple):
    """Represent one event, in the order of `RecordingWriter.event`'s arguments."""

    stamp_ns: int
    level: int
    message: str


Record = Cycle | EventRecord


def cycle_bytes(joint_count: int) -> int:
    """Return the size of a cycle's content in a slot, behind the checksum [bytes]."""
    return AT_VECTORS - BODY + 8 * (VECTORS + 1) * joint_count + joint_count


def slot_bytes(joint_count: int) -> int:
    """Return the size of a slot [bytes] for so many joints, a multiple of 64 (cache lines)."""
    return max(_LEAST_BYTES, -(-(8 + BODY + cycle_bytes(joint_count)) // 64) * 64)


def message_bytes(message: str, most_bytes: int) -> bytes:
    """Return a message in UTF-8, cut at a whole character and ending in `[cut]` where longer than `most_bytes`."""
    data = message.encode("utf-8", "backslashreplace")
    if len(data) <= most_bytes:
        return data
    return data[: most_bytes - len(_CUT)].decode("utf-8", "ignore").encode() + _CUT


def decode(content: bytes, record_number: int, joint_count: int) -> Record | None:
    """Return the cycle or event in a slot's content; None unless it is record `record_number` and its checksum fits."""
    checksum, length = CHECK.unpack_from(content)
    if not HEAD.size <= length <= len(content) - BODY or zlib.crc32(content[BODY : BODY + length]) != checksum:
        return None
    found, kind, level, stamp_ns = HEAD.unpack_from(content, BODY)
    if found != record_number:
        return None
    if kind == EVENT:
        return EventRecord(stamp_ns, level, content[AT_MESSAGE : BODY + length].decode("utf-8", "replace"))
    if kind not in (CYCLE, CYCLE_WITH_VELOCITY) or length != cycle_bytes(joint_count):
        return None
    cycle, lateness_ns, compute_ns, lost = TIMING.unpack_from(content, AT_TIMING)
    vectors = np.frombuffer(content, np.float64, VECTORS * joint_count, AT_VECTORS).reshape(VECTORS, joint_count)
    age = np.frombuffer(content, np.int64, joint_count, AT_VECTORS + 8 * VECTORS * joint_count)
    valid = np.frombuffer(content, np.bool_, joint_count, AT_VECTORS + 8 * (VECTORS + 1) * joint_count)
    velocity = vectors[1] if kind == CYCLE_WITH_VELOCITY else None
    return Cycle(
        *(stamp_ns, vectors[0], velocity, vectors[2], vectors[3], vectors[4]),
        *(cycle, lateness_ns, compute_ns, valid, age, lost),
        None if np.isnan(vectors[5]).all() else vectors[5],
        None if np.isnan(vectors[6]).all() else vectors[6],
    )


SLOTS: Final = 8192  # eight seconds at 1 kHz; 4 MiB for up to eight joints

_RETRIES: Final = 16


def create_ring(joint_count: int, slot_count: int = SLOTS) -> int:
    """Create an empty ring; return its file descriptor, for the caller to close."""
    return create_memory(joint_count, slot_count, slot_bytes(joint_count))


class RingWriter:
    """Write records to a ring as its only writer.

    Attributes:
        memory: memory of the ring.
        written: number of records written so far.
    """

    def __init__(self, fd: int) -> None:
        """Attach to a ring as its writer.

        Args:
            fd: file descriptor of the ring; stays the caller's.

        Raises:
            UsageError: not a ring, or a ring that has a writer.
        """
        self.memory = RingMemory(fd, writable=True)
        if other := self.memory.words[WRITER_PID]:
            self.memory.close()
            raise UsageError(f"the ring has a writer already, process {other}")
        self.written = 0
        joints = self.memory.joints
        self._words, self._content = self.memory.words, self.memory.content
        self._words[WRITER_HEARTBEAT] = time.monotonic_ns()
        self._words[WRITER_PID] = os.getpid()
        # A record is put together here, so that it stands in shared memory half done for one copy only.
        self._stage = bytearray(self.memory.slot_bytes - 8)
        # Views of bytes take an array in a third of the time that views of arrays do, and check its type and shape.
        whole, at = memoryview(self._stage), range(AT_VECTORS, len(self._stage), 8 * joints)
        vectors = [whole[at[k] : at[k + 1]].cast("d") for k in range(VECTORS)]
        self._position, self._velocity, self._torque, self._q_reference, self._dq_reference, *others = vectors
        self._measured, self._joint_position = others
        self._age = whole[at[VECTORS] : at[VECTORS] + 8 * joints].cast("l")
        self._valid = whole[at[VECTORS] + 8 * joints : at[VECTORS] + 9 * joints].cast("?")
        self._none = np.full(joints, np.nan).data
        self._cycle_bytes = cycle_bytes(joints)
        self._cycle_body = whole[BODY : BODY + self._cycle_bytes]
        self._cycle = whole[: BODY + self._cycle_bytes]

    def put(self, cycle: Cycle) -> None:
        """Copy one cycle into the ring, over the oldest record if it is full; never waits.

        Raises:
            ValueError: an array of another shape or type.
            struct.error: an integer beyond 64 bits.
        """
        stamp_ns, position, velocity, torque, reference_position, reference_velocity = cycle[:6]
        number, lateness_ns, compute_ns, valid, age, lost, measured, encoders = cycle[6:]
        try:
            self._position[:] = position.data
            if velocity is not None:
                self._velocity[:] = velocity.data
            self._torque[:] = torque.data
            self._q_reference[:] = reference_position.data
            self._dq_reference[:] = reference_velocity.data
            self._measured[:] = self._none if measured is None else measured.data
            self._joint_position[:] = self._none if encoders is None else encoders.data
            self._age[:] = age.data
            self._valid[:] = valid.data
        except ValueError:
            given = (position, velocity, torque, reference_position, reference_velocity, valid, age, measured, encoders)
            shapes = ", ".join(f"{array.shape} of {array.dtype}" for array in given if array is not None)
            raise ValueError(f"arrays of shapes {shapes} but the ring has {self.memory.joints} joints") from None
        stage = self._stage
        kind = CYCLE if velocity is None else CYCLE_WITH_VELOCITY
        HEAD.pack_into(stage, BODY, self.written, kind, 0, stamp_ns)
        TIMING.pack_into(stage, AT_TIMING, number, lateness_ns, compute_ns, lost)
        CHECK.pack_into(stage, 0, zlib.crc32(self._cycle_body), self._cycle_bytes)
        self._publish(self._cycle)

    def event(self, stamp_ns: int, level: int, message: str) -> None:
        """Write one event into the ring; a message that does not fit the slot is cut and ends in `[cut]`.

        Raises:
            struct.error: an integer beyond its bits.
        """
        data = message_bytes(message, len(self._stage) - AT_MESSAGE)
        body = HEAD.pack(self.written, EVENT, level, stamp_ns) + data
        self._publish(CHECK.pack(zlib.crc32(body), len(body)) + body)

    def close(self, *, finished: bool) -> bool:
        """Mark the ring as closed, so that readers know the last record; return False if it was closed already.

        Args:
            finished: False when the motion ended early, in an exception for example.

        Returns:
            False the second time, which changes nothing.
        """
        if self._words[CLOSED] != Closed.OPEN:
            return False
        self._words[CLOSED] = Closed.FINISHED if finished else Closed.ENDED_EARLY
        return True

    def _publish(self, content: memoryview | bytes) -> None:
        number, words = self.written, self._words
        sequence = self.memory.slot_word_index(number)
        begin = 8 * sequence + 8
        words[sequence] = 2 * number + 1
        self._content[begin : begin + len(content)] = content
        # Counted before it can be seen: an exception that a signal throws in here must not lead to a second record n.
        self.written = number + 1
        words[sequence] = 2 * number + 2
        words[WRITTEN] = number + 1
        words[WRITER_HEARTBEAT] = time.monotonic_ns()


class RingReader:
    """Read records of a ring with a cursor of its own; a context manager.

    Attributes:
        memory: memory of the ring, writable only for the recorder.
        cursor: number of the next record; `returned + lost` when it began at 0.
        returned: number of records that `read` returned.
        lost: number of records that `read` could not return.
    """

    def __init__(self, fd: int, *, recorder: bool = False, from_now: bool = False) -> None:
        """Attach to a ring, at its first record.

        Args:
            fd: file descriptor of the ring; stays the caller's.
            recorder: whether this is the reader whose progress the motion loop watches (`ring_sink.py`).
            from_now: begin behind what has been written so far.

        Raises:
            UsageError: not a ring, or a second recorder.
        """
        self.memory = RingMemory(fd, writable=recorder)
        self._words, self._content = self.memory.words, self.memory.content
        self._recorder = recorder
        if recorder:
            if other := self._words[RECORDER_PID]:
                self.memory.close()
                raise UsageError(f"the ring has a recorder already, process {other}")
            self._words[RECORDER_PID] = os.getpid()
            self.beat()
            self._words[STATE] = State.RUNNING
        self.cursor = self._words[WRITTEN] if from_now else 0
        self.returned = 0
        self.lost = 0

    def __enter__(self) -> Self:
        """Return this reader."""
        return self

    def __exit__(self, *_: object) -> None:
        """Detach."""
        self.memory.close()

    @property
    def closed(self) -> Closed:
        """Return whether the ring is open, finished or ended early; load it before the `read` that is to be last."""
        return Closed(self._words[CLOSED])

    @property
    def writer_pid(self) -> int:
        """Return the process id of the writer, 0 before there is one."""
        return self._words[WRITER_PID]

    @property
    def writer_heartbeat_ns(self) -> int:
        """Return the monotonic time of the writer's last sign of life [ns]."""
        return self._words[WRITER_HEARTBEAT]

    def read(self) -> Record | None:
        """Return the next record that is not overwritten yet; None while there is none. Never waits."""
        words, torn = self._words, 0
        while True:
            number = self.cursor
            word = self.memory.slot_word_index(number)
            expected = 2 * number + 2
            sequence = words[word]
            if sequence < expected:
                # Loaded once more after the count: a record that the count includes has its sequence by then.
                if words[WRITTEN] <= number:
                    return None
                if words[word] < expected:
                    self._skip_to(number + 1)
            elif sequence > expected:
                # With a quarter of the ring between them, the writer does not catch up with the next read at once.
                oldest = words[WRITTEN] - self.memory.slots
                self._skip_to(max(number + 1, oldest + self.memory.slots // 4))
            else:
                begin = 8 * word + 8
                content = self._content[begin : begin + self.memory.slot_bytes - 8]
                if words[word] == expected:
                    record = decode(content, number, self.memory.joints)
                    if record is not None:
                        self.cursor = number + 1
                        self.returned += 1
                        return record
                    torn += 1
                    if torn >= _RETRIES:
                        self._skip_to(number + 1)
                        torn = 0

    def publish_cursor(self) -> None:
        """Publish the recorder's cursor: every record before it has been processed."""
        self._words[CURSOR] = self.cursor

    def beat(self) -> None:
        """Store the current monotonic time as the recorder's heartbeat."""
        self._words[RECORDER_HEARTBEAT] = time.monotonic_ns()

    def end(self, error_text: str | None = None) -> None:
        """Mark, as the recorder, that no more records are taken: ended, or failed with `error_text` as the reason."""
        if error_text is not None:
            self.memory.set_text(error_text)
        self._words[STATE] = State.ENDED if error_text is None else State.FAILED

    def _skip_to(self, number: int) -> None:
        self.lost += number - self.cursor
        self.cursor = number
