"""URDF and MJCF: what is read from them, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.random_arms import random_states, reference_model, reference_torque

from ident_service.config.arm import ArmConfig
from ident_service.config.quantities import TextFile
from ident_service.errors import ModelError
from ident_service.model.arm_model import arm_model
from ident_service.model.chain import Chain
from ident_service.model.parameter_layout import Layout
from ident_service.model.pinocchio_models import read_mjcf, read_urdf
from ident_service.model.regressor import joint_regressor

GRAVITY = (0.0, 0.0, -9.81)
BALL = '<inertial><origin xyz="0.1 0.2 0.3"/><mass value="2"/>'
BALL += '<inertia ixx="0.1" ixy="0.01" ixz="0.02" iyy="0.2" iyz="0.03" izz="0.25"/></inertial>'
# The same body about the link's origin, by Steiner's theorem.
BALL_DELTA = [
    0.1 + 2 * (0.04 + 0.09),
    0.01 - 2 * 0.02,
    0.02 - 2 * 0.03,
    0.2 + 2 * (0.01 + 0.09),
    0.03 - 2 * 0.06,
    0.25 + 2 * (0.01 + 0.04),
    0.2,
    0.4,
    0.6,
    2.0,
]
LIMIT = '<limit lower="-1" upper="1" velocity="1" effort="1"/>'


def link(name: str, body: str = BALL) -> str:
    return f'<link name="{name}">{body}</link>'


def joint(name: str, kind: str, parent: str, child: str, rest: str = "", axis: str = "0 0 1") -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="{axis}"/>{LIMIT}{rest}</joint>'
    )


def urdf(*parts: str) -> TextFile:
    return TextFile(name="arm.urdf", text='<?xml version="1.0"?><robot name="r">' + "".join(parts) + "</robot>")


def mjcf(*parts: str, head: str = "") -> TextFile:
    text = f'<mujoco model="m"><compiler angle="radian"/>{head}<worldbody>{"".join(parts)}</worldbody></mujoco>'
    return TextFile(name="arm.xml", text=text)


def assert_torques_agree(file: TextFile, chain: Chain, bodies: np.ndarray) -> None:
    """What was read gives the torques that pinocchio computes from the file itself."""
    model = pin.buildModelFromXML(file.text)
    layout = Layout(chain.revolute, ())
    states = random_states(np.random.default_rng(0), 6, chain.joints)
    data = model.createData()
    expected = []
    for q, dq, ddq in zip(*states, strict=True):
        position = []
        for k in range(chain.joints):
            whole_turn = model.joints[k + 1].nq == 2
            position += [np.cos(q[k]), np.sin(q[k])] if whole_turn else [q[k]]
        expected.append(pin.rnea(model, data, np.array(position), dq, ddq))
    H = joint_regressor(chain, layout, *states)
    np.testing.assert_allclose(np.einsum("jps,p->sj", H, bodies.ravel()), expected, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(
        reference_torque(reference_model(chain, bodies), *states), expected, rtol=1e-11, atol=1e-11
    )


@pytest.mark.parametrize("kind", ["revolute", "continuous", "prismatic"])
@pytest.mark.parametrize("axis", ["1 0 0", "0 1 0", "0 0 1", "0 0 -1", "1 2 3", "-0.6 0 0.8"])
def test_joints_of_every_kind_and_axis_are_read(kind: str, axis: str) -> None:
    origin = '<origin xyz="0.1 0.2 0.3" rpy="0.4 0.5 0.6"/>'
    file = urdf(
        link("base", ""),
        link("one"),
        link("two"),
        joint("a", "revolute", "base", "one", axis="0 1 0"),
        joint("b", kind, "one", "two", origin, axis=axis),
    )
    chain, bodies = read_urdf(file, GRAVITY)
    assert chain.names == ("a", "b")
    assert chain.parents == (-1, 0)
    assert chain.revolute == (True, kind != "prismatic")
    direction = np.array([float(x) for x in axis.split()])
    np.testing.assert_allclose(chain.axes[1], direction / np.linalg.norm(direction), atol=1e-12)
    np.testing.assert_allclose(chain.translation[1], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(pin.rpy.matrixToRpy(chain.rotation[1]), [0.4, 0.5, 0.6])
    np.testing.assert_allclose(bodies, [BALL_DELTA, BALL_DELTA], rtol=1e-13)
    assert_torques_agree(file, chain, bodies)


def test_fixed_joints_are_merged_into_their_parents() -> None:
    file = urdf(
        link("base"),
        link("foot"),
        link("one"),
        link("tool"),
        joint("bolt", "fixed", "base", "foot", '<origin xyz="0 0 1"/>'),
        joint("a", "revolute", "foot", "one", '<origin xyz="1 0 0"/>'),
        joint("flange", "fixed", "one", "tool", '<origin xyz="0 0 0.5"/>'),
    )
    chain, bodies = read_urdf(file, GRAVITY)
    assert chain.names == ("a",)
    np.testing.assert_allclose(chain.translation[0], [1, 0, 1])
    lifted = np.array(BALL_DELTA)
    lifted[8] += 2 * 0.5  # lz of the tool seen from the link
    lifted[[0, 3]] += 2 * ((0.3 + 0.5) ** 2 - 0.3**2)
    lifted[2] -= 2 * 0.1 * 0.5
    lifted[4] -= 2 * 0.2 * 0.5
    np.testing.assert_allclose(bodies[0], np.array(BALL_DELTA) + lifted, rtol=1e-13)


def test_branches_are_read() -> None:
    file = urdf(
        link("base", ""),
        *(link(name) for name in ("torso", "left", "right", "hand")),
        joint("waist", "revolute", "base", "torso"),
        joint("left_arm", "revolute", "torso", "left", '<origin xyz="0 0.2 0.4"/>', axis="0 1 0"),
        joint("right_arm", "revolute", "torso", "right", '<origin xyz="0 -0.2 0.4"/>', axis="0 1 0"),
        joint("wrist", "prismatic", "left", "hand", '<origin xyz="0 0 0.3"/>', axis="1 0 0"),
    )
    chain, bodies = read_urdf(file, GRAVITY)
    tree = {name: (None if p < 0 else chain.names[p]) for name, p in zip(chain.names, chain.parents, strict=True)}
    assert tree == {"waist": None, "left_arm": "waist", "right_arm": "waist", "wrist": "left_arm"}
    assert_torques_agree(file, chain, bodies)


def test_gravity_is_the_configurations() -> None:
    file = urdf(link("base", ""), link("one"), joint("a", "revolute", "base", "one"))
    chain, _ = read_urdf(file, (1.0, 2.0, 3.0))
    assert chain.gravity.tolist() == [1.0, 2.0, 3.0]


MJCF_BODY = """
<body name="one" pos="0 0 0.1"><joint name="turn" type="hinge" axis="0 1 0" range="-1 1"/>
  <inertial pos="0.1 0.2 0.3" mass="2" fullinertia="0.1 0.2 0.25 0.01 0.02 0.03"/>
  <body name="two" pos="0.3 0 0.2" euler="0.2 0 0"><joint name="slide" type="slide" axis="1 0 0" range="0 1"/>
    <inertial pos="0.1 0.2 0.3" mass="2" fullinertia="0.1 0.2 0.25 0.01 0.02 0.03"/>
  </body>
</body>"""


def test_mjcf_hinges_and_slides_are_read() -> None:
    chain, bodies = read_mjcf(mjcf(MJCF_BODY), GRAVITY)
    assert chain.names == ("turn", "slide")
    assert chain.revolute == (True, False)
    assert chain.parents == (-1, 0)
    np.testing.assert_allclose(chain.axes, [[0, 1, 0], [1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(chain.translation, [[0, 0, 0.1], [0.3, 0, 0.2]])
    np.testing.assert_allclose(pin.rpy.matrixToRpy(chain.rotation[1]), [0.2, 0, 0], atol=1e-12)
    np.testing.assert_allclose(bodies, [BALL_DELTA, BALL_DELTA], rtol=1e-9)
    assert chain.gravity.tolist() == list(GRAVITY)


def test_the_same_arm_as_urdf_and_as_mjcf_is_the_same_arm() -> None:
    file = urdf(
        link("base", ""),
        link("one"),
        link("two"),
        joint("turn", "revolute", "base", "one", '<origin xyz="0 0 0.1"/>', axis="0 1 0"),
        joint("slide", "prismatic", "one", "two", '<origin xyz="0.3 0 0.2" rpy="0.2 0 0"/>', axis="1 0 0"),
    )
    of_urdf, urdf_bodies = read_urdf(file, GRAVITY)
    of_mjcf, mjcf_bodies = read_mjcf(mjcf(MJCF_BODY), GRAVITY)
    states = random_states(np.random.default_rng(1), 5, 2)
    layout = Layout((True, False), ())
    torques = [
        np.einsum("jps,p->sj", joint_regressor(chain, layout, *states), bodies.ravel())
        for chain, bodies in ((of_urdf, urdf_bodies), (of_mjcf, mjcf_bodies))
    ]
    np.testing.assert_allclose(torques[0], torques[1], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("file", "message"),
    [
        pytest.param(urdf(link("a"), link("b"), joint("j", "floating", "a", "b")), "'j' is a", id="floating"),
        pytest.param(urdf(link("a"), link("b"), joint("j", "planar", "a", "b")), "'j' is a", id="planar"),
        pytest.param(
            urdf(
                *(link(name) for name in "abc"),
                joint("j", "revolute", "a", "b"),
                joint("k", "revolute", "b", "c", '<mimic joint="j" multiplier="2"/>'),
            ),
            "mimic",
            id="mimic",
        ),
        pytest.param(urdf(link("a")), "no movable joint", id="no joint"),
        pytest.param(urdf(link("a"), link("b"), joint("j", "fixed", "a", "b")), "no movable joint", id="only fixed"),
        pytest.param(TextFile(name="arm.urdf", text="garbage"), "not a URDF", id="garbage"),
        pytest.param(TextFile(name="arm.urdf", text=""), "not a URDF", id="empty"),
        pytest.param(TextFile(name="arm.urdf", text="<robot"), "not a URDF", id="torn"),
        pytest.param(
            TextFile(name="arm.urdf", text='<!DOCTYPE r [<!ENTITY a "b">]><robot name="&a;"/>'), "DOCTYPE", id="doctype"
        ),
        pytest.param(TextFile(name="arm.urdf", text='<!\n entity a "b"><robot name="r"/>'), "entity", id="entity"),
        pytest.param(urdf('<xi:include href="other.urdf"/>'), "include", id="xinclude"),
        pytest.param(urdf('< include file="/etc/passwd"/>'), "include", id="include"),
    ],
)
def test_urdfs_that_are_no_arm_are_refused(file: TextFile, message: str) -> None:
    with pytest.raises(ModelError, match=message) as caught:
        read_urdf(file, GRAVITY)
    assert str(caught.value).startswith("arm.urdf: ")


BODY = '<inertial pos="0 0 0.1" mass="1" diaginertia="0.1 0.1 0.1"/></body>'


@pytest.mark.parametrize("axis", ["0 0 0", "nan 0 1", "0 1", "1e400 0 0", ""])
def test_mjcfs_with_an_axis_that_is_no_direction_are_refused(axis: str) -> None:
    file = mjcf(f'<body name="a">\n<joint name="j" axis="{axis}"/>' + BODY)
    line = 1 + file.text[: file.text.index("<joint")].count("\n")
    with pytest.raises(ModelError, match=rf":{line}: joint 'j': axis is '{axis}', which is no direction; give one of"):
        read_mjcf(file, GRAVITY)


@pytest.mark.parametrize(
    ("file", "message"),
    [
        pytest.param(mjcf('<body name="a"><freejoint name="j"/>' + BODY), "'j' is a", id="free"),
        pytest.param(mjcf('<body name="a"><joint name="j" type="ball"/>' + BODY), "'j' is a", id="ball"),
        pytest.param(
            mjcf('<body name="a"><joint name="j" axis="1 0 0"/><joint name="k" axis="0 1 0"/>' + BODY),
            "is a JointModelComposite",
            id="two joints in one body",
        ),
        pytest.param(mjcf('<include file="/etc/passwd"/>'), "include", id="include"),
        pytest.param(TextFile(name="arm.xml", text="<mujoco"), "not a MJCF", id="torn"),
        pytest.param(TextFile(name="arm.xml", text="<!DOCTYPE mujoco><mujoco/>"), "DOCTYPE", id="doctype"),
        pytest.param(mjcf('<body name="a">' + BODY), "no movable joint", id="no joint"),
    ],
)
def test_mjcfs_that_are_no_arm_are_refused(file: TextFile, message: str) -> None:
    with pytest.raises(ModelError, match=message) as caught:
        read_mjcf(file, GRAVITY)
    assert str(caught.value).startswith("arm.xml: ")


def configured(file: TextFile, *joints: str, **more: object) -> ArmConfig:
    """An arm around a URDF."""
    return ArmConfig.model_validate(
        {
            "format": "ident-arm",
            "version": 1,
            "name": "arm",
            "kinematics": {"urdf": {"name": file.name, "text": file.text}},
            "joints": {name: {} for name in joints},
            **more,
        }
    )


ONE = urdf(link("base", ""), link("one"), joint("a", "revolute", "base", "one"))


def test_the_inertials_of_a_urdf_are_the_prior() -> None:
    model = arm_model(configured(ONE, "a"))
    assert model.prior is not None
    np.testing.assert_allclose(model.prior, [*BALL_DELTA, 0, 0, 0, 0])
    with pytest.raises(ValueError, match="read-only"):
        model.prior[0] = 1.0


def test_a_configured_prior_goes_before_the_inertials() -> None:
    model = arm_model(configured(ONE, "a", prior={"m1": 3.0}))
    assert model.prior is not None
    assert np.flatnonzero(model.prior).tolist() == [9]


def test_a_urdf_without_inertials_has_no_prior() -> None:
    bare = urdf(link("base", ""), link("one", ""), joint("a", "revolute", "base", "one"))
    assert arm_model(configured(bare, "a")).prior is None


@pytest.mark.parametrize("joints", [("b",), ("a", "b")])
def test_joints_that_the_mechanism_lacks_are_refused(joints: tuple[str, ...]) -> None:
    with pytest.raises(ModelError, match=r"configured as .*but the mechanism has a"):
        arm_model(configured(ONE, *joints))


def test_the_shipped_urdf_reads_as_what_it_says() -> None:
    text = (Path(__file__).parents[2] / "configs" / "threelink.urdf").read_text(encoding="utf-8")
    chain, bodies = read_urdf(TextFile(name="threelink.urdf", text=text), GRAVITY)
    assert chain.names == ("waist", "shoulder", "slide")
    assert chain.revolute == (True, True, False)
    np.testing.assert_allclose(bodies[:, 9], [4.0, 2.0, 0.8 + 0.3])
    assert_torques_agree(TextFile(name="threelink.urdf", text=text), chain, bodies)
