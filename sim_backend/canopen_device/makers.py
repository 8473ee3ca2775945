"""Emulate watchdogs that no standard has, in place of those of real makers.

2F70h says after how many periods (1006h) without SYNC, and 2F75h after how many milliseconds without a target torque,
the drive takes its host for gone; 0 is never.
"""

from __future__ import annotations

from collections.abc import Callable

from sim_backend.canopen_device.emergency import Emergency
from sim_backend.canopen_device.node import Node

NO_SYNC, NO_TARGET = 0x8700, 0xFF01
_PERIODS, _MILLISECONDS, _SYNC_PERIOD = 0x2F70, 0x2F75, 0x1006
_SYNC, _TARGET = "sync", "target"


class MakersWatchdogs:
    """Emulate both watchdogs of one drive; each starts with the first event that it supervises."""

    def __init__(self, node: Node, emergency: Emergency, late: Callable[[], None], *, there: bool) -> None:
        """Use the drive's parts; `late` is called when the host is gone, `there`: whether the drive has watchdogs."""
        self._there = there
        self._node, self._emergency, self._late = node, emergency, late

    def synced(self) -> None:
        """Restart the watchdog of SYNC."""
        number = self._node.objects.number
        self._wait(_SYNC, NO_SYNC, number(_PERIODS) * number(_SYNC_PERIOD) * 1_000)

    def targeted(self) -> None:
        """Restart the watchdog of target torques."""
        self._wait(_TARGET, NO_TARGET, self._node.objects.number(_MILLISECONDS) * 1_000_000)

    def stop(self) -> None:
        """Stop both watchdogs."""
        self._node.stop(_SYNC)
        self._node.stop(_TARGET)

    def due(self, name: str) -> None:
        """Handle the due timer of this name."""
        if name in (_SYNC, _TARGET):
            self._emergency.occurs(NO_SYNC if name == _SYNC else NO_TARGET)
            self._late()

    def _wait(self, name: str, code: int, delay_ns: int) -> None:
        if delay_ns and self._there:
            self._node.after(name, delay_ns)
            self._emergency.is_over(code)
