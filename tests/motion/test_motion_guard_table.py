"""Every fault of the table is found, with its reaction, its joint and one sentence."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from guard_bench import HOME, LIMITS, LOWER, NAMES, OFF, PERIOD, QUICK, STOP, WARN, WINDOW, Bench, is_fault, unit
from motion_bench import bench_model

from drivers.arm import StopKind
from drivers.axis_status import AxisEventCode, AxisStatus
from ident_service.model.collision import Contact
from ident_service.motion.faults import FAULTS, Fault, FaultCounter, Reaction, Severity
from ident_service.motion.safety_monitor import (
    ABSURD,
    ENVELOPE,
    ENVELOPE_SLACK,
    FOLLOWING_LOST,
    FROZEN_CYCLES,
    FROZEN_EFFORT,
    MAX_AGE,
    NOT_APPLIED,
    PUSHES,
    TORQUE_RATE,
    TORQUE_RATE_SHARE,
    VELOCITY_OFF,
    VELOCITY_STOP,
    approach_speed,
)

Array = np.ndarray
ON = int(AxisStatus.POWERED)
TRUTHLESS = np.zeros(2)


def torque_saturated(joint: int) -> Fault | None:
    return Bench().guard.limit_torque(1.01 * LIMITS.torque * unit(joint))[1]


def torque_rate(joint: int) -> Fault | None:
    guard = Bench().guard
    guard.limit_torque(TRUTHLESS)
    return guard.limit_torque(1.01 * guard.rate * unit(joint))[1]


def torque_absurd(joint: int) -> Fault | None:
    return Bench().guard.limit_torque(-1.01 * ABSURD * LIMITS.torque * unit(joint))[1]


def torque_not_finite(joint: int) -> Fault | None:
    return Bench().guard.limit_torque(np.where(unit(joint) > 0.0, np.nan, 0.0))[1]


def torque_not_applied(joint: int) -> Fault | None:
    bench = Bench()
    bench.guard.limit_torque(TRUTHLESS)
    assert bench.see(HOME, torque=0.99 * NOT_APPLIED * LIMITS.torque)[1] is None
    return bench.see(HOME, torque=-1.01 * NOT_APPLIED * LIMITS.torque * unit(joint))[1]


def torque_measured_otherwise(joint: int) -> Fault | None:
    bench = Bench()
    assert bench.see(HOME, torque_difference=0.99 * NOT_APPLIED * LIMITS.torque)[1] is None
    return bench.see(HOME, torque_difference=-1.01 * NOT_APPLIED * LIMITS.torque * unit(joint))[1]


def encoder_jump(joint: int) -> Fault | None:
    return Bench().see(HOME + 1.01 * WINDOW * unit(joint), HOME)[1]


def encoder_jumps(joint: int) -> Fault | None:
    bench = Bench()
    bench.see(HOME + 0.5 * unit(joint), HOME)
    return bench.see(HOME + 0.5 * unit(joint), HOME)[1]


def lost_feedback(joint: int) -> Fault | None:
    return Bench().see(HOME, valid=(joint != 0, joint != 1))[1]


def feedback_gone(joint: int) -> Fault | None:
    bench = Bench()
    faults = [bench.see(HOME, valid=(joint != 0, joint != 1))[1] for _ in range(MAX_AGE)]
    return faults[-1]


def stale_from_the_start(joint: int) -> Fault | None:
    age = np.where(unit(joint) > 0.0, MAX_AGE, 0)
    return Bench().see(HOME, valid=(joint != 0, joint != 1), age=age)[1]


def feedback_not_finite(joint: int) -> Fault | None:
    return Bench().see(np.where(unit(joint) > 0.0, np.nan, HOME), HOME)[1]


def velocity_not_finite(joint: int) -> Fault | None:
    assert Bench().see(HOME, measured=TRUTHLESS)[1] is None
    return Bench().see(HOME, measured=np.where(unit(joint) > 0.0, np.inf, 0.0))[1]


def acting_torque_not_finite(joint: int) -> Fault | None:
    bench, acting = Bench(), np.where(unit(joint) > 0.0, np.nan, 0.0)
    assert is_fault(bench.see(HOME, torque=acting)[1], "feedback_not_finite", joint)  # before any torque
    bench.guard.limit_torque(TRUTHLESS)
    return bench.see(HOME, torque=acting)[1]


def position_limit(joint: int) -> Fault | None:
    edge = np.where(unit(joint) > 0.0, LIMITS.upper + 1e-9, HOME)
    return Bench(edge).see(edge)[1]


def position_envelope(joint: int) -> Fault | None:
    near = np.where(unit(joint) > 0.0, LIMITS.upper - 0.01, HOME)
    speed = np.sqrt(2.0 * ENVELOPE * LIMITS.acceleration * 0.01 + (ENVELOPE_SLACK * LIMITS.velocity) ** 2)
    np.testing.assert_allclose(approach_speed(np.full(2, 0.01), LIMITS), speed)
    assert Bench(near).see(near, velocity=0.999 * speed * unit(joint))[1] is None
    assert Bench(near).see(near, velocity=-1.001 * speed * unit(joint))[1] is None
    below = np.where(unit(joint) > 0.0, LIMITS.lower + 0.01, HOME)
    is_fault(Bench(below).see(below, velocity=-1.001 * speed * unit(joint))[1], "position_envelope", joint)
    return Bench(near).see(near, velocity=1.001 * speed * unit(joint))[1]


def far_outside(joint: int) -> Fault | None:
    far = np.where(unit(joint) > 0.0, LIMITS.lower - 1.01 * LIMITS.following_error, HOME)
    return Bench(far).see(far)[1]


def over_velocity(joint: int) -> Fault | None:
    return Bench().see(HOME, velocity=-1.01 * VELOCITY_STOP * LIMITS.velocity * unit(joint))[1]


def runaway(joint: int) -> Fault | None:
    return Bench().see(HOME, velocity=1.01 * VELOCITY_OFF * LIMITS.velocity * unit(joint))[1]


def following_error(joint: int) -> Fault | None:
    return Bench().see(HOME, HOME + 1.01 * LIMITS.following_error * unit(joint))[1]


def following_lost(joint: int) -> Fault | None:
    return Bench().see(HOME, HOME - 1.01 * FOLLOWING_LOST * LIMITS.following_error * unit(joint))[1]


def frozen_encoder(joint: int) -> Fault | None:
    bench, push = Bench(), -1.01 * FROZEN_EFFORT * LIMITS.torque * unit(joint)
    return [bench.see(HOME, correction=push)[1] for _ in range(FROZEN_CYCLES)][-1]


def says(joint: int, bits: int) -> Fault | None:
    bench = Bench()
    assert bench.see(HOME, status=(ON, ON))[1] is None
    return bench.see(HOME, status=(bits, ON) if joint == 0 else (ON, bits))[1]


def drive_fault(joint: int) -> Fault | None:
    return says(joint, ON | AxisStatus.FAULT)


def drive_off(joint: int) -> Fault | None:
    return says(joint, int(AxisStatus.IDLE))


def drive_watchdog(joint: int) -> Fault | None:
    return says(joint, AxisStatus.WATCHDOG | AxisStatus.IDLE)


def emergency_stop(joint: int) -> Fault | None:
    return says(joint, AxisStatus.EMERGENCY_STOP | AxisStatus.IDLE)


def repeated_warnings(joint: int) -> Fault | None:
    bench = Bench()
    for cycle in range(FAULTS["lost_feedback"].often):
        is_fault(bench.see(HOME, valid=(joint != 0, joint != 1))[1], "lost_feedback", joint)
        for _ in range(cycle % 3 + 1):
            assert bench.see(HOME)[1] is None
    fault = bench.see(HOME, valid=(joint != 0, joint != 1))[1]
    assert fault is not None
    assert fault.message.startswith(f"lost_feedback in more than 20 of the last 100 cycles ({NAMES[joint]}: ")
    return Fault(fault.code, fault.reaction, f"{NAMES[joint]}: ")


def of_positions() -> Bench:
    """A guard of drives that are given positions."""
    return Bench(most_torque=LIMITS.torque)


def position_rate(joint: int) -> Fault | None:
    return of_positions().guard.limit_position(HOME + 1.01 * VELOCITY_STOP * LIMITS.velocity * PERIOD * unit(joint))[1]


def position_outside(joint: int) -> Fault | None:
    return of_positions().guard.limit_position(np.where(unit(joint) > 0.0, LIMITS.upper + 1e-6, HOME))[1]


def position_not_finite(joint: int) -> Fault | None:
    return of_positions().guard.limit_position(np.where(unit(joint) > 0.0, np.nan, HOME))[1]


def torque_exceeded(joint: int) -> Fault | None:
    return of_positions().see(HOME, torque=1.01 * LIMITS.torque * unit(joint))[1]


def torque_unexplained(joint: int) -> Fault | None:
    bench, fault = of_positions(), None
    for number in range(FROZEN_CYCLES):
        assert fault is None
        fault = bench.see(HOME + number * 1e-5, unexplained=1.01 * PUSHES * LIMITS.torque * unit(joint))[1]
    return fault


TRIGGERS: dict[str, Callable[[int], Fault | None]] = {
    trigger.__name__: trigger
    for trigger in (
        torque_saturated,
        torque_rate,
        torque_absurd,
        torque_not_finite,
        torque_not_applied,
        encoder_jump,
        encoder_jumps,
        lost_feedback,
        feedback_gone,
        feedback_not_finite,
        position_limit,
        position_envelope,
        far_outside,
        over_velocity,
        runaway,
        following_error,
        following_lost,
        frozen_encoder,
        drive_fault,
        drive_watchdog,
        emergency_stop,
        repeated_warnings,
        position_rate,
        position_outside,
        position_not_finite,
        torque_exceeded,
        torque_unexplained,
    )
}
OTHER_TRIGGERS = {
    torque_measured_otherwise: "torque_not_applied",
    stale_from_the_start: "feedback_gone",
    velocity_not_finite: "feedback_not_finite",
    acting_torque_not_finite: "feedback_not_finite",
    drive_off: "drive_fault",
}
# Found by others than the guard: test_motion_deadlines.py, test_motion_run_*.py, and below.
FOUND_ELSEWHERE = {
    *("late_cycle", "late_cycles", "bus_silent", "clock_jump"),
    *("driver", "recorder_behind", "program", "lease_lost", "controls_failed", "no_way_back"),
    *("not_at_rest", "hold_lost", "workspace"),
    *(code.value for code in AxisEventCode),
}


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("code", sorted(TRIGGERS))
def test_a_fault_is_found_and_names_its_joint(code: str, joint: int) -> None:
    is_fault(TRIGGERS[code](joint), code, joint)


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("trigger", OTHER_TRIGGERS, ids=lambda trigger: trigger.__name__)
def test_a_fault_is_found_by_other_signs_too(trigger: Callable[[int], Fault | None], joint: int) -> None:
    is_fault(trigger(joint), OTHER_TRIGGERS[trigger], joint)


def test_every_fault_of_the_table_is_triggered() -> None:
    assert set(TRIGGERS) | FOUND_ELSEWHERE == set(FAULTS)


def test_the_reactions_are_those_of_the_fault_table() -> None:
    by_reaction = {reaction: {code for code in FAULTS if FAULTS[code].reaction is reaction} for reaction in Reaction}
    assert by_reaction[WARN] == {
        *("torque_saturated", "torque_rate", "torque_not_applied", "encoder_jump", "lost_feedback", "late_cycle"),
        *("drive_notice", "drive_warning", "torque_limited", "strange_frame", "torque_exceeded", "position_rate"),
    }
    assert by_reaction[STOP] == {
        *("repeated_warnings", "late_cycles", "encoder_jumps", "position_envelope", "position_limit", "over_velocity"),
        *("following_error", "workspace", "lease_lost", "controls_failed", "no_way_back", "recorder_behind"),
        *("bus_degraded", "status_stale", "joint_encoder_lost"),
    }
    assert by_reaction[LOWER] == {"following_lost"}
    assert by_reaction[OFF] == {"emergency_stop", "feedback_not_finite", "frozen_encoder", "far_outside", "runaway"}
    assert WARN < STOP < LOWER < QUICK < OFF
    assert [reaction.stop_kind for reaction in (STOP, LOWER, QUICK)] == [StopKind.QUICK_STOP] * 3
    assert OFF.stop_kind is StopKind.TORQUE_OFF


def test_severity_follows_from_the_reaction() -> None:
    assert [FAULTS[code].severity for code in ("late_cycle", "following_error", "following_lost")] == [30, 40, 40]
    assert FAULTS["runaway"].severity is FAULTS["driver"].severity is Severity.FATAL
    assert Fault("runaway", OFF, "").severity is Severity.FATAL


def test_every_warning_becomes_something_worse() -> None:
    for rule in FAULTS.values():
        assert 0 < rule.often < 100
        assert FAULTS[rule.becomes].reaction > WARN


def test_old_warnings_are_forgotten() -> None:
    findings = FaultCounter()
    for _ in range(1000):
        findings.cycle += 5
        assert findings.count_fault("torque_rate", "x").code == "torque_rate"
    assert findings.warnings == {"torque_rate": 1000}


def test_a_sentence_names_all_joints_with_numbers_and_limits() -> None:
    fault = Bench().see(HOME, velocity=np.array([3.0, -4.0]))[1]
    assert fault is not None
    assert fault.message.startswith(
        "shoulder, elbow: moves at 3, -4 rad/s, more than 1.2 times the limit of 2, 3 rad/s: "
    )
    fault = Bench(revolute=(True, False)).see(HOME, velocity=np.array([0.0, -4.0]))[1]
    assert fault is not None
    assert fault.message.startswith("elbow: moves at -4 m/s, more than 1.2 times the limit of 3 m/s: ")


@pytest.mark.parametrize(("joint", "unit_of_torque"), [(0, "N m"), (1, "N")])
def test_torques_are_reported_in_the_unit_of_the_joint(joint: int, unit_of_torque: str) -> None:
    def told(fault: Fault | None) -> str:
        assert fault is not None
        return fault.message

    asked = unit(joint) * LIMITS.torque
    guard = Bench(revolute=(True, False)).guard
    assert f"{2.0 * LIMITS.torque[joint]:.4g} {unit_of_torque} was requested" in told(
        guard.limit_torque(2.0 * asked)[1]
    )
    assert f"{4.0 * LIMITS.torque[joint]:.4g} {unit_of_torque} was requested" in told(
        guard.limit_torque(4.0 * asked)[1]
    )
    bench = Bench(revolute=(True, False))
    bench.guard.limit_torque(0.5 * asked)
    words = told(bench.see(HOME, torque=np.zeros(2))[1])
    assert f"gives 0 of the {0.5 * LIMITS.torque[joint]:.4g} {unit_of_torque} commanded" in words
    assert f" {unit_of_torque}/s, " in told(
        bench.guard.limit_torque(0.5 * asked - 1.5 * bench.guard.rate * unit(joint))[1]
    )


def test_the_rate_of_torque_is_libfrankas_or_a_share() -> None:
    np.testing.assert_allclose(Bench().guard.rate / PERIOD, [1000.0, 1000.0])
    assert (TORQUE_RATE, TORQUE_RATE_SHARE) == (1000.0, 100.0)


@pytest.mark.parametrize("sent", [np.zeros(2), np.array([5.0, -3.0])])
def test_a_torque_that_jumps_is_led_there(sent: Array) -> None:
    guard = Bench().guard
    guard.limit_torque(sent)
    leaves, fault = guard.limit_torque(sent + np.array([0.5, -8.0]))
    assert fault is not None
    assert fault.message.startswith("elbow: the torque was to change by -8000 N m/s")
    np.testing.assert_allclose(leaves, sent + np.array([0.5, -1.0]))
    np.testing.assert_allclose(guard.limit_torque(sent + np.array([0.5, -8.0]))[0], sent + np.array([0.5, -2.0]))


def test_the_worse_of_two_faults_of_a_torque_is_reported() -> None:
    guard = Bench().guard
    codes = []
    for cycle in range(22):
        guard.findings.cycle = cycle
        guard.limit_torque(np.zeros(2))
        fault = guard.limit_torque(1.5 * LIMITS.torque)[1]
        assert fault is not None
        codes.append(fault.code)
    assert codes[0] == "torque_saturated"
    assert codes[-1] == "repeated_warnings"


def workspace_guard() -> Bench:
    """The bench in a vertical plane, y up, over a floor that its tip may not touch."""
    bodies = {name: [{"from": (-0.5, 0.0, 0.0), "to": (0.0, 0.0, 0.0), "radius": 0.05}] for name in NAMES}
    workspace = {"obstacles": {"floor": {"half_space": {"normal": (0.0, 1.0, 0.0), "offset": -0.5}}}}
    workspace["inside"] = {"x": (-0.5, 1.2)}
    model = bench_model(geometry=bodies, workspace=workspace)
    return Bench(contact=Contact(model))


@pytest.mark.parametrize(("angle", "deep"), [(-0.4, False), (-0.5, True)])
def test_the_arm_stays_in_its_space(angle: float, deep: bool) -> None:
    bench = workspace_guard()
    position = np.array([angle, 0.0])  # the tip is at height sin(angle), on a ball of 0.05
    assert (np.sin(angle) - 0.05 < -0.5) == deep
    bench.guard._position = position
    fault = bench.see(position)[1]
    assert (fault is not None) == deep
    if fault is not None:
        assert (fault.code, fault.reaction) == ("workspace", STOP)
        assert fault.message.startswith("elbow - obstacle floor: touch, 0.02943 m deep: ")


@pytest.mark.parametrize(
    ("position", "pair"),
    [
        ((0.1, -0.1), None),
        ((0.25 * np.pi, 0.0), "elbow - obstacle post"),  # stretched out along the diagonal
        ((0.0, 1.9), "elbow - base"),  # its tip is at (0.338, 0.473)
    ],
)
def test_the_arm_touches_neither_boxes_nor_itself(position: tuple[float, float], pair: str | None) -> None:
    bodies: dict[str, Any] = {
        name: [{"from": (-0.4, 0.0, 0.0), "to": (0.0, 0.0, 0.0), "radius": 0.03}] for name in NAMES
    }
    bodies["base"] = [{"from": (0.338, 0.473, 0.0), "to": (0.338, 0.473, 0.1), "radius": 0.03}]
    workspace = {"obstacles": {"post": {"box": {"center": (0.7, 0.7, 0.0), "size": (0.1, 0.1, 0.1)}}}}
    bench = Bench(np.array(position), contact=Contact(bench_model(geometry=bodies, workspace=workspace)))
    fault = bench.see(np.array(position))[1]
    if pair is None:
        assert fault is None
        return
    assert fault is not None
    assert (fault.code, fault.reaction) == ("workspace", STOP)
    assert fault.message.startswith(f"{pair}: touch, ")


def test_a_velocity_is_reported_with_its_joint_and_unit() -> None:
    bench = Bench(revolute=(True, False))
    assert bench.guard.joint_message(0, "moves at {} too long", 0.5) == "shoulder: moves at 0.5 rad/s too long"
    assert bench.guard.joint_message(1, "moves at {} too long", 0.25) == "elbow: moves at 0.25 m/s too long"


def test_a_lost_axis_is_where_it_was_last_seen() -> None:
    bench = workspace_guard()
    assert bench.see(HOME, valid=(False, True))[1] is not None
    is_fault(bench.see(HOME, valid=(True, False))[1], "lost_feedback")


def test_without_bodies_nothing_is_looked_at() -> None:
    model = bench_model()
    assert Bench(contact=Contact(model)).see(HOME)[1] is None
