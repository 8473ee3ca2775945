"""The feasible sets against the paper's matrices written out, and against real bodies made of mass points."""

from __future__ import annotations

import numpy as np
import pytest
from estimation.bodies import cloud, eq17, moments_of, ten_of
from hypothesis import given
from hypothesis import strategies as st

from ident_service.config.arm import ArmConfig
from ident_service.estimation.feasible.feasible_set import FeasibleSet, feasible_set, symmetric
from ident_service.model.parameter_layout import INERTIAL

NAMES = tuple(f"{symbol}{link}" for link in (1, 2) for symbol in (*INERTIAL, "Ia", "fv", "fc", "fo"))
ONE = tuple(f"{symbol}1" for symbol in INERTIAL)


def config(**rest: object) -> ArmConfig:
    joints = {
        "a": {"body": {"mass": [1.0, 3.0], "center_of_mass": {"lower": [-0.1, -0.2, -0.3], "upper": [0.4, 0.5, 0.6]}}},
        "b": {},
    }
    table = {"convention": "standard", "joints": {"a": {}, "b": {}}}
    return ArmConfig.model_validate(
        {"format": "ident-arm", "version": 1, "name": "two", "kinematics": {"dh": table}, "joints": joints, **rest}
    )


def values(conditions: FeasibleSet, delta: np.ndarray) -> dict[str, np.ndarray]:
    """Per block, its matrix or its numbers."""
    return {
        block.name: symmetric(block.F @ delta + block.f, block.size) if block.size else block.F @ delta + block.f
        for block in conditions.blocks
    }


def test_inertia_is_eq_17_entry_for_entry() -> None:
    delta = np.random.default_rng(1).normal(size=len(NAMES))
    got = values(feasible_set("inertia", NAMES), delta)
    assert list(got) == ["link 1: mass and inertia positive", "link 2: mass and inertia positive"]
    for matrix, ten in zip(got.values(), (delta[:10], delta[14:24]), strict=True):
        np.testing.assert_allclose(matrix, eq17(ten), rtol=0, atol=1e-15)


def test_pseudo_inertia_is_the_second_moment_of_the_mass() -> None:
    rng = np.random.default_rng(2)
    clouds = [cloud(rng), cloud(rng)]
    delta = np.concatenate([np.append(ten_of(*body), rng.normal(size=4)) for body in clouds])
    got = values(feasible_set("pseudo_inertia", NAMES), delta)
    assert list(got) == ["link 1: a mass distribution exists", "link 2: a mass distribution exists"]
    for matrix, body in zip(got.values(), clouds, strict=True):
        np.testing.assert_allclose(matrix, moments_of(*body), rtol=0, atol=1e-14)


@given(st.integers(0, 2**32 - 1), st.integers(5, 20))
def test_real_bodies_are_members_of_both_sets(seed: int, points: int) -> None:
    ten = ten_of(*cloud(np.random.default_rng(seed), points))
    assert feasible_set("inertia", ONE).margin(ten)[0] > 0.0
    assert feasible_set("pseudo_inertia", ONE).margin(ten)[0] > 0.0


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 0.9))
def test_triangle_inequality_is_what_the_sets_differ_in(seed: int, excess: float) -> None:
    rng = np.random.default_rng(seed)
    # Principal moments of which one exceeds the sum of the others, anywhere and in any orientation.
    small = rng.uniform(0.1, 1.0, size=2)
    principal = np.array([*small, (1.0 + excess) * small.sum()])
    Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    m, c = rng.uniform(0.5, 3.0), rng.normal(scale=0.3, size=3)
    L = Q @ np.diag(principal) @ Q.T + m * (c @ c * np.eye(3) - np.outer(c, c))
    ten = np.array([L[0, 0], L[0, 1], L[0, 2], L[1, 1], L[1, 2], L[2, 2], *(m * c), m])
    assert feasible_set("inertia", ONE).margin(ten)[0] > 0.0
    assert feasible_set("pseudo_inertia", ONE).margin(ten)[0] < 0.0


@pytest.mark.parametrize("kind", ["inertia", "pseudo_inertia"])
def test_no_mass_and_no_inertia_are_no_body(kind: str) -> None:
    conditions = feasible_set(kind, ONE)
    body = ten_of(*cloud(np.random.default_rng(3)))
    weightless, reversed_inertia = body.copy(), body.copy()
    weightless[9] = -1e-6
    reversed_inertia[:6] *= -1.0
    assert conditions.margin(weightless)[0] < 0.0
    assert conditions.margin(reversed_inertia)[0] < 0.0
    margin, name = conditions.margin(reversed_inertia)
    assert name == conditions.blocks[0].name
    assert margin == pytest.approx(np.linalg.eigvalsh(next(iter(values(conditions, reversed_inertia).values())))[0])


def test_conditions_of_the_configuration_have_names_and_values() -> None:
    arm = config(constraints={"total_mass": {"lower": 2.0, "upper": 9.0}, "positive": ["viscous", "coulomb"]})
    conditions = feasible_set("pseudo_inertia", NAMES, arm)
    delta = np.zeros(len(NAMES))
    index = {name: column for column, name in enumerate(NAMES)}
    for name, value in {"m1": 2.5, "lx1": 0.5, "ly1": -0.25, "lz1": 0.0, "m2": 4.0, "fv1": 0.7, "fc2": -0.1}.items():
        delta[index[name]] = value
    got = values(conditions, delta)
    wanted = {
        "link 1: mass within 1..3 kg": [1.5, 0.5],
        "total mass at least 2 kg": [4.5],
        "total mass at most 9 kg": [2.5],
        # l - m lower and m upper - l, axis by axis (eq. 26).
        "link 1: centre of mass inside its box": [0.75, 0.5, 0.25, 1.5, 0.75, 1.5],
        "joint 1: viscous positive": [0.7],
        "joint 2: viscous positive": [0.0],
        "joint 1: coulomb positive": [0.0],
        "joint 2: coulomb positive": [-0.1],
    }
    assert list(got)[2:] == list(wanted)
    for name, numbers in wanted.items():
        np.testing.assert_allclose(got[name], numbers, rtol=0, atol=1e-15, err_msg=name)


def test_terms_that_the_names_lack_and_bare_tables_have_no_conditions() -> None:
    arm = config()
    assert {block.name for block in feasible_set("inertia", ONE, arm).blocks} == {
        "link 1: mass and inertia positive",
        "link 1: mass within 1..3 kg",
        "link 1: centre of mass inside its box",
    }
    assert len(feasible_set("inertia", NAMES).blocks) == 2


def test_identity_is_what_a_margin_shifts() -> None:
    arm = config(constraints={"total_mass": {"upper": 9.0}})
    delta = np.random.default_rng(4).normal(size=len(NAMES))
    for block in feasible_set("inertia", NAMES, arm).blocks:
        moved = type(block)(block.name, block.size, block.F, block.f - 0.3 * block.identity())
        assert moved.smallest(delta) == pytest.approx(block.smallest(delta) - 0.3, abs=1e-12)
