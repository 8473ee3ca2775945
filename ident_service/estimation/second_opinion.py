"""Solve the constrained problem of an estimate a second time, with another formulation and solver, and compare.

What is compared is the optimum, not the link values: of these, many are behind the same base parameters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident_service.estimation.custom import CustomFunction
from ident_service.estimation.feasible.convex import SOLVER, available_solvers, convex_least_squares, objective
from ident_service.estimation.feasible.feasible_set import FeasibleSet
from ident_service.estimation.feasible.nearest import FeasibleEstimate
from ident_service.estimation.feasible.priors import Prior
from ident_service.estimation.least_squares import LeastSquares
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.chain import Array

AGREED_BELOW = 0.1  # percent of the torques that the fit is about


@dataclass(frozen=True)
class SecondOpinion:
    """Comparison of two solutions of one problem.

    Attributes:
        solvers: of the first and of the second solution; the first is `ident` where the problem was not posed in cvxpy.
        status: cvxpy's word for the second.
        objectives: of both: |R_1 beta - rho_1|, or with a prior or a penalty the whole sum that is minimised.
        torque_percent: |R_1 (beta_2 - beta_1)| of |rho_1|, in percent: how far the predicted torques are apart.
        deviations: the largest difference of a base parameter, in its standard deviations.
        expression: of that parameter.
        margin: of the second solution in the set; where it is negative, the solver missed the set by so much.
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
        """Return whether the two solutions predict the same torques, to a thousandth."""
        return self.torque_percent < AGREED_BELOW

    @property
    def conclusive(self) -> bool:
        """Return whether the second solver reached its optimum; one that stopped early disproves nothing."""
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
    """Solve again what `first` solves, within the same bound of masses.

    Args:
        first: the estimate; with `custom` it was found through cvxpy, by `solver`.
        fit: the unconstrained least squares.
        base: grouping of the parameters.
        conditions: the feasible set.
        deviations: standard deviations of the base parameters, shape (base,).
        prior: what both are drawn to.
        custom: further knowledge in both.
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
        fit, base, conditions, prior=prior, custom=custom, solver=asked, bound=first.bound, inside=False
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
