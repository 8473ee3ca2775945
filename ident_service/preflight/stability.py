"""Compute whether the gains are stable at this rate and delay, when the true inertia differs from the model's.

Around a posture computed torque (eq. 76) leaves a double integrator, `ddq = R alpha` with `R = M_true^-1 M_model`. In
discrete time, with period h, low-pass gain g and torque constant over a period,

    v_k = v_{k-1} + g ((q_k - q_{k-1}) / h - v_{k-1})          alpha_k = -K_p q_k - K_d v_k
    q_{k+1} = q_k + h dq_k + h^2/2 R a_k,   dq_{k+1} = dq_k + h R a_k,   a_k = alpha_{k-d}

exactly, d being the delay in cycles (1 by the Arm contract). The loop is stable where the spectral radius of this
linear recursion is below 1. A delay between whole cycles is exact too: the torque changes within the period.

The model is the one that the control law computes with, so it has the drive inertia that the description states. The
true inertia is any sum of the prior's inertias, each between `INERTIA` times as large, plus what `drive_inertia` states
beyond the prior, which is the least that is there, plus drive inertia that the model lacks. A model without any drive
inertia for a joint (a CAD model of the links) lacks some, so that such a joint's link is taken to be no lighter than
modelled. Friction and gravity's stiffness are left out: the first only damps, the second is small beside K_p, and
friction that is fed forward depends on the reference alone. Margins are stated for the model's inertia.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from ident_service.config.arm import ArmConfig
from ident_service.config.motion_limits import MotionLimits, Vector
from ident_service.errors import UsageError
from ident_service.model.arm_model import ArmModel, control_model
from ident_service.model.pinocchio_models import InverseDynamics

INERTIA = (0.5, 2.0)  # every link's true inertia, as a share of the model's
# Drive inertia that the model lacks, as a share of the joint's inertia: where it has some, and where it has none.
# Behind the WAM's wrist the drives are forty times what its CAD model knows.
KNOWN_DRIVE, UNKNOWN_DRIVE = 1.0, 50.0
LEAST_GAIN_MARGIN = 2.0  # 6 dB, as textbooks ask (Astrom & Murray, Feedback Systems, ch. 10: 2 to 5)
_MOST_GAIN, _MOST_DELAY = 1e3, 50.0
_RANDOM_CASES, _RANDOM_POSTURES, _SEED = 8, 4, 20140101
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Loop:
    """Hold the parameters of a linearised control loop.

    Attributes:
        kp: position gains [1/s^2], shape (joints,).
        kd: velocity gains [1/s], shape (joints,).
        period: [s].
        cutoff: cut-off of the velocity low-pass [Hz], one or shape (joints,).
        delay: delay from a sample to the torque computed from it [cycles], at least 1, whole or not.
    """

    kp: Vector
    kd: Vector
    period: float
    cutoff: Vector | float
    delay: float = 1.0

    @property
    def filter_gain(self) -> Vector:
        """Return the low-pass's share of the new velocity in each cycle, 1 - exp(-2 pi cutoff period), (joints,)."""
        gain = 1.0 - np.exp(-2.0 * np.pi * np.asarray(self.cutoff) * self.period)
        return np.asarray(np.broadcast_to(gain, self.kp.shape))


@dataclass(frozen=True)
class JointStability:
    """Represent the stability of one joint's loop by itself.

    Attributes:
        joint: name of the joint.
        lightest: the least true inertia considered, as a share of the model's.
        radius: the largest spectral radius over the range of inertias.
        gain_margin: the loop gain may rise by this factor at the model's inertia before it oscillates; 1000 stands for
            more, and 1 for none.
        delay_margin: delay that may be added at the model's inertia before the loop oscillates [s]; 0 for none.
    """

    joint: str
    lightest: float
    radius: float
    gain_margin: float
    delay_margin: float


@dataclass(frozen=True)
class StabilityReport:
    """Represent the stability of all joints, by themselves and together.

    Attributes:
        period: of the loop [s].
        delay_cycles: assumed delay from a sample to the torque computed from it [cycles].
        joints: stability of each joint by itself.
        coupled_radius: the largest spectral radius of all joints together over postures and inertias; None where no
            model is known.
    """

    period: float
    delay_cycles: int
    joints: tuple[JointStability, ...]
    coupled_radius: float | None

    @property
    def stable(self) -> bool:
        """Return whether every joint, and all together, are stable and each joint's gain margin is large enough."""
        return not self.objections()

    def objections(self) -> list[str]:
        """Return a sentence for each joint that is unstable or lacks gain margin, and if all together are unstable."""
        found = [
            f"{one.joint}: unstable for some inertia from {one.lightest:g} times the model's up "
            f"(spectral radius {one.radius:.4f}, gain margin {one.gain_margin:.2f})"
            for one in self.joints
            if not one.radius < 1.0
        ]
        found += [
            f"{one.joint}: gain margin {one.gain_margin:.2f}, at least {LEAST_GAIN_MARGIN:g} is needed"
            for one in self.joints
            if one.radius < 1.0 and one.gain_margin < LEAST_GAIN_MARGIN
        ]
        if self.coupled_radius is not None and not self.coupled_radius < 1.0:
            found.append(f"all joints together are unstable (spectral radius {self.coupled_radius:.4f})")
        return found


def delay_of(config: ArmConfig) -> int:
    """Return the cycles from a sample to the torque that is computed from it: as the driver states, at least 1."""
    return max(1, config.delay_cycles)


def stability(
    model: ArmModel, limits: MotionLimits, delay_cycles: int = 1, postures: Vector | None = None
) -> StabilityReport:
    """Return spectral radius and margins of each joint over a range of inertias, and of all joints at some postures.

    Args:
        model: model; without a prior, only each joint by itself is judged.
        limits: limits with the gains, and the position limits for postures where none are given.
        delay_cycles: delay from a sample to the torque computed from it [cycles]; 1 is the Arm contract's.
        postures: postures in which the coupled loop is judged [rad or m], shape (samples, joints), of a motion for
            example; by default home, the middle of the position limits and a few random ones.

    Raises:
        UsageError: a delay below one cycle.
        ModelError: a model that no real body has.
    """
    if delay_cycles < 1:
        raise UsageError(f"{delay_cycles=}, but no torque can act before it is computed")
    control = model.config.control
    cutoff = np.broadcast_to(np.asarray(control.velocity_cutoff, dtype=float), limits.kp.shape)
    loop = Loop(limits.kp, limits.kd, 1.0 / control.rate, cutoff, float(delay_cycles))
    some = _postures(limits) if postures is None else postures
    lightest, unknown = _lightest_and_unknown(model)
    own_lightest = lightest
    used = control_model(model)
    if used.prior is not None and model.prior is not None:
        own, whole = (np.einsum("skk->sk", _mass_matrices(model, one, some)) for one in (model.prior, used.prior))
        # Where a joint's links are heaviest, its drives help least.
        own_lightest = ((lightest * own + whole - own) / whole).min(axis=0)
    joints = tuple(
        _joint(name, _single_joint_loop(loop, k), float(own_lightest[k]), float(INERTIA[1] + unknown[k]))
        for k, name in enumerate(model.chain.names)
    )
    coupled: float | None = None
    if used.prior is not None and model.prior is not None:
        coupled = max(
            float(spectral_radius(loop, R).max())
            for R in _ratios(model, model.prior, used.prior, some, lightest, unknown)
        )
    return StabilityReport(loop.period, delay_cycles, joints, coupled)


def transition_matrix(loop: Loop, inertia_ratio: Vector) -> Vector:
    """Return the matrix of the closed loop's linear recursion from cycle to cycle; its eigenvalues show stability.

    Args:
        loop: loop with gains, rate and delay.
        inertia_ratio: `R = M_true^-1 M_model`, shape (..., joints, joints).

    Returns:
        Shape (..., size, size), size = joints * (4 + queued torques).
    """
    n, h, g = len(loop.kp), loop.period, loop.filter_gain
    whole = int(np.floor(loop.delay + _ROUNDING))
    late = max(loop.delay - whole, 0.0)  # share of the period in which the older torque still acts
    queued = whole + (1 if late > 0.0 else 0)
    eye = np.eye(n)

    def at(block: int) -> slice:
        return slice(block * n, (block + 1) * n)

    q, dq, before, filtered = at(0), at(1), at(2), at(3)
    A = np.zeros((*inertia_ratio.shape[:-2], (4 + queued) * n, (4 + queued) * n))
    A[..., q, q] = A[..., dq, dq] = A[..., before, q] = eye
    A[..., q, dq] = h * eye
    older, newer = (at(4), at(5)) if late > 0.0 else (at(4), at(4))
    A[..., q, older] += h * h * (late - 0.5 * late**2) * inertia_ratio
    A[..., dq, older] += h * late * inertia_ratio
    A[..., q, newer] += h * h * 0.5 * (1.0 - late) ** 2 * inertia_ratio
    A[..., dq, newer] += h * (1.0 - late) * inertia_ratio
    A[..., filtered, q] = np.diag(g / h)
    A[..., filtered, before] = -np.diag(g / h)
    A[..., filtered, filtered] = np.diag(1.0 - g)
    for place in range(queued - 1):
        A[..., at(4 + place), at(5 + place)] = eye
    last = at(3 + queued)
    A[..., last, q] = -np.diag(loop.kp + loop.kd * g / h)
    A[..., last, before] = np.diag(loop.kd * g / h)
    A[..., last, filtered] = -np.diag(loop.kd * (1.0 - g))
    return A


def spectral_radius(loop: Loop, inertia_ratio: Vector) -> Vector:
    """Return the spectral radius of the loop's recursion, (...,), below 1 if stable, for `inertia_ratio`."""
    return np.asarray(np.abs(np.linalg.eigvals(transition_matrix(loop, inertia_ratio))).max(axis=-1))


def _single_joint_loop(loop: Loop, joint: int) -> Loop:
    kept = slice(joint, joint + 1)
    cutoff = np.broadcast_to(np.asarray(loop.cutoff), loop.kp.shape)
    return Loop(loop.kp[kept], loop.kd[kept], loop.period, cutoff[kept], loop.delay)


def _joint(name: str, loop: Loop, least: float, most: float) -> JointStability:
    factors = np.geomspace(least, most, 16)
    radius = float(spectral_radius(loop, (1.0 / factors)[:, None, None]).max())
    gains = np.geomspace(1.0, _MOST_GAIN, 64)
    gain = _first(gains, lambda some: spectral_radius(loop, some[:, None, None]))
    extra = np.linspace(0.0, _MOST_DELAY, 101)
    delay = _first(extra, lambda some: np.array([_delayed(loop, float(more)) for more in some]))
    return JointStability(name, least, radius, gain, delay * loop.period)


def _delayed(loop: Loop, more: float) -> float:
    later = Loop(loop.kp, loop.kd, loop.period, loop.cutoff, loop.delay + more)
    return float(spectral_radius(later, np.ones((1, 1))))


def _first(values: Vector, radii: Callable[[Vector], Vector]) -> float:
    """Return the smallest value at which a radius reaches 1, refined; the first value where it does at once."""
    low = float(values[0])
    for high in values.tolist():
        if not float(radii(np.array([high]))[0]) < 1.0:
            break
        low = high
    else:
        return low
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if float(radii(np.array([middle]))[0]) < 1.0 else (low, middle)
    return low


def _lightest_and_unknown(model: ArmModel) -> tuple[Vector, Vector]:
    """Return the least share of the prior that may be true, and the share of drive inertia that the model may lack.

    Each of shape (joints,).
    """
    n = model.chain.joints
    used = control_model(model).prior
    if used is None:
        return np.full(n, INERTIA[0]), np.full(n, UNKNOWN_DRIVE)
    known = np.diag(drive_matrix(model, used)) > 0.0
    return np.where(known, INERTIA[0], 1.0), np.where(known, KNOWN_DRIVE, UNKNOWN_DRIVE)


def drive_matrix(model: ArmModel, delta: Vector) -> Vector:
    """Return the drives' part of the mass matrix by link parameters `delta`, shape (joints, joints)."""
    coupling = model.chain.coupling
    return np.asarray(coupling.T @ (model.layout.term_values("drive_inertia", delta)[:, None] * coupling))


def known_drive_inertia(model: ArmModel) -> Vector:
    """Return drive inertia that the description states beyond the prior's [kg m^2 or kg], (joints,); 0 if no prior."""
    joints = [model.config.joints.get(name) for name in model.chain.names]
    said = np.array([0.0 if joint is None else joint.drive_inertia or 0.0 for joint in joints])
    if model.prior is None:
        return 0.0 * said
    return np.asarray(np.maximum(said - np.diag(drive_matrix(model, model.prior)), 0.0))


def _postures(limits: MotionLimits) -> Vector:
    random = np.random.default_rng(_SEED).uniform(limits.lower, limits.upper, (_RANDOM_POSTURES, len(limits.home)))
    return np.vstack([limits.home, 0.5 * (limits.lower + limits.upper), random])


def _link_factors(lightest: Vector) -> Iterator[Vector]:
    """Yield factors of the links' inertias: as modelled, all extreme, one extreme, random; each shape (joints,)."""
    heaviest = np.full_like(lightest, INERTIA[1])
    rng = np.random.default_rng(_SEED)
    yield np.ones_like(lightest)
    for extreme in (lightest, heaviest):
        yield extreme
        for link, factor in enumerate(extreme):
            yield np.where(np.arange(len(lightest)) == link, factor, 1.0)
    for _ in range(_RANDOM_CASES):
        yield np.where(rng.random(len(lightest)) < 0.5, lightest, heaviest)


def _ratios(
    model: ArmModel, prior: Vector, used: Vector, postures: Vector, lightest: Vector, unknown: Vector
) -> Iterator[Vector]:
    """Yield `M_true^-1 M_model` at all postures, case by case, each of shape (samples, joints, joints)."""
    nominal = _mass_matrices(model, used, postures)
    own = np.einsum("skk->sk", nominal)
    stated = drive_matrix(model, used) - drive_matrix(model, prior)
    for factors in _link_factors(lightest):
        delta = np.array(prior, dtype=float)
        for link, factor in enumerate(factors):
            delta[model.layout.inertial(link)] *= factor
        rigid = _mass_matrices(model, delta, postures)
        for lacking in (0.0 * own, unknown * own):
            yield np.linalg.solve(rigid + stated + lacking[:, :, None] * np.eye(own.shape[1]), nominal)


def _mass_matrices(model: ArmModel, delta: Vector, postures: Vector) -> Vector:
    dynamics = InverseDynamics(model.chain, model.layout, delta)
    return np.array([dynamics.mass_matrix(posture) for posture in postures])
