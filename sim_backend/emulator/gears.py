"""Convert between joints and motors through the gears of the emulated arm.

`q_motor = J (q - q0)` with `J = diag(r) C`, hence `dq_motor = J dq`, and since gears lose nothing here,
`tau = J^T tau_motor`. A motor's braking `b_i` is felt by the joints as `J^T diag(b) J`, which couples the joints of a
differential. (`config/recording.py` has the symbols.)

This is written apart from the driver's conversion, so that one can be checked against the other.
"""

from __future__ import annotations

import numpy as np

from drivers.arm import Vector
from ident_service.config.recording import Transmission
from ident_service.errors import DriverError


class Gears:
    """Represent the gears of one arm.

    Attributes:
        matrix: J, shape (motors, joints), read-only.
        ratios: r, shape (motors,), read-only.
    """

    def __init__(self, transmission: Transmission, joints: int) -> None:
        """Take the gears from an arm's description.

        Args:
            transmission: its section.
            joints: of the arm.

        Raises:
            DriverError: not one motor a joint.
        """
        if len(transmission.ratios) != joints:
            raise DriverError(f"{len(transmission.ratios)} ratios in transmission, but the arm has {joints} joints")
        coupling = np.eye(joints) if transmission.coupling is None else np.array(transmission.coupling)
        self.ratios: Vector = np.array(transmission.ratios)
        self.matrix: Vector = self.ratios[:, None] * coupling
        self._offsets: Vector = np.zeros(joints) if transmission.offsets is None else np.array(transmission.offsets)
        self.ratios.setflags(write=False)
        self.matrix.setflags(write=False)

    def motor_position(self, position: Vector) -> Vector:
        """Return the motor angles [rad] of joint positions [rad or m], shape (motors,)."""
        return np.asarray(self.matrix @ (position - self._offsets))

    def motor_velocity(self, velocity: Vector) -> Vector:
        """Return the motor speeds [rad/s] of joint velocities [rad/s or m/s], shape (motors,)."""
        return np.asarray(self.matrix @ velocity)

    def joint_torque(self, torque: Vector) -> Vector:
        """Return the joint torques [N m or N] of motor torques [N m], shape (joints,)."""
        return np.asarray(self.matrix.T @ torque)

    def joint_damping(self, damping: Vector) -> Vector:
        """Return the joints' damping by braked motors [N m s/rad or N s/m], symmetric, shape (joints, joints).

        Args:
            damping: of each motor [N m s/rad], shape (motors,).
        """
        return np.asarray(self.matrix.T @ (damping[:, None] * self.matrix))

    def motor_damping(self, damping: Vector) -> Vector:
        """Return motor dampings [N m s/rad] that brake no joint less than asked when all motors brake, shape (motors,).

        Args:
            damping: asked for, per joint [N m s/rad or N s/m], shape (joints,).
        """
        squares = self.matrix**2
        needed = damping / squares.sum(axis=0)
        return np.asarray(np.where(squares > 0.0, needed, 0.0).max(axis=1))

    def driven(self, motors: Vector) -> Vector:
        """Return which joints have all of their motors among the given ones: 1 or 0, shape (joints,).

        Args:
            motors: 1 for each of these, else 0, shape (motors,).
        """
        return np.asarray(~((self.matrix != 0.0) & (motors == 0.0)[:, None]).any(axis=0), dtype=float)
