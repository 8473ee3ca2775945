"""An arm that takes no torque once somebody asks for a stop: for whoever moves it without a loop that asks.

Preflight moves an arm by hand's breadths, and ends whatever goes wrong with torque off; so does a stop in it.
"""

from __future__ import annotations

from collections.abc import Callable

from drivers.arm import Arm, ArmDescription, Sample, StopKind, Vector, Watchdog
from drivers.status import AxisStatus
from ident_service.errors import DriverError


class StoppableArm(Arm):
    """Another arm; before it is energised, and before every torque, somebody may have asked for a stop."""

    def __init__(self, arm: Arm, asked: Callable[[], bool]) -> None:
        """Take an arm, and who says whether it is to stop."""
        self._arm, self._asked = arm, asked
        self.clock = arm.clock

    def open(self) -> None:
        """Open it; the clock is its then."""
        self._arm.open()
        self.clock = self._arm.clock

    def describe(self) -> ArmDescription:
        """As the arm says."""
        return self._arm.describe()

    def enable(self) -> None:
        """As the arm does; raises DriverError instead once a stop was asked for."""
        self._require_not_asked()
        self._arm.enable()

    def reset(self) -> None:
        """As the arm does."""
        self._arm.reset()

    def exchange(self, torque: Vector | None) -> Sample:
        """As the arm does; raises DriverError instead of sending a torque once a stop was asked for."""
        if torque is not None:
            self._require_not_asked()
        return self._arm.exchange(torque)

    def watchdogs(self) -> tuple[Watchdog, ...]:
        """As the arm says."""
        return self._arm.watchdogs()

    def withhold(self, kind: str) -> None:
        """As the arm does."""
        self._arm.withhold(kind)

    def drive_status(self) -> tuple[AxisStatus, ...]:
        """As the arm says."""
        return self._arm.drive_status()

    def stop(self, kind: StopKind) -> None:
        """As the arm does."""
        self._arm.stop(kind)

    def close(self) -> None:
        """As the arm does."""
        self._arm.close()

    def _require_not_asked(self) -> None:
        if self._asked():
            raise DriverError("somebody asked for a stop")
