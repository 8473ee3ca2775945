"""Forward dynamics: the inverse of the regressor in every term, stable in steps of any length, and nearly sticking."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.random_arms import random_chain, random_delta
from sim.sim_arms import pendulum, random_arm

from ident_service.config.quantities import ParameterTable
from ident_service.errors import ModelError
from ident_service.model.arm_model import arm_model
from ident_service.model.parameter_layout import TERM_SYMBOLS, Layout
from ident_service.model.pinocchio_models import ForwardDynamics, InverseDynamics
from ident_service.model.regressor import joint_regressor
from sim_backend.plant import Plant


@pytest.mark.parametrize("seed", range(5))
def test_it_undoes_the_regressor_with_every_term_and_coupled_drives(seed: int) -> None:
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, 4)
    coupling = np.eye(4)
    coupling[2, 1], coupling[3, 2] = -0.7, 0.4
    chain = replace(chain, coupling=coupling)
    layout = Layout(chain.revolute, tuple(TERM_SYMBOLS), (0.1, 0.2, 0.3, 0.4))
    delta = random_delta(rng, layout)
    # An asymmetry larger than the friction would drive the arm.
    delta[layout.term_columns("viscous_asymmetry")] *= 0.05
    dynamics = ForwardDynamics(chain, layout, delta)
    q, dq, ddq = rng.uniform(-2.0, 2.0, size=(3, 1, 4))
    torque = np.einsum("jps,p->sj", joint_regressor(chain, layout, q, dq, ddq), delta)[0]
    np.testing.assert_allclose(dynamics.torque(q[0], dq[0], ddq[0]) + dynamics.friction(dq[0]), torque, rtol=1e-9)
    h = 1e-7
    after = dynamics.next_velocity(q[0], dq[0], torque, h)
    np.testing.assert_allclose((after - dq[0]) / h, ddq[0], rtol=0, atol=1e-4)


def test_it_moves_as_the_simulated_arm_does() -> None:
    model = arm_model(random_arm(3, prismatic=False, fv=0.5, fc=0.2, fo=0.1))
    delta = model.layout.vector(model.config.driver.truth)
    plant = Plant(model.chain, model.layout, delta, np.zeros(4), 1e-3)
    dynamics = ForwardDynamics(model.chain, model.layout, delta)
    q = v = np.zeros(4)
    for step in range(500):
        torque = np.sin(0.01 * step + np.arange(4.0)) * np.array([4.0, 3.0, 2.0, 1.0])
        plant.step(torque)
        after = dynamics.next_velocity(q, v, torque, 1e-3)
        q, v = q + 0.5e-3 * (v + after), after
    moved = np.abs(plant.position).max()
    assert moved > 0.1
    np.testing.assert_allclose(q, plant.position, rtol=0, atol=0.02 * moved)


def test_without_coupling_it_is_the_inverse_dynamics_of_the_control_loop() -> None:
    rng = np.random.default_rng(1)
    chain = random_chain(rng, 5)
    layout = Layout(chain.revolute, ("drive_inertia", "viscous"))
    delta = random_delta(rng, layout)
    q, dq, ddq = rng.uniform(-2.0, 2.0, size=(3, 5))
    wanted = InverseDynamics(chain, layout, delta).torque(q, dq, ddq)
    np.testing.assert_allclose(ForwardDynamics(chain, layout, delta).torque(q, dq, ddq), wanted, rtol=1e-10)


def test_friction_as_stiff_as_it_likes_only_brakes() -> None:
    model = arm_model(pendulum(fv=1e5, fc=1e3))
    dynamics = ForwardDynamics(model.chain, model.layout, model.layout.vector(model.config.driver.truth))
    v, speeds = np.array([5.0]), []
    for _ in range(20):
        v = dynamics.next_velocity(np.zeros(1), v, np.zeros(1), 1e-2)
        speeds.append(float(v[0]))
    assert speeds[0] < 0.01
    # Gravity pulls with 7.8 N m against a thousand: it creeps, slower than a thousandth of what friction holds.
    assert abs(speeds[-1]) < 1e-5


@pytest.mark.parametrize(("torque", "moves"), [(4.0, False), (6.0, True)])
def test_below_its_friction_a_joint_creeps_and_above_it_goes(torque: float, moves: bool) -> None:
    truth = {"m1": 1.0, "Lxx1": 0.5, "Lyy1": 0.5, "Lzz1": 0.5, "fc1": 5.0}
    model = arm_model(pendulum())
    dynamics = ForwardDynamics(model.chain, model.layout, model.layout.vector(ParameterTable.model_validate(truth)))
    q = v = np.zeros(1)
    for _ in range(1000):
        v = dynamics.next_velocity(q, v, np.array([torque]), 1e-3)
        q = q + 1e-3 * v
    assert (q[0] > 0.5) == moves
    assert moves or 0.0 < q[0] < 1e-3


def test_a_body_that_cannot_be_is_refused() -> None:
    model = arm_model(pendulum())
    delta = model.layout.vector(model.config.driver.truth)
    heavy_inside = delta.copy()
    heavy_inside[model.layout.names.index("Lzz1")] = -1.0
    dynamics = ForwardDynamics(model.chain, model.layout, heavy_inside)
    with pytest.raises(ModelError, match="not positive definite"):
        dynamics.next_velocity(np.zeros(1), np.zeros(1), np.zeros(1), 1e-3)
    with pytest.raises(ModelError, match="no centre of mass"):
        ForwardDynamics(model.chain, model.layout, np.zeros_like(delta))
