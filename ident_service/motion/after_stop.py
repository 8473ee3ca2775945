"""Choose how a stopped arm is secured: its brakes hold it, the loop holds it, or it is lowered.

Joints are asked by their weight: one whose gravity torque, by the prior model, is above `WEIGHS` of its torque limit in
some posture falls when its drive is switched off, unless it has a brake.
"""

from __future__ import annotations

from enum import Enum
from typing import Final

import numpy as np

from ident_service.config.motion_limits import MotionLimits
from ident_service.errors import MotionRefused
from ident_service.model.arm_model import ArmModel
from ident_service.model.pinocchio_models import InverseDynamics

WEIGHS: Final = 1e-3  # of a torque limit; every drive that reaches this torque has more friction than that
ONLY_BRAKED: Final = (
    "drives that are given positions (driver.streams) cannot lower an arm by torque; give its joints brakes, and leave "
    "control.after_stop out"
)
_POSTURES, _SEED = 64, 1
# Faults after whose stop a held arm may be led home: they concern neither the arm nor its drives.
HOME_AFTER: Final = frozenset({"lease_lost", "recorder_behind", "no_way_back", "late_cycles", "controls_failed"})


class StopSecuring(Enum):
    """Name the ways to secure a stopped arm that rests."""

    BRAKE = "brake"  # held for a while, then a quick stop: brakes close, or nothing weighs
    HOLD = "hold"  # held until a person confirms that the arm is supported or home; then lowered
    LOWER = "lower"  # held for a while, then lowered under damped control until it rests


def falling_joints(model: ArmModel, limits: MotionLimits) -> tuple[str, ...]:
    """Return the names of the joints that gravity moves when their drives are off, with or without a brake.

    Args:
        model: with prior parameters.
        limits: of the arm.

    Raises:
        MotionRefused: no prior parameters.
    """
    if model.prior is None:
        raise MotionRefused(f"{model.config.name}: computed torque needs prior parameters")
    dynamics = InverseDynamics(model.chain, model.layout, model.prior)
    still = np.zeros(model.chain.joints)
    postures = np.random.default_rng(_SEED).uniform(limits.lower, limits.upper, (_POSTURES, model.chain.joints))
    weight = np.abs([dynamics.torque(posture, still, still) for posture in postures]).max(axis=0)
    return tuple(name for name, falls in zip(model.chain.names, weight > WEIGHS * limits.torque, strict=True) if falls)


def after_stop(model: ArmModel, limits: MotionLimits) -> StopSecuring:
    """Return how this arm is secured after a stop: braked, held or lowered.

    Args:
        model: with prior parameters.
        limits: of the arm.

    Raises:
        MotionRefused: joints can fall that have no brake, and the description says nothing else of them.
    """
    asked = model.config.control.after_stop
    if asked in ("hold", "lower"):
        return StopSecuring(asked)
    loose = [name for name in falling_joints(model, limits) if not model.config.has_brake(name)]
    if loose:
        raise MotionRefused(
            f"{model.config.name}: {', '.join(loose)} would fall after a stop: gravity moves them, and no brake is "
            f"described; set control.after_stop to hold or lower, or joints.{loose[0]}.brake to true where there is one"
        )
    return StopSecuring.BRAKE
