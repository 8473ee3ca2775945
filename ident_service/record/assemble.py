"""From the pieces a reader decodes to the blocks the door promises: of the asked length, and checked.

The checks are the same for every kind of file: finite values and strictly increasing stamps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from ident_service.errors import RecordingError, UsageError
from ident_service.record.recording import Block, Matrix


def assemble(
    pieces: Iterable[Block],
    samples: int,
    path: Path,
    joints: Sequence[str],
    place: Callable[[int], str] = "sample {}".format,
) -> Iterator[Block]:
    """Cut consecutive pieces anew and check each block; the blocks' arrays are read-only.

    Args:
        pieces: consecutive samples in pieces of any length, all with or all without velocity.
        samples: length of the blocks; the last one is shorter.
        path: of the file, for messages.
        joints: a name per column, for messages.
        place: what to call the sample of this index (from 0) in messages.

    Raises:
        RecordingError: a value that is not finite, a stamp that does not increase; names the first one.
        UsageError: `samples` is not positive.
    """
    if samples < 1:
        raise UsageError(f"{samples=} but a block has at least one sample")
    check = _Check(path, joints, place)
    waiting: list[Block] = []
    count = 0
    for piece in pieces:
        waiting.append(piece)
        count += len(piece.stamp_ns)
        if count < samples:
            continue
        whole = _join(waiting)
        for start in range(0, count - samples + 1, samples):
            yield check(_cut(whole, start, start + samples))
        rest = count % samples
        waiting = [_cut(whole, count - rest, count)] if rest else []
        count = rest
    if count:
        yield check(_join(waiting))


class _Check:
    """Knows the samples that went by."""

    def __init__(self, path: Path, joints: Sequence[str], place: Callable[[int], str]) -> None:
        self._path = path
        self._joints = joints
        self._place = place
        self._seen = 0
        self._first_ns = 0
        self._last_ns: int | None = None

    def __call__(self, block: Block) -> Block:
        stamps = block.stamp_ns
        stuck = np.zeros(len(stamps), np.bool_)
        stuck[1:] = stamps[1:] <= stamps[:-1]
        if self._last_ns is None:
            self._first_ns = int(stamps[0])
        else:
            stuck[0] = stamps[0] <= self._last_ns
        problems = [(int(np.argmax(stuck)), "the stamp does not increase")] if stuck.any() else []
        for what, values in (("position", block.position), ("velocity", block.velocity), ("torque", block.torque)):
            if values is not None and (found := self._not_finite(what, values)) is not None:
                problems.append(found)
        if problems:
            index, problem = min(problems)
            after = (int(stamps[index]) - self._first_ns) * 1e-9
            raise RecordingError(
                self._path,
                f"{self._place(self._seen + index)}, {after:.6f} s after the first: {problem}; "
                "remove the samples from there on, or record again",
            )
        self._seen += len(stamps)
        self._last_ns = int(stamps[-1])
        for array in (stamps, block.position, block.torque, block.velocity):
            if array is not None:
                array.flags.writeable = False
        return block

    def _not_finite(self, what: str, values: Matrix) -> tuple[int, str] | None:
        finite = np.isfinite(values)
        if finite.all():
            return None
        index, joint = (int(i) for i in np.argwhere(~finite)[0])
        return index, f"{what} of joint {self._joints[joint]} is {values[index, joint]}"


def _join(pieces: Sequence[Block]) -> Block:
    if len(pieces) == 1:
        return pieces[0]
    velocities = [piece.velocity for piece in pieces if piece.velocity is not None]
    return Block(
        np.concatenate([piece.stamp_ns for piece in pieces]),
        np.concatenate([piece.position for piece in pieces]),
        np.concatenate([piece.torque for piece in pieces]),
        np.concatenate(velocities) if velocities else None,
    )


def _cut(block: Block, start: int, stop: int) -> Block:
    part = slice(start, stop)
    velocity = None if block.velocity is None else block.velocity[part]
    return Block(block.stamp_ns[part], block.position[part], block.torque[part], velocity)
