"""Detect frozen encoders: estimate how far a joint whose position reads constant would have moved against dry friction.

Behind a light joint a small torque makes a large speed before a push that is large for the drive is reached, so what is
asked is not how hard a joint is pushed but what the push must have done. The push c is the correction and the friction
fed forward. Dry friction f holds a joint that stands still within `[-f, f]`, so the push can change by
`2 f` from the `c_0` with which the position last changed before the joint must move; one that was sliding is held by
`f` already, and a change that pushes it on in its direction moves it, but for what friction is larger at rest. If its
push braked it, and its last step is so small that it may have come to rest within that cycle, the push that braked it
may end as well, which moves no joint. With the allowance b of these cases, never more than that of a joint that stands,

    dv = max(|c - c_0| - b, 0) / m_jj(q) dt          dd = v dt

with m the inertia of the prior alone: with the drive inertia that the description states, the estimate d would grow
more slowly, and behind a light joint too slowly. Of the change only as much counts as is also the joint's own, what is
fed forward and `M_jj (a - a_0)_j` with M the control law's inertia and a the feedback acceleration: the rest balances
what other joints' corrections do to it. A joint whose estimated displacement d is more than its encoder's steps can
hide is not where its encoder says. A jammed joint looks the same, and so does one whose dry friction is far larger than
configuration says.

Where drives move several joints, encoders count the drives' motion d = C q. One that is frozen leaves its joints the
motion of the other drives, so that none of them stands still. Such drives are observed as joints are, with their own
torque C^-T tau and inertia (C^-T M C^-1)_kk.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivers.arm import Flags, Vector
from ident_service.config.arm import ArmConfig
from ident_service.config.motion_limits import MotionLimits
from ident_service.model.arm_model import ArmModel
from ident_service.model.expected_friction import expected_friction
from ident_service.model.pinocchio_models import InverseDynamics

# Times the expected friction, which is a guess: by how much the push may change against a joint that stands, and along
# the direction of one that slid, since friction is larger at rest and other joints react.
STANDING, SLIDING = 3.0, 1.0
# s within which a second step in the same direction shows that a joint slides; longer apart, it may stand in between.
SLID = 0.02
HIDDEN_SHARE, STEPS = 0.02, 10.0  # of the following error allowed; and steps of the encoder
_SAME = 1e-9  # rad or m, by which a drive's position that did not change may seem to: positions are computed back


@dataclass(frozen=True)
class EncoderCoordinates:
    """Coordinates in which encoders may stand still: every joint, then every drive that moves several joints.

    Attributes:
        motions: matrix from velocities of joints to those of the drives, shape (drives, joints).
        torques: matrix from torques of joints to those of the drives, shape (drives, joints).
    """

    motions: Vector
    torques: Vector

    @staticmethod
    def of(coupling: Vector | None, joint_count: int) -> EncoderCoordinates:
        """Create the coordinates of all joints and of the drives that move several joints, from the arm's coupling.

        Args:
            coupling: drive coordinates per joint coordinates, shape (joints, joints); each joint's own drive when None.
            joint_count: number of joints.
        """
        if coupling is None:
            return EncoderCoordinates(np.zeros((0, joint_count)), np.zeros((0, joint_count)))
        shared = np.sum(coupling != 0.0, axis=1) > 1
        return EncoderCoordinates(coupling[shared], np.linalg.inv(coupling).T[shared])

    def steps(self, position: Vector, position_before: Vector) -> Vector:
        """Return how far joints and multi-joint drives moved between two positions [rad or m], (joints + drives,)."""
        change = position - position_before
        if not len(self.motions):
            return np.asarray(change)
        with np.errstate(invalid="ignore"):  # positions that are not finite are not valid either
            drives = self.motions @ change
        return np.concatenate([change, np.where(np.abs(drives) > _SAME, drives, 0.0)])

    def valid(self, valid: Flags) -> Flags:
        """Return which joints and multi-joint drives are known: a drive is where all joints that it moves are valid."""
        if not len(self.motions):
            return valid
        return np.append(valid, (valid | (self.motions == 0.0)).all(axis=1))

    def velocities(self, joint_velocities: Vector) -> Vector:
        """Append the velocities (or accelerations) of drives that move several joints to those of joints."""
        return np.append(joint_velocities, self.motions @ joint_velocities) if len(self.motions) else joint_velocities

    def forces(self, joint_torques: Vector) -> Vector:
        """Append the torques [N m or N] of drives that move several joints to those of the joints."""
        return np.append(joint_torques, self.torques @ joint_torques) if len(self.torques) else joint_torques

    def largest_motions(self, joint_motions: Vector) -> Vector:
        """Append each multi-joint drive's largest motion if every joint moves by at most its value."""
        return np.append(joint_motions, np.abs(self.motions) @ joint_motions)

    def largest_forces(self, joint_torques: Vector) -> Vector:
        """Append each multi-joint drive's torque if only its most demanding joint needs its value."""
        drives = np.abs(self.torques) * joint_torques
        return np.append(joint_torques, drives.max(axis=1, initial=0.0))

    def inertias(self, mass_matrix: Vector) -> Vector:
        """Return the inertia of each joint and multi-joint drive while all others stand [kg m^2 or kg]."""
        own = np.diag(mass_matrix)
        if not len(self.torques):
            return own
        return np.append(own, np.einsum("dj,jk,dk->d", self.torques, mass_matrix, self.torques))

    def at_joints(self, flags: Flags) -> Flags:
        """Return which joints are flagged, themselves or by a flagged multi-joint drive, shape (joints,)."""
        joints = self.motions.shape[1]
        if not len(self.motions):
            return flags
        return np.asarray(flags[:joints] | (flags[joints:, None] & (self.motions != 0.0)).any(axis=0))


class FrozenEncoderObserver:
    """Observe joints whose encoders may be frozen: integrate the motion that each joint's push should have caused."""

    def __init__(
        self,
        dynamics: InverseDynamics,
        limits: MotionLimits,
        period: float,
        friction: Vector,
        resolution: Vector,
        least: InverseDynamics | None = None,
        coupling: Vector | None = None,
    ) -> None:
        """Start with an estimated displacement of zero.

        Args:
            dynamics: the control law's model.
            limits: of the arm.
            period: of the loop [s].
            friction: dry friction expected of each joint, and of each drive that moves several [N m or N], shape
                (joints + drives,).
            resolution: smallest step of the positions [rad or m], shape (joints,).
            least: the prior model; the control law's when None.
            coupling: coupling of the arm, as for `EncoderCoordinates.of`.
        """
        self._dynamics, self._least, self._period = dynamics, least or dynamics, period
        self._encoders = EncoderCoordinates.of(coupling, len(resolution))
        self._standing, self._sliding = (STANDING * friction).tolist(), (SLIDING * friction).tolist()
        hidden = HIDDEN_SHARE * limits.following_error + STEPS * resolution
        self._hidden = self._encoders.largest_motions(hidden)
        self._speed, self._way = np.zeros_like(friction), np.zeros_like(friction)
        # Push, feedback acceleration and friction fed forward with which each position last changed.
        self._base, self._base_acceleration, self._base_fed = ([0.0] * len(friction) for _ in range(3))
        self._none: Flags = np.zeros(len(friction), dtype=bool)
        self._direction, self._slid, self._step = ([0.0] * len(friction) for _ in range(3))
        self._cycle, self._slides_within = 0, max(1, round(SLID / period))
        self._stepped = [0] * len(friction)
        self._owing = False

    def update(
        self,
        steps: Vector,
        feedback_torque: Vector,
        feedback_acceleration: Vector,
        position: Vector,
        friction_feedforward: Vector | float = 0.0,
    ) -> Flags:
        """Estimate unseen motion; return which joints and multi-joint drives exceed what their encoders can hide.

        Args:
            steps: change of each position since the cycle before [rad or m], 0 where it was not measured, shape
                (joints + drives,).
            feedback_torque: feedback torque [N m or N], shape (joints,); all zero where no position is asked for, which
                allows no conclusion.
            feedback_acceleration: of the control law [rad/s^2 or m/s^2], shape (joints,).
            position: last known position [rad or m], shape (joints,).
            friction_feedforward: friction in the torque [N m or N], shape (joints,).

        Returns:
            Which joints and drives should have moved farther than their encoders can hide, shape (joints + drives,).
        """
        self._cycle += 1
        encoders, given = self._encoders, feedback_torque
        fed = (
            friction_feedforward
            if isinstance(friction_feedforward, np.ndarray)
            else np.full(feedback_torque.shape, friction_feedforward)
        )
        fed = encoders.forces(fed)
        feedback_torque, feedback_acceleration = (
            encoders.forces(feedback_torque),
            encoders.velocities(feedback_acceleration),
        )
        pushed = feedback_torque + fed
        self._note_changes(steps, pushed, feedback_acceleration, fed)
        shifts = [push - base for push, base in zip(pushed.tolist(), self._base, strict=True)]
        limits = zip(shifts, self._slid, self._sliding, self._standing, strict=True)
        most = [sliding if shift * slid > 0.0 else standing for shift, slid, sliding, standing in limits]
        beyond = [abs(shift) > limit for shift, limit in zip(shifts, most, strict=True)]
        if not any(beyond):
            self._reset_estimate()
            return self._none
        if not given.any():
            self._base, self._base_acceleration = feedback_torque.tolist(), feedback_acceleration.tolist()
            self._base_fed = [0.0] * len(self._base)
            self._reset_estimate()
            return self._none
        change, inertia = np.array(shifts), encoders.inertias(self._dynamics.mass_matrix(position))
        braking = np.maximum(-np.array(self._slid) * (inertia * self._base_acceleration + self._base_fed), 0.0)
        stopping = (braking + self._standing) / inertia * self._period**2  # twice the longest step that ends at rest
        rests = np.array(self._step) <= stopping
        allowed = np.where(rests, np.minimum(np.array(most) + braking, self._standing), most)
        own = np.sign(change) * (inertia * (feedback_acceleration - self._base_acceleration) + fed - self._base_fed)
        push = np.minimum(np.abs(change), own) - allowed
        acting, gained = push > 0.0, push / encoders.inertias(self._least.mass_matrix(position)) * self._period
        self._speed = np.where(acting, self._speed + gained, 0.0)
        self._way = np.where(acting, self._way + self._speed * self._period, 0.0)
        self._owing = True
        return np.asarray(self._way > self._hidden)

    def _note_changes(self, steps: Vector, pushed: Vector, answer: Vector, fed: Vector) -> None:
        """Note with what each position that has changed did so, and whether its joint slides."""
        rows = zip(steps.tolist(), pushed.tolist(), answer.tolist(), fed.tolist(), strict=True)
        for k, (step, push, acceleration, friction) in enumerate(rows):
            if step == 0.0:
                continue
            towards, self._step[k] = 1.0 if step > 0.0 else -1.0, abs(step)
            slides = towards == self._direction[k] and self._cycle - self._stepped[k] <= self._slides_within
            self._slid[k] = towards if slides else 0.0
            self._direction[k], self._stepped[k] = towards, self._cycle
            self._base[k], self._base_acceleration[k], self._base_fed[k] = push, acceleration, friction

    def _reset_estimate(self) -> None:
        if self._owing:
            self._speed, self._way, self._owing = np.zeros_like(self._speed), np.zeros_like(self._way), False


def frozen_encoder_observer(
    dynamics: InverseDynamics, model: ArmModel, limits: MotionLimits, period: float, position_resolution: Vector
) -> FrozenEncoderObserver:
    """Create the frozen-encoder observer of an arm; dry friction is the prior's, at least the configuration's guess."""
    guess, chain = model.config.design.friction_guess, model.chain
    joints = np.maximum(expected_friction(model, limits, guess).at_joints(chain).coulomb, guess[0] * limits.torque)
    coupling = encoder_coupling(model.config)
    # The friction of joints that slide while a drive of theirs stands balances there: the sum would be too much.
    friction = EncoderCoordinates.of(coupling, chain.joints).largest_forces(joints)
    least = None if model.prior is None else InverseDynamics(chain, model.layout, model.prior)
    return FrozenEncoderObserver(dynamics, limits, period, friction, position_resolution, least, coupling)


def encoder_coupling(config: ArmConfig) -> Vector | None:
    """Return the encoders' motion per motion of the joints, shape (joints, joints); None without a coupling.

    Without one each joint has its own drive. Whether friction and inertia are the drives' (`drive_terms`) is another
    question: encoders at shared drives count the drives' motion in any case.
    """
    gears = config.transmission
    return None if gears is None or gears.coupling is None else np.array(gears.coupling, dtype=float)
