"""Exact arithmetic of feasibility proofs: rational numbers, definiteness by L D L^T, linear equations.

Boundary: standard library only, pure computation, no I/O.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from fractions import Fraction
from typing import TypeVar

from ident_service.errors import ParameterError

Matrix = list[list[Fraction]]
Unknown = TypeVar("Unknown", bound=Hashable)

MAX_CHARACTERS = 2000  # of one number; those of a real proof have tens
_MAX_BITS = 100_000  # of a number on the way, so that hostile ones end in an error and not in hours
_NUMBER = re.compile(r"-?(?:\d+/\d+|(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?)", re.ASCII)


def rational(text: str) -> Fraction:
    """The number a decimal (`-1.5e-3`) or a fraction (`-2/3`) stands for, digit for digit.

    Raises:
        ParameterError: neither, or of more than `MAX_CHARACTERS` characters.
    """
    if len(text) > MAX_CHARACTERS:
        raise ParameterError(f"a number of {len(text)} characters; at most {MAX_CHARACTERS} are read")
    if not _NUMBER.fullmatch(text):
        raise ParameterError(f"{text[:40]!r} is not a number")
    try:
        return Fraction(text)
    except ZeroDivisionError:
        raise ParameterError(f"{text[:40]!r} divides by zero") from None


def rational_text(value: Fraction) -> str:
    """A decimal where the number has a finite one, else a fraction; `rational` reads back the same number.

    Raises:
        ParameterError: more than `MAX_CHARACTERS` characters.
    """
    if max(value.numerator.bit_length(), value.denominator.bit_length()) > 3 * MAX_CHARACTERS:
        raise ParameterError(f"a number needs more than {MAX_CHARACTERS} characters")
    places, rest = 0, value.denominator
    for prime in (2, 5):
        power = 0
        while rest % prime == 0:
            rest, power = rest // prime, power + 1
        places = max(places, power)
    if rest != 1:
        return f"{value.numerator}/{value.denominator}"
    digits = str(abs(value.numerator) * 10**places // value.denominator)
    sign = "-" if value < 0 else ""
    if places == 0:
        return sign + digits
    if places > len(digits) + 4:
        return f"{sign}{digits}e-{places}"
    digits = digits.rjust(places + 1, "0")
    return f"{sign}{digits[:-places]}.{digits[-places:]}"


def triangle(size: int) -> list[tuple[int, int]]:
    """Row and column of each entry of an upper triangle, column by column."""
    return [(i, j) for j in range(size) for i in range(j + 1)]


def symmetric(entries: Sequence[Fraction], size: int) -> Matrix:
    """The symmetric matrix with this upper triangle, column by column."""
    matrix = [[Fraction(0)] * size for _ in range(size)]
    for value, (i, j) in zip(entries, triangle(size), strict=True):
        matrix[i][j] = matrix[j][i] = value
    return matrix


def is_positive_definite(matrix: Matrix) -> bool:
    """Whether every pivot of L D L^T is positive.

    Raises:
        ParameterError: numbers grow beyond what a real proof needs.
    """
    return all(pivot > 0 for pivot, _ in _pivots(matrix))


def is_positive_semidefinite(matrix: Matrix) -> bool:
    """Whether no pivot of L D L^T is negative and each zero pivot stands in a zero row.

    Raises:
        ParameterError: numbers grow beyond what a real proof needs.
    """
    return all(pivot > 0 or (pivot == 0 and empty) for pivot, empty in _pivots(matrix))


def _pivots(matrix: Matrix) -> Iterator[tuple[Fraction, bool]]:
    """Each pivot with whether the rest of its row is zero; elimination goes on while that has a meaning."""
    size = len(matrix)
    work = [list(row) for row in matrix]
    for k in range(size):
        pivot, rest = work[k][k], [j for j in range(k + 1, size) if work[k][j]]
        yield pivot, not rest
        for i in rest:
            factor = work[k][i] / pivot
            for j in rest:
                if j >= i:
                    work[i][j] -= factor * work[k][j]
                    if work[i][j].denominator.bit_length() > _MAX_BITS:
                        raise ParameterError("the numbers of a matrix need more digits than a proof may have")


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
        weight: how readily an unknown may change.

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
