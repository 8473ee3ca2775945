"""A certificate that was changed no longer verifies.

Any digit of a base parameter, an expression or a witness breaks `K delta = beta`, any digit of a dual breaks the
equations, all checked exactly. The exception are link parameters that no expression names: another digit there is
another witness, and a valid one as long as every block stays positive.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from certificate_samples import parameter_file, random_bodies, random_config, text
from helpers.examples import NIGHT

from ident_service.certificate_verifier import verify
from ident_service.estimation.certificate import certify
from ident_service.estimation.feasible.feasible_set import feasible_set
from ident_service.model.arm_model import arm_model
from ident_service.model.base_parameters import BaseParameters, base_parameters

Document = dict[str, Any]
SOME = 1 if NIGHT else 3  # of so many digits one is changed


def _arm() -> tuple[BaseParameters, Any, np.ndarray]:
    rng = np.random.default_rng(11)
    model = arm_model(random_config(rng, 3, square=True))
    base = base_parameters(model.chain, model.layout)
    mass = type(model.config.constraints.total_mass)(upper=20.0)
    constraints = model.config.constraints.model_copy(update={"total_mass": mass})
    config = model.config.model_copy(update={"constraints": constraints})
    return base, feasible_set("pseudo_inertia", base.names, config), random_bodies(rng, base.names)


@pytest.fixture(scope="module")
def witness() -> Document:
    base, conditions, delta = _arm()
    beta = base.K @ delta
    document = parameter_file(beta, base, certify(beta, base, conditions, delta), delta)
    assert verify(text(document)).verdict == "feasible"
    return document


@pytest.fixture(scope="module")
def dual() -> Document:
    base, conditions, delta = _arm()
    delta[base.names.index("lx3")] += 10.0
    beta = base.K @ delta
    document = parameter_file(beta, base, certify(beta, base, conditions))
    assert verify(text(document)).verdict == "infeasible"
    return document


def _changed_digits(number: str, every: int = 1) -> Iterator[str]:
    """The number with one of its digits replaced; not the exponent's, which only get larger."""
    mantissa = re.split("[eE]", number)[0]
    for place in range(0, len(mantissa), every):
        if mantissa[place].isdigit():
            yield number[:place] + str((int(mantissa[place]) + 1) % 10) + number[place + 1 :]


def _fails(document: Document, change: Callable[[Document], None]) -> str:
    changed = copy.deepcopy(document)
    change(changed)
    result = verify(text(changed))
    assert result.verdict == "failed", result
    assert result.message
    return result.message


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["witness", "dual"])
def test_every_digit_of_a_base_parameter_counts(kind: str, request: pytest.FixtureRequest) -> None:
    document = request.getfixturevalue(kind)
    content = text(document)
    for value in document["base_parameters"]["values"]:
        for number in _changed_digits(repr(value), SOME):
            if float(number) == value:
                continue
            # In the text, as rounding to a float must not hide a digit.
            result = verify(content.replace(f" {value!r}", f" {number}", 1).replace(f"[{value!r}", f"[{number}", 1))
            if kind == "witness":
                assert result.verdict == "failed"
            else:
                # The same multipliers prove more than one vector infeasible; they must not prove a feasible one so.
                assert result.verdict in ("failed", "infeasible")


def test_a_dual_does_not_prove_feasible_parameters_infeasible(witness: Document, dual: Document) -> None:
    def swap(document: Document) -> None:
        document["base_parameters"] = witness["base_parameters"]

    assert "value is positive" in _fails(dual, swap)


@pytest.mark.parametrize("kind", ["witness", "dual"])
def test_every_coefficient_of_an_expression_counts(kind: str, request: pytest.FixtureRequest) -> None:
    document = request.getfixturevalue(kind)
    expressions = document["base_parameters"]["expressions"]
    for row, expression in enumerate(expressions):
        for match in re.finditer(r"\d+\.\d+", expression):
            for number in _changed_digits(match.group(), SOME):
                changed = expression[: match.start()] + number + expression[match.end() :]
                _fails(document, lambda d, r=row, c=changed: d["base_parameters"]["expressions"].__setitem__(r, c))
        flipped = expression.replace(" - ", " + ", 1) if " - " in expression else f"-{expression}"
        if kind == "witness":
            _fails(document, lambda d, r=row, c=flipped: d["base_parameters"]["expressions"].__setitem__(r, c))


@pytest.mark.slow
def test_every_digit_of_the_witness_counts_where_an_expression_names_it(witness: Document) -> None:
    named = set(re.findall(r"[A-Za-z]+\d+", " ".join(witness["base_parameters"]["expressions"])))
    for name, number in witness["feasibility"]["certificate"]["delta"].items():
        for changed in _changed_digits(number, SOME):
            if name in named:
                _fails(witness, lambda d, n=name, c=changed: d["feasibility"]["certificate"]["delta"].__setitem__(n, c))
        _fails(witness, lambda d, n=name: d["feasibility"]["certificate"]["delta"].pop(n))


def test_an_impossible_body_is_no_witness_even_where_no_expression_tells(witness: Document) -> None:
    assert "Lxx1" not in " ".join(witness["base_parameters"]["expressions"])
    for number in ("0", "-1", "1000"):
        message = _fails(witness, lambda d, n=number: d["feasibility"]["certificate"]["delta"].__setitem__("Lxx1", n))
        assert "link 1: a mass distribution exists" in message


@pytest.mark.slow
def test_every_digit_of_a_dual_counts(dual: Document) -> None:
    certificate = dual["feasibility"]["certificate"]
    for name, row in certificate["multipliers"].items():
        for place, number in enumerate(row):
            for changed in _changed_digits(number, 2 * SOME):
                _fails(
                    dual,
                    lambda d, n=name, p=place, c=changed: d["feasibility"]["certificate"]["multipliers"][n].__setitem__(
                        p, c
                    ),
                )
    for place, number in enumerate(certificate["base"]):
        for changed in _changed_digits(number, 2 * SOME):
            _fails(dual, lambda d, p=place, c=changed: d["feasibility"]["certificate"]["base"].__setitem__(p, c))


def test_duals_that_cancel_but_prove_nothing(dual: Document) -> None:
    def negative(document: Document) -> None:
        certificate = document["feasibility"]["certificate"]
        flip = lambda number: number.removeprefix("-") if number.startswith("-") else f"-{number}"  # noqa: E731
        certificate["base"] = [flip(n) for n in certificate["base"]]
        certificate["multipliers"] = {k: [flip(n) for n in row] for k, row in certificate["multipliers"].items()}

    def nothing(document: Document) -> None:
        certificate = document["feasibility"]["certificate"]
        certificate["base"] = ["0"] * len(certificate["base"])
        certificate["multipliers"] = {}

    assert "not positive semidefinite" in _fails(dual, negative)
    assert "all are zero" in _fails(dual, nothing)


def test_a_claim_that_contradicts_the_certificate_fails(witness: Document, dual: Document) -> None:
    for document in (witness, dual):
        feasible = document["feasibility"]["feasible"]
        _fails(document, lambda d, f=feasible: d["feasibility"].__setitem__("feasible", not f))
        _fails(document, lambda d, f=feasible: d["feasibility"].__setitem__("margin", -1.0 if f else 1.0))
        _fails(document, lambda d: d.__setitem__("feasible_set", "inertia"))
        _fails(document, lambda d: d["feasibility"].pop("certificate"))
        _fails(document, lambda d: d["feasibility"]["certificate"].__setitem__("kind", "none"))
        _fails(document, lambda d: d["feasibility"]["certificate"]["links"].pop())


def test_a_smaller_bound_is_another_condition(witness: Document) -> None:
    def tighter(document: Document) -> None:
        blocks = document["feasibility"]["certificate"]["blocks"]
        next(b for b in blocks if b["name"].startswith("total mass"))["entries"][0]["constant"] = "0.1"

    assert "total mass" in _fails(witness, tighter)


def test_printed_link_parameters_are_held_against_the_proof(witness: Document) -> None:
    names = witness["link_parameters"]["names"]

    def other(name: str, value: float) -> Callable[[Document], None]:
        return lambda d: d["link_parameters"]["values"].__setitem__(names.index(name), value)

    assert "not positive as printed: link 1" in _fails(witness, other("m1", -1.0))
    value = witness["link_parameters"]["values"][names.index("lx3")]
    assert "base parameter" in _fails(witness, other("lx3", value + 1e-3))


def test_undecided_is_reported_as_such(witness: Document) -> None:
    document = copy.deepcopy(witness)
    document["feasibility"]["certificate"] = {"kind": "undecided", "set": "inertia", "margin": 0.0, "reason": "why\x1b"}
    result = verify(text(document))
    assert result.verdict == "undecided"
    assert r"why\x1b" in result.message
