"""Determine how regular a recording's stamps are (usual period, jitter, gaps) in one pass, in constant memory.

The usual period is the mean of the steps that are near it, found from the median step in a few rounds: the median
alone would be off by the rounding of the stamps (steps of 7 and 8 ms at 128 Hz) or by stamps that come late in turns,
the mean alone by gaps. Steps are counted in classes of 0.1 %.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from ident_service.config.recording import RecordingFormat
from ident_service.errors import RecordingError
from ident_service.recordings.kept import memory_of
from ident_service.recordings.recording import Block, Recording, Stamps, cut

REGULAR: Final = 1e-3  # of a period; what stamps in whole nanoseconds or few decimals differ by
CROWDED: Final = 0.1  # of a period; samples closer than this are too close to draw a curve through both
MAX_GAPS: Final = 1000
_RATES: Final = (0.8, 10.0)  # of the own rate
_NEAR: Final = (0.4, 1.6)  # of the usual step; a lost sample makes 2
_ROUNDS: Final = 4
_CLASSES: Final = 43_700  # 1000 a factor of e, up to the longest step an int64 holds [ns]


@dataclass(frozen=True)
class Segment:
    """Represent a range of samples without a gap between them.

    Attributes:
        first_ns: stamp of the first one [ns].
        last_ns: stamp of the last one [ns].
    """

    first_ns: int
    last_ns: int

    @property
    def duration_s(self) -> float:
        """Return the duration from the first to the last sample [s]."""
        return (self.last_ns - self.first_ns) * 1e-9


@dataclass(frozen=True)
class Grid:
    """Describe the stamps of a recording, after trimming.

    Attributes:
        period_s: of the uniform samples made of it [s].
        own_period_s: its usual step [s].
        first_ns: stamp of the first sample [ns].
        last_ns: stamp of the last sample [ns].
        samples: their number, repeated ones not counted.
        repeats: number of samples left out because they repeat the one before.
        skipped: number of samples left out because a value is missing.
        regular: whether all steps but gaps are `own_period_s` to 0.1 %.
        resampled: whether uniform samples have to be read off curves between the recorded ones.
        jitter_std_s: standard deviation of the steps, gaps excepted, from the usual step [s].
        jitter_max_s: largest difference of a step, gaps excepted, from the usual step [s].
        gap_s: a longer step is a gap [s].
        segments: the stretches between gaps, in order, at least one.
    """

    period_s: float
    own_period_s: float
    first_ns: int
    last_ns: int
    samples: int
    repeats: int
    skipped: int
    regular: bool
    resampled: bool
    jitter_std_s: float
    jitter_max_s: float
    gap_s: float
    segments: tuple[Segment, ...]

    @property
    def gaps(self) -> tuple[Segment, ...]:
        """Return each gap, from the last sample before it to the first one after it."""
        pairs = zip(self.segments[:-1], self.segments[1:], strict=True)
        return tuple(Segment(before.last_ns, after.first_ns) for before, after in pairs)

    def least_s(self, shortest_s: float) -> float:
        """Return the least duration of a usable segment [s]: as asked for, and enough for a curve through four samples.

        Args:
            shortest_s: shortest duration asked for [s].
        """
        curve = 3.0 * (self.gap_s + CROWDED * self.own_period_s) if self.resampled else 0.0
        return max(shortest_s, curve)


def grid(recording: Recording, fmt: RecordingFormat) -> Grid:
    """Read a recording's stamps once and determine their period, jitter and gaps.

    Raises:
        RecordingError: fewer than two samples, or none left after trimming; more than 1000 gaps; a rate asked for
            that is too far from the recording's own; and whatever reading the blocks raises.
    """
    memory = memory_of(recording)
    found: Grid | None = None if memory is None else memory.recall("grid", fmt)
    if found is None:
        found = _grid(recording, fmt)
        if memory is not None:
            memory.remember("grid", fmt, found)
    return found


def _grid(recording: Recording, fmt: RecordingFormat) -> Grid:
    steps = _Steps()
    first_ns = last_ns = samples = repeats = skipped = 0
    lost: list[tuple[int, int]] = []
    for block in trimmed(recording.blocks(), fmt.trim):
        stamps = block.stamp_ns
        first_ns = first_ns if samples else int(stamps[0])
        run = stamps if samples == 0 else np.concatenate([[last_ns], stamps])
        if block.skipped is None:
            steps.add(run)
        else:
            # A step across samples that were left out does not show how evenly samples were taken.
            skipped += int(block.skipped.sum())
            behind = np.flatnonzero(block.skipped) + len(run) - len(stamps)
            for part in np.split(run, behind):
                steps.add(part)
            lost += [(int(run[index - 1]), int(run[index])) for index in behind[behind > 0]]
        last_ns = int(stamps[-1])
        samples += len(stamps)
        repeats += block.repeats
    if samples < 2:
        cause = f"after trimming {fmt.trim[0]:g} s and {fmt.trim[1]:g} s " if any(fmt.trim) else ""
        raise RecordingError(recording.path, f"holds no samples {cause}".rstrip() + "; record the motion again")
    if steps.none:  # no two samples without one between them that was left out
        for pair in lost:
            steps.add(np.array(pair, np.int64))
    own = steps.usual()
    gap = fmt.gap * own
    low, high, deviation = steps.spread(own, gap)
    longer = steps.longer_than(gap)
    if len(longer) > MAX_GAPS:
        raise RecordingError(
            recording.path,
            f"more than {MAX_GAPS} steps longer than {gap * 1e-6:.4g} ms, where {own * 1e-6:.4g} ms are usual; "
            "find out where the samples went, or raise recording.gap",
        )
    # Samples that are spaced evenly must not close up over one that was left out.
    apart = [pair for pair in lost if fmt.stamps == "arrival" or pair[1] - pair[0] > gap]
    if apart:
        longer = np.unique(np.concatenate([longer, np.array(apart, np.int64)]), axis=0)
        if len(longer) > MAX_GAPS:
            raise RecordingError(
                recording.path,
                f"samples that lack a value leave more than {MAX_GAPS} gaps; raise recording.gap, or, if each stamp "
                "says when its sample was taken, set recording.stamps: sampled",
            )
    edges = [first_ns, *(int(stamp) for pair in longer for stamp in pair), last_ns]
    period = _period(recording, fmt, own)
    furthest = max(high - own, own - low)
    regular = furthest <= REGULAR * own and len(apart) == len(lost)
    return Grid(
        period_s=period * 1e-9,
        own_period_s=own * 1e-9,
        first_ns=first_ns,
        last_ns=last_ns,
        samples=samples,
        repeats=repeats,
        skipped=skipped,
        regular=regular,
        resampled=period != own or not (regular or fmt.stamps == "arrival"),
        jitter_std_s=deviation * 1e-9,
        jitter_max_s=furthest * 1e-9,
        gap_s=gap * 1e-9,
        segments=tuple(Segment(*pair) for pair in zip(edges[::2], edges[1::2], strict=True)),
    )


def trimmed(blocks: Iterable[Block], trim: tuple[float, float]) -> Iterator[Block]:
    """Yield blocks without the first and the last seconds; holds back as many samples as the last seconds have.

    Args:
        blocks: of a recording, in order.
        trim: seconds to leave out at the start and at the end [s].
    """
    at_start, at_end = (round(seconds * 1e9) for seconds in trim)
    waiting: deque[Block] = deque()
    first_ns: int | None = None
    end_ns = 0
    for block in blocks:
        first_ns = int(block.stamp_ns[0]) if first_ns is None else first_ns
        end_ns = int(block.stamp_ns[-1]) - at_end
        start = int(np.searchsorted(block.stamp_ns, first_ns + at_start))
        if start < len(block.stamp_ns):
            waiting.append(cut(block, start, len(block.stamp_ns)))
        while waiting and waiting[0].stamp_ns[-1] <= end_ns:
            yield waiting.popleft()
    for block in waiting:
        stop = int(np.searchsorted(block.stamp_ns, end_ns, side="right"))
        if stop:
            yield cut(block, 0, stop)


def _period(recording: Recording, fmt: RecordingFormat, own: float) -> float:
    """Return the uniform samples' period [ns]."""
    if fmt.rate is None or abs(fmt.rate * own * 1e-9 - 1.0) <= REGULAR:
        return own
    share = fmt.rate * own * 1e-9
    if not _RATES[0] <= share <= _RATES[1]:
        raise RecordingError(
            recording.path,
            f"sampled at {1e9 / own:.4g} Hz, too far from a recording.rate of {fmt.rate:g} Hz: a lower rate would "
            "fold noise into the motion, a higher one has nothing to say; leave it out",
        )
    return 1e9 / fmt.rate


class _Steps:
    """Count steps in classes, and remember the longest steps with their stamps."""

    def __init__(self) -> None:
        self._count = np.zeros(_CLASSES, np.int64)
        self._sum = np.zeros(_CLASSES)
        self._square = np.zeros(_CLASSES)
        self._low = np.full(_CLASSES, np.inf)
        self._high = np.zeros(_CLASSES)
        self._longest = np.empty((0, 2), np.int64)

    def add(self, stamps: Stamps) -> None:
        """Count the steps between consecutive stamps [ns]."""
        if len(stamps) < 2:
            return
        order = np.argsort(np.diff(stamps), kind="stable")
        steps = np.diff(stamps)[order].astype(np.float64)
        classes = (np.log(steps) * 1000.0).astype(np.intp)
        starts = np.flatnonzero(np.diff(classes, prepend=-1))
        found = classes[starts]
        self._count[found] += np.diff(starts, append=len(steps))
        self._sum[found] += np.add.reduceat(steps, starts)
        self._square[found] += np.add.reduceat(steps * steps, starts)
        self._low[found] = np.minimum(self._low[found], np.minimum.reduceat(steps, starts))
        self._high[found] = np.maximum(self._high[found], np.maximum.reduceat(steps, starts))
        last = order[-(MAX_GAPS + 1) :]
        pairs = np.concatenate([self._longest, np.column_stack([stamps[last], stamps[last + 1]])])
        self._longest = pairs[np.argsort(pairs[:, 1] - pairs[:, 0], kind="stable")[-(MAX_GAPS + 1) :]]

    @property
    def none(self) -> bool:
        """Tell whether no step was counted."""
        return not self._count.any()

    def usual(self) -> float:
        """Return the usual step [ns]."""
        median = int(np.searchsorted(np.cumsum(self._count), 0.5 * self._count.sum()))
        usual = float(self._sum[median] / self._count[median])
        for _ in range(_ROUNDS):
            near = (self._low >= _NEAR[0] * usual) & (self._high <= _NEAR[1] * usual) & (self._count > 0)
            usual = float(self._sum[near].sum() / self._count[near].sum())
        return usual

    def spread(self, usual: float, gap: float) -> tuple[float, float, float]:
        """Return the smallest and largest step that is no gap, and the standard deviation from the usual one [ns]."""
        inside = (self._count > 0) & (self._low <= gap)
        n = self._count[inside].sum()
        square = self._square[inside].sum() - 2.0 * usual * self._sum[inside].sum() + n * usual**2
        # What is left of equal steps is rounding.
        deviation = float(np.sqrt(max(square / n, 0.0))) if square > 1e-12 * n * usual**2 else 0.0
        return float(self._low[inside].min()), min(float(self._high[inside].max()), gap), deviation

    def longer_than(self, gap: float) -> Stamps:
        """Return the stamps before and after each of the longest gaps [ns], in order, shape (gaps, 2)."""
        found: Stamps = self._longest[self._longest[:, 1] - self._longest[:, 0] > gap]
        return found[np.argsort(found[:, 0])]
