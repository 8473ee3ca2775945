"""Ways and stops keep to the limits, at every moment and for every moving state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from motion_bench import bench_excitation, bench_limits

from ident_service.config.limits import MotionLimits
from ident_service.errors import MotionRefused
from ident_service.motion.reference import FourierReference, Reference, RuckigReference, Setpoint, rest, stop, way

Array = np.ndarray
LIMITS = bench_limits()
# A velocity that still rises must pass its limit by what the jerk allows before the acceleration is gone.
FORCED = 0.5 * LIMITS.acceleration**2 / LIMITS.jerk


def vector(share: float) -> st.SearchStrategy[Array]:
    return st.tuples(st.floats(-share, share), st.floats(-share, share)).map(np.array)


def setpoints(share: float = 1.0) -> st.SearchStrategy[Setpoint]:
    """Moving states that use at most `share` of every limit."""
    middle, half = 0.5 * (LIMITS.upper + LIMITS.lower), 0.5 * (LIMITS.upper - LIMITS.lower)
    return st.builds(
        lambda q, dq, ddq: Setpoint(middle + half * q, LIMITS.velocity * dq, LIMITS.acceleration * ddq),
        vector(share),
        vector(share),
        vector(share),
    )


def sampled(reference: Reference, points: int = 400) -> tuple[Array, Array, Array, Array]:
    """Times, positions, velocities and accelerations along a way."""
    times = np.linspace(0.0, reference.duration, points)
    setpoints = [reference.at(float(time)) for time in times]
    columns = ([getattr(point, key) for point in setpoints] for key in ("position", "velocity", "acceleration"))
    position, velocity, acceleration = (np.array(column) for column in columns)
    return times, position, velocity, acceleration


def close(one: Setpoint, other: Setpoint) -> None:
    np.testing.assert_allclose(one.position, other.position, atol=1e-7)
    np.testing.assert_allclose(one.velocity, other.velocity, atol=1e-7)
    np.testing.assert_allclose(one.acceleration, other.acceleration, atol=1e-6)


def consistent(times: Array, position: Array, velocity: Array, acceleration: Array) -> None:
    """Each is the derivative of the one before, and no jerk is beyond its limit."""
    if times[-1] == 0.0:
        return
    step = times[1]
    mean = np.diff(position, axis=0) / step
    assert (np.abs(mean - 0.5 * (velocity[1:] + velocity[:-1])) <= LIMITS.jerk * step**2 + 1e-6).all()
    assert (np.abs(np.diff(acceleration, axis=0)) <= LIMITS.jerk * step * (1 + 1e-6) + 1e-6).all()


@given(setpoints(), setpoints())
def test_a_way_keeps_to_every_limit_or_is_refused(start: Setpoint, end: Setpoint) -> None:
    try:
        reference = way(start, end, LIMITS)
    except MotionRefused:
        return
    close(reference.at(0.0), start)
    close(reference.at(reference.duration), end)
    times, position, velocity, acceleration = sampled(reference)
    consistent(times, position, velocity, acceleration)
    assert (position >= LIMITS.lower - 1e-5).all()
    assert (position <= LIMITS.upper + 1e-5).all()
    assert (np.abs(acceleration) <= LIMITS.acceleration * (1 + 1e-6)).all()
    rising = np.abs(start.velocity) + 0.5 * start.acceleration**2 / LIMITS.jerk
    assert (np.abs(velocity) <= np.maximum(LIMITS.velocity, rising) * (1 + 1e-6)).all()


@given(setpoints(0.3), setpoints(0.3))
def test_between_gentle_states_a_way_exists(start: Setpoint, end: Setpoint) -> None:
    _, _, velocity, _ = sampled(way(start, end, LIMITS))
    assert (np.abs(velocity) <= LIMITS.velocity * (1 + 1e-6)).all()


@given(setpoints(), setpoints())
def test_the_extent_of_a_way_is_where_it_goes(start: Setpoint, end: Setpoint) -> None:
    wide = 100.0 * np.ones(2)
    try:
        reference = way(start, end, _with(lower=-wide, upper=wide))
    except MotionRefused:
        assume(False)
    lowest, highest = reference.extent()
    _, position, _, _ = sampled(reference, 700)
    assert (position >= lowest - 1e-5).all()
    assert (position <= highest + 1e-5).all()


def test_a_turning_point_outside_the_limits_is_refused() -> None:
    # Start and end lie inside; in between, the elbow turns 0.17 rad beyond what its limits allow.
    start = Setpoint(np.array([0.0, 1.7339]), np.array([0.0, 2.6862]), np.array([0.0, -13.9096]))
    end = Setpoint(np.array([0.0, -0.4985]), np.array([0.0, 2.0916]), np.array([0.0, 11.7914]))
    upper = np.array([1.8, 1.9])
    with pytest.raises(MotionRefused, match="joint 2"):
        way(start, end, _with(upper=upper))
    _, position, _, _ = sampled(way(start, end, _with(upper=upper + 0.1)))
    assert position[:, 1].max() > 1.9


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("key", ["velocity", "acceleration"])
def test_an_end_beyond_a_limit_is_refused(joint: int, key: str) -> None:
    beyond = np.zeros(2)
    beyond[joint] = 1.1 * getattr(LIMITS, key)[joint]
    end = Setpoint(**({"position": np.zeros(2), "velocity": np.zeros(2), "acceleration": np.zeros(2)} | {key: beyond}))
    with pytest.raises(MotionRefused):
        way(rest(np.zeros(2)), end, LIMITS)


def test_an_end_that_no_jerk_can_bring_is_refused() -> None:
    # Each is within its limit, but with this acceleration the velocity must have been too large just before.
    end = Setpoint(np.zeros(2), np.array([0.99, 0.0]) * LIMITS.velocity, np.array([-0.9, 0.0]) * LIMITS.acceleration)
    with pytest.raises(MotionRefused, match="no jerk-limited way"):
        way(rest(np.zeros(2)), end, LIMITS)


def test_the_way_to_where_one_stands_takes_no_time() -> None:
    here = rest(np.array([0.3, -0.2]))
    assert way(here, here, LIMITS).duration == 0.0
    close(way(here, here, LIMITS).at(1.0), here)


def test_all_joints_of_a_way_arrive_together() -> None:
    reference = way(rest(np.zeros(2)), rest(np.array([1.0, 0.1])), LIMITS)
    velocity = reference.at(0.95 * reference.duration).velocity
    assert (velocity > 1e-4).all()


@given(setpoints())
def test_a_stop_ends_at_rest_within_limits(start: Setpoint) -> None:
    reference = stop(start, LIMITS)
    close(reference.at(0.0), start)
    times, position, velocity, acceleration = sampled(reference)
    consistent(times, position, velocity, acceleration)
    np.testing.assert_allclose(velocity[-1], 0.0, atol=1e-9)
    np.testing.assert_allclose(acceleration[-1], 0.0, atol=1e-9)
    assert (np.abs(acceleration) <= LIMITS.acceleration * (1 + 1e-6)).all()
    # It goes faster than it did only where the acceleration at its start forces it.
    rising = start.velocity * start.acceleration > 0.0
    forced = np.where(rising, 0.5 * start.acceleration**2 / LIMITS.jerk, 0.0)
    opposite = np.where(~rising, FORCED, 0.0)  # an acceleration already braking may lead through rest
    assert (np.abs(velocity) <= np.maximum(np.abs(start.velocity) + forced, opposite) + 1e-6).all()
    assert (np.abs(velocity) <= LIMITS.velocity + FORCED + 1e-6).all()
    longest = (LIMITS.velocity + FORCED) / LIMITS.acceleration + 2.0 * LIMITS.acceleration / LIMITS.jerk
    assert reference.duration <= longest.max() + 1e-9


@given(st.floats(0.0, 1.0))
def test_a_stop_out_of_an_excitation_passes_no_velocity_limit(share: float) -> None:
    exciting = FourierReference(bench_excitation())
    reference = stop(exciting.at(share * exciting.duration), LIMITS)
    _, position, velocity, _ = sampled(reference, 200)
    assert (np.abs(velocity) <= LIMITS.velocity).all()
    assert (position >= LIMITS.lower).all()
    assert (position <= LIMITS.upper).all()


@given(setpoints(5.0))
def test_a_stop_exists_even_from_beyond_the_limits(start: Setpoint) -> None:
    end = stop(start, LIMITS).at(100.0)
    np.testing.assert_allclose(end.velocity, 0.0, atol=1e-9)
    np.testing.assert_allclose(end.acceleration, 0.0, atol=1e-9)


def test_a_stop_from_rest_stays() -> None:
    reference = stop(rest(np.array([0.5, -0.5])), LIMITS)
    assert reference.duration == 0.0
    np.testing.assert_array_equal(reference.at(1.0).position, [0.5, -0.5])


def test_each_joint_stops_as_soon_as_it_can() -> None:
    both = stop(Setpoint(np.zeros(2), np.array([2.0, 0.5]), np.zeros(2)), LIMITS)
    alone = stop(Setpoint(np.zeros(2), np.array([0.0, 0.5]), np.zeros(2)), LIMITS)
    assert alone.duration < both.duration
    assert both.at(alone.duration).velocity[1] == pytest.approx(0.0, abs=1e-9)


def test_the_excitation_ends_where_its_time_ends() -> None:
    motion = bench_excitation()
    reference = FourierReference(motion)
    assert reference.duration == motion.duration
    position, velocity, acceleration, _ = motion.series.at(motion.duration)
    for time in (motion.duration, motion.duration + 1.0):
        close(reference.at(time), Setpoint(position, velocity, acceleration))


def test_a_way_stands_at_its_end() -> None:
    reference = way(rest(np.zeros(2)), rest(np.ones(2)), LIMITS)
    assert isinstance(reference, RuckigReference)
    close(reference.at(reference.duration + 5.0), rest(np.ones(2)))


def _with(**changes: Array) -> MotionLimits:
    return replace(LIMITS, **changes)
