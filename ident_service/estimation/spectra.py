"""Choose the cut-off of the smoothing filter, and the rate after it, from the spectra of the recorded positions.

A filter has to pass the motion and to stop the noise, which two differentiations raise with the fourth power of the
frequency. So the cut-off is a few times the frequency that the motion's velocity ends at, but not beyond the one below
which the noise is a few percent of the acceleration: noise in the regressor biases least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from ident_service.config.arm import Identification
from ident_service.config.recording import RecordingFormat
from ident_service.model.arm_model import ArmModel
from ident_service.recordings.cached_recording import memory_of
from ident_service.recordings.recording import Recording
from ident_service.recordings.resampling import grid, uniform

Array = NDArray[np.float64]
USUAL = 8.0  # Hz; lower, and filtered friction would not turn round where the velocity does
_MARGIN = 5.0  # of the motion's own bandwidth
_LEAST_MARGIN = 2.0  # of it, however noisy the positions are
_MOVING = 0.99  # of the velocity's energy is motion
_ABOVE_NOISE = 3.0  # power that is no noise, of the noise's
_NOISE = 1e-3  # of the acceleration's power; 3 % of its size
_ROUNDED = 1.1  # of the frequency where noise begins: cut-offs that are chosen there have two digits
_HIGHEST = 0.2  # of the sampling rate; above half of it there is nothing
_KEPT = 10.0  # samples a period of the cut-off
EDGE = 2.0  # periods of the cut-off at the ends, where the filter has one side to look at
_WINDOW_S = 20.0
_SAMPLES = 16384


@dataclass(frozen=True)
class Spectrum:
    """Frequencies of a recording at which its motion ends and its noise begins.

    Attributes:
        rate: of the samples [Hz].
        motion: frequency below which the fastest joint's motion lies [Hz].
        noise: frequency below which noise is a few percent of most joints' accelerations [Hz].
    """

    rate: float
    motion: float
    noise: float

    @property
    def cutoff(self) -> float:
        """Return the filter's cut-off [Hz]: above the motion's spectrum and, where there is room, below the noise."""
        wanted = max(_MARGIN * self.motion, USUAL)
        return min(wanted, max(self.noise, _LEAST_MARGIN * self.motion), _HIGHEST * self.rate)


def with_filter(
    recordings: Sequence[Recording], options: Identification, fmt: RecordingFormat | None = None
) -> Identification:
    """Return the options with `choose` of cut-off, decimation and edge replaced, from the recordings' spectra.

    Args:
        recordings: read once where there is something to choose.
        options: how to smooth.
        fmt: what to trim, what a gap is, and the rate; the defaults when None.

    Raises:
        RecordingError: a recording cannot be read.
    """
    smoothing, fmt = options.smoothing, fmt or RecordingFormat()
    if "choose" not in (smoothing.cutoff, smoothing.decimate, options.edge):
        return options
    if smoothing.cutoff == "choose":
        seen = [spectrum(recording, fmt, from_velocities=smoothing.velocity == "measured") for recording in recordings]
        cutoff, rate = float(f"{max(one.cutoff for one in seen):.2g}"), min(one.rate for one in seen)
    else:
        cutoff, rate = smoothing.cutoff, min(1.0 / grid(recording, fmt).period_s for recording in recordings)
    keep = smoothing.decimate if smoothing.decimate != "choose" else max(1, int(rate / (_KEPT * cutoff)))
    chosen = smoothing.model_copy(update={"cutoff": cutoff, "decimate": keep})
    edge = options.edge if options.edge != "choose" else EDGE / min(cutoff, smoothing.regressor_cutoff or cutoff)
    return options.model_copy(update={"smoothing": chosen, "edge": edge})


def with_chosen_cutoff(model: ArmModel, recordings: Sequence[Recording]) -> ArmModel:
    """Return the arm with the filter settings left to `choose` replaced, from the recordings' spectra.

    Raises:
        RecordingError: a recording cannot be read.
    """
    return model.with_options(with_filter(recordings, model.config.identification, model.config.recording))


def remarks_on_noise(recordings: Sequence[Recording], model: ArmModel) -> tuple[str, ...]:
    """Return a remark per recording whose position noise passes the filter; none where periods are averaged.

    Args:
        recordings: fitted recordings.
        model: the arm, with numbers for its filter.

    Raises:
        RecordingError: a recording cannot be read.
    """
    options, fmt = model.config.identification, model.config.recording
    if options.period is not None:  # periods are averaged, not filtered
        return ()
    cutoff, found = float(options.smoothing.cutoff), []
    for recording in recordings:
        noise = spectrum(recording, fmt, from_velocities=options.smoothing.velocity == "measured").noise
        if cutoff > _ROUNDED * noise:
            found.append(
                f"{recording.path.name}: noise of the positions is more than 3 % of the accelerations from"
                f" {noise:.2g} Hz on, and the filter passes up to {cutoff:.2g} Hz: least squares is then biased by more"
                " than its standard deviations show; identification.method: iv is not, and a lower"
                " identification.smoothing.cutoff lets less of it pass"
            )
    return tuple(found)


def spectrum(recording: Recording, fmt: RecordingFormat, *, from_velocities: bool = False) -> Spectrum:
    """Return the frequencies [Hz] where motion ends and noise begins in a recording's positions, kept for reuse.

    A recording that has a memory keeps it: the choice of the filter and remarks on noise ask for the same.

    Args:
        recording: to look at.
        fmt: what to trim, what a gap is, and the rate.
        from_velocities: whether to look at its velocities instead, as far as it has any.

    Raises:
        RecordingError: it cannot be read.
    """
    memory, key = memory_of(recording), (fmt, from_velocities)
    if memory is not None and (found := memory.recall("spectrum", key)) is not None:
        return cast("Spectrum", found)
    seen = _spectrum(recording, fmt, from_velocities)
    if memory is not None:
        memory.remember("spectrum", key, seen)
    return seen


def _spectrum(recording: Recording, fmt: RecordingFormat, measured: bool) -> Spectrum:
    stamps = grid(recording, fmt)
    period = stamps.period_s
    length = min(int(_WINDOW_S / period), _SAMPLES, stamps.samples)
    power, windows, own = np.zeros((0, recording.joints)), 0, False
    waiting = np.zeros((0, recording.joints))
    for piece in uniform(recording, fmt, stamps, samples=_SAMPLES):
        own = measured and piece.block.velocity is not None
        waiting = np.concatenate([waiting, piece.block.velocity if own else piece.block.position])
        while len(waiting) >= length > 3:
            rates = waiting[1:length] if own else np.diff(waiting[:length], axis=0)
            rates = rates * np.hanning(length - 1)[:, None]
            found = np.abs(np.fft.rfft(rates, axis=0)) ** 2
            power = found if windows == 0 else power + found
            windows += 1
            waiting = waiting[length // 2 :]
        if piece.end:
            waiting = waiting[:0]
    if windows == 0:
        return Spectrum(1.0 / period, 0.0, 0.5 / period)  # later steps report that it is too short
    frequency = np.fft.rfftfreq(length - 1, period)[1:]
    # A difference multiplies power by this, and white noise of positions is that of rates after one.
    difference = (2.0 * np.sin(np.pi * frequency * period)) ** 2
    white = np.ones_like(difference) if own else difference
    ends = [
        _ends(power[1:, joint] / windows, frequency, period, difference, white)
        for joint in np.flatnonzero(power[1:].any(axis=0))
    ]
    if not ends:
        return Spectrum(1.0 / period, 0.0, 0.5 / period)
    motion, noise = np.array(ends).T
    return Spectrum(1.0 / period, float(motion.max()), float(np.median(noise)))


def _ends(
    power: NDArray[np.floating],
    frequency: NDArray[np.floating],
    period: float,
    difference: NDArray[np.floating],
    white: NDArray[np.floating],
) -> tuple[float, float]:
    """Return the frequencies [Hz] that a joint's motion ends at and its noise matters from; `power` is of its rates."""
    flat = power / white
    high = (frequency > 0.25 / period) & (frequency < 0.475 / period)
    # The mean of an exponential distribution from its median.
    floor = np.median(flat[high]) / np.log(2.0) if high.any() else 0.0
    width = max(1, round(1.0 / frequency[0]))  # 1 Hz
    smooth = np.convolve(flat, np.full(width, 1.0 / width), "same")
    below = np.flatnonzero(smooth <= _ABOVE_NOISE * floor)
    last = max(int(below[0]), 1) if len(below) else len(frequency)
    share = np.cumsum(power[:last]) / max(float(np.sum(power[:last])), np.finfo(float).tiny)
    noise = np.cumsum(floor * white * difference)
    motion = float(np.sum(np.maximum(power - floor * white, 0.0)[:last] * difference[:last]))
    loud = np.flatnonzero(noise > _NOISE * motion)
    matters = frequency[int(loud[0])] if len(loud) else frequency[-1]
    return float(frequency[np.argmax(share >= _MOVING)]), float(matters)
