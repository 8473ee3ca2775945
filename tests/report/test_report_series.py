"""Long series made short: what can be seen stays, and what is known of noise and sines comes out."""

from __future__ import annotations

import numpy as np
import pytest

from ident_service.results.evidence.gathering import Envelope, Scatter, Welch, spread

RATE = 500.0


def envelope_of(time: np.ndarray, values: np.ndarray, most: int, chunk: int) -> Envelope:
    envelope = Envelope(len(values), most, 1.0 / RATE)
    for start in range(0, len(time), chunk):
        part = slice(start, start + chunk)
        envelope.add(time[part], values[:, part], values[:, part] > 3.0)
    return envelope


@pytest.mark.parametrize("chunk", [1000, 4096, 30_000])
def test_no_extreme_is_lost_however_few_stretches_there_are(chunk: int) -> None:
    rng = np.random.default_rng(3)
    time = np.arange(30_000) / RATE
    values = rng.normal(size=(2, 30_000))
    values[0, 12_345], values[1, 29_999] = 50.0, -70.0
    envelope = envelope_of(time, values, 300, chunk)
    assert 150 < len(envelope.time) <= 300
    for series in range(2):
        low, high = envelope.extremes[series]
        for k in range(len(envelope.time)):
            inside = np.abs(time + 1e-6 - envelope.time[k]) < 0.5 * envelope.width
            assert (low[k], high[k]) == (values[series][inside].min(), values[series][inside].max())
            assert envelope.marked[series][k] == (values[series][inside] > 3.0).any()
    assert envelope.extremes[0].max() == 50.0
    assert envelope.extremes[1].min() == -70.0


def test_a_short_series_keeps_every_sample() -> None:
    time = np.arange(100) / RATE
    values = np.sin(time)[None]
    envelope = envelope_of(time, values, 300, 33)
    np.testing.assert_array_equal(envelope.extremes[0], np.vstack([values, values]))


def test_a_gap_stays_a_gap() -> None:
    time = np.concatenate([np.arange(2000), 10_000 + np.arange(2000)]) / RATE
    envelope = envelope_of(time, np.ones((1, 4000)), 200, 1500)
    steps = np.diff(envelope.time)
    assert np.sort(steps)[-1] == pytest.approx(16.0, abs=2 * envelope.width)
    np.testing.assert_allclose(np.sort(steps)[:-1], envelope.width)


def test_white_noise_has_a_flat_spectrum_and_no_memory() -> None:
    values = 0.3 * np.random.default_rng(7).normal(size=(1, 200_000))
    welch = Welch(1, RATE)
    for start in range(0, 200_000, 4096):
        welch.add(values[:, start : start + 4096])
    _, density = welch.density()
    # One-sided: the variance over half the rate.
    expected = 0.09 / (RATE / 2)
    assert np.median(density[0]) == pytest.approx(expected, rel=0.05)
    assert np.ptp(np.log10(density[0])) < 0.8
    lag, correlation = welch.correlation()
    assert (lag[0], correlation[0, 0]) == (0.0, 1.0)
    outside = np.abs(correlation[0, 1:]) > welch.white
    # 5 % on the average; segments that overlap count the middle samples twice.
    assert outside.mean() < 0.15
    assert welch.white == pytest.approx(1.96 / np.sqrt(200_000))


def test_a_sine_is_one_line_and_an_autocorrelation_of_its_period() -> None:
    time = np.arange(60_000) / RATE
    values = 2.0 * np.sin(2.0 * np.pi * 12.5 * time)[None]
    welch = Welch(1, RATE)
    welch.add(values)
    frequency, density = welch.density()
    assert frequency[np.argmax(density[0])] == pytest.approx(12.5, rel=0.05)
    lag, correlation = welch.correlation()
    np.testing.assert_allclose(correlation[0], np.cos(2.0 * np.pi * 12.5 * lag), atol=0.05)
    # Parseval: half the squared amplitude.
    fine = np.linspace(frequency[0], frequency[-1], 200_000)
    assert np.trapezoid(np.interp(fine, frequency, density[0]), fine) == pytest.approx(2.0, rel=0.1)


def test_segments_do_not_reach_across_a_gap() -> None:
    welch = Welch(1, RATE)
    welch.add(np.ones((1, welch.length - 1)))
    assert not welch.ready
    welch.add(np.ones((1, welch.length - 1)), after_gap=True)
    assert not welch.ready
    welch.add(np.ones((1, 1)))
    assert welch.ready


def test_a_scatter_keeps_evenly_spaced_rows() -> None:
    scatter = Scatter(100)
    rows = np.arange(1000.0)[:, None]
    for start in range(0, 1000, 37):
        scatter.add(rows[start : start + 37])
    kept = scatter.rows()[:, 0]
    assert 50 < len(kept) <= 100
    assert len(set(np.diff(kept))) == 1


def test_a_spread_leaves_no_part_of_the_range_empty() -> None:
    rng = np.random.default_rng(2)
    x = np.concatenate([rng.normal(0.0, 0.01, 5000), [-1.0, 1.0, 0.7]])
    kept, y = spread(x, 2.0 * x)
    assert len(kept) <= 400
    assert {-1.0, 1.0, 0.7} <= set(kept)
    np.testing.assert_array_equal(y, 2.0 * kept)
