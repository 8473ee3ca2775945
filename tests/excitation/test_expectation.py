"""What a motion will teach, told beforehand, is what estimates from it show afterwards."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from design_bench import ONE_START, quick, small
from motions import random_fourier_path

from ident_service.config.arm import Control
from ident_service.config.motion_limits import motion_limits
from ident_service.excitation.design import complete_task, criterion_of, design_motion, motion_family
from ident_service.excitation.prediction import (
    NoiseModel,
    described_noise,
    expected_deviations,
    information,
    seconds_of_information,
)
from ident_service.excitation.trajectory import FourierPath, PosturePath
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import BaseParameters, base_parameters
from ident_service.model.regressor import joint_regressor

Array = np.ndarray
NOISE = NoiseModel(np.array([0.5, 0.1]), 1.0, "a test")
RATE = 50.0


def slow_sampled() -> ArmModel:
    """planar2, recorded at a rate that keeps a Monte Carlo small, with gains that are stable at it."""
    soft = {"kp": 60.0, "kd": 12.0, "following_error": 0.5}
    model = small(joints={"shoulder": soft, "elbow": soft})
    return replace(model, config=model.config.model_copy(update={"control": Control(rate=RATE)}))


MODEL = slow_sampled()
BASE = base_parameters(MODEL.chain, MODEL.layout)
PATH = FourierPath(random_fourier_path(1, ramps=False).series, 2)


def rows_at_the_recording_s_rate(path: FourierPath, base: BaseParameters = BASE) -> Array:
    """The whitened regressor of every sample, shape (rows, base)."""
    count = round(path.periods * path.series.period * RATE)
    time = path.ramp + np.arange(count) / RATE
    H = joint_regressor(MODEL.chain, MODEL.layout, *path.at(time)[:3], base.base)
    return np.concatenate([rows.T / sigma for rows, sigma in zip(H, NOISE.deviation, strict=True)])


def test_least_squares_estimates_scatter_as_predicted() -> None:
    W, rng, replicates = rows_at_the_recording_s_rate(PATH), np.random.default_rng(0), 1000
    solve = np.linalg.pinv(W)
    errors = solve @ rng.normal(size=(len(W), replicates))
    told = expected_deviations(PATH, MODEL, BASE, NOISE)
    # The deviation of a deviation from so many replicates is 1 / sqrt(2 replicates).
    assert np.abs(errors.std(axis=1) / told - 1.0).max() < 4.5 / np.sqrt(2.0 * replicates)


def test_the_information_is_that_of_the_recording_s_samples() -> None:
    W = rows_at_the_recording_s_rate(PATH)
    G = information(PATH, MODEL, BASE, NOISE.deviation) * seconds_of_information(PATH) * RATE
    size = np.sqrt(np.outer(np.diag(G), np.diag(G)))
    np.testing.assert_allclose(W.T @ W / size, G / size, atol=2e-2)


def test_four_times_the_periods_halve_the_deviations_and_ramps_count_for_nothing() -> None:
    once = expected_deviations(FourierPath(PATH.series, 1), MODEL, BASE, NOISE)
    four = expected_deviations(FourierPath(PATH.series, 4), MODEL, BASE, NOISE)
    ramped = expected_deviations(FourierPath(PATH.series, 4, 5.0), MODEL, BASE, NOISE)
    np.testing.assert_allclose(four, 0.5 * once, rtol=1e-9)
    np.testing.assert_allclose(ramped, four, rtol=1e-6)


def test_twice_the_noise_or_an_inflation_of_two_doubles_the_deviations() -> None:
    once = expected_deviations(PATH, MODEL, BASE, NOISE)
    noisy = expected_deviations(PATH, MODEL, BASE, replace(NOISE, deviation=2.0 * NOISE.deviation))
    inflated = expected_deviations(PATH, MODEL, BASE, replace(NOISE, inflation=2.0))
    np.testing.assert_allclose(noisy, 2.0 * once, rtol=1e-9)
    np.testing.assert_allclose(inflated, 2.0 * once, rtol=1e-9)


def test_a_joint_that_stands_still_teaches_nothing_of_its_own() -> None:
    series = replace(PATH.series, a=PATH.series.a * [[1.0], [0.0]], b=PATH.series.b * [[1.0], [0.0]])
    told = dict(zip(BASE.expressions, expected_deviations(FourierPath(series, 2), MODEL, BASE, NOISE), strict=True))
    for name in ("fv2", "fc2"):
        assert told[name] == np.inf
    for name in ("fv1", "fc1", "fo1"):
        assert np.isfinite(told[name])


def test_an_arm_that_stands_still_teaches_no_friction() -> None:
    still = PosturePath(np.zeros((2, 2)), np.ones(1), 1.0)
    told = dict(zip(BASE.expressions, expected_deviations(still, MODEL, BASE, NOISE), strict=True))
    for name in ("fv1", "fc1", "fo1", "fv2", "fc2", "fo2"):
        assert told[name] == np.inf  # an offset and gravity cannot be told apart either


def test_where_nothing_at_all_is_taught_everything_is_infinite() -> None:
    model = small(gravity=[0.0, 0.0, 0.0], terms=["drive_inertia", "viscous"])
    base = base_parameters(model.chain, model.layout)
    still = PosturePath(np.zeros((2, 2)), np.ones(1), 1.0)
    np.testing.assert_array_equal(expected_deviations(still, model, base, NOISE), np.inf)


def test_added_information_is_information_like_any_other() -> None:
    G = information(PATH, MODEL, BASE, NOISE.deviation) * seconds_of_information(PATH) * RATE
    once = expected_deviations(PATH, MODEL, BASE, NOISE)
    np.testing.assert_allclose(expected_deviations(PATH, MODEL, BASE, NOISE, 3.0 * G), 0.5 * once, rtol=1e-6)


def test_noise_is_the_simulated_driver_s_else_a_hundredth_of_the_torque() -> None:
    limits = motion_limits(MODEL.config)
    np.testing.assert_array_equal(described_noise(MODEL, limits).deviation, [0.05, 0.02])
    other = small(driver=None)
    np.testing.assert_allclose(described_noise(other, limits).deviation, 0.01 * limits.torque)


@pytest.mark.campaign
@pytest.mark.slow
@pytest.mark.parametrize("seed", [pytest.param(0, marks=pytest.mark.campaign), 1])
def test_a_motion_designed_with_earlier_information_teaches_more_of_the_rest(seed: int) -> None:
    # Half of the parameters are known already, a thousand times better than one motion will tell.
    model, design = MODEL, quick(criterion="a_optimal")
    basis, base = motion_family(design, model)
    noise = described_noise(model, motion_limits(model.config))
    without = design_motion(model, design, seed=seed, budget=ONE_START).excitation.path
    # Known are the inertias and moments of first order; unknown the friction.
    known = np.array([expression.startswith(("L", "l", "m", "I")) for expression in base.expressions])
    added = np.diag(np.where(known, 1e6 / expected_deviations(without, model, base, noise) ** 2, 0.0))
    with_added = design_motion(model, design, seed=seed, budget=ONE_START, earlier_information=added).excitation.path
    deviations = [expected_deviations(path, model, base, noise, added) for path in (without, with_added)]
    task = complete_task(model, design, basis, base, earlier_information=added)
    assert criterion_of(task, with_added, base) < criterion_of(task, without, base)
    assert task.scale is not None
    before, after = ((part / task.scale)[~known] ** 2 for part in deviations)
    assert after.mean() < before.mean()
