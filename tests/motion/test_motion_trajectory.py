"""Ways keep to the limits at every moment, between all moving states, or are refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from motion_bench import bench_limits
from reachable import (
    close,
    goes_together,
    sampled,
    setpoints,
)

from ident_service.config.motion_limits import MotionLimits
from ident_service.errors import MotionRefused
from ident_service.motion.trajectory import RuckigReference, Setpoint, plan_trajectory, rest

Array = np.ndarray
LIMITS = bench_limits()


@pytest.mark.slow
@settings(max_examples=100)
@given(setpoints(LIMITS), setpoints(LIMITS))
def test_a_trajectory_keeps_to_every_limit_or_is_refused(start: Setpoint, end: Setpoint) -> None:
    try:
        reference = plan_trajectory(start, end, LIMITS)
    except MotionRefused:
        return
    close(reference.at(0.0), start)
    close(reference.at(reference.duration), end)
    times, position, velocity, acceleration = sampled(reference)
    goes_together(LIMITS, times, position, velocity, acceleration)
    assert (position >= LIMITS.lower - 1e-5).all()
    assert (position <= LIMITS.upper + 1e-5).all()
    assert (np.abs(acceleration) <= LIMITS.acceleration * (1 + 1e-6)).all()
    rising = np.abs(start.velocity) + 0.5 * start.acceleration**2 / LIMITS.jerk
    assert (np.abs(velocity) <= np.maximum(LIMITS.velocity, rising) * (1 + 1e-6)).all()


@settings(max_examples=100)
@given(setpoints(LIMITS, 0.3), setpoints(LIMITS, 0.3))
def test_between_gentle_states_a_trajectory_exists(start: Setpoint, end: Setpoint) -> None:
    _, _, velocity, _ = sampled(plan_trajectory(start, end, LIMITS))
    assert (np.abs(velocity) <= LIMITS.velocity * (1 + 1e-6)).all()


def test_a_joint_that_ends_as_it_begins_goes_round_while_another_moves() -> None:
    start = Setpoint(np.array([0.0, 0.25]), np.zeros(2), np.array([0.0, 3.75]))
    end = Setpoint(np.array([0.0, 0.25]), np.zeros(2), np.array([1.0, 3.75]))
    reference = plan_trajectory(start, end, LIMITS)
    close(reference.at(reference.duration), end)
    times, position, velocity, acceleration = sampled(reference)
    goes_together(LIMITS, times, position, velocity, acceleration)


@pytest.mark.slow
@settings(max_examples=100)
@given(setpoints(LIMITS), setpoints(LIMITS))
def test_the_extent_of_a_trajectory_is_where_it_goes(start: Setpoint, end: Setpoint) -> None:
    wide = 100.0 * np.ones(2)
    try:
        reference = plan_trajectory(start, end, _with(lower=-wide, upper=wide))
    except MotionRefused:
        assume(False)
    lowest, highest = reference.extent()
    _, position, _, _ = sampled(reference, 700)
    assert (position >= lowest - 1e-5).all()
    assert (position <= highest + 1e-5).all()


def test_a_turning_point_outside_the_limits_is_refused() -> None:
    # Start and end lie inside; in between, the elbow turns 0.17 rad beyond what its limits allow.
    start = Setpoint(np.array([0.0, 1.7339]), np.array([0.0, 2.6862]), np.array([0.0, -13.9096]))
    end = Setpoint(np.array([0.0, -0.4985]), np.array([0.0, 2.0916]), np.array([0.0, 11.7914]))
    upper = np.array([1.8, 1.9])
    with pytest.raises(MotionRefused, match="joint 2"):
        plan_trajectory(start, end, _with(upper=upper))
    _, position, _, _ = sampled(plan_trajectory(start, end, _with(upper=upper + 0.1)))
    assert position[:, 1].max() > 1.9


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("key", ["velocity", "acceleration"])
def test_an_end_beyond_a_limit_is_refused(joint: int, key: str) -> None:
    beyond = np.zeros(2)
    beyond[joint] = 1.1 * getattr(LIMITS, key)[joint]
    end = Setpoint(**({"position": np.zeros(2), "velocity": np.zeros(2), "acceleration": np.zeros(2)} | {key: beyond}))
    with pytest.raises(MotionRefused):
        plan_trajectory(rest(np.zeros(2)), end, LIMITS)


def test_an_end_that_no_jerk_can_bring_is_refused() -> None:
    # Each is within its limit, but with this acceleration the velocity must have been too large just before.
    end = Setpoint(np.zeros(2), np.array([0.99, 0.0]) * LIMITS.velocity, np.array([-0.9, 0.0]) * LIMITS.acceleration)
    with pytest.raises(MotionRefused, match="no jerk-limited trajectory"):
        plan_trajectory(rest(np.zeros(2)), end, LIMITS)


def test_the_trajectory_to_where_one_stands_takes_no_time() -> None:
    here = rest(np.array([0.3, -0.2]))
    assert plan_trajectory(here, here, LIMITS).duration == 0.0
    close(plan_trajectory(here, here, LIMITS).at(1.0), here)


def test_all_joints_of_a_trajectory_arrive_together() -> None:
    reference = plan_trajectory(rest(np.zeros(2)), rest(np.array([1.0, 0.1])), LIMITS)
    velocity = reference.at(0.95 * reference.duration).velocity
    assert (velocity > 1e-4).all()


def test_a_trajectory_stands_at_its_end() -> None:
    reference = plan_trajectory(rest(np.zeros(2)), rest(np.ones(2)), LIMITS)
    assert isinstance(reference, RuckigReference)
    close(reference.at(reference.duration + 5.0), rest(np.ones(2)))


def _with(**changes: Array) -> MotionLimits:
    return replace(LIMITS, **changes)
