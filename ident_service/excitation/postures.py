"""Find a posture in which the arm can stand: every motion may shrink to it, and a failed search returns it.

The checks are static: gravity torque, position limits and clearance.
"""

from __future__ import annotations

import numpy as np

from ident_service.config.motion_limits import MotionLimits
from ident_service.errors import MotionRefused
from ident_service.excitation.prediction import dry_friction
from ident_service.model.arm_model import ArmModel
from ident_service.model.capsule_distances import CapsuleModel
from ident_service.model.chain import Array
from ident_service.model.regressor import joint_regressor

_TRIED = 4000
_INSIDE = 0.01  # of a joint's range, at either end
_RESERVE = 0.9  # of the room between clearance and torque limits that the posture should leave to a motion about it


def safe_posture(model: ArmModel, limits: MotionLimits, seed: int = 0, extra_clearance: float = 0.0) -> Array:
    """Return the posture nearest to home that leaves the motion room, shape (joints,).

    Args:
        model: its prior gives the gravity torque.
        limits: what a motion may use, margins taken off.
        seed: of the postures that are tried.
        extra_clearance: kept free beyond the workspace's clearance [m].

    Raises:
        MotionRefused: no posture keeps the limits; the message says which of them stand in the way.
    """
    rng = np.random.default_rng(seed)
    # At the very end of a range there is no room for a motion, nor for the rounding of a proof.
    span = limits.upper - limits.lower
    lower, upper = limits.lower + _INSIDE * span, limits.upper - _INSIDE * span
    home = np.clip(limits.home, lower, upper)
    # Nearer and nearer to home: half of the postures are drawn from all of the range, the others from parts of it.
    share = np.where(np.arange(_TRIED) % 2, 1.0, rng.uniform(size=_TRIED))[:, None]
    drawn = rng.uniform(lower, upper, size=(_TRIED, len(home)))
    postures = np.vstack([home, 0.5 * (lower + upper), home + share * (drawn - home)])
    torque = _torque_used(model, limits, postures)
    capsules = CapsuleModel(model)
    clearance = model.config.workspace.clearance + extra_clearance
    room = np.full(len(postures), np.inf)
    if capsules.pairs:
        distances = capsules.distances(postures)
        room = distances.min(axis=0)
    stands = (torque.max(axis=1) < 1.0) & (room > clearance)
    if not stands.any():
        raise MotionRefused(_reason(model, torque, room, clearance, capsules, postures))
    roomy = stands & (torque.max(axis=1) < _RESERVE) & (room > clearance + 0.02)
    pick = np.flatnonzero(roomy if roomy.any() else stands)
    away = (((postures[pick] - home) / span) ** 2).sum(axis=1)
    return np.asarray(postures[pick[int(away.argmin())]])


def _torque_used(model: ArmModel, limits: MotionLimits, postures: Array) -> Array:
    """Return the share of the torque limits that standing takes, dry friction against it, shape (postures, joints)."""
    if model.prior is None:
        return np.zeros_like(postures)
    still = np.zeros_like(postures)
    rows = joint_regressor(model.chain, model.layout, postures, still, still)
    _, dry = dry_friction(model, model.prior)
    gravity = np.einsum("jps,p->sj", rows, model.prior)
    used = (np.abs(gravity) + dry) / limits.torque
    return np.asarray(used if limits.motors is None else np.maximum(used, limits.motors.used_of_joints(gravity)))


def _reason(
    model: ArmModel, torque: Array, room: Array, clearance: float, capsules: CapsuleModel, postures: Array
) -> str:
    name, tried = model.config.name, len(postures)
    strong, clear = torque.max(axis=1) < 1.0, room > clearance
    if not strong.any():
        joint = int(torque.min(axis=0).argmax())
        if torque[:, joint].min() >= 1.0:
            return (
                f"{name}: {model.chain.names[joint]} cannot hold the arm in any of {tried} postures: standing asks for "
                f"at least {torque[:, joint].min():.0%} of what the torque limit leaves after the margin"
            )
        return f"{name}: in each of {tried} postures some joint cannot hold the arm within its torque limit"
    if not clear.any():
        best = int(room.argmax())
        pair = capsules.pairs[int(capsules.distances(postures[best : best + 1])[:, 0].argmin())]
        return (
            f"{name}: no posture within the position limits keeps {clearance:g} m clear: of {tried} tried the best "
            f"leaves {room[best]:.3f} m at {pair}; check workspace, obstacles and position limits"
        )
    return f"{name}: of {tried} postures none keeps torque limits and clearance together"
