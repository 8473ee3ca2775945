"""The C header, compiled by compilers and run beside the regressor; and what its own reader does not let pass."""

from __future__ import annotations

import ctypes
import dataclasses
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
from exports.export_bench import (
    SIMULATED,
    assert_same,
    compiler,
    identified,
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
from ident_service.results.export import c_header as writer
from ident_service.results.export.c_header import c_header, c_prefix, read_c_header, run_c_lines
from ident_service.results.export.identified_arm import IdentifiedArm

Array = np.ndarray
STRICT = ["-Wall", "-Wextra", "-Werror", "-pedantic", "-O2", "-fPIC", "-shared"]
C = ("gcc", "-std=c99", "c")
CPP = ("g++", "-std=c++11", "cpp")
ALL_TERMS = tuple(TERM_SYMBOLS)
CALLS = ("inverse_dynamics", "rigid_dynamics", "friction", "gravity", "mass_matrix")


class Compiled:
    """A header's functions, called from here."""

    def __init__(self, folder: Path, arm: IdentifiedArm, how: tuple[str, str, str] = C) -> None:
        program, standard, ending = how
        name, n = c_prefix(arm), arm.model.chain.joints
        (folder / "arm.h").write_text(c_header(arm))
        arguments = {"inverse_dynamics": 3, "rigid_dynamics": 3, "friction": 1, "gravity": 1, "mass_matrix": 1}
        lines = ['#include "arm.h"', '#include "arm.h"']
        for call, count in arguments.items():
            taken = ", ".join(f"const double *a{k}" for k in range(count))
            given = ", ".join(f"a{k}" for k in range(count))
            linkage = 'extern "C" ' if ending == "cpp" else ""
            lines.append(f"{linkage}void call_{call}({taken}, double *out);")
            lines.append(f"{linkage}void call_{call}({taken}, double *out) {{ {name}_{call}({given}, out); }}")
        (folder / f"arm.{ending}").write_text("\n".join(lines) + "\n")
        command = [compiler(program), standard, *STRICT, "-o", str(folder / f"arm_{ending}.so"), f"arm.{ending}", "-lm"]
        subprocess.run(command, cwd=folder, check=True, timeout=100)
        self._library = ctypes.CDLL(str(folder / f"arm_{ending}.so"))
        self._sizes = dict.fromkeys(arguments, n) | {"mass_matrix": n * n}

    def __call__(self, call: str, *arguments: Array) -> Array:
        rows = []
        for row in zip(*arguments, strict=True):
            inputs = [np.ascontiguousarray(argument) for argument in row]
            out = np.full(self._sizes[call], np.nan)
            pointers = [array.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for array in (*inputs, out)]
            getattr(self._library, f"call_{call}")(*pointers)
            rows.append(out)
        return np.array(rows)


def assert_dynamics(run: Compiled, arm: IdentifiedArm) -> None:
    """Every function against the regressor with the link parameters that a body has."""
    q, dq, _ = states = states_of(arm.model.chain)
    still, n = np.zeros_like(q), arm.model.chain.joints
    terms = arm.model.layout.terms
    assert_same(run("inverse_dynamics", *states), torque_of(arm, states, terms))
    assert_same(run("rigid_dynamics", *states) + run("friction", dq), torque_of(arm, states, terms))
    # Only the sum is known where a sliding joint's offset is grouped with masses.
    resting = torque_of(arm, (q, still, still), terms)
    assert_same(run("gravity", q) + run("friction", still), resting)
    gravity = torque_of(arm, (q, still, still), ())
    columns = [torque_of(arm, (q, still, still + unit), ("drive_inertia",)) - gravity for unit in np.eye(n)]
    M = run("mass_matrix", q).reshape(-1, n, n)
    assert_same(M, np.array(columns).transpose(1, 2, 0))
    np.testing.assert_array_equal(M, M.transpose(0, 2, 1))


@pytest.mark.parametrize("name", SIMULATED)
@pytest.mark.parametrize("how", [C, CPP], ids=["c99", "c++11"])
def test_simulated_arms_have_the_regressor_s_torques(tmp_path: Path, name: str, how: tuple[str, str, str]) -> None:
    arm = true_arm(name)
    run = Compiled(tmp_path, arm, how)
    assert_dynamics(run, arm)
    # None of them has an offset that cannot be told from gravity.
    q, dq, ddq = states = states_of(arm.model.chain)
    assert_same(run("gravity", q), torque_of(arm, (q, np.zeros_like(q), np.zeros_like(q)), ()))
    assert_same(run("rigid_dynamics", *states), torque_of(arm, states, ("drive_inertia",)))
    friction = torque_of(arm, (q, dq, ddq), arm.model.layout.terms) - torque_of(arm, states, ("drive_inertia",))
    np.testing.assert_allclose(run("friction", dq), friction, rtol=0, atol=1e-9 * np.abs(friction).max())


def test_drives_that_move_several_joints_are_in_the_code(tmp_path: Path) -> None:
    model = arm_model(load_arm("tx40"))
    assert not np.array_equal(model.chain.coupling, np.diag(np.diag(model.chain.coupling)))
    arm = identified(model, some_delta(model))
    assert_dynamics(Compiled(tmp_path, arm), arm)


@pytest.mark.parametrize("seed", range(3))
def test_random_trees_with_every_friction_term_compile_and_agree(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, 1 + 2 * seed)
    layout = Layout(chain.revolute, ALL_TERMS, tuple(rng.uniform(0.1, 1.0, size=chain.joints)))
    arm = identified(model_around(chain, layout), random_delta(rng, layout))
    assert_dynamics(Compiled(tmp_path, arm), arm)


def test_parameters_that_no_body_has_are_exported_all_the_same(tmp_path: Path) -> None:
    model = arm_model(load_arm("threelink"))
    delta = some_delta(model)
    delta[model.layout.inertial(2)] *= -1.0
    arm = identified(model, delta, feasible=False)
    run = Compiled(tmp_path, arm)
    states = states_of(model.chain)
    meant = torque_of(dataclasses.replace(arm, delta=delta), states, model.layout.terms)
    assert_same(run("inverse_dynamics", *states), meant)


@pytest.mark.slow
@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 5), square=st.booleans())
def test_the_text_of_random_arms_says_what_the_regressor_says(seed: int, joints: int, square: bool) -> None:
    rng = np.random.default_rng(seed)
    model = model_around(random_chain(rng, joints, square=square))
    arm = identified(model, random_delta(rng, model.layout))
    text = c_header(arm)
    states = states_of(model.chain)
    arrays = dict(zip(("q", "dq", "ddq"), (state.T for state in states), strict=True))
    found = [read_c_header(text, c_prefix(arm), call, arrays).T for call in ("rigid_dynamics", "friction")]
    assert_same(sum(found), torque_of(arm, states, model.layout.terms))


def test_results_may_overwrite_arguments(tmp_path: Path) -> None:
    arm = true_arm("planar2")
    run = Compiled(tmp_path, arm)
    states = states_of(arm.model.chain, 1)
    for place in range(3):
        row = [state[0].copy() for state in states]
        pointers = [array.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for array in (*row, row[place])]
        run._library.call_inverse_dynamics(*pointers)
        np.testing.assert_array_equal(row[place], run("inverse_dynamics", *states)[0])


@pytest.mark.slow
def test_names_that_mean_something_in_c_are_harmless(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    names = ('"quoted" */ int', "a b", "a-b", "int", "3rd", "a_b", "??/", "µ\n#error")
    chain = dataclasses.replace(random_chain(rng, len(names)), names=names)
    model = model_around(chain)
    model = dataclasses.replace(model, config=model.config.model_copy(update={"name": "7.for"}))
    arm = identified(model, random_delta(rng, model.layout))
    assert_dynamics(Compiled(tmp_path, arm), arm)
    places = re.findall(r"^    (\w+) = (\d+) /\*", c_header(arm), re.MULTILINE)
    assert [int(number) for _, number in places] == list(range(len(names)))
    assert len({name for name, _ in places}) == len(names)


def test_the_header_uses_nothing_but_math(tmp_path: Path) -> None:
    arm = true_arm("planar2")
    Compiled(tmp_path, arm)
    text = c_header(arm)
    assert re.findall(r"#include (.*)", text) == ["<math.h>"]
    assert len(re.findall(r"^static ", text, re.MULTILINE)) == len(CALLS) + 1
    undefined = subprocess.run(
        [compiler("nm"), "-u", str(tmp_path / "arm_c.so")], capture_output=True, text=True, check=True
    ).stdout
    needed = {line.split()[-1].split("@")[0] for line in undefined.splitlines()}
    assert {name for name in needed if not name.startswith("_")} <= {"sin", "cos", "sincos", "exp"}


def test_numbers_are_those_of_the_parameter_file() -> None:
    arm = true_arm("sixaxis")
    table = c_header(arm).split("_base_parameters[sixaxis_BASE_PARAMETERS] = {\n")[1].split("};")[0]
    assert [float(line.split("/*")[0].rstrip(", ")) for line in table.splitlines()] == arm.beta.tolist()
    assert "standard deviation 0.12" in table


@pytest.mark.parametrize(
    ("what", "by"),
    [
        (r"(x\d+) - (x\d+);", r"\2 - \1;"),
        (r"= -(x\d+);", r"= \1;"),
        (r"sin\(", "cos("),
        (r" \* 9.81", " * 9.82"),
        (r"tau\[0\] = (x\d+);", r"tau[0] = 0.0;"),
    ],
)
def test_a_header_that_computes_something_else_is_refused(monkeypatch: pytest.MonkeyPatch, what: str, by: str) -> None:
    arm = true_arm("planar2")
    honest = writer._written(arm)
    changed, count = re.subn(what, by, honest, count=1)
    assert count == 1
    monkeypatch.setattr(writer, "_written", lambda _: changed)
    with pytest.raises(ModelError, match=r"read back from the C header differs|generated code"):
        c_header(arm)


@pytest.mark.parametrize("line", ["    system(x0);", "    tau[0] = x9;", "    const double x0 = 1.0 / 0.0;", "}"])
def test_the_reader_runs_generated_lines_only(line: str) -> None:
    with pytest.raises(ModelError, match="generated code"):
        run_c_lines([line], {"q": np.zeros((1, 1))})
