"""What touches is what the exact distances say touches, and with many pairs none waits longer than its turn."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.random_bodies import arm_with_bodies, random_postures
from hypothesis import given
from hypothesis import strategies as st

from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm
from ident_service.errors import MotionRefused
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.collision import AT_ONCE, CollisionModel, Contact

Array = np.ndarray


def exact(model: ArmModel) -> CollisionModel | None:
    try:
        return CollisionModel(model)
    except MotionRefused:  # a pair that is never free
        return None


def deepest(contact: Contact, position: Array) -> dict[str, float]:
    """By name of the pair, the deepest of its solids, of all turns."""
    found: dict[str, float] = {}
    for _ in range(contact._turns):
        for name, depth in zip(contact.pairs, contact.depths(position).tolist(), strict=True):
            found[name] = max(found.get(name, -np.inf), depth)
    return found


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_what_touches_is_as_deep_as_the_exact_distance_says(seed: int, joints: int) -> None:
    model = arm_with_bodies(seed, joints)
    collision = exact(model)
    if collision is None:
        return
    contact = Contact(model)
    assert tuple(dict.fromkeys(contact.pairs)) == collision.pairs
    for posture in random_postures(np.random.default_rng(seed), model, 5):
        (distances,) = collision.distances(posture[None])
        found = deepest(contact, posture)
        if (distances >= 0.0).all():
            assert set(found.values()) <= {-np.inf}
        for name, distance in zip(collision.pairs, distances.tolist(), strict=True):
            if distance < 0.0:
                assert found[name] == pytest.approx(-distance, abs=1e-9)
            else:
                assert found[name] <= 0.0


def many_boxes(count: int) -> ArmModel:
    """The planar arm over a floor that it touches in some postures, and boxes that nothing can reach."""
    obstacles: dict[str, Any] = {
        f"box {k}": {"box": {"center": (50.0 + k, 0.0, 0.0), "size": (0.1, 0.1, 0.1)}} for k in range(count)
    }
    obstacles["floor"] = {"half_space": {"normal": (0.0, 1.0, 0.0), "offset": -0.5}}
    document = load_arm("planar2").model_dump(mode="json", by_alias=True)
    return arm_model(ArmConfig.model_validate(document | {"workspace": {"obstacles": obstacles}}))


@pytest.mark.parametrize("count", [0, 10, 60, 100])
def test_with_many_pairs_each_has_its_turn(count: int) -> None:
    model = many_boxes(count)
    contact, collision = Contact(model), CollisionModel(model)
    turns = contact._turns
    assert turns == -(-len(contact.pairs) // AT_ONCE)
    rng, touched = np.random.default_rng(1), 0
    for posture in random_postures(rng, model, 50):
        distances = collision.distances(posture[None])[0]
        seen = [bool((contact.depths(posture) > 0.0).any()) for _ in range(turns)]
        assert any(seen) == bool((distances < 0.0).any())
        touched += any(seen)
    assert 0 < touched < 50


def test_four_hundred_pairs_are_all_seen_within_ten_cycles() -> None:
    assert -(-400 // AT_ONCE) <= 10


def test_a_posture_that_is_no_number_counts_as_touching() -> None:
    contact = Contact(many_boxes(0))
    assert (contact.depths(np.full(2, np.nan)) == np.inf).all()


def test_an_arm_without_bodies_touches_nothing() -> None:
    model = arm_with_bodies(4, 2, obstacles=(), inside=False)
    bare = replace(model, config=model.config.model_copy(update={"geometry": {}}))
    contact = Contact(bare)
    assert contact.pairs == ()
    assert contact.depths(np.zeros(2)).shape == (0,)
