"""One way to a destination: slow, guarded, held where it ends, and inwards only from outside the limits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.local_commands import LocalCommands
from motion_bench import ELBOW, JOINTS, SHOULDER, bench_model
from run_bench import HOLD, HOME, LIMITS, PERIOD, RATE, Bench

from drivers.arm import StopKind
from ident_service.config.motion_limits import motion_limits
from ident_service.errors import ArmFault, MotionRefused
from ident_service.motion.clearance import just_inside, relaxed_limits
from ident_service.motion.run import RunReport, follow
from ident_service.motion.run_plan import Destination, PointToPointPlan
from ident_service.motion.state_machine import State

Array = np.ndarray
OUT = LIMITS.upper[0] + 0.1  # of the shoulder, half a following error outside


def standing(shoulder: float, elbow: float) -> dict[str, Any]:
    """The bench's arm somewhere else; a plant of its own knows no limits."""
    wide = {"position": (-4.0, 4.0)}
    return {"joints": {"shoulder": SHOULDER | wide | {"home": shoulder}, "elbow": ELBOW | wide | {"home": elbow}}}


def go(bench: Bench, destination: Destination = Destination.HOME, controls: Any = None) -> RunReport:
    return follow(bench.arm, bench.model, PointToPointPlan(destination), bench.story, controls, hold_seconds=HOLD)


def refused(bench: Bench, match: str, destination: Destination = Destination.HOME) -> None:
    with pytest.raises(MotionRefused, match=match):
        go(bench, destination)
    bench.nothing_was_enabled()


def positions(bench: Bench) -> Array:
    return np.array([truth.position for truth in bench.truth])


@pytest.mark.slow
@pytest.mark.parametrize(
    "start",
    [(-0.4, 0.3), (0.1, -0.1), *(pytest.param(one, marks=pytest.mark.campaign) for one in ((-1.2, 1.0), (1.7, -1.9)))],
)
def test_it_goes_home_and_is_held_there(make: Callable[..., Bench], start: tuple[float, float]) -> None:
    bench = make(**standing(*start))
    report = go(bench)
    assert report.state is State.DONE
    assert bench.story.states == ["checked", "armed", "returning", "stopping", "stopped", "done"]
    assert (np.abs(positions(bench)[-1] - HOME) < 0.05).all()
    # Whatever carried the arm where it stood is not here: the drives brake it, instead of letting it fall.
    assert bench.arm.stops == [StopKind.QUICK_STOP]
    stopped = next(stamp for stamp, _, message in bench.story.events if message == "stopped")
    assert bench.story.column("stamp_ns")[-1] - stopped >= (HOLD - 2 * PERIOD) * 1e9


@pytest.mark.slow
def test_no_joint_is_faster_than_a_tenth_of_its_limit(make: Callable[..., Bench]) -> None:
    bench = make(**standing(-0.5, 0.4))
    go(bench)
    asked = np.abs(bench.story.column("reference_velocity"))
    assert (asked <= 0.1 * LIMITS.velocity * (1.0 + 1e-9)).all()
    assert (asked.max(axis=0) > 0.09 * LIMITS.velocity).any()
    assert (np.abs([truth.velocity for truth in bench.truth]) < 0.3 * LIMITS.velocity).all()


@pytest.mark.slow
@pytest.mark.parametrize("destination", list(Destination))
@pytest.mark.parametrize("side", [pytest.param(-1.0, marks=pytest.mark.campaign), 1.0])
def test_from_a_little_outside_the_path_leads_inwards_only(
    make: Callable[..., Bench], destination: Destination, side: float
) -> None:
    bench = make(**standing(side * OUT, 0.5))
    assert go(bench, destination).state is State.DONE
    held = next(stamp for stamp, _, message in bench.story.events if message == "stopping")
    apply_to_frames = bench.story.column("stamp_ns") < held
    wanted = side * bench.story.column("reference_position")[apply_to_frames, 0]
    assert (np.diff(wanted) <= 1e-12).all(), "it never turns round"
    assert wanted[0] == pytest.approx(OUT, abs=1e-4)
    end = positions(bench)[-1]
    assert ((end > LIMITS.lower) & (end < LIMITS.upper)).all()
    if destination is Destination.INSIDE:
        # The other joint stays, and this one goes no farther than it must.
        assert abs(end[1] - 0.5) < 0.05
        assert LIMITS.upper[0] - side * end[0] < LIMITS.following_error[0]


@pytest.mark.parametrize("destination", list(Destination))
def test_from_farther_outside_nothing_moves(make: Callable[..., Bench], destination: Destination) -> None:
    out = float(LIMITS.upper[0] + 1.01 * LIMITS.following_error[0])
    refused(make(**standing(out, 0.0)), "shoulder at 2.0.*its zero may be wrong.*by hand", destination)


def test_there_is_nothing_to_leave_inside(make: Callable[..., Bench]) -> None:
    refused(make(**standing(1.0, 0.0)), "nothing to leave", Destination.INSIDE)


def test_a_push_outwards_on_the_path_inwards_stops_the_arm(make: Callable[..., Bench]) -> None:
    bench = make(**standing(OUT, 0.5))
    away = np.array([0.08, 0.0])  # more than it may give way
    bench.arm.shown = lambda sample: replace(
        sample, position=sample.position + away * min(max(sample.cycle - 50, 0) / 30.0, 1.0)
    )
    with pytest.raises(ArmFault) as caught:
        go(bench)
    assert caught.value.code in ("position_limit", "position_envelope")


@pytest.mark.slow
def test_a_stop_on_the_path_home_is_a_stop(make: Callable[..., Bench]) -> None:
    bench, switches = make(**standing(-1.2, 1.0)), LocalCommands()
    bench.arm.before_exchange = lambda cycle: setattr(switches, "stop", cycle > 750)
    assert go(bench, controls=switches).state is State.STOPPED
    assert bench.story.states[-2:] == ["stopping", "stopped"]
    assert abs(positions(bench)[-1][0] - HOME[0]) > 0.5


@pytest.mark.slow
def test_a_pause_on_the_path_home_ends_at_home(make: Callable[..., Bench]) -> None:
    bench, switches = make(**standing(-0.5, 0.4)), LocalCommands()
    bench.arm.before_exchange = lambda cycle: setattr(switches, "pause", 500 < cycle < 900)
    assert go(bench, controls=switches).state is State.DONE
    assert bench.story.states[3:7] == ["pausing", "paused", "resuming", "returning"]
    assert (np.abs(positions(bench)[-1] - HOME) < 0.05).all()


def test_a_path_through_an_obstacle_is_refused(make: Callable[..., Bench]) -> None:
    bench = make(**standing(-1.2, 0.0))
    bench.model = bench_model(
        **RATE,
        geometry={"elbow": [{"from": [-0.45, 0, 0], "to": [0, 0, 0], "radius": 0.03}]},
        workspace={"obstacles": {"post": {"box": {"center": [0.75, -0.5, 0.0], "size": [0.1, 0.2, 0.2]}}}},
    )
    refused(bench, "the path home comes within .*post.*by hand")


def test_limits_are_widened_only_where_the_arm_stands_outside() -> None:
    inside = relaxed_limits(HOME, LIMITS)
    np.testing.assert_array_equal([inside.lower, inside.upper], [LIMITS.lower, LIMITS.upper])
    out = relaxed_limits(np.array([OUT, 0.0]), LIMITS)
    np.testing.assert_allclose(out.upper, [OUT + 0.05, LIMITS.upper[1]])
    np.testing.assert_array_equal(out.lower, LIMITS.lower)
    np.testing.assert_allclose(just_inside(np.array([OUT, 0.0]), LIMITS), [LIMITS.upper[0] - 0.05, 0.0])


def test_inside_a_narrow_range_is_inside_it() -> None:
    narrow = motion_limits(bench_model().config)
    narrow = replace(narrow, lower=narrow.upper - 0.04)
    end = just_inside(narrow.upper + 0.1, narrow)
    assert ((narrow.lower < end) & (end < narrow.upper)).all()
    assert JOINTS["shoulder"]["following_error"] > 0.04
