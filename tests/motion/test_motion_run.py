"""A whole run on the simulated arm, as it should go."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from motion_bench import LOOKED, PRIOR
from run_bench import HOME, LIMITS, MIDWAY, MOTION, PERIOD, Bench, Healthy, with_series

from drivers.arm import Sample
from ident_service.errors import UsageError
from ident_service.motion.command_channel import StopCondition
from ident_service.motion.control_loop import REST_CYCLES
from ident_service.motion.run import run
from ident_service.motion.state_machine import State

Array = np.ndarray


def test_a_run_goes_out_and_comes_back(healthy: Healthy) -> None:
    bench, report = healthy.bench, healthy.report
    assert report.state is State.DONE
    assert bench.story.states == ["checked", "armed", "approaching", "exciting", "returning", "done"]
    assert bench.story.errors == []
    assert report.warnings == {}
    np.testing.assert_allclose(bench.truth[0].position, HOME, atol=1e-9)
    assert (np.abs(bench.truth[-1].position - HOME) < 0.25 * LIMITS.following_error).all()
    cycles = bench.story.column("cycle")
    np.testing.assert_array_equal(cycles, np.arange(LOOKED, report.cycles - 1))
    np.testing.assert_array_equal(np.diff(bench.story.column("stamp_ns")), round(PERIOD * 1e9))
    assert bench.story.column("valid").all()
    assert not bench.story.column("lateness_ns").any()


def test_the_recorded_reference_is_the_excitation(healthy: Healthy) -> None:
    bench = healthy.bench
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
        key=lambda late: float(np.abs(MOTION.path.at(late)[0] - position[exciting][0]).max()),
    )
    expected = MOTION.path.at((stamps[exciting] - first) * 1e-9 + offset)
    np.testing.assert_allclose(position[exciting], expected[0], atol=1e-5)
    np.testing.assert_allclose(velocity[exciting], expected[1], atol=1e-4)
    # No step anywhere, at the seams neither.
    assert (np.abs(np.diff(position, axis=0)) <= LIMITS.velocity * PERIOD).all()
    assert (np.abs(np.diff(velocity, axis=0)) <= LIMITS.acceleration * PERIOD * 1.001).all()


def test_the_report_says_what_was_recorded(healthy: Healthy) -> None:
    bench, report = healthy.bench, healthy.report
    torque, position = bench.story.column("torque"), bench.story.column("position")
    np.testing.assert_array_equal(report.peak_torque, np.abs(torque).max(axis=0))
    error = np.abs(bench.story.column("reference_position") - position).max(axis=0)
    np.testing.assert_array_equal(report.peak_following_error, error)
    assert (error > 1e-4).all()
    assert (error < 0.5 * LIMITS.following_error).all()


def test_what_is_recorded_is_the_torque_that_acted(healthy: Healthy) -> None:
    bench = healthy.bench
    acted = np.array([truth.torque for truth in bench.truth])[LOOKED : LOOKED + len(bench.story.samples)]
    np.testing.assert_array_equal(bench.story.column("torque"), acted)


def test_an_arm_that_has_nowhere_to_go_is_done_at_once(make: Callable[..., Bench]) -> None:
    series = replace(MOTION.path.series.scaled(0.0), q0=HOME.copy())
    bench = make(driver={"kind": "simulated", "truth": PRIOR})
    report = bench.run(motion=with_series(series))
    assert report.state is State.DONE
    assert (report.peak_following_error < 1e-3).all()


@pytest.mark.slow
def test_two_runs_are_the_same_to_the_last_bit(make: Callable[..., Bench], healthy: Healthy) -> None:
    one, other = healthy, make()
    other.run()
    for name in ("position", "torque", "reference_position"):
        np.testing.assert_array_equal(one.story.column(name), other.story.column(name))


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_rehearsal_is_the_same_run_in_slow_motion(make: Callable[..., Bench], healthy: Healthy) -> None:
    full, slow = healthy, make()
    report = run(slow.arm, slow.model, MOTION, slow.story, speed=0.2)
    assert report.state is State.DONE
    assert slow.story.states == full.story.states
    assert len(slow.story.samples) == pytest.approx(5 * len(full.story.samples), abs=10)
    # Where the motion begins lies between two cycles, elsewhere in the one run than in the other.
    nearly = LIMITS.velocity * PERIOD
    same = min(len(full.story.samples), len(slow.story.samples) // 5)
    position, expected = slow.story.column("reference_position")[::5][:same], full.story.column("reference_position")
    assert (np.abs(position - expected[:same]) <= nearly).all()
    velocity, expected = slow.story.column("reference_velocity"), full.story.column("reference_velocity")
    np.testing.assert_allclose(np.abs(velocity).max(axis=0), 0.2 * np.abs(expected).max(axis=0), rtol=1e-3)
    assert (np.abs(np.diff(velocity, axis=0)) <= 0.04 * LIMITS.acceleration * PERIOD * 1.001).all()


@pytest.mark.slow
def test_a_stop_out_of_a_rehearsal_is_not_slowed(make: Callable[..., Bench]) -> None:
    bench = make()
    stopping = 5 * MIDWAY
    report = run(
        bench.arm,
        bench.model,
        MOTION,
        bench.story,
        StopCondition(lambda: len(bench.story.samples) >= stopping - LOOKED),
        speed=0.2,
    )
    assert report.state is State.STOPPED
    told = {message: stamp for stamp, _, message in bench.story.events}
    longest = (
        REST_CYCLES * PERIOD + 0.2 * LIMITS.velocity / LIMITS.acceleration + 3.0 * LIMITS.acceleration / LIMITS.jerk
    )
    assert (told["stopped"] - told["stopping"]) * 1e-9 <= longest.max()


@pytest.mark.parametrize("speed", [0.0, -1.0, 1.01, np.nan])
def test_no_run_is_faster_than_its_motion_or_backwards(make: Callable[..., Bench], speed: float) -> None:
    bench = make()
    with pytest.raises(UsageError, match="above 0 and at most 1"):
        run(bench.arm, bench.model, MOTION, bench.story, speed=speed)
    bench.nothing_was_enabled()
