"""Doubt from blocks: it is the delete-one-block jackknife, and it is right where eq. 81 is not."""

from __future__ import annotations

from functools import reduce

import numpy as np
import pytest
import scipy  # its parts load for a second where they are used
from estimation.synthetic import one_joint_information, random_information, serial_chain
from helpers.random_arms import model_around, random_delta

from ident_service.estimation.equations import Equations
from ident_service.estimation.least_squares import ordinary_least_squares
from ident_service.estimation.uncertainty import jackknife, negligible, student_factors, uncertainty, verdicts
from ident_service.model.base_parameters import base_parameters
from ident_service.model.chain import Array
from ident_service.model.information import Information


def test_it_is_the_jackknife_over_blocks() -> None:
    arm = model_around(serial_chain(2, 2))
    base = base_parameters(arm.chain, arm.layout)
    delta = random_delta(np.random.default_rng(2), arm.layout)
    blocks = [
        random_information(arm, base, delta, seed=seed, samples=int(8 + 5 * seed), noise=0.5) for seed in range(12)
    ]
    gathered = Equations(tuple(blocks), 0)
    fit = ordinary_least_squares(gathered.total)
    wanted = np.zeros((base.size, base.size))
    for left_out in range(len(blocks)):
        rest = reduce(Information.merged, blocks[:left_out] + blocks[left_out + 1 :])
        change = ordinary_least_squares(rest).beta - fit.beta
        wanted += np.outer(change, change)
    got, *_ = jackknife(gathered.clusters, fit)
    scale = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))
    np.testing.assert_allclose(got / scale, wanted / scale, rtol=0, atol=1e-8)


def test_combinations_are_the_parameters_of_other_coordinates() -> None:
    rng = np.random.default_rng(3)
    W, y, T = rng.normal(size=(60, 3)), rng.normal(size=60), rng.normal(size=(3, 3))
    pairs = list(zip(np.split(W, 6), np.split(y, 6), strict=True))

    def cut(change: Array) -> Equations:
        return Equations(tuple(one_joint_information(rows @ change, torque) for rows, torque in pairs), len(W))

    # y = W b = (W T) c with c = T^-1 b.
    other, gathered = cut(T), cut(np.eye(3))
    wanted = jackknife(other.clusters, ordinary_least_squares(other.total))
    got = jackknife(gathered.clusters, ordinary_least_squares(gathered.total), np.linalg.inv(T).T)
    for one, another in zip(got, wanted, strict=True):
        np.testing.assert_allclose(one, another, rtol=1e-8)


@pytest.mark.campaign
@pytest.mark.slow
def test_it_is_calibrated_where_neighbours_are_alike() -> None:
    rng = np.random.default_rng(5)
    samples, blocks, parameters, repetitions = 2400, 60, 4, 200
    time = np.arange(samples) / 40.0
    W = np.column_stack([np.sin(w * time + w) for w in (0.5, 0.9, 1.4, 2.1)])
    errors, claimed, careful, white = (np.zeros((repetitions, parameters)) for _ in range(4))
    for repetition in range(repetitions):
        # First-order autoregression with a memory of ten samples, a quarter of a block.
        noise = scipy.signal.lfilter([1.0], [1.0, -0.9], rng.normal(size=samples))
        pairs = zip(np.split(W, blocks), np.split(noise, blocks), strict=True)
        parts = [one_joint_information(*pair) for pair in pairs]
        gathered = Equations(tuple(parts), samples)
        fit = ordinary_least_squares(gathered.total)
        errors[repetition] = fit.beta
        claimed[repetition] = np.diag(jackknife(gathered.clusters, fit)[0])
        careful[repetition] = uncertainty(gathered, fit).deviations ** 2
        white[repetition] = fit.standard_deviations**2
    empirical = np.sqrt(np.mean(errors**2, axis=0))
    np.testing.assert_allclose(np.sqrt(claimed.mean(axis=0)) / empirical, 1.0, rtol=0, atol=0.25)
    # The largest of three lengths, each widened for its degrees of freedom.
    assert np.all(np.sqrt(careful.mean(axis=0)) / empirical < 1.6)
    assert np.all(np.abs(errors) / np.sqrt(careful) < 4.0)
    # Residuals taken for independent promise too much by the factor that makes the blocks necessary.
    assert np.all(np.sqrt(white.mean(axis=0)) / empirical < 0.5)


def few_blocks(seed: int, blocks: int) -> tuple[Equations, np.ndarray]:
    """Equations of white noise, of which the last column is seen in the first block alone."""
    rng = np.random.default_rng(seed)
    parts = []
    for number in range(blocks):
        W = rng.normal(size=(30, 4))
        W[:, 3] *= number == 0
        parts.append(one_joint_information(W, rng.normal(size=30)))
    return Equations(tuple(parts), 30 * blocks), np.zeros(4)


def test_what_one_block_alone_tells_has_no_deviation() -> None:
    for seed in range(12):
        gathered, _ = few_blocks(seed, 10)
        found = uncertainty(gathered, ordinary_least_squares(gathered.total))
        np.testing.assert_array_equal(np.isinf(np.diag(found.covariance)), np.arange(4) == 3)


def test_no_deviation_is_below_that_of_white_residuals() -> None:
    for seed in range(12):
        gathered, _ = few_blocks(seed, 4)
        fit = ordinary_least_squares(gathered.total)
        deviations = np.sqrt(np.diag(uncertainty(gathered, fit).covariance))
        assert (deviations >= fit.standard_deviations * (1.0 - 1e-12)).all()


@pytest.mark.slow
@pytest.mark.parametrize("blocks", [4, 12, pytest.param(24, marks=pytest.mark.campaign)])
def test_degrees_of_freedom_are_those_of_the_variances(blocks: int) -> None:
    """The variance of a variance is 2 V^2 / degrees where errors are white, as it is of a chi-squared variable."""
    rng, repetitions = np.random.default_rng(blocks), 700
    W = rng.normal(size=(20 * blocks, 3))
    claimed = np.zeros((repetitions, 3))
    for repetition in range(repetitions):
        noise = rng.normal(size=len(W))
        parts = [
            one_joint_information(*pair) for pair in zip(np.split(W, blocks), np.split(noise, blocks), strict=True)
        ]
        gathered = Equations(tuple(parts), len(W))
        fit = ordinary_least_squares(gathered.total)
        covariance, degrees, _ = jackknife(gathered.clusters, fit)
        claimed[repetition] = np.diag(covariance)
    empirical = 2.0 * claimed.mean(axis=0) ** 2 / claimed.var(axis=0)
    np.testing.assert_allclose(degrees / empirical, 1.0, rtol=0, atol=0.25)


def test_a_deviation_from_few_blocks_is_wider() -> None:
    table = [1.0, 2.021 / 1.960, 2.776 / 1.960]  # of Student's t
    np.testing.assert_allclose(student_factors(np.array([1e6, 40.0, 4.0])), table, rtol=1e-3)


def repeated(periods: int, error: float, noise: float, seed: int = 3) -> Equations:
    """Equations of a motion that is repeated, with an error of the model that is the same in each period."""
    rng = np.random.default_rng(seed)
    parts, samples = 12, 30
    time = np.arange(parts * samples) / samples
    W = np.column_stack([np.sin(w * time + w) for w in (0.5, 0.9, 1.4)])
    model = error * np.sin(2.3 * time + 0.4)
    blocks = [
        one_joint_information(*pair)
        for _ in range(periods)
        for pair in zip(np.split(W, parts), np.split(model + noise * rng.normal(size=len(W)), parts), strict=True)
    ]
    labels = tuple((-1, phase) for _ in range(periods) for phase in range(parts))
    return Equations(tuple(blocks), periods * len(W), (), labels)


def test_repetitions_say_nothing_new_about_what_the_model_lacks() -> None:
    deviations = []
    for periods in (1, 9):
        gathered = repeated(periods, error=1.0, noise=0.01)
        found = uncertainty(gathered, ordinary_least_squares(gathered.total))
        deviations.append(found.deviations)
        assert (found.noise is None) == (periods == 1)
    np.testing.assert_allclose(deviations[1] / deviations[0], 1.0, rtol=0.02)
    assert found.noise is not None
    assert (np.sqrt(found.noise) < 0.02 * deviations[1]).all()


def test_repetitions_average_noise_out() -> None:
    deviations = []
    for periods in (3, 12):
        gathered = repeated(periods, error=0.0, noise=1.0)
        fit = ordinary_least_squares(gathered.total)
        found = uncertainty(gathered, fit)
        deviations.append(found.deviations)
        assert found.noise is not None
        np.testing.assert_allclose(np.sqrt(found.noise) / fit.standard_deviations, 1.0, rtol=0, atol=0.35)
    np.testing.assert_allclose(deviations[1] / deviations[0], 0.5, rtol=0.4)


@pytest.mark.parametrize(
    ("value", "deviation", "word"),
    [
        (2.0, 0.19, "identified"),
        (2.0, 0.21, "weak"),
        (-2.0, 0.99, "weak"),
        (-2.0, 1.01, "unidentified"),
        (0.0, 0.0009, "identified"),
        (0.0, 0.0011, "weak"),
        (1e-9, 0.0051, "unidentified"),
        (5.0, np.inf, "unidentified"),
        (0.0, 0.0, "identified"),
    ],
)
def test_verdicts_hold_a_deviation_against_size_or_what_is_as_good_as_zero(
    value: float, deviation: float, word: str
) -> None:
    assert verdicts(np.array([value]), np.array([deviation]), np.array([0.01])) == (word,)


def test_a_parameter_is_as_good_as_zero_that_makes_a_tenth_of_a_joints_torque() -> None:
    arm = model_around(serial_chain(4, 3))
    base = base_parameters(arm.chain, arm.layout)
    information = random_information(arm, base, random_delta(np.random.default_rng(4), arm.layout), seed=4)
    sizes = negligible(information)
    torques = np.sqrt(information.squared_torques())
    for place, size in enumerate(sizes):
        alone = np.zeros(base.size)
        alone[place] = size
        made = [
            np.linalg.norm(factor[:, :-1] @ alone[support])
            for support, factor in zip(information.supports, information.factors, strict=True)
        ]
        assert np.max(made / torques) == pytest.approx(0.1)
