"""Identify the torque constant of every motor jointly with the parameters of the arm, from a load that is known.

What is recorded of motor i is m_i, its current or count by the constant that it is said to have; it really gives
kappa_i m_i. With tau = C^T diag(r) tau_motor, rows of the regressor of motors are H = (C^T diag(r))^-1 H_b, and

    m_i = g_i (H_i beta + y_i) + noise,    g_i = 1 / kappa_i,

y_i being the torque of the known payload at that motor. Without payload beta s and g / s explain the same torques for
every s, so that one recording at least has one; any other, with another load or none, says more.

Noise is in m_i. The form that is linear in both, kappa_i m_i - H_i beta = y_i, has it in its regressor, and would draw
all kappa_i towards zero (errors in variables; Gautier and Briot 2014 take total least squares). So the bilinear
equations are solved by Gauss-Newton, on the triangular factors of the motors' columns; each step minimises |r - J step|
with J = [g_i H_i, H_i beta + y_i]. Motors are weighted by their residuals, as joints are.

Where the estimate is not feasible, the same linearised least squares is solved inside the feasible set, and linearised
anew where it ends. The covariance of both together is that of the linearised equations, from blocks (`uncertainty.py`).
Parameters that are estimated with the constants taken for known lack what these are uncertain by: to first order
beta follows by d beta / d kappa, and both parts of its uncertainty are independent, as those of any least squares are
whose unknowns are eliminated one group after the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ident_service.errors import ModelError, UsageError
from ident_service.estimation.equations import (
    Equations,
    Rows,
    equation_rows,
    equations_of,
    known_torque,
    motors_of_torques,
)
from ident_service.estimation.feasible.feasible_set import FeasibleSet
from ident_service.estimation.feasible.problems import feasibility_test
from ident_service.estimation.feasible.torque_scales import feasible_with_factors
from ident_service.estimation.least_squares import LeastSquares, ordinary_least_squares, unit_columns
from ident_service.estimation.shape_uncertainty import ShapeUncertainty
from ident_service.estimation.uncertainty import IDENTIFIED_BELOW, Verdict, uncertainty
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.blas_threads import one_blas_thread
from ident_service.model.chain import Array
from ident_service.model.information import Information, sparsity
from ident_service.recordings.cached_recording import payload_of
from ident_service.recordings.recording import Recording

MOST_DEVIATION = 0.25  # sources of a puck's IPNM differ by that much: what is not known better is not known
_FACTORS = 0.2, 5.0  # of g; beyond, some unit is mistaken
_ROUNDS, _HALVINGS, _SETTLED = 60, 12, 1e-9
_FEASIBLE_ROUNDS, _FEASIBLE_SETTLED = 8, 1e-4
_RANK_TOLERANCE = 1e-10


@dataclass(frozen=True)
class TorqueConstants:
    """Factors of the motors' recorded torques, with what base parameters owe to their uncertainty.

    Attributes:
        factors: kappa, what the recorded torque of each motor is multiplied by, shape (motors,); 1 where the recordings
            do not show it.
        deviations: standard deviations of the factors on the careful side, shape (motors,); infinite where not shown.
        verdicts: of each motor's factor.
        covariance: of the factors that are shown, zero for the others, shape (motors, motors).
        degrees: degrees of freedom of the deviations, shape (motors,).
        follow: d beta / d kappa, shape (base, motors).
        error_percent: relative difference of the motors' torques from the explained ones (eq. 84) [percent].
        error_before: the same with all factors at 1 [percent].
        applied: factors that the description had already applied to recorded torques, shape (motors,).
    """

    factors: Array
    deviations: Array
    verdicts: tuple[Verdict, ...]
    covariance: Array
    degrees: Array
    follow: Array
    error_percent: float
    error_before: float
    applied: Array

    def of(self, model: ArmModel) -> ArmModel:
        """Return the arm with these factors of recorded motor torques, multiplied by those it was described with."""
        return model.with_options(torque_factors=tuple((self.applied * self.factors).tolist()))

    def uncertainty(self) -> ShapeUncertainty:
        """Return the covariance that the factors' uncertainty adds to base parameters that take them for known."""
        added = self.follow @ self.covariance @ self.follow.T
        shown = np.isfinite(self.deviations)
        degrees = np.full(len(added), np.min(self.degrees[shown], initial=np.inf))
        return ShapeUncertainty(0.5 * (added + added.T), degrees, np.full(len(added), np.inf))


@one_blas_thread()
def identify_torque_constants(
    recordings: Sequence[Recording], model: ArmModel, base: BaseParameters, conditions: FeasibleSet | None
) -> TorqueConstants:
    """Fit a torque factor per motor together with base parameters, from a known payload; raises UsageError without.

    Args:
        recordings: recordings with the payloads that they carry (`CachedRecording.payload`), one at least.
        model: the arm, the shape of its friction and the delay as numbers.
        base: grouping of its parameters.
        conditions: the set that parameters must lie in; None for none.

    Raises:
        UsageError: as `require_known_load`.
        RecordingError: a recording cannot be used.
        ModelError: the search does not settle.
        SolverError: the solver stopped without an optimum.
    """
    require_known_load(recordings, model)
    gathered = _motor_equations(recordings, model, base)
    total, motors = gathered.total, model.chain.joints
    everything = _solved(total, base.size, np.ones(motors, dtype=bool))
    found, degrees = _deviations(gathered, everything)
    free = found * everything.factors < MOST_DEVIATION  # of g, so that the share counts
    held = everything if free.all() else _solved(total, base.size, free)
    start = _inside(total, held, base, conditions)
    again, degrees_again = (found, degrees) if free.all() else _deviations(gathered, held)
    kappa = start.factors
    # What is held does not make the others better known than they were with it.
    deviations = np.where(free, np.maximum(found, again) * kappa**2, np.inf)
    covariance, follow = _covariance(gathered, replace(start, free=free), deviations)
    error, before = (_error(total, one) for one in (start, _at_one(total, base.size, motors)))
    verdicts: tuple[Verdict, ...] = tuple(
        "unidentified" if not shown else "identified" if deviation < IDENTIFIED_BELOW else "weak"
        for shown, deviation in zip(free, deviations / kappa, strict=True)
    )
    told = model.config.identification.torque_factors
    applied = np.ones(motors) if told is None else np.array(told)
    return TorqueConstants(
        kappa, deviations, verdicts, covariance, np.minimum(degrees, degrees_again), follow, error, before, applied
    )


def require_known_load(recordings: Sequence[Recording], model: ArmModel) -> None:
    """Raise UsageError unless a recording has a known payload and no bounds on torque constants are described.

    Raises:
        UsageError: says what to do.
    """
    if not any(payload_of(one) for one in recordings):
        raise UsageError(
            "torque constants cannot be told from masses without a load that is known: record the motion with one, and "
            "add --payload RECORDING=FILE"
        )
    if model.config.constraints.torque_constant:
        raise UsageError(
            f"{model.config.name}: constraints.torque_constant bounds what is to be identified; leave one out"
        )


def _motor_equations(recordings: Sequence[Recording], model: ArmModel, base: BaseParameters) -> Equations:
    """Gather the equations of motors, the payload's torque as one more column."""
    to_motors = motors_of_torques(model)
    own = sparsity(model.chain, model.layout, base.base)
    joints_of = [np.flatnonzero(row) for row in to_motors]
    felt = tuple(
        np.append(np.unique(np.concatenate([own[joint] for joint in joints])), base.size) for joints in joints_of
    )

    def rows_of(recording: Recording) -> Iterator[Rows]:
        for rows in equation_rows(recording, model, base):
            carried = known_torque(recording, model, base, rows)
            load = np.zeros_like(rows.torque) if carried is None else carried
            H = np.empty((len(to_motors), base.size + 1, len(rows.time)))
            keep = np.empty_like(rows.keep)
            for motor, joints in enumerate(joints_of):
                H[motor, :-1] = np.einsum("j,jbs->bs", to_motors[motor, joints], rows.H_b[joints])
                H[motor, -1] = load[:, joints] @ to_motors[motor, joints]
                keep[:, motor] = rows.keep[:, joints].all(axis=1)
            yield replace(rows, H_b=H, torque=(rows.torque + load) @ to_motors.T, keep=keep)

    found = equations_of(recordings, model, felt, rows_of)
    # Where the motion reverses too often for any rows in motion, all rows count.
    return found if found.total.rows.all() else found.with_standstill_rows(np.ones(len(to_motors)))


@dataclass(frozen=True)
class _Point:
    """Parameters and gains at which the equations are linearised.

    Attributes:
        beta: base parameters, shape (base,).
        gains: g, shape (motors,).
        free: mask of the gains that are sought, shape (motors,).
    """

    beta: Array
    gains: Array
    free: NDArray[np.bool_]

    @property
    def factors(self) -> Array:
        """Return kappa, shape (motors,)."""
        return np.asarray(1.0 / self.gains)

    def residuals(self, total: Information) -> Array:
        """Return the root mean square of each motor's residual [N m or N], shape (motors,)."""
        rest = [
            float(np.sum(_explained(factor, support, self.beta, gain)[1] ** 2))
            for support, factor, gain in zip(total.supports, total.factors, self.gains, strict=True)
        ]
        floor = 1e-9 * np.sqrt(total.squared_torques() / np.maximum(total.rows, 1))
        return np.maximum(np.sqrt(np.array(rest) / np.maximum(total.rows, 1)), floor)

    def moved(self, step: Array, share: float) -> _Point:
        """Return the point a share of a step further; no gain changes by more than a factor of two."""
        gains = np.clip(self.gains + share * step[len(self.beta) :], 0.5 * self.gains, 2.0 * self.gains)
        return replace(self, beta=self.beta + share * step[: len(self.beta)], gains=np.clip(gains, *_FACTORS))


def _explained(factor: Array, support: NDArray[np.intp], beta: Array, gain: float) -> tuple[Array, Array]:
    """Return H beta + y of a motor, and what is left of its torque."""
    torque = factor[:, :-2] @ beta[support[:-1]] + factor[:, -2]
    return torque, factor[:, -1] - gain * torque


def _linearised(information: Information, point: _Point) -> Information:
    """Return equations of the step from a point: columns of the base parameters, of the gains, and the residual."""
    size = len(point.beta)
    supports, factors = [], []
    for motor, (support, factor) in enumerate(zip(information.supports, information.factors, strict=True)):
        torque, rest = _explained(factor, support, point.beta, point.gains[motor])
        of_gain = torque if point.free[motor] else np.zeros_like(torque)
        factors.append(np.column_stack([point.gains[motor] * factor[:, :-2], of_gain, rest]))
        supports.append(np.append(support[:-1], size + motor))
    return Information(tuple(supports), tuple(factors), information.rows.copy(), size + len(factors))


def _weights(total: Information, point: _Point) -> Array:
    rest = point.residuals(total)
    return np.asarray(np.exp(np.mean(np.log(rest))) / rest)


def _at_one(total: Information, size: int, motors: int) -> _Point:
    """Return the least squares with all factors at 1."""
    point = _Point(np.zeros(size), np.ones(motors), np.zeros(motors, dtype=bool))
    for _ in range(2):  # the second time with the motors' weights
        step = ordinary_least_squares(_linearised(total, point), _weights(total, point))
        point = point.moved(step.beta, 1.0)
    return point


def _solved(total: Information, size: int, free: NDArray[np.bool_]) -> _Point:
    """Minimise the product of the motors' residuals; raises ModelError where that does not settle."""
    point = replace(_at_one(total, size, len(free)), free=free)

    def cost(one: _Point) -> float:
        return float(total.rows @ np.log(one.residuals(total)) / total.rows.sum())

    present = cost(point)
    for _ in range(_ROUNDS):
        step = ordinary_least_squares(_linearised(total, point), _weights(total, point)).beta
        tried = ((point.moved(step, 0.5**halving)) for halving in range(_HALVINGS))
        better = next(((one, value) for one in tried if (value := cost(one)) < present), None)
        if better is None or present - better[1] < _SETTLED:
            return point if better is None else better[0]
        point, present = better
    raise ModelError(f"torque constants do not settle in {_ROUNDS} rounds; record a motion that shows more of the load")


def _inside(total: Information, free: _Point, base: BaseParameters, conditions: FeasibleSet | None) -> _Point:
    """Return the point inside the feasible set that explains the torques best, linearised where it lies."""
    if conditions is None or feasibility_test(free.beta, base, conditions).feasible:
        return free
    weights, point, size = _weights(total, free), free, len(free.beta)
    sought = np.flatnonzero(free.free)
    bounds = np.full(len(sought), _FACTORS[0]), np.full(len(sought), _FACTORS[1])
    for _ in range(_FEASIBLE_ROUNDS):
        stacked = _linearised(total, point).stacked(weights)
        J = stacked[:, np.concatenate([np.arange(size), size + sought])]
        rest = stacked[:, -1] + J @ np.concatenate([point.beta, point.gains[sought]])
        found, gains = feasible_with_factors(np.column_stack([J, -rest]), base, conditions, free.beta, bounds)
        before = point.gains
        moved = before.copy()
        moved[sought] = gains
        point = replace(point, beta=found.beta, gains=moved)
        if np.abs(moved / before - 1.0).max() < _FEASIBLE_SETTLED:
            break
    return point


def _linear_fit(gathered: Equations, point: _Point) -> tuple[Equations, LeastSquares]:
    total = gathered.total
    blocks = tuple(_linearised(block, point) for block in gathered.blocks)
    fit = ordinary_least_squares(_linearised(total, point), _weights(total, point))
    return replace(gathered, blocks=blocks, near=()), fit


def _deviations(gathered: Equations, point: _Point) -> tuple[Array, Array]:
    """Return the standard deviations of the gains and their degrees of freedom, shape (motors,) each."""
    found = uncertainty(*_linear_fit(gathered, point))
    size = len(point.beta)
    return found.deviations[size:], found.degrees[size:]


def _covariance(gathered: Equations, point: _Point, deviations: Array) -> tuple[Array, Array]:
    """Return the covariance of the factors with these deviations, and what base parameters follow them by."""
    equations, fit = _linear_fit(gathered, point)
    size, motors, free = len(point.beta), len(point.gains), point.free
    covariance, follow = np.zeros((motors, motors)), np.zeros((size, motors))
    if not free.any():
        return covariance, follow
    sought = size + np.flatnonzero(free)
    part = uncertainty(equations, fit).covariance[np.ix_(sought, sought)]
    told = np.sqrt(np.diag(part))
    correlation = part / np.outer(told, told)
    covariance[np.ix_(free, free)] = correlation * np.outer(deviations[free], deviations[free])
    W, D = fit.R1[:, :size], fit.R1[:, sought]
    scale, _ = unit_columns(W)
    by_gain = -np.linalg.lstsq(W / scale, D, rcond=_RANK_TOLERANCE)[0] / scale[:, None]
    follow[:, free] = -by_gain * point.gains[free] ** 2
    return covariance, follow


def _error(total: Information, point: _Point) -> float:
    """Return the relative error of the motors' torques [percent], each motor's as a share of its own."""
    squared = total.squared_torques() / np.maximum(total.rows, 1)
    shares = point.residuals(total) ** 2 / np.maximum(squared, np.finfo(float).tiny)
    return 100.0 * float(np.sqrt(np.mean(shares)))
