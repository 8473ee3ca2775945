"""Criteria of the information matrix: values that are known, gradients, and what they do not depend on."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ident_service.excitation.optimal_design import condition_number, criterion

Array = np.ndarray
SEEDS = st.integers(0, 2**32 - 1)
KINDS: list[Any] = ["d_optimal", "a_optimal", "condition_number"]


def random_rows(seed: int, parameters: int) -> Array:
    """A well-conditioned regressor, rows by parameters."""
    return np.random.default_rng(seed).normal(size=(4 * parameters, parameters))


@settings(max_examples=40)
@given(seed=SEEDS, n=st.integers(1, 8), sharpness=st.floats(1.0, 64.0), some=st.booleans(), scaled=st.booleans())
@pytest.mark.parametrize("kind", KINDS)
def test_the_gradient_is_what_central_differences_say(
    kind: Any, seed: int, n: int, sharpness: float, some: bool, scaled: bool
) -> None:
    rng = np.random.default_rng(seed)
    W = random_rows(seed, n)
    G, direction = W.T @ W, rng.normal(size=(n, n))
    direction = 0.5 * (direction + direction.T)
    chosen = np.sort(rng.choice(n, size=rng.integers(1, n + 1), replace=False)) if some else None
    scale = rng.uniform(0.1, 10.0, size=n) if scaled else None
    value = criterion(kind, G, sharpness, chosen, scale)
    np.testing.assert_allclose(value.gradient, value.gradient.T, atol=1e-12)
    step = 1e-5
    above, below = (criterion(kind, G + s * direction, sharpness, chosen, scale).value for s in (step, -step))
    slope = float((value.gradient * direction).sum())
    assert slope == pytest.approx((above - below) / (2.0 * step), rel=1e-4, abs=1e-7)


@given(seed=SEEDS, n=st.integers(1, 10))
def test_d_optimal_is_the_log_determinant_per_parameter(seed: int, n: int) -> None:
    W = random_rows(seed, n)
    assert criterion("d_optimal", W.T @ W).value == pytest.approx(-np.linalg.slogdet(W.T @ W)[1] / n, abs=1e-9)


@given(seed=SEEDS, n=st.integers(1, 10))
def test_a_optimal_is_the_log_of_the_mean_variance_of_the_chosen_in_their_units(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    W, scale = random_rows(seed, n), rng.uniform(0.1, 10.0, size=n)
    chosen = np.sort(rng.choice(n, size=rng.integers(1, n + 1), replace=False))
    variances = np.diag(np.linalg.inv(W.T @ W))
    assert criterion("a_optimal", W.T @ W).value == pytest.approx(np.log(variances.mean()))
    wanted = np.log((variances / scale**2)[chosen].mean())
    assert criterion("a_optimal", W.T @ W, chosen_indices=chosen, parameter_scales=scale).value == pytest.approx(wanted)


@given(seed=SEEDS, n=st.integers(1, 10))
def test_the_smooth_condition_number_tends_to_the_true_one_from_above(seed: int, n: int) -> None:
    W = random_rows(seed, n)
    true = np.log(np.linalg.cond(W))
    values = [criterion("condition_number", W.T @ W, sharpness).value for sharpness in (1.0, 8.0, 64.0)]
    assert values[0] >= values[1] - 1e-9 >= values[2] - 2e-9 >= true - 1e-8
    assert values[2] - true <= np.log(n) / 64.0 + 1e-8
    assert condition_number(W.T @ W) == pytest.approx(np.exp(true), rel=1e-6)


@given(seed=SEEDS, n=st.integers(1, 8), factor=st.floats(1e-3, 1e3))
def test_more_of_the_same_information_counts_as_it_should(seed: int, n: int, factor: float) -> None:
    G = random_rows(seed, n).T @ random_rows(seed, n)
    # Both optimality criteria fall by the logarithm of the factor; the condition number does not see it.
    expected = {"d_optimal": -np.log(factor), "a_optimal": -np.log(factor), "condition_number": 0.0}
    for kind in KINDS:
        difference = criterion(kind, factor * G).value - criterion(kind, G).value
        assert difference == pytest.approx(expected[kind], abs=1e-8)


@given(seed=SEEDS, n=st.integers(2, 8))
def test_d_optimal_ranks_motions_alike_whatever_the_units(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    one, other, units = random_rows(seed, n), random_rows(seed + 1, n), np.diag(rng.uniform(0.01, 100.0, size=n))
    plain = [criterion("d_optimal", W.T @ W).value for W in (one, other)]
    changed = [criterion("d_optimal", units @ W.T @ W @ units).value for W in (one, other)]
    assert changed[0] - changed[1] == pytest.approx(plain[0] - plain[1], abs=1e-7)


@given(seed=SEEDS, n=st.integers(2, 8))
def test_a_optimal_in_units_of_the_scale_does_not_depend_on_the_units(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    W, scale, units = random_rows(seed, n), rng.uniform(0.1, 10.0, size=n), rng.uniform(0.1, 10.0, size=n)
    plain = criterion("a_optimal", W.T @ W, parameter_scales=scale).value
    # A parameter u times as large in number is a column 1/u as large, and its scale is u times as large too.
    changed = criterion("a_optimal", (W / units).T @ (W / units), parameter_scales=scale * units).value
    assert changed == pytest.approx(plain, abs=1e-8)


@given(seed=SEEDS, n=st.integers(2, 8))
@pytest.mark.parametrize("kind", KINDS)
def test_the_order_of_the_parameters_does_not_matter(kind: Any, seed: int, n: int) -> None:
    W, order = random_rows(seed, n), np.random.default_rng(seed).permutation(n)
    one, other = (criterion(kind, rows.T @ rows) for rows in (W, W[:, order]))
    assert other.value == pytest.approx(one.value, abs=1e-9)
    np.testing.assert_allclose(other.gradient, one.gradient[np.ix_(order, order)], rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_more_information_is_never_worse_for_the_optimal_designs(kind: Any) -> None:
    W, row = random_rows(3, 5), np.random.default_rng(4).normal(size=5)
    less, more = (criterion(kind, G).value for G in (W.T @ W, W.T @ W + 10.0 * np.outer(row, row)))
    # A single strong row may well spoil the condition number.
    assert (more < less) == (kind != "condition_number")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("G", [np.zeros((3, 3)), np.diag([1.0, 1.0, 0.0]), np.diag([1e300, 1.0, 1e-300])])
def test_no_information_is_bad_but_a_number(kind: Any, G: Array) -> None:
    with np.errstate(over="ignore"):
        value = criterion(kind, G)
    assert np.isfinite(value.value)


def test_the_condition_number_of_no_information_is_infinite() -> None:
    assert condition_number(np.diag([1.0, 0.0])) == np.inf
    assert condition_number(np.zeros((2, 2))) == np.inf
    assert condition_number(np.diag([1.0, -1e-20])) == np.inf
    assert condition_number(np.diag([4.0, 1.0])) == 2.0
