"""Encode and decode one record in one slot of the ring, with the checksum that validates it.

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
72     6 x 8 J   position, velocity, torque, reference position, reference velocity, measured torque (NaN: none)
...    8 J       age
...    J         valid
40     ...       an event's: message in UTF-8
====== ========= ==============================================================================

J is the number of joints. The checksum covers the number, so that a record of an earlier lap cannot pass for a later
one, and no mixture of two for either.
"""

from __future__ import annotations

import struct
import zlib
from typing import Final, NamedTuple

import numpy as np

from ident_service.recordings.cycle import Cycle

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
VECTORS: Final = 6

_LEAST_BYTES: Final = 512  # room for a sentence even where an arm has one joint
_CUT: Final = b" [cut]"


class EventRecord(NamedTuple):
    """Represent one event, in the order of `RecordingWriter.event`'s arguments."""

    stamp_ns: int
    level: int
    message: str


Record = Cycle | EventRecord


def cycle_bytes(joints: int) -> int:
    """Return the size of a cycle's content behind the checksum [bytes]."""
    return AT_VECTORS - BODY + 8 * (VECTORS + 1) * joints + joints


def slot_bytes(joints: int) -> int:
    """Return the size of a slot [bytes], in whole cache lines, so that two slots never share one."""
    return max(_LEAST_BYTES, -(-(8 + BODY + cycle_bytes(joints)) // 64) * 64)


def message_bytes(message: str, room: int) -> bytes:
    """Encode a message in UTF-8, cut at a whole character and marked as cut where it does not fit `room` [bytes]."""
    data = message.encode("utf-8", "backslashreplace")
    if len(data) <= room:
        return data
    return data[: room - len(_CUT)].decode("utf-8", "ignore").encode() + _CUT


def decode(content: bytes, number: int, joints: int) -> Record | None:
    """Decode a slot's content, None unless it is record `number`, whole."""
    checksum, length = CHECK.unpack_from(content)
    if not HEAD.size <= length <= len(content) - BODY or zlib.crc32(content[BODY : BODY + length]) != checksum:
        return None
    found, kind, level, stamp_ns = HEAD.unpack_from(content, BODY)
    if found != number:
        return None
    if kind == EVENT:
        return EventRecord(stamp_ns, level, content[AT_MESSAGE : BODY + length].decode("utf-8", "replace"))
    if kind not in (CYCLE, CYCLE_WITH_VELOCITY) or length != cycle_bytes(joints):
        return None
    cycle, lateness_ns, compute_ns, lost = TIMING.unpack_from(content, AT_TIMING)
    vectors = np.frombuffer(content, np.float64, VECTORS * joints, AT_VECTORS).reshape(VECTORS, joints)
    age = np.frombuffer(content, np.int64, joints, AT_VECTORS + 8 * VECTORS * joints)
    valid = np.frombuffer(content, np.bool_, joints, AT_VECTORS + 8 * (VECTORS + 1) * joints)
    velocity = vectors[1] if kind == CYCLE_WITH_VELOCITY else None
    return Cycle(
        *(stamp_ns, vectors[0], velocity, vectors[2], vectors[3], vectors[4]),
        *(cycle, lateness_ns, compute_ns, valid, age, lost),
        None if np.isnan(vectors[5]).all() else vectors[5],
    )
