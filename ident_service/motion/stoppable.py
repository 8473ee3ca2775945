"""Wrap an arm so that it takes no torque once a stop was asked for, for callers without a loop that checks for stops.

Preflight moves an arm by a few centimetres, and ends whatever goes wrong with torque off; so does a stop in it.
"""

from __future__ import annotations

from collections.abc import Callable

from drivers.arm import Arm, ArmDescription, Sample, StopKind, Vector, Watchdog
from drivers.axis_status import AxisStatus
from ident_service.errors import DriverError


class StoppableArm(Arm):
    """Wrap an arm and refuse to enable it, or to send a torque, once a stop was asked for."""

    def __init__(self, arm: Arm, asked: Callable[[], bool]) -> None:
        """Wrap the given arm; `asked` returns whether it is to stop."""
        self._arm, self._asked = arm, asked
        self.clock = arm.clock

    def open(self) -> None:
        """Open the wrapped arm and use its clock."""
        self._arm.open()
        self.clock = self._arm.clock

    def describe(self) -> ArmDescription:
        """Return the wrapped arm's description."""
        return self._arm.describe()

    def enable(self) -> None:
        """Enable the wrapped arm; raises DriverError instead once a stop was asked for."""
        self._require_not_asked()
        self._arm.enable()

    def reset(self) -> None:
        """Reset the wrapped arm."""
        self._arm.reset()

    def exchange(self, torque: Vector | None) -> Sample:
        """Exchange with the wrapped arm; raises DriverError instead of sending a torque once a stop was asked for."""
        if torque is not None:
            self._require_not_asked()
        return self._arm.exchange(torque)

    def watchdogs(self) -> tuple[Watchdog, ...]:
        """Return the wrapped arm's watchdogs."""
        return self._arm.watchdogs()

    def withhold(self, kind: str) -> None:
        """Withhold what watchdogs of one kind watch from the wrapped arm's drives."""
        self._arm.withhold(kind)

    def drive_status(self) -> tuple[AxisStatus, ...]:
        """Return the wrapped arm's drive status."""
        return self._arm.drive_status()

    def stop(self, kind: StopKind) -> None:
        """Stop the wrapped arm."""
        self._arm.stop(kind)

    def close(self) -> None:
        """Close the wrapped arm."""
        self._arm.close()

    def _require_not_asked(self) -> None:
        if self._asked():
            raise DriverError("somebody asked for a stop")
