"""Formulate the constrained least squares in cvxpy, for `constraints.custom` and as a second opinion.

The problem is that of `nearest.py` and `priors.py`: the same blocks with the same inset, the same equalities, the same
bound of each link's tr(P) = m + tr(L)/2, the same residual and prior. The formulation is another one: the variable is
delta itself in reference scales (`feasible_set.py`), and cvxpy makes the cones.

With a penalty p(delta), |R_1 beta - rho_1|^2 / sigma^2 + p (+ the prior's term) is minimised: p is measured in residual
variances, as -2 log of a prior density would be. cvxpy is loaded when a problem is posed, not before.

A second opinion compares optima and not link parameters, many of which have the same base parameters.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ident_service.errors import SolverError, UsageError
from ident_service.estimation.custom import CustomError, CustomFunction
from ident_service.estimation.feasible.conic import triangle_entries
from ident_service.estimation.feasible.feasible_set import Block, FeasibleSet, reference_scale
from ident_service.estimation.feasible.formulation import (
    MULTIPLIER,
    OF_ESTIMATES,
    ConditionsError,
    conflicting_constraints,
    insets,
    project,
    require_consistent,
    trace_unit,
    traces,
)
from ident_service.estimation.feasible.nearest import FeasibleEstimate
from ident_service.estimation.feasible.priors import Prior, residual_deviation
from ident_service.estimation.least_squares import LeastSquares, unit_columns
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.chain import Array

if TYPE_CHECKING:
    import cvxpy as cp

SOLVER = "clarabel"
_NAME = "constrained least squares in cvxpy"
_WEIGHT = 8.0  # of the residual norm, as in `nearest.py`: multipliers are then comparable
# In turn, until the solver reaches an optimum. Other solvers are asked with their own defaults.
_OPTIONS: dict[str, tuple[dict[str, Any], ...]] = {
    "CLARABEL": tuple(
        {f"{kind}{name}": tolerance for kind in ("", "reduced_") for name in ("tol_gap_abs", "tol_gap_rel", "tol_feas")}
        | {"max_iter": 200, "max_threads": 1}
        for tolerance in (1e-9, 1e-8, 1e-7)
    ),
    # With acceleration SCS sometimes does not converge, on one processor and not on another.
    "SCS": ({"eps_abs": 1e-7, "eps_rel": 1e-7, "max_iters": 100_000, "acceleration_lookback": 0},),
}


@dataclass(frozen=True)
class ConvexEstimate:
    """Estimate found through cvxpy.

    Attributes:
        estimate: the parameters.
        solver: name of the solver, lower case.
        status: cvxpy's word: `optimal`, or `optimal_inaccurate` where the solver stopped early.
    """

    estimate: FeasibleEstimate
    solver: str
    status: str


def available_solvers() -> tuple[str, ...]:
    """List the installed cvxpy solvers that solve semidefinite problems, in lower case."""
    import cvxpy as cp
    from cvxpy.reductions.solvers.defines import SOLVER_MAP_CONIC

    return tuple(
        name.lower()
        for name in cp.installed_solvers()
        if name in SOLVER_MAP_CONIC
        and any("PSD" in kind.__name__ for kind in SOLVER_MAP_CONIC[name].SUPPORTED_CONSTRAINTS)
    )


def require_solver(solver: str) -> str:
    """Return the name (upper case) that cvxpy knows a solver by; raises UsageError if it is not an available one.

    Raises:
        UsageError: it is not installed, or solves no semidefinite problems.
    """
    names = available_solvers()
    if solver.lower() not in names:
        raise UsageError(
            f"the solver {solver!r} is not installed, or solves no semidefinite problems; here are {', '.join(names)}"
        )
    return solver.upper()


def convex_least_squares(
    fit: LeastSquares,
    base: BaseParameters,
    conditions: FeasibleSet,
    *,
    prior: Prior | None = None,
    custom: CustomFunction | None = None,
    solver: str = SOLVER,
    trace_bound: float | None = None,
    require_positive_margin: bool = True,
) -> ConvexEstimate:
    """Find through cvxpy the feasible base parameters of least torque error, plus prior distance and custom penalty.

    Args:
        fit: the unconstrained least squares.
        base: grouping of the parameters.
        conditions: the feasible set.
        prior: prior that the estimate is drawn to; None for none.
        custom: the user's constraints and penalty.
        solver: any that `available_solvers` names.
        trace_bound: upper bound of each link's tr(P) [kg]; those of `formulation.py` in turn when None, none with a
            prior.
        require_positive_margin: whether the parameters must have a positive margin; a solver of first order may miss
            the inset of 1e-6.

    Raises:
        UsageError: the solver is not installed.
        ParameterError: shapes or names do not fit, or the residual has no variance to weigh a penalty against.
        CustomError: `custom` raises, returns what is not convex, or contradicts the conditions.
        ConditionsError: no parameters at all fulfil the conditions.
        SolverError: the solver stopped without an optimum.
    """
    require_consistent(fit.beta, base, conditions)
    name = require_solver(solver)
    if prior is not None and prior.weight == 0.0:
        prior = None
    posed = _Posed(fit, base, conditions, prior, custom)
    size = float(np.max(np.abs(fit.beta), initial=0.0))
    reaches = OF_ESTIMATES if prior is None else (np.inf,)
    bounds = [reach * trace_unit(conditions, size) for reach in reaches] if trace_bound is None else [trace_bound]
    statuses: list[str] = []
    early: FeasibleEstimate | None = None
    for limit in bounds:
        for options in _OPTIONS.get(name, ({},)):
            status = posed.solve(name, options, limit)
            statuses.append(status)
            if status in ("optimal", "optimal_inaccurate"):
                found = posed.found(limit)
                if found.margin <= 0.0 and require_positive_margin:
                    continue
                if status == "optimal":
                    return ConvexEstimate(found, solver.lower(), status)
                early = early or found
            if status.startswith("infeasible"):
                break
        if early is not None:
            return ConvexEstimate(early, solver.lower(), "optimal_inaccurate")
    if statuses[0].startswith("infeasible"):
        if blocks := conflicting_constraints(conditions):
            raise ConditionsError(_NAME, statuses[0], blocks)
        if custom is not None:
            raise CustomError(
                f"{custom.name} contradicts the rest of the description, or asks for links of more than "
                f"{bounds[-1]:.3g} kg: no parameters fulfil both"
            )
    outside = " but outside the set; try another solver" if statuses[0].startswith("optimal") else ""
    raise SolverError(f"{_NAME} by {solver.lower()}", f"{statuses[0]}{outside}")


def objective(fit: LeastSquares, estimate: FeasibleEstimate, prior: Prior | None) -> float:
    """Return the objective's value at an estimate: |R_1 beta - rho_1|, or the weighted sum with prior and penalty.

    Args:
        fit: the unconstrained least squares.
        estimate: the estimate.
        prior: prior that the estimate is drawn to; None for none.

    Raises:
        ParameterError: the residual has no variance.
    """
    drawn = prior is not None and prior.weight > 0.0
    if not drawn and estimate.penalty is None:
        return estimate.objective
    added = prior.weight * estimate.prior_distance if prior is not None else 0.0
    return (estimate.objective / _sigma(fit, prior)) ** 2 + added + (estimate.penalty or 0.0)


def _sigma(fit: LeastSquares, prior: Prior | None) -> float:
    return residual_deviation(fit) if prior is None or prior.sigma is None else prior.sigma


class _Posed:
    """Constrained least squares in cvxpy, to be solved with several options and bounds."""

    def __init__(
        self,
        fit: LeastSquares,
        base: BaseParameters,
        conditions: FeasibleSet,
        prior: Prior | None,
        custom: CustomFunction | None,
    ) -> None:
        import cvxpy as cp

        self._fit, self._base, self._conditions, self._prior = fit, base, conditions, prior
        self._custom = custom
        self._scales = np.array([reference_scale(name) for name in base.names])
        self._x = cp.Variable(len(base.names))
        delta = cp.multiply(self._scales, self._x)
        inside = insets(conditions, base, fit.beta)
        self._blocks = [self._block(*pair) for pair in zip(conditions.blocks, inside.tolist(), strict=True)]
        E, e = conditions.equality_rows()
        self._equalities = [(E * self._scales) @ self._x + e == 0.0] if len(e) else []
        self._custom_constraints: Sequence[cp.Constraint] = ()
        self._penalty: cp.Expression | None = None
        if custom is not None:
            beta = base.K @ delta
            link = {name: delta[index] for index, name in enumerate(base.names)}
            grouped = {text: beta[index] for index, text in enumerate(base.expressions)}
            self._custom_constraints, self._penalty = custom.constraints(link, grouped)
        self._objective = cp.Minimize(self._cost())
        self._iterations, self._seconds = 0, 0.0

    def _block(self, block: Block, inset: float) -> cp.Constraint:
        """Return the constraint of one block, with the inset of eq. 21."""
        import cvxpy as cp

        entries = (block.F * self._scales) @ self._x + (block.f - inset * block.identity())
        if block.size == 0:
            return entries >= 0.0
        places = {pair: k for k, pair in enumerate(triangle_entries(block.size))}
        order = range(block.size)
        return cp.bmat([[entries[places[min(i, j), max(i, j)]] for j in order] for i in order]) >> 0

    def _cost(self) -> cp.Expression:
        import cvxpy as cp

        unit, seen = unit_columns(self._fit.R1)
        metric = np.where(seen, self._fit.R1, 0.0) @ (self._base.K * self._scales)
        if self._prior is None and self._penalty is None:
            scale = float(unit[seen].max(initial=np.finfo(float).tiny))
            return _WEIGHT * cp.norm(metric / scale @ self._x - self._fit.rho1 / scale)
        sigma = _sigma(self._fit, self._prior)
        cost = cp.sum_squares(metric / sigma @ self._x - self._fit.rho1 / sigma)
        weight = 0.0
        if self._prior is not None:
            weight = self._prior.weight
            cost += weight * self._divergence(self._prior)
        if self._penalty is not None:
            cost += self._penalty
        return cost / (1.0 + weight)

    def _divergence(self, prior: Prior) -> cp.Expression:
        import cvxpy as cp

        columns = prior.euclidean
        total = cp.sum_squares(self._x[columns] - (prior.delta / self._scales)[columns])
        if prior.kind == "entropic":
            for block in prior.whitened:
                entries = (block.F * self._scales) @ self._x
                places = {pair: k for k, pair in enumerate(triangle_entries(4))}
                Q = cp.bmat([[entries[places[min(i, j), max(i, j)]] for j in range(4)] for i in range(4)])
                total += cp.trace(Q) - 4.0 - cp.log_det(Q)
        return total

    def solve(self, name: str, options: dict[str, Any], bound: float) -> str:
        """Solve and return cvxpy's status, or a solver's own words where it fails."""
        import cvxpy as cp

        constraints = [*self._blocks, *self._equalities, *self._custom_constraints]
        if np.isfinite(bound):
            constraints.append((traces(self._conditions) * self._scales / bound) @ self._x <= 1.0)
        problem = cp.Problem(self._objective, constraints)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # what they say is in the status
                problem.solve(solver=name, **options)
        except Exception as error:  # noqa: BLE001 - every solver raises its own errors (no licence, say)
            return f"failed ({type(error).__name__}: {' '.join(str(error).split())[:200]})"
        self._iterations += int(problem.solver_stats.num_iters or 0)
        self._seconds += float(problem.solver_stats.solve_time or 0.0)
        return str(problem.status)

    def found(self, bound: float) -> FeasibleEstimate:
        """Return the parameters of the last solution."""
        delta = project(self._scales * np.asarray(self._x.value), self._conditions)
        beta = self._base.K @ delta
        return FeasibleEstimate(
            beta=beta,
            delta=delta,
            objective=float(np.linalg.norm(self._fit.R1 @ beta - self._fit.rho1)),
            margin=self._conditions.margin(delta)[0],
            tight=self._active(),
            iterations=self._iterations,
            solver_seconds=self._seconds,
            prior_distance=0.0 if self._prior is None else self._prior.divergence(delta),
            bound=bound,
            penalty=None if self._penalty is None else float(self._penalty.value),
        )

    def _active(self) -> tuple[str, ...]:
        """Return the names of the active constraints, custom ones too, by multiplier as `active_constraints` does."""
        named = [(block.name, one) for block, one in zip(self._conditions.blocks, self._blocks, strict=True)]
        if self._custom is not None:
            named += [
                (f"{self._custom.name}, constraint {k}", one) for k, one in enumerate(self._custom_constraints, 1)
            ]
        weights = {name: _multiplier(one) for name, one in named}
        floor = max(MULTIPLIER, 1e-3 * max(weights.values(), default=0.0))
        return tuple(sorted((name for name in weights if weights[name] > floor), key=lambda name: -weights[name]))


def _multiplier(constraint: cp.Constraint) -> float:
    """Return the largest entry of a constraint's multipliers; cones of several parts have several."""
    return max(
        (float(np.abs(dual.value).max()) for dual in constraint.dual_variables if dual.value is not None), default=0.0
    )


AGREED_BELOW = 0.1  # percent of the torques that the fit is about


@dataclass(frozen=True)
class SecondOpinion:
    """Comparison of two solutions of one problem.

    Attributes:
        solvers: names of the solvers of the first and of the second solution; the first is `ident` where the problem
            was not posed in cvxpy.
        status: cvxpy's word for the second.
        objectives: objectives of both solutions: |R_1 beta - rho_1|, or with a prior or a penalty the whole sum that is
            minimised.
        torque_percent: |R_1 (beta_2 - beta_1)| of |rho_1|, in percent: how far the predicted torques are apart.
        deviations: the largest difference of a base parameter, in its standard deviations.
        expression: expression of the base parameter with that difference.
        margin: margin of the second solution in the set; where it is negative, the solver missed the set by so much.
    """

    solvers: tuple[str, str]
    status: str
    objectives: tuple[float, float]
    torque_percent: float
    deviations: float
    expression: str
    margin: float

    @property
    def agrees(self) -> bool:
        """Return whether the two solutions' predicted torques differ by less than 0.1 % of the torques."""
        return self.torque_percent < AGREED_BELOW

    @property
    def conclusive(self) -> bool:
        """Return whether the comparison counts: the solutions agree, or the second is optimal and inside the set."""
        return self.agrees or (self.status == "optimal" and self.margin > 0.0)


def second_opinion(
    first: FeasibleEstimate,
    fit: LeastSquares,
    base: BaseParameters,
    conditions: FeasibleSet,
    deviations: Array,
    *,
    prior: Prior | None = None,
    custom: CustomFunction | None = None,
    solver: str | None = None,
) -> SecondOpinion:
    """Solve the problem of `first` again, through cvxpy by another solver; return how far the solutions are apart.

    Args:
        first: the estimate; with `custom` it was found through cvxpy, by `solver`.
        fit: the unconstrained least squares.
        base: grouping of the parameters.
        conditions: the feasible set.
        deviations: standard deviations of the base parameters, shape (base,).
        prior: prior that both estimates are drawn to; None for none.
        custom: the user's constraints and penalty, in both.
        solver: without `custom`, that of the second solution; with it, that of the first, and the second is another.

    Raises:
        UsageError: the solver is not installed, or no other one is.
        CustomError: `custom` fails.
        SolverError: the second solver stopped without an optimum.
    """
    before = "ident" if custom is None else (solver or SOLVER).lower()
    asked = solver or SOLVER
    if custom is not None:
        asked = next(name for name in (SOLVER, "scs", *available_solvers()) if name != before)
    second = convex_least_squares(
        fit,
        base,
        conditions,
        prior=prior,
        custom=custom,
        solver=asked,
        trace_bound=first.bound,
        require_positive_margin=False,
    )
    found = second.estimate
    apart = np.abs(found.beta - first.beta)
    known = np.isfinite(deviations) & (deviations > 0.0)
    shifts = np.divide(apart, deviations, out=np.zeros(base.size), where=known)
    worst = int(np.argmax(shifts))
    size = max(float(np.linalg.norm(fit.rho1)), np.finfo(float).tiny)
    return SecondOpinion(
        solvers=(before, second.solver),
        status=second.status,
        objectives=(objective(fit, first, prior), objective(fit, found, prior)),
        torque_percent=100.0 * float(np.linalg.norm(fit.R1 @ (found.beta - first.beta))) / size,
        deviations=float(shifts[worst]),
        expression=base.expressions[worst],
        margin=found.margin,
    )
