"""A plant whose drives move several joints: against an independent integrator, and sticking drive by drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from sim_arms import random_arm

from ident_service.model.arm_model import arm_model
from ident_service.model.pinocchio_models import InverseDynamics
from ident_service.model.regressor import joint_regressor
from sim_backend.plant import Plant

Array = np.ndarray
COUPLING = np.eye(4)
COUPLING[2:, 2:] = [[1.0, -0.6], [1.0, 0.6]]  # a differential at the last two joints


def coupled(seed: int, period: float = 1e-3, coupling: Array = COUPLING, **terms: float) -> Plant:
    config = random_arm(seed, **terms)
    model = arm_model(config)
    chain = replace(model.chain, coupling=coupling)
    return Plant(chain, model.layout, model.layout.vector(config.driver.truth), np.zeros(4), period)


@pytest.mark.parametrize("seed", [1, 2])
def test_it_agrees_with_an_independent_integrator_to_second_order(seed: int) -> None:
    config = random_arm(seed, fv=0.3, fo=0.1)
    model = arm_model(config)
    bare = model.layout.vector(config.driver.truth).copy()
    bare[model.layout.term_columns("drive_inertia")] = 0.0
    links = InverseDynamics(model.chain, model.layout, bare)
    drives = COUPLING.T @ np.diag(np.full(4, 0.05)) @ COUPLING
    torque = np.array([0.4, 12.0, -0.3, 0.2])

    def flow(_: float, state: Array) -> Array:
        q, v = state[:4], state[4:]
        friction = COUPLING.T @ (0.3 * (COUPLING @ v) + 0.1)
        rest = links.torque(q, v, np.zeros(4)) + friction
        return np.concatenate([v, np.linalg.solve(links.mass_matrix(q) + drives, torque - rest)])

    truth = solve_ivp(flow, (0.0, 0.5), np.zeros(8), rtol=1e-11, atol=1e-12).y[:, -1]

    def error(period: float) -> float:
        plant = coupled(seed, period, fv=0.3, fo=0.1)
        for _ in range(round(0.5 / period)):
            plant.step(torque)
        return float(np.abs(np.concatenate([plant.position, plant.velocity]) - truth).max())

    coarse, fine = error(1e-3), error(5e-4)
    assert np.abs(truth).max() > 0.3
    assert fine < 1e-4
    assert coarse / fine == pytest.approx(4.0, rel=0.3)


def test_its_inverse_dynamics_is_the_regressor_times_the_truth() -> None:
    config = random_arm(5, fv=0.3, fc=0.2, fo=-0.1)
    model = arm_model(config)
    delta = model.layout.vector(config.driver.truth)
    chain = replace(model.chain, coupling=COUPLING)
    q, v, a = np.random.default_rng(0).normal(size=(3, 4))
    H = joint_regressor(chain, model.layout, q[None], v[None], a[None])[:, :, 0]
    plant = coupled(5, fv=0.3, fc=0.2, fo=-0.1)
    np.testing.assert_allclose(plant.inverse_dynamics(q, v, a), H @ delta, rtol=1e-10)


def test_a_drive_sticks_while_the_one_that_it_shares_joints_with_slides() -> None:
    plant = coupled(3, fc=2.0)
    held = plant.inverse_dynamics(plant.position, np.zeros(4), np.zeros(4))
    # Torque of the drives beside what holds the arm: the fourth is pushed beyond its friction, the third is not.
    plant.step(held + COUPLING.T @ np.array([0.0, 0.0, 0.0, 3.0]))
    for _ in range(50):
        held = plant.inverse_dynamics(plant.position, np.zeros(4), np.zeros(4))
        plant.step(held + COUPLING.T @ np.array([0.0, 0.0, 0.0, 3.0]))
        assert plant.drive_velocity[2] == 0.0
        assert plant.drive_velocity[3] > 0.0
        assert (plant.drive_velocity[:2] == 0.0).all()
        assert (np.abs(plant.velocity[2:]) > 0.0).all()  # both joints go where the sliding drive takes them
        assert plant.velocity[2] == pytest.approx(0.6 * plant.velocity[3], rel=1e-9)


def test_all_joints_stand_exactly_where_all_drives_stick() -> None:
    plant = coupled(3, fc=50.0, fv=0.2)
    for _ in range(20):
        plant.step(np.zeros(4))
        assert (plant.velocity == 0.0).all()
        assert (plant.position == 0.0).all()


def test_braking_of_coupled_drives_is_theirs() -> None:
    """Braking by a matrix that couples joints acts as viscous friction of the drives does."""
    one, other = coupled(7, fv=0.3), coupled(7)
    other.set_braking(COUPLING.T @ np.diag(np.full(4, 0.3)) @ COUPLING)
    torque = np.array([0.4, 12.0, -0.3, 0.2])
    for _ in range(200):
        one.step(torque)
        other.step(torque)
    np.testing.assert_allclose(one.position, other.position, atol=1e-12)
    assert np.abs(one.position).max() > 0.01
