"""Send stop commands to each drive by itself, and again until its link has taken them.

A transmit queue that is full for a moment, or one bus of two that has failed, must not lose the stop of any drive. The
drives' own deadline for torque frames comes before the last try, so that nobody waits for this.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

from drivers.arm import StopKind
from drivers.canopen.cia402 import DISABLE_VOLTAGE, QUICK_STOP, DriveState
from drivers.canopen.sync_cycle import Buses

_TRIES, _AGAIN = 75, 0.001  # s between them
_BRAKING = 1.0  # s that drives may take for a quick stop before the arm is left to them
_FAREWELL = 5  # cycles after the last control words, in which drives report that they are off
_ENDING = (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP, DriveState.FAULT_REACTION)


class StopCommand:
    """Hold the last stop command, and the drives that it could not be sent to yet; no method raises.

    Attributes:
        braking: whether it is a quick stop.
    """

    def __init__(self) -> None:
        self.braking = False
        self._untold: list[int] = []

    def give(self, buses: Buses, kind: StopKind) -> None:
        """Send the stop to every drive; for 75 ms again to those whose link has not taken it."""
        self.braking = kind is StopKind.QUICK_STOP
        self._untold = list(range(len(buses.drives)))
        for _ in range(_TRIES):
            self.repeat(buses)
            if not self._untold:
                break
            with suppress(Exception):
                buses.clock.sleep_until_ns(buses.clock.now_ns() + round(_AGAIN * 1e9))

    def repeat(self, buses: Buses) -> None:
        """Send the stop once more to the drives whose link has not taken it."""
        word, drives, self._untold = QUICK_STOP if self.braking else DISABLE_VOLTAGE, self._untold, []
        for number in drives:
            try:
                buses.control(number, word)
            except Exception:  # noqa: BLE001 - whatever the link died of, the other drives must be told
                self._untold.append(number)

    def counts(self, zero: Sequence[int]) -> Sequence[int] | None:
        """Return the torques to send: zero, or None for no torque frames before all drives were told to brake.

        By zero torque alone an arm without brakes would fall.

        Args:
            zero: torque of every drive [per mille of rated torque].
        """
        return None if self.braking and self._untold else zero

    def see_through(self, buses: Buses, zero: Sequence[int] | None, period_ns: int) -> None:
        """Cycle until the drives report that they are off, or have had their time; a lost command is sent again.

        Args:
            buses: open.
            zero: as for `counts`; None where no torque frames are sent.
            period_ns: of a cycle [ns].
        """
        for cycle in range(1, max(_FAREWELL, round(_BRAKING * 1e9 / period_ns)) + 1):
            self.repeat(buses)
            with suppress(Exception):  # of one cycle: the next one may be possible
                buses.cycle(None if zero is None else self.counts(zero))
            brakes = self.braking and any(drive.state in _ENDING for drive in buses.drives)
            if brakes and cycle % _FAREWELL == 0:
                self._untold = list(range(len(buses.drives)))  # what was sent may have been lost
            if cycle >= _FAREWELL and not brakes:
                break
        self._untold = []
