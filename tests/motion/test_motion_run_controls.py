"""A run that is paused, goes on, loses its lease, or whose arm does not stay where it was stopped."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from helpers.local_commands import LocalCommands
from motion_bench import LOOKED
from run_bench import FOREVER, HOLD, HOME, LIMITS, MIDWAY, MOTION, PERIOD, Bench, Healthy

from drivers.arm import StopKind
from ident_service.errors import ArmFault, MotionRefused
from ident_service.motion.command_channel import HOLD_TO_RUN_SECONDS
from ident_service.motion.control_loop import HOLD_SPEED, REST_CYCLES, REST_SPEED
from ident_service.motion.faults import LOWER, LOWER_AFTER, SETTLE, ActiveFaults
from ident_service.motion.run import RunReport, run
from ident_service.motion.sequencer import Paused
from ident_service.motion.state_machine import State
from sim_backend.faults import Fault, FaultKind

pytestmark = pytest.mark.slow  # whole runs

Array = np.ndarray


@dataclass
class Hands:
    """Somebody at the controls, by cycles of the loop."""

    paused: tuple[tuple[int, int], ...] = ()
    stopped: int = FOREVER
    gone: int = FOREVER
    dead: int = FOREVER
    finished: int = FOREVER
    cycle: int = field(default=0, init=False)

    @property
    def pause(self) -> bool:
        return any(begin <= self.cycle < end for begin, end in self.paused)

    @property
    def stop(self) -> bool:
        self.cycle += 1
        if self.cycle + LOOKED > self.dead:
            raise BrokenPipeError("nobody there")
        return self.cycle + LOOKED > self.stopped

    @property
    def finish(self) -> bool:
        return self.cycle + LOOKED > self.finished

    def lease_ok(self, now_ns: int) -> bool:
        return self.cycle + LOOKED <= self.gone


def played(bench: Bench, hands: Any, **options: Any) -> RunReport:
    return run(bench.arm, bench.model, MOTION, bench.story, hands, **({"hold_seconds": HOLD} | options))


def times(bench: Bench) -> dict[str, float]:
    """When each state was entered last [s]."""
    return {message: stamp * 1e-9 for stamp, level, message in bench.story.events if level == 20}


def no_step_anywhere(bench: Bench) -> None:
    """Until the arm is held, when no position is asked for any more."""
    followed = bench.story.column("stamp_ns") <= [stamp for stamp, level, _ in bench.story.events if level == 20][-1]
    reference = bench.story.column("reference_position")[followed]
    velocity = bench.story.column("reference_velocity")[followed]
    assert (np.abs(np.diff(reference, axis=0)) <= LIMITS.velocity * PERIOD * 1.001).all()
    assert (np.abs(np.diff(velocity, axis=0)) <= LIMITS.acceleration * PERIOD * 1.001).all()


@pytest.mark.parametrize(
    "cycle", [pytest.param(100, marks=pytest.mark.campaign), MIDWAY, pytest.param(950, marks=pytest.mark.campaign)]
)
def test_a_pause_is_gone_on_from(make: Callable[..., Bench], cycle: int) -> None:
    bench = make()
    report = played(bench, Hands(((cycle, cycle + 300),)))
    assert report.state is State.DONE
    states = bench.story.states
    left = states[states.index("pausing") - 1]
    assert states[states.index("pausing") : states.index("pausing") + 4] == ["pausing", "paused", "resuming", left]
    assert times(bench)["resuming"] == pytest.approx((LOOKED + cycle + 300) * PERIOD, abs=2.5 * PERIOD)
    no_step_anywhere(bench)
    stamps, paused = bench.story.column("stamp_ns") * 1e-9, times(bench)["paused"]
    standing = (stamps > paused) & (stamps < times(bench)["resuming"])
    assert not bench.story.column("reference_velocity")[standing].any()
    assert (np.abs(bench.truth[-1].position - HOME) < 0.25 * LIMITS.following_error).all()


def test_the_whole_motion_is_made_in_spite_of_pauses(make: Callable[..., Bench], healthy: Healthy) -> None:
    bench = make()
    # Short enough that the second one strikes on the way back from the first.
    report = played(bench, Hands(((350, 351), (500, 501), (800, 900))))
    assert report.state is State.DONE
    assert bench.story.states.count("pausing") == 3
    assert bench.story.states[4:8] == ["pausing", "paused", "resuming", "pausing"]
    no_step_anywhere(bench)
    expected, made = (story.column("reference_position") for story in (healthy.story, bench.story))
    near = [np.abs(made - point).max(axis=1).min() for point in expected[::25]]
    assert max(near) < 2.0 * (LIMITS.velocity * PERIOD).max()


def test_a_pause_wanted_for_a_moment_is_a_pause(make: Callable[..., Bench]) -> None:
    bench = make()
    assert played(bench, Hands(((MIDWAY, MIDWAY + 1),))).state is State.DONE
    assert bench.story.states.count("paused") == 1


def test_a_rehearsal_goes_on_as_slowly_as_it_went(make: Callable[..., Bench]) -> None:
    bench = make()
    assert played(bench, Hands(((1500, 1750),)), speed=0.4).state is State.DONE
    stamps = bench.story.column("stamp_ns") * 1e-9
    velocity = bench.story.column("reference_velocity")[stamps > times(bench)["resuming"]]
    assert (np.abs(velocity) <= 0.4 * LIMITS.velocity * 1.001).all()


@pytest.mark.parametrize(("pause", "stop"), [((350, 360), 371), ((350, 700), 600), ((350, 500), 600)])
def test_a_stop_is_obeyed_in_a_pause_too(make: Callable[..., Bench], pause: tuple[int, int], stop: int) -> None:
    bench = make()
    assert played(bench, Hands((pause,), stopped=stop)).state is State.STOPPED
    before = {371: "pausing", 600: "paused" if pause[1] == 700 else "resuming"}[stop]
    assert bench.story.states[-3:] == [before, "stopping", "stopped"]
    no_step_anywhere(bench)


def test_no_return_ends_the_pause(make: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(self: Paused, *_: Any) -> Any:
        yield
        raise MotionRefused("it swings")

    monkeypatch.setattr(Paused, "resume_in_slices", refused)
    bench = make()
    with pytest.raises(ArmFault, match="it swings") as caught:
        played(bench, Hands(((350, 750),)))
    assert caught.value.code == "no_way_back"
    assert bench.story.states[-3:] == ["paused", "stopping", "stopped"]


@pytest.mark.parametrize("cycle", [150, MIDWAY, 950])
@pytest.mark.parametrize(("wish", "code"), [("gone", "lease_lost"), ("dead", "controls_failed")])
def test_an_arm_that_nobody_watches_stops(make: Callable[..., Bench], wish: str, code: str, cycle: int) -> None:
    bench, latch = make(), ActiveFaults()
    with pytest.raises(ArmFault) as caught:
        played(bench, Hands(**{wish: cycle}), active_faults=latch)
    assert caught.value.code == code
    assert times(bench)["stopping"] == pytest.approx(cycle * PERIOD, abs=1.5 * PERIOD)
    assert bench.story.states[-2:] == ["stopping", "stopped"]
    assert [fault.code for fault in latch.faults] == [code]
    assert len(bench.story.errors) == 1


def test_a_lease_lost_while_a_motion_is_planned_energises_nothing(make: Callable[..., Bench]) -> None:
    bench = make()
    with pytest.raises(MotionRefused, match="the program that started the motion has ended"):
        played(bench, Hands(gone=-500))
    assert "armed" not in bench.story.states


def test_a_lease_lost_in_a_pause_stops_and_one_lost_in_a_stop_is_nothing(make: Callable[..., Bench]) -> None:
    bench = make()
    with pytest.raises(ArmFault, match="lease_lost"):
        played(bench, Hands(((350, FOREVER),), gone=650))
    assert bench.story.states[-3:] == ["paused", "stopping", "stopped"]

    class Leaving(Hands):
        @property
        def stop(self) -> bool:
            return super().stop and self.cycle + LOOKED < 455

    bench = make()
    assert played(bench, Leaving(stopped=450, gone=460)).state is State.STOPPED


def test_hold_to_run_is_a_short_lease(make: Callable[..., Bench]) -> None:
    bench, switches = make(), LocalCommands(HOLD_TO_RUN_SECONDS)
    clock = bench.arm.clock
    bench.arm.before_exchange = lambda cycle: switches.renew(clock.now_ns()) if cycle <= MIDWAY else None
    with pytest.raises(ArmFault, match="lease_lost"):
        played(bench, switches)
    assert times(bench)["stopping"] == pytest.approx(MIDWAY * PERIOD + HOLD_TO_RUN_SECONDS, abs=3 * PERIOD)


@pytest.mark.parametrize("hold", [0.0, 0.5])
def test_a_stopped_arm_is_held_and_then_left_to_its_drives(make: Callable[..., Bench], hold: float) -> None:
    bench = make()
    assert played(bench, Hands(stopped=MIDWAY), hold_seconds=hold).state is State.STOPPED
    assert bench.arm.stops == [StopKind.QUICK_STOP]
    stopped = times(bench)["stopped"]
    held = [moment for moment in bench.truth if moment.stamp_ns * 1e-9 >= stopped]
    assert held[-1].stamp_ns * 1e-9 - stopped == pytest.approx(hold, abs=1.5 * PERIOD)
    speeds = np.abs([moment.velocity for moment in held])
    assert (speeds <= REST_SPEED * LIMITS.velocity).all()
    assert len(bench.arm.torques) == bench.arm.cycle - LOOKED


def test_stopped_means_that_the_arm_rests(make: Callable[..., Bench]) -> None:
    bench = make()
    played(bench, Hands(stopped=MIDWAY))
    stopped = times(bench)["stopped"]
    before = [np.abs(moment.velocity) for moment in bench.truth if stopped - 0.015 <= moment.stamp_ns * 1e-9 <= stopped]
    assert len(before) >= 7
    assert (np.array(before) <= REST_SPEED * LIMITS.velocity).all()


def shaken(bench: Bench, begin: int, speed: float) -> None:
    """From some cycle on the shoulder is shown to swing, far less than anything else would mind."""

    def shown(sample: Any) -> Any:
        since = (sample.cycle - begin) * PERIOD
        if since <= 0.0:
            return sample
        swing = speed / 60.0 * np.sin(60.0 * since) * np.array([1.0, 0.0])
        return replace(sample, position=sample.position + swing)

    bench.arm.shown = shown


def test_an_arm_that_does_not_come_to_rest_is_left_to_its_drives(make: Callable[..., Bench]) -> None:
    bench = make()
    shaken(bench, MIDWAY + 50, 4.0 * REST_SPEED * LIMITS.velocity[0])
    with pytest.raises(
        ArmFault, match=r"^not_at_rest: shoulder: moves at .* rad/s 0.5 s after it was to rest: "
    ) as caught:
        played(bench, Hands(stopped=MIDWAY))
    assert caught.value.code == "not_at_rest"
    assert bench.story.states[-2:] == ["stopping", "faulted"]
    assert bench.arm.stops == [StopKind.QUICK_STOP]
    longest = LIMITS.velocity / LIMITS.acceleration + 3.0 * LIMITS.acceleration / LIMITS.jerk
    assert (bench.arm.cycle - MIDWAY) * PERIOD <= longest.max() + SETTLE + REST_CYCLES * PERIOD


def test_a_pause_must_come_to_rest_too(make: Callable[..., Bench]) -> None:
    bench = make()
    shaken(bench, MIDWAY + 50, 4.0 * REST_SPEED * LIMITS.velocity[0])
    with pytest.raises(ArmFault, match="not_at_rest"):
        played(bench, Hands(((MIDWAY - LOOKED, FOREVER),)))
    assert bench.story.states[-2:] == ["pausing", "faulted"]


def test_an_arm_that_is_pushed_while_it_is_held_is_left_to_its_drives(make: Callable[..., Bench]) -> None:
    bench = make()
    shaken(bench, MIDWAY + 200, 3.0 * HOLD_SPEED * LIMITS.velocity[0])
    with pytest.raises(ArmFault, match=r"^hold_lost: shoulder: moves at ") as caught:
        played(bench, Hands(stopped=MIDWAY), hold_seconds=2.0)
    assert caught.value.code == "hold_lost"
    assert bench.story.states[-2:] == ["stopped", "faulted"]


def test_an_arm_that_does_not_follow_is_lowered(make: Callable[..., Bench]) -> None:
    bench, latch = make(Fault(350, FaultKind.LOAD_ATTACHED, None, None, 3.0)), ActiveFaults()
    with pytest.raises(ArmFault, match="following_lost: ") as caught:
        played(bench, LocalCommands(), active_faults=latch)
    assert caught.value.code == "following_lost"
    assert [fault.code for fault in latch.faults] == ["following_error", "following_lost"]
    assert bench.story.states[-2:] == ["stopping", "faulted"]
    stamp = next(stamp for stamp, _, message in bench.story.events if message.startswith("following_lost"))
    assert bench.truth[-1].stamp_ns - stamp == pytest.approx((LOWER_AFTER + LOWER) * 1e9, abs=2e6)
    assert bench.arm.stops == [StopKind.QUICK_STOP]
    lowering = [moment for moment in bench.truth if moment.stamp_ns > stamp]
    assert (np.abs(lowering[-1].torque) < np.abs(lowering[10].torque) + 2.0).all()
    assert (np.abs([moment.velocity for moment in lowering]) <= 1.2 * LIMITS.velocity).all()


def test_a_latched_fault_refuses_the_next_run_until_it_is_acknowledged(make: Callable[..., Bench]) -> None:
    bench, latch = make(Fault(MIDWAY, FaultKind.NAN_POSITION, 0)), ActiveFaults()
    with pytest.raises(ArmFault):
        played(bench, LocalCommands(), active_faults=latch)
    (fault,) = latch.faults
    assert fault.cause.startswith("shoulder: position is not a number: ")
    assert fault.since_ns == round(MIDWAY * PERIOD * 1e9)
    again = make()
    with pytest.raises(MotionRefused, match=r"unacknowledged faults: feedback_not_finite \(shoulder: "):
        played(again, LocalCommands(), active_faults=latch)
    again.nothing_was_enabled()
    latch.acknowledge("feedback_not_finite")
    assert played(again, LocalCommands(), active_faults=latch).state is State.DONE
    assert latch.faults == ()


def test_rest_is_seen_in_all_samples_before_a_run(make: Callable[..., Bench]) -> None:
    bench = make()
    bench.arm.shown = lambda sample: replace(sample, position=HOME + 0.01 * (sample.cycle % 10 == 5))
    with pytest.raises(MotionRefused, match="moving"):
        played(bench, LocalCommands())
    bench.nothing_was_enabled()


def test_a_warning_is_reported_once_and_counted(make: Callable[..., Bench]) -> None:
    bench = make(*(Fault(cycle, FaultKind.LOST_FEEDBACK, 1) for cycle in (350, 400, 450)))
    report = played(bench, LocalCommands())
    assert report.warnings == {"lost_feedback": 3}
    warnings = [message for _, level, message in bench.story.events if level == 30]
    assert warnings == ["lost_feedback: elbow: no feedback in this cycle: a frame was lost or came too late"]
