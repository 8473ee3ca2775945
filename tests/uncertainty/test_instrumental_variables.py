"""Instruments: noise that goes round the loop biases least squares and not them; without it nothing changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from estimation.synthetic import SampledRecording, recorded, serial_chain, waves, with_options
from helpers.plain import plain_options, plain_smoothing
from helpers.random_arms import model_around, random_delta
from uncertainty.closed_loop import pendulum_model, recorded_in_closed_loop

from ident_service.errors import ModelError
from ident_service.estimation.equations import equation_rows, equations
from ident_service.estimation.feasible.feasible_set import feasible_set
from ident_service.estimation.feasible.problems import constrained_least_squares
from ident_service.estimation.identify import identify
from ident_service.estimation.instrumental_variables import InstrumentalEstimate, instrumental_variables, simulated
from ident_service.estimation.least_squares import LeastSquares, ordinary_least_squares
from ident_service.estimation.uncertainty import block_covariance
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import base_parameters

Array = np.ndarray


def refined(model: ArmModel, recording: SampledRecording) -> tuple[LeastSquares, Array, InstrumentalEstimate]:
    """Least squares, its deviations, and what instruments make of it."""
    base = base_parameters(model.chain, model.layout)
    conditions = feasible_set("pseudo_inertia", base.names, model.config)
    gathered = equations(recording, model, base)
    fit = ordinary_least_squares(gathered.total)
    delta = constrained_least_squares(fit, base, conditions).delta
    result = instrumental_variables([recording], model, base, conditions, fit, delta)
    return fit, np.sqrt(np.diag(block_covariance(gathered, fit))), result


@pytest.mark.campaign
@pytest.mark.slow
def test_least_squares_is_biased_in_a_noisy_loop_and_instruments_are_not() -> None:
    model, truth = pendulum_model()
    beta = base_parameters(model.chain, model.layout).K @ truth
    plain, better, claimed = [], [], []
    for seed in range(6):
        recording = recorded_in_closed_loop(model, truth, seed=seed, position_noise=3e-3)
        fit, _, result = refined(model, recording)
        plain.append(fit.beta - beta)
        better.append(result.beta - beta)
        claimed.append(result.standard_deviations)
    inertia = 0  # Lzz1 + Ia1, what noise in the acceleration shrinks
    assert np.mean(plain, axis=0)[inertia] < -0.15 * beta[inertia]
    standard_error = np.std(better, axis=0, ddof=1) / np.sqrt(len(better))
    assert np.all(np.abs(np.mean(better, axis=0)) < 4.0 * standard_error)
    assert np.abs(np.mean(better, axis=0)[inertia]) < 0.03 * beta[inertia]
    # Their own doubt covers their scatter, and is not careful beyond use.
    spread = np.sqrt(np.mean(np.square(better), axis=0))
    ratio = np.mean(claimed, axis=0) / spread
    assert np.all(ratio > 0.6)
    assert np.all(ratio < 5.0)


@pytest.mark.campaign
@pytest.mark.slow
def test_of_noise_that_biases_least_squares_is_warned_and_instruments_hold_their_deviations() -> None:
    """Noise of 3e-4 rad, of which a cut-off of 20 Hz lets more pass than the acceleration bears."""
    plain, truth = pendulum_model()
    model = with_options(plain, plain_options(smoothing=plain_smoothing(cutoff=20.0)))
    beta = base_parameters(model.chain, model.layout).K @ truth
    off: dict[str, list[Array]] = {"ols": [], "iv": []}
    for seed in range(6):
        recording = recorded_in_closed_loop(model, truth, seed=seed, position_noise=3e-4)
        for method, errors in off.items():
            estimate = identify(model, [recording], method=method)  # type: ignore[arg-type]
            errors.append((estimate.fit.beta - beta) / estimate.standard_deviations)
            warned = [remark for remark in estimate.remarks if "identification.method: iv is not" in remark]
            assert len(warned) == (method == "ols")
    sizes = {method: float(np.sqrt(np.mean(np.square(errors)))) for method, errors in off.items()}
    assert sizes["ols"] > 2.0
    assert sizes["iv"] < 1.5


@pytest.mark.slow
def test_without_noise_nothing_changes() -> None:
    model, truth = pendulum_model()
    recording = recorded_in_closed_loop(model, truth, seed=0)
    # Noise of the torque's measurement alone, which never enters the loop.
    noise = 0.1 * np.random.default_rng(1).normal(size=recording.torque.shape)
    measured = replace(recording, torque=recording.torque + noise)
    fit, deviations, result = refined(model, measured)
    assert np.all(np.abs(result.beta - fit.beta) < 0.5 * deviations)
    np.testing.assert_allclose(result.standard_deviations, deviations, rtol=0.2)
    assert result.strength.min() > 0.999
    assert result.rounds == 2


def test_two_joints_with_everything_between_them() -> None:
    model = model_around(serial_chain(5, 2))
    delta = random_delta(np.random.default_rng(5), model.layout)
    recording = recorded(model, delta, waves(4, 2), rate=125.0, seconds=16.0)
    rng = np.random.default_rng(0)
    noisy = replace(recording, torque=recording.torque + 0.3 * rng.normal(size=recording.torque.shape))
    fit, deviations, result = refined(model, noisy)
    base = base_parameters(model.chain, model.layout)
    assert np.all(np.abs(result.beta - fit.beta) < 0.7 * deviations)
    assert np.all(np.abs(result.beta - base.K @ delta) < 6.0 * result.standard_deviations)
    np.testing.assert_allclose(base.K @ result.delta, result.feasible_beta, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(result.covariance, result.covariance.T)


@pytest.mark.slow
def test_the_covariance_is_the_jackknife_over_blocks() -> None:
    # One round by hand, on explicit rows.
    model, truth = pendulum_model()
    recording = recorded_in_closed_loop(model, truth, seed=1, position_noise=5e-4)
    _, _, result = refined(model, recording)
    base = base_parameters(model.chain, model.layout)
    made = simulated(recording, model, result.delta, 2.0)
    (rows,), (other,) = (list(equation_rows(source, model, base)) for source in (recording, made))
    keep = other.keep[:, 0]
    W, Z, omega = rows.H_b[0].T[keep], other.H_b[0].T[keep], rows.torque[keep, 0]
    beta = np.linalg.solve(Z.T @ W, Z.T @ omega)
    np.testing.assert_allclose(result.beta, beta, rtol=0, atol=0.02 * result.standard_deviations.min() + 1e-6)
    number = np.floor(rows.time - rows.time[0] + 1e-9)[keep]
    changes = []
    for block in np.unique(number):
        rest = number != block
        changes.append(np.linalg.solve(Z[rest].T @ W[rest], Z[rest].T @ omega[rest]) - beta)
    wanted = np.sqrt(np.sum(np.square(changes), axis=0))
    np.testing.assert_allclose(result.standard_deviations, wanted, rtol=0.02)


def test_the_simulated_arm_follows_and_keeps_everything_else() -> None:
    model, truth = pendulum_model()
    recording = recorded_in_closed_loop(model, truth, seed=2, position_noise=5e-3)
    made = simulated(recording, model, truth, 2.0)
    blocks = list(made.blocks(1000))
    position = np.concatenate([block.position for block in blocks])
    np.testing.assert_array_equal(np.concatenate([block.torque for block in blocks]), recording.torque)
    np.testing.assert_array_equal(np.concatenate([block.stamp_ns for block in blocks]), recording.stamp_ns)
    assert made.sha256 == recording.sha256
    assert made.torque_zero_order_hold
    # The encoder's noise is nowhere in it.
    assert np.sqrt(np.mean((position - recording.position) ** 2)) > 4e-3
    assert np.abs(np.diff(position, 3, axis=0)).max() < 2e-3


def test_a_gap_is_not_simulated_across() -> None:
    model, truth = pendulum_model()
    recording = recorded_in_closed_loop(model, truth, seed=2)
    half = len(recording.stamp_ns) // 2
    late = recording.stamp_ns.copy()
    late[half:] += 3_000_000_000
    moved = replace(recording, stamp_ns=late)
    made = simulated(moved, model, truth, 8.0)
    (block,) = made.blocks(len(late))
    before = (values[:half] for values in (recording.stamp_ns, recording.position, recording.torque))
    first = simulated(SampledRecording(*before, torque_zero_order_hold=True), model, truth, 8.0)
    np.testing.assert_allclose(block.position[:half], next(iter(first.blocks(half))).position, rtol=0, atol=1e-12)
    assert np.abs(block.position - moved.position).max() < 2e-3


def test_what_cannot_be_refined_says_why() -> None:
    model, truth = pendulum_model()
    recording = recorded_in_closed_loop(model, truth, seed=0)
    base = base_parameters(model.chain, model.layout)
    conditions = feasible_set("pseudo_inertia", base.names, model.config)
    fit = ordinary_least_squares(equations(recording, model, base).total)
    with pytest.raises(ModelError, match="5 of 6 directions"):
        instrumental_variables([recording], model, base, conditions, replace(fit, rank=5), truth)
    with pytest.raises(ModelError, match="needs a recording"):
        instrumental_variables([], model, base, conditions, fit, truth)
    with pytest.raises(ModelError, match="cut-off of 70 Hz"):
        simulated(recording, model, truth, 70.0)
    weightless = truth.copy()
    weightless[model.layout.inertial(0)] = 0.0
    with pytest.raises(ModelError, match="no centre of mass"):
        instrumental_variables([recording], model, base, conditions, fit, weightless)


def test_a_loop_that_runs_away_is_named() -> None:
    model, truth = pendulum_model()
    recording = recorded_in_closed_loop(model, truth, seed=0)
    with pytest.raises(ModelError, match="is unstable after"):
        simulated(replace(recording, position=1e6 * recording.position), model, truth, 8.0)
