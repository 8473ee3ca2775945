"""JSON and CSV: read by the loader that the documentation prints, and by Python's own parsers."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import io
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from exports.export_bench import (
    SIMULATED,
    assert_same,
    identified,
    pinocchio_torque,
    some_delta,
    states_of,
    torque_of,
    true_arm,
)
from helpers.random_arms import model_around, random_chain, random_delta
from hypothesis import given, settings
from hypothesis import strategies as st

from ident_service.config.load import load_arm
from ident_service.errors import ModelError
from ident_service.model.arm_model import arm_model
from ident_service.model.parameter_layout import TERM_SYMBOLS, Layout
from ident_service.results.export import formats as json_model
from ident_service.results.export.formats import csv_export, export_texts, json_export

DOCUMENT = Path(__file__).parents[2] / "docs" / "exports.md"


def documented_loader(folder: Path) -> dict[str, Any]:
    """What the documentation's lines make of a file, run as they stand there: their variables."""
    blocks = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL)
    (code,) = [block for block in blocks if "json.loads" in block]
    assert "ident_service" not in code
    found: dict[str, Any] = {}
    with contextlib.chdir(folder):
        exec(code, found)  # noqa: S102  # the documentation's own lines
    return found


@pytest.mark.parametrize("name", SIMULATED)
def test_the_documented_lines_load_the_file_into_pinocchio(tmp_path: Path, name: str) -> None:
    arm = true_arm(name)
    (tmp_path / "ARM.json").write_text(json_export(arm, "ARM.json"))
    found = documented_loader(tmp_path)
    states = states_of(arm.model.chain)
    assert_same(pinocchio_torque(found["model"], arm.model.chain, states), torque_of(arm, states, ("drive_inertia",)))
    assert not found["coupled"].any()


def test_the_documented_lines_know_drives_that_move_several_joints(tmp_path: Path) -> None:
    model = arm_model(load_arm("tx40"))
    arm = identified(model, some_delta(model))
    (tmp_path / "ARM.json").write_text(json_export(arm, "ARM.json"))
    found = documented_loader(tmp_path)
    states = states_of(model.chain)
    alone, meant = pinocchio_torque(found["model"], model.chain, states), torque_of(arm, states, ("drive_inertia",))
    assert_same(alone + states[2] @ found["coupled"], meant)
    assert np.abs(alone - meant).max() > 1e-3 * np.abs(meant).max()


@pytest.mark.slow
@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 5))
def test_random_trees_with_every_term_are_written(seed: int, joints: int) -> None:
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, joints)
    layout = Layout(chain.revolute, tuple(TERM_SYMBOLS), tuple(rng.uniform(0.1, 1.0, size=joints)))
    arm = identified(model_around(chain, layout), random_delta(rng, layout))
    content = json.loads(json_export(arm, "ARM.json"))
    assert content["drives"]["stribeck_velocity"] == list(layout.stribeck_velocity)
    for term in layout.terms:
        assert content["drives"][term] == layout.term_values(term, arm.delta).tolist()  # type: ignore[arg-type]
    assert content["base_parameters"]["values"] == arm.beta.tolist()


def test_coupled_drives_are_written() -> None:
    model = arm_model(load_arm("tx40"))
    content = json.loads(json_export(identified(model, some_delta(model)), "ARM.json"))
    assert content["drives"]["coupling"] == model.chain.coupling.tolist()


def test_without_a_body_there_are_base_parameters_only() -> None:
    arm = dataclasses.replace(true_arm("planar2"), delta=None)
    content = json.loads(json_export(arm, "ARM.json"))
    assert [joint["body"] for joint in content["joints"]] == [None, None]
    assert content["drives"] is None
    assert content["base_parameters"]["values"] == arm.beta.tolist()
    rows = list(csv.DictReader(io.StringIO(csv_export(arm, "ARM.csv"))))
    assert {row["kind"] for row in rows} == {"base"}


def test_every_parameter_has_a_row_with_its_exact_value() -> None:
    arm = true_arm("wam7_sim")
    assert arm.delta is not None
    rows = list(csv.DictReader(io.StringIO(csv_export(arm, "ARM.csv"))))
    base, link = ([row for row in rows if row["kind"] == kind] for kind in ("base", "link"))
    assert [row["name"] for row in base] == list(arm.base.expressions)
    assert [float(row["value"]) for row in base] == arm.beta.tolist()
    assert [row["unit"] for row in base] == list(arm.base.units)
    assert [row["sigma"] for row in base[:2]] == ["0.125", ""]
    assert {row["verdict"] for row in base} == {"identified"}
    assert [row["name"] for row in link] == list(arm.model.layout.names)
    assert [float(row["value"]) for row in link] == arm.delta.tolist()
    assert [row["unit"] for row in link] == list(arm.model.layout.units)


def test_strange_names_come_back(tmp_path: Path) -> None:
    names = ('a"b', "c,d\n", "<e>", "µ")
    chain = dataclasses.replace(random_chain(np.random.default_rng(1), 4), names=names)
    model = model_around(chain)
    (tmp_path / "ARM.json").write_text(json_export(identified(model, some_delta(model)), "ARM.json"))
    assert tuple(documented_loader(tmp_path)["model"].names)[1:] == names


@pytest.mark.parametrize("what", ["mass", "viscous", "axis", "values"])
def test_a_file_that_says_something_else_is_refused(monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    arm = true_arm("threelink")
    document = json_model._document(arm)
    if what == "mass":
        document["joints"][1]["body"]["mass"] *= 1.0 + 1e-6
    elif what == "axis":
        document["joints"][1]["axis"][1] *= -1.0
    elif what == "viscous":
        document["drives"]["viscous"][2] += 1e-3
    else:
        document["base_parameters"]["values"][0] += 1e-12
    monkeypatch.setattr(json_model, "_document", lambda _: document)
    with pytest.raises(ModelError, match="it was not written"):
        json_export(arm, "ARM.json")


def test_values_before_the_constraints_stand_beside_their_deviations() -> None:
    arm = true_arm("planar2")
    free = arm.beta + 0.5
    arm = dataclasses.replace(arm, feasible_set="pseudo_inertia", unconstrained=free)
    rows = [row for row in csv.DictReader(io.StringIO(csv_export(arm, "ARM.csv"))) if row["kind"] == "base"]
    assert [float(row["unconstrained_value"]) for row in rows] == free.tolist()
    content = json.loads(json_export(arm, "ARM.json"))
    assert content["base_parameters"]["unconstrained_values"] == free.tolist()
    said = "standard deviations are of the unconstrained fit; values are constrained to the set pseudo_inertia"
    assert said in content["notes"]
    (exported,) = export_texts(arm, ["c"])
    assert f" * Mind: {said}.\n" in exported.text
    assert exported.notes == (said,)
    assert export_texts(true_arm("planar2"), ["c"])[0].notes == ()
