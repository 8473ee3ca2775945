"""MJCF as MuJoCo and pinocchio read it."""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from exports.export_bench import (
    SIMULATED,
    arm_of_file,
    assert_same,
    identified,
    mujoco_torque,
    needed,
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
from ident_service.model.chain import Chain
from ident_service.model.parameter_layout import Layout
from ident_service.results.export import mjcf
from ident_service.results.export.identified_arm import IdentifiedArm
from ident_service.results.export.mjcf import mjcf_export


def written(arm: IdentifiedArm) -> str:
    assert arm.delta is not None
    return mjcf_export(arm.model, arm.delta, "arm.xml")[0]


def tree(chain: Chain) -> IdentifiedArm:
    """A random arm with this chain, its gravity in the configuration."""
    model = model_around(chain)
    config = model.config.model_copy(update={"gravity": tuple(chain.gravity.tolist())})
    return identified(dataclasses.replace(model, config=config), random_delta(np.random.default_rng(6), model.layout))


@pytest.mark.parametrize("name", SIMULATED)
def test_mujoco_has_the_regressor_s_torques(name: str) -> None:
    arm = true_arm(name)
    chain, layout = arm.model.chain, arm.model.layout
    states = states_of(chain)
    found, model = mujoco_torque(written(arm), chain, states)
    assert_same(found, torque_of(arm, states, ("drive_inertia", "viscous")))
    np.testing.assert_array_equal(model.dof_armature, layout.term_values("drive_inertia", arm.delta))
    np.testing.assert_array_equal(np.ravel(model.dof_damping), layout.term_values("viscous", arm.delta))
    np.testing.assert_array_equal(model.dof_frictionloss, layout.term_values("coulomb", arm.delta))
    np.testing.assert_array_equal(model.opt.gravity, chain.gravity)
    joints = [arm.model.config.joints[joint] for joint in chain.names]
    np.testing.assert_array_equal(model.jnt_range, [joint.position for joint in joints])
    assert model.jnt_limited.all()
    torques = [[-joint.torque, joint.torque] for joint in joints if joint.torque is not None]
    np.testing.assert_array_equal(model.jnt_actfrcrange, torques)
    np.testing.assert_array_equal(model.actuator_ctrlrange, torques)


def test_dry_friction_is_what_mujoco_holds_a_joint_with() -> None:
    arm = true_arm("planar2")
    mujoco = needed("mujoco")
    model = mujoco.MjModel.from_xml_string(written(arm))
    model.opt.gravity[:] = 0.0
    data = mujoco.MjData(model)
    friction = arm.model.layout.term_values("coulomb", arm.delta)
    for share, moves in ((0.9, False), (1.2, True)):
        mujoco.mj_resetData(model, data)
        data.ctrl[0] = share * friction[0]
        for _ in range(200):
            mujoco.mj_step(model, data)
        assert bool(abs(data.qvel[0]) > 0.01) == moves


def test_drives_that_move_several_joints_become_tendons() -> None:
    arm = identified(arm_model(load_arm("tx40")), some_delta(arm_model(load_arm("tx40"))))
    text, lost = mjcf_export(arm.model, arm.delta, "arm.xml")  # type: ignore[arg-type]
    states = states_of(arm.model.chain)
    found, model = mujoco_torque(text, arm.model.chain, states)
    assert_same(found, torque_of(arm, states, ("drive_inertia", "viscous")))
    coulomb = arm.model.layout.term_values("coulomb", arm.delta)
    np.testing.assert_array_equal(model.tendon_frictionloss, coulomb[4:])
    np.testing.assert_array_equal(model.dof_frictionloss, [*coulomb[:4], 0.0, 0.0])
    assert lost == ("torque offset (fo) of every joint", "Stribeck friction (fs) of every joint", "velocity limits")


@pytest.mark.slow
@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 6), square=st.booleans())
def test_random_trees_agree_in_mujoco_and_pinocchio(seed: int, joints: int, square: bool) -> None:
    arm = tree(random_chain(np.random.default_rng(seed), joints, square=square))
    text, states = written(arm), states_of(arm.model.chain)
    found, _ = mujoco_torque(text, arm.model.chain, states)
    assert_same(found, torque_of(arm, states, ("drive_inertia", "viscous")))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.xml"
        path.write_text(text)
        read = pin.buildModelFromMJCF(str(path))
    assert_same(pinocchio_torque(read, arm.model.chain, states), torque_of(arm, states, ("drive_inertia",)))


def test_the_file_describes_the_same_arm_to_us(tmp_path: Path) -> None:
    arm = true_arm("sixaxis")
    again = arm_of_file(tmp_path, "mjcf", written(arm), gravity=[0, 0, -9.81])
    assert again.prior is not None
    layout = Layout(again.chain.revolute, ())
    bodies = np.concatenate([again.prior[again.layout.inertial(k)] for k in range(layout.joints)])
    read = identified(dataclasses.replace(again, layout=layout, prior=None), bodies)
    states = states_of(arm.model.chain)
    assert_same(torque_of(read, states, ()), torque_of(arm, states, ()))


def test_names_with_markup_come_back() -> None:
    names = ('a"b', "<c> & d", "e--f", "g'h i", "µ", "j_link", "base_link")
    chain = dataclasses.replace(random_chain(np.random.default_rng(4), len(names)), names=names)
    assert chain.parents.count(-1) > 1
    arm, states = tree(chain), states_of(chain)
    found, _ = mujoco_torque(written(arm), chain, states)
    assert_same(found, torque_of(arm, states, ("drive_inertia", "viscous")))


def test_what_the_format_lacks_is_stated_in_the_file_and_in_the_answer() -> None:
    arm = true_arm("threelink")
    text, lost = mjcf_export(arm.model, arm.delta, "arm.xml")  # type: ignore[arg-type]
    assert lost == ("torque offset (fo) of every joint", "velocity limits")
    assert "<!-- This format has no place for: torque offset (fo) of every joint; velocity limits. -->" in text


def test_negative_values_are_left_out_and_named() -> None:
    arm = true_arm("planar2")
    delta = np.array(arm.delta)
    delta[arm.model.layout.names.index("fv2")] = -0.1
    text, lost = mjcf_export(arm.model, delta, "arm.xml")
    assert "viscous friction (fv) of elbow" in lost
    _, model = mujoco_torque(text, arm.model.chain, states_of(arm.model.chain))
    assert np.ravel(model.dof_damping)[1] == 0.0


def test_a_body_that_mujoco_would_refuse_is_refused_with_a_reason() -> None:
    arm = true_arm("planar2")
    delta = np.array(arm.delta)
    delta[arm.model.layout.names.index("Lzz2")] *= 3.0  # more than Lxx + Lyy
    with pytest.raises(ModelError, match="link of elbow has an inertia that no distribution of mass has, which MuJoCo"):
        mjcf_export(arm.model, delta, "arm.xml")
    delta[arm.model.layout.names.index("m2")] = 0.0
    with pytest.raises(ModelError, match="the link of elbow has mass 0 kg"):
        mjcf_export(arm.model, delta, "arm.xml")


@pytest.mark.parametrize(
    ("old", "new"), [('mass="2', 'mass="3'), ('armature="0', 'armature="1'), ('coef="1', 'coef="2')]
)
def test_a_file_that_says_something_else_is_refused(monkeypatch: pytest.MonkeyPatch, old: str, new: str) -> None:
    model = arm_model(load_arm("tx40"))
    honest = mjcf._text

    def careless(*arguments: Any) -> str:
        text = honest(*arguments)
        assert old in text
        return text.replace(old, new, 1)

    monkeypatch.setattr(mjcf, "_text", careless)
    with pytest.raises(ModelError, match="it was not written"):
        mjcf_export(model, some_delta(model), "arm.xml")
