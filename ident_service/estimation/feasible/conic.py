"""Call Clarabel: minimise a linear or convex quadratic objective over affine maps into cones.

Every problem of this package is written as `F x + f in K` with K zero, the non-negative numbers, a second-order cone,
the exponential cone or the positive semidefinite matrices, the latter by the entries of their upper triangle, column by
column.

Interior points lose digits where an optimum is not unique or lies far out, which is common here: a link that no motion
feels may weigh anything. So a solve that stops early is posed again in the fixed order of `_POSES`, then at the next
of `_TOLERANCES`; what it ends with is an optimum to a stated tolerance, or an error with the solver's own word.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import clarabel
import numpy as np
import scipy.sparse

from ident_service.errors import SolverError
from ident_service.estimation.feasible.restate import Columns, Pose, Rows, restated
from ident_service.model.chain import Array


@dataclass(frozen=True)
class Solution:
    """Optimum of a conic problem.

    Attributes:
        x: the variables, shape (variables,).
        duals: per constraint in the order they were added, its multiplier; matrices by upper triangle as above.
        objective: value of the objective.
        iterations: of the interior-point method, over all attempts.
        seconds: inside the solver, over all attempts.
        tolerance: of gap and feasibility, relative, that the solver was asked for and reached.
        attempts: how many times the problem was posed, 1 unless the solver stopped early.
        bound: of each link's tr(P) [kg] that the problem was posed with, see `posing.py`.
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
class _Pose:
    """Options of one solver attempt: share of the way to the boundary per step, scaling passes, coordinates."""

    step: float
    equilibrations: int
    around: Columns | None = None


# Distances of a thousandth and margins of a millionth are results here: 1e-9 first, in every pose. The looser ones are
# for problems whose last digits the solver cannot separate from rounding, in the poses that came close.
_TOLERANCES = (1e-9, 1e-8, 1e-7)
_POSES = (_Pose(0.99, 10), _Pose(0.95, 30, "unit"), _Pose(0.9, 50), _Pose(0.9, 10, "orthonormal"))
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
    _scales: list[Array] = field(default_factory=list)

    def zero(self, F: Array, f: Array) -> None:
        """Add `F x + f = 0` entry by entry; F of shape (rows, variables)."""
        self._add(Rows("zero", F, f), np.ones(len(f)))

    def nonnegative(self, F: Array, f: Array) -> None:
        """Add `F x + f >= 0` entry by entry; F of shape (rows, variables)."""
        self._add(Rows("nonnegative", F, f), np.ones(len(f)))

    def second_order(self, F: Array, f: Array) -> None:
        """Add the condition that the first entry of `F x + f` is at least the norm of the others."""
        self._add(Rows("second_order", F, f), np.ones(len(f)))

    def exponential(self, F: Array, f: Array) -> None:
        """Add the condition b exp(a / b) <= c on the three entries (a, b, c) of `F x + f`."""
        self._add(Rows("exponential", F, f), np.ones(len(f)))

    def semidefinite(self, F: Array, f: Array, size: int) -> None:
        """Add the condition that `F x + f` is the upper triangle of a positive semidefinite matrix of `size` rows."""
        scale = np.array([1.0 if i == j else np.sqrt(2.0) for i, j in triangle_entries(size)])
        self._add(Rows("semidefinite", F * scale[:, None], f * scale, size), scale)

    def copy(self) -> ConicProblem:
        """Return a copy of the problem that further constraints can be added to."""
        return ConicProblem(self.variables, list(self._rows), list(self._scales), rough=self.rough)

    def _add(self, rows: Rows, scale: Array) -> None:
        self._rows.append(rows)
        self._scales.append(scale)

    def minimise(self, objective: Array, name: str, quadratic: Array | None = None) -> Solution:
        """Minimise an objective over the constraints.

        Args:
            objective: linear coefficients, shape (variables,).
            name: what to call the problem in an error.
            quadratic: non-negative diagonal of the Hessian, shape (variables,); the objective is
                `objective^T x + x^T diag(quadratic) x / 2`.

        Raises:
            SolverError: the solver stopped anywhere but at an optimum, in every pose; with the first pose's status.
        """
        hessian = np.zeros(self.variables) if quadratic is None else quadratic
        around = np.zeros(self.variables)
        status, attempts, iterations, seconds = "", 0, 0, 0.0
        # Orthonormal coordinates make every constraint one of all variables, which costs twenty times as much.
        close = [way for way in _POSES if not (self.rough and way.around == "orthonormal")]
        for tolerance in _TOLERANCES[-1:] if self.rough else _TOLERANCES:
            for way in tuple(close):
                pose = restated(self._rows, objective, hessian, around, way.around)
                result = _solve(pose, way, tolerance)
                attempts, iterations = attempts + 1, iterations + result.iterations
                seconds += result.solve_time
                x = pose.point(np.array(result.x))
                if result.status == clarabel.SolverStatus.Solved:
                    value = float(objective @ x + 0.5 * hessian @ x**2)
                    duals = self._duals(pose, np.array(result.z))
                    return Solution(x, duals, value, iterations, seconds, tolerance, attempts)
                status = status or str(result.status)
                if result.status in _FINAL and way.around is None:
                    raise SolverError(name, str(result.status))
                if result.status != clarabel.SolverStatus.AlmostSolved:
                    close.remove(way)
                if way.around is None and np.all(np.isfinite(x)):
                    around = x
        raise SolverError(name, status)

    def _duals(self, pose: Pose, z: Array) -> tuple[Array, ...]:
        ends = np.cumsum([len(rows.f) for rows in self._rows])[:-1]
        return tuple(dual / scale for dual, scale in zip(pose.duals(np.split(z, ends)), self._scales, strict=True))


def _solve(pose: Pose, way: _Pose, tolerance: float) -> clarabel.DefaultSolution:
    A = scipy.sparse.csc_matrix(-np.vstack([block.F for block in pose.rows]))
    b = np.concatenate([block.f for block in pose.rows])
    hessian = np.diag(pose.hessian) if pose.hessian.ndim == 1 else np.triu(pose.hessian)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_iter = 200
    settings.max_threads = 1
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    # `AlmostSolved` then means that the loosest tolerance was reached.
    settings.reduced_tol_gap_abs = settings.reduced_tol_gap_rel = settings.reduced_tol_feas = _TOLERANCES[-1]
    settings.max_step_fraction = way.step
    settings.equilibrate_max_iter = way.equilibrations
    cones = [_cone(block) for block in pose.rows]
    return clarabel.DefaultSolver(scipy.sparse.csc_matrix(hessian), pose.objective, A, b, cones, settings).solve()


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
