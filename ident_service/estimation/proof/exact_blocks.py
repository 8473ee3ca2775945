"""The conditions on link parameters, by name and in fractions: eq. 17, the 4x4 condition, and others linear in delta.

They are written down here a second time, from the formulas, so that a proof does not rest on the arrays that the solver
was given.

Boundary: standard library only, pure computation, no I/O.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Literal

from ident_service.estimation.proof.exact import is_positive_definite, rational_text, symmetric, triangle

Kind = Literal["inertia", "pseudo_inertia"]


@dataclass(frozen=True)
class Affine:
    """A number that depends on link parameters: `constant + sum of coefficient*parameter`."""

    coefficients: Mapping[str, Fraction]
    constant: Fraction = Fraction(0)

    def at(self, values: Mapping[str, Fraction]) -> Fraction:
        """Its value; KeyError where a parameter has none."""
        return self.constant + sum((c * values[name] for name, c in self.coefficients.items()), Fraction(0))

    def __str__(self) -> str:
        text = "" if not self.constant and self.coefficients else rational_text(self.constant)
        for name, coefficient in self.coefficients.items():
            size = abs(coefficient)
            body = name if size == 1 else f"{rational_text(size)}*{name}"
            sign = "-" if coefficient < 0 else "+"
            text += f" {sign} {body}" if text else body if sign == "+" else f"-{body}"
        return text


@dataclass(frozen=True)
class ExactBlock:
    """One condition on link parameters.

    Attributes:
        name: what it says, for people.
        size: rows of the symmetric matrix that must be positive definite; 0 for a list of positive numbers.
        entries: the numbers, or the matrix's upper triangle, column by column.
    """

    name: str
    size: int
    entries: tuple[Affine, ...]

    def is_positive(self, values: Mapping[str, Fraction]) -> bool:
        """Whether the condition holds strictly, decided exactly."""
        entries = [entry.at(values) for entry in self.entries]
        if self.size == 0:
            return all(entry > 0 for entry in entries)
        return is_positive_definite(symmetric(entries, self.size))


def set_blocks(kind: Kind, link: int) -> ExactBlock:
    """The condition on the inertia of one link: eq. 17 as printed, or [[tr(L)/2 1 - L, l], [l^T, m]].

    Args:
        kind: which of the two.
        link: its number, counted from 1.
    """

    def parameter(symbol: str, coefficient: Fraction | int = 1) -> dict[str, Fraction]:
        return {f"{symbol}{link}": Fraction(coefficient)}

    axes = "xyz"
    rows: list[list[dict[str, Fraction]]]
    if kind == "inertia":
        rows = [[{} for _ in range(6)] for _ in range(6)]
        for i in range(3):
            rows[3 + i][3 + i] = parameter("m")
            for j in range(3):
                rows[i][j] = parameter("L" + "".join(sorted(axes[i] + axes[j])))
                if i != j:
                    # S(l): the cross product with l.
                    sign = -1 if (j - i) % 3 == 1 else 1
                    rows[i][3 + j] = parameter("l" + axes[3 - i - j], sign)
        return _matrix(f"link {link}: mass and inertia positive", rows)
    half = Fraction(1, 2)
    rows = [[{} for _ in range(4)] for _ in range(4)]
    rows[3][3] = parameter("m")
    for i in range(3):
        rows[i][3] = parameter("l" + axes[i])
        for j in range(3):
            rows[i][j] = parameter("L" + "".join(sorted(axes[i] + axes[j])), -1)
        rows[i][i] = {}
        for k in range(3):
            rows[i][i] |= parameter("L" + 2 * axes[k], -half if k == i else half)
    return _matrix(f"link {link}: a mass distribution exists", rows)


def _matrix(name: str, rows: list[list[dict[str, Fraction]]]) -> ExactBlock:
    return ExactBlock(name, len(rows), tuple(Affine(rows[i][j]) for i, j in triangle(len(rows))))
