"""Define the interface of a recording: path, hash, joints, and blocks of samples in order of time.

Readers implement it; how samples lie in a file is known to `mcap_file.py` and `csv_file.py` alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

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
    """Join consecutive blocks, at least one, into one."""
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
    """Return samples `start` to `stop` of a block, as views; its repeats count in the part with its first sample."""
    part = slice(start, stop)
    velocity = None if block.velocity is None else block.velocity[part]
    repeats = block.repeats if start == 0 else 0
    skipped = None if block.skipped is None else block.skipped[part]
    return Block(block.stamp_ns[part], block.position[part], block.torque[part], velocity, repeats, skipped)


class Recording(Protocol):
    """Define a file of samples that can be read any number of times, one block at a time.

    Attributes:
        path: the file.
        sha256: of the file's bytes.
        joint_names: in the order of the block's columns; empty where the file names none (CSV `q1..qN`).
        joints: number of joints.
        torque_held: True when the torque of a sample acts from its stamp until the next stamp (our own recordings:
            a zero-order hold), False when it was sampled at its stamp.
        torn: True when the file ended in the middle of a record and was read up to there.
    """

    path: Path
    sha256: str
    joint_names: tuple[str, ...]
    joints: int
    torque_held: bool
    torn: bool

    def blocks(self, samples: int = BLOCK_SAMPLES) -> Iterator[Block]:
        """Read the samples in order, `samples` at a time (the last block is shorter).

        Raises:
            RecordingError: NaN or infinite values, stamps that run backwards or repeat with other values, a torn row
                in a CSV file; the message names the first place.
        """
