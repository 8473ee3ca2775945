"""Emulate emergency messages, error register and error history of a node (CiA 301, 7.2.7; objects 1001h, 1003h)."""

from __future__ import annotations

import struct

from sim_backend.canopen_device.node import Node

GENERIC, CURRENT, VOLTAGE, TEMPERATURE, COMMUNICATION, PROFILE = 0x01, 0x02, 0x04, 0x08, 0x10, 0x20
_HISTORY = 8
_INVALID = 1 << 31
_INHIBIT = "emergency"
_UNIT_NS = 100_000  # of 1015h

# Error codes by their first four or eight bits (CiA 301, table 26), and the register bit of each.
_REGISTER = {0x2: CURRENT, 0x3: VOLTAGE, 0x4: TEMPERATURE, 0x81: COMMUNICATION, 0x82: COMMUNICATION, 0x86: PROFILE}


class Emergency:
    """Hold the errors of a node, in the order in which they came, and send emergency messages."""

    def __init__(self, node: Node) -> None:
        """Start without errors."""
        self._node = node
        self._waiting: list[bytes] = []
        self.active: list[int] = []

    def reset(self) -> None:
        """Discard all errors without a message."""
        self.active.clear()
        self._waiting.clear()
        self._node.stop_timer(_INHIBIT)

    @property
    def register(self) -> int:
        """Return the error register, object 1001h."""
        bits = 0
        for code in self.active:
            bits |= GENERIC | _REGISTER.get(code >> 12, 0) | _REGISTER.get(code >> 8, 0)
        return bits

    def add_error(self, code: int) -> None:
        """Add an error, record it in the history and send its emergency message; do nothing if it is active already."""
        if code in self.active:
            return
        self.active.append(code)
        objects = self._node.objects
        history = [code, *(objects.number(0x1003, k) for k in range(1, _HISTORY))]
        objects.put(0x1003, min(objects.number(0x1003) + 1, _HISTORY))
        for number, old in enumerate(history, 1):
            objects.put(0x1003, old, number)
        objects.put(0x603F, code)
        self._tell(code)

    def remove_errors(self, *codes: int) -> None:
        """Remove errors; sends `error reset` if some of them were active."""
        gone = [code for code in self.active if code in codes]
        if gone:
            self.active = [code for code in self.active if code not in codes]
            self._tell(0)

    def timer_ran_out(self, timer: str) -> None:
        """Send the next waiting emergency if `timer`, which ran out, is that of the inhibit time; ignore others."""
        if timer == _INHIBIT and self._waiting:
            self._transmit(self._waiting.pop(0))

    def _tell(self, code: int) -> None:
        self._node.objects.put(0x1001, self.register)
        message = struct.pack("<HB5x", code, self.register)
        if _INHIBIT in self._node.timers:
            self._waiting.append(message)
        else:
            self._transmit(message)

    def _transmit(self, message: bytes) -> None:
        objects = self._node.objects
        identifier = objects.number(0x1014) or 0x80 + self._node.number  # where none is listed, CiA 301's
        if not identifier & _INVALID:
            self._node.send(identifier & 0x7FF, message)
        if inhibit := objects.number(0x1015):
            self._node.start_timer(_INHIBIT, inhibit * _UNIT_NS)
