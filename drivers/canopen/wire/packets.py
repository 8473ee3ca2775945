"""What travels between the wire and its ends: packets of a sequenced-packet socket, little-endian.

An end says `Hello` first and is answered with a `Welcome`; from then on each packet in either direction holds one or
more frames in their order. A frame is a header of 16 bytes (stamp [ns], the kernel's identifier word, length, flags)
and its data.

Boundary: bytes in, values out; every malformed packet is one DriverError.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from drivers.canopen.frame import Frame
from drivers.canopen.kernel_frame import ERROR, EXTENDED, REMOTE
from drivers.canopen.sendable import FD_LENGTHS
from ident_service.errors import DriverError

MAGIC: Final = b"IDCW"
VERSION: Final = 2
MAX_BYTES: Final = 8192
MAX_FRAMES: Final = 64  # in one packet; fits with 64 bytes each
_OWN: Final = 1  # flag of Hello: hear own frames; flag of a frame: it is an echo, or was sent rather than heard
_FD: Final = 2  # flag of Hello: its controller knows CAN FD; flag of a frame: it is one
_CLASSIC_BYTES: Final = 8
_HELLO: Final = struct.Struct("<4sBBBx32s")
_FILTER: Final = struct.Struct("<HH")
_WELCOME: Final = struct.Struct("<4sBBBxII")
_FRAME: Final = struct.Struct("<qIBB2x")
_MAX_FILTERS: Final = 16

ACCEPTED, OTHER_VERSION, CROWDED = 0, 1, 2  # answers


@dataclass(frozen=True, slots=True)
class Hello:
    """Who connects, whether it wants its own frames, which others (identifier, mask), and whether it knows CAN FD."""

    label: str
    own: bool = False
    filters: tuple[tuple[int, int], ...] = ()
    fd: bool = True


@dataclass(frozen=True, slots=True)
class Welcome:
    """The wire's answer: whether it takes the end, its bit rates (0: no pace, no switch), whether it carries CAN FD."""

    answer: int = ACCEPTED
    bitrate: int = 0
    fd: bool = False
    data_bitrate: int = 0


def pack_hello(hello: Hello) -> bytes:
    """Bytes of the first packet; the label is cut to 32 bytes."""
    if len(hello.filters) > _MAX_FILTERS:
        raise DriverError(f"{len(hello.filters)} filters, at most {_MAX_FILTERS}")
    label = hello.label.encode()[:32].decode(errors="ignore").encode()
    flags = _OWN * hello.own | _FD * hello.fd
    head = _HELLO.pack(MAGIC, VERSION, flags, len(hello.filters), label)
    return head + b"".join(_FILTER.pack(*pair) for pair in hello.filters)


def unpack_hello(data: bytes) -> Hello:
    """The first packet of an end.

    Raises:
        DriverError: it is none, or of another version.
    """
    if len(data) < _HELLO.size or data[:4] != MAGIC:
        raise DriverError("no greeting")
    _, version, flags, count, label = _HELLO.unpack_from(data)
    if version != VERSION:
        raise DriverError(f"version {version}, not {VERSION}")
    if flags & ~(_OWN | _FD) or count > _MAX_FILTERS or len(data) != _HELLO.size + count * _FILTER.size:
        raise DriverError("a malformed greeting")
    filters = tuple(_FILTER.iter_unpack(data[_HELLO.size :]))
    return Hello(label.rstrip(b"\0").decode(errors="replace"), bool(flags & _OWN), filters, bool(flags & _FD))


def pack_welcome(welcome: Welcome) -> bytes:
    """Bytes of the answer."""
    return _WELCOME.pack(MAGIC, VERSION, welcome.answer, welcome.fd, welcome.bitrate, welcome.data_bitrate)


def unpack_welcome(data: bytes) -> Welcome:
    """The answer of a wire.

    Raises:
        DriverError: it is none.
    """
    if len(data) != _WELCOME.size or data[:4] != MAGIC:
        raise DriverError("not the answer of a wire")
    _, version, answer, fd, bitrate, data_bitrate = _WELCOME.unpack(data)
    return Welcome(OTHER_VERSION if version != VERSION else answer, bitrate, bool(fd), data_bitrate)


def pack_frames(frames: Iterable[tuple[Frame, bool]]) -> bytes:
    """Bytes of one packet.

    Args:
        frames: at most `MAX_FRAMES` that exist on a bus, and whether each was sent by whom the packet is for.
    """
    parts = []
    for (identifier, data, remote, error, extended, stamp_ns, fd), own in frames:
        word = identifier | (EXTENDED if extended else 0) | (REMOTE if remote else 0) | (ERROR if error else 0)
        parts.append(_FRAME.pack(stamp_ns, word, len(data), own | fd << 1))
        parts.append(data)
    return b"".join(parts)


def unpack_frames(data: bytes) -> list[tuple[Frame, bool]]:
    """Frames of one packet, and whether each was sent by whom the packet is for.

    Raises:
        DriverError: a packet that is empty, too long, torn, or has a frame that cannot exist.
    """
    if not 0 < len(data) <= MAX_BYTES:
        raise DriverError(f"a packet of {len(data)} bytes")
    frames, at, end = [], 0, len(data)
    while at < end:
        if end - at < _FRAME.size:
            raise DriverError(f"a torn packet: {end - at} bytes left")
        stamp_ns, word, length, flags = _FRAME.unpack_from(data, at)
        at += _FRAME.size
        payload = data[at : at + length]
        at += length
        remote, error, extended = bool(word & REMOTE), bool(word & ERROR), bool(word & EXTENDED)
        identifier = word & 0x1FFF_FFFF
        fd = bool(flags & _FD)
        if (
            len(payload) != length
            or length not in FD_LENGTHS
            or (length > _CLASSIC_BYTES and not fd)
            or (remote and length)
            or (fd and (remote or error))
            or flags & ~(_OWN | _FD)
        ):
            raise DriverError(f"a malformed frame: {length=}, {flags=}")
        if identifier > 0x7FF and not (extended or error):
            raise DriverError(f"identifier {identifier:X}h does not fit 11 bits")
        frames.append((Frame(identifier, payload, remote, error, extended, stamp_ns, fd), bool(flags & _OWN)))
    return frames
