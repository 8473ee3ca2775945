"""A frame as the kernel's CAN sockets carry it (linux/can.h), to and from `Frame`.

`struct can_frame` has 16 bytes: identifier and flags (32 bit, native order), length, 3 bytes of padding, 8 of data.
`struct canfd_frame` has 72: the same with a byte of flags after the length and 64 of data.

Boundary: bytes in, values out; no socket.
"""

from __future__ import annotations

import struct
from typing import Final

from drivers.canopen.frame import Frame
from ident_service.errors import DriverError

CLASSIC_BYTES: Final = 16
FD_BYTES: Final = 72
EXTENDED, REMOTE, ERROR = 0x8000_0000, 0x4000_0000, 0x2000_0000
RATE_SWITCH: Final = 0x01  # CANFD_BRS: the data phase at the data bit rate
_CLASSIC: Final = struct.Struct("=IB3x8s")
_FD: Final = struct.Struct("=IBB2x64s")


def to_kernel(frame: Frame, *, fd: bool = False) -> bytes:
    """Bytes to write to a socket.

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
    """The frame that was read from a socket.

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
