"""Parametrise motions as linear functions of coefficients, which a search varies.

Every joint has the same basis functions of time and coefficients of its own: `q_k(t) = sum_c X[k, c] B_c(t)`, likewise
for all derivatives. The last coefficient of a Fourier basis is the middle; the coefficients of ways between postures
are the postures themselves.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ident_service.excitation.fourier import FourierSeries
from ident_service.excitation.path import FourierPath, PosturePath
from ident_service.model.chain import Array


class Basis(Protocol):
    """Family of motions, linear in its coefficients."""

    @property
    def size(self) -> int:
        """Return the number of coefficients per joint."""

    @property
    def moving(self) -> NDArray[np.bool_]:
        """Return which coefficients move the arm away from standing still, shape (size,)."""

    def path(self, coefficients: Array) -> FourierPath | PosturePath:
        """Return the motion with coefficients of shape (joints, size)."""

    def standing(self, posture: Array) -> Array:
        """Return the coefficients of standing still at a posture of shape (joints,), shape (joints, size)."""

    def still(self, coefficients: Array) -> Array:
        """Return the coefficients of standing at the middle of a motion, shape (joints, size)."""

    def samples(self, per_period: int) -> tuple[Array, Array]:
        """Return times [s] to check limits at, and the time of information that each of them stands for [s]."""


@dataclass(frozen=True)
class FourierBasis:
    """Family of windowed Fourier series (eq. 78); coefficients are a, b, q0."""

    base_frequency: float
    harmonics: int
    periods: int
    ramp: float

    @property
    def size(self) -> int:
        """Return the number of coefficients per joint."""
        return 2 * self.harmonics + 1

    @cached_property
    def moving(self) -> NDArray[np.bool_]:
        """Return True for all coefficients but the middle position, shape (size,)."""
        return np.arange(self.size) < 2 * self.harmonics

    def path(self, coefficients: Array) -> FourierPath:
        """Return the motion with coefficients of shape (joints, size)."""
        n = self.harmonics
        a, b, q0 = coefficients[:, :n].copy(), coefficients[:, n : 2 * n].copy(), coefficients[:, -1].copy()
        return FourierPath(FourierSeries(self.base_frequency, a, b, q0), self.periods, self.ramp)

    def standing(self, posture: Array) -> Array:
        """Return the coefficients of standing still."""
        return np.column_stack([np.zeros((len(posture), 2 * self.harmonics)), posture])

    def still(self, coefficients: Array) -> Array:
        """Return the coefficients of standing at the middle."""
        return self.standing(coefficients[:, -1])

    def samples(self, per_period: int) -> tuple[Array, Array]:
        """Return times in one period, which count for all periods, and in both ramps, which have no weight."""
        period = 1.0 / self.base_frequency
        step = period / per_period
        times = np.asarray(self.ramp + step * np.arange(per_period))
        weights = np.full(per_period, step * self.periods, dtype=float)
        if self.ramp == 0.0:
            return times, weights
        points = max(24, int(np.ceil(self.ramp / step)))
        rising = (np.arange(points) + 0.5) * self.ramp / points
        duration = self.periods * period + 2.0 * self.ramp
        return np.concatenate([rising, times, duration - rising]), np.concatenate(
            [np.zeros(points), weights, np.zeros(points)]
        )


@dataclass(frozen=True)
class PostureBasis:
    """Family of motions through postures and back, each segment forwards and backwards in its own time.

    Attributes:
        postures: number of postures.
        times: durations of the segments [s], there and back again: 2 (postures - 1) of them.
        dwell: time that the arm stands at each posture [s].
    """

    postures: int
    times: tuple[float, ...]
    dwell: float

    @property
    def size(self) -> int:
        """Return the number of coefficients per joint."""
        return self.postures

    @cached_property
    def moving(self) -> NDArray[np.bool_]:
        """Return True for all coefficients: the arm stands still where all postures are one."""
        return np.ones(self.postures, dtype=bool)

    def path(self, coefficients: Array) -> PosturePath:
        """Return the motion with coefficients of shape (joints, postures)."""
        order = [*range(self.postures), *range(self.postures - 2, -1, -1)]
        return PosturePath(coefficients.T[order].copy(), np.array(self.times), self.dwell)

    def standing(self, posture: Array) -> Array:
        """Return the coefficients of standing still."""
        return np.repeat(posture[:, None], self.postures, axis=1)

    def still(self, coefficients: Array) -> Array:
        """Return the coefficients of standing at the mean posture."""
        return self.standing(coefficients.mean(axis=1))

    def samples(self, per_period: int) -> tuple[Array, Array]:
        """Return times [s] over the whole motion, with equal weights [s]."""
        duration = self.dwell * (len(self.times) + 1) + sum(self.times)
        step = duration / per_period
        return np.asarray(step * (np.arange(per_period) + 0.5)), np.full(per_period, step, dtype=float)


def maps(basis: Basis, times: Array) -> tuple[Array, Array, Array, Array]:
    """Return the values of all basis functions and of their first three derivatives, each of shape (samples, size)."""
    return basis.path(np.eye(basis.size)).at(times)
