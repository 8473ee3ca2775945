"""Plan where the arm should be: a state, the excitation, and jerk-limited trajectories between moving states.

Such a trajectory is ruckig's, within the arm's velocity, acceleration and jerk; ruckig is imported nowhere else. Stops
are planned in `stop_trajectory.py`; `sequencer.py` leads through them all.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace
from math import inf
from typing import Protocol, TypeVar, cast

import numpy as np
import ruckig

from ident_service.config.motion_limits import MotionLimits, Vector
from ident_service.errors import MotionRefused
from ident_service.excitation.trajectory import MotionPath


@dataclass(frozen=True)
class Setpoint:
    """Hold position [rad or m], velocity and acceleration of all joints, each of shape (joints,)."""

    position: Vector
    velocity: Vector
    acceleration: Vector


class Reference(Protocol):
    """Define a reference trajectory from now on; after `duration` it stays at its last setpoint."""

    @property
    def duration(self) -> float:
        """Return the duration of the reference [s]."""

    def at(self, time: float) -> Setpoint:
        """Return the setpoint at `time` [s] since the reference began; after its duration the last one."""


class PathReference:
    """Represent a path of the excitation as a reference."""

    def __init__(self, path: MotionPath) -> None:
        self._path = path
        self.duration = path.duration

    def at(self, time: float) -> Setpoint:
        """Return the setpoint at `time` [s] since the path began; after its duration the last one."""
        position, velocity, acceleration = self._path.derivatives(np.asarray(min(time, self.duration), dtype=float), 2)
        return Setpoint(position, velocity, acceleration)


class Hold:
    """Represent standing still as a reference, for a time or for good."""

    def __init__(self, position: Vector, duration: float) -> None:
        self._setpoint = rest(position.copy())
        self.duration = duration

    def at(self, time: float) -> Setpoint:
        """Return the setpoint, which does not depend on `time` [s]."""
        return self._setpoint


def rest(position: Vector) -> Setpoint:
    """Return the setpoint of standing still at `position` [rad or m], shape (joints,)."""
    return Setpoint(position, np.zeros_like(position), np.zeros_like(position))


def hold(position: Vector, duration: float = inf) -> Hold:
    """Create a reference that stands still at `position` [rad or m], (joints,), for `duration` [s], or for good."""
    return Hold(position, duration)


_Result = TypeVar("_Result")
_SLICE = 50  # points of a trajectory evaluated in one slice
# s; where a joint is to end as it begins, accelerating, ruckig finds no trajectory of just the slowest joint's duration
_DURATIONS = (None, 0.1, 0.2, 0.5, 1.0)
_EXTENT_STEP = 1e-3  # s; a turning point lies at most acceleration * step^2 / 8 outside: 2e-6 rad at 16 rad/s^2


class RuckigReference:
    """Represent a jerk-limited trajectory computed by ruckig."""

    def __init__(self, parameters: ruckig.InputParameter) -> None:
        self._trajectory = ruckig.Trajectory(parameters.degrees_of_freedom)
        try:
            result = self._calculated(parameters)
        except (ruckig.RuckigError, ValueError) as error:  # ValueError: a result that its own enumeration lacks
            raise MotionRefused(f"no jerk-limited trajectory exists within the limits: {str(error).strip()}") from error
        if result not in (ruckig.Result.Working, ruckig.Result.Finished):
            raise MotionRefused(f"no jerk-limited trajectory exists within the limits: {result}")
        self.duration = float(self._trajectory.duration)

    def _calculated(self, parameters: ruckig.InputParameter) -> ruckig.Result:
        """Compute the trajectory; where ruckig cannot stretch one joint's to the others' duration, a longer one."""
        for shortest in _DURATIONS[:-1]:
            parameters.minimum_duration = shortest
            try:
                return ruckig.Ruckig(parameters.degrees_of_freedom).calculate(parameters, self._trajectory)
            except ruckig.RuckigError as error:
                if "step 2" not in str(error):
                    raise
        parameters.minimum_duration = _DURATIONS[-1]
        return ruckig.Ruckig(parameters.degrees_of_freedom).calculate(parameters, self._trajectory)

    def at(self, time: float) -> Setpoint:
        """Return the setpoint at `time` [s] since the trajectory began; after its duration the last one."""
        position, velocity, acceleration = self._trajectory.at_time(min(time, self.duration))[:3]
        return Setpoint(np.array(position), np.array(velocity), np.array(acceleration))

    def extent(self) -> tuple[Vector, Vector]:
        """Return the lowest and highest position at times sampled every millisecond [rad or m], (joints,) each."""
        return run_to_end(self.extent_in_slices())

    def extent_in_slices(self) -> Generator[None, None, tuple[Vector, Vector]]:
        """Compute the sampled lowest and highest position in slices for control cycles; the generator returns both."""
        # The position_extrema of ruckig itself miss turning points (pantor/ruckig#215), here by more than 0.1 rad.
        times = np.linspace(0.0, self.duration, 2 + int(self.duration / _EXTENT_STEP)).tolist()
        at_time = self._trajectory.at_time
        lowest = highest = np.array(at_time(0.0)[0])
        for first in range(0, len(times), _SLICE):
            positions = np.array([at_time(time)[0] for time in times[first : first + _SLICE]])
            lowest = np.minimum(lowest, positions.min(axis=0))
            highest = np.maximum(highest, positions.max(axis=0))
            yield
        return lowest, highest


_CALM = 0.5  # of the limits, on the way to a motion and back


def plan_reduced_trajectory(start: Setpoint, end: Setpoint, limits: MotionLimits) -> RuckigReference:
    """Plan a trajectory at half the velocity and acceleration limits, or what its ends need; MotionRefused if none.

    A trajectory at the full limits leaves no margin for errors of the model, and a second more does not matter.

    Raises:
        MotionRefused: as `plan_trajectory`.
    """
    return run_to_end(plan_reduced_trajectory_in_slices(start, end, limits))


def plan_reduced_trajectory_in_slices(
    start: Setpoint, end: Setpoint, limits: MotionLimits
) -> Generator[None, None, RuckigReference]:
    """Plan in slices a trajectory at half the limits, or what its ends need; the generator returns it.

    Raises:
        MotionRefused: as `plan_trajectory`, from any of its steps.
    """
    velocity = np.maximum(np.abs(start.velocity), np.abs(end.velocity))
    acceleration = np.maximum(np.abs(start.acceleration), np.abs(end.acceleration))
    calm = replace(
        limits,
        velocity=np.minimum(limits.velocity, np.maximum(_CALM * limits.velocity, 1.1 * velocity)),
        acceleration=np.minimum(limits.acceleration, np.maximum(_CALM * limits.acceleration, 1.1 * acceleration)),
    )
    return (yield from plan_trajectory_in_slices(start, end, calm))


def plan_trajectory(start: Setpoint, end: Setpoint, limits: MotionLimits) -> RuckigReference:
    """Plan a trajectory between two states of motion, all joints arriving together; MotionRefused outside limits.

    Raises:
        MotionRefused: no such way exists within the limits, or it would leave the position limits.
    """
    return run_to_end(plan_trajectory_in_slices(start, end, limits))


def plan_trajectory_in_slices(
    start: Setpoint, end: Setpoint, limits: MotionLimits
) -> Generator[None, None, RuckigReference]:
    """Plan in slices a trajectory between two states of motion within the limits; the generator returns it.

    Raises:
        MotionRefused: as `plan_trajectory`, from any of its steps.
    """
    parameters = ruckig.InputParameter(len(start.position))
    parameters.current_position = start.position.tolist()
    parameters.current_velocity = start.velocity.tolist()
    parameters.current_acceleration = start.acceleration.tolist()
    parameters.target_position = end.position.tolist()
    parameters.target_velocity = end.velocity.tolist()
    parameters.target_acceleration = end.acceleration.tolist()
    parameters.max_velocity = limits.velocity.tolist()
    parameters.max_acceleration = limits.acceleration.tolist()
    parameters.max_jerk = limits.jerk.tolist()
    # From rest to rest all joints share one profile, so that the way is straight in joint space; else it cannot be.
    parameters.synchronization = ruckig.Synchronization.Phase
    reference = RuckigReference(parameters)
    yield
    lowest, highest = yield from reference.extent_in_slices()
    if bool(np.any(lowest < limits.lower) or np.any(highest > limits.upper)):
        joint = int(np.argmax(np.maximum(limits.lower - lowest, highest - limits.upper)))
        raise MotionRefused(
            f"the trajectory to or from the motion moves joint {joint + 1} to "
            f"{lowest[joint]:.3f}..{highest[joint]:.3f}, outside {limits.lower[joint]:g}..{limits.upper[joint]:g}; "
            "start closer to it or slower"
        )
    return reference


def run_to_end(slices: Generator[None, None, _Result]) -> _Result:
    """Run a generator to its end and return its result."""
    while True:
        try:
            next(slices)
        except StopIteration as end:
            return cast(_Result, end.value)
