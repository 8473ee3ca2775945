"""State the design of a motion as an optimisation problem: task, information criterion, objective and limits.

All are logarithms and all are to be made small; `G = sum_s H_b' H_b`, rows whitened where the criterion asks for it.

    d_optimal          -log det(G) / n                     the volume of the confidence ellipsoid
    a_optimal          log of the mean of (G^-1)_ii / s_i^2, chosen parameters only: variances in units of s_i^2
    condition_number   log(largest / smallest singular value of the stacked regressor), by power means of the
                       eigenvalues of G, which have gradients where the extremes cross: sharper with a larger exponent

Variables are the coefficients of the basis, scaled to about one. Every limit is a number that must not be positive, in
shares of the limit. They enter the objective as an augmented Lagrangian (Hestenes 1969, Powell 1969),

    f(x) + 1/2 sum (max(0, rho c(x) + lambda)^2 - lambda^2) / rho

so that one sweep forwards and one backwards through the regressor give value and gradient, whatever the number of
limits. What holds between the samples is proven afterwards (`limit_proof.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ident_service.config.motion_design import Criterion, Design
from ident_service.config.motion_limits import MotionLimits
from ident_service.errors import MotionRefused
from ident_service.excitation.prediction import (
    TOLERATED,
    USABLE,
    FollowingError,
    dry_friction,
    rate_of_change,
    uncompensated_friction,
)
from ident_service.excitation.trajectory import Basis, basis_values
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import base_parameters
from ident_service.model.capsule_distances import CapsuleModel
from ident_service.model.chain import Array
from ident_service.model.expected_friction import ExpectedFriction
from ident_service.model.regressor import RegressorGradient


@dataclass(frozen=True)
class Task:
    """Complete input of a search.

    Attributes:
        model: model with the prior parameters that torque is predicted from.
        columns: columns of delta that belong to the parameters that the motion shall teach, shape (base,).
        basis: the family of motions.
        limits: limits of the motion, margins taken off.
        criterion: criterion to be minimised.
        chosen: indices into `columns`, for `a_optimal`; all when None.
        scale: unit of each parameter's deviation, for `a_optimal`, shape (base,).
        noise: standard deviation of each joint's torque [N m or N], shape (joints,); rows are whitened by it. Ones for
            the condition number, which is the paper's, of the plain rows.
        friction: friction of the drives that makes the arm fall behind; not looked at when None.
        rate: samples per second that will be recorded [Hz].
        added: information from earlier recordings, whitened alike, shape (base, base), or None.
        extra_clearance: distance kept free beyond the workspace's clearance while the motion lasts [m].
    """

    model: ArmModel
    columns: NDArray[np.intp]
    basis: Basis
    limits: MotionLimits
    criterion: Criterion
    chosen: NDArray[np.intp] | None
    scale: Array | None
    noise: Array
    friction: ExpectedFriction | None
    rate: float
    added: Array | None = None
    extra_clearance: float = 0.0


def usable_limits(joint_names: tuple[str, ...], limits: MotionLimits, design: Design) -> MotionLimits:
    """Return the limits less the design's margins of position and torque; raises if no range is left.

    Raises:
        MotionRefused: nothing is left of a position range.
    """
    margin = np.broadcast_to(np.asarray(design.position_margin, dtype=float), limits.lower.shape)
    lower, upper = limits.lower + margin, limits.upper - margin
    if gone := [
        f"{name}: {low:g}..{high:g} less {m:g} on either side"
        for name, low, high, m, left in zip(joint_names, limits.lower, limits.upper, margin, upper - lower, strict=True)
        if left <= 0.0
    ]:
        raise MotionRefused("the position margin leaves nothing of the range of " + "; ".join(gone))
    left = 1.0 - design.torque_margin
    motors = None if limits.motors is None else replace(limits.motors, torque=left * limits.motors.torque)
    return replace(limits, lower=lower, upper=upper, torque=limits.torque * left, motors=motors)


_FLOOR = 1e-13  # of the largest eigenvalue: below it an eigenvalue is rounding noise
_NOTHING = 1e-100  # a largest eigenvalue that is no information at all, and still has an inverse


@dataclass(frozen=True)
class Value:
    """Value and gradient of a criterion at one information matrix.

    Attributes:
        value: value of the criterion, to be minimised.
        gradient: symmetric, shape (base, base): the value changes by `sum(gradient * dG)`.
    """

    value: float
    gradient: Array


def criterion(
    kind: Criterion,
    G: Array,
    sharpness: float = 16.0,
    chosen_indices: NDArray[np.intp] | None = None,
    parameter_scales: Array | None = None,
) -> Value:
    """Return a criterion's value (smaller is better) and its gradient over the information matrix G.

    Args:
        kind: kind of criterion.
        G: information matrix, shape (base, base).
        sharpness: exponent of the condition number's power means.
        chosen_indices: indices of the parameters, for `a_optimal`; all when None.
        parameter_scales: unit of each parameter's deviation, for `a_optimal`, shape (base,).
    """
    eigenvalues, V = np.linalg.eigh(G)
    eigenvalues = np.maximum(eigenvalues, _FLOOR * max(float(eigenvalues[-1]), _NOTHING))
    n = len(eigenvalues)
    if kind == "d_optimal":
        return Value(-float(np.log(eigenvalues).sum()) / n, -(V / (n * eigenvalues)) @ V.T)
    if kind == "a_optimal":
        pick = np.arange(n) if chosen_indices is None else chosen_indices
        weights = np.zeros(n)
        weights[pick] = 1.0 if parameter_scales is None else 1.0 / parameter_scales[pick] ** 2
        weights /= len(pick)
        inverse = (V / eigenvalues) @ V.T
        mean = float(weights @ np.diag(inverse))
        return Value(float(np.log(mean)), -(inverse * weights) @ inverse / mean)
    top, bottom = eigenvalues[-1], eigenvalues[0]
    high, low = (eigenvalues / top) ** sharpness, (eigenvalues / bottom) ** -sharpness
    value = np.log(high.sum()) / sharpness + np.log(top) + np.log(low.sum()) / sharpness - np.log(bottom)
    slope = (high / high.sum() - low / low.sum()) / eigenvalues
    return Value(0.5 * float(value), 0.5 * (V * slope) @ V.T)


def condition_number(G: Array) -> float:
    """Return the condition number, the root of G's eigenvalue ratio; infinite where G is singular."""
    eigenvalues = np.linalg.eigvalsh(G)
    return float(np.sqrt(eigenvalues[-1] / eigenvalues[0])) if eigenvalues[0] > 0.0 else float("inf")


_RESERVE = 0.004  # of every limit, for what happens between two samples
# Likewise for the forecast of the following error, which is static: the arm itself takes its time to settle.
_TURNING = 0.5
_CREEP = 0.05  # share of the velocity limit over which friction reverses, which gives its direction a gradient
_DEPTH = 0.05  # m; a clearance missed by so much counts like another limit missed altogether
_BETWEEN = 0.02  # m, the most that is kept free for what happens between two samples; the proof mends the rest
_LINE = 25  # points on the way from home to where the motion begins
_INSIDE = 0.0005  # linear conditions are tighter than the limits by this, so that rounding leaves none exceeded
Limits = dict[str, Array]
Peak = tuple[int, int, int, bool]  # order of the derivative, sample, joint, and whether its upper limit is near
LINEAR = ("position", "velocity", "acceleration", "jerk")  # limits that are linear in the variables


@dataclass
class Multipliers:
    """State of the augmented Lagrangian: one multiplier per limit and sample, and the weight of violations."""

    values: Limits
    weight: float

    def tightened(self, excesses: Limits, weight_factor: float) -> Multipliers:
        """Return multipliers and weight (times `weight_factor`) after a minimisation that left these `excesses`."""
        values = {name: np.maximum(0.0, self.values[name] + self.weight * c) for name, c in excesses.items()}
        return Multipliers(values, self.weight * weight_factor)


@dataclass(frozen=True)
class State:
    """Criterion and limits at one point of the search.

    Attributes:
        coefficients: of the basis, shape (joints, size).
        criterion: value of the criterion, and gradient with respect to the information.
        limits: excess over each limit as a share of it, by name; not positive where the limit is kept.
    """

    coefficients: Array
    criterion: Value
    limits: Limits

    @property
    def worst(self) -> float:
        """Return the largest relative excess over a limit, 0.1 for 10 % above; not positive where all are kept."""
        return max(float(values.max()) for values in self.limits.values() if values.size)


class Problem:
    """Optimisation problem of one search on one time grid."""

    def __init__(self, task: Task, samples_per_period: int) -> None:
        """Prepare the time grid.

        Args:
            task: task of the search.
            samples_per_period: samples per period.
        """
        self.task = task
        model, limits = task.model, task.limits
        self._n = model.chain.joints
        self._regressor = RegressorGradient(model.chain, model.layout, task.columns)
        times, weights = task.basis.samples(samples_per_period)
        self._maps = basis_values(task.basis, times)
        self._weights = weights * task.rate
        self._middle, self._half = 0.5 * (limits.lower + limits.upper), 0.5 * (limits.upper - limits.lower)
        sizes = [np.maximum(np.abs(values).max(axis=0), 1e-12) for values in self._maps[:2]]
        reach = np.minimum(self._half[:, None] / sizes[0], limits.velocity[:, None] / sizes[1])
        self._scale = np.where(task.basis.moving, reach, self._half[:, None])
        self._offset = task.basis.standing(self._middle)
        self._creep = _CREEP * limits.velocity
        self._torque_parameters()
        self._following: FollowingError | None = None
        if task.friction is not None and model.prior is not None:
            unknown = uncompensated_friction(task.friction, model.config.control.friction_feedforward)
            self._following = FollowingError(model, limits, unknown, _TURNING * limits.velocity)
            self._allowed = USABLE * limits.following_error
            self._rate_of = rate_of_change(times)
        self._capsules = CapsuleModel(model)
        step = float(np.median(np.diff(times)))
        # Departure of a point, a metre from an axis, from the straight line between two samples.
        between = min(0.125 * float(limits.acceleration.max()) * step**2, _BETWEEN)
        self._clearance = np.full(len(times) + _LINE, model.config.workspace.clearance + between)
        self._clearance[: len(times)] += task.extra_clearance
        # The straight way from home to where the motion begins, for which only clearance matters.
        self._line = np.linspace(0.0, 1.0, _LINE)[:, None]
        self._begin = basis_values(task.basis, np.zeros(1))[0]
        self.names = list(LINEAR)
        self.names += ["torque"] * (model.prior is not None) + ["motor torque"] * (self._motors is not None)
        self.names += ["power"] * (self._supply is not None)
        self.names += ["following error", "forecast speed"] * (self._following is not None)
        self.names += ["clearance"] * bool(self._capsules.pairs)

    def _torque_parameters(self) -> None:
        """Compute base parameters without dry friction, which has no slope and is taken off the limits instead."""
        model = self.task.model
        self._beta = np.zeros(len(self.task.columns))
        self._torque_limit = self.task.limits.torque.copy()
        self._supply = model.config.supply if model.prior is not None else None
        self._motors = self.task.limits.motors if model.prior is not None else None
        self._torque_regressor = self._regressor
        if model.prior is None:
            return
        base = base_parameters(model.chain, model.layout)
        delta = model.prior.copy()
        self._dry, at_joints = dry_friction(model, delta)
        self._torque_limit = self._torque_limit - at_joints
        if self._motors is not None:
            friction = np.abs(self._motors.to_motors @ model.chain.coupling.T) @ self._dry
            self._motor_limit = self._motors.torque - friction
        delta[model.layout.term_columns("coulomb")] = 0.0
        delta[model.layout.term_columns("stribeck")] = 0.0
        self._beta = base.K @ delta
        if not np.array_equal(base.base, self.task.columns):
            self._torque_regressor = RegressorGradient(model.chain, model.layout, base.base)
        self._to_drives = np.linalg.inv(model.chain.coupling)  # drive torques are C^-T tau, rows times C^-1

    @property
    def size(self) -> int:
        """Return the number of variables."""
        return self._scale.size

    def coefficients(self, x: Array) -> Array:
        """Return the motion's coefficients, shape (joints, size), from the search variables, shape (size,)."""
        return np.asarray(self._offset + x.reshape(self._scale.shape) * self._scale)

    def variables(self, coefficients: Array) -> Array:
        """Return the search variables of a motion's coefficients, the inverse of `coefficients`."""
        return np.asarray(((coefficients - self._offset) / self._scale).ravel())

    def no_multipliers(self, penalty_weight: float) -> Multipliers:
        """Return multipliers that are all zero, with this penalty weight."""
        samples = len(self._weights)
        shapes = {"power": (samples, 1), "clearance": (samples + _LINE, len(self._capsules.pairs))}
        return Multipliers(
            {name: np.zeros(shapes.get(name, (samples, self._n))) for name in self.names}, penalty_weight
        )

    def linear_peaks(self, x: Array, share: float) -> set[Peak]:
        """Return local peaks above a share of limits linear in x, with neighbours: (kind, sample, joint, upper side).

        Args:
            x: variables, shape (size,).
            share: least share of a limit that counts.
        """
        X = self.coefficients(x)
        found: set[Peak] = set()
        for order, (values, middle, limit) in enumerate(self._linear()):
            used = (values @ X.T - middle) / limit
            size = np.abs(used)
            peak = (size >= np.roll(size, 1, axis=0)) & (size >= np.roll(size, -1, axis=0)) & (size > share)
            peak |= np.roll(peak, 1, axis=0) | np.roll(peak, -1, axis=0)
            found |= {(order, sample, joint, bool(used[sample, joint] > 0.0)) for sample, joint in np.argwhere(peak)}
        return found

    def linear_rows(self, peaks: Sequence[Peak]) -> tuple[Array, Array]:
        """Return A and b of the conditions `A x <= b` that keep the limits at peaks, shapes (peaks, size), (peaks,)."""
        A, b = np.zeros((len(peaks), *self._scale.shape)), np.zeros(len(peaks))
        linear = self._linear()
        for row, (order, sample, joint, above) in enumerate(peaks):
            values, middle, limit = linear[order]
            side = 1.0 if above else -1.0
            A[row, joint] = side * values[sample] * self._scale[joint] / limit[joint]
            at_zero = (values[sample] @ self._offset[joint] - middle[joint]) / limit[joint]
            b[row] = 1.0 - _RESERVE - _INSIDE - side * at_zero
        return A.reshape(len(peaks), self.size), b

    def _linear(self) -> tuple[tuple[Array, Array, Array], ...]:
        """Return maps of position and its derivatives, with middle and size of each allowed range, shape (joints,)."""
        limits, zero = self.task.limits, np.zeros(self._n)
        middles = (self._middle, zero, zero, zero)
        sizes = (self._half, limits.velocity, limits.acceleration, limits.jerk)
        return tuple(zip(self._maps, middles, sizes, strict=True))

    def speed_from_error(self, x: Array) -> Array:
        """Return speed added by correcting the following error, over the allowed; negative slows; (samples, joints)."""
        q, dq = (values @ self.coefficients(x).T for values in self._maps[:2])
        if self._following is None:
            return np.zeros_like(q)
        catching_up = -(self._rate_of @ self._following.run(q, dq))
        return np.asarray(catching_up * np.sign(dq + catching_up) / (TOLERATED * self.task.limits.velocity))

    def error_at_velocity_limit(self, x: Array) -> Array:
        """Return the largest predicted following error at the velocity limits [rad or m], shape (joints,).

        It is taken in all postures of the motion.
        """
        q, dq = (values @ self.coefficients(x).T for values in self._maps[:2])
        if self._following is None:
            return np.zeros(self._n)
        fastest = np.where(dq < 0.0, -1.0, 1.0) * self.task.limits.velocity
        return np.asarray(np.abs(self._following.run(q, fastest)).max(axis=0))

    def state(self, x: Array, sharpness: float) -> State:
        """Return the criterion's value and how far each limit is exceeded at x."""
        return self._evaluate(x, sharpness, None)[0]

    def value_and_gradient(self, x: Array, sharpness: float, multipliers: Multipliers) -> tuple[float, Array]:
        """Return the augmented Lagrangian and its gradient, shape (size,)."""
        _, value, gradient = self._evaluate(x, sharpness, multipliers)
        return value, gradient

    def _evaluate(self, x: Array, sharpness: float, multipliers: Multipliers | None) -> tuple[State, float, Array]:
        task, X = self.task, self.coefficients(x)
        q, dq, ddq, jerk = (values @ X.T for values in self._maps)
        direction = np.tanh(dq @ task.model.chain.coupling.T / self._creep)
        H = self._regressor.run(q, dq, ddq, direction)
        G = np.zeros((H.shape[1], H.shape[1]))
        counted = self._weights > 0.0
        roots = np.sqrt(self._weights[counted])
        for rows, felt, noise in zip(H, self._regressor.supports, task.noise, strict=True):
            seen = rows[felt][:, counted] * roots if not counted.all() else rows[felt] * roots
            G[np.ix_(felt, felt)] += seen @ seen.T / noise**2
        if task.added is not None:
            G += task.added
        value = criterion(task.criterion, G, sharpness, task.chosen, task.scale)
        T = H
        if self._torque_regressor is not self._regressor:
            T = self._torque_regressor.run(q, dq, ddq, direction)
        torque = np.stack([self._beta @ rows for rows in T], axis=1) if task.model.prior is not None else None
        limits = task.limits
        signed = {
            "position": (q - self._middle) / self._half,
            "velocity": dq / limits.velocity,
            "acceleration": ddq / limits.acceleration,
            "jerk": jerk / limits.jerk,
        }
        if torque is not None:
            signed["torque"] = torque / self._torque_limit
            if self._motors is not None:
                signed["motor torque"] = torque @ self._motors.to_motors.T / self._motor_limit
        if self._following is not None:
            behind = self._following.run(q, dq)
            signed["following error"] = behind / self._allowed
            signed["forecast speed"] = (dq - self._rate_of @ behind) / (TOLERATED * limits.velocity)
        found = {name: np.abs(share) - (1.0 - _RESERVE) for name, share in signed.items()}
        if torque is not None and self._supply is not None:
            found["power"], power_slopes = self._power(torque, dq)
        if self._capsules.pairs:
            way = limits.home + self._line * (self._begin @ X.T - limits.home)
            # Clearance is that of the arm, which lags behind its reference.
            where = q if self._following is None else q - behind
            found["clearance"] = (
                self._clearance[:, None] - self._capsules.distances(np.concatenate([where, way])).T
            ) / _DEPTH
        state = State(X, value, found)
        if multipliers is None:
            return state, value.value, np.zeros(0)
        rho = multipliers.weight
        forces = {name: np.maximum(0.0, rho * c + multipliers.values[name]) for name, c in found.items()}
        penalty = sum(
            float((forces[name] ** 2).sum() - (multipliers.values[name] ** 2).sum()) / (2.0 * rho) for name in found
        )
        pushes = {name: forces[name] * np.sign(share) for name, share in signed.items()}
        on_q = pushes["position"] / self._half
        on_dq = pushes["velocity"] / limits.velocity
        on_ddq = pushes["acceleration"] / limits.acceleration
        on_jerk = pushes["jerk"] / limits.jerk
        on_begin = np.zeros(self._n)
        on_behind = np.zeros_like(q)
        if "clearance" in found:
            by_posture = self._capsules.pull(-forces["clearance"].T / _DEPTH)
            on_q = on_q + by_posture[: len(q)]
            on_behind = -by_posture[: len(q)]
            on_begin = (self._line * by_posture[len(q) :]).sum(axis=0)
        if self._following is not None:
            on_speed = pushes["forecast speed"] / (TOLERATED * limits.velocity)
            on_behind = on_behind + pushes["following error"] / self._allowed - self._rate_of.T @ on_speed
            by_q, by_dq = self._following.pull(on_behind)
            on_q, on_dq = on_q + by_q, on_dq + by_dq + on_speed
        seeds = np.zeros_like(H)
        for k, (rows, felt, noise) in enumerate(zip(H, self._regressor.supports, task.noise, strict=True)):
            seeds[k, felt] = (2.0 / noise**2 * value.gradient[np.ix_(felt, felt)]) @ rows[felt] * self._weights
        if torque is not None:
            on_torque = pushes["torque"] / self._torque_limit
            if self._motors is not None:
                on_torque = on_torque + (pushes["motor torque"] / self._motor_limit) @ self._motors.to_motors
            if self._supply is not None:
                on_torque = on_torque + forces["power"] * power_slopes[0]
                on_dq = on_dq + forces["power"] * power_slopes[1]
            if T is H:
                for k, felt in enumerate(self._regressor.supports):
                    seeds[k, felt] += np.outer(self._beta[felt], on_torque[:, k])
            else:
                along = on_torque.T[:, None, :] * self._beta[None, :, None]
                by_q, by_dq, by_ddq, _ = self._torque_regressor.pull(along)
                on_q, on_dq, on_ddq = on_q + by_q, on_dq + by_dq, on_ddq + by_ddq
        by_q, by_dq, by_ddq, by_direction = self._regressor.pull(seeds)
        turning = (by_direction * (1.0 - direction**2) / self._creep) @ task.model.chain.coupling
        sources = (on_q + by_q, on_dq + by_dq + turning, on_ddq + by_ddq, on_jerk)
        gradient = np.outer(on_begin, self._begin[0])
        gradient += sum(source.T @ values for source, values in zip(sources, self._maps, strict=True))
        return state, value.value + penalty, (gradient * self._scale).ravel()

    def _power(self, torque: Array, velocity: Array) -> tuple[Array, tuple[Array, Array]]:
        """Return the power beyond the supply's budget, in shares of it, (samples, 1), and its slopes.

        The slopes are over torque and velocity.
        """
        supply = self._supply
        if supply is None:
            raise AssertionError("no supply")
        coupling = self.task.model.chain.coupling
        loss = np.broadcast_to(np.asarray(supply.loss, dtype=float), (self._n,))
        rate = velocity @ coupling.T
        rigid = torque @ self._to_drives
        effort = rigid + self._dry * np.tanh(rate / self._creep)
        drawn = effort * rate + loss * effort**2
        on = drawn > 0.0
        share = (supply.standby + np.where(on, drawn, 0.0).sum(axis=1)) / supply.budget
        by_effort = on * (rate + 2.0 * loss * effort) / supply.budget
        by_rate = on * effort / supply.budget
        by_rate = by_rate + by_effort * self._dry * (1.0 - np.tanh(rate / self._creep) ** 2) / self._creep
        return share[:, None] - (1.0 - _RESERVE), (by_effort @ self._to_drives.T, by_rate @ coupling)
