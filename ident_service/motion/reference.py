"""Define reference trajectories: a setpoint, the interface of a reference, the excitation as one, and standing still.

The other references are in `way.py` (from one moving state to another), `stop.py`, `pause.py` and `speed.py`.
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
        """Return the setpoint at `time` [s] since the reference began."""


class PathReference:
    """Represent a path of the excitation as a reference."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.duration = path.duration

    def at(self, time: float) -> Setpoint:
        """Return the setpoint at `time` [s]."""
        position, velocity, acceleration, _ = self._path.at(min(time, self.duration))
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
    """Return the reference of standing still at `position` [rad or m], shape (joints,), for `duration` [s]."""
    return Hold(position, duration)
