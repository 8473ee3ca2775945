"""Fit the numbers in the friction that are not linear, over trials that exchange the friction's columns alone.

A shape changes two columns per drive: the direction of its Coulomb friction and that direction times the Stribeck
curve. All others, and the torque, are kept as a table X with products `X^T X`, per joint and third of the samples.
Equations with new columns F then have the products `[[X^T X, X^T F], [F^T X, F^T F]]`.

The direction at a sample needs no look at the samples before it: between two reversals it is an exponential in the
distance travelled since (`model/friction_state.py`), so the distances of reversals and of samples are all that is kept.

The pre-sliding distance x0 and the Stribeck velocity v_s belong to one drive each, and act on that drive's own rows. So
one value is tried for all drives at once, and each drive keeps the one that leaves it the smallest residual. Two
searches begin differently, the numbers in turn or all their pairs at once, because the residual has several minima.
Between their results decides what predicts better: the recordings are cut into thirds, and each third's torque is
predicted by friction fitted to the other two, inertias being those of the whole. A shape that only explains what it has
seen, such as a spike at a few reversals, loses there. Nothing but the recordings that are fitted to is looked at.

An arm without pre-sliding, or without Stribeck friction, is the alternative (`choices.py`). No gear turns round at
once, so that pre-sliding is left out only where held-out thirds are predicted clearly better without. Stribeck friction
is a further term: without it, a model that predicts better by a hundredth is the simpler one, too, and is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ident_service.config.arm import FrictionShape, JointTerm
from ident_service.estimation.choices import (
    Choice,
    best_choice,
    held_out_thirds,
    rms_over_thirds,
    significant_choice,
)
from ident_service.estimation.equations import Equations, Rows, equation_rows, require_motion
from ident_service.estimation.feasible.feasible_set import FeasibleSet
from ident_service.estimation.least_squares import Moments, solve_with_ridge, weighted_least_squares
from ident_service.estimation.robust_regression import standstill_weights
from ident_service.estimation.signal_processing import windows
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.blas_threads import one_blas_thread
from ident_service.model.chain import Array
from ident_service.model.information import Information, sparsity, triangle
from ident_service.model.parameter_layout import INERTIAL, NO_STRIBECK
from ident_service.model.zero_phase import low_pass
from ident_service.recordings.recording import Recording

FOLDS = 3
_MOST_ROWS = 30_000  # samples that are kept; of longer recordings every second, every fourth ...
_CHANGING: tuple[JointTerm, ...] = ("coulomb", "stribeck")
_GAP = 1.5  # periods; a longer step is a gap
_KEPT_DIRECTIONS = 12  # per drive: those of a search's values, of which the same are asked for again and again


@dataclass
class _Travel:
    """Distances that one drive travels: between its reversals, and of each kept sample since the last reversal.

    Attributes:
        signs: directions of the motion after each reversal, 1 or -1, the first one included.
        distances: distances travelled until the next reversal [rad or m].
        segments: per kept sample, the reversal before it.
        since: per kept sample, the distance travelled since then [rad or m].
        fresh: reversals that begin a stretch, where nothing is known of the motion before.
    """

    signs: list[float] = field(default_factory=list)
    distances: list[float] = field(default_factory=list)
    segments: list[NDArray[np.intp]] = field(default_factory=list)
    since: list[Array] = field(default_factory=list)
    fresh: set[int] = field(default_factory=set)
    _found: dict[float, Array] = field(default_factory=dict)

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
        if presliding not in self._found:
            if len(self._found) >= _KEPT_DIRECTIONS:
                self._found.pop(next(iter(self._found)))
            self._found[presliding] = self._direction(presliding)
        return self._found[presliding]

    def _direction(self, presliding: float) -> Array:
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
        self._supports = sparsity(model.chain, model.layout, base.base)
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
        self._tried: dict[tuple[int, int, int, tuple[tuple[float, float], ...]], tuple[Array, Array]] = {}
        self._places = [self._places_of(joint) for joint in self._joints]
        require_motion(recordings, model, moved)

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
        """Return the products of the equations' columns, per part of the samples, for one shape of the friction.

        Args:
            presliding: x0 per drive [rad or m], shape (drives,).
            stribeck_velocity: v_s per drive [rad/s or m/s], shape (drives,).
            parts: ranges of samples, each with a result of its own, such as `thirds`; all together when None.
        """
        wanted = [slice(0, self._rows)] if parts is None else list(parts)
        found: list[list[Array]] = [[] for _ in wanted]
        used: dict[JointTerm, Array] | None = None
        for joint, table in enumerate(self._tables):
            fixed, new, places = self._places[joint]
            size = len(self._supports[joint]) + 1
            shape = tuple((float(presliding[drive]), float(stribeck_velocity[drive])) for _, drive, _ in new)
            F: Array | None = None
            for products, part in zip(found, wanted, strict=True):
                product = np.empty((size, size))
                product[fixed[:, None], fixed] = self._normal_matrix(joint, part)
                if new:
                    # A third of all trials have for some joint the numbers of an earlier one.
                    key = (joint, part.start, part.stop, shape)
                    if key not in self._tried:
                        if F is None:
                            used = used or self._friction(presliding, stribeck_velocity)
                            F = self._new_columns(new, used)
                        self._tried[key] = (table[part].T @ F[part], F[part].T @ F[part])
                    across, own = self._tried[key]
                    product[fixed[:, None], places] = across
                    product[places[:, None], fixed] = across.T
                    product[places[:, None], places] = own
                products.append(product)
        counts = [part.stop - part.start for part in wanted]
        return [
            Moments(self._supports, tuple(products), np.full(self.joints, count), self._size)
            for products, count in zip(found, counts, strict=True)
        ]

    def _normal_matrix(self, joint: int, part: slice) -> Array:
        """Return X^T X of a joint's kept columns and torque, computed once for each part."""
        key = (joint, part.start, part.stop)
        if key not in self._products:
            rows = self._tables[joint][part]
            self._products[key] = rows.T @ rows
        return self._products[key]

    @one_blas_thread()
    def equations(self, presliding: Array, stribeck_velocity: Array) -> Equations:
        """Return the equations for one shape of the friction, in three blocks (thirds), rows near standstill apart.

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
    def delayed_rows(self, stribeck_velocity: Array) -> Callable[[float], tuple[Information, ...]]:
        """Return a function from the torque's delay [s] to the equations of rows in motion, one `Information` a third.

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
            "stribeck": direction
            * np.where(stribeck_velocity > NO_STRIBECK, np.exp(-((self._rate / stribeck_velocity) ** 2)), 0.0),
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
    for rows in equation_rows(recording, model, base, read_once=True):
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


# No gear gives by more than three degrees before it slips; a Stribeck velocity is a small share of full speed.
_GRIDS: dict[str, Array] = {
    "presliding": np.array([0.0, *np.geomspace(3e-4, 0.05, 8)]),
    "stribeck_velocity": np.geomspace(0.02, 0.8, 8),
}
# Values that stand for absence.
_NONE = {"presliding": 0.0, "stribeck_velocity": NO_STRIBECK}
_FINER = np.array([0.6, 0.8, 1.0, 1.25, 1.6])
_ROUNDS = 2
# So near that what is left of the grid moves no parameter by much beside its deviation.
_NEARER = (np.array([0.9, 0.95, 1.0, 1.05, 1.1]), np.array([0.975, 1.0, 1.025]), np.array([0.99, 1.0, 1.01]))
_RATE = 125.0  # Hz; friction changes slowly enough to be fitted on fewer rows


def with_friction(model: ArmModel, shape: FrictionShape) -> ArmModel:
    """Return the arm with these friction numbers; a Stribeck velocity still to be fitted stands at 0.1."""
    model = model.with_options(friction=shape)
    velocity = 0.1 if shape.stribeck_velocity == "fit" else shape.stribeck_velocity
    if "stribeck" not in model.layout.terms:
        return model
    velocities = tuple(float(v) for v in np.broadcast_to(np.asarray(velocity), (model.chain.joints,)))
    return replace(model, layout=replace(model.layout, stribeck_velocity=velocities))


def friction_trials(recordings: Sequence[Recording], model: ArmModel, base: BaseParameters) -> FrictionTrials:
    """Read recordings into thinned rows on which friction shapes can be tried quickly; raises RecordingError.

    Raises:
        RecordingError: a recording cannot be used.
    """
    return FrictionTrials(recordings, _thinned(model, recordings), base)


def fitted_friction_parameters(model: ArmModel) -> tuple[str, ...]:
    """Return which of `presliding` and `stribeck_velocity` are left to `fit` and matter to the arm's friction terms."""
    shape, terms = model.config.identification.friction, set(model.layout.terms)
    if not {"coulomb", "stribeck"} & terms:
        return ()
    return tuple(
        key for key in _GRIDS if getattr(shape, key) == "fit" and (key != "stribeck_velocity" or "stribeck" in terms)
    )


def log_deviation_of_search_range(number_name: str) -> float:
    """Return the standard deviation of the log of a named friction number, were it uniform over its search range."""
    grid = _GRIDS[number_name][_GRIDS[number_name] > 0.0]
    return float(np.log(grid[-1] / grid[0]) / np.sqrt(12.0))


def fit_friction(
    trials: FrictionTrials | None, model: ArmModel, base: BaseParameters, conditions: FeasibleSet | None = None
) -> tuple[ArmModel, tuple[Choice, ...]]:
    """Fit friction numbers left to `fit`; return the arm with them and, given `conditions`, which were worth keeping.

    Args:
        trials: rows of the fitted recordings; None where nothing is to be fitted.
        model: the arm; `identification.friction` says what to fit.
        base: grouping of its parameters, which these numbers do not change.
        conditions: feasible set of the estimates that judge choices; nothing is chosen when None.
    """
    shape = model.config.identification.friction
    wanted = fitted_friction_parameters(model)
    joints = model.chain.joints
    values = {
        key: np.full(joints, 0.1 if key == "stribeck_velocity" else 0.0)
        if getattr(shape, key) == "fit"
        else np.broadcast_to(np.asarray(getattr(shape, key), dtype=float), (joints,)).copy()
        for key in _GRIDS
    }
    choices: list[Choice] = []
    if wanted and trials is not None:
        search = _Search(trials, model, base)
        found = [
            search.finer(start, wanted)
            for start in (search.coordinate_search(values, wanted), search.pairs(values, wanted))
        ]
        start, values = values, search.nearer(search.best(values, found, predicting=True), wanted)
        if conditions is not None:
            values, choices = search.chosen(start, values, wanted, conditions)
    return with_friction(model, _shape(values)), tuple(choices)


def at_search_bounds(shape: FrictionShape, joints: Sequence[str], joint_terms: Sequence[str]) -> tuple[str, ...]:
    """Return a message per number of a fitted friction shape at an end of its search range; empty for none.

    Args:
        shape: fitted shape of the friction.
        joints: names of the joints.
        joint_terms: terms of the model's joints; without Stribeck friction its velocity means nothing.
    """
    found = []
    for key, what in (("presliding", "pre-sliding distance"), ("stribeck_velocity", "Stribeck velocity")):
        if key == "stribeck_velocity" and "stribeck" not in joint_terms:
            continue
        grid = _GRIDS[key]
        for name, value in zip(joints, np.broadcast_to(np.asarray(getattr(shape, key)), len(joints)), strict=True):
            if value >= grid[-1] or (_NONE[key] < value <= grid[0]):
                edge = "largest" if value >= grid[-1] else "smallest"
                found.append(f"{name}: its {what} of {value:g} is the {edge} that is searched")
    return tuple(found)


_Numbers = dict[str, Array]


@dataclass
class _Search:
    trials: FrictionTrials
    model: ArmModel
    base: BaseParameters
    _last: tuple[_Numbers, Moments, Array] | None = None

    def _weighed(self, values: _Numbers) -> tuple[Moments, Array]:
        """Return the products of the equations with these numbers, and the joint weights that they ask for."""
        if self._last is None or any(not np.array_equal(values[key], self._last[0][key]) for key in values):
            (now,) = self._moments(values)
            self._last = (values, now, now.weights(None if self._last is None else self._last[2]))
        return self._last[1:]

    def coordinate_search(self, values: _Numbers, wanted: Sequence[str]) -> _Numbers:
        """Search one number after the other over its whole grid."""
        for key in wanted:
            trials = [{key: np.full(self.model.chain.joints, value)} for value in _GRIDS[key]]
            values = self.best(values, trials)
        return values

    def pairs(self, values: _Numbers, wanted: Sequence[str]) -> _Numbers:
        """Search every combination of the grids' values."""
        joints = self.model.chain.joints
        grids = product(*(_GRIDS[key].tolist() for key in wanted))
        return self.best(
            values,
            [{key: np.full(joints, value) for key, value in zip(wanted, pair, strict=True)} for pair in grids],
        )

    def finer(self, values: _Numbers, wanted: Sequence[str]) -> _Numbers:
        """Search around the values, inside the grids."""
        for key in [*wanted] * _ROUNDS:
            values = self._around(values, key, _FINER, np.ones_like(values[key], dtype=bool))
        return values

    def nearer(self, values: _Numbers, wanted: Sequence[str]) -> _Numbers:
        """Search around given values with finer and finer steps; a value at the edge of its range stays there."""
        inside = {key: (values[key] > _GRIDS[key][0]) & (values[key] < _GRIDS[key][-1]) for key in wanted}
        for factors in _NEARER:
            for key in [*wanted] * _ROUNDS:
                values = self._around(values, key, factors, inside[key])
        return values

    def _around(self, values: _Numbers, key: str, factors: Array, moving: NDArray[np.bool_]) -> _Numbers:
        low, high = _GRIDS[key][0], _GRIDS[key][-1]
        trials = [np.where(moving, np.clip(values[key] * factor, low, high), values[key]) for factor in factors]
        return self.best(values, [{key: trial} for trial in trials])

    def best(self, values: _Numbers, trials: Sequence[_Numbers], *, predicting: bool = False) -> _Numbers:
        """Return, per drive, the trial that leaves its joint the smallest residual, or predicts its torque best."""
        # All trials use the joint weights of the best values so far.
        now, weights = self._weighed(values)
        terms = _own_terms(self.model, self.base)
        left = []
        for trial in trials:
            same = all(np.array_equal(trial[key], values[key]) for key in trial)
            total = now if same else self._moments(values | trial)[0]
            beta = total.solved(weights)
            left.append(
                _unpredicted(self._moments(values | trial, self.trials.thirds), beta, terms)
                if predicting
                else total.squared_residuals(beta)
            )
        choice = np.argmin(np.array(left), axis=0)
        return values | {
            key: np.array([trials[index][key][drive] for drive, index in enumerate(choice)]) for key in trials[0]
        }

    def chosen(
        self, start: _Numbers, fitted: _Numbers, wanted: Sequence[str], conditions: FeasibleSet
    ) -> tuple[_Numbers, list[Choice]]:
        """Return the fitted values, 0 for terms that held-out thirds are predicted as well without, and the choices."""
        values, choices = fitted, []
        gathered = self._equations(fitted)
        shares = standstill_weights(gathered)
        gathered = gathered.with_standstill_rows(shares)
        weights = weighted_least_squares(gathered.total).weights
        errors = held_out_thirds(gathered.blocks, weights, self.base, conditions)
        for key in wanted:
            if np.all(values[key] <= _NONE[key]):
                continue
            without = start | {key: np.full_like(values[key], _NONE[key])}
            others = [other for other in wanted if other != key and not np.all(values[other] <= _NONE[other])]
            without = self.finer(self.coordinate_search(without, others), others)
            blocks = self._equations(without).with_standstill_rows(shares).blocks
            both = {"fit": errors, "none": held_out_thirds(blocks, weights, self.base, conditions)}
            option = f"friction.{key}"
            simpler = key == "stribeck_velocity"
            choices.append(best_choice(option, rms_over_thirds(both)) if simpler else significant_choice(option, both))
            values, errors = (values if choices[-1].value == "fit" else without), both[choices[-1].value]
        return values, choices

    def _equations(self, values: _Numbers) -> Equations:
        return self.trials.equations(values["presliding"], values["stribeck_velocity"])

    def _moments(self, values: _Numbers, parts: Sequence[slice] | None = None) -> list[Moments]:
        return self.trials.moments(values["presliding"], values["stribeck_velocity"], parts)


def _own_terms(model: ArmModel, base: BaseParameters) -> NDArray[np.bool_]:
    """Return whether each base parameter is a joint term, shape (base,)."""
    return np.asarray(base.base % model.layout.per_link >= len(INERTIAL))


def _unpredicted(thirds: Sequence[Moments], beta: Array, terms: NDArray[np.bool_]) -> Array:
    """Return per joint the squared errors of each third as predicted from the other two, shape (joints,)."""
    total = np.zeros(len(thirds[0].products))
    for joint, support in enumerate(thirds[0].supports):
        own = np.flatnonzero(terms[support])
        # Columns: the joint's own terms, and the torque less the prediction of all other parameters.
        rest = np.zeros((len(support) + 1, len(own) + 1))
        rest[own, np.arange(len(own))] = 1.0
        rest[:-1, -1] = np.where(terms[support], 0.0, -beta[support])
        rest[-1, -1] = 1.0
        left = [rest.T @ third.products[joint] @ rest for third in thirds]
        for number, unseen in enumerate(left):
            told = np.sum([other for place, other in enumerate(left) if place != number], axis=0)
            error = np.append(-solve_with_ridge(told[:-1, :-1], told[:-1, -1]), 1.0)
            total[joint] += max(float(error @ unseen @ error), 0.0)
    return total


def _shape(values: dict[str, Array]) -> FrictionShape:
    return FrictionShape(
        presliding=tuple(float(value) for value in values["presliding"]),
        stribeck_velocity=tuple(float(value) for value in values["stribeck_velocity"]),
    )


def _thinned(model: ArmModel, recordings: Sequence[Recording]) -> ArmModel:
    options = model.config.identification
    first = next(iter(recordings[0].blocks()), None)
    period = 1e-3 if first is None else float(np.median(np.diff(first.stamp_ns))) * 1e-9
    step = max(int(options.smoothing.decimate), int(1.0 / (_RATE * period)))
    return model.with_options(smoothing=options.smoothing.model_copy(update={"decimate": step}))
