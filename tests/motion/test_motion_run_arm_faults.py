"""A run on an arm with everything going wrong that can."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from motion_bench import LOOKED
from run_bench import FOREVER, LIMITS, MIDWAY, PERIOD, Bench, Healthy

from drivers.arm import Sample
from ident_service.motion.safety_monitor import FROZEN_CYCLES, JUMP
from ident_service.motion.state_machine import State
from sim_backend.faults import Fault, FaultKind

pytestmark = pytest.mark.slow  # whole runs

Array = np.ndarray


@pytest.mark.parametrize("joint", [0, 1, None])
@pytest.mark.parametrize("cycles", [1, 2])
def test_feedback_lost_for_a_moment_is_bridged(
    make: Callable[..., Bench], healthy: Healthy, joint: int | None, cycles: int
) -> None:
    bench, expected = make(Fault(MIDWAY, FaultKind.LOST_FEEDBACK, joint, cycles)), healthy.report
    report = bench.run()
    assert report.state is State.DONE
    assert report.warnings == {"lost_feedback": cycles}
    assert (report.peak_following_error < expected.peak_following_error + 1e-3).all()
    assert (report.peak_torque < 1.1 * expected.peak_torque).all()


@pytest.mark.parametrize("joint", [0, 1, None])
def test_feedback_gone_takes_the_torque(make: Callable[..., Bench], joint: int | None) -> None:
    bench = make(Fault(MIDWAY, FaultKind.LOST_FEEDBACK, joint, FOREVER))
    error = bench.fault()
    assert error.code == "feedback_gone"
    assert bench.story.states[-1] == "faulted"
    assert bench.story.errors == [str(error)]
    assert bench.story.column("cycle")[-1] == MIDWAY + 2


def test_a_drive_that_lets_go_before_the_first_sample_ends_the_run(make: Callable[..., Bench]) -> None:
    bench = make()
    arm = bench.arm
    arm.shown = lambda sample: replace(sample, status=(sample.status[0], 0)) if arm.torques else sample
    error = bench.fault()
    assert error.code == "drive_fault"
    assert str(error).startswith("drive_fault: elbow: the drive is not energised")
    assert len(arm.torques) == arm.describe().lost_cycles + 1


@pytest.mark.parametrize("joint", [0, 1])
def test_one_encoder_jump_is_passed_over(make: Callable[..., Bench], healthy: Healthy, joint: int) -> None:
    bench, expected = make(Fault(MIDWAY, FaultKind.ENCODER_JUMP, joint, 1, 1.0)), healthy.report
    report = bench.run()
    assert report.state is State.DONE
    assert report.warnings == {"encoder_jump": 1}
    assert (report.peak_following_error < expected.peak_following_error + 1e-3).all()
    assert (report.peak_torque < 1.1 * expected.peak_torque).all()


@pytest.mark.parametrize("joint", [0, 1])
def test_two_encoder_jumps_in_a_row_stop_the_arm(make: Callable[..., Bench], joint: int) -> None:
    bench = make(Fault(MIDWAY, FaultKind.ENCODER_JUMP, joint, 2, 1.0))
    error = bench.fault()
    assert error.code == "encoder_jumps"
    assert bench.story.errors == [str(error)]
    bench.stopped_under_control()


@pytest.mark.parametrize("times", [1.2, 1.5, 100.0])
def test_an_encoder_that_stays_wrong_never_steers_the_arm(make: Callable[..., Bench], times: float) -> None:
    size = times * JUMP * LIMITS.velocity[0] * PERIOD
    bench = make(Fault(MIDWAY, FaultKind.ENCODER_JUMP, 0, FOREVER, size))
    error = bench.fault()
    # The stop that the second jump began cannot be kept up without the axis.
    assert error.code == "feedback_gone"
    assert bench.story.states[-2:] == ["stopping", "faulted"]
    assert len(bench.story.errors) == 2
    assert bench.story.column("cycle")[-1] == MIDWAY + 2


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("begin", [300, MIDWAY, 650])
def test_a_frozen_encoder_takes_the_torque_in_time(make: Callable[..., Bench], joint: int, begin: int) -> None:
    bench = make(Fault(begin, FaultKind.FROZEN_ENCODER, joint, FOREVER))
    error = bench.fault()
    assert error.code == "frozen_encoder"
    assert bench.story.states[-1] == "faulted"
    # Nothing but the true arm knows how fast it has become.
    speeds = np.abs([truth.velocity for truth in bench.truth])
    assert (speeds <= LIMITS.velocity).all()


def test_an_encoder_frozen_for_a_moment_is_nothing(make: Callable[..., Bench]) -> None:
    report = make(Fault(MIDWAY, FaultKind.FROZEN_ENCODER, 1, FROZEN_CYCLES // 4)).run()
    assert report.state is State.DONE
    # The velocity jumps when the position moves on.
    assert set(report.warnings) <= {"torque_rate"}


@pytest.mark.parametrize("joint", [0, 1, None])
def test_a_position_that_is_no_number_takes_the_torque(make: Callable[..., Bench], joint: int | None) -> None:
    bench = make(Fault(MIDWAY, FaultKind.NAN_POSITION, joint))
    error = bench.fault()
    assert error.code == "feedback_not_finite"
    assert bench.story.column("cycle")[-1] == MIDWAY
    assert len(bench.arm.torques) == MIDWAY - LOOKED + 1
    # What is recorded can be read.
    struck = slice(None) if joint is None else joint
    position = bench.story.column("position")
    np.testing.assert_array_equal(position[-1][struck], position[-2][struck])
    assert not bench.story.column("valid")[-1][struck].any()


@pytest.mark.parametrize("joint", [0, 1])
def test_a_drive_that_is_stuck_is_noticed(make: Callable[..., Bench], joint: int) -> None:
    bench = make(Fault(MIDWAY + 20, FaultKind.STUCK_TORQUE, joint, FOREVER))
    error = bench.fault()
    # What the arm does without one of its drives is for physics to say; that it is seen to do it, for the guard.
    assert error.code in {"over_velocity", "runaway", "following_error", "torque_absurd"}
    position = np.array([truth.position for truth in bench.truth])
    assert ((LIMITS.lower < position) & (position < LIMITS.upper)).all()


def test_a_drive_that_is_stuck_for_a_moment_is_only_felt(make: Callable[..., Bench]) -> None:
    assert make(Fault(MIDWAY, FaultKind.STUCK_TORQUE, None, 5)).run().state is State.DONE


@pytest.mark.parametrize("begin", [LOOKED, 150, MIDWAY, 950])
def test_a_bus_that_is_gone_ends_the_run(make: Callable[..., Bench], begin: int) -> None:
    bench = make(Fault(begin, FaultKind.BUS_GONE, duration=FOREVER))
    error = bench.fault()
    assert error.code == "driver"
    assert "bus is gone" in str(error)
    assert bench.story.states[-1] == "faulted"
    assert bench.story.errors == [str(error)]


def test_a_late_cycle_is_recorded_as_late(make: Callable[..., Bench]) -> None:
    bench = make(Fault(MIDWAY, FaultKind.LATE_CYCLE, size=0.4e-3))
    assert bench.run().state is State.DONE
    lateness = {sample["cycle"]: sample["lateness_ns"] for sample in bench.story.samples}
    assert lateness[MIDWAY] == 400_000
    assert sum(late > 0 for late in lateness.values()) == 1


@pytest.mark.parametrize(
    ("gap", "told"), [(0, "0 ms"), (-1_000_000, "-1 ms"), (50_000_000, "50 ms"), (10**10, "10000 ms")]
)
def test_stamps_that_do_not_go_on_as_they_should_end_the_run(make: Callable[..., Bench], gap: int, told: str) -> None:
    bench = make()

    def shown(sample: Sample) -> Sample:
        return (
            sample if sample.cycle != MIDWAY else replace(sample, stamp_ns=sample.stamp_ns - round(PERIOD * 1e9) + gap)
        )

    bench.arm.shown = shown
    error = bench.fault()
    assert error.code == "clock_jump"
    assert told in str(error)
    assert bench.story.states == ["checked", "armed", "approaching", "exciting", "faulted"]


def test_a_fault_carries_the_last_samples(make: Callable[..., Bench]) -> None:
    bench = make(Fault(MIDWAY, FaultKind.NAN_POSITION, 0))
    samples = bench.fault().samples
    assert [sample.cycle for sample in samples] == list(range(MIDWAY - 99, MIDWAY + 1))  # type: ignore[attr-defined]
    assert np.isnan(samples[-1].position[0])  # type: ignore[attr-defined]


@pytest.mark.parametrize("begin", [50, 950])
def test_approach_and_return_are_guarded_too(make: Callable[..., Bench], begin: int) -> None:
    bench = make(Fault(begin, FaultKind.NAN_POSITION, 1))
    assert bench.fault().code == "feedback_not_finite"
    assert bench.story.states[-2] == ("approaching" if begin < MIDWAY else "returning")


def test_a_stop_is_guarded_too(make: Callable[..., Bench]) -> None:
    bench = make(
        Fault(MIDWAY, FaultKind.ENCODER_JUMP, 0, 2, 1.0),
        Fault(MIDWAY + 20, FaultKind.NAN_POSITION, 1),
    )
    assert bench.fault().code == "feedback_not_finite"
    assert bench.story.states[-2:] == ["stopping", "faulted"]
