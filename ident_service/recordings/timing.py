"""Tell whether irregular stamps are times of sampling, or only of arrival.

Across a step that is longer or shorter than usual the motion goes on in proportion to the step if the sample was taken
then, and by as much as across the steps beside it if it was taken on time. Both are predicted from the steps before and
after, and the prediction that errs less decides.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from ident_service.recordings.grid import Grid
from ident_service.recordings.recording import Block, cut, join

_IRREGULAR: Final = 0.05  # of a period
_LEAST: Final = 10  # irregular steps
_CLEAR: Final = 4.0  # ratio of the squared errors below which it is not decided


class Timing:
    """Compare both predictions of the motion over a recording's blocks, one after the other."""

    def __init__(self, stamps: Grid) -> None:
        """Use the period and gap of the stamps."""
        self._period = stamps.own_period_s * 1e9
        self._gap = stamps.gap_s * 1e9
        self._tail: Block | None = None
        self._steps = 0
        self._even = self._in_proportion = 0.0

    def add(self, block: Block) -> None:
        """Add the next samples."""
        run = block if self._tail is None else join([self._tail, block])
        self._tail = cut(run, max(0, len(run.stamp_ns) - 3), len(run.stamp_ns))
        if len(run.stamp_ns) < 4:
            return
        step = np.diff(run.stamp_ns) / self._period
        move = np.diff(run.position, axis=0)
        speed = move / step[:, None]
        # No gap among the three steps.
        near = step * self._period <= self._gap
        tell = (np.abs(step[1:-1] - 1.0) > _IRREGULAR) & near[:-2] & near[1:-1] & near[2:]
        even = (move[1:-1] - 0.5 * (move[:-2] + move[2:]))[tell]
        in_proportion = (move[1:-1] - step[1:-1, None] * 0.5 * (speed[:-2] + speed[2:]))[tell]
        self._steps += int(tell.sum())
        self._even += float((even**2).sum())
        self._in_proportion += float((in_proportion**2).sum())

    def arrival(self) -> bool | None:
        """Return True for stamps of arrival, False for stamps of sampling, None where it cannot be told."""
        if self._steps < _LEAST:
            return None
        if _CLEAR * self._even < self._in_proportion:
            return True
        return False if _CLEAR * self._in_proportion < self._even else None
