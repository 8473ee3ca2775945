"""The grammar of base-parameter expressions; they are parsed, never evaluated.

A sum of `coefficient*name`, parentheses allowed around sums (conventions)::

    sum    = [sign] term {sign term}
    term   = number "*" factor | factor
    factor = name | "(" sum ")"

Boundary: standard library only, so that a verifier can read expressions exactly without any numerical package.
"""

from __future__ import annotations

import re
from fractions import Fraction

from ident_service.errors import ParameterError

MAX_LENGTH = 100_000
MAX_DEPTH = 50
_MAX_DIGITS = 400  # more than any float has
_SPACE = re.compile(r"\s*")
_WORD = re.compile(r"(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?)|(?P<name>[A-Za-z_]\w*)|(?P<sign>[+*()-]))")


def parse_exactly(text: str) -> dict[str, Fraction]:
    """Coefficients by name, the decimals taken as they are written.

    Raises:
        ParameterError: not a sum as in the grammar; the message says where.
    """
    if len(text) > MAX_LENGTH:
        raise ParameterError(f"expression of {len(text)} characters; at most {MAX_LENGTH} are read")
    parser = _Parser(text)
    result = parser.sum(0)
    parser.expect_end()
    return result


class _Parser:
    def __init__(self, text: str) -> None:
        self._text = text
        self._begin = self._end = 0  # of the word
        self._kind, self._word = "", ""
        self._next()

    def _next(self) -> None:
        space = _SPACE.match(self._text, self._end)
        self._begin = space.end() if space else self._end
        if self._begin == len(self._text):
            self._kind, self._word = "end", ""
            return
        match = _WORD.match(self._text, self._begin)
        if match is None:
            raise self._error("unexpected character")
        self._kind, self._word = str(match.lastgroup), match.group()
        self._end = match.end()

    def _error(self, what: str) -> ParameterError:
        return ParameterError(f"{what} at column {self._begin + 1} of {self._text!r}")

    def expect_end(self) -> None:
        if self._kind != "end":
            raise self._error(f"unexpected {self._word!r}")

    def sum(self, depth: int) -> dict[str, Fraction]:
        if depth > MAX_DEPTH:
            raise self._error(f"parentheses deeper than {MAX_DEPTH}")
        total: dict[str, Fraction] = {}
        sign = self._sign(optional=True)
        while True:
            for name, coefficient in self._term(depth).items():
                total[name] = total.get(name, Fraction(0)) + sign * coefficient
            if self._word not in ("+", "-"):
                return {name: coefficient for name, coefficient in total.items() if coefficient}
            sign = self._sign(optional=False)

    def _sign(self, *, optional: bool) -> int:
        if self._word in ("+", "-"):
            sign = -1 if self._word == "-" else 1
            self._next()
            return sign
        if not optional:
            raise self._error("expected + or -")
        return 1

    def _term(self, depth: int) -> dict[str, Fraction]:
        factor = Fraction(1)
        if self._kind == "number":
            if len(self._word) > _MAX_DIGITS:
                raise self._error(f"a number of more than {_MAX_DIGITS} digits")
            factor = Fraction(self._word)
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
