"""The arm behind emulated drives: the simulated arm's physics, gears that lose nothing, brakes that couple joints."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from drives_bench import GEARS, MS, drives_config
from hypothesis import given
from hypothesis import strategies as st

from ident_service.config.load import load_arm
from ident_service.config.recording import Transmission
from ident_service.config.simulation import SimulatedDriver
from ident_service.errors import DriverError
from sim_backend.build import build_machine
from sim_backend.emulator.body import Body, Gears
from sim_backend.emulator.build import build_emulator
from sim_backend.emulator.motor import Power

WAM = Transmission(
    ratios=(-42.0, 28.25, -28.25, -18.0, 9.7, 9.7, -14.93),
    coupling=(
        (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        (0.0, 1.0, -1 / 1.68, 0.0, 0.0, 0.0, 0.0),
        (0.0, 1.0, 1 / 1.68, 0.0, 0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0, 0.0, 1.0, -1.0, 0.0),
        (0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0),
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
    ),
)


def body_of(folder: Path, **emulation: object) -> Body:
    return build_emulator(drives_config(folder, emulation={"seed": 3, **emulation})).body


def test_gears_of_the_wam_are_those_of_its_tables() -> None:
    gears = Gears(WAM, 7)
    expected = np.zeros((7, 7))
    expected[0, 0], expected[3, 3], expected[6, 6] = -42.0, -18.0, -14.93
    expected[1, 1:3], expected[2, 1:3] = (28.25, -28.25 / 1.68), (-28.25, -28.25 / 1.68)
    expected[4, 4:6], expected[5, 4:6] = (9.7, -9.7), (9.7, 9.7)
    assert gears.matrix == pytest.approx(expected)


@given(st.lists(st.floats(-3.0, 3.0), min_size=14, max_size=14))
def test_gears_lose_no_power(values: list[float]) -> None:
    gears = Gears(WAM, 7)
    speed, torque = np.array(values[:7]), np.array(values[7:])
    at_motors = torque @ gears.motor_velocity(speed)
    assert gears.joint_torque(torque) @ speed == pytest.approx(at_motors, abs=1e-9)


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_at_the_nominal_period_it_is_the_simulated_arm_to_the_bit(tmp_path: Path, noise: float) -> None:
    body = body_of(tmp_path, torque_noise=noise)
    simulated = SimulatedDriver(kind="simulated", seed=3, torque_noise=noise)
    machine = build_machine(load_arm("planar2").model_copy(update={"driver": simulated, "joints": {}}))
    # Home is the same without the limits, which would clip what the simulated arm makes of a torque.
    assert (machine.plant.position == body.plant.position).all()
    machine.enable()
    body.set_clock(0)
    random = np.random.default_rng(1)
    for cycle in range(500):
        at_motors = random.uniform(-0.5, 0.5, 2)
        for motor, torque in zip(body.motors, at_motors.tolist(), strict=True):
            motor.drive(torque, cycle * MS)
        machine.cycle(body.gears.joint_torque(at_motors))
        machine.advance()
        body.advance((cycle + 1) * MS)
        assert (machine.plant.position == body.plant.position).all()
        assert (machine.plant.velocity == body.plant.velocity).all()
    assert np.abs(body.plant.velocity).max() > 0.1


def test_uneven_cycles_lead_to_nearly_the_same_place(tmp_path: Path) -> None:
    ends = []
    for divided in (False, True):
        body = body_of(tmp_path)
        body.set_clock(0)
        now = 0
        for motor in body.motors:
            motor.drive(0.1, 0)
        random = np.random.default_rng(5)
        while now < 300 * MS:
            now = min(300 * MS, now + (round(random.uniform(0.2, 1.4) * MS) if divided else MS))
            body.advance(now)
        ends.append(body.plant.position)
    assert np.abs(ends[0]).max() > 0.1
    assert ends[1] == pytest.approx(ends[0], abs=2e-6)


def test_a_long_silence_is_watched_in_steps(tmp_path: Path) -> None:
    body, seen = body_of(tmp_path), []
    body.watch = seen.append
    body.set_clock(0)
    for motor in body.motors:
        motor.drive(0.0, 0)
    body.advance(10 * MS)
    assert len(seen) >= 5
    assert seen == sorted(seen)
    assert max(np.diff([0, *seen, 10 * MS])) <= 1.5 * MS


def test_nobody_falls_before_all_motors_have_power_and_some_torque(tmp_path: Path) -> None:
    body = body_of(tmp_path)
    start = body.plant.position
    body.motors[0].drive(1.0, 0)
    body.advance(100 * MS)
    assert body.plant.position is start
    body.motors[1].drive(0.0, 100 * MS)
    body.motors[0].drive(0.0, 100 * MS)
    body.advance(200 * MS)
    assert body.plant.position is start
    body.motors[0].drive(1e-3, 200 * MS)
    body.advance(300 * MS)
    assert (body.plant.position != start).any()


@pytest.mark.parametrize("braked", [(0,), (1,), (0, 1)])
def test_braking_takes_the_energy_that_motors_turn_into_heat(tmp_path: Path, braked: tuple[int, ...]) -> None:
    body = body_of(tmp_path)
    plant, gears = body.plant, body.gears
    body.set_clock(0)
    for motor in body.motors:
        motor.drive(0.05, 0)
    body.advance(200 * MS)
    for number, motor in enumerate(body.motors):
        if number in braked:
            motor.brake(200 * MS)
        else:
            motor.switch_off(200 * MS)
    coefficients = np.array([m.braking if m.power is Power.BRAKE else 0.0 for m in body.motors])
    body.advance(205 * MS)  # the step in which brakes close sees the acceleration before
    for cycle in range(205, 400):
        q0, v0 = plant.position, plant.velocity
        body.advance((cycle + 1) * MS)
        q, v, a = (q0 + plant.position) / 2, (v0 + plant.velocity) / 2, plant.acceleration
        # What the true model needs beyond friction is what the brakes give, turned over the gears by power balance.
        needed = plant.inverse_dynamics(q, v, a)
        speed = gears.motor_velocity(v)
        heat = coefficients @ speed**2
        assert -needed @ v == pytest.approx(heat, rel=2e-3, abs=2e-3)


def test_all_motors_together_brake_no_joint_less_than_requested(tmp_path: Path) -> None:
    gears = Gears(WAM, 7)
    asked = np.array([15.0, 15.0, 11.0, 7.0, 2.5, 2.5, 0.3])
    felt = gears.joint_damping(gears.motor_damping(asked))
    assert (np.diag(felt) >= asked - 1e-12).all()
    assert np.linalg.eigvalsh(felt).min() > 0.0
    one = gears.joint_damping(np.where(np.arange(7) == 1, gears.motor_damping(asked), 0.0))
    assert one[1, 2] != 0.0


def test_gears_of_another_arm_are_refused() -> None:
    with pytest.raises(DriverError, match="7 ratios in transmission, but the arm has 6 joints"):
        Gears(WAM, 6)


def test_an_encoder_counts_motor_turns_from_the_zero_of_the_joints(tmp_path: Path) -> None:
    gears = dict(GEARS, offsets=[0.3, -0.2])
    absolute = build_emulator(drives_config(tmp_path, gears=gears)).body
    expected = gears["ratios"] * (np.array(gears["coupling"]) @ (absolute.plant.position - [0.3, -0.2]))
    counts = [motor.encoder(0) for motor in absolute.motors]
    assert counts == np.rint(expected * 4096 / (2 * np.pi)).astype(int).tolist()
    relative = build_emulator(drives_config(tmp_path, gears=gears, zero="at_home"))
    relative.power_up(0)
    assert [motor.encoder(0) for motor in relative.body.motors] == [0, 0]


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_a_step_that_was_prepared_is_the_step_to_the_bit(tmp_path: Path, noise: float) -> None:
    prepared, plain = (body_of(tmp_path, torque_noise=noise) for _ in range(2))
    random = np.random.default_rng(1)
    taken = 0
    for cycle in range(300):
        at_motors = random.uniform(-0.5, 0.5, 2).tolist()
        for body in (prepared, plain):
            for motor, torque in zip(body.motors, at_motors, strict=True):
                motor.drive(torque, cycle * MS)
        prepared.prepare()
        foreseen = prepared._prepared
        changed = cycle % 50
        for body in (prepared, plain):  # what changes after it was prepared counts
            if changed == 10:
                body.motors[0].drive(0.25, cycle * MS)
            elif changed == 20 and not noise:  # which acts on no joint that is braked, and is drawn for none then
                body.motors[1].brake(cycle * MS)
            elif changed == 30:
                body.plant.attach_loads(((0.5 + cycle * 1e-3, (0.0, 0.0, 0.0)),))
            body.advance((cycle + 1) * MS)
        taken += foreseen is not None and foreseen[1][0] is prepared.plant.position
        assert (prepared.plant.position == plain.plant.position).all()
        assert (prepared.plant.velocity == plain.plant.velocity).all()
    assert taken == 300 - 1 - (12 if noise else 18)  # the first, and two or three of each fifty


def test_cycles_a_little_early_or_late_find_the_motors_where_their_speed_has_brought_them(tmp_path: Path) -> None:
    body, exact = (body_of(tmp_path) for _ in range(2))
    body.slack_ns = MS // 20
    random = np.random.default_rng(1)
    for motor, other in zip(body.motors, exact.motors, strict=True):
        motor.drive(0.5, 0)
        other.drive(0.5, 0)
    for cycle in range(1, 200):
        body.prepare()
        at = cycle * MS + int(random.integers(-body.slack_ns, body.slack_ns))
        found = [body.angle(motor, at) for motor in range(2)]
        assert found == pytest.approx([exact.angle(motor, at) for motor in range(2)], abs=2e-5)  # of 20 turns a joint
        assert body.now_ns == cycle * MS
        body.catch_up(at)
        assert abs(body.now_ns - at) <= body.slack_ns
    late = 200 * MS + 3 * body.slack_ns
    body.advance(late)  # too late for a step in advance
    assert body.now_ns == late


def test_a_late_host_finds_the_arm_moved_on_already(tmp_path: Path) -> None:
    emulator = build_emulator(drives_config(tmp_path))
    emulator.power_up(0)
    body = emulator.body
    emulator.compute_ahead(100 * MS)
    assert (body.overdue_ns, body.now_ns) == (None, 0)  # somebody holds it
    for motor in body.motors:
        motor.drive(0.5, 0)
    body.advance(MS)
    assert not body.supported
    start = body.plant.position
    emulator.compute_ahead(MS + MS)  # a cycle that is in time needs nothing
    assert body.plant.position is start
    assert body.overdue_ns is not None
    assert 2 * MS < body.overdue_ns <= MS + 1.5 * MS
    emulator.compute_ahead(body.overdue_ns)
    assert (body.plant.position != start).any()
