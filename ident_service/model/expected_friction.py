"""Predict friction before it is identified, and compute the control law's friction feed-forward.

Drives are expected to take `f(w) = F_c s(w) + F_v w + F_o` at their velocity w: the prior's friction, or a guess in
shares of the torque limits. Where it is felt by joints, `C^T f(C dq)`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident_service.config.motion_limits import MotionLimits
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import Array, Chain

# Share of the velocity limit over which the Coulomb feed-forward reverses. A sign function of the velocity would
# step by twice the friction, and chatter where a reference stands.
_TURNS = 0.02
# Wider for much dry friction: reversing at the acceleration limit changes the torque at most at this rate, half of what
# the safety monitor allows (libfranka's 1000 N m/s); errors at a reversal need the other half.
_TURNING = 500.0  # N m/s or N/s


@dataclass(frozen=True)
class ExpectedFriction:
    """Friction of the drives, in their own coordinates; of joints with a drive each, the joints'.

    Attributes:
        coulomb: [N m or N], shape (joints,).
        viscous: [N m s/rad or N s/m], shape (joints,).
        offset: [N m or N], shape (joints,).
    """

    coulomb: Array
    viscous: Array
    offset: Array

    def at_joints(self, chain: Chain) -> ExpectedFriction:
        """Return the largest friction that each joint can feel, summed over all drives that move it."""
        moves = np.abs(chain.coupling)
        return ExpectedFriction(self.coulomb @ moves, np.diag((moves.T * self.viscous) @ moves), self.offset @ moves)


def expected_friction(model: ArmModel, limits: MotionLimits, guessed_shares: tuple[float, float]) -> ExpectedFriction:
    """Return each drive's friction: the prior's where it has any, else `guessed_shares` of its torque limit.

    Args:
        model: of the arm.
        limits: full limits of the arm.
        guessed_shares: Coulomb friction, and viscous friction at the velocity limit, as shares of the torque limit: the
            joint's, or, of drives that move several joints, the most that a joint's limit alone asks of the drive.
    """
    coupling = model.chain.coupling
    torque = (np.abs(np.linalg.inv(coupling).T) * limits.torque).max(axis=1)
    coulomb, viscous = guessed_shares[0] * torque, guessed_shares[1] * torque / (np.abs(coupling) @ limits.velocity)
    if model.prior is None:
        return ExpectedFriction(coulomb, viscous, np.zeros_like(coulomb))
    known = [model.layout.term_values(term, model.prior) for term in ("coulomb", "viscous", "offset")]
    some = (known[0] > 0.0) | (known[1] > 0.0)
    return ExpectedFriction(np.where(some, known[0], coulomb), np.where(some, known[1], viscous), known[2])


class FrictionFeedforward:
    """Friction torque that the control law adds for the velocity of the reference.

    It depends on the reference alone, so that it closes no loop: it can neither chatter on the noise of a measured
    velocity nor drive a limit cycle, and where the reference stands it is the drives' offset.

    Attributes:
        friction: expected friction of the drives.
        share: share of Coulomb and viscous friction that is added; the offset is added whole.
    """

    def __init__(self, friction: ExpectedFriction, share: float, chain: Chain, limits: MotionLimits) -> None:
        """Store the expected friction and the share of it to add.

        Args:
            friction: of the drives.
            share: share of Coulomb and viscous friction that is added; the offset is added whole.
            chain: chain with the coupling of drives and joints.
            limits: limits that give the velocity over which Coulomb friction changes sign.
        """
        self.friction, self.share = friction, share
        self._coupling = None if np.array_equal(chain.coupling, np.eye(chain.joints)) else chain.coupling
        self._coulomb, self._viscous = share * friction.coulomb, share * friction.viscous
        moves = np.abs(chain.coupling)
        over = np.maximum(_TURNS * moves @ limits.velocity, self._coulomb * (moves @ limits.acceleration) / _TURNING)
        self._turns = 1.0 / over

    def torque(self, velocity: Array) -> Array:
        """Return the torque to add [N m or N] for a reference's velocity [rad/s or m/s], each (..., joints)."""
        rate = velocity if self._coupling is None else velocity @ self._coupling.T
        felt = self._coulomb * np.tanh(self._turns * rate) + self._viscous * rate + self.friction.offset
        return np.asarray(felt if self._coupling is None else felt @ self._coupling)


def friction_feedforward(model: ArmModel, limits: MotionLimits) -> FrictionFeedforward:
    """Build the friction feed-forward that the description asks for, from the prior's or guessed friction."""
    friction = expected_friction(model, limits, model.config.design.friction_guess)
    return FrictionFeedforward(friction, model.config.control.friction_feedforward, model.chain, limits)
