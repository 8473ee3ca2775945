"""Predict what a motion will teach and how far the arm will fall behind it.

Rows whitened by each joint's torque noise, `G = sum_s H_b' S^-1 H_b`, give the covariance `G^-1` of the best linear
estimate (eq. 81 with a noise per joint). Noise that resembles itself from sample to sample teaches less than white
noise of the same size: `NoiseModel.inflation` is by how much deviations grow.

Drives are expected to take `f(w) = F_c s(w) + F_v w` at their velocity w. The law adds the share s_f of it, for the
velocity of the reference (`FrictionFeedforward`). What is left, `d = (b - s_f) f` where friction is b times what is
expected, computed torque (eq. 76) answers with the error `e = K_p^-1 M(q)^-1 d`, once it has settled. Where little
inertia stands behind a joint, as behind the upper arm's rotation when the elbow is straight, little friction moves it
far. It is static, so a prediction and no bound; the safety monitor keeps the limit.

Friction is the prior's where it has some, else a guess from the torque limits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ident_service.config.motion_limits import MotionLimits
from ident_service.config.simulation import SimulatedDriver
from ident_service.excitation.trajectory import FourierPath, PosturePath
from ident_service.model.arm_model import ArmModel, control_model
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.chain import Array
from ident_service.model.expected_friction import ExpectedFriction
from ident_service.model.regressor import joint_regressor

if TYPE_CHECKING:
    import scipy.sparse
from dataclasses import replace

from ident_service.errors import ModelError
from ident_service.model.chain import Chain
from ident_service.model.parameter_layout import Layout
from ident_service.model.pinocchio_models import ForwardDynamics
from ident_service.model.regressor import traced_rigid_torque
from ident_service.model.symbolic import Differentiable, ExpressionGraph


class InertiaResponse:
    """Accelerations that torques cause, `y = M(q)^-1 d`, at many postures, run forwards and backwards.

    With `lambda = M^-1 s` for seeds s, the gradient of `sum(s y)` is `-lambda' d(M y)/dq` over position and lambda over
    torque; `M y` is the torque of the acceleration y from rest without gravity, traced once per arm.
    """

    def __init__(self, chain: Chain, layout: Layout, delta: Array) -> None:
        """Trace the dynamics for link parameters `delta` [SI], shape (layout.size,).

        Raises:
            ModelError: a link without positive mass.
        """
        n = chain.joints
        tape = ExpressionGraph()
        q, y = [tape.input() for _ in range(n)], [tape.input() for _ in range(n)]
        torque = traced_rigid_torque(tape, replace(chain, gravity=np.zeros(3)), layout, delta, q, [0.0] * n, list(y))
        self._torque = Differentiable(tape, q, torque)
        self._dynamics = ForwardDynamics(chain, layout, delta)
        self._position = self._M = self._response = np.zeros((0, n))

    def run(self, position: Array, torque: Array) -> Array:
        """Return the joint accelerations that torques alone cause [rad/s^2 or m/s^2], shape (samples, joints).

        Args:
            position: [rad or m], shape (samples, joints).
            torque: [N m or N], shape (samples, joints).

        Raises:
            ModelError: the mass matrix is singular: no real body has these parameters.
        """
        self._position = position
        self._M = self._dynamics.mass_matrices(position)
        self._response = self._solved(torque)
        return self._response

    def pull(self, seeds: Array) -> tuple[Array, Array]:
        """Return the gradient of `sum(seeds * run(...))` over position and torque, each of shape (samples, joints).

        Args:
            seeds: shape (samples, joints).

        Returns:
            Derivatives with respect to position and torque, each of shape (samples, joints).
        """
        multipliers = self._solved(seeds)
        self._torque.run(np.concatenate([self._position.T, self._response.T]))
        return -self._torque.pull(np.ascontiguousarray(multipliers.T)).T, multipliers

    def _solved(self, right: Array) -> Array:
        try:
            return np.asarray(np.linalg.solve(self._M, right[..., None])[..., 0])
        except np.linalg.LinAlgError:
            raise ModelError("the mass matrix is singular: no real body has these parameters") from None


_NOISE_SHARE = 0.01  # of the torque limit, where nothing is known of a joint's noise
_SAMPLES = 2000


@dataclass(frozen=True)
class NoiseModel:
    """Expected size and correlation of the torque residual.

    Attributes:
        deviation: per joint [N m or N], shape (joints,).
        inflation: standard deviations of parameters against those that white noise would give.
        source: origin of the numbers, for people.
    """

    deviation: Array
    inflation: float
    source: str


def described_noise(model: ArmModel, limits: MotionLimits) -> NoiseModel:
    """Return each joint's torque noise: the simulated driver's where given, else 1 % of the torque limits."""
    driver = model.config.driver
    fallback = _NOISE_SHARE * limits.torque
    if isinstance(driver, SimulatedDriver):
        noise = np.broadcast_to(np.asarray(driver.torque_noise, dtype=float), fallback.shape)
        if (noise > 0.0).any():
            return NoiseModel(np.where(noise > 0.0, noise, fallback), 1.0, "the driver's torque noise")
    return NoiseModel(fallback, 1.0, f"{_NOISE_SHARE:.0%} of the torque limits, assumed")


def information(
    path: FourierPath | PosturePath, model: ArmModel, base: BaseParameters, torque_deviations: Array
) -> Array:
    """Return the information matrix per sample of a motion without its ramps, shape (base, base).

    Args:
        path: the motion.
        model: of the arm.
        base: the parameters.
        torque_deviations: standard deviation of each joint's torque, shape (joints,).
    """
    begin, end = path.distinct[1] if len(path.distinct) > 1 else path.distinct[0]
    time = begin + (np.arange(_SAMPLES) + 0.5) * (end - begin) / _SAMPLES
    q, dq, ddq, _ = path.at(time)
    H = joint_regressor(model.chain, model.layout, q, dq, ddq, base.base)
    return np.asarray(
        sum(rows @ rows.T / sigma**2 for rows, sigma in zip(H, torque_deviations, strict=True)) / _SAMPLES
    )


def seconds_of_information(path: FourierPath | PosturePath) -> float:
    """Return the time that `information` counts for [s]: all periods, or the whole motion through postures."""
    return path.periods * path.series.period if isinstance(path, FourierPath) else path.duration


def expected_deviations(
    path: FourierPath | PosturePath,
    model: ArmModel,
    base: BaseParameters,
    noise: NoiseModel,
    earlier_information: Array | None = None,
) -> Array:
    """Return the expected standard deviations of the base parameters [SI], shape (base,); infinite where unseen.

    Args:
        path: the motion.
        model: of the arm; its control rate is that of the recording.
        base: the parameters.
        noise: of the torques.
        earlier_information: information from earlier recordings, whitened by `noise.deviation`, shape (base, base).
    """
    G = information(path, model, base, noise.deviation) * seconds_of_information(path) * model.config.control.rate
    if earlier_information is not None:
        G = G + earlier_information
    # Parameters have units of their own; scaled to a unit diagonal, what is not taught shows as an eigenvalue of zero.
    size = np.sqrt(np.diag(G))
    seen = size > 0.0
    deviations = np.full(len(G), np.inf)
    if not seen.any():
        return deviations
    scaled = G[np.ix_(seen, seen)] / np.outer(size[seen], size[seen])
    eigenvalues, V = np.linalg.eigh(scaled)
    taught = eigenvalues > 1e-12 * eigenvalues[-1]
    variance = (V[:, taught] ** 2 / eigenvalues[taught]).sum(axis=1)
    variance[(V[:, ~taught] ** 2).sum(axis=1) > 1e-9] = np.inf
    deviations[seen] = noise.inflation * np.sqrt(variance) / size[seen]
    return deviations


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


def uncompensated_friction(friction: ExpectedFriction, compensated_share: float) -> ExpectedFriction:
    """Return the most friction that a feed-forward leaves if the true one is 0.6 to 1.4 times this; offset 0."""
    left = max(DOUBT[1] - compensated_share, compensated_share - DOUBT[0])
    return ExpectedFriction(left * friction.coulomb, left * friction.viscous, 0.0 * friction.offset)


class FollowingError:
    """Predicted following error at many states, with derivatives of functions of it."""

    def __init__(self, model: ArmModel, limits: MotionLimits, friction: ExpectedFriction, creep: Array) -> None:
        """Build the inertia response of the prior model.

        Args:
            model: model with prior parameters.
            limits: limits with the controller's gains.
            friction: friction of the drives, as much of it as the control law does not know (`uncompensated_friction`).
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
        """Return the predicted following error [rad or m] from uncompensated friction, shape (samples, joints)."""
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
    """Return the sparse matrix that maps values at `times` [s] to their time derivatives, by differences.

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


def predict_following_error(
    model: ArmModel, limits: MotionLimits, friction: ExpectedFriction, position: Array, velocity: Array
) -> Array:
    """Return the largest predicted following error of every joint over a motion [rad or m], shape (joints,).

    Args:
        model: of the arm; its description says which share of the friction is fed forward.
        limits: limits with the controller's gains.
        friction: expected friction of the drives.
        position: [rad or m], shape (samples, joints).
        velocity: [rad/s or m/s], shape (samples, joints).
    """
    sharp = np.full(len(limits.kp), 1e-6)
    unknown = uncompensated_friction(friction, model.config.control.friction_feedforward)
    behind = FollowingError(model, limits, unknown, sharp).run(position, velocity)
    return np.asarray(np.abs(behind).max(axis=0))
