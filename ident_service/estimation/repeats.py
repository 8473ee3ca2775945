"""Find which stretches of the recordings show the same motion.

Where an arm repeats a motion, what its model lacks errs by the same torque again, so that the repetition says nothing
new about it, however many periods there are; only noise is drawn anew (Pintelon and Schoukens 2012, chapter 4). So
stretches of time are counted as one wherever the motion repeats itself, within a recording or from one to another.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident_service.config.recording import RecordingFormat
from ident_service.recordings.recording import Recording
from ident_service.recordings.resampling import grid, uniform

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Label = tuple[int, int]

_STEP = 0.02  # s; a motion up to 2 Hz moves by a tenth of its range meanwhile, see _SAME
_MOST = 1 << 17  # largest number of grid samples
_SHORTEST = 1.0  # s
_SAME = 0.04  # share of a joint's range that positions of the same motion may differ by
_HARDLY = 0.05  # share of the largest joint range: the least scale that joints are compared on
_PART = 0.5  # share of the common path length that has to agree
_LEAST = 0.2  # share of a period that has to be repeated
_CANDIDATES = 40


@dataclass(frozen=True)
class Stretches:
    """Division of a recording into stretches of time, labelled by the motion they show.

    Attributes:
        length: length of each stretch [s].
        origin: beginning of one of the stretches [s since the recording's first sample]; its first equation's when
            None.
        labels: labels of the stretches from number `first` on; stretches with the same label show the same motion.
        first: number of the stretch that the first label belongs to.
        recording: index of the recording, for stretches without a label.
    """

    length: float
    origin: float | None = None
    labels: tuple[Label, ...] = ()
    first: int = 0
    recording: int = 0

    def label(self, stretch_number: int) -> Label:
        """Return the label of the stretch with this number, equal for repeats of a motion; a unique one if unknown."""
        place = stretch_number - self.first
        return self.labels[place] if 0 <= place < len(self.labels) else (self.recording, stretch_number)


@dataclass(frozen=True)
class _Positions:
    """Positions every `step` seconds from the recording's first sample on, NaN in gaps, shape (samples, joints)."""

    q: Array
    step: float
    scale: Array


@dataclass(frozen=True)
class _Motion:
    """Reference motion: one period, or a whole recording where it does not repeat itself.

    Attributes:
        q: positions every `step` seconds, NaN where they are not known, shape (samples, joints).
        step: [s].
        scale: of the joints [rad or m].
        period: [s]; None where it does not repeat itself.
        length: of its stretches [s].
        number: of the motion.
    """

    q: Array
    step: float
    scale: Array
    period: float | None
    length: float
    number: int

    def shown(self, positions: _Positions, offset: float) -> Mask:
        """Return where a recording shows the motion, when its time plus `offset` [s] is that of the motion."""
        time = np.arange(len(positions.q)) * positions.step + offset
        place = np.rint((time if self.period is None else time % self.period) / self.step).astype(np.intp)
        place = place if self.period is None else place % len(self.q)
        inside = (place >= 0) & (place < len(self.q))
        apart = np.abs(positions.q - self.q[np.where(inside, place, 0)]) / self.scale
        return np.asarray(inside & (np.nan_to_num(apart, nan=np.inf).max(axis=1) < _SAME))


def stretches(
    recordings: Sequence[Recording],
    stretch_seconds: Sequence[float],
    fmt: RecordingFormat | None = None,
    *,
    stretches_per_period: int = 12,
) -> tuple[Stretches, ...]:
    """Divide each recording into stretches of time, labelled alike where they show the same motion.

    Args:
        recordings: of one arm.
        stretch_seconds: length of the stretches of each recording [s]; what repeats is cut into whole parts of
            about the same length.
        fmt: what to trim, what a gap is, and the rate; the defaults when None.
        stretches_per_period: least number of stretches in a period.

    Raises:
        RecordingError: a recording cannot be read.
    """
    seen = [_positions(recording, fmt or RecordingFormat()) for recording in recordings]
    periods = [_period(positions) for positions in seen]
    motions: list[_Motion] = []
    found: dict[int, Stretches] = {}
    # Motions that repeat themselves first, so that others are compared with a whole period.
    for index in sorted(range(len(seen)), key=lambda one: (periods[one] is None, one)):
        positions, period = seen[index], periods[index]
        for motion in motions:
            offset = _offset(motion, positions)
            if offset is not None:
                break
        else:
            motion, offset = _motion(positions, period, stretch_seconds[index], len(motions), stretches_per_period), 0.0
            motions.append(motion)
            if period is None and len(recordings) == 1:
                return (Stretches(stretch_seconds[index]),)
        found[index] = _cut(positions, motion, offset, index)
    return tuple(found[index] for index in range(len(seen)))


def _positions(recording: Recording, fmt: RecordingFormat) -> _Positions:
    stamps = grid(recording, fmt)
    duration = (stamps.last_ns - stamps.first_ns) * 1e-9
    step = max(_STEP, stamps.period_s, duration / _MOST)
    q = np.full((int(duration / step) + 1, recording.joints), np.nan)
    for piece in uniform(recording, fmt, stamps):
        # Every sample goes to its nearest grid time, the last of several stays: at most half a step off.
        q[np.rint((piece.block.stamp_ns - stamps.first_ns) * 1e-9 / step).astype(np.intp).clip(0, len(q) - 1)] = (
            piece.block.position
        )
    ranges = np.nanmax(q, axis=0) - np.nanmin(q, axis=0)
    return _Positions(q, step, np.maximum(ranges, max(_HARDLY * float(ranges.max()), 1e-9)))


def _period(positions: _Positions) -> float | None:
    """Return the shortest time [s] after which a recording repeats its motion; None where it does not."""
    q, scale = positions.q, positions.scale
    for lag in _candidates(q, q, scale, round(_SHORTEST / positions.step)):
        same = _same(q[lag:], q[:-lag], scale)
        if _covers_most_of_path(q[:-lag], same, scale, positions.step) and np.sum(same) >= _LEAST * lag:
            return _refined(positions, lag) * positions.step
    return None


def _refined(positions: _Positions, lag: int) -> float:
    """Return the period in steps, refined by the largest multiple of it that the recording shows."""
    q, scale, period = positions.q, positions.scale, float(lag)
    for times in range(1, len(q) // lag + 1):
        about = round(times * period)
        near = range(about - 2, min(about + 2, len(q) - 1) + 1)
        apart = []
        for shift in near:
            same = _same(q[shift:], q[:-shift], scale)
            differences = (q[shift:] - q[:-shift])[same] / scale
            apart.append(float(np.mean(differences**2)) if same.sum() >= _LEAST * lag else np.inf)
        best = int(np.argmin(apart))
        if not np.isfinite(apart[best]):
            break
        period = (near[best] + _vertex(apart, best)) / times
    return period


def _vertex(values: Sequence[float], place: int) -> float:
    """Return the offset from `place` to the vertex of the parabola through the value there and its neighbours."""
    if not 0 < place < len(values) - 1:
        return 0.0
    before, here, after = values[place - 1 : place + 2]
    curve = before - 2.0 * here + after
    return 0.5 * (before - after) / curve if np.isfinite(curve) and curve > 0.0 else 0.0


def _motion(positions: _Positions, period: float | None, length: float, number: int, phases: int) -> _Motion:
    q, step, scale = positions.q, positions.step, positions.scale
    if period is None:
        return _Motion(q, step, scale, None, length, number)
    lag = round(period / step)
    same = _same(q[lag:], q[:-lag], scale)
    shown = np.concatenate([same, np.zeros(lag, bool)]) | np.concatenate([np.zeros(lag, bool), same])
    mean = np.full((lag, q.shape[1]), np.nan)
    places = np.rint((np.arange(len(q)) * step % period) / step).astype(np.intp) % lag
    rows = np.flatnonzero(shown)[np.argsort(places[shown], kind="stable")]
    counts = np.bincount(places[shown], minlength=lag)
    begins = np.cumsum(counts) - counts
    for often in np.unique(counts[counts > 0]).tolist():
        alike = np.flatnonzero(counts == often)
        mean[alike] = np.median(q[rows[begins[alike, None] + np.arange(often)]], axis=1)
    count = max(phases, round(period / length))
    return _Motion(mean, period / lag, scale, period, period / count, number)


def _offset(motion: _Motion, positions: _Positions) -> float | None:
    """Return what to add to a recording's time [s] to have that of a motion; None where it shows another."""
    step, q = motion.step, positions.q
    if abs(positions.step - step) > 1e-3 * step:
        q = q[np.rint(np.arange(0.0, len(q) - 0.5, step / positions.step)).astype(np.intp).clip(0, len(q) - 1)]
    reference = motion.q if motion.period is None else np.concatenate([motion.q, motion.q])
    best: tuple[float, float] | None = None
    for lag in _candidates(reference, q, motion.scale, None):
        offset = lag * step
        shown = motion.shown(positions, offset)
        if _covers_most_of_path(positions.q, shown, motion.scale, positions.step):
            share = float(np.mean(shown))
            best = max(best or (0.0, 0.0), (share, offset))
    return None if best is None else best[1]


def _cut(positions: _Positions, motion: _Motion, offset: float, recording: int) -> Stretches:
    """Number the stretches of a recording in the time of a motion, and label those that show it."""
    length, step = motion.length, positions.step
    shown = motion.shown(positions, offset)
    numbers = np.floor((np.arange(len(shown)) * step + offset) / length + 1e-9).astype(np.intp)
    first = int(numbers[0])
    share = np.bincount(numbers - first, weights=shown) / np.maximum(np.bincount(numbers - first), 1)
    count = None if motion.period is None else round(motion.period / length)
    labels = tuple(
        (-1 - motion.number, number if count is None else number % count) if part > _PART else (recording, number)
        for number, part in enumerate(share, start=first)
    )
    return Stretches(length, -offset, labels, first, recording)


def _candidates(reference: Array, q: Array, scale: Array, least: int | None) -> Iterator[int]:
    """Yield lags at which `reference[lag:]` is most like `q`: those from `least` on in order, or the best first."""
    size = len(reference) + len(q)
    length = 1 << (size - 1).bit_length()

    def spectra(values: Array) -> list[NDArray[np.complex128]]:
        known = np.all(np.isfinite(values), axis=1, keepdims=True)
        centred = np.where(known, (values - middle) / scale, 0.0)
        parts = known.astype(float), np.sum(centred**2, axis=1, keepdims=True), centred
        return [np.fft.rfft(part, length, axis=0).T for part in parts]

    middle = np.nanmean(reference, axis=0)
    (known_a, squared_a, a), (known_b, squared_b, b) = spectra(reference), spectra(q)
    both = np.fft.irfft(known_a[0] * known_b[0].conj(), length)
    cross = np.fft.irfft(np.sum(a * b.conj(), axis=0), length)
    squares = np.fft.irfft(squared_a[0] * known_b[0].conj() + known_a[0] * squared_b[0].conj(), length)
    lags = np.arange(length)
    lags = np.where(lags < len(reference), lags, lags - length)
    order = np.argsort(lags)
    lags, both = lags[order], both[order]
    distance = np.where(both > 1.0, (squares - 2.0 * cross)[order] / np.maximum(both, 1.0), np.inf)
    lowest = np.flatnonzero((distance[1:-1] <= distance[:-2]) & (distance[1:-1] < distance[2:])) + 1
    if least is not None:
        lowest = lowest[lags[lowest] >= least]
    best = lowest[np.argsort(distance[lowest], kind="stable")][:_CANDIDATES]
    yield from (np.sort(lags[best]) if least is not None else lags[best]).tolist()


def _same(one: Array, other: Array, scale: Array) -> Mask:
    return np.asarray(np.nan_to_num(np.abs(one - other) / scale, nan=np.inf).max(axis=1) < _SAME)


def _covers_most_of_path(q: Array, same: Mask, scale: Array, step: float) -> bool:
    """Return whether the samples that agree make up most of the travelled distance, not only a rest."""
    way = np.nansum(np.abs(np.diff(q, axis=0)) / scale, axis=1)
    return bool(same.sum() * step >= _SHORTEST) and float(way @ same[1:]) >= _PART * float(way.sum()) > 0.0
