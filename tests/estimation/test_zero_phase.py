"""Filters against scipy.signal, which computes the same and is not loaded by the product."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import scipy  # its parts load for a second where they are used
from hypothesis import given
from hypothesis import strategies as st

from ident_service.model.zero_phase import local_polynomial, low_pass, spline_shifted, widened


def walk(samples: int, seed: int = 0) -> np.ndarray:
    return np.cumsum(np.random.default_rng(seed).normal(size=(samples, 3)), axis=0)


@given(st.integers(1, 6), st.floats(0.001, 0.49), st.integers(40, 400), st.integers(0, 2**32 - 1))
def test_a_low_pass_is_scipys(order: int, share: float, samples: int, seed: int) -> None:
    rate, values = 250.0, walk(samples, seed)
    sections = scipy.signal.butter(order, share * rate, fs=rate, output="sos")
    for pad in (None, 0, samples - 1):
        expected = scipy.signal.sosfiltfilt(sections, values, axis=0, **({} if pad is None else {"padlen": pad}))
        found = low_pass(values, order, share * rate, rate, pad)
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-8 * np.abs(values).max())


def test_a_low_pass_of_an_hour_of_a_slow_signal_keeps_its_digits() -> None:
    values = walk(200_000)
    sections = scipy.signal.butter(3, 10.0, fs=1000.0, output="sos")
    expected = scipy.signal.sosfiltfilt(sections, values, axis=0, padlen=300)
    np.testing.assert_allclose(low_pass(values, 3, 10.0, 1000.0, 300), expected, rtol=0.0, atol=1e-8)


@given(st.integers(0, 40), st.integers(0, 5), st.integers(0, 2), st.integers(0, 2**32 - 1))
def test_a_local_polynomial_is_scipys(half: int, degree: int, derivative: int, seed: int) -> None:
    length = 2 * half + 1
    if degree >= length:
        with pytest.raises(ValueError, match="does not fit"):
            local_polynomial(walk(100), length, degree, derivative, 0.01)
        return
    values = walk(100, seed)
    expected = scipy.signal.savgol_filter(values, length, degree, deriv=derivative, delta=0.01, axis=0)
    found = local_polynomial(values, length, degree, derivative, 0.01)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-7 * max(1.0, np.abs(expected).max()))


@given(st.integers(1, 200), st.floats(-40.0, 40.0), st.integers(0, 2**32 - 1))
def test_a_shift_is_scipys(samples: int, steps: float, seed: int) -> None:
    values = walk(samples, seed)
    columns = [scipy.ndimage.shift(column, -steps, order=3, mode="nearest") for column in values.T]
    # scipy mirrors its spline twelve samples beyond the ends, this one further out; its memory is 0.268 a sample.
    close = 1e-13 + 1e-7 * 0.268 ** max(12.0 - abs(steps), 0.0)
    found = spline_shifted(values, steps)
    np.testing.assert_allclose(found, np.column_stack(columns), rtol=0.0, atol=close * max(1.0, np.abs(values).max()))


@pytest.mark.parametrize("cutoff", [0.0, -1.0, 50.0, 60.0, float("nan")])
def test_an_impossible_cut_off_is_refused(cutoff: float) -> None:
    with pytest.raises(ValueError, match="is not between"):
        low_pass(walk(100), 3, cutoff, 100.0)


def test_a_recording_that_is_shorter_than_its_reflection_is_refused() -> None:
    with pytest.raises(ValueError, match="not more than"):
        low_pass(walk(10), 3, 5.0, 100.0, 10)


@pytest.mark.slow
def test_slow_packages_are_not_loaded() -> None:
    program = "import sys, ident_service.estimation.identify; print(*sys.modules)"
    told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert not {"scipy.signal", "scipy.stats", "scipy.ndimage", "scipy.interpolate"} & set(told.stdout.split())


@given(st.integers(0, 30), st.integers(1, 60), st.integers(0, 2**32 - 1))
def test_widening_is_scipys_dilation(reach: int, samples: int, seed: int) -> None:
    marks = np.random.default_rng(seed).random((samples, 2)) < 0.05
    expected = scipy.ndimage.binary_dilation(marks, np.ones((2 * reach + 1, 1), dtype=bool))
    np.testing.assert_array_equal(widened(marks, reach), expected)
