"""Error counters of one controller and what they make of it (ISO 11898-1, fault confinement).

An error while sending counts 8, while receiving 1; a success takes one back. From 96 the controller warns, from 128 it
is error-passive, a send counter above 255 takes it off the bus until it is restarted.

Boundary: pure computation. Changes come out as the error frames that the kernel would hand on (linux/can/error.h).
"""

from __future__ import annotations

from typing import Final, Literal

from drivers.canopen.bus_errors import (
    ACTIVE,
    BUS_OFF,
    CONTROLLER,
    COUNTERS,
    PASSIVE_RX,
    PASSIVE_TX,
    RESTARTED,
    WARNING_RX,
    WARNING_TX,
)
from drivers.canopen.frame import Frame

State = Literal["active", "warning", "passive", "off"]
_WARNING, _PASSIVE, _OFF = 96, 128, 256
_PASSIVE_SUCCESS: Final = 127  # what a success sets the receive counter of a passive controller to


class ErrorCounters:
    """Two counters, and the state they stand for.

    Attributes:
        sending, receiving: the counters, each at most 256.
        state: of the controller.
    """

    def __init__(self) -> None:
        self.sending = self.receiving = 0
        self.state: State = "active"

    def set(self, sending: int, receiving: int, stamp_ns: int) -> Frame | None:
        """Set both; the error frame when the state changes."""
        self.sending, self.receiving = min(max(sending, 0), _OFF), min(max(receiving, 0), _OFF)
        return self._change(stamp_ns)

    def send_error(self, stamp_ns: int) -> Frame | None:
        """A frame of this controller was destroyed."""
        return self.set(self.sending + 8, self.receiving, stamp_ns)

    def receive_error(self, stamp_ns: int) -> Frame | None:
        """A frame of another one was."""
        return self.set(self.sending, self.receiving + 1, stamp_ns)

    def sent(self, stamp_ns: int) -> Frame | None:
        """A frame went out."""
        return self.set(self.sending - 1, self.receiving, stamp_ns) if self.sending else None

    def received(self, stamp_ns: int) -> Frame | None:
        """A frame came in."""
        return self.set(self.sending, min(self.receiving - 1, _PASSIVE_SUCCESS), stamp_ns) if self.receiving else None

    def restart(self, stamp_ns: int) -> Frame:
        """Back on the bus, both counters zero."""
        self.sending = self.receiving = 0
        self.state = "active"
        return Frame(RESTARTED, bytes(8), error=True, stamp_ns=stamp_ns)

    def _change(self, stamp_ns: int) -> Frame | None:
        most = max(self.sending, self.receiving)
        state: State = "active"
        if self.state == "off" or self.sending >= _OFF:
            state = "off"
        elif most >= _PASSIVE:
            state = "passive"
        elif most >= _WARNING:
            state = "warning"
        if state == self.state:
            return None
        self.state = state
        if state == "off":
            return Frame(BUS_OFF, bytes(8), error=True, stamp_ns=stamp_ns)
        detail = ACTIVE
        if state != "active":
            send, receive = (PASSIVE_TX, PASSIVE_RX) if state == "passive" else (WARNING_TX, WARNING_RX)
            limit = _PASSIVE if state == "passive" else _WARNING
            detail = (send if self.sending >= limit else 0) | (receive if self.receiving >= limit else 0)
        counters = (min(self.sending, 255), min(self.receiving, 255))
        return Frame(CONTROLLER | COUNTERS, bytes((0, detail, 0, 0, 0, 0, *counters)), error=True, stamp_ns=stamp_ns)
