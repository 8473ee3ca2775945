"""Runs that must not begin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from motion_bench import JOINTS, LOOKED, PRIOR, bench_model
from run_bench import HOME, LIMITS, MOTION, PERIOD, RATE, Bench, with_series

from ident_service.errors import DriverError, MotionRefused
from ident_service.excitation.motion_file import Excitation
from ident_service.motion.run import run
from ident_service.motion.state_machine import State
from sim_backend.faults import Fault, FaultKind

Array = np.ndarray


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


@pytest.mark.slow
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
    bench.model = bench_model(**RATE, prior=None)
    _refused(bench, "prior parameters")


@pytest.mark.parametrize(
    "key", ["position", "velocity", "acceleration", "jerk", "torque", "following_error", "kp", "kd"]
)
def test_no_run_begins_without_its_limits(make: Callable[..., Bench], key: str) -> None:
    bench = make()
    elbow = {name: value for name, value in JOINTS["elbow"].items() if name not in (key, "home")}
    bench.model = bench_model(**RATE, joints=JOINTS | {"elbow": elbow})
    _refused(bench, rf"joints\.elbow\.{key}")


def test_no_run_begins_that_cannot_reach_its_motion(make: Callable[..., Bench]) -> None:
    series = replace(MOTION.path.series.scaled(0.0), q0=LIMITS.upper + 0.1)
    _refused(make(), "leaves the arm's limits", with_series(series))


def test_no_run_begins_where_the_arm_cannot_be_held(make: Callable[..., Bench]) -> None:
    bench = make()
    bench.model = bench_model(**RATE, prior=PRIOR | {"m2": 10.0, "lx2": -2.5, "Lyy2": 0.84, "Lzz2": 0.84})
    # A motion that the arm could make if it were light enough where it stands now.
    series = replace(MOTION.path.series.scaled(0.0), q0=np.array([0.0, np.pi / 2]))
    motion = replace(with_series(series), arm_sha256=bench.model.config.motion_sha256)
    _refused(bench, "cannot be held|leaves the arm's limits: .*torque", motion)


def test_no_run_begins_with_a_motion_made_for_another_arm(make: Callable[..., Bench]) -> None:
    _refused(make(), "made for another description", replace(MOTION, arm_sha256="0" * 64))


def test_a_bus_that_is_silent_from_the_start_is_reported_as_such(make: Callable[..., Bench]) -> None:
    bench = make(Fault(3, FaultKind.BUS_GONE))
    with pytest.raises(DriverError, match="bus is gone"):
        run(bench.arm, bench.model, MOTION, bench.story)
    bench.nothing_was_enabled()


def test_no_run_begins_whose_stops_would_leave_the_limits(
    make: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    # The motion itself keeps to its limits wherever its demands are asked for; the stops are looked at on their own.
    bench = make()
    monkeypatch.setattr("ident_service.motion.run_plan.require_within_limits", lambda *_: None)
    series = replace(MOTION.path.series.scaled(0.0), q0=LIMITS.upper + 0.1)
    _refused(bench, "a stop out of the motion would leave", with_series(series))
