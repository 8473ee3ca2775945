"""The plant against closed forms, against an independent integrator, and against its own energy."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from sim_arms import arm_config, pendulum, plant_of, random_arm, slider

from ident_service.errors import DriverError, ModelError
from ident_service.model.arm_model import arm_model
from ident_service.model.pinocchio_models import InverseDynamics
from ident_service.model.regressor import joint_regressor
from sim_backend.plant import Plant


def run(plant, seconds, torque):
    for _ in range(round(seconds / plant.period)):
        plant.step(torque)
    return plant


def test_pendulum_keeps_its_energy_to_second_order():
    def drift(period):
        plant = plant_of(pendulum(), period)
        worst = 0.0
        for _ in range(round(2.0 / period)):
            plant.step(np.zeros(1))
            energy = 0.25 * plant.velocity[0] ** 2 + 2.0 * 9.81 * 0.4 * np.sin(plant.position[0])
            worst = max(worst, abs(energy))
        return worst

    coarse, fine = drift(2e-3), drift(1e-3)
    assert fine < 1e-4
    assert coarse / fine == pytest.approx(4.0, rel=0.15)


def test_weightless_chain_keeps_its_kinetic_energy():
    config = random_arm(3, gravity=False)
    model = arm_model(config)
    inverse = InverseDynamics(model.chain, model.layout, model.layout.vector(config.driver.truth))

    def drift(period):
        plant = plant_of(config, period)
        run(plant, 0.1, np.array([0.3, 0.5, -0.4, 0.2]))

        def kinetic():
            return 0.5 * plant.velocity @ inverse.mass_matrix(plant.position) @ plant.velocity

        before = kinetic()
        run(plant, 1.0, np.zeros(4))
        return abs(kinetic() / before - 1.0)

    coarse, fine = drift(2e-3), drift(1e-3)
    assert fine < 1e-5
    assert coarse / fine == pytest.approx(4.0, rel=0.3)


@pytest.mark.parametrize("seed", [1, 2])
def test_agrees_with_an_independent_integrator_to_second_order(seed):
    config = random_arm(seed, fv=0.3, fo=0.1)
    model = arm_model(config)
    inverse = InverseDynamics(model.chain, model.layout, model.layout.vector(config.driver.truth))
    torque = np.array([0.4, 12.0, -0.3, 0.2])

    def flow(_, state):
        q, v = state[:4], state[4:]
        rest = inverse.torque(q, v, np.zeros(4)) + 0.3 * v + 0.1
        return np.concatenate([v, np.linalg.solve(inverse.mass_matrix(q), torque - rest)])

    truth = solve_ivp(flow, (0.0, 0.5), np.zeros(8), rtol=1e-11, atol=1e-12).y[:, -1]

    def error(period):
        plant = run(plant_of(config, period), 0.5, torque)
        return np.abs(np.concatenate([plant.position, plant.velocity]) - truth).max()

    coarse, fine = error(1e-3), error(5e-4)
    assert np.abs(truth).max() > 0.3
    assert fine < 1e-4
    assert coarse / fine == pytest.approx(4.0, rel=0.3)


def test_slider_falls_as_it_should():
    plant = run(plant_of(slider()), 1.0, np.zeros(1))
    assert plant.position[0] == pytest.approx(-0.5 * 9.81, rel=1e-12)
    assert plant.velocity[0] == pytest.approx(-9.81, rel=1e-12)


def test_viscous_slider_reaches_its_terminal_speed():
    plant = run(plant_of(slider(fv=30.0)), 3.0, np.zeros(1))
    assert plant.velocity[0] == pytest.approx(-3.0 * 9.81 / 30.0, rel=1e-9)
    assert plant.acceleration[0] == pytest.approx(0.0, abs=1e-9)


def test_drive_inertia_is_felt():
    plant = run(plant_of(slider(gravity=(0.0, 0.0, 0.0), Ia=2.0)), 1.0, np.array([10.0]))
    assert plant.velocity[0] == pytest.approx(2.0, rel=1e-12)


def test_inverse_dynamics_is_the_regressor_times_the_truth():
    config = random_arm(5, fv=0.3, fc=0.2, fo=-0.1)
    model = arm_model(config)
    delta = model.layout.vector(config.driver.truth)
    q, v, a = np.random.default_rng(0).normal(size=(3, 4))
    H = joint_regressor(model.chain, model.layout, q[None], v[None], a[None])[:, :, 0]
    np.testing.assert_allclose(plant_of(config).inverse_dynamics(q, v, a), H @ delta, rtol=1e-10)


def test_inverse_dynamics_explains_what_the_plant_did():
    plant = plant_of(random_arm(5, fv=0.3, fc=0.05, fo=-0.1), 1e-4)
    torque = np.array([0.4, 12.0, -0.6, 0.5])
    run(plant, 0.2, torque)
    q, v = plant.position, plant.velocity
    plant.step(torque)
    middle = plant.inverse_dynamics(0.5 * (q + plant.position), 0.5 * (v + plant.velocity), plant.acceleration)
    np.testing.assert_allclose(middle, torque, atol=1e-5)


def test_states_are_read_only_and_kept():
    plant = plant_of(pendulum())
    before = plant.position
    plant.step(np.zeros(1))
    assert before[0] == 0.0
    for state in (plant.position, plant.velocity, plant.acceleration):
        with pytest.raises(ValueError, match="read-only"):
            state[0] = 1.0


def test_running_away_is_an_error_and_changes_nothing():
    plant = plant_of(random_arm(1, fc=0.1))
    with pytest.raises(DriverError, match="ran away"):
        plant.step(np.full(4, np.nan))
    np.testing.assert_array_equal(plant.position, 0.0)


@pytest.mark.parametrize("name", ["fv1", "fc1"])
def test_negative_friction_is_refused(name):
    config = pendulum()
    model = arm_model(config)
    delta = model.layout.vector(config.driver.truth)
    delta[model.layout.names.index(name)] = -0.1
    with pytest.raises(ModelError, match="friction"):
        Plant(model.chain, model.layout, delta, np.zeros(1), 1e-3)


def test_impossible_bodies_and_shapes_are_refused():
    with pytest.raises(ModelError, match="positive definite"):
        plant_of(arm_config({"j1": {}}, {"m1": 1.0, "Lzz1": -0.1}))
    with pytest.raises(ModelError, match="mass"):
        plant_of(arm_config({"j1": {}}, {"Lzz1": 0.1}))
    with pytest.raises(ModelError, match="joints"):
        plant_of(pendulum(), position=np.zeros(2))
