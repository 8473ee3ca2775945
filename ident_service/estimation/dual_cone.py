"""Follow the central path in the cone of dual matrices, always in the interior.

A point is one vector: per block the upper triangle of a matrix, column by column, with sqrt(2) beside the diagonal, so
that inner products of vectors are those of matrices. Pure computation, no I/O.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ident_service.model.chain import Array

_CLOSE_TO_OPTIMUM = 9.0  # value at most this many times the gap below zero: shares of the blocks are then meaningful
_PATH_STEP = 10.0
_PATH_STEPS = 40
_NEWTON_STEPS = 60
_CENTRED = 0.1  # Newton decrement


@dataclass(frozen=True)
class Part:
    """Block of the dual cone: a matrix over `rows` of its block, or the numbers `rows` of a list.

    Attributes:
        block: index in the list of blocks.
        matrix: whether it is a matrix.
        rows: rows that are left.
        entries: the block's entries these leave.
        scale: 1 on the diagonal, sqrt(2) beside it, so that inner products of entries are those of matrices.
        duplication: entries to the matrix column by column, shape (rows^2, entries).
    """

    block: int
    matrix: bool
    rows: tuple[int, ...]
    entries: tuple[int, ...]
    scale: Array
    duplication: Array


def identity(part: Part) -> Array:
    """Return the entries of the identity matrix, or of ones, shape (entries,)."""
    return part.duplication.T @ np.eye(len(part.rows)).ravel() if part.matrix else np.ones(len(part.rows))


def split(parts: Sequence[Part], z: Array) -> list[Array]:
    """Return the rows of `z` that belong to each part, shape (entries, ...) each."""
    return np.split(z, np.cumsum([len(part.entries) for part in parts])[:-1])


def central_path(parts: Sequence[Part], c: Array, z: Array, normals: Array) -> Iterator[Array]:
    """Yield points of the central path of `minimise c.z` with a negative value.

    Args:
        parts: the cone.
        c: the objective, shape (entries,).
        z: an interior point, shape (entries,).
        normals: orthonormal directions that must not be followed from there, such that what is left of the cone is
            bounded, shape (entries, normals).
    """
    degree = float(sum(len(part.rows) for part in parts))
    weight = degree / max(abs(float(c @ z)), float(np.linalg.norm(c)) * 1e-3, np.finfo(float).tiny)
    for _ in range(_PATH_STEPS):
        centred = _centre(parts, weight * c, z, normals)
        if centred is None:
            return
        z = centred
        value = float(c @ z)
        if value < 0.0:
            yield z
        if value < -_CLOSE_TO_OPTIMUM * degree / weight:
            return
        weight *= _PATH_STEP


def _centre(parts: Sequence[Part], c: Array, z: Array, normals: Array) -> Array | None:
    """Minimise `c.z - log det Z` across the normals by Newton's method; None where it stalls.

    With Z = L L^T, the map X -> L X L^T takes the identity to Z and the barrier's Hessian to the identity: each step is
    a projection, small and accurate however close to the boundary Z is.
    """
    identities = np.concatenate([identity(part) for part in parts])
    for _ in range(_NEWTON_STEPS):
        maps = colouring(parts, z)
        if maps is None:
            return None
        slope = np.concatenate([P.T @ piece for P, piece in zip(maps, split(parts, c), strict=True)])
        across = np.vstack([P.T @ piece for P, piece in zip(maps, split(parts, normals), strict=True)])
        Q = np.linalg.qr(across)[0]
        step = identities - slope
        for _ in range(2):
            step = step - Q @ (Q.T @ step)
        spectrum = np.concatenate(
            [_spectrum(part, piece) for part, piece in zip(parts, split(parts, step), strict=True)]
        )
        length = _step_length(float(slope @ step), spectrum)
        z = z + length * np.concatenate([P @ piece for P, piece in zip(maps, split(parts, step), strict=True)])
        if np.linalg.norm(step) < _CENTRED:
            return z
    return None


def _step_length(slope: float, spectrum: Array) -> float:
    """Return the minimiser a of `slope a - sum log(1 + a spectrum)`, by bisection on its derivative, 1 at most."""
    lowest = float(spectrum.min())
    low, high = 0.0, min(1.0, -0.99 / lowest) if lowest < 0.0 else 1.0
    if slope - float(np.sum(spectrum / (1.0 + high * spectrum))) <= 0.0:
        return high
    for _ in range(40):
        middle = 0.5 * (low + high)
        if slope - float(np.sum(spectrum / (1.0 + middle * spectrum))) > 0.0:
            high = middle
        else:
            low = middle
    return low


def _spectrum(part: Part, entries: Array) -> Array:
    """Return the eigenvalues of a matrix block, or its numbers."""
    if not part.matrix:
        return entries
    return np.asarray(np.linalg.eigvalsh((part.duplication @ entries).reshape(len(part.rows), -1)), dtype=float)


def colouring(parts: Sequence[Part], z: Array) -> list[Array] | None:
    """Return per part the map of entries X -> L X L^T with Z = L L^T; None outside the interior of the cone."""
    maps = []
    for part, piece in zip(parts, split(parts, z), strict=True):
        if not part.matrix:
            if piece.min() <= 0.0:
                return None
            maps.append(np.diag(piece))
            continue
        try:
            factor = np.linalg.cholesky((part.duplication @ piece).reshape(len(part.rows), -1))
        except np.linalg.LinAlgError:
            return None
        maps.append(part.duplication.T @ np.kron(factor, factor) @ part.duplication)
    return maps
