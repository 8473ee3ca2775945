"""Faults are found at their thresholds and not below, and the guard forgets nothing; no torque leaves unlimited."""

from __future__ import annotations

import numpy as np
import pytest
from guard_bench import HOME, LIMITS, NAMES, OFF, PERIOD, STILL, WINDOW, Bench, is_fault, unit
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from drivers.arm import Sample
from drivers.axis_status import AxisStatus
from ident_service.motion.faults import Fault
from ident_service.motion.safety_monitor import (
    ABSURD,
    FROZEN_CYCLES,
    FROZEN_EFFORT,
    MAX_AGE,
    NOT_APPLIED,
    SUDDEN_CYCLES,
    SUDDEN_SPEED,
    VELOCITY_OFF,
    VELOCITY_STOP,
)
from ident_service.motion.trajectory import Setpoint

Array = np.ndarray


def test_a_healthy_sample_is_no_fault() -> None:
    bench = Bench()
    assert bench.see(HOME) == ([True, True], None)
    assert bench.guard.warnings == {}


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_thresholds_of_position(joint: int, side: float) -> None:
    edge = LIMITS.upper if side > 0.0 else LIMITS.lower

    def seen(beyond: Array) -> Fault | None:
        position = np.where(unit(joint) > 0.0, edge + side * beyond, HOME)
        return Bench(position).see(position)[1]

    margin = LIMITS.following_error
    assert seen(0.0 * margin) is None
    is_fault(seen(np.full(2, 1e-9)), "position_limit", joint)
    is_fault(seen(0.999 * margin), "position_limit", joint)
    is_fault(seen(1.001 * margin), "far_outside", joint)


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_thresholds_of_velocity(joint: int, side: float) -> None:
    def seen(times: float) -> Fault | None:
        velocity = side * times * LIMITS.velocity * unit(joint)
        return Bench().see(HOME + PERIOD * velocity, velocity=velocity)[1]

    assert seen(0.999 * VELOCITY_STOP) is None
    is_fault(seen(1.001 * VELOCITY_STOP), "over_velocity", joint)
    is_fault(seen(0.999 * VELOCITY_OFF), "over_velocity", joint)
    is_fault(seen(1.001 * VELOCITY_OFF), "runaway", joint)


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_thresholds_of_the_following_error(joint: int, side: float) -> None:
    def seen(times: float) -> Fault | None:
        position = HOME + 1e-5
        return Bench().see(position, position + side * times * LIMITS.following_error * unit(joint))[1]

    assert seen(0.999) is None
    is_fault(seen(1.001), "following_error", joint)


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_thresholds_of_a_jump(joint: int, side: float) -> None:
    for times, jumped in ((0.999, False), (1.001, True)):
        usable, fault = Bench().see(HOME + side * times * WINDOW * unit(joint), HOME)
        assert usable == [not (jumped and k == joint) for k in range(2)]
        assert (fault is not None) == jumped


def test_a_jump_is_measured_from_where_the_arm_goes() -> None:
    velocity, bench = LIMITS.velocity * unit(0), Bench()
    expected = HOME + PERIOD * velocity
    usable, fault = bench.see(expected - 1.001 * WINDOW * unit(0), velocity=velocity)
    assert usable == [False, True]
    is_fault(fault, "encoder_jump", 0)


@pytest.mark.parametrize("times", [1.01, 1.5, 1.99, 2.5, 100.0])
def test_a_jump_that_stays_is_never_let_in(times: float) -> None:
    bench, wrong = Bench(), HOME + times * WINDOW * unit(1)
    usable, fault = bench.see(wrong, HOME)
    assert usable == [True, False]
    is_fault(fault, "encoder_jump", 1)
    usable, fault = bench.see(wrong, HOME)
    assert usable == [True, False]
    is_fault(fault, "encoder_jumps", 1)
    usable, fault = bench.see(wrong, HOME)
    assert usable == [True, False]
    is_fault(fault, "feedback_gone", 1)


@pytest.mark.parametrize("skipped", [1, 5, 15])
def test_after_skipped_cycles_the_arm_is_expected_where_it_has_gone_meanwhile(skipped: int) -> None:
    velocity = 0.9 * LIMITS.velocity
    there = HOME + velocity * PERIOD * (1 + skipped)
    assert Bench().see(there, velocity=velocity, elapsed=PERIOD * (1 + skipped)) == ([True, True], None)
    beyond = there + 1.001 * WINDOW * unit(1)
    usable, fault = Bench().see(beyond, velocity=velocity, elapsed=PERIOD * (1 + skipped))
    assert usable == [True, False]
    is_fault(fault, "encoder_jump", 1)


def test_where_nobody_knows_how_long_it_took_no_position_on_the_way_is_a_jump() -> None:
    velocity, longest = 0.9 * LIMITS.velocity, 8 * PERIOD
    for way in (velocity * PERIOD, velocity * longest):
        assert Bench().see(HOME + way, velocity=velocity, elapsed=longest, known=False) == ([True, True], None)
    usable, fault = Bench().see(HOME + 16 * WINDOW * unit(1), velocity=velocity, elapsed=longest, known=False)
    assert usable == [True, False]
    is_fault(fault, "encoder_jump", 1)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("skipped", [1, 8])
def test_an_axis_that_was_away_meanwhile_is_expected_where_it_has_gone(skipped: int, known: bool) -> None:
    velocity, gone = 0.9 * LIMITS.velocity, PERIOD * (1 + skipped)

    def back(way: Array) -> tuple[list[bool], Fault | None]:
        bench = Bench()
        there = HOME + velocity * gone
        fault = bench.see(HOME * [np.nan, 1.0], there, velocity, (False, False), elapsed=gone, known=known)[1]
        is_fault(fault, "lost_feedback")
        return bench.see(HOME + way, velocity=velocity)

    for passed in (gone,) if known else (PERIOD, gone):
        assert back(velocity * (passed + PERIOD)) == ([True, True], None)
    bench, now = Bench(), HOME
    for _ in range(2):  # and what has passed before counts no more
        now = now + velocity * gone
        bench.see(now, velocity=velocity, valid=(False, False), elapsed=gone, known=known)
        now = now + velocity * PERIOD
        assert bench.see(now, velocity=velocity) == ([True, True], None)
    is_fault(bench.see(now + velocity * PERIOD + 1.001 * WINDOW * unit(0), now, velocity)[1], "encoder_jump", 0)
    reach = 1 if known else 1 + skipped
    usable, fault = back(velocity * (gone + PERIOD) + 1.001 * reach * WINDOW * unit(1))
    assert usable == [True, False]
    is_fault(fault, "encoder_jump", 1)


def test_one_jump_is_discarded_and_forgiven() -> None:
    bench = Bench()
    for _ in range(3):
        is_fault(bench.see(HOME + 0.5 * unit(0), HOME)[1], "encoder_jump", 0)
        assert bench.see(HOME) == ([True, True], None)
    assert bench.guard.warnings == {"encoder_jump": 3}


def test_jumps_of_different_axes_in_turn_are_not_two_in_a_row() -> None:
    bench = Bench()
    is_fault(bench.see(HOME + 0.5 * unit(0), HOME)[1], "encoder_jump", 0)
    is_fault(bench.see(HOME + 0.5 * unit(1), HOME)[1], "encoder_jump", 1)


@pytest.mark.parametrize("lost", range(1, MAX_AGE))
def test_an_axis_that_comes_back_where_it_should_be_is_welcome(lost: int) -> None:
    velocity, bench = LIMITS.velocity * np.array([1.0, -1.0]), Bench()
    for cycle in range(1, lost + 1):
        now = HOME + cycle * PERIOD * velocity
        usable, fault = bench.see(np.array([np.nan, now[1]]), now, velocity, (False, True))
        assert usable == [False, True]
        is_fault(fault, "lost_feedback", 0)
    now = HOME + (lost + 1) * PERIOD * velocity
    assert bench.see(now, velocity=velocity) == ([True, True], None)
    assert bench.guard.warnings == {"lost_feedback": lost}


def test_an_axis_that_comes_back_elsewhere_has_jumped() -> None:
    bench = Bench()
    for _ in range(MAX_AGE - 1):
        bench.see(HOME, valid=(False, True))
    usable, fault = bench.see(HOME + 1.01 * WINDOW * unit(0), HOME)
    assert usable == [False, True]
    is_fault(fault, "feedback_gone", 0)


def test_a_status_that_is_read_anew_but_says_the_same_is_the_same() -> None:
    bench = Bench()
    for _ in range(3):
        assert bench.see(HOME, status=tuple([int(AxisStatus.POWERED)] * 2)) == ([True, True], None)
    is_fault(bench.see(HOME, status=(int(AxisStatus.POWERED), 0))[1], "drive_fault", 1)


def test_a_drive_that_has_not_said_in_time_that_it_is_energised_is_not() -> None:
    """It may have let go between the enabling and the first sample."""
    on, bench = int(AxisStatus.POWERED), Bench(max_age=3, report_delay=1.5 * PERIOD)
    for _ in range(3 + 2):
        assert bench.see(HOME, status=(on, 0)) == ([True, True], None)
    is_fault(bench.see(HOME, status=(on, 0))[1], "drive_fault", 1)
    for status in ((on, on), ()):
        bench = Bench(max_age=3, report_delay=0.0)
        assert [bench.see(HOME, status=status)[1] for _ in range(9)] == [None] * 9


def test_axes_that_are_gone_one_after_the_other_are_named_together() -> None:
    """The machine that has them answer stalled between two of them."""
    bench = Bench(max_age=3)
    for valid in ((True, False), (False, False)):
        bench.see(HOME, valid=valid)
    fault = bench.see(HOME, valid=(False, False))[1]
    is_fault(fault, "feedback_gone")
    assert fault is not None
    assert fault.message.startswith("shoulder, elbow: no usable feedback for 2, 3 cycles: a drive is late")


def test_jumps_behind_cycles_without_feedback_say_so() -> None:
    bench = Bench(max_age=9)
    for _ in range(4):
        bench.see(HOME, valid=(False, True))
    for _ in range(2):
        fault = bench.see(HOME + 0.5 * unit(0), HOME)[1]
    is_fault(fault, "encoder_jumps", 0)
    assert fault is not None
    assert "jumped in consecutive cycles after 4 without feedback: " in fault.message


@pytest.mark.parametrize("most", [3, 5])
def test_an_axis_is_gone_after_as_many_cycles_as_its_driver_says(most: int) -> None:
    bench = Bench(max_age=most)
    for _ in range(most - 1):
        is_fault(bench.see(HOME, valid=(True, False))[1], "lost_feedback", 1)
    fault = bench.see(HOME, valid=(True, False))[1]
    is_fault(fault, "feedback_gone", 1)
    assert fault is not None
    assert f"for {most} cycles" in fault.message


def test_age_counts_again_from_every_answer() -> None:
    bench = Bench()
    for _ in range(5):
        for _ in range(MAX_AGE - 1):
            is_fault(bench.see(HOME, valid=(True, False))[1], "lost_feedback", 1)
        assert bench.see(HOME)[1] is None


def test_losing_both_axes_by_turns_is_not_losing_one() -> None:
    bench = Bench()
    for cycle in range(12):
        is_fault(bench.see(HOME, valid=(cycle % 2 == 0, cycle % 2 == 1))[1], "lost_feedback")


def test_not_a_number_where_nothing_was_answered_is_only_lost() -> None:
    usable, fault = Bench().see(np.array([np.nan, -0.1]), HOME, valid=(False, True))
    assert usable == [False, True]
    is_fault(fault, "lost_feedback", 0)


def test_only_axes_that_answered_are_blamed_for_not_being_numbers() -> None:
    fault = Bench().see(np.array([np.nan, np.inf]), HOME, valid=(False, True))[1]
    is_fault(fault, "feedback_not_finite", 1)


@pytest.mark.parametrize("joint", [0, 1])
def test_a_frozen_encoder_needs_its_time_and_its_push(joint: int) -> None:
    push = FROZEN_EFFORT * LIMITS.torque * unit(joint)
    bench = Bench()
    assert [bench.see(HOME, correction=0.99 * push)[1] for _ in range(1000)] == [None] * 1000
    assert [bench.see(HOME, correction=1.01 * push)[1] for _ in range(FROZEN_CYCLES - 1)] == [None] * 19
    is_fault(bench.see(HOME, correction=1.01 * push)[1], "frozen_encoder", joint)


@pytest.mark.parametrize("joint", [0, 1])
def test_a_position_that_changes_now_and_then_is_not_frozen(joint: int) -> None:
    # An axis held by dry friction follows in small slips.
    bench, push = Bench(), 5.0 * FROZEN_EFFORT * LIMITS.torque * unit(joint)
    for cycle in range(200):
        position = HOME + 1e-5 * (cycle // (FROZEN_CYCLES - 1))
        assert bench.see(position, correction=push)[1] is None


@pytest.mark.parametrize("joint", [0, 1])
def test_a_push_that_ends_is_forgotten(joint: int) -> None:
    bench, push = Bench(), 1.01 * FROZEN_EFFORT * LIMITS.torque * unit(joint)
    for _ in range(3):
        for _ in range(FROZEN_CYCLES - 1):
            assert bench.see(HOME, correction=push)[1] is None
        assert bench.see(HOME)[1] is None


def test_losing_an_axis_does_not_excuse_a_frozen_one() -> None:
    bench, push = Bench(), 1.01 * FROZEN_EFFORT * LIMITS.torque * unit(1)
    for cycle in range(FROZEN_CYCLES - 1):
        fault = bench.see(HOME, correction=push, valid=(True, cycle % 3 != 0))[1]
        assert fault is None or fault.code == "lost_feedback"
    is_fault(bench.see(HOME, correction=push)[1], "frozen_encoder", 1)


def test_the_most_severe_fault_wins() -> None:
    fast, faster = ((times * 1.01 * LIMITS.velocity) * unit(0) for times in (VELOCITY_STOP, VELOCITY_OFF))
    jump = HOME + 0.5 * unit(1)
    # A jump with a warning's weight beside ever worse things.
    is_fault(Bench().see(jump, HOME, fast)[1], "over_velocity", 0)
    is_fault(Bench().see(jump, HOME, faster)[1], "runaway", 0)
    is_fault(Bench().see(np.array([np.nan, 0.5]), HOME, faster)[1], "feedback_not_finite", 0)
    away = HOME + 1.5 * LIMITS.following_error * unit(0)
    is_fault(Bench().see(HOME + 1e-5, away, fast, (True, False))[1], "over_velocity", 0)
    is_fault(Bench().see(HOME + 1e-5, away, STILL, (True, False))[1], "following_error", 0)


def anything() -> st.SearchStrategy[float]:
    return st.floats(allow_nan=True, allow_infinity=True, width=64)


@settings(max_examples=100)
@given(arrays(float, 2, elements=anything()))
def test_whatever_is_wanted_what_leaves_is_finite_and_limited(wanted: Array) -> None:
    kept = wanted.copy()
    leaves, fault = Bench().guard.limit_torque(wanted)
    assert np.isfinite(leaves).all()
    assert (np.abs(leaves) <= LIMITS.torque).all()
    np.testing.assert_array_equal(wanted, kept)
    if fault is None:
        np.testing.assert_array_equal(leaves, wanted)
    elif fault.reaction is OFF:
        np.testing.assert_array_equal(leaves, 0.0)


@pytest.mark.slow
@settings(max_examples=100)
@given(
    arrays(float, 2, elements=anything()),
    arrays(float, 2, elements=anything()),
    arrays(float, 2, elements=anything()),
    st.tuples(st.booleans(), st.booleans()),
)
def test_whatever_is_seen_the_guard_does_not_fall_over(
    position: Array, reference: Array, velocity: Array, valid: tuple[bool, bool]
) -> None:
    bench = Bench()
    with np.errstate(all="ignore"):
        usable, fault = bench.see(position, reference, velocity, valid)
    bad = ~np.isfinite(position) & np.array(valid)
    if bad.any():
        assert fault is not None
        named = ", ".join(name for name, hit in zip(NAMES, bad, strict=True) if hit)
        assert (fault.code, fault.reaction) == ("feedback_not_finite", OFF)
        assert fault.message.startswith(f"{named}: ")
    else:
        assert not np.array(usable)[~np.array(valid)].any()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_torque_that_is_no_number_becomes_none(bad: float) -> None:
    leaves, fault = Bench().guard.limit_torque(np.array([1.0, bad]))
    np.testing.assert_array_equal(leaves, 0.0)
    is_fault(fault, "torque_not_finite", 1)


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_thresholds_of_torque(joint: int, side: float) -> None:
    guard = Bench().guard
    limit = side * LIMITS.torque * unit(joint)
    assert guard.limit_torque(limit)[1] is None
    for times in (1.001, 0.999 * ABSURD):
        leaves, fault = guard.limit_torque(times * limit)
        is_fault(fault, "torque_saturated", joint)
        np.testing.assert_array_equal(leaves, limit)
    leaves, fault = guard.limit_torque(1.001 * ABSURD * limit)
    is_fault(fault, "torque_absurd", joint)
    np.testing.assert_array_equal(leaves, 0.0)
    assert guard.warnings == {"torque_saturated": 2}


def test_a_moving_reference_is_compared_by_its_position_only() -> None:
    moving = Setpoint(HOME, LIMITS.velocity, LIMITS.acceleration)
    sample = Sample(0, 0, HOME.copy(), None, np.zeros(2), np.ones(2, dtype=bool), np.zeros(2, dtype=np.int64))
    assert Bench().guard.check_feedback(sample, moving, STILL, STILL)[1] is None


@pytest.mark.parametrize(("share", "frozen"), [(0.99, False), (1.01, True)])
@pytest.mark.parametrize("joint", [0, 1])
def test_an_encoder_that_stops_in_full_motion_is_frozen(joint: int, share: float, frozen: bool) -> None:
    bench, velocity = Bench(), share * SUDDEN_SPEED * LIMITS.velocity * unit(joint)
    assert bench.see(HOME + 1e-5, velocity=velocity)[1] is None
    for _ in range(SUDDEN_CYCLES - 1):
        assert bench.see(HOME + 1e-5, velocity=velocity)[1] is None
    fault = bench.see(HOME + 1e-5, velocity=velocity)[1]
    assert (fault is not None) == frozen
    if fault is not None:
        is_fault(fault, "frozen_encoder", joint)
    # A step forgives.
    assert bench.see(HOME + 2e-5, velocity=velocity)[1] is None


@pytest.mark.parametrize(("first", "then", "frozen"), [(1.01, 0.0, True), (0.0, 1.01, False)])
@pytest.mark.parametrize("joint", [0, 1])
def test_what_counts_is_the_motion_in_which_an_encoder_stopped(
    joint: int, first: float, then: float, frozen: bool
) -> None:
    bench, fast = Bench(), SUDDEN_SPEED * LIMITS.velocity * unit(joint)
    assert bench.see(HOME + 1e-5, velocity=fast)[1] is None
    faults = [bench.see(HOME + 1e-5, velocity=first * fast)[1]]
    faults += [bench.see(HOME + 1e-5, velocity=then * fast)[1] for _ in range(SUDDEN_CYCLES - 1)]
    assert faults[:-1] == [None] * (SUDDEN_CYCLES - 1)
    assert (faults[-1] is not None) == frozen


@pytest.mark.parametrize("joint", [0, 1])
def test_a_measured_torque_is_compared_after_a_lost_sample_as_before(joint: int) -> None:
    bench, allowed = Bench(), NOT_APPLIED * LIMITS.torque * unit(joint)
    bench.see(HOME, valid=(joint != 0, joint != 1), torque_difference=STILL)
    assert bench.see(HOME, torque_difference=0.99 * allowed)[1] is None
    bench.see(HOME, valid=(joint != 0, joint != 1), torque_difference=STILL)
    is_fault(bench.see(HOME, torque_difference=1.01 * allowed)[1], "torque_not_applied", joint)
