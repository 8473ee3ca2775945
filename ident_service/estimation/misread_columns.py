"""Find columns read with the wrong sign, scale, zero or time, or for another joint, by fitting each other reading.

Forced into the feasible set, an estimate predicts a part of any torque, so that its error alone does not tell wrong
columns from a poor model. The reading that is right leaves an error smaller by an order of magnitude than all others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, combinations
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ident_service.errors import SolverError
from ident_service.estimation.equations import Rows, motions_of, rows_of_motion, with_recorded_torque
from ident_service.estimation.feasible.problems import ENOUGH, constrained_least_squares
from ident_service.estimation.identify import Estimate
from ident_service.estimation.least_squares import (
    RANK_TOLERANCE,
    TorqueError,
    ordinary_least_squares,
    torque_error,
    unit_columns,
)
from ident_service.estimation.signal_processing import Motion
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.blas_threads import one_blas_thread
from ident_service.model.chain import Array
from ident_service.model.information import Information, sparsity, triangle
from ident_service.recordings.recording import Recording

SUSPECTED_FROM, CONCERNED_FROM = 10.0, 2.5  # percent of a joint's torque: to search at all, and to try a joint
NO_ERROR = 1.0  # percent of a joint's torque; smaller errors count as this one
BETTER = 3.0  # by which the product of the joints' errors must shrink; real arms with right columns reach 1.7
NONE_WORSE = 2.0  # by which the error of no joint may grow; that of one whose torque is noise may
LIKELIER = 2.0  # by which an exchange must explain more than a sign: poor joints gain a little by many exchanges
EXPLAINED = 10.0  # percent of all torques in motion that the right reading leaves at most; wrong geometry leaves more
_LONGEST = 60.0  # s of recordings that are fitted
_ROWS = 1000  # that are fitted, about
# Readings besides signs of torques, and of measured values, that are fitted under the conditions, while none explains.
_TRIED, _MEASURED_TRIED = 6, 3
_THINNED = 4  # of these rows, one in so many is fitted to choose among positions
_BOTH_WAYS = np.concatenate([-np.arange(37.0, 0.0, -1.0), np.arange(1.0, 38.0)])
_FACTORS = 1.2 ** (_BOTH_WAYS + np.sign(_BOTH_WAYS))  # of a torque: from 1.44, beyond what gains are off, to a thousand
_DELAYS = 3e-3 * np.sign(_BOTH_WAYS[::2]) * 1.15 ** np.abs(_BOTH_WAYS[::2])  # s; to half a second
_GEARS = 1.5 ** np.array([n for n in range(-13, 14) if n])  # of a position: to two hundred
_ZEROS = np.radians([n for n in range(-150, 181, 30) if n])  # that a position may be off by
_FINER = 3  # times that the best of these are made finer, by halves
WHOLE_CONCERNED, _WHOLE_BETTER = 4.0, 1.3  # percent of all torques to try these, and factor by which it must shrink

_NO_DELAYS = np.empty(0)

_Which = Literal["torque", "position", "both"]


@dataclass(frozen=True)
class Reading:
    """Another reading of the columns.

    Attributes:
        which: columns that it is about.
        joints: one whose sign is negated, two that are exchanged, or all.
        all_negated: whether all columns are meant, with the other sign.
        factor: factor of the columns of one joint, or of all; torques are divided where both are read.
        late: time by which the torque of one joint is stamped too late [s].
        zero: angle added to the position of one joint [rad].
    """

    which: _Which
    joints: tuple[int, ...]
    all_negated: bool = False
    factor: float = -1.0
    late: float = 0.0
    zero: float = 0.0

    @property
    def exchanges(self) -> bool:
        """Return whether two joints' columns are exchanged; if not, the columns of one joint, or of all, change."""
        return len(self.joints) == 2 and not self.all_negated

    @property
    def negates(self) -> bool:
        """Return whether the reading only negates columns: no exchange, and `factor` is -1."""
        return not self.exchanges and self.factor == -1.0

    @property
    def is_measured(self) -> bool:
        """Return whether the reading fits a number (a scale, a zero or a time) instead of negating or exchanging."""
        return not (self.negates or self.exchanges)

    @property
    def of_torque_signs(self) -> bool:
        """Return whether only signs of torques are negated, which needs no other regressor."""
        return self.which == "torque" and self.negates

    def read(self, samples: Array, quantity: Literal["torque", "position"]) -> Array:
        """Return samples, (samples, joints), exchanged or scaled by this reading; unchanged if not about `quantity`.

        `which` says whether the reading is about torques, positions (with velocities) or both. Time and zero are not
        applied.
        """
        if self.which not in (quantity, "both"):
            return samples
        read = samples.copy()
        if self.exchanges:
            read[:, self.joints] = samples[:, self.joints[::-1]]
        else:
            read[:, self.joints] *= 1.0 / self.factor if quantity == "torque" and self.which == "both" else self.factor
        return read


@dataclass(frozen=True)
class MisreadColumns:
    """A reading that explains the recordings far better.

    Attributes:
        reading: the reading.
        before: torque error in motion with the columns as they are.
        after: the same with that reading.
    """

    reading: Reading
    before: TorqueError
    after: TorqueError

    def sentence(self, joint_names: Sequence[str]) -> str:
        """Return a sentence for people: which columns seem misread, the errors before and after, and what to correct.

        Args:
            joint_names: of the joints.
        """
        named = [joint_names[joint] for joint in self.reading.joints]
        before, after = self.before.joint_relative_percent, self.after.joint_relative_percent
        each = ", ".join(
            f"of {name} {before[joint]:.0f} % and {after[joint]:.2g} %"
            for name, joint in zip(named, self.reading.joints, strict=True)
        )
        whole, then = self.before.relative_percent, self.after.relative_percent
        errors = f"the torque error in motion is {whole:.1f} %, and {then:.2g} % with"
        if self.reading.all_negated:
            return (
                "the torques of all joints seem to have the wrong sign, or gravity to point the other way:"
                f" {errors} the other sign ({each}): correct them where they are recorded, give the columns the factor"
                " -1 (recording.columns), or correct gravity in the description"
            )
        if len(named) == 1:
            if late := self.reading.late:
                when = f"about {abs(late):.2g} s too {'late' if late > 0.0 else 'early'}"
                return (
                    f"the torque of {named[0]} seems to be stamped {when}: {errors} it moved by that ({each}): give it"
                    " the time of its position where it is recorded"
                )
            if zero := self.reading.zero:
                off = f"{-zero:.2g} rad ({np.degrees(-zero):.0f} degrees)"
                return (
                    f"the zero of {named[0]} seems to be off by about {off}: {errors} its position less by that"
                    f" ({each}): correct its zero where it is recorded, or in the description"
                )
            if not self.reading.negates:
                factor = self.reading.factor
                if self.reading.which == "both":
                    return (
                        f"position and torque of {named[0]} seem to be those of its motor: {errors} the position"
                        f" multiplied and the torque divided by about {factor:.2g} ({each}): describe its gear"
                        " (transmission), or give both columns these factors (recording.columns)"
                    )
                return (
                    f"the {self.reading.which} of {named[0]} seems to have another unit or scale than those of other"
                    f" joints: {errors} it multiplied by about {factor:.2g} ({each}): correct it where it is recorded,"
                    " or give the column that factor (recording.columns)"
                )
            if self.reading.which == "both":
                return (
                    f"{named[0]} seems to count in the other direction than described: {errors} position and torque"
                    f" negated ({each}): turn its axis in the description, or give both columns the factor -1"
                    " (recording.columns)"
                )
            return (
                f"the {self.reading.which} of {named[0]} seems to have the wrong sign: {errors} the other sign"
                f" ({each}): correct it where it is recorded, or give the column the factor -1 (recording.columns)"
            )
        what = {"torque": "the torques", "position": "the positions", "both": "positions and torques"}
        return (
            f"{what[self.reading.which]} of {named[0]} and {named[1]} seem to be exchanged: {errors} them exchanged"
            f" ({each}): correct the order of the joints or of the columns (recording.columns)"
        )


@one_blas_thread()
def misread_columns(estimate: Estimate, recordings: Sequence[Recording]) -> MisreadColumns | None:
    """Return the reading (sign, order, scale, zero, time) that predicts far better; None if none, or errors are small.

    Nothing is tried where every joint's torque is predicted to a tenth, and all of them together to 4 %. Of the
    recordings at most a minute is fitted.

    Args:
        estimate: identified estimate.
        recordings: recordings that the estimate was fitted to; without them only signs of torques are tried, on the
            estimate's equations.
    """
    moving = estimate.candidates[estimate.chosen].moving
    own = moving.joint_relative_percent
    if own.max(initial=0.0) < SUSPECTED_FROM and moving.relative_percent < WHOLE_CONCERNED:
        return None
    weights = weights_of_joints(moving)
    parts = _samples(recordings, estimate.prepared.model)
    as_read = _equations(estimate, parts, None, _DELAYS) if recordings else _equations_of_estimate(estimate)
    before = _constrained_error(estimate, as_read.information(None), weights)
    joints = np.flatnonzero(own > CONCERNED_FROM)
    readings = [one for one in _of_torques(estimate, joints) if recordings or one.of_torque_signs]
    found = _best_of_each_kind(readings, as_read.free_errors(readings, weights), before)
    if recordings:
        found += _of_positions(estimate, parts, joints, weights, before)
    # Without conditions a fit hardly tells signs of torques, so that all of these are tried, and the best of others;
    # once one explains the recordings, every other is compared with it.
    found.sort(key=lambda one: -one[0])
    signs = [one for one in found if one[1].of_torque_signs]
    exact = [one for one in found if not (one[1].of_torque_signs or one[1].is_measured)]
    measured = [one for one in found if one[1].is_measured]
    best, most = None, -np.inf
    numbered = chain(enumerate(signs, -len(signs)), enumerate(exact), enumerate(measured, _TRIED - _MEASURED_TRIED))
    for number, (without_conditions, reading) in numbered:
        if without_conditions < max(most, np.log(BETTER)):  # conditions only add to the error
            continue
        if best is None and number >= _TRIED:
            continue
        equations = as_read if reading.which == "torque" else _equations(estimate, parts, reading)
        try:
            after = _constrained_error(estimate, equations.information(reading), weights)
        except SolverError:  # it explains nothing, and must not end what has been identified
            continue
        gained_by = error_reductions(before, after)
        gained = float(gained_by.sum()) - (0.0 if reading.negates else np.log(LIKELIER))
        enough = gained_by.sum() >= np.log(BETTER) and gained_by.min() >= -np.log(NONE_WORSE)
        if reading.is_measured and reading.which != "torque":
            enough = enough and after.relative_percent * _WHOLE_BETTER < before.relative_percent
        if enough and after.relative_percent < EXPLAINED and (best is None or gained > most):
            best, most = MisreadColumns(reading, before, after), gained
    return best


_Found = list[tuple[float, Reading]]  # gain without conditions, and the reading


def _of_torques(estimate: Estimate, joints: NDArray[np.intp]) -> Iterator[Reading]:
    yield Reading("torque", tuple(range(estimate.model.chain.joints)), all_negated=True)
    yield from _signs_and_exchanges("torque", estimate, joints)
    for joint in joints.tolist():
        yield from (Reading("torque", (joint,), factor=float(factor)) for factor in _FACTORS)
        yield from (Reading("torque", (joint,), factor=1.0, late=float(late)) for late in _DELAYS)


def _signs_and_exchanges(which: _Which, estimate: Estimate, joints: NDArray[np.intp]) -> Iterator[Reading]:
    turns = estimate.model.chain.revolute
    yield from (Reading(which, (joint,)) for joint in joints.tolist())
    for one, other in combinations(joints.tolist(), 2):
        if turns[one] == turns[other]:
            yield Reading(which, (one, other))


def _of_positions(
    estimate: Estimate, parts: Sequence[_Part], joints: NDArray[np.intp], weights: Array, before: TorqueError
) -> _Found:
    """Return the best readings of positions, of zeros and scales one for each joint."""

    def tried(readings: Sequence[Reading], parts: Sequence[_Part] = parts) -> _Found:
        errors: dict[Reading, Array] = {}
        for one in readings:
            if one in errors:
                continue
            alike = [other for other in readings if replace(other, which=one.which) == one]  # in the positions
            found = _equations(estimate, parts, one).free_errors(alike, weights)
            errors |= zip(alike, found, strict=True)
        return _best_of_each_kind(readings, [errors[one] for one in readings], before)

    kinds: tuple[_Which, ...] = ("position", "both")
    found = tried([one for which in kinds for one in _signs_and_exchanges(which, estimate, joints)])
    if before.relative_percent < WHOLE_CONCERNED:
        return found
    thin = [replace(part, some=part.some[slice(None, None, _THINNED)]) for part in parts]
    for joint in range(estimate.model.chain.joints):  # those before it feel it, too
        for which in kinds:
            found += _finest(
                partial(tried, parts=thin), [Reading(which, (joint,), factor=float(factor)) for factor in _GEARS]
            )
        if estimate.model.chain.revolute[joint]:
            found += _finest(
                partial(tried, parts=thin),
                [Reading("position", (joint,), factor=1.0, zero=float(zero)) for zero in _ZEROS],
            )
    return found


def _finest(tried: Callable[[Sequence[Reading]], _Found], readings: Sequence[Reading]) -> _Found:
    """Return the best of factors or zeros, made finer where it may explain anything."""
    (best,) = tried(readings)
    factor, zero = readings[1].factor / readings[0].factor, readings[1].zero - readings[0].zero
    for _ in range(_FINER if best[0] > np.log(BETTER) else 0):
        factor, zero = factor**0.5, 0.5 * zero
        near = [(best[1].factor * factor**way, best[1].zero + zero * way) for way in (-1.0, 1.0)]
        finer = tried([replace(best[1], factor=one, zero=other) for one, other in near])
        best = max(best, *finer, key=lambda one: one[0])
    return [best]


def _best_of_each_kind(readings: Sequence[Reading], errors: Iterable[Array], before: TorqueError) -> _Found:
    """Return readings with their gains, and of one joint's factors, zeros or times only the best."""
    found: dict[Reading, tuple[float, Reading]] = {}
    for reading, after in zip(readings, errors, strict=True):
        gain = float(_gains(before.joint_relative_percent, after).sum())
        alike = reading
        if reading.is_measured:
            alike = replace(reading, factor=0.0, late=float(reading.late != 0.0), zero=float(reading.zero != 0.0))
        if alike not in found or gain > found[alike][0]:
            found[alike] = gain, reading
    return list(found.values())


def weights_of_joints(torque_error: TorqueError) -> Array:
    """Return the reciprocals of the joints' rms errors, scaled to a geometric mean of 1; shape (joints,)."""
    rms = torque_error.joint_rms
    weights = 1.0 / np.maximum(rms, 1e-9 * max(float(rms.max(initial=0.0)), np.finfo(float).tiny))
    return np.asarray(weights / np.exp(np.mean(np.log(weights))))


def error_reductions(before: TorqueError, after: TorqueError) -> Array:
    """Return per joint the logarithm of its torque error before over after, positive where better; shape (joints,)."""
    return _gains(before.joint_relative_percent, after.joint_relative_percent)


def _constrained_error(estimate: Estimate, information: Information, weights: Array) -> TorqueError:
    fit = ordinary_least_squares(information, weights)
    found = constrained_least_squares(fit, estimate.base, estimate.conditions, first_tolerance=ENOUGH)
    return torque_error(information, found.beta)


def _gains(before: Array, after: Array) -> Array:
    """Return per joint the logarithm of the factor by which its error [percent] shrinks, shape (joints,)."""
    return np.asarray(np.log(np.maximum(before, NO_ERROR) / np.maximum(after, NO_ERROR)))


@dataclass(frozen=True)
class _Equations:
    """Equations with one reading of the positions, for every reading of the torques.

    Attributes:
        supports: per joint, which base parameters it feels, increasing.
        columns: per joint, orthogonal combinations of its rows, shape (rows, k).
        torques: the same combinations of all joints' torques, shape (rows, joints); then of these at each delay.
        rows: equations that went into each joint's, shape (joints,).
        base: number of base parameters.
        delays: delays of the torques [s], shape (delays,).
    """

    supports: tuple[NDArray[np.intp], ...]
    columns: tuple[Array, ...]
    torques: tuple[Array, ...]
    rows: NDArray[np.int64]
    base: int
    delays: Array

    def _torques(self, joint: int, reading: Reading | None) -> Array:
        joints = len(self.torques)
        if reading is not None and reading.late and joint in reading.joints:
            delayed = 1 + int(np.argmin(np.abs(self.delays - reading.late)))
            return self.torques[joint][:, delayed * joints + joint]
        torques = self.torques[joint][:, :joints]
        return (torques if reading is None else reading.read(torques, "torque"))[:, joint]

    def information(self, reading: Reading | None) -> Information:
        """Return their information with a reading of the torques, which is about the same positions or none."""
        factors = (np.column_stack([one, self._torques(joint, reading)]) for joint, one in enumerate(self.columns))
        return Information(self.supports, tuple(factors), self.rows.copy(), self.base)

    def free_errors(self, readings: Sequence[Reading], weights: Array) -> Array:
        """Return the torque errors that least squares without conditions leaves [percent], shape (readings, joints).

        Args:
            readings: readings of the torques.
            weights: per joint, what its equations are multiplied by, shape (joints,).
        """
        H, torques = [], []
        for joint, (support, columns) in enumerate(zip(self.supports, self.columns, strict=True)):
            H.append(np.zeros((len(columns), self.base)))
            H[-1][:, support] = weights[joint] * columns
            torques.append(weights[joint] * np.column_stack([self._torques(joint, one) for one in readings]))
        stacked, wanted = np.vstack(H), np.vstack(torques)
        unit, seen = unit_columns(stacked)
        scaled = np.where(seen, stacked, 0.0) / unit
        left = wanted - scaled @ np.linalg.lstsq(scaled, wanted, rcond=RANK_TOLERANCE)[0]
        ends = np.cumsum([len(one) for one in H])[:-1]
        squares, of = (
            np.array([np.sum(np.square(part), axis=0) for part in np.split(one, ends)]) for one in (left, wanted)
        )
        return 100.0 * np.sqrt(squares / np.where(of > 0.0, of, np.inf)).T


def _equations_of_estimate(estimate: Estimate) -> _Equations:
    """Return the equations that an estimate keeps, for other signs of torques."""
    moving = estimate.prepared.equations.moving
    torques = []
    for joint, factor in enumerate(moving.factors):
        torques.append(np.zeros((len(factor), moving.joints)))
        torques[-1][:, joint] = factor[:, -1]
    columns = tuple(factor[:, :-1] for factor in moving.factors)
    return _Equations(moving.supports, columns, tuple(torques), moving.rows, moving.base, _NO_DELAYS)


def _equations(
    estimate: Estimate, parts: Sequence[_Part], reading: Reading | None, delays: Array = _NO_DELAYS
) -> _Equations:
    """Return the equations of some samples of recordings with one reading of the positions, at some delays."""
    model, base = estimate.prepared.model, estimate.base
    supports = sparsity(model.chain, model.layout, base.base)
    rows = [
        rows_of_motion(
            part.some if reading is None else _rearranged(part.some, reading, model), part.recording, model, base
        )
        for part in parts
    ]
    keep = np.concatenate([one.keep for one in rows])
    keep = keep if keep.any() else np.ones_like(keep)
    torque = np.concatenate([_at_delays(one, part, model, base, delays) for one, part in zip(rows, parts, strict=True)])
    columns, torques = [], []
    for joint, support in enumerate(supports):
        H = np.concatenate([one.H_b[joint, support].T for one in rows])
        # With all torques beside the columns, every reading of them needs no other decomposition.
        factor = triangle(np.column_stack([H, torque])[keep[:, joint]])
        columns.append(factor[:, : len(support)])
        torques.append(estimate.prepared.torque_scales[joint] * factor[:, len(support) :])
    counts = keep.sum(axis=0).astype(np.int64)
    return _Equations(supports, tuple(columns), tuple(torques), counts, base.size, delays)


def _at_delays(rows: Rows, part: _Part, model: ArmModel, base: BaseParameters, delays: Array) -> Array:
    """Return torques as recorded, then as stamped late by each delay, shape (samples, joints (1 + delays))."""
    torques = [rows.torque]
    for late in delays:
        moved = [np.interp(part.some.time + late, part.all.time, torque) for torque in part.all.torque.T]
        torques.append(with_recorded_torque(rows, np.array(moved).T, part.recording, model, base).torque)
    return np.hstack(torques)


def _rearranged(motion: Motion, reading: Reading, model: ArmModel) -> Motion:
    """Return smoothed samples as they are with another reading of the positions: each column is smoothed alone."""
    names = ("position", "velocity", "acceleration")
    moved = {name: reading.read(getattr(motion, name), "position") for name in names}
    moved["position"][:, reading.joints] += reading.zero
    coupling, direction = model.chain.coupling, motion.direction
    if direction is not None:
        uncoupled = np.array_equal(coupling != 0.0, np.eye(len(coupling), dtype=bool))
        # Where drives share joints, nothing is known of the pre-sliding of a motion that they did not make.
        turned = replace(reading, factor=float(np.sign(reading.factor)))
        direction = turned.read(direction, "position") if uncoupled else np.sign(moved["velocity"] @ coupling.T)
    keep = motion.keep
    if reading.exchanges:
        keep = keep.copy()
        keep[:, reading.joints] = motion.keep[:, reading.joints[::-1]]
    return replace(motion, **moved, keep=keep, direction=direction)


@dataclass(frozen=True)
class _Part:
    """Smoothed samples of a stretch of a recording, and some of them, which are fitted."""

    recording: Recording
    all: Motion
    some: Motion


def _samples(recordings: Sequence[Recording], model: ArmModel) -> list[_Part]:
    """Return about `_ROWS` smoothed samples of at most a minute of the recordings."""
    options = model.config.identification
    # What else filters the equations is left out: readings are compared among themselves.
    smoothing = options.smoothing.model_copy(update={"regressor_cutoff": None})
    if options.smoothing.regressor_cutoff is not None:
        smoothing = smoothing.model_copy(update={"filter_torque": True})
    model = model.with_options(smoothing=smoothing)
    parts = list(_first_minute(recordings, model))
    step = max(sum(len(motion.time) for _, motion in parts) // _ROWS, 1)
    return [_Part(one, motion, motion[slice(None, None, step)]) for one, motion in parts]


def _first_minute(recordings: Sequence[Recording], model: ArmModel) -> Iterator[tuple[Recording, Motion]]:
    """Yield smoothed samples until a minute is full: they are in memory as a rule, and no more of them is smoothed."""
    left = _LONGEST
    for recording in recordings:
        for motion in motions_of(recording, model):
            if not len(motion.time):
                continue
            inside = motion.time - motion.time[0] <= left
            yield recording, motion[np.flatnonzero(inside)]
            if not inside.all():
                return
            left -= float(motion.time[-1] - motion.time[0])
