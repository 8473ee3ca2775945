"""SDF as Drake reads it (with libsdformat), and our own reader against files that were written by hand."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from exports.export_bench import (
    SIMULATED,
    assert_same,
    drake_torque,
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
from ident_service.model.parameter_layout import joint_drives
from ident_service.results.export import sdf
from ident_service.results.export.identified_arm import IdentifiedArm
from ident_service.results.export.sdf import read_sdf, sdf_export

GRAVITY = (0.0, 0.0, -9.81)


def written(arm: IdentifiedArm) -> str:
    assert arm.delta is not None
    return sdf_export(arm.model, arm.delta, "arm.sdf")[0]


@pytest.mark.parametrize("name", SIMULATED)
def test_drake_has_the_regressor_s_torques(name: str) -> None:
    arm = true_arm(name)
    states = states_of(arm.model.chain)
    found, plant = drake_torque(written(arm), arm.model.chain, states)
    assert_same(found, torque_of(arm, states, ("viscous",)))
    for joint in arm.model.chain.names:
        settings_, read = arm.model.config.joints[joint], plant.GetJointByName(joint)
        assert (read.position_lower_limit(), read.position_upper_limit()) == settings_.position
        assert read.velocity_upper_limit() == settings_.velocity
        assert plant.GetJointActuatorByName(joint).effort_limit() == settings_.torque


def test_terms_of_shared_drives_are_left_out_and_named() -> None:
    model = arm_model(load_arm("tx40"))
    arm = identified(model, some_delta(model))
    text, lost, _ = sdf_export(model, arm.delta, "arm.sdf")  # type: ignore[arg-type]
    states = states_of(model.chain)
    found, _ = drake_torque(text, model.chain, states)
    damping = joint_drives(model.chain, model.layout, some_delta(model)).damping
    assert not damping[4:].any()
    assert damping[:4].all()
    assert_same(found, torque_of(arm, states, ()) + damping * states[1])
    assert "viscous friction (fv) of joint_5, joint_6" in lost
    assert "drive inertia (Ia) of every joint" in lost
    assert "gravity" in lost


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 6), square=st.booleans())
def test_random_trees_agree_in_drake(seed: int, joints: int, square: bool) -> None:
    rng = np.random.default_rng(seed)
    model = model_around(random_chain(rng, joints, square=square))
    config = model.config.model_copy(update={"gravity": tuple(model.chain.gravity.tolist())})
    arm = identified(dataclasses.replace(model, config=config), random_delta(rng, model.layout))
    states = states_of(model.chain)
    found, _ = drake_torque(written(arm), model.chain, states)
    assert_same(found, torque_of(arm, states, ("viscous",)))


def test_names_that_sdf_keeps_for_itself_are_changed_and_named() -> None:
    rng = np.random.default_rng(4)
    names = ("world", "__model__", "a::b", 'c"<&', "a_b", "d_link", "d")
    chain = dataclasses.replace(random_chain(rng, len(names)), names=names)
    model = model_around(chain)
    model = dataclasses.replace(
        model, config=model.config.model_copy(update={"gravity": tuple(chain.gravity.tolist())})
    )
    arm = identified(model, random_delta(rng, model.layout))
    text, _, notes = sdf_export(model, arm.delta, "arm.sdf")  # type: ignore[arg-type]
    new = ("world_joint", "__model___joint", "a_b", 'c"<&', "a_b_2", "d_link", "d")
    changed = {f"{old} is called {now}" for old, now in zip(names, new, strict=True) if old != now}
    assert set(notes) == changed
    states = states_of(chain)
    found, _ = drake_torque(text, dataclasses.replace(chain, names=new), states)
    assert_same(found, torque_of(arm, states, ("viscous",)))


LINK = """<link name="{name}"><pose{relative}>{pose}</pose><inertial><pose>0.1 0.2 0.3 0.4 -0.5 0.6</pose><mass>2</mass>
<inertia><ixx>0.3</ixx><ixy>0.01</ixy><ixz>0.02</ixz><iyy>0.4</iyy><iyz>-0.03</iyz><izz>0.5</izz></inertia></inertial></link>"""
BY_HAND = f"""<?xml version="1.0"?>
<sdf version="1.9"><model name="hand">
{LINK.format(name="one", relative="", pose="0.1 0 1 0.3 0.2 0.1")}
{LINK.format(name="two &lt;", relative=' relative_to="one"', pose="0 0.2 0.5 -0.7 0.4 1.1")}
<joint name="a" type="revolute"><pose>0.05 0.06 0.07 0.2 0.3 0.4</pose><parent>world</parent><child>one</child>
<axis><xyz>0 0.6 0.8</xyz><limit><lower>-1</lower><upper>1</upper></limit>
<dynamics><damping>0.25</damping><friction>0.5</friction></dynamics></axis></joint>
<joint name="b" type="prismatic"><parent>one</parent><child> two &lt; </child>
<axis><xyz>1 0 0</xyz><limit><lower>-1</lower><upper>1</upper></limit></axis></joint>
</model></sdf>"""


def test_our_reader_reads_poses_as_the_specification_says() -> None:
    """A file that our writer would never write, against the same arm built in pinocchio by hand, and against Drake."""
    arm = read_sdf(BY_HAND, "hand.sdf", GRAVITY)

    def pose(*numbers: float) -> pin.SE3:
        return pin.SE3(pin.rpy.rpyToMatrix(*numbers[3:]), np.array(numbers[:3]))

    in_inertial = pin.Inertia(2.0, np.zeros(3), np.array([[0.3, 0.01, 0.02], [0.01, 0.4, -0.03], [0.02, -0.03, 0.5]]))
    body = in_inertial.se3Action(pose(0.1, 0.2, 0.3, 0.4, -0.5, 0.6))
    in_child = pose(0.05, 0.06, 0.07, 0.2, 0.3, 0.4)
    model = pin.Model()
    first = model.addJoint(
        0, pin.JointModelRevoluteUnaligned(0.0, 0.6, 0.8), pose(0.1, 0, 1, 0.3, 0.2, 0.1) * in_child, "a"
    )
    model.appendBodyToJoint(first, body, in_child.inverse())
    place = in_child.inverse() * pose(0, 0.2, 0.5, -0.7, 0.4, 1.1)
    second = model.addJoint(first, pin.JointModelPrismaticUnaligned(1.0, 0.0, 0.0), place, "b")
    model.appendBodyToJoint(second, body, pin.SE3.Identity())
    assert arm.chain.names == ("a", "b")
    assert arm.damping.tolist() == [0.25, 0.0]
    assert arm.friction.tolist() == [0.5, 0.0]
    for k in range(2):
        np.testing.assert_allclose(arm.chain.rotation[k], model.jointPlacements[k + 1].rotation, atol=1e-14)
        np.testing.assert_allclose(arm.chain.translation[k], model.jointPlacements[k + 1].translation, atol=1e-14)
        own = pin.Inertia(model.inertias[k + 1]).toDynamicParameters()
        np.testing.assert_allclose(arm.bodies[k][[9, 6, 7, 8, 0, 1, 3, 2, 4, 5]], own, atol=1e-14)
    states = states_of(arm.chain)
    data = model.createData()
    meant = np.array([pin.rnea(model, data, *state) for state in zip(*states, strict=True)]) + [0.25, 0.0] * states[1]
    found, _ = drake_torque(BY_HAND, arm.chain, states)
    assert_same(found, meant)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('<sdf version="1.9">', '<!DOCTYPE sdf [<!ENTITY a "b">]><sdf version="1.9">'),
        ("<model", "<world"),
        ("<pose>0.05", '<pose degrees="true">0.05'),
        ("<pose>0.1 0.2 0.3 0.4 -0.5 0.6</pose>", '<pose rotation_format="quat_xyzw">0 0 0 0 0 0 1</pose>'),
        ("<xyz>0", '<xyz expressed_in="one">0'),
        ('type="revolute"', 'type="screw"'),
        ("<mass>2", "<mass>two"),
        ("<mass>2", "<mass>nan"),
        ("<parent>one", "<parent>nobody"),
        (' relative_to="one"', ' relative_to="two &lt;"'),
        (' relative_to="one"', ' relative_to="nobody"'),
        ("<ixx>0.3</ixx>", ""),
        ("</sdf>", ""),
    ],
)
def test_what_could_mean_something_else_is_refused(old: str, new: str) -> None:
    assert old in BY_HAND
    with pytest.raises(ModelError, match=r"hand\.sdf: "):
        read_sdf(
            BY_HAND.replace(old, new).replace("</model>", "</world>" if new == "<world" else "</model>"),
            "hand.sdf",
            GRAVITY,
        )


@pytest.mark.parametrize(
    ("old", "new"), [("<mass>2", "<mass>3"), ("<damping>0", "<damping>1"), ("<friction>0", "<friction>1")]
)
def test_a_file_that_says_something_else_is_refused(monkeypatch: pytest.MonkeyPatch, old: str, new: str) -> None:
    arm = true_arm("planar2")
    honest = sdf._text

    def careless(*arguments: Any) -> str:
        text = honest(*arguments)
        assert old in text
        return text.replace(old, new, 1)

    monkeypatch.setattr(sdf, "_text", careless)
    with pytest.raises(ModelError, match="it was not written"):
        sdf_export(arm.model, arm.delta, "arm.sdf")  # type: ignore[arg-type]
