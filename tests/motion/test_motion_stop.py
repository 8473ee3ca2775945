"""From every state there is a stop; out of a motion within limits it stays within them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import ruckig
from helpers.examples import some
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_bench import bench_excitation, bench_limits
from reachable import (
    Reached,
    close,
    goes_together,
    keeps_to,
    random_limits,
    random_path,
    reached,
    sampled,
    setpoints,
    turning_state,
)

from ident_service.config.motion_limits import MotionLimits
from ident_service.errors import MotionRefused
from ident_service.excitation.trajectory import PosturePath
from ident_service.motion.stop_trajectory import (
    StopProfile,
    plan_stop,
    require_stops_within_limits,
    stop_extent,
)
from ident_service.motion.trajectory import PathReference, Setpoint, rest

Array = np.ndarray
LIMITS = bench_limits()
# A velocity that still rises must pass its limit by what the jerk allows before the acceleration is gone.
FORCED = 0.5 * LIMITS.acceleration**2 / LIMITS.jerk
SEEDS = st.integers(0, 2**32 - 1)


@pytest.mark.slow
@some(25)
@given(setpoints(LIMITS))
def test_a_stop_ends_at_rest_within_limits(start: Setpoint) -> None:
    reference = plan_stop(start, _unlimited(LIMITS))
    close(reference.at(0.0), start)
    times, position, velocity, acceleration = sampled(reference)
    goes_together(LIMITS, times, position, velocity, acceleration)
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


@pytest.mark.slow
@some(25)
@given(st.floats(0.0, 1.0))
def test_a_stop_out_of_an_excitation_passes_no_velocity_limit(share: float) -> None:
    exciting = PathReference(bench_excitation().path)
    reference = plan_stop(exciting.at(share * exciting.duration), LIMITS)
    _, position, velocity, _ = sampled(reference, 200)
    assert (np.abs(velocity) <= LIMITS.velocity).all()
    assert (position >= LIMITS.lower).all()
    assert (position <= LIMITS.upper).all()


@settings(max_examples=100)
@given(setpoints(LIMITS, 5.0))
def test_a_stop_exists_even_from_beyond_the_limits(start: Setpoint) -> None:
    end = plan_stop(start, LIMITS).at(100.0)
    np.testing.assert_allclose(end.velocity, 0.0, atol=1e-9)
    np.testing.assert_allclose(end.acceleration, 0.0, atol=1e-9)


def test_a_stop_from_rest_stays() -> None:
    reference = plan_stop(rest(np.array([0.5, -0.5])), LIMITS)
    assert reference.duration == 0.0
    np.testing.assert_array_equal(reference.at(1.0).position, [0.5, -0.5])


def test_each_joint_stops_as_soon_as_it_can() -> None:
    both = plan_stop(Setpoint(np.zeros(2), np.array([2.0, 0.5]), np.zeros(2)), LIMITS)
    alone = plan_stop(Setpoint(np.zeros(2), np.array([0.0, 0.5]), np.zeros(2)), LIMITS)
    assert alone.duration < both.duration
    assert both.at(alone.duration).velocity[1] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.slow
@some(50)
@given(reached())
def test_from_every_reachable_state_the_stop_stays_within_all_limits(case: Reached) -> None:
    reference = plan_stop(case.state, case.limits)
    close(reference.at(0.0), case.state)
    close(reference.at(-0.5), case.state)
    keeps_to(case.limits, reference, 5e-6)  # what a way or a sampled motion may leave its limits by, unseen
    end = reference.at(reference.duration)
    np.testing.assert_array_equal(end.position, reference.end)
    np.testing.assert_array_equal(end.velocity, 0.0)
    np.testing.assert_array_equal(end.acceleration, 0.0)
    close(reference.at(reference.duration + 1e3), end)


@pytest.mark.slow
@some(25)
@given(SEEDS)
def test_a_stop_that_can_only_just_stay_inside_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    limits = random_limits(rng, 3)
    reference = plan_stop(turning_state(rng, limits), limits)
    keeps_to(limits, reference, 2e-7)
    lowest, highest = reference.extent()
    assert (lowest >= limits.lower - 2e-7).all()
    assert (highest <= limits.upper + 2e-7).all()


def _overshoot(limits: MotionLimits) -> Array:
    """Return the proven bound of the module's docstring [rad or m], shape (joints,)."""
    return np.asarray(limits.acceleration**3 / (24.0 * limits.jerk**2))


@settings(max_examples=100)
@given(SEEDS)
def test_the_quickest_stop_overshoots_a_turning_point_by_less_than_its_bound(seed: int) -> None:
    rng = np.random.default_rng(seed)
    limits = random_limits(rng, 5)
    state = turning_state(rng, limits)
    lowest, highest = plan_stop(state, _unlimited(limits)).extent()
    assert (highest <= limits.upper + _overshoot(limits) + 1e-7).all()
    assert (lowest >= limits.lower - _overshoot(limits) - 1e-7).all()


def test_the_bound_of_the_overshoot_is_reached() -> None:
    # Braking in full until it stands turns here; ramping back from here at once is the quickest stop.
    velocity = 0.5 * LIMITS.acceleration**2 / LIMITS.jerk
    start = Setpoint(np.zeros(2), velocity, -LIMITS.acceleration)
    turning = 0.5 * velocity**2 / LIMITS.acceleration
    wide = _unlimited(LIMITS)
    np.testing.assert_allclose(plan_stop(start, wide).extent()[1] - turning, _overshoot(LIMITS), rtol=1e-9)
    narrow = replace(LIMITS, upper=turning)
    np.testing.assert_allclose(plan_stop(start, narrow).extent()[1], turning, rtol=1e-9)
    np.testing.assert_allclose(_overshoot(LIMITS), [8.0**3 / 24 / 80.0**2, 15.0**3 / 24 / 150.0**2])


@settings(max_examples=100)
@given(setpoints(LIMITS, 1.5))
def test_a_stop_that_cannot_stay_inside_leaves_by_no_more_than_the_quickest(start: Setpoint) -> None:
    def leaves(limits: MotionLimits) -> Array:
        lowest, highest = plan_stop(start, limits).extent()
        return np.maximum(np.maximum(within.lower - lowest, highest - within.upper), 0.0)

    # In a narrow range the hardest braking would settle back beyond the other limit.
    for within in (LIMITS, replace(LIMITS, lower=start.position - 0.01, upper=start.position + 0.02)):
        assert (leaves(within) <= leaves(_unlimited(within)) + 1e-12).all()


@pytest.mark.slow
@some(25)
@given(setpoints(LIMITS, 1.5))
def test_the_quickest_stop_is_the_one_that_ruckig_finds(start: Setpoint) -> None:
    wide = _unlimited(LIMITS)
    parameters = ruckig.InputParameter(2)
    parameters.control_interface = ruckig.ControlInterface.Velocity
    parameters.synchronization = ruckig.Synchronization.No
    for name, numbers in vars(start).items():
        setattr(parameters, f"current_{name}", numbers.tolist())
    for name in ("velocity", "acceleration", "jerk"):
        setattr(parameters, f"max_{name}", getattr(LIMITS, name).tolist())
    expected = ruckig.Trajectory(2)
    ruckig.Ruckig(2).calculate(parameters, expected)
    reference = plan_stop(start, wide)
    assert reference.duration == pytest.approx(expected.duration, abs=1e-12)
    for time in np.linspace(0.0, reference.duration, 20):
        close(reference.at(float(time)), Setpoint(*(np.array(column) for column in expected.at_time(time)[:3])))


@pytest.mark.parametrize("size", [5.0, 1e3, 1e9, 1e40])
@pytest.mark.parametrize("signs", [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0)])
def test_a_stop_exists_from_far_beyond_the_limits(size: float, signs: tuple[float, float]) -> None:
    start = Setpoint(np.array([0.1, 9.0]), signs[0] * size * np.ones(2), signs[1] * size * np.ones(2))
    reference = plan_stop(start, LIMITS)
    end = reference.at(reference.duration)
    assert np.isfinite(end.position).all()
    assert not end.velocity.any()
    assert not end.acceleration.any()
    _, _, _, acceleration = sampled(reference)
    assert (np.abs(acceleration) <= np.maximum(size, LIMITS.acceleration) * (1 + 1e-9)).all()


@pytest.mark.slow
@some(25)
@given(setpoints(LIMITS, 3.0))
def test_an_acceleration_beyond_its_limit_is_led_back_first(start: Setpoint) -> None:
    reference = plan_stop(start, LIMITS)
    times, _, _, acceleration = sampled(reference, 800)
    allowed = np.maximum(np.abs(start.acceleration) - LIMITS.jerk * times[:, None], LIMITS.acceleration)
    assert (np.abs(acceleration) <= allowed + 1e-9).all()
    assert (np.abs(np.diff(acceleration, axis=0)) <= LIMITS.jerk * times[1] * (1 + 1e-6) + 1e-9).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("which", ["position", "velocity", "acceleration"])
def test_a_stop_from_what_is_no_number_is_no_number_and_raises_nothing(which: str, bad: float) -> None:
    start = replace(rest(np.array([0.1, 0.2])), **{which: np.array([0.0, bad])})
    reference = plan_stop(start, LIMITS)
    assert not np.isfinite(reference.at(0.1).position[1])
    assert np.isfinite(reference.at(0.1).position[0])


@pytest.mark.slow
@some(2)
@given(SEEDS)
def test_the_extent_of_the_stops_is_that_of_every_single_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    limits = _unlimited(random_limits(rng, 3))
    path = random_path(rng, random_limits(rng, 3))
    times = np.concatenate([np.linspace(*ends, 2 + int((ends[1] - ends[0]) / 5e-3)) for ends in path.distinct])
    motion = PathReference(path)
    singles = [plan_stop(motion.at(float(time)), limits).extent() for time in times]
    lowest, highest = stop_extent(path, limits)
    np.testing.assert_allclose(lowest, np.min([low for low, _ in singles], axis=0), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(highest, np.max([high for _, high in singles], axis=0), rtol=1e-9, atol=1e-9)


@pytest.mark.slow
@some(15)
@given(SEEDS)
def test_no_motion_within_its_limits_is_refused_for_its_stops(seed: int) -> None:
    rng = np.random.default_rng(seed)
    limits = random_limits(rng, 3)
    require_stops_within_limits(random_path(rng, limits), limits, ("a", "b", "c"))


def test_a_long_motion_is_looked_at_in_blocks() -> None:
    points = np.array([[0.0, 0.0], [1.0, -0.5], [0.0, 0.0], [-1.5, 1.7]])
    slow, quick = PosturePath(points, np.full(3, 20.0), 0.0), PosturePath(points, np.full(3, 19.0), 0.0)
    for path in (slow, quick):
        lowest, highest = stop_extent(path, LIMITS)
        np.testing.assert_allclose(lowest, points.min(axis=0), atol=1e-3)
        np.testing.assert_allclose(highest, points.max(axis=0), atol=1e-3)


@pytest.mark.slow
@some(15)
@given(SEEDS)
def test_the_extent_of_any_pieces_is_where_they_lead(seed: int) -> None:
    rng = np.random.default_rng(seed)
    start = Setpoint(*rng.normal(size=(3, 2)))
    pieces = [(rng.choice([-5.0, 0.0, 5.0], 2), rng.uniform(0.0, 1.0, 2)) for _ in range(4)]
    reference = StopProfile(start, pieces)
    lowest, highest = reference.extent()
    _, position, _, _ = sampled(reference, 800)
    np.testing.assert_allclose(lowest, position.min(axis=0), atol=5e-3)
    np.testing.assert_allclose(highest, position.max(axis=0), atol=5e-3)


@pytest.mark.slow
@some(10)
@given(SEEDS)
def test_the_extent_of_a_stop_is_where_it_goes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    limits = random_limits(rng, 3)
    reference = plan_stop(turning_state(rng, limits), limits)
    lowest, highest = reference.extent()
    _, position, _, _ = sampled(reference, 2000)
    between = limits.acceleration * (reference.duration / 2000) ** 2
    assert (np.abs(lowest - position.min(axis=0)) <= between + 1e-12).all()
    assert (np.abs(highest - position.max(axis=0)) <= between + 1e-12).all()
    assert (lowest <= position.min(axis=0) + 1e-12).all()
    assert (highest >= position.max(axis=0) - 1e-12).all()


def test_a_motion_whose_stops_leave_the_limits_is_refused_by_name() -> None:
    path = bench_excitation().path
    lowest, highest = stop_extent(path, LIMITS)
    require_stops_within_limits(path, replace(LIMITS, lower=lowest - 1e-6, upper=highest + 1e-6), ("shoulder", "elbow"))
    # What is no number is no limit that is kept.
    unknown = replace(LIMITS, lower=lowest - 1e-6, upper=np.array([highest[0] + 1e-6, np.nan]))
    with pytest.raises(MotionRefused, match="elbow"):
        require_stops_within_limits(path, unknown, ("shoulder", "elbow"))
    turning = path.at(np.linspace(0.0, path.duration, 5000))[0].max(axis=0)
    limits = replace(LIMITS, upper=np.array([LIMITS.upper[0], turning[1] - 0.01]))
    with pytest.raises(MotionRefused, match=r"^a stop out of the motion.*: elbow: [^;]*$"):
        require_stops_within_limits(path, limits, ("shoulder", "elbow"))


def _unlimited(limits: MotionLimits) -> MotionLimits:
    return replace(limits, lower=limits.lower - 1e9, upper=limits.upper + 1e9)
