"""Resample a recording to stretches of exactly uniform samples; nothing is interpolated across a gap.

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
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import groupby
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from ident_service.config.recording import RecordingFormat
from ident_service.errors import RecordingError
from ident_service.recordings.grid import CROWDED, Grid, Segment, grid, trimmed
from ident_service.recordings.recording import BLOCK_SAMPLES, Block, Matrix, Recording, Stamps, cut, join

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Piece:
    """Hold consecutive samples of a segment, as far apart as `Grid.period_s`.

    Attributes:
        block: at least one sample; the stamps are the uniform times rounded to whole nanoseconds.
        start: whether the segment begins here.
        end: whether the segment ends here.
    """

    block: Block
    start: bool
    end: bool


def uniform(
    recording: Recording,
    fmt: RecordingFormat,
    known: Grid | None = None,
    *,
    shortest_s: float = 0.0,
    samples: int = BLOCK_SAMPLES,
) -> Iterator[Piece]:
    """Read a recording as uniform samples, segment after segment, in constant memory.

    A regular recording passes through bit for bit, cut at its gaps; so do the values of one whose stamps are of
    arrival, which get even stamps from each segment's first one on. Any other is resampled at `first + k period` in all
    segments; of samples closer than a tenth of a period the first is used. `recording.torque_held` stays true of the
    result.

    Args:
        recording: to be read.
        fmt: seconds to trim, length of a gap, and the rate.
        known: its `grid(recording, fmt)`, where that has been found already.
        shortest_s: segments shorter than `Grid.least_s` of this are left out [s].
        samples: how many samples to read at a time.

    Raises:
        RecordingError: no segment is long enough, and whatever `grid` and the recording's blocks raise.
    """
    stamps = known or grid(recording, fmt)
    least = stamps.least_s(shortest_s)
    longest = max(segment.duration_s for segment in stamps.segments)
    if longest < least:
        raise RecordingError(
            recording.path,
            f"the longest stretch without a gap (a step above {stamps.gap_s * 1e3:.4g} ms) is {longest:.4g} s; "
            f"at least {least:.4g} s are needed",
        )
    parts = _parts(trimmed(recording.blocks(samples), fmt.trim), stamps.segments)
    for segment, group in groupby(parts, key=itemgetter(0)):
        if segment.duration_s < least:
            continue
        blocks: Iterator[Block] = map(itemgetter(1), group)
        if fmt.stamps == "arrival" and not stamps.regular:
            blocks = _evenly(blocks, stamps, segment)
        if stamps.resampled:
            blocks = _resampled(blocks, stamps, segment, recording.torque_held)
        yield from _marked(blocks)


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


def _marked(blocks: Iterable[Block]) -> Iterator[Piece]:
    """Yield one segment's blocks as pieces, each held back until it is known whether it is the last one."""
    start, waiting = True, None
    for block in blocks:
        if waiting is not None:
            yield Piece(waiting, start, end=False)
            start = False
        waiting = block
    if waiting is not None:
        yield Piece(waiting, start, end=True)


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

    torque = _mean_of_held(old, run.torque, np.append(new, new[-1] + period)) if held else curve(run.torque)
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


def _mean_of_held(old: Vector, values: Matrix, edges: Vector) -> Matrix:
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
