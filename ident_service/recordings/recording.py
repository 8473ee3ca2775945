"""Represent a recording: a name, a hash, joints, and blocks of samples made of a reader's pieces.

Readers implement it; how samples lie in a file is known to `mcap_reader.py` and `csv_reader.py` alone.

The checks are the same for every kind of file: finite values and strictly increasing stamps. A sample that repeats the
one before it, stamp and values, says nothing new (a message delivered twice, a bag merged with itself); it is left out
and counted. The same stamp with other values, or one that runs backwards, has no meaning and is refused. Samples with a
missing value (NaN) are refused too, or on request left out and counted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ident_service.errors import RecordingError, UsageError

Matrix = NDArray[np.float64]
Stamps = NDArray[np.int64]

BLOCK_SAMPLES = 4096


@dataclass(frozen=True)
class Block:
    """Hold consecutive samples.

    Attributes:
        stamp_ns: times [ns], strictly increasing, shape (samples,).
        position: [rad or m], shape (samples, joints).
        torque: [N m or N], shape (samples, joints).
        velocity: [rad/s or m/s], shape (samples, joints), or None where the recording has none.
        repeats: samples of the file that were left out before the last one here because they repeat, stamp and
            values, the one before them; a recording's blocks together count every one.
        skipped: samples of the file that were left out directly before each one here, and behind the file's last,
            because a value is missing; shape (samples,), None where there are none.
    """

    stamp_ns: Stamps
    position: Matrix
    torque: Matrix
    velocity: Matrix | None = None
    repeats: int = 0
    skipped: Stamps | None = None


def join(blocks: Sequence[Block]) -> Block:
    """Return consecutive blocks, at least one, as one block."""
    if len(blocks) == 1:
        return blocks[0]
    velocities = [block.velocity for block in blocks if block.velocity is not None]
    return Block(
        np.concatenate([block.stamp_ns for block in blocks]),
        np.concatenate([block.position for block in blocks]),
        np.concatenate([block.torque for block in blocks]),
        np.concatenate(velocities) if velocities else None,
        sum(block.repeats for block in blocks),
        None
        if all(block.skipped is None for block in blocks)
        else np.concatenate(
            [np.zeros_like(block.stamp_ns) if block.skipped is None else block.skipped for block in blocks]
        ),
    )


def cut(block: Block, start: int, stop: int) -> Block:
    """Return samples `start` to `stop` of a block, as views; `repeats` goes with the part that begins at 0."""
    part = slice(start, stop)
    velocity = None if block.velocity is None else block.velocity[part]
    repeats = block.repeats if start == 0 else 0
    skipped = None if block.skipped is None else block.skipped[part]
    return Block(block.stamp_ns[part], block.position[part], block.torque[part], velocity, repeats, skipped)


class Recording(Protocol):
    """Define a file of samples that can be read any number of times, one block at a time.

    Attributes:
        path: the file.
        sha256: hash of the file's bytes.
        joint_names: names of the joints, in the order of the block's columns; empty where the file names none (CSV
            `q1..qN`).
        joints: number of joints.
        torque_zero_order_hold: whether the torque of a sample acts from its stamp until the next stamp, as in our own
            recordings; otherwise it was sampled at its stamp.
        torn: whether the file is damaged or lacks its end mark, and is read up to there; always False for CSV.
    """

    path: Path
    sha256: str
    joint_names: tuple[str, ...]
    joints: int
    torque_zero_order_hold: bool
    torn: bool

    def blocks(self, samples: int = BLOCK_SAMPLES) -> Iterator[Block]:
        """Yield samples in blocks of `samples` (the last is shorter); RecordingError for NaN or stamps that run back.

        Raises:
            RecordingError: NaN or infinite values, stamps that run backwards or repeat with other values, a torn row
                in a CSV file; the message names the first place.
        """


def assemble(
    pieces: Iterable[Block],
    samples: int,
    path: Path,
    joints: Sequence[str],
    sample_words: Callable[[int], str] = "sample {}".format,
    *,
    skip_missing: bool = False,
) -> Iterator[Block]:
    """Regroup pieces into blocks of `samples`, each checked (finite values, increasing stamps) and read-only.

    Args:
        pieces: consecutive samples in pieces of any length, all with or all without velocity.
        samples: length of the blocks; the last one is shorter.
        path: of the file, for messages.
        joints: a name per column, for messages.
        sample_words: name in messages of the sample of this index (from 0, those left out counted).
        skip_missing: whether to leave out samples with a value of NaN.

    Raises:
        RecordingError: a value that is not finite (nor left out), no sample without a missing value, a stamp that
            runs backwards or repeats with other values; names the first one.
        UsageError: `samples` is not positive.
    """
    if samples < 1:
        raise UsageError(f"{samples=} but a block has at least one sample")
    check = _Check(path, joints, sample_words, skip_missing=skip_missing)
    waiting: list[Block] = []
    count = 0
    for piece in pieces:
        if not len(piece.stamp_ns):
            continue
        waiting.append(check(piece))
        count += len(waiting[-1].stamp_ns)
        if count <= samples:
            continue
        # One sample at least keeps waiting, so that what is left out at the very end has a block to be counted in.
        whole = join(waiting)
        start = 0
        while count - start > samples:
            yield _frozen(cut(whole, start, start + samples))
            start += samples
        waiting = [cut(whole, start, count)]
        count -= start
    if count:
        yield _frozen(check.ended(join(waiting)))
    elif check.skipped:
        raise RecordingError(path, f"every one of its {check.skipped} samples lacks a value; record again")


class _Check:
    """Check pieces one after the other, remembering the last sample."""

    def __init__(self, path: Path, joints: Sequence[str], place: Callable[[int], str], *, skip_missing: bool) -> None:
        self._path = path
        self._skip_missing = skip_missing
        self.skipped = 0  # since the last sample that was kept
        self._joints = joints
        self._place = place
        self._seen = 0
        self._first_ns: int | None = None
        self._last: Block | None = None

    def __call__(self, piece: Block) -> Block:
        """Leave out the samples that lack a value, and those that repeat the one before."""
        found = len(piece.stamp_ns)
        piece, self._order = self._complete(piece)
        if not len(piece.stamp_ns):
            self._seen += found
            return piece
        if self._first_ns is None:
            self._first_ns = int(piece.stamp_ns[0])
        before = 0 if self._last is None else 1
        run = piece if self._last is None else join([self._last, piece])
        step = np.zeros(len(piece.stamp_ns), np.int64)
        step[1 - before :] = np.diff(run.stamp_ns)
        repeats = np.zeros(len(step), np.bool_)
        repeats[1 - before :] = _repeated_samples(run)
        stuck = (step == 0) & ~repeats
        stuck[: 1 - before] = False
        self._refuse(piece, step, stuck)
        self._seen += found
        self._last = cut(piece, len(step) - 1, len(step))
        if not repeats.any():
            return piece
        rows = ~repeats
        return _selected(piece, np.flatnonzero(rows), int(repeats.sum()))

    def ended(self, block: Block) -> Block:
        """Add the samples that were left out behind the file's last sample to the count of that sample."""
        if not self.skipped:
            return block
        skipped = np.zeros_like(block.stamp_ns) if block.skipped is None else block.skipped.copy()
        skipped[-1] += self.skipped
        return replace(block, skipped=skipped)

    def _complete(self, piece: Block) -> tuple[Block, NDArray[np.intp]]:
        """Find the samples that lack no value, and their indices in the piece."""
        order = np.arange(len(piece.stamp_ns))
        if not self._skip_missing:
            return piece, order
        missing = np.zeros(len(order), np.bool_)
        for values in (piece.position, piece.torque, piece.velocity):
            if values is not None:
                missing |= np.isnan(values).any(axis=1)
        if not self.skipped and not missing.any():
            return piece, order
        before = self.skipped + np.cumsum(missing)
        rows = np.flatnonzero(~missing)
        self.skipped = int(before[-1] - (before[rows[-1]] if len(rows) else 0))
        return _selected(replace(piece, skipped=np.diff(before, prepend=0)), rows, piece.repeats), rows

    def _refuse(self, piece: Block, step: Stamps, stuck: NDArray[np.bool_]) -> None:
        """Raise RecordingError for the first sample that is not valid."""
        problems = []
        if stuck.any():
            problems.append((int(np.argmax(stuck)), "the stamp does not increase, but the values change"))
        if (step < 0).any():
            index = int(np.argmax(step < 0))
            problems.append((index, f"the stamp does not increase, it runs back by {-int(step[index]) * 1e-9:.9g} s"))
        for what, values in (("position", piece.position), ("velocity", piece.velocity), ("torque", piece.torque)):
            if values is not None and (found := self._not_finite(what, values)) is not None:
                problems.append(found)
        if problems:
            index, problem = min(problems)
            after = (int(piece.stamp_ns[index]) - (self._first_ns or 0)) * 1e-9
            before = int(piece.stamp_ns[index] - step[index])
            # Of a clock that began anew the stamps stay behind; the pieces that follow are not known here.
            anew = step[index] < 0 and (piece.stamp_ns[index + 1 : index + 2] <= before).all()
            remedy = "remove the samples from there on" if anew else "remove this sample, and others like it"
            raise RecordingError(
                self._path,
                f"{self._place(self._seen + int(self._order[index]))}, {after:.6f} s after the first: {problem}; "
                f"{remedy}, or record again",
            )

    def _not_finite(self, what: str, values: Matrix) -> tuple[int, str] | None:
        finite = np.isfinite(values)
        if finite.all():
            return None
        index, joint = (int(i) for i in np.argwhere(~finite)[0])
        hint = "; recording.missing: skip leaves such samples out" if np.isnan(values[index, joint]) else ""
        return index, f"{what} of joint {self._joints[joint]} is {values[index, joint]}{hint}"


def _repeated_samples(run: Block) -> NDArray[np.bool_]:
    """Return which samples, from the second on, equal the one before in stamp and all values."""
    same: NDArray[np.bool_] = np.diff(run.stamp_ns) == 0
    if same.any():
        for values in (run.position, run.torque, run.velocity):
            if values is not None:
                same &= (values[1:] == values[:-1]).all(axis=1)
    return same


def _selected(piece: Block, rows: NDArray[np.intp], repeats: int) -> Block:
    """Select samples of a piece; samples skipped before dropped ones count before the next one that is kept."""
    velocity = None if piece.velocity is None else piece.velocity[rows]
    skipped = None if piece.skipped is None else np.diff(np.cumsum(piece.skipped)[rows], prepend=0)
    return Block(piece.stamp_ns[rows], piece.position[rows], piece.torque[rows], velocity, repeats, skipped)


def _frozen(block: Block) -> Block:
    for array in (block.stamp_ns, block.position, block.torque, block.velocity, block.skipped):
        if array is not None:
            array.flags.writeable = False
    return block
