"""Simulate the difference between a true state and a sample: encoder steps, torque steps and limits, torque noise."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from drivers.arm import Flags, Vector
from ident_service.errors import DriverError


@dataclass(frozen=True)
class Imperfections:
    """Hold the imperfections per joint, all of shape (joints,).

    Attributes:
        encoder_resolution: step of the position [rad or m]; 0 where continuous.
        torque_resolution: step of the torque [N m or N]; 0 where continuous.
        torque_noise: standard deviation per cycle of what acts besides the torque [N m or N].
        torque_limit: clip of the driver [N m or N]; infinite where there is none.
    """

    encoder_resolution: Vector
    torque_resolution: Vector
    torque_noise: Vector
    torque_limit: Vector

    def __post_init__(self) -> None:
        for field in fields(self):
            value = np.array(getattr(self, field.name), dtype=float)
            if value.shape != self.torque_limit.shape or not (value >= 0.0).all():
                raise DriverError(
                    f"{field.name} must be {self.torque_limit.shape[0]} numbers, none negative, is {value}"
                )
            value.setflags(write=False)
            object.__setattr__(self, field.name, value)

    @classmethod
    def none(cls, joints: int) -> Imperfections:
        """Return the imperfections of a perfect arm: continuous, without noise, unlimited."""
        return cls(np.zeros(joints), np.zeros(joints), np.zeros(joints), np.full(joints, np.inf))

    def encode(self, position: Vector) -> Vector:
        """Return the position that encoders show, a new array of shape (joints,)."""
        return _in_steps(position, self._encoder_steps)

    def drive(self, torque: Vector) -> Vector:
        """Return the torque that drives give for a request, a new array of shape (joints,)."""
        least, most = self._range
        return np.asarray(np.minimum(np.maximum(_in_steps(torque, self._torque_steps), least), most))

    @cached_property
    def _encoder_steps(self) -> _Steps:
        return _steps(self.encoder_resolution)

    @cached_property
    def _torque_steps(self) -> _Steps:
        return _steps(self.torque_resolution)

    @cached_property
    def _range(self) -> tuple[Vector, Vector]:
        """Return the largest whole steps inside the limits, because rounding could lead out of them again."""
        step, limit = self.torque_resolution, self.torque_limit
        whole = np.where(step > 0.0, step, 1.0)
        # A limit that is a whole number of steps must stay one when their quotient is rounded down.
        reach = np.where(step > 0.0, np.floor(limit / whole * (1.0 + 1e-12)) * whole, limit)
        return -reach, reach


# Which values have steps, None where all have; and the steps, 1 where a value is continuous.
_Steps = tuple[Flags | None, Vector]


def _steps(step: Vector) -> _Steps:
    stepped = step > 0.0
    return None if stepped.all() else stepped, np.where(stepped, step, 1.0)


def _in_steps(value: Vector, steps: _Steps) -> Vector:
    stepped, step = steps
    whole: Vector = np.rint(value / step) * step
    return whole if stepped is None else np.where(stepped, whole, value)
