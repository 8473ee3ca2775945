"""Solve the feasibility test (BPFT, eq. 51), the correction (BPFC, eqs. 52-56) and constrained least squares.

All three look for delta, written as the pair (beta, delta_d) through the bijection of eqs. 42-49. Norms are
second-order cones: the Schur complements of eqs. 54 and 73 say the same with many more entries.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ident_service.errors import ParameterError, SolverError
from ident_service.estimation.feasible.conic import ConicProblem, Solution
from ident_service.estimation.feasible.feasible_set import FeasibleSet
from ident_service.estimation.feasible.formulation import (
    EPSILON,
    OF_ESTIMATES,
    OF_TABLES,
    OF_TESTS,
    ConditionsError,
    LinkParameterMap,
    active_constraints,
    constrain,
    insets,
    minimise,
    require_consistent,
    traces,
)
from ident_service.estimation.feasible.nearest import HARD, FeasibleEstimate, nearest
from ident_service.estimation.feasible.priors import Prior, solve_with_prior
from ident_service.estimation.feasible.torque_scales import constrained_least_squares_with_scales
from ident_service.estimation.least_squares import LeastSquares
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.chain import Array

ENOUGH = 1e-6  # tolerance of estimates that are compared by hundredths; their distances are right to five digits
_LARGEST_CONDITION = 1e13  # of the correlations, beyond which their inverse is rounding


def whitening(covariance: Array, base: BaseParameters) -> Array:
    """Return W with W^T W the inverse of a covariance, shape (base, base); raises ParameterError if it is singular.

    Args:
        covariance: of the base parameters, SI units, shape (base, base).
        base: grouping of the link parameters.

    Raises:
        ParameterError: the covariance has no inverse; the message says along which parameters.
    """
    refusal = "no correction in the metric of this covariance:"
    if covariance.shape != (base.size, base.size):
        raise ParameterError(f"{covariance.shape=} but there are {base.size} base parameters")
    variances = np.diag(covariance)
    if blind := [base.expressions[i] for i in np.flatnonzero(np.isinf(variances))]:
        raise ParameterError(
            f"{refusal} the data left directions unseen, the variance of {'; '.join(blind)} is infinite"
        )
    if not np.all(np.isfinite(covariance)) or not np.allclose(covariance, covariance.T, rtol=1e-6, atol=0.0):
        raise ParameterError(f"{refusal} it is not a symmetric matrix of numbers")
    if wrong := [base.expressions[i] for i in np.flatnonzero(variances <= 0.0)]:
        raise ParameterError(f"{refusal} the variance of {'; '.join(wrong)} is not positive")
    deviations = np.sqrt(variances)
    values, vectors = np.linalg.eigh(covariance / np.outer(deviations, deviations))
    if values[0] * _LARGEST_CONDITION <= values[-1]:
        worst = base.expressions[int(np.argmax(np.abs(vectors[:, 0])))]
        raise ParameterError(
            f"{refusal} it is singular, most of all along {worst}; fewer blocks or equations than parameters?"
        )
    return np.asarray((vectors / np.sqrt(values)).T / deviations)


__all__ = [
    "EPSILON",
    "ConditionsError",
    "FeasibilityTest",
    "FeasibleEstimate",
    "constrained_least_squares",
    "constrained_least_squares_with_scales",
    "feasibility_correction",
    "feasibility_test",
]

EQUALITY_TOLERANCE = 1e-6  # largest violation of an equality in a test, in units of its reference scale
_LARGEST_MARGIN = 1e3  # bound of the margin, where nothing in the table bounds it


@dataclass(frozen=True)
class FeasibilityTest:
    """Result of the base parameter feasibility test (BPFT).

    Attributes:
        feasible: whether a real body could have these base parameters.
        margin: largest t with D(beta, delta_d) - t 1 >= 0 in SI units; its sign is the verdict. Where an equality
            cannot hold, minus the amount by which it does not.
        delta: link parameters that attain it, shape (parameters,).
        tight: names of the blocks that keep the margin from being larger, the most decisive first.
        scaled_margin: largest t with D - t S >= 0, S the reference scales of `feasible_set.py`; of the same sign.
        shares: of the scaled margin: the blocks that keep it from being larger and the share of each, largest first.
            A share is what the scaled margin would gain if that block alone asked for one unit less; they add up to 1.
    """

    feasible: bool
    margin: float
    delta: Array
    tight: tuple[str, ...]
    scaled_margin: float = float("nan")
    shares: tuple[tuple[str, float], ...] = ()


def feasibility_test(beta: Array, base: BaseParameters, conditions: FeasibleSet) -> FeasibilityTest:
    """Test whether a real body could have these base parameters: sign of the largest margin (BPFT, eq. 51).

    Args:
        beta: base parameters in SI units, shape (base,).
        base: grouping of the link parameters.
        conditions: the feasible set over the same link parameters.

    Raises:
        ParameterError: shapes or names do not fit.
        SolverError: the solver stopped without an optimum.
    """
    require_consistent(beta, base, conditions)
    lift = LinkParameterMap(base)
    fixed = lift.of_beta @ beta
    E, e = conditions.equality_rows()
    E_d, e = E @ lift.of_dependent, e + E @ fixed
    closest: Array = np.linalg.pinv(E_d) @ -e if len(e) else np.zeros(len(lift.dependent))
    residual = E_d @ closest + e
    if np.max(np.abs(residual), initial=0.0) > EQUALITY_TOLERANCE:
        return _unequal(lift.delta(beta, closest), conditions)
    plain, scaled = (_largest_margin(lift, fixed, (E_d, e - residual), conditions, scaled) for scaled in (False, True))
    # Either point bounds both margins from below, so the two cannot disagree about the sign.
    found = [lift.delta(beta, solution.x[:-1]) for solution in (plain, scaled)]
    margin, first = max((conditions.margin(delta)[0], -i) for i, delta in enumerate(found))
    return FeasibilityTest(
        feasible=margin > 0.0,
        margin=margin,
        delta=found[-first],
        tight=active_constraints(conditions, plain.duals),
        scaled_margin=max(conditions.scaled_margin(delta)[0] for delta in found),
        shares=_shares(conditions, scaled),
    )


def _largest_margin(
    lift: LinkParameterMap, fixed: Array, equalities: tuple[Array, Array], conditions: FeasibleSet, scaled: bool
) -> Solution:
    dependents = len(lift.dependent)
    problem = ConicProblem(dependents + 1)
    for block in conditions.blocks:
        unit = block.reference_identity() if scaled else block.identity()
        constrain(problem, block, np.column_stack([block.times(lift.of_dependent), -unit]), block.f + block.F @ fixed)
    problem.nonnegative(np.append(np.zeros(dependents), -1.0)[None], np.array([_LARGEST_MARGIN]))
    E, e = equalities
    if len(e):
        problem.zero(np.column_stack([E, np.zeros(len(e))]), e)
    to_delta = np.column_stack([lift.of_dependent, np.zeros(len(fixed))])
    objective = np.append(np.zeros(dependents), -1.0)
    size = float(np.max(np.abs(fixed), initial=0.0))
    return minimise(problem, objective, "feasibility test", (to_delta, fixed), conditions, largest_parameter=size)


def _shares(conditions: FeasibleSet, solution: Solution) -> tuple[tuple[str, float], ...]:
    """Return each block's share of the scaled margin: multipliers weighed by S, which sum to 1 at the optimum."""
    weights = [
        max(float(np.sum(block.reference_identity() * dual)), 0.0)
        for block, dual in zip(conditions.blocks, solution.duals, strict=False)
    ]
    total = max(sum(weights), np.finfo(float).tiny)
    order = sorted(range(len(weights)), key=lambda i: -weights[i])
    return tuple((conditions.blocks[i].name, weights[i] / total) for i in order if weights[i] > 1e-3 * total)


def _unequal(delta: Array, conditions: FeasibleSet) -> FeasibilityTest:
    off = {block.name: block.largest_scaled(delta) for block in conditions.equalities}
    broken = sorted((name for name, value in off.items() if value > EQUALITY_TOLERANCE), key=lambda name: -off[name])
    plain = max(float(np.max(np.abs(block.F @ delta + block.f))) for block in conditions.equalities)
    total = sum(off[name] for name in broken)
    shares = tuple((name, off[name] / total) for name in broken)
    return FeasibilityTest(False, -plain, delta, tuple(broken), -max(off.values()), shares)


def feasibility_correction(
    beta: Array, base: BaseParameters, conditions: FeasibleSet, covariance: Array | None = None
) -> FeasibleEstimate:
    """Return the feasible base parameters nearest to `beta` (BPFC, eq. 55), at an inset from the set's boundary.

    Args:
        beta: base parameters in SI units, shape (base,).
        base: grouping of the link parameters.
        conditions: the feasible set.
        covariance: of `beta`, shape (base, base): distance then is the root of (b - beta)^T covariance^-1 (b - beta)
            and the result does not depend on which columns are the base; the paper's Euclidean metric of the
            parameters' units when None.

    Raises:
        ParameterError: shapes or names do not fit, or the covariance has no inverse.
        ConditionsError: no parameters at all fulfil the conditions.
        SolverError: the solver stopped without an optimum.
    """
    require_consistent(beta, base, conditions)
    metric = np.eye(base.size) if covariance is None else whitening(covariance, base)
    # A bound on masses depends on the size of beta, so on the base columns, which this metric must not.
    reaches = OF_TABLES if covariance is None else OF_TESTS
    found = nearest(metric, metric @ beta, beta, base, conditions, "feasibility correction", reaches)
    return _unless_feasible(found, beta, base, conditions, reaches[0])


def constrained_least_squares(
    fit: LeastSquares,
    base: BaseParameters,
    conditions: FeasibleSet,
    prior: Prior | None = None,
    *,
    first_tolerance: float | None = None,
) -> FeasibleEstimate:
    """Return the feasible base parameters that explain the torques best (FBPE-OLS, eq. 74).

    `objective` is |rho_1 - R_1 beta|, the part of the residual that beta can change (eq. 70). With a prior, what is
    minimised is |rho_1 - R_1 beta|^2 / sigma^2 + weight * divergence(delta, prior), see `priors.py`.

    Args:
        fit: unconstrained least squares.
        base: grouping of the parameters.
        conditions: the feasible set.
        prior: prior that the estimate is drawn to; None for none.
        first_tolerance: tolerance of the objective that is enough to compare estimates, such as `ENOUGH`; all digits
            when None, and with a prior.

    Raises:
        ParameterError: shapes or names do not fit, or the prior is not one that a divergence can be measured from.
        ConditionsError: no parameters at all fulfil the conditions.
        SolverError: the solver stopped without an optimum.
    """
    require_consistent(fit.beta, base, conditions)
    if prior is None or prior.weight == 0.0:
        found = nearest(
            fit.R1, fit.rho1, fit.beta, base, conditions, "constrained least squares", first_tolerance=first_tolerance
        )
        return _unless_feasible(found, fit.beta, base, conditions, OF_ESTIMATES[0])
    return solve_with_prior(fit, base, conditions, prior)


def _unless_feasible(
    found: FeasibleEstimate, beta: Array, base: BaseParameters, conditions: FeasibleSet, reach: float
) -> FeasibleEstimate:
    """Return `beta` itself where a hard solve missed that a body within reach has these base parameters."""
    if found.iterations <= HARD or conditions.equalities:
        return found
    try:
        tested = feasibility_test(beta, base, conditions)
    except SolverError:
        return found
    size = max(1.0, float(np.max(np.abs(beta), initial=0.0)))
    if (
        tested.margin < insets(conditions, base, beta).min()
        or np.max(traces(conditions) @ tested.delta, initial=0.0) > reach * size
    ):
        return found
    return replace(found, beta=beta, delta=tested.delta, objective=0.0, margin=tested.margin, tight=())
