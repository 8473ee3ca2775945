"""Feasibility test (BPFT, eq. 51), correction (BPFC, eqs. 52-56) and constrained regression (FBPE-OLS, eq. 74).

All three look for delta, written as the pair (beta, delta_d) through the bijection of eqs. 42-49. Norms are
second-order cones: the Schur complements of eqs. 54 and 73 say the same with many more entries.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ident_service.errors import ParameterError
from ident_service.estimation.conic import ConicProblem
from ident_service.estimation.feasible_set import Block, FeasibleSet
from ident_service.estimation.least_squares import LeastSquares
from ident_service.model.base import BaseParameters
from ident_service.model.chain import Array

EPSILON = 1e-6  # eq. 21, the paper's margin
_MULTIPLIER = 1e-6  # smaller ones are the interior-point method's own distance from the boundary
_LARGEST_MARGIN = 1e3  # where nothing in the table bounds the margin, any larger one says no more


@dataclass(frozen=True)
class FeasibilityTest:
    """Answer of the BPFT.

    Attributes:
        feasible: whether a real body could have these base parameters.
        margin: largest t with D(beta, delta_d) - t 1 >= 0; its sign is the verdict.
        delta: link parameters that attain it, shape (parameters,).
        tight: names of the blocks that keep the margin from being larger, the most decisive first.
    """

    feasible: bool
    margin: float
    delta: Array
    tight: tuple[str, ...]


@dataclass(frozen=True)
class FeasibleEstimate:
    """A feasible point that is optimal for something.

    Attributes:
        beta: base parameters, shape (base,).
        delta: link parameters with K delta = beta, shape (parameters,).
        objective: what was minimised (a distance in the space of beta, or a residual norm).
        margin: smallest eigenvalue of all blocks at delta.
        tight: names of the blocks that keep the objective from being smaller, the most decisive first.
        iterations: of the solver.
        solver_seconds: inside the solver.
    """

    beta: Array
    delta: Array
    objective: float
    margin: float
    tight: tuple[str, ...]
    iterations: int
    solver_seconds: float


class _Lift:
    """The bijection (beta, delta_d) -> delta of eq. 49, for any grouping whose K has full row rank."""

    def __init__(self, base: BaseParameters) -> None:
        inverse = np.linalg.inv(base.K[:, base.base])
        self.dependent = base.dependent
        self.of_beta = np.zeros((len(base.names), base.size))
        self.of_beta[base.base] = inverse
        self.of_dependent = np.zeros((len(base.names), len(self.dependent)))
        self.of_dependent[base.base] = -inverse @ base.K[:, self.dependent]
        self.of_dependent[self.dependent, np.arange(len(self.dependent))] = 1.0

    def delta(self, beta: Array, dependent: Array) -> Array:
        return np.asarray(self.of_beta @ beta + self.of_dependent @ dependent)


def feasibility_test(beta: Array, base: BaseParameters, conditions: FeasibleSet) -> FeasibilityTest:
    """Could a real body have these base parameters? (BPFT, eq. 51, as a largest margin).

    Args:
        beta: base parameters in SI units, shape (base,).
        base: their grouping.
        conditions: the feasible set over the same link parameters.

    Raises:
        ParameterError: shapes or names do not fit.
        SolverError: the solver stopped without an optimum.
    """
    _check(beta, base, conditions)
    lift = _Lift(base)
    fixed = lift.of_beta @ beta
    dependents = len(lift.dependent)
    problem = ConicProblem(dependents + 1)
    for block in conditions.blocks:
        F = np.column_stack([block.F @ lift.of_dependent, -block.identity()])
        _constrain(problem, block, F, block.f + block.F @ fixed)
    problem.nonnegative(np.append(np.zeros(dependents), -1.0)[None], np.array([_LARGEST_MARGIN]))
    solution = problem.minimise(np.append(np.zeros(dependents), -1.0), "feasibility test")
    delta = lift.delta(beta, solution.x[:dependents])
    margin, _ = conditions.margin(delta)
    return FeasibilityTest(margin > 0.0, margin, delta, _tight(conditions, solution.duals))


def feasibility_correction(beta: Array, base: BaseParameters, conditions: FeasibleSet) -> FeasibleEstimate:
    """The feasible base parameters nearest to `beta` in the Euclidean metric of its units (BPFC, eq. 55).

    Raises:
        ParameterError: shapes or names do not fit.
        SolverError: the solver stopped without an optimum.
    """
    _check(beta, base, conditions)
    return _nearest(np.eye(base.size), beta, base, conditions, "feasibility correction")


def constrained_least_squares(fit: LeastSquares, base: BaseParameters, conditions: FeasibleSet) -> FeasibleEstimate:
    """The feasible base parameters that explain the torques best (FBPE-OLS, eq. 74).

    `objective` is |rho_1 - R_1 beta|, the part of the residual that beta can change (eq. 70).

    Raises:
        ParameterError: shapes or names do not fit.
        SolverError: the solver stopped without an optimum.
    """
    _check(fit.beta, base, conditions)
    return _nearest(fit.R1, fit.rho1, base, conditions, "constrained least squares")


def _nearest(
    metric: Array, target: Array, base: BaseParameters, conditions: FeasibleSet, name: str
) -> FeasibleEstimate:
    """Minimise |metric beta - target| over feasible beta."""
    lift = _Lift(base)
    n, dependents = base.size, len(lift.dependent)
    problem = ConicProblem(n + dependents + 1)
    scale = max(float(np.linalg.norm(metric, axis=0).max()), np.finfo(float).tiny)
    distance = np.zeros((n + 1, n + dependents + 1))
    distance[0, -1] = 1.0
    distance[1:, :n] = metric / scale
    problem.second_order(distance, np.concatenate([[0.0], -target / scale]))
    for block in conditions.blocks:
        F = np.column_stack([block.F @ lift.of_beta, block.F @ lift.of_dependent, np.zeros(len(block.f))])
        _constrain(problem, block, F, block.f - EPSILON * block.identity())
    solution = problem.minimise(np.append(np.zeros(n + dependents), 1.0), name)
    beta = solution.x[:n]
    delta = lift.delta(beta, solution.x[n:-1])
    margin, _ = conditions.margin(delta)
    return FeasibleEstimate(
        beta=beta,
        delta=delta,
        objective=float(np.linalg.norm(metric @ beta - target)),
        margin=margin,
        tight=_tight(conditions, solution.duals[1:]),
        iterations=solution.iterations,
        solver_seconds=solution.seconds,
    )


def _constrain(problem: ConicProblem, block: Block, F: Array, f: Array) -> None:
    if block.size == 0:
        problem.nonnegative(F, f)
        return
    problem.semidefinite(F, f, block.size)


def _tight(conditions: FeasibleSet, duals: Sequence[Array]) -> tuple[str, ...]:
    """Blocks with a multiplier that counts: relaxing them would let the optimum improve."""
    weights = [float(np.abs(dual).max()) for dual in duals[: len(conditions.blocks)]]
    order = sorted(range(len(weights)), key=lambda i: -weights[i])
    floor = max(_MULTIPLIER, 1e-3 * max(weights))
    return tuple(conditions.blocks[i].name for i in order if weights[i] > floor)


def _check(beta: Array, base: BaseParameters, conditions: FeasibleSet) -> None:
    if beta.shape != (base.size,):
        raise ParameterError(f"{beta.shape=} but there are {base.size} base parameters")
    if conditions.names != base.names:
        raise ParameterError("the feasible set and the base parameters are about different link parameters")
