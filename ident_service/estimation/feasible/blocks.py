"""Represent one condition on delta: an affine map into symmetric matrices or numbers, with its reference scale.

Margins in SI units mix kg, kg m^2 and N m. Dividing each row by the reference of its unit makes them comparable; the
references are those of a body of 1 kg and 0.1 m and of a small joint:

    | row                                  | reference    |
    |--------------------------------------|--------------|
    | second moments, inertias, `Ia`       | 0.01 kg m^2  |
    | first moments against a box or hull  | 0.1 kg m     |
    | masses, the bounding ellipsoid       | 1 kg         |
    | friction terms                       | 0.1 N m, 0.1 N m s/rad |

The off-diagonal entries of a matrix need none: with D the matrix and S the diagonal of references, D - t S >= 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ident_service.config.schema import FeasibleSetName
from ident_service.estimation.feasible.conic import triangle_entries
from ident_service.model.chain import Array

SetName = FeasibleSetName | Literal["none"]
Row = dict[str, float]

REFERENCE_MASS = 1.0  # kg
REFERENCE_LENGTH = 0.1  # m
REFERENCE_MOMENT = REFERENCE_MASS * REFERENCE_LENGTH  # kg m
REFERENCE_INERTIA = REFERENCE_MASS * REFERENCE_LENGTH**2  # kg m^2
REFERENCE_FRICTION = 0.1  # N m, N m s/rad and what else friction is measured in


def reference(name: str) -> float:
    """Return the reference scale of a link parameter, by its name."""
    symbol = name.rstrip("0123456789")
    if symbol == "m":
        return REFERENCE_MASS
    if symbol in ("lx", "ly", "lz"):
        return REFERENCE_MOMENT
    return REFERENCE_INERTIA if symbol.startswith("L") or symbol == "Ia" else REFERENCE_FRICTION


def link_of(name: str) -> str:
    """Return the number of the link that a parameter belongs to, which its name ends in."""
    return name[len(name.rstrip("0123456789")) :]


@dataclass(frozen=True)
class Block:
    """Named condition on delta: an affine map into a symmetric matrix or into numbers that must be positive.

    Attributes:
        name: of the condition, for people.
        size: rows of the symmetric matrix; 0 for a list of numbers.
        F: affine map, shape (entries, parameters); entries of a matrix are its upper triangle, column by column.
        f: constant part, shape (entries,).
        scale: reference scale per row of the matrix or per number; ones when empty.
    """

    name: str
    size: int
    F: Array
    f: Array
    scale: tuple[float, ...] = ()

    def smallest(self, delta: Array) -> float:
        """Return the smallest eigenvalue, or smallest number, of the block at `delta`."""
        return self._smallest(delta, np.ones(self.size or len(self.f)))

    def smallest_scaled(self, delta: Array) -> float:
        """Return the largest t with the block at `delta` minus t times its reference scale still positive."""
        return self._smallest(delta, self.references())

    def largest_scaled(self, delta: Array) -> float:
        """Return the largest of the numbers' magnitudes at `delta`, each divided by its reference scale."""
        return float(np.max(np.abs(self.F @ delta + self.f) / self.references()))

    def _smallest(self, delta: Array, scale: Array) -> float:
        entries = self.F @ delta + self.f
        if self.size == 0:
            return float((entries / scale).min())
        root = np.sqrt(scale)
        return float(np.linalg.eigvalsh(symmetric(entries, self.size) / np.outer(root, root))[0])

    def times(self, T: Array) -> Array:
        """Return F T, shape (entries, columns of T), from the nonzero columns of F."""
        return np.asarray(self.F[:, self.felt] @ T[self.felt])

    @cached_property
    def felt(self) -> NDArray[np.intp]:
        """The parameters that it is about, as columns of F."""
        return np.flatnonzero(np.any(self.F != 0.0, axis=0))

    def identity(self) -> Array:
        """Return the entries of the identity matrix (or of ones), shape (entries,)."""
        return self._diagonal(np.ones(self.size or len(self.f)))

    def references(self) -> Array:
        """Return the reference scale per row of the matrix or per number, shape (size,) or (entries,)."""
        return np.array(self.scale) if self.scale else np.ones(self.size or len(self.f))

    def reference_identity(self) -> Array:
        """Return the entries of S, the diagonal of the reference scales, shape (entries,)."""
        return self._diagonal(self.references())

    def _diagonal(self, values: Array) -> Array:
        if self.size == 0:
            return values
        return np.array([values[i] if i == j else 0.0 for i, j in triangle_entries(self.size)])


def symmetric(entries: Array, size: int) -> Array:
    """Fill a symmetric matrix with the entries of its upper triangle, shape (size, size, ...) from (entries, ...)."""
    matrix = np.zeros((size, size, *entries.shape[1:]))
    for value, (i, j) in zip(entries, triangle_entries(size), strict=True):
        matrix[i, j] = matrix[j, i] = value
    return matrix


def matrix_block(name: str, rows: list[list[Row]], scale: tuple[float, ...], index: dict[str, int]) -> Block:
    """Return the block of a symmetric matrix whose entries are sums of link parameters."""
    size = len(rows)
    F = np.zeros((size * (size + 1) // 2, len(index)))
    for entry, (i, j) in enumerate(triangle_entries(size)):
        for parameter, coefficient in rows[i][j].items():
            F[entry, index[parameter]] += coefficient
    return Block(name, size, F, np.zeros(len(F)), scale)


def linear_block(name: str, rows: Sequence[tuple[Row, float]], scale: float, index: dict[str, int]) -> Block:
    """Return the block of numbers that are sums of link parameters and a constant, all of one unit."""
    F = np.zeros((len(rows), len(index)))
    for entry, (row, _) in enumerate(rows):
        for parameter, coefficient in row.items():
            F[entry, index[parameter]] = coefficient
    return Block(name, 0, F, np.array([constant for _, constant in rows]), (scale,) * len(rows))
