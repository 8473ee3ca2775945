"""Check the gravity torque of the model against the torque that holds the arm where it stands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ident_service.config.motion_limits import MotionLimits, Vector
from ident_service.errors import ArmFault
from ident_service.model.arm_model import ArmModel
from ident_service.model.expected_friction import ExpectedFriction
from ident_service.motion.ticket import Check, Verdict, check_from_measures, failed, joint_units, measures
from ident_service.preflight.direction import sign_failure, wrong_signs
from ident_service.preflight.session import Rows, Session, remedy_of
from ident_service.preflight.static_checks import HOLDABLE

SETTLE, HOLD = 0.3, 1.0  # s before the mean is taken, and over which
_SUNK = 1e-3  # rad or m that a joint must have moved down before a load is reported
GRAVITY_ERROR = 0.1  # of the torque limit, beside Coulomb friction, which may carry as much of the weight
_SIGNS = "Check the signs of encoders and torques too."
REMEDY = (
    "Compare tool and load on the arm with the description, check that it does not lean on anything, and check "
    "torque constants and the zero positions of the joints."
)


def holdable(gravity: Vector, model: ArmModel, limits: MotionLimits) -> Check | None:
    """Return a failed check where the model says that the arm cannot be held in this posture; else None.

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
        "holding the arm takes too much of the torque limits: " + "; ".join(str(one) for one in found if not one.kept),
        "Support the arm in a posture that takes less torque, then check again.",
        found,
    )


def holding_torque(rows: Rows, period: float) -> Vector:
    """Return the mean torque that held the arm, after it had settled [N m or N], shape (joints,).

    Args:
        rows: of holding still for `SETTLE + HOLD` seconds.
        period: [s].
    """
    return np.asarray(np.mean([sample.torque for sample, _ in rows[round(SETTLE / period) :]], axis=0))


def differences(
    held: Vector, gravity: Vector, limits: MotionLimits, friction: ExpectedFriction
) -> tuple[Vector, Vector]:
    """Return how far two torques are apart, and how far they may be [N m or N], shape (joints,) each."""
    return np.abs(held - gravity), GRAVITY_ERROR * limits.torque + friction.coulomb


def gravity_check(
    held: Vector, gravity: Vector, model: ArmModel, limits: MotionLimits, friction: ExpectedFriction
) -> Check:
    """Compare the torque that held the arm with the model's gravity torque.

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
        *measures("holding torque", held, force, names),
        *measures("gravity torque of the model", gravity, force, names),
        *measures("difference", difference, force, names, most=most),
    ]
    check = check_from_measures("gravity", found, REMEDY)
    if check.verdict is Verdict.FAILED and (weight := _weight(held - gravity, gravity, most)):
        return replace(check, reason=f"{weight}: {check.reason}")
    return check


def holding_fault_check(
    session: Session, model: ArmModel, limits: MotionLimits, friction: ExpectedFriction, error: ArmFault
) -> Check:
    """Find out why a fault ended the holding of an arm.

    Causes: a wrong sign that explains how the arm moved; what the fault itself says; or a load: an arm that sinks,
    although the torque that holds it is above the model's. Its joints stick on the way, like a frozen encoder.

    Args:
        session: in which it was held.
        model: of the arm.
        limits: of the arm.
        friction: expected.
        error: the fault.
    """
    remedy, trace = remedy_of(error), session.trace()
    stands_still = error.code == "frozen_encoder"
    if remedy is not None and not stands_still:
        return failed("gravity", str(error), remedy)
    if not stands_still and (wrong := wrong_signs(trace, session)):
        return sign_failure(wrong, model, str(error))
    moved = trace.position[-1] - trace.position[0]
    sunk = (moved * session.gravity < 0.0) & (np.abs(moved) > _SUNK)
    extra = np.where(sunk, trace.torque[-1] - session.gravity, 0.0)
    _, most = differences(trace.torque[-1], session.gravity, limits, friction)
    if weight := _weight(extra, session.gravity, most):
        joints = ", ".join(
            f"{name} sank by {abs(way):.3g} {unit} against {abs(more):.3g} {force} more than the model's"
            for name, way, more, most_more, unit, force in zip(
                model.chain.names,
                moved,
                extra,
                most,
                joint_units(model.chain.revolute, "rad", "m"),
                joint_units(model.chain.revolute, "N m", "N"),
                strict=True,
            )
            if abs(more) > most_more
        )
        return failed("gravity", f"{weight}: {joints}; the safety monitor released it ({error.code})", REMEDY)
    if remedy is not None:
        return failed("gravity", str(error), remedy)
    return failed("gravity", f"the arm could not be held where it stands: {error}", f"{REMEDY} {_SIGNS}")


def _weight(extra: Vector, gravity: Vector, most: Vector) -> str:
    """Describe whether the arm is heavier or lighter than described, where all joints that differ agree; else empty."""
    sides = np.sign(extra * gravity)[np.abs(extra) > most]
    if not len(sides) or (sides != sides[0]).any() or sides[0] == 0.0:
        return ""
    if sides[0] > 0.0:
        return "the arm is heavier than described, or its drives give less torque than they are asked for"
    return "the arm is lighter than described, or its drives give more torque than they are asked for"
