"""A slowed motion is the same one, within smaller limits."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.examples import some
from hypothesis import given
from hypothesis import strategies as st
from motion_bench import bench_excitation, bench_limits
from reachable import close, keeps_to, random_limits, random_path, sampled

from ident_service.errors import UsageError
from ident_service.motion.speed_scaling import ScaledMotion, slowed_limits
from ident_service.motion.trajectory import PathReference, plan_trajectory, rest

LIMITS = bench_limits()
MOTION = PathReference(bench_excitation().path)
SEEDS, FACTORS = st.integers(0, 2**32 - 1), st.floats(0.05, 1.0)


@pytest.mark.slow
@some(15)
@given(SEEDS, FACTORS)
def test_a_slowed_motion_has_the_same_path_within_smaller_limits(seed: int, factor: float) -> None:
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


def test_a_slowed_trajectory_is_the_one_within_slowed_limits() -> None:
    start, end = rest(np.zeros(2)), rest(np.array([1.0, -0.4]))
    slow, other = (
        ScaledMotion(plan_trajectory(start, end, LIMITS), 0.2),
        plan_trajectory(start, end, slowed_limits(LIMITS, 0.2)),
    )
    assert slow.duration == pytest.approx(other.duration)
    for time in np.linspace(0.0, slow.duration, 9):
        close(slow.at(float(time)), other.at(float(time)))


@pytest.mark.parametrize("factor", [0.0, -0.2, 1.001, np.nan, np.inf])
def test_no_motion_is_played_backwards_or_faster_than_it_is(factor: float) -> None:
    with pytest.raises(UsageError, match="above 0 and at most 1"):
        ScaledMotion(MOTION, factor)
    with pytest.raises(UsageError, match="above 0 and at most 1"):
        slowed_limits(LIMITS, factor)
