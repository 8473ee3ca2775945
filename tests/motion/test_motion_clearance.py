"""Ways back from a pause keep clear, or are none; and looking takes only a bearable part of a cycle."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.local_commands import LocalCommands
from motion_bench import bench_excitation, bench_limits, bench_model
from run_bench import MOTION as EXCITATION
from run_bench import Bench

from ident_service.config.motion_limits import MotionLimits
from ident_service.errors import ArmFault, MotionRefused
from ident_service.model.arm_model import ArmModel
from ident_service.model.collision import CollisionModel
from ident_service.motion.clearance import ClearanceChecker, require_clear, trajectory_stop_contact
from ident_service.motion.run import run
from ident_service.motion.sequencer import Paused, Resumed
from ident_service.motion.trajectory import PathReference, Reference, Setpoint, plan_trajectory, rest, run_to_end

Array = np.ndarray
LIMITS = bench_limits()
MOTION = PathReference(bench_excitation().path)
BODIES = {name: [{"from": (-0.45, 0.0, 0.0), "to": (0.0, 0.0, 0.0), "radius": 0.02}] for name in ("shoulder", "elbow")}


def with_ball(center: Array, radius: float, clearance: float = 0.02) -> ArmModel:
    ball = {"from": center.tolist(), "to": center.tolist(), "radius": radius}
    return bench_model(geometry=BODIES, workspace={"obstacles": {"ball": {"capsule": ball}}, "clearance": clearance})


def tip(position: Array) -> Array:
    shoulder, elbow = position[0], position[0] + position[1]
    return np.array([0.5 * np.cos(shoulder) + 0.5 * np.cos(elbow), 0.5 * np.sin(shoulder) + 0.5 * np.sin(elbow), 0.0])


def nearest(model: ArmModel, reference: Reference, duration: float) -> float:
    """The smallest distance on a way, densely sampled [m]."""
    times = np.linspace(0.0, duration, 2000).tolist()
    return float(CollisionModel(model).distances(np.array([reference.at(time).position for time in times])).min())


def beside_the_way_back(left: float, radius: float = 0.01) -> tuple[Paused, Resumed, ArmModel]:
    """A pause, the way back that it finds in free space, and a ball where only that way's run-up passes."""
    paused = Paused(MOTION, left, LIMITS)
    resumed = paused.resume()
    way_back = [resumed.at(time).position for time in np.linspace(0.0, resumed.back, 400).tolist()]
    here = tip(way_back[0])
    away = max(way_back, key=lambda position: float(np.linalg.norm(tip(position) - here)))
    return paused, resumed, with_ball(tip(away), radius)


def searched(paused: Paused, model: ArmModel) -> Resumed:
    return run_to_end(paused.resume_in_slices(None, ClearanceChecker(model, LIMITS)))


@pytest.mark.parametrize("left", np.linspace(0.3, 0.9 * MOTION.duration, 6).tolist())
def test_a_return_that_would_touch_is_not_taken(left: float) -> None:
    paused, free, model = beside_the_way_back(left)
    assert nearest(model, free, free.back) < 0.0
    try:
        resumed = searched(paused, model)
    except MotionRefused:
        return
    assert resumed.joined != free.joined
    assert nearest(model, resumed, resumed.back) > 0.0


def test_some_are_searched_again_and_some_are_none() -> None:
    """Both answers occur in the test above."""
    found = []
    for left in np.linspace(0.3, 0.9 * MOTION.duration, 6).tolist():
        paused, _, model = beside_the_way_back(left)
        try:
            searched(paused, model)
            found.append(True)
        except MotionRefused:
            found.append(False)
    assert True in found


def test_far_from_everything_the_return_is_what_it_was() -> None:
    paused = Paused(MOTION, 1.0, LIMITS)
    model = with_ball(np.array([0.0, 0.0, 5.0]), 0.1)
    assert searched(paused, model).joined == paused.resume().joined
    assert searched(paused, bench_model()).joined == paused.resume().joined


def test_an_arm_that_stands_touching_finds_no_return() -> None:
    paused = Paused(MOTION, 1.0, LIMITS)
    model = with_ball(tip(paused.at(paused.duration).position), 0.05)
    with pytest.raises(MotionRefused, match=r"the path comes within -0\.\d+ m at elbow - obstacle ball, 0\.00 s"):
        searched(paused, model)


@pytest.mark.parametrize("gap", [0.03, 0.015])
def test_half_of_what_a_stop_left_is_kept(gap: float) -> None:
    """The tip stands `gap` from a ball and swings towards it or away."""
    start = np.array([0.0, 0.0])
    above = tip(start) + np.array([0.0, 0.02 + 0.1 + gap, 0.0])
    surroundings = ClearanceChecker(with_ball(above, 0.1), LIMITS)
    least = min(0.02, 0.5 * gap)

    def judged(angle: float) -> None:
        run_to_end(
            surroundings.require_clear(plan_trajectory(rest(start), rest(np.array([angle, 0.0])), LIMITS), LIMITS)
        )

    judged(-0.3)
    judged(0.5 * (gap - least))
    with pytest.raises(MotionRefused, match=f"{least:.4f} m must remain"):
        judged(gap - 0.9 * least)


class Standing:
    """A way that goes nowhere."""

    duration = 1.0

    def __init__(self, setpoint: Setpoint) -> None:
        self._setpoint = setpoint

    def at(self, time: float) -> Setpoint:
        return self._setpoint


def test_a_stop_out_of_a_trajectory_that_would_touch_is_reported() -> None:
    """The tip flies at 2 rad/s towards a ball that the way itself does not reach."""
    moving = replace(rest(np.zeros(2)), velocity=np.array([2.0, 0.0]))
    ahead = tip(np.array([0.2, 0.0])) + np.array([0.0, 0.03, 0.0])
    collision = CollisionModel(with_ball(ahead, 0.01))
    assert collision.distances(np.zeros((1, 2))).min() > 0.1
    told = run_to_end(trajectory_stop_contact(collision, Standing(moving), LIMITS))
    assert told is not None
    assert told.startswith("a stop out of the trajectory at 0.00 s would touch: elbow - obstacle ball, -0.")
    assert run_to_end(trajectory_stop_contact(collision, Standing(rest(np.zeros(2))), LIMITS)) is None


def test_a_run_is_refused_for_a_stop_out_of_its_approach_too() -> None:
    """Far below the motion, a ball that neither the motion nor the approach reaches."""
    low = np.array([-1.6, 0.0])
    ahead = tip(low + np.array([0.2, 0.0]))
    model = with_ball(1.04 * ahead, 0.05, clearance=0.0)
    path = bench_excitation().path
    require_clear(model, path, [Standing(rest(low))], LIMITS)
    flying = replace(rest(low), velocity=np.array([2.0, 0.0]))
    with pytest.raises(MotionRefused, match=r"a stop out of the trajectory at 0\.00 s would touch: elbow - "):
        require_clear(model, path, [Standing(flying)], LIMITS)


def test_looking_takes_a_bearable_part_of_a_cycle(monkeypatch: pytest.MonkeyPatch) -> None:
    paused, _, model = beside_the_way_back(1.0)
    looked, plain = [0], CollisionModel.distances

    def counted(self: CollisionModel, position: Array) -> Any:
        looked[0] += len(position)
        return plain(self, position)

    surroundings = ClearanceChecker(model, LIMITS)
    monkeypatch.setattr(CollisionModel, "distances", counted)
    most, slices = 0, paused.resume_in_slices(None, surroundings)
    while True:
        looked[0] = 0
        try:
            next(slices)
        except (StopIteration, MotionRefused):
            break
        most = max(most, looked[0])
    assert 0 < most <= 9


@pytest.mark.slow
def test_in_a_run_a_return_that_is_not_clear_is_none(
    make: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[float] = []

    def unclear(self: ClearanceChecker, way_back: Reference, limits: MotionLimits) -> Generator[None, None, None]:
        asked.append(way_back.duration)
        yield
        raise MotionRefused("the table is in the way")

    class Pausing(LocalCommands):
        def lease_ok(self, now_ns: int) -> bool:
            self.pause = 700_000_000 <= now_ns < 1_500_000_000
            return True

    monkeypatch.setattr(ClearanceChecker, "require_clear", unclear)
    bench = make()
    with pytest.raises(ArmFault, match="the table is in the way") as caught:
        run(bench.arm, bench.model, EXCITATION, bench.story, Pausing(), hold_seconds=0.1)
    assert caught.value.code == "no_way_back"
    assert len(asked) > 1  # searched again before it gave up
    assert bench.story.states[-3:] == ["paused", "stopping", "stopped"]
