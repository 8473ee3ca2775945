"""Random limits, motions that use them in full, and every kind of state that these can bring an arm into."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st

from ident_service.config.motion_limits import MotionLimits
from ident_service.errors import MotionRefused
from ident_service.excitation.trajectory import FourierPath, FourierSeries, PosturePath
from ident_service.motion.sequencer import Paused
from ident_service.motion.speed_scaling import ScaledMotion
from ident_service.motion.stop_trajectory import plan_stop, state_after
from ident_service.motion.trajectory import PathReference, Reference, Setpoint, plan_trajectory, rest

Array = np.ndarray
Motion = FourierPath | PosturePath
# Times A^3 / J^2: how far a stop settles back from where it turns, and how far inside the limit that may lie.
NARROWEST = 1 / 3 + 8**-0.5 + 1 / 24


@dataclass(frozen=True)
class Reached:
    """A state, the limits under which it was reached, and on what."""

    limits: MotionLimits
    state: Setpoint
    kind: str


def random_limits(rng: np.random.Generator, joints: int) -> MotionLimits:
    """Limits of all proportions, with ranges of positions down to the narrowest that a stop can settle in."""
    velocity, acceleration, jerk = (np.exp(rng.uniform(np.log(low), np.log(high), joints)) for low, high in _SCALES)
    width = NARROWEST * acceleration**3 / jerk**2 + rng.choice([0.0, 0.1, 3.0], joints) * rng.uniform(size=joints)
    lower = rng.uniform(-2.0, 1.0, joints)
    upper = lower + np.maximum(width, 1e-3)
    unused = np.ones(joints)
    return MotionLimits(
        lower, upper, velocity, acceleration, jerk, unused, unused, unused, unused, 0.5 * (lower + upper)
    )


_SCALES = ((0.3, 5.0), (1.0, 30.0), (20.0, 500.0))


def random_path(rng: np.random.Generator, limits: MotionLimits) -> Motion:
    """A motion that touches at least one limit of each joint, without a margin."""
    middle, half = 0.5 * (limits.lower + limits.upper), 0.5 * (limits.upper - limits.lower)
    joints = len(middle)
    if rng.uniform() < 0.2:
        times = rng.uniform(0.2, 2.0, 3)
        path: Motion = PosturePath(rng.uniform(-1.0, 1.0, (4, joints)), times, float(rng.choice([0.0, 0.3])))
        lowest, highest, *peaks = _peaks(path)
        scale = _scale(0.5 * (highest - lowest), peaks, half, limits)
        return PosturePath(middle + (path.points - 0.5 * (highest + lowest)) * scale, times, path.dwell)
    shape = (joints, int(rng.integers(1, 5)))
    series = FourierSeries(
        float(rng.uniform(0.1, 1.0)), rng.normal(size=shape), rng.normal(size=shape), np.zeros(joints)
    )
    ramp = float(rng.choice([0.0, 0.5, 2.0]))
    lowest, highest, *peaks = _peaks(FourierPath(series, 1, ramp))
    scale = _scale(np.maximum(-lowest, highest), peaks, half, limits)[:, None]
    return FourierPath(FourierSeries(series.base_frequency, series.a * scale, series.b * scale, middle), 1, ramp)


def random_reference(rng: np.random.Generator, limits: MotionLimits, path: Motion) -> tuple[Reference, str]:
    """The motion itself, or one of the ways that are made of it."""
    motion = PathReference(path)
    time = float(rng.uniform(0.0, motion.duration))
    match str(rng.choice(["path", "slowed", "way", "paused", "resumed", "approach"])):
        case "slowed":
            return ScaledMotion(motion, float(rng.uniform(0.1, 1.0))), "slowed"
        case "paused":
            return Paused(motion, time, limits), "paused"
        case "way" | "resumed" | "approach" as kind:
            try:
                if kind == "resumed":
                    return Paused(motion, time, limits).resume(), kind
                start = motion.at(float(rng.uniform(0.0, motion.duration)))
                here = rest(start.position) if kind == "approach" else start
                return plan_trajectory(here, motion.at(time), limits), kind
            except MotionRefused:
                return motion, "path"
        case _:
            return motion, "path"


def turning_state(rng: np.random.Generator, limits: MotionLimits) -> Setpoint:
    """A state of a motion that each joint turns at its very position limit, braking as hard as it can or less.

    Followed backwards from the turning point, where it stands, through pieces of constant jerk.
    """
    joints = [_before_turning(rng, *numbers) for numbers in zip(*_columns(limits), strict=True)]
    return Setpoint(*(np.array(column) for column in zip(*joints, strict=True)))


def _columns(limits: MotionLimits) -> tuple[Array, ...]:
    return limits.lower, limits.upper, limits.velocity, limits.acceleration, limits.jerk


def _before_turning(
    rng: np.random.Generator, lower: float, upper: float, velocity: float, acceleration: float, jerk: float
) -> tuple[float, float, float]:
    steepest = min(acceleration, (2.0 * jerk * velocity) ** 0.5)  # else it would turn back faster than it may
    state = Setpoint(np.array(upper), np.array(0.0), np.array(-steepest * rng.choice([1.0, rng.uniform()])))
    # Long pieces, so that the whole range of velocities is visited; braking more often than not.
    longest = rng.choice([1.0, 3.0]) * (velocity / acceleration + acceleration / jerk)
    for _ in range(int(rng.integers(1, 7))):
        size = np.array(rng.choice([-jerk, -jerk, 0.0, jerk]))
        back = -longest * rng.uniform() * np.linspace(0.0, 1.0, 2000)
        way_back = state_after(state, size, back)
        fits = (way_back.position >= lower) & (way_back.position <= upper)
        fits &= (np.abs(way_back.velocity) <= velocity) & (np.abs(way_back.acceleration) <= acceleration * (1 + 1e-12))
        last = len(fits) - 1 if fits.all() else max(int(np.argmin(fits)) - 1, 0)
        state = state_after(state, size, back[last])
    middle, sign = (lower + upper, -1.0) if rng.uniform() < 0.5 else (0.0, 1.0)
    return middle + sign * float(state.position), sign * float(state.velocity), sign * float(state.acceleration)


@st.composite
def reached(draw: st.DrawFn) -> Reached:
    """States of all kinds, those of stops out of the others among them."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    limits = random_limits(rng, int(rng.integers(1, 5)))
    if rng.uniform() < 0.4:
        state, kind = turning_state(rng, limits), "before a turning point"
    else:
        reference, kind = random_reference(rng, limits, random_path(rng, limits))
        state = reference.at(float(rng.uniform(0.0, reference.duration)))
    if rng.uniform() < 0.25:
        stopping, kind = plan_stop(state, limits), f"stop out of {kind}"
        state = stopping.at(float(rng.uniform(0.0, stopping.duration)))
    return Reached(limits, state, kind)


def _peaks(path: Motion) -> list[Array]:
    position, *others = path.at(np.linspace(0.0, path.duration, 8001))
    return [position.min(axis=0), position.max(axis=0), *(np.abs(other).max(axis=0) for other in others)]


def _scale(swing: Array, peaks: list[Array], half: Array, limits: MotionLimits) -> Array:
    room = [half / swing, limits.velocity / peaks[0], limits.acceleration / peaks[1], limits.jerk / peaks[2]]
    return np.asarray(np.min(room, axis=0) * (1.0 - 1e-4))  # what happens between two points of the grid


def sampled(reference: Reference, points: int = 400, duration: float | None = None) -> tuple[Array, ...]:
    """Times, positions, velocities and accelerations along a way."""
    times = np.linspace(0.0, reference.duration if duration is None else duration, points)
    setpoints = [reference.at(float(time)) for time in times]
    columns = ([getattr(point, key) for point in setpoints] for key in ("position", "velocity", "acceleration"))
    return times, *(np.array(column) for column in columns)


def keeps_to(limits: MotionLimits, reference: Reference, position_slack: float = 1e-9, points: int = 400) -> None:
    """Every limit holds all along a way, and each column is the derivative of the one before."""
    times, position, velocity, acceleration = sampled(reference, points)
    assert (position >= limits.lower - position_slack).all()
    assert (position <= limits.upper + position_slack).all()
    assert (np.abs(velocity) <= limits.velocity * (1 + 3e-6) + 1e-9).all()
    assert (np.abs(acceleration) <= limits.acceleration * (1 + 3e-6) + 1e-9).all()
    goes_together(limits, times, position, velocity, acceleration)


def goes_together(limits: MotionLimits, times: Array, position: Array, velocity: Array, acceleration: Array) -> None:
    """No jerk is beyond its limit, no column has a step, and each is the derivative of the one before."""
    step = float(times[1])
    mean = np.diff(position, axis=0) - 0.5 * step * (velocity[1:] + velocity[:-1])
    # Besides the error of the trapezoidal rule: ruckig takes a way as arrived within 1e-8 of position and velocity.
    assert (np.abs(mean) <= limits.jerk * step**3 / 6.0 + 2e-8).all()
    rise = np.diff(velocity, axis=0) - 0.5 * step * (acceleration[1:] + acceleration[:-1])
    assert (np.abs(rise) <= limits.jerk * step**2 / 2.0 + 3e-8).all()
    assert (np.abs(np.diff(acceleration, axis=0)) <= limits.jerk * step * (1 + 3e-6) + 1e-7).all()


def close(one: Setpoint, other: Setpoint) -> None:
    """The same state but for rounding."""
    np.testing.assert_allclose(one.position, other.position, atol=1e-7)
    np.testing.assert_allclose(one.velocity, other.velocity, atol=1e-7)
    np.testing.assert_allclose(one.acceleration, other.acceleration, atol=1e-6)


def _vector(share: float) -> st.SearchStrategy[Array]:
    return st.tuples(st.floats(-share, share), st.floats(-share, share)).map(np.array)


def setpoints(limits: MotionLimits, share: float = 1.0) -> st.SearchStrategy[Setpoint]:
    """Moving states that use at most `share` of every limit."""
    middle, half = 0.5 * (limits.upper + limits.lower), 0.5 * (limits.upper - limits.lower)
    return st.builds(
        lambda q, dq, ddq: Setpoint(middle + half * q, limits.velocity * dq, limits.acceleration * ddq),
        _vector(share),
        _vector(share),
        _vector(share),
    )
