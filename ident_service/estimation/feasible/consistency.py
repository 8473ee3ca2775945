"""Check whether any arm could fulfil a set of conditions, after a problem over them had no solution."""

from __future__ import annotations

import numpy as np

from ident_service.errors import ParameterError, SolverError
from ident_service.estimation.feasible.conic import ConicProblem, Solution
from ident_service.estimation.feasible.feasible_set import FeasibleSet
from ident_service.estimation.feasible.posing import EPSILON, constrain, minimise, project
from ident_service.model.chain import Array

_LARGEST_MARGIN = 1.0
_SHARE = 1e-3


class ConditionsError(ParameterError, SolverError):
    """Report that no parameters at all fulfil the conditions; `blocks` are the conflicting ones."""

    def __init__(self, problem: str, status: str, blocks: tuple[str, ...]) -> None:
        SolverError.__init__(self, problem, status)
        self.blocks = blocks
        self.args = (f"{self.args[0]}, because these conditions contradict each other: {'; '.join(blocks)}",)


def contradiction(conditions: FeasibleSet) -> tuple[str, ...]:
    """Return the names of the conditions that conflict whatever the data; none where some delta fulfils all of them.

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
    """Return link parameters well inside a set, shape (parameters,); None where the conditions conflict.

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
