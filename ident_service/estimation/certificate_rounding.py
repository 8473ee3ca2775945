"""Round floating-point statements and multipliers to exact decimals that still prove the statement."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TypeVar

import numpy as np

from ident_service.certificate_verifier import Affine, ExactBlock, is_positive_semidefinite, symmetric, triangle
from ident_service.estimation.feasible.feasible_set import Block
from ident_service.model.chain import Array

_SPARE_DIGITS = 5
_MOST_DIGITS = 28

Unknown = TypeVar("Unknown", bound=Hashable)
Key = tuple[int, int]  # block and entry of a multiplier; block -1 for the multipliers of base parameters


@dataclass(frozen=True)
class Statement:
    """Statement to be proven, in exact numbers as they are printed.

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
        """Return the left-hand sides of all linear equations on delta: K, then the equalities."""
        return [*self.K, *(entry.coefficients for block in self.equalities for entry in block.entries)]

    @property
    def right(self) -> list[Fraction]:
        """Return the right-hand sides of the equations whose left-hand sides are `rows`."""
        return [*self.beta, *(-entry.constant for block in self.equalities for entry in block.entries)]


def exact_block(block: Block, names: Sequence[str]) -> ExactBlock:
    """Return the block with its coefficients as decimals."""
    entries = tuple(
        Affine({names[int(column)]: printed(row[column]) for column in np.flatnonzero(row)}, printed(constant))
        for row, constant in zip(block.F, block.f, strict=True)
    )
    return ExactBlock(block.name, block.size, entries)


def printed(value: float) -> Fraction:
    """Return the number that a file shows: the shortest decimal that reads back as this float."""
    return Fraction(repr(float(value)))


def trace(block: ExactBlock, z: Sequence[Fraction]) -> Fraction:
    """Return the trace of a multiplier, or the sum of its numbers."""
    return sum((v for v, n in zip(z, counts(block), strict=True) if n == 1), Fraction(0))


def counts(block: ExactBlock) -> list[int]:
    """Return how often each entry counts in an inner product of symmetric matrices."""
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
    """Return the smallest eigenvalue on the rows that facial reduction left, zero where it left none."""
    if block.size == 0:
        return float(min(z[z != 0.0], default=0.0))
    matrix = np.zeros((block.size, block.size))
    for value, (i, j) in zip(z, triangle(block.size), strict=True):
        matrix[i, j] = matrix[j, i] = value
    left = np.diag(matrix) != 0.0
    return float(np.linalg.eigvalsh(matrix[left][:, left])[0]) if left.any() else 0.0


def _rounded(value: float, digits: int) -> Fraction:
    return Fraction(round(Fraction(float(value)) * 10**digits), 10**digits)


def repair(
    equations: Sequence[Mapping[Unknown, Fraction]],
    right: Sequence[Fraction],
    values: Mapping[Unknown, Fraction],
    weight: Callable[[Unknown], float],
) -> dict[Unknown, Fraction] | None:
    """Change a few values so that linear equations hold exactly.

    Elimination on the residuals; each equation changes the unknown that stands in the fewest equations, so that
    decimals stay short, and of these the one with the largest weight times coefficient.

    Args:
        equations: coefficients by unknown.
        right: right-hand sides.
        values: what is nearly a solution.
        weight: the larger, the sooner an unknown is changed.

    Returns:
        The values that solve the equations, or None where these contradict each other.
    """
    count: dict[Unknown, int] = {}
    for equation in equations:
        for unknown in equation:
            count[unknown] = count.get(unknown, 0) + 1
    solved: list[tuple[Unknown, dict[Unknown, Fraction], Fraction]] = []
    for equation, target in zip(equations, right, strict=True):
        row = {unknown: coefficient for unknown, coefficient in equation.items() if coefficient}
        rest = target - sum((c * values[unknown] for unknown, c in row.items()), Fraction(0))
        for pivot, pivot_row, pivot_rest in solved:
            if factor := row.pop(pivot, Fraction(0)):
                rest -= factor * pivot_rest
                for unknown, coefficient in pivot_row.items():
                    row[unknown] = row.get(unknown, Fraction(0)) - factor * coefficient
                    if not row[unknown]:
                        del row[unknown]
        if not row:
            if rest:
                return None
            continue
        chosen = min(row, key=lambda unknown: (count[unknown], -weight(unknown) * abs(float(row[unknown]))))
        scale = row.pop(chosen)
        solved.append((chosen, {unknown: c / scale for unknown, c in row.items()}, rest / scale))
    change: dict[Unknown, Fraction] = {}
    for chosen, row, rest in reversed(solved):
        change[chosen] = rest - sum((c * change.get(unknown, Fraction(0)) for unknown, c in row.items()), Fraction(0))
    return {unknown: value + change.get(unknown, 0) for unknown, value in values.items()}
