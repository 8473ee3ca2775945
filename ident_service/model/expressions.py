"""Write and parse base-parameter expressions, and build the matrix K of a table of them."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from ident_service import certificate_verifier
from ident_service.errors import ParameterError


def format_number(value: float) -> str:
    """Return the shortest decimal that reads back as the same number, without a trailing `.0`."""
    text = repr(float(value))
    return text.removesuffix(".0")


def format_expression(terms: Sequence[tuple[float, str]]) -> str:
    """Write a sum, in the order given; neighbours and others with the same coefficient share parentheses.

    Args:
        terms: coefficient and name; coefficients are not zero.
    """
    sharing: dict[float, list[str]] = {}
    for coefficient, name in terms:
        sharing.setdefault(coefficient, []).append(name)
    text = ""
    for coefficient, name in terms:
        names = sharing[coefficient]
        if abs(coefficient) == 1.0:
            body = name
        elif name == names[0]:
            body = f"{format_number(abs(coefficient))}*{name if len(names) == 1 else '(' + ' + '.join(names) + ')'}"
        else:
            continue
        sign = "-" if coefficient < 0 else "+"
        text += f" {sign} {body}" if text else body if sign == "+" else f"-{body}"
    return text


def parse_exactly(text: str) -> dict[str, Fraction]:
    """Parse a sum into its coefficients by name, decimals as they are written.

    Raises:
        ParameterError: not a sum as in `certificate_verifier.parse_expression`; the message says where.
    """
    try:
        return certificate_verifier.parse_expression(text)
    except certificate_verifier.VerificationError as error:
        raise ParameterError(str(error)) from None


def parse_expression(text: str) -> dict[str, float]:
    """Parse a sum into its coefficients by name.

    Raises:
        ParameterError: as `parse_exactly`, or a coefficient too large for a float.
    """
    try:
        return {name: float(coefficient) for name, coefficient in parse_exactly(text).items()}
    except OverflowError:
        raise ParameterError(f"a coefficient is too large for a float in {text!r}") from None


def parameter_matrix(expressions: Sequence[str], names: Sequence[str]) -> NDArray[np.float64]:
    """Return K of eq. 38: `K @ delta` gives the values of the expressions, shape (expressions, names).

    Raises:
        ParameterError: an expression does not parse or uses a name that is not among `names`.
    """
    index = {name: column for column, name in enumerate(names)}
    K = np.zeros((len(expressions), len(names)))
    for row, expression in enumerate(expressions):
        for name, coefficient in parse_expression(expression).items():
            if name not in index:
                raise ParameterError(f"expression {row + 1} ({expression!r}): no parameter is called {name!r}")
            K[row, index[name]] = coefficient
    return K
