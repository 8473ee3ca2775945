"""Predict the following error that friction causes beyond the control law's friction feed-forward.

Drives are expected to take `f(w) = F_c s(w) + F_v w` at their velocity w. The law adds the share s_f of it, for the
velocity of the reference (`FrictionFeedforward`). What is left, `d = (b - s_f) f` where friction is b times what is
expected, computed torque (eq. 76) answers with the error `e = K_p^-1 M(q)^-1 d`, once it has settled. Where little
inertia stands behind a joint, as behind the upper arm's rotation when the elbow is straight, little friction moves it
far. It is static, so a prediction and no bound; the safety monitor keeps the limit.

Friction is the prior's where it has some, else a guess from the torque limits.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ident_service.config.limits import MotionLimits
from ident_service.model.arm_model import ArmModel, control_model
from ident_service.model.chain import Array
from ident_service.model.expected_friction import ExpectedFriction
from ident_service.model.inertia_response import InertiaResponse

if TYPE_CHECKING:
    import scipy.sparse

# Where the inertia behind a joint changes, so does how far it falls behind, and its speed is another than asked for.
TOLERATED = 1.05  # share of the velocity limit; the safety monitor stops at 1.2
USABLE = 0.8  # share of the limit: settling overshoots a little, and the prediction is static
# Times the expected friction, between which an arm's own lies for a forecast: it changes by a third between a cold and
# a warm drive (Bittencourt & Gunnarsson 2012, figure 5).
DOUBT = (0.6, 1.4)


def dry_friction(model: ArmModel, delta: Array) -> tuple[Array, Array]:
    """Return the largest dry friction of every drive and of every joint [N m or N], each of shape (joints,)."""
    drives = np.abs(model.layout.term_values("coulomb", delta)) + np.abs(model.layout.term_values("stribeck", delta))
    return drives, drives @ np.abs(model.chain.coupling)


def unknown_friction(friction: ExpectedFriction, share: float) -> ExpectedFriction:
    """Return the most of the expected friction that a feed-forward of `share` leaves, either way, within `DOUBT`."""
    left = max(DOUBT[1] - share, share - DOUBT[0])
    return ExpectedFriction(left * friction.coulomb, left * friction.viscous, 0.0 * friction.offset)


class FollowingError:
    """Predicted following error at many states, with derivatives of functions of it."""

    def __init__(self, model: ArmModel, limits: MotionLimits, friction: ExpectedFriction, creep: Array) -> None:
        """Build the inertia response of the prior model.

        Args:
            model: with prior parameters.
            limits: for the gains.
            friction: of the drives, as much of it as the law does not know (`unknown_friction`).
            creep: velocity over which a joint's Coulomb friction turns round [rad/s or m/s], shape (joints,).

        Raises:
            ModelError: no prior, or one that no real body has.
        """
        known = control_model(model).prior
        prior = np.zeros(model.layout.size) if known is None else known
        self._response = InertiaResponse(model.chain, model.layout, prior)
        self._coupling, self._kp = model.chain.coupling, limits.kp
        self._friction, self._creep = friction, creep
        self._slope = np.zeros((0, len(creep)))

    def run(self, position: Array, velocity: Array) -> Array:
        """Return the predicted error [rad or m], shape (samples, joints), at states of shape (samples, joints)."""
        rate = velocity @ self._coupling.T
        turned = np.tanh(rate / self._creep)
        self._slope = self._friction.viscous + self._friction.coulomb * (1.0 - turned**2) / self._creep
        torque = (self._friction.coulomb * turned + self._friction.viscous * rate) @ self._coupling
        return self._response.run(position, torque) / self._kp

    def pull(self, seeds: Array) -> tuple[Array, Array]:
        """Return the gradient of `sum(seeds * run(...))` over position and velocity, each (samples, joints)."""
        by_position, by_torque = self._response.pull(seeds / self._kp)
        return by_position, ((by_torque @ self._coupling.T) * self._slope) @ self._coupling


def rate_of_change(times: Array) -> scipy.sparse.csr_array:
    """Return the matrix that takes values at `times` [s] to time derivatives, by differences of neighbours.

    Neighbours are samples of one stretch; where times jump or turn back, another stretch begins.
    """
    import scipy.sparse  # loads for 0.1 s, and only a design needs it

    steps = np.diff(times)
    usual = np.median(np.abs(steps))
    jumps = np.abs(steps) > 1.6 * usual
    turns = (np.sign(steps[1:]) != np.sign(steps[:-1])) & ~jumps[:-1]
    apart = jumps | np.concatenate([[False], turns])
    stretch = np.concatenate([[0], np.cumsum(apart)])
    n = len(times)
    index = np.arange(n)
    before = np.where((index > 0) & (stretch == np.roll(stretch, 1)), index - 1, index)
    after = np.where((index < n - 1) & (stretch == np.roll(stretch, -1)), index + 1, index)
    gap = times[after] - times[before]
    weight = np.where(gap != 0.0, 1.0 / np.where(gap != 0.0, gap, 1.0), 0.0)
    rows = np.concatenate([index, index])
    return scipy.sparse.csr_array((np.concatenate([weight, -weight]), (rows, np.concatenate([after, before]))), (n, n))


def forecast(
    model: ArmModel, limits: MotionLimits, friction: ExpectedFriction, position: Array, velocity: Array
) -> Array:
    """Return the largest predicted following error of every joint over a motion [rad or m], shape (joints,).

    Args:
        model: of the arm; its description says which share of the friction is fed forward.
        limits: for the gains.
        friction: expected of the drives.
        position: [rad or m], shape (samples, joints).
        velocity: [rad/s or m/s], shape (samples, joints).
    """
    sharp = np.full(len(limits.kp), 1e-6)
    unknown = unknown_friction(friction, model.config.control.friction_feedforward)
    behind = FollowingError(model, limits, unknown, sharp).run(position, velocity)
    return np.asarray(np.abs(behind).max(axis=0))
