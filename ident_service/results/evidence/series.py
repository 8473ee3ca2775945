"""Reduce long series in one pass and constant memory: envelopes, spectra, scatter."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ident_service.results.evidence.evidence import Array, Mask

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
        """Add the next samples.

        Args:
            time: not decreasing, not below that of earlier samples [s], shape (samples,).
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

    def add(self, values: Array, *, opens: bool = False) -> None:
        """Add the next samples, shape (series, samples); they do not follow the earlier ones where `opens`."""
        self._waiting = values if opens else np.hstack([self._waiting, values])
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
        """Return whether there was a whole segment."""
        return self._segments > 0

    def density(self) -> tuple[Array, Array]:
        """Return frequencies [Hz], shape (lines,), and densities, (series, lines), denser at low frequencies."""
        frequency = np.arange(1, self._density.shape[1]) * self.rate / self.length
        density = self._density[:, 1:] / max(self._segments, 1)
        edges = np.unique(np.geomspace(1, len(frequency) + 1, _LINES + 1).astype(int)) - 1
        sizes = np.diff(edges)
        sums = np.add.reduceat(np.vstack([frequency, density]), edges[:-1], axis=1) / sizes
        return sums[0], sums[1:]

    def correlation(self) -> tuple[Array, Array]:
        """Return lags [s], shape (lags,), and autocorrelations, (series, lags); zero where a series is zero."""
        longest = max(1, min(self.length // 2, round(_LONGEST_LAG * self.rate)))
        step = max(1, longest // _LAGS)
        lags = np.arange(0, longest + 1, step)
        products = self._products[:, lags] / (self.length - lags)
        power = products[:, :1]
        return lags / self.rate, np.divide(products, power, out=np.zeros_like(products), where=power > 0.0)

    @property
    def white(self) -> float:
        """Return the bound that 95 % of the lags of white noise stay below."""
        return 1.96 / float(np.sqrt(max(self._samples, 1)))


class Scatter:
    """Subset of many points, spread evenly in time as they come."""

    def __init__(self, most: int = 8192) -> None:
        """Prepare to keep at most `most` of the rows that come."""
        self._most, self._step, self._seen = most, 1, 0
        self._rows: list[Array] = []
        self._kept = 0

    def add(self, rows: Array) -> None:
        """Add the next rows, shape (samples, columns)."""
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


def spread(x: Array, y: Array, most: int = 400, bins: int = 50) -> tuple[Array, Array]:
    """Return at most `most` of the points, so that no part of the range of x that has any is left empty.

    Args:
        x: shape (points,).
        y: likewise.
        most: number of points to keep.
        bins: equal parts of the range of x, each with an equal right to points.
    """
    if len(x) <= most:
        return x, y
    width = (x.max() - x.min()) / bins or 1.0
    place = np.minimum((x - x.min()) / width, bins - 1).astype(int)
    share = most // bins
    chosen = []
    for part in range(bins):
        members = np.flatnonzero(place == part)
        if len(members) > share:
            members = members[np.linspace(0, len(members) - 1, share).round().astype(int)]
        chosen.append(members)
    kept = np.sort(np.concatenate(chosen))
    return x[kept], y[kept]
