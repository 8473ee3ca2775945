"""Map the shared memory of the ring between motion and recorder, with its layout and a check of its identity.

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
4096   ...   the slots, one behind the other (`ring_slot.py`)      writer
====== ===== ===================================================== =============

Every word has one owner, who stores it whole: an aligned 8-byte copy, which CPython makes of `memoryview[i] = n`, is
one store on every 64-bit machine. That stores of one process are seen by another in the order they were made is a
promise of x86-64 (and of the interpreter, whose calls no compiler reorders). Where a machine does not give it, a late
word makes a reader wait or lose a record; a wrong record it never gets, because that hangs on a checksum alone.
"""

from __future__ import annotations

import enum
import fcntl
import mmap
import os
import struct
import zlib
from contextlib import suppress
from typing import Final

from ident_service.errors import UsageError

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
_VERSION: Final = 1
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


def create_memory(joints: int, slots: int, slot_bytes: int) -> int:
    """Create the memory of a ring, all of it allocated, and nothing written yet.

    Args:
        joints: of every record, 1 to 64.
        slots: records that fit, 4 to 2**20.
        slot_bytes: of one slot [bytes].

    Returns:
        Its file descriptor, which the caller closes and which no child inherits unless it is passed.

    Raises:
        UsageError: a count beyond its bounds.
        OSError: not enough memory.
    """
    if not (1 <= joints <= MAX_JOINTS and LEAST_SLOTS <= slots <= MAX_SLOTS):
        raise UsageError(
            f"{joints=}, {slots=} but a ring has 1 to {MAX_JOINTS} joints and {LEAST_SLOTS} to {MAX_SLOTS} slots"
        )
    size = HEADER_BYTES + slots * slot_bytes
    fixed = _FIXED.pack(_MAGIC, _VERSION, joints, slots, slot_bytes, size)
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
        joints: of every record.
        slots: how many there are.
        slot_bytes: of one slot.
        words: the memory as 64-bit words.
        content: the memory as bytes.
    """

    def __init__(self, fd: int, *, writable: bool) -> None:
        """Map the memory; its layout is read from its header.

        Args:
            fd: from `create_memory`, in whatever process; stays the caller's.
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

    def word_of(self, number: int) -> int:
        """Return the index of the word that record `number`'s slot begins with."""
        return (HEADER_BYTES + number % self.slots * self.slot_bytes) >> 3

    def set_text(self, text: str) -> None:
        """Store the reason of a failure; the state that announces it is stored afterwards."""
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
