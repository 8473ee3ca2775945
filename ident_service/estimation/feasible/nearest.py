"""Find the feasible point nearest to a target, as BPFC (eq. 55) and FBPE (eq. 74) both do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident_service.errors import SolverError
from ident_service.estimation.feasible.central import ChangeEllipsoid, centre
from ident_service.estimation.feasible.conic import ConicProblem, Solution
from ident_service.estimation.feasible.feasible_set import FeasibleSet
from ident_service.estimation.feasible.formulation import (
    OF_ESTIMATES,
    ConditionsError,
    LinkParameterMap,
    active_constraints,
    conflicting_constraints,
    constrain,
    insets,
    minimise,
    project,
)
from ident_service.estimation.least_squares import unit_columns
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.chain import Array
from ident_service.model.likely_bodies import LikelyBodies

_AT_TARGET = 1e-8  # share of the target's size below which a distance is zero
# Weights of the distance (in units of the largest column) in the objective, in turn. A solve that was hard may have
# ended far from the optimum although the solver calls it one: then the others are tried, and the nearest point counts.
_WEIGHTS = (8.0, 30.0, 1.0)
HARD = 45  # iterations; an easy problem takes 10 to 30


@dataclass(frozen=True)
class FeasibleEstimate:
    """Feasible parameters that minimise an objective.

    Attributes:
        beta: base parameters, shape (base,).
        delta: some link parameters with K delta = beta, shape (parameters,); which ones is the solver's rounding.
        objective: a distance in the space of beta, or a residual norm, without what a prior adds.
        margin: smallest eigenvalue of all blocks at delta.
        tight: names of the blocks that keep the objective from being smaller, the most decisive first.
        iterations: of the solver.
        solver_seconds: inside the solver.
        prior_distance: divergence from the prior, before its weight; 0 without one.
        bound: upper bound of each link's tr(P) [kg] in the search, see `formulation.py`; infinite for none.
        penalty: value of the penalty of `constraints.custom`; None without one.
    """

    beta: Array
    delta: Array
    objective: float
    margin: float
    tight: tuple[str, ...]
    iterations: int
    solver_seconds: float
    prior_distance: float = 0.0
    bound: float = np.inf
    penalty: float | None = None

    def centred(
        self,
        base: BaseParameters,
        conditions: FeasibleSet,
        likely: LikelyBodies | None = None,
        allowed_change: ChangeEllipsoid | None = None,
    ) -> FeasibleEstimate:
        """Return the estimate with link parameters near likely ones; base ones move only in `allowed_change`."""
        delta = centre(self.delta, base, conditions, likely, allowed_change)
        beta = self.beta if allowed_change is None else base.K @ delta
        return replace(self, beta=beta, delta=delta, margin=conditions.margin(delta)[0])


def add_conditions(problem: ConicProblem, conditions: FeasibleSet, to_delta: Array, block_insets: Array) -> None:
    """Add a set's conditions to a problem, delta = to_delta x: blocks by their insets (eq. 21), equalities exactly."""
    for block, inset in zip(conditions.blocks, block_insets, strict=True):
        constrain(problem, block, block.times(to_delta), block.f - inset * block.identity())
    E, e = conditions.equality_rows()
    if len(e):
        problem.zero(E @ to_delta, e)


def solve_inside(
    problem: ConicProblem,
    objective: Array,
    problem_name: str,
    to_delta: Array,
    conditions: FeasibleSet,
    largest_parameter: float,
    hessian_diagonal: Array | None = None,
    trace_bounds: Sequence[float] = OF_ESTIMATES,
    first_tolerance: float | None = None,
) -> tuple[Array, Solution]:
    """Solve a problem; return link parameters strictly inside the set and the solution; raises where there are none.

    Args:
        problem: problem with all its constraints, those of the set included.
        objective: linear coefficients, shape (variables,).
        problem_name: of the problem, for errors.
        to_delta: delta = to_delta x.
        conditions: the set.
        largest_parameter: size of the largest base parameter.
        hessian_diagonal: diagonal of the Hessian, shape (variables,).
        trace_bounds: bounds of links' masses to try, in turn, see `formulation.py`.
        first_tolerance: tolerance that is enough, where one is, see `formulation.py`.

    Returns:
        Delta, with a positive margin and the equalities fulfilled to the last digit, and the solution.

    Raises:
        ConditionsError: no parameters at all fulfil the conditions.
        SolverError: the solver stopped without an optimum.
    """

    def inside(x: Array) -> bool:
        return conditions.margin(project(to_delta @ x, conditions))[0] > 0.0

    try:
        solution = minimise(
            problem,
            objective,
            problem_name,
            (to_delta, np.zeros(len(to_delta))),
            conditions,
            largest_parameter=largest_parameter,
            hessian_diagonal=hessian_diagonal,
            accept=inside,
            trace_bounds=trace_bounds,
            first_tolerance=first_tolerance,
        )
    except SolverError as error:
        if blocks := conflicting_constraints(conditions):
            raise ConditionsError(problem_name, error.status, blocks) from error
        raise
    return project(to_delta @ solution.x, conditions), solution


def nearest(
    metric: Array,
    target: Array,
    unconstrained_beta: Array,
    base: BaseParameters,
    conditions: FeasibleSet,
    problem_name: str,
    trace_bounds: Sequence[float] = OF_ESTIMATES,
    first_tolerance: float | None = None,
) -> FeasibleEstimate:
    """Return feasible base parameters b of least |metric b - target|; raises ConditionsError if there are none.

    Args:
        metric: shape (rows, base).
        target: shape (rows,).
        unconstrained_beta: unconstrained base parameters, shape (base,).
        base: grouping of the parameters.
        conditions: the set.
        problem_name: of the problem, for errors.
        trace_bounds: bounds of links' masses to try, in turn, see `formulation.py`.
        first_tolerance: tolerance that is enough, where one is, see `formulation.py`.

    Raises:
        ConditionsError: no parameters at all fulfil the conditions.
        SolverError: the solver stopped without an optimum.
    """
    lift = LinkParameterMap(base)
    n, variables = base.size, len(base.names) + 1
    problem = ConicProblem(variables)
    # Unit columns for beta: in SI units they differ by orders of magnitude.
    unit, seen = unit_columns(metric)
    metric = np.where(seen, metric, 0.0)
    scale = float(unit[seen].max(initial=np.finfo(float).tiny))
    columns = scale / unit
    distance = np.zeros((len(target) + 1, variables))
    distance[0, -1] = 1.0
    distance[1:, :n] = metric * columns / scale
    problem.second_order(distance, np.concatenate([[0.0], -target / scale]))
    to_delta = np.column_stack([lift.of_beta * columns, lift.of_dependent, np.zeros(len(base.names))])
    add_conditions(problem, conditions, to_delta, insets(conditions, base, unconstrained_beta))
    size = float(np.max(np.abs(unconstrained_beta), initial=0.0))
    best: FeasibleEstimate | None = None
    failure: SolverError | None = None
    for weight in _WEIGHTS:
        objective = np.append(np.zeros(variables - 1), weight)
        try:
            delta, solution = solve_inside(
                problem,
                objective,
                problem_name,
                to_delta,
                conditions,
                size,
                trace_bounds=trace_bounds,
                first_tolerance=first_tolerance,
            )
        except ConditionsError:
            raise
        except SolverError as error:
            failure = failure or error
            continue
        found = columns * solution.x[:n] if not conditions.equalities else base.K @ delta
        distance_found = float(np.linalg.norm(metric @ found - target))
        if best is None or distance_found < best.objective:
            # At the target itself nothing is in the way; the multipliers there are the solver's rounding.
            at_target = distance_found <= _AT_TARGET * float(np.linalg.norm(target))
            best = FeasibleEstimate(
                beta=found,
                delta=delta,
                objective=distance_found,
                margin=conditions.margin(delta)[0],
                tight=() if at_target else active_constraints(conditions, solution.duals[1:]),
                iterations=solution.iterations,
                solver_seconds=solution.seconds,
                bound=solution.bound,
            )
        if solution.attempts == 1 and solution.iterations <= HARD:
            break
    if best is None:
        raise failure or SolverError(problem_name, "no weight was tried")
    return best
