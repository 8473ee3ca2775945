"""Encode and decode frames between an arm and a plant in another process.

Every frame is one packet of a sequenced-packet socket, little-endian and packed: a header, then the fields of `TABLE`
in their order. A frame's length follows from its kind and the number of joints; anything else is refused. The plant
answers every request with one reply that has its number, in order::

    Hello    -> Welcome | Refused      who is there; a plant serves one client at a time
    Enable   -> Done | Failed
    Reset    -> Done | Failed          what the drives have latched
    Exchange -> Answer | Failed        one cycle
    Stop     -> Done

A value that cannot be told from noise (a torque that is not finite) is
refused here too.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from drivers.arm import Counts, Flags, Vector
from ident_service.errors import DriverError

MAGIC = b"IDP"
VERSION = 2
_HEADER = struct.Struct("<3sBBxHI")  # magic, version, kind, -, joints (0 where no field is per joint), number
_TEXT = 480
MAX_BYTES = 65536

IN_USE, OTHER_ARM, OTHER_USER = 1, 2, 3  # reasons to refuse


@dataclass(frozen=True, slots=True)
class Hello:
    """Represent the client's first frame, with the hash of its configuration, which both must share."""

    sha256: bytes


@dataclass(frozen=True, slots=True)
class Welcome:
    """Represent the acceptance of a client: the plant is its own until the connection ends."""

    pid: int


@dataclass(frozen=True, slots=True)
class Refused:
    """Represent the refusal of a client; `pid` is the process that has the plant, 0 where that is not the reason."""

    reason: int
    pid: int


@dataclass(frozen=True, slots=True)
class Enable:
    """Represent the request to energise with zero torque."""


@dataclass(frozen=True, slots=True)
class Reset:
    """Represent the request to clear what the drives have latched."""


@dataclass(frozen=True, slots=True)
class Exchange:
    """Represent one cycle: its stamp [ns] and, if `sends`, the torque from then on [N m or N], shape (joints,)."""

    stamp_ns: int
    sends: int
    torque: Vector


@dataclass(frozen=True, slots=True)
class Stop:
    """Represent the request to end torque with this period, braked or not."""

    brakes: int


@dataclass(frozen=True, slots=True)
class Done:
    """Represent the reply that a request has been fulfilled."""


@dataclass(frozen=True, slots=True)
class Failed:
    """Represent the reply that a request failed, and why; a cycle that failed has passed all the same."""

    text: bytes


@dataclass(frozen=True, slots=True)
class Answer:
    """Hold the result of a cycle, as in `Reading`, and the truth, as in `Truth`."""

    stamp_ns: int
    lost: int
    status_age: int
    position: Vector
    torque: Vector
    valid: Flags
    age: Counts
    status: tuple[int, ...]
    true_position: Vector
    true_velocity: Vector
    true_acceleration: Vector
    true_torque: Vector


Request = Hello | Enable | Reset | Exchange | Stop
Reply = Welcome | Refused | Done | Failed | Answer

# Kind, frame, and per field: struct code, and whether there is one per joint.
_EACH, _ONE = True, False
TABLE: tuple[tuple[int, type[Request] | type[Reply], tuple[tuple[str, bool], ...]], ...] = (
    (1, Hello, (("32s", _ONE),)),
    (2, Enable, ()),
    (3, Exchange, (("q", _ONE), ("B", _ONE), ("d", _EACH))),
    (4, Stop, (("B", _ONE),)),
    (5, Reset, ()),
    (65, Welcome, (("i", _ONE),)),
    (66, Refused, (("B", _ONE), ("i", _ONE))),
    (67, Done, ()),
    (68, Failed, ((f"{_TEXT}s", _ONE),)),
    (
        69,
        Answer,
        (
            ("q", _ONE),  # stamp_ns
            ("q", _ONE),  # lost
            ("q", _ONE),  # status_age
            ("d", _EACH),  # position
            ("d", _EACH),  # torque
            ("B", _EACH),  # valid
            ("q", _EACH),  # age
            ("I", _EACH),  # status
            ("d", _EACH),  # true_position
            ("d", _EACH),  # true_velocity
            ("d", _EACH),  # true_acceleration
            ("d", _EACH),  # true_torque
        ),
    ),
)
_KINDS = {frame: (kind, fields) for kind, frame, fields in TABLE}
_FRAMES = {kind: (frame, fields) for kind, frame, fields in TABLE}
# Conversion of the numbers of a per-joint field.
_ARRAYS: dict[str, type[np.float64] | type[np.int64] | type[np.bool_]] = {"d": np.float64, "q": np.int64, "B": np.bool_}


class MalformedFrame(DriverError):
    """Report bytes that are not a frame; the connection to their sender is closed."""


def encode(frame: Request | Reply, request_number: int, joints: int) -> bytes:
    """Encode a request or a reply as bytes, with the low 32 bits of its number.

    Args:
        frame: frame with arrays of shape (joints,).
        request_number: number of the request that the frame is or answers.
        joints: of the arm.
    """
    kind, fields = _KINDS[type(frame)]
    values: list[object] = []
    for name, (_, each) in zip(type(frame).__slots__, fields, strict=True):
        value = getattr(frame, name)
        if not each:
            values.append(value)
        else:
            values += value.tolist() if isinstance(value, np.ndarray) else value
    body = _body(kind, joints)
    per_joint = joints if any(each for _, each in fields) else 0
    return _HEADER.pack(MAGIC, VERSION, kind, per_joint, request_number & 0xFFFFFFFF) + body.pack(*values)


def decode_request(data: bytes, joints: int) -> tuple[int, Request]:
    """Decode a client's request, and return its number and the frame; raises MalformedFrame otherwise.

    Raises:
        MalformedFrame: not a request to an arm of so many joints.
    """
    number, frame = _decode(data, joints)
    if not isinstance(frame, Request):
        raise MalformedFrame(f"malformed frame: {type(frame).__name__} is no request")
    return number, frame


def decode_reply(data: bytes, joints: int) -> tuple[int, Reply]:
    """Decode a plant's reply, and return its number and the frame; raises MalformedFrame otherwise.

    Raises:
        MalformedFrame: not a reply of an arm of so many joints.
    """
    number, frame = _decode(data, joints)
    if isinstance(frame, Request):
        raise MalformedFrame(f"malformed frame: {type(frame).__name__} is no reply")
    return number, frame


def _decode(data: bytes, joints: int) -> tuple[int, Request | Reply]:
    if len(data) < _HEADER.size:
        raise MalformedFrame(f"malformed frame: {len(data)} bytes, a header has {_HEADER.size}")
    magic, version, kind, per_joint, number = _HEADER.unpack_from(data)
    if magic != MAGIC or version != VERSION:
        raise MalformedFrame(f"malformed frame: begins with {magic + bytes([version])!r}")
    if kind not in _FRAMES:
        raise MalformedFrame(f"malformed frame: there is no kind {kind}")
    frame, fields = _FRAMES[kind]
    body = _body(kind, joints)
    wanted = joints if any(each for _, each in fields) else 0
    if per_joint != wanted or len(data) != _HEADER.size + body.size:
        raise MalformedFrame(
            f"malformed frame: {frame.__name__} of {len(data)} bytes for {per_joint} joints, "
            f"expected {_HEADER.size + body.size} for {wanted}"
        )
    numbers, values, place = body.unpack_from(data, _HEADER.size), list[object](), 0
    for code, each in fields:
        if not each:
            values.append(numbers[place])
            place += 1
            continue
        several = numbers[place : place + joints]
        place += joints
        if code == "B" and max(several) > 1:
            raise MalformedFrame(f"malformed frame: {max(several)} is no yes or no")
        values.append(np.array(several, dtype=_ARRAYS[code]) if code in _ARRAYS else several)
    make: Callable[..., Request | Reply] = frame
    found = make(*values)
    if isinstance(found, Exchange) and not (found.sends <= 1 and np.isfinite(found.torque).all()):
        raise MalformedFrame(f"malformed frame: a torque of {found.torque}")
    if isinstance(found, Stop) and found.brakes > 1:
        raise MalformedFrame(f"malformed frame: {found.brakes} is no yes or no")
    return number, found


@cache
def _body(kind: int, joints: int) -> struct.Struct:
    return struct.Struct("<" + "".join(f"{joints}{code}" if each else code for code, each in _FRAMES[kind][1]))


def text_of(failed: Failed) -> str:
    """Return the reason of a failure as text."""
    return failed.text.rstrip(b"\0").decode("utf-8", errors="replace")


def failure_of(error: Exception) -> Failed:
    """Create the reply that reports an error, its text cut to the frame's length."""
    return Failed(str(error).encode()[:_TEXT])
