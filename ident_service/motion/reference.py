"""Where the arm should be: a state, what a way is, the excitation as one, and standing still.

The other ways are in `way.py` (from one moving state to another), `stop.py`, `pause.py` and `speed.py`.
Boundary: pure functions of time.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Protocol

import numpy as np

from ident_service.config.limits import Vector
from ident_service.excitation.path import Path


@dataclass(frozen=True)
class Setpoint:
    """Position [rad or m], velocity and acceleration of all joints, each of shape (joints,)."""

    position: Vector
    velocity: Vector
    acceleration: Vector


class Reference(Protocol):
    """A way from now on; after `duration` it stays at its last setpoint."""

    @property
    def duration(self) -> float:
        """Length [s]."""

    def at(self, time: float) -> Setpoint:
        """Setpoint at `time` [s] since the way began."""


class PathReference:
    """A path of the excitation."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.duration = path.duration

    def at(self, time: float) -> Setpoint:
        """Setpoint at `time` [s]."""
        position, velocity, acceleration, _ = self._path.at(min(time, self.duration))
        return Setpoint(position, velocity, acceleration)


class Hold:
    """Standing, for a time or for good."""

    def __init__(self, position: Vector, duration: float) -> None:
        self._setpoint = rest(position.copy())
        self.duration = duration

    def at(self, time: float) -> Setpoint:
        """Setpoint at `time` [s]."""
        return self._setpoint


def rest(position: Vector) -> Setpoint:
    """Standing still at `position` [rad or m], shape (joints,)."""
    return Setpoint(position, np.zeros_like(position), np.zeros_like(position))


def hold(position: Vector, duration: float = inf) -> Hold:
    """Stand at `position` [rad or m], shape (joints,), for `duration` [s]."""
    return Hold(position, duration)
