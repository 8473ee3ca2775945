"""Ordinary least squares against numpy and against eqs. 81 to 84 written out."""

from __future__ import annotations

import numpy as np
import pytest
from estimation.synthetic import one_joint_information, random_information, serial_chain
from helpers.random_arms import model_around, random_delta

from ident_service.estimation.equations import Equations
from ident_service.estimation.least_squares import ordinary_least_squares, torque_error
from ident_service.estimation.uncertainty import block_covariance
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import BaseParameters, base_parameters
from ident_service.model.information import information_of, sparsity
from ident_service.model.regressor import joint_regressor


@pytest.fixture(scope="module")
def arm() -> ArmModel:
    return model_around(serial_chain(4, 3))


@pytest.fixture(scope="module")
def base(arm: ArmModel) -> BaseParameters:
    return base_parameters(arm.chain, arm.layout)


def linear_problem(seed: int, rows: int = 300, columns: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """Equations whose columns differ by orders of magnitude, with noise."""
    rng = np.random.default_rng(seed)
    W = rng.normal(size=(rows, columns)) * np.logspace(-3, 3, columns)
    return W, W @ rng.normal(size=columns) + 0.1 * rng.normal(size=rows)


def test_estimate_and_deviations_are_the_textbook_s() -> None:
    W, omega = linear_problem(1)
    fit = ordinary_least_squares(one_joint_information(W, omega))
    beta, residual, rank, singular = np.linalg.lstsq(W, omega, rcond=None)
    np.testing.assert_allclose(fit.beta, beta, rtol=1e-9)
    assert fit.rank == rank == 6
    assert fit.rho2**2 == pytest.approx(residual[0], rel=1e-9)
    assert fit.condition_number == pytest.approx(singular[0] / singular[-1], rel=1e-9)
    # Eqs. 81 to 83.
    variance = np.sum((omega - W @ beta) ** 2) / (W.shape[0] - W.shape[1])
    wanted = np.sqrt(variance * np.diag(np.linalg.inv(W.T @ W)))
    np.testing.assert_allclose(fit.standard_deviations, wanted, rtol=1e-9)
    # Eqs. 64 and 67: the factors say the same as the equations.
    np.testing.assert_allclose(fit.R1.T @ fit.R1, W.T @ W, rtol=1e-9)
    np.testing.assert_allclose(fit.R1.T @ fit.rho1, W.T @ omega, rtol=1e-9)
    np.testing.assert_allclose(fit.inverse @ fit.R1, np.eye(6), rtol=0, atol=1e-7)


def test_several_joints_are_one_system(arm: ArmModel, base: BaseParameters) -> None:
    rng = np.random.default_rng(3)
    q, dq, ddq = rng.uniform(-2.0, 2.0, size=(3, 200, 3))
    H_b = joint_regressor(arm.chain, arm.layout, q, dq, ddq, base.base)
    torque = np.einsum("jps,p->sj", H_b, rng.normal(size=base.size)) + rng.normal(size=(200, 3))
    keep = rng.random((200, 3)) < 0.8
    information = information_of(H_b, torque, keep, sparsity(arm.chain, arm.layout, base.base))
    W = np.vstack([H_b[joint].T[keep[:, joint]] for joint in range(3)])
    omega = np.concatenate([torque[keep[:, joint], joint] for joint in range(3)])
    fit = ordinary_least_squares(information)
    beta = np.linalg.lstsq(W, omega, rcond=None)[0]
    np.testing.assert_allclose(fit.beta, beta, rtol=0, atol=1e-8 * np.abs(beta).max())
    variance = np.sum((omega - W @ beta) ** 2) / (len(omega) - base.size)
    wanted = np.sqrt(variance * np.diag(np.linalg.pinv(W.T @ W)))
    np.testing.assert_allclose(fit.standard_deviations, wanted, rtol=1e-6)

    # Eq. 84, whole and per joint.
    other = beta + 0.01 * rng.normal(size=base.size)
    error = torque_error(information, other)
    left = omega - W @ other
    assert error.relative_percent == pytest.approx(100.0 * np.linalg.norm(left) / np.linalg.norm(omega), rel=1e-9)
    assert error.rms == pytest.approx(np.sqrt(np.mean(left**2)), rel=1e-9)
    ends = np.cumsum(keep.sum(axis=0))[:-1]
    for joint, (e, w) in enumerate(zip(np.split(left, ends), np.split(omega, ends), strict=True)):
        wanted_percent = 100.0 * np.linalg.norm(e) / np.linalg.norm(w)
        assert error.joint_relative_percent[joint] == pytest.approx(wanted_percent, rel=1e-8)
        assert error.joint_rms[joint] == pytest.approx(np.sqrt(np.mean(e**2)), rel=1e-8)


def test_a_column_of_zeros_is_blind_and_alone() -> None:
    W, omega = linear_problem(2)
    W[:, 2] = 0.0
    fit = ordinary_least_squares(one_joint_information(W, omega))
    np.testing.assert_array_equal(np.isinf(fit.standard_deviations), np.arange(6) == 2)
    assert abs(fit.beta[2]) < 1e-9
    assert fit.rank == 5
    assert np.isinf(fit.condition_number)


def test_a_column_of_rounding_is_as_blind_as_one_of_zeros() -> None:
    W, omega = linear_problem(2)
    W[:, 2] *= 1e-160
    fit = ordinary_least_squares(one_joint_information(W, omega))
    np.testing.assert_array_equal(np.isinf(fit.standard_deviations), np.arange(6) == 2)
    assert np.isfinite(fit.beta).all()
    assert fit.rank == 5


def test_two_columns_that_only_occur_together_are_both_blind() -> None:
    W, omega = linear_problem(3)
    W[:, 4] = -0.3 * W[:, 1]
    information = one_joint_information(W, omega)
    fit = ordinary_least_squares(information)
    blind = np.isin(np.arange(6), (1, 4))
    np.testing.assert_array_equal(np.isinf(fit.standard_deviations), blind)
    beta = np.linalg.lstsq(np.delete(W, 4, axis=1), omega, rcond=None)[0]
    np.testing.assert_allclose(fit.beta[~blind], np.delete(beta, 1), rtol=1e-8)
    # What the two say together is known.
    assert fit.beta[1] - 0.3 * fit.beta[4] == pytest.approx(beta[1], rel=1e-8)
    blocks = tuple(one_joint_information(W[k::10], omega[k::10]) for k in range(10))
    deviations = np.sqrt(np.diag(block_covariance(Equations(blocks, len(W)), fit)))
    np.testing.assert_array_equal(np.isinf(deviations), blind)
    assert np.all(deviations[~blind] > 0.0)


def test_fewer_equations_than_parameters() -> None:
    W, omega = linear_problem(4, rows=3)
    fit = ordinary_least_squares(one_joint_information(W, omega))
    assert fit.rank == 3
    assert np.isinf(fit.condition_number)
    assert np.all(np.isinf(fit.standard_deviations))
    np.testing.assert_allclose(W @ fit.beta, omega, rtol=0, atol=1e-9)


def test_no_information_at_all() -> None:
    fit = ordinary_least_squares(one_joint_information(np.zeros((20, 3)), np.zeros(20)))
    assert fit.rank == 0
    np.testing.assert_array_equal(fit.beta, 0.0)
    assert np.all(np.isinf(fit.standard_deviations))


def test_exact_equations_leave_no_doubt(arm: ArmModel, base: BaseParameters) -> None:
    delta = random_delta(np.random.default_rng(8), arm.layout)
    fit = ordinary_least_squares(random_information(arm, base, delta))
    beta = base.K @ delta
    np.testing.assert_allclose(fit.beta, beta, rtol=0, atol=1e-9 * np.abs(beta).max())
    assert fit.standard_deviations.max() < 1e-9


def test_what_nothing_sees_has_no_part_in_the_factor() -> None:
    rng = np.random.default_rng(3)
    W, omega = rng.normal(size=(40, 5)), rng.normal(size=40)
    W[:, [1, 3]] = 0.0
    R = one_joint_information(W, omega).stacked()
    assert not R[[1, 3]].any()
    assert not R[:, [1, 3]].any()
    np.testing.assert_array_equal(R, np.triu(R))
    together = np.column_stack([W, omega])
    np.testing.assert_allclose(R.T @ R, together.T @ together, atol=1e-12)
