"""A whole run on the simulated arm: as it should go, and with everything going wrong that can."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from motion_bench import JOINTS, LOOKED, PRIOR, Story, WatchedArm, bench_excitation, bench_limits, bench_model, watched

from drivers.arm import Sample, StopKind
from ident_service.errors import ArmFault, DriverError, MotionRefused
from ident_service.excitation.fourier import Excitation
from ident_service.motion.control import ComputedTorque
from ident_service.motion.guard import FROZEN_CYCLES, JUMP
from ident_service.motion.run import RunReport, run
from ident_service.motion.states import State
from sim_backend.arm import Truth
from sim_backend.faults import Fault, FaultKind

Array = np.ndarray
LIMITS = bench_limits()
HOME = LIMITS.home
MOTION = bench_excitation()
PERIOD = 1e-3
MIDWAY = 900  # a cycle in the middle of the excitation, both joints moving
FOREVER = 10**6


@dataclass
class Bench:
    """An open arm, the truth about it, and what a run makes of it."""

    arm: WatchedArm
    truth: list[Truth]
    story: Story = field(default_factory=Story)
    model: Any = field(default_factory=bench_model)

    def run(self, stop_requested: Callable[[], bool] = lambda: False, motion: Excitation = MOTION) -> RunReport:
        """Run; whatever comes of it, no torque was too large and none is left."""
        try:
            return run(self.arm, self.model, motion, self.story, stop_requested)
        finally:
            assert all((np.abs(torque) <= LIMITS.torque).all() for torque in self.arm.torques)
            self.arm.inner.faults = ()  # mended, to see what is left of the run
            with pytest.raises(DriverError, match="not enabled"):
                self.arm.inner.exchange(np.zeros(2))
            np.testing.assert_array_equal(self.arm.inner.exchange(None).torque, 0.0)
            self.truth.pop()

    def fault(self, **options: Any) -> ArmFault:
        """Run into a fault."""
        with pytest.raises(ArmFault) as caught:
            self.run(**options)
        return caught.value

    def stopped_under_control(self) -> None:
        """All joints were brought to rest together with the loop closed, within every limit."""
        assert self.story.states[-2:] == ["stopping", "stopped"]
        begin = next(stamp for stamp, _, message in self.story.events if message == "stopping")
        reference = self.story.column("reference_velocity")[self.story.column("stamp_ns") >= begin]
        assert (np.abs(reference) <= LIMITS.velocity).all()
        assert (np.abs(np.diff(reference, axis=0)) <= LIMITS.acceleration * PERIOD * 1.001).all()
        assert np.abs(reference[0]).max() > 0.2
        # The last setpoint recorded is one cycle short of rest.
        assert (np.abs(reference[-1]) <= LIMITS.acceleration * PERIOD).all()
        position = np.array([truth.position for truth in self.truth])
        assert ((LIMITS.lower <= position) & (position <= LIMITS.upper)).all()
        speeds = np.abs([truth.velocity for truth in self.truth])
        assert (speeds <= LIMITS.velocity).all()
        assert (speeds[-1] < 0.15).all()
        held = self.story.column("reference_position")[-1]
        assert (np.abs(held - position[-1]) < 0.25 * LIMITS.following_error).all()

    def nothing_was_enabled(self) -> None:
        assert self.arm.enabled == 0
        assert self.arm.torques == []
        assert self.story.events == []
        assert self.story.samples == []


@pytest.fixture
def make() -> Iterator[Callable[..., Bench]]:
    arms: list[WatchedArm] = []

    def build(*faults: Fault, **changes: Any) -> Bench:
        truth: list[Truth] = []
        arm = watched(faults, truth.append, **changes)
        arm.open()
        arms.append(arm)
        return Bench(arm, truth)

    yield build
    for arm in arms:
        arm.close()


def test_a_run_goes_out_and_comes_back(make: Callable[..., Bench]) -> None:
    bench = make()
    report = bench.run()
    assert report.state is State.DONE
    assert bench.story.states == ["approaching", "exciting", "returning", "done"]
    assert bench.story.errors == []
    assert report.warnings == {}
    np.testing.assert_allclose(bench.truth[0].position, HOME, atol=1e-9)
    assert (np.abs(bench.truth[-1].position - HOME) < 0.25 * LIMITS.following_error).all()
    cycles = bench.story.column("cycle")
    np.testing.assert_array_equal(cycles, np.arange(LOOKED, report.cycles - 1))
    np.testing.assert_array_equal(np.diff(bench.story.column("stamp_ns")), 1_000_000)
    assert bench.story.column("valid").all()
    assert not bench.story.column("lateness_ns").any()


def test_the_recorded_reference_is_the_excitation(make: Callable[..., Bench]) -> None:
    bench = make()
    bench.run()
    position, velocity = bench.story.column("reference_position"), bench.story.column("reference_velocity")
    np.testing.assert_allclose(position[0], HOME, atol=1e-9)
    told = {message: stamp for stamp, _, message in bench.story.events}
    stamps = bench.story.column("stamp_ns")
    exciting = (stamps >= told["exciting"]) & (stamps < told["returning"])
    assert np.count_nonzero(exciting) == pytest.approx(MOTION.duration / PERIOD, abs=1)
    # The excitation begins between two stamps: as much later as the approach is no whole number of cycles.
    first = stamps[exciting][0]
    offset = min(
        np.linspace(0.0, PERIOD, 1001),
        key=lambda late: float(np.abs(MOTION.series.at(late)[0] - position[exciting][0]).max()),
    )
    expected = MOTION.series.at((stamps[exciting] - first) * 1e-9 + offset)
    np.testing.assert_allclose(position[exciting], expected[0], atol=1e-5)
    np.testing.assert_allclose(velocity[exciting], expected[1], atol=1e-4)
    # No step anywhere, at the seams neither.
    assert (np.abs(np.diff(position, axis=0)) <= LIMITS.velocity * PERIOD).all()
    assert (np.abs(np.diff(velocity, axis=0)) <= LIMITS.acceleration * PERIOD * 1.001).all()


def test_the_report_says_what_was_recorded(make: Callable[..., Bench]) -> None:
    bench = make()
    report = bench.run()
    torque, position = bench.story.column("torque"), bench.story.column("position")
    np.testing.assert_array_equal(report.peak_torque, np.abs(torque).max(axis=0))
    error = np.abs(bench.story.column("reference_position") - position).max(axis=0)
    np.testing.assert_array_equal(report.peak_following_error, error)
    assert (error > 1e-4).all()
    assert (error < 0.5 * LIMITS.following_error).all()


def test_what_is_recorded_is_the_torque_that_acted(make: Callable[..., Bench]) -> None:
    bench = make()
    bench.run()
    acted = np.array([truth.torque for truth in bench.truth])[LOOKED : LOOKED + len(bench.story.samples)]
    np.testing.assert_array_equal(bench.story.column("torque"), acted)


def test_an_arm_that_has_nowhere_to_go_is_done_at_once(make: Callable[..., Bench]) -> None:
    series = replace(MOTION.series.scaled(0.0), q0=HOME.copy())
    bench = make(driver={"kind": "simulated", "truth": PRIOR})
    report = bench.run(motion=replace(MOTION, series=series))
    assert report.state is State.DONE
    assert (report.peak_following_error < 1e-3).all()


def test_two_runs_are_the_same_to_the_last_bit(make: Callable[..., Bench]) -> None:
    one, other = make(), make()
    one.run()
    other.run()
    for name in ("position", "torque", "reference_position"):
        np.testing.assert_array_equal(one.story.column(name), other.story.column(name))


def test_enabling_may_take_its_time(make: Callable[..., Bench]) -> None:
    bench = make()
    clock = bench.arm.clock
    # The stamps jump by what enabling took, as they do on a bus.
    late = 700_000_000
    bench.arm.after_enable = lambda: clock.sleep_until_ns(clock.now_ns() + late)
    shift: Callable[[Sample], Sample] = lambda sample: replace(sample, stamp_ns=sample.stamp_ns + late)  # noqa: E731
    bench.arm.before_exchange = lambda cycle: setattr(bench.arm, "shown", shift) if cycle == LOOKED else None
    assert bench.run().state is State.DONE
    np.testing.assert_allclose(bench.story.samples[0]["reference_position"], HOME, atol=1e-9)
    steps = np.abs(np.diff(bench.story.column("reference_position"), axis=0))
    assert (steps <= LIMITS.velocity * PERIOD).all()


# Faults of the arm ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("joint", [0, 1, None])
@pytest.mark.parametrize("cycles", [1, 2])
def test_feedback_lost_for_a_moment_is_bridged(make: Callable[..., Bench], joint: int | None, cycles: int) -> None:
    healthy, bench = make(), make(Fault(MIDWAY, FaultKind.LOST_FEEDBACK, joint, cycles))
    expected = healthy.run()
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


@pytest.mark.parametrize("joint", [0, 1])
def test_one_encoder_jump_is_passed_over(make: Callable[..., Bench], joint: int) -> None:
    healthy, bench = make(), make(Fault(MIDWAY, FaultKind.ENCODER_JUMP, joint, 1, 1.0))
    expected = healthy.run()
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
@pytest.mark.parametrize("begin", [600, MIDWAY, 1300])
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
    assert report.warnings == {}


@pytest.mark.parametrize("joint", [0, 1, None])
def test_a_position_that_is_no_number_takes_the_torque(make: Callable[..., Bench], joint: int | None) -> None:
    bench = make(Fault(MIDWAY, FaultKind.NAN_POSITION, joint))
    error = bench.fault()
    assert error.code == "feedback_not_finite"
    assert bench.story.column("cycle")[-1] == MIDWAY
    assert len(bench.arm.torques) == MIDWAY - LOOKED + 1


@pytest.mark.parametrize("joint", [0, 1])
def test_a_drive_that_is_stuck_is_noticed(make: Callable[..., Bench], joint: int) -> None:
    bench = make(Fault(MIDWAY, FaultKind.STUCK_TORQUE, joint, FOREVER))
    error = bench.fault()
    # What the arm does without one of its drives is for physics to say; that it is seen to do it, for the guard.
    assert error.code in {"over_velocity", "runaway", "following_error", "torque_absurd"}
    position = np.array([truth.position for truth in bench.truth])
    assert ((LIMITS.lower < position) & (position < LIMITS.upper)).all()


def test_a_drive_that_is_stuck_for_a_moment_is_only_felt(make: Callable[..., Bench]) -> None:
    assert make(Fault(MIDWAY, FaultKind.STUCK_TORQUE, None, 5)).run().state is State.DONE


@pytest.mark.parametrize("begin", [LOOKED, 300, MIDWAY, 1900])
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


def test_every_fault_of_the_simulator_is_tried() -> None:
    tried = {kind for kind in FaultKind if f"FaultKind.{kind.name}" in _source()}
    assert tried == set(FaultKind)


@pytest.mark.parametrize(
    ("gap", "told"), [(0, "0 ms"), (-1_000_000, "-1 ms"), (25_000_000, "25 ms"), (10**10, "10000 ms")]
)
def test_stamps_that_do_not_go_on_as_they_should_end_the_run(make: Callable[..., Bench], gap: int, told: str) -> None:
    bench = make()

    def shown(sample: Sample) -> Sample:
        return sample if sample.cycle != MIDWAY else replace(sample, stamp_ns=sample.stamp_ns - 1_000_000 + gap)

    bench.arm.shown = shown
    error = bench.fault()
    assert error.code == "driver"
    assert told in str(error)
    assert bench.story.states == ["approaching", "exciting", "faulted"]


def test_a_fault_carries_the_last_samples(make: Callable[..., Bench]) -> None:
    bench = make(Fault(MIDWAY, FaultKind.NAN_POSITION, 0))
    samples = bench.fault().samples
    assert [sample.cycle for sample in samples] == list(range(MIDWAY - 99, MIDWAY + 1))  # type: ignore[attr-defined]
    assert np.isnan(samples[-1].position[0])  # type: ignore[attr-defined]


@pytest.mark.parametrize("begin", [100, 1900])
def test_the_way_out_and_the_way_back_are_guarded_too(make: Callable[..., Bench], begin: int) -> None:
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


# Faults of everything else -------------------------------------------------------------------------------------------


def test_a_recorder_that_is_behind_stops_the_arm(make: Callable[..., Bench]) -> None:
    bench = make()
    bench.story.misbehave = lambda count: count < 850
    error = bench.fault()
    assert error.code == "recorder_behind"
    bench.stopped_under_control()


def test_a_warning_does_not_hide_that_the_recorder_is_behind(make: Callable[..., Bench]) -> None:
    bench = make(Fault(LOOKED + 849, FaultKind.LOST_FEEDBACK, 0))
    bench.story.misbehave = lambda count: count != 850
    assert bench.fault().code == "recorder_behind"
    bench.stopped_under_control()


@pytest.mark.parametrize("error", [OSError("disk full"), ValueError("no"), RuntimeError()])
def test_a_recorder_that_fails_stops_the_arm_under_control(make: Callable[..., Bench], error: Exception) -> None:
    bench = make()

    def fail(count: int) -> bool:
        if count >= 850:
            raise error
        return True

    bench.story.misbehave = fail
    fault = bench.fault()
    assert fault.code == "recorder_behind"
    assert str(error) in str(fault)
    bench.stopped_under_control()


def test_events_that_cannot_be_kept_end_nothing(make: Callable[..., Bench]) -> None:
    bench = make()

    def fail(message: str) -> None:
        raise OSError(message)

    bench.story.at_event = fail
    assert bench.run().state is State.DONE
    assert bench.story.events == []


@pytest.mark.parametrize("cycle", [250, MIDWAY, 1500])
def test_a_stop_that_is_asked_for_is_controlled(make: Callable[..., Bench], cycle: int) -> None:
    bench = make()
    report = bench.run(lambda: len(bench.story.samples) >= cycle - LOOKED)
    assert report.state is State.STOPPED
    assert bench.story.errors == []
    bench.stopped_under_control()


def test_a_stop_before_the_first_cycle_moves_nothing(make: Callable[..., Bench]) -> None:
    bench = make()
    assert bench.run(lambda: True).state is State.STOPPED
    assert bench.story.states == ["approaching", "stopping", "stopped"]
    assert (np.abs(bench.truth[-1].position - HOME) < 1e-3).all()


def test_a_fault_during_a_stop_that_was_asked_for_is_not_swallowed(make: Callable[..., Bench]) -> None:
    bench = make(Fault(MIDWAY + 20, FaultKind.ENCODER_JUMP, 0, 2, 1.0))
    error = bench.fault(stop_requested=lambda: len(bench.story.samples) >= MIDWAY - LOOKED)
    assert error.code == "encoder_jumps"
    assert bench.story.states[-2:] == ["stopping", "stopped"]
    assert bench.story.errors == [str(error)]


def test_an_arm_that_cannot_be_enabled_is_left_without_torque(make: Callable[..., Bench]) -> None:
    bench = make()
    bench.arm.enable_error = DriverError("drive 3 does not answer")
    with pytest.raises(DriverError, match="drive 3"):
        bench.run()
    assert bench.arm.stops == [StopKind.TORQUE_OFF]
    assert bench.arm.torques == []
    assert bench.story.states == ["faulted"]


class _Broken(Exception):
    pass


def test_a_mistake_in_the_control_law_takes_the_torque(
    make: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench, law = make(), ComputedTorque.torque

    def broken(self: ComputedTorque, *arguments: Any) -> Array:
        if len(bench.arm.torques) > 500:
            raise _Broken
        return law(self, *arguments)

    monkeypatch.setattr(ComputedTorque, "torque", broken)
    with pytest.raises(_Broken):
        bench.run()
    assert bench.arm.stops == [StopKind.TORQUE_OFF]
    assert bench.story.states[-1] == "faulted"
    assert bench.story.errors == ["_Broken"]


@pytest.mark.parametrize(
    ("wrong", "code"), [(np.nan, "torque_not_finite"), (np.inf, "torque_not_finite"), (1e3, "torque_absurd")]
)
def test_an_impossible_torque_never_leaves(
    make: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch, wrong: float, code: str
) -> None:
    bench, law = make(), ComputedTorque.torque

    def broken(self: ComputedTorque, *arguments: Any) -> Array:
        torque = law(self, *arguments)
        return np.array([torque[0], wrong]) if len(bench.arm.torques) == 500 else torque

    monkeypatch.setattr(ComputedTorque, "torque", broken)
    error = bench.fault()
    assert error.code == code
    assert "elbow" in str(error)
    assert len(bench.arm.torques) == 500


def test_a_torque_beyond_the_limit_is_clipped_and_counted(
    make: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench, law = make(), ComputedTorque.torque

    def strong(self: ComputedTorque, *arguments: Any) -> Array:
        torque = law(self, *arguments)
        return 2.0 * LIMITS.torque if len(bench.arm.torques) in (500, 501) else torque

    monkeypatch.setattr(ComputedTorque, "torque", strong)
    report = bench.run()
    assert report.state is State.DONE
    assert report.warnings == {"torque_saturated": 2}
    np.testing.assert_array_equal(report.peak_torque, LIMITS.torque)


@pytest.mark.parametrize("where", ["sample", "event", "exchange", "enable"])
def test_an_interrupt_takes_the_torque(make: Callable[..., Bench], where: str) -> None:
    bench = make()

    def interrupt(*_: Any) -> bool:
        raise KeyboardInterrupt

    def later(count: int) -> bool:
        return interrupt() if count == 850 else True

    if where == "sample":
        bench.story.misbehave = later
    elif where == "event":
        bench.story.at_event = lambda message: interrupt() and None if message == "exciting" else None
    elif where == "exchange":
        bench.arm.before_exchange = lambda cycle: later(cycle) and None
    else:
        bench.arm.after_enable = lambda: interrupt() and None
    with pytest.raises(KeyboardInterrupt):
        bench.run()
    assert bench.arm.stops == [StopKind.TORQUE_OFF]
    assert bench.story.states[-1] == "faulted"


def test_torque_is_taken_before_anything_is_told(make: Callable[..., Bench]) -> None:
    bench = make(Fault(MIDWAY, FaultKind.NAN_POSITION, 0))
    stops: dict[str, int] = {}
    bench.story.at_event = lambda message: stops.setdefault(message, len(bench.arm.stops)) and None
    bench.fault()
    assert stops["exciting"] == 0
    assert stops["faulted"] == 1


@pytest.mark.parametrize("stop_error", [DriverError("bus is gone"), ZeroDivisionError("driver")])
def test_a_stop_that_raises_hides_nothing(make: Callable[..., Bench], stop_error: Exception) -> None:
    bench = make(Fault(MIDWAY, FaultKind.NAN_POSITION, 0))
    bench.arm.stop_error = stop_error
    error = bench.fault()
    assert error.code == "feedback_not_finite"
    assert any(str(stop_error) in note for note in error.__notes__)
    assert bench.story.states[-1] == "faulted"


def test_a_run_whose_torque_cannot_be_taken_is_not_done(make: Callable[..., Bench]) -> None:
    bench = make()
    bench.arm.stop_error = DriverError("bus is gone")
    with pytest.raises(DriverError, match="bus is gone"):
        bench.run()


# Refusals ------------------------------------------------------------------------------------------------------------


def _stand_at(bench: Bench, position: Array) -> None:
    bench.arm.shown = lambda sample: replace(sample, position=position)


def _refused(bench: Bench, match: str, motion: Excitation = MOTION) -> None:
    with pytest.raises(MotionRefused, match=match):
        run(bench.arm, bench.model, motion, bench.story)
    bench.nothing_was_enabled()


@pytest.mark.parametrize("joint", [0, 1])
def test_no_run_begins_outside_the_limits(make: Callable[..., Bench], joint: int) -> None:
    bench = make()
    _stand_at(bench, np.where(np.eye(2)[joint] > 0.0, LIMITS.upper + 0.01, HOME))
    _refused(bench, f"outside the position limits: {('shoulder', 'elbow')[joint]}")


def test_no_run_begins_while_the_arm_moves(make: Callable[..., Bench]) -> None:
    bench = make()
    speed = 0.06 * LIMITS.velocity * np.array([0.0, 1.0])
    bench.arm.shown = lambda sample: replace(sample, position=HOME + sample.cycle * PERIOD * speed)
    _refused(bench, "moving")


def test_a_crawl_within_encoder_noise_is_rest(make: Callable[..., Bench]) -> None:
    bench = make()
    bench.arm.shown = lambda sample: replace(sample, position=sample.position + 1e-5 * (sample.cycle % 2))
    assert bench.run().state is State.DONE


@pytest.mark.parametrize("cycle", [0, 7, LOOKED - 1])
def test_no_run_begins_while_an_axis_is_silent(make: Callable[..., Bench], cycle: int) -> None:
    _refused(make(Fault(cycle, FaultKind.LOST_FEEDBACK, 1)), "not every axis answers")


@pytest.mark.parametrize("cycle", [0, 7, LOOKED - 1])
def test_no_run_begins_where_a_position_is_no_number(make: Callable[..., Bench], cycle: int) -> None:
    _refused(make(Fault(cycle, FaultKind.NAN_POSITION, 0)), "not every axis answers")


def test_no_run_begins_without_prior_parameters(make: Callable[..., Bench]) -> None:
    bench = make()
    bench.model = bench_model(prior=None)
    _refused(bench, "prior parameters")


@pytest.mark.parametrize(
    "key", ["position", "velocity", "acceleration", "jerk", "torque", "following_error", "kp", "kd"]
)
def test_no_run_begins_without_its_limits(make: Callable[..., Bench], key: str) -> None:
    bench = make()
    elbow = {name: value for name, value in JOINTS["elbow"].items() if name not in (key, "home")}
    bench.model = bench_model(joints=JOINTS | {"elbow": elbow})
    _refused(bench, rf"joints\.elbow\.{key}")


def test_no_run_begins_that_cannot_reach_its_motion(make: Callable[..., Bench]) -> None:
    series = replace(MOTION.series.scaled(0.0), q0=LIMITS.upper + 0.1)
    _refused(make(), "leaves the arm's limits", replace(MOTION, series=series))


def test_no_run_begins_where_the_arm_cannot_be_held(make: Callable[..., Bench]) -> None:
    bench = make()
    bench.model = bench_model(prior=PRIOR | {"m2": 10.0, "lx2": -2.5, "Lyy2": 0.84, "Lzz2": 0.84})
    # A motion that the arm could make if it were light enough where it stands now.
    series = replace(MOTION.series.scaled(0.0), q0=np.array([0.0, np.pi / 2]))
    motion = replace(MOTION, arm_sha256=bench.model.config.sha256, series=series)
    _refused(bench, "cannot be held|leaves the arm's limits: .*torque", motion)


def test_no_run_begins_with_a_motion_made_for_another_arm(make: Callable[..., Bench]) -> None:
    _refused(make(), "made for another description", replace(MOTION, arm_sha256="0" * 64))


def test_a_bus_that_is_silent_from_the_start_is_told_as_such(make: Callable[..., Bench]) -> None:
    bench = make(Fault(3, FaultKind.BUS_GONE))
    with pytest.raises(DriverError, match="bus is gone"):
        run(bench.arm, bench.model, MOTION, bench.story)
    bench.nothing_was_enabled()


def _source() -> str:
    return Path(__file__).read_text(encoding="utf-8")
