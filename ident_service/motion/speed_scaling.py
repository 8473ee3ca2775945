"""Play a motion at another speed, along the same positions: constantly slower, or changing smoothly from some time on.

With the motion's own time s as a function of time, and its rate r = ds/dt,

    velocity      q'(s) r
    acceleration  q''(s) r^2  + q'(s) dr/dt
    jerk          q'''(s) r^3 + 3 q''(s) r dr/dt + q'(s) d2r/dt2

A constant rate of at most 1 asks for less velocity, acceleration and jerk than the motion itself.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol, TypeVar

import numpy as np

from ident_service.config.motion_limits import MotionLimits, Vector
from ident_service.errors import MotionRefused, UsageError
from ident_service.motion.trajectory import Reference, Setpoint

_SHARES = np.linspace(0.0, 1.0, 2001)
_SHORTEST, _LONGEST = 0.05, 600.0  # s
_SLACK = 1e-6  # of a limit: rounding, and the last trace of a change towards a limit used in full
_Share = TypeVar("_Share", float, Vector)


class Peaks(Protocol):
    """Define the largest sizes of a motion's derivatives; for a motion within limits, the limits themselves will do."""

    @property
    def velocity(self) -> Vector:
        """Return the largest velocity [rad/s or m/s], shape (joints,)."""

    @property
    def acceleration(self) -> Vector:
        """Return the largest acceleration [rad/s^2 or m/s^2], shape (joints,)."""

    @property
    def jerk(self) -> Vector:
        """Return the largest jerk [rad/s^3 or m/s^3], shape (joints,)."""


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
        """Return the setpoint at `time` [s]."""
        point = self._reference.at(self._factor * time)
        return Setpoint(point.position, point.velocity * self._factor, point.acceleration * self._factor**2)


class SpeedChange:
    """Represent the rest of a motion, led smoothly from one speed to another.

    Attributes:
        change: length of the change [s]; velocity, acceleration and jerk limits hold all the while.
        duration: until the motion ends [s].
    """

    def __init__(
        self, reference: Reference, time: float, factors: tuple[float, float], peaks: Peaks, limits: MotionLimits
    ) -> None:
        """Plan to change the speed from now on.

        Args:
            reference: the motion at full speed.
            time: of the motion [s], at which the change begins.
            factors: speed before and after the change; it must not begin while another is under way.
            peaks: of the motion at full speed; the change takes as long as they ask for: a fraction of a second where
                they leave room, most of a minute towards a speed at which they use a limit in full.
            limits: of the arm.

        Raises:
            UsageError: a factor is not above 0 and at most 1.
            MotionRefused: the motion is beyond the limits at one of the speeds.
        """
        self._reference = reference
        self._begin = time
        self._before, self._after = (require_factor(factor) for factor in factors)
        self.change = _change_length(self._before, self._after, peaks, limits)
        self.duration = self._time_of(reference.duration)

    def motion_time(self, time: float) -> float:
        """Return the time of the motion [s] at `time` [s] since the change began."""
        share = min(time / self.change, 1.0)
        gained = self.change * (self._before * share + (self._after - self._before) * _sum(share))
        return self._begin + gained + self._after * max(time - self.change, 0.0)

    def at(self, time: float) -> Setpoint:
        """Return the setpoint at `time` [s] since the change began."""
        time = min(time, self.duration)
        share = min(time / self.change, 1.0)
        rate = self._before + (self._after - self._before) * _step(share)
        quickening = (self._after - self._before) * _rate(share) / self.change
        point = self._reference.at(self.motion_time(time))
        acceleration = point.acceleration * rate**2 + point.velocity * quickening
        return Setpoint(point.position, point.velocity * rate, acceleration)

    def _time_of(self, motion_time: float) -> float:
        """Return the time since the change began [s] at which the motion gets to a time [s] of its own."""
        beyond = motion_time - self.motion_time(self.change)
        if beyond >= 0.0:
            return self.change + beyond / self._after
        low, high = 0.0, self.change
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.motion_time(middle) < motion_time else (low, middle)
        return high


def slowed_limits(limits: MotionLimits, factor: float) -> MotionLimits:
    """Return limits within which a reference looks like one within `limits` at `factor` times its speed.

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
    """Return the factor, when it is a speed that a motion can be slowed to.

    Raises:
        UsageError: it is not above 0 and at most 1.
    """
    if not 0.0 < factor <= 1.0:
        raise UsageError(f"a speed of {factor:g} times the motion's own; it must be above 0 and at most 1")
    return factor


def _change_length(before: float, after: float, peaks: Peaks, limits: MotionLimits) -> float:
    if not _is_within_limits(_LONGEST, before, after, peaks, limits):
        raise MotionRefused("the motion leaves the limits at the speed asked for, so the speed cannot be changed to it")
    low, high = np.log(_SHORTEST), np.log(_LONGEST)
    for _ in range(24):
        middle = 0.5 * (low + high)
        low, high = (
            (low, middle) if _is_within_limits(float(np.exp(middle)), before, after, peaks, limits) else (middle, high)
        )
    return 1.01 * float(np.exp(high))  # more than what happens between two shares


def _is_within_limits(length: float, before: float, after: float, peaks: Peaks, limits: MotionLimits) -> bool:
    """Check whether a change of `length` [s] stays within the limits even where all peaks meet."""
    step = after - before
    rate = (before + step * _step(_SHARES))[:, None]
    quickening = np.abs(step * _rate(_SHARES))[:, None] / length
    curve = np.abs(step * _curve(_SHARES))[:, None] / length**2
    velocity = peaks.velocity * rate
    acceleration = peaks.acceleration * rate**2 + peaks.velocity * quickening
    jerk = peaks.jerk * rate**3 + 3.0 * peaks.acceleration * rate * quickening + peaks.velocity * curve
    asked = ((velocity, limits.velocity), (acceleration, limits.acceleration), (jerk, limits.jerk))
    return all(bool((size <= limit * (1.0 + _SLACK)).all()) for size, limit in asked)


def _step(share: _Share) -> _Share:
    """Return a smooth step from 0 to 1, so flat at both ends that a motion using a limit in full reaches full speed."""
    return share**4 * (35.0 + share * (-84.0 + share * (70.0 - 20.0 * share)))


def _rate(share: _Share) -> _Share:
    """Return the first derivative of the smooth step."""
    return 140.0 * (share * (1.0 - share)) ** 3


def _curve(share: _Share) -> _Share:
    """Return the second derivative of the smooth step."""
    return 420.0 * (share * (1.0 - share)) ** 2 * (1.0 - 2.0 * share)


def _sum(share: _Share) -> _Share:
    """Return the integral of the smooth step from 0."""
    return share**5 * (7.0 + share * (-14.0 + share * (10.0 - 2.5 * share)))
