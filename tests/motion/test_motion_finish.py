"""A run that is finished early: it rests, goes back to where it stood, and is done; whatever is graver comes first."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from helpers.examples import some
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from motion_bench import JOINTS, LOOKED, WatchedArm, bench_model, watched
from run_bench import FOREVER, HOLD, HOME, LIMITS, MIDWAY, MOTION, PERIOD, RATE, Bench, Healthy

from drivers.arm import StopKind
from ident_service.config.motion_limits import MotionLimits
from ident_service.errors import ArmFault, MotionRefused
from ident_service.motion.clearance import ClearanceChecker
from ident_service.motion.run import RunReport, follow, run
from ident_service.motion.run_plan import Destination, PointToPointPlan
from ident_service.motion.sequencer import Paused
from ident_service.motion.state_machine import State
from ident_service.motion.trajectory import Reference, rest
from sim_backend.arm import Truth

pytestmark = pytest.mark.slow  # whole runs

Array = np.ndarray
WHOLE = ["checked", "armed", "approaching", "exciting", "returning", "done"]


@dataclass
class Hands:
    """Somebody at the controls, by cycles of the loop; each wish lasts from its cycle on, a pause as long as told."""

    finished: int = FOREVER
    paused: tuple[int, int] = (FOREVER, FOREVER)
    stopped: int = FOREVER
    gone: int = FOREVER
    cycle: int = field(default=0, init=False)

    @property
    def stop(self) -> bool:
        self.cycle += 1
        return self.cycle >= self.stopped

    @property
    def pause(self) -> bool:
        return self.paused[0] <= self.cycle < self.paused[1]

    @property
    def finish(self) -> bool:
        return self.cycle >= self.finished

    def lease_ok(self, now_ns: int) -> bool:
        return self.cycle < self.gone


def played(bench: Bench, hands: Hands, **options: Any) -> RunReport:
    return run(bench.arm, bench.model, MOTION, bench.story, hands, **({"hold_seconds": HOLD} | options))


def times(bench: Bench) -> dict[str, float]:
    """When each state was entered last [s]."""
    return {message: stamp * 1e-9 for stamp, level, message in bench.story.events if level == 20}


def kept_all_limits(bench: Bench) -> None:
    position, velocity = (bench.story.column(f"reference_{name}") for name in ("position", "velocity"))
    assert ((position >= LIMITS.lower - 1e-9) & (position <= LIMITS.upper + 1e-9)).all()
    assert (np.abs(velocity) <= LIMITS.velocity * (1.0 + 1e-6)).all()
    acceleration = np.diff(velocity, axis=0) / PERIOD
    assert (np.abs(acceleration) <= LIMITS.acceleration * 1.001).all()
    # Without a step: the reference goes where its velocity says.
    assert (np.abs(np.diff(position, axis=0) - velocity[:-1] * PERIOD) <= LIMITS.acceleration * PERIOD**2 * 1.001).all()
    assert all((np.abs(torque) <= LIMITS.torque).all() for torque in bench.arm.torques)
    assert ((LIMITS.lower <= bench.truth[-1].position) & (bench.truth[-1].position <= LIMITS.upper)).all()


def ended_where_it_began(bench: Bench) -> None:
    assert (np.abs(bench.story.column("reference_position")[-1] - HOME) < 1e-3).all()
    assert (np.abs(bench.truth[-1].position - HOME) < 0.25 * LIMITS.following_error).all()
    assert bench.arm.stops == [StopKind.TORQUE_OFF]


@pytest.mark.parametrize("cycle", [1, 75, MIDWAY, 650])
def test_a_run_is_finished_from_every_part_of_it(make: Callable[..., Bench], healthy: Healthy, cycle: int) -> None:
    bench, whole = make(), healthy.bench
    report = played(bench, Hands(finished=cycle))
    assert report.state is State.DONE
    left = "exciting" if cycle * PERIOD > times(whole)["exciting"] - LOOKED * PERIOD else "approaching"
    before = WHOLE[: WHOLE.index(left) + 1]
    assert bench.story.states == [*before, "pausing", "paused", "returning", "done"]
    assert bench.story.errors == []
    expected = cycle * PERIOD - (times(bench)["exciting"] - LOOKED * PERIOD) if left == "exciting" else 0.0
    assert report.finished_at == pytest.approx(expected, abs=2.5 * PERIOD)
    kept_all_limits(bench)
    ended_where_it_began(bench)
    assert bench.arm.cycle < whole.arm.cycle


@settings(some(6), phases=[Phase.explicit, Phase.generate])
@given(cycle=st.integers(1, 1300), speed=st.sampled_from([1.0, 0.6]), pause=st.integers(-200, 200))
def test_limits_are_kept_whenever_a_run_is_finished(cycle: int, speed: float, pause: int) -> None:
    truth: list[Truth] = []
    arm: WatchedArm = watched((), truth.append, **RATE)
    arm.open()
    try:
        bench = Bench(arm, truth)
        begin = max(cycle + pause, 1)
        report = played(bench, Hands(finished=cycle, paused=(begin, begin + 50)), speed=speed)
        assert report.state is State.DONE
        kept_all_limits(bench)
        ended_where_it_began(bench)
        states = bench.story.states
        early = states[states.index("returning") - 1] == "paused"
        assert (report.finished_at is not None) == early
        assert early or "exciting" in states
    finally:
        arm.close()


def test_the_return_is_as_slow_as_the_run(make: Callable[..., Bench]) -> None:
    bench = make()
    assert played(bench, Hands(finished=1500), speed=0.4).finished_at is not None
    stamps = bench.story.column("stamp_ns") * 1e-9
    velocity = bench.story.column("reference_velocity")[stamps > times(bench)["returning"]]
    assert (np.abs(velocity) <= 0.5 * 0.4 * LIMITS.velocity * 1.001).all()


def test_a_finished_run_returns_from_a_pause_once_the_pause_is_over(make: Callable[..., Bench]) -> None:
    bench = make()
    report = played(bench, Hands(finished=600, paused=(350, 1000)))
    assert report.state is State.DONE
    assert bench.story.states[-5:] == ["exciting", "pausing", "paused", "returning", "done"]
    assert times(bench)["returning"] == pytest.approx((LOOKED + 1000) * PERIOD, abs=2.5 * PERIOD)
    ended_where_it_began(bench)


def test_a_run_is_finished_while_it_pauses_and_while_it_goes_on_again(make: Callable[..., Bench]) -> None:
    pausing, resuming = make(), make()
    assert played(pausing, Hands(finished=355, paused=(350, 360))).finished_at is not None
    assert pausing.story.states[-5:] == ["exciting", "pausing", "paused", "returning", "done"]
    begin = 750
    assert played(resuming, Hands(finished=begin + 20, paused=(350, begin))).finished_at is not None
    assert resuming.story.states[-7:] == ["pausing", "paused", "resuming", "pausing", "paused", "returning", "done"]
    for bench in (pausing, resuming):
        kept_all_limits(bench)
        ended_where_it_began(bench)


def test_the_return_of_a_finished_run_can_be_paused(make: Callable[..., Bench]) -> None:
    free, bench = make(), make()
    played(free, Hands(finished=MIDWAY))
    begin = round(times(free)["returning"] / PERIOD) - LOOKED + 100
    assert played(bench, Hands(finished=MIDWAY, paused=(begin, begin + 150))).finished_at is not None
    expected = ["paused", "returning", "pausing", "paused", "resuming", "returning", "done"]
    assert bench.story.states[-7:] == expected
    kept_all_limits(bench)
    ended_where_it_began(bench)


def test_a_run_on_its_return_is_not_finished_early(make: Callable[..., Bench], healthy: Healthy) -> None:
    whole, bench = healthy.bench, make()
    cycle = round(times(whole)["returning"] / PERIOD) - LOOKED + 50
    report = played(bench, Hands(finished=cycle))
    assert (report.state, report.finished_at, report.not_finished) == (State.DONE, None, "")
    assert bench.story.states == WHOLE
    assert bench.arm.cycle == whole.arm.cycle


def test_a_single_trajectory_is_not_finished_early(make: Callable[..., Bench]) -> None:
    ways = []
    away = {"joints": {name: joint | {"home": 0.3} for name, joint in JOINTS.items()}}
    for hands in (Hands(), Hands(finished=30)):
        bench = make(**away)
        report = follow(
            bench.arm, bench.model, PointToPointPlan(Destination.HOME), bench.story, hands, hold_seconds=HOLD
        )
        assert (report.state, report.finished_at) == (State.DONE, None)
        ways.append((bench.story.states, bench.arm.cycle))
    assert ways[0] == ways[1]
    assert "returning" in ways[0][0]


@pytest.mark.parametrize("after", [0, 15, 100, 175])
@pytest.mark.parametrize(("wish", "code"), [("stopped", ""), ("gone", "lease_lost")])
def test_whatever_stops_the_arm_comes_first(make: Callable[..., Bench], wish: str, code: str, after: int) -> None:
    bench = make()
    hands = Hands(finished=MIDWAY, **{wish: MIDWAY + after})
    if code:
        with pytest.raises(ArmFault) as caught:
            played(bench, hands)
        assert caught.value.code == code
    else:
        report = played(bench, hands)
        assert (report.state, report.finished_at) == (State.STOPPED, None)
    assert bench.story.states[-2:] == ["stopping", "stopped"]
    assert times(bench)["stopping"] == pytest.approx((LOOKED + MIDWAY + after) * PERIOD, abs=2.5 * PERIOD)
    assert bench.arm.stops == [StopKind.QUICK_STOP]


def test_a_stop_is_not_finished(make: Callable[..., Bench]) -> None:
    bench = make()
    report = played(bench, Hands(finished=MIDWAY + 20, stopped=MIDWAY))
    assert (report.state, report.finished_at) == (State.STOPPED, None)
    assert bench.story.states[-3:] == ["exciting", "stopping", "stopped"]


def test_where_the_straight_return_is_not_free_the_run_goes_on(
    make: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    free = ClearanceChecker.require_clear
    judged: list[float] = []

    def home_is_blocked(self: ClearanceChecker, way: Reference, limits: MotionLimits) -> Generator[None, None, None]:
        judged.append(float(np.abs(way.at(way.duration).position - HOME).max()))
        yield
        if judged[-1] < 1e-9:
            raise MotionRefused("the table is in the way")
        yield from free(self, way, limits)

    monkeypatch.setattr(ClearanceChecker, "require_clear", home_is_blocked)
    bench = make()
    report = played(bench, Hands(finished=MIDWAY, paused=(800, 850)))
    assert (report.state, report.finished_at) == (State.DONE, None)
    assert report.not_finished == "the table is in the way"
    expected = ["exciting", "pausing", "paused", "resuming", "exciting"]
    assert bench.story.states[3:8] == expected
    assert bench.story.states[-1] == "done"
    assert sum(distance < 1e-9 for distance in judged) == 1  # asked for once, not in later pauses again
    warnings = [message for _, level, message in bench.story.events if level == 30]
    assert warnings == ["not finished early, continues to its end: the table is in the way"]
    kept_all_limits(bench)
    ended_where_it_began(bench)


def test_without_any_return_a_finish_ends_as_a_pause_does(
    make: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(self: Paused, *_: Any) -> Any:
        yield
        raise MotionRefused("it swings")

    monkeypatch.setattr(Paused, "leave_in_slices", refused)
    monkeypatch.setattr(Paused, "resume_in_slices", refused)
    bench = make()
    with pytest.raises(ArmFault, match="it swings") as caught:
        played(bench, Hands(finished=350))
    assert caught.value.code == "no_way_back"
    assert bench.story.states[-3:] == ["paused", "stopping", "stopped"]


def test_the_return_keeps_clear(make: Callable[..., Bench]) -> None:
    """A ball in the middle of the straight way home: with it that way is none."""
    bodies = {
        name: [{"from": (-0.45, 0.0, 0.0), "to": (0.0, 0.0, 0.0), "radius": 0.02}] for name in ("shoulder", "elbow")
    }
    free = make()
    played(free, Hands(finished=MIDWAY))
    stamps = free.story.column("stamp_ns") * 1e-9
    back = free.story.column("reference_position")[stamps > times(free)["returning"]]
    assert np.abs(back[0] - back[-1]).max() > 0.05  # a way worth the name
    middle = back[len(back) // 2]
    tip = 0.5 * np.array([np.cos(middle[0]) + np.cos(middle.sum()), np.sin(middle[0]) + np.sin(middle.sum()), 0.0])
    ball = {"from": tip.tolist(), "to": tip.tolist(), "radius": 0.01}
    model = bench_model(
        **RATE, geometry=bodies, workspace={"obstacles": {"ball": {"capsule": ball}}, "clearance": 0.001}
    )
    paused = Paused(_Standing(back[0]), 0.0, LIMITS)
    search = paused.leave_in_slices(_Standing(back[-1]).at(0.0), LIMITS, ClearanceChecker(model, LIMITS))
    with pytest.raises(MotionRefused, match="at elbow - obstacle ball"):
        for _ in search:
            pass


class _Standing:
    """A reference that stands."""

    duration = 1.0

    def __init__(self, position: Array) -> None:
        self._position = position

    def at(self, time: float) -> Any:
        return rest(self._position)
