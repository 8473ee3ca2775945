"""Files that were made to pass for a proof, and the sentence that each is refused with.

The arm has every kind of condition that a description can hold. Each row changes a good file, once alone and once held
against the arm; where it says None, the file is still consistent with its own conditions, and is told so, never more.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from certificate.conftest import Made

from ident_service.certificate_verifier import INERTIAL, rational_text, verify
from ident_service.cli import main
from ident_service.config.arm import Ellipsoid
from ident_service.config.load import load_arm
from ident_service.estimation.certificate import exact_block
from ident_service.estimation.feasible.feasible_set import feasible_set

Document = dict[str, Any]
SET = "a mass distribution exists"
MASS, BOX, HULL = "link 1: mass within 0.1..5 kg", "link 1: centre of mass inside its box", "inside its hull"
TOTAL, ELLIPSOID, PLANE = "total mass at most 12 kg", "link 2: all mass inside its ellipsoid", "about its xy plane"


def test_the_files_that_are_changed_are_good(made: Made) -> None:
    for document, verdict in ((made.witness, "feasible"), (made.dual, "infeasible")):
        alone, about = verify(json.dumps(document)), verify(json.dumps(document), made.arm)
        assert (alone.verdict, about.verdict) == (verdict, verdict), (alone.message, about.message)
        assert alone.message.startswith(f"consistent with its own conditions: {verdict}: ")
        assert alone.arm is None
        assert "proven" not in alone.message
        assert about.message.startswith("proven for rich: ")
        assert about.arm == "rich"


def certificate(document: Document) -> Document:
    found: Document = document["feasibility"]["certificate"]
    return found


def block(document: Document, name: str) -> Document:
    (found,) = [one for one in _all(document) if name in one["name"] and "link 2: sym" not in one["name"]][:1]
    return found


def _all(document: Document) -> list[Document]:
    return [*certificate(document)["blocks"], *certificate(document)["equalities"]]


def without(name: str) -> Callable[[Document], None]:
    """Delete conditions."""

    def change(document: Document) -> None:
        for key in ("blocks", "equalities"):
            certificate(document)[key] = [one for one in certificate(document)[key] if name not in one["name"]]

    return change


def entry(coefficients: dict[str, str], constant: str = "0") -> Document:
    return {"coefficients": coefficients, "constant": constant}


def listed(name: str, *entries: Document, key: str = "blocks") -> Callable[[Document], None]:
    """Add a condition, or replace the one of its name."""

    def change(document: Document) -> None:
        kept = [one for one in certificate(document)[key] if one["name"] != name]
        certificate(document)[key] = [*kept, {"name": name, "size": 0, "entries": list(entries)}]

    return change


def both(*changes: Callable[[Document], None]) -> Callable[[Document], None]:
    def change(document: Document) -> None:
        for one in changes:
            one(document)

    return change


def named(old: str, new: str) -> Callable[[Document], None]:
    """Replace a name everywhere in the file."""

    def change(document: Document) -> None:
        text = json.dumps(document).replace(old, new)
        document.clear()
        document.update(json.loads(text))

    return change


def printed(name: str, value: float) -> Callable[[Document], None]:
    def change(document: Document) -> None:
        table = document["link_parameters"]
        table["values"][table["names"].index(name)] = value

    return change


def third_link(document: Document) -> None:
    """Give the arm a link of -3 kg."""
    table = document["link_parameters"]
    for symbol in ("Lxx", "Lxy", "Lxz", "Lyy", "Lyz", "Lzz", "lx", "ly", "lz", "m"):
        table["names"].append(f"{symbol}3")
        table["values"].append(-3.0)
        table["units"].append("kg")


def scaled(name: str, place: int, key: str, factor: float) -> Callable[[Document], None]:
    """Change one number of a condition."""

    def change(document: Document) -> None:
        found = block(document, name)["entries"][place]
        if key == "constant":
            found["constant"] = repr(float(found["constant"]) * factor)
        else:
            found["coefficients"][key] = repr(float(found["coefficients"][key]) * factor)

    return change


def arm(**changes: Any) -> Callable[[Document], None]:
    return lambda document: document["arm"].update(changes)


def base(change: Callable[[list[str], list[float]], None]) -> Callable[[Document], None]:
    def changed(document: Document) -> None:
        table = document["base_parameters"]
        table.pop("units")
        change(table["expressions"], table["values"])

    return changed


def drop_last(expressions: list[str], values: list[float]) -> None:
    expressions.pop()
    values.pop()


def add(expression: str, value: float) -> Callable[[Document], None]:
    def change(expressions: list[str], values: list[float]) -> None:
        expressions.append(expression)
        values.append(value)

    return base(change)


def other_expression(expressions: list[str], _: list[float]) -> None:
    # No value changes: lz2 is zero in the witness.
    expressions[0] += " + 5*lz2"


BOUND = {"coefficients": {"m1": "-1"}, "constant": "1000"}
INERTIA_BOUND = {"coefficients": dict.fromkeys(("Lxx1", "Lyy1", "Lzz1"), "-1"), "constant": "1000"}
ASSUMED = "assumed: link 1 below 1000 kg and 1000 kg m^2"
IS_NOT = "is named as something it is not"
NO_NAME = (
    "is not the name of a link parameter: allowed are Lxx Lxy Lxz Lyy Lyz Lzz lx ly lz m and the joint terms Ia fv"
)

# Which file, what is changed, what is said of it alone, what is said with the arm.
Forgery = tuple[str, str, Callable[[Document], None], str | None, str]
FORGERIES: tuple[Forgery, ...] = (
    # Names.
    ("Khalil's notation", "witness", named("lx2", "MXR2"), f"'MXR2' {NO_NAME}", f"'MXR2' {NO_NAME}"),
    ("alias", "witness", named("Lzz2", "Lzz02"), f"'Lzz02' {NO_NAME}", f"'Lzz02' {NO_NAME}"),
    ("foreign name", "witness", named("fc2", "dry2"), f"'dry2' {NO_NAME}", f"'dry2' {NO_NAME}"),
    ("unicode digit", "witness", named("lx2", "lx\u0662"), "is not the name of", "is not the name of"),
    ("printed name", "witness", lambda d: d["link_parameters"]["names"].__setitem__(0, "XX1"), NO_NAME, NO_NAME),
    # Constant conditions.
    ("-1 > 0 as a mass", "dual", listed(MASS, entry({}, "-1")), f"{MASS}: a condition that says -1", "that says -1"),
    (
        "-1 = 0",
        "dual",
        listed("link 1: symmetric about its xy plane", entry({}, "-1"), key="equalities"),
        "says -1",
        "says -1",
    ),
    ("1 > 0", "witness", listed(TOTAL, entry({"m1": "0"}, "1")), "a condition that says 1", "a condition that says 1"),
    # Names that are not what the condition says.
    ("Lzz as a mass", "dual", listed(MASS, entry({"Lzz1": "-1"}, "0.05")), f"{MASS}: {IS_NOT}", IS_NOT),
    (
        "mass of another link",
        "witness",
        listed(MASS, entry({"m2": "1"}, "-0.1"), entry({"m2": "-1"}, "5")),
        IS_NOT,
        IS_NOT,
    ),
    ("other number than named", "witness", scaled(MASS, 1, "constant", 2.0), f"{MASS}: {IS_NOT}", IS_NOT),
    ("half of a mass", "witness", lambda d: block(d, MASS)["entries"].pop(), f"{MASS}: {IS_NOT}", IS_NOT),
    (
        "mass the wrong way round",
        "dual",
        listed("link 1: mass within 5..1 kg", entry({"m1": "1"}, "-5"), entry({"m1": "-1"}, "1")),
        IS_NOT,
        IS_NOT,
    ),
    ("total of one link", "witness", listed(TOTAL, entry({"m1": "-1"}, "12")), f"{TOTAL}: {IS_NOT}", IS_NOT),
    ("box turned over", "dual", scaled(BOX, 0, "m1", -3.0), f"{BOX}: {IS_NOT}", IS_NOT),
    (
        "box with an inertia",
        "witness",
        lambda d: block(d, BOX)["entries"][0]["coefficients"].update(Lzz1="1"),
        IS_NOT,
        IS_NOT,
    ),
    ("box of five", "witness", lambda d: block(d, BOX)["entries"].pop(), f"{BOX}: {IS_NOT}", IS_NOT),
    ("hull with a constant", "witness", lambda d: block(d, HULL)["entries"][0].update(constant="7"), IS_NOT, IS_NOT),
    ("hull of masses", "dual", lambda d: block(d, HULL)["entries"].append(entry({"m1": "-1"})), IS_NOT, IS_NOT),
    ("ellipsoid inside out", "witness", scaled(ELLIPSOID, 0, "Lxx2", -9.0), f"{ELLIPSOID}: {IS_NOT}", IS_NOT),
    ("ellipsoid of any mass", "witness", scaled(ELLIPSOID, 0, "m2", 1000.0), f"{ELLIPSOID}: {IS_NOT}", IS_NOT),
    (
        "negative friction called positive",
        "witness",
        listed("joint 1: coulomb positive", entry({"fc1": "-1"})),
        IS_NOT,
        IS_NOT,
    ),
    (
        "plane without its moments",
        "witness",
        lambda d: block(d, PLANE)["entries"].pop(),
        "it lacks Lyz1",
        "it lacks Lyz1",
    ),
    (
        "plane of the mass",
        "dual",
        listed("link 1: symmetric about its xy plane", entry({"m1": "1"}), key="equalities"),
        IS_NOT,
        IS_NOT,
    ),
    (
        "unknown kind",
        "dual",
        listed("link 1: weighs little", entry({"m1": "-1"}, "0.01")),
        "no condition that a description can hold",
        "no condition",
    ),
    (
        "a set beside the set",
        "witness",
        listed(f"link 1: {SET}", entry({"m1": "1"})),
        "two conditions of one name",
        "two conditions",
    ),
    (
        "condition of no link",
        "witness",
        listed("link 9: mass within 1..2 kg", entry({"m9": "1"}, "-1"), entry({"m9": "-1"}, "2")),
        "says nothing about link 9",
        "says nothing about link 9",
    ),
    # Conditions that contradict each other.
    (
        "contradiction",
        "dual",
        listed("total mass at most 0.5 kg", entry({"m1": "-1", "m2": "-1"}, "0.5")),
        "may contradict each other: total mass at most 0.5",
        "no such condition: total mass at most 0.5 kg",
    ),
    ("no body", "dual", lambda d: certificate(d).pop("body"), "certificate.body: missing", "certificate.body: missing"),
    (
        "body that is none",
        "dual",
        lambda d: certificate(d)["body"].update(m1="-1"),
        "not positive at the certificate's body",
        "not positive at the certificate's body",
    ),
    (
        "a parameter more",
        "dual",
        both(add("m1 - 3*lz2", 9.0), lambda d: certificate(d)["base"].append("0")),
        None,
        "expression 14 is no base parameter of rich",
    ),
    (
        "two values of one thing",
        "dual",
        add("2*fo1 + fo2", 9.0),
        "is zero whatever the link parameters, or a combination of those before it",
        "or a combination of those before it",
    ),
    (
        "zero is one",
        "dual",
        add("m1 - m1", 1.0),
        "is zero whatever the link parameters",
        "is zero whatever the link parameters",
    ),
    (
        "assumed to be light",
        "dual",
        listed(
            "assumed: link 1 below 1 kg and 1 kg m^2",
            entry({"m1": "-1"}, "1"),
            entry(dict.fromkeys(("Lxx1", "Lyy1", "Lzz1"), "-1"), "1"),
        ),
        IS_NOT,
        IS_NOT,
    ),
    (
        "assumed in a witness",
        "witness",
        listed(ASSUMED, BOUND, INERTIA_BOUND),
        "a witness assumes nothing",
        "a witness assumes nothing",
    ),
    # What no condition covers.
    ("a link of -3 kg", "witness", third_link, "no condition covers Lxx3", "no condition covers Lxx3"),
    (
        "a link less",
        "witness",
        lambda d: certificate(d).update(links=["1"]),
        "the certificate says nothing about link 2",
        "the certificate says nothing about link 2",
    ),
    (
        "a link more",
        "witness",
        both(without("total mass"), lambda d: certificate(d).update(links=["1", "2", "3"])),
        "an arm of 2 joints, but its certificate has conditions for the links 1, 2, 3",
        "an arm of 2 joints",
    ),
    (
        "drive inertia of any sign",
        "witness",
        without("joint 1: drive inertia"),
        "no condition says anything about Ia1: 'joint 1: drive inertia positive' is missing",
        "missing from the certificate: joint 1: drive inertia positive",
    ),
    (
        "friction of any sign",
        "witness",
        without("viscous positive"),
        "no condition says anything about fv1",
        "missing from the certificate: joint 1: viscous positive",
    ),
    (
        "a body beside its disproof",
        "dual",
        lambda d: d.update(link_parameters={"names": ["m1"], "values": [1.0]}),
        "stand beside a proof that no body",
        "no value for",
    ),
    # Deleted and changed conditions: only the arm tells.
    (
        "without a total mass",
        "witness",
        without(TOTAL),
        None,
        f"a condition of rich is missing from the certificate: {TOTAL}",
    ),
    ("without a box", "witness", without(BOX), None, f"missing from the certificate: {BOX}"),
    (
        "without a hull",
        "witness",
        without(HULL),
        None,
        "missing from the certificate: link 1: centre of mass inside its hull",
    ),
    (
        "without a plane",
        "witness",
        without(PLANE),
        None,
        "missing from the certificate: link 1: symmetric about its xy plane",
    ),
    (
        "without anything",
        "dual",
        both(without("mass"), without("positive")),
        "no condition is called",
        "missing from the certificate",
    ),
    ("a wider box", "witness", scaled(BOX, 0, "m1", 40.0), None, f"not as the description of rich has it: {BOX}"),
    (
        "a wider hull",
        "witness",
        scaled(HULL, 0, "m1", 1.5),
        None,
        "not as the description of rich has it: link 1: centre of mass inside its hull",
    ),
    (
        "a heavier arm",
        "witness",
        both(without(TOTAL), listed("total mass at most 1200 kg", entry({"m1": "-1", "m2": "-1"}, "1200"))),
        None,
        "missing from the certificate: total mass at most 12 kg",
    ),
    (
        "a condition more",
        "witness",
        listed(
            "link 2: symmetric about its yz plane",
            entry({"lx2": "1"}),
            entry({"Lxy2": "1"}),
            entry({"Lxz2": "1"}),
            key="equalities",
        ),
        "not zero at the witness",
        "no such condition: link 2: symmetric about its yz plane",
    ),
    # Another arm, other expressions.
    (
        "another arm's hash",
        "witness",
        arm(sha256="0" * 64),
        None,
        "made for another description than that of rich: it names the hash 000000000000",
    ),
    (
        "a base parameter less",
        "witness",
        both(base(drop_last), lambda d: certificate(d)["delta"].pop("fo2")),
        "link_parameters: 'fo2' is in no expression and in no condition",
        "a base parameter of rich is missing",
    ),
    ("another expression", "witness", base(other_expression), None, "is no base parameter of rich"),
    (
        "grams",
        "witness",
        lambda d: d["link_parameters"]["units"].__setitem__(9, "g"),
        "link_parameters.units: number 10 is 'g', not kg",
        "link_parameters.units: number 10 is 'g', not kg",
    ),
    # The file against itself.
    ("printed values of another body", "witness", printed("m2", 2.5), "link_parameters: ", "link_parameters: "),
    (
        "a printed link that is none",
        "witness",
        printed("m1", -3.0),
        "link_parameters: not positive as printed",
        "not positive as printed",
    ),
    (
        "the other verdict",
        "witness",
        lambda d: d["feasibility"].update(feasible=False, margin=-1.0),
        "the file says feasible: false",
        "the file says feasible: false",
    ),
    (
        "a margin",
        "dual",
        lambda d: d["feasibility"].update(margin=1000.74),
        "the margin 1000.74 contradicts the certificate",
        "the margin 1000.74 contradicts",
    ),
    (
        "another set",
        "witness",
        lambda d: d.update(feasible_set="inertia"),
        "feasible_set is inertia, but its certificate is about pseudo_inertia",
        "feasible_set is inertia",
    ),
    (
        "said to be proven",
        "witness",
        lambda d: d["feasibility"].update(certificate={"kind": "undecided", "reason": "none"}),
        "no proof either way",
        "no proof either way",
    ),
)


def test_there_are_enough() -> None:
    assert len(FORGERIES) >= 30
    assert len({forgery[0] for forgery in FORGERIES}) == len(FORGERIES)


@pytest.mark.parametrize(
    ("kind", "change", "alone", "with_arm"), [row[1:] for row in FORGERIES], ids=[row[0] for row in FORGERIES]
)
def test_no_forgery_is_proven(
    made: Made, kind: str, change: Callable[[Document], None], alone: str | None, with_arm: str | None
) -> None:
    document = copy.deepcopy(made.witness if kind == "witness" else made.dual)
    change(document)
    text = json.dumps(document)
    result = verify(text)
    assert "proven" not in result.message
    if alone is None:
        assert result.message.startswith("consistent with its own conditions: "), result.message
    else:
        assert result.verdict in ("failed", "undecided"), result.message
        assert alone in result.message
    held = verify(text, made.arm)
    assert held.verdict in ("failed", "undecided"), held.message
    assert with_arm in held.message


@pytest.fixture
def folder(made: Made, tmp_path: Path) -> Path:
    (tmp_path / "parameters.json").write_text(json.dumps(made.witness), encoding="utf-8")
    return tmp_path


def test_the_command_says_whose_conditions_count(made: Made, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(folder / "parameters.json")
    assert main(["verify", path]) == 0
    alone = capsys.readouterr().out
    assert alone.startswith(f"{path}: consistent with its own conditions: feasible: ")
    assert "proven" not in alone
    assert main(["verify", path, "--arm", str(made.description)]) == 0
    assert f"{path}: feasible: proven for rich: " in capsys.readouterr().out
    assert main(["verify", path, "--arm", str(made.description), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["arm"], document["verdict"]) == ("rich", "feasible")
    assert main(["verify", path, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["arm"] is None
    assert main(["verify", path, "--arm", "wam7"]) == 3
    assert "failed: the file was made for another description than that of wam7" in capsys.readouterr().out
    assert main(["verify", path, "--arm", "nothing"]) == 2


def test_options_of_the_identification_leave_the_arm_the_same(
    made: Made, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The file names the sections that were changed, and its hash is that of the description with these."""
    config = load_arm(made.description)
    options = config.identification.model_copy(update={"delay": 0.003, "edge": 0.25})
    used = config.model_copy(update={"identification": options})
    document = copy.deepcopy(made.witness)
    document["arm"] |= {"sha256": used.sha256, "changes": {"identification": json.loads(options.model_dump_json())}}
    path = folder / "parameters.json"

    def verified(**changes: Any) -> tuple[int, str]:
        path.write_text(json.dumps(document | {"arm": document["arm"] | changes}), encoding="utf-8")
        return main(["verify", str(path), "--arm", str(made.description)]), capsys.readouterr().out

    assert verified() == (0, verified()[1])
    assert "proven for rich" in verified()[1]
    for changes in ({}, {"identification": {}}, {"identification": 3}, {"constraints": {}}, [], "x"):
        code, words = verified(changes=changes)
        assert code == 3, changes
        assert "made for another description" in words


@pytest.mark.parametrize(("change", "good"), [(1e-10, True), (-1e-10, True), (1.1e-10, False), (-1.1e-10, False)])
def test_expressions_of_an_arm_may_differ_in_their_last_decimal(made: Made, change: float, good: bool) -> None:
    """Coefficients are rounded to eleven decimals, and processors differ in the last."""
    arm = replace(made.arm, K=({**made.arm.K[0], "Ia1": 1 + Fraction(repr(change))}, *made.arm.K[1:]))
    assert (verify(json.dumps(made.witness), arm).verdict == "feasible") is good


def test_expressions_of_an_arm_may_stand_in_another_order(made: Made) -> None:
    document = copy.deepcopy(made.witness)
    for values in document["base_parameters"].values():
        values.reverse()
    assert verify(json.dumps(document), made.arm).verdict == "feasible"
    # Each once.
    table = document["base_parameters"]
    table["expressions"][0], table["values"][0] = table["expressions"][1], table["values"][1]
    assert verify(json.dumps(document), made.arm).verdict == "failed"


@pytest.mark.parametrize("seed", range(5))
def test_an_ellipsoid_of_any_direction_is_one(made: Made, seed: int) -> None:
    """Recognise a description's ellipsoid, and nothing that differs in one of its numbers."""
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    config = load_arm(made.description)
    joint = next(iter(config.joints.values()))
    ellipsoid = {"center": rng.uniform(-0.05, 0.05, 3).tolist(), "axes": axes.tolist(), "semi_axes": [0.9, 0.8, 0.7]}
    body = joint.body.model_copy(update={"ellipsoid": Ellipsoid.model_validate(_tuples(ellipsoid)), "symmetry": ()})
    joints = dict.fromkeys(config.joints, joint.model_copy(update={"body": body}))
    names = made.arm.names
    conditions = feasible_set("pseudo_inertia", names, config.model_copy(update={"joints": joints}))
    document = copy.deepcopy(made.witness)
    (found,) = (block for block in conditions.blocks if block.name == ELLIPSOID)
    (entry,) = exact_block(found, names).entries
    numbers = {name: rational_text(value) for name, value in entry.coefficients.items()}
    assert len(numbers) == len(INERTIAL)
    listed(ELLIPSOID, {"coefficients": numbers, "constant": "0"})(document)
    assert verify(json.dumps(document)).verdict == "feasible", verify(json.dumps(document)).message
    for name in numbers:
        document = copy.deepcopy(made.witness)
        changed = numbers | {name: repr(float(numbers[name]) + 1.0)}
        listed(ELLIPSOID, {"coefficients": changed, "constant": "0"})(document)
        assert IS_NOT in verify(json.dumps(document)).message, name


def _tuples(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _tuples(one) for key, one in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
