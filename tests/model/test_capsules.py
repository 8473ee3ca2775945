"""Fast distances: those of coal for capsules, never larger for anything else, with the right gradient."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.random_bodies import arm_with_bodies, random_postures
from hypothesis import assume, given
from hypothesis import strategies as st

from ident_service.config.arm import ArmConfig
from ident_service.config.motion_design import Workspace
from ident_service.errors import ModelError, MotionRefused
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.capsule_distances import CapsuleModel, distances_between_segments, distances_to_boxes
from ident_service.model.collision import CollisionModel

SHAPES = (
    '<box size="{0} {1} {2}"/>',
    '<sphere radius="{0}"/>',
    '<cylinder radius="{0}" length="{1}"/>',
    '<capsule radius="{0}" length="{1}"/>',
)


def collision_model(model: ArmModel) -> CollisionModel:
    try:
        return CollisionModel(model)
    except (ModelError, MotionRefused):
        assume(False)
        raise


@pytest.mark.slow
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 7))
def test_distances_are_those_of_coal(seed: int, joints: int) -> None:
    model = arm_with_bodies(seed, joints)
    exact, fast = collision_model(model), CapsuleModel(model)
    assert fast.pairs == exact.pairs
    position = random_postures(np.random.default_rng(seed), model, 50)
    expected, found = exact.distances(position), fast.distances(position).T
    apart = expected > 0.0
    np.testing.assert_allclose(found[apart], expected[apart], rtol=0, atol=1e-6)
    assert np.all(found[~apart] < 1e-6)


@pytest.mark.slow
@given(seed=st.integers(0, 2**32 - 1))
def test_distances_of_other_solids_are_never_too_large(seed: int) -> None:
    model = urdf_arm(np.random.default_rng(seed))
    exact, fast = collision_model(model), CapsuleModel(model)
    position = np.random.default_rng(seed).uniform(-3.0, 3.0, size=(50, 4))
    expected, found = exact.distances(position), fast.distances(position).T
    assert np.all(found[expected > 0.0] <= expected[expected > 0.0] + 1e-6)
    assert np.all(found[expected <= 0.0] <= 1e-6)


def urdf_arm(rng: np.random.Generator) -> ArmModel:
    """Four links, each of one random primitive, over a random floor."""
    links, joints = [], []
    for k in range(5):
        sizes = rng.uniform(0.02, 0.2, size=3)
        shape = str(rng.choice(SHAPES)).format(*sizes)
        origin = 'xyz="{} {} {}" rpy="{} {} {}"'.format(*rng.uniform(-0.2, 0.2, 3), *rng.uniform(-3.0, 3.0, 3))
        geometry = f"<collision><origin {origin}/><geometry>{shape}</geometry></collision>"
        links.append(f'<link name="l{k}">{geometry}</link>')
        if k:
            place = 'xyz="{} {} {}" rpy="{} {} {}"'.format(*rng.uniform(-0.5, 0.5, 3), *rng.uniform(-3.0, 3.0, 3))
            joints.append(
                f'<joint name="j{k}" type="continuous"><parent link="l{k - 1}"/><child link="l{k}"/>'
                f'<origin {place}/><axis xyz="0 0 1"/></joint>'
            )
    text = f'<robot name="x">{"".join(links)}{"".join(joints)}</robot>'
    floor = {"normal": rng.normal(size=3).tolist(), "offset": -1.0}
    return arm_model(
        ArmConfig.model_validate(
            {
                "format": "ident-arm",
                "version": 1,
                "name": "u",
                "kinematics": {"urdf": {"name": "x.urdf", "text": text}},
                "workspace": {"obstacles": {"floor": {"half_space": floor}}},
            }
        )
    )


@pytest.mark.slow
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 6), step=st.just(1e-6))
def test_the_pull_is_the_gradient(seed: int, joints: int, step: float) -> None:
    model = arm_with_bodies(seed, joints)
    fast = CapsuleModel(model)
    assume(fast.pairs)
    rng = np.random.default_rng(seed)
    position = random_postures(rng, model, 20)
    here = fast.distances(position)
    seeds = rng.normal(size=here.shape)
    pulled = fast.pull(seeds)
    compared = 0
    for joint in range(joints):
        moved = step * np.eye(joints)[joint]
        ahead = (fast.distances(position + moved) - here) / step
        behind = (here - fast.distances(position - moved)) / step
        # Where another end or another capsule becomes the nearest, there is no gradient.
        smooth = np.abs(ahead - behind).max(axis=0) < 1e-3
        slope = (0.5 * seeds * (ahead + behind)).sum(axis=0)
        assert np.all(np.abs(pulled[:, joint] - slope)[smooth] < 1e-3 * np.abs(seeds).sum(axis=0)[smooth])
        compared += int(smooth.sum())
    assert compared > 10 * joints


def test_ends_that_are_equally_near_share_the_gradient() -> None:
    ball = {"from": [0, 0, 0], "to": [0, 0, 0], "radius": 0.1}
    config = {
        "format": "ident-arm",
        "version": 1,
        "name": "twice",
        "kinematics": {"dh": {"convention": "standard", "joints": {"j1": {"a": 1.0}}}},
        "geometry": {"j1": [ball, ball]},
        "workspace": {"obstacles": {"wall": {"half_space": {"normal": [1, 0, 0], "offset": -2}}}},
    }
    fast = CapsuleModel(arm_model(ArmConfig.model_validate(config)))
    np.testing.assert_allclose(fast.distances(np.array([[0.3]])), [[np.cos(0.3) + 1.9]])
    np.testing.assert_allclose(fast.pull(np.array([[2.0]])), [[-2.0 * np.sin(0.3)]])


def test_an_arm_without_geometry_has_no_distances(wam7: ArmModel) -> None:
    bare = arm_model(wam7.config.model_copy(update={"geometry": {}, "workspace": Workspace()}))
    fast = CapsuleModel(bare)
    assert fast.pairs == ()
    assert fast.distances(np.zeros((3, 7))).shape == (0, 3)
    np.testing.assert_array_equal(fast.pull(np.zeros((0, 3))), np.zeros((3, 7)))


def test_shapes_are_checked_on_entry(wam7: ArmModel) -> None:
    fast = CapsuleModel(wam7)
    with pytest.raises(ModelError, match="does not belong to the last distances"):
        fast.pull(np.zeros((27, 3)))
    with pytest.raises(ModelError, match=r"expected \(samples, 7\)"):
        fast.distances(np.zeros((3, 6)))


numbers = st.floats(-1.0, 1.0).map(lambda value: round(value, 3))
vectors = st.tuples(numbers, numbers, numbers).map(np.array)


@given(start=vectors, along=vectors, other_start=vectors, other_along=vectors, turn=st.integers(0, 3))
def test_no_two_points_of_segments_are_nearer(
    start: np.ndarray, along: np.ndarray, other_start: np.ndarray, other_along: np.ndarray, turn: int
) -> None:
    # Parallel segments, and segments that are points, are what goes wrong.
    other_along = (other_along, along, -2.0 * along, 1e-9 * other_along)[turn]
    column = [vector[:, None, None] for vector in (start, along, other_start, other_along)]
    squares = [np.array([[float(vector @ vector)]]) for vector in (along, other_along)]
    distance, direction, s, t = distances_between_segments(*column, *squares)
    share = np.linspace(0.0, 1.0, 101)
    points, others = start + share[:, None] * along, other_start + share[:, None] * other_along
    assert distance[0, 0] <= np.linalg.norm(points[:, None] - others[None], axis=2).min() + 1e-7
    met = start + s[0, 0] * along - other_start - t[0, 0] * other_along
    np.testing.assert_allclose(met, distance[0, 0] * direction[:, 0, 0], atol=1e-12)


@given(start=vectors, along=vectors, half=vectors)
def test_no_point_of_a_segment_is_nearer_to_the_box(start: np.ndarray, along: np.ndarray, half: np.ndarray) -> None:
    half = np.abs(half) + 0.01
    column = [vector[:, None, None] for vector in (start, along, half)]
    distance, _, _ = distances_to_boxes(*column)
    beyond = np.abs(start + np.linspace(0.0, 1.0, 1001)[:, None] * along) - half
    signed = np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)
    assert signed.min() - 0.0011 <= distance[0, 0] <= signed.min() + 1e-9
