"""Gather what a report shows while an estimate is still at hand.

A solid ellipsoid of uniform density with half axes a_1, a_2, a_3 and mass m has second moments m a_i^2 / 5 about
its centre. So the ellipsoid with a link's mass, centre and inertia has a_i = sqrt(5 s_i / m), with s_i the eigenvalues
of Sigma = tr(I)/2 1 - I, I the inertia about the centre of mass; it exists where all of them are positive, as
`pseudo_inertia` asks.

Friction lives on the drives. Where drives move several joints (`d = C q`), joint torques are `C^T` times drive torques,
so what is left of the joints' torques is solved for the drives' before it is shown against their velocity.

Memory does not grow with a recording: what is kept of it is an envelope, averaged spectra and a scatter.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ident_service.config.arm import JointTerm
from ident_service.estimation.equations import Rows, equation_rows
from ident_service.estimation.feasible.feasible_set import FeasibleSet
from ident_service.estimation.identify import Candidate, Estimate
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.blas_threads import one_blas_thread
from ident_service.model.kinematics import branches, frame_origins, link_poses
from ident_service.model.parameter_layout import TERM_SYMBOLS, Layout
from ident_service.recordings.adapters import RangeRecording, driver_of
from ident_service.recordings.mcap_reader import Cycles, McapRecording, read_cycles
from ident_service.recordings.recording import Recording
from ident_service.results.evidence.evidence import (
    Array,
    Body,
    Condition,
    Estimated,
    Evidence,
    Friction,
    JointTrace,
    Mask,
    PosedArm,
    PredictionTrace,
    Role,
    Spectrum,
    Spike,
    Timing,
)


def conditions_of(estimate: Estimate) -> tuple[Condition, ...]:
    """Return the links and smallest eigenvalue of each condition of the feasible set; none without link parameters."""
    if estimate.delta is None:
        return ()
    found = []
    for block in estimate.conditions.blocks:
        columns = np.flatnonzero(np.any(block.F != 0.0, axis=0))
        links = sorted({int(column) // estimate.model.layout.per_link for column in columns})
        smallest, scaled = block.smallest(estimate.delta), block.smallest_scaled(estimate.delta)
        found.append(Condition(block.name, tuple(links), smallest, scaled))
    return tuple(found)


def bounds_of(active: tuple[str, ...], conditions: FeasibleSet, base: BaseParameters) -> tuple[tuple[str, ...], ...]:
    """Return per base parameter the active conditions (`active`) that involve the first link parameter of its sum."""
    touched = {
        block.name: set(np.flatnonzero(np.any(block.F != 0.0, axis=0)).tolist())
        for block in (*conditions.blocks, *conditions.equalities)
    }
    return tuple(tuple(name for name in active if int(column) in touched.get(name, set())) for column in base.base)


def posed(model: ArmModel, delta: Array | None, positions: Array) -> PosedArm | None:
    """Return frames and bodies of the arm in the posture of a motion where its frames spread most; None without bodies.

    Args:
        model: the arm.
        delta: link parameters, shape (parameters,), or None where nothing has bodies.
        positions: postures of the motion [rad or m], shape (postures, joints), at least one.
    """
    if delta is None:
        return None
    posture = positions[[_most_spread_posture(frame_origins(model.chain, positions))]]
    turns, places = link_poses(model.chain, posture)
    bodies = []
    for link in range(model.layout.joints):
        mass, center, axes = ellipsoid(delta[model.layout.inertial(link)])
        R, p = turns[0, link], places[0, link]
        bodies.append(Body(mass, R @ center + p, None if axes is None else axes @ R.T))
    return PosedArm(frame_origins(model.chain, posture)[0], branches(model.chain), tuple(bodies))


def _most_spread_posture(points: Array) -> int:
    """Return the posture whose frames lie farthest from each other, as seen from the side and from above."""
    seen = np.zeros(len(points))
    for view in ((0, 2), (0, 1)):
        flat = points[:, :, view]
        apart = np.linalg.norm(flat[:, :, None] - flat[:, None, :], axis=-1)
        seen += apart.sum(axis=(1, 2))
    return int(np.argmax(seen))


def ellipsoid(inertial_parameters: Array) -> tuple[float, Array, Array | None]:
    """Return mass, centre of mass and half axes of the solid ellipsoid that has a body's inertial parameters.

    Args:
        inertial_parameters: the ten parameters of eq. 13, about the link frame's origin, shape (10,).

    Returns:
        Mass [kg], centre of mass in the link frame [m], shape (3,), zero where the mass is not positive, and half axes
        as rows [m], shape (3, 3), or None where no such ellipsoid exists.
    """
    xx, xy, xz, yy, yz, zz, lx, ly, lz, m = (float(value) for value in inertial_parameters)
    if m <= 0.0:
        return m, np.zeros(3), None
    center = np.array([lx, ly, lz]) / m
    L = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    # Shift from the origin to the centre of mass (Steiner).
    second = 0.5 * np.trace(L) * np.eye(3) - L - m * np.outer(center, center)
    values, vectors = np.linalg.eigh(second)
    if values[0] <= 0.0:
        return m, center, None
    return m, center, (np.sqrt(5.0 * values / m) * vectors).T


_BINS = 60
_GAPS = 100
_MAX_STAMPS = 1 << 22  # samples looked at, more than an hour at 1 kHz
_GAP = 1.9  # times the usual step; a longer step is a gap


def timing(recording: Recording) -> Timing:
    """Return rate, jitter and gaps of a recording, from its `/cycle` where a whole run has one, else from its stamps.

    Args:
        recording: of two samples at least.

    Raises:
        RecordingError: the recording can no longer be read, or its `/cycle` is damaged.
    """
    path, stamps = recording.path, _stamps(recording)
    steps = np.diff(stamps)
    usual = float(np.median(steps))
    # Rounded stamps make the median too coarse to tell jitter from.
    usual = float(steps[(steps > 0.4 * usual) & (steps < 1.6 * usual)].mean())
    longer = np.flatnonzero(steps > _GAP * usual)
    order = longer[np.argsort(-steps[longer], kind="stable")][:_GAPS]
    gaps = tuple(((int(stamps[k]) - int(stamps[0])) * 1e-9, int(steps[k]) * 1e-9) for k in order)
    # The loop's account covers a whole run, so it is not used for a part of a recording.
    parts = [] if isinstance(recording, RangeRecording) else list(_cycles(recording))
    if parts:
        return _of_cycles(path.name, parts, 1e9 / usual, gaps, len(longer))
    off = np.abs(steps[steps <= _GAP * usual] - usual) * 1e-9
    # Differences below the resolution of nanosecond stamps are not jitter.
    edges, counts = _histogram(np.where(off < 2e-9, 0.0, off))
    return Timing(
        recording=path.name,
        source="stamps",
        edges=edges,
        counts=counts,
        samples=len(stamps),
        rate=1e9 / usual,
        largest=float(off.max(initial=0.0)),
        compute=None,
        gaps=gaps,
        gap_count=len(longer),
        lost=None,
        invalid=(),
        oldest=(),
    )


def _stamps(recording: Recording) -> NDArray[np.int64]:
    """Return the stamps of the first few million samples [ns]."""
    kept, count = [], 0
    for block in recording.blocks():
        kept.append(block.stamp_ns)
        count += len(block.stamp_ns)
        if count >= _MAX_STAMPS:
            break
    return np.concatenate(kept)


def _cycles(recording: Recording) -> Iterator[Cycles]:
    while (inner := getattr(recording, "whole", None)) is not None:
        recording = inner
    return recording.read_cycles() if isinstance(recording, McapRecording) else read_cycles(recording.path)


def _of_cycles(
    name: str, parts: list[Cycles], rate: float, gaps: tuple[tuple[float, float], ...], gap_count: int
) -> Timing:
    lateness = np.concatenate([part.lateness_ns for part in parts]) * 1e-9
    edges, counts = _histogram(lateness)
    lost = np.concatenate([part.lost for part in parts])
    return Timing(
        recording=name,
        source="cycle",
        edges=edges,
        counts=counts,
        samples=len(lateness),
        rate=rate,
        largest=float(lateness.max()),
        compute=max(float(part.compute_ns.max()) for part in parts) * 1e-9,
        gaps=gaps,
        gap_count=gap_count,
        lost=int(lost[-1]) - int(lost[0]),
        invalid=tuple(int(count) for count in np.sum([(~part.valid).sum(axis=0) for part in parts], axis=0)),
        oldest=tuple(int(age) for age in np.max([part.age.max(axis=0) for part in parts], axis=0)),
    )


def _histogram(values: Array) -> tuple[Array, NDArray[np.int64]]:
    low, high = float(min(values.min(initial=0.0), 0.0)), float(max(values.max(initial=0.0), 0.0))
    counts, edges = np.histogram(values, _BINS, (low, max(high, low + 1e-6)))
    return edges, counts.astype(np.int64)


Index = NDArray[np.int64]

_SECONDS = 8.0  # of a segment: lines every eighth of a Hz
_LONGEST_SEGMENT = 1 << 14
_SHORTEST_SEGMENT = 64
_LINES = 160
_LAGS = 200
_LONGEST_LAG = 1.0  # s


class Envelope:
    """Lowest and highest value of several series in equal stretches of time.

    Stretches are as short as their number allows: when there are too many, neighbours merge in pairs.
    """

    def __init__(self, series: int, most: int, width: float) -> None:
        """Prepare `series` series in at most `most` stretches of `width` seconds, or more."""
        self._most, self.width = most, width
        self._index: Index = np.zeros(0, np.int64)
        self._low, self._high = np.zeros((series, 0)), np.zeros((series, 0))
        self._any = np.zeros((series, 0), bool)

    def add(self, time: Array, values: Array, marked: Mask) -> None:
        """Add samples, a row per series, to the extremes of their stretches of time; merge stretches if too many.

        Args:
            time: times, not decreasing, not below that of earlier samples [s], shape (samples,).
            values: shape (series, samples).
            marked: samples whose stretch is to be marked, shape (series, samples).
        """
        if not len(time):
            return
        number = np.floor(time / self.width + 1e-9).astype(np.int64)
        self._index = np.concatenate([self._index, number])
        self._low, self._high = np.hstack([self._low, values]), np.hstack([self._high, values])
        self._any = np.hstack([self._any, marked])
        self._reduce()
        while len(self._index) > self._most:
            self.width *= 2.0
            self._index = self._index // 2
            self._reduce()

    def _reduce(self) -> None:
        begins = np.flatnonzero(np.diff(self._index, prepend=self._index[0] - 1))
        self._low = np.minimum.reduceat(self._low, begins, axis=1)
        self._high = np.maximum.reduceat(self._high, begins, axis=1)
        self._any = np.logical_or.reduceat(self._any, begins, axis=1)
        self._index = self._index[begins]

    @property
    def time(self) -> Array:
        """Return the middle of every stretch [s], shape (stretches,)."""
        return np.asarray((self._index + 0.5) * self.width)

    @property
    def extremes(self) -> Array:
        """Return the lowest and highest values, shape (series, 2, stretches)."""
        return np.stack([self._low, self._high], axis=1)

    @property
    def marked(self) -> Mask:
        """Return whether each stretch has a marked sample, shape (series, stretches)."""
        return self._any


class Welch:
    """Power spectral density and autocorrelation of several series (Welch 1967), segment after segment.

    Segments overlap by half; those of the density are seen through Hann's window, those of the autocorrelation are
    padded with zeros and weighted by how many pairs each lag has.
    """

    def __init__(self, series: int, rate: float) -> None:
        """Prepare `series` series of `rate` samples a second."""
        self.length = int(min(max(_SHORTEST_SEGMENT, round(_SECONDS * rate)), _LONGEST_SEGMENT))
        self.rate = rate
        self._waiting = np.zeros((series, 0))
        self._density = np.zeros((series, self.length // 2 + 1))
        self._products = np.zeros((series, self.length))
        self._segments = self._samples = 0
        self._window = np.hanning(self.length + 1)[:-1]

    def add(self, values: Array, *, after_gap: bool = False) -> None:
        """Add the next samples, (series, samples), to spectrum and correlation; `after_gap` if a gap precedes them."""
        self._waiting = values if after_gap else np.hstack([self._waiting, values])
        self._samples += values.shape[1]
        half = self.length // 2
        while self._waiting.shape[1] >= self.length:
            self._segment(self._waiting[:, : self.length])
            self._waiting = self._waiting[:, half:]

    def _segment(self, values: Array) -> None:
        level = values - values.mean(axis=1, keepdims=True)
        power = np.abs(np.fft.rfft(level * self._window)) ** 2
        power[:, 1:-1] *= 2.0
        self._density += power / (self.rate * float(self._window @ self._window))
        # The mean stays in: a residual with an offset is correlated at every lag.
        padded = np.abs(np.fft.rfft(values, 2 * self.length)) ** 2
        self._products += np.fft.irfft(padded)[:, : self.length]
        self._segments += 1

    @property
    def ready(self) -> bool:
        """Return whether at least one whole segment of samples has been added."""
        return self._segments > 0

    def density(self) -> tuple[Array, Array]:
        """Return frequencies [Hz], (lines,), closer together where low, and power spectral density (series, lines)."""
        frequency = np.arange(1, self._density.shape[1]) * self.rate / self.length
        density = self._density[:, 1:] / max(self._segments, 1)
        edges = np.unique(np.geomspace(1, len(frequency) + 1, _LINES + 1).astype(int)) - 1
        sizes = np.diff(edges)
        sums = np.add.reduceat(np.vstack([frequency, density]), edges[:-1], axis=1) / sizes
        return sums[0], sums[1:]

    def correlation(self) -> tuple[Array, Array]:
        """Return lags [s], (lags,), and autocorrelations, (series, lags), 1 at lag 0; zero where a series is zero."""
        longest = max(1, min(self.length // 2, round(_LONGEST_LAG * self.rate)))
        step = max(1, longest // _LAGS)
        lags = np.arange(0, longest + 1, step)
        products = self._products[:, lags] / (self.length - lags)
        power = products[:, :1]
        return lags / self.rate, np.divide(products, power, out=np.zeros_like(products), where=power > 0.0)

    @property
    def white(self) -> float:
        """Return the bound that 95 % of the autocorrelations of white noise stay below."""
        return 1.96 / float(np.sqrt(max(self._samples, 1)))


class Scatter:
    """Subset of many points, spread evenly in time as they come."""

    def __init__(self, most: int = 8192) -> None:
        """Prepare to keep at most `most` of the rows that come."""
        self._most, self._step, self._seen = most, 1, 0
        self._rows: list[Array] = []
        self._kept = 0

    def add(self, rows: Array) -> None:
        """Add the next rows, shape (samples, columns), of which every n-th is kept, so that they stay few enough."""
        first = -self._seen % self._step
        self._seen += len(rows)
        self._rows.append(rows[first :: self._step].copy())
        self._kept += len(self._rows[-1])
        while self._kept > self._most:
            kept = np.concatenate(self._rows)[::2]
            self._rows, self._kept, self._step = [kept], len(kept), 2 * self._step

    def rows(self) -> Array:
        """Return the kept rows, shape (samples, columns)."""
        return np.concatenate(self._rows)


_MOST_POINTS, _PARTS = (
    400,
    50,
)  # points of friction that are kept; equal parts of their range, each with its share


def spread(x: Array, y: Array) -> tuple[Array, Array]:
    """Return at most 400 of the points, so that no part of the range of x that has any is left empty.

    Args:
        x: shape (points,).
        y: shape (points,).
    """
    if len(x) <= _MOST_POINTS:
        return x, y
    width = (x.max() - x.min()) / _PARTS or 1.0
    place = np.minimum((x - x.min()) / width, _PARTS - 1).astype(int)
    share = _MOST_POINTS // _PARTS
    chosen = []
    for part in range(_PARTS):
        members = np.flatnonzero(place == part)
        if len(members) > share:
            members = members[np.linspace(0, len(members) - 1, share).round().astype(int)]
        chosen.append(members)
    kept = np.sort(np.concatenate(chosen))
    return x[kept], y[kept]


_CURVE = 160  # samples of a curve, closer together near standstill
_TERMS: tuple[JointTerm, ...] = tuple(term for term in TERM_SYMBOLS if term != "drive_inertia")


class FrictionCollector:
    """Collector of friction points against velocity, chunk after chunk, with the estimate's curve."""

    def __init__(self, estimate: Estimate) -> None:
        """Prepare to collect the friction of `estimate`."""
        layout, base = estimate.model.layout, estimate.base
        columns: dict[int, tuple[JointTerm, int]] = {}
        for term in _TERMS:
            columns |= {int(column): (term, drive) for drive, column in enumerate(layout.term_columns(term))}
        self._estimate = estimate
        self._places = {k: columns[int(column)] for k, column in enumerate(base.base) if int(column) in columns}
        self._rigid: NDArray[np.intp] = np.setdiff1d(np.arange(base.size), list(self._places))
        self._coupling = estimate.model.chain.coupling
        self._points = Scatter()

    def add(self, rows: Rows, torque: Array) -> None:
        """Add velocity and non-rigid torque of each drive; `torque`, (samples, joints), has torque scales applied."""
        if not self._places or not len(rows.time):
            return
        rigid = np.tensordot(self._estimate.beta[self._rigid], rows.H_b[:, self._rigid], axes=(0, 1)).T
        drives = (torque - rigid) @ np.linalg.pinv(self._coupling)
        self._points.add(np.hstack([rows.velocity @ self._coupling.T, drives]))

    def found(self) -> tuple[Friction, ...]:
        """Return the recorded points and the model's curve of each drive's friction; none where it has no friction."""
        if not self._places:
            return ()
        points = self._points.rows()
        drives = points.shape[1] // 2
        return tuple(self._of(drive, points[:, drive], points[:, drives + drive]) for drive in range(drives))

    def _of(self, drive: int, velocity: Array, torque: Array) -> Friction:
        fastest = max(float(np.abs(velocity).max()), 1e-6)
        half = fastest * np.linspace(0.0, 1.0, _CURVE // 2 + 1)[1:] ** 2
        at = np.concatenate([-half[::-1], half])
        curve = np.zeros(len(at))
        terms = []
        for place, (term, whose) in self._places.items():
            if whose == drive:
                curve += self._estimate.beta[place] * friction_term(term, at, self._estimate.model.layout, drive)
                terms.append(self._estimate.base.expressions[place])
        x, y = spread(velocity, torque)
        return Friction(x, y, at, curve, tuple(terms))


def friction_term(term: JointTerm, velocity: Array, layout: Layout, drive_index: int) -> Array:
    """Return the torque of a friction term in steady motion per unit of its coefficient, shape of `velocity`.

    Args:
        term: one of the model's friction terms.
        velocity: velocity of the drive, not zero [rad/s or m/s].
        layout: layout with the Stribeck velocities.
        drive_index: number of the drive.
    """
    sign = np.sign(velocity)
    if term == "viscous":
        return velocity
    if term == "coulomb":
        return sign
    if term == "offset":
        return np.ones_like(velocity)
    if term == "stribeck":
        return np.asarray(sign * np.exp(-((velocity / layout.stribeck_velocity[drive_index]) ** 2)))
    return velocity * np.abs(velocity) if term == "quadratic" else np.abs(velocity)


_STRETCHES = 8000  # of all recordings together; a screen has some thousand columns
_FEWEST_STRETCHES = 400
_POSTURES = 256
CAD = "CAD"


@one_blas_thread()
def gather_evidence(
    estimate: Estimate,
    recordings: Sequence[Recording],
    validation: Sequence[Recording],
    parameters_sha256: str,
    warnings: Sequence[str] = (),
) -> Evidence:
    """Return everything that a report shows of an estimate and its recordings.

    Args:
        estimate: estimate made from `recordings` and judged on `validation`.
        recordings: recordings that were fitted to.
        validation: recordings that were not fitted to.
        parameters_sha256: hash of the parameter file that holds the estimate.
        warnings: what is wrong with the recordings, in words.

    Raises:
        RecordingError: a recording can no longer be read.
    """
    everyone: list[tuple[Recording, Role]] = [(one, "identification") for one in recordings]
    everyone += [(one, "validation") for one in validation]
    most = max(_STRETCHES // len(everyone), _FEWEST_STRETCHES)
    friction = FrictionCollector(estimate)
    traced: list[PredictionTrace] = []
    times: list[Timing] = []
    postures = Scatter(_POSTURES)
    for recording, role in everyone:
        seen = _TraceCollector(estimate, most)
        for rows in equation_rows(recording, estimate.model, estimate.base):
            seen.add(rows)
            if role == "identification":
                friction.add(rows, seen.torque)
                postures.add(rows.position)
        traced.append(seen.traced(recording, role))
        times.append(timing(recording))
    fitted_inside = f"FBPE-{estimate.method.upper()} {estimate.conditions.kind}"
    constrained = [one.name for one in estimate.candidates].index(fitted_inside)
    shown = posed(estimate.model, estimate.delta, postures.rows())
    own = _evidence(estimate, parameters_sha256, constrained, shown)
    return replace(
        own,
        recordings=tuple(traced),
        friction=friction.found(),
        timing=tuple(times),
        warnings=tuple(warnings),
    )


def evidence_without_samples(estimate: Estimate, parameters_sha256: str) -> Evidence:
    """Return what a report can show of an estimate whose recordings are gone but for their information.

    That is no trace, spectrum, friction curve or timing; bodies stand in the middle of the joints' ranges.

    Args:
        estimate: estimate to show.
        parameters_sha256: hash of the parameter file that holds the estimate.
    """
    limits = [estimate.model.config.joints[name].position for name in estimate.model.chain.names]
    middle = np.array([[0.0 if ends is None else 0.5 * (ends[0] + ends[1]) for ends in limits]])
    return _evidence(estimate, parameters_sha256, estimate.chosen, posed(estimate.model, estimate.delta, middle))


def _evidence(estimate: Estimate, parameters_sha256: str, constrained: int, shown: PosedArm | None) -> Evidence:
    """Return what an estimate shows without its recordings; `constrained` is the number of a candidate."""
    estimates = _estimates(estimate)
    offset = len(estimates) - len(estimate.candidates)
    return Evidence(
        parameters_sha256=parameters_sha256,
        joints=estimate.model.chain.names,
        revolute=estimate.model.chain.revolute,
        estimates=estimates,
        unconstrained=offset,
        constrained=offset + constrained,
        chosen=offset + estimate.chosen,
        bounds=bounds_of(estimate.tight, estimate.conditions, estimate.base),
        recordings=(),
        friction=(),
        conditions=conditions_of(estimate),
        posed=shown,
        timing=(),
        warnings=(),
    )


def _estimates(estimate: Estimate) -> tuple[Estimated, ...]:
    def of(candidate: Candidate) -> Estimated:
        scores = candidate.validation
        return Estimated(
            name=candidate.name,
            values=candidate.beta,
            margin=candidate.margin,
            identification=candidate.identification.relative_percent,
            validation=tuple(score.error.relative_percent for score in scores),
            moving=candidate.moving.relative_percent,
            moving_validation=tuple(score.moving.relative_percent for score in scores),
        )

    found = [of(candidate) for candidate in estimate.candidates]
    prior = estimate.model.prior
    if prior is not None:
        found.insert(0, Estimated(CAD, estimate.base.K @ prior, None, None, ()))
    return tuple(found)


class _TraceCollector:
    """Collector of one recording's traces, chunk after chunk, against the chosen estimate."""

    def __init__(self, estimate: Estimate, most: int) -> None:
        self._estimate, self._most = estimate, most
        self._envelope: Envelope | None = None
        self._welch: Welch | None = None
        self._velocity = Scatter(4 * most)
        self._spikes: list[Spike | None] = [None] * estimate.model.chain.joints
        self._last = -np.inf
        self._period = 0.0
        self.torque: Array = np.zeros((0, 0))

    def add(self, rows: Rows) -> None:
        """Add the next equations; `torque` then holds their torques in the units of the estimate, (samples, joints)."""
        self.torque = rows.torque * self._estimate.prepared.torque_scales
        if not len(rows.time):
            return
        joints = self.torque.shape[1]
        if self._envelope is None or self._welch is None:
            self._period = float(np.median(np.diff(rows.time))) if len(rows.time) > 1 else 1e-3
            self._envelope = Envelope(3 * joints, self._most, self._period)
            self._welch = Welch(joints, 1.0 / self._period)
        predicted = np.tensordot(self._estimate.beta, rows.H_b, axes=(0, 1))
        measured = self.torque.T
        residual = measured - predicted
        values = np.concatenate([measured, predicted, residual])
        self._envelope.add(rows.time, values, np.tile(~rows.keep.T, (3, 1)))
        self._velocity.add(np.column_stack([rows.time, rows.velocity]))
        self._look_for_spikes(rows, residual)
        # Spectra are of stretches without a gap.
        breaks = np.flatnonzero(np.diff(rows.time, prepend=self._last) > 1.5 * self._period).tolist()
        for begin, end in pairwise(sorted({0, *breaks, len(rows.time)})):
            self._welch.add(residual[:, begin:end], after_gap=begin in breaks)
        self._last = float(rows.time[-1])

    def _look_for_spikes(self, rows: Rows, residual: Array) -> None:
        sizes = np.where(rows.keep.T, np.abs(residual), -1.0)
        for joint, row in enumerate(np.argmax(sizes, axis=1)):
            known = self._spikes[joint]
            if sizes[joint, row] > (-1.0 if known is None else abs(known.residual)):
                at, value = float(rows.time[row]), float(residual[joint, row])
                self._spikes[joint] = Spike(at, value, np.array(rows.position[row]))

    def traced(self, recording: Recording, role: Role) -> PredictionTrace:
        """Return the recording's traces and spectra."""
        if self._envelope is None or self._welch is None:
            raise AssertionError("a recording that was identified from has equations")
        joints = len(self._envelope.extremes) // 3
        extremes, marked, time = self._envelope.extremes, self._envelope.marked, self._envelope.time
        rows = self._velocity.rows()
        middle = np.clip(np.searchsorted(rows[:, 0], time), 0, len(rows) - 1)
        velocity = rows[middle, 1:]
        traces = tuple(
            JointTrace(
                torque=extremes[k],
                predicted=extremes[joints + k],
                residual=extremes[2 * joints + k],
                velocity=velocity[:, k],
                standstill=marked[k],
            )
            for k in range(joints)
        )
        return PredictionTrace(
            name=recording.path.name,
            sha256=recording.sha256,
            role=role,
            time=time,
            width=self._envelope.width,
            joints=traces,
            spectra=self._spectra(),
            spikes=tuple(self._spikes),
            driver=driver_of(recording),
        )

    def _spectra(self) -> tuple[Spectrum, ...]:
        if self._welch is None or not self._welch.ready:
            return ()
        frequency, density = self._welch.density()
        lag, correlation = self._welch.correlation()
        white = self._welch.white
        return tuple(Spectrum(frequency, density[k], lag, correlation[k], white) for k in range(len(density)))
