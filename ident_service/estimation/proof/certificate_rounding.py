"""From floating point to exact statements: what is to be proven, and multipliers rounded to decimals that prove it.

Boundary: pure computation, no I/O.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from ident_service.estimation.feasible.feasible_set import Block
from ident_service.estimation.proof.exact import is_positive_semidefinite, repair, symmetric, triangle
from ident_service.estimation.proof.exact_blocks import Affine, ExactBlock
from ident_service.model.chain import Array

_SPARE_DIGITS = 5
_MOST_DIGITS = 28

Key = tuple[int, int]  # block and entry of a multiplier; block -1 for the multipliers of base parameters


@dataclass(frozen=True)
class Statement:
    """What is to be proven, in numbers as they are printed.

    Attributes:
        names: link parameters.
        K: per base parameter the coefficients of its expression.
        beta: base parameters.
        blocks: what must be positive.
        equalities: lists of numbers that must be zero.
    """

    names: tuple[str, ...]
    K: tuple[dict[str, Fraction], ...]
    beta: tuple[Fraction, ...]
    blocks: tuple[ExactBlock, ...]
    equalities: tuple[ExactBlock, ...] = ()

    @property
    def rows(self) -> list[Mapping[str, Fraction]]:
        """Left-hand sides of all linear equations on delta: K, then the equalities."""
        return [*self.K, *(entry.coefficients for block in self.equalities for entry in block.entries)]

    @property
    def right(self) -> list[Fraction]:
        """Their right-hand sides."""
        return [*self.beta, *(-entry.constant for block in self.equalities for entry in block.entries)]


def exact_block(block: Block, names: Sequence[str]) -> ExactBlock:
    """The block with its coefficients as decimals."""
    entries = tuple(
        Affine({names[int(column)]: printed(row[column]) for column in np.flatnonzero(row)}, printed(constant))
        for row, constant in zip(block.F, block.f, strict=True)
    )
    return ExactBlock(block.name, block.size, entries)


def printed(value: float) -> Fraction:
    """The number that a file shows: the shortest decimal that reads back as this float."""
    return Fraction(repr(float(value)))


def trace(block: ExactBlock, z: Sequence[Fraction]) -> Fraction:
    """Trace of a multiplier, or sum of its numbers."""
    return sum((v for v, n in zip(z, counts(block), strict=True) if n == 1), Fraction(0))


def counts(block: ExactBlock) -> list[int]:
    """How often each entry counts in an inner product of symmetric matrices."""
    return [1 if i == j else 2 for i, j in triangle(block.size)] if block.size else [1] * len(block.entries)


def prove(
    statement: Statement, multipliers: Sequence[Array], y: Array
) -> tuple[list[list[Fraction]], list[Fraction]] | None:
    """Round the multipliers, make the equations hold exactly, and check the rest exactly.

    Args:
        statement: what they are multipliers of.
        multipliers: per block, strictly inside the cone on the rows that are not zero, shape (entries,) each.
        y: multipliers of the statement's rows, shape (rows,).

    Returns:
        Both in fractions, or None where rounding broke the proof.
    """
    smallest = [_smallest(block, z) for block, z in zip(statement.blocks, multipliers, strict=True)]
    floor = min((value for value in smallest if value > 0.0), default=1e-12)
    digits = min(int(np.ceil(-np.log10(floor))) + _SPARE_DIGITS, _MOST_DIGITS)
    values: dict[Key, Fraction] = {(-1, i): _rounded(value, digits) for i, value in enumerate(y)}
    for k, z in enumerate(multipliers):
        values |= {(k, e): _rounded(value, digits) for e, value in enumerate(z) if value != 0.0}
    equations: dict[str, dict[Key, Fraction]] = {name: {} for name in statement.names}
    for i, row in enumerate(statement.rows):
        for name, coefficient in row.items():
            equations[name][-1, i] = -coefficient
    for k, block in enumerate(statement.blocks):
        for e, (entry, n) in enumerate(zip(block.entries, counts(block), strict=True)):
            if (k, e) in values:
                for name, coefficient in entry.coefficients.items():
                    equations[name][k, e] = n * coefficient
    exact = repair(
        list(equations.values()),
        [Fraction(0)] * len(equations),
        values,
        lambda key: smallest[key[0]] if key[0] >= 0 else 0.0,
    )
    if exact is None:
        return None
    factors = [exact[-1, i] for i in range(len(y))]
    Z = [[exact.get((k, e), Fraction(0)) for e in range(len(b.entries))] for k, b in enumerate(statement.blocks)]
    value = sum((factor * beta for factor, beta in zip(factors, statement.right, strict=True)), Fraction(0))
    for block, z_k in zip(statement.blocks, Z, strict=True):
        terms = (n * z * e.constant for n, z, e in zip(counts(block), z_k, block.entries, strict=True))
        value += sum(terms, Fraction(0))
        if not (is_positive_semidefinite(symmetric(z_k, block.size)) if block.size else all(z >= 0 for z in z_k)):
            return None
    return (Z, factors) if value < 0 or (value == 0 and any(any(row) for row in Z)) else None


def _smallest(block: ExactBlock, z: Array) -> float:
    """Smallest eigenvalue on the rows that facial reduction left, zero where it left none."""
    if block.size == 0:
        return float(min(z[z != 0.0], default=0.0))
    matrix = np.zeros((block.size, block.size))
    for value, (i, j) in zip(z, triangle(block.size), strict=True):
        matrix[i, j] = matrix[j, i] = value
    left = np.diag(matrix) != 0.0
    return float(np.linalg.eigvalsh(matrix[left][:, left])[0]) if left.any() else 0.0


def _rounded(value: float, digits: int) -> Fraction:
    return Fraction(round(Fraction(float(value)) * 10**digits), 10**digits)
