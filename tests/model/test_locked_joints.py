"""Stock URDFs: joints that are locked, mimic others, or lie outside of base and tip."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from pydantic import ValidationError

from ident_service.config.arm import ArmConfig
from ident_service.config.kinematics import Kinematics
from ident_service.config.quantities import TextFile
from ident_service.errors import ModelError
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.chain import Chain
from ident_service.model.collision import scene
from ident_service.model.mechanism import read_mechanism
from ident_service.model.regressor import joint_regressor
from ident_service.operations.new_description import new_description
from ident_service.results.export.urdf import urdf_export


def inertial(mass: float, x: float, y: float, z: float) -> str:
    moments = f'ixx="{0.011 * mass}" iyy="{0.012 * mass}" izz="{0.009 * mass}" ixy="0" ixz="{0.001 * mass}" iyz="0"'
    return (
        f'<inertial><origin xyz="{x} {y} {z}" rpy="0.1 0.2 0.3"/><mass value="{mass}"/><inertia {moments}/></inertial>'
    )


def link(name: str, mass: float) -> str:
    body = inertial(mass, 0.02 * mass, -0.01, 0.05) if mass else ""
    mesh = '<visual><geometry><mesh filename="package://arm/mesh.dae"/></geometry></visual>'
    return f'<link name="{name}">{body}{mesh}</link>'


def joint(name: str, kind: str, parent: str, child: str, place: str, axis: str = "0 0 1", more: str = "") -> str:
    bounds = '<limit lower="-2.9" upper="2.9" effort="87" velocity="2"/>' if kind == "revolute" else ""
    bounds = '<limit lower="0" upper="0.04" effort="20" velocity="0.2"/>' if kind == "prismatic" else bounds
    origin = '<origin xyz="{} {} {}" rpy="{} {} {}"/>'.format(*place.split())
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{origin}'
        f'<axis xyz="{axis}"/>{bounds}{more}</joint>'
    )


# The tree of Franka's Panda (frames of its manual), bodies made up: seven joints, a hand with two fingers of which the
# second mimics the first.
PANDA_PLACES = (
    "0 0 0.333 0 0 0",
    "0 0 0 -1.570796327 0 0",
    "0 -0.316 0 1.570796327 0 0",
    "0.0825 0 0 1.570796327 0 0",
    "-0.0825 0.384 0 -1.570796327 0 0",
    "0 0 0 1.570796327 0 0",
    "0.088 0 0 1.570796327 0 0",
)
PANDA = (
    '<?xml version="1.0" encoding="utf-8"?>\n<robot name="panda" xmlns:xacro="http://www.ros.org/wiki/xacro">\n'
    + link("panda_link0", 2.8)
    + "".join(
        link(f"panda_link{k}", 3.5 - 0.3 * k)
        + joint(f"panda_joint{k}", "revolute", f"panda_link{k - 1}", f"panda_link{k}", place)
        for k, place in enumerate(PANDA_PLACES, 1)
    )
    + link("panda_link8", 0.0)
    + joint("panda_joint8", "fixed", "panda_link7", "panda_link8", "0 0 0.107 0 0 0")
    + link("panda_hand", 0.73)
    + joint("panda_hand_joint", "fixed", "panda_link8", "panda_hand", "0 0 0 0 0 -0.785398163397")
    + link("panda_leftfinger", 0.1)
    + link("panda_rightfinger", 0.1)
    + joint("panda_finger_joint1", "prismatic", "panda_hand", "panda_leftfinger", "0 0 0.0584 0 0 0", "0 1 0")
    + joint(
        "panda_finger_joint2",
        "prismatic",
        "panda_hand",
        "panda_rightfinger",
        "0 0 0.0584 0 0 0",
        "0 -1 0",
        '<mimic joint="panda_finger_joint1"/>',
    )
    + "\n</robot>\n"
)
# A mobile manipulator in the manner of PAL's TIAGo: wheels, a lifting torso, a head, an arm with a gripper whose second
# finger mimics the first.
TIAGO = (
    '<robot name="tiago" xmlns:xacro="http://ros.org/wiki/xacro"><gazebo><plugin filename="x.so" name="y"/></gazebo>\n'
    + link("base_footprint", 0.0)
    + link("base_link", 30.0)
    + joint("base_joint", "fixed", "base_footprint", "base_link", "0 0 0.0985 0 0 0")
    + "".join(
        link(f"wheel_{side}_link", 1.8)
        + joint(f"wheel_{side}_joint", "continuous", "base_link", f"wheel_{side}_link", f"0 {y} 0 -1.57079632679 0 0")
        for side, y in (("left", 0.2), ("right", -0.2))
    )
    + link("torso_lift_link", 6.9)
    + joint("torso_lift_joint", "prismatic", "base_link", "torso_lift_link", "-0.06 0 0.7 0.1 0.2 0.3")
    + link("head_1_link", 0.6)
    + joint("head_1_joint", "revolute", "torso_lift_link", "head_1_link", "0.18 0 0.1 0 0 0")
    + link("arm_1_link", 2.1)
    + joint("arm_1_joint", "revolute", "torso_lift_link", "arm_1_link", "0.155 0.014 -0.151 0 0 -1.57079632679")
    + link("arm_2_link", 1.8)
    + joint("arm_2_joint", "revolute", "arm_1_link", "arm_2_link", "0.125 0.018 -0.0311 -1.57079632679 0 0")
    + link("arm_3_link", 2.3)
    + joint("arm_3_joint", "revolute", "arm_2_link", "arm_3_link", "0.0895 0 -0.0015 -1.57079632679 0 1.57079632679")
    + link("arm_tool_link", 0.2)
    + joint("arm_tool_joint", "fixed", "arm_3_link", "arm_tool_link", "0 0 0.06 -1.5 -1.5 0")
    + "".join(
        link(f"gripper_{side}_link", 0.05)
        + joint(
            f"gripper_{side}_joint",
            "revolute",
            "arm_tool_link",
            f"gripper_{side}_link",
            f"0 {y} 0.1 0 0 0",
            "1 0 0",
            more,
        )
        for side, y, more in (
            ("left", 0.02, ""),
            ("right", -0.02, '<mimic joint="gripper_left_joint" multiplier="-1" offset="0.2"/>'),
        )
    )
    + "\n</robot>\n"
)
SEVEN = tuple(f"panda_joint{k}" for k in range(1, 8))
THREE = ("arm_1_joint", "arm_2_joint", "arm_3_joint")


def config(text: str, **kinematics: Any) -> ArmConfig:
    return ArmConfig.model_validate(
        {
            "format": "ident-arm",
            "version": 1,
            "name": "arm",
            "gravity": (0.3, -0.2, -9.7),
            "kinematics": {"urdf": {"name": "arm.urdf", "text": text}, **kinematics},
        }
    )


def arm(text: str, **kinematics: Any) -> ArmModel:
    return arm_model(config(text, **kinematics))


def torques(model: ArmModel, position: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
    assert model.prior is not None
    H = joint_regressor(model.chain, model.layout, position, velocity, acceleration)
    return np.einsum("jps,p->sj", H, model.prior)


def whole_torques(
    text: str, chain: Chain, held: dict[str, float], base: str | None, states: tuple[np.ndarray, ...]
) -> np.ndarray:
    """Torques of the arm's joints in the whole mechanism, all others held, gravity turned as the base is."""
    model = pin.buildModelFromXML(text)
    data = model.createData()
    position = pin.neutral(model)
    for name, value in held.items():
        one = model.joints[model.getJointId(name)]
        position[one.idx_q : one.idx_q + one.nq] = [value] if one.nq == 1 else [np.cos(value), np.sin(value)]
    if base is not None:
        pin.framesForwardKinematics(model, data, position)
        model.gravity.linear = data.oMf[model.getFrameId(base)].rotation @ chain.gravity
    else:
        model.gravity.linear = chain.gravity
    of = [model.joints[model.getJointId(name)] for name in chain.names]
    q_places, v_places = [one.idx_q for one in of], [one.idx_v for one in of]
    found = []
    for q, dq, ddq in zip(*states, strict=True):
        position[q_places] = q
        velocity, acceleration = np.zeros(model.nv), np.zeros(model.nv)
        velocity[v_places], acceleration[v_places] = dq, ddq
        found.append(pin.rnea(model, data, position, velocity, acceleration)[v_places])
    return np.array(found)


@pytest.mark.parametrize(
    ("text", "kinematics", "names"),
    [
        (PANDA, {"tip": "panda_hand"}, SEVEN),
        (PANDA, {"base": "panda_link0", "tip": "panda_link8"}, SEVEN),
        (PANDA, {"lock": {"panda_finger_joint1": 0.03}}, SEVEN),
        (PANDA, {"lock": {"panda_finger_joint1": 0.03, "panda_finger_joint2": 0.03}}, SEVEN),
        (PANDA, {"lock": {"panda_finger_joint1": 0.03, "panda_joint3": "40 deg"}}, (*SEVEN[:2], *SEVEN[3:])),
        (PANDA, {"base": "panda_link2", "tip": "panda_link6", "lock": {"panda_joint1": 1.0}}, SEVEN[2:6]),
        (TIAGO, {"tip": "arm_tool_link"}, ("torso_lift_joint", *THREE)),
        (TIAGO, {"base": "torso_lift_link", "tip": "arm_tool_link"}, THREE),
        (TIAGO, {"base": "torso_lift_link", "tip": "arm_3_link", "lock": {"gripper_left_joint": 0.7}}, THREE),
        (
            TIAGO,
            {"base": "base_link", "tip": "arm_3_link", "lock": {"torso_lift_joint": 0.03, "head_1_joint": 1}},
            THREE,
        ),
    ],
)
def test_the_arm_moves_as_in_the_whole_mechanism(text: str, kinematics: dict[str, Any], names: tuple[str, ...]) -> None:
    model = arm(text, **kinematics)
    assert model.chain.names == names
    held = read_mechanism(TextFile(name="arm.urdf", text=text), "urdf", model.config.kinematics).held
    assert set(held) | set(names) == set(pin.buildModelFromXML(text).names[1:])
    rng = np.random.default_rng(7)
    states = tuple(rng.uniform(-1.5, 1.5, (20, len(names))) for _ in range(3))
    expected = whole_torques(text, model.chain, held, kinematics.get("base"), states)
    np.testing.assert_allclose(torques(model, *states), expected, atol=1e-9 * np.abs(expected).max())


def test_a_finger_that_mimics_a_locked_one_is_where_that_one_puts_it() -> None:
    file = TextFile(name="arm.urdf", text=PANDA)
    held = read_mechanism(file, "urdf", Kinematics(urdf=file, lock={"panda_finger_joint1": 0.03})).held
    assert held == {"panda_finger_joint1": 0.03, "panda_finger_joint2": 0.03}
    file = TextFile(name="arm.urdf", text=TIAGO)
    held = read_mechanism(file, "urdf", Kinematics(urdf=file, tip="arm_3_link", lock={"gripper_left_joint": 0.7})).held
    assert held["gripper_right_joint"] == pytest.approx(-0.5)
    assert (held["wheel_left_joint"], held["head_1_joint"]) == (0.0, 0.0)


def test_a_joint_outside_that_cannot_be_at_zero_is_at_its_nearest_limit() -> None:
    file = TextFile(name="arm.urdf", text=PANDA.replace('lower="0" upper="0.04"', 'lower="0.01" upper="0.04"'))
    held = read_mechanism(file, "urdf", Kinematics(urdf=file, tip="panda_hand")).held
    assert held == {"panda_finger_joint1": 0.01, "panda_finger_joint2": 0.01}


@pytest.mark.parametrize(
    ("text", "kinematics", "words"),
    [
        (
            PANDA,
            {},
            "'panda_finger_joint2' mimics 'panda_finger_joint1', which moves with the arm; lock 'panda_finger_joint1'",
        ),
        (PANDA, {"base": "panda_link8"}, "'panda_finger_joint2' mimics"),
        (PANDA, {"tip": "hand"}, "kinematics.tip: no link 'hand'; it has panda_link0"),
        (PANDA, {"base": "panda_joint1"}, "kinematics.base: no link 'panda_joint1'"),
        (PANDA, {"base": "panda_hand", "tip": "panda_link2"}, "no movable joint from 'panda_hand' to 'panda_link2'"),
        (PANDA, {"tip": "panda_link0"}, "no movable joint from 'the root' to 'panda_link0'"),
        (PANDA, {"lock": {"finger": 0.0}}, "kinematics.lock: no movable joint 'finger'; it has panda_joint1"),
        (PANDA, {"lock": {"panda_joint8": 0.0}}, "kinematics.lock: no movable joint 'panda_joint8'"),
        (PANDA, {"lock": {"panda_finger_joint1": 4}}, "panda_finger_joint1 at 4 is outside its limits, 0 to 0.04"),
        (
            PANDA,
            {"lock": {"panda_joint1": 90}, "tip": "panda_hand"},
            "outside its limits.*degrees are written '90 deg'",
        ),
        (PANDA, {"lock": dict.fromkeys(SEVEN, 0.0), "tip": "panda_hand"}, "no movable joint"),
    ],
)
def test_what_is_no_arm_is_refused(text: str, kinematics: dict[str, Any], words: str) -> None:
    with pytest.raises(ModelError, match=words):
        arm(text, **kinematics)


def test_whoever_has_no_description_yet_is_told_how_one_locks_a_joint(tmp_path: Path) -> None:
    (tmp_path / "panda.urdf").write_text(PANDA)
    with pytest.raises(ModelError) as caught:
        new_description(tmp_path / "panda.urdf", tmp_path / "arm.yaml", tip_link="panda_leftfinger")
    said = str(caught.value)
    assert "lock 'panda_finger_joint1' in a description written by hand (`ident new` locks none), as" in said
    assert "with `ident new` --base and --tip, so that it is not between them" in said


def test_a_follower_of_the_arm_is_refused_locked_or_not() -> None:
    parallel = TIAGO.replace(
        '<mimic joint="gripper_left_joint" multiplier="-1" offset="0.2"/>', '<mimic joint="arm_2_joint"/>'
    )
    with pytest.raises(ModelError, match="joint 'gripper_right_joint' mimics 'arm_2_joint', which moves with the arm"):
        arm(parallel, tip="arm_tool_link")
    with pytest.raises(
        ModelError, match="'gripper_right_joint' mimics 'arm_2_joint', which is not locked and would move"
    ):
        arm(parallel, base="torso_lift_link", tip="arm_3_link", lock={"gripper_right_joint": 0.0})
    assert "arm_2_joint" not in arm(parallel, tip="arm_tool_link", lock={"arm_2_joint": 0.1}).chain.names


@pytest.mark.parametrize(
    ("text", "kinematics", "words"),
    [
        # The leader alone would be a joint of the arm, and its follower stand still.
        (
            PANDA,
            {"lock": {"panda_finger_joint2": 0.02}},
            r"'panda_finger_joint2' mimics 'panda_finger_joint1', which is not locked.*{panda_finger_joint1: 0.02}",
        ),
        # The leader is held at zero, outside of base and tip.
        (
            PANDA,
            {"lock": {"panda_finger_joint2": 0.02}, "tip": "panda_hand"},
            "panda_finger_joint2 at 0.02 contradicts panda_finger_joint1 at 0, which puts it at 0",
        ),
        (
            PANDA,
            {"lock": {"panda_finger_joint1": 0.01, "panda_finger_joint2": 0.03}},
            r"panda_finger_joint2 at 0.03 contradicts panda_finger_joint1 at 0.01, which puts it at 0.01",
        ),
        (
            TIAGO,
            {"tip": "arm_3_link", "lock": {"gripper_left_joint": 0.7, "gripper_right_joint": 0.5}},
            r"gripper_right_joint at 0.5 contradicts gripper_left_joint at 0.7, which puts it at -0.5.*"
            r"lock: {gripper_left_joint: -0.3}",
        ),
    ],
)
def test_locks_that_contradict_a_mimic_are_refused(text: str, kinematics: dict[str, Any], words: str) -> None:
    with pytest.raises(ModelError, match=words):
        arm(text, **kinematics)


def test_locks_that_agree_with_a_mimic_are_taken() -> None:
    file = TextFile(name="arm.urdf", text=TIAGO)
    locks = {"gripper_left_joint": 0.7, "gripper_right_joint": -0.5}
    held = read_mechanism(file, "urdf", Kinematics(urdf=file, tip="arm_3_link", lock=locks)).held
    assert (held["gripper_left_joint"], held["gripper_right_joint"]) == (0.7, -0.5)


def test_a_prefix_that_nobody_declared_is_passed_over_as_by_pinocchio() -> None:
    loose = PANDA.replace(' xmlns:xacro="http://www.ros.org/wiki/xacro"', "").replace("</robot>", "<xacro:x/></robot>")
    assert loose != PANDA
    lock = {"panda_finger_joint1": 0.0}
    assert arm(loose, lock=lock).chain.names == arm(PANDA, lock=lock).chain.names


def test_the_description_says_what_it_means() -> None:
    with pytest.raises(ValidationError, match="base, tip and lock are of urdf and mjcf"):
        Kinematics.model_validate({"dh": {"convention": "standard", "joints": {"a": {}}}, "lock": {"a": 0}})
    whole, part = config(PANDA), config(PANDA, tip="panda_hand", lock={"panda_finger_joint1": "1 deg"})
    assert set(whole.model_dump(mode="json")["kinematics"]) == {"dh", "urdf", "mjcf"}
    assert len({whole.sha256, part.sha256}) == len({whole.motion_sha256, part.motion_sha256}) == 2
    assert ArmConfig.model_validate_json(part.model_dump_json()) == part


@pytest.mark.slow
def test_an_export_keeps_the_whole_tree() -> None:
    for text, kinematics in (
        (PANDA, {"lock": {"panda_finger_joint1": 0.03}}),
        (PANDA, {"tip": "panda_hand", "lock": {"panda_joint4": -1.3}}),
        (TIAGO, {"base": "torso_lift_link", "tip": "arm_tool_link", "lock": {"gripper_left_joint": 0.7}}),
    ):
        model = arm(text, **kinematics)
        assert model.prior is not None
        delta = model.prior.copy()
        for k in range(model.chain.joints):
            delta[model.layout.inertial(k)] *= 1.0 + 0.02 * k
        # Read back by the export itself: the arm in it has these torques.
        written, _, notes = urdf_export(model, delta, "arm.urdf")
        assert all("less the links fixed to it, which are unchanged" in note for note in notes)
        assert any(("finger" in note) or ("gripper" in note) for note in notes)
        bare = re.compile(r"<(?:mass|inertia|origin)\b[^>]*>|<dynamics[^>]*>|\s+")
        assert bare.sub("", written) == bare.sub("", text)
        original, exported = pin.buildModelFromXML(text), pin.buildModelFromXML(written)
        assert list(exported.names) == list(original.names)
        untouched = set(original.names[1:]) - set(model.chain.names)
        for name in untouched - {"panda_joint4"}:
            k = original.getJointId(name)
            assert exported.inertias[k].isApprox(original.inertias[k])


def test_a_locked_link_without_inertia_is_distinguished() -> None:
    model = arm(PANDA, tip="panda_hand")
    assert model.prior is not None
    delta = model.prior.copy()
    delta[model.layout.inertial(6)] *= 0.05  # less than the fingers alone
    _, _, notes = urdf_export(model, delta, "arm.urdf")
    assert "of these, panda_leftfinger, panda_rightfinger are on moving joints, which some programs refuse" in notes


def test_geometry_is_seen_from_the_base() -> None:
    ball = '<collision><origin xyz="0.01 0.02 0.03"/><geometry><sphere radius="0.1"/></geometry></collision>'
    text = TIAGO.replace('<link name="torso_lift_link">', f'<link name="torso_lift_link">{ball}')
    text = text.replace('<link name="head_1_link">', f'<link name="head_1_link">{ball}')
    bodies = scene(arm(text, base="torso_lift_link", tip="arm_tool_link")).bodies
    assert [body.owner for body in bodies] == ["base", "base"]
    centers = [body.solid.start for body in bodies]  # type: ignore[union-attr]
    np.testing.assert_allclose(centers, [[0.01, 0.02, 0.03], [0.19, 0.02, 0.13]], atol=1e-12)


@pytest.mark.slow
def test_joints_of_an_mjcf_can_be_locked() -> None:
    body = '<inertial pos="0 0 0.1" mass="1" diaginertia="0.1 0.1 0.1"/>'
    text = (
        '<mujoco model="m"><compiler angle="radian"/><worldbody><body name="a"><joint name="one" axis="0 0 1"/>'
        f'{body}<body name="b" pos="0 0 1"><joint name="two" axis="0 1 0"/>{body}</body></body></worldbody></mujoco>'
    )
    file = TextFile(name="arm.xml", text=text)
    found = read_mechanism(file, "mjcf", Kinematics(mjcf=file, lock={"two": 0.5}))
    assert (found.names, found.held) == (("one",), {"two": 0.5})
    assert found.bodies[0, 9] == pytest.approx(2.0)
    assert read_mechanism(file, "mjcf", Kinematics(mjcf=file, base="a")).names == ("two",)
