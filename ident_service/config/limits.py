"""Collect an arm's limits, gains and home position as arrays; refuse a description that lacks one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident_service.config.schema import ArmConfig
from ident_service.errors import MotionRefused

Vector = NDArray[np.float64]
_NEEDED = ("position", "velocity", "acceleration", "jerk", "torque", "following_error", "kp", "kd")


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
        home: where motions begin and end.
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


def motion_limits(config: ArmConfig) -> MotionLimits:
    """Collect limits and gains of all joints.

    Raises:
        MotionRefused: the description leaves out something that a safe motion needs; all gaps are named.
    """
    missing = [
        f"joints.{name}.{key}"
        for name, joint in config.joints.items()
        for key in _NEEDED
        if getattr(joint, key) is None
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
    return MotionLimits(lower, upper, home=home, **{key: column(key) for key in _NEEDED[1:]})
