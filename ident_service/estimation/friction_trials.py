"""Equations of the same motion for many shapes of its friction, without reading or smoothing anything again.

A shape changes two columns per drive: the direction of its Coulomb friction and that direction times the Stribeck
curve. All others, and the torque, are kept as an orthogonal basis Q and their triangle R, per joint and third of the
samples. Equations with new columns F then have the factor `[[R, Q^T F], [0, R_F]]` with R_F of `F - Q Q^T F`.

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


@dataclass(frozen=True)
class _Kept:
    """Columns that no trial changes, of one joint in one third of the samples.

    Attributes:
        samples: which kept samples its rows are, shape (rows,).
        Q: orthonormal basis of the columns and the torque, shape (rows, k).
        R: `[columns | torque] = Q R`, shape (k, columns + 1).
    """

    samples: NDArray[np.intp]
    Q: Array
    R: Array


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
        self._parts = []
        for third in np.array_split(np.arange(self._rows), FOLDS):
            part = []
            for joint in range(joints):
                Q, R = np.linalg.qr(np.concatenate(tables[joint])[third])
                part.append(_Kept(third, Q, R))
            self._parts.append(part)
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
    def equations(self, presliding: Array, stribeck_velocity: Array) -> Equations:
        """Give the equations for one shape of the friction, in `FOLDS` blocks of consecutive samples.

        Args:
            presliding: x0 per drive [rad or m], shape (drives,).
            stribeck_velocity: v_s per drive [rad/s or m/s], shape (drives,).
        """
        direction = np.column_stack(
            [travel.direction(float(x0)) for travel, x0 in zip(self._travels, presliding, strict=True)]
        )
        values: dict[JointTerm, Array] = {
            "coulomb": direction,
            "stribeck": direction * np.exp(-((self._rate / stribeck_velocity) ** 2)),
        }
        used = {term: self._filtered(values[term]) for term in self._columns}
        blocks = []
        for part in self._parts:
            factors = [self._factor(joint, kept, used) for joint, kept in enumerate(part)]
            rows = np.array([len(kept.samples) for kept in part], dtype=np.int64)
            blocks.append(Information(self._supports, tuple(factors), rows, self._size))
        return Equations(tuple(blocks), self._rows)

    def _filtered(self, values: Array) -> Array:
        if not any(self._filters):
            return values
        parts = np.split(values, np.cumsum(self._lengths)[:-1])
        return np.concatenate(
            [low_pass(part, *made) if made else part for part, made in zip(parts, self._filters, strict=True)]
        )

    def _factor(self, joint: int, kept: _Kept, used: dict[JointTerm, Array]) -> Array:
        support, fixed = self._supports[joint], self._kept_columns[joint]
        factor = np.zeros((len(kept.R) + 2 * len(self._travels), len(support) + 1))
        where = np.searchsorted(support, fixed)
        factor[: len(kept.R), where] = kept.R[:, :-1]
        factor[: len(kept.R), -1] = kept.R[:, -1]
        new, places = [], []
        for term, columns in self._columns.items():
            for drive, column in enumerate(columns):
                if share := self._coupling[drive, joint]:
                    new.append(share * used[term][kept.samples, drive])
                    places.append(int(np.searchsorted(support, column)))
        if new:
            F = np.column_stack(new)
            inside = kept.Q.T @ F
            beyond = triangle(F - kept.Q @ inside)
            factor[: len(kept.R), places] = inside
            factor[len(kept.R) : len(kept.R) + len(beyond), places] = beyond
        return triangle(factor[: len(kept.R) + len(new)])


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
