"""Finite Fourier motions (eq. 78) and what they are made of.

    q_k(t) = sum_l a_kl / (w l) sin(w l t) - b_kl / (w l) cos(w l t) + q0_k

Boundary: pure functions of time; whether an arm may move so is `demands.py`'s question.
"""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np

from ident_service.errors import ModelError
from ident_service.model.chain import Array


@dataclass(frozen=True)
class FourierSeries:
    """A periodic motion of all joints.

    Attributes:
        base_frequency: [Hz]; `2 pi base_frequency` is the paper's omega_f.
        a: sine coefficients [rad/s or m/s], shape (joints, harmonics).
        b: cosine coefficients [rad/s or m/s], shape (joints, harmonics).
        q0: middle position [rad or m], shape (joints,).
    """

    base_frequency: float
    a: Array
    b: Array
    q0: Array

    def __post_init__(self) -> None:
        if not (self.a.ndim == 2 and self.a.shape == self.b.shape and self.q0.shape == self.a.shape[:1]):
            raise ModelError(f"{self.a.shape=}, {self.b.shape=} and {self.q0.shape=} do not belong to one motion")
        for array in (self.a, self.b, self.q0):
            array.setflags(write=False)

    @property
    def period(self) -> float:
        """Length of one period [s]."""
        return 1.0 / self.base_frequency

    def at(self, time: Array | float) -> tuple[Array, Array, Array, Array]:
        """Position, velocity, acceleration and jerk.

        Args:
            time: [s], shape (samples,) or a single number.

        Returns:
            Four arrays in SI units, shape (samples, joints), or (joints,) for a single time.
        """
        t = np.asarray(time, dtype=float)
        harmonics = 2.0 * np.pi * self.base_frequency * np.arange(1, self.a.shape[1] + 1)
        phase = t[..., None] * harmonics
        sine, cosine = np.sin(phase), np.cos(phase)
        a, b = self.a.T, self.b.T
        position = (sine / harmonics) @ a - (cosine / harmonics) @ b + self.q0
        velocity = cosine @ a + sine @ b
        acceleration = (-sine * harmonics) @ a + (cosine * harmonics) @ b
        jerk = (-cosine * harmonics**2) @ a - (sine * harmonics**2) @ b
        return position, velocity, acceleration, jerk

    def scaled(self, factor: float) -> FourierSeries:
        """The same motion about the same middle with all amplitudes times `factor`."""
        return FourierSeries(self.base_frequency, self.a * factor, self.b * factor, self.q0.copy())


@dataclass(frozen=True)
class Excitation:
    """A motion ready to run, and the arm it was made for.

    Attributes:
        name: what the motion is for.
        series: the motion.
        periods: how often it repeats.
        arm_sha256: hash of the arm description.
    """

    name: str
    series: FourierSeries
    periods: int
    arm_sha256: str

    @property
    def duration(self) -> float:
        """Length of the whole motion [s]."""
        return self.periods * self.series.period

    def to_json(self) -> str:
        """One small JSON object from which the motion can be repeated to the last bit."""
        return json.dumps(
            {
                "format": "ident-excitation",
                "version": 1,
                "name": self.name,
                "arm": {"sha256": self.arm_sha256},
                "base_frequency": self.series.base_frequency,
                "periods": self.periods,
                "a": self.series.a.tolist(),
                "b": self.series.b.tolist(),
                "q0": self.series.q0.tolist(),
            },
            indent=1,
        )
