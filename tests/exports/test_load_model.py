"""Identified parameters in pinocchio by one call: what it computes is what the regressor predicts."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from estimation.synthetic import SampledRecording, stamps, waves
from exports.export_bench import SIMULATED, arm_of_file, assert_same, identified, some_delta, states_of, true_arm
from helpers.random_arms import bodies_of, model_around, random_chain, random_delta, reference_model, reference_torque
from hypothesis import given, settings
from hypothesis import strategies as st

from ident_service.config.load import load_arm
from ident_service.errors import ModelError, ParameterError, UsageError
from ident_service.estimation.identify import identify
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.dynamic_model import DynamicModel
from ident_service.model.parameter_layout import TERM_SYMBOLS, Layout
from ident_service.model.regressor import joint_regressor
from ident_service.results import load_model
from ident_service.results.run_folder import write_manifest, write_results

Array = np.ndarray


def predicted(model: ArmModel, delta: Array, states: tuple[Array, Array, Array]) -> Array:
    return np.asarray(np.einsum("jps,p->sj", joint_regressor(model.chain, model.layout, *states), delta))


def computed(model: DynamicModel, states: tuple[Array, Array, Array]) -> Array:
    return np.array([model.inverse_dynamics(*state) for state in zip(*states, strict=True)])


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of results of the small arm with other Stribeck velocities than its description has."""
    folder = tmp_path_factory.mktemp("results")
    text = (Path(__file__).parents[2] / "configs" / "planar2.yaml").read_text()
    text = text.replace("coulomb, offset]", "coulomb, offset, stribeck]").split("driver:")[0]
    text += "identification: {friction: {stribeck_velocity: [0.3, 0.5]}, smoothing: {cutoff: 40}}\n"
    (folder / "arm.yaml").write_text(text)
    model = arm_model(load_arm(folder / "arm.yaml"))
    delta = some_delta(model)
    time = np.arange(5000) / 250.0
    q, dq, ddq = (waves(1, 2).derivative(time, order) for order in range(3))
    torque = predicted(model, delta, (q, dq, ddq))
    estimate = identify(model, [SampledRecording(stamps(5000, 250.0), q, torque, sha256="a" * 64)], [])
    (folder / "run").mkdir()
    write_results(folder / "run", estimate)
    write_manifest(folder / "run")
    return folder / "run"


def test_a_folder_of_results_becomes_a_model(run: Path) -> None:
    model = load_model(run)
    content = json.loads((run / "parameters.json").read_text())
    arm = model.arm
    assert arm.layout.stribeck_velocity == (0.3, 0.5)
    states = states_of(arm.chain)
    assert_same(computed(model, states), predicted(arm, np.array(content["link_parameters"]["values"]), states))


def test_a_parameter_file_and_an_arm_become_the_same_model(run: Path, tmp_path: Path) -> None:
    shutil.copy(run / "parameters.json", tmp_path / "mine.json")
    other = (run.parent / "arm.yaml").read_text().replace("[0.3, 0.5]", "0.1")
    (tmp_path / "arm.yaml").write_text(other)
    states = states_of(load_model(run).arm.chain)
    alone = load_model(tmp_path / "mine.json", tmp_path / "arm.yaml")
    # The friction's shape is the one that the parameters were fitted with.
    np.testing.assert_array_equal(computed(alone, states), computed(load_model(run), states))
    shutil.copy(run / "arm.json", tmp_path / "arm.json")
    np.testing.assert_array_equal(computed(load_model(str(tmp_path / "mine.json")), states), computed(alone, states))


def test_what_does_not_belong_together_is_refused(run: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such file"):
        load_model(tmp_path / "parameters.json", "planar2")
    shutil.copy(run / "parameters.json", tmp_path)
    with pytest.raises(UsageError, match=r"there is no arm\.json beside it; name its arm"):
        load_model(tmp_path / "parameters.json")
    with pytest.raises(ParameterError, match="wam7"):
        load_model(tmp_path / "parameters.json", "wam7")
    (tmp_path / "arm.json").write_text(load_arm("planar2").model_dump_json())
    with pytest.raises(ParameterError, match=r"identified for another arm than .*arm\.json describes"):
        load_model(tmp_path / "parameters.json")


def changed(run: Path, folder: Path, **changes: object) -> Path:
    """The run's parameter file with another table, and its arm beside it."""
    content = json.loads((run / "parameters.json").read_text())
    for key, value in changes.items():
        if value is None:
            del content[key]
        else:
            content[key] |= value
    (folder / "parameters.json").write_text(json.dumps(content))
    shutil.copy(run / "arm.json", folder)
    return folder / "parameters.json"


def test_parameters_that_no_body_has_are_refused(run: Path, tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="these parameters are not feasible, so there is no model"):
        load_model(changed(run, tmp_path, link_parameters=None))


def test_link_values_that_contradict_the_base_values_are_refused(run: Path, tmp_path: Path) -> None:
    values = json.loads((run / "parameters.json").read_text())["link_parameters"]["values"]
    values[5] += 1e-3
    with pytest.raises(ParameterError, match="link parameters do not have the values of its base parameters"):
        load_model(changed(run, tmp_path, link_parameters={"values": values}))
    with pytest.raises(ParameterError, match="link parameters are not those of the arm"):
        load_model(changed(run, tmp_path, link_parameters={"values": values[1:], "names": ["m1"]}))


def test_another_grouping_is_refused(run: Path, tmp_path: Path) -> None:
    expressions = json.loads((run / "parameters.json").read_text())["base_parameters"]["expressions"]
    assert "0.25" in expressions[0]
    expressions[0] = expressions[0].replace("0.25", "0.26")
    with pytest.raises(ParameterError, match="do not group the parameters of planar2 as its motion does"):
        load_model(changed(run, tmp_path, base_parameters={"expressions": expressions}))


@pytest.mark.slow
@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 5))
def test_random_trees_with_every_friction_term(seed: int, joints: int) -> None:
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, joints)
    layout = Layout(chain.revolute, tuple(TERM_SYMBOLS), tuple(rng.uniform(0.1, 1.0, size=joints)))
    arm, delta = model_around(chain, layout), random_delta(rng, layout)
    model, states = DynamicModel(arm, delta), states_of(chain)
    assert_same(computed(model, states), predicted(arm, delta, states))
    rigid = reference_torque(reference_model(chain, bodies_of(layout, delta)), *states)
    assert_same(computed(model, states) - model.friction(states[1]), rigid + model.model.armature * states[2])


def test_shared_drives_are_computed_though_no_joint_has_them() -> None:
    arm = arm_model(load_arm("tx40"))
    delta, states = some_delta(arm), states_of(arm.chain)
    model = DynamicModel(arm, delta)
    assert_same(computed(model, states), predicted(arm, delta, states))
    assert not np.array(model.model.armature)[4:].any()


@pytest.mark.parametrize("name", SIMULATED)
def test_pinocchio_knows_the_numbers(name: str) -> None:
    arm = true_arm(name)
    assert arm.delta is not None
    model, layout = DynamicModel(arm.model, arm.delta).model, arm.model.layout
    np.testing.assert_array_equal(model.armature, layout.term_values("drive_inertia", arm.delta))
    np.testing.assert_array_equal(model.damping, layout.term_values("viscous", arm.delta))
    np.testing.assert_array_equal(model.upperDryFrictionLimit, layout.term_values("coulomb", arm.delta))
    np.testing.assert_array_equal(model.lowerDryFrictionLimit, -layout.term_values("coulomb", arm.delta))
    joints = [arm.model.config.joints[joint] for joint in arm.model.chain.names]
    np.testing.assert_array_equal(model.lowerPositionLimit, [joint.position[0] for joint in joints if joint.position])
    np.testing.assert_array_equal(model.upperEffortLimit, [joint.torque for joint in joints])
    np.testing.assert_array_equal(model.upperVelocityLimit, [joint.velocity for joint in joints])
    np.testing.assert_array_equal(model.gravity.linear, arm.model.chain.gravity)
    assert isinstance(model, pin.Model)


def test_friction_is_none_at_rest_but_for_offsets() -> None:
    arm = true_arm("planar2")
    assert arm.delta is not None
    model = DynamicModel(arm.model, arm.delta)
    np.testing.assert_array_equal(model.friction(np.zeros(2)), arm.model.layout.term_values("offset", arm.delta))
    assert model.friction(np.ones((3, 4, 2))).shape == (3, 4, 2)


def test_parameters_of_the_wrong_size_are_refused() -> None:
    arm = true_arm("planar2")
    with pytest.raises(ModelError, match="28 parameters"):
        DynamicModel(arm.model, np.zeros(27))


def test_an_arm_of_a_urdf_is_loaded_like_any_other(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "configs" / "threelink.urdf").read_text()
    arm = arm_of_file(tmp_path, "urdf", text)
    made = identified(arm, some_delta(arm))
    assert made.delta is not None
    states = states_of(arm.chain)
    assert_same(computed(DynamicModel(arm, made.delta), states), predicted(arm, made.delta, states))


def test_importing_the_results_loads_no_pinocchio() -> None:
    code = "import sys, ident_service.results as r; assert callable(r.load_model); print('pinocchio' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout == "False\n"
