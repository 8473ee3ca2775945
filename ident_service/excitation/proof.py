"""Prove that a motion keeps all limits for all time, and find the largest motion of a family that can be proven."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ident_service.config.limits import MotionLimits
from ident_service.excitation.basis import Basis
from ident_service.excitation.clearance import Clearance, Tube, certified_clearance
from ident_service.excitation.demands import Demands, demands
from ident_service.excitation.path import STEP_PEAKS, FourierPath, Path, PosturePath
from ident_service.excitation.task import Task
from ident_service.excitation.tracking import Tracking, track, way_width
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import Array
from ident_service.model.collision import CollisionModel

_LARGE = 0.4  # of a motion's size
_FREER = 1.1  # times what was missing: a motion that is moved away becomes another one
_FARTHEST = 0.2  # m, of clearance
_CALM, _SHORTEST = 0.5, 0.5  # share of the limits on the ways to and from a motion; s
_SHRINKS = (*(1.0 - 0.002 * 1.35**k for k in range(20)), 0.2, 0.1, 0.05, 0.01)  # 0.998 ... 0.4 ... 0.01


@dataclass(frozen=True)
class Proof:
    """Bounds that hold at every instant of a motion.

    Attributes:
        demands: on the joints and the supply.
        clearance: the smallest distance, None where the arm has no geometry.
        approach: the smallest distance on the straight way from home to where the motion begins and back, likewise.
        ways: peak bounds on the slow segments from home and back, home itself included.
        tracking: how a simulated arm follows the motion, None where nothing was simulated; clearances are the arm's
            then, and else the reference's.
    """

    demands: Demands
    clearance: Clearance | None
    approach: Clearance | None
    ways: Demands
    tracking: Tracking | None = None


def proof_of(
    path: FourierPath | PosturePath,
    model: ArmModel,
    limits: MotionLimits,
    collision: CollisionModel,
    torque_margin: float | None = None,
) -> Proof:
    """Bound a motion's peaks, and simulate the arm where its reference is proven to keep every limit.

    Args:
        path: the motion.
        model: of the arm.
        limits: that the motion may use, also for home and for the speed of the segments to and from it.
        collision: geometry of the arm.
        torque_margin: share of the torque that the motion keeps free for what the model does not know; the
            description's when None.
    """
    margin = model.config.design.torque_margin if torque_margin is None else torque_margin
    ways = _ways(path, limits)

    def clear(one: Path, tube: Tube | None = None) -> Clearance | None:
        return certified_clearance(collision, one, model.config.workspace.clearance, tube) if collision.pairs else None

    proof = Proof(demands(path, model), clear(path), clear(ways), demands(ways, model))
    if model.prior is None or objections(proof, model, limits):
        return proof
    tracking = track(path, model, margin)
    proof = replace(proof, tracking=tracking)
    if not collision.pairs or objections(proof, model, limits):
        return proof
    proof = replace(proof, clearance=clear(path, tracking.width))
    if objections(proof, model, limits):
        return proof
    return replace(proof, approach=clear(ways, way_width(ways, model, margin)))


def _ways(path: FourierPath | PosturePath, limits: MotionLimits) -> PosturePath:
    """Return straight segments from home to a motion's beginning, back, and to its end, at half of the limits."""
    points = np.array([limits.home, path.at(0.0)[0], limits.home, path.at(path.duration)[0]])
    far = np.abs(np.diff(points, axis=0))
    needed = [
        (STEP_PEAKS[order] * far / (_CALM * limit)) ** (1.0 / order)
        for order, limit in ((1, limits.velocity), (2, limits.acceleration), (3, limits.jerk))
    ]
    return PosturePath(points, np.maximum(np.max(needed, axis=(0, 2)), _SHORTEST), 0.0)


def objections(proof: Proof, model: ArmModel, limits: MotionLimits) -> list[str]:
    """Return every limit that is not proven to be kept, in words; empty when all are."""
    found = proof.demands.violations(model.chain.names, limits, model.config.supply)
    forces = proof.ways.forces_beyond(model.chain.names, limits, model.config.supply)
    found += [f"at home, or on the way from it or back: {one}" for one in forces]
    if proof.tracking is not None:
        found += proof.tracking.objections(model.chain.names, limits)
    least = model.config.workspace.clearance
    for what, clearance in (("the motion", proof.clearance), ("the way from home or back", proof.approach)):
        if clearance is not None and clearance.lower_bound < least:
            found.append(
                f"{what} comes within {clearance.lower_bound:.4f} m at {clearance.pair}, {clearance.time:.2f} s; "
                f"{least:g} m must remain"
            )
    return found


def tightened(task: Task, proof: Proof, limits: MotionLimits) -> Task | None:
    """Return a task whose search keeps free what a proof has found to be missing; None where that would not help.

    The search forecasts friction alone. The simulated arm also has heavier links, and takes its time to settle, and the
    tube around its motion is as wide as its worst joint makes it.

    Args:
        task: of the search that found the motion.
        proof: of the motion at full size.
        limits: of the arm.
    """
    allowed, velocity, extra = task.limits.following_error, task.limits.velocity, task.extra_clearance
    if proof.tracking is not None:
        behind, fast = proof.tracking.used(limits)
        allowed = allowed / np.where(behind > 1.0, _FREER * behind, 1.0)
        velocity = velocity / np.where(fast > 1.0, fast, 1.0)
    if proof.clearance is not None and not proof.clearance.proven:
        extra += _FREER * (proof.clearance.required - proof.clearance.lower_bound)
    if not extra < _FARTHEST:
        return None  # no search could keep so much free
    mended = replace(
        task, limits=replace(task.limits, following_error=allowed, velocity=velocity), extra_clearance=extra
    )
    same = (allowed == task.limits.following_error).all() and (velocity == task.limits.velocity).all()
    return None if same and extra == task.extra_clearance else mended


def largest_proven(
    basis: Basis,
    coefficients: Array,
    safe: Array,
    proven: Callable[[Array], Proof | None],
) -> tuple[Array, Proof] | None:
    """Return the largest motion between standing still and the given one that can be proven to keep all limits.

    Sizes are tried ever more coarsely until one can be proven, then halfway back. That takes a few proofs, of seconds
    each, where one size after another would take twenty.

    Args:
        basis: the family.
        coefficients: of the motion, shape (joints, size).
        safe: coefficients of standing still in a posture that keeps all limits.
        proven: the proof of a motion that keeps all limits, None for one that does not.

    Returns:
        Coefficients and proof, or None where even a hundredth of the motion cannot be proven.
    """
    if (proof := proven(coefficients)) is not None:
        return coefficients, proof
    best: tuple[float, tuple[Array, Proof]] | None = None
    for anchor in (basis.still(coefficients), safe):
        if best is not None and best[0] >= _LARGE:
            break  # where a motion's own middle is a bad place, little is left of it; the safe posture may leave more
        found: tuple[Array, Proof] | None = None
        too_large, small_enough = -1, len(_SHRINKS)
        step = 1
        while small_enough - too_large > 1:
            size = too_large + step if found is None else (too_large + small_enough) // 2
            size = min(size, len(_SHRINKS) - 1)
            smaller = anchor + _SHRINKS[size] * (coefficients - anchor)
            if (proof := proven(smaller)) is not None:
                found, small_enough = (smaller, proof), size
            else:
                too_large, step = size, 2 * step
        if found is not None and (best is None or _SHRINKS[small_enough] > best[0]):
            best = _SHRINKS[small_enough], found
    return None if best is None else best[1]
