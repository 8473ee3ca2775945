"""Exact distances: which pairs there are, what they are called, how far apart, and how fast that can change."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.random_arms import model_around, random_chain, reference_model
from helpers.random_bodies import arm_with_bodies, random_postures
from hypothesis import assume, given
from hypothesis import strategies as st

from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm
from ident_service.errors import ModelError, MotionRefused
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.collision import CollisionModel

BALL = {"from": [0, 0, 0], "to": [0, 0, 0], "radius": 0.1}


def serial(geometry: dict[str, Any], workspace: dict[str, Any] | None = None, joints: int = 4) -> ArmModel:
    """Links of one metre in the plane z = 0, link frames at their far ends."""
    return arm_model(
        ArmConfig.model_validate(
            {
                "format": "ident-arm",
                "version": 1,
                "name": "serial",
                "kinematics": {
                    "dh": {"convention": "standard", "joints": {f"j{k}": {"a": 1.0} for k in range(1, joints + 1)}}
                },
                "geometry": geometry,
                "workspace": workspace or {},
            }
        )
    )


def urdf_arm(
    hand: str, geometry: dict[str, Any] | None = None, arm: str = "", workspace: dict[str, Any] | None = None
) -> ArmModel:
    """A floor up to z = 0.1, a turning link at z = 1 with a tool bolted on crosswise, and a hand at its end."""
    text = f"""<robot name="x">
    <link name="floor"><collision><geometry><box size="20 20 0.2"/></geometry></collision></link>
    <link name="arm">{arm}</link><link name="tool"><collision><origin xyz="0 0 0.5"/>
    <geometry><sphere radius="0.1"/></geometry></collision></link><link name="hand">{hand}</link>
    <joint name="a" type="revolute"><parent link="floor"/><child link="arm"/><origin xyz="0 0 1"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
    <joint name="t" type="fixed"><parent link="arm"/><child link="tool"/>
    <origin xyz="1 0 0" rpy="1.5707963267948966 0 0"/></joint>
    <joint name="b" type="revolute"><parent link="arm"/><child link="hand"/><origin xyz="1 0 0"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>"""
    return arm_model(
        ArmConfig.model_validate(
            {
                "format": "ident-arm",
                "version": 1,
                "name": "u",
                "kinematics": {"urdf": {"name": "x.urdf", "text": text}},
                "geometry": geometry or {},
                "workspace": workspace or {},
            }
        )
    )


def collision_element(shape: str) -> str:
    return f"<collision><geometry>{shape}</geometry></collision>"


def test_pairs_are_all_but_the_same_and_connected_links() -> None:
    model = CollisionModel(serial({name: [BALL] for name in ("base", "j1", "j2", "j3", "j4")}))
    assert model.pairs == ("j2 - base", "j3 - base", "j3 - j1", "j4 - base", "j4 - j1", "j4 - j2")
    distances = model.distances(np.zeros((1, 4)))
    np.testing.assert_allclose(distances, [np.array([2, 3, 2, 4, 3, 2]) - 0.2], atol=1e-12)


def test_a_link_without_geometry_connects_nothing() -> None:
    assert CollisionModel(serial({"j1": [BALL], "j3": [BALL], "j4": [BALL]})).pairs == ("j3 - j1", "j4 - j1")


def test_surroundings_are_checked_against_moving_links_only() -> None:
    workspace = {
        "obstacles": {
            "table": {"half_space": {"normal": [0, 0, 2], "offset": -1}},
            "post": {"capsule": {"from": [3, 0, -1], "to": [3, 0, 1], "radius": 0.2}},
            "crate": {"box": {"center": [0, -2, 0], "size": [1, 2, 3], "rpy": [0, 0, "pi/2"]}},
        },
        "inside": {"x": [-2.5, 5], "z": [-1, 0.4]},
        "may_touch": [["base", "j2"]],
    }
    model = CollisionModel(serial({"base": [BALL], "j2": [BALL]}, workspace, joints=2))
    expected = {
        "j2 - obstacle table": 0.4,
        "j2 - obstacle post": 0.7,
        "j2 - obstacle crate": np.hypot(1.0, 1.5) - 0.1,
        "j2 - inside x lower": 4.4,
        "j2 - inside x upper": 2.9,
        "j2 - inside z lower": 0.9,
        "j2 - inside z upper": 0.3,
    }
    assert model.pairs == tuple(expected)
    np.testing.assert_allclose(model.distances(np.zeros((1, 2)))[0], list(expected.values()), atol=1e-8)
    # Turned back, the ball leaves the allowed box by as much as it is big.
    np.testing.assert_allclose(model.distances(np.array([[np.pi, 0.0]]))[0, 3], 0.4, atol=1e-12)


def test_several_capsules_of_a_link_count_with_the_nearest() -> None:
    two = [BALL, {"from": [-0.5, 0, 0], "to": [-0.5, 0, 0], "radius": 0.2}]
    model = CollisionModel(serial({"base": [BALL], "j2": two}, joints=2))
    assert model.pairs == ("j2 - base",)
    np.testing.assert_allclose(model.distances(np.zeros((1, 2))), [[1.2]], atol=1e-12)


def test_overlap_is_negative() -> None:
    model = CollisionModel(serial({"base": [BALL], "j2": [BALL]}, joints=2))
    np.testing.assert_allclose(model.distances(np.array([[0.0, np.pi - 0.1]])), [[2 * np.sin(0.05) - 0.2]], atol=1e-12)


def test_a_pair_that_is_never_free_is_named() -> None:
    geometry = {"base": [BALL], "j2": [{"from": [-2, 0, 0], "to": [2, 0, 0], "radius": 0.9}]}
    with pytest.raises(
        MotionRefused, match=r"j2 - base; shorten the capsules, or list the pair under workspace.may_touch"
    ):
        CollisionModel(serial(geometry | {"base": [BALL | {"radius": 1.2}]}, joints=2))
    pool = {"obstacles": {"pool": {"half_space": {"normal": [0, 0, 1], "offset": 0.5}}}}
    with pytest.raises(MotionRefused, match="j1 - obstacle pool; shorten the capsules, or move the obstacle"):
        CollisionModel(serial({"j1": [BALL]}, pool))


def test_an_arm_without_geometry_has_no_pairs() -> None:
    with pytest.raises(MotionRefused, match="no link has a body"):
        CollisionModel(serial({}, {"obstacles": {"table": {"half_space": {"normal": [0, 0, 1], "offset": 0}}}}))
    model = CollisionModel(serial({}))
    assert model.pairs == ()
    assert model.reach == ()
    assert model.distances(np.zeros((3, 4))).shape == (3, 0)
    with pytest.raises(ModelError, match="expected"):
        model.distances(np.zeros((3, 5)))


@pytest.mark.parametrize("workspace", [{"may_touch": [["j1", "j9"]]}, {}])
def test_links_that_do_not_exist_are_refused(workspace: dict[str, Any]) -> None:
    with pytest.raises(ModelError, match="neither 'base' nor one of j1"):
        CollisionModel(serial({"j1" if workspace else "j8": [BALL]}, workspace))


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        ('<box size="0.1 0.2 0.6"/>', 0.6),
        ('<sphere radius="0.25"/>', 0.65),
        ('<cylinder radius="0.1" length="0.4"/>', 0.7),
        ('<capsule radius="0.1" length="0.4"/>', 0.6),
    ],
)
def test_primitives_of_a_urdf_are_taken_where_the_description_is_silent(shape: str, expected: float) -> None:
    collision = CollisionModel(urdf_arm(collision_element(shape)))
    assert collision.pairs == ("b - base",)
    np.testing.assert_allclose(collision.distances(np.zeros((1, 2))), [[expected]], atol=1e-7)


def test_bolted_on_links_belong_to_the_link_that_carries_them() -> None:
    wall = {"obstacles": {"wall": {"half_space": {"normal": [0, 1, 0], "offset": -2}}}}
    collision = CollisionModel(urdf_arm("", workspace=wall))
    assert collision.pairs == ("a - obstacle wall",)
    np.testing.assert_allclose(collision.distances(np.zeros((1, 2))), [[1.4]], atol=1e-12)


def test_the_description_replaces_all_of_a_links_geometry() -> None:
    hand = collision_element('<mesh filename="hand.stl"/>') + collision_element('<box size="1 1 1"/>')
    collision = CollisionModel(urdf_arm(hand, {"b": [BALL], "base": [BALL]}))
    np.testing.assert_allclose(collision.distances(np.zeros((1, 2))), [[np.sqrt(2.0) - 0.2]], atol=1e-12)


@pytest.mark.parametrize(
    ("element", "message"),
    [
        (collision_element('<mesh filename="hand.stl"/>'), "is a mesh.* give capsules for 'b' under geometry"),
        (collision_element('<cone radius="1"/>'), "'cone' is none of box"),
        (collision_element('<box size="1 1"/>'), "'1 1' instead of 3 finite numbers"),
        (collision_element('<box size="1 1 nan"/>'), "instead of 3 finite numbers"),
        (collision_element('<sphere radius="-1"/>'), "'-1' is no size"),
        (collision_element('<sphere radius="big"/>'), "'big' instead of 1 finite"),
        (collision_element("<sphere/>"), "None instead of 1 finite"),
        ("<collision/>", "without geometry"),
        ('<collision><origin xyz="1"/><geometry><sphere radius="1"/></geometry></collision>', "'1' instead of 3"),
    ],
)
def test_collision_geometry_that_cannot_be_read_is_refused(element: str, message: str) -> None:
    with pytest.raises(ModelError, match=message) as caught:
        CollisionModel(urdf_arm(element))
    assert "x.urdf: link 'hand'" in str(caught.value)


def test_link_frames_are_those_of_the_table() -> None:
    rng = np.random.default_rng(5)
    chain = random_chain(rng, 3, branches=False, prismatic=False)
    point = rng.normal(size=3)
    model = model_around(chain)
    config = ArmConfig.model_validate(
        model.config.model_dump()
        | {
            "geometry": {"joint_2": [{"from": point.tolist(), "to": point.tolist(), "radius": 0.1}], "base": [BALL]},
            "workspace": {"may_touch": [["joint_2", "base"]], "inside": {"x": [-9.0, 9.0]}},
        }
    )
    position = rng.normal(size=3)
    pin_model = reference_model(chain)
    data = pin_model.createData()
    pin.forwardKinematics(pin_model, data, position)
    where = data.oMi[3].act(chain.link_rotation[2] @ point + chain.link_translation[2])
    distances = CollisionModel(replace(model, config=config)).distances(position[None])[0]
    np.testing.assert_allclose(distances, [where[0] + 8.9, 8.9 - where[0]], atol=1e-12)


def free_model(seed: int, joints: int) -> tuple[ArmModel, CollisionModel]:
    """A random arm none of whose pairs overlaps always."""
    model = arm_with_bodies(seed, joints)
    try:
        return model, CollisionModel(model)
    except (ModelError, MotionRefused):
        assume(False)
        raise


@pytest.mark.slow
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 7), step=st.sampled_from([1e-3, 0.1, 1.0]))
def test_no_distance_changes_faster_than_the_reach_says(seed: int, joints: int, step: float) -> None:
    model, collision = free_model(seed, joints)
    assume(collision.pairs)
    rng = np.random.default_rng(seed)
    one, other = random_postures(rng, model, 40), random_postures(rng, model, 40)
    # Single joints as well as all of them at once.
    moving = rng.random((40, joints)) < rng.choice([0.3, 1.0], size=(40, 1))
    other = one + step * moving * (other - one)
    change = np.abs(collision.distances(one) - collision.distances(other))
    bound = np.abs(one - other) @ np.array(collision.reach).T
    assert np.all(change <= bound + 1e-7)


@pytest.mark.slow
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 4))
def test_no_point_is_farther_from_an_axis_than_the_reach_says(seed: int, joints: int) -> None:
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, joints, branches=False)
    limits = np.sort(rng.uniform(-1.0, 1.0, size=(joints, 2)), axis=1)
    limits[np.array(chain.revolute)] = (-np.pi, np.pi)
    start, end = rng.uniform(-0.2, 0.2, size=(2, 3))
    model = model_around(chain, **{name: {"position": limits[k]} for k, name in enumerate(chain.names)})
    geometry = {chain.names[-1]: ({"from": start, "to": end, "radius": 0.1},)}
    wall = {"wall": {"half_space": {"normal": [1.0, 0.0, 0.0], "offset": -9.0}}}
    dumped = model.config.model_dump() | {"geometry": geometry, "workspace": {"obstacles": wall}}
    (reach,) = CollisionModel(replace(model, config=ArmConfig.model_validate(dumped))).reach
    position = rng.uniform(*limits.T, size=(300, joints))
    position[:200] = np.where(rng.random((200, joints)) < 0.5, limits[:, 0], position[:200])
    position[100:] = np.where(rng.random((200, joints)) < 0.5, limits[:, 1], position[100:])
    pin_model = reference_model(chain)
    data = pin_model.createData()
    farthest = np.zeros(joints)
    for posture in position:
        pin.forwardKinematics(pin_model, data, posture)
        link = data.oMi[joints] * pin.SE3(chain.link_rotation[-1], chain.link_translation[-1])
        for point in (start, end):
            for k in range(joints):
                seen = data.oMi[k + 1].inverse().act(link.act(point))
                distance = np.linalg.norm(np.cross(seen, chain.axes[k])) + 0.1
                farthest[k] = max(farthest[k], distance if chain.revolute[k] else 1.0)
    assert np.all(farthest <= reach + 1e-9)
    assert farthest[-1] == pytest.approx(reach[-1])


def test_the_reach_of_a_simple_arm_is_what_one_would_say() -> None:
    geometry = {"base": [BALL], "j1": [BALL], "j2": [BALL], "j3": [BALL]}
    workspace = {"obstacles": {"wall": {"half_space": {"normal": [1, 0, 0], "offset": -9}}}}
    model = CollisionModel(serial(geometry, workspace, joints=3))
    reach = dict(zip(model.pairs, model.reach, strict=True))
    np.testing.assert_allclose(reach["j2 - base"], [2.1, 1.1, 0.0])
    np.testing.assert_allclose(reach["j3 - j1"], [0.0, 2.1, 1.1])
    np.testing.assert_allclose(reach["j3 - obstacle wall"], [3.1, 2.1, 1.1])


def test_the_reach_across_a_sliding_joint_without_limits_is_infinite() -> None:
    table = {"j1": {}, "j2": {"type": "prismatic", "alpha": "pi/2"}, "j3": {"a": 1.0}}
    config = {
        "format": "ident-arm",
        "version": 1,
        "name": "slide",
        "kinematics": {"dh": {"convention": "standard", "joints": table}},
        "geometry": {"base": [BALL], "j3": [BALL]},
    }
    (unlimited,) = CollisionModel(arm_model(ArmConfig.model_validate(config))).reach
    np.testing.assert_array_equal(np.isfinite(unlimited), [False, True, True])
    limits = {"joints": {"j1": {}, "j2": {"position": [0.0, 2.0]}, "j3": {}}}
    (limited,) = CollisionModel(arm_model(ArmConfig.model_validate(config | limits))).reach
    # The hand turns in a plane through the slide's axis, 1.1 m from it at most.
    np.testing.assert_allclose(limited, [1.1, 1.0, 1.1])


def test_the_shipped_arms_have_bodies(wam7: ArmModel) -> None:
    model = CollisionModel(wam7)
    assert len(model.pairs) == 26
    assert "j7 - obstacle table" in model.pairs
    assert "j7 - j5" not in model.pairs
    threelink = CollisionModel(arm_model(load_arm("threelink")))
    assert threelink.pairs == ("shoulder - base", "slide - base", "slide - waist")
    assert CollisionModel(arm_model(load_arm("planar2"))).pairs == ("elbow - base",)
    assert CollisionModel(arm_model(load_arm("kuka_lwr4"))).pairs == ()
