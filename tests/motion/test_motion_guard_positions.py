"""Positions that drives are given pass the guard as torques do: no number that is none, no limit, no jump."""

from __future__ import annotations

import numpy as np
import pytest
from guard_bench import HOME, LIMITS, NAMES, PERIOD, QUICK, STILL, WARN, Bench, is_fault, unit
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ident_service.motion.faults import FAULTS, Fault, Reaction
from ident_service.motion.safety_monitor import NOT_APPLIED, VELOCITY_STOP, SafetyMonitor

Array = np.ndarray
STEP = VELOCITY_STOP * LIMITS.velocity * PERIOD
MOST = (1.0 + NOT_APPLIED) * LIMITS.torque


def bench() -> Bench:
    return Bench(most_torque=MOST)


def test_a_position_within_reach_leaves_as_it_is() -> None:
    guard = bench().guard
    wanted = HOME + 0.99 * STEP * np.array([1.0, -1.0])
    leaves, fault = guard.limit_position(wanted)
    assert fault is None
    np.testing.assert_array_equal(leaves, wanted)


@settings(max_examples=100)
@given(arrays(float, 2, elements=st.floats(-1.7, 1.7)))
def test_no_position_is_a_step_that_a_joint_may_not_make(wanted: Array) -> None:
    guard, before = bench().guard, HOME
    for _ in range(5):
        leaves, fault = guard.limit_position(wanted)
        assert (np.abs(leaves - before) <= STEP * (1.0 + 1e-9)).all()
        # Towards where it shall be, and never past it.
        assert ((leaves - before) * (wanted - before) >= 0.0).all()
        assert (np.abs(wanted - leaves) <= np.abs(wanted - before) + 1e-12).all()
        jumps = (np.abs(wanted - before) > STEP).any()
        assert (fault is not None) == jumps
        if fault is not None:
            assert is_fault(fault, "position_rate")
            assert fault.reaction is WARN
        before = leaves


def test_a_jump_is_bridged_once_and_stops_the_arm_when_it_goes_on() -> None:
    guard, reactions = bench().guard, []
    for number in range(FAULTS["position_rate"].often + 1):
        guard.findings.cycle += 1
        _, fault = guard.limit_position(HOME + 1.5 * (-1.0) ** number)
        assert fault is not None
        reactions.append(fault.reaction)
    assert reactions[:-1] == [WARN] * FAULTS["position_rate"].often
    assert reactions[-1] is Reaction.CONTROLLED_STOP


def test_what_is_no_number_or_outside_the_limits_ends_it_and_the_last_position_stays() -> None:
    for wrong, code in (
        (HOME + np.array([0.0, np.nan]), "position_not_finite"),
        (HOME + np.array([0.0, np.inf]), "position_not_finite"),
        (np.array([HOME[0], LIMITS.upper[1] + 1e-6]), "position_outside"),
        (np.array([HOME[0], LIMITS.lower[1] - 1.0]), "position_outside"),
    ):
        guard = bench().guard
        before, _ = guard.limit_position(HOME + 0.5 * STEP)
        leaves, fault = guard.limit_position(wrong)
        assert is_fault(fault, code, joint=1)
        assert fault is not None
        assert fault.reaction is QUICK
        np.testing.assert_array_equal(leaves, before)


def test_a_measured_torque_beyond_the_limit_is_reported_and_stops_the_arm_when_it_stays() -> None:
    seen = bench()
    assert seen.see(HOME, torque=MOST)[1] is None
    faults = [seen.see(HOME, torque=MOST + 0.01 * unit(1))[1] for _ in range(FAULTS["torque_exceeded"].often + 1)]
    assert is_fault(faults[0], "torque_exceeded", joint=1)
    assert [fault.reaction for fault in faults if fault][:-1] == [WARN] * FAULTS["torque_exceeded"].often
    assert is_fault(faults[-1], "repeated_warnings")


def test_it_is_no_fault_of_drives_that_are_given_torques() -> None:
    assert Bench().see(HOME, torque=10.0 * MOST)[1] is None


def told(period: float, pushes: float, *, moving: bool) -> list[str]:
    """The fault of each cycle in which the elbow's drive pushes by this share of its limit; empty for none."""
    seen = bench()
    seen.guard = SafetyMonitor(NAMES, LIMITS, period, HOME, most_torque=MOST)
    steps = [HOME + number * moving * 1e-5 for number in range(30)]
    faults = [seen.see(at, unexplained=pushes * LIMITS.torque * unit(1))[1] for at in steps]
    return ["" if fault is None else fault.code for fault in faults]


def test_a_drive_that_pushes_a_joint_which_stands_still_is_noticed_within_its_time() -> None:
    """A position loop in the drive pushes long before the host sees much of a following error."""
    for period, cycles in ((1e-3, 20), (4e-3, 5), (1e-2, 3)):
        codes = told(period, 0.3, moving=False)
        assert codes[: cycles - 1] == [""] * (cycles - 1)
        assert codes[cycles - 1] == "frozen_encoder"
        assert told(period, 0.19, moving=False) == [""] * 30
        assert told(period, 0.3, moving=True) == [""] * 30


def test_a_drive_that_pushes_hard_quick_stops_although_its_joint_moves() -> None:
    """Against somebody, or by a frozen encoder of a differential; a stop under control would go on pushing."""
    codes = told(4e-3, 0.45, moving=True)
    assert codes[:4] == [""] * 4
    assert codes[4] == "torque_unexplained"
    assert FAULTS["torque_unexplained"].reaction is QUICK
    seen = bench()
    for _ in range(3):  # and never in a row
        for share in (0.45,) * 19 + (0.0,):
            assert seen.see(HOME + seen.cycle * 1e-5, unexplained=share * LIMITS.torque * unit(1))[1] is None
    # What is worse stays the fault.
    worse = bench()
    for number in range(25):
        _, fault = worse.see(HOME + number * 1e-5, unexplained=0.45 * LIMITS.torque, torque=np.array([np.nan, 0.0]))
        assert is_fault(fault, "feedback_not_finite")


def test_what_a_drive_pushes_to_catch_up_after_a_stall_is_no_push_and_what_goes_on_is() -> None:
    """It is given what lies cycles ahead, as the emulated drives were after 12 ms: 0.8 of the limit for up to 40 ms."""
    for late, cycles in ((1.4, 5), (1.6, 15)):
        seen = bench()
        seen.guard = SafetyMonitor(NAMES, LIMITS, 4e-3, HOME, most_torque=MOST)
        for number in range(cycles):
            elapsed = 4e-3 * (late if number == 0 else 1.0)
            at, push = HOME + number * 1e-5, 0.82 * LIMITS.torque * unit(1)
            _, fault = seen.see(at, elapsed=elapsed, unexplained=push)
            assert (fault is not None) == (number == cycles - 1)
        is_fault(fault, "torque_unexplained", 1)


def test_a_joint_that_stands_still_although_it_shall_move_is_a_frozen_encoder() -> None:
    """Find a frozen encoder by the torque that the law would add for the following error, though it is not sent."""
    seen, fault = bench(), None
    for number in range(100):
        away = 0.002 * number * unit(0)
        correction = LIMITS.kp * away * 0.7
        _, fault = seen.see(HOME, HOME + away, STILL, correction=correction)
        if fault is not None:
            break
    assert is_fault(fault, "frozen_encoder", joint=0)


@pytest.mark.parametrize("goes_on", [True, False])
def test_a_joint_that_stands_at_once_is_frozen_only_where_other_positions_are_given(goes_on: bool) -> None:
    seen, step, faults = bench(), 0.5 * LIMITS.velocity * PERIOD * unit(0), list[Fault | None]()
    for number in range(20):
        if goes_on or number < 4:
            assert seen.guard.limit_position(HOME + (number + 1) * step)[1] is None
        faults.append(seen.see(HOME + min(number, 3) * step, velocity=step / PERIOD)[1])
    codes = {fault.code for fault in faults if fault is not None}
    assert codes == ({"frozen_encoder"} if goes_on else set())
