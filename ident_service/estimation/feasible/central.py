"""Choose link parameters among all that have the same base parameters: those at the centre of the feasible set.

Motion shows base parameters only. Which of the many bodies behind them an interior-point method ends with depends on
its path, so on rounding and on the processor. The answer here does not: it minimises

    f(delta) = sum_blocks -logdet(D_b(delta) - t 1) + sum_links tr(S_b^-1 D_b(delta))
    over all delta with K delta = beta and E delta + e = 0

with S_b what D_b is of a likely body where one is known, else the reference scales of `blocks.py`, and t half of the
paper's margin (eq. 21), so that where data press against the set no more than the other half is given up. The first sum
is the barrier whose minimiser is the analytic centre (Boyd and Vandenberghe, *Convex Optimization*, 8.5.3); with the
second, f is per link the entropic divergence from the likely body, or from one of 1 kg and 0.1 m (Lee, Wensing and Park
2020), so that nothing is drawn to infinity where nothing bounds a mass. f is strictly convex and self-concordant;
Newton's method finds its minimiser to the last digits.

Where data press against the set, the only bodies with exactly these base parameters are nearly points and rods. So an
estimate's base parameters may move by far less than is known of them, K delta = beta + x with |N x| < 1, and f has the
barrier -log(1 - |N x|^2) besides. Along what data do not see x is free; the drive inertias that then are have a likely
value as bodies have, -log Ia + Ia / Ia_likely.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from ident_service.estimation.feasible.blocks import Block, symmetric
from ident_service.estimation.feasible.feasible_set import FeasibleSet
from ident_service.estimation.feasible.posing import EPSILON, Lift
from ident_service.model.base import BaseParameters
from ident_service.model.chain import Array
from ident_service.model.likely_bodies import LikelyBodies

_ITERATIONS = 200
_CONVERGED = 1e-10  # Newton's decrement: the distance from the minimiser in the metric of f
_QUADRATIC = 1e-2  # decrement from which Newton's method at least halves it with every step, unless rounding forbids
_STEP = 0.99  # largest share of the distance to the boundary in one step
_LONGEST = 10.0  # largest multiple of Newton's step
_HALVINGS = 50  # bisections of the step length
_KEPT = 0.5  # share of the margin, at most the paper's, that is left where data press against the set


@dataclass(frozen=True)
class Near:
    """Ellipsoid that base parameters may move in.

    Attributes:
        origin: base parameters that they move from [SI], shape (base,).
        metric: N above, shape (rows, base).
        moves: which base parameters may move, shape (base,).
    """

    origin: Array
    metric: Array
    moves: NDArray[np.bool_]

    def moved(self, beta: Array) -> Array:
        """Return N x of other base parameters, shape (rows,); they are near where its length is below 1."""
        return np.asarray(self.metric @ (beta - self.origin))


@dataclass(frozen=True)
class _Matrix:
    """Symmetric matrix of the set over its reference scale, as an affine function of the free directions.

    Attributes:
        value: shape (size, size).
        directions: free directions that change the matrix, shape (changing,).
        slopes: its derivatives along them, shape (changing, size, size).
        bounded: whether its trace is part of f, as that of a link's inertia is.
    """

    value: Array
    directions: NDArray[np.intp]
    slopes: Array
    bounded: bool


def central(
    delta: Array,
    base: BaseParameters,
    conditions: FeasibleSet,
    likely: LikelyBodies | None = None,
    near: Near | None = None,
) -> Array:
    """Move link parameters to the centre of those with the same base parameters.

    Args:
        delta: inside the feasible set (margin above 0), SI units, shape (parameters,).
        base: grouping of the parameters.
        conditions: the feasible set.
        likely: bodies to stay near to; ones of 1 kg and 0.1 m at each link's origin when None.
        near: how far base parameters may move; none moves when None.

    Returns:
        Link parameters with the same base parameters to rounding, or as near to them as `near` says, inside the set,
        shape (parameters,); `delta` itself where rounding forbids a step.
    """
    lift = Lift(base)
    N = np.zeros((0, base.size)) if near is None else near.metric
    begin = np.zeros(0) if near is None else near.moved(base.K @ delta)
    moving = np.zeros(0, dtype=int) if near is None else np.flatnonzero(near.moves)
    free = np.column_stack([lift.of_dependent, lift.of_beta[:, moving]])
    N = np.column_stack([np.zeros((len(N), len(lift.dependent))), N[:, moving]])
    E, _ = conditions.equality_rows()
    if len(E):
        kept = scipy.linalg.null_space(E @ free)
        free, N = free @ kept, N @ kept
    inset = _KEPT * min(EPSILON, conditions.margin(delta)[0])
    matrices = [matrix for block in conditions.blocks for matrix in _matrices(block, delta, free, inset, likely)]
    y, before = np.zeros(free.shape[1]), np.inf
    for _ in range(_ITERATIONS if matrices else 0):
        # With D = L L^T and M_k = L^-1 dD/dy_k L^-T, f has the gradient -J^T r and the Hessian J^T J, where J has the
        # columns vec(M_k) and r is vec(1 - L^T L): Newton's step is a least-squares problem, without the square of its
        # condition number.
        rows, wanted, moves = [], [], []
        for matrix in matrices:
            try:
                L = np.linalg.cholesky(matrix.value + np.tensordot(y[matrix.directions], matrix.slopes, 1))
            except np.linalg.LinAlgError:  # so close to the boundary, at such size, that rounding decides
                return delta
            inverse = np.linalg.inv(L)
            move = inverse @ matrix.slopes @ inverse.T
            J = np.zeros((L.size, len(y)))
            J[:, matrix.directions] = move.reshape(len(move), -1).T
            rows.append(J)
            wanted.append((np.eye(len(L)) - (L.T @ L if matrix.bounded else 0.0)).ravel())
            moves.append(move)
        away = begin + N @ y
        left = 1.0 - float(away @ away)
        J = np.vstack([*rows, np.sqrt(2.0 / left) * N, 2.0 / left * (away @ N)[None]])
        r = np.concatenate([*wanted, -np.sqrt(2.0 / left) * away, np.zeros(1)])
        norms = np.linalg.norm(J, axis=0)
        unit = np.divide(1.0, norms, out=np.zeros(len(norms)), where=norms > 0.0)  # 0: no condition feels the direction
        step = unit * scipy.linalg.lstsq(J * unit, r, lapack_driver="gelsy")[0]
        decrement = float(np.linalg.norm(J @ step))
        if decrement < _CONVERGED or (decrement < _QUADRATIC and decrement > 0.5 * before):
            break
        before = decrement
        along = [np.tensordot(step[matrix.directions], move, 1) for matrix, move in zip(matrices, moves, strict=True)]
        changes = np.concatenate([np.linalg.eigvalsh(change) for change in along])
        y += _length(changes, away, N @ step, decrement) * step
    found = np.asarray(delta + free @ y)
    return found if conditions.margin(found)[0] > 0.0 else delta


def _length(changes: Array, away: Array, going: Array, decrement: float) -> float:
    """Return the step length s that minimises f along Newton's step.

    `changes` are the mu below, and |N x| is that of `away` + s `going`.

    There f is -sum log(1 + s mu) - log(1 - |N x|^2) and linear in s besides, with the slope -decrement^2 at 0.
    """
    c, b, a = float(away @ away), float(away @ going), float(going @ going)

    def bound(s: float) -> float:
        return 2.0 * (b + a * s) / (1.0 - c - 2.0 * b * s - a * s**2)

    def slope(s: float) -> float:
        barrier = float(np.sum(changes * (1.0 - 1.0 / (1.0 + s * changes))))
        return barrier + bound(s) - bound(0.0) - decrement**2

    longest = min(_STEP / max(-float(changes.min()), np.finfo(float).tiny), _LONGEST)
    if a > 0.0:  # to where |N x| is 1
        longest = min(longest, _STEP * (np.sqrt(b**2 + a * (1.0 - c)) - b) / a)
    if slope(longest) < 0.0:
        return longest
    # f is convex: halving finds its minimum, without the 0.1 s in which scipy.optimize loads.
    low, high = 0.0, longest
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if slope(middle) < 0.0 else (low, middle)
    return 0.5 * (low + high)


def _matrices(block: Block, delta: Array, free: Array, inset: float, likely: LikelyBodies | None) -> list[_Matrix]:
    """Return the block's matrix, or its numbers as matrices of one row, without those that no direction changes."""
    values, slopes = block.F @ delta + block.f - inset * block.identity(), block.F @ free
    directions = np.flatnonzero(np.any(slopes != 0.0, axis=0))
    if block.size:
        G = np.linalg.inv(_root(block, likely))
        value, *found = (G @ symmetric(entries, block.size) @ G.T for entries in (values, *slopes.T[directions]))
        return [_Matrix(value, directions, np.array(found), bounded=True)] if found else []
    units = block.references()
    drives = np.zeros(len(units), dtype=bool)
    if likely is not None:  # of drive inertias, which nothing else bounds
        own = block.F @ likely.drives
        drives = own > 0.0
        units = np.where(drives, own, units)
    scaled = zip(values / units, slopes / units[:, None], drives, strict=True)
    return [
        _Matrix(np.full((1, 1), value), np.flatnonzero(row), row[row != 0.0][:, None, None], bounded=bool(drive))
        for value, row, drive in scaled
        if np.any(row != 0.0)
    ]


def _root(block: Block, likely: LikelyBodies | None) -> Array:
    """Return a root of S_b, shape (size, size)."""
    scales = np.diag(np.sqrt(block.references()))
    if likely is None:
        return scales
    inverse = np.linalg.inv(scales)
    try:
        return np.asarray(
            scales @ np.linalg.cholesky(inverse @ symmetric(block.F @ likely.delta + block.f, block.size) @ inverse)
        )
    except np.linalg.LinAlgError:  # a condition that the likely bodies do not fulfil
        return scales
