"""Base-parameter expressions that people read and programs parse; parsed, never evaluated.

Grammar (conventions): a sum of `coefficient*name`, parentheses allowed around sums::

    sum    = [sign] term {sign term}
    term   = number "*" factor | factor
    factor = name | "(" sum ")"
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ident_service.errors import ParameterError

MAX_LENGTH = 100_000
MAX_DEPTH = 50
_TOKEN = re.compile(r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>[A-Za-z_]\w*)|(?P<sign>[+*()-]))")


def format_number(value: float) -> str:
    """The shortest decimal that reads back as the same number, without a trailing `.0`."""
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


def parse_expression(text: str) -> dict[str, float]:
    """Coefficients by name.

    Raises:
        ParameterError: not a sum as in the grammar above; the message says where.
    """
    if len(text) > MAX_LENGTH:
        raise ParameterError(f"expression of {len(text)} characters; at most {MAX_LENGTH} are read")
    parser = _Parser(text)
    result = parser.sum(0)
    parser.expect_end()
    return result


def parameter_matrix(expressions: Sequence[str], names: Sequence[str]) -> NDArray[np.float64]:
    """K of eq. 38: `K @ delta` gives the values of the expressions, shape (expressions, names).

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


class _Parser:
    def __init__(self, text: str) -> None:
        self._text = text
        self._position = 0
        self._kind, self._word = "", ""
        self._next()

    def _next(self) -> None:
        if not self._text[self._position :].strip():
            self._kind, self._word = "end", ""
            return
        match = _TOKEN.match(self._text, self._position)
        if match is None:
            raise self._error("unexpected character")
        self._kind, self._word = str(match.lastgroup), match.group(match.lastgroup or 0)
        self._position = match.end()

    def _error(self, what: str) -> ParameterError:
        return ParameterError(f"{what} at column {self._position + 1} of {self._text!r}")

    def expect_end(self) -> None:
        if self._kind != "end":
            raise self._error(f"unexpected {self._word!r}")

    def sum(self, depth: int) -> dict[str, float]:
        if depth > MAX_DEPTH:
            raise self._error(f"parentheses deeper than {MAX_DEPTH}")
        total: dict[str, float] = {}
        sign = self._sign(optional=True)
        while True:
            for name, coefficient in self._term(depth).items():
                total[name] = total.get(name, 0.0) + sign * coefficient
            if self._word not in ("+", "-"):
                return {name: coefficient for name, coefficient in total.items() if coefficient != 0.0}
            sign = self._sign(optional=False)

    def _sign(self, *, optional: bool) -> float:
        if self._word in ("+", "-"):
            sign = -1.0 if self._word == "-" else 1.0
            self._next()
            return sign
        if not optional:
            raise self._error("expected + or -")
        return 1.0

    def _term(self, depth: int) -> Mapping[str, float]:
        factor = 1.0
        if self._kind == "number":
            factor = float(self._word)
            self._next()
            if self._word != "*":
                raise self._error("expected * after a number")
            self._next()
        if self._kind == "name":
            name = self._word
            self._next()
            return {name: factor}
        if self._word == "(":
            self._next()
            inner = self.sum(depth + 1)
            if self._word != ")":
                raise self._error("expected )")
            self._next()
            return {name: factor * coefficient for name, coefficient in inner.items()}
        raise self._error("expected a name or (")
