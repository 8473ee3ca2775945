"""Represent CAN frames (ISO 11898-1): checks, the kernel's bytes (linux/can.h), packets between processes.

`struct can_frame` has 16 bytes: identifier and flags (32 bit, native order), length, 3 bytes of padding, 8 of data.
`struct canfd_frame` has 72: the same with a byte of flags after the length and 64 of data.
`struct canfd_frame` has 72: the same with a byte of flags after the length and 64 of data.

SDO is among them, since drives are configured over the same link before anything streams. Frames of foreign nodes are
received too: a second master's SYNC or torque is a fault.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import Final, NamedTuple

from ident_service.errors import DriverError


class Frame(NamedTuple):
    """Represent a data frame with an 11-bit identifier, unless a flag says otherwise (ISO 11898-1).

    Attributes:
        identifier: COB-ID.
        data: payload, up to 8 bytes (64 with CAN FD).
        remote: a remote frame; `data` is empty.
        error: an error frame of the controller, not of the wire; `identifier` holds the error class bits of
            linux/can/error.h and `data` its details.
        extended: a 29-bit identifier, which CANopen never uses.
        stamp_ns: time when it was received, monotonic [ns]; 0 where unknown.
        fd: a CAN FD frame with its bit rate switched. What a driver sends is one where its link's bus is configured so,
            whatever stands here.
    """

    identifier: int
    data: bytes = b""
    remote: bool = False
    error: bool = False
    extended: bool = False
    stamp_ns: int = 0
    fd: bool = False


FD_LENGTHS: Final = frozenset((*range(9), 12, 16, 20, 24, 32, 48, 64))


def check_sendable(frame: Frame, *, fd: bool) -> None:
    """Raise DriverError for a frame that no controller would send.

    Args:
        frame: frame to be sent.
        fd: whether the bus carries CAN FD frames.

    Raises:
        DriverError: an identifier or length that does not exist, an error frame, data in a remote frame.
    """
    length = len(frame.data)
    if not 0 <= frame.identifier <= (0x1FFF_FFFF if frame.extended else 0x7FF):
        raise DriverError(f"identifier {frame.identifier:X}h does not fit {29 if frame.extended else 11} bits")
    if length > 8 and not (fd and length in FD_LENGTHS):
        on = "a CAN FD frame cannot have" if fd else "a frame has at most 8 bytes, not"
        raise DriverError(f"identifier {frame.identifier:X}h: {on} {length}")
    if frame.error or (frame.remote and length):
        what = "an error frame is the controller's, not ours" if frame.error else "a remote frame has no data"
        raise DriverError(f"identifier {frame.identifier:X}h: {what}")


CLASSIC_BYTES: Final = 16
FD_BYTES: Final = 72
EXTENDED, REMOTE, ERROR = 0x8000_0000, 0x4000_0000, 0x2000_0000
RATE_SWITCH: Final = 0x01  # CANFD_BRS: the data phase at the data bit rate
_CLASSIC: Final = struct.Struct("=IB3x8s")
_FD: Final = struct.Struct("=IBB2x64s")
MAX_PACKET_BYTES: Final = 8192
MAX_PACKET_FRAMES: Final = 64  # fits with 64 bytes each
_PACKED: Final = struct.Struct("<qIBB2x")
_ECHO_FLAG: Final = 1  # the frame is an echo, or was sent rather than received
_FD_FLAG: Final = 2


def to_kernel(frame: Frame, *, fd: bool = False) -> bytes:
    """Return the bytes of a frame to write to a socket.

    Args:
        frame: one that `check_sendable` accepts.
        fd: whether data frames go out as CAN FD with rate switch; a remote frame stays classic, FD has none.
    """
    word = frame.identifier | (EXTENDED if frame.extended else 0) | (REMOTE if frame.remote else 0)
    if frame.error:
        word |= ERROR
    if fd and not (frame.remote or frame.error):
        return _FD.pack(word, len(frame.data), RATE_SWITCH, frame.data)
    return _CLASSIC.pack(word, len(frame.data), frame.data)


def from_kernel(data: bytes, stamp_ns: int = 0) -> Frame:
    """Return the frame that was read from a socket as bytes; DriverError for bytes that are none.

    Raises:
        DriverError: bytes that are neither of the two structures, or a length that exceeds the structure's.
    """
    if len(data) == CLASSIC_BYTES:
        word, length, payload = _CLASSIC.unpack(data)
    elif len(data) == FD_BYTES:
        word, length, _, payload = _FD.unpack(data)
    else:
        raise DriverError(f"a CAN socket gave {len(data)} bytes, neither 16 nor 72")
    if length > len(payload):
        raise DriverError(f"a CAN frame of {length} bytes in a structure for {len(payload)}")
    remote, error, extended = bool(word & REMOTE), bool(word & ERROR), bool(word & EXTENDED)
    identifier = word & (0x1FFF_FFFF if extended or error else 0x7FF)
    fd = len(data) == FD_BYTES
    return Frame(identifier, b"" if remote else payload[:length], remote, error, extended, stamp_ns, fd)


def pack_frames(frames: Iterable[tuple[Frame, bool]]) -> bytes:
    """Pack frames, each with whether the packet's recipient sent it, into one little-endian packet for another process.

    A frame is a header of 16 bytes (stamp [ns], the kernel's identifier word, length, flags) and its data.

    Args:
        frames: frames that can exist on a bus, at most `MAX_PACKET_FRAMES`, each with whether the recipient of the
            packet sent it.
    """
    parts = []
    for (identifier, data, remote, error, extended, stamp_ns, fd), own in frames:
        word = identifier | (EXTENDED if extended else 0) | (REMOTE if remote else 0) | (ERROR if error else 0)
        parts.append(_PACKED.pack(stamp_ns, word, len(data), own | fd << 1))
        parts.append(data)
    return b"".join(parts)


def unpack_frames(data: bytes) -> list[tuple[Frame, bool]]:
    """Unpack the frames of one packet, each with whether the packet's recipient sent it; DriverError for a bad packet.

    Raises:
        DriverError: a packet that is empty, too long, torn, or has a frame that cannot exist.
    """
    if not 0 < len(data) <= MAX_PACKET_BYTES:
        raise DriverError(f"a packet of {len(data)} bytes")
    frames, at, end = [], 0, len(data)
    while at < end:
        if end - at < _PACKED.size:
            raise DriverError(f"a torn packet: {end - at} bytes left")
        stamp_ns, word, length, flags = _PACKED.unpack_from(data, at)
        at += _PACKED.size
        payload = data[at : at + length]
        at += length
        remote, error, extended = bool(word & REMOTE), bool(word & ERROR), bool(word & EXTENDED)
        identifier = word & 0x1FFF_FFFF
        fd = bool(flags & _FD_FLAG)
        if (
            len(payload) != length
            or length not in FD_LENGTHS
            or (length > 8 and not fd)
            or (remote and length)
            or (fd and (remote or error))
            or flags & ~(_ECHO_FLAG | _FD_FLAG)
        ):
            raise DriverError(f"a malformed frame: {length=}, {flags=}")
        if identifier > 0x7FF and not (extended or error):
            raise DriverError(f"identifier {identifier:X}h does not fit 11 bits")
        frames.append((Frame(identifier, payload, remote, error, extended, stamp_ns, fd), bool(flags & _ECHO_FLAG)))
    return frames


# Identifier and mask; a frame with 11 bits of identifier is received when any pair fits.
RECEIVE_FILTER: Final = ((0x000, 0x000),)


# Frames of one drain: a flood, which no bus but a local socket can bring, must not hold the loop.
MOST_AT_ONCE: Final = 4096
