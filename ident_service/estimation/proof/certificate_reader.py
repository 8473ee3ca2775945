"""What a proof is about, read from the text of a `parameters.json`: its decimals as they are printed, its size bounded.

Boundary: standard library only, no I/O.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from fractions import Fraction
from typing import NoReturn

from ident_service.errors import ParameterError
from ident_service.estimation.proof.exact import rational
from ident_service.estimation.proof.exact_blocks import Affine, ExactBlock, Kind, set_blocks
from ident_service.model.grammar import parse_exactly

MAX_CHARACTERS = 64 * 2**20
MAX_LINKS = 200
MAX_BLOCKS = 5000
MAX_SIZE = 20
_NAME = re.compile(r"[A-Za-z_]\w{0,39}?(\d{1,4})", re.ASCII)

Row = dict[str, Fraction]


class _Number(str):
    """A JSON number as it is written."""

    __slots__ = ()


@dataclass(frozen=True)
class Claim:
    """The parts of a file that a proof is about.

    Attributes:
        K: per base parameter the coefficients of its expression.
        beta: base parameters.
        kind: the feasible set.
        blocks: all conditions that must be positive, those of the set first.
        equalities: lists of numbers that must be zero.
        links: how many conditions the set has, one per link.
        names: every parameter that an expression or a condition mentions.
    """

    K: tuple[Row, ...]
    beta: tuple[Fraction, ...]
    kind: Kind
    blocks: tuple[ExactBlock, ...]
    equalities: tuple[ExactBlock, ...]
    links: int
    names: frozenset[str]

    @property
    def implied(self) -> frozenset[str]:
        """Names of the conditions that the set itself consists of."""
        return frozenset(block.name for block in self.blocks[: self.links])


def read_claim(document: dict[str, object], certificate: dict[str, object]) -> Claim:
    """What the certificate is about: the file's base parameters, and the conditions of its set and list.

    Raises:
        ParameterError: anything missing, contradictory, foreign or larger than a real one.
    """
    kind = certificate.get("set")
    if kind not in ("inertia", "pseudo_inertia"):
        raise ParameterError("certificate.set: neither inertia nor pseudo_inertia")
    claimed = document.get("feasible_set", "none")
    if claimed not in ("none", kind):
        raise ParameterError(f"the file's feasible_set is {clean(str(claimed))}, but its certificate is about {kind}")
    table = as_object(document.get("base_parameters"), "base_parameters")
    expressions = as_list(table.get("expressions"), "base_parameters.expressions")
    K = tuple(parse_exactly(as_text(text, "base_parameters.expressions")) for text in expressions)
    values = as_list(table.get("values"), "base_parameters.values")
    beta = tuple(as_number(value, "base_parameters.values") for value in values if isinstance(value, _Number))
    if not K or len(K) != len(beta):
        raise ParameterError(f"base_parameters: {len(K)} expressions but {len(beta)} values")
    links = sorted({_link(number) for number in as_list(certificate.get("links"), "certificate.links")})
    own = tuple(set_blocks("inertia" if kind == "inertia" else "pseudo_inertia", link) for link in links)
    blocks = own + _blocks(certificate.get("blocks"), "certificate.blocks")
    equalities = _blocks(certificate.get("equalities"), "certificate.equalities")
    if any(block.size for block in equalities):
        raise ParameterError("certificate.equalities: one that is a matrix")
    conditions = (*blocks, *equalities)
    if len({block.name for block in conditions}) != len(conditions):
        raise ParameterError("the certificate has two conditions of one name")
    names = frozenset(name for row in K for name in row)
    names |= frozenset(name for block in conditions for entry in block.entries for name in entry.coefficients)
    for name in sorted(names):
        match = _NAME.fullmatch(name)
        if match is None:
            raise ParameterError(f"{name[:40]!r} is not a link parameter's name")
        if int(match[1]) not in links:
            raise ParameterError(f"the certificate says nothing about link {int(match[1])}")
    return Claim(K, beta, "inertia" if kind == "inertia" else "pseudo_inertia", blocks, equalities, len(own), names)


def _blocks(value: object, where: str) -> tuple[ExactBlock, ...]:
    listed = as_list(value, where)
    if len(listed) > MAX_BLOCKS:
        raise ParameterError(f"{where}: more than {MAX_BLOCKS}")
    return tuple(_block(item) for item in listed)


def _block(item: object) -> ExactBlock:
    table = as_object(item, "certificate.blocks")
    name = as_text(table.get("name"), "certificate.blocks.name")
    if not name.isprintable() or len(name) > 200:
        raise ParameterError("certificate.blocks: a name that cannot be printed")
    size = as_number(table.get("size"), f"size of {name!r}")
    if size.denominator != 1 or not 0 <= size <= MAX_SIZE:
        raise ParameterError(f"{name}: a size between 0 and {MAX_SIZE} was expected")
    entries = []
    for row in as_list(table.get("entries"), f"entries of {name!r}"):
        parts = as_object(row, f"entries of {name!r}")
        coefficients = as_numbers_by_name(parts.get("coefficients"), f"coefficients of {name!r}")
        entries.append(Affine(coefficients, as_number(parts.get("constant"), f"constant of {name!r}")))
    if not entries or (size and len(entries) != size * (size + 1) / 2):
        raise ParameterError(f"{name}: {len(entries)} entries do not make a block of size {size}")
    return ExactBlock(name, int(size), tuple(entries))


def load(content: str) -> dict[str, object]:
    """The file's objects and lists, its numbers as the texts they are written as.

    Raises:
        ParameterError: not JSON, nested too deeply, too long, or a key that stands twice in one object.
    """
    if len(content) > MAX_CHARACTERS:
        raise ParameterError(f"more than {MAX_CHARACTERS} characters")
    try:
        document = json.loads(
            content, parse_float=_Number, parse_int=_Number, parse_constant=_refuse, object_pairs_hook=_without_repeats
        )
    except RecursionError:
        raise ParameterError("not a parameter file: nested too deeply") from None
    except ParameterError:
        raise
    except ValueError as error:
        raise ParameterError(f"not JSON: {error}") from None
    return as_object(document, "the file")


def _without_repeats(pairs: list[tuple[str, object]]) -> dict[str, object]:
    # Readers differ in which of two they take; a proof must not depend on that.
    result = dict(pairs)
    if len(result) != len(pairs):
        raise ParameterError("not a parameter file: a key stands twice in one object")
    return result


def _refuse(constant: str) -> NoReturn:
    raise ParameterError(f"{constant} is not a number that JSON knows")


def as_object(value: object, where: str) -> dict[str, object]:
    """An object; ParameterError where it is none."""
    if not isinstance(value, dict):
        raise ParameterError(f"{where}: missing or not an object")
    return value


def as_list(value: object, where: str) -> list[object]:
    """A list; ParameterError where it is none."""
    if not isinstance(value, list):
        raise ParameterError(f"{where}: missing or not a list")
    return value


def as_text(value: object, where: str) -> str:
    """A text that is not a number; ParameterError where it is none."""
    if not isinstance(value, str) or isinstance(value, _Number):
        raise ParameterError(f"{where}: a text was expected")
    return value


def as_number(value: object, where: str) -> Fraction:
    """A number, or a text that holds one; ParameterError where it is none."""
    if not isinstance(value, str):
        raise ParameterError(f"{where}: a number was expected")
    try:
        return rational(value)
    except ParameterError as error:
        raise ParameterError(f"{where}: {error}") from None


def as_numbers(value: object, where: str) -> list[Fraction]:
    """A list of numbers; ParameterError where it is none."""
    return [as_number(item, where) for item in as_list(value, where)]


def as_numbers_by_name(value: object, where: str) -> Row:
    """Numbers by name; ParameterError where they are none."""
    return {name: as_number(item, where) for name, item in as_object(value, where).items()}


def _link(value: object) -> int:
    number = as_number(value, "certificate.links")
    if number.denominator != 1 or not 1 <= number <= MAX_LINKS:
        raise ParameterError(f"certificate.links: numbers from 1 to {MAX_LINKS} were expected")
    return int(number)


def clean(text: str) -> str:
    """What comes from a file may hold anything; a terminal gets one printable line of it."""
    return "".join(character if character.isprintable() else "?" for character in text)[:500]
