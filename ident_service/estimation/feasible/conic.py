"""Minimise a linear or convex quadratic objective over cones, by Clarabel.

With x = x0 + C y and a congruence U S U^T of every matrix slack S, a problem keeps its optimum but not its rounding:
what was a difference of large numbers far out becomes a number of order one. Multipliers of a slack mapped by M map
back by M^T.

Every problem of this package is written as `F x + f in K` with K zero, the non-negative numbers, a second-order cone,
the exponential cone or the positive semidefinite matrices, the latter by the entries of their upper triangle, column by
column.

Interior points lose digits where an optimum is not unique or lies far out, which is common here: a link that no motion
feels may weigh anything. So a solve that stops early is posed again in the fixed order of `_POSES`, then at the next
of `_TOLERANCES`; what it ends with is an optimum to a stated tolerance, or an error with the solver's own word.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import clarabel
import numpy as np
from numpy.typing import NDArray

from ident_service.errors import SolverError
from ident_service.model.chain import Array

ColumnScaling = Literal["unit", "orthonormal"]

_RANK = 1e-12  # of the largest singular value: below it, a direction that no constraint feels
_FLOOR = 1e-6  # of the largest eigenvalue: scaling by smaller ones would magnify rounding


@dataclass(frozen=True)
class Rows:
    """Constraint `F x + f` in one cone.

    Attributes:
        cone: kind of cone.
        F: shape (rows, variables).
        f: shape (rows,).
        size: rows of the matrix, for `semidefinite`; off-diagonal entries carry sqrt(2).
    """

    cone: Literal["zero", "nonnegative", "second_order", "exponential", "semidefinite"]
    F: Array
    f: Array
    size: int = 0


@dataclass(frozen=True)
class ScaledProblem:
    """Scaled problem for the solver, with the maps back to the original variables.

    Attributes:
        rows: constraints on y.
        objective: linear coefficients of y.
        hessian: quadratic part in y, a matrix or its diagonal.
        origin: x0.
        columns: C, a matrix or its diagonal.
        maps: per constraint M, a matrix or its diagonal.
        scale: divisor of the objective.
    """

    rows: list[Rows]
    objective: Array
    hessian: Array
    origin: Array
    columns: Array
    maps: tuple[Array, ...]
    scale: float

    def point(self, scaled_variables: Array) -> Array:
        """Return the variables x in the problem's original coordinates, from the scaled ones y."""
        return np.asarray(self.origin + _apply(self.columns, scaled_variables))

    def duals(self, scaled_duals: Sequence[Array]) -> list[Array]:
        """Return the multipliers in the problem's original coordinates, from those of the scaled problem."""
        return [self.scale * _transposed(M, z) for M, z in zip(self.maps, scaled_duals, strict=True)]


def precondition(
    rows: Sequence[Rows], objective: Array, hessian: Array, around: Array, column_scaling: ColumnScaling | None
) -> ScaledProblem:
    """Return the conic problem rescaled around a point for better conditioning; unchanged if `column_scaling` is None.

    Args:
        rows: constraints.
        objective: linear coefficients, shape (variables,).
        hessian: diagonal of the quadratic part, shape (variables,).
        around: x0, shape (variables,).
        column_scaling: whether C makes the constraints' columns of unit length, or orthonormal; None leaves everything
            as it is.
    """
    if column_scaling is None:
        n = len(objective)
        ones = tuple(np.ones(len(block.f)) for block in rows)
        return ScaledProblem(list(rows), objective, hessian, np.zeros(n), np.ones(n), ones, 1.0)
    slacks = [block.F @ around + block.f for block in rows]
    maps = tuple(_map(block, slack) for block, slack in zip(rows, slacks, strict=True))
    F = [_apply(M, block.F) for M, block in zip(maps, rows, strict=True)]
    stacked = np.vstack(F)
    norms = np.linalg.norm(stacked, axis=0)
    C = 1.0 / np.where(norms > 0.0, norms, 1.0)
    if column_scaling == "orthonormal":
        triangle = np.linalg.qr(stacked * C, mode="r")
        _, values, right = np.linalg.svd(np.vstack([triangle, np.zeros((len(C) - len(triangle), len(C)))]))
        C = C[:, None] * right.T / np.where(values > _RANK * values[0], values, 1.0)
    linear = _transposed(C, objective + hessian * around)
    quadratic = C**2 * hessian if C.ndim == 1 else C.T @ (hessian[:, None] * C)
    scale = max(float(np.linalg.norm(linear)), np.finfo(float).tiny)
    return ScaledProblem(
        [
            Rows(block.cone, part * C if C.ndim == 1 else part @ C, _apply(M, slack), block.size)
            for block, part, M, slack in zip(rows, F, maps, slacks, strict=True)
        ],
        linear / scale,
        quadratic / scale,
        around,
        C,
        maps,
        scale,
    )


def _apply(M: Array, values: Array) -> Array:
    """Return the product of M, a matrix or the diagonal of one, with `values`."""
    if M.ndim == 2:
        return np.asarray(M @ values)
    return np.asarray(M * values if values.ndim == 1 else M[:, None] * values)


def _transposed(M: Array, values: Array) -> Array:
    return np.asarray(M.T @ values if M.ndim == 2 else M * values)


def _map(block: Rows, slack: Array) -> Array:
    tiny = np.finfo(float).tiny
    match block.cone:
        case "semidefinite":
            values, vectors = np.linalg.eigh(_matrix(slack, block.size))
            values = np.maximum(values, max(_FLOOR * abs(float(values[-1])), tiny))
            return _congruence((vectors / np.sqrt(values)).T)
        case "nonnegative":
            size = np.abs(slack)
            return np.asarray(1.0 / np.maximum(size, max(_FLOOR * float(size.max()), tiny)))
        case "second_order":
            return np.full(len(slack), 1.0 / max(float(np.linalg.norm(slack)), tiny))
        case "zero" | "exponential":
            return np.ones(len(slack))


def _entries(size: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Return row, column and weight of each entry of an upper triangle, as `triangle_entries` orders them."""
    columns = np.concatenate([np.full(j + 1, j) for j in range(size)])
    rows = np.concatenate([np.arange(j + 1) for j in range(size)])
    return rows, columns, np.where(rows == columns, 1.0, np.sqrt(2.0))


def _matrix(entries: Array, size: int) -> Array:
    i, j, weight = _entries(size)
    matrix = np.zeros((size, size))
    matrix[i, j] = matrix[j, i] = entries / weight
    return matrix


def _congruence(U: Array) -> Array:
    """Return M with svec(U S U^T) = M svec(S), shape (entries, entries)."""
    i, j, weight = _entries(len(U))
    # (U S U^T)_ab = sum_ij U_ai S_ij U_bj, each off-diagonal entry of S counted from both sides.
    both = U[np.ix_(i, i)] * U[np.ix_(j, j)] + U[np.ix_(i, j)] * U[np.ix_(j, i)]
    return np.asarray(weight[:, None] * both / np.where(i == j, 2.0, weight)[None, :])


@dataclass(frozen=True)
class Solution:
    """Optimum of a conic problem.

    Attributes:
        x: the variables, shape (variables,).
        duals: per constraint in the order they were added, its multiplier; matrices by upper triangle as above.
        objective: value of the objective.
        iterations: iterations of the interior-point method, over all attempts.
        seconds: time inside the solver [s], over all attempts.
        tolerance: relative tolerance of gap and feasibility that the solver was asked for and reached.
        attempts: how many times the problem was posed, 1 unless the solver stopped early.
        bound: upper bound of each link's tr(P) [kg] in the posed problem, see `formulation.py`.
    """

    x: Array
    duals: tuple[Array, ...]
    objective: float
    iterations: int
    seconds: float
    tolerance: float = 1e-9
    attempts: int = 1
    bound: float = np.inf


@dataclass(frozen=True)
class _SolverAttempt:
    """Options of one solver attempt: share of the way to the boundary per step, scaling passes, coordinates."""

    step: float
    equilibrations: int
    column_scaling: ColumnScaling | None = None


# Distances of a thousandth and margins of a millionth are results here: 1e-9 first, in every pose. The looser ones are
# for problems whose last digits the solver cannot separate from rounding, in the poses that came close.
_TOLERANCES = (1e-9, 1e-8, 1e-7)
_POSES = (
    _SolverAttempt(0.99, 10),
    _SolverAttempt(0.95, 30, "unit"),
    _SolverAttempt(0.9, 50),
    _SolverAttempt(0.9, 10, "orthonormal"),
)
_FINAL = (clarabel.SolverStatus.PrimalInfeasible, clarabel.SolverStatus.DualInfeasible)


@dataclass
class ConicProblem:
    """Conic problem: constraints are added one by one, then it is solved.

    Attributes:
        variables: number of variables.
        rough: whether seven digits are enough, and a problem that is hard may stay unsolved.
    """

    variables: int
    rough: bool = field(default=False, kw_only=True)
    _rows: list[Rows] = field(default_factory=list)

    def zero(self, F: Array, f: Array) -> None:
        """Add `F x + f = 0` entry by entry; F of shape (rows, variables)."""
        self._rows.append(Rows("zero", F, f))

    def nonnegative(self, F: Array, f: Array) -> None:
        """Add `F x + f >= 0` entry by entry; F of shape (rows, variables)."""
        self._rows.append(Rows("nonnegative", F, f))

    def second_order(self, F: Array, f: Array) -> None:
        """Add the condition that the first entry of `F x + f` is at least the norm of the others."""
        self._rows.append(Rows("second_order", F, f))

    def exponential(self, F: Array, f: Array) -> None:
        """Add the condition b exp(a / b) <= c on the three entries (a, b, c) of `F x + f`."""
        self._rows.append(Rows("exponential", F, f))

    def semidefinite(self, F: Array, f: Array, size: int) -> None:
        """Add the condition that `F x + f` is the upper triangle of a positive semidefinite matrix of `size` rows."""
        *_, weight = _entries(size)
        self._rows.append(Rows("semidefinite", F * weight[:, None], f * weight, size))

    def copy(self) -> ConicProblem:
        """Return a copy of the problem that further constraints can be added to."""
        return ConicProblem(self.variables, list(self._rows), rough=self.rough)

    def minimise(
        self,
        objective: Array,
        problem_name: str,
        hessian_diagonal: Array | None = None,
        sufficient_tolerance: float | None = None,
    ) -> Solution:
        """Return the x that minimises an objective over the constraints added so far; raises SolverError.

        Args:
            objective: linear coefficients, shape (variables,).
            problem_name: name of the problem, for errors.
            hessian_diagonal: non-negative diagonal of the Hessian, shape (variables,); the objective is
                `objective^T x + x^T diag(hessian_diagonal) x / 2`.
            sufficient_tolerance: tolerance that is enough, of a problem that is posed once; None for nine digits, in
                any pose.

        Raises:
            SolverError: the solver stopped anywhere but at an optimum, in every pose; with the first pose's status.
        """
        hessian = np.zeros(self.variables) if hessian_diagonal is None else hessian_diagonal
        around = np.zeros(self.variables)
        status, attempts, iterations, seconds = "", 0, 0, 0.0
        # Orthonormal coordinates make every constraint one of all variables, which costs twenty times as much.
        close = [attempt for attempt in _POSES if not (self.rough and attempt.column_scaling == "orthonormal")]
        tolerances = _TOLERANCES[-1:] if self.rough else _TOLERANCES
        if sufficient_tolerance is not None:
            close, tolerances = close[:1], (sufficient_tolerance,)
        for tolerance in tolerances:
            for attempt in tuple(close):
                pose = precondition(self._rows, objective, hessian, around, attempt.column_scaling)
                result = _solve(pose, attempt, tolerance)
                attempts, iterations = attempts + 1, iterations + result.iterations
                seconds += result.solve_time
                x = pose.point(np.array(result.x))
                if result.status == clarabel.SolverStatus.Solved:
                    value = float(objective @ x + 0.5 * hessian @ x**2)
                    duals = self._duals(pose, np.array(result.z))
                    return Solution(x, duals, value, iterations, seconds, tolerance, attempts)
                status = status or str(result.status)
                if result.status in _FINAL and attempt.column_scaling is None:
                    raise SolverError(problem_name, str(result.status))
                if result.status != clarabel.SolverStatus.AlmostSolved:
                    close.remove(attempt)
                if attempt.column_scaling is None and np.all(np.isfinite(x)):
                    around = x
        raise SolverError(problem_name, status)

    def _duals(self, pose: ScaledProblem, z: Array) -> tuple[Array, ...]:
        ends = np.cumsum([len(rows.f) for rows in self._rows])[:-1]
        found = zip(pose.duals(np.split(z, ends)), self._rows, strict=True)
        return tuple(dual / _entries(rows.size)[2] if rows.size else dual for dual, rows in found)


@dataclass(frozen=True)
class CompressedColumns:
    """Sparse matrix as Clarabel reads it: by the attributes of scipy.sparse's `csc_matrix`, without its checks.

    Attributes:
        data: nonzero entries, column by column.
        indices: row of each.
        indptr: where each column begins, and the end of the last one, shape (columns + 1,).
        shape: rows and columns.
        has_canonical_format: rows of each column increase, and none stands twice.
    """

    data: Array
    indices: NDArray[np.intp]
    indptr: NDArray[np.intp]
    shape: tuple[int, int]
    has_canonical_format: bool = True

    @staticmethod
    def of(matrix: Array) -> CompressedColumns:
        """Build the compressed sparse columns of a matrix."""
        columns, rows = np.nonzero(matrix.T)
        ends = np.searchsorted(columns, np.arange(matrix.shape[1] + 1))
        return CompressedColumns(matrix[rows, columns], rows, ends, (matrix.shape[0], matrix.shape[1]))


def _solve(pose: ScaledProblem, attempt: _SolverAttempt, tolerance: float) -> clarabel.DefaultSolution:
    A = CompressedColumns.of(-np.vstack([block.F for block in pose.rows]))
    b = np.concatenate([block.f for block in pose.rows])
    hessian = np.diag(pose.hessian) if pose.hessian.ndim == 1 else np.triu(pose.hessian)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_iter = 200
    settings.max_threads = 1
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    # `AlmostSolved` then means that the loosest tolerance was reached.
    loosest = max(tolerance, _TOLERANCES[-1])
    settings.reduced_tol_gap_abs = settings.reduced_tol_gap_rel = settings.reduced_tol_feas = loosest
    settings.max_step_fraction = attempt.step
    settings.equilibrate_max_iter = attempt.equilibrations
    cones = [_cone(block) for block in pose.rows]
    return clarabel.DefaultSolver(CompressedColumns.of(hessian), pose.objective, A, b, cones, settings).solve()


def _cone(rows: Rows) -> object:
    match rows.cone:
        case "zero":
            return clarabel.ZeroConeT(len(rows.f))
        case "nonnegative":
            return clarabel.NonnegativeConeT(len(rows.f))
        case "second_order":
            return clarabel.SecondOrderConeT(len(rows.f))
        case "exponential":
            return clarabel.ExponentialConeT()
        case "semidefinite":
            return clarabel.PSDTriangleConeT(rows.size)


def triangle_entries(size: int) -> list[tuple[int, int]]:
    """Return row and column of each entry of an upper triangle, column by column."""
    return [(i, j) for j in range(size) for i in range(j + 1)]
