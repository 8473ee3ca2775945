"""Represent profiles of piecewise constant jerk: cubic in position, so that turning points are exact.

    q(t) = q_i + dq_i t + ddq_i t^2 / 2 + j_i t^3 / 6          within piece i

Pieces may differ from joint to joint.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident_service.config.limits import Vector
from ident_service.motion.reference import Setpoint

Piece = tuple[Vector, Vector]


class ToRest:
    """Represent a motion to rest, in pieces of constant jerk.

    Attributes:
        duration: until the last joint stands [s].
        end: where it stands then [rad or m], shape (..., joints).
    """

    def __init__(self, start: Setpoint, pieces: Sequence[Piece]) -> None:
        """Integrate the pieces from the start on.

        Args:
            start: its arrays of shape (joints,), or (samples, joints) for many ways at once.
            pieces: jerk [rad/s^3 or m/s^3] and length [s] of each, shaped like the position.
        """
        knots = [start]
        for jerk, length in pieces:
            knots.append(after(knots[-1], jerk, length))
        # The last velocity and acceleration are zero but for rounding, which must not grow into a drift.
        knots[-1] = Setpoint(knots[-1].position, 0.0 * knots[-1].velocity, 0.0 * knots[-1].acceleration)
        still = np.zeros_like(start.position)
        self._position = np.array([knot.position for knot in knots])
        self._velocity = np.array([knot.velocity for knot in knots])
        self._acceleration = np.array([knot.acceleration for knot in knots])
        self._jerk = np.array([*(jerk for jerk, _ in pieces), still])
        self._length = np.array([*(length for _, length in pieces), still])
        self._begin = np.concatenate([still[None], np.cumsum(self._length[:-1], axis=0)])
        self._joint = np.arange(start.position.shape[-1])
        self.duration = float(self._begin[-1].max())
        self.end = self._position[-1]

    def at(self, time: float) -> Setpoint:
        """Return the setpoint at `time` [s] of a single motion."""
        time = max(time, 0.0)
        here = ((self._begin <= time).sum(axis=0) - 1, self._joint)
        knot = Setpoint(self._position[here], self._velocity[here], self._acceleration[here])
        with np.errstate(all="ignore"):  # NaN and infinity are for the guard to judge, in the same cycle
            return after(knot, self._jerk[here], time - self._begin[here])

    def extent(self) -> tuple[Vector, Vector]:
        """Return the lowest and highest position on the profile, exact but for rounding, shape (..., joints) each."""
        velocity, acceleration, jerk = self._velocity, self._acceleration, self._jerk
        with np.errstate(all="ignore"):  # a piece without a turning point has no root; its ends stand for it
            root = np.sqrt(acceleration**2 - 2.0 * jerk * velocity)
            # The sum of equal signs: nothing cancels in the nearer of the two roots.
            sum_ = -(acceleration + np.copysign(root, acceleration))
            turns = [np.fmin(np.fmax(turn, 0.0), self._length) for turn in (2.0 * velocity / sum_, sum_ / jerk)]
        knot = Setpoint(self._position, velocity, acceleration)
        seen = np.stack([self._position, *(after(knot, jerk, turn).position for turn in turns)])
        return seen.min(axis=(0, 1)), seen.max(axis=(0, 1))


def after(start: Setpoint, jerk: Vector, time: Vector) -> Setpoint:
    """Return the state `time` [s] later under a constant `jerk`, shaped like the position."""
    velocity = start.velocity + time * (start.acceleration + time * jerk / 2.0)
    position = start.position + time * (start.velocity + time * (start.acceleration / 2.0 + time * jerk / 6.0))
    return Setpoint(position, velocity, start.acceleration + time * jerk)
