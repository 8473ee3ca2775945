"""How far the arm is expected to fall behind: what unknown friction does against the stiffness of the loop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from design_bench import FOURIER, random_task, small
from helpers.random_arms import bodies_of, reference_model
from hypothesis import given, settings
from hypothesis import strategies as st

from ident_service.config.motion_limits import motion_limits
from ident_service.excitation.prediction import predict_following_error, rate_of_change
from ident_service.model.expected_friction import ExpectedFriction, expected_friction
from ident_service.model.regressor import joint_regressor

Array = np.ndarray


UNKNOWN = 0.6  # of the friction expected: what 1.4 times as much has beyond the 0.8 that the law feeds forward


@pytest.mark.slow
@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 4))
def test_the_forecast_is_friction_through_the_mass_matrix_and_the_gains(seed: int, joints: int) -> None:
    task = random_task(seed, joints, "d_optimal", FOURIER)
    model, rng = task.model, np.random.default_rng(seed)
    assert model.prior is not None
    assert task.friction is not None
    q, dq = rng.uniform(-1.0, 1.0, size=(2, joints))
    # The mass matrix, column by column: torque of unit accelerations without gravity.
    still = np.zeros((joints, joints))
    weightless = replace(model.chain, gravity=np.zeros(3))
    rows = joint_regressor(weightless, model.layout, np.tile(q, (joints, 1)), still, np.eye(joints), direction=still)
    offset = model.chain.coupling.T @ model.layout.term_values("offset", model.prior)
    M = np.einsum("jps,p->js", rows, model.prior) - offset[:, None]
    rate = model.chain.coupling @ dq
    torque = model.chain.coupling.T @ (task.friction.coulomb * np.sign(rate) + task.friction.viscous * rate)
    expected = UNKNOWN * np.abs(np.linalg.solve(M, torque) / task.limits.kp)
    found = predict_following_error(model, task.limits, task.friction, q[None], dq[None])
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-10)


def test_the_mass_matrix_above_is_pinocchio_s() -> None:
    # Of bodies alone, in a mechanism without coupling, by another route.
    import pinocchio as pin

    task = random_task(3, 3, "d_optimal", FOURIER)
    model = replace(task.model, chain=replace(task.model.chain, coupling=np.eye(3)))
    assert model.prior is not None
    reference = reference_model(model.chain, bodies_of(model.layout, model.prior))
    q = np.array([0.3, -0.4, 0.5])
    M = pin.crba(reference, reference.createData(), q)
    M = np.triu(M) + np.triu(M, 1).T + np.diag(model.layout.term_values("drive_inertia", model.prior))
    friction = ExpectedFriction(np.array([1.0, 2.0, 3.0]), np.zeros(3), np.zeros(3))
    found = predict_following_error(model, task.limits, friction, q[None], np.ones((1, 3)))
    expected = UNKNOWN * np.abs(np.linalg.solve(M, friction.coulomb)) / task.limits.kp
    np.testing.assert_allclose(found, expected, rtol=1e-8)


def test_friction_is_the_prior_s_or_a_share_of_the_limits_where_it_has_none() -> None:
    model = small()
    limits = motion_limits(model.config)
    guessed = expected_friction(model, limits, (0.02, 0.05))
    np.testing.assert_allclose(guessed.coulomb, 0.02 * limits.torque)
    np.testing.assert_allclose(guessed.viscous * limits.velocity, 0.05 * limits.torque)
    assert model.prior is not None
    prior = model.prior.copy()
    prior[model.layout.names.index("fc2")] = 0.7
    known = expected_friction(replace(model, prior=prior), limits, (0.02, 0.05))
    np.testing.assert_allclose(known.coulomb, [guessed.coulomb[0], 0.7])
    np.testing.assert_allclose(known.viscous, [guessed.viscous[0], 0.0])


def test_rates_of_change_know_where_one_stretch_ends_and_another_begins() -> None:
    rising, falling = np.linspace(0.05, 1.95, 20), 60.0 - np.linspace(0.05, 1.95, 20)
    times = np.concatenate([rising, np.linspace(2.0, 20.0, 181), falling])
    rates = rate_of_change(times) @ np.column_stack([np.sin(times), times])
    np.testing.assert_allclose(rates[:, 1], 1.0, rtol=1e-12)
    np.testing.assert_allclose(rates[:, 0], np.cos(times), atol=0.06)
