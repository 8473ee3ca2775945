"""Count the errors of one CAN controller and derive its state (ISO 11898-1, fault confinement).

An error while sending counts 8, while receiving 1; a success takes one back. From 96 the controller warns, from 128 it
is error-passive, a send counter above 255 takes it off the bus until it is restarted.

Changes of state come out as the error frames that the kernel would pass on (linux/can/error.h).
"""

from __future__ import annotations

from typing import Final, Literal

from drivers.can.bus_errors import (
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
from drivers.can.can_frame import Frame

State = Literal["active", "warning", "passive", "off"]
_WARNING, _PASSIVE, _OFF = 96, 128, 256
_PASSIVE_SUCCESS: Final = 127  # what a success sets the receive counter of a passive controller to


class ErrorCounters:
    """Count send and receive errors of a controller, and derive its state.

    Attributes:
        sending, receiving: the counters, each at most 256.
        state: of the controller.
    """

    def __init__(self) -> None:
        self.sending = self.receiving = 0
        self.state: State = "active"

    def set(self, sending: int, receiving: int, stamp_ns: int) -> Frame | None:
        """Set both counters; returns the error frame when the state changes."""
        self.sending, self.receiving = min(max(sending, 0), _OFF), min(max(receiving, 0), _OFF)
        return self._change(stamp_ns)

    def send_error(self, stamp_ns: int) -> Frame | None:
        """Count a destroyed frame of this controller."""
        return self.set(self.sending + 8, self.receiving, stamp_ns)

    def receive_error(self, stamp_ns: int) -> Frame | None:
        """Count a destroyed frame of another controller."""
        return self.set(self.sending, self.receiving + 1, stamp_ns)

    def sent(self, stamp_ns: int) -> Frame | None:
        """Count a frame sent without error."""
        return self.set(self.sending - 1, self.receiving, stamp_ns) if self.sending else None

    def received(self, stamp_ns: int) -> Frame | None:
        """Count a frame received without error."""
        return self.set(self.sending, min(self.receiving - 1, _PASSIVE_SUCCESS), stamp_ns) if self.receiving else None

    def restart(self, stamp_ns: int) -> Frame:
        """Return to the bus with both counters zero; returns the error frame that says so."""
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
