"""Check that a frame can exist on a bus at all (ISO 11898-1), so that it is refused here and not by a drive."""

from __future__ import annotations

from typing import Final

from drivers.can.can_frame import Frame
from ident_service.errors import DriverError

FD_LENGTHS: Final = frozenset((*range(9), 12, 16, 20, 24, 32, 48, 64))


def check_sendable(frame: Frame, *, fd: bool) -> None:
    """Raise DriverError for a frame that no controller would send.

    Args:
        frame: to be sent.
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
