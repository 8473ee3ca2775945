"""Whether a run keeps clear of the arm itself and of its surroundings: the motion, the ways to and from it, the stops.

Motion and ways are proven for all time (`excitation/clearance.py`); stops are looked at where they begin every 50 ms,
and must only not touch: a stop is short, rare, and better than what it was asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ident_service.config.limits import MotionLimits, Vector
from ident_service.errors import MotionRefused
from ident_service.excitation.clearance import Clearance, certified_along, certified_clearance
from ident_service.excitation.path import Path
from ident_service.model.arm_model import ArmModel
from ident_service.model.capsules import CapsuleModel
from ident_service.model.collision import CollisionModel
from ident_service.motion.reference import Reference, Setpoint
from ident_service.motion.stop import stop

_BEGINS, _POINTS = 0.05, 8  # s between stops, points on each


@dataclass(frozen=True)
class Nearest:
    """Where something comes nearest.

    Attributes:
        distance: [m]; infinite where there is nothing to touch.
        pair: whose it is, or None.
        time: when [s].
    """

    distance: float
    pair: str | None
    time: float


def way_clearance(collision: CollisionModel, reference: Reference, limits: MotionLimits, least: float) -> Clearance:
    """Prove that a way within the velocity limits keeps clear by `least` [m]."""

    def position(time: Vector) -> Vector:
        return np.array([reference.at(float(t)).position for t in time])

    return certified_along(collision, position, limits.velocity, reference.duration, least)


def stop_clearance(path: Path, limits: MotionLimits, model: ArmModel) -> Nearest:
    """The smallest distance on stops out of a motion, bodies replaced by capsules around them."""
    capsules = CapsuleModel(model)
    nearest = Nearest(float("inf"), None, 0.0)
    if not capsules.pairs:
        return nearest
    for begin, end in path.distinct:
        for time in np.arange(begin, end, _BEGINS):
            position, velocity, acceleration, _ = path.at(float(time))
            way = stop(Setpoint(position, velocity, acceleration), limits)
            postures = np.array([way.at(share * way.duration).position for share in np.linspace(0.0, 1.0, _POINTS)])
            distances = capsules.distances(postures).min(axis=1)
            pair = int(distances.argmin())
            if distances[pair] < nearest.distance:
                nearest = Nearest(float(distances[pair]), capsules.pairs[pair], float(time))
    return nearest


def touching_stop(path: Path, limits: MotionLimits, model: ArmModel) -> str | None:
    """The stop out of a motion that would touch something, in words; None where none does."""
    nearest = stop_clearance(path, limits, model)
    if nearest.distance > 0.0:
        return None
    return f"a stop out of the motion at {nearest.time:.2f} s would touch: {nearest.pair}, {nearest.distance:.4f} m"


def require_clear(model: ArmModel, path: Path, ways: Sequence[Reference], limits: MotionLimits) -> None:
    """Refuse a run that would come too near to anything.

    Args:
        model: of the arm, with its geometry and surroundings; without any, nothing is checked.
        path: the motion.
        ways: to it and back from it.
        limits: of the arm.

    Raises:
        MotionRefused: naming what comes how near to what, and when.
    """
    require_ways_clear(model, [("a way to or from the motion", way) for way in ways], limits)
    collision = CollisionModel(model)
    if not collision.pairs:
        return
    least = model.config.workspace.clearance
    _require_proven("the motion", certified_clearance(collision, path, least), least)
    if touching := touching_stop(path, limits, model):
        raise MotionRefused(touching)


def require_ways_clear(model: ArmModel, ways: Sequence[tuple[str, Reference]], limits: MotionLimits) -> None:
    """Refuse ways that come too near to anything.

    Args:
        model: of the arm, with its geometry and surroundings; without any, nothing is checked.
        ways: each with what it is called in a refusal.
        limits: of the arm; no way is faster.

    Raises:
        MotionRefused: naming what comes how near to what, and when.
    """
    collision = CollisionModel(model)
    if not collision.pairs:
        return
    least = model.config.workspace.clearance
    for what, way in ways:
        _require_proven(what, way_clearance(collision, way, limits, least), least)


def _require_proven(what: str, clearance: Clearance, least: float) -> None:
    if not clearance.proven:
        raise MotionRefused(
            f"{what} comes within {clearance.lower_bound:.4f} m at {clearance.pair}, {clearance.time:.2f} s; "
            f"{least:g} m must remain"
        )
