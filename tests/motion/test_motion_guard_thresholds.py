"""The numbers of the guard, and that what is compared at once has the same thresholds as what is put into words."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NoReturn

import numpy as np
import pytest
from guard_bench import HOME, LIMITS, NAMES, PERIOD, STILL, WINDOW, Bench, is_fault, unit
from motion_bench import bench_model

from drivers.axis_status import AxisStatus
from ident_service.config.motion_limits import Vector
from ident_service.model.collision import Contact
from ident_service.model.pinocchio_models import InverseDynamics
from ident_service.motion import safety_monitor as checks
from ident_service.motion import safety_monitor as guard
from ident_service.motion.encoder_observer import FrozenEncoderObserver
from ident_service.motion.safety_monitor import approach_speed

Array = np.ndarray


def test_the_thresholds_are_the_ones_decided_on() -> None:
    # Every other test takes them from the code, and so would follow a slip of the finger.
    assert (checks.MAX_AGE, checks.VELOCITY_STOP, checks.VELOCITY_OFF, checks.JUMP) == (3, 1.2, 2.0, 4.0)
    assert (checks.FROZEN_CYCLES, checks.FROZEN_EFFORT) == (20, 0.2)
    assert (checks.SUDDEN_CYCLES, checks.SUDDEN_SPEED) == (10, 0.1)
    assert (checks.ENVELOPE, checks.ENVELOPE_SLACK) == (1.5, 0.2)
    assert (checks.FOLLOWING_LOST, checks.NOT_APPLIED, guard.ABSURD) == (2.0, 0.1, 3.0)


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail where a sample is looked at threshold by threshold."""

    def asked(seen: checks.MonitoredSample, limits: Any) -> NoReturn:
        pytest.fail("a healthy sample was looked at threshold by threshold")

    monkeypatch.setattr(guard, "checks", asked)


def fast(joint: int, side: float) -> None:
    velocity = side * 0.999 * checks.VELOCITY_STOP * LIMITS.velocity * unit(joint)
    assert Bench().see(HOME + PERIOD * velocity, velocity=velocity)[1] is None


def far_from_its_reference(joint: int, side: float) -> None:
    away = side * 0.999 * LIMITS.following_error * unit(joint)
    assert Bench().see(HOME + 1e-5, HOME + 1e-5 + away)[1] is None


def at_its_limit(joint: int, side: float) -> None:
    edge = np.where(unit(joint) > 0.0, LIMITS.upper if side > 0.0 else LIMITS.lower, HOME)
    assert Bench(edge).see(edge)[1] is None


def quick_towards_its_limit(joint: int, side: float) -> None:
    edge = np.where(unit(joint) > 0.0, (LIMITS.upper if side > 0.0 else LIMITS.lower) - side * 0.05, HOME)
    velocity = side * 0.999 * approach_speed(np.full(2, 0.05), LIMITS) * unit(joint)
    assert Bench(edge).see(edge, velocity=velocity)[1] is None


def a_step_aside(joint: int, side: float) -> None:
    velocity = 0.5 * LIMITS.velocity
    for cycles in (1, 4):
        there = HOME + cycles * PERIOD * velocity + side * 0.999 * WINDOW * unit(joint)
        assert Bench().see(there, velocity=velocity, elapsed=cycles * PERIOD)[1] is None


def less_torque_than_asked_for(joint: int, side: float) -> None:
    bench = Bench()
    bench.guard.limit_torque(side * LIMITS.torque * unit(joint))
    acting = side * (1.0 - 0.999 * checks.NOT_APPLIED) * LIMITS.torque * unit(joint)
    assert bench.see(HOME, torque=acting, measured=STILL)[1] is None


def powered_for_the_first_time(joint: int, side: float) -> None:
    bench, on = Bench(), int(AxisStatus.POWERED)
    for status in ((0, 0), (on, 0) if joint == 0 else (0, on), (on, on)):
        assert bench.see(HOME, status=status)[1] is None


def near_the_floor(joint: int, side: float) -> None:
    bodies = {name: [{"from": (-0.5, 0.0, 0.0), "to": (0.0, 0.0, 0.0), "radius": 0.05}] for name in NAMES}
    workspace = {"obstacles": {"floor": {"half_space": {"normal": (0.0, 1.0, 0.0), "offset": -0.2}}}}
    bench = Bench(contact=Contact(bench_model(geometry=bodies, workspace=workspace)))
    assert bench.see(HOME)[1] is None


HEALTHY = (
    fast,
    far_from_its_reference,
    at_its_limit,
    quick_towards_its_limit,
    a_step_aside,
    less_torque_than_asked_for,
    powered_for_the_first_time,
    near_the_floor,
)


@pytest.mark.usefixtures("at_once")
@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("healthy", HEALTHY, ids=lambda healthy: healthy.__name__)
def test_what_is_just_healthy_is_found_so_at_once(
    healthy: Callable[[int, float], None], joint: int, side: float
) -> None:
    healthy(joint, side)


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("healthy", HEALTHY, ids=lambda healthy: healthy.__name__)
def test_what_is_just_healthy_is_so_threshold_by_threshold(
    healthy: Callable[[int, float], None], joint: int, side: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guard.SafetyMonitor, "_quiet", lambda *_: False)
    healthy(joint, side)


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_limit_that_was_passed_is_named(joint: int, side: float) -> None:
    limit = (LIMITS.upper if side > 0.0 else LIMITS.lower)[joint]
    position = np.where(unit(joint) > 0.0, limit + side * 0.01, HOME)
    fault = Bench(position).see(position)[1]
    is_fault(fault, "position_limit", joint)
    assert fault is not None
    assert f"at {limit + side * 0.01:.4g} rad, beyond the limit of {limit:.4g} rad" in fault.message


@pytest.mark.parametrize("joint", [0, 1])
def test_an_encoder_that_stops_while_another_joint_stands_is_frozen(joint: int) -> None:
    bench, velocity = Bench(), 0.5 * LIMITS.velocity * unit(joint)
    for cycle in range(5):
        assert bench.see(HOME + cycle * PERIOD * velocity, velocity=velocity)[1] is None
    frozen = HOME + 4 * PERIOD * velocity
    faults = [bench.see(frozen, velocity=velocity)[1] for _ in range(checks.SUDDEN_CYCLES)]
    assert faults[:-1] == [None] * (checks.SUDDEN_CYCLES - 1)
    is_fault(faults[-1], "frozen_encoder", joint)


def test_a_push_of_just_the_share_freezes_nothing() -> None:
    bench, push = Bench(), checks.FROZEN_EFFORT * LIMITS.torque
    assert [bench.see(HOME, correction=push)[1] for _ in range(3 * checks.FROZEN_CYCLES)] == [
        None
    ] * 3 * checks.FROZEN_CYCLES


@pytest.mark.parametrize("wanted", [(8.0, -8.0), (8.0, 8.0), (-8.0, 0.0)])
def test_torques_of_all_joints_are_led_where_they_jump_together(wanted: tuple[float, float]) -> None:
    guarded = Bench().guard
    guarded.limit_torque(STILL)
    leaves, fault = guarded.limit_torque(np.array(wanted))
    is_fault(fault, "torque_rate")
    np.testing.assert_allclose(leaves, np.sign(wanted) * guarded.rate)
    assert fault is not None
    changes = ", ".join(f"{1000.0 * change:g}" for change in wanted if change)
    allowed = ", ".join("1000" for change in wanted if change)
    assert f": the torque was to change by {changes} N m/s, {allowed} allowed: " in fault.message


def test_a_torque_that_changes_as_fast_as_it_may_is_not_led() -> None:
    guarded = Bench().guard
    guarded.limit_torque(STILL)
    leaves, fault = guarded.limit_torque(guarded.rate)
    assert fault is None
    np.testing.assert_array_equal(leaves, guarded.rate)


def test_a_small_joint_may_go_from_no_torque_to_all_in_ten_milliseconds() -> None:
    small = replace(LIMITS, torque=np.array([4.0, 15.0]))
    rate = guard.SafetyMonitor(NAMES, small, PERIOD, HOME).rate
    np.testing.assert_allclose(rate, [4.0 / 10.0, 1.0])


class Heard(FrozenEncoderObserver):
    """An observer that keeps the steps it was told."""

    def update(self, steps: Vector, *others: Vector) -> Array:
        self.steps = [*getattr(self, "steps", []), steps.tolist()]
        return super().update(steps, *others)


def test_the_observer_gets_the_step_of_each_position() -> None:
    model = bench_model()
    assert model.prior is not None
    dynamics = InverseDynamics(model.chain, model.layout, model.prior)
    heard = Heard(dynamics, LIMITS, PERIOD, np.array([0.8, 0.3]), np.full(2, 1e-5))
    bench, step = Bench(encoder_observer=heard), 1e-5 * np.array([1.0, -1.0])
    for position, valid in ((HOME, (True, True)), (HOME + step, (True, True)), (HOME, (True, False))):
        bench.see(position, valid=valid, answer=STILL)
    np.testing.assert_allclose(heard.steps, [[0.0, 0.0], step, [-step[0], 0.0]], rtol=1e-9)


@pytest.mark.parametrize("joint", [0, 1])
def test_jumps_in_a_row_are_counted_from_the_first_after_another_axis_was_lost(joint: int) -> None:
    bench, jump = Bench(), HOME + 0.5 * unit(joint)
    is_fault(bench.see(HOME, valid=(joint == 0, joint == 1))[1], "lost_feedback", 1 - joint)
    is_fault(bench.see(jump, HOME)[1], "encoder_jump", joint)
    is_fault(bench.see(jump, HOME)[1], "encoder_jumps", joint)


@pytest.mark.parametrize("joint", [0, 1])
def test_a_push_is_counted_from_its_own_begin(joint: int) -> None:
    bench, push = Bench(), 1.01 * checks.FROZEN_EFFORT * LIMITS.torque
    faults = []
    for cycle in range(5 + checks.FROZEN_CYCLES):
        position = HOME + 1e-5 * cycle * unit(1 - joint)
        correction = push * unit(1 - joint) if cycle < 5 else push
        faults.append(bench.see(position, correction=correction)[1])
    assert faults[:-1] == [None] * (4 + checks.FROZEN_CYCLES)
    is_fault(faults[-1], "frozen_encoder", joint)


def test_twice_the_following_error_allowed_is_not_lost_yet() -> None:
    middle = np.zeros(2)
    fault = Bench(middle).see(middle, checks.FOLLOWING_LOST * LIMITS.following_error * unit(0))[1]
    is_fault(fault, "following_error", 0)
