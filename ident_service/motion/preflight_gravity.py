"""Gravity torque against the model: what it takes to hold the arm where it stands."""

from __future__ import annotations

import numpy as np

from ident_service.config.limits import MotionLimits, Vector
from ident_service.excitation.following import ExpectedFriction
from ident_service.model.arm_model import ArmModel
from ident_service.motion.preflight_check import Check, failed, joint_units, judged, measures
from ident_service.motion.preflight_plan import HOLDABLE
from ident_service.motion.preflight_session import Trace

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


def gravity_check(
    trace: Trace, gravity: Vector, model: ArmModel, limits: MotionLimits, friction: ExpectedFriction
) -> Check:
    """Compare what held the arm with what the model says would.

    Args:
        trace: of holding still for `SETTLE + HOLD` seconds.
        gravity: the model's torque there [N m or N], shape (joints,).
        model: of the arm.
        limits: of the arm.
        friction: Coulomb friction may hold the arm instead of torque, either way.
    """
    names = model.chain.names
    force = joint_units(model.chain.revolute, "N m", "N")
    held = trace.torque[round(SETTLE / trace.period) :].mean(axis=0)
    most = GRAVITY_ERROR * limits.torque + friction.coulomb
    found = [
        *measures("torque that holds", held, force, names),
        *measures("gravity torque of the model", gravity, force, names),
        *measures("difference", np.abs(held - gravity), force, names, most=most),
    ]
    return judged("gravity", found, REMEDY)
