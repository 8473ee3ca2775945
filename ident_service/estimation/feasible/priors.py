"""Estimate with a prior on the link parameters, as from CAD, in units of the residual's variance.

    minimise  |R_1 beta - rho_1|^2 / sigma^2 + weight * d(delta, delta0)    over the feasible set

- `euclidean`: d is the sum of squared differences, each in units of its parameter's reference scale.
- `entropic`: per link the log-det Bregman divergence of the 4x4 pseudo-inertias (Lee, Wensing and Park 2020),
  `-logdet(P) + logdet(P0) + tr(P0^-1 P) - 4`, which does not depend on the choice of link frame; joint terms, which
  have no such metric, are Euclidean.

With P0 = G G^T the divergence is that of Q = G^-1 P G^-T from the identity. In cones, logdet Q >= sum_i t_i where
[[Q, Z], [Z^T, diag(Z)]] >= 0 for a lower triangular Z and t_i <= log Z_ii.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ident_service.errors import ParameterError, SolverError
from ident_service.estimation.feasible.central import ChangeEllipsoid
from ident_service.estimation.feasible.conic import ConicProblem, triangle_entries
from ident_service.estimation.feasible.feasible_set import Block, FeasibleSet, feasible_set, reference_scale, symmetric
from ident_service.estimation.feasible.formulation import OF_TESTS, active_constraints, insets
from ident_service.estimation.feasible.nearest import FeasibleEstimate, add_conditions, solve_inside
from ident_service.estimation.least_squares import LeastSquares
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.chain import Array
from ident_service.model.likely_bodies import LikelyBodies
from ident_service.model.parameter_layout import INERTIAL

_ROOM = 0.9  # share of the allowed change of base parameters that moving to likely bodies may use
_TRIANGLE = [(i, j) for i in range(4) for j in range(i + 1)]  # entries of Z, row by row


@dataclass(frozen=True)
class Prior:
    """Prior values of the link parameters, and their weight.

    Attributes:
        kind: of divergence.
        names: link parameters.
        delta: prior values of the link parameters [SI], shape (parameters,).
        weight: weight of one unit of divergence, in residual variances; 0 for none.
        sigma: standard deviation of the residual [N m or N]; that of the fit when None.
    """

    kind: Literal["euclidean", "entropic"]
    names: tuple[str, ...]
    delta: Array
    weight: float
    sigma: float | None = None

    def __post_init__(self) -> None:
        if self.delta.shape != (len(self.names),):
            raise ParameterError(f"{self.delta.shape=} but the prior has {len(self.names)} names")
        if not np.all(np.isfinite(self.delta)):
            raise ParameterError("the prior has values that are not finite")
        if not (np.isfinite(self.weight) and self.weight >= 0.0):
            raise ParameterError(f"the weight of a prior is {self.weight:g}, not a number from 0 up")
        if self.sigma is not None and not (np.isfinite(self.sigma) and self.sigma > 0.0):
            raise ParameterError(f"the residual's standard deviation is {self.sigma:g}, not a positive number")
        if self.kind == "entropic":
            _ = self.whitened

    @cached_property
    def scales(self) -> Array:
        """Return the reference scale of each parameter [SI], shape (parameters,)."""
        return np.array([reference_scale(name) for name in self.names])

    @cached_property
    def euclidean(self) -> NDArray[np.intp]:
        """Return indices of parameters compared by squared difference: all for kind `euclidean`, else joints'."""
        inertial = [name.rstrip("0123456789") in INERTIAL for name in self.names]
        return np.flatnonzero(np.ones(len(self.names)) if self.kind == "euclidean" else ~np.array(inertial))

    @cached_property
    def whitened(self) -> tuple[Block, ...]:
        """Return per link the pseudo-inertia whitened by the prior's, as an affine map of delta; identity at the prior.

        Raises:
            ParameterError: a link whose prior pseudo-inertia is not positive definite.
        """
        blocks = []
        for block in feasible_set("pseudo_inertia", self.names).blocks:
            size = np.sqrt(block.references())
            P0 = symmetric(block.F @ self.delta, 4) / np.outer(size, size)
            if np.linalg.eigvalsh(P0)[0] <= 1e-12 * np.trace(P0):
                link = block.name.split(":")[0]
                raise ParameterError(
                    f"{link}: no real body has the inertia of the prior, its pseudo-inertia is not > 0"
                )
            root = np.linalg.inv(size[:, None] * np.linalg.cholesky(P0))
            matrices = [root @ symmetric(column, 4) @ root.T for column in block.F.T]
            F = np.array([[matrix[i, j] for i, j in triangle_entries(4)] for matrix in matrices]).T
            blocks.append(Block(block.name, 4, F, np.zeros(10)))
        return tuple(blocks)

    def divergence(self, delta: Array) -> float:
        """Return the divergence of delta from the prior; for `entropic`, infinite outside positive pseudo-inertias."""
        columns = self.euclidean
        total = float(np.sum(((delta - self.delta)[columns] / self.scales[columns]) ** 2))
        if self.kind == "entropic":
            for block in self.whitened:
                values = np.linalg.eigvalsh(symmetric(block.F @ delta, 4))
                if values[0] <= 0.0:
                    return float("inf")
                total += float(np.sum(values - 1.0 - np.log(values)))
        return total


def residual_deviation(fit: LeastSquares) -> float:
    """Return the residual's standard deviation in eq. 81; raises ParameterError if it is zero or no parameter was seen.

    Raises:
        ParameterError: no parameter was seen, or the residual is exactly zero.
    """
    rows = np.linalg.norm(fit.inverse, axis=1)
    seen = np.isfinite(fit.standard_deviations) & (rows > 0.0)
    if not np.any(seen):
        raise ParameterError("a prior is weighted by the residual's variance, but the data saw no parameter at all")
    sigma = float(np.median(fit.standard_deviations[seen] / rows[seen]))
    if sigma <= 0.0:
        raise ParameterError("a prior is weighted by the residual's variance, but the residual is zero; give a sigma")
    return sigma


def solve_with_prior(
    fit: LeastSquares, base: BaseParameters, conditions: FeasibleSet, prior: Prior
) -> FeasibleEstimate:
    """Return the feasible estimate that minimises squared residuals plus the prior's weight times its divergence.

    Raises:
        ParameterError: the prior is about other link parameters, or the residual has no variance.
        ConditionsError: no parameters at all fulfil the conditions.
        SolverError: the solver stopped without an optimum.
    """
    if prior.names != conditions.names:
        raise ParameterError("the prior and the feasible set are about different link parameters")
    sigma = residual_deviation(fit) if prior.sigma is None else prior.sigma
    n, rows = len(prior.names), len(fit.rho1)
    # Variables: delta in reference scales, the whitened residual r, per link Z and t.
    variables = n + rows + (14 * len(prior.whitened) if prior.kind == "entropic" else 0)
    problem = ConicProblem(variables)
    to_delta = np.zeros((n, variables))
    to_delta[:, :n] = np.diag(prior.scales)
    add_conditions(problem, conditions, to_delta, insets(conditions, base, fit.beta))
    residual = np.zeros((rows, variables))
    residual[:, :n] = fit.R1 @ base.K * prior.scales / sigma
    residual[:, n : n + rows] = -np.eye(rows)
    problem.zero(residual, -fit.rho1 / sigma)
    # Divided by 1 + weight, so that the objective keeps its scale whatever the weight.
    data, known = 1.0 / (1.0 + prior.weight), prior.weight / (1.0 + prior.weight)
    objective, quadratic = np.zeros(variables), np.zeros(variables)
    quadratic[n : n + rows] = 2.0 * data
    _add_divergence(problem, prior, to_delta, n + rows, known, objective, quadratic)
    size = float(np.max(np.abs(np.concatenate([fit.beta, prior.delta])), initial=0.0))
    name = "constrained least squares with a prior"
    # The prior itself keeps masses from growing beyond all limits.
    delta, solution = solve_inside(problem, objective, name, to_delta, conditions, size, quadratic, OF_TESTS)
    beta = base.K @ delta
    return FeasibleEstimate(
        beta=beta,
        delta=delta,
        objective=float(np.linalg.norm(fit.R1 @ beta - fit.rho1)),
        margin=conditions.margin(delta)[0],
        tight=active_constraints(conditions, solution.duals),
        iterations=solution.iterations,
        solver_seconds=solution.seconds,
        prior_distance=prior.divergence(delta),
        bound=solution.bound,
    )


def move_off_boundary(
    boundary_estimate: FeasibleEstimate,
    base: BaseParameters,
    conditions: FeasibleSet,
    likely: LikelyBodies,
    allowed_change: ChangeEllipsoid,
) -> FeasibleEstimate:
    """Return the estimate moved inside towards likely bodies, within `allowed_change`; unchanged if none is found.

    Newton's method (`central.py`) needs room to begin: between links of tonnes whose masses cancel there is none.

    Args:
        boundary_estimate: constrained least squares, pressed against the set.
        base: grouping of the parameters.
        conditions: the set.
        likely: bodies that the estimate is drawn to.
        allowed_change: how far base parameters may move.

    Returns:
        `boundary_estimate` with other link values and nearly the same base parameters; itself where the solver finds
        none.
    """
    delta = boundary_estimate.delta.copy()  # friction keeps its value as prior
    links = np.array([name.rstrip("0123456789") in INERTIAL for name in conditions.names])
    delta[links] = likely.delta[links]
    delta = np.where(likely.drives > 0.0, likely.drives, delta)
    prior = Prior("entropic", conditions.names, delta, 1.0)
    try:
        found = _within(prior, base, conditions, allowed_change, insets(conditions, base, boundary_estimate.beta))
    except (ParameterError, SolverError):
        return boundary_estimate
    beta = base.K @ found
    inside = conditions.margin(found)[0]
    if float(np.linalg.norm(allowed_change.scaled_change(beta))) < 1.0 and inside > 0.0:
        return replace(boundary_estimate, beta=beta, delta=found, margin=inside)
    return boundary_estimate


def _within(prior: Prior, base: BaseParameters, conditions: FeasibleSet, near: ChangeEllipsoid, inside: Array) -> Array:
    """Return link parameters of least divergence from the prior whose base parameters lie within `near`."""
    n = len(prior.names)
    variables = n + 14 * len(prior.whitened)
    problem = ConicProblem(variables, rough=True)  # seven digits are enough to start Newton's method
    to_delta = np.zeros((n, variables))
    to_delta[:, :n] = np.diag(prior.scales)
    add_conditions(problem, conditions, to_delta, inside)
    still = np.flatnonzero(~near.moves)
    problem.zero(base.K[still] @ to_delta, -near.origin[still])
    rows = near.metric @ base.K @ to_delta
    problem.second_order(np.vstack([np.zeros(rows.shape[1]), rows]), np.append(_ROOM, -near.metric @ near.origin))
    objective, quadratic = np.zeros(rows.shape[1]), np.zeros(rows.shape[1])
    _add_divergence(problem, prior, to_delta, n, 1.0, objective, quadratic)
    size = float(np.max(np.abs(np.concatenate([near.origin, prior.delta])), initial=0.0))
    return solve_inside(problem, objective, "likely bodies", to_delta, conditions, size, quadratic, OF_TESTS)[0]


def _add_divergence(
    problem: ConicProblem,
    prior: Prior,
    to_delta: Array,
    start: int,
    weight: float,
    objective: Array,
    quadratic: Array,
) -> None:
    """Add the divergence from a prior to an objective; its own variables, per link Z and t, begin at `start`.

    The first variables are delta in reference scales; `objective` and `quadratic` are changed in place.
    """
    quadratic[prior.euclidean] = 2.0 * weight
    objective[prior.euclidean] = -2.0 * weight * (prior.delta / prior.scales)[prior.euclidean]
    diagonal = [entry for entry, (i, j) in enumerate(triangle_entries(4)) if i == j]
    for block in prior.whitened if prior.kind == "entropic" else ():
        _logdet(problem, block, to_delta, start)
        objective += weight * (block.F[diagonal].sum(axis=0) @ to_delta)
        objective[start + 10 : start + 14] -= weight
        start += 14


def _logdet(problem: ConicProblem, block: Block, to_delta: Array, start: int) -> None:
    """Add Z from variable `start` on (10, row by row) and t (4) with sum t <= logdet Q."""
    entries = triangle_entries(8)
    place = {entry: row for row, entry in enumerate(entries)}
    lifted = np.zeros((len(entries), to_delta.shape[1]))
    Q = block.F @ to_delta
    for row, (i, j) in enumerate(triangle_entries(4)):
        lifted[place[i, j]] = Q[row]
    for offset, (i, j) in enumerate(_TRIANGLE):
        lifted[place[i, 4 + j], start + offset] = 1.0
        if i == j:
            lifted[place[4 + i, 4 + i], start + offset] = 1.0
            cone = np.zeros((3, to_delta.shape[1]))
            cone[0, start + 10 + i] = 1.0
            cone[2, start + offset] = 1.0
            problem.exponential(cone, np.array([0.0, 1.0, 0.0]))
    problem.semidefinite(lifted, np.zeros(len(entries)), 8)


@dataclass(frozen=True)
class WeightChoice:
    """Chosen weight, with the score of every weight tried, in the order of the grid."""

    weight: float
    weights: tuple[float, ...]
    scores: tuple[float, ...]


def choose_weight(
    fit_for_weight: Callable[[float], Array], score: Callable[[Array], float], grid: Sequence[float]
) -> WeightChoice:
    """Return the weight with the smallest held-out score, and all scores; the larger weight of equal ones.

    Args:
        fit_for_weight: base parameters for a weight, shape (base,).
        score: function that scores base parameters on held-out recordings; smaller is better.
        grid: weights to try; of equal scores the larger weight wins, which asks less of the data.

    Raises:
        ParameterError: an empty grid, a negative weight or a score that is not a number.
    """
    if not grid or not all(np.isfinite(weight) and weight >= 0.0 for weight in grid):
        raise ParameterError("weights to choose from are one or more numbers from 0 up")
    scores = tuple(float(score(fit_for_weight(float(weight)))) for weight in grid)
    if not np.all(np.isfinite(scores)):
        raise ParameterError(f"held-out scores are not all finite: {scores}")
    best = min(range(len(grid)), key=lambda i: (scores[i], -grid[i]))
    return WeightChoice(float(grid[best]), tuple(float(weight) for weight in grid), scores)
