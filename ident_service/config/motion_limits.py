"""Hold what a motion needs of an arm as arrays: limits, gains, home; refuse a description that lacks them.

Motors that share joints are limited by themselves: with `J = diag(r) C` (`config/recording.py`), `tau = J^T tau_motor`,
so that what two joints may have each by itself may be more than a motor gives when both want it at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident_service.config.arm import ArmConfig
from ident_service.config.recording import motor_groups
from ident_service.errors import MotionRefused

Vector = NDArray[np.float64]
_ROUNDING = 1e-12  # of the largest number in a row
NEEDED = ("position", "velocity", "acceleration", "jerk", "torque", "following_error", "kp", "kd")


@dataclass(frozen=True)
class MotorLimits:
    """Most that motors give which share joints with others.

    Attributes:
        to_motors: J^-T, torque of the motors [N m] per torque of the joints [N m or N], shape (motors, joints).
        torque: torque limit of each motor [N m], infinite where nothing is known, shape (motors,).
        together: mask of the motors that move each joint, directly or through other joints, shape (joints, motors).
    """

    to_motors: Vector
    torque: Vector
    together: NDArray[np.bool_]

    @property
    def names(self) -> tuple[str, ...]:
        """Return names of the motors for messages, `motor 1` and so on, in the order of the transmission's ratios."""
        return tuple(f"motor {number + 1}" for number in range(len(self.torque)))

    def torque_shares(self, joint_torque: Vector) -> Vector:
        """Return each motor's |torque| as a share of its limit, shape (..., motors), for joint torques [N m or N]."""
        return np.asarray(np.abs(joint_torque @ self.to_motors.T) / self.torque)

    def torque_shares_of_joints(self, joint_torque: Vector) -> Vector:
        """Return per joint the largest share of a motor coupled with it, even indirectly, shape (..., joints)."""
        shares = np.where(self.together, self.torque_shares(joint_torque)[..., None, :], 0.0)
        return np.asarray(shares.max(axis=-1))

    def scaled_within(self, joint_torque: Vector) -> Vector:
        """Return joint torques [N m or N], scaled down by one factor per group of joints that share overloaded motors.

        Joints that share motors are scaled by one factor, so that no joint is pushed the other way, as drives do that
        are asked for too much (`drivers/motor_units.py`).
        """
        return np.asarray(joint_torque / np.maximum(self.torque_shares_of_joints(joint_torque), 1.0))


@dataclass(frozen=True)
class MotionLimits:
    """Per-joint numbers in SI units, each of shape (joints,).

    Attributes:
        lower: lowest position.
        upper: highest position.
        velocity: largest speed.
        acceleration: largest acceleration.
        jerk: largest jerk.
        torque: largest torque.
        following_error: largest distance from the reference.
        kp: position gains [1/s^2] (table 4).
        kd: velocity gains [1/s] (table 4).
        home: position where motions begin and end.
        motors: limits of motors that share joints; None where each joint has its own motor, whose limit is the joint's.
    """

    lower: Vector
    upper: Vector
    velocity: Vector
    acceleration: Vector
    jerk: Vector
    torque: Vector
    following_error: Vector
    kp: Vector
    kd: Vector
    home: Vector
    motors: MotorLimits | None = None


def motor_limits(config: ArmConfig) -> MotorLimits | None:
    """Return all motors' torque limits if some are coupled through joints; None if none are, or no limit is known.

    Limits are those of `transmission.motor_torque` or of the drives, whichever is smaller.
    """
    gears = config.transmission
    if gears is None or gears.coupling is None:
        return None
    coupling = np.array(gears.coupling)
    together = motor_groups(gears)
    if (together.sum(axis=1) == 1).all():
        return None
    most = np.full(len(coupling), np.inf) if gears.motor_torque is None else np.array(gears.motor_torque)
    if config.motor_torques is not None:
        most = np.minimum(most, np.array(config.motor_torques))
    if not np.isfinite(most).any():
        return None
    to_motors = np.linalg.inv(np.array(gears.ratios)[:, None] * coupling).T
    # Rounding would tie motors together that have nothing to do with each other.
    to_motors = np.where(np.abs(to_motors) > _ROUNDING * np.abs(to_motors).max(axis=1, keepdims=True), to_motors, 0.0)
    return MotorLimits(to_motors, most, together)


def motion_limits(config: ArmConfig) -> MotionLimits:
    """Return limits, gains and home of all joints as arrays; raises MotionRefused that names all that is missing.

    Raises:
        MotionRefused: the description leaves out something that a safe motion needs; all gaps are named.
    """
    missing = [
        f"joints.{name}.{key}" for name, joint in config.joints.items() for key in NEEDED if getattr(joint, key) is None
    ]
    if missing or not config.joints:
        raise MotionRefused(
            f"{config.name}: a motion needs {', '.join(missing) or 'limits for every joint under joints'}"
        )
    joints = list(config.joints.values())

    def column(key: str) -> Vector:
        return np.array([getattr(joint, key) for joint in joints], dtype=float)

    position = column("position")
    lower, upper = position[:, 0].copy(), position[:, 1].copy()
    home = np.array([j.home if j.home is not None else np.clip(0.0, *p) for j, p in zip(joints, position, strict=True)])
    columns = {key: column(key) for key in NEEDED[1:]}
    return MotionLimits(lower, upper, home=home, motors=motor_limits(config), **columns)
