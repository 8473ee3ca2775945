"""Estimators that weigh equations: by joint, and by how badly they fit."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from estimation.synthetic import SampledRecording, one_joint_information, recorded, serial_chain, waves, with_options
from helpers.plain import plain_options, plain_smoothing
from helpers.random_arms import model_around, random_delta

from ident_service.config.arm import Reversal
from ident_service.estimation import robust_regression as robust
from ident_service.estimation.equations import equations
from ident_service.estimation.identify import identify
from ident_service.estimation.least_squares import ordinary_least_squares, weighted_least_squares
from ident_service.estimation.robust_regression import huber
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import BaseParameters, base_parameters
from ident_service.model.information import Information, information_of, sparsity
from ident_service.model.regressor import joint_regressor
from ident_service.results.parameter_file import parameters_document, write_parameters


@cache
def three_links() -> tuple[ArmModel, BaseParameters, np.ndarray]:
    options = plain_options(smoothing=plain_smoothing(cutoff=30.0), reversal=Reversal(window=0.05))
    model = with_options(model_around(serial_chain(31, 3)), options)
    return model, base_parameters(model.chain, model.layout), random_delta(np.random.default_rng(7), model.layout)


def rows(seed: int, deviations: tuple[float, ...], samples: int = 150) -> tuple[np.ndarray, np.ndarray, Information]:
    """H_b, torque and information of random states, each joint with noise of its own."""
    model, base, delta = three_links()
    rng = np.random.default_rng(seed)
    states = rng.uniform(-2.0, 2.0, size=(3, samples, 3))
    H_b = joint_regressor(model.chain, model.layout, *states, base.base)
    torque = np.einsum("jps,p->sj", H_b, base.K @ delta) + rng.normal(size=(samples, 3)) * np.array(deviations)
    felt = sparsity(model.chain, model.layout, base.base)
    return H_b, torque, information_of(H_b, torque, np.ones(torque.shape, dtype=bool), felt)


def iterated(H_b: np.ndarray, torque: np.ndarray, rounds: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Gautier's weighting in the plainest words: stack, divide by the joint's own residual, repeat."""
    joints, size, samples = H_b.shape
    deviations = np.ones(joints)
    for _ in range(rounds):
        W = np.vstack([H_b[joint].T / deviations[joint] for joint in range(joints)])
        omega = np.concatenate([torque[:, joint] / deviations[joint] for joint in range(joints)])
        beta = np.linalg.lstsq(W, omega, rcond=None)[0]
        errors = [torque[:, joint] - H_b[joint].T @ beta for joint in range(joints)]
        deviations = np.array([np.sqrt(error @ error / (samples - size / joints)) for error in errors])
    return beta, deviations


def test_weighted_least_squares_equals_iterated_numpy() -> None:
    H_b, torque, information = rows(1, (5.0, 0.5, 0.02))
    beta, deviations = iterated(H_b, torque)
    fit = weighted_least_squares(information)
    np.testing.assert_allclose(fit.beta, beta, rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(fit.weights * deviations, np.exp(np.mean(np.log(deviations))), rtol=1e-6)


def test_unit_of_the_torques_does_not_matter() -> None:
    _, _, information = rows(2, (5.0, 0.5, 0.02))
    fit = weighted_least_squares(information)
    for factor in (1e-3, 1e4):
        scaled = weighted_least_squares(information.with_torques_times(np.full(3, factor)))
        np.testing.assert_allclose(scaled.beta, factor * fit.beta, rtol=1e-7, atol=1e-9 * factor)
        np.testing.assert_allclose(scaled.weights, fit.weights, rtol=1e-6)
        np.testing.assert_allclose(scaled.standard_deviations, factor * fit.standard_deviations, rtol=1e-6)


def test_one_joint_weighs_nothing() -> None:
    rng = np.random.default_rng(3)
    W, omega = rng.normal(size=(80, 5)), rng.normal(size=80)
    information = one_joint_information(W, omega)
    fit, plain = weighted_least_squares(information), ordinary_least_squares(information)
    np.testing.assert_allclose(fit.weights, 1.0, rtol=1e-12)
    np.testing.assert_allclose(fit.beta, plain.beta, rtol=1e-10)


def test_exact_equations_settle() -> None:
    _, base, delta = three_links()
    _, _, information = rows(4, (0.0, 0.0, 0.0))
    np.testing.assert_allclose(weighted_least_squares(information).beta, base.K @ delta, rtol=1e-7, atol=1e-8)


def test_joints_of_different_noise_are_worth_different_weights() -> None:
    _, base, delta = three_links()
    truth = base.K @ delta
    plain, weighted, inside = [], [], []
    for seed in range(40):
        _, _, information = rows(100 + seed, (5.0, 0.5, 0.02))
        plain.append(ordinary_least_squares(information).beta - truth)
        fit = weighted_least_squares(information)
        weighted.append(fit.beta - truth)
        inside.append(np.abs(fit.beta - truth) < 1.96 * fit.standard_deviations)
    one, other = (np.sqrt(np.mean(np.square(errors), axis=0)) for errors in (plain, weighted))
    assert np.all(other < 1.2 * one)
    assert np.median(other / one) < 0.5
    # Only with the right weights are the white deviations right.
    assert np.mean(inside) == pytest.approx(0.95, abs=0.04)


# Bad rows.


def with_noise(outliers: float, deviations: tuple[float, ...] = (0.2, 0.1, 0.05), seed: int = 3) -> SampledRecording:
    """An exact recording with noise on the torque, a share of its samples grossly wrong, all in one direction."""
    model, _, delta = three_links()
    exact = recorded(model, delta, waves(4, 3), rate=200.0, seconds=40.0)
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=exact.torque.shape) * np.array(deviations)
    noise[rng.random(noise.shape) < outliers] += 40.0
    return replace(exact, torque=exact.torque + noise)


def off(estimate: np.ndarray) -> float:
    """How far an estimate predicts torques from the truth, in equations without noise."""
    _, base, delta = three_links()
    _, _, information = rows(5, (0.0, 0.0, 0.0))
    truth = base.K @ delta
    fit = ordinary_least_squares(information)
    return float(np.linalg.norm(fit.R1 @ (estimate - truth)))


def huber_of(recording: SampledRecording, scales: np.ndarray | None = None) -> np.ndarray:
    model, base, _ = three_links()
    gathered = equations(recording, model, base)
    gathered = gathered if scales is None else gathered.with_torques_times(scales)
    return huber([recording], model, base, weighted_least_squares(gathered.total), scales)[0].beta


def test_gross_outliers_hardly_move_huber() -> None:
    model, base, _ = three_links()
    recording = with_noise(0.02)
    plain = ordinary_least_squares(equations(recording, model, base).total).beta
    assert off(huber_of(recording)) < off(plain) / 3.0


def test_without_outliers_huber_is_weighted_least_squares_nearly() -> None:
    model, base, _ = three_links()
    recording = with_noise(0.0)
    total = equations(recording, model, base).everything
    fit = weighted_least_squares(total)
    robust, gathered, _ = huber([recording], model, base, fit)
    assert np.all(np.abs(robust.beta - fit.beta) < 1.5 * fit.standard_deviations)
    np.testing.assert_allclose(robust.standard_deviations, fit.standard_deviations, rtol=0.25)
    np.testing.assert_array_equal(gathered.total.rows, total.rows)


def test_huber_solves_its_own_condition() -> None:
    # At the estimate, the sum of regressor times clipped residual vanishes.
    model, base, _ = three_links()
    recording = with_noise(0.02)
    fit, gathered, _ = huber([recording], model, base, weighted_least_squares(equations(recording, model, base).total))
    scores = gathered.total.scores(fit.beta)
    assert np.all(np.abs(fit.inverse.T @ scores) < 1e-6 * np.linalg.norm(fit.rho1))


def test_huber_knows_torque_constants() -> None:
    scales = np.array([2.0, 0.5, 1.25])
    recording = with_noise(0.01)
    halved = replace(recording, torque=recording.torque / scales)
    np.testing.assert_allclose(huber_of(halved, scales), huber_of(recording), rtol=0, atol=1e-6)


def test_the_start_does_not_matter() -> None:
    model, base, _ = three_links()
    recording = with_noise(0.02)
    total = equations(recording, model, base).total
    one, other = (
        huber([recording], model, base, start)[0]
        for start in (weighted_least_squares(total), ordinary_least_squares(total))
    )
    assert np.all(np.abs(one.beta - other.beta) < 0.05 * one.standard_deviations)


# The whole way.


@pytest.fixture(scope="module")
def estimates() -> dict[str, np.ndarray]:
    model, _, _ = three_links()
    recording = with_noise(0.0)
    found = {}
    for method in ("ols", "wls", "huber", "iv"):
        estimate = identify(model, [recording], method=method)  # type: ignore[arg-type]
        assert estimate.method == method
        assert estimate.candidates[0].name == method.upper()
        assert estimate.feasible
        found[method] = estimate.candidates[0].beta
    return found


@pytest.mark.slow
def test_every_method_finds_the_parameters(estimates: dict[str, np.ndarray]) -> None:
    _, base, delta = three_links()
    _, _, information = rows(5, (0.0, 0.0, 0.0))
    whole = float(np.sqrt(information.squared_torques().sum()))
    assert len(estimates) == 4
    for method, beta in estimates.items():
        assert off(beta) < 0.02 * whole, method
    assert off(estimates["wls"]) < off(estimates["ols"])
    assert len({tuple(beta) for beta in estimates.values()}) == 4
    assert off(base.K @ delta) < 1e-9 * whole


@pytest.mark.slow
def test_weights_that_do_not_settle_give_the_best_round_and_say_so(monkeypatch: pytest.MonkeyPatch) -> None:
    model, _, _ = three_links()
    monkeypatch.setattr("ident_service.estimation.robust_regression._MOST_ROUNDS", 2)
    estimate = identify(model, [with_noise(0.02)], method="huber")
    assert np.isfinite(estimate.beta).all()
    assert "Huber's weights did not converge: the round is used" in estimate.remarks[0]
    monkeypatch.undo()
    assert identify(model, [with_noise(0.02)], method="huber").remarks == ()


@pytest.mark.campaign
@pytest.mark.slow
def test_instruments_that_do_not_settle_give_the_best_round_and_say_so(monkeypatch: pytest.MonkeyPatch) -> None:
    model, _, _ = three_links()
    settled = identify(model, [with_noise(0.0)], method="iv")
    assert settled.remarks == ()
    monkeypatch.setattr("ident_service.estimation.instrumental_variables._MOST_ROUNDS", 3)
    monkeypatch.setattr("ident_service.estimation.instrumental_variables.SETTLED", 0.0)
    estimate = identify(model, [with_noise(0.0)], method="iv")
    (remark,) = estimate.remarks
    assert remark.startswith("the instrumental estimate did not converge: the round is used that changed")
    assert estimate.method == "iv"
    assert np.all(np.abs(estimate.beta - settled.beta) < 0.1 * settled.standard_deviations)
    assert np.isfinite(estimate.standard_deviations).all()


@pytest.mark.parametrize("torque", [0.0, 1.5])
def test_a_torque_that_never_changes_leaves_numbers_everywhere(torque: float, tmp_path: Path) -> None:
    model, _, _ = three_links()
    recording = with_noise(0.0)
    columns = recording.torque.copy()
    columns[:, 2] = torque
    estimate = identify(model, [replace(recording, torque=columns)], method="wls")
    assert estimate.method == "wls"
    assert estimate.feasible
    assert estimate.delta is not None
    for values in (estimate.beta, estimate.standard_deviations, estimate.covariance, estimate.delta):
        assert np.isfinite(values).all()
    path = tmp_path / "parameters.json"
    write_parameters(path, parameters_document(estimate))
    document = json.loads(path.read_text(), parse_constant=lambda word: pytest.fail(f"{word} in the file"))
    assert document["base_parameters"]


def test_the_rows_that_weights_are_found_on_do_not_grow_with_the_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    model, base, _ = three_links()
    monkeypatch.setattr(robust, "_SPREAD", 300)
    for count in (1, 2, 5):
        recordings = [with_noise(0.0, seed=seed) for seed in range(count)]
        found = robust.spread_rows(recordings, model, base, np.ones(3), np.ones(3))
        assert all(300 < len(table) <= 600 for table in found.tables)
