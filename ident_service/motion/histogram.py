"""Count how late cycles woke and how long they computed, in fixed bins, so that nothing grows while the loop runs."""

from __future__ import annotations

from typing import Any

import numpy as np

_EDGES_US = (1, 2, 5, 10, 20, 50, 100, 150, 200, 300, 500, 1000, 2000, 5000, 10_000, 20_000, 50_000, 100_000)


class Histogram:
    """Count times in fixed bins.

    Attributes:
        count: how many.
        worst_ns: the longest [ns].
    """

    def __init__(self) -> None:
        self.count = 0
        self.worst_ns = 0
        self._edges = np.array(_EDGES_US, dtype=np.int64) * 1000
        self._counts = [0] * (len(_EDGES_US) + 1)

    def add(self, time_ns: int) -> None:
        """Count one time [ns]."""
        self.count += 1
        if time_ns > self.worst_ns:
            self.worst_ns = time_ns
        self._counts[int(self._edges.searchsorted(time_ns, side="left"))] += 1

    def below_us(self, share: float) -> float:
        """Return the bin edge [us] that `share` of all times do not exceed; the longest time if in the last bin."""
        if self.count == 0:
            return 0.0
        seen = 0
        for edge, number in zip(_EDGES_US, self._counts, strict=False):
            seen += number
            if seen >= share * self.count:
                return float(edge)
        return self.worst_ns / 1e3

    def document(self) -> dict[str, Any]:
        """Return the histogram as JSON values."""
        return {
            "count": self.count,
            "worst_us": self.worst_ns / 1e3,
            "median_below_us": self.below_us(0.5),
            "p99_below_us": self.below_us(0.99),
            "p999_below_us": self.below_us(0.999),
            "edges_us": list(_EDGES_US),
            "counts": list(self._counts),
        }
