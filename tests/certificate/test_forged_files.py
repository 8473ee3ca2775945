"""Forgeries of what stands around a proof: how numbers, names and units are written, labels, sizes, rounding, folders.

As in `test_forgeries.py` each row changes a good file, once alone and once held against the arm; None means that the
file is still consistent with its own conditions. What is true stays true: `test_what_changes_nothing_is_still_a_proof`.
"""

from __future__ import annotations

import copy
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from certificate.conftest import Made

from ident_service import certificate_verifier
from ident_service.certificate_verifier import (
    INERTIAL,
    MAX_FILE_CHARACTERS,
    UNITS,
    Arm,
    VerificationError,
    rational,
    rational_text,
    verify,
    verify_path,
)
from ident_service.errors import UsageError
from ident_service.model import parameter_layout
from ident_service.operations.verify import verify_file

Document = dict[str, Any]
Change = Callable[[Document], str | None]
PROOF = ("feasibility", "certificate")
TOTAL, SET = "total mass at most 12 kg", "link 1: a mass distribution exists"


def put(value: Any, *path: str | int) -> Change:
    """Replace one value."""

    def change(document: Document) -> None:
        place: Any = document
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = value

    return change


def text(old: str, new: str, times: int = 1) -> Change:
    """Replace letters of the file."""

    def change(document: Document) -> str:
        content = json.dumps(document, ensure_ascii=False)
        assert old in content
        return content.replace(old, new, times)

    return change


def together(*changes: Change) -> Change:
    def change(document: Document) -> None:
        for one in changes:
            assert one(document) is None

    return change


def condition(document: Document, name: str) -> Document:
    proof = document["feasibility"]["certificate"]
    return next(one for one in [*proof["blocks"], *proof["equalities"]] if name in one["name"])  # type: ignore[no-any-return]


def number(name: str, entry: int, constant: str) -> Change:
    """Replace the constant of a condition."""
    return lambda document: condition(document, name)["entries"][entry].update(constant=constant)


def coefficient(name: str, entry: int, **values: str) -> Change:
    return lambda document: condition(document, name)["entries"][entry]["coefficients"].update(values)


def moved(name: str, source: str, target: str) -> Change:
    """Take a condition from one list to the other."""

    def change(document: Document) -> None:
        proof = document["feasibility"]["certificate"]
        (found,) = (one for one in proof[source] if name in one["name"])
        proof[source].remove(found)
        proof[target].append(found)

    return change


def one_more(name: str, value: float, expression: bool = False) -> Change:
    """Print a parameter that the arm does not have, or make it a base parameter."""

    def change(document: Document) -> None:
        printed, base = document["link_parameters"], document["base_parameters"]
        for table, key in ((printed, "names"), (base, "expressions"))[: 1 + expression]:
            table[key].append(name)
            table["values"].append(value)
            table["units"].append("N m")
        if expression:
            document["feasibility"]["certificate"]["delta"][name] = repr(value)

    return change


def multipliers(factor: Fraction, *, base: Fraction | None = None) -> Change:
    def change(document: Document) -> None:
        proof = document["feasibility"]["certificate"]
        proof["base"] = [rational_text(rational(one) * (factor if base is None else base)) for one in proof["base"]]
        for name, row in proof["multipliers"].items():
            proof["multipliers"][name] = [rational_text(rational(one) * factor) for one in row]

    return change


def multiplier(name: str, *values: Any) -> Change:
    return put(list(values), *PROOF, "multipliers", name)


def dropped(*path: str | int) -> Change:
    def change(document: Document) -> None:
        place: Any = document
        for key in path[:-1]:
            place = place[key]
        del place[path[-1]]

    return change


def assumed(document: Document) -> None:
    """Assume a bound of a thousand kilograms, where base parameters reach fifty."""
    entries = [{"coefficients": dict.fromkeys(names, "-1"), "constant": "1000"} for names in (["m1"], INERTIA)]
    name = "assumed: link 1 below 1000 kg and 1000 kg m^2"
    document["feasibility"]["certificate"]["blocks"].append({"name": name, "size": 0, "entries": entries})


INERTIA = ["Lxx1", "Lyy1", "Lzz1"]
VALUES, EXPRESSIONS = ("base_parameters", "values"), ("base_parameters", "expressions")
TEXT, NO_NUMBER = "unexpected character at column", "is not a number"
IS_NOT, NO_SUCH = "is named as something it is not", "no condition that a description can hold has this name"
TWICE = "not a parameter file: a key stands twice in one object"
LARGE = f"{2**5990}"

Forgery = tuple[str, str, Change, str | None, str]
FORGERIES: tuple[Forgery, ...] = (
    # Numbers.
    ("truth value as a number", "witness", put(False, *PROOF, "delta", "Lxy1"), "a number was expected", ""),
    ("truth value as a margin", "witness", put(True, "feasibility", "margin"), "margin: a number was expected", ""),
    ("one for true", "witness", put(1, "feasibility", "feasible"), "the file says feasible: 1, but its", ""),
    ("text for true", "witness", put("true", "feasibility", "feasible"), "the file says feasible: true, but", ""),
    ("text as a version", "witness", put("1", "version"), "format is not ident-parameters, version 1", ""),
    ("text as a printed value", "witness", put("2", "link_parameters", "values", 9), "number 10 is not a number", ""),
    ("fraction as a printed value", "witness", put("4/2", "link_parameters", "values", 9), "number 10 is not a", ""),
    ("infinite", "witness", text("2.02", "-Infinity"), "-Infinity is not a number that JSON knows", ""),
    ("beyond a double", "witness", text("2.02", "1e309"), "base parameter 2 is not what its expression gives", ""),
    ("exponent of four digits", "witness", text("2.02", "202e-1000"), "base_parameters.values: '202e-1000' is no", ""),
    ("nothing by nothing", "witness", put("0/0", *PROOF, "delta", "m1"), "'0/0' divides by zero", ""),
    ("sign below the line", "witness", put("-2/-1", *PROOF, "delta", "m1"), NO_NUMBER, ""),
    ("digits between lines", "witness", put("2_0", *PROOF, "delta", "m1"), NO_NUMBER, ""),
    ("wide digit", "witness", put("\uff12", *PROOF, "delta", "m1"), NO_NUMBER, ""),
    ("size as a truth value", "witness", text('"size": 0', '"size": false'), "a number was expected", ""),
    ("truth value as a link", "witness", put([True, 2], *PROOF, "links"), "links: a number was expected", ""),
    # Letters that look alike. The first two were read as 0.25.
    ("Arabic digits", "witness", text("Lzz2 - 0.25*m2", "Lzz2 - \u0660.\u0662\u0665*m2"), f"{TEXT} 8 of", ""),
    ("bold digit", "witness", text("Lzz2 - 0.25*m2", "Lzz2 - 0.\U0001d7d05*m2"), f"{TEXT} 10 of", ""),
    ("space that does not break", "witness", text("Lzz2 - 0", "Lzz2\u00a0- 0"), f"{TEXT} 5 of", ""),
    ("line within a line", "witness", text("Lzz2 - 0", "Lzz2 -\u20280"), f"{TEXT} 7 of", ""),
    ("long minus", "witness", text("Lzz2 - 0", "Lzz2 \u2212 0"), f"{TEXT} 6 of", ""),
    ("comma", "witness", text("Lzz2 - 0.25", "Lzz2 - 0,25"), f"{TEXT} 9 of", ""),
    ("Cyrillic letter", "witness", text('"m1": "2"', '"\u043c1": "2"'), "certificate.delta: no value for m1", ""),
    ("wide digit of a link", "witness", text("link 1: mass", "link \uff11: mass"), NO_SUCH, ""),
    (
        "letters from right to left",
        "witness",
        text("total mass", "total\u202e mass"),
        "a name that cannot be printed",
        "",
    ),
    ("capital letter", "witness", text("link 1: mass", "Link 1: mass"), NO_SUCH, ""),
    ("capitals of a parameter", "witness", text("Lzz1", "LZZ1", 99), "'LZZ1' is not the name of", ""),
    ("delta in capitals", "witness", text('"delta"', '"Delta"'), "certificate.delta: missing", ""),
    ("key in other letters", "witness", text('"Lxy1": "0"', '"Lxy1": "0", "L\\u0078y1": "5"'), TWICE, ""),
    ("two sets", "witness", text('"set": "pseudo', '"set": "inertia", "set": "pseudo'), TWICE, ""),
    ("two files", "witness", lambda d: f"{json.dumps(d)}\n{json.dumps(d)}", "not JSON: Extra data", ""),
    ("byte order mark", "witness", lambda d: "\ufeff" + json.dumps(d), "not JSON: Unexpected UTF-8 BOM", ""),
    # Names and numbers that say one thing in two ways.
    ("bound with another zero", "witness", text("at most 12 kg", "at most 12.0 kg"), f"12.0 kg: {IS_NOT}", ""),
    ("link with a zero", "witness", text("link 1: mass", "link 01: mass"), NO_SUCH, ""),
    ("bound that its name rounds", "witness", number("1: mass within", 1, "5.000004"), None, "not as the description"),
    ("bounds in the other order", "witness", lambda d: condition(d, "mass within")["entries"].reverse(), IS_NOT, ""),
    ("coefficient of zero", "witness", coefficient("mass within", 0, m2="0"), IS_NOT, ""),
    ("plane beside itself", "witness", number("link 2: symmetric", 0, "1e-9"), IS_NOT, ""),
    ("plane of a tiny factor", "witness", coefficient("link 2: symmetric", 0, lz2="1e-300"), IS_NOT, ""),
    ("plane as a bound", "witness", moved("link 2: symmetric", "equalities", "blocks"), NO_SUCH, ""),
    ("bound as a plane", "witness", moved("joint 2: coulomb", "blocks", "equalities"), NO_SUCH, ""),
    (
        "box of the other link",
        "witness",
        text("link 2: centre of mass inside its box", "link 1: centre of mass inside its box"),
        "two conditions of one name",
        "",
    ),
    ("number as a matrix", "witness", text('at most 12 kg", "size": 0', 'at most 12 kg", "size": 1'), IS_NOT, ""),
    # Formerly a traceback: a decimal of more digits than Python writes.
    (
        "many digits",
        "witness",
        coefficient("1: centre of mass inside its hull", 0, m1=f"{'7' * 150}/{LARGE}"),
        None,
        "not as the description",
    ),
    (
        "more digits",
        "witness",
        coefficient("1: centre of mass inside its hull", 0, m1=f"{2**6200}"),
        "more than 2000",
        "",
    ),
    # Labels.
    (
        "joints exchanged",
        "witness",
        lambda d: d["arm"]["joints"].reverse(),
        None,
        "arm.joints: not as the description of rich has it: ['elbow', 'shoulder']",
    ),
    (
        "joints of nobody",
        "witness",
        put([1, 1], "arm", "joints"),
        None,
        "arm.joints: not as the description of rich has it",
    ),
    (
        "joints exchanged in a disproof",
        "dual",
        lambda d: d["arm"]["joints"].reverse(),
        None,
        "arm.joints: not as the description",
    ),
    (
        "another arm's name",
        "witness",
        put("wam7", "arm", "name"),
        None,
        "arm.name: not as the description of rich has it: wam7",
    ),
    ("hash of nothing", "witness", put(None, "arm", "sha256"), None, "it names the hash None"),
    ("no arm", "witness", put(None, "arm"), "arm: missing or not an object", ""),
    (
        "grams of a base parameter",
        "witness",
        put("g m^2", "base_parameters", "units", 6),
        "base_parameters.units: number 7 is 'g m^2', not kg or kg m^2",
        "",
    ),
    (
        "unit of another term",
        "witness",
        put("kg", "base_parameters", "units", 6),
        None,
        "base_parameters.units: not those",
    ),
    ("no units", "witness", put([], "link_parameters", "units"), "link_parameters.units: 0 for 28 values", ""),
    ("a slide's drive", "witness", put("kg", "link_parameters", "units", 10), None, "link_parameters.units: not those"),
    # What is about no link of the arm.
    ("offset of a joint that is none", "witness", one_more("fo9", -1e9), "no condition covers fo9", ""),
    ("base parameter of no joint", "witness", one_more("fo9", -1e9, expression=True), "no condition covers fo9", ""),
    ("friction that nothing names", "witness", one_more("fs1", -1e9), "'fs1' is in no expression and in no", "has no"),
    # Rounding.
    ("triangle without thickness", "witness", put("0.01", *PROOF, "delta", "Lxx2"), "not positive at the witness", ""),
    ("triangle printed flat", "witness", put(0.01, "link_parameters", "values", 14), "not positive as printed", ""),
    (
        "last digit of a printed value",
        "witness",
        put(0.07 + 2e-12, "link_parameters", "values", 19),
        "is another one",
        "",
    ),
    ("printed beside its plane", "witness", put(1e-9, "link_parameters", "values", 8), "not zero as printed", ""),
    # Multipliers.
    (
        "huge multipliers of the base parameters",
        "dual",
        multipliers(Fraction(1), base=Fraction(10**300)),
        "do not cancel",
        "",
    ),
    ("multipliers turned over", "dual", multipliers(Fraction(-1)), "not positive semidefinite", ""),
    ("base multipliers turned over", "dual", multipliers(Fraction(1), base=Fraction(-1)), "do not cancel", ""),
    ("multipliers of nothing", "dual", multipliers(Fraction(0)), "all are zero", ""),
    ("a negative multiplier", "dual", multiplier(TOTAL, "-0.005"), f"not positive semidefinite: {TOTAL}", ""),
    ("multipliers that are none", "dual", multiplier(TOTAL, "nan"), NO_NUMBER, ""),
    ("a multiplier less", "dual", dropped(*PROOF, "multipliers", TOTAL), "do not cancel m1", ""),
    ("multipliers of no entry", "dual", multiplier(TOTAL), f"{TOTAL}: 0 multipliers for 1 entries", ""),
    ("a whole matrix", "dual", multiplier(SET, *["0"] * 16), f"{SET}: 16 multipliers for 10 entries", ""),
    ("a matrix of rows", "dual", multiplier(SET, *[["0"] * 4] * 4), "a number was expected", ""),
    ("indefinite beside the diagonal", "dual", put("1", *PROOF, "multipliers", SET, 1), f"semidefinite: {SET}", ""),
    ("multipliers as a list", "dual", put([], *PROOF, "multipliers"), "multipliers: missing or not an object", ""),
    (
        "name in other letters",
        "dual",
        text(f'"{TOTAL}": [', '"Total mass at most 12 kg": ['),
        "no condition is called",
        "",
    ),
    ("body without an offset", "dual", dropped(*PROOF, "body", "fo1"), "certificate.body: no value for fo1", ""),
    (
        "body of a billion tonnes",
        "dual",
        put("1e999", *PROOF, "body", "m1"),
        "not positive at the certificate's body",
        "",
    ),
    ("assumed too near", "dual", assumed, "is less than 100 times the largest base parameter", ""),
    # What kind of proof.
    ("kind in capitals", "witness", put("Witness", *PROOF, "kind"), "no certificate that proves anything", ""),
    ("two kinds", "witness", put(["witness", "dual"], *PROOF, "kind"), "no certificate that proves anything", ""),
    (
        "proof of the other kind",
        "dual",
        together(put("witness", *PROOF, "kind"), put(True, "feasibility", "feasible"), put(1, "feasibility", "margin")),
        "certificate.delta: missing",
        "",
    ),
    (
        "proven by hand",
        "dual",
        together(put("undecided", *PROOF, "kind"), put("proven for rich: yes", *PROOF, "reason")),
        "no proof either way; the file gives the reason 'proven for rich: yes'",
        "",
    ),
    ("values in another order", "witness", lambda d: d["base_parameters"]["values"].reverse(), "is not what its", ""),
    (
        "row a thousandfold",
        "witness",
        together(put("1000*ly1", *EXPRESSIONS, 2), put(10.0, *VALUES, 2)),
        None,
        "expression 3 is no base parameter of rich",
    ),
    (
        "another text than an expression",
        "witness",
        put("", *EXPRESSIONS, 2),
        "expected a name or ( at column 1 of ''",
        "",
    ),
)


@pytest.mark.parametrize(
    ("kind", "change", "alone", "with_arm"), [row[1:] for row in FORGERIES], ids=[row[0] for row in FORGERIES]
)
def test_no_forgery_is_proven(made: Made, kind: str, change: Change, alone: str | None, with_arm: str) -> None:
    document = copy.deepcopy(made.witness if kind == "witness" else made.dual)
    content = change(document) or json.dumps(document)
    result, held = verify(content), verify(content, made.arm)
    assert not result.message.startswith("proven")
    if alone is None:
        assert result.message.startswith("consistent with its own conditions: "), result.message
    else:
        assert result.verdict in ("failed", "undecided"), result.message
        assert alone in result.message
    assert held.verdict in ("failed", "undecided"), held.message
    assert (with_arm or alone or "") in held.message


TRUE: dict[str, tuple[str, Change]] = {
    "sizes and links as texts": (
        "witness",
        together(put("0", *PROOF, "blocks", 0, "size"), put(["1", "4/2", 2], *PROOF, "links")),
    ),
    "keys that nobody reads": ("witness", together(put("proven", *PROOF, "note"), put({}, "Link_parameters"))),
    "no arm named": ("witness", dropped("arm")),
    "no link parameters": ("witness", dropped("link_parameters")),
    "nothing times a mass": ("witness", put("ly1 + 0*m1", *EXPRESSIONS, 2)),
    "huge multipliers of all": ("dual", multipliers(Fraction(10) ** 900)),
    "a third of all multipliers": ("dual", multipliers(Fraction(1, 3))),
    "further from what is possible": ("dual", put(1e300, *VALUES, 7)),
}


@pytest.mark.parametrize("name", TRUE)
def test_what_changes_nothing_is_still_a_proof(made: Made, name: str) -> None:
    kind, change = TRUE[name]
    document = copy.deepcopy(made.witness if kind == "witness" else made.dual)
    content = change(document) or json.dumps(document)
    assert verify(content, made.arm).message.startswith("proven for rich: ")


# The last decimal of an arm's expressions


def hand_made(beta: list[float], proof: Document, coefficient: str, *, printed: bool = False) -> tuple[str, Arm]:
    """One link whose mass no condition bounds: its axis lies at x = -0.5 m, and a mass there changes nothing."""
    names = tuple(f"{symbol}1" for symbol in INERTIAL)
    expressions = [f"Lyy1 + Lzz1 - Lxx1 - {coefficient}*m1", "lx1 + 0.5*m1"]
    certificate = {"set": "pseudo_inertia", "links": [1], "blocks": [], "equalities": [], **proof}
    document: Document = {
        "format": "ident-parameters",
        "version": 1,
        "base_parameters": {"expressions": expressions, "values": beta},
        "feasibility": {"feasible": "delta" in proof, "certificate": certificate},
    }
    if printed:
        document["link_parameters"] = {"names": list(names), "values": [float(one) for one in proof["delta"].values()]}
    first = {name: Fraction(sign) for name, sign in (("Lyy1", 1), ("Lzz1", 1), ("Lxx1", -1))}
    K = ({**first, "m1": Fraction(-1, 2)}, {"lx1": Fraction(1), "m1": Fraction(1, 2)})
    return json.dumps(document), Arm("bench", None, names, (), K, (), ())


def large(mass: int) -> Document:
    """Give a mass at the axis, and 1 kg m^2 about each of its own axes."""
    quarter = mass // 4
    values = {"Lxx": 1, "Lxy": 0, "Lxz": 0, "Lyy": quarter + 1, "Lyz": 0, "Lzz": quarter + 1}
    values |= {"lx": -(mass // 2), "ly": 0, "lz": 0, "m": mass}
    return {"kind": "witness", "delta": {f"{name}1": str(value) for name, value in values.items()}}


def test_no_body_is_so_large_that_the_last_decimal_of_an_expression_decides() -> None:
    """Lyy + Lzz - Lxx about the axis is beta1 + 2 beta2, which no body has negative; 4e11 kg hide 40 kg m^2 of it."""
    for printed in (False, True):
        content, arm = hand_made([-39.0, 0.0], large(4 * 10**11), "0.5000000001", printed=printed)
        assert verify(content).verdict == "feasible"  # for its own expressions it is true
        held = verify(content, arm)
        assert (held.verdict, held.message[:13]) == ("failed", "the witness: "), held.message
        assert "so large that base parameter 1 depends on the last decimals of its expression" in held.message
    content, arm = hand_made([1 - 4e-10, 0.0], large(4), "0.5000000001", printed=True)
    assert verify(content, arm).verdict == "feasible", verify(content, arm).message


def corner(value: float, coefficient: str) -> tuple[str, Arm]:
    """Disprove beta1 + 2 beta2 = value by twice the square of (1, 0, 0, 1/2)."""
    rest = rational_text(1 - rational(coefficient))
    body = {f"{name}1": "1" if name in ("Lxx", "Lyy", "Lzz", "m") else "0" for name in INERTIAL}
    proof = {"base": ["1", "2"], "body": body, "multipliers": {SET: ["2", *["0"] * 5, "1", "0", "0", rest]}}
    return hand_made([value, 0.0], {"kind": "dual", **proof}, coefficient)


@pytest.mark.parametrize(
    ("value", "coefficient", "proven"),
    [
        (0.0, "0.5", True),
        (-1e-9, "0.5", True),
        (0.0, "0.4999999999", False),
        # A mass of at most 100 kg times 1e-10.
        (-0.9e-8, "0.4999999999", False),
        (-1.1e-8, "0.4999999999", True),
    ],
)
def test_no_disproof_hangs_on_the_last_decimal_of_an_expression(value: float, coefficient: str, proven: bool) -> None:
    content, arm = corner(value, coefficient)
    assert verify(content).verdict == "infeasible", verify(content).message
    held = verify(content, arm)
    assert held.verdict == ("infeasible" if proven else "failed"), held.message
    assert proven or "they depend on the last decimals of the file's expressions" in held.message


# Time and memory


def fractions(count: int) -> list[str]:
    """Make numbers of a thousand digits without a common factor."""
    return [f"1/{10**998 + 2 * k + 1}" for k in range(count)]


def test_sums_of_long_fractions_end_soon(made: Made) -> None:
    """Two thousand of a thousand digits each took minutes for one base parameter."""
    names = [f"{symbol}{link}" for link in range(1, 201) for symbol in INERTIAL]
    document = copy.deepcopy(made.witness)
    del document["arm"], document["link_parameters"]
    document["base_parameters"] = {"expressions": [" + ".join(names)], "values": [1.0]}
    proof = document["feasibility"]["certificate"]
    proof |= {"blocks": [], "equalities": [], "links": list(range(1, 201))}
    proof["delta"] = dict(zip(names, fractions(len(names)), strict=True))
    begin = time.process_time()
    assert verify(json.dumps(document)).message == "a sum needs more digits than a proof may have"
    assert time.process_time() - begin < 5


def test_many_expressions_are_refused_before_they_are_read(made: Made) -> None:
    document = copy.deepcopy(made.witness)
    for texts in (["m1"] * 1001, ["m1+" * 30_000 + "m1"] * 3):
        document["base_parameters"] = {"expressions": texts, "values": [1.0] * len(texts)}
        message = "base_parameters: more than 1000 expressions, or 262144 characters in them"
        assert verify(json.dumps(document)).message == message


def test_a_file_is_no_larger_than_what_others_read() -> None:
    """Lists of a 64 MiB file took four gigabytes."""
    from ident_service.results.parameter_file import MAX_BYTES

    assert MAX_FILE_CHARACTERS == MAX_BYTES


@pytest.mark.parametrize("depth", [100, 900, 985, 990, 995, 1000, 5000])
def test_lists_of_any_depth_are_answered(made: Made, depth: int) -> None:
    content = json.dumps(made.witness).replace('"feasible": true', f'"feasible": {"[" * depth}{"]" * depth}')
    assert verify(content).verdict == "failed"


def test_numbers_of_any_length_are_written_or_refused() -> None:
    """Those that would need more than 4300 digits ended in Python's own error."""
    for value in (Fraction(7**700, 2**5990), Fraction(1, 2**5990), Fraction(-(3**3000), 5**1200), Fraction(1, 10**999)):
        try:
            assert rational(rational_text(value)) == value
        except VerificationError as error:
            assert str(error) == "a number needs more than 2000 characters"  # noqa: PT017


# Files and folders


@pytest.fixture
def folder(made: Made, tmp_path: Path) -> Path:
    (tmp_path / "parameters.json").write_text(json.dumps(made.witness), encoding="utf-8")
    return tmp_path


def test_an_arm_without_end_is_answered_at_once(folder: Path) -> None:
    """A quote that never closes took a time that grows with the square of the file: 5 s for 32 kB."""
    (folder / "arm.json").write_text('"' + '\\"' * 500_000, encoding="utf-8")
    begin = time.process_time()
    answer = verify_path(folder)
    assert (answer.verdict, answer.message[:45]) == ("failed", "not a description of an arm: not JSON: Unterm")
    assert time.process_time() - begin < 5


def test_an_arm_with_foreign_spaces_is_not_the_one_of_the_hash(made: Made, folder: Path) -> None:
    import hashlib

    document = copy.deepcopy(made.witness)
    document["arm"]["sha256"] = hashlib.sha256(b'{"mass":12}').hexdigest()
    (folder / "parameters.json").write_text(json.dumps(document), encoding="utf-8")
    (folder / "arm.json").write_text('{"mass": 12}', encoding="utf-8")
    assert verify_path(folder).verdict == "feasible"
    for other in ('{"mass": 1 2}', '{"mass":\u00a012}', '{"mass": 12, "mass": 12}', "12"):
        (folder / "arm.json").write_text(other, encoding="utf-8")
        assert verify_path(folder).message.startswith("not a description of an arm: ")


@pytest.mark.parametrize("place", ["parameters.json", "."])
def test_pipes_are_not_waited_for(folder: Path, place: str) -> None:
    (folder / "parameters.json").unlink()
    os.mkfifo(folder / "parameters.json")
    for arm in (None, "planar2"):
        with pytest.raises(UsageError, match=r"parameters\.json: not a file"):
            verify_file(folder / place, arm)


def run(path: Path, *environment: str) -> subprocess.CompletedProcess[bytes]:
    command = [sys.executable, "-S", certificate_verifier.__file__, str(path)]
    variables = dict(one.split("=") for one in environment)
    return subprocess.run(command, capture_output=True, timeout=60, check=False, env=variables)


def test_what_cannot_be_read_is_named(folder: Path) -> None:
    parameters = folder / "parameters.json"
    parameters.unlink()
    for make, said in (
        (lambda: None, "No such file or directory"),
        (parameters.mkdir, "Is a directory"),
        (lambda: (parameters.rmdir(), parameters.symlink_to("parameters.json")), "Too many levels of symbolic links"),
    ):
        make()
        done = run(folder)
        assert (done.returncode, done.stdout) == (2, b"")
        assert done.stderr.decode() == f"{parameters}: {said}\n"


def test_terminals_without_a_letter_get_its_number(made: Made, folder: Path) -> None:
    """A letter that the output cannot show ended in a traceback, and a file's name could move the cursor."""
    content = json.dumps(made.witness, ensure_ascii=False).replace("total mass at least", "t\u00f6tal mass at least")
    path = folder / "wrong\x1b[2J.json"
    path.write_text(content, encoding="utf-8")
    done = run(path, "PYTHONIOENCODING=ascii")
    assert (done.returncode, done.stderr) == (3, b"")
    assert b"/wrong?[2J.json: failed: 't\\xf6tal mass at least 1 kg'" in done.stdout


def test_folders_of_two_runs_are_refused(made: Made, folder: Path) -> None:
    """Parameters of one run beside the arm or the manifest of another."""
    (folder / "arm.json").write_text('{"name": "other"}', encoding="utf-8")
    assert verify_path(folder).message == "parameters.json: was made for another arm than arm.json describes"
    (folder / "manifest.json").write_text('{"files": {"parameters.json": "0", "arm.json": "0"}}', encoding="utf-8")
    assert verify_path(folder).message.startswith("parameters.json: not what the manifest names")
    (folder / "manifest.json").write_text('{"files": {"a": "0", "a": "0"}}', encoding="utf-8")
    assert verify_path(folder).message == "not a manifest: a key stands twice in one object"


def test_units_are_those_of_the_model() -> None:
    for table in (parameter_layout._REVOLUTE_UNITS, parameter_layout._PRISMATIC_UNITS):
        assert all(unit in UNITS[symbol] for symbol, unit in table.items())
    layout = parameter_layout.Layout((True,), ())
    assert [{unit} for unit in layout.units] == [UNITS[symbol] for symbol in INERTIAL]
    assert {*INERTIAL, *parameter_layout.TERM_SYMBOLS.values()} == UNITS.keys()
