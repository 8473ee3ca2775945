"""The control law is eq. 76, and its velocity is what a low-pass makes of encoder differences."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from motion_bench import PRIOR, bench_limits, bench_model

from ident_service.model.rigid_body import InverseDynamics
from ident_service.motion.control import ComputedTorque
from ident_service.motion.reference import Setpoint, rest

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
