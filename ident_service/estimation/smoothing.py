"""From positions to positions, velocities and accelerations, without phase (5.2.2).

Third-order Butterworth forwards and backwards, then central differences (five points, fourth order, twice for the
acceleration). Filtering and differencing commute, so their order does not matter. Runs in overlapping windows: memory
does not grow with the recording, and what a window's cut ends do has decayed below 1e-12 where windows meet.

A torque that is held from its stamp to the next (our own recordings) acts, on the average over the two intervals that a
central difference sees, as the mean of its own and the previous value; that is what stands beside the acceleration.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import scipy.ndimage
import scipy.signal
from numpy.typing import NDArray

from ident_service.config.schema import Identification
from ident_service.errors import RecordingError
from ident_service.record.recording import Block, Recording

Array = NDArray[np.float64]
_WINDOW = 16384
_DECAY = 28.0  # -ln(1e-12)
_DIFFERENCE = np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / 12.0
_JITTER = 0.2


@dataclass(frozen=True)
class Motion:
    """Smoothed samples and which of their equations count.

    Attributes:
        time: [s] since the recording's first sample, shape (samples,).
        position, velocity, acceleration: [rad or m and derivatives], shape (samples, joints).
        torque: [N m or N], shape (samples, joints).
        keep: False where a joint is too near standstill for its friction to be known, shape (samples, joints).
    """

    time: Array
    position: Array
    velocity: Array
    acceleration: Array
    torque: Array
    keep: NDArray[np.bool_]


def smoothed(recording: Recording, options: Identification) -> Iterator[Motion]:
    """Smoothed samples of a recording, block by block, its edges left out.

    Raises:
        RecordingError: too short for the filter, or stamps too irregular to be differenced.
    """
    first = next(iter(recording.blocks(_WINDOW)), None)
    if first is None or len(first.stamp_ns) < 2:
        raise RecordingError(recording.path, "holds no samples; record the motion again")
    period = float(np.median(np.diff(first.stamp_ns))) * 1e-9
    if options.smoothing.cutoff >= 0.5 / period:
        raise RecordingError(
            recording.path,
            f"sampled at {1.0 / period:.4g} Hz, too slow for a cut-off of {options.smoothing.cutoff:g} Hz; "
            "lower identification.smoothing.cutoff",
        )
    sos = scipy.signal.butter(options.smoothing.order, options.smoothing.cutoff, fs=1.0 / period, output="sos")
    slowest = 2.0 * np.pi * options.smoothing.cutoff * np.sin(np.pi / (2 * options.smoothing.order))
    margin = int(np.ceil(_DECAY / slowest / period)) + int(np.ceil(options.reversal.window / period)) + 4
    edge = int(np.ceil(options.edge / period))
    count = 0
    for window, start, stop, begin, end in _windows(recording, margin, period):
        count = begin + len(window.stamp_ns)
        motion = _smooth(window, options, sos, period, recording.torque_held)
        # The recording's own edges, where the filter has only one side to look at, are left out.
        low = max(start, edge - begin)
        high = min(stop, len(window.stamp_ns) - edge) if end else stop
        if high > low:
            yield _part(motion, slice(low, high), begin * period)
    if count * period < 2.0 * options.edge + 1.0 or count < 2 * margin:
        shortest = max(2.0 * options.edge + 1.0, 2 * margin * period)
        raise RecordingError(
            recording.path,
            f"{count * period:.3g} s of samples are too few to smooth; at least {shortest:.3g} s are needed",
        )


def _windows(recording: Recording, margin: int, period: float) -> Iterator[tuple[Block, int, int, int, bool]]:
    """Windows with `margin` samples of overlap: block, inner start and stop, its first sample's index, whether last."""
    held: list[Block] = []
    length, begin, left = 0, 0, 0
    for block in _checked(recording, period):
        held.append(block)
        length += len(block.stamp_ns)
        if length >= _WINDOW + 2 * margin:
            window = _joined(held)
            yield window, left, length - margin, begin, False
            # Keep the margin that was withheld and the margin before it.
            cut = length - 2 * margin
            held = [_slice(window, slice(cut, length))]
            begin, length, left = begin + cut, 2 * margin, margin
    if length:
        yield _joined(held), left, length, begin, True


def _checked(recording: Recording, period: float) -> Iterator[Block]:
    last: int | None = None
    index = 0
    for block in recording.blocks(_WINDOW):
        stamps = block.stamp_ns if last is None else np.concatenate([[last], block.stamp_ns])
        steps = np.diff(stamps) * 1e-9
        if len(steps) and float(np.abs(steps - period).max()) > _JITTER * period:
            worst = int(np.abs(steps - period).argmax())
            raise RecordingError(
                recording.path,
                f"irregular stamps: {steps[worst] * 1e3:.3f} ms at sample {index + worst}, "
                f"where {period * 1e3:.3f} ms are usual; resample the recording to a fixed rate",
            )
        index += len(block.stamp_ns)
        last = int(block.stamp_ns[-1])
        yield block


def _smooth(window: Block, options: Identification, sos: Array, period: float, held: bool) -> Motion:
    length = len(window.stamp_ns)
    # Odd extension as scipy's default, as long as the data allow.
    pad = min(3 * int(1.0 / (options.smoothing.cutoff * period)), length - 1)

    def low_pass(values: Array) -> Array:
        return np.asarray(scipy.signal.sosfiltfilt(sos, values, axis=0, padlen=pad))

    position = low_pass(window.position)
    velocity = _differenced(position, period)
    acceleration = _differenced(velocity, period)
    torque = window.torque
    if held:
        torque = np.vstack([torque[:1], 0.5 * (torque[:-1] + torque[1:])])
    if options.smoothing.filter_torque:
        torque = low_pass(torque)
    near = np.abs(velocity) <= options.reversal.speed
    near[1:] |= np.diff(np.signbit(velocity), axis=0)
    reach = round(options.reversal.window / period)
    keep = ~scipy.ndimage.binary_dilation(near, np.ones((2 * reach + 1, 1), dtype=bool)) if reach else ~near
    time = np.arange(length, dtype=np.float64) * period
    return Motion(time, position, velocity, acceleration, torque, keep)


def _differenced(values: Array, period: float) -> Array:
    return np.asarray(scipy.ndimage.correlate1d(values, _DIFFERENCE / period, axis=0, mode="nearest"))


def _part(motion: Motion, part: slice, offset: float) -> Motion:
    return Motion(
        motion.time[part] + offset,
        motion.position[part],
        motion.velocity[part],
        motion.acceleration[part],
        motion.torque[part],
        motion.keep[part],
    )


def _joined(blocks: Iterable[Block]) -> Block:
    parts = list(blocks)
    if len(parts) == 1:
        return parts[0]
    return Block(
        np.concatenate([part.stamp_ns for part in parts]),
        np.concatenate([part.position for part in parts]),
        np.concatenate([part.torque for part in parts]),
    )


def _slice(block: Block, part: slice) -> Block:
    return Block(block.stamp_ns[part], block.position[part], block.torque[part])
