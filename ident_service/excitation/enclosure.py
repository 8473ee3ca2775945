"""Enclose a motion over all time, by bounds on short stretches of time.

By Taylor's theorem the k-th derivative stays, at s from the middle of a stretch, within

    |x_k(s) - x_k - x_(k+1) s| <= sum_(i=2)^(4-k) |x_(k+i)| |s|^i / i! + M |s|^(5-k) / (5-k)!

with M the path's bound of its fifth derivative. Stretches never reach across a seam, where the fourth may jump.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import factorial

import numpy as np

from ident_service.excitation.path import Path
from ident_service.model.chain import Array
from ident_service.model.taylor import Taylor

_PER_CYCLE = 400  # stretches per period of the highest frequency; its half length is then 0.008 of that phase


@dataclass(frozen=True)
class Stretches:
    """Enclosed motion on consecutive stretches of time.

    Attributes:
        time: their middles [s], shape (stretches,).
        half: half their lengths [s], shape (stretches,).
        values: position and its first four derivatives in the middles, each of shape (stretches, joints).
        crackle: bound of the fifth derivative, shape (joints,).
    """

    time: Array
    half: Array
    values: list[Array]
    crackle: Array

    def of(self, order: int) -> list[Taylor]:
        """Return enclosures of position (order 0), velocity, acceleration or jerk (3), one per joint."""
        h = self.half
        rest = self.crackle * (h ** (5 - order) / factorial(5 - order))[:, None]
        for i in range(2, 5 - order):
            rest = rest + np.abs(self.values[order + i]) * (h**i / factorial(i))[:, None]
        middle, slope = self.values[order], self.values[order + 1]
        return [Taylor(middle[:, k], slope[:, k], rest[:, k], h) for k in range(middle.shape[1])]


def stretches(path: Path, longest: float | None = None) -> Stretches:
    """Return stretches of time that cover one instance of every distinct part of a motion.

    Args:
        path: the motion.
        longest: their greatest length [s]; by default a small part of the fastest oscillation.
    """
    edges = []
    for begin, end in path.distinct:
        length = 1.0 / (_PER_CYCLE * path.fastest(begin, end)) if longest is None else longest
        inner = path.seams[(path.seams > begin) & (path.seams < end)]
        corners = np.concatenate([[begin], inner, [end]])
        for first, last in pairwise(corners.tolist()):
            points = np.linspace(first, last, 1 + max(1, int(np.ceil((last - first) / length))))
            edges.append(np.column_stack([points[:-1], points[1:]]))
    pairs = np.concatenate(edges)
    time, half = pairs.mean(axis=1), 0.5 * (pairs[:, 1] - pairs[:, 0])
    return Stretches(time, half, path.derivatives(time, 4), path.crackle)
