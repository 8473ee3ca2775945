"""The posture that every motion may shrink to: near home, strong enough, clear of everything."""

from __future__ import annotations

import numpy as np
import pytest
from design_bench import quick, small
from hypothesis import given, settings
from hypothesis import strategies as st

from ident_service.config.motion_limits import MotionLimits, motion_limits
from ident_service.excitation.design import complete_task, motion_family, safe_posture
from ident_service.excitation.optimal_design import Problem, usable_limits
from ident_service.excitation.search import within_limits
from ident_service.model.arm_model import ArmModel
from ident_service.model.collision import CollisionModel

Array = np.ndarray


def usable(model: ArmModel, **changes: float) -> MotionLimits:
    return usable_limits(model.chain.names, motion_limits(model.config), quick(**changes))


def gravity(posture: Array) -> Array:
    """Of planar2's prior, by hand: first moments of 1 and 0.25 kg m about shoulder and elbow."""
    both = 0.25 * 9.81 * np.cos(posture.sum())
    return np.array([9.81 * np.cos(posture[0]) + both, both])


def test_home_itself_where_nothing_speaks_against_it() -> None:
    model = small()
    np.testing.assert_array_equal(safe_posture(model, usable(model)), [0.0, 0.0])


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1), torque=st.floats(3.0, 40.0))
def test_the_torque_limits_hold_the_arm_there(seed: int, torque: float) -> None:
    model = small(joints={"shoulder": {"position": [-2.4, 1.8], "torque": torque}})
    limits = usable(model)
    posture = safe_posture(model, limits, seed)
    assert (np.abs(gravity(posture)) < limits.torque).all()
    assert ((limits.lower < posture) & (posture < limits.upper)).all()


@pytest.mark.parametrize("lower", [-0.12, -0.3])
def test_it_keeps_clear(lower: float) -> None:
    # Home is clear, and the posture nearest to it with some room to move.
    model = small(workspace={"inside": {"y": [lower, 1.0]}})
    posture = safe_posture(model, usable(model))
    assert CollisionModel(model).distances(posture[None]).min() > model.config.workspace.clearance + 0.02 - 1e-6


def test_a_posture_is_not_at_the_end_of_a_range() -> None:
    model = small(joints={"shoulder": {"position": [0.0, 1.8]}, "elbow": {"position": [-2.0, 0.0]}})
    limits = usable(model)
    posture = safe_posture(model, limits)
    assert ((limits.lower < posture) & (posture < limits.upper)).all()
    basis, base = motion_family(quick(), model)
    problem = Problem(complete_task(model, quick(), basis, base), 40)
    assert within_limits(problem, basis.standing(posture))


def test_the_same_seed_finds_the_same_posture() -> None:
    model = small(joints={"shoulder": {"position": [-2.4, 1.8], "torque": 5.0}})
    np.testing.assert_array_equal(safe_posture(model, usable(model), 3), safe_posture(model, usable(model), 3))
