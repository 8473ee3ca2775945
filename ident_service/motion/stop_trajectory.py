"""Stop each joint from any state: trajectories whose jerk is constant piece by piece.

q(t) = q_i + dq_i t + ddq_i t^2 / 2 + j_i t^3 / 6          within piece i

Pieces may differ from joint to joint.

The quickest stop of a joint ramps its acceleration with the largest jerk to a braking one, holds it, and ramps it back
so that velocity and acceleration vanish together. It is written down in closed form: nothing is searched, nothing can
fail, and thousands of stops are judged at once. What is guaranteed of it, with A, J the acceleration and jerk limits:

* From every state acceleration and jerk keep to their limits; an acceleration beyond its limit is led back to it with
  the largest jerk first. No velocity is too large to be stopped from.
* From a state that some motion within A and J passes through, it reaches no velocity that this motion is not forced to
  reach as well, so the velocity limit is kept.
* It overshoots no turning point of that motion by more than A^3 / (24 J^2). Proof: braking as hard as possible, -J down
  to -A, has at every instant the smallest velocity there can be, so every motion reaches at least its turning point. As
  functions of velocity, its acceleration and the quickest stop's differ only where the stop ramps back, with at least
  sqrt(2 J v) against at most A: the ways differ by no more than the integral of v (1 / sqrt(2 J v) - 1 / A) from v = 0
  to A^2 / (2 J), which is A^3 / (6 J^2) - A^3 / (8 J^2).
* A joint whose quickest stop would leave a position limit brakes as hard as possible until it stands, and settles
  afterwards, at most (1/3 + 1/sqrt(8)) A^3 / J^2 back from there. So where the range of positions is at least
  (1/3 + 1/sqrt(8) + 1/24) A^3 / J^2 wide, 0.73 of that unit, the stop stays inside whenever anything does: from every
  state of a motion that itself keeps to all limits until each joint has next stood or turned, without any margin. From
  a state that nothing can keep inside, the way out is never longer than the quickest stop's.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ident_service.config.motion_limits import MotionLimits, Vector
from ident_service.errors import MotionRefused
from ident_service.excitation.trajectory import MotionPath
from ident_service.motion.trajectory import Setpoint

Piece = tuple[Vector, Vector]


class StopProfile:
    """Represent a motion to rest, in pieces of constant jerk.

    Attributes:
        duration: time until the last joint stands [s].
        end: position at which the arm stands then [rad or m], shape (..., joints).
    """

    def __init__(self, start: Setpoint, pieces: Sequence[Piece]) -> None:
        """Integrate the pieces from the start on.

        Args:
            start: state at the beginning, with arrays of shape (joints,), or (samples, joints) for many stops at once.
            pieces: jerk [rad/s^3 or m/s^3] and length [s] of each, shaped like the position.
        """
        knots = [start]
        for jerk, length in pieces:
            knots.append(state_after(knots[-1], jerk, length))
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
        """Return the setpoint at `time` [s] since the stop began; for a profile of a single motion only."""
        time = max(time, 0.0)
        here = ((self._begin <= time).sum(axis=0) - 1, self._joint)
        knot = Setpoint(self._position[here], self._velocity[here], self._acceleration[here])
        with np.errstate(all="ignore"):  # NaN and infinity are for the guard to judge, in the same cycle
            return state_after(knot, self._jerk[here], time - self._begin[here])

    def extent(self) -> tuple[Vector, Vector]:
        """Return the lowest and highest position on the profile, exact but for rounding, shape (..., joints) each."""
        velocity, acceleration, jerk = self._velocity, self._acceleration, self._jerk
        with np.errstate(all="ignore"):  # a piece without a turning point has no root; its ends stand for it
            root = np.sqrt(acceleration**2 - 2.0 * jerk * velocity)
            # The sum of equal signs: nothing cancels in the nearer of the two roots.
            sum_ = -(acceleration + np.copysign(root, acceleration))
            turns = [np.fmin(np.fmax(turn, 0.0), self._length) for turn in (2.0 * velocity / sum_, sum_ / jerk)]
        knot = Setpoint(self._position, velocity, acceleration)
        seen = np.stack([self._position, *(state_after(knot, jerk, turn).position for turn in turns)])
        return seen.min(axis=(0, 1)), seen.max(axis=(0, 1))


def state_after(start: Setpoint, jerk: Vector, time: Vector) -> Setpoint:
    """Return the state `time` [s] later under a constant `jerk`, shaped like the position."""
    velocity = start.velocity + time * (start.acceleration + time * jerk / 2.0)
    position = start.position + time * (start.velocity + time * (start.acceleration / 2.0 + time * jerk / 6.0))
    return Setpoint(position, velocity, start.acceleration + time * jerk)


_STEP = 5e-3  # s
_BLOCK = 4096  # samples judged at once, so that a long motion needs no more memory than a short one


def plan_stop(start: Setpoint, limits: MotionLimits) -> StopProfile:
    """Return the controlled stop from any state to rest, within acceleration and jerk limits; never raises.

    Args:
        start: state at the beginning, with arrays of shape (joints,), or (samples, joints) for many stops at once.
            Where a number is not finite or beyond 1e100, the stop is not a number either, which the guard turns into no
            torque.
        limits: acceleration and jerk are kept; position where it can be kept (see above).
    """
    with np.errstate(all="ignore"):
        quick, quick_leaves, side = _judged(start, limits, np.zeros_like(start.position))
        if not np.any(quick_leaves > 0.0):
            return quick
        _, hard_leaves, _ = _judged(start, limits, side)
        return _braked(start, limits, np.where(hard_leaves < quick_leaves, side, 0.0))


def stop_extent(motion: MotionPath, limits: MotionLimits) -> tuple[Vector, Vector]:
    """Return the lowest and highest positions of a motion and of stops out of it at sampled times [rad or m].

    Between two sampled times it may be exceeded slightly; and where stops come so close to a position limit that
    some must brake harder, by how far these settle back from there. Neither leads outside the limits: see above.

    Args:
        motion: sampled every 5 ms in its distinct parts.
        limits: limits that the stops keep.

    Returns:
        Two arrays [rad or m], shape (joints,).
    """
    lowest, highest = np.full(motion.joints, np.inf), np.full(motion.joints, -np.inf)
    for times in _sampled(motion):
        position, velocity, acceleration, _ = motion.at(times)
        low, high = plan_stop(Setpoint(position, velocity, acceleration), limits).extent()
        np.minimum(lowest, low.min(axis=0), out=lowest)
        np.maximum(highest, high.max(axis=0), out=highest)
    return lowest, highest


def require_stops_within_limits(motion: MotionPath, limits: MotionLimits, joint_names: tuple[str, ...]) -> None:
    """Raise MotionRefused where a stop out of the motion, sampled every 5 ms, would leave a joint's position limits.

    Args:
        motion: the motion.
        limits: of the arm.
        joint_names: of the joints, for the message.

    Raises:
        MotionRefused: naming every joint and how far it would go.
    """
    lowest, highest = stop_extent(motion, limits)
    # Rounding of a stop that turns exactly at its limit.
    slack = 1e-9 * (1.0 + np.maximum(np.abs(limits.lower), np.abs(limits.upper)))
    found = [
        f"{name}: {low:.3f}..{high:.3f} leaves {limits.lower[k]:g}..{limits.upper[k]:g}"
        for k, (name, low, high) in enumerate(zip(joint_names, lowest, highest, strict=True))
        if not (low >= limits.lower[k] - slack[k] and high <= limits.upper[k] + slack[k])  # NaN too
    ]
    if found:
        raise MotionRefused("a stop out of the motion would leave the position limits: " + "; ".join(found))


def _sampled(path: MotionPath) -> Iterator[Vector]:
    for begin, end in path.distinct:
        count = 2 + int((end - begin) / _STEP)
        for first in range(0, count, _BLOCK):
            share = np.arange(first, min(first + _BLOCK, count)) / (count - 1)
            yield begin + share * (end - begin)


def _judged(start: Setpoint, limits: MotionLimits, side: Vector) -> tuple[StopProfile, Vector, Vector]:
    """Return a stop, how far it leaves the position limits [rad or m], and on which side (-1 or 1)."""
    braked = _braked(start, limits, side)
    lowest, highest = braked.extent()
    above, below = highest - limits.upper, limits.lower - lowest
    return braked, np.maximum(above, below), np.where(above >= below, 1.0, -1.0)


def _braked(start: Setpoint, limits: MotionLimits, side: Vector) -> StopProfile:
    """Return the quickest stop; where `side` is 1 or -1, the hardest braking before that position limit comes first."""
    pieces: list[Piece] = []
    state = start
    for piece in (_return_to_limit, _ramped, _held):
        pieces.append(piece(state, limits, side))
        state = state_after(state, *pieces[-1])
    return StopProfile(start, [*pieces, *_quickest_stop(state, limits)])


def _return_to_limit(state: Setpoint, limits: MotionLimits, side: Vector) -> Piece:
    """Return the piece that leads an acceleration beyond its limit back to it."""
    excess = np.maximum(np.abs(state.acceleration) - limits.acceleration, 0.0)
    return -np.sign(state.acceleration) * limits.jerk, excess / limits.jerk


def _ramped(state: Setpoint, limits: MotionLimits, side: Vector) -> Piece:
    """Return the hardest ramp to a braking acceleration, no further than to where the joint stands."""
    acceleration = side * state.acceleration
    level = _braking(state, limits, side)
    length = np.where(level > 0.0, np.maximum(acceleration + level, 0.0) / limits.jerk, 0.0)
    return -side * limits.jerk, length


def _held(state: Setpoint, limits: MotionLimits, side: Vector) -> Piece:
    """Return the piece of largest braking acceleration until the joint stands."""
    full = _braking(state, limits, side) >= limits.acceleration
    # Ramping back from the full acceleration changes the velocity by so much, and it must not pass its own limit.
    spare = np.maximum(0.5 * limits.acceleration**2 / limits.jerk - limits.velocity, 0.0)
    length = np.where(full, np.maximum(side * state.velocity - spare, 0.0) / limits.acceleration, 0.0)
    return np.zeros_like(length), length


def _braking(state: Setpoint, limits: MotionLimits, side: Vector) -> Vector:
    """Return the largest braking acceleration reached before the joint stands; 0 if it does not move to that side."""
    velocity, acceleration = side * state.velocity, side * state.acceleration
    # The velocity at which the acceleration vanishes on the ramp through this state.
    crest = np.maximum(velocity + 0.5 * acceleration**2 / limits.jerk, 0.0)
    # At standstill on the ramp; and where ramping back would turn it round at its velocity limit.
    standing, turning = np.sqrt(2.0 * limits.jerk * crest), np.sqrt(limits.jerk * (crest + limits.velocity))
    return np.minimum(limits.acceleration, np.minimum(standing, turning))


def _quickest_stop(state: Setpoint, limits: MotionLimits) -> list[Piece]:
    """Return the quickest stop from an acceleration within its limit: ramp, hold, ramp back."""
    jerk, largest = limits.jerk, limits.acceleration
    # Where it would go on to if the acceleration were led straight to zero: that is what braking works against.
    side = np.where(state.velocity + 0.5 * state.acceleration * np.abs(state.acceleration) / jerk < 0.0, -1.0, 1.0)
    velocity, acceleration = side * state.velocity, side * state.acceleration
    crest = np.maximum(velocity + 0.5 * acceleration**2 / jerk, 0.0)
    peak = np.minimum(np.sqrt(jerk * crest), largest)
    ramp = np.maximum(acceleration + peak, 0.0) / jerk
    hold = np.where(peak < largest, 0.0, np.maximum(crest - peak**2 / jerk, 0.0) / largest)
    return [(-side * jerk, ramp), (np.zeros_like(hold), hold), (side * jerk, peak / jerk)]
