"""Fourier series: derivatives, periods, shapes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ident_service.errors import ModelError
from ident_service.excitation.trajectory import FourierSeries

Array = np.ndarray


def random_series(seed: int, joints: int = 3, harmonics: int = 5, frequency: float = 0.1) -> FourierSeries:
    rng = np.random.default_rng(seed)
    return FourierSeries(frequency, *rng.normal(size=(2, joints, harmonics)), rng.normal(size=joints))


@given(
    seed=st.integers(0, 2**32 - 1),
    joints=st.integers(1, 5),
    harmonics=st.integers(1, 8),
    frequency=st.floats(0.01, 2.0),
    phase=st.floats(0.0, 3.0),
)
def test_each_output_is_the_derivative_of_the_one_before(
    seed: int, joints: int, harmonics: int, frequency: float, phase: float
) -> None:
    series = random_series(seed, joints, harmonics, frequency)
    time, step = phase / frequency, 1e-4 / (frequency * harmonics)
    here, steps = series.at(time), [series.at(time + k * step) for k in (-2, -1, 1, 2)]
    for order in range(3):
        far_before, before, after, far_after = (values[order] for values in steps)
        slope = (far_before - 8.0 * before + 8.0 * after - far_after) / (12.0 * step)
        rate = 2.0 * np.pi * frequency * harmonics
        size = max(1.0, np.abs(here[order]).max()) * rate + np.abs(series.a).sum() * rate ** (order + 1) / rate
        np.testing.assert_allclose(slope, here[order + 1], rtol=0, atol=1e-7 * size)


def test_the_formula_is_the_papers() -> None:
    series = FourierSeries(0.05, np.array([[0.3, 0.0]]), np.array([[0.0, 0.7]]), np.array([0.2]))
    w, t = 0.1 * np.pi, 3.7
    position = 0.3 / w * np.sin(w * t) - 0.7 / (2 * w) * np.cos(2 * w * t) + 0.2
    np.testing.assert_allclose(series.at(t)[0], [position], rtol=1e-14)
    np.testing.assert_allclose(series.at(t)[1], [0.3 * np.cos(w * t) + 0.7 * np.sin(2 * w * t)], rtol=1e-14)


def test_the_published_series_is_the_reference_that_was_sent(wam7_data: Path) -> None:
    content = json.loads((wam7_data / "traj1_fourier.json").read_text())
    a, b, q0 = (np.array(content[key]) for key in ("a", "b", "q0"))
    series = FourierSeries(content["wf_rad_s"] / (2.0 * np.pi), a, b, q0)
    assert series.period == pytest.approx(20.0)
    reference = np.loadtxt(wam7_data / "traj1_reference.csv.gz", delimiter=",", skiprows=1)
    rows = np.arange(479, 479 + 60_000, 7)
    np.testing.assert_allclose(series.at((rows - 479) * 1e-3)[0], reference[rows], rtol=0, atol=1.1e-5)


def test_many_times_are_many_single_times() -> None:
    series = random_series(1)
    times = np.linspace(0.0, 25.0, 40)
    for together, *alone in zip(series.at(times), *(series.at(float(t)) for t in times), strict=True):
        np.testing.assert_allclose(together, alone, rtol=1e-13, atol=1e-13)
        assert together.shape == (40, 3)


def test_a_motion_repeats_itself() -> None:
    series = random_series(2)
    for first, second in zip(series.at(1.234), series.at(1.234 + 2 * series.period), strict=True):
        np.testing.assert_allclose(first, second, atol=1e-11)


def test_scaling_keeps_the_middle_and_scales_everything_else() -> None:
    series = random_series(3)
    q, *others = series.at(2.0)
    half_q, *half_others = series.scaled(0.5).at(2.0)
    np.testing.assert_allclose(half_q - series.q0, 0.5 * (q - series.q0), rtol=1e-12)
    for half, whole in zip(half_others, others, strict=True):
        np.testing.assert_allclose(half, 0.5 * whole, rtol=1e-12)


@pytest.mark.parametrize(
    ("a", "b", "q0"), [((2, 5), (2, 4), (2,)), ((2, 5), (2, 5), (3,)), ((5,), (5,), (1,)), ((2, 5), (1, 5), (2,))]
)
def test_arrays_that_do_not_belong_together_are_refused(
    a: tuple[int, ...], b: tuple[int, ...], q0: tuple[int, ...]
) -> None:
    with pytest.raises(ModelError, match="do not belong to one motion"):
        FourierSeries(0.1, np.zeros(a), np.zeros(b), np.zeros(q0))


def test_a_series_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="read-only"):
        random_series(4).a[0, 0] = 1.0
