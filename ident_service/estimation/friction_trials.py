"""Equations of the same motion for many shapes of its friction, without reading or smoothing anything again.

A shape changes two columns per drive: the direction of its Coulomb friction and that direction times the Stribeck
curve. All others, and the torque, are kept as a table X with their products `X^T X`, per joint and third of the samples.
Equations with new columns F then have the products `[[X^T X, X^T F], [F^T X, F^T F]]`: their residuals are as good as
from orthogonal factors, as only trials are compared by them.

The direction at a sample needs no look at the samples before it: between two reversals it is an exponential in the
distance travelled since (`direction.py`), so the distances of reversals and of samples are all that is kept.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ident_service.config.schema import JointTerm
from ident_service.errors import RecordingError
from ident_service.estimation.equations import Equations, Rows, equation_rows
from ident_service.estimation.smoothing import windows
from ident_service.model.arm_model import ArmModel
from ident_service.model.base import BaseParameters
from ident_service.model.chain import Array
from ident_service.model.information import Information, supports, triangle
from ident_service.model.threads import one_blas_thread
from ident_service.model.zero_phase import low_pass
from ident_service.record.recording import Recording

FOLDS = 3
_MOST_ROWS = 30_000  # samples that are kept; of longer recordings every second, every fourth ...
_CHANGING: tuple[JointTerm, ...] = ("coulomb", "stribeck")
_GAP = 1.5  # periods: what is longer is no step between neighbours
_LEAST_COLUMN = 1e-14  # of the longest
_RIDGE = 1e-12  # of a column's squared length: columns that are alike share what they explain
_SETTLED = 1e-6  # of a weight
_MOST_ROUNDS = 100


@dataclass(frozen=True)
class Moments:
    """Products of the equations' columns, from which least squares can be solved.

    Attributes:
        supports: per joint, which base parameters it feels, increasing.
        products: per joint, `[H_b | tau]^T [H_b | tau]` of its support, shape (k + 1, k + 1).
        rows: equations of each joint, shape (joints,).
        base: number of base parameters.
    """

    supports: tuple[NDArray[np.intp], ...]
    products: tuple[Array, ...]
    rows: NDArray[np.int64]
    base: int

    @staticmethod
    def sum(parts: Sequence[Moments]) -> Moments:
        """All parts together."""
        products = tuple(sum(of[1:], of[0]) for of in zip(*(part.products for part in parts), strict=True))
        return Moments(parts[0].supports, products, np.sum([part.rows for part in parts], axis=0), parts[0].base)

    def solved(self, weights: Array) -> Array:
        """Minimise the squared residuals, each joint's equations multiplied by its weight; shape (base,)."""
        total = np.zeros((self.base, self.base))
        right = np.zeros(self.base)
        for support, product, weight in zip(self.supports, self.products, weights, strict=True):
            total[np.ix_(support, support)] += weight**2 * product[:-1, :-1]
            right[support] += weight**2 * product[:-1, -1]
        return ridge(total, right)

    def weights(self) -> Array:
        """Give what the joints' equations are multiplied by so that their residuals are alike, shape (joints,)."""
        torques = np.array([product[-1, -1] for product in self.products])
        floor = 1e-9 * np.sqrt(torques / np.maximum(self.rows, 1))
        weights = np.ones(len(self.products))
        for _ in range(_MOST_ROUNDS):
            left = np.sqrt(self.squared_residuals(self.solved(weights)) / np.maximum(self.rows, 1))
            deviations = np.maximum(left, np.maximum(floor, np.finfo(float).tiny))
            before, weights = weights, np.exp(np.mean(np.log(deviations))) / deviations
            if np.all(np.abs(weights - before) <= _SETTLED * weights):
                break
        return weights

    def squared_residuals(self, beta: Array) -> Array:
        """Per joint, the sum of squared torque errors of `beta` [N^2 m^2 or N^2], shape (joints,)."""
        tried = [np.append(-beta[support], 1.0) for support in self.supports]
        found = [one @ product @ one for one, product in zip(tried, self.products, strict=True)]
        return np.maximum(found, 0.0)


def ridge(products: Array, right: Array) -> Array:
    """Solve normal equations of columns that may be alike, or unseen: those get no more than they need."""
    sizes = np.diag(products)
    seen = sizes > _LEAST_COLUMN**2 * sizes.max(initial=0.0)
    unit = np.sqrt(np.where(seen, sizes, 1.0))
    scaled = np.where(np.outer(seen, seen), products, 0.0) / np.outer(unit, unit) + _RIDGE * np.eye(len(unit))
    return np.asarray(np.linalg.solve(scaled + np.diag(~seen * 1.0), np.where(seen, right, 0.0) / unit) / unit)


@dataclass
class _Travel:
    """How one drive moved: distances between its reversals, and each kept sample's since the last.

    Attributes:
        signs: of the motion that each reversal begins, the first one included.
        distances: travelled until the next reversal [rad or m].
        segments: per kept sample, the reversal before it.
        since: per kept sample, the distance travelled since then [rad or m].
        fresh: reversals that begin a stretch, where nothing is known of the motion before.
    """

    signs: list[float] = field(default_factory=list)
    distances: list[float] = field(default_factory=list)
    segments: list[NDArray[np.intp]] = field(default_factory=list)
    since: list[Array] = field(default_factory=list)
    fresh: set[int] = field(default_factory=set)

    def follow(self, rate: Array, period: float, wanted: NDArray[np.intp], fresh: bool) -> None:
        """Travel on with the velocities of consecutive samples; `wanted` are those that are kept."""
        signs = np.sign(rate)
        moving = np.flatnonzero(signs)
        if fresh or not self.signs:
            self.fresh.add(len(self.signs))
            self.signs.append(float(signs[moving[0]]) if len(moving) else 1.0)
            self.distances.append(0.0)
        # Where the velocity is exactly zero nothing is travelled, and the last sign may stand.
        last = np.maximum.accumulate(np.where(signs != 0.0, np.arange(len(signs)), -1))
        held = np.where(last >= 0, signs[np.maximum(last, 0)], self.signs[-1])
        travelled = np.cumsum(np.abs(rate)) * period
        begins = np.flatnonzero(np.diff(held, prepend=self.signs[-1]))
        reached = np.concatenate([[0.0], travelled[begins - 1] * (begins > 0)])
        ends = np.concatenate([reached[1:], travelled[-1:]])
        number = np.searchsorted(begins, wanted, side="right")
        first = len(self.signs) - 1
        self.segments.append(first + number)
        self.since.append(travelled[wanted] - reached[number] + np.where(number == 0, self.distances[-1], 0.0))
        self.distances[-1] += float(ends[0] - reached[0])
        self.signs += held[begins].tolist()
        self.distances += (ends[1:] - reached[1:]).tolist()

    def direction(self, presliding: float) -> Array:
        """Direction of Coulomb friction at the kept samples, shape (samples,), as `direction.direction` has it."""
        segments, signs = np.concatenate(self.segments), np.array(self.signs)
        if presliding <= 0.0:
            return signs[segments]
        left = np.exp(-np.array(self.distances) / presliding).tolist()
        states, state = [], 0.0
        for number, (sign, share) in enumerate(zip(self.signs, left, strict=True)):
            state = sign if number in self.fresh else state
            states.append(state)
            state = sign + (state - sign) * share
        held = signs[segments]
        return np.asarray(held + (np.array(states)[segments] - held) * np.exp(-np.concatenate(self.since) / presliding))


class FrictionTrials:
    """Keep recordings as equations whose pre-sliding and Stribeck velocities can be exchanged."""

    @one_blas_thread()
    def __init__(self, recordings: Sequence[Recording], model: ArmModel, base: BaseParameters) -> None:
        """Read the recordings.

        Args:
            recordings: to read, each twice.
            model: the arm; its configuration says how to smooth.
            base: grouping of its parameters.

        Raises:
            RecordingError: a recording cannot be used, or no joint moves enough to give an equation.
        """
        self._coupling, joints = model.chain.coupling, model.chain.joints
        self._supports = supports(model.chain, model.layout, base.base)
        self._size = base.size
        # Per term, the base column of each drive.
        place = {int(column): number for number, column in enumerate(base.base)}
        self._columns: dict[JointTerm, list[int]] = {
            term: [place[int(column)] for column in model.layout.term_columns(term)]
            for term in _CHANGING
            if term in model.layout.terms
        }
        changing = {column for columns in self._columns.values() for column in columns}
        kept = [[column for column in support if int(column) not in changing] for support in self._supports]
        self._kept_columns = kept
        self._travels = [_Travel() for _ in range(joints)]
        rates, self._filters = [], []
        tables: list[list[Array]] = [[] for _ in range(joints)]
        moved = np.zeros(joints, dtype=bool)
        for recording in recordings:
            time, rate, moving, columns = _thinned_rows(recording, model, base, kept)
            self._follow(recording, model, time, rate)
            self._filters.append(_filter(model, time))
            rates.append(rate)
            moved |= moving
            for table, more in zip(tables, columns, strict=True):
                table.append(more)
        self._rate = np.concatenate(rates)
        self._lengths = [len(rate) for rate in rates]
        self._rows = len(self._rate)
        self._tables = [np.concatenate(table) for table in tables]
        self._thirds = [slice(int(part[0]), int(part[-1]) + 1) for part in np.array_split(np.arange(self._rows), FOLDS)]
        self._products = [[table[third].T @ table[third] for table in self._tables] for third in self._thirds]
        if still := [name for joint, name in enumerate(model.chain.names) if not moved[joint]]:
            raise RecordingError(
                recordings[0].path,
                f"{', '.join(still)}: never faster than identification.reversal.speed, nothing to identify from",
            )

    def _follow(self, recording: Recording, model: ArmModel, time: Array, rate: Array) -> None:
        for drive, travel in enumerate(self._travels):
            if model.config.identification.period is not None:
                # Once round to know the direction that the period begins with.
                step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
                travel.follow(rate[:, drive], step, np.zeros(0, dtype=np.intp), fresh=True)
                travel.follow(rate[:, drive], step, np.arange(len(time)), fresh=False)
        if model.config.identification.period is not None:
            return
        last = -np.inf
        for times, rates in _full_rate(recording, model):
            period = float(np.median(np.diff(times)))
            fresh = times[0] - last > _GAP * period
            first, end = np.searchsorted(time, [times[0] - 0.5 * period, times[-1] + 0.5 * period])
            wanted = np.minimum(np.searchsorted(times, time[first:end] - 0.5 * period), len(times) - 1)
            for drive, travel in enumerate(self._travels):
                travel.follow(rates[:, drive], period, wanted, fresh)
            last = times[-1]

    @one_blas_thread()
    def moments(self, presliding: Array, stribeck_velocity: Array) -> tuple[Moments, ...]:
        """Give the products of the equations for one shape of the friction, of each third of the samples.

        Args:
            presliding: x0 per drive [rad or m], shape (drives,).
            stribeck_velocity: v_s per drive [rad/s or m/s], shape (drives,).
        """
        used = self._friction(presliding, stribeck_velocity)
        found: list[list[Array]] = [[] for _ in self._thirds]
        for joint, table in enumerate(self._tables):
            fixed, new, places = self._places(joint)
            F = self._new_columns(new, used)
            size = len(self._supports[joint]) + 1
            for parts, kept, third in zip(found, self._products, self._thirds, strict=True):
                product = np.empty((size, size))
                product[np.ix_(fixed, fixed)] = kept[joint]
                if new:
                    across = table[third].T @ F[third]
                    product[np.ix_(fixed, places)] = across
                    product[np.ix_(places, fixed)] = across.T
                    product[np.ix_(places, places)] = F[third].T @ F[third]
                parts.append(product)
        joints = len(self._tables)
        return tuple(
            Moments(self._supports, tuple(parts), np.full(joints, third.stop - third.start), self._size)
            for parts, third in zip(found, self._thirds, strict=True)
        )

    @one_blas_thread()
    def equations(self, presliding: Array, stribeck_velocity: Array) -> Equations:
        """Give the equations for one shape of the friction, in `FOLDS` blocks of consecutive samples.

        Args:
            presliding: x0 per drive [rad or m], shape (drives,).
            stribeck_velocity: v_s per drive [rad/s or m/s], shape (drives,).
        """
        used = self._friction(presliding, stribeck_velocity)
        factors: list[list[Array]] = [[] for _ in self._thirds]
        for joint, table in enumerate(self._tables):
            fixed, new, places = self._places(joint)
            rows = np.empty((len(table), len(self._supports[joint]) + 1), order="F")
            rows[:, fixed] = table
            if new:
                rows[:, places] = self._new_columns(new, used)
            for parts, third in zip(factors, self._thirds, strict=True):
                parts.append(triangle(rows[third]))
        joints = len(self._tables)
        blocks = tuple(
            Information(self._supports, tuple(parts), np.full(joints, third.stop - third.start), self._size)
            for parts, third in zip(factors, self._thirds, strict=True)
        )
        return Equations(blocks, self._rows)

    def _friction(self, presliding: Array, stribeck_velocity: Array) -> dict[JointTerm, Array]:
        direction = np.column_stack(
            [travel.direction(float(x0)) for travel, x0 in zip(self._travels, presliding, strict=True)]
        )
        values: dict[JointTerm, Array] = {
            "coulomb": direction,
            "stribeck": direction * np.exp(-((self._rate / stribeck_velocity) ** 2)),
        }
        return {term: self._filtered(values[term]) for term in self._columns}

    def _filtered(self, values: Array) -> Array:
        if not any(self._filters):
            return values
        parts = np.split(values, np.cumsum(self._lengths)[:-1])
        return np.concatenate(
            [low_pass(part, *made) if made else part for part, made in zip(parts, self._filters, strict=True)]
        )

    def _places(self, joint: int) -> tuple[NDArray[np.intp], list[tuple[JointTerm, int, float]], list[int]]:
        """Say where in a joint's rows the kept columns and the torque stand, which are new, and where those stand."""
        support = self._supports[joint]
        fixed = np.append(np.searchsorted(support, self._kept_columns[joint]), len(support))
        new, places = [], []
        for term, columns in self._columns.items():
            for drive, column in enumerate(columns):
                if share := float(self._coupling[drive, joint]):
                    new.append((term, drive, share))
                    places.append(int(np.searchsorted(support, column)))
        return fixed, new, places

    def _new_columns(self, new: Sequence[tuple[JointTerm, int, float]], used: dict[JointTerm, Array]) -> Array:
        columns = [share * used[term][:, drive] for term, drive, share in new]
        return np.column_stack(columns) if columns else np.zeros((self._rows, 0))


def _full_rate(recording: Recording, model: ArmModel) -> Iterator[tuple[Array, Array]]:
    """Times [s] and drive velocities of all samples, also at the edges of stretches, in consecutive parts."""
    options, last = model.config.identification, -np.inf
    for window in windows(recording, options, model.chain.coupling, model.config.recording):
        low, high, _ = window.inner.indices(len(window.motion.time))
        time = window.motion.time
        begin = 0 if low == 0 or time[low - 1] - last > _GAP * (time[low] - time[low - 1]) else low
        last = time[high - 1]
        yield time[begin:high], window.motion.velocity[begin:high] @ model.chain.coupling.T


def _thinned_rows(
    recording: Recording, model: ArmModel, base: BaseParameters, columns: Sequence[Sequence[int]]
) -> tuple[Array, Array, NDArray[np.bool_], list[Array]]:
    """Give times [s], drive velocities, which joints move, and per joint its columns with the torque as the last."""
    parts: list[_Part] = []
    every, count, seen = 1, 0, 0
    for rows in equation_rows(recording, model, base):
        picked = np.arange((-seen) % every, len(rows.time), every)
        seen += len(rows.time)
        parts.append(_part(rows, picked, columns, model))
        count += len(picked)
        if count > 2 * _MOST_ROWS:
            parts = [_joined(parts, 2)]
            every, count = 2 * every, len(parts[0][0])
    return _joined(parts, 1)


_Part = tuple[Array, Array, NDArray[np.bool_], list[Array]]


def _part(rows: Rows, picked: NDArray[np.intp], columns: Sequence[Sequence[int]], model: ArmModel) -> _Part:
    tables = [
        np.column_stack([rows.H_b[joint][np.array(own)[:, None], picked].T, rows.torque[picked, joint]])
        for joint, own in enumerate(columns)
    ]
    moved: NDArray[np.bool_] = np.logical_or.reduce(rows.moving)
    return rows.time[picked], rows.velocity[picked] @ model.chain.coupling.T, moved, tables


def _joined(parts: Sequence[_Part], every: int) -> _Part:
    time, rate, moving, tables = zip(*parts, strict=True)
    moved: NDArray[np.bool_] = np.logical_or.reduce(moving)
    return (
        np.concatenate(time)[::every],
        np.concatenate(rate)[::every],
        moved,
        [np.concatenate(joint)[::every] for joint in zip(*tables, strict=True)],
    )


def _filter(model: ArmModel, time: Array) -> tuple[int, float, float] | None:
    """Order, cut-off and rate [Hz] of the low-pass on both sides of the equations, where there is one that matters."""
    smoothing = model.config.identification.smoothing
    if smoothing.regressor_cutoff is None or len(time) < 2:
        return None
    rate = 1.0 / float(np.median(np.diff(time)))
    long_enough = len(time) > 6 * (smoothing.order + 1)
    if not long_enough or smoothing.regressor_cutoff >= 0.5 * rate:
        return None
    return smoothing.order, smoothing.regressor_cutoff, rate
