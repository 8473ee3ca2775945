"""Compute joint torques: computed torque with proportional-derivative feedback (5.2.1, eq. 76, figure 3), and damping.

    alpha = ddq_r + K_d (dq_r - dq) + K_p (q_r - q)          tau = M(q) alpha + c(q, dq) + g(q) + f(dq_r)

with the prior (CAD) model, the drive inertia that the description states included, and a share of the expected friction
f at the velocity of the reference (`model/expected_friction.py`). Velocity comes from encoder differences through a
first-order low-pass, because at 1 kHz one encoder step is a tenth of a radian per second. An arm that is only held, or
lowered, is asked for no position:

    tau = M(q) (K_p e - K_d dq) + c(q, dq) + s g(q) + tau_0

where e is how far it is to be brought back inside its position limits.
"""

from __future__ import annotations

import numpy as np

from drivers.arm import Flags, Vector
from ident_service.config.motion_limits import MotionLimits
from ident_service.model.expected_friction import FrictionFeedforward
from ident_service.model.pinocchio_models import InverseDynamics
from ident_service.motion.trajectory import Setpoint


class ComputedTorque:
    """Compute the control law and filter the velocity for it.

    Attributes:
        position: position at the last update [rad or m], shape (joints,), predicted where it was not measured.
        velocity: filtered velocity of the last update [rad/s or m/s], shape (joints,).
        correction: feedback part of the last torque, `M(q) (K_d (dq_r - dq) + K_p (q_r - q))` [N m or N],
            shape (joints,); nothing when the arm is only damped.
        feedforward: friction in the last torque [N m or N], shape (joints,); nothing when the arm is only damped.
        feedback_acceleration: `K_d (dq_r - dq) + K_p (q_r - q)` [rad/s^2 or m/s^2], shape (joints,); nothing
            when the arm is only damped.
    """

    def __init__(
        self,
        dynamics: InverseDynamics,
        limits: MotionLimits,
        period: float,
        velocity_cutoff: Vector | float | tuple[float, ...],
        position: Vector,
        friction: FrictionFeedforward | None = None,
    ) -> None:
        """Start with the arm at rest.

        Args:
            dynamics: the prior model.
            limits: limits of the arm, with the gains.
            period: of the loop [s].
            velocity_cutoff: cut-off of the low-pass of the velocity [Hz], one or per joint.
            position: present position of the arm [rad or m], shape (joints,).
            friction: friction to feed forward; none when None.
        """
        self._dynamics = dynamics
        self._kp, self._kd = limits.kp, limits.kd
        self._period = period
        self._friction = friction
        self._cutoff = np.asarray(velocity_cutoff, dtype=float)
        self._gain = _gain(self._cutoff, period)
        self.position = position.copy()
        self.velocity = np.zeros_like(position)
        self._none = np.zeros_like(position)
        # While some are missing: what was measured last [rad or m], and how long ago [s], shape (joints,) each.
        self._missing: tuple[Vector, Vector] | None = None
        self.correction = self.feedback_acceleration = self.feedforward = self._none

    def torque(
        self, position: Vector, valid: Flags, reference: Setpoint, elapsed_seconds: float | None = None
    ) -> Vector:
        """Return the computed torque for the next cycle [N m or N], not yet limited; updates the velocity filter.

        Args:
            position: measured position [rad or m], shape (joints,).
            valid: mask of the fresh positions; elsewhere the joint is taken to have gone on as it went.
            reference: setpoint of the cycle.
            elapsed_seconds: time since the update before; one period when None; 0 where it is unknown, and the velocity
                stays.

        Returns:
            Torque [N m or N], shape (joints,), not yet limited.
        """
        position = self._filtered(position, valid, elapsed_seconds)
        self.feedback_acceleration = self._kd * (reference.velocity - self.velocity) + self._kp * (
            reference.position - position
        )
        torque = self._dynamics.torque(position, self.velocity, reference.acceleration + self.feedback_acceleration)
        self.correction = torque - self._dynamics.torque(position, self.velocity, reference.acceleration)
        if self._friction is None:
            return torque
        self.feedforward = self._friction.torque(reference.velocity)
        return torque + self.feedforward

    def damping(
        self,
        position: Vector,
        valid: Flags,
        gravity_share: float = 1.0,
        added_torque: Vector | float = 0.0,
        elapsed_seconds: float | None = None,
        displacement_back: Vector | float = 0.0,
    ) -> Vector:
        """Update the velocity filter; return torque that damps motion, bears a share of gravity, and pulls back.

        Args:
            position: as for `torque`.
            valid: as for `torque`.
            gravity_share: share of gravity to compensate.
            added_torque: tau_0, further torque that is needed to stand [N m or N], shape (joints,).
            elapsed_seconds: as for `torque`.
            displacement_back: e, displacement by which each joint is to be brought back [rad or m], shape (joints,).

        Returns:
            Torque [N m or N], shape (joints,), not yet limited.
        """
        position = self._filtered(position, valid, elapsed_seconds)
        self.correction = self.feedback_acceleration = self.feedforward = self._none
        acceleration = self._kp * displacement_back - self._kd * self.velocity
        torque = self._dynamics.torque(position, self.velocity, acceleration) + added_torque
        if gravity_share < 1.0:
            torque = torque - (1.0 - gravity_share) * self._dynamics.torque(position, self._none, self._none)
        return torque

    def _filtered(self, position: Vector, valid: Flags, elapsed: float | None) -> Vector:
        """Update the velocity filter and return the position, predicted where it was not measured."""
        seconds = self._period if elapsed is None else elapsed
        if self._missing is not None or not all(valid.tolist()):
            return self._bridged(position, valid, seconds)
        gain = self._gain if seconds == self._period else _gain(self._cutoff, seconds)
        if seconds > 0.0:
            self.velocity = self.velocity + gain * ((position - self.position) / seconds - self.velocity)
        self.position = position
        return position

    def _bridged(self, position: Vector, valid: Flags, seconds: float) -> Vector:
        """Update where positions are missing, or were: a velocity is over the time since the last one measured.

        Against a prediction over one period, what a joint had gained unseen in several would be a jump of its velocity.
        Where that time is not known, the velocity stays for one more cycle.
        """
        measured, since = (self.position, np.zeros_like(position)) if self._missing is None else self._missing
        since = since + (seconds if seconds > 0.0 else np.inf)
        seen = valid & np.isfinite(since)
        over = np.where(seen, since, self._period)
        gain = _gain(self._cutoff, over)
        self.velocity = np.where(
            seen, self.velocity + gain * ((position - measured) / over - self.velocity), self.velocity
        )
        self.position = np.where(valid, position, self.position + seconds * self.velocity)
        self._missing = None if valid.all() else (np.where(valid, position, measured), np.where(valid, 0.0, since))
        return self.position


def _gain(cutoff: Vector, seconds: Vector | float) -> Vector:
    """Return the gain of a first-order low-pass [Hz] over a time [s], whatever its length."""
    return np.asarray(1.0 - np.exp(-2.0 * np.pi * cutoff * seconds))
