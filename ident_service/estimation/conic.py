"""The door to Clarabel: minimise a linear objective over affine maps into cones.

Every problem of this package is written as `F x + f in K` with K the non-negative numbers, a second-order cone or the
positive semidefinite matrices, the latter by the entries of their upper triangle, column by column.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import clarabel
import numpy as np
import scipy.sparse

from ident_service.errors import SolverError
from ident_service.model.chain import Array


@dataclass(frozen=True)
class Solution:
    """An optimum.

    Attributes:
        x: the variables, shape (variables,).
        duals: per constraint in the order they were added, its multiplier; matrices by upper triangle as above.
        objective: value of the linear objective.
        iterations: of the interior-point method.
        seconds: inside the solver.
    """

    x: Array
    duals: tuple[Array, ...]
    objective: float
    iterations: int
    seconds: float


@dataclass
class ConicProblem:
    """Constraints gathered one by one, then solved.

    Attributes:
        variables: how many.
    """

    variables: int
    _rows: list[Array] = field(default_factory=list)
    _offsets: list[Array] = field(default_factory=list)
    _cones: list[object] = field(default_factory=list)
    _scales: list[Array] = field(default_factory=list)

    def nonnegative(self, F: Array, f: Array) -> None:
        """`F x + f >= 0` entry by entry; F of shape (rows, variables)."""
        self._add(F, f, clarabel.NonnegativeConeT(len(f)), np.ones(len(f)))

    def second_order(self, F: Array, f: Array) -> None:
        """The first entry of `F x + f` is at least the norm of the others."""
        self._add(F, f, clarabel.SecondOrderConeT(len(f)), np.ones(len(f)))

    def semidefinite(self, F: Array, f: Array, size: int) -> None:
        """`F x + f` is the upper triangle of a positive semidefinite matrix of `size` rows."""
        scale = np.array([1.0 if i == j else np.sqrt(2.0) for i, j in triangle_entries(size)])
        self._add(F * scale[:, None], f * scale, clarabel.PSDTriangleConeT(size), scale)

    def _add(self, F: Array, f: Array, cone: object, scale: Array) -> None:
        self._rows.append(F)
        self._offsets.append(f)
        self._cones.append(cone)
        self._scales.append(scale)

    def minimise(self, objective: Array, name: str) -> Solution:
        """Solve.

        Args:
            objective: coefficients, shape (variables,).
            name: what to call the problem in an error.

        Raises:
            SolverError: the solver stopped anywhere but at an optimum.
        """
        A = scipy.sparse.csc_matrix(-np.vstack(self._rows))
        b = np.concatenate(self._offsets)
        P = scipy.sparse.csc_matrix((self.variables, self.variables))
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.max_iter = 200
        settings.max_threads = 1
        # Distances of a thousandth and margins of a millionth are results here.
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-9
        result = clarabel.DefaultSolver(P, objective, A, b, self._cones, settings).solve()
        if result.status != clarabel.SolverStatus.Solved:
            raise SolverError(name, str(result.status))
        ends = np.cumsum([len(f) for f in self._offsets])[:-1]
        duals = tuple(
            dual / scale for dual, scale in zip(np.split(np.array(result.z), ends), self._scales, strict=True)
        )
        return Solution(np.array(result.x), duals, float(result.obj_val), result.iterations, result.solve_time)


def triangle_entries(size: int) -> list[tuple[int, int]]:
    """Row and column of each entry of an upper triangle, column by column."""
    return [(i, j) for j in range(size) for i in range(j + 1)]
