"""Play a motion slower, along the same positions: at a constant rate of its own time.

A rate of at most 1 asks for less velocity, acceleration and jerk than the motion itself: the rate, its square and its
cube times theirs.
"""

from __future__ import annotations

from dataclasses import replace

from ident_service.config.motion_limits import MotionLimits
from ident_service.errors import UsageError
from ident_service.motion.trajectory import Reference, Setpoint


class ScaledMotion:
    """Represent a motion at a constant share of its speed: a rehearsal.

    Attributes:
        duration: the motion's divided by the factor [s].
    """

    def __init__(self, reference: Reference, factor: float) -> None:
        """Slow a motion down.

        Raises:
            UsageError: the factor is not above 0 and at most 1.
        """
        self._reference = reference
        self._factor = require_factor(factor)
        self.duration = reference.duration / factor

    def at(self, time: float) -> Setpoint:
        """Return the setpoint at `time` [s] of the slowed motion."""
        point = self._reference.at(self._factor * time)
        return Setpoint(point.position, point.velocity * self._factor, point.acceleration * self._factor**2)


def slowed_limits(limits: MotionLimits, factor: float) -> MotionLimits:
    """Return limits with velocity times `factor`, acceleration its square, jerk its cube; UsageError if not in (0, 1].

    Raises:
        UsageError: the factor is not above 0 and at most 1.
    """
    require_factor(factor)
    return replace(
        limits,
        velocity=limits.velocity * factor,
        acceleration=limits.acceleration * factor**2,
        jerk=limits.jerk * factor**3,
    )


def require_factor(factor: float) -> float:
    """Return the factor unchanged if it is above 0 and at most 1; raises UsageError otherwise.

    Raises:
        UsageError: it is not above 0 and at most 1.
    """
    if not 0.0 < factor <= 1.0:
        raise UsageError(f"a speed of {factor:g} times the motion's own; it must be above 0 and at most 1")
    return factor
