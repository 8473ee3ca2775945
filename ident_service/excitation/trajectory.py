"""Describe motions of all joints over time: finite Fourier series (eq. 78), and ways between postures.

q_k(t) = sum_l a_kl / (w l) sin(w l t) - b_kl / (w l) cos(w l t) + q0_k

`limit_proof.py` checks whether an arm may move so.

Every path bounds its fifth derivative, so that what holds at single times can be extended to all times
(`limit_proof.py`).

Every joint has the same basis functions of time and coefficients of its own: `q_k(t) = sum_c X[k, c] B_c(t)`, likewise
for all derivatives. The last coefficient of a Fourier basis is the middle; the coefficients of ways between postures
are the postures themselves.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from math import comb
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ident_service.errors import ModelError
from ident_service.model.chain import Array


class _Sampled:
    """Motion that is given by its derivatives of any order."""

    def at(self, time: Array | float) -> tuple[Array, Array, Array, Array]:
        """Return position, velocity, acceleration and jerk.

        Args:
            time: [s] since the motion begins, shape (samples,) or a single number; before and after a motion with
                ramps it stands where it begins and ends, one without them goes on.

        Returns:
            Four arrays in SI units, shape (samples, joints), or (joints,) for a single time.
        """
        position, velocity, acceleration, jerk = self.derivatives(np.asarray(time, dtype=float), 3)
        return position, velocity, acceleration, jerk

    def derivatives(self, time: Array, highest: int) -> list[Array]:
        """Return position and its time derivatives up to the order `highest`, each of shape (samples, joints)."""
        raise NotImplementedError


@dataclass(frozen=True)
class FourierSeries(_Sampled):
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

    def derivatives(self, time: Array, highest_order: int) -> list[Array]:
        """Return position and its time derivatives up to the order `highest_order`, each of shape (samples, joints)."""
        rates = self._rates
        phase = time[..., None] * rates
        sine, cosine = np.sin(phase), np.cos(phase)
        a, b = self.a.T, self.b.T
        position = (sine / rates) @ a - (cosine / rates) @ b + self.q0
        values = [position, cosine @ a + sine @ b]
        while len(values) <= highest_order:
            # Every derivative turns (sine, cosine) by a quarter and multiplies by the rate.
            sine, cosine = cosine * rates, -sine * rates
            values.append(cosine @ a + sine @ b)
        return values[: highest_order + 1]

    @cached_property
    def _rates(self) -> Array:
        """Return the angular frequencies of the harmonics [rad/s], shape (harmonics,)."""
        return np.asarray(2.0 * np.pi * self.base_frequency * np.arange(1, self.a.shape[1] + 1))

    def scaled(self, factor: float) -> FourierSeries:
        """Return a series about the same middle position with all amplitudes times `factor`."""
        return FourierSeries(self.base_frequency, self.a * factor, self.b * factor, self.q0.copy())


# The smooth step 35 s^4 - 84 s^5 + 70 s^6 - 20 s^7: three derivatives vanish at both ends. The peaks are those of the
# step and of its first five derivatives on [0, 1].
_STEP = np.polynomial.Polynomial([0.0, 0.0, 0.0, 0.0, 35.0, -84.0, 70.0, -20.0])
_STEP_DERIVATIVES = (_STEP, *(_STEP.deriv(order) for order in (1, 2, 3, 4)))
STEP_PEAKS = (1.0, 35.0 / 16.0, 84.0 / 5.0**0.5 / 5.0, 52.5, 840.0, 10080.0)


class MotionPath(Protocol):
    """Motion of all joints as a function of time."""

    @property
    def joints(self) -> int:
        """Return the number of joints."""

    @property
    def duration(self) -> float:
        """Return the length of the motion [s]."""

    @property
    def distinct(self) -> tuple[tuple[float, float], ...]:
        """Return (begin, end) [s] of the stretches that contain every distinct part; all other times repeat them."""

    @property
    def crackle(self) -> Array:
        """Return the bound of the fifth derivative between the seams [rad/s^5 or m/s^5], shape (joints,)."""

    @property
    def seams(self) -> Array:
        """Return the times at which higher derivatives may jump [s], from 0 to the duration, increasing."""

    def highest_frequency(self, begin: float, end: float) -> float:
        """Return the highest frequency of the motion between two times [Hz], for choosing how finely to sample."""

    def derivatives(self, time: Array, highest_order: int) -> list[Array]:
        """Return position and its time derivatives up to `highest_order` <= 4, each of shape (samples, joints)."""

    def at(self, time: Array | float) -> tuple[Array, Array, Array, Array]:
        """Return position, velocity, acceleration and jerk at `time` [s], shape (samples, joints) or (joints,)."""


@dataclass(frozen=True)
class FourierPath(_Sampled):
    """Fourier series that swells from rest about its middle, repeats, and dies down to rest.

        q(t) = q0 + w(t) s(t - ramp)

    with w the smooth step over `ramp` at both ends and 1 between, where whole periods of the series s are played.

    Attributes:
        series: the periodic motion.
        periods: number of repetitions at full size.
        ramp: length of the swelling and of the dying down [s]; 0 for a motion that begins and ends moving.
    """

    series: FourierSeries
    periods: int
    ramp: float = 0.0

    def __post_init__(self) -> None:
        if self.periods < 1 or not 0.0 <= self.ramp < float("inf"):
            raise ModelError(f"{self.periods=} and {self.ramp=} are no motion")

    @property
    def joints(self) -> int:
        """Return the number of joints."""
        return len(self.series.q0)

    @property
    def duration(self) -> float:
        """Return the length of the whole motion [s]."""
        return self.periods * self.series.period + 2.0 * self.ramp

    @property
    def distinct(self) -> tuple[tuple[float, float], ...]:
        """Return (begin, end) [s] of the first ramp, first period and last ramp; only the period without ramps."""
        full = (self.ramp, self.ramp + self.series.period)
        if self.ramp == 0.0:
            return (full,)
        return ((0.0, self.ramp), full, (self.duration - self.ramp, self.duration))

    @property
    def crackle(self) -> Array:
        """Return a bound of the fifth derivative of ramp times series [rad/s^5 or m/s^5], shape (joints,)."""
        rates = 2.0 * np.pi * self.series.base_frequency * np.arange(1, self.series.a.shape[1] + 1)
        sizes = np.hypot(self.series.a, self.series.b) / rates
        swing = [(sizes * rates**order).sum(axis=1) for order in range(6)]
        if self.ramp == 0.0:
            return np.asarray(swing[5])
        window = [peak / self.ramp**order for order, peak in enumerate(STEP_PEAKS)]
        return np.asarray(sum(comb(5, k) * window[k] * swing[5 - k] for k in range(6)))

    @property
    def seams(self) -> Array:
        """Return the times at which ramps begin and end [s], increasing."""
        ends = [0.0, self.ramp, self.duration - self.ramp, self.duration]
        return np.array(sorted(set(ends)))

    def highest_frequency(self, begin: float, end: float) -> float:
        """Return the highest harmonic's frequency [Hz]; in a ramp, the reciprocal ramp time where that is higher."""
        highest = self.series.base_frequency * self.series.a.shape[1]
        in_ramp = self.ramp > 0.0 and (begin < self.ramp or end > self.duration - self.ramp)
        return float(max(highest, 1.0 / self.ramp) if in_ramp else highest)

    def derivatives(self, time: Array, highest_order: int) -> list[Array]:
        """Return position and its time derivatives up to the order `highest_order`, each of shape (samples, joints)."""
        swing = self.series.derivatives(time - self.ramp, highest_order)
        if self.ramp == 0.0:
            return swing
        swing[0] = swing[0] - self.series.q0
        window = self._window(time, highest_order)
        values = [
            np.asarray(sum(comb(order, k) * window[k][..., None] * swing[order - k] for k in range(order + 1)))
            for order in range(highest_order + 1)
        ]
        values[0] = values[0] + self.series.q0
        return values

    def _window(self, t: Array, highest: int) -> list[Array]:
        """Return the window and its derivatives."""
        rising, falling = t / self.ramp, (self.duration - t) / self.ramp
        nearer = np.minimum(rising, falling)
        inside = (nearer > 0.0) & (nearer < 1.0)
        nearer = np.clip(nearer, 0.0, 1.0)
        rate = np.where(rising <= falling, 1.0, -1.0) / self.ramp
        # Only the fourth derivative does not vanish at the ends; outside the ramps it is zero all the same.
        return [
            np.asarray(_STEP_DERIVATIVES[order](nearer) * (rate**order * (inside if order else 1.0)))
            for order in range(highest + 1)
        ]


@dataclass(frozen=True)
class PosturePath(_Sampled):
    """Straight segments in joint space from posture to posture, at rest at each.

    Attributes:
        points: postures in the order they are visited [rad or m], shape (postures, joints).
        times: durations of the segments [s], shape (postures - 1,).
        dwell: time that the arm stands at each posture [s].
    """

    points: Array
    times: Array
    dwell: float
    _begins: Array = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        ways = max(len(self.points) - 1, 0)
        if self.points.ndim != 2 or not ways or self.times.shape != (ways,) or not (self.times > 0.0).all():
            raise ModelError(f"{self.points.shape=} and {self.times.shape=} do not belong to one motion")
        if not 0.0 <= self.dwell < float("inf"):
            raise ModelError(f"{self.dwell=} is no time")
        begins = self.dwell + np.concatenate([[0.0], np.cumsum(self.times + self.dwell)])
        object.__setattr__(self, "_begins", begins)
        for array in (self.points, self.times, begins):
            array.setflags(write=False)

    @property
    def joints(self) -> int:
        """Return the number of joints."""
        return int(self.points.shape[1])

    @property
    def duration(self) -> float:
        """Return the length of the whole motion [s]."""
        return float(self._begins[-1])

    @property
    def distinct(self) -> tuple[tuple[float, float], ...]:
        """Return the whole motion as one stretch, ((0, duration),) [s]."""
        return ((0.0, self.duration),)

    @property
    def crackle(self) -> Array:
        """Return a bound of the fifth derivative, that of the steepest segment [rad/s^5 or m/s^5], shape (joints,)."""
        ways = np.abs(np.diff(self.points, axis=0))
        return np.asarray((ways * STEP_PEAKS[5] / self.times[:, None] ** 5).max(axis=0))

    @property
    def seams(self) -> Array:
        """Return the times at which segments begin and end [s]."""
        return np.unique(np.concatenate([[0.0], self._begins[:-1], self._begins[:-1] + self.times, [self.duration]]))

    def highest_frequency(self, begin: float, end: float) -> float:
        """Return the reciprocal duration of the shortest of all segments [Hz], whatever the two times are."""
        return float(1.0 / self.times.min())

    def derivatives(self, time: Array, highest_order: int) -> list[Array]:
        """Return position and its time derivatives up to the order `highest_order`, each of shape (samples, joints)."""
        way = np.clip(np.searchsorted(self._begins, time, side="right") - 1, 0, len(self.times) - 1)
        length = self.times[way]
        share = (time - self._begins[way]) / length
        inside = (share > 0.0) & (share < 1.0)
        share = np.clip(share, 0.0, 1.0)
        whole = self.points[way + 1] - self.points[way]
        values = [
            np.asarray(
                (_STEP_DERIVATIVES[order](share) / length**order * (inside if order else 1.0))[..., None] * whole
            )
            for order in range(highest_order + 1)
        ]
        values[0] = values[0] + self.points[way]
        return values


class Basis(Protocol):
    """Family of motions, linear in its coefficients."""

    @property
    def size(self) -> int:
        """Return the number of coefficients per joint."""

    @property
    def moving(self) -> NDArray[np.bool_]:
        """Return a mask over one joint's coefficients, False for those that only set its place, shape (size,)."""

    def path(self, coefficients: Array) -> FourierPath | PosturePath:
        """Return the motion with coefficients of shape (joints, size)."""

    def standing(self, posture: Array) -> Array:
        """Return the coefficients of standing still at a posture of shape (joints,), shape (joints, size)."""

    def standing_at_middle(self, coefficients: Array) -> Array:
        """Return the coefficients of standing still at q0, or at the mean of the postures, shape (joints, size)."""

    def samples(self, samples_per_period: int) -> tuple[Array, Array]:
        """Return times [s] at which to check limits, and the time that each counts for in the information [s]."""


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
        """Return a mask over one joint's coefficients, False for its middle position alone, shape (size,)."""
        return np.arange(self.size) < 2 * self.harmonics

    def path(self, coefficients: Array) -> FourierPath:
        """Return the motion with coefficients of shape (joints, size)."""
        n = self.harmonics
        a, b, q0 = coefficients[:, :n].copy(), coefficients[:, n : 2 * n].copy(), coefficients[:, -1].copy()
        return FourierPath(FourierSeries(self.base_frequency, a, b, q0), self.periods, self.ramp)

    def standing(self, posture: Array) -> Array:
        """Return the coefficients of standing still at a posture of shape (joints,), shape (joints, size)."""
        return np.column_stack([np.zeros((len(posture), 2 * self.harmonics)), posture])

    def standing_at_middle(self, coefficients: Array) -> Array:
        """Return the coefficients of standing still at the series' constant q0, shape (joints, size)."""
        return self.standing(coefficients[:, -1])

    def samples(self, samples_per_period: int) -> tuple[Array, Array]:
        """Return times [s] in one period and both ramps, and weights [s]: all periods' in the period, 0 in ramps."""
        period = 1.0 / self.base_frequency
        step = period / samples_per_period
        times = np.asarray(self.ramp + step * np.arange(samples_per_period))
        weights = np.full(samples_per_period, step * self.periods, dtype=float)
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
        """Return a mask that is True for all coefficients, each of which is a posture; shape (size,)."""
        return np.ones(self.postures, dtype=bool)

    def path(self, coefficients: Array) -> PosturePath:
        """Return the motion through the postures and back, of coefficients of shape (joints, postures)."""
        order = [*range(self.postures), *range(self.postures - 2, -1, -1)]
        return PosturePath(coefficients.T[order].copy(), np.array(self.times), self.dwell)

    def standing(self, posture: Array) -> Array:
        """Return the coefficients of standing still at a posture of shape (joints,), shape (joints, postures)."""
        return np.repeat(posture[:, None], self.postures, axis=1)

    def standing_at_middle(self, coefficients: Array) -> Array:
        """Return the coefficients of standing still at a motion's mean posture, shape (joints, postures)."""
        return self.standing(coefficients.mean(axis=1))

    def samples(self, samples_per_period: int) -> tuple[Array, Array]:
        """Return `samples_per_period` times [s] over the whole motion, with equal weights [s]."""
        duration = self.dwell * (len(self.times) + 1) + sum(self.times)
        step = duration / samples_per_period
        return np.asarray(step * (np.arange(samples_per_period) + 0.5)), np.full(samples_per_period, step, dtype=float)


def basis_values(basis: Basis, times: Array) -> tuple[Array, Array, Array, Array]:
    """Return the values of all basis functions and of their first three derivatives, each of shape (samples, size)."""
    return basis.path(np.eye(basis.size)).at(times)
