"""Encode and decode the packets between the wire and its ends: sequenced-packet socket, little-endian.

An end says `Hello` first and is answered with a `Welcome`; from then on each packet in either direction holds one or
more frames in their order (`pack_frames`).

Every malformed packet is one DriverError.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final

from ident_service.errors import DriverError

MAGIC: Final = b"IDCW"
VERSION: Final = 2
_OWN, _FD = 1, 2  # flags of Hello: receive own frames; its controller supports CAN FD
_HELLO: Final = struct.Struct("<4sBBBx32s")
_FILTER: Final = struct.Struct("<HH")
_WELCOME: Final = struct.Struct("<4sBBBxII")
_MAX_FILTERS: Final = 16

ACCEPTED, OTHER_VERSION, CROWDED = 0, 1, 2  # answers


@dataclass(frozen=True, slots=True)
class Hello:
    """Represent an end's greeting: label, whether it wants its own frames, filters (identifier, mask), and CAN FD."""

    label: str
    own: bool = False
    filters: tuple[tuple[int, int], ...] = ()
    fd: bool = True


@dataclass(frozen=True, slots=True)
class Welcome:
    """Represent the wire's answer: acceptance, bit rates (0: no pace, no switch), and whether it carries CAN FD."""

    answer: int = ACCEPTED
    bitrate: int = 0
    fd: bool = False
    data_bitrate: int = 0


def pack_hello(hello: Hello) -> bytes:
    """Encode the greeting that an end sends first, label cut to 32 bytes; DriverError for more than 16 filters."""
    if len(hello.filters) > _MAX_FILTERS:
        raise DriverError(f"{len(hello.filters)} filters, at most {_MAX_FILTERS}")
    label = hello.label.encode()[:32].decode(errors="ignore").encode()
    flags = _OWN * hello.own | _FD * hello.fd
    head = _HELLO.pack(MAGIC, VERSION, flags, len(hello.filters), label)
    return head + b"".join(_FILTER.pack(*pair) for pair in hello.filters)


def unpack_hello(data: bytes) -> Hello:
    """Decode the greeting that an end sends first; raises DriverError where it is none.

    Raises:
        DriverError: it is no greeting, or of another version.
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
    """Encode the welcome with which a simulated bus answers a greeting."""
    return _WELCOME.pack(MAGIC, VERSION, welcome.answer, welcome.fd, welcome.bitrate, welcome.data_bitrate)


def unpack_welcome(data: bytes) -> Welcome:
    """Decode the welcome of a simulated bus; one of another version has the answer `OTHER_VERSION`.

    Raises:
        DriverError: it is no such answer.
    """
    if len(data) != _WELCOME.size or data[:4] != MAGIC:
        raise DriverError("not the answer of a wire")
    _, version, answer, fd, bitrate, data_bitrate = _WELCOME.unpack(data)
    return Welcome(OTHER_VERSION if version != VERSION else answer, bitrate, bool(fd), data_bitrate)
