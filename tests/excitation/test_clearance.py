"""How close a motion comes is proven for all times, not only for those that are looked at."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest
from helpers.random_bodies import arm_with_bodies, random_postures
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm
from ident_service.config.motion_design import Workspace
from ident_service.errors import ModelError, MotionRefused
from ident_service.excitation.described_motion import excitation
from ident_service.excitation.limit_proof import certified_along, certified_clearance
from ident_service.excitation.trajectory import FourierPath, FourierSeries, MotionPath, PosturePath
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.capsule_distances import CapsuleModel
from ident_service.model.collision import CollisionModel

BALL = {"from": [0, 0, 0], "to": [0, 0, 0], "radius": 0.1}


def swinging(offset: float) -> CollisionModel:
    """A ball on an arm of one metre above a floor at `offset`."""
    return CollisionModel(
        arm_model(
            ArmConfig.model_validate(
                {
                    "format": "ident-arm",
                    "version": 1,
                    "name": "swing",
                    "kinematics": {"dh": {"convention": "standard", "joints": {"j1": {"a": 1.0}}}},
                    "geometry": {"j1": [BALL]},
                    "workspace": {"obstacles": {"floor": {"half_space": {"normal": [0, 1, 0], "offset": offset}}}},
                }
            )
        )
    )


def swing(amplitude: float) -> FourierPath:
    """`q(t) = amplitude sin(2 pi t)`."""
    rate = 2.0 * np.pi
    return FourierPath(FourierSeries(1.0, np.array([[amplitude * rate]]), np.zeros((1, 1)), np.zeros(1)), 3)


def test_a_clearance_is_proven_or_disproven() -> None:
    collision, path = swinging(-1.0), swing(0.5)
    closest = 0.9 - np.sin(0.5)
    proof = certified_clearance(collision, path, closest - 1e-3)
    assert proof.proven
    assert closest - 1e-3 <= proof.lower_bound <= closest <= proof.sampled
    assert proof.pair == "j1 - obstacle floor"
    assert proof.time == pytest.approx(0.75, abs=0.02)
    refusal = certified_clearance(collision, path, closest + 1e-3)
    assert not refusal.proven
    assert refusal.lower_bound <= closest <= refusal.sampled < closest + 1e-3


def test_what_can_neither_be_proven_nor_disproven_is_not_proven() -> None:
    collision, path = swinging(-1.0), swing(0.5)
    closest = 0.9 - np.sin(0.5)
    unknown = certified_clearance(collision, path, closest)
    assert not unknown.proven
    assert closest - 1e-3 < unknown.lower_bound < closest


def test_without_pairs_everything_is_clear(wam7: ArmModel) -> None:
    bare = arm_model(wam7.config.model_copy(update={"geometry": {}, "workspace": Workspace()}))
    collision = CollisionModel(bare)
    clear = certified_clearance(collision, excitation(wam7, "identification").path, 1.0)
    assert clear.proven
    assert (clear.lower_bound, clear.pair, clear.time) == (np.inf, None, None)


@pytest.mark.parametrize("name", ["wam7", "planar2", "threelink"])
@pytest.mark.parametrize("purpose", ["identification", "validation"])
def test_the_shipped_motions_keep_clear(name: str, purpose: Any) -> None:
    model = arm_model(load_arm(name))
    clear = certified_clearance(
        CollisionModel(model), excitation(model, purpose).path, model.config.workspace.clearance
    )
    assert clear.proven


def test_a_sliding_joint_without_limits_proves_nothing() -> None:
    table = {"j1": {}, "j2": {"type": "prismatic", "alpha": "pi/2"}, "j3": {"a": 1.0}}
    config = {
        "format": "ident-arm",
        "version": 1,
        "name": "slide",
        "kinematics": {"dh": {"convention": "standard", "joints": table}},
        "geometry": {"base": [BALL], "j3": [BALL]},
    }
    collision = CollisionModel(arm_model(ArmConfig.model_validate(config)))
    with pytest.raises(ModelError, match="without position limits"):
        certified_along(collision, lambda time: np.zeros((len(time), 3)), np.ones(3), 1.0, 0.1)


def free_arm(seed: int) -> tuple[ArmModel, CollisionModel]:
    # Without boxes the fast distances are exact, so that they can look for what the proof has missed.
    model = arm_with_bodies(seed, 4, obstacles=("half_space", "capsule"))
    try:
        collision = CollisionModel(model)
    except (ModelError, MotionRefused):
        assume(False)
        raise
    assume(collision.pairs)
    return model, collision


def random_path(seed: int, model: ArmModel) -> MotionPath:
    rng = np.random.default_rng(seed)
    postures = random_postures(rng, model, 3)
    if rng.random() < 0.3:
        return PosturePath(postures, rng.uniform(0.1, 0.3, size=2), float(rng.choice([0.0, 0.05])))
    ramp, frequency = float(rng.choice([0.0, 0.1])), float(rng.choice([2.0, 5.0]))
    limits = np.array([joint.position for joint in model.config.joints.values()])
    a, b = rng.normal(size=(2, 4, 3))
    rates = 2.0 * np.pi * frequency * np.arange(1, 4)
    # Anywhere in the limits: sliding joints must not leave theirs.
    room = np.minimum(limits[:, 1] - postures[0], postures[0] - limits[:, 0])
    scale = (room / ((np.abs(a) + np.abs(b)) / rates).sum(axis=1))[:, None]
    return FourierPath(FourierSeries(frequency, a * scale, b * scale, postures[0]), 1, ramp)


def assert_nothing_closer(seed: int, share: float | None) -> None:
    model, collision = free_arm(seed)
    path = random_path(seed, model)
    time = np.arange(0.0, path.duration, 2e-5)
    fast = CapsuleModel(model)
    closest = float(fast.distances(path.at(time)[0]).min())
    # Asked for a little less than there is, the proof has to look closely.
    clear = certified_clearance(collision, path, 0.02 if share is None else closest * share - 1e-4)
    assert clear.lower_bound <= closest
    # Between two of the times looked at here, half a step from either, it may be a little nearer.
    speed = np.abs(path.at(time)[1]).max(axis=0)
    assert clear.sampled >= closest - 1e-5 * float((np.array(collision.reach) @ speed).max()) - 1e-6
    if share is not None and closest > 0.0:
        assert clear.proven == (clear.lower_bound >= clear.required)


@pytest.mark.slow
@settings(max_examples=6)
@given(seed=st.integers(0, 2**32 - 1), share=st.sampled_from([None, 0.5, 0.99]))
def test_nothing_closer_is_found_between_the_samples(seed: int, share: float | None) -> None:
    assert_nothing_closer(seed, share)


@pytest.mark.campaign
@settings(max_examples=200)
@given(seed=st.integers(0, 2**32 - 1), share=st.sampled_from([None, 0.5, 0.99]))
def test_nothing_closer_is_found_between_the_samples_of_many_motions(seed: int, share: float | None) -> None:
    assert_nothing_closer(seed, share)


class Crossing:
    """A distance that falls and rises as fast as it may: `|q - goal|` of a single joint."""

    pairs = ("one - other",)
    reach = (np.ones(1),)

    def __init__(self, goal: float) -> None:
        self.goal = goal

    def distances(self, position: np.ndarray) -> np.ndarray:
        return np.abs(position - self.goal)


@given(
    seed=st.integers(0, 2**32 - 1),
    frequency=st.sampled_from([0.2, 2.0, 20.0]),
    ramp=st.sampled_from([0.0, 0.05]),
    required=st.sampled_from([-10.0, 1e-3]),
)
def test_a_crossing_between_samples_is_not_missed(seed: int, frequency: float, ramp: float, required: float) -> None:
    rng = np.random.default_rng(seed)
    path = FourierPath(FourierSeries(frequency, *rng.normal(size=(2, 1, 2)), np.zeros(1)), 1, ramp)
    ((goal,),) = path.at(rng.uniform(0.0, path.duration, size=1))[0]
    clear = certified_clearance(cast(CollisionModel, Crossing(goal)), path, required)
    assert clear.lower_bound <= 0.0
    assert not (clear.proven and required > 0.0)


@given(seed=st.integers(0, 2**32 - 1), ways=st.integers(1, 3))
def test_a_crossing_on_the_segment_between_postures_is_not_missed(seed: int, ways: int) -> None:
    rng = np.random.default_rng(seed)
    path = PosturePath(
        rng.normal(size=(ways + 1, 1)), rng.uniform(0.01, 0.3, size=ways), float(rng.choice([0.0, 0.013]))
    )
    ((goal,),) = path.at(rng.uniform(0.0, path.duration, size=1))[0]
    assert certified_clearance(cast(CollisionModel, Crossing(goal)), path, -10.0).lower_bound <= 0.0


@pytest.mark.parametrize("edge", range(1, 50))
def test_a_crossing_where_two_cells_meet_is_not_missed(edge: int) -> None:
    # Cells of 20 ms: nowhere on this way is the bound further from the samples, or closer to the truth.
    path = PosturePath(np.array([[0.0], [1.0]]), np.array([1.0]), 0.0)
    ((goal,),) = path.at(np.array([0.02 * edge]))[0]
    clear = certified_clearance(cast(CollisionModel, Crossing(goal)), path, -10.0)
    assert -1e-2 < clear.lower_bound <= 0.0


def assert_a_bound_is_enough(seed: int) -> None:
    model, collision = free_arm(seed)
    one, other = random_postures(np.random.default_rng(seed), model, 2)

    def position(time: np.ndarray) -> np.ndarray:
        return np.asarray(one + np.abs(np.sin(5.0 * time))[:, None] * (other - one))

    time = np.arange(0.0, 0.5, 2e-5)
    closest = float(CapsuleModel(model).distances(position(time)).min())
    clear = certified_along(collision, position, 5.0 * np.abs(other - one), 0.5, closest - 0.01)
    assert clear.lower_bound <= closest
    assert clear.sampled >= closest - 1e-5
    assert clear.proven


@pytest.mark.slow
@settings(max_examples=6)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_bound_of_the_speed_is_enough(seed: int) -> None:
    assert_a_bound_is_enough(seed)


@pytest.mark.campaign
@settings(max_examples=150)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_bound_of_the_speed_is_enough_for_many_motions(seed: int) -> None:
    assert_a_bound_is_enough(seed)
