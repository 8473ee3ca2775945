"""Doubt from blocks: it is the delete-one-block jackknife, and it is right where eq. 81 is not."""

from __future__ import annotations

from functools import reduce

import numpy as np
import pytest
import scipy.signal
from estimation.synthetic import one_joint_information, random_information, serial_chain
from helpers.random_arms import model_around, random_delta

from ident_service.estimation.doubt import REFERENCE, block_covariance, verdicts
from ident_service.estimation.equations import Equations
from ident_service.estimation.least_squares import ordinary_least_squares
from ident_service.model.base import base_parameters
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
    got = block_covariance(gathered, fit)
    scale = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))
    np.testing.assert_allclose(got / scale, wanted / scale, rtol=0, atol=1e-8)


@pytest.mark.slow
def test_it_is_calibrated_where_neighbours_are_alike() -> None:
    rng = np.random.default_rng(5)
    samples, blocks, parameters, repetitions = 2400, 60, 4, 300
    time = np.arange(samples) / 40.0
    W = np.column_stack([np.sin(w * time + w) for w in (0.5, 0.9, 1.4, 2.1)])
    errors, claimed, white = (np.zeros((repetitions, parameters)) for _ in range(3))
    for repetition in range(repetitions):
        # First-order autoregression with a memory of ten samples, a quarter of a block.
        noise = scipy.signal.lfilter([1.0], [1.0, -0.9], rng.normal(size=samples))
        pairs = zip(np.split(W, blocks), np.split(noise, blocks), strict=True)
        parts = [one_joint_information(*pair) for pair in pairs]
        gathered = Equations(tuple(parts), samples)
        fit = ordinary_least_squares(gathered.total)
        errors[repetition] = fit.beta
        claimed[repetition] = np.diag(block_covariance(gathered, fit))
        white[repetition] = fit.standard_deviations**2
    empirical = np.sqrt(np.mean(errors**2, axis=0))
    np.testing.assert_allclose(np.sqrt(claimed.mean(axis=0)) / empirical, 1.0, rtol=0, atol=0.25)
    # Residuals taken for independent promise too much by the factor that makes the blocks necessary.
    assert np.all(np.sqrt(white.mean(axis=0)) / empirical < 0.5)


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
def test_verdicts_hold_a_deviation_against_size_or_reference(value: float, deviation: float, word: str) -> None:
    assert REFERENCE["kg m^2"] == 0.01
    assert verdicts(np.array([value]), np.array([deviation]), ("kg m^2",)) == (word,)


def test_verdicts_without_a_unit_only_know_the_size() -> None:
    assert verdicts(np.array([0.0, 1.0]), np.array([1e-12, 0.05]), ("", "")) == ("unidentified", "identified")
