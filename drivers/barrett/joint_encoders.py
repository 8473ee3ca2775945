"""Follow encoders at the joints, and compare how far joints and motors have moved since the arm was opened.

What a joint encoder counts from is not known. So each takes the motors' position where the arm is opened, and from then
on says the same as they, but for what cables stretch. Where it does not, a cable has slipped or broken, or one of the
two encoders is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import pi
from typing import Final

import numpy as np

from drivers.arm import SetupCheck, Vector
from drivers.axis_status import AxisEvent, AxisEventCode
from drivers.barrett.cycle import MotorPuck
from drivers.barrett.protocol import POSITION_BITS
from drivers.motor_units import Coordinates, unwrapped
from ident_service.config.barrett import BarrettDriver

_CYCLES: Final = 3  # in a row beyond the tolerance: two encoders are not read in the very same moment


class JointEncoders:
    """Follow the joint encoders of one arm."""

    def __init__(self, driver: BarrettDriver, coordinates: Coordinates, names: Sequence[str]) -> None:
        """Use the description; nothing is known yet.

        Args:
            driver: the section `driver`.
            coordinates: of the arm.
            names: of the joints.
        """
        self._pucks, self._names, self._tolerance = driver.pucks, names, driver.joint_tolerance
        self._radians = {k: 2.0 * pi / puck.joint_counts for k, puck in enumerate(driver.pucks) if puck.joint_counts}
        self._motors_of = coordinates.motors_of
        self._counts: dict[int, int] = {}
        self._origin: dict[int, float] = {}
        self._beyond = dict.fromkeys(self._radians, 0)
        self._position = np.full(len(names), np.nan)

    def checks(self, pucks: Sequence[MotorPuck]) -> tuple[SetupCheck, ...]:
        """Compare whether pucks tell a joint encoder with the description.

        Args:
            pucks: as they have answered.
        """
        remedy = "List the nodes that read one in driver.joint_encoders, with joint_counts; its bits are on the bus."
        words = {True: "told", False: "not told"}
        return tuple(
            SetupCheck(
                f"joint encoder of puck {puck.node}", words[puck.encoder is not None], words[k in self._radians], remedy
            )
            for k, puck in enumerate(pucks)
            if (puck.encoder is not None) or k in self._radians
        )

    def begin(self, pucks: Sequence[MotorPuck], position: Vector) -> None:
        """Take the motors' position [rad], shape (joints,), as that of the encoders."""
        for k in self._radians:
            self._counts[k] = pucks[k].encoder or 0
            self._origin[k] = float(position[k]) - self._counts[k] * self._radians[k]
            self._beyond[k] = 0

    def update(self, pucks: Sequence[MotorPuck], position: Vector) -> tuple[Vector | None, list[AxisEvent]]:
        """Compare the encoders with the motors.

        Args:
            pucks: at the end of a cycle.
            position: of the joints by their motors [rad], shape (joints,).

        Returns:
            Positions by the encoders [rad], shape (joints,), NaN for joints without one; None for an arm without any.
            And an event of each joint that has come apart from its motors.
        """
        if not self._radians:
            return None, []
        found, told = self._position.copy(), []
        for k, radians in self._radians.items():
            encoder = pucks[k].encoder
            if encoder is None:
                continue
            self._counts[k] = unwrapped(self._counts[k], encoder, POSITION_BITS)
            found[k] = self._counts[k] * radians + self._origin[k]
            if not all(pucks[motor].answered for motor in (*self._motors_of[k], k)):
                continue  # of different moments
            apart = found[k] - position[k]
            self._beyond[k] = self._beyond[k] + 1 if abs(apart) > self._tolerance else 0
            if self._beyond[k] == _CYCLES:
                words = (
                    f"{self._names[k]}: its encoder has moved {apart:+.3f} rad further than its motors since the arm "
                    f"was opened, {self._tolerance:g} rad are tolerated"
                )
                told.append(AxisEvent(AxisEventCode.TRANSMISSION_SLIPPED, k, words))
        found.setflags(write=False)
        return found, told
