"""Filter with zero phase, fit local polynomials, and shift by parts of a sample.

They do as scipy.signal's `sosfiltfilt` and `savgol_filter`, and scipy.ndimage's `shift`. Loading scipy.signal, which
brings scipy.stats, interpolate, ndimage and spatial, takes half a second. That is more than identifying an arm from a
minute of recording, and every verb that looks at positions would pay it. A recursive filter is a triangular system with
a band of three, `A y = B x`, and a cubic spline one with a band of three about its diagonal; LAPACK solves both for all
joints at once.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def low_pass(values: Array, order: int, cutoff: float, rate: float, pad_samples: int | None = None) -> Array:
    """Filter every column both ways with a Butterworth low-pass, so without phase; same shape; ValueError if too short.

    Each end is continued by its odd reflection, and the filter begins in the steady state of the first value, as
    Gustafsson (1996) has it for `filtfilt` in general.

    Args:
        values: shape (samples, ...).
        order: of the filter that runs in one direction.
        cutoff: [Hz], where one direction has -3 dB and both have -6 dB.
        rate: of the samples [Hz].
        pad_samples: samples of reflection, at most one less than there are; three times the order plus one when None.

    Returns:
        Shape of `values`.

    Raises:
        ValueError: a cut-off that is not between zero and half the rate, or no more samples than `pad_samples`.
    """
    sections = butterworth_sections(order, cutoff, rate)
    pad_samples = 3 * (2 * (order // 2) + order % 2 + 1) if pad_samples is None else pad_samples
    if len(values) <= pad_samples:
        raise ValueError(f"{len(values)} samples are not more than the {pad_samples} of a reflection")
    columns = np.asarray(values, dtype=float).reshape(len(values), -1)
    before = 2.0 * columns[:1] - columns[pad_samples:0:-1]
    after = 2.0 * columns[-1:] - columns[-2 : -pad_samples - 2 : -1]
    extended = np.concatenate([before, columns, after])
    both = _one_way(_one_way(extended, sections)[::-1], sections)[::-1]
    return np.ascontiguousarray(both[pad_samples : pad_samples + len(columns)]).reshape(values.shape)


def butterworth_sections(order: int, cutoff: float, rate: float) -> list[tuple[float, float, float]]:
    """Return the (g, a1, a2) of sections `g (1 + 1/z)^k / (1 + a1/z + a2/z^2)` of a Butterworth low-pass.

    Returns:
        Per section `(g, a1, a2)`; k is 2, or 1 in the last section of an odd order, where a2 is 0.

    Raises:
        ValueError: a cut-off that is not between zero and half the rate.
    """
    if not 0.0 < cutoff < 0.5 * rate:
        raise ValueError(f"a cut-off of {cutoff:g} Hz is not between 0 and half of {rate:g} Hz")
    K = math.tan(math.pi * cutoff / rate)
    sections = []
    for pair in range(order // 2):
        damping = math.sin(math.pi * (2 * pair + 1) / (2 * order))
        divisor = 1.0 + 2.0 * damping * K + K * K
        sections.append((K * K / divisor, 2.0 * (K * K - 1.0) / divisor, (1.0 - 2.0 * damping * K + K * K) / divisor))
    if order % 2:
        sections.append((K / (1.0 + K), (K - 1.0) / (K + 1.0), 0.0))
    return sections


def _one_way(columns: Array, sections: list[tuple[float, float, float]]) -> Array:
    from scipy.linalg.lapack import dtbtrs  # loads for 0.2 s; who looks at drives alone filters nothing

    # Unit gain at rest: what departs from the first value is filtered from zero, and the first value comes back.
    first = columns[:1]
    signal = np.asfortranarray(columns - first)
    for gain, a1, a2 in sections:
        driven = signal.copy(order="F")
        driven[1:] += (2.0 if a2 else 1.0) * signal[:-1]
        if a2:
            driven[2:] += signal[:-2]
        driven *= gain
        band = np.empty((3 if a2 else 2, len(columns)), order="F")
        band[0], band[1] = 1.0, a1
        if a2:
            band[2] = a2
        signal, _ = dtbtrs(band, driven, uplo="L", overwrite_b=True)
    return np.asarray(signal + first)


def local_polynomial(values: Array, window_samples: int, degree: int, derivative: int, period: float) -> Array:
    """Return the `derivative` (0: the value) of polynomials fitted to a window around each sample (Savitzky-Golay).

    The first and last half window belong to the polynomials of the first and last whole window.

    Args:
        values: shape (samples, ...), at least `window_samples` samples.
        window_samples: samples of a window, odd and more than `degree`.
        degree: of the polynomial.
        derivative: order of the derivative, 0 for the value itself.
        period: of the samples [s].

    Returns:
        Shape of `values`, in units of `values` per second to the power `derivative`.

    Raises:
        ValueError: fewer samples than a window, or a window that is even or not longer than the degree.
    """
    if window_samples % 2 == 0 or window_samples <= degree or len(values) < window_samples:
        raise ValueError(f"a window of {window_samples} samples for degree {degree} does not fit {len(values)} samples")
    half = window_samples // 2
    # Columns are powers of the place in the window, scaled to at most one: rows of the inverse are Taylor coefficients.
    place = np.arange(-half, half + 1) / half if half else np.zeros(1)
    to_coefficients = np.linalg.pinv(np.vander(place, degree + 1, increasing=True))
    powers = np.arange(derivative, degree + 1)
    factors = np.array([math.perm(int(power), derivative) for power in powers]) / (max(half, 1) * period) ** derivative

    def at(places: Array) -> Array:
        """Return weights of a window's samples for the derivative at places in it, shape (places, length)."""
        return (np.vander(places, len(powers), increasing=True) * factors) @ to_coefficients[derivative:]

    columns = np.asarray(values, dtype=float).reshape(len(values), -1)
    middle = at(place[half : half + 1])[0]
    inner = np.column_stack([np.correlate(column, middle) for column in columns.T])
    first, last = at(place[:half]) @ columns[:window_samples], at(place[half + 1 :]) @ columns[-window_samples:]
    return np.concatenate([first, inner, last]).reshape(values.shape)


_SPLINE_REACH = 12  # samples, after which a value counts for a ten-millionth in a cubic spline


def spline_shifted(values: Array, shift_samples: float) -> Array:
    """Return values read `shift_samples` (a fraction too) samples later, by a cubic spline; ends keep their values.

    Args:
        values: shape (samples, columns), at least one sample.
        shift_samples: number of samples further on at which the spline is read; negative for back.

    Returns:
        Shape of `values`.
    """
    from scipy.linalg.lapack import dgtsv  # loads for 0.2 s, as above

    pad = _SPLINE_REACH + math.ceil(abs(shift_samples))
    knots = np.pad(values, ((pad, pad), (0, 0)), mode="edge")
    # B-splines of a sixth, four sixths and a sixth at their knots, mirrored at the ends.
    before, after = np.ones(len(knots) - 1), np.ones(len(knots) - 1)
    before[-1] = after[0] = 2.0
    *_, coefficients, _ = dgtsv(before, np.full(len(knots), 4.0), after, knots)
    t = shift_samples - math.floor(shift_samples)
    weights = (1.0 - t) ** 3, 3.0 * t**3 - 6.0 * t**2 + 4.0, 1.0 + 3.0 * (t + t**2 - t**3), t**3
    first = pad + math.floor(shift_samples) - 1
    shifted = np.zeros(values.shape)
    for place, weight in enumerate(weights, first):
        shifted += weight * coefficients[place : place + len(values)]
    return shifted


def widened(mask: NDArray[np.bool_], samples: int) -> NDArray[np.bool_]:
    """Return a mask of all within `samples` samples of one that `mask` marks, shape (samples, columns)."""
    counts = np.cumsum(np.pad(mask, ((samples + 1, samples), (0, 0))), axis=0)
    return np.asarray(counts[2 * samples + 1 :] > counts[: len(mask)])
