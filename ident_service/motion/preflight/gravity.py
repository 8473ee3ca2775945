"""Gravity torque against the model: what it takes to hold the arm where it stands."""

from __future__ import annotations

import numpy as np

from ident_service.config.limits import MotionLimits, Vector
from ident_service.model.arm_model import ArmModel
from ident_service.model.expected_friction import ExpectedFriction
from ident_service.motion.preflight.check import Check, failed, joint_units, judged, measures
from ident_service.motion.preflight.plan import HOLDABLE
from ident_service.motion.preflight.session import Rows

SETTLE, HOLD = 0.3, 1.0  # s before the mean is taken, and over which
GRAVITY_ERROR = 0.1  # of the torque limit, beside Coulomb friction, which may carry as much of the weight
REMEDY = (
    "Compare tool and load on the arm with the description, check that it does not lean on anything, and check "
    "torque constants and the zero positions of the joints."
)


def holdable(gravity: Vector, model: ArmModel, limits: MotionLimits) -> Check | None:
    """A failed check where the model says that the arm cannot be held in this posture; else None.

    Args:
        gravity: the model's torque where the arm stands [N m or N], shape (joints,).
        model: of the arm.
        limits: of the arm.
    """
    found = measures(
        "gravity torque of the model",
        np.abs(gravity),
        joint_units(model.chain.revolute, "N m", "N"),
        model.chain.names,
        most=HOLDABLE * limits.torque,
    )
    if all(one.kept for one in found):
        return None
    return failed(
        "gravity",
        "holding takes more than the drives have to spare: " + "; ".join(str(one) for one in found if not one.kept),
        "Support the arm in a posture that takes less torque, then check again.",
        found,
    )


def held_torque(rows: Rows, period: float) -> Vector:
    """Mean torque that held the arm, after it had settled [N m or N], shape (joints,).

    Args:
        rows: of holding still for `SETTLE + HOLD` seconds.
        period: [s].
    """
    return np.asarray(np.mean([sample.torque for sample, _ in rows[round(SETTLE / period) :]], axis=0))


def differences(
    held: Vector, gravity: Vector, limits: MotionLimits, friction: ExpectedFriction
) -> tuple[Vector, Vector]:
    """How far two torques are apart, and how far they may be [N m or N], shape (joints,) each."""
    return np.abs(held - gravity), GRAVITY_ERROR * limits.torque + friction.coulomb


def gravity_check(
    held: Vector, gravity: Vector, model: ArmModel, limits: MotionLimits, friction: ExpectedFriction
) -> Check:
    """Compare what held the arm with what the model says would.

    Args:
        held: `held_torque` [N m or N], shape (joints,).
        gravity: the model's torque there, likewise.
        model: of the arm.
        limits: of the arm.
        friction: Coulomb friction may hold the arm instead of torque, either way.
    """
    names = model.chain.names
    force = joint_units(model.chain.revolute, "N m", "N")
    difference, most = differences(held, gravity, limits, friction)
    found = [
        *measures("torque that holds", held, force, names),
        *measures("gravity torque of the model", gravity, force, names),
        *measures("difference", difference, force, names, most=most),
    ]
    return judged("gravity", found, REMEDY)
