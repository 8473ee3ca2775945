"""Turn positions into positions, velocities and accelerations without phase, and average repeated periods before.

Third-order Butterworth forwards and backwards, then central differences (five points, fourth order, twice for the
acceleration); filtering and differencing commute, so their order does not matter. Or local polynomials
(Savitzky-Golay), whose derivatives come with them. Both run in overlapping windows: memory does not grow with the
recording, and what a window's cut ends do has decayed below 1e-12 where windows meet.

A torque that is held from its stamp to the next (our own recordings) acts, on the average over the two intervals that a
central difference sees, as the mean of its own and the previous value; that is what stands beside the acceleration.

Averaging n periods divides the noise by the square root of n without touching the motion, and what is left between
periods is an honest estimate of the noise. Derivatives of a periodic signal are exact in the frequency domain; only
harmonics up to the cut-off are kept.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident_service.config.arm import Identification
from ident_service.config.recording import RecordingFormat
from ident_service.errors import RecordingError
from ident_service.estimation.spectra import with_filter
from ident_service.model.friction_state import friction_direction
from ident_service.model.zero_phase import local_polynomial, low_pass, spline_shifted, widened
from ident_service.recordings.cached_recording import memory_of
from ident_service.recordings.recording import Block, Recording, cut, join
from ident_service.recordings.resampling import Grid, UniformRun, grid, uniform

Array = NDArray[np.float64]
_WINDOW = 16384
_DECAY = 28.0  # -ln(1e-12)


@dataclass(frozen=True)
class Motion:
    """Smoothed samples, with a mask of those whose equations count.

    Attributes:
        time: [s] since the recording's first sample, shape (samples,).
        position, velocity, acceleration: [rad or m and derivatives], shape (samples, joints).
        torque: [N m or N], shape (samples, joints).
        keep: False where a drive of the joint is too near standstill for its friction to be known, (samples, joints).
        direction: of Coulomb friction per drive, between -1 and 1, shape (samples, joints).
    """

    time: Array
    position: Array
    velocity: Array
    acceleration: Array
    torque: Array
    keep: NDArray[np.bool_]
    direction: Array | None = None

    def __getitem__(self, part: slice | NDArray[np.intp]) -> Motion:
        """Return some of the samples."""
        return Motion(
            self.time[part],
            self.position[part],
            self.velocity[part],
            self.acceleration[part],
            self.torque[part],
            self.keep[part],
            None if self.direction is None else self.direction[part],
        )


@dataclass(frozen=True)
class Window:
    """Smoothed samples of which only `inner` counts; the others are the filter's margin."""

    motion: Motion
    inner: slice


def smoothed(
    recording: Recording,
    options: Identification,
    coupling: Array | None = None,
    fmt: RecordingFormat | None = None,
) -> Iterator[Motion]:
    """Yield smoothed position, velocity, acceleration and torque in blocks, without the edges of each stretch.

    Args:
        recording: to read.
        options: how to smooth.
        coupling: drive coordinates per joint coordinates, shape (joints, joints); the identity when None.
        fmt: what to trim, what a gap is, and the rate; the defaults when None.

    Raises:
        RecordingError: too short for the filter, or what reading the recording raises.
    """
    options = with_filter([recording], options, fmt)
    step = int(options.smoothing.decimate)
    offset = 0
    for window in windows(recording, options, coupling, fmt):
        inner = window.motion[window.inner]
        # Every `step`-th sample of the recording, wherever windows meet.
        yield inner[slice((-offset) % step, None, step)] if step > 1 else inner
        offset += len(inner.time)


def windows(
    recording: Recording,
    options: Identification,
    coupling: Array | None = None,
    fmt: RecordingFormat | None = None,
    extra_margin: float = 0.0,
) -> Iterator[Window]:
    """Yield smoothed samples in windows that overlap by the filter's memory plus `extra_margin` [s] on both sides.

    Raises:
        RecordingError: as for `smoothed`.
    """
    fmt = fmt or RecordingFormat()
    stamps = grid(recording, fmt)
    period = stamps.period_s
    options = with_filter([recording], options, fmt)
    smoother = _Smoother(recording, options, period)
    way = _FrictionDirection(recording.joints, options, period, coupling)
    left_out = float(options.edge)
    edge = int(np.ceil(left_out / period))
    # A window that is not the last must never hold samples of the recording's end edge.
    margin = max(smoother.margin + int(np.ceil(extra_margin / period)), edge)
    shortest = max(2.0 * left_out + 1.0, 2 * margin * period)
    for smooth in _smooth_windows(recording, fmt, stamps, smoother, margin, shortest):
        motion = way(smooth, slice(max(smooth.stop - margin, 0), smooth.stop))
        # At the edges of a stretch the filter has only one side to look at.
        low = max(smooth.start, edge) if smooth.opens else smooth.start
        high = min(smooth.stop, len(motion.time) - edge) if smooth.closes else smooth.stop
        if high > low:
            yield Window(motion, slice(low, high))


@dataclass(frozen=True)
class _Smooth:
    """A window of smoothed samples, whatever is known of friction.

    Attributes:
        time: [s] since the recording's first sample, shape (samples,).
        position, velocity, acceleration: [rad or m and derivatives], shape (samples, joints).
        torque: [N m or N], shape (samples, joints).
        start: index of the first sample that counts; no sample counts in two windows.
        stop: index after the last sample that counts.
        opens: whether a stretch without gaps begins with it.
        closes: whether a stretch without gaps ends with it.
    """

    time: Array
    position: Array
    velocity: Array
    acceleration: Array
    torque: Array
    start: int
    stop: int
    opens: bool
    closes: bool

    @property
    def nbytes(self) -> int:
        """Return the size in memory [bytes]."""
        return self.time.nbytes + 4 * self.position.nbytes


def _smooth_windows(
    recording: Recording, fmt: RecordingFormat, stamps: Grid, smoother: _Smoother, margin: int, shortest: float
) -> Iterator[_Smooth]:
    """Smooth a recording, or recall what the same filter made of it: trials, equations and evidence ask for it."""
    memory, key = memory_of(recording), (fmt, smoother.key, margin, shortest)
    if memory is not None and (found := memory.recall("smoothed", key)) is not None:
        yield from found
        return
    kept: list[_Smooth] | None = None if memory is None else []
    size = 0
    pieces = uniform(recording, fmt, stamps, shortest_s=shortest, samples=_WINDOW)
    for window, start, stop, opens, closes in _overlapping(pieces, margin):
        smooth = _Smooth(*smoother(window, stamps.first_ns), start, stop, opens, closes)
        for array in (smooth.time, smooth.position, smooth.velocity, smooth.acceleration, smooth.torque):
            array.setflags(write=False)
        size += smooth.nbytes
        if memory is not None and size > memory.max_bytes:
            kept = None
        if kept is not None:
            kept.append(smooth)
        yield smooth
    if memory is not None and kept is not None:
        memory.remember("smoothed", key, kept)


class _Smoother:
    """The filter of one recording.

    Attributes:
        margin: samples on either side of a window that its ends reach.
        key: key of everything beside the recording that the results depend on.
    """

    def __init__(self, recording: Recording, options: Identification, period: float) -> None:
        smoothing = options.smoothing
        self._cutoff = float(smoothing.cutoff)
        if self._cutoff >= 0.5 / period:
            raise RecordingError(
                recording.path,
                f"sampled at {1.0 / period:.4g} Hz, too slow for a cut-off of {self._cutoff:g} Hz; "
                "lower identification.smoothing.cutoff",
            )
        self._smoothing, self._period, self._held = smoothing, period, recording.torque_zero_order_hold
        self._path = recording.path
        self._delay = 0.0 if isinstance(options.delay, str) else float(options.delay)
        slowest = 2.0 * np.pi * self._cutoff * np.sin(np.pi / (2 * smoothing.order))
        memory = _DECAY / slowest
        if smoothing.method == "savitzky_golay":
            # The polynomial's window that has about the cut-off asked for (Schafer 2011).
            half = max(smoothing.order + 2, round((smoothing.order + 1) / (3.2 * 2 * self._cutoff * period) + 0.7))
            self._length = 2 * half + 1
            memory = max(half * period, memory if smoothing.filter_torque else 0.0)
        reach = options.reversal.window + abs(self._delay)
        self.margin = int(np.ceil(memory / period)) + int(np.ceil(reach / period)) + 4
        self.key = (smoothing.model_copy(update={"decimate": 1}), self._delay)

    def __call__(self, window: Block, first_ns: int) -> tuple[Array, Array, Array, Array, Array]:
        """Give time, position, velocity, acceleration and torque of a window."""
        position, velocity, acceleration = self._derivatives(window)
        torque = window.torque
        if self._held:
            torque = np.vstack([torque[:1], 0.5 * (torque[:-1] + torque[1:])])
        if self._delay:
            torque = spline_shifted(torque, self._delay / self._period)
        if self._smoothing.filter_torque:
            torque = self._low_pass(torque)
        time = np.asarray((window.stamp_ns - first_ns) * 1e-9, dtype=np.float64)
        return time, position, velocity, acceleration, torque

    def _derivatives(self, window: Block) -> tuple[Array, Array, Array]:
        values, measured = window.position, self._measured(window)
        if self._smoothing.method == "savitzky_golay":
            length, degree = min(self._length, len(values) - (len(values) + 1) % 2), self._smoothing.order

            def fitted(of: Array, derivative: int) -> Array:
                return np.asarray(local_polynomial(of, length, degree, derivative, self._period))

            if measured is not None:
                return fitted(values, 0), fitted(measured, 0), fitted(measured, 1)
            return fitted(values, 0), fitted(values, 1), fitted(values, 2)
        position = self._low_pass(values)
        velocity = self._differenced(position) if measured is None else self._low_pass(measured)
        return position, velocity, self._differenced(velocity)

    def _measured(self, window: Block) -> Array | None:
        if self._smoothing.velocity != "measured":
            return None
        if window.velocity is None:
            raise RecordingError(
                self._path, "has no velocities; leave out identification.smoothing.velocity or set it to position"
            )
        return window.velocity

    def _low_pass(self, values: Array) -> Array:
        smoothing = self._smoothing
        pad = min(3 * int(1.0 / (self._cutoff * self._period)), len(values) - 1)
        return low_pass(values, smoothing.order, self._cutoff, 1.0 / self._period, pad)

    def _differenced(self, values: Array) -> Array:
        padded = np.pad(values, ((2, 2), (0, 0)), mode="edge")
        return np.asarray((8.0 * (padded[3:-1] - padded[1:-3]) - (padded[4:] - padded[:-4])) / (12.0 * self._period))


class _FrictionDirection:
    """Direction of friction; its windows must come in order, because friction has a memory."""

    def __init__(self, joints: int, options: Identification, period: float, coupling: Array | None) -> None:
        self._reversal, self._period = options.reversal, period
        self._coupling = np.eye(joints) if coupling is None else coupling
        presliding = options.friction.presliding
        if presliding == "fit":
            presliding = 0.0
        self._presliding = np.broadcast_to(np.asarray(presliding, dtype=float), (joints,))
        self._direction = np.zeros((0, joints))

    def __call__(self, smooth: _Smooth, again: slice) -> Motion:
        """Say of a window which of its equations count; the next one begins with the samples `again` of this one."""
        rate = smooth.velocity @ self._coupling.T
        near = np.abs(rate) <= self._reversal.speed
        near[1:] |= np.diff(np.signbit(rate), axis=0)
        reach = round(self._reversal.window / self._period)
        keep = ~(widened(near, reach) @ (self._coupling != 0.0))
        # What the window before knew better, because it had both sides to look at, stands.
        known = self._direction[:0] if smooth.opens else self._direction
        start = known[-1] if len(known) else None
        way = np.vstack([known, friction_direction(rate[len(known) :], self._period, self._presliding, start)])
        self._direction = way[again]
        return Motion(smooth.time, smooth.position, smooth.velocity, smooth.acceleration, smooth.torque, keep, way)


def _overlapping(pieces: Iterable[UniformRun], margin: int) -> Iterator[tuple[Block, int, int, bool, bool]]:
    """Yield windows of the stretches in order: block, inner start and stop, whether it opens or closes a stretch."""
    held: list[Block] = []
    length, left, opens = 0, 0, True
    for piece in pieces:
        held.append(piece.block)
        length += len(piece.block.stamp_ns)
        if piece.end:
            yield join(held), left, length, opens, True
            held, length, left, opens = [], 0, 0, True
        elif length >= _WINDOW + 2 * margin:
            window = join(held)
            yield window, left, length - margin, opens, False
            # Keep the margin that was withheld and the margin before it.
            held = [cut(window, length - 2 * margin, length)]
            length, left, opens = 2 * margin, margin, False


_WHOLE = 1e-3  # how far, in samples, a period may be from a whole number of them after all periods
_APERIODIC = 0.05  # of a joint's range: what periods may differ by and still be called periods


@dataclass(frozen=True)
class Averaged:
    """Mean period of a recording.

    Attributes:
        motion: one period.
        periods: number of periods that were averaged.
        torque_noise: standard deviation of one torque sample between periods [N m or N], shape (joints,).
    """

    motion: Motion
    periods: int
    torque_noise: Array


def averaged(
    recording: Recording,
    options: Identification,
    motion_period: float,
    coupling: Array | None = None,
    fmt: RecordingFormat | None = None,
) -> Averaged:
    """Return the mean period of a periodic recording, smoothed; raises RecordingError if it does not repeat.

    Args:
        recording: recording of a periodic motion; whatever is not periodic (approach, return) is trimmed by `fmt`.
        options: cut-off and rows near reversal.
        motion_period: of the motion [s].
        coupling: drive coordinates per joint coordinates; the identity when None.
        fmt: what to trim and the rate.

    Raises:
        RecordingError: fewer than two whole periods, a period that is no whole number of samples, or a motion that
            does not repeat itself.
    """
    fmt = fmt or RecordingFormat()
    options = with_filter([recording], options, fmt)
    stamps = grid(recording, fmt)
    step = stamps.period_s
    length = max(round(motion_period / step), 1)
    # The first and the last sample count both: n periods end one step before the next one would begin.
    total = (round((stamps.last_ns - stamps.first_ns) * 1e-9 / step) + 1) // length
    if total < 2:
        raise RecordingError(recording.path, f"holds {total} whole periods of {motion_period:g} s; averaging needs two")
    if abs(motion_period / step - length) * total > max(_WHOLE * length, 0.5):
        raise RecordingError(
            recording.path,
            f"a period of {motion_period:g} s is {motion_period / step:.3f} samples; "
            "set recording.rate to a whole number of them",
        )
    counts = np.zeros(length)
    sums = np.zeros((4, length, recording.joints))
    for piece in uniform(recording, fmt, stamps):
        numbers = np.round((piece.block.stamp_ns - stamps.first_ns) * 1e-9 / step).astype(np.int64)
        whole = numbers < total * length
        phase = numbers[whole] % length
        q, tau = piece.block.position[whole], piece.block.torque[whole]
        np.add.at(counts, phase, 1.0)
        for target, values in zip(sums, (q, q**2, tau, tau**2), strict=True):
            np.add.at(target, phase, values)
    if counts.min() < 2:
        raise RecordingError(recording.path, "gaps leave parts of the period with fewer than two samples to average")
    n = counts[:, None]
    mean_q, mean_tau = sums[0] / n, sums[2] / n
    spread_q = np.sqrt(np.mean(np.maximum(sums[1] / n - mean_q**2, 0.0) * n / (n - 1.0), axis=0))
    spread_tau = np.sqrt(np.mean(np.maximum(sums[3] / n - mean_tau**2, 0.0) * n / (n - 1.0), axis=0))
    swing = np.ptp(mean_q, axis=0)
    if bool(np.any(spread_q > _APERIODIC * np.maximum(swing, 1e-6))):
        joint = int(np.argmax(spread_q / np.maximum(swing, 1e-6)))
        raise RecordingError(
            recording.path,
            f"joint {joint + 1} differs by {spread_q[joint]:.3g} between periods of {motion_period:g} s; "
            "trim approach and return with recording.trim, or correct identification.period",
        )
    motion = _motion(mean_q, mean_tau, recording.torque_zero_order_hold, options, step, coupling)
    return Averaged(motion, total, spread_tau)


def _motion(
    q: Array, torque: Array, held: bool, options: Identification, step: float, coupling: Array | None
) -> Motion:
    length, joints = q.shape
    harmonics = 2j * np.pi * np.fft.rfftfreq(length, step)[:, None]
    spectrum = np.fft.rfft(q, axis=0)
    spectrum[np.abs(harmonics[:, 0]) > 2.0 * np.pi * float(options.smoothing.cutoff)] = 0.0
    position, velocity, acceleration = (np.fft.irfft(spectrum * harmonics**order, length, axis=0) for order in range(3))
    if held:
        torque = 0.5 * (torque + np.roll(torque, 1, axis=0))
    if not isinstance(options.delay, str) and options.delay:
        torque = np.fft.irfft(np.fft.rfft(torque, axis=0) * np.exp(harmonics * float(options.delay)), length, axis=0)
    C = np.eye(joints) if coupling is None else coupling
    rate = velocity @ C.T
    near = np.abs(rate) <= options.reversal.speed
    near |= np.signbit(rate) != np.signbit(np.roll(rate, 1, axis=0))
    reach = round(options.reversal.window / step)
    if reach:
        near = widened(np.concatenate([near[-reach:], near, near[:reach]]), reach)[reach:-reach]
    shape = options.friction.presliding
    presliding = np.broadcast_to(np.asarray(0.0 if shape == "fit" else shape, dtype=float), (joints,))
    # One pass over the period first, for the friction direction that it begins with.
    once = friction_direction(rate, step, presliding)
    return Motion(
        np.arange(length, dtype=np.float64) * step,
        position,
        velocity,
        acceleration,
        torque,
        ~(near @ (C != 0.0)),
        friction_direction(rate, step, presliding, once[-1]),
    )
