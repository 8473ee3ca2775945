"""Define the CAN frame that every layer of this package passes on."""

from __future__ import annotations

from typing import NamedTuple


class Frame(NamedTuple):
    """Represent a data frame with an 11-bit identifier, unless a flag says otherwise (ISO 11898-1).

    Attributes:
        identifier: COB-ID.
        data: payload, up to 8 bytes (64 with CAN FD).
        remote: a remote frame; `data` is empty.
        error: an error frame of the controller, not of the wire; `identifier` holds the error class bits of
            linux/can/error.h and `data` its details.
        extended: a 29-bit identifier, which CANopen never uses.
        stamp_ns: when it was received, monotonic [ns]; 0 where unknown.
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
