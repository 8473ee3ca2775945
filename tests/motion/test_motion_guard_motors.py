"""No torque leaves that is more than a motor can give, where motors share joints; and joints keep their direction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from guard_bench import HOME, LIMITS, NAMES, PERIOD, is_fault
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from motion_bench import bench_config

from ident_service.config.motion_limits import MotionLimits, motion_limits
from ident_service.config.recording import Transmission
from ident_service.motion.safety_monitor import SafetyMonitor

Array = np.ndarray
RATIOS, COUPLING, MOST = (20.0, -30.0), ((1.0, -0.5), (1.0, 0.5)), (0.8, 0.5)
# Written out: tau = C^T diag(r) tau_motor.
TO_JOINTS = np.array(COUPLING).T @ np.diag(RATIOS)
SLACK = 1.0 + 1e-9


def coupled_limits() -> MotionLimits:
    gears = Transmission(ratios=RATIOS, coupling=COUPLING, motor_torque=MOST)
    return motion_limits(bench_config(transmission=gears.model_dump()))


def guard() -> SafetyMonitor:
    return SafetyMonitor(NAMES, coupled_limits(), PERIOD, HOME)


def motors(torque: Array) -> Array:
    return np.linalg.solve(TO_JOINTS, torque)


WANTED = arrays(float, 2, elements=st.floats(-1.0, 1.0)).map(lambda share: 2.0 * share * LIMITS.torque)


def test_motors_are_weaker_together_than_joints_alone() -> None:
    """Else these tests would show nothing."""
    assert (np.abs(motors(np.array([39.0, 14.0]))) > MOST).any()
    assert (np.abs(motors(np.array([20.0, 0.0]))) < MOST).all()


@settings(max_examples=100)
@given(WANTED)
def test_the_first_torque_is_scaled_as_a_whole(wanted: Array) -> None:
    leaves, fault = guard().limit_torque(wanted)
    within = np.clip(wanted, -LIMITS.torque, LIMITS.torque)
    share = min(1.0, *(np.array(MOST) / np.maximum(np.abs(motors(within)), 1e-12)))
    np.testing.assert_allclose(leaves, share * within, rtol=1e-9, atol=1e-12)
    assert (fault is None) == bool((np.abs(wanted) <= LIMITS.torque).all() and share == 1.0)
    if fault is not None:
        assert fault.code == "torque_saturated"


@settings(max_examples=100)
@given(st.lists(WANTED, min_size=2, max_size=30))
def test_whatever_is_wanted_in_turn_no_motor_and_no_joint_gets_more_and_none_jumps(wanted: list[Array]) -> None:
    one, before = guard(), None
    for torque in wanted:
        leaves, _ = one.limit_torque(torque)
        assert (np.abs(motors(leaves)) <= np.array(MOST) * SLACK).all()
        assert (np.abs(leaves) <= LIMITS.torque * SLACK).all()
        if before is not None:
            assert (np.abs(leaves - before) <= one.rate * SLACK).all()
        before = leaves


def test_what_is_wanted_for_long_is_reached() -> None:
    one, wanted = guard(), np.array([10.0, -3.0])
    one.limit_torque(np.zeros(2))
    for _ in range(200):
        leaves, fault = one.limit_torque(wanted)
    np.testing.assert_array_equal(leaves, wanted)
    assert fault is None


def test_the_sentence_names_the_motor() -> None:
    _, fault = guard().limit_torque(np.array([20.0, 14.0]))
    assert fault is not None
    assert fault.code == "torque_saturated"
    wanted = motors(np.array([20.0, 14.0]))
    assert (np.abs(wanted) > MOST).tolist() == [False, True]
    assert fault.message.startswith(f"motor 2: a torque of {wanted[1]:.4g} N m was requested, the limit is 0.5: ")


def test_a_joint_alone_is_reported_as_before() -> None:
    one = SafetyMonitor(NAMES, replace(coupled_limits(), motors=None), PERIOD, HOME)
    is_fault(one.limit_torque(1.01 * LIMITS.torque * np.array([1.0, 0.0]))[1], "torque_saturated", 0)
