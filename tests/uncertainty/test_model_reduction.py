"""Essential parameters: what is zero leaves, what matters stays, and the F-test keeps its level."""

from __future__ import annotations

import numpy as np
import pytest
import scipy  # its parts load for a second where they are used
from estimation.synthetic import one_joint_information

from ident_service.errors import ModelError
from ident_service.estimation.equations import Equations
from ident_service.estimation.least_squares import ordinary_least_squares, weighted_least_squares
from ident_service.estimation.model_reduction import effective_samples, essential_parameters
from ident_service.estimation.uncertainty import block_covariance

Array = np.ndarray
TRUTH = np.array([5.0, 0.0, -2.0, 0.0, 0.8, 0.0, 0.0, 3.0, 0.0, 0.0])
LARGE = np.flatnonzero(TRUTH)


def recorded(seed: int, *, memory: float = 0.0, blocks: int = 80, samples: int = 4000) -> Equations:
    """Ten columns whose size differs, slowly moving so that coloured noise counts; five parameters are zero."""
    rng = np.random.default_rng(seed)
    W = scipy.signal.lfilter([1.0], [1.0, -0.97], np.random.default_rng(0).normal(size=(samples, 10)), axis=0)
    W = W * np.geomspace(0.1, 1.0, 10) + 0.05 * W[:, ::-1]
    noise = rng.normal(size=samples)
    if memory:
        decay = np.exp(-1.0 / memory)
        noise = scipy.signal.lfilter([np.sqrt(1.0 - decay**2)], [1.0, -decay], noise)
    pairs = zip(np.split(W, blocks), np.split(W @ TRUTH + noise, blocks), strict=True)
    return Equations(tuple(one_joint_information(*pair) for pair in pairs), samples)


@pytest.mark.slow
@pytest.mark.parametrize(("memory", "share"), [(0.0, 0.005), (12.0, 0.05)])
def test_zeros_leave_and_large_ones_stay(memory: float, share: float) -> None:
    dropped = np.zeros(10)
    for seed in range(40):
        gathered = recorded(seed, memory=memory)
        result = essential_parameters(gathered, ordinary_least_squares(gathered.total))
        assert set(LARGE) <= set(result.kept)
        assert np.all(result.beta[np.setdiff1d(np.arange(10), result.kept)] == 0.0)
        errors = (result.beta - TRUTH)[LARGE] / result.standard_deviations[LARGE]
        assert np.abs(errors).max() < 6.0
        # What chance may explain of the residual: some parameters out of 4000, or of a few hundred independent rows.
        assert result.reduced.relative_percent < (1.0 + share) * result.full.relative_percent
        dropped[np.setdiff1d(np.arange(10), result.kept)] += 1.0 / 40.0
    # Five zeros leave together unless chance, at 5 %, makes the model without them look worse.
    assert np.all(dropped[TRUTH == 0.0] > 0.8)


def test_white_residuals_give_the_textbook_test() -> None:
    gathered = recorded(3)
    fit = ordinary_least_squares(gathered.total)
    rows, size = int(gathered.total.rows.sum()), 10
    residual = float(gathered.total.squared_residuals(fit.beta).sum())
    white = residual / (rows - size) * fit.inverse @ fit.inverse.T
    result = essential_parameters(gathered, fit, covariance=white)
    assert result.effective_samples == pytest.approx(rows, rel=1e-9)
    gone: list[int] = []
    for step in result.eliminated:
        kept = np.setdiff1d(np.arange(10), gone)
        beta = np.linalg.lstsq(fit.R1[:, kept], fit.rho1, rcond=None)[0]
        sizes = np.abs(beta) / np.sqrt(np.diag(np.linalg.inv(fit.R1[:, kept].T @ fit.R1[:, kept])))
        assert step.parameter == kept[np.argmin(sizes)]
        assert step.deviations == pytest.approx(sizes.min() / np.sqrt(residual / (rows - size)))
        gone.append(step.parameter)
        kept = np.setdiff1d(np.arange(10), gone)
        beta = np.zeros(10)
        beta[kept] = np.linalg.lstsq(fit.R1[:, kept], fit.rho1, rcond=None)[0]
        loss = float(gathered.total.squared_residuals(beta).sum()) - residual
        assert pytest.approx(loss / len(gone) / (residual / (rows - size))) == step.F
        assert step.critical >= step.F
    assert result.refused is not None
    assert result.refused.critical < result.refused.F


def test_coloured_noise_counts_for_fewer_samples() -> None:
    sizes = {}
    for memory in (0.0, 12.0):
        gathered = recorded(1, memory=memory)
        fit = ordinary_least_squares(gathered.total)
        sizes[memory] = essential_parameters(gathered, fit).effective_samples
    assert sizes[12.0] < 0.3 * sizes[0.0]
    assert sizes[0.0] <= 4000.0


def test_more_parameters_than_independent_samples_leaves_one_sample() -> None:
    gathered = recorded(1)
    fit = ordinary_least_squares(gathered.total)
    covariance = 1e9 * np.diag(fit.standard_deviations**2)
    assert effective_samples(fit, covariance, 4000) == 11.0
    assert effective_samples(fit, 1e-9 * covariance, 4000) == pytest.approx(4000.0)


def test_a_stricter_test_keeps_fewer() -> None:
    gathered = recorded(2)
    fit = ordinary_least_squares(gathered.total)
    kept = [len(essential_parameters(gathered, fit, significance_level=level).kept) for level in (1e-12, 0.05, 0.999)]
    assert kept[0] <= kept[1] <= kept[2]
    assert kept[0] < kept[2]


def test_weights_stay_what_they_were() -> None:
    gathered = recorded(5, memory=3.0)
    fit = weighted_least_squares(gathered.total)
    covariance = block_covariance(gathered, fit)
    given, own = (essential_parameters(gathered, fit, covariance=c) for c in (covariance, None))
    np.testing.assert_array_equal(given.kept, own.kept)
    kept = given.kept
    np.testing.assert_allclose(given.beta[kept], np.linalg.lstsq(fit.R1[:, kept], fit.rho1, rcond=None)[0], rtol=1e-9)


def test_nothing_is_decided_about_what_is_not_seen() -> None:
    W = np.random.default_rng(2).normal(size=(80, 4))
    W[:, 2] = 0.0
    gathered = Equations(tuple(one_joint_information(part, part @ np.ones(4)) for part in np.split(W, 8)), 80)
    fit = ordinary_least_squares(gathered.total)
    with pytest.raises(ModelError, match="3 of 4 directions"):
        essential_parameters(gathered, fit)
    whole = recorded(0)
    with pytest.raises(ModelError, match="level=1"):
        essential_parameters(whole, ordinary_least_squares(whole.total), significance_level=1.0)
