"""What contradicts itself is refused before a search, and the message says why."""

from __future__ import annotations

from typing import Any

import pytest
from design_bench import ONE_START, quick, small

from ident_service.errors import MotionRefused, UsageError
from ident_service.excitation.design import design_motion
from ident_service.model.arm_model import ArmModel


def refusal(model: ArmModel, **changes: Any) -> str:
    with pytest.raises(MotionRefused) as caught:
        design_motion(model, quick(**changes), budget=ONE_START)
    return str(caught.value)


def test_a_position_margin_that_eats_a_range() -> None:
    model = small(joints={"elbow": {"position": [-0.1, 0.1]}})
    reason = refusal(model, position_margin=0.1)
    assert reason == "the position margin leaves nothing of the range of elbow: -0.1..0.1 less 0.1 on either side"


def test_a_position_margin_of_one_joint_only() -> None:
    assert "elbow" in refusal(small(), position_margin=[0.1, 2.5])


def test_a_torque_limit_below_friction() -> None:
    prior = small().config.model_dump()["prior"]
    names, values = [*prior["names"], "fc2"], [*prior["values"], 12.5]
    model = small(prior=dict(zip(names, values, strict=True)))
    assert refusal(model, torque_margin=0.2) == (
        "dry friction alone exceeds the torque limit less the margin: elbow: friction 12.5 against 12"
    )


def test_gravity_too_strong_in_every_posture() -> None:
    model = small(joints={"shoulder": {"position": [-0.5, 0.5], "torque": 6.0}})
    reason = refusal(model, torque_margin=0.0)
    assert "shoulder cannot hold the arm in any of" in reason
    assert "of what the torque limit leaves" in reason


def test_home_in_collision() -> None:
    wall = {"box": {"center": [0.75, 0.0, 0.0], "size": [0.1, 0.1, 0.1]}}
    reason = refusal(small(workspace={"obstacles": {"wall": wall}}))
    assert "home, where motions begin, is in collision" in reason
    assert "elbow - obstacle wall" in reason


def test_home_nearer_than_the_clearance() -> None:
    wall = {"half_space": {"normal": [0.0, 1.0, 0.0], "offset": -0.05}}
    reason = refusal(small(workspace={"obstacles": {"table": wall}, "clearance": 0.02}))
    assert "home, where motions begin, is nearer than the clearance of 0.02 m: 0.010 m" in reason


def test_no_posture_inside_a_tiny_box() -> None:
    reason = refusal(small(workspace={"inside": {"x": [-0.1, 0.1], "y": [-0.1, 0.1]}}))
    assert "home, where motions begin" in reason
    assert "inside" in reason


def test_no_posture_within_the_margins_that_keeps_clear() -> None:
    # Home, straight ahead, is clear; the range that the margin leaves is not.
    floor = {"half_space": {"normal": [0.0, 1.0, 0.0], "offset": -0.07}}
    model = small(
        joints={"shoulder": {"position": [-1.0, 0.0]}, "elbow": {"position": [-0.5, 0.0]}},
        workspace={"obstacles": {"floor": floor}, "clearance": 0.02},
    )
    reason = refusal(model, position_margin=0.2)
    assert "no posture within the position limits keeps 0.02 m clear" in reason
    assert "obstacle floor" in reason


def test_standby_beyond_the_budget() -> None:
    model = small(supply={"voltage": 24.0, "current": 1.0, "standby": 24.0})
    assert refusal(model) == "planar2: the supply's standby 24 W leaves nothing of 24 W"


def test_a_parameter_that_is_none() -> None:
    with pytest.raises(UsageError, match="mass of the moon: not among the base parameters of planar2"):
        design_motion(small(), quick(criterion="a_optimal", parameters=["mass of the moon"]), budget=ONE_START)


def test_missing_limits() -> None:
    assert "joints.elbow.jerk" in refusal(small(joints={"elbow": {"jerk": None}}))


def test_no_prior() -> None:
    assert "torque cannot be predicted without prior" in refusal(small(prior=None))
