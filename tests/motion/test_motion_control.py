"""The control law is eq. 76, and its velocity is what a low-pass makes of encoder differences."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_bench import PRIOR, bench_config, bench_limits, bench_model

from drivers.arm import StopKind
from ident_service.model.arm_model import ArmModel, control_model
from ident_service.model.expected_friction import ExpectedFriction, FrictionFeedforward, expected_friction
from ident_service.model.pinocchio_models import InverseDynamics
from ident_service.motion.controller import ComputedTorque
from ident_service.motion.safety_monitor import TORQUE_RATE
from ident_service.motion.trajectory import Setpoint, rest
from sim_backend.arm import from_config

Array = np.ndarray
LIMITS = bench_limits()
MODEL = bench_model()
assert MODEL.prior is not None
DYNAMICS = InverseDynamics(MODEL.chain, MODEL.layout, MODEL.prior)
PERIOD = 1e-3
ALL = np.array([True, True])
VECTORS = st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0)).map(np.array)


def controller(position: Array, cutoff: float = 30.0) -> ComputedTorque:
    return ComputedTorque(DYNAMICS, LIMITS, PERIOD, cutoff, position)


def independent_model() -> pin.Model:
    """The bench's arm, put together by hand from its table and its parameters."""
    model = pin.Model()
    model.gravity.linear = np.array([0.0, -9.81, 0.0])
    parent, placement = 0, pin.SE3.Identity()
    for k in ("1", "2"):
        parent = model.addJoint(parent, pin.JointModelRZ(), placement, f"j{k}")
        placement = pin.SE3(np.eye(3), np.array([0.5, 0.0, 0.0]))
        # Bodies are given in the frame at the far end of the link (standard convention).
        mass, center = PRIOR[f"m{k}"], np.array([PRIOR[f"lx{k}"] / PRIOR[f"m{k}"], 0.0, 0.0])
        about_origin = np.diag([PRIOR[f"Lxx{k}"], PRIOR[f"Lyy{k}"], PRIOR[f"Lzz{k}"]])
        about_center = about_origin - mass * (center @ center * np.eye(3) - np.outer(center, center))
        model.appendBodyToJoint(parent, pin.Inertia(mass, center, about_center), placement)
    model.armature = np.array([PRIOR["Ia1"], PRIOR["Ia2"]])
    return model


INDEPENDENT = independent_model()


@settings(max_examples=100)
@given(VECTORS, VECTORS, VECTORS, VECTORS, VECTORS)
def test_the_law_is_equation_76(q: Array, moved: Array, q_r: Array, dq_r: Array, ddq_r: Array) -> None:
    control = controller(q)
    step = 1e-3 * moved
    torque = control.torque(q + step, ALL, Setpoint(q_r, dq_r, ddq_r))
    dq = (1.0 - np.exp(-2.0 * np.pi * 30.0 * PERIOD)) * step / PERIOD
    np.testing.assert_allclose(control.velocity, dq, rtol=1e-9, atol=1e-9)
    alpha = ddq_r + LIMITS.kd * (dq_r - dq) + LIMITS.kp * (q_r - q - step)
    data = INDEPENDENT.createData()
    expected = np.array(pin.rnea(INDEPENDENT, data, q + step, dq, alpha))
    np.testing.assert_allclose(torque, expected, rtol=1e-7, atol=1e-7)
    without_errors = pin.rnea(INDEPENDENT, data, q + step, dq, ddq_r)
    np.testing.assert_allclose(control.correction, expected - without_errors, rtol=1e-7, atol=1e-6)


@settings(max_examples=100)
@given(VECTORS)
def test_at_rest_on_the_reference_only_gravity_is_held(q: Array) -> None:
    torque = controller(q).torque(q, ALL, rest(q))
    expected = pin.computeGeneralizedGravity(INDEPENDENT, INDEPENDENT.createData(), q)
    np.testing.assert_allclose(torque, expected, atol=1e-9)


@pytest.mark.parametrize("cutoff", [10.0, 30.0, 60.0])
def test_the_velocity_is_3_db_down_at_the_cutoff(cutoff: float) -> None:
    control = controller(np.zeros(2), cutoff)
    omega = 2.0 * np.pi * cutoff
    cycles = round(40.0 / cutoff / PERIOD)
    times = PERIOD * np.arange(1, cycles + 1)
    seen = np.empty(cycles)
    for k, time in enumerate(times):
        control.torque(np.full(2, np.sin(omega * time) / omega), ALL, rest(np.zeros(2)))
        seen[k] = control.velocity[0]
    late = times > times[-1] / 2.0
    wave = np.exp(1j * omega * times[late])
    gain = 2.0 * abs(np.mean(seen[late] * wave))
    assert gain == pytest.approx(np.sqrt(0.5), rel=0.04)


def test_a_steady_velocity_passes_in_full() -> None:
    control = controller(np.zeros(2))
    speed = np.array([1.5, -0.5])
    for cycle in range(1, 200):
        control.torque(cycle * PERIOD * speed, ALL, rest(np.zeros(2)))
    np.testing.assert_allclose(control.velocity, speed, rtol=1e-6)


def test_samples_that_come_late_or_not_at_all_give_the_velocity_of_the_time_that_has_passed() -> None:
    speed, time = np.array([1.5, -0.5]), 0.0
    control = controller(np.zeros(2))
    for cycle in range(1, 200):
        elapsed = PERIOD * (5.3 if cycle == 150 else 0.8 if cycle == 170 else 1.0)
        time += elapsed
        control.torque(time * speed, ALL, rest(np.zeros(2)), elapsed)
        if cycle > 140:
            np.testing.assert_allclose(control.velocity, speed, rtol=1e-3)
    np.testing.assert_allclose(control.velocity, speed, rtol=1e-6)


@pytest.mark.parametrize("unknown", [1, 2])
def test_an_axis_that_was_away_for_an_unknown_time_keeps_its_velocity(unknown: int) -> None:
    """Nine periods' stall, in which an axis' answer is missed: over one period its way would be tenfold."""
    speed, time = np.array([1.5, -0.5]), 0.0
    control = controller(np.zeros(2))
    for cycle in range(1, 200):
        stalled = 150 <= cycle < 150 + unknown
        time += PERIOD * (10.0 if cycle == 150 else 1.0)
        valid = np.array([not stalled, True])
        control.torque(time * speed, valid, rest(np.zeros(2)), 0.0 if stalled else PERIOD)
        if cycle > 140:
            np.testing.assert_allclose(control.velocity, speed, rtol=1e-3)


@pytest.mark.parametrize("shown", [np.nan, 1e6, 0.0])
def test_an_invalid_axis_is_taken_to_go_on_as_it_went(shown: float) -> None:
    speed = np.array([1.5, -0.5])
    control, healthy = controller(np.zeros(2)), controller(np.zeros(2))
    for cycle in range(1, 200):
        position = cycle * PERIOD * speed
        reference = Setpoint(position, speed, np.zeros(2))
        expected = healthy.torque(position, ALL, reference)
        if cycle in (150, 151):
            torque = control.torque(np.array([shown, position[1]]), np.array([False, True]), reference)
        else:
            torque = control.torque(position, ALL, reference)
        np.testing.assert_allclose(torque, expected, atol=1e-6)
        np.testing.assert_allclose(control.velocity, healthy.velocity, atol=1e-9)


def test_an_axis_that_comes_back_gives_no_kick() -> None:
    # While an axis was away it braked at its limit; its velocity is off by no more than what braking changed.
    control = controller(np.zeros(2))
    brake, speed = LIMITS.acceleration, np.array([1.0, 1.0])
    for cycle in range(1, 200):
        control.torque(cycle * PERIOD * speed, ALL, rest(np.zeros(2)))
    begin = 199 * PERIOD * speed
    for lost in (1, 2, 3):
        since = lost * PERIOD
        valid = np.full(2, lost == 3)
        control.torque(begin + speed * since - 0.5 * brake * since**2, valid, rest(np.zeros(2)))
    assert (np.abs(control.velocity - speed) < 5.0 * brake * PERIOD).all()


def test_what_the_caller_holds_is_not_written_into() -> None:
    start = np.array([0.1, 0.2])
    control = controller(start)
    start[:] = 9.0
    control.torque(np.array([0.1, 0.2]), ALL, rest(np.zeros(2)))
    np.testing.assert_allclose(control.velocity, 0.0, atol=1e-12)


def friction(share: float = 0.8) -> FrictionFeedforward:
    expected = ExpectedFriction(np.array([0.5, 0.2]), np.array([0.3, 0.1]), np.array([0.05, -0.02]))
    return FrictionFeedforward(expected, share, MODEL.chain, LIMITS)


@settings(max_examples=100)
@given(VECTORS, VECTORS, VECTORS, VECTORS)
def test_friction_is_fed_forward_for_the_velocity_of_the_reference_alone(
    q: Array, moved: Array, q_r: Array, dq_r: Array
) -> None:
    """So it closes no loop: whatever a noisy encoder shows, the part of the torque that is friction stays the same."""
    reference = Setpoint(q_r, dq_r, np.zeros(2))
    plain = controller(q).torque(q + 1e-3 * moved, ALL, reference)
    control = ComputedTorque(DYNAMICS, LIMITS, PERIOD, 30.0, q, friction())
    added = control.torque(q + 1e-3 * moved, ALL, reference) - plain
    turned = np.tanh(dq_r / (0.02 * LIMITS.velocity))
    expected = 0.8 * (np.array([0.5, 0.2]) * turned + np.array([0.3, 0.1]) * dq_r) + np.array([0.05, -0.02])
    np.testing.assert_allclose(added, expected, atol=1e-9)
    np.testing.assert_allclose(control.feedforward, expected, atol=1e-9)


@settings(max_examples=100)
@given(st.floats(-3.0, 3.0), st.floats(-0.1, 0.1))
def test_friction_fed_forward_has_no_step_where_the_reference_turns_round(speed: float, more: float) -> None:
    slope = 0.8 * (np.array([0.5, 0.2]) / (0.02 * LIMITS.velocity) + np.array([0.3, 0.1]))
    one, other = (friction().torque(np.full(2, value)) for value in (speed, speed + more))
    assert (np.abs(other - one) <= slope * abs(more) + 1e-12).all()


def test_friction_behind_dry_gears_turns_round_more_slowly_than_the_guard_allows() -> None:
    dry = np.array([40.0, 40.0])
    fed = FrictionFeedforward(ExpectedFriction(dry, np.zeros(2), np.zeros(2)), 0.8, MODEL.chain, LIMITS)
    pace = np.linspace(-1.0, 1.0, 2001)[:, None] * LIMITS.velocity
    steepest = (np.abs(np.diff(fed.torque(pace), axis=0)) / np.diff(pace, axis=0)).max(axis=0)
    assert (steepest * LIMITS.acceleration <= 0.5 * TORQUE_RATE * (1.0 + 1e-9)).all()
    assert (steepest * LIMITS.acceleration > 0.45 * TORQUE_RATE).all()


def test_an_arm_with_far_less_friction_than_expected_comes_to_rest_without_hunting() -> None:
    """A limit cycle would keep the held arm moving; overcompensation ends with the reference's motion."""
    arm = from_config(bench_config(driver={"kind": "simulated", "truth": PRIOR, "encoder_resolution": 1e-4}))
    control = ComputedTorque(DYNAMICS, LIMITS, PERIOD, 30.0, LIMITS.home, friction(0.99))
    seen = []
    with arm:
        first = arm.exchange(None).position.copy()
        arm.enable()
        torque = control.torque(first, ALL, rest(first))
        for cycle in range(2000):
            time = min(cycle * PERIOD, 1.0)
            there = first + 0.1 * np.sin(2.0 * np.pi * time)
            pace = np.full(2, 0.2 * np.pi * np.cos(2.0 * np.pi * time) * (time < 1.0))
            sample = arm.exchange(torque)
            seen.append(sample.position)
            torque = control.torque(sample.position, ALL, Setpoint(there, pace, np.zeros(2)))
        arm.stop(StopKind.TORQUE_OFF)
    assert np.ptp(np.array(seen[-200:]), axis=0).max() <= 2e-4


def test_stated_drive_inertia_is_in_the_computed_torque() -> None:
    joints = {name: joint.model_dump() | {"drive_inertia": 0.3} for name, joint in bench_config().joints.items()}
    model = control_model(bench_model(joints=joints))
    assert model.prior is not None
    stated = InverseDynamics(model.chain, model.layout, model.prior)
    still, wanted = np.zeros(2), np.array([1.0, -2.0])
    more = stated.torque(still, still, wanted) - DYNAMICS.torque(still, still, wanted)
    np.testing.assert_allclose(more, (0.3 - np.array([0.02, 0.01])) * wanted, atol=1e-12)
    less = {name: joint.model_dump() | {"drive_inertia": 0.001} for name, joint in bench_config().joints.items()}
    np.testing.assert_array_equal(control_model(bench_model(joints=less)).prior, MODEL.prior)


def coupled(**changes: Any) -> ArmModel:
    """The bench's arm behind a differential whose drives have the inertia and the friction."""
    gears = {"ratios": [20.0, -20.0], "coupling": COUPLING.tolist(), "drive_terms": "motors"}
    return bench_model(transmission=gears, **changes)


COUPLING = np.array([[1.0, -0.5], [1.0, 0.5]])


@settings(max_examples=100)
@given(VECTORS, VECTORS)
def test_drives_that_move_both_joints_add_their_inertia_to_both(q: Array, wanted: Array) -> None:
    model = coupled()
    assert model.prior is not None
    both = InverseDynamics(model.chain, model.layout, model.prior)
    assert MODEL.prior is not None
    bare = MODEL.prior.copy()
    bare[MODEL.layout.term_columns("drive_inertia")] = 0.0
    links = InverseDynamics(MODEL.chain, MODEL.layout, bare)
    drives = COUPLING.T @ np.diag([PRIOR["Ia1"], PRIOR["Ia2"]]) @ COUPLING
    still = np.zeros(2)
    np.testing.assert_allclose(
        both.torque(q, still, wanted), links.torque(q, still, wanted) + drives @ wanted, atol=1e-9
    )
    np.testing.assert_allclose(both.mass_matrix(q), links.mass_matrix(q) + drives, atol=1e-12)


@settings(max_examples=100)
@given(VECTORS)
def test_friction_of_drives_that_move_both_joints_is_fed_forward_for_their_velocities(pace: Array) -> None:
    expected = ExpectedFriction(np.array([0.5, 0.2]), np.array([0.3, 0.1]), np.array([0.05, -0.02]))
    fed = FrictionFeedforward(expected, 0.8, coupled().chain, LIMITS)
    rate = COUPLING @ pace
    over = 0.02 * np.abs(COUPLING) @ LIMITS.velocity
    felt = 0.8 * (np.array([0.5, 0.2]) * np.tanh(rate / over) + np.array([0.3, 0.1]) * rate) + np.array([0.05, -0.02])
    np.testing.assert_allclose(fed.torque(pace), COUPLING.T @ felt, atol=1e-9)


def test_what_holds_a_joint_is_the_friction_of_all_drives_that_move_it() -> None:
    drives = ExpectedFriction(np.array([0.5, 0.2]), np.array([0.3, 0.1]), np.array([0.05, -0.02]))
    joints = drives.at_joints(coupled().chain)
    np.testing.assert_allclose(joints.coulomb, [0.7, 0.35])
    np.testing.assert_allclose(joints.viscous, [0.4, 0.1])
    own = drives.at_joints(MODEL.chain)
    np.testing.assert_array_equal(own.coulomb, drives.coulomb)
    np.testing.assert_array_equal(own.viscous, drives.viscous)


def test_friction_is_guessed_of_a_drive_by_the_torque_that_joints_ask_of_it() -> None:
    """By `t = C^-T tau` the shoulder's limit of 40 N m asks for (20, 20) N m, the elbow's of 15 for (-15, 15)."""
    guessed = expected_friction(coupled(), LIMITS, (0.02, 0.05))
    np.testing.assert_allclose(guessed.coulomb, [0.02 * 20.0, 0.02 * 20.0])
    # At their limits both joints turn a drive by 2 + 3/2 rad/s.
    np.testing.assert_allclose(guessed.viscous, [0.05 * 20.0 / 3.5] * 2)


@pytest.mark.parametrize("lost", [1, 4, 9])
def test_the_velocity_after_lost_positions_is_over_the_time_since_the_last_one(lost: int) -> None:
    """A joint that gains speed unseen: no velocity that it never had is taken for its own."""
    begin, speed, gains = np.zeros(2), np.array([0.5, -1.0]), np.array([40.0, -60.0])
    control, time, fastest = controller(begin, cutoff=120.0), 0.0, np.zeros(2)
    for cycle in range(1, 60):
        time = cycle * PERIOD
        since = max(0.0, time - 0.030)
        valid = np.array([True, not 35 <= cycle < 35 + lost])
        control.torque(speed * time + 0.5 * gains * since**2, valid, rest(begin))
        fastest = np.maximum(fastest, np.abs(control.velocity))
    np.testing.assert_array_less(fastest, np.abs(speed + gains * 0.030) * 1.01)
    np.testing.assert_allclose(control.velocity, speed + gains * 0.0278, rtol=0.05)
