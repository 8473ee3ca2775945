"""Evaluate finite Fourier series (eq. 78) and their derivatives.

    q_k(t) = sum_l a_kl / (w l) sin(w l t) - b_kl / (w l) cos(w l t) + q0_k

`demands.py` checks whether an arm may move so.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ident_service.errors import ModelError
from ident_service.model.chain import Array


@dataclass(frozen=True)
class FourierSeries:
    """Periodic motion of all joints, a finite Fourier series.

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
        """Return the length of one period [s]."""
        return 1.0 / self.base_frequency

    def at(self, time: Array | float) -> tuple[Array, Array, Array, Array]:
        """Return position, velocity, acceleration and jerk.

        Args:
            time: [s], shape (samples,) or a single number.

        Returns:
            Four arrays in SI units, shape (samples, joints), or (joints,) for a single time.
        """
        position, velocity, acceleration, jerk = self.derivatives(np.asarray(time, dtype=float), 3)
        return position, velocity, acceleration, jerk

    def derivatives(self, time: Array, highest: int) -> list[Array]:
        """Return position and its time derivatives up to the order `highest`, each of shape (samples, joints)."""
        rates = self._rates
        phase = time[..., None] * rates
        sine, cosine = np.sin(phase), np.cos(phase)
        a, b = self.a.T, self.b.T
        position = (sine / rates) @ a - (cosine / rates) @ b + self.q0
        values = [position, cosine @ a + sine @ b]
        while len(values) <= highest:
            # Every derivative turns (sine, cosine) by a quarter and multiplies by the rate.
            sine, cosine = cosine * rates, -sine * rates
            values.append(cosine @ a + sine @ b)
        return values[: highest + 1]

    @cached_property
    def _rates(self) -> Array:
        """Return the angular frequencies of the harmonics [rad/s], shape (harmonics,)."""
        return np.asarray(2.0 * np.pi * self.base_frequency * np.arange(1, self.a.shape[1] + 1))

    def scaled(self, factor: float) -> FourierSeries:
        """Return the motion about the same middle with all amplitudes times `factor`."""
        return FourierSeries(self.base_frequency, self.a * factor, self.b * factor, self.q0.copy())
