"""Pose feasibility problems in (beta, delta_d), and name conditions that exclude each other.

Where nothing bounds the mass of a link that hardly shows in beta, an optimum may only be approached as masses grow
beyond all limits, and where a solver stops on that way depends on rounding, so on the processor. Every estimate
without a prior is therefore sought with each link's tr(P) = m + tr(Sigma) bounded by a reach that no robot has. A
feasibility test asks whether any body exists; it is bounded only where it cannot be solved otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ident_service.errors import ParameterError, SolverError
from ident_service.estimation.feasible.conic import ConicProblem, Solution
from ident_service.estimation.feasible.feasible_set import Block, FeasibleSet, link_number_of, reference_scale
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.chain import Array

EPSILON = 1e-6  # eq. 21: the paper's margin, for links of about the size of the reference scales
_LEAST_INSET = 1e-11  # smallest distance from the boundary that a solver resolves
MULTIPLIER = 1e-6  # smaller multipliers are the interior-point method's own distance from the boundary
# Bounds of tr(P) to try, in turn: kg and kg m^2, times the largest base parameter or bound if that is above 1.
OF_TESTS = (np.inf, 1e4, 1e3, 1e2)
OF_TABLES = (1e4, 1e3, 1e2)  # the nearest feasible table; the paper's table 1 takes masses of thousands of kg to print
OF_ESTIMATES = (1e2, 1e3, 1e4)


class LinkParameterMap:
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
        """Return the link parameters with these base parameters and dependent parameters, shape (parameters,)."""
        return np.asarray(self.of_beta @ beta + self.of_dependent @ dependent)


def insets(conditions: FeasibleSet, base: BaseParameters, beta: Array) -> Array:
    """Return the distance that estimates keep inside each block: eq. 21 for usual links, less for smaller ones.

    A millionth of a kg m^2 is what the finger of a hand has. How small a link is shows in the base parameters that its
    own parameters lead.

    Args:
        conditions: the set.
        base: grouping of the parameters.
        beta: unconstrained base parameters, shape (base,).

    Returns:
        One inset per block, shape (blocks,).
    """
    sizes: dict[str, float] = {}
    for column, value in zip(base.base, beta, strict=True):
        name = base.names[column]
        if name.startswith(("L", "l", "m")):
            size = abs(float(value)) / reference_scale(name)
            sizes[link_number_of(name)] = max(sizes.get(link_number_of(name), 0.0), size)
    found = []
    for links in conditions.links:
        size = max((sizes.get(link, 1.0) for link in links), default=1.0)
        found.append(max(EPSILON * min(1.0, size), _LEAST_INSET))
    return np.array(found)


def constrain(problem: ConicProblem, block: Block, F: Array, f: Array) -> None:
    """Add to the problem that F x + f is in the block's cone: positive semidefinite, or not negative for numbers."""
    if block.size == 0:
        problem.nonnegative(F, f)
    else:
        problem.semidefinite(F, f, block.size)


def minimise(
    problem: ConicProblem,
    objective: Array,
    problem_name: str,
    to_delta: tuple[Array, Array],
    conditions: FeasibleSet,
    *,
    largest_parameter: float = 1.0,
    hessian_diagonal: Array | None = None,
    accept: Callable[[Array], bool] = lambda _: True,
    trace_bounds: Sequence[float] = OF_TESTS,
    first_tolerance: float | None = None,
) -> Solution:
    """Minimise an objective under `trace_bounds` on links' tr(P), in turn; return the first whose x `accept` takes.

    Args:
        problem: problem with all its constraints.
        objective: linear coefficients, shape (variables,).
        problem_name: of the problem, for errors.
        to_delta: T and d with delta = T x + d.
        conditions: feasible set whose links are bounded.
        largest_parameter: size of the largest base parameter, which a bound must not cut off.
        hessian_diagonal: diagonal of the Hessian, shape (variables,).
        accept: whether an optimum is accurate enough to be used.
        trace_bounds: bounds of tr(P) to try, in turn.
        first_tolerance: tolerance that is enough within the first bound; where it gives nothing, and when None, all
            digits are asked for.

    Raises:
        SolverError: no optimum within any reach, or none that is acceptable.
    """
    T, d = to_delta
    trace, top = traces(conditions), trace_unit(conditions, largest_parameter)
    status = ""
    tries = [(reach, None) for reach in trace_bounds]
    for reach, tolerance in tries if first_tolerance is None else [(trace_bounds[0], first_tolerance), *tries]:
        bounded = problem
        if np.isfinite(reach):
            bounded = problem.copy()
            bounded.nonnegative(-trace @ T / reach, top - trace @ d / reach)
        try:
            solution = bounded.minimise(objective, problem_name, hessian_diagonal, tolerance)
        except SolverError as error:
            if tolerance is not None:
                continue
            # Without a bound, infeasibility is that of the problem itself.
            if error.status.endswith("Infeasible") and bounded is problem:
                raise
            status = status or error.status
            continue
        if accept(solution.x):
            return replace(solution, bound=reach * top)
        status = status or "outside the set"
    raise SolverError(problem_name, status)


def trace_unit(conditions: FeasibleSet, largest_parameter: float) -> float:
    """Return the size that bounds on tr(P) are multiples of: the largest of 1, the parameter and the set's constants.

    Args:
        conditions: feasible set with the bounds.
        largest_parameter: size of the largest base parameter.
    """
    numbers = (np.abs(block.f).max(initial=0.0) for block in conditions.blocks)
    return max(1.0, largest_parameter, *map(float, numbers))


def traces(conditions: FeasibleSet) -> Array:
    """Return the rows T with T delta = tr(P_k) = m + tr(L)/2 of each link, shape (links, parameters)."""
    index = {name: column for column, name in enumerate(conditions.names)}
    links = [name[1:] for name in conditions.names if name.startswith("m") and name[1:].isdigit()]
    rows = np.zeros((len(links), len(index)))
    for row, link in zip(rows, links, strict=True):
        row[[index[f"Lxx{link}"], index[f"Lyy{link}"], index[f"Lzz{link}"]]] = 0.5
        row[index[f"m{link}"]] = 1.0
    return rows


def active_constraints(conditions: FeasibleSet, duals: Sequence[Array]) -> tuple[str, ...]:
    """Return the names of blocks with a large multiplier, so at the boundary; the largest multiplier first."""
    weights = [float(np.abs(dual).max()) for dual in duals[: len(conditions.blocks)]]
    order = sorted(range(len(weights)), key=lambda i: -weights[i])
    floor = max(MULTIPLIER, 1e-3 * max(weights))
    return tuple(conditions.blocks[i].name for i in order if weights[i] > floor)


def project(delta: Array, conditions: FeasibleSet) -> Array:
    """Return the delta nearest to the given one that fulfils the equalities; unchanged where the set has none."""
    E, e = conditions.equality_rows()
    if len(e) == 0:
        return delta
    moved = np.asarray(delta - np.linalg.pinv(E) @ (E @ delta + e))
    # An equality about one parameter alone is a value, without rounding.
    for row in np.flatnonzero(np.count_nonzero(E, axis=1) == 1):
        column = int(np.flatnonzero(E[row])[0])
        moved[column] = -e[row] / E[row, column] + 0.0
    return moved


def require_consistent(beta: Array, base: BaseParameters, conditions: FeasibleSet) -> None:
    """Raise ParameterError unless base parameters, grouping and feasible set fit each other in shape and names.

    Raises:
        ParameterError: shapes or names do not fit.
    """
    if beta.shape != (base.size,):
        raise ParameterError(f"{beta.shape=} but there are {base.size} base parameters")
    if conditions.names != base.names:
        raise ParameterError("the feasible set and the base parameters are about different link parameters")


_LARGEST_MARGIN = 1.0
_SHARE = 1e-3


class ConditionsError(ParameterError, SolverError):
    """Report that no parameters at all fulfil the conditions; `blocks` are the conflicting ones."""

    def __init__(self, problem: str, status: str, blocks: tuple[str, ...]) -> None:
        SolverError.__init__(self, problem, status)
        self.blocks = blocks
        self.args = (f"{self.args[0]}, because these conditions contradict each other: {'; '.join(blocks)}",)


def conflicting_constraints(conditions: FeasibleSet) -> tuple[str, ...]:
    """Return the names of the conditions that conflict whatever the data; empty if some delta has a margin above 1e-6.

    Below the inset that every problem keeps, the multipliers of the largest margin name the blocks of the proof.

    Raises:
        SolverError: the solver stopped without an optimum.
    """
    solution = _largest_margin(conditions)
    if -solution.objective > EPSILON:
        return ()
    bound = len(conditions.blocks)
    named = [*zip(conditions.blocks, solution.duals[:bound], strict=True)]
    # The bound of the margin itself stands between blocks and equalities.
    named += zip(conditions.equalities, solution.duals[bound + 1 :], strict=False)
    weights = [float(np.abs(dual).max(initial=0.0)) for _, dual in named]
    order = sorted(range(len(named)), key=lambda i: -weights[i])
    return tuple(named[i][0].name for i in order if weights[i] > _SHARE * max(weights))


def interior_point(conditions: FeasibleSet) -> Array | None:
    """Return link parameters with the largest margin in a set, shape (parameters,); None where the conditions conflict.

    Raises:
        SolverError: the solver stopped without an optimum.
    """
    solution = _largest_margin(conditions)
    return project(solution.x[:-1], conditions) if -solution.objective > 0.0 else None


def _largest_margin(conditions: FeasibleSet) -> Solution:
    """Solve for the largest t with D(delta) - t 1 >= 0 over all delta; x is (delta, t)."""
    n = len(conditions.names)
    problem = ConicProblem(n + 1)
    for block in conditions.blocks:
        constrain(problem, block, np.column_stack([block.F, -block.identity()]), block.f)
    problem.nonnegative(np.append(np.zeros(n), -1.0)[None], np.array([_LARGEST_MARGIN]))
    for block in conditions.equalities:
        problem.zero(np.column_stack([block.F, np.zeros(len(block.f))]), block.f)
    objective = np.append(np.zeros(n), -1.0)
    return minimise(problem, objective, "consistency of the conditions", (np.eye(n, n + 1), np.zeros(n)), conditions)
