"""Dry friction: joints that hold, joints that stop, joints that break away."""

import numpy as np
import pytest
from sim_arms import pendulum, plant_of, random_arm, slider

from ident_service.config.load import load_arm
from ident_service.config.quantities import ParameterTable
from sim_backend.arm import from_config

WEIGHT = 2.0 * 9.81 * 0.4  # of the pendulum at zero [N m]


def test_holds_exactly_for_ten_seconds_inside_the_cone():
    plant = plant_of(pendulum(fc=1.0, fv=0.1, fo=0.2), position=np.array([0.0]))
    torque = np.array([WEIGHT + 0.2 + 0.99])
    for _ in range(10_000):
        plant.step(torque)
    assert plant.position[0] == 0.0
    assert plant.velocity[0] == 0.0


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_breaks_away_beyond_the_cone(side):
    plant = plant_of(pendulum(fc=1.0))
    for _ in range(100):
        plant.step(np.array([WEIGHT + side * 1.01]))
    assert plant.velocity[0] * side == pytest.approx(0.01 / 0.5 * 0.1, rel=1e-2)


def test_a_whole_arm_holds_while_another_joint_moves():
    config = load_arm("wam7_sim")
    plant = from_config(config).plant
    start = plant.position
    hold = plant.inverse_dynamics(start, np.zeros(7), np.zeros(7))
    furthest = 0.0
    for cycle in range(1000):
        push = np.zeros(7)
        push[6] = 0.02 * np.sin(2.0 * np.pi * cycle / 500)
        plant.step(hold + push)
        furthest = max(furthest, abs(plant.position[6] - start[6]))
    assert furthest > 0.01
    np.testing.assert_array_equal(plant.velocity[:6], 0.0)
    np.testing.assert_array_equal(plant.position[:6], start[:6])


@pytest.mark.parametrize("period", [1e-3, 2.5e-4])
def test_sliding_block_stops_where_and_when_it_must(period):
    # m dv/dt = F - fc while pushed, then -fc: speed (F - fc) T / m, braking time speed m / fc.
    m, fc, push, seconds = 3.0, 2.0, 8.0, 0.5003
    plant = plant_of(slider(m, gravity=(0.0, 0.0, 0.0), fc=fc), period)
    pushed = round(seconds / period)
    speed = (push - fc) * pushed * period / m
    stop_after, way = speed * m / fc, 0.5 * speed * pushed * period + 0.5 * speed**2 * m / fc
    for _ in range(pushed):
        plant.step(np.array([push]))
    assert plant.velocity[0] == pytest.approx(speed, rel=1e-12)
    steps = 0
    while plant.velocity[0] != 0.0:
        plant.step(np.zeros(1))
        steps += 1
    assert stop_after <= steps * period * (1 + 1e-9)
    assert steps * period < stop_after + period * (1 + 1e-9)
    # Within the step in which it stops, it is at most half that step's way off.
    assert plant.position[0] == pytest.approx(way, abs=0.5 * period**2 * fc / m)
    rest = plant.position
    plant.step(np.zeros(1))
    np.testing.assert_array_equal(plant.position, rest)


def test_reverses_without_sticking_when_the_torque_is_strong():
    plant = plant_of(slider(gravity=(0.0, 0.0, 0.0), fc=1.0))
    for _ in range(10):
        plant.step(np.array([5.0]))
    for _ in range(30):
        plant.step(np.array([-5.0]))
    # 10 steps at (5-1)/m up; the way down brakes at 6/m and then gains 4/m for what is left.
    assert plant.velocity[0] == pytest.approx(-(30 - 10 * 4 / 6) * 1e-3 * 4 / 3, abs=2 * 1e-3 / 3)


def test_joints_with_and_without_friction_mix():
    config = random_arm(7)
    free = config.driver.truth
    values = {**dict(zip(free.names, free.values, strict=True)), "fc2": 500.0, "fc4": 500.0}
    config = config.model_copy(
        update={"driver": config.driver.model_copy(update={"truth": ParameterTable.model_validate(values)})}
    )
    plant = plant_of(config)
    for _ in range(500):
        plant.step(np.array([0.5, 0.0, 0.0, 0.0]))
    np.testing.assert_array_equal(plant.velocity != 0.0, [True, False, True, False])
    np.testing.assert_array_equal(plant.position[[1, 3]], 0.0)


def test_nothing_moves_by_itself_without_torque_or_gravity():
    plant = plant_of(random_arm(2, gravity=False))
    for _ in range(100):
        plant.step(np.zeros(4))
    np.testing.assert_array_equal(plant.position, 0.0)
