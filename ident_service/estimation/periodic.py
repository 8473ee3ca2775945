"""Average a periodic motion over its periods before it is differentiated (Swevers et al. 1997).

Averaging n periods divides the noise by the square root of n without touching the motion, and what is left between
periods is an honest estimate of the noise. Derivatives of a periodic signal are exact in the frequency domain; only
harmonics up to the cut-off are kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident_service.config.recording import RecordingFormat
from ident_service.config.schema import Identification
from ident_service.errors import RecordingError
from ident_service.estimation.smoothing import Motion
from ident_service.estimation.spectra import with_filter
from ident_service.model.coulomb_direction import direction
from ident_service.model.zero_phase import widened
from ident_service.recordings.grid import grid
from ident_service.recordings.recording import Recording
from ident_service.recordings.segments import uniform

Array = NDArray[np.float64]
_WHOLE = 1e-3  # how far, in samples, a period may be from a whole number of them after all periods
_APERIODIC = 0.05  # of a joint's range: what periods may differ by and still be called periods


@dataclass(frozen=True)
class Averaged:
    """Mean period of a recording.

    Attributes:
        motion: one period.
        periods: how many were averaged.
        torque_noise: standard deviation of one torque sample between periods [N m or N], shape (joints,).
        position_noise: likewise of the position [rad or m], shape (joints,).
    """

    motion: Motion
    periods: int
    torque_noise: Array
    position_noise: Array


def averaged(
    recording: Recording,
    options: Identification,
    period: float,
    coupling: Array | None = None,
    fmt: RecordingFormat | None = None,
) -> Averaged:
    """Average a recording over its periods, in memory for one period.

    Args:
        recording: of a periodic motion; whatever is not (approach, return) trimmed by `fmt`.
        options: cut-off and rows near reversal.
        period: of the motion [s].
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
    length = max(round(period / step), 1)
    # The first and the last sample count both: n periods end one step before the next one would begin.
    total = (round((stamps.last_ns - stamps.first_ns) * 1e-9 / step) + 1) // length
    if total < 2:
        raise RecordingError(recording.path, f"holds {total} whole periods of {period:g} s; averaging needs two")
    if abs(period / step - length) * total > max(_WHOLE * length, 0.5):
        raise RecordingError(
            recording.path,
            f"a period of {period:g} s is {period / step:.3f} samples; set recording.rate to a whole number of them",
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
            f"joint {joint + 1} differs by {spread_q[joint]:.3g} between periods of {period:g} s; "
            "trim approach and return with recording.trim, or correct identification.period",
        )
    motion = _motion(mean_q, mean_tau, recording.torque_held, options, step, coupling)
    return Averaged(motion, total, spread_tau, spread_q)


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
    once = direction(rate, step, presliding)
    return Motion(
        np.arange(length, dtype=np.float64) * step,
        position,
        velocity,
        acceleration,
        torque,
        ~(near @ (C != 0.0)),
        direction(rate, step, presliding, once[-1]),
    )
