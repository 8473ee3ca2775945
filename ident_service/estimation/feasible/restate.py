"""Precondition a conic problem around a point: shift, unit columns, and matrices made the identity there.

With x = x0 + C y and a congruence U S U^T of every matrix slack S, a problem keeps its optimum but not its rounding:
what was a difference of large numbers far out becomes a number of order one. Multipliers of a slack mapped by M map
back by M^T.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ident_service.model.chain import Array

Columns = Literal["unit", "orthonormal"]

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
class Pose:
    """Scaled problem for the solver, with the maps back to the original variables.

    Attributes:
        rows: constraints on y.
        objective: linear coefficients of y.
        hessian: quadratic part in y, a matrix or its diagonal.
        origin: x0.
        columns: C, a matrix or its diagonal.
        maps: per constraint M, a matrix or its diagonal.
        scale: what the objective was divided by.
    """

    rows: list[Rows]
    objective: Array
    hessian: Array
    origin: Array
    columns: Array
    maps: tuple[Array, ...]
    scale: float

    def point(self, y: Array) -> Array:
        """Return the variables in the problem's original coordinates."""
        return np.asarray(self.origin + _apply(self.columns, y))

    def duals(self, found: Sequence[Array]) -> list[Array]:
        """Return the multipliers in the problem's original coordinates."""
        return [self.scale * _transposed(M, z) for M, z in zip(self.maps, found, strict=True)]


def restated(rows: Sequence[Rows], objective: Array, hessian: Array, around: Array, columns: Columns | None) -> Pose:
    """Return the problem preconditioned around a point, or unchanged.

    Args:
        rows: constraints.
        objective: linear coefficients, shape (variables,).
        hessian: diagonal of the quadratic part, shape (variables,).
        around: x0, shape (variables,).
        columns: C makes the constraints' columns of unit length, or orthonormal; None leaves everything as it is.
    """
    if columns is None:
        n = len(objective)
        ones = tuple(np.ones(len(block.f)) for block in rows)
        return Pose(list(rows), objective, hessian, np.zeros(n), np.ones(n), ones, 1.0)
    slacks = [block.F @ around + block.f for block in rows]
    maps = tuple(_map(block, slack) for block, slack in zip(rows, slacks, strict=True))
    F = [_apply(M, block.F) for M, block in zip(maps, rows, strict=True)]
    stacked = np.vstack(F)
    norms = np.linalg.norm(stacked, axis=0)
    C = 1.0 / np.where(norms > 0.0, norms, 1.0)
    if columns == "orthonormal":
        triangle = np.linalg.qr(stacked * C, mode="r")
        _, values, right = np.linalg.svd(np.vstack([triangle, np.zeros((len(C) - len(triangle), len(C)))]))
        C = C[:, None] * right.T / np.where(values > _RANK * values[0], values, 1.0)
    linear = _transposed(C, objective + hessian * around)
    quadratic = C**2 * hessian if C.ndim == 1 else C.T @ (hessian[:, None] * C)
    scale = max(float(np.linalg.norm(linear)), np.finfo(float).tiny)
    return Pose(
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


def _entries(size: int) -> tuple[Array, Array, Array]:
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
