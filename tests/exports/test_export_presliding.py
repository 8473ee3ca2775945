"""Friction with a memory: carried by what has a place for its state, and named where it is lost."""

from __future__ import annotations

import csv
import ctypes
import dataclasses
import io
import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from exports.export_bench import assert_same, compiler, identified, some_delta, states_of, true_arm

from ident_service.config.load import load_arm
from ident_service.errors import ModelError
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.dynamic_model import DynamicModel
from ident_service.model.friction_state import friction_direction as directions
from ident_service.model.regressor import joint_regressor
from ident_service.results import load_model
from ident_service.results.export import c_header as writer
from ident_service.results.export.c_header import c_header, c_prefix, read_c_header
from ident_service.results.export.formats import export_texts
from ident_service.results.export.identified_arm import IdentifiedArm

Array = np.ndarray
PERIOD = 1e-3
WAYS = {"tx40": (0.02, 0.0, 0.05, 0.01, 0.03, 0.002), "planar2": (0.01, 0.0)}


def with_ways(name: str) -> IdentifiedArm:
    """An arm whose dry friction turns round over these ways; tx40 has a drive that moves two joints."""
    config = load_arm(name)
    shape = config.identification.friction.model_copy(
        update={"presliding": WAYS[name], "stribeck_velocity": (0.2,) * len(WAYS[name])}
    )
    settings = config.identification.model_copy(update={"friction": shape})
    model = arm_model(config.model_copy(update={"identification": settings}))
    return identified(model, some_delta(model))


def motion(model: ArmModel, samples: int = 400) -> tuple[Array, Array, Array]:
    """Position, velocity and acceleration of joints that turn round again and again, with a pause."""
    time = np.arange(samples) * PERIOD
    rate = np.array([4.0 * np.cos(2.0 * np.pi * (5.0 + k) * time + k) for k in range(model.chain.joints)]).T
    rate[100:140] = 0.0
    return 0.3 + PERIOD * np.cumsum(rate, axis=0), rate, np.gradient(rate, PERIOD, axis=0)


def predicted(arm: IdentifiedArm, states: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    """Torques as the estimation has them, and the directions that it finds in the whole motion."""
    chain, rate = arm.model.chain, states[1] @ arm.model.chain.coupling.T
    way = directions(rate, PERIOD, np.array(WAYS[arm.model.config.name]))
    H = joint_regressor(chain, arm.model.layout, *states, direction=way)
    return np.einsum("jps,p->sj", H, arm.delta), way


@pytest.mark.parametrize("name", sorted(WAYS))
def test_the_state_of_the_model_gives_the_torques_that_were_fitted(name: str) -> None:
    arm = with_ways(name)
    assert arm.delta is not None
    model, states = DynamicModel(arm.model, arm.delta), motion(arm.model)
    meant, way = predicted(arm, states)
    direction, found = np.sign(states[1][0] @ arm.model.chain.coupling.T), []
    for q, dq, ddq in zip(*states, strict=True):
        direction = model.turned(direction, PERIOD * dq)
        found.append(model.inverse_dynamics(q, dq, ddq, direction))
    np.testing.assert_allclose(direction, way[-1], rtol=0, atol=1e-12)
    assert_same(np.array(found), meant)
    # Without the state, the torques are others.
    memoryless = np.array([model.inverse_dynamics(*state) for state in zip(*states, strict=True)])
    assert np.abs(memoryless - meant).max() > 0.1 * np.abs(model.friction(states[1])).max()


@pytest.mark.parametrize("name", sorted(WAYS))
def test_the_header_s_state_gives_the_torques_that_were_fitted(name: str) -> None:
    arm = with_ways(name)
    states = q, dq, ddq = motion(arm.model, 200)
    meant, way = predicted(arm, states)
    text, prefix = c_header(arm), c_prefix(arm)
    direction = np.sign(dq[0] @ arm.model.chain.coupling.T)
    for k in range(len(dq)):
        step = {"step": PERIOD * dq[k][:, None], "before": direction[:, None]}
        direction = read_c_header(text, prefix, "turned", step)[:, 0]
        np.testing.assert_allclose(direction, way[k], rtol=0, atol=1e-12)
    found = read_c_header(text, prefix, "rigid_dynamics", {"q": q.T, "dq": dq.T, "ddq": ddq.T})
    found += read_c_header(text, prefix, "turning_friction", {"dq": dq.T, "direction": way.T})
    assert_same(found.T, meant)


def test_a_header_that_turns_otherwise_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    arm, written = with_ways("planar2"), writer._written
    assert "(-100.0)" in written(arm)
    monkeypatch.setattr(writer, "_written", lambda one: written(one).replace("(-100.0)", "(-101.0)"))
    with pytest.raises(ModelError, match="direction of friction read back from the C header differs"):
        c_header(arm)


def test_what_has_no_state_says_so_and_tables_have_the_presliding_lengths() -> None:
    arm = with_ways("planar2")
    made = {one.format: one for one in export_texts(arm, ["urdf", "mjcf", "sdf", "json", "csv", "c"])}
    way = "pre-sliding of dry friction (distance: shoulder 0.01 rad): here it reverses at once"
    for name in ("urdf", "mjcf", "sdf"):
        (said,) = [one for one in made[name].not_carried if one.startswith("pre-sliding")]
        assert said.startswith(way)
        assert "the torque errors of the report are with pre-sliding" in said
        assert "pre-sliding of dry friction (distance: shoulder 0.01 rad)" in made[name].text
    assert not [one for name in ("json", "csv", "c") for one in made[name].not_carried if "pre-sliding" in one]
    assert "planar2_friction are without pre-sliding" in made["c"].notes[0]
    assert json.loads(made["json"].text)["friction"]["presliding"] == [0.01, 0.0]
    rows = list(csv.DictReader(io.StringIO(made["csv"].text)))
    shape = [(row["name"], row["unit"], row["value"]) for row in rows if row["kind"] == "friction shape"]
    assert shape == [("presliding1", "rad", "0.01"), ("presliding2", "rad", "0.0")]
    bodiless = dataclasses.replace(arm, delta=None)
    content = json.loads(export_texts(bodiless, ["json"])[0].text)
    assert content["friction"]["presliding"] == [0.01, 0.0]
    assert "pre-sliding" in export_texts(bodiless, ["c"])[0].notes[0]


def test_arms_without_it_have_no_word_of_it() -> None:
    for one in export_texts(true_arm("planar2"), ["urdf", "mjcf", "sdf", "csv", "c"]):
        assert "sliding of dry" not in one.text
        assert "_turned" not in one.text
        assert "sliding" not in " ".join((*one.not_carried, *one.notes))
    arm = true_arm("planar2")
    assert arm.delta is not None
    model, (_, dq, _) = DynamicModel(arm.model, arm.delta), states_of(arm.model.chain)
    still = np.zeros_like(dq)
    np.testing.assert_array_equal(model.friction(dq, model.turned(still, dq)), model.friction(dq))


def test_the_presliding_lengths_of_a_parameter_file_go_into_the_model(tmp_path: Path) -> None:
    arm = with_ways("planar2")
    assert arm.delta is not None
    content = {
        "format": "ident-parameters",
        "version": 1,
        "base_parameters": {"expressions": list(arm.base.expressions), "values": arm.beta.tolist()},
        "link_parameters": {"names": list(arm.model.layout.names), "values": arm.delta.tolist()},
        "friction": {"presliding": [0.01, 0.0], "stribeck_velocity": []},
    }
    (tmp_path / "mine.json").write_text(json.dumps(content))
    model = load_model(tmp_path / "mine.json", "planar2")
    np.testing.assert_array_equal(model.presliding, [0.01, 0.0])
    dq, direction = np.array([0.5, 0.5]), np.array([-1.0, 1.0])
    fc = arm.model.layout.term_values("coulomb", arm.delta)
    np.testing.assert_allclose(model.friction(dq) - model.friction(dq, direction), [2.0 * fc[0], 0.0], atol=1e-12)
    # After its way, a third of the turn is still to come: 1 - 2/e.
    turned = model.turned(direction, np.array([0.01, 0.0]))
    np.testing.assert_allclose(turned, [1.0 - 2.0 / np.e, 0.0], atol=1e-12)


@pytest.mark.parametrize(("program", "standard", "ending"), [("gcc", "-std=c99", "c"), ("g++", "-std=c++11", "cpp")])
def test_a_compiled_header_turns_in_place(tmp_path: Path, program: str, standard: str, ending: str) -> None:
    (tmp_path / "arm.h").write_text(c_header(with_ways("tx40")))
    linkage = 'extern "C" ' if ending == "cpp" else ""
    call = "void turn(const double *step, double *direction)"
    text = f"{linkage}{call};\n{linkage}{call} {{ tx40_turned(step, direction, direction); }}\n"
    (tmp_path / f"arm.{ending}").write_text(f'#include "arm.h"\n{text}')
    strict = ["-Wall", "-Wextra", "-Werror", "-pedantic", "-O2", "-fPIC", "-shared", "-Wno-unused-function"]
    command = [compiler(program), standard, *strict, "-o", "arm.so", f"arm.{ending}", "-lm"]
    subprocess.run(command, cwd=tmp_path, check=True, timeout=100)
    library, model = ctypes.CDLL(str(tmp_path / "arm.so")), with_ways("tx40").model
    rate, direction = motion(model)[1], np.ones(6)
    pointer = ctypes.POINTER(ctypes.c_double)
    for row in rate:
        step = np.ascontiguousarray(PERIOD * row)
        library.turn(step.ctypes.data_as(pointer), direction.ctypes.data_as(pointer))
    drives = rate @ model.chain.coupling.T
    meant = directions(drives, PERIOD, np.array(WAYS["tx40"]), np.ones(6))[-1]
    np.testing.assert_allclose(direction, meant, rtol=0, atol=1e-12)
