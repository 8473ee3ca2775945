"""Choose link parameters among all that have the same base parameters: those at the centre of the feasible set.

Motion shows base parameters only. Which of the many bodies behind them an interior-point method ends with depends on
its path, so on rounding and on the processor. The answer here does not: it minimises

    f(delta) = sum_blocks -logdet(D_b(delta) - t 1) + sum_links tr(S_b^-1 D_b(delta))
    over all delta with K delta = beta and E delta + e = 0

with S_b what D_b is of a likely body where one is known, else the reference scales of `feasible_set.py`, and t half of
the paper's margin (eq. 21), so that where data press against the set no more than the other half is given up. The first
sum is the barrier whose minimiser is the analytic centre (Boyd and Vandenberghe, *Convex Optimization*, 8.5.3); with
the second, f is per link the entropic divergence from the likely body, or from one of 1 kg and 0.1 m (Lee, Wensing and
Park 2020), so that nothing is drawn to infinity where nothing bounds a mass. f is strictly convex and self-concordant;
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

from ident_service.estimation.feasible.feasible_set import Block, FeasibleSet, symmetric
from ident_service.estimation.feasible.formulation import EPSILON, LinkParameterMap
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.chain import Array
from ident_service.model.information import triangle
from ident_service.model.likely_bodies import LikelyBodies

_ITERATIONS = 200
_CONVERGED = 1e-10  # Newton's decrement: the distance from the minimiser in the metric of f
_QUADRATIC = 1e-2  # decrement from which Newton's method at least halves it with every step, unless rounding forbids
_STEP = 0.99  # largest share of the distance to the boundary in one step
_LONGEST = 10.0  # largest multiple of Newton's step
_RANK = 1e-10  # least entry on the diagonal of R that counts
_ROUNDS = 50  # in which the step length is sought, a handful as a rule
_SETTLED = 1e-12  # share of the longest step length
_KEPT = 0.5  # share of the margin, at most the paper's, that is left where data press against the set


@dataclass(frozen=True)
class ChangeEllipsoid:
    """Ellipsoid that base parameters may move in.

    Attributes:
        origin: base parameters that they move from [SI], shape (base,).
        metric: N above, shape (rows, base).
        moves: mask of the base parameters that may move, shape (base,).
    """

    origin: Array
    metric: Array
    moves: NDArray[np.bool_]

    def scaled_change(self, beta: Array) -> Array:
        """Return N (beta - origin), shape (rows,): the change in units of the ellipsoid, of norm below 1 inside it."""
        return np.asarray(self.metric @ (beta - self.origin))


@dataclass(frozen=True)
class _Matrices:
    """Symmetric matrices of the set, all of one size, over their reference scales: affine in the free directions.

    Attributes:
        values: shape (matrices, size, size).
        slopes: derivatives of the values along the directions, shape (matrices, size, size, directions).
        bounded: 1 where the trace is part of f, as that of a link's inertia is, else 0, shape (matrices,).
    """

    values: Array
    slopes: Array
    bounded: Array


def centre(
    delta: Array,
    base: BaseParameters,
    conditions: FeasibleSet,
    likely: LikelyBodies | None = None,
    allowed_change: ChangeEllipsoid | None = None,
) -> Array:
    """Return link parameters moved to the set's centre near likely bodies; base ones move only in `allowed_change`.

    Args:
        delta: inside the feasible set (margin above 0), SI units, shape (parameters,).
        base: grouping of the parameters.
        conditions: the feasible set.
        likely: bodies to stay near to; ones of 1 kg and 0.1 m at each link's origin when None.
        allowed_change: how far base parameters may move; none moves when None.

    Returns:
        Link parameters with the same base parameters to rounding, or as near to them as `allowed_change` says, inside
        the set, shape (parameters,); `delta` itself where rounding forbids a step.
    """
    lift = LinkParameterMap(base)
    N = np.zeros((0, base.size)) if allowed_change is None else allowed_change.metric
    begin = np.zeros(0) if allowed_change is None else allowed_change.scaled_change(base.K @ delta)
    moving = np.zeros(0, dtype=int) if allowed_change is None else np.flatnonzero(allowed_change.moves)
    free = np.column_stack([lift.of_dependent, lift.of_beta[:, moving]])
    N = np.column_stack([np.zeros((len(N), len(lift.dependent))), N[:, moving]])
    E, _ = conditions.equality_rows()
    if len(E):
        kept = scipy.linalg.null_space(E @ free)
        free, N = free @ kept, N @ kept
    inset = _KEPT * min(EPSILON, conditions.margin(delta)[0])
    groups = _matrices(conditions, delta, free, inset, likely)
    y, before = np.zeros(free.shape[1]), np.inf
    for _ in range(_ITERATIONS if groups else 0):
        # With D = L L^T and M_k = L^-1 dD/dy_k L^-T, f has the gradient -J^T r and the Hessian J^T J, where J has the
        # columns vec(M_k) and r is vec(1 - L^T L): Newton's step is a least-squares problem, without the square of its
        # condition number.
        rows, wanted, moves = [], [], []
        for group in groups:
            try:
                L = np.linalg.cholesky(group.values + group.slopes @ y)
            except np.linalg.LinAlgError:  # so close to the boundary, at such size, that rounding decides
                return delta
            inverse, (count, size, _, directions) = np.linalg.inv(L), group.slopes.shape
            half = (inverse @ group.slopes.reshape(count, size, -1)).reshape(group.slopes.shape)
            move = inverse[:, None] @ half
            rows.append(move.reshape(-1, directions))
            wanted.append((np.eye(size) - group.bounded[:, None, None] * (L.transpose(0, 2, 1) @ L)).ravel())
            moves.append(move)
        away = begin + N @ y
        left = 1.0 - float(away @ away)
        J = np.vstack([*rows, np.sqrt(2.0 / left) * N, 2.0 / left * (away @ N)[None]])
        r = np.concatenate([*wanted, -np.sqrt(2.0 / left) * away, np.zeros(1)])
        norms = np.linalg.norm(J, axis=0)
        unit = np.divide(1.0, norms, out=np.zeros(len(norms)), where=norms > 0.0)  # 0: no condition feels the direction
        step = unit * _least_squares(J * unit, r)
        decrement = float(np.linalg.norm(J @ step))
        if decrement < _CONVERGED or (decrement < _QUADRATIC and decrement > 0.5 * before):
            break
        before = decrement
        changes = np.concatenate([np.linalg.eigvalsh(move @ step).ravel() for move in moves])
        y += _length(changes, away, N @ step, decrement) * step
    found = np.asarray(delta + free @ y)
    return found if conditions.margin(found)[0] > 0.0 else delta


def _least_squares(J: Array, r: Array) -> Array:
    """Return the x that minimises |J x - r|, the smallest one where several do.

    Args:
        J: matrix whose columns have unit length, or none, shape (rows, unknowns).
        r: shape (rows,).
    """
    from scipy.linalg.lapack import dgelsy, dgelsy_lwork, dtrtrs  # alone: all of scipy.linalg loads for 0.2 s

    size = J.shape[1]
    R = triangle(np.column_stack([J, r]))
    if len(R) > size and np.abs(np.diag(R)[:size]).min(initial=1.0) > _RANK:
        # R^T is as LAPACK stores matrices: no copy.
        return np.asarray(dtrtrs(R[:size, :size].T, R[:size, size], lower=True, trans=True)[0])
    unknown = np.zeros(max(J.shape))
    unknown[: len(r)] = r
    free, precision = np.zeros((size, 1), dtype=np.int32), float(np.finfo(float).eps)
    room = int(dgelsy_lwork(*J.shape, 1, precision)[0])
    return np.asarray(dgelsy(J, unknown, free, precision, room)[1][:size])


def _length(changes: Array, away: Array, going: Array, decrement: float) -> float:
    """Return the step length s that minimises f along Newton's step.

    `changes` are the mu below, and |N x| is that of `away` + s `going`.

    There f is -sum log(1 + s mu) - log(1 - |N x|^2) and linear in s besides, with the slope -decrement^2 at 0.
    """
    c, b, a = float(away @ away), float(away @ going), float(going @ going)

    def slope_and_curvature(s: float) -> tuple[float, float]:
        shares, left = changes / (1.0 + s * changes), 1.0 - c - 2.0 * b * s - a * s**2
        bound, at_0 = 2.0 * (b + a * s) / left, 2.0 * b / (1.0 - c)
        slope = s * float(changes @ shares) + bound - at_0 - decrement**2
        return slope, float(shares @ shares) + 2.0 * a / left + bound**2

    longest = min(_STEP / max(-float(changes.min()), np.finfo(float).tiny), _LONGEST)
    if a > 0.0:  # to where |N x| is 1
        longest = min(longest, _STEP * (np.sqrt(b**2 + a * (1.0 - c)) - b) / a)
    if slope_and_curvature(longest)[0] < 0.0:
        return longest
    # f is convex: Newton's method, halved where it leaves the bracket, without the 0.1 s in which scipy.optimize loads.
    low, high, s = 0.0, longest, min(1.0, longest)
    for _ in range(_ROUNDS):
        slope, curvature = slope_and_curvature(s)
        low, high = (s, high) if slope < 0.0 else (low, s)
        newton = s - slope / curvature if curvature > 0.0 else low
        before, s = s, newton if low <= newton <= high else 0.5 * (low + high)
        if abs(s - before) <= _SETTLED * longest:
            break
    return s


def _matrices(
    conditions: FeasibleSet, delta: Array, free: Array, inset: float, likely: LikelyBodies | None
) -> list[_Matrices]:
    """Gather the set's matrices and numbers, as matrices of one row, by size; those that no direction changes not."""
    found: dict[int, list[_Matrices]] = {}
    for block in conditions.blocks:
        values, slopes = block.F @ delta + block.f - inset * block.identity(), block.F @ free
        felt = slopes.any(axis=1)
        if block.size:
            G, felt = np.linalg.inv(_root(block, likely)), felt.any(keepdims=True)
            value = (G @ symmetric(values, block.size) @ G.T)[None]
            slope = np.einsum("ij,jkd,lk->ild", G, symmetric(slopes, block.size), G)[None]
            bounded = np.ones(1)
        else:
            units = block.references()
            bounded = np.zeros(len(units))
            if likely is not None:  # drive inertias, which nothing else bounds
                own = block.F @ likely.drives
                units, bounded = np.where(own > 0.0, own, units), (own > 0.0).astype(float)
            value, slope = (values / units)[:, None, None], (slopes / units[:, None])[:, None, None]
        found.setdefault(value.shape[1], []).append(_Matrices(value[felt], slope[felt], bounded[felt]))
    groups = []
    for parts in found.values():
        values, slopes, bounded = (
            np.concatenate(of) for of in zip(*((one.values, one.slopes, one.bounded) for one in parts), strict=True)
        )
        groups.append(_Matrices(values, slopes, bounded))
    return [group for group in groups if len(group.values)]


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
