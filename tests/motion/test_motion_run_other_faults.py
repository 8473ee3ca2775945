"""A run in which the recorder, the operator, the drives or the program get in the way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from motion_bench import LOOKED
from run_bench import HOME, LIMITS, MIDWAY, PERIOD, Bench

from drivers.arm import Sample, StopKind
from drivers.axis_status import AxisEvent, AxisEventCode
from ident_service.errors import DriveFaulted, DriverError, MotionRefused
from ident_service.motion.controller import ComputedTorque
from ident_service.motion.safety_monitor import TORQUE_RATE, TORQUE_RATE_SHARE
from ident_service.motion.state_machine import State
from sim_backend.faults import Fault, FaultKind

pytestmark = pytest.mark.slow  # whole runs

Array = np.ndarray


def test_a_recorder_that_is_behind_stops_the_arm(make: Callable[..., Bench]) -> None:
    bench = make()
    bench.story.misbehave = lambda count: count < 425
    error = bench.fault()
    assert error.code == "recorder_behind"
    bench.stopped_under_control()


def test_a_recorder_that_knows_why_says_why(make: Callable[..., Bench]) -> None:
    bench = make()
    bench.story.misbehave = lambda count: count < 425
    bench.story.error = "the recorder's process died"
    fault = bench.fault()
    assert fault.code == "recorder_behind"
    assert "the recorder's process died" in str(fault)
    assert "cannot keep up" not in str(fault)


def test_a_warning_does_not_hide_that_the_recorder_is_behind(make: Callable[..., Bench]) -> None:
    bench = make(Fault(LOOKED + 424, FaultKind.LOST_FEEDBACK, 0))
    bench.story.misbehave = lambda count: count != 425
    assert bench.fault().code == "recorder_behind"
    bench.stopped_under_control()


@pytest.mark.parametrize("error", [OSError("disk full"), ValueError("no"), RuntimeError()])
def test_a_recorder_that_fails_stops_the_arm_under_control(make: Callable[..., Bench], error: Exception) -> None:
    bench = make()

    def fail(count: int) -> bool:
        if count >= 425:
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


def test_every_notice_of_a_drive_is_reported_and_recorded_and_stops_nothing(make: Callable[..., Bench]) -> None:
    bench, words = make(), ["node 1: FF01h one", "node 2: FF02h another"]
    cycles = {MIDWAY: words[0], MIDWAY + 150: words[1]}

    def informs(sample: Sample) -> Sample:
        said = cycles.get(sample.cycle)
        return sample if said is None else replace(sample, events=(AxisEvent(AxisEventCode.DRIVE_NOTICE, None, said),))

    bench.arm.shown = informs
    report = bench.run()
    assert (report.state, report.warnings["drive_notice"]) == (State.DONE, 2)
    told = [message for _, _, message in bench.story.events if message.startswith("drive_notice: ")]
    assert len(told) == 2
    assert all(said in message for said, message in zip(words, told, strict=True))


@pytest.mark.parametrize("cycle", [125, MIDWAY, 750])
def test_a_stop_that_is_requested_is_controlled(make: Callable[..., Bench], cycle: int) -> None:
    bench = make()
    report = bench.run(lambda: len(bench.story.samples) >= cycle - LOOKED)
    assert report.state is State.STOPPED
    assert bench.story.errors == []
    bench.stopped_under_control()


def test_a_stop_before_the_first_cycle_energises_nothing(make: Callable[..., Bench]) -> None:
    bench = make()
    with pytest.raises(MotionRefused, match="a stop was requested before the arm was energised"):
        bench.run(lambda: True)
    assert bench.story.states == []
    assert bench.arm.torques == []


def test_a_stop_in_the_first_cycle_holds_the_arm_where_it_stands(make: Callable[..., Bench]) -> None:
    bench, asked = make(), iter([False])
    assert bench.run(lambda: next(asked, True)).state is State.STOPPED
    assert bench.story.states == ["checked", "armed", "approaching", "stopping", "stopped"]
    assert (np.abs(bench.truth[-1].position - HOME) < 0.02).all()  # held without asking for a position


def test_a_fault_during_a_stop_that_was_requested_is_not_swallowed(make: Callable[..., Bench]) -> None:
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
    assert bench.arm.stops == [StopKind.QUICK_STOP]
    assert bench.arm.torques == []
    assert bench.story.states == ["checked", "faulted"]


def test_a_drive_that_is_in_a_fault_when_it_is_enabled_stops_the_run_by_the_fault_of_that_name(
    make: Callable[..., Bench],
) -> None:
    bench = make()
    bench.arm.enable_error = DriveFaulted("drive 3 is in the state fault")
    error = bench.fault()
    assert (error.code, str(error)) == ("drive_fault", "drive_fault: drive 3 is in the state fault")
    assert bench.arm.stops == [StopKind.QUICK_STOP]
    assert bench.arm.torques == []


class _Broken(Exception):
    pass


def test_a_mistake_in_the_control_law_takes_the_torque(
    make: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench, law = make(), ComputedTorque.torque

    def broken(self: ComputedTorque, *arguments: Any) -> Array:
        if len(bench.arm.torques) > 250:
            raise _Broken
        return law(self, *arguments)

    monkeypatch.setattr(ComputedTorque, "torque", broken)
    with pytest.raises(_Broken):
        bench.run()
    assert bench.arm.stops == [StopKind.QUICK_STOP]
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
        return np.array([torque[0], wrong]) if len(bench.arm.torques) == 250 else torque

    monkeypatch.setattr(ComputedTorque, "torque", broken)
    error = bench.fault()
    assert error.code == code
    assert "elbow" in str(error)
    assert len(bench.arm.torques) == 250


def test_a_torque_beyond_the_limit_is_clipped_and_counted(
    make: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench, law = make(), ComputedTorque.torque

    def strong(self: ComputedTorque, *arguments: Any) -> Array:
        torque = law(self, *arguments)
        return 2.0 * LIMITS.torque if 250 <= len(bench.arm.torques) < 253 else torque

    monkeypatch.setattr(ComputedTorque, "torque", strong)
    report = bench.run()
    assert report.state is State.DONE
    assert report.warnings["torque_saturated"] == 3
    assert set(report.warnings) == {"torque_saturated", "torque_rate"}
    torques = np.array(bench.arm.torques)
    rate = np.minimum(TORQUE_RATE, TORQUE_RATE_SHARE * LIMITS.torque)
    assert (np.abs(np.diff(torques, axis=0)) <= rate * PERIOD * (1 + 1e-9)).all()


@pytest.mark.parametrize("where", ["sample", "event", "exchange", "enable"])
def test_an_interrupt_takes_the_torque(make: Callable[..., Bench], where: str) -> None:
    bench = make()

    def interrupt(*_: Any) -> bool:
        raise KeyboardInterrupt

    def later(count: int) -> bool:
        return interrupt() if count == 425 else True

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
    assert bench.arm.stops == [StopKind.QUICK_STOP]
    assert bench.story.states[-1] == "faulted"


def test_torque_is_taken_before_anything_is_reported(make: Callable[..., Bench]) -> None:
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


def test_a_fault_that_the_table_does_not_know_takes_the_torque_away_all_the_same() -> None:
    from types import SimpleNamespace

    from ident_service.errors import ArmFault
    from ident_service.motion.faults import ActiveFaults
    from ident_service.motion.run import _Run
    from ident_service.motion.state_machine import State

    stopped: list[StopKind] = []
    latch = ActiveFaults()
    arm = SimpleNamespace(stop=stopped.append, clock=SimpleNamespace(now_ns=lambda: 0))
    run_ = SimpleNamespace(arm=arm, latch=latch, states=SimpleNamespace(state=State.FAULTED))
    _Run._halt(run_, ArmFault("from_a_foreign_driver", "who knows"), SimpleNamespace(lowered=False))  # type: ignore[arg-type]
    assert len(stopped) == 1
    assert [fault.code for fault in latch.faults] == ["from_a_foreign_driver"]
