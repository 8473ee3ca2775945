"""Resample a recording's own stamps to stretches of uniform samples, and judge how regular they are.

The usual period is the mean of the steps that are near it, found from the median step in a few rounds: the median
alone would be off by the rounding of the stamps (steps of 7 and 8 ms at 128 Hz) or by stamps that come late in turns,
the mean alone by gaps. Steps are counted in classes of 0.1 %.

A filter and a central difference count samples, so a step that is a tenth off puts a tenth of the velocity's change
into the acceleration. Where stamps are irregular, the samples between them are read off the cubic through the four
nearest (two on either side): its error is at most 3/128 h^4 |q''''|, at 200 Hz 2e-8 of a 1 Hz motion and 1e-4 at
8 Hz, and it needs no neighbours beyond those, so that memory is constant and an error stays where it is. A straight
line errs by h^2/8 |q''| (1e-4 at 1 Hz, and twice differenced a percent of the acceleration); shape-preserving cubics
(PCHIP) flatten where the motion turns round, which is where friction is read; a spline is smoother but global.

A sample that was left out because a value is missing is a step like any other: the cubic spans it up to
`RecordingFormat.gap`, beyond it is a gap.

Stamps that only say when a sample arrived jitter where the motion does not, and curves through them would put that
jitter into the motion: such samples are spaced evenly instead and keep their values. There, a sample that was left out
is a gap, as even spacing would close up over it.

A torque that is held from stamp to stamp is no curve: its mean over each new interval is taken, which keeps the
impulse.

Across a step that is longer or shorter than usual the motion goes on in proportion to the step if the sample was taken
then, and by as much as across the steps beside it if it was taken on time. Both are predicted from the steps before and
after, and the prediction that errs less decides.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import groupby
from operator import itemgetter
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ident_service.config.recording import RecordingFormat
from ident_service.errors import RecordingError
from ident_service.recordings.cached_recording import memory_of
from ident_service.recordings.recording import BLOCK_SAMPLES, Block, Matrix, Recording, Stamps, cut, join

REGULAR: Final = 1e-3  # of a period; what stamps in whole nanoseconds or few decimals differ by
CROWDED: Final = 0.1  # of a period; samples closer than this are too close to draw a curve through both
MAX_GAPS: Final = 1000
_QUICKEST_SAMPLING = 5e-5  # s; no recording of an arm has shorter steps, but its time may be in another unit
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
        period_s: period of the uniform samples made of it [s].
        own_period_s: usual step of the recording [s].
        first_ns: stamp of the first sample [ns].
        last_ns: stamp of the last sample [ns].
        samples: number of samples, repeated ones not counted.
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
        """Return each gap as a segment from the last sample before it to the first one after it."""
        pairs = zip(self.segments[:-1], self.segments[1:], strict=True)
        return tuple(Segment(before.last_ns, after.first_ns) for before, after in pairs)

    def least_s(self, shortest_s: float) -> float:
        """Return the least duration of a usable segment [s]: `shortest_s`, or more where resampling needs it.

        Args:
            shortest_s: shortest duration asked for [s].
        """
        curve = 3.0 * (self.gap_s + CROWDED * self.own_period_s) if self.resampled else 0.0
        return max(shortest_s, curve)


def grid(recording: Recording, fmt: RecordingFormat) -> Grid:
    """Return period, jitter and gaps of a recording's stamps, read once and kept where it has a memory.

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
        raise RecordingError(
            recording.path, f"holds fewer than two samples {cause}".rstrip() + "; record the motion again"
        )
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


def trimmed(blocks: Iterable[Block], trim_seconds: tuple[float, float]) -> Iterator[Block]:
    """Yield blocks without the first and the last seconds of `trim_seconds`, cutting those at the borders.

    Args:
        blocks: blocks of a recording, in order.
        trim_seconds: seconds to leave out at the start and at the end [s].
    """
    at_start, at_end = (round(seconds * 1e9) for seconds in trim_seconds)
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


Vector = NDArray[np.float64]


@dataclass(frozen=True)
class UniformRun:
    """Hold consecutive samples of a segment, as far apart as `Grid.period_s`.

    Attributes:
        block: block of at least one sample; its stamps are the uniform times rounded to whole nanoseconds.
        start: whether the segment begins here.
        end: whether the segment ends here.
    """

    block: Block
    start: bool
    end: bool


def uniform(
    recording: Recording,
    fmt: RecordingFormat,
    known_grid: Grid | None = None,
    *,
    shortest_s: float = 0.0,
    samples: int = BLOCK_SAMPLES,
) -> Iterator[UniformRun]:
    """Yield a recording as uniformly spaced samples, segment by segment; unchanged where regular already.

    A regular recording passes through bit for bit, cut at its gaps; so do the values of one whose stamps are of
    arrival, which get even stamps from each segment's first one on. Any other is resampled at `first + k period` in all
    segments; of samples closer than a tenth of a period the first is used. `recording.torque_zero_order_hold` stays
    true of the result.

    Args:
        recording: to be read.
        fmt: seconds to trim, length of a gap, and the rate.
        known_grid: result of `grid(recording, fmt)`, where that has been found already.
        shortest_s: least duration of the segments that are read [s]; more where resampling needs it (`Grid.least_s`).
        samples: how many samples to read at a time.

    Raises:
        RecordingError: no segment is long enough, and whatever `grid` and the recording's blocks raise.
    """
    stamps = known_grid or grid(recording, fmt)
    least = stamps.least_s(shortest_s)
    longest = max(segment.duration_s for segment in stamps.segments)
    if longest < least:
        if stamps.own_period_s < _QUICKEST_SAMPLING:
            raise RecordingError(
                recording.path,
                f"samples are {stamps.own_period_s:.3g} s apart, and all of them last {longest:.4g} s: is the time in "
                "the unit that recording.columns names? It is s where none is named",
            )
        raise RecordingError(
            recording.path,
            f"the longest stretch without a gap (a step above {stamps.gap_s * 1e3:.4g} ms) is {longest:.4g} s; "
            f"at least {least:.4g} s are needed; record a longer stretch, or cut or mend the gaps",
        )
    parts = _parts(trimmed(recording.blocks(samples), fmt.trim), stamps.segments)
    for segment, group in groupby(parts, key=itemgetter(0)):
        if segment.duration_s < least:
            continue
        blocks: Iterator[Block] = map(itemgetter(1), group)
        if fmt.stamps == "arrival" and not stamps.regular:
            blocks = _evenly(blocks, stamps, segment)
        if stamps.resampled:
            blocks = _resampled(blocks, stamps, segment, recording.torque_zero_order_hold)
        yield from _with_ends(blocks)


def _parts(blocks: Iterable[Block], segments: tuple[Segment, ...]) -> Iterator[tuple[Segment, Block]]:
    """Yield the blocks, cut where segments end."""
    index = 0
    for block in blocks:
        start, length = 0, len(block.stamp_ns)
        while start < length:
            stop = int(np.searchsorted(block.stamp_ns, segments[index].last_ns, side="right"))
            if stop > start:
                yield segments[index], cut(block, start, stop)
                start = stop
            else:
                index += 1


def _with_ends(blocks: Iterable[Block]) -> Iterator[UniformRun]:
    """Yield one segment's blocks as pieces, each held back until it is known whether it is the last one."""
    start, waiting = True, None
    for block in blocks:
        if waiting is not None:
            yield UniformRun(waiting, start, end=False)
            start = False
        waiting = block
    if waiting is not None:
        yield UniformRun(waiting, start, end=True)


def _evenly(blocks: Iterable[Block], stamps: Grid, segment: Segment) -> Iterator[Block]:
    """Yield one segment's samples, restamped a usual period apart from its first."""
    number = 0
    for block in blocks:
        numbers = np.arange(number, number + len(block.stamp_ns))
        even: Stamps = segment.first_ns + np.rint(numbers * (stamps.own_period_s * 1e9)).astype(np.int64)
        even.flags.writeable = False
        yield replace(block, stamp_ns=even)
        number += len(even)


def _resampled(blocks: Iterable[Block], stamps: Grid, segment: Segment, held: bool) -> Iterator[Block]:
    period = stamps.period_s * 1e9
    number = int(np.ceil((segment.first_ns - stamps.first_ns) / period))
    run: Block | None = None
    for block in blocks:
        last_ns = None if run is None else int(run.stamp_ns[-1])
        spaced = _spaced(block, last_ns, CROWDED * stamps.own_period_s * 1e9)
        run = spaced if run is None else join([run, spaced])
        if len(run.stamp_ns) < 4:
            continue
        # The cubic needs one more sample behind its interval; a held torque, all samples up to the next new one.
        until = min(int(run.stamp_ns[-2]), int(run.stamp_ns[-1]) - int(np.ceil(period)))
        count = int(np.floor((until - stamps.first_ns) / period)) + 1 - number
        if count > 0:
            yield _at(run, stamps, np.arange(number, number + count), held)
            number += count
        # At the end the interval is the last of the four samples', so two before it are kept.
        place = int(np.searchsorted(run.stamp_ns - stamps.first_ns, number * period, side="right"))
        run = cut(run, max(0, min(place - 3, len(run.stamp_ns) - 4)), len(run.stamp_ns))
    if run is not None:
        count = int(np.floor((int(run.stamp_ns[-1]) - stamps.first_ns) / period)) + 1 - number
        if count > 0:
            yield _at(run, stamps, np.arange(number, number + count), held)


def _at(run: Block, stamps: Grid, numbers: NDArray[np.int64], held: bool) -> Block:
    """Return the samples of the given numbers on the grid."""
    period = stamps.period_s * 1e9
    # Times count from the first sample, as floats that are exact for a hundred days.
    old = (run.stamp_ns - stamps.first_ns).astype(np.float64)
    new: Vector = np.multiply(numbers, period, dtype=np.float64)
    first, weights = _cubic(old, new)

    def curve(values: Matrix) -> Matrix:
        return np.asarray(sum(weights[:, m, None] * values[first + m] for m in range(4)))

    torque = _zero_order_hold_mean(old, run.torque, np.append(new, new[-1] + period)) if held else curve(run.torque)
    stamp: Stamps = stamps.first_ns + np.rint(new).astype(np.int64)
    block = Block(stamp, curve(run.position), torque, None if run.velocity is None else curve(run.velocity))
    for array in (block.stamp_ns, block.position, block.torque, block.velocity):
        if array is not None:
            array.flags.writeable = False
    return block


def _cubic(old: Vector, new: Vector) -> tuple[NDArray[np.intp], Matrix]:
    """Return Lagrange's cubic: index of the first of four samples, shape (new,), and their weights, shape (new, 4)."""
    inside = np.searchsorted(old, new, side="right") - 1
    first = np.clip(inside - 1, 0, len(old) - 4)
    nodes = old[first[:, None] + np.arange(4)]
    weights = np.ones_like(nodes)
    for m in range(4):
        for other in range(4):
            if other != m:
                weights[:, m] *= (new - nodes[:, other]) / (nodes[:, m] - nodes[:, other])
    return first, weights


def _zero_order_hold_mean(old: Vector, values: Matrix, edges: Vector) -> Matrix:
    """Return the mean of a value held from each stamp to the next, between edges; shape (edges - 1, joints)."""
    integral = np.zeros_like(values)
    np.cumsum(values[:-1] * np.diff(old)[:, None], axis=0, out=integral[1:])
    inside = np.clip(np.searchsorted(old, edges, side="right") - 1, 0, None)
    at_edges = integral[inside] + values[inside] * (edges - old[inside])[:, None]
    return np.asarray(np.diff(at_edges, axis=0) / np.diff(edges)[:, None])


def _spaced(block: Block, last_ns: int | None, least: float) -> Block:
    """Return the samples at least `least` [ns] behind the one kept before."""
    stamps = block.stamp_ns
    before = stamps[0] - least if last_ns is None else last_ns
    if bool((np.diff(stamps, prepend=np.int64(before)) >= least).all()):
        return block
    kept, last = [], last_ns
    for index, stamp in enumerate(stamps.tolist()):
        if last is None or stamp - last >= least:
            kept.append(index)
            last = stamp
    velocity = None if block.velocity is None else block.velocity[kept]
    return Block(stamps[kept], block.position[kept], block.torque[kept], velocity)


_IRREGULAR: Final = 0.05  # of a period
_LEAST: Final = 10  # irregular steps
_CLEAR: Final = 4.0  # ratio of the squared errors below which it is not decided


class ArrivalTest:
    """Compare both predictions of the motion over a recording's blocks, one after the other."""

    def __init__(self, stamps: Grid) -> None:
        """Use the period and gap of the stamps."""
        self._period = stamps.own_period_s * 1e9
        self._gap = stamps.gap_s * 1e9
        self._tail: Block | None = None
        self._steps = 0
        self._even = self._in_proportion = 0.0

    def add(self, block: Block) -> None:
        """Add the next samples to the test's sums."""
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
        """Return True if stamps are of arrival, False if of sampling, None where the motion cannot tell.

        Told by whether irregular steps of time go with even steps of position, or with steps in proportion.
        """
        if self._steps < _LEAST:
            return None
        if _CLEAR * self._even < self._in_proportion:
            return True
        return False if _CLEAR * self._in_proportion < self._even else None
