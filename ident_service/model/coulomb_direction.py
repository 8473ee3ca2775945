"""Compute the factor of Coulomb friction: the sign of the velocity, or Dahl's pre-sliding state near reversals.

A drive that turns round does not change its friction at once: teeth and bearings give by some micrometres or
milliradians first. The simplest law for that is Dahl's (1968),

    ds/dx = (1 - s sign(v)) / x0

whose solution between two reversals is an exponential in the distance travelled, so it costs nothing to compute. With
x0 = 0 it is the sign.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def direction(rate: Array, period: float, presliding: Array, start: Array | None = None) -> Array:
    """Return the direction of friction of each drive, between -1 and 1.

    Args:
        rate: drive velocities [rad/s or m/s], shape (samples, drives).
        period: of the samples [s].
        presliding: x0 per drive [rad or m], shape (drives,); 0 for the sign itself.
        start: direction before the first sample, shape (drives,); the first sign that follows when None.

    Returns:
        Shape (samples, drives).
    """
    result = np.empty_like(rate)
    for drive, x0 in enumerate(presliding):
        signs = np.sign(rate[:, drive])
        if x0 <= 0.0:
            result[:, drive] = signs
            continue
        # Where the velocity is exactly zero nothing is travelled, and the last sign may stand.
        moving = np.flatnonzero(signs)
        before = signs[moving[0]] if start is None and len(moving) else 0.0 if start is None else float(start[drive])
        travelled = np.cumsum(np.abs(rate[:, drive])) * (period / x0)
        last = np.maximum.accumulate(np.where(signs != 0.0, np.arange(len(signs)), -1))
        held = np.where(last >= 0, signs[np.maximum(last, 0)], np.sign(before) or 1.0)
        turns = np.flatnonzero(np.diff(held)) + 1
        state, reached = before, 0.0
        for begin, end in zip([0, *turns], [*turns, len(held)], strict=True):
            part = slice(begin, end)
            result[part, drive] = held[begin] + (state - held[begin]) * np.exp(reached - travelled[part])
            state, reached = result[end - 1, drive], travelled[end - 1]
    return result
