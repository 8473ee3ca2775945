"""Proofs small enough to be written by hand: each condition of the verifier holds by itself, and so does each bound.

One body of 1 kg whose mass distribution is a ball's, in the plane `lz = Lxz = Lyz = 0`.
"""

from __future__ import annotations

import copy
import json
import re
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest

from ident_service import certificate_verifier
from ident_service.certificate_verifier import (
    MAX_BLOCKS,
    MAX_LINKS,
    MAX_SIZE,
    Affine,
    Verification,
    VerificationError,
    clean,
    dependent_row,
    is_positive_definite,
    is_positive_semidefinite,
    parse_expression,
    rational,
    rational_text,
    symmetric,
    verify,
)
from ident_service.errors import UsageError
from ident_service.operations import verify as service

Document = dict[str, Any]
BODY = {"Lxx1": 0.5, "Lxy1": 0.0, "Lxz1": 0.0, "Lyy1": 0.5, "Lyz1": 0.0, "Lzz1": 0.5}
BODY |= {"lx1": 0.0, "ly1": 0.0, "lz1": 0.0, "m1": 1.0}
OWN = "consistent with its own conditions: infeasible"
SET = "link 1: a mass distribution exists"


def number(name: str, coefficients: dict[str, str], constant: str = "0") -> Document:
    """A condition that is one number."""
    return {"name": name, "size": 0, "entries": [{"coefficients": coefficients, "constant": constant}]}


PLANE_NAME = "link 1: symmetric about its xy plane"
PLANE = number(PLANE_NAME, {"lz1": "1"})
PLANE["entries"] += [{"coefficients": {name: "1"}, "constant": "0"} for name in ("Lxz1", "Lyz1")]
LIGHT = number("total mass at most 3 kg", {"m1": "-1"}, "3")


def feasible() -> Document:
    certificate = {"kind": "witness", "set": "pseudo_inertia", "links": [1], "blocks": [LIGHT], "equalities": [PLANE]}
    certificate["delta"] = {name: repr(value) for name, value in BODY.items()}
    return copy.deepcopy(
        {
            "format": "ident-parameters",
            "version": 1,
            "base_parameters": {"expressions": ["m1", "lz1", "Lzz1 - Lxx1"], "values": [1.0, 0.0, 0.0]},
            "feasibility": {"feasible": True, "certificate": certificate},
            "link_parameters": {"names": list(BODY), "values": list(BODY.values())},
        }
    )


def infeasible(
    expressions: list[str], values: list[float], base: list[str], multipliers: Document, *blocks: Document
) -> Document:
    certificate = {"kind": "dual", "set": "pseudo_inertia", "links": [1], "blocks": list(blocks), "equalities": []}
    certificate |= {"base": base, "multipliers": multipliers}
    certificate["body"] = {name: repr(value) for name, value in BODY.items()}
    return {
        "format": "ident-parameters",
        "version": 1,
        "base_parameters": {"expressions": expressions, "values": values},
        "feasibility": {"feasible": False, "certificate": certificate},
    }


def verified(document: Document) -> Verification:
    return verify(json.dumps(document))


def fails(document: Document, message: str) -> None:
    result = verified(document)
    assert (result.verdict, result.message) == ("failed", message)


def test_a_witness_is_reported_with_all_that_it_meets() -> None:
    result = verified(feasible())
    assert result.verdict == "feasible", result.message
    assert result.message == (
        "consistent with its own conditions: feasible: link parameters with these base parameters meet the set "
        "pseudo_inertia and all conditions listed in the file; if these are an arm's, only its description can tell"
    )
    assert result.checked == (
        SET,
        "total mass at most 3 kg (3 - m1 > 0)",
        f"{PLANE_NAME} (lz1 = 0, Lxz1 = 0, Lyz1 = 0)",
        "link_parameters: as printed they meet all of these conditions and belong to the base parameters",
    )


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("m1", "1.1", "base parameter 1 is not what its expression gives for the witness"),
        ("Lzz1", "0.51", "base parameter 3 is not what its expression gives for the witness"),
        ("Lxz1", "1e-30", f"not zero at the witness: {PLANE_NAME}"),
        ("Lxz1", "-1e-30", f"not zero at the witness: {PLANE_NAME}"),
        ("lx1", "0.6", f"not positive at the witness: {SET}"),
    ],
)
def test_a_witness_meets_every_equation_and_condition(name: str, value: str, message: str) -> None:
    document = feasible()
    document["feasibility"]["certificate"]["delta"][name] = value
    fails(document, message)


def test_a_witness_meets_what_is_listed_beside_the_set() -> None:
    document = feasible()
    document["feasibility"]["certificate"]["blocks"] = [number("total mass at most 1 kg", {"m1": "-1"}, "1")]
    fails(document, "not positive at the witness: total mass at most 1 kg")


@pytest.mark.parametrize("name", ["lx1", "m1"])
def test_a_witness_has_neither_more_nor_fewer_values(name: str) -> None:
    document = feasible()
    value = document["feasibility"]["certificate"]["delta"].pop(name)
    fails(document, f"certificate.delta: no value for {name}")
    document["feasibility"]["certificate"]["delta"] |= {name: value, "zzz1": "1"}
    fails(document, "certificate.delta: 'zzz1' is in no expression and in no condition")


@pytest.mark.parametrize(
    ("name", "within", "beyond", "message"),
    [
        # Of the sizes of all terms together: of 1 kg that was printed and 1 kg that it should be.
        ("m1", 1.0 + 1.9e-12, 1.0 + 2.1e-12, "base parameter 1 is another one"),
        ("m1", 1.0 - 1.9e-12, 1.0 - 2.1e-12, "base parameter 1 is another one"),
        ("Lxz1", 0.9e-12, 1.1e-12, f"not zero as printed: {PLANE_NAME}"),
        ("Lxz1", -0.9e-12, -1.1e-12, f"not zero as printed: {PLANE_NAME}"),
        ("Lzz1", 0.5 + 0.9e-12, 0.5 + 1.1e-12, "base parameter 3 is another one"),
        ("lx1", 0.4999, 0.5001, f"not positive as printed: {SET}"),
    ],
)
def test_printed_link_parameters_belong_to_the_proof_but_for_rounding(
    name: str, within: float, beyond: float, message: str
) -> None:
    document = feasible()
    table = document["link_parameters"]
    table["values"][table["names"].index(name)] = within
    assert verified(document).verdict == "feasible"
    table["values"][table["names"].index(name)] = beyond
    fails(document, f"link_parameters: {message}")


def test_a_table_of_link_parameters_is_whole() -> None:
    document = feasible()
    document["link_parameters"]["names"][0] = "Lxy1"
    fails(document, "link_parameters: names and values do not match")
    document["link_parameters"]["names"][0] = "fo1"
    fails(document, "link_parameters: no value for Lxx1")
    document["link_parameters"]["values"].append(1.0)
    fails(document, "link_parameters: names and values do not match")


def test_a_negative_mass_is_disproven_by_the_mass_alone() -> None:
    document = infeasible(["m1"], [-1.0], ["1"], {SET: ["0"] * 9 + ["1"]})
    result = verified(document)
    assert result.verdict == "infeasible", result.message
    message = f"{OWN}: no body in the set pseudo_inertia has these base parameters; most of all {SET}"
    assert (result.message, result.checked) == (message, (f"100 %: {SET}",))
    document["base_parameters"]["values"] = [0.0]
    assert "has these base parameters, unless one on the set's boundary; most" in verified(document).message
    document["base_parameters"]["values"] = [1e-30]
    fails(document, "the dual matrices prove nothing: their value is positive")


def test_a_centre_of_mass_too_far_out_is_disproven_by_what_stands_beside_the_diagonal() -> None:
    # Z = v v^T with v = (2, 0, 0, -1): 4 (Lyy + Lzz - Lxx)/2 - 4 lx + m, each beside the diagonal counted twice.
    rows = ["4", "0", "0", "0", "0", "0", "-2", "0", "0", "1"]
    document = infeasible(["Lyy1 + Lzz1 - Lxx1", "lx1", "m1"], [1.0, 2.0, 1.0], ["2", "-4", "1"], {SET: rows})
    assert verified(document).verdict == "infeasible"
    assert "boundary" not in verified(document).message
    document["feasibility"]["certificate"]["base"] = ["2", "-2", "1"]
    fails(document, "the dual matrices do not cancel lx1")
    document["feasibility"]["certificate"]["multipliers"][SET] = ["4", "0", "0", "0", "0", "0", "-2", "0", "0", "0.9"]
    fails(document, f"the multiplier is not positive semidefinite: {SET}")


def assumed(bound: str) -> Document:
    """A bound that a disproof assumes of link 1."""
    condition = number(f"assumed: link 1 below {bound} kg and {bound} kg m^2", {"m1": "-1"}, bound)
    condition["entries"].append({"coefficients": dict.fromkeys(("Lxx1", "Lyy1", "Lzz1"), "-1"), "constant": bound})
    return condition


def test_shares_are_those_of_the_weights() -> None:
    total, bound = number("total mass at most 4 kg", {"m1": "-1"}, "4"), assumed("100")
    weights = {total["name"]: ["1"], bound["name"]: ["3", "0"]}
    document = infeasible(["0.001*m1"], [0.08], ["-4000"], weights, total, bound)
    result = verified(document)
    assert result.checked == (
        f"75 %: {bound['name']} (100 - m1 > 0, 100 - Lxx1 - Lyy1 - Lzz1 > 0)",
        "25 %: total mass at most 4 kg (4 - m1 > 0)",
    )
    assert result.message == (
        f"{OWN}: no body in the set pseudo_inertia that also meets 2 listed conditions (1 of them assumed) "
        f"has these base parameters; most of all {bound['name']}"
    )
    document["base_parameters"]["values"] = [0.076]
    assert "unless one on the set's boundary" in verified(document).message
    document["base_parameters"]["values"] = [0.0759]
    fails(document, "the dual matrices prove nothing: their value is positive")
    document["feasibility"]["certificate"]["multipliers"] = {total["name"]: ["-1"], bound["name"]: ["5", "0"]}
    fails(document, "the multiplier is not positive semidefinite: total mass at most 4 kg")


def test_what_is_assumed_lies_far_beyond_the_base_parameters() -> None:
    for bound, value, kept in (
        ("100", 1.0, True),
        ("1000", -10.0, True),
        ("1000", 10.1, False),
        ("1000", -11.0, False),
    ):
        condition = assumed(bound)
        document = infeasible(["lx1"], [value], ["0"], {}, condition)
        why = f"{condition['name']}: is less than 100 times the largest base parameter"
        fails(document, "the dual matrices prove nothing: all are zero" if kept else why)
    light = assumed("99")
    document = infeasible(["lx1"], [0.1], ["0"], {}, light)
    fails(document, f"{light['name']}: is named as something it is not: 99 - m1, 99 - Lxx1 - Lyy1 - Lzz1")


def test_equalities_alone_can_contradict_and_may_have_any_sign() -> None:
    for value, factor in ((0.1, "-1"), (-0.1, "1")):
        document = infeasible(["m1", "lz1"], [1.0, value], ["0", factor], {PLANE_NAME: [factor, "0", "0"]})
        document["feasibility"]["certificate"]["equalities"] = [PLANE]
        result = verified(document)
        assert result.verdict == "infeasible", result.message
        assert result.checked == (f"{PLANE_NAME} (lz1 = 0, Lxz1 = 0, Lyz1 = 0)",)
        assert result.message == (
            f"{OWN}: no body in the set pseudo_inertia that also meets 1 listed conditions has these base parameters"
        )
        document["base_parameters"]["values"] = [1.0, 0.0]
        fails(document, "the dual matrices prove nothing: all are zero")


def test_multipliers_fit_what_they_multiply() -> None:
    document = infeasible(["m1"], [-1.0], ["1"], {SET: ["0"] * 9 + ["1"]})
    certificate = document["feasibility"]["certificate"]
    certificate["multipliers"][SET].append("0")
    fails(document, f"{SET}: 11 multipliers for 10 entries")
    certificate["multipliers"] = {"else": ["1"]}
    fails(document, "certificate.multipliers: no condition is called 'else'")
    certificate["base"] = ["1", "0"]
    fails(document, "certificate.base: 2 multipliers for 1 base parameters")


@pytest.mark.parametrize(("margin", "verdict"), [("1e-9", "feasible"), ("0", "failed"), ("-1e-9", "failed")])
def test_a_margin_has_the_sign_of_the_proof(margin: str, verdict: str) -> None:
    document = feasible()
    document["feasibility"]["margin"] = margin
    assert verified(document).verdict == verdict


@pytest.mark.parametrize(("margin", "verdict"), [("1e-9", "failed"), ("0", "infeasible"), ("-1e-9", "infeasible")])
def test_a_margin_has_the_sign_of_the_disproof(margin: str, verdict: str) -> None:
    document = infeasible(["m1"], [-1.0], ["1"], {SET: ["0"] * 9 + ["1"]})
    document["feasibility"]["margin"] = margin
    assert verified(document).verdict == verdict


@pytest.mark.parametrize("key", ["format", "version"])
def test_only_our_format_is_read(key: str) -> None:
    document = feasible()
    document[key] = "2"
    fails(document, "not a parameter file: format is not ident-parameters, version 1")


def test_a_claim_is_true_or_false() -> None:
    document = feasible()
    for claim in ("yes", 1, None):
        document["feasibility"]["feasible"] = claim
        fails(
            document,
            f"the file says feasible: {str(claim).lower()}, but its certificate is a witness, a proof of feasibility",
        )


@pytest.mark.parametrize("link", [1, 7, MAX_LINKS])
def test_links_have_numbers_up_to_the_most(link: int) -> None:
    content = re.sub(r"\b([A-Za-z]+|link )1\b", rf"\g<1>{link}", json.dumps(feasible()))
    result = verify(content.replace('"links": [1]', f'"links": [{link}]'))
    assert (result.verdict, result.checked[0]) == ("feasible", f"link {link}: a mass distribution exists")


@pytest.mark.parametrize("link", [0, -1, MAX_LINKS + 1, 1.5])
def test_other_numbers_of_links_are_refused(link: float) -> None:
    document = feasible()
    document["feasibility"]["certificate"]["links"] = [1, link]
    fails(document, "certificate.links: numbers from 1 to 200 were expected")


def matrix(size: int) -> Document:
    """A matrix as a condition; no description has one beside its set."""
    entries = [
        {"coefficients": {"m1": str(int(i == j) or 2)}, "constant": "0"} for j in range(size) for i in range(j + 1)
    ]
    return {"name": "unit", "size": size, "entries": entries}


@pytest.mark.slow
def test_conditions_are_bounded_in_size_and_number() -> None:
    document = feasible()
    certificate = document["feasibility"]["certificate"]
    certificate["blocks"] = [matrix(MAX_SIZE)]
    fails(document, "'unit': no condition that a description can hold has this name")
    certificate["blocks"] = [matrix(MAX_SIZE + 1)]
    fails(document, "unit: a size between 0 and 20 was expected")
    certificate["blocks"] = [matrix(2) | {"size": 1}]
    fails(document, "unit: 3 entries do not make a block of size 1")
    for size in (0.5, -1):
        certificate["blocks"] = [matrix(1) | {"size": size}]
        fails(document, "unit: a size between 0 and 20 was expected")
    certificate["blocks"] = [
        number(f"total mass at most {k} kg", {"m1": "-1"}, str(k)) for k in range(2, MAX_BLOCKS + 2)
    ]
    assert verified(document).verdict == "feasible"
    certificate["blocks"].append(LIGHT)
    fails(document, "certificate.blocks: more than 5000")


def test_names_of_conditions_are_printable_short_and_distinguished() -> None:
    document = feasible()
    certificate = document["feasibility"]["certificate"]
    certificate["blocks"] = [number("n" * 200, {"m1": "1"})]
    fails(document, f"{'n' * 200!r}: no condition that a description can hold has this name")
    for bad in ("n" * 201, "a\nb"):
        certificate["blocks"] = [number(bad, {"m1": "1"})]
        fails(document, "certificate.blocks: a name that cannot be printed")
    for same in (SET, PLANE_NAME):
        certificate["blocks"] = [number(same, {"m1": "1"})]
        fails(document, "the certificate has two conditions of one name")
    certificate["blocks"], certificate["equalities"] = [], [matrix(1)]
    fails(document, "'unit': no condition that a description can hold has this name")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("m2", "the certificate says nothing about link 2, of which there is m2"),
        ("m", "'m' is not the name of a link parameter: allowed are Lxx Lxy Lxz Lyy Lyz Lzz lx ly lz m and the joint"),
        ("m10000", "'m10000' is not the name of a link parameter"),
        ("m201", "'m201' is not the name of a link parameter"),
        ("m01", "'m01' is not the name of a link parameter"),
        ("ZZR1", "'ZZR1' is not the name of a link parameter"),
        ("_" * 41 + "1", "is not the name of a link parameter"),
    ],
)
def test_parameters_belong_to_a_link(name: str, message: str) -> None:
    document = feasible()
    document["base_parameters"]["expressions"][0] = f"m1 + {name}"
    result = verified(document)
    assert result.verdict == "failed"
    assert message in result.message


def test_every_expression_has_its_value() -> None:
    document = feasible()
    document["base_parameters"]["values"].append(1.0)
    fails(document, "base_parameters: 3 expressions but 4 values")
    document["base_parameters"] = {"expressions": [], "values": []}
    fails(document, "base_parameters: 0 expressions but 0 values")


@pytest.mark.parametrize(("claimed", "fits"), [("pseudo_inertia", True), ("none", True), ("inertia", False)])
def test_the_file_and_its_certificate_are_about_one_set(claimed: str, fits: bool) -> None:
    document = feasible()
    document["feasible_set"] = claimed
    assert verified(document).verdict == ("feasible" if fits else "failed")


def test_the_bounds_of_what_is_read_are_the_ones_decided_on() -> None:
    # Every other test takes them from the code.
    assert (certificate_verifier.MAX_FILE_CHARACTERS, MAX_LINKS, MAX_BLOCKS, MAX_SIZE) == (4_194_304, 200, 5000, 20)
    assert (certificate_verifier.MAX_NUMBER_CHARACTERS, certificate_verifier._MAX_BITS) == (2000, 20_000)
    assert certificate_verifier._MAX_STEPS == 20_000_000
    assert (certificate_verifier.MAX_EXPRESSIONS, certificate_verifier.MAX_CHARACTERS) == (1000, 262_144)


def test_numbers_are_written_up_to_a_length() -> None:
    assert rational(rational_text(Fraction(2**5999))) == 2**5999
    assert rational(rational_text(Fraction(1, 3 * 2**5990))) == Fraction(1, 3 * 2**5990)
    for long in (Fraction(2**6000), Fraction(1, 2**6000)):
        with pytest.raises(VerificationError, match="a number needs more than 2000 characters"):
            rational_text(long)


def test_dependent_expressions_are_found() -> None:
    rows = [parse_expression(text) for text in ("m1 + 3*lx1", "lx1 - 0.1*ly1", "ly1 + lz1", "m1 - 0.7*lz1")]
    assert dependent_row(rows) is None
    assert dependent_row([*rows, parse_expression("m1 + 3.1*lx1 + 2*ly1")]) == 4
    assert dependent_row([rows[0], rows[1], parse_expression("2*m1 + 5*lx1 + 0.1*ly1")]) == 2
    assert dependent_row([{}]) == 0


def test_hostile_expressions_end_in_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    # Independent, but not modulo the prime; and one that the prime divides.
    prime = Fraction(2**61 - 1)
    assert dependent_row([{"m1": Fraction(1)}, {"m1": Fraction(1), "lx1": prime}]) == 1
    with pytest.raises(VerificationError, match="base parameter 1: a coefficient that no real table has"):
        dependent_row([{"m1": 1 / prime}])
    dense = [{f"m{k}": Fraction(1, k + row) for k in range(1, 5)} for row in range(4)]
    assert dependent_row(dense) is None
    # The second row takes four steps, the third four and three, the fourth four, three and two.
    monkeypatch.setattr(certificate_verifier, "_MAX_STEPS", 20)
    assert dependent_row(dense) is None
    monkeypatch.setattr(certificate_verifier, "_MAX_STEPS", 19)
    with pytest.raises(VerificationError, match="more arithmetic than those of a real table"):
        dependent_row(dense)


def test_a_file_is_read_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content, path = json.dumps(feasible()), tmp_path / "parameters.json"
    monkeypatch.setattr(certificate_verifier, "MAX_FILE_CHARACTERS", len(content))
    path.write_text(content, encoding="utf-8")
    assert service.verify_file(path).verdict == "feasible"
    # Without the character that is too many it would be a good file.
    path.write_text(content + " ", encoding="utf-8")
    assert service.verify_file(path) == Verification("failed", f"more than {len(content)} characters")


def test_numbers_are_bounded_in_length() -> None:
    assert rational("0" * 1999 + "7") == 7
    with pytest.raises(VerificationError, match="a number of 2001 characters; at most 2000 are read"):
        rational("0" * 2000 + "7")


@pytest.mark.parametrize(
    ("corner", "definite", "semidefinite"),
    [(11, True, True), (Fraction(10_000_001, 1_000_000), True, True), (10, False, True), (9, False, False)],
)
def test_definiteness_is_decided_by_the_last_pivot_after_all_eliminations(
    corner: Fraction, definite: bool, semidefinite: bool
) -> None:
    matrix = symmetric([Fraction(n) for n in (1, 2, 5, 3, 7, corner)], 3)
    assert matrix == [[1, 2, 3], [2, 5, 7], [3, 7, corner]]
    assert (is_positive_definite(matrix), is_positive_semidefinite(matrix)) == (definite, semidefinite)
    # The same in the other order, where the decision falls in the middle.
    turned = [row[::-1] for row in matrix[::-1]]
    assert (is_positive_definite(turned), is_positive_semidefinite(turned)) == (definite, semidefinite)


def test_a_matrix_whose_numbers_grow_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    third = Fraction(1, 3)
    matrix = symmetric([Fraction(1), third, Fraction(1)], 2)
    monkeypatch.setattr(certificate_verifier, "_MAX_BITS", 4)  # 1 - 1/9 has a denominator of four bits
    assert is_positive_definite(matrix)
    monkeypatch.setattr(certificate_verifier, "_MAX_BITS", 3)
    with pytest.raises(VerificationError, match="more digits than a proof may have"):
        is_positive_definite(matrix)


@pytest.mark.parametrize("bad", [7, None, ["m1"], True])
def test_what_must_be_a_text_is_one(bad: object) -> None:
    document = feasible()
    document["base_parameters"]["expressions"][0] = bad
    fails(document, "base_parameters.expressions: a text was expected")
    document = feasible()
    document["feasibility"]["certificate"]["blocks"][0]["name"] = bad
    fails(document, "certificate.blocks.name: a text was expected")
    document = feasible()
    document["link_parameters"]["names"][0] = bad
    fails(document, "link_parameters.names: a text was expected")


def test_inequalities_are_shown_with_their_signs() -> None:
    half = Fraction(1, 2)
    assert str(Affine({"m1": Fraction(-1), "lx1": -half, "ly1": half})) == "-m1 - 0.5*lx1 + 0.5*ly1"
    assert str(Affine({"m1": Fraction(1)}, -half)) == "-0.5 + m1"
    assert str(Affine({})) == "0"


def test_a_line_for_a_terminal_has_at_most_500_characters() -> None:
    assert clean("a\x1b" + 600 * "x") == "a?" + 498 * "x"


def test_what_is_reported_of_a_file_is_one_line_of_bounded_length() -> None:
    document = feasible()
    document["feasibility"]["certificate"] = {"kind": "undecided", "reason": "why\n" + 1000 * "x"}
    result = verified(document)
    assert result.verdict == "undecided"
    assert result.message == "no proof either way; the file gives the reason 'why\\n" + 296 * "x" + "'"


def test_a_file_that_is_not_there_is_named_once(tmp_path: Path) -> None:
    path = tmp_path / "none.json"
    with pytest.raises(UsageError) as caught:
        service.verify_file(path)
    assert str(caught.value) == f"{path}: No such file or directory"


def rows(*entries: tuple[dict[str, str], str]) -> list[Document]:
    return [{"coefficients": coefficients, "constant": constant} for coefficients, constant in entries]


def box(lower: str, upper: str) -> list[Document]:
    """A box around the origin, its first side between two numbers."""
    sides = [({"lx1": "1", "m1": lower}, "0"), ({"lx1": "-1", "m1": upper}, "0")]
    for name in ("ly1", "lz1"):
        sides += [({name: "1", "m1": "1"}, "0"), ({name: "-1", "m1": "1"}, "0")]
    return rows(*sides)


def ellipsoid(xx: str, mass: str) -> list[Document]:
    """With xx = -5/2 and mass = 1/2: W = diag(2, 4, 3) around c = (0.5, 0, 0), so 2 W c = (2, 0, 0) and c W c = 0.5."""
    coefficients = {"Lxx1": xx, "Lyy1": "-1/2", "Lzz1": "-3/2", "lx1": "2", "m1": mass}
    return rows((coefficients, "0"))


PLANES = [({"lx1": sign, "m1": "1"}, "0") for sign in ("1", "-1")] + [({"ly1": sign, "m1": "1"}, "0") for sign in "12"]


@pytest.mark.parametrize(
    ("name", "entries", "good"),
    [
        ("link 1: mass within 0.5..2 kg", rows(({"m1": "1"}, "-0.5"), ({"m1": "-1"}, "2")), True),
        ("link 1: mass within 0..2.33333 kg", rows(({"m1": "1"}, "0"), ({"m1": "-1"}, "7/3")), True),
        ("link 1: mass within 1..1 kg", rows(({"m1": "1"}, "-1"), ({"m1": "-1"}, "1")), False),
        ("link 1: mass within 0.5..2 kg", rows(({"m1": "1"}, "-0.6"), ({"m1": "-1"}, "2")), False),
        ("link 1: mass within 0.5..2 kg", rows(({"m1": "1"}, "-0.5"), ({"m1": "-1"}, "1.9")), False),
        ("link 1: mass within 0.5..2 kg", rows(({"m1": "1"}, "-0.5"), ({"m1": "-1"}, "2"), ({"m1": "1"}, "1")), False),
        ("total mass at least 0.5 kg", rows(({"m1": "1"}, "-0.5")), True),
        ("total mass at most 3 kg", rows(({"m1": "-1"}, "3")), True),
        ("total mass at least 3 kg", rows(({"m1": "-1"}, "3")), False),
        ("total mass at least 0 kg", rows(({"m1": "1"}, "0")), False),
        ("total mass at most 1e+400 kg", rows(({"m1": "-1"}, "1e400")), False),
        ("link 1: centre of mass inside its box", box("0.1", "0.2"), True),
        ("link 1: centre of mass inside its box", box("0.2", "-0.1"), True),
        ("link 1: centre of mass inside its box", box("0.2", "-0.2"), False),
        ("link 1: centre of mass inside its hull", rows(*PLANES), True),
        ("link 1: centre of mass inside its hull", rows(*PLANES, ({"lz1": "1", "m1": "1"}, "0")), True),
        ("link 1: centre of mass inside its hull", rows(*PLANES[:3]), False),
        ("link 1: all mass inside its ellipsoid", ellipsoid("-5/2", "1/2"), True),
        ("link 1: all mass inside its ellipsoid", ellipsoid("-5/2", "0.5000000014"), True),
        ("link 1: all mass inside its ellipsoid", ellipsoid("-5/2", "0.5000000016"), False),
        ("link 1: all mass inside its ellipsoid", ellipsoid("-5/2", "0.4999999984"), False),
        ("link 1: all mass inside its ellipsoid", ellipsoid("2", "1/2"), False),
        ("joint 1: drive inertia positive", rows(({"Ia1": "1"}, "0")), True),
        ("joint 1: drive inertia positive", rows(({"Ia1": "1"}, "1")), False),
        ("joint 1: viscous positive", rows(({"fv1": "1"}, "0")), True),
        ("joint 1: viscous positive", rows(({"fc1": "1"}, "0")), False),
        ("joint 1: offset positive", rows(({"fo1": "1"}, "0")), False),
    ],
)
def test_a_condition_is_what_its_name_says(name: str, entries: list[Document], good: bool) -> None:
    document = infeasible(["lx1"], [0.1], ["0"], {}, {"name": name, "size": 0, "entries": entries})
    names = {key for entry in entries for key in entry["coefficients"]}
    document["feasibility"]["certificate"]["body"] |= dict.fromkeys(names - BODY.keys(), "1")
    document["feasibility"]["certificate"]["body"]["m1"] = "1"
    result = verified(document)
    assert result.verdict == "failed"
    # What is a condition gets as far as the body, or to multipliers that are all zero.
    named = "is named as something it is not" in result.message or "no condition that a description" in result.message
    assert named is not good, result.message
