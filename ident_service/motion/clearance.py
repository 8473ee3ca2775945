"""Check a run's clearance to the arm itself and its surroundings, and positions outside the limits.

Motion and trajectories are proven for all time (`excitation/limit_proof.py`); stops are sampled every 50 ms,
and must only not touch: a stop is short, rare, and better than what it was asked for.

A way back from a pause is proven while the arm stands and the loop goes on, one posture at a time. Within a time h a
pair's distance d falls by no more than `sum_k L_k (|dq_k| h + A_k h^2 / 2)` (`model/collision.py`), with A the largest
acceleration; the next posture is where that could have used up what d may fall by.

Position limits are the description's and lie inside the hardware's. An arm that was pushed, or that overshot in a stop,
may stand beyond one of them; only an inward trajectory may begin there. Farther out than the following error it is left
alone: no controller here can have brought it there, so that its zero may be wrong (`far_outside` in `faults.py`),
and a trajectory that is planned from a wrong position leads anywhere.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident_service.config.motion_limits import MotionLimits, Vector
from ident_service.errors import MotionRefused
from ident_service.excitation.limit_proof import Clearance, certified_along, certified_clearance
from ident_service.excitation.trajectory import MotionPath
from ident_service.model.arm_model import ArmModel
from ident_service.model.capsule_distances import CapsuleModel
from ident_service.model.collision import CollisionModel
from ident_service.motion.stop_trajectory import plan_stop
from ident_service.motion.trajectory import Reference, Setpoint, run_to_end

_BEGINS, _POINTS = 0.05, 8  # s between stops, points on each
_AT_ONCE = 4  # postures checked in one slice, while the loop goes on
_SHORTEST = 1e-4  # s between two postures of a way
_ROUNDING = 1e-6  # m, more than what coal's distances are wrong by


@dataclass(frozen=True)
class Nearest:
    """Represent the smallest distance found on a motion.

    Attributes:
        distance: [m]; infinite where there is nothing to touch.
        pair: names of the two bodies, or None.
        time: time on the motion of the smallest distance [s].
    """

    distance: float
    pair: str | None
    time: float


class ClearanceChecker:
    """Check that references which are found while the arm is energised keep clear of the surroundings."""

    def __init__(self, model: ArmModel, limits: MotionLimits) -> None:
        """Prepare the collision model of an arm.

        Args:
            model: model with its geometry and surroundings; without any, every trajectory is clear.
            limits: limits of the arm, which its stops keep.

        Raises:
            MotionRefused: a pair of bodies that is never free.
        """
        self._collision = CollisionModel(model)
        self._clearance = model.config.workspace.clearance
        self._limits = limits

    def require_clear(self, reference: Reference, limits: MotionLimits) -> Generator[None, None, None]:
        """Prove in slices that a trajectory keeps the clearance and no sampled stop touches; MotionRefused if it fails.

        Where the arm stands nearer to something than the clearance, as after a stop, half of that distance is kept.

        Args:
            reference: trajectory that begins at rest.
            limits: limits that the trajectory keeps.

        Raises:
            MotionRefused: from any of the steps, naming what comes how near to what, and when.
        """
        if not self._collision.pairs:
            return
        yield from self._proven(reference, limits)
        touching = yield from trajectory_stop_contact(self._collision, reference, self._limits)
        if touching is not None:
            raise MotionRefused(touching)

    def _proven(self, reference: Reference, limits: MotionLimits) -> Generator[None, None, None]:
        reach = np.array(self._collision.reach)
        rising = 0.5 * reach @ limits.acceleration
        here = float(self._collision.distances(reference.at(0.0).position[None]).min())
        least = max(min(self._clearance, 0.5 * here), 0.0)
        time, looked = 0.0, 0
        while time < reference.duration:
            setpoint = reference.at(time)
            (distances,) = self._collision.distances(setpoint.position[None])
            spare = np.maximum(distances - least - _ROUNDING, 0.0)
            rate = reach @ np.abs(setpoint.velocity)
            # The positive root of `rising h^2 + rate h = spare`; what nothing moves has forever.
            pace = rate + np.sqrt(rate**2 + 4.0 * rising * spare)
            steps = np.divide(2.0 * spare, pace, out=np.where(spare > 0.0, np.inf, 0.0), where=pace > 0.0)
            pair = int(steps.argmin())
            if not steps[pair] > _SHORTEST:
                raise MotionRefused(
                    f"the path comes within {distances[pair]:.4f} m at {self._collision.pairs[pair]}, {time:.2f} s; "
                    f"{least:.4f} m must remain"
                )
            time, looked = time + float(steps[pair]), looked + 1
            if looked % _AT_ONCE == 0:
                yield


def trajectory_stop_contact(
    collision: CollisionModel, reference: Reference, limits: MotionLimits
) -> Generator[None, None, str | None]:
    """Check sampled stops out of a trajectory by exact shapes, in slices; describe the first that touches, or None."""
    for time in np.arange(0.0, reference.duration, _BEGINS).tolist():
        stopping = plan_stop(reference.at(time), limits)
        yield
        times = np.linspace(0.0, stopping.duration, _POINTS).tolist()
        for first in range(0, _POINTS, _AT_ONCE):
            postures = np.array([stopping.at(moment).position for moment in times[first : first + _AT_ONCE]])
            nearest = collision.distances(postures).min(axis=0)
            pair = int(nearest.argmin())
            if nearest[pair] <= 0.0:
                return _touches("trajectory", time, collision.pairs[pair], float(nearest[pair]))
            yield
    return None


def _touches(what: str, time: float, pair: str | None, distance: float) -> str:
    return f"a stop out of the {what} at {time:.2f} s would touch: {pair}, {distance:.4f} m"


def trajectory_clearance(
    collision: CollisionModel, reference: Reference, limits: MotionLimits, least_distance: float
) -> Clearance:
    """Return a certified lower bound of a trajectory's distance to anything; proven if at least `least_distance`."""

    def position(time: Vector) -> Vector:
        return np.array([reference.at(float(t)).position for t in time])

    return certified_along(collision, position, limits.velocity, reference.duration, least_distance)


def motion_stop_clearance(motion: MotionPath, limits: MotionLimits, model: ArmModel) -> Nearest:
    """Return the smallest capsule distance in sampled stops out of a motion, its pair, and when the stop begins [s]."""
    capsules = CapsuleModel(model)
    nearest = Nearest(float("inf"), None, 0.0)
    if not capsules.pairs:
        return nearest
    for begin, end in motion.distinct:
        for time in np.arange(begin, end, _BEGINS):
            position, velocity, acceleration, _ = motion.at(float(time))
            way = plan_stop(Setpoint(position, velocity, acceleration), limits)
            postures = np.array([way.at(share * way.duration).position for share in np.linspace(0.0, 1.0, _POINTS)])
            distances = capsules.distances(postures).min(axis=1)
            pair = int(distances.argmin())
            if distances[pair] < nearest.distance:
                nearest = Nearest(float(distances[pair]), capsules.pairs[pair], float(time))
    return nearest


def motion_stop_contact(motion: MotionPath, limits: MotionLimits, model: ArmModel) -> str | None:
    """Describe the sampled stop out of a motion in which capsules around bodies overlap most; None if none touch."""
    nearest = motion_stop_clearance(motion, limits, model)
    if nearest.distance > 0.0:
        return None
    return _touches("motion", nearest.time, nearest.pair, nearest.distance)


def require_clear(model: ArmModel, motion: MotionPath, trajectories: Sequence[Reference], limits: MotionLimits) -> None:
    """Raise MotionRefused unless motion and trajectories provably keep clear and no sampled stop out of them touches.

    Args:
        model: model of the arm, with its geometry and surroundings; without any, nothing is checked.
        motion: the motion.
        trajectories: trajectories to the motion and back from it.
        limits: of the arm.

    Raises:
        MotionRefused: naming what comes how near to what, and when.
    """
    collision = CollisionModel(model)
    if not collision.pairs:
        return
    least = model.config.workspace.clearance
    _require_proven("the motion", certified_clearance(collision, motion, least), least)
    require_clear_trajectories(model, [("the path to or from the motion", one) for one in trajectories], limits)
    if touching := motion_stop_contact(motion, limits, model):
        raise MotionRefused(touching)


def require_clear_trajectories(
    model: ArmModel, trajectories: Sequence[tuple[str, Reference]], limits: MotionLimits
) -> None:
    """Raise MotionRefused unless trajectories provably keep the clearance and no sampled stop out of them touches.

    Args:
        model: model of the arm, with its geometry and surroundings; without any, nothing is checked.
        trajectories: trajectories, each with its name in a refusal.
        limits: limits of the arm; no trajectory is faster.

    Raises:
        MotionRefused: naming what comes how near to what, and when.
    """
    collision = CollisionModel(model)
    if not collision.pairs:
        return
    least = model.config.workspace.clearance
    for what, reference in trajectories:
        _require_proven(what, trajectory_clearance(collision, reference, limits, least), least)
        if touching := run_to_end(trajectory_stop_contact(collision, reference, limits)):
            raise MotionRefused(touching)


def _require_proven(what: str, clearance: Clearance, least: float) -> None:
    if not clearance.proven:
        raise MotionRefused(
            f"{what} comes within {clearance.lower_bound:.4f} m at {clearance.pair}, {clearance.time:.2f} s; "
            f"{least:g} m must remain"
        )


SAG = 0.25  # of the following error, that an arm may give way outwards when its torque begins, and lands inside at last


def position_limit_violations(position: Vector, limits: MotionLimits, joint_names: Sequence[str]) -> list[str]:
    """Return a phrase for each joint that is outside its position limits, as NaN is; empty where none is.

    Args:
        position: [rad or m], shape (joints,).
        limits: of the arm.
        joint_names: of the joints.
    """
    return [
        f"{name} at {q:.3f}, limits {low:g}..{high:g}"
        for name, q, low, high in zip(joint_names, position, limits.lower, limits.upper, strict=True)
        if not low <= q <= high
    ]


def recoverable_limits(limits: MotionLimits) -> MotionLimits:
    """Return limits whose position range is wider by the following error on each side: an arm there may be led back."""
    more = limits.following_error
    return replace(limits, lower=limits.lower - more, upper=limits.upper + more)


def require_near(position: Vector, limits: MotionLimits, joint_names: Sequence[str]) -> None:
    """Raise MotionRefused where a joint stands farther outside its position limits than its following error.

    Raises:
        MotionRefused: naming every such joint.
    """
    if position_limit_violations(position, recoverable_limits(limits), joint_names):
        raise MotionRefused(
            "farther outside the position limits than a following error: "
            f"{'; '.join(position_limit_violations(position, limits, joint_names))}; its zero may be wrong: compare "
            "the numbers with the arm, and bring it back by hand"
        )


def relaxed_limits(position: Vector, limits: MotionLimits, following_error_share: float = SAG) -> MotionLimits:
    """Return limits widened for joints that are outside: to `position` and a share of the following error beyond.

    Args:
        position: present position of the arm [rad or m], shape (joints,).
        limits: of the arm.
        following_error_share: share of the following error that is added where a joint stands outside.

    Returns:
        The limits themselves in all joints that stand inside.
    """
    more = following_error_share * limits.following_error
    return replace(
        limits,
        lower=np.where(position < limits.lower, position - more, limits.lower),
        upper=np.where(position > limits.upper, position + more, limits.upper),
    )


def just_inside(position: Vector, limits: MotionLimits) -> Vector:
    """Return `position`, joints outside moved inside their limit by 1/4 of following error or range, the lesser.

    Joints that stand inside stay where they are. So far in, an arm that stops short of its reference, because friction
    holds it, is inside nevertheless.
    """
    margin = np.minimum(SAG * limits.following_error, 0.25 * (limits.upper - limits.lower))
    below, above = position < limits.lower, position > limits.upper
    return np.where(below, limits.lower + margin, np.where(above, limits.upper - margin, position))
