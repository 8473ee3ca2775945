"""Motions as functions of time: derivatives, seams, rest at both ends, and the bound of the fifth derivative."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from motions import random_fourier_path, random_path, random_posture_path

from ident_service.errors import ModelError
from ident_service.excitation.trajectory import STEP_PEAKS, FourierPath, FourierSeries, PosturePath

Array = np.ndarray
SEEDS = st.integers(0, 2**32 - 1)


def stencil(path: FourierPath | PosturePath, order: int, time: Array, step: float) -> Array:
    """The slope of a derivative by differences of fourth order."""
    far_before, before, after, far_after = (path.derivatives(time + k * step, 4)[order] for k in (-2, -1, 1, 2))
    return np.asarray((far_before - 8.0 * before + 8.0 * after - far_after) / (12.0 * step))


def away_from_seams(path: FourierPath | PosturePath, count: int) -> Array:
    """Times in the middle four fifths between two seams each."""
    corners = path.seams
    shares = np.linspace(0.1, 0.9, count)
    return (corners[:-1, None] + shares * np.diff(corners)[:, None]).ravel()


@settings(max_examples=60)
@given(seed=SEEDS)
def test_each_derivative_is_the_slope_of_the_one_before(seed: int) -> None:
    path = random_path(seed)
    time, step = away_from_seams(path, 9), 1e-3 * float(np.diff(path.seams).min())
    step = min(step, 1e-3 / path.highest_frequency(0.0, path.duration))
    values = path.derivatives(time, 4)
    for order in range(4):
        size = np.abs(values[order + 1]).max() + np.abs(values[order]).max() * path.highest_frequency(
            0.0, path.duration
        )
        np.testing.assert_allclose(stencil(path, order, time, step), values[order + 1], rtol=0, atol=1e-6 * size)


@settings(max_examples=60)
@given(seed=SEEDS)
def test_the_fifth_derivative_stays_below_its_bound_between_seams(seed: int) -> None:
    path = random_path(seed)
    time, step = away_from_seams(path, 400), 1e-3 * float(np.diff(path.seams).min())
    fifth = stencil(path, 4, time, step)
    assert (np.abs(fifth) <= path.crackle * (1.0 + 1e-6)).all()


def test_the_bound_of_the_fifth_derivative_is_reached_by_a_single_sine() -> None:
    rate = 2.0 * np.pi * 0.5
    path = FourierPath(FourierSeries(0.5, np.array([[0.3 * rate]]), np.zeros((1, 1)), np.zeros(1)), 1)
    np.testing.assert_allclose(path.crackle, [0.3 * rate**5], rtol=1e-12)


def test_the_bound_of_the_fifth_derivative_is_reached_where_a_segment_begins() -> None:
    path = PosturePath(np.array([[0.0, 0.0], [1.0, -2.0]]), np.array([2.0]), 0.0)
    np.testing.assert_allclose(path.crackle, np.array([1.0, 2.0]) * 10080.0 / 2.0**5, rtol=1e-12)


def test_the_peaks_of_the_step_are_those_of_its_derivatives() -> None:
    path = PosturePath(np.array([[0.0], [1.0]]), np.array([1.0]), 0.0)
    values = path.derivatives(np.linspace(1e-9, 1.0 - 1e-9, 200_001), 4)
    for value, peak in zip(values, STEP_PEAKS, strict=False):
        assert np.abs(value).max() == pytest.approx(peak, rel=1e-6)


@settings(max_examples=60)
@given(seed=SEEDS)
def test_only_the_fourth_derivative_may_jump_at_a_seam(seed: int) -> None:
    path = random_path(seed)
    inner = path.seams[1:-1]
    eps = 1e-7 * path.duration
    before, after = path.derivatives(inner - eps, 4), path.derivatives(inner + eps, 4)
    peaks = [np.abs(value).max(axis=0) for value in path.derivatives(np.linspace(0.0, path.duration, 2000), 4)]
    for order in range(4):
        room = 4.0 * eps * (peaks[order + 1] + eps * path.crackle) + 1e-9
        assert (np.abs(after[order] - before[order]) <= room).all()


@settings(max_examples=60)
@given(seed=SEEDS, ahead=st.floats(0.0, 10.0))
def test_with_ramps_it_begins_and_ends_at_rest_and_stays_there(seed: int, ahead: float) -> None:
    path = random_fourier_path(seed)
    times = np.array([-ahead, 0.0, path.duration, path.duration + ahead])
    position, *rates = path.at(times)
    np.testing.assert_array_equal(position, np.tile(path.series.q0, (4, 1)))
    for rate in rates:
        np.testing.assert_array_equal(rate, 0.0)


@settings(max_examples=60)
@given(seed=SEEDS, ramps=st.booleans(), share=st.floats(0.0, 1.0))
def test_between_the_ramps_whole_periods_of_the_series_are_played(seed: int, ramps: bool, share: float) -> None:
    path = random_fourier_path(seed, ramps=ramps)
    time = share * path.periods * path.series.period
    for value, plain in zip(path.at(path.ramp + time), path.series.at(time), strict=True):
        np.testing.assert_allclose(value, plain, rtol=1e-9, atol=1e-9)
    assert path.duration == pytest.approx(2.0 * path.ramp + path.periods / path.series.base_frequency)


@settings(max_examples=60)
@given(seed=SEEDS, share=st.floats(0.0, 1.0))
def test_periods_repeat(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    path = FourierPath(random_fourier_path(seed).series, 3, float(rng.choice([0.0, 0.7])))
    first = path.ramp + share * path.series.period
    for again in (1, 2):
        for one, other in zip(path.at(first), path.at(first + again * path.series.period), strict=True):
            size = 1.0 + np.abs(one).max()
            # Where the last period goes over into the ramp both are the same up to rounding.
            fastest = max(1.0, path.highest_frequency(0.0, path.duration))
            np.testing.assert_allclose(one, other, rtol=0, atol=1e-8 * size * fastest**3)


@settings(max_examples=60)
@given(seed=SEEDS)
def test_what_happens_outside_the_distinct_stretches_happens_inside_too(seed: int) -> None:
    path = random_path(seed)
    everywhere = path.at(np.linspace(0.0, path.duration, 4001))
    inside = path.at(np.concatenate([np.linspace(begin, end, 4001) for begin, end in path.distinct]))
    for all_values, distinct in zip(everywhere, inside, strict=True):
        size = np.abs(all_values).max()
        assert (distinct.max(axis=0) >= all_values.max(axis=0) - 1e-4 * size).all()
        assert (distinct.min(axis=0) <= all_values.min(axis=0) + 1e-4 * size).all()


@settings(max_examples=60)
@given(seed=SEEDS, postures=st.integers(2, 6), ahead=st.floats(0.0, 10.0))
def test_every_posture_is_visited_at_rest_for_the_dwell(seed: int, postures: int, ahead: float) -> None:
    path = random_posture_path(seed, postures=postures)
    arrivals = np.concatenate([[0.0], path.dwell + np.cumsum(path.times + path.dwell) - path.dwell])
    for posture, arrival in zip(path.points, arrivals, strict=True):
        stay = np.array([arrival, arrival + 0.5 * path.dwell, arrival + path.dwell])
        position, *rates = path.at(stay)
        np.testing.assert_allclose(position, np.tile(posture, (3, 1)), rtol=0, atol=1e-9)
        for rate in rates:
            np.testing.assert_allclose(rate, 0.0, atol=1e-7)
    before_and_after = path.at(np.array([-ahead, path.duration + ahead]))[0]
    np.testing.assert_allclose(before_and_after, path.points[[0, -1]], rtol=0, atol=1e-12)
    assert path.duration == pytest.approx(path.times.sum() + postures * path.dwell)


@settings(max_examples=60)
@given(seed=SEEDS, share=st.floats(0.0, 1.0))
def test_segments_between_postures_are_straight(seed: int, share: float) -> None:
    path = random_posture_path(seed, joints=3, postures=2)
    position, velocity, *_ = path.at(path.dwell + share * path.times[0])
    way = path.points[1] - path.points[0]
    np.testing.assert_allclose(np.cross(position - path.points[0], way), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.cross(velocity, way), 0.0, atol=1e-12)


@settings(max_examples=60)
@given(seed=SEEDS)
def test_many_times_are_many_single_times(seed: int) -> None:
    path = random_path(seed)
    times = np.linspace(-0.1, path.duration + 0.1, 40)
    for together, *alone in zip(path.at(times), *(path.at(float(t)) for t in times), strict=True):
        np.testing.assert_allclose(together, alone, rtol=1e-12, atol=1e-12 * (1.0 + np.abs(together).max()))
        assert together.shape == (40, path.joints)


@settings(max_examples=60)
@given(seed=SEEDS)
def test_seams_begin_at_zero_and_end_with_the_motion(seed: int) -> None:
    path = random_path(seed)
    assert path.seams[0] == 0.0
    assert path.seams[-1] == path.duration
    assert (np.diff(path.seams) > 0.0).all()


@pytest.mark.parametrize(("periods", "ramp"), [(0, 1.0), (1, -1.0), (1, float("inf")), (1, float("nan"))])
def test_what_is_no_repetition_is_refused(periods: int, ramp: float) -> None:
    with pytest.raises(ModelError, match="no motion"):
        FourierPath(random_fourier_path(1).series, periods, ramp)


@pytest.mark.parametrize(
    ("points", "times"),
    [
        (np.zeros((1, 2)), np.zeros(0)),
        (np.zeros((3, 2)), np.ones(3)),
        (np.zeros(3), np.ones(2)),
        (np.zeros((3, 2)), np.array([1.0, 0.0])),
        (np.zeros((3, 2)), np.array([1.0, np.nan])),
    ],
)
def test_segments_that_do_not_belong_to_postures_are_refused(points: Array, times: Array) -> None:
    with pytest.raises(ModelError, match="do not belong to one motion"):
        PosturePath(points, times, 0.0)


@pytest.mark.parametrize("dwell", [-0.1, float("inf"), float("nan")])
def test_a_dwell_that_is_no_time_is_refused(dwell: float) -> None:
    with pytest.raises(ModelError, match="no time"):
        PosturePath(np.zeros((2, 1)), np.ones(1), dwell)


def test_a_path_cannot_be_changed() -> None:
    path = random_posture_path(1)
    with pytest.raises(ValueError, match="read-only"):
        path.points[0, 0] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        path.times[0] = 1.0
