"""A slowed motion is the same one, and changes its speed without leaving a limit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_bench import bench_excitation, bench_limits
from reachable import PathPeaks, close, keeps_to, path_peaks, random_limits, random_path, sampled

from ident_service.errors import MotionRefused, UsageError
from ident_service.motion.speed_scaling import ScaledMotion, SpeedChange, slowed_limits
from ident_service.motion.trajectory import PathReference, Setpoint, plan_trajectory, rest

LIMITS = bench_limits()
PATH = bench_excitation().path
MOTION = PathReference(PATH)
SEEDS, FACTORS, SHARES = st.integers(0, 2**32 - 1), st.floats(0.05, 1.0), st.floats(0.0, 1.0)


@pytest.mark.slow
@settings(max_examples=50)
@given(SEEDS, FACTORS)
def test_a_slowed_motion_goes_the_same_way_within_smaller_limits(seed: int, factor: float) -> None:
    rng = np.random.default_rng(seed)
    limits = random_limits(rng, 2)
    motion = PathReference(random_path(rng, limits))
    slow = ScaledMotion(motion, factor)
    assert slow.duration == pytest.approx(motion.duration / factor)
    times, position, _, _ = sampled(slow, 50)
    for time, seen in zip(times, position, strict=True):
        np.testing.assert_allclose(seen, motion.at(factor * float(time)).position, atol=1e-12)
    keeps_to(slowed_limits(limits, factor), slow)


def test_a_motion_at_full_speed_is_itself() -> None:
    same = ScaledMotion(MOTION, 1.0)
    assert same.duration == MOTION.duration
    for time in np.linspace(0.0, MOTION.duration, 9):
        seen, expected = same.at(float(time)), MOTION.at(float(time))
        np.testing.assert_array_equal(seen.position, expected.position)
        np.testing.assert_array_equal(seen.velocity, expected.velocity)
        np.testing.assert_array_equal(seen.acceleration, expected.acceleration)


def test_a_slowed_way_is_the_way_within_slowed_limits() -> None:
    start, end = rest(np.zeros(2)), rest(np.array([1.0, -0.4]))
    slow, other = (
        ScaledMotion(plan_trajectory(start, end, LIMITS), 0.2),
        plan_trajectory(start, end, slowed_limits(LIMITS, 0.2)),
    )
    assert slow.duration == pytest.approx(other.duration)
    for time in np.linspace(0.0, slow.duration, 9):
        close(slow.at(float(time)), other.at(float(time)))


@pytest.mark.slow
@settings(max_examples=40)
@given(SEEDS, SHARES, FACTORS, st.sampled_from([0.05, 0.2, 0.5, 0.9, 0.99, 1.0]), st.booleans())
def test_a_change_of_speed_keeps_to_all_limits(seed: int, share: float, one: float, other: float, faster: bool) -> None:
    # The motions use at least one limit of each joint in full, so that nothing is left at full speed.
    rng = np.random.default_rng(seed)
    limits = random_limits(rng, 2)
    path = random_path(rng, limits)
    motion, time = PathReference(path), share * path.duration
    factors = (one, other) if faster else (other, one)
    change = SpeedChange(motion, time, factors, path_peaks(path), limits)
    close(change.at(0.0), ScaledMotion(motion, factors[0]).at(time / factors[0]))
    close(change.at(change.duration + 1.0), change.at(change.duration))
    assert change.motion_time(change.duration) == pytest.approx(path.duration, abs=1e-9)
    if change.duration > change.change:
        close(change.at(change.duration), ScaledMotion(motion, factors[1]).at(path.duration / factors[1]))
    if change.duration > 1e-6:
        keeps_to(limits, change, points=800)


@settings(max_examples=30)
@given(SHARES, FACTORS, FACTORS)
def test_a_change_of_speed_stays_on_the_motion(share: float, before: float, after: float) -> None:
    time = share * MOTION.duration
    change = SpeedChange(MOTION, time, (before, after), path_peaks(PATH), LIMITS)
    seen = np.array([change.motion_time(float(now)) for now in np.linspace(0.0, change.duration, 100)])
    assert seen[0] == time
    assert (np.diff(seen) >= 0.0).all()
    for now in np.linspace(0.0, change.duration, 20):
        expected = MOTION.at(change.motion_time(float(now))).position
        np.testing.assert_allclose(change.at(float(now)).position, expected, atol=1e-12)


def test_a_change_takes_as_long_as_the_limits_ask_for() -> None:
    peaks = path_peaks(PATH)
    half = replace(LIMITS, velocity=2 * peaks.velocity, acceleration=2 * peaks.acceleration, jerk=2 * peaks.jerk)
    exact = replace(LIMITS, velocity=peaks.velocity, acceleration=peaks.acceleration, jerk=peaks.jerk)
    quick = SpeedChange(MOTION, 0.0, (0.2, 1.0), peaks, half).change
    slow = SpeedChange(MOTION, 0.0, (0.2, 1.0), peaks, exact).change
    small = SpeedChange(MOTION, 0.0, (0.9, 1.0), peaks, half).change
    assert small < quick < 2.0 < slow < 90.0
    # Down again it is not quicker: the same stretch, mirrored.
    assert SpeedChange(MOTION, 0.0, (1.0, 0.2), peaks, half).change == pytest.approx(quick)


def test_the_limits_are_the_peaks_of_a_way() -> None:
    reference = plan_trajectory(rest(np.array([-1.7, -1.9])), rest(np.array([1.7, 1.9])), LIMITS)
    change = SpeedChange(reference, 0.5, (0.2, 0.9), LIMITS, LIMITS)
    # The jerk of a way has steps, so only sizes are looked at.
    keeps_to(LIMITS, change, 1e-5, 3000)


@pytest.mark.parametrize("factor", [0.0, -0.2, 1.001, np.nan, np.inf])
def test_no_motion_is_played_backwards_or_faster_than_it_is(factor: float) -> None:
    with pytest.raises(UsageError, match="above 0 and at most 1"):
        ScaledMotion(MOTION, factor)
    with pytest.raises(UsageError, match="above 0 and at most 1"):
        slowed_limits(LIMITS, factor)
    for factors in ((factor, 0.5), (0.5, factor)):
        with pytest.raises(UsageError, match="above 0 and at most 1"):
            SpeedChange(MOTION, 0.0, factors, path_peaks(PATH), LIMITS)


@pytest.mark.parametrize("key", ["velocity", "acceleration", "jerk"])
def test_no_change_leads_to_a_speed_beyond_the_limits(key: str) -> None:
    peaks = path_peaks(PATH)
    limits = replace(LIMITS, **{key: 0.9 * getattr(peaks, key)})
    with pytest.raises(MotionRefused, match="at the speed asked for"):
        SpeedChange(MOTION, 0.0, (0.2, 1.0), peaks, limits)
    assert SpeedChange(MOTION, 0.0, (0.2, 0.8), peaks, limits).change > 0.0


def test_a_change_at_the_end_of_a_motion_lasts_no_longer_than_it() -> None:
    change = SpeedChange(MOTION, MOTION.duration, (0.2, 1.0), path_peaks(PATH), LIMITS)
    assert change.duration == pytest.approx(0.0, abs=1e-9)
    end, seen = MOTION.at(MOTION.duration), change.at(5.0)
    close(seen, Setpoint(end.position, 0.2 * end.velocity, 0.04 * end.acceleration))


def test_the_length_of_a_change_follows_from_the_largest_of_its_terms() -> None:
    # Each term alone: acceleration by quickening; jerk by quickening and by its change.
    share = np.linspace(0.0, 1.0, 10001)
    step = 35 * share**4 - 84 * share**5 + 70 * share**6 - 20 * share**7
    rate, quickening = 0.2 + 0.6 * step, 0.6 * np.gradient(step, share)
    curve = np.abs(np.gradient(quickening, share)).max()
    none, huge = np.zeros(1), np.full(1, 1e9)

    def length(velocity: float, acceleration: float, limit_acceleration: float, limit_jerk: float) -> float:
        peaks = PathPeaks(np.full(1, velocity), np.full(1, acceleration), none)
        limits = replace(
            LIMITS, velocity=huge, acceleration=np.full(1, limit_acceleration), jerk=np.full(1, limit_jerk)
        )
        return SpeedChange(MOTION, 0.0, (0.2, 0.8), peaks, limits).change

    assert length(2.0, 0.0, 3.0, 1e9) == pytest.approx(2.0 * quickening.max() / 3.0, rel=0.02)
    assert length(2.0, 0.0, 1e9, 30.0) == pytest.approx((2.0 * curve / 30.0) ** 0.5, rel=0.02)
    assert length(0.0, 8.0, 1e9, 30.0) == pytest.approx(3.0 * 8.0 * (rate * quickening).max() / 30.0, rel=0.02)
