"""Build equations of one motion for many friction shapes, without reading or smoothing the recording again.

A shape changes two columns per drive: the direction of its Coulomb friction and that direction times the Stribeck
curve. All others, and the torque, are kept as a table X with products `X^T X`, per joint and third of the samples.
Equations with new columns F then have the products `[[X^T X, X^T F], [F^T X, F^T F]]`.

The direction at a sample needs no look at the samples before it: between two reversals it is an exponential in the
distance travelled since (`model/coulomb_direction.py`), so the distances of reversals and of samples are all that is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ident_service.config.schema import JointTerm
from ident_service.errors import RecordingError
from ident_service.estimation.equations import Equations, Rows, equation_rows
from ident_service.estimation.moments import Moments
from ident_service.estimation.smoothing import windows
from ident_service.model.arm_model import ArmModel
from ident_service.model.base import BaseParameters
from ident_service.model.chain import Array
from ident_service.model.information import Information, supports, triangle
from ident_service.model.threads import one_blas_thread
from ident_service.model.zero_phase import low_pass
from ident_service.recordings.recording import Recording

FOLDS = 3
_MOST_ROWS = 30_000  # samples that are kept; of longer recordings every second, every fourth ...
_CHANGING: tuple[JointTerm, ...] = ("coulomb", "stribeck")
_GAP = 1.5  # periods; a longer step is a gap


@dataclass
class _Travel:
    """Distances that one drive travels: between its reversals, and of each kept sample since the last reversal.

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
        """Add the velocities of consecutive samples; `wanted` are those that are kept."""
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
        """Return the direction of Coulomb friction at the kept samples, shape (samples,), as `direction.direction`."""
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
            recordings: to read, each twice; rows are kept, those of long recordings thinned.
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
        rates, keeps, slopes, self._filters = [], [], [], []
        tables: list[list[Array]] = [[] for _ in range(joints)]
        moved = np.zeros(joints, dtype=bool)
        for recording in recordings:
            part = _thinned_rows(recording, model, base, kept)
            self._follow(recording, model, part.time, part.rate)
            self._filters.append(_filter(model, part.time))
            rates.append(part.rate)
            keeps.append(part.keep)
            slopes.append(part.slopes)
            moved |= part.moved
            for table, more in zip(tables, part.tables, strict=True):
                table.append(more)
        self._rate, self._slopes = np.concatenate(rates), np.concatenate(slopes)
        self._keep: NDArray[np.bool_] = np.concatenate(keeps)
        self._lengths = [len(rate) for rate in rates]
        self._rows = len(self._rate)
        self._joints = range(joints)
        self._tables = [np.concatenate(table) for table in tables]
        self.thirds = [slice(self._rows * k // FOLDS, self._rows * (k + 1) // FOLDS) for k in range(FOLDS)]
        self._products: dict[tuple[int, int, int], Array] = {}
        self._places = [self._places_of(joint) for joint in self._joints]
        if still := [name for joint, name in enumerate(model.chain.names) if not moved[joint]]:
            raise RecordingError(
                recordings[0].path,
                f"{', '.join(still)}: never faster than identification.reversal.speed, nothing to identify from",
            )

    @property
    def joints(self) -> int:
        """Return the number of joints."""
        return len(self._tables)

    def _follow(self, recording: Recording, model: ArmModel, time: Array, rate: Array) -> None:
        for drive, travel in enumerate(self._travels):
            if model.config.identification.period is not None:
                # One pass over the period first, for the friction direction that it begins with.
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
    def moments(
        self, presliding: Array, stribeck_velocity: Array, parts: Sequence[slice] | None = None
    ) -> list[Moments]:
        """Return the products of the equations for one shape of the friction.

        Args:
            presliding: x0 per drive [rad or m], shape (drives,).
            stribeck_velocity: v_s per drive [rad/s or m/s], shape (drives,).
            parts: of the samples, one result each, such as `thirds`; all together when None.
        """
        used = self._friction(presliding, stribeck_velocity)
        wanted = [slice(0, self._rows)] if parts is None else list(parts)
        found: list[list[Array]] = [[] for _ in wanted]
        for joint, table in enumerate(self._tables):
            fixed, new, places = self._places[joint]
            size = len(self._supports[joint]) + 1
            F = self._new_columns(new, used)
            for products, part in zip(found, wanted, strict=True):
                product = np.empty((size, size))
                product[fixed[:, None], fixed] = self._kept_products(joint, part)
                if new:
                    across = table[part].T @ F[part]
                    product[fixed[:, None], places] = across
                    product[places[:, None], fixed] = across.T
                    product[places[:, None], places] = F[part].T @ F[part]
                products.append(product)
        counts = [part.stop - part.start for part in wanted]
        return [
            Moments(self._supports, tuple(products), np.full(self.joints, count), self._size)
            for products, count in zip(found, counts, strict=True)
        ]

    def _kept_products(self, joint: int, part: slice) -> Array:
        """Return X^T X of a joint's kept columns and torque, computed once for each part."""
        key = (joint, part.start, part.stop)
        if key not in self._products:
            rows = self._tables[joint][part]
            self._products[key] = rows.T @ rows
        return self._products[key]

    @one_blas_thread()
    def equations(self, presliding: Array, stribeck_velocity: Array) -> Equations:
        """Return the equations for one shape of the friction, in `FOLDS` blocks, rows near standstill apart.

        Args:
            presliding: x0 per drive [rad or m], shape (drives,).
            stribeck_velocity: v_s per drive [rad/s or m/s], shape (drives,).
        """
        used = self._friction(presliding, stribeck_velocity)
        blocks: list[Information] = []
        near: list[Information] = []
        for third in self.thirds:
            for found, which in ((blocks, self._keep[third]), (near, ~self._keep[third])):
                factors = [triangle(self._rows_of(joint, used, third)[which[:, joint]]) for joint in self._joints]
                found.append(Information(self._supports, tuple(factors), np.sum(which, axis=0), self._size))
        return Equations(tuple(blocks), self._rows, tuple(near))

    @one_blas_thread()
    def later_torques(self, stribeck_velocity: Array) -> Callable[[float], tuple[Information, ...]]:
        """Return a function of the torque's delay [s] that returns the rows in motion, per third.

        The torque between its samples is that of its first two derivatives: good for delays that are short beside the
        period of the filter's cut-off. Where a joint turns round friction looks like a delay; those rows are left out.

        Args:
            stribeck_velocity: v_s per drive [rad/s or m/s], shape (drives,).
        """
        used = self._friction(np.zeros(len(self._travels)), stribeck_velocity)
        counts = [np.sum(self._keep[third], axis=0) for third in self.thirds]
        factors = [
            [
                triangle(
                    np.column_stack([self._rows_of(joint, used, third), self._slopes[third, :, joint]])[
                        self._keep[third, joint]
                    ]
                )
                for joint in self._joints
            ]
            for third in self.thirds
        ]

        def shifted(factor: Array, seconds: float) -> Array:
            columns = factor[:, :-2].copy()
            columns[:, -1] += seconds * factor[:, -2] + 0.5 * seconds**2 * factor[:, -1]
            return triangle(columns)

        def of(seconds: float) -> tuple[Information, ...]:
            return tuple(
                Information(self._supports, tuple(shifted(one, seconds) for one in part), count.copy(), self._size)
                for part, count in zip(factors, counts, strict=True)
            )

        return of

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

    def _places_of(self, joint: int) -> tuple[NDArray[np.intp], list[tuple[JointTerm, int, float]], NDArray[np.intp]]:
        """Return places of the kept columns and torque in a joint's rows, the new columns, and their places."""
        support = self._supports[joint]
        fixed = np.append(np.searchsorted(support, self._kept_columns[joint]), len(support))
        new, places = [], []
        for term, columns in self._columns.items():
            for drive, column in enumerate(columns):
                if share := float(self._coupling[drive, joint]):
                    new.append((term, drive, share))
                    places.append(int(np.searchsorted(support, column)))
        return fixed, new, np.array(places, dtype=np.intp)

    def _rows_of(self, joint: int, used: dict[JointTerm, Array], part: slice) -> Array:
        """Return a joint's columns and its torque as the last, shape (rows, k + 1)."""
        fixed, new, places = self._places[joint]
        rows = np.empty((part.stop - part.start, len(self._supports[joint]) + 1), order="F")
        rows[:, fixed] = self._tables[joint][part]
        if new:
            rows[:, places] = self._new_columns(new, used)[part]
        return rows

    def _new_columns(self, new: Sequence[tuple[JointTerm, int, float]], used: dict[JointTerm, Array]) -> Array:
        columns = [share * used[term][:, drive] for term, drive, share in new]
        return np.column_stack(columns) if columns else np.zeros((self._rows, 0))


def _full_rate(recording: Recording, model: ArmModel) -> Iterator[tuple[Array, Array]]:
    """Yield times [s] and drive velocities of all samples, also at the edges of stretches, in consecutive parts."""
    options, last = model.config.identification, -np.inf
    for window in windows(recording, options, model.chain.coupling, model.config.recording):
        low, high, _ = window.inner.indices(len(window.motion.time))
        time = window.motion.time
        begin = 0 if low == 0 or time[low - 1] - last > _GAP * (time[low] - time[low - 1]) else low
        last = time[high - 1]
        yield time[begin:high], window.motion.velocity[begin:high] @ model.chain.coupling.T


def _thinned_rows(
    recording: Recording, model: ArmModel, base: BaseParameters, columns: Sequence[Sequence[int]]
) -> _Part:
    """Read a recording's rows; a joint's table has its columns with the torque as the last."""
    parts: list[_Part] = []
    every, count, seen = 1, 0, 0
    for rows in equation_rows(recording, model, base):
        picked = np.arange((-seen) % every, len(rows.time), every)
        seen += len(rows.time)
        parts.append(_part(rows, picked, columns, model))
        count += len(picked)
        if count > 2 * _MOST_ROWS:
            parts = [_joined(parts, 2)]
            every, count = 2 * every, len(parts[0].time)
    return _joined(parts, 1)


@dataclass(frozen=True)
class _Part:
    """Thinned rows: times [s], drive velocities, rows in motion, the torque's two derivatives, tables per joint."""

    time: Array
    rate: Array
    keep: NDArray[np.bool_]
    slopes: Array
    moved: NDArray[np.bool_]
    tables: list[Array]


def _part(rows: Rows, picked: NDArray[np.intp], columns: Sequence[Sequence[int]], model: ArmModel) -> _Part:
    tables = [
        np.column_stack([rows.H_b[joint][np.array(own)[:, None], picked].T, rows.torque[picked, joint]])
        for joint, own in enumerate(columns)
    ]
    slopes = np.zeros((len(rows.time), 2, rows.torque.shape[1]))
    if len(rows.time) > 2:
        slopes[:, 0] = np.gradient(rows.torque, rows.time, axis=0)
        slopes[:, 1] = np.gradient(slopes[:, 0], rows.time, axis=0)
    moved: NDArray[np.bool_] = np.logical_or.reduce(rows.moving)
    rate = rows.velocity[picked] @ model.chain.coupling.T
    return _Part(rows.time[picked], rate, rows.keep[picked], slopes[picked], moved, tables)


def _joined(parts: Sequence[_Part], every: int) -> _Part:
    def whole(arrays: Iterable[Array]) -> Array:
        return np.concatenate(list(arrays))[::every]

    return _Part(
        whole(part.time for part in parts),
        whole(part.rate for part in parts),
        np.concatenate([part.keep for part in parts])[::every],
        whole(part.slopes for part in parts),
        np.logical_or.reduce([part.moved for part in parts]),
        [whole(joint) for joint in zip(*(part.tables for part in parts), strict=True)],
    )


def _filter(model: ArmModel, time: Array) -> tuple[int, float, float] | None:
    """Return order, cut-off and rate [Hz] of the low-pass on both sides of the equations; None where there is none."""
    smoothing = model.config.identification.smoothing
    if smoothing.regressor_cutoff is None or len(time) < 2:
        return None
    rate = 1.0 / float(np.median(np.diff(time)))
    long_enough = len(time) > 6 * (smoothing.order + 1)
    if not long_enough or smoothing.regressor_cutoff >= 0.5 * rate:
        return None
    return smoothing.order, smoothing.regressor_cutoff, rate
