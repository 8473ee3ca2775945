"""Check a feasibility certificate in exact arithmetic; one file of the standard library alone (Python 3.10 or later).

`python -I verify.py result/` runs it on a folder of results, `ident verify` imports it.

**What a certificate states.** Base parameters beta with `K delta = beta` (eq. 38) and a list of conditions on delta:
the feasible set of each link (eq. 17 or the 4x4 condition) and what the arm's description adds.

- A *witness* is a delta with `K delta = beta` that meets every condition. So a body with these base parameters exists.
- A *dual* disproves that: positive semidefinite Z_k, not all zero, and y with `sum_k <F_kj, Z_k> = (K^T y)_j` for
  every link parameter j and a value `y . beta + sum_k <f_k, Z_k>` that is not positive. Every delta with
  `K delta = beta` then has `sum_k <F_k(delta) + f_k, Z_k> <= 0`, which is impossible where every block is positive
  definite. Equalities count as further rows of K. A *body* beside the dual meets all conditions alone: so it is beta
  that contradicts them.

**What its author can choose**: everything in the file. So a condition counts only where its name and its numbers are of
a kind that an arm's description can hold (`_FORMS`), and names are link parameters only. Whether the conditions and the
expressions are those of an arm can only be told by `verify` with an `Arm`, made from a description that the reader
trusts. Without one, the answer is about the file: it is consistent with its own conditions.

All decimals count as they are printed. Printed link parameters are rounded as doubles are: they are held against the
conditions exactly, and must give the base parameters up to that. An arm's expressions may differ from the file's in
their last decimal, as processors do; no proof may depend on it.
"""

from __future__ import annotations

import argparse
import errno
import hashlib
import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Literal, NoReturn

Kind = Literal["inertia", "pseudo_inertia"]
Row = dict[str, Fraction]
Matrix = list[list[Fraction]]

INERTIAL = ("Lxx", "Lxy", "Lxz", "Lyy", "Lyz", "Lzz", "lx", "ly", "lz", "m")
JOINT_TERMS = ("Ia", "fv", "fc", "fo", "fs", "fq", "fa")

MAX_FILE_CHARACTERS = 4 * 2**20
MAX_NUMBER_CHARACTERS = 2000  # those of a real proof have tens
MAX_EXPRESSION_CHARACTERS = 100_000
MAX_EXPRESSIONS = 1000
MAX_CHARACTERS = 2**18  # of all expressions
MAX_DEPTH = 50
MAX_LINKS = 200
MAX_BLOCKS = 5000
MAX_SIZE = 20
_MAX_DIGITS = 400  # of a coefficient in an expression; more than any float has
# Hostile numbers and tables end in an error and not in hours.
_MAX_BITS = 20_000
_MAX_STEPS = 20_000_000
_PRIME = 2**61 - 1
_PRINTED_TOLERANCE = Fraction(1, 10**12)
_EXPRESSION_TOLERANCE = Fraction(1, 10**10)  # coefficients of an arm's expressions are rounded to eleven decimals
_ROUNDING = Fraction(1, 10**8)  # share of the largest base parameter that this rounding may decide about
_LEAST_ASSUMED = 100  # kg and kg m^2

UNITS = {
    **dict.fromkeys(("Lxx", "Lxy", "Lxz", "Lyy", "Lyz", "Lzz"), frozenset({"kg m^2"})),
    **dict.fromkeys(("lx", "ly", "lz"), frozenset({"kg m"})),
    "m": frozenset({"kg"}),
    "Ia": frozenset({"kg m^2", "kg"}),
    **dict.fromkeys(("fv", "fa"), frozenset({"N m s/rad", "N s/m"})),
    **dict.fromkeys(("fc", "fo", "fs"), frozenset({"N m", "N"})),
    "fq": frozenset({"N m s^2/rad^2", "N s^2/m^2"}),
}

_NUMBER = re.compile(r"-?(?:\d+/\d+|(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?)", re.ASCII)
_NAME = re.compile(f"({'|'.join((*INERTIAL, *JOINT_TERMS))})([1-9][0-9]{{0,2}})")
_SPACE = re.compile(r"[ \t\r\n]*")
_WORD = re.compile(
    r"(?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?)|(?P<name>[A-Za-z_]\w*)|(?P<sign>[+*()-])"
)


class VerificationError(ValueError):
    """A file, a name, a number or a proof does not hold; the message says which and why."""


# Numbers and names


def rational(text: str) -> Fraction:
    """Parse a decimal (`-1.5e-3`) or a fraction (`-2/3`) into an exact Fraction; any other text raises.

    Raises:
        VerificationError: neither, or of more than `MAX_NUMBER_CHARACTERS` characters.
    """
    if len(text) > MAX_NUMBER_CHARACTERS:
        raise VerificationError(f"a number of {len(text)} characters; at most {MAX_NUMBER_CHARACTERS} are read")
    if not _NUMBER.fullmatch(text):
        raise VerificationError(f"{text[:40]!r} is not a number")
    try:
        return Fraction(text)
    except ZeroDivisionError:
        raise VerificationError(f"{text[:40]!r} divides by zero") from None


def rational_text(value: Fraction) -> str:
    """Format a number as a decimal where it has a finite one, else as `a/b`; `rational` reads back the same number.

    Raises:
        VerificationError: more than `MAX_NUMBER_CHARACTERS` characters.
    """
    if max(value.numerator.bit_length(), value.denominator.bit_length()) > 3 * MAX_NUMBER_CHARACTERS:
        raise VerificationError(f"a number needs more than {MAX_NUMBER_CHARACTERS} characters")
    places, rest = 0, value.denominator
    for prime in (2, 5):
        power = 0
        while rest % prime == 0:
            rest, power = rest // prime, power + 1
        places = max(places, power)
    sign = "-" if value < 0 else ""
    if rest != 1 or places >= 1000:
        text = f"{value.numerator}/{value.denominator}"
    else:
        digits = str(abs(value.numerator) * 10**places // value.denominator)
        if places == 0:
            text = sign + digits
        elif places > len(digits) + 4:
            text = f"{sign}{digits}e-{places}"
        else:
            digits = digits.rjust(places + 1, "0")
            text = f"{sign}{digits[:-places]}.{digits[-places:]}"
    if len(text) > MAX_NUMBER_CHARACTERS:
        raise VerificationError(f"a number needs more than {MAX_NUMBER_CHARACTERS} characters")
    return text


def exact_sum(terms: Iterable[Fraction]) -> Fraction:
    """Return the exact sum of the terms; raise VerificationError once its denominator has too many bits.

    Raises:
        VerificationError: numbers grow beyond what a real proof needs.
    """
    result = Fraction(0)
    for term in terms:
        result += term
        if result.denominator.bit_length() > _MAX_BITS:
            raise VerificationError("a sum needs more digits than a proof may have")
    return result


def split_name(name: str) -> tuple[str, int]:
    """Split the name of a link parameter, such as `Lxx1`, into symbol and link number; any other name raises.

    Raises:
        VerificationError: no name of a link parameter; the message says which are.
    """
    match = _NAME.fullmatch(name)
    if match is None or int(match[2]) > MAX_LINKS:
        raise VerificationError(
            f"{name[:40]!r} is not the name of a link parameter: allowed are {' '.join(INERTIAL)} and the joint terms "
            f"{' '.join(JOINT_TERMS)}, each followed by a link number from 1 to {MAX_LINKS} (Lxx1 ... fa1)"
        )
    return match[1], int(match[2])


def parse_expression(text: str) -> Row:
    """Parse a sum such as `m1 + 2*(lx2 - 0.5*m2)`, without constants, into the exact coefficient of each name.

    The grammar, of which any name is read here::

        sum    = [sign] term {sign term}
        term   = number "*" factor | factor
        factor = name | "(" sum ")"

    Raises:
        VerificationError: not a sum as in the grammar; the message says where.
    """
    if len(text) > MAX_EXPRESSION_CHARACTERS:
        raise VerificationError(f"expression of {len(text)} characters; at most {MAX_EXPRESSION_CHARACTERS} are read")
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

    def _error(self, what: str) -> VerificationError:
        return VerificationError(f"{what} at column {self._begin + 1} of {self._text!r}")

    def expect_end(self) -> None:
        if self._kind != "end":
            raise self._error(f"unexpected {self._word!r}")

    def sum(self, depth: int) -> Row:
        if depth > MAX_DEPTH:
            raise self._error(f"parentheses deeper than {MAX_DEPTH}")
        total: Row = {}
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

    def _term(self, depth: int) -> Row:
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


# Matrices


def triangle(size: int) -> list[tuple[int, int]]:
    """List (row, column), from 0, of each entry of an upper triangle, column by column."""
    return [(i, j) for j in range(size) for i in range(j + 1)]


def symmetric(entries: Sequence[Fraction], size: int) -> Matrix:
    """Build the symmetric matrix whose upper triangle has these entries, listed column by column."""
    matrix = [[Fraction(0)] * size for _ in range(size)]
    for value, (i, j) in zip(entries, triangle(size), strict=True):
        matrix[i][j] = matrix[j][i] = value
    return matrix


def is_positive_definite(matrix: Matrix) -> bool:
    """Tell if a symmetric matrix is positive definite: every pivot of its exact L D L^T is positive.

    Raises:
        VerificationError: numbers grow beyond what a real proof needs.
    """
    return all(pivot > 0 for pivot, _ in _pivots(matrix))


def is_positive_semidefinite(matrix: Matrix) -> bool:
    """Tell if a symmetric matrix is positive semidefinite: no pivot of L D L^T < 0, each zero pivot in a zero row.

    Raises:
        VerificationError: numbers grow beyond what a real proof needs.
    """
    return all(pivot > 0 or (pivot == 0 and empty) for pivot, empty in _pivots(matrix))


def _pivots(matrix: Matrix) -> Iterator[tuple[Fraction, bool]]:
    """Yield each pivot and if the rest of its row is zero; elimination goes on while that has a meaning."""
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
                        raise VerificationError("the numbers of a matrix need more digits than a proof may have")


def dependent_row(rows: Sequence[Mapping[str, Fraction]]) -> int | None:
    """Return the index of the first row that is a combination of those before it modulo a prime; None if none is.

    Rows that are independent modulo a prime are independent. The converse fails for one table in 10^18, or for one made
    so on purpose, which then is refused.

    Raises:
        VerificationError: more arithmetic than a real table needs, or a coefficient that the prime divides.
    """
    solved: list[tuple[str, dict[str, int]]] = []
    steps = 0
    for number, row in enumerate(rows):
        if any(coefficient.denominator % _PRIME == 0 for coefficient in row.values()):
            raise VerificationError(f"base parameter {number + 1}: a coefficient that no real table has")
        rest = {name: c.numerator * pow(c.denominator, -1, _PRIME) % _PRIME for name, c in row.items()}
        for pivot, other in solved:
            if factor := rest.get(pivot, 0):
                steps += len(other)
                for name, coefficient in other.items():
                    rest[name] = (rest.get(name, 0) - factor * coefficient) % _PRIME
        if steps > _MAX_STEPS:
            raise VerificationError("the expressions need more arithmetic than those of a real table")
        rest = {name: coefficient for name, coefficient in rest.items() if coefficient}
        if not rest:
            return number
        pivot = next(iter(rest))
        inverse = pow(rest[pivot], -1, _PRIME)
        solved.append((pivot, {name: coefficient * inverse % _PRIME for name, coefficient in rest.items()}))
    return None


# Conditions


@dataclass(frozen=True)
class Affine:
    """A number that depends on link parameters: `constant + sum of coefficient*parameter`."""

    coefficients: Mapping[str, Fraction]
    constant: Fraction = Fraction(0)

    def at(self, values: Mapping[str, Fraction]) -> Fraction:
        """Return constant plus sum of coefficient times value, exactly; KeyError where a parameter has no value."""
        return exact_sum((self.constant, *(c * values[name] for name, c in self.coefficients.items())))

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
        name: name of the condition, for people.
        size: rows of the symmetric matrix that must be positive definite; 0 for a list of numbers.
        entries: the numbers, or the matrix's upper triangle, column by column.
    """

    name: str
    size: int
    entries: tuple[Affine, ...]

    def is_positive(self, values: Mapping[str, Fraction]) -> bool:
        """Tell if the matrix at these values is positive definite, exactly; with size 0, if every entry is positive."""
        entries = [entry.at(values) for entry in self.entries]
        if self.size == 0:
            return all(entry > 0 for entry in entries)
        return is_positive_definite(symmetric(entries, self.size))


def link_condition(kind: Kind, link: int) -> ExactBlock:
    """Build the matrix of one link that must be positive definite: eq. 17 for `inertia`, else the pseudo-inertia.

    It is written down here a second time, from the formulas, so that a proof does not rest on the solver's arrays.

    Args:
        kind: kind of the condition.
        link: number of the link, from 1.
    """

    def parameter(symbol: str, coefficient: Fraction | int = 1) -> Row:
        return {f"{symbol}{link}": Fraction(coefficient)}

    axes = "xyz"
    rows: list[list[Row]]
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


def _matrix(name: str, rows: list[list[Row]]) -> ExactBlock:
    return ExactBlock(name, len(rows), tuple(Affine(rows[i][j]) for i, j in triangle(len(rows))))


# The kinds of conditions that an arm's description can hold beside its set. Each function gets what the name says, the
# entries of the file and the links, and returns the entries that a condition of this name has; numbers it takes from
# the file. None, or other entries, are those of something else.

Entries = Sequence[Affine]
_PLANES = {"xy": ("lz", "Lxz", "Lyz"), "yz": ("lx", "Lxy", "Lxz"), "xz": ("ly", "Lxy", "Lyz")}
_POSITIVE = {"drive inertia": "Ia", "viscous": "fv", "coulomb": "fc"}


def _number_entry(coefficients: Mapping[str, Fraction | int], constant: Fraction | int = 0) -> Affine:
    return Affine({name: Fraction(c) for name, c in coefficients.items() if c}, Fraction(constant))


def _is_shortened_form_of(text: str, value: Fraction) -> bool:
    """Tell if a name's number, which is shortened, is this one."""
    try:
        return f"{float(value):g}" == text
    except OverflowError:
        return False


def _mass(words: Mapping[str, str], entries: Entries, _: Sequence[int]) -> list[Affine] | None:
    if len(entries) != 2:
        return None
    name, lower, upper = f"m{words['link']}", -entries[0].constant, entries[1].constant
    if not (
        lower < upper and _is_shortened_form_of(words["lower"], lower) and _is_shortened_form_of(words["upper"], upper)
    ):
        return None
    return [_number_entry({name: 1}, -lower), _number_entry({name: -1}, upper)]


def _total_mass(words: Mapping[str, str], entries: Entries, links: Sequence[int]) -> list[Affine] | None:
    sign = 1 if words["side"] == "least" else -1
    bound = -sign * entries[0].constant
    if not (bound > 0 and _is_shortened_form_of(words["bound"], bound)):
        return None
    return [_number_entry(dict.fromkeys((f"m{link}" for link in links), sign), -sign * bound)]


def _box(words: Mapping[str, str], entries: Entries, _: Sequence[int]) -> list[Affine] | None:
    if len(entries) != 6:
        return None
    expected, mass = [], f"m{words['link']}"
    for i, axis in enumerate("xyz"):
        moment = f"l{axis}{words['link']}"
        lower = -entries[2 * i].coefficients.get(mass, Fraction(0))
        upper = entries[2 * i + 1].coefficients.get(mass, Fraction(0))
        if not lower < upper:
            return None
        expected += [_number_entry({moment: 1, mass: -lower}), _number_entry({moment: -1, mass: upper})]
    return expected


def _hull(words: Mapping[str, str], entries: Entries, _: Sequence[int]) -> list[Affine] | None:
    moments = [f"l{axis}{words['link']}" for axis in "xyz"]
    names = (*moments, f"m{words['link']}")
    planes = [{name: entry.coefficients.get(name, Fraction(0)) for name in names} for entry in entries]
    # Fewer than four half-spaces enclose nothing.
    if len(planes) < 4 or not all(any(plane[name] for name in moments) for plane in planes):
        return None
    return [_number_entry(plane) for plane in planes]


def _ellipsoid(words: Mapping[str, str], entries: Entries, _: Sequence[int]) -> list[Affine] | None:
    """Hold m - tr(W (Sigma - l c^T - c l^T + m c c^T)) against its form, W positive definite, Sigma = tr(L)/2 1 - L."""
    names = [f"{symbol}{words['link']}" for symbol in INERTIAL]
    row = {name: entries[0].coefficients.get(name, Fraction(0)) for name in names}
    xx, xy, xz, yy, yz, zz, *first, mass = row.values()
    trace = -2 * (xx + yy + zz)
    W = symmetric([xx + trace / 2, xy / 2, yy + trace / 2, xz / 2, yz / 2, zz + trace / 2], 3)
    if not is_positive_definite(W):
        return None
    # c W c from 2 W c, as the Schur complement of W in [[W, Wc], [c^T W, 0]].
    half = [value / 2 for value in first]
    bordered = [[*line, b] for line, b in zip(W, half, strict=True)] + [[*half, Fraction(0)]]
    reach = -[pivot for pivot, _ in _pivots(bordered)][3]
    # The mass's coefficient is rounded by itself.
    if abs(mass - (1 - reach)) > Fraction(1, 10**9) * (1 + reach):
        return None
    return [_number_entry(row)]


def _sign(words: Mapping[str, str], _: Entries, __: Sequence[int]) -> list[Affine] | None:
    return [_number_entry({f"{_POSITIVE[words['term']]}{words['link']}": 1})]


def _assumed_bound_form(words: Mapping[str, str], entries: Entries, _: Sequence[int]) -> list[Affine] | None:
    bound, link = entries[0].constant, words["link"]
    if not (bound >= _LEAST_ASSUMED and _is_shortened_form_of(words["bound"], bound)):
        return None
    return [
        _number_entry({f"m{link}": -1}, bound),
        _number_entry({f"{symbol}{link}": -1 for symbol in ("Lxx", "Lyy", "Lzz")}, bound),
    ]


def _symmetry(words: Mapping[str, str], entries: Entries, _: Sequence[int]) -> list[Affine] | None:
    """Allow any of the plane's odd moments: those that another plane has already do not stand twice."""
    odd = [f"{symbol}{words['link']}" for symbol in _PLANES[words["plane"]]]
    return [_number_entry({name: 1}) for name in odd if any(name in entry.coefficients for entry in entries)]


_G = r"-?[0-9][0-9.e+-]{0,20}"
_LINK = r"(?P<link>[1-9][0-9]{0,2})"
Form = Callable[[Mapping[str, str], Entries, Sequence[int]], list[Affine] | None]
# Compiled when a name is looked at: `re` keeps them, and most who load this file read no certificate.
_FORMS: tuple[tuple[str, Form], ...] = (
    (rf"link {_LINK}: mass within (?P<lower>{_G})\.\.(?P<upper>{_G}) kg", _mass),
    (rf"total mass at (?P<side>least|most) (?P<bound>{_G}) kg", _total_mass),
    (rf"link {_LINK}: centre of mass inside its box", _box),
    (rf"link {_LINK}: centre of mass inside its hull", _hull),
    (rf"link {_LINK}: all mass inside its ellipsoid", _ellipsoid),
    (rf"joint {_LINK}: (?P<term>{'|'.join(_POSITIVE)}) positive", _sign),
    (rf"assumed: link {_LINK} below (?P<bound>{_G}) kg and (?P=bound) kg m\^2", _assumed_bound_form),
)
_EQUALITY_FORMS: tuple[tuple[str, Form], ...] = (
    (rf"link {_LINK}: symmetric about its (?P<plane>xy|yz|xz) plane", _symmetry),
)


def is_assumed(name: str) -> bool:
    """Tell if a condition's name begins with `assumed: `: a disproof adds such bounds, which no arm description has."""
    return name.startswith("assumed: ")


def _require_form(block: ExactBlock, forms: Sequence[tuple[str, Form]], links: Sequence[int]) -> None:
    """Refuse a condition that is not what its name says.

    Raises:
        VerificationError: a name that no description gives to a condition, or other numbers than the name asks for.
    """
    for pattern, form in forms:
        if not (match := re.fullmatch(pattern, block.name)):
            continue
        words = match.groupdict()
        if (link := words.get("link")) is not None and int(link) not in links:
            raise VerificationError(f"{block.name}: the certificate's set has no link {link}")
        if block.size == 0 and (expected := form(words, block.entries, links)) and tuple(expected) == block.entries:
            return
        shown = ", ".join(str(entry)[:80] for entry in block.entries[:3])
        raise VerificationError(f"{block.name}: is named as something it is not: {shown}")
    raise VerificationError(f"{block.name!r}: no condition that a description can hold has this name")


# The file


class _Number(str):
    """A JSON number as it is written."""

    __slots__ = ()


@dataclass(frozen=True)
class Arm:
    """The conditions and expressions of an arm, from a description that the reader trusts.

    Attributes:
        name: of the arm.
        sha256: of the description; None where no file can name it.
        names: link parameters in the order of delta.
        units: units of these parameters.
        K: per base parameter the coefficients of its expression.
        blocks: conditions beside the set: matrices or lists of numbers that must be positive.
        equalities: lists of numbers that must be zero.
        joints: names of the joints in the order of the links; empty where no file can name them.
    """

    name: str
    sha256: str | None
    names: tuple[str, ...]
    units: tuple[str, ...]
    K: tuple[Row, ...]
    blocks: tuple[ExactBlock, ...]
    equalities: tuple[ExactBlock, ...]
    joints: tuple[str, ...] = ()


@dataclass(frozen=True)
class Claim:
    """The parts of a file that a proof is about.

    Attributes:
        K: per base parameter the coefficients of its expression.
        beta: base parameters.
        kind: the feasible set.
        blocks: all conditions that must be positive, those of the set first.
        equalities: lists of numbers that must be zero.
        links: numbers of the links that the set has a condition for.
        names: every parameter that an expression or a condition mentions.
    """

    K: tuple[Row, ...]
    beta: tuple[Fraction, ...]
    kind: Kind
    blocks: tuple[ExactBlock, ...]
    equalities: tuple[ExactBlock, ...]
    links: tuple[int, ...]
    names: frozenset[str]

    @property
    def implied(self) -> frozenset[str]:
        """Return the names of the conditions on each link's inertia, which make up the feasible set itself."""
        return frozenset(block.name for block in self.blocks[: len(self.links)])


def read_claim(document: dict[str, object], certificate: dict[str, object]) -> Claim:
    """Parse the base parameters and the conditions that a certificate is about; raise if they do not fit together.

    Raises:
        VerificationError: anything missing, contradictory, foreign or larger than a real one.
    """
    kind = certificate.get("set")
    if kind not in ("inertia", "pseudo_inertia"):
        raise VerificationError("certificate.set: neither inertia nor pseudo_inertia")
    claimed = document.get("feasible_set", "none")
    if claimed not in ("none", kind):
        raise VerificationError(
            f"the file's feasible_set is {clean(str(claimed))}, but its certificate is about {kind}"
        )
    table = _as_object(document.get("base_parameters"), "base_parameters")
    expressions = _as_list(table.get("expressions"), "base_parameters.expressions")
    texts = [_as_text(text, "base_parameters.expressions") for text in expressions]
    if len(texts) > MAX_EXPRESSIONS or sum(map(len, texts)) > MAX_CHARACTERS:
        raise VerificationError(
            f"base_parameters: more than {MAX_EXPRESSIONS} expressions, or {MAX_CHARACTERS} characters in them"
        )
    K = tuple(map(parse_expression, texts))
    beta = tuple(_as_plain_numbers(table.get("values"), "base_parameters.values"))
    if not K or len(K) != len(beta):
        raise VerificationError(f"base_parameters: {len(K)} expressions but {len(beta)} values")
    links = tuple(sorted({_link(number) for number in _as_list(certificate.get("links"), "certificate.links")}))
    name_of_set: Kind = "inertia" if kind == "inertia" else "pseudo_inertia"
    own = tuple(link_condition(name_of_set, link) for link in links)
    listed = _blocks(certificate.get("blocks"), "certificate.blocks")
    equalities = _blocks(certificate.get("equalities"), "certificate.equalities")
    conditions = (*own, *listed, *equalities)
    if len({block.name for block in conditions}) != len(conditions):
        raise VerificationError("the certificate has two conditions of one name")
    names = frozenset(name for row in K for name in row)
    names |= frozenset(name for block in conditions for entry in block.entries for name in entry.coefficients)
    for name in sorted(names):
        symbol, link = split_name(name)
        if symbol in INERTIAL and link not in links:
            raise VerificationError(f"the certificate says nothing about link {link}, of which there is {name}")
    for block in listed:
        _require_form(block, _FORMS, links)
    for block in equalities:
        _require_form(block, _EQUALITY_FORMS, links)
    _require_whole_planes(equalities)
    if (dependent := dependent_row(K)) is not None:
        raise VerificationError(
            f"base parameter {dependent + 1} is zero whatever the link parameters, or a combination of those before it"
        )
    return Claim(K, beta, name_of_set, own + listed, equalities, links, names)


def _require_whole_planes(equalities: Sequence[ExactBlock]) -> None:
    zero = {name for block in equalities for entry in block.entries for name in entry.coefficients}
    for block in equalities:
        match = re.fullmatch(_EQUALITY_FORMS[0][0], block.name)
        if match and (missing := {f"{odd}{match['link']}" for odd in _PLANES[match["plane"]]} - zero):
            raise VerificationError(f"{block.name}: is named as something it is not: it lacks {min(missing)}")


def _blocks(value: object, where: str) -> tuple[ExactBlock, ...]:
    listed = _as_list(value, where)
    if len(listed) > MAX_BLOCKS:
        raise VerificationError(f"{where}: more than {MAX_BLOCKS}")
    return tuple(_block(item) for item in listed)


def _block(item: object) -> ExactBlock:
    table = _as_object(item, "certificate.blocks")
    name = _as_text(table.get("name"), "certificate.blocks.name")
    if not name.isprintable() or len(name) > 200:
        raise VerificationError("certificate.blocks: a name that cannot be printed")
    size = _as_number(table.get("size"), f"size of {name!r}")
    if size.denominator != 1 or not 0 <= size <= MAX_SIZE:
        raise VerificationError(f"{name}: a size between 0 and {MAX_SIZE} was expected")
    entries = []
    for row in _as_list(table.get("entries"), f"entries of {name!r}"):
        parts = _as_object(row, f"entries of {name!r}")
        coefficients = _as_numbers_by_name(parts.get("coefficients"), f"coefficients of {name!r}")
        entries.append(Affine(coefficients, _as_number(parts.get("constant"), f"constant of {name!r}")))
    if not entries or (size and len(entries) != size * (size + 1) / 2):
        raise VerificationError(f"{name}: {len(entries)} entries do not make a block of size {size}")
    if constant := [entry for entry in entries if not any(entry.coefficients.values())]:
        raise VerificationError(f"{name}: a condition that says {constant[0].constant} whatever the link parameters")
    return ExactBlock(name, int(size), tuple(entries))


def load(content: str, what: str = "a parameter file") -> dict[str, object]:
    """Parse a JSON object, its numbers kept as the texts they are written as; any other content raises.

    Args:
        content: the text.
        what: description of the file that is expected, for the message.

    Raises:
        VerificationError: not JSON, nested too deeply, too long, or a key that stands twice in one object.
    """
    if len(content) > MAX_FILE_CHARACTERS:
        raise VerificationError(f"more than {MAX_FILE_CHARACTERS} characters")
    try:
        document = json.loads(
            content, parse_float=_Number, parse_int=_Number, parse_constant=_refuse, object_pairs_hook=_without_repeats
        )
    except RecursionError:
        raise VerificationError(f"not {what}: nested too deeply") from None
    except VerificationError as error:
        raise VerificationError(f"not {what}: {error}") from None
    except ValueError as error:
        raise VerificationError(f"not {what}: not JSON: {error}") from None
    return _as_object(document, f"not {what}: its content")


def _without_repeats(pairs: list[tuple[str, object]]) -> dict[str, object]:
    # Readers differ in which of two they take; a proof must not depend on that.
    result = dict(pairs)
    if len(result) != len(pairs):
        raise VerificationError("a key stands twice in one object")
    return result


def _refuse(constant: str) -> NoReturn:
    raise VerificationError(f"{constant} is not a number that JSON knows")


def _as_object(value: object, where: str) -> dict[str, object]:
    if not isinstance(value, dict):
        raise VerificationError(f"{where}: missing or not an object")
    return value


def _as_list(value: object, where: str) -> list[object]:
    if not isinstance(value, list):
        raise VerificationError(f"{where}: missing or not a list")
    return value


def _as_text(value: object, where: str) -> str:
    if not isinstance(value, str) or isinstance(value, _Number):
        raise VerificationError(f"{where}: a text was expected")
    return value


def _as_number(value: object, where: str) -> Fraction:
    """Read a number, or a text that holds one."""
    if not isinstance(value, str):
        raise VerificationError(f"{where}: a number was expected")
    try:
        return rational(value)
    except VerificationError as error:
        raise VerificationError(f"{where}: {error}") from None


def _as_numbers(value: object, where: str) -> list[Fraction]:
    return [_as_number(item, where) for item in _as_list(value, where)]


def _as_plain_numbers(value: object, where: str) -> list[Fraction]:
    """Read numbers that are none of them a text, as every reader of a parameter file does."""
    listed = _as_list(value, where)
    if (wrong := next((k for k, one in enumerate(listed, 1) if not isinstance(one, _Number)), None)) is not None:
        raise VerificationError(f"{where}: number {wrong} is not a number")
    return _as_numbers(listed, where)


def _as_numbers_by_name(value: object, where: str) -> Row:
    return {name: _as_number(item, where) for name, item in _as_object(value, where).items()}


def _link(value: object) -> int:
    number = _as_number(value, "certificate.links")
    if number.denominator != 1 or not 1 <= number <= MAX_LINKS:
        raise VerificationError(f"certificate.links: numbers from 1 to {MAX_LINKS} were expected")
    return int(number)


def clean(text: str) -> str:
    """Return the first 500 characters, each unprintable one as `?`: a file may hold anything."""
    return _printable(text)[:500]


def _printable(text: str) -> str:
    return "".join(character if character.isprintable() else "?" for character in text)


# The proof


_NO_PARAMETERS = "not a parameter file"


@dataclass(frozen=True)
class Verification:
    """The answer about a file.

    Attributes:
        verdict: `feasible` and `infeasible` hold for the conditions that were looked at: an arm's where one was given,
            else the file's own; `undecided` is what the file itself says; `failed` is a certificate that is missing,
            broken, contradicts the file or is about another arm.
        message: one sentence for people; of a failure, what failed.
        checked: the conditions that hold, or that contradict the base parameters with their share of the
            contradiction; linear ones with their inequalities.
        arm: the arm that the verdict is about; None where it is about the file alone.
        notes: what was not looked at, though one might think so.
    """

    verdict: Literal["feasible", "infeasible", "undecided", "failed"]
    message: str
    checked: tuple[str, ...] = ()
    arm: str | None = None
    notes: tuple[str, ...] = ()

    @property
    def about_parameters(self) -> bool:
        """Return False only for a failed verdict on a file that is no parameter file at all, which is exit code 2."""
        return not (self.verdict == "failed" and self.message.startswith(_NO_PARAMETERS))


def verify(content: str, arm: Arm | None = None) -> Verification:
    """Check the certificate in a parameter file's text and return the verdict; a bad text is `failed`, never raised.

    Args:
        content: the text of `parameters.json`.
        arm: arm whose conditions and expressions the file must have; without one, the file's own count.
    """
    try:
        return _verify(load(content), arm)
    except VerificationError as error:
        return Verification("failed", clean(str(error)), arm=None if arm is None else arm.name)


def _verify(document: dict[str, object], arm: Arm | None) -> Verification:
    version = document.get("version")
    if document.get("format") != "ident-parameters" or version != "1" or not isinstance(version, _Number):
        raise VerificationError("not a parameter file: format is not ident-parameters, version 1")
    feasibility = _as_object(document.get("feasibility"), "feasibility")
    certificate = _as_object(feasibility.get("certificate"), "feasibility.certificate")
    kind, claimed = certificate.get("kind"), feasibility.get("feasible")
    margin, about = feasibility.get("margin"), None if arm is None else arm.name
    if kind == "undecided":
        reason = certificate.get("reason")
        told = reason[:300] if isinstance(reason, str) else ""
        return Verification("undecided", clean(f"no proof either way; the file gives the reason {told!r}"), (), about)
    if kind not in ("witness", "dual"):
        raise VerificationError("the file has no certificate that proves anything")
    feasible = kind == "witness"
    if claimed is not feasible:
        raise VerificationError(
            f"the file says feasible: {clean(str(claimed)).lower()}, but its certificate is a {kind}, "
            f"a proof of {'feasibility' if feasible else 'infeasibility'}"
        )
    if margin is not None and (_as_number(margin, "feasibility.margin") > 0) is not feasible:
        raise VerificationError(f"the margin {margin} contradicts the certificate, a {kind}")
    claim = read_claim(document, certificate)
    printed = _printed(document)
    _require_links(document, claim, printed)
    _require_known_units(document, claim)
    rows = claim.K
    if arm is not None:
        rows = _require_arm(document, claim, printed, arm)
    elif feasible:
        # Infeasible without a condition is infeasible with it.
        _require_joint_conditions(claim, printed)
    if feasible:
        return _witness(certificate, claim, printed, rows, about)
    if printed:
        raise VerificationError("link_parameters: stand beside a proof that no body has these base parameters")
    return _dual(certificate, claim, rows, about)


def _printed(document: dict[str, object]) -> Row:
    """Read the table of link parameters, empty where the file has none."""
    if "link_parameters" not in document:
        return {}
    table = _as_object(document["link_parameters"], "link_parameters")
    names = [_as_text(name, "link_parameters.names") for name in _as_list(table.get("names"), "link_parameters.names")]
    numbers = _as_plain_numbers(table.get("values"), "link_parameters.values")
    if not names or len(names) != len(numbers) or len(set(names)) != len(names):
        raise VerificationError("link_parameters: names and values do not match")
    return dict(zip(names, numbers, strict=True))


def _require_links(document: dict[str, object], claim: Claim, printed: Row) -> None:
    """Refuse a file about more links than its certificate has conditions for."""
    if "arm" in document:
        joints = _as_list(_as_object(document["arm"], "arm").get("joints"), "arm.joints")
        if claim.links != tuple(range(1, len(joints) + 1)):
            raise VerificationError(
                f"the file is about an arm of {len(joints)} joints, "
                f"but its certificate has conditions for the links {', '.join(map(str, claim.links)) or 'of none'}"
            )
    for name in sorted(claim.names | printed.keys()):
        symbol, link = split_name(name)
        if link not in claim.links and ("arm" in document or symbol in INERTIAL):
            raise VerificationError(f"no condition covers {name}: the certificate has no link {link}")


def _require_known_units(document: dict[str, object], claim: Claim) -> None:
    """Refuse units that a parameter cannot have: kg, m and rad are what the conditions mean."""
    for key in ("base_parameters", "link_parameters"):
        table = document.get(key)
        if not isinstance(table, dict) or "units" not in table:
            continue
        units = _as_list(table["units"], f"{key}.units")
        named = [{name} for name in table["names"]] if key == "link_parameters" else [set(row) for row in claim.K]
        if len(units) != len(named):
            raise VerificationError(f"{key}.units: {len(units)} for {len(named)} values")
        for number, (unit, names) in enumerate(zip(units, named, strict=True), 1):
            known = {one for name in names for one in UNITS[split_name(name)[0]]}
            if unit not in ("", *known):
                raise VerificationError(
                    f"{key}.units: number {number} is {clean(str(unit))[:40]!r}, not {' or '.join(sorted(known))}"
                )


def _require_joint_conditions(claim: Claim, printed: Row) -> None:
    """Refuse drive inertia and friction of which the file does not say that they are positive.

    Only an arm's description may leave that open. Offsets and the terms beyond eq. 27 may have either sign.
    """
    bound = {name for block in claim.blocks if not block.size for entry in block.entries for name in entry.coefficients}
    for name in sorted(claim.names | printed.keys()):
        symbol, link = split_name(name)
        if symbol in _POSITIVE.values() and name not in bound:
            term = next(word for word, short in _POSITIVE.items() if short == symbol)
            raise VerificationError(
                f"no condition says anything about {name}: 'joint {link}: {term} positive' is missing; an arm whose "
                "description leaves it open has to be given"
            )


def _require_arm(document: dict[str, object], claim: Claim, printed: Row, arm: Arm) -> tuple[Row, ...]:
    """Refuse a file whose expressions or conditions are not those of the arm; return its rows in the file's order.

    Raises:
        VerificationError: what differs.
    """
    told = _as_object(document.get("arm"), "arm") if "arm" in document else {}
    if "sha256" in told and arm.sha256 is not None and told["sha256"] != arm.sha256:
        raise VerificationError(
            f"the file was made for another description than that of {arm.name}: it names the hash "
            f"{clean(str(told['sha256']))[:12]}..., not {arm.sha256[:12]}..."
        )
    for key, label in (("name", arm.name), ("joints", list(arm.joints))):
        if label and told.get(key, label) != label:
            raise VerificationError(
                f"arm.{key}: not as the description of {arm.name} has it: {clean(str(told[key]))[:100]}"
            )
    links = tuple(sorted(link for symbol, link in map(split_name, arm.names) if symbol == "m"))
    if claim.links != links:
        raise VerificationError(f"the certificate's links are not the {len(links)} of {arm.name}")
    if foreign := (claim.names | printed.keys()) - set(arm.names):
        raise VerificationError(f"{arm.name} has no parameter {min(foreign)}")
    if printed and (missing := set(arm.names) - printed.keys()):
        raise VerificationError(f"link_parameters: no value for {min(missing)} of {arm.name}")
    rows = _require_expressions(claim, arm)
    _require_units(document, rows, arm)
    for own, listed in ((arm.blocks, claim.blocks[len(claim.links) :]), (arm.equalities, claim.equalities)):
        described = {block.name: block for block in own}
        found = {block.name: block for block in listed if not is_assumed(block.name)}
        if absent := sorted(described.keys() - found.keys()):
            raise VerificationError(f"a condition of {arm.name} is missing from the certificate: {absent[0]}")
        if added := sorted(found.keys() - described.keys()):
            raise VerificationError(f"the description of {arm.name} has no such condition: {added[0]}")
        if changed := sorted(name for name, block in found.items() if block != described[name]):
            raise VerificationError(f"not as the description of {arm.name} has it: {_described(found[changed[0]])}")
    return rows


def _require_units(document: dict[str, object], rows: Sequence[Row], arm: Arm) -> None:
    units = dict(zip(arm.names, arm.units, strict=True)) if arm.units else {}
    for key in ("link_parameters", "base_parameters"):
        table = document.get(key)
        if not units or not isinstance(table, dict) or "units" not in table:
            continue
        # A base parameter has the unit of the first link parameter in it.
        names = table["names"] if key == "link_parameters" else [min(row, key=arm.names.index) for row in rows]
        if table["units"] != [units[name] for name in names]:
            raise VerificationError(f"{key}.units: not those of {arm.name}")


def _require_expressions(claim: Claim, arm: Arm) -> tuple[Row, ...]:
    left, rows = list(arm.K), []
    for number, row in enumerate(claim.K, 1):
        same = [other for other in left if _rows_agree(row, other)]
        if not same:
            raise VerificationError(
                f"expression {number} is no base parameter of {arm.name}; `ident base-parameters` prints them"
            )
        left.remove(same[0])
        rows.append(same[0])
    if left:
        terms = Affine(left[0])
        raise VerificationError(f"a base parameter of {arm.name} is missing: {str(terms)[:200]}")
    return tuple(rows)


def _rows_agree(a: Row, b: Row) -> bool:
    return a.keys() == b.keys() and all(abs(a[name] - b[name]) <= _EXPRESSION_TOLERANCE for name in a)


def _require_met(values: Row, claim: Claim, where: str) -> None:
    for block in claim.blocks:
        if not block.is_positive(values):
            raise VerificationError(f"not positive at {where}: {block.name}")
    for block in claim.equalities:
        if any(entry.at(values) for entry in block.entries):
            raise VerificationError(f"not zero at {where}: {block.name}")


def _require_rounding(values: Row, claim: Claim, rows: Sequence[Row], where: str) -> None:
    """Refuse a body so large that the last decimals of the file's expressions, which are not the arm's, decide."""
    allowed = _ROUNDING * max(map(abs, claim.beta))
    for number, (row, own) in enumerate(zip(claim.K, rows, strict=True), 1):
        if abs(exact_sum((row[name] - own[name]) * values[name] for name in row)) > allowed:
            raise VerificationError(
                f"{where}: so large that base parameter {number} depends on the last decimals of its expression, "
                "which are not those of the arm's"
            )


def _witness(
    certificate: dict[str, object], claim: Claim, printed: Row, rows: Sequence[Row], arm: str | None
) -> Verification:
    delta = _as_numbers_by_name(certificate.get("delta"), "certificate.delta")
    _require_names(frozenset(delta), claim.names, "certificate.delta")
    if assumed := [block.name for block in claim.blocks if is_assumed(block.name)]:
        raise VerificationError(f"{assumed[0]}: a witness assumes nothing")
    for number, (row, value) in enumerate(zip(claim.K, claim.beta, strict=True), 1):
        if Affine(row).at(delta) != value:
            raise VerificationError(f"base parameter {number} is not what its expression gives for the witness")
    _require_met(delta, claim, "the witness")
    _require_rounding(delta, claim, rows, "the witness")
    checked = [_described(block) for block in claim.blocks] + [_described(block, "=") for block in claim.equalities]
    if printed:
        _check_printed(printed, claim)
        _require_rounding(printed, claim, rows, "link_parameters")
        checked.append(
            "link_parameters: as printed they meet all of these conditions and belong to the base parameters"
        )
    if arm is None:
        message = (
            f"consistent with its own conditions: feasible: link parameters with these base parameters meet the set "
            f"{claim.kind} and all conditions listed in the file; if these are an arm's, only its description can tell"
        )
    else:
        message = (
            f"proven for {arm}: a body with these base parameters exists in the set {claim.kind}, and meets every "
            "condition of the description"
        )
    return Verification("feasible", message, tuple(checked), arm)


def _check_printed(printed: Row, claim: Claim) -> None:
    """Hold printed link parameters, which are rounded, against the set exactly, and against beta up to rounding."""
    _require_names(frozenset(printed), claim.names, "link_parameters")
    for block in claim.blocks:
        if not block.is_positive(printed):
            raise VerificationError(f"link_parameters: not positive as printed: {block.name}")
    for block in claim.equalities:
        if any(abs(entry.at(printed)) > _PRINTED_TOLERANCE for entry in block.entries):
            raise VerificationError(f"link_parameters: not zero as printed: {block.name}")
    for number, (row, value) in enumerate(zip(claim.K, claim.beta, strict=True), 1):
        terms = [coefficient * printed[name] for name, coefficient in row.items()]
        if abs(exact_sum((*terms, -value))) > _PRINTED_TOLERANCE * exact_sum(map(abs, (*terms, value))):
            raise VerificationError(f"link_parameters: base parameter {number} is another one")


def _dual(certificate: dict[str, object], claim: Claim, rows: Sequence[Row], arm: str | None) -> Verification:
    if "body" not in certificate:
        raise VerificationError(
            "certificate.body: missing; it is a body that meets the conditions alone, without which they may "
            "contradict each other (files of earlier versions lack it: make the file again)"
        )
    body = _as_numbers_by_name(certificate["body"], "certificate.body")
    _require_names(frozenset(body), claim.names, "certificate.body")
    _require_met(body, claim, "the certificate's body, so the conditions may contradict each other")
    _require_far_bounds(claim)
    y = _as_numbers(certificate.get("base"), "certificate.base")
    if len(y) != len(claim.K):
        raise VerificationError(f"certificate.base: {len(y)} multipliers for {len(claim.K)} base parameters")
    table = _as_object(certificate.get("multipliers"), "certificate.multipliers")
    if unknown := table.keys() - {block.name for block in (*claim.blocks, *claim.equalities)}:
        raise VerificationError(f"certificate.multipliers: no condition is called {min(unknown)!r}")
    left: dict[str, list[Fraction]] = {}
    parts = [factor * beta for factor, beta in zip(y, claim.beta, strict=True)]
    weights: dict[str, Fraction] = {}
    for block in (*claim.blocks, *claim.equalities):
        if block.name not in table:
            continue
        Z = _as_numbers(table[block.name], f"multipliers of {block.name!r}")
        if len(Z) != len(block.entries):
            raise VerificationError(f"{block.name}: {len(Z)} multipliers for {len(block.entries)} entries")
        if block not in claim.equalities:
            weights[block.name] = _weight(block, Z)
        twice = [1] * len(Z) if block.size == 0 else [1 if i == j else 2 for i, j in triangle(block.size)]
        for entry, factor in zip(block.entries, (n * z for n, z in zip(twice, Z, strict=True)), strict=True):
            parts.append(factor * entry.constant)
            for name, coefficient in entry.coefficients.items():
                left.setdefault(name, []).append(factor * coefficient)
    rounding: dict[str, list[Fraction]] = {}
    for row, own, factor in zip(claim.K, rows, y, strict=True):
        for name, coefficient in row.items():
            left.setdefault(name, []).append(-factor * coefficient)
            rounding.setdefault(name, []).append(factor * (coefficient - own[name]))
    if unbalanced := sorted(name for name, terms in left.items() if exact_sum(terms)):
        raise VerificationError(f"the dual matrices do not cancel {unbalanced[0]}")
    value = exact_sum(parts)
    if value > 0:
        raise VerificationError("the dual matrices prove nothing: their value is positive")
    if value > -_far(claim) * exact_sum(abs(exact_sum(terms)) for terms in rounding.values()):
        raise VerificationError(
            "the dual matrices prove nothing about the arm: they depend on the last decimals of the file's "
            "expressions, which are not those of the arm's"
        )
    weight_of_all = exact_sum(weights.values())
    if weight_of_all == 0 and value == 0:
        raise VerificationError("the dual matrices prove nothing: all are zero")
    shares = sorted(((weight / weight_of_all, name) for name, weight in weights.items() if weight), reverse=True)
    described = {block.name: _described(block) for block in claim.blocks}
    checked = [f"{float(100 * share):.3g} %: {described[name]}" for share, name in shares]
    used = [block for block in claim.equalities if block.name in table]
    checked += [_described(block, "=") for block in used]
    message = _disproof(claim, value, [name for _, name in shares], len(used))
    if arm is None:
        return Verification("infeasible", f"consistent with its own conditions: infeasible: {message}", tuple(checked))
    return Verification("infeasible", f"proven for {arm}: {message}", tuple(checked), arm)


def _require_far_bounds(claim: Claim) -> None:
    """Refuse assumed bounds that an arm with these base parameters could come near to."""
    for block in claim.blocks:
        if is_assumed(block.name) and block.entries[0].constant < _far(claim):
            raise VerificationError(f"{block.name}: is less than {_LEAST_ASSUMED} times the largest base parameter")


def _far(claim: Claim) -> Fraction:
    """Return a size that no link parameter of an arm with these base parameters comes near to."""
    return _LEAST_ASSUMED * max([Fraction(1), *map(abs, claim.beta)])


def _disproof(claim: Claim, value: Fraction, names: Sequence[str], equalities: int) -> str:
    listed = [name for name in names if name not in claim.implied]
    assumed = sum(is_assumed(name) for name in listed)
    more = f" that also meets {len(listed) + equalities} listed conditions" if listed or equalities else ""
    more += f" ({assumed} of them assumed)" if assumed else ""
    closed = "" if value < 0 else ", unless one on the set's boundary"
    most = f"; most of all {names[0]}" if names else ""
    return f"no body in the set {claim.kind}{more} has these base parameters{closed}{most}"


def _weight(block: ExactBlock, Z: Sequence[Fraction]) -> Fraction:
    """Return the trace of a multiplier after the check that it is positive semidefinite."""
    matrix = symmetric(Z, block.size) if block.size else []
    if (block.size and not is_positive_semidefinite(matrix)) or (not block.size and any(z < 0 for z in Z)):
        raise VerificationError(f"the multiplier is not positive semidefinite: {block.name}")
    return sum((matrix[i][i] for i in range(block.size)), Fraction(0)) if block.size else sum(Z, Fraction(0))


def _described(block: ExactBlock, relation: str = ">") -> str:
    if block.size:
        return block.name
    return f"{block.name} ({', '.join(f'{entry} {relation} 0' for entry in block.entries)})"


def _require_names(given: frozenset[str], wanted: frozenset[str], where: str) -> None:
    if missing := wanted - given:
        raise VerificationError(f"{where}: no value for {min(missing)}")
    if foreign := given - wanted:
        raise VerificationError(f"{where}: {min(foreign)[:40]!r} is in no expression and in no condition")


# Files and folders


def read_file(path: Path) -> str:
    """Return a file's text; VerificationError: too long or not UTF-8, OSError: unreadable, device or pipe.

    Raises:
        OSError: it cannot be read, or is a device or pipe, which may never end.
        VerificationError: it is longer, or not UTF-8.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OSError(errno.EINVAL, "not a file", str(path))
    with path.open("rb") as file:
        content = file.read(MAX_FILE_CHARACTERS + 1)
    if len(content) > MAX_FILE_CHARACTERS:
        raise VerificationError(f"more than {MAX_FILE_CHARACTERS} characters")
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError:
        raise VerificationError("not a parameter file: not UTF-8") from None


def require_folder(folder: Path) -> None:
    """Raise if a file differs from the folder's manifest, if any, or the parameters are of another arm than `arm.json`.

    Raises:
        OSError: a file cannot be read, or `parameters.json` is not there.
        VerificationError: a file is not what the manifest names, or the parameters are about another arm.
    """
    (folder / "parameters.json").stat()  # what is not there cannot be read, whatever the manifest names
    if (folder / "manifest.json").is_file():
        files = _as_object(load(read_file(folder / "manifest.json"), "a manifest").get("files"), "manifest.json: files")
        for name, digest in files.items():
            if Path(name).name != name or name in (".", ".."):
                raise VerificationError(f"manifest.json: {name[:60]!r} is no name of a file in the folder")
            # A recording may have been pruned; what the answer is about may not.
            if not (folder / name).is_file():
                if name == "arm.json":
                    raise VerificationError(f"{name}: named by the manifest, but not there")
                continue
            found = hashlib.sha256()
            with (folder / name).open("rb") as file:
                while block := file.read(2**20):
                    found.update(block)
            if found.hexdigest() != digest:
                raise VerificationError(f"{name[:60]}: not what the manifest names; it was changed, or is torn")
        if missing := {"parameters.json", "arm.json"} - files.keys():
            raise VerificationError(f"manifest.json: does not name {min(missing)}")
    if (folder / "arm.json").is_file():
        named = _as_object(load(read_file(folder / "parameters.json")).get("arm"), "parameters.json: arm")
        if named.get("sha256") != hashlib.sha256(_without_space(read_file(folder / "arm.json")).encode()).hexdigest():
            raise VerificationError("parameters.json: was made for another arm than arm.json describes")


def _without_space(text: str) -> str:
    """Drop the white space between the words of a JSON text, which is how an arm's hash is made.

    Raises:
        VerificationError: not a JSON object.
    """
    load(text, "a description of an arm")
    return "".join(re.findall(r'"(?:[^"\\]|\\.)*"|[^\s"]+', text))


_WITHOUT_MANIFEST = "there is no manifest.json, so the other files of the folder were compared with nothing"


def verify_path(path: Path, arm: Arm | None = None) -> Verification:
    """Check the certificate of a parameter file or a folder of results; return the verdict, `failed` for a bad one.

    Args:
        path: file or folder.
        arm: as for `verify`.

    Raises:
        OSError: it cannot be read.
    """
    notes: tuple[str, ...] = ()
    try:
        if path.is_dir():
            require_folder(path)
            notes = () if (path / "manifest.json").is_file() else (_WITHOUT_MANIFEST,)
            path = path / "parameters.json"
        return replace(verify(read_file(path), arm), notes=notes)
    except VerificationError as error:
        return Verification("failed", clean(str(error)), arm=None if arm is None else arm.name)


def answer_text(path: Path, answer: Verification) -> str:
    """Format a verification as lines for a person: file and verdict or message, what was checked, notes.

    Where no arm was given, the first word is about the file and not about parameters.
    """
    word = answer.verdict
    head = f"{word}: {answer.message}" if answer.arm or word in ("failed", "undecided") else answer.message
    lines = (f"{path}: {head}", *(f"  {line}" for line in answer.checked), *(f"note: {note}" for note in answer.notes))
    return "".join(f"{_printable(line)}\n" for line in lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Check the given file or folder, print the verdict; return 0 feasible, 2 no readable parameter file, 3 otherwise.

    Returns:
        0: consistent with its own conditions, and these can be met. 3: not so. 2: the file cannot be read, or is
        no parameter file.
    """
    parser = argparse.ArgumentParser(
        prog="verify.py",
        description="Check the certificate of a parameter file in exact arithmetic, against the file's own conditions. "
        "Exit codes: 0 consistent, 3 not consistent or infeasible, 2 no parameter file, or cannot be read. Whether the "
        "conditions are an arm's is checked by `ident verify FILE --arm ARM`. Take this program from where you trust "
        "it: a folder from somebody else may hold another one.",
    )
    parser.add_argument("path", type=Path, help="parameters.json, or the folder that holds it")
    path: Path = parser.parse_args(arguments).path
    try:
        answer = verify_path(path)
    except OSError as error:
        sys.stderr.write(f"{_printable(str(error.filename or path))}: {error.strerror or error}\n")
        return 2
    if not answer.about_parameters:
        sys.stderr.write(answer_text(path, answer))
        return 2
    # A terminal may not have every letter of a file.
    encoding = sys.stdout.encoding or "utf-8"
    sys.stdout.write(answer_text(path, answer).encode(encoding, "backslashreplace").decode(encoding))
    return 0 if answer.verdict == "feasible" else 3


if __name__ == "__main__":
    sys.exit(main())
