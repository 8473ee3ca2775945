"""Recordings that tests make: in memory, with any stamps, and as bags of other people's."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from mcap_ros2.writer import Writer as BagWriter
from numpy.typing import NDArray

from ident_service.recordings.mcap_writer import DEFINITIONS, JOINT_STATE
from ident_service.recordings.recording import BLOCK_SAMPLES, Block, Matrix, Recording, Stamps, assemble, join
from ident_service.recordings.resampling import UniformRun

Array = NDArray[np.float64]


class MadeRecording:
    """A Recording of one block; reads like one from a file, checks included."""

    path = Path("made")
    sha256 = "0" * 64
    torn = False

    def __init__(
        self,
        stamp_ns: Stamps | Sequence[int],
        position: Matrix,
        torque: Matrix,
        velocity: Matrix | None = None,
        *,
        held: bool = False,
    ) -> None:
        # Blocks that were read are read-only; the caller's arrays stay his.
        own = None if velocity is None else velocity.copy()
        self.block = Block(np.array(stamp_ns, np.int64), position.copy(), torque.copy(), own)
        self.joints = position.shape[1]
        self.joint_names = tuple(f"j{k}" for k in range(self.joints))
        self.torque_zero_order_hold = held

    def blocks(self, samples: int = BLOCK_SAMPLES) -> Iterator[Block]:
        return assemble([self.block], samples, self.path, self.joint_names)


def curve(frequencies: Sequence[float], derivative: int = 0) -> Callable[[Array], Matrix]:
    """A smooth motion of one joint, or its derivative: times [s] of shape (samples,) to shape (samples, 1)."""

    def value(time: Array) -> Matrix:
        terms = [
            (2 * np.pi * f) ** derivative * np.sin(2 * np.pi * f * time + k + derivative * np.pi / 2)
            for k, f in enumerate(frequencies)
        ]
        return np.sum(terms, axis=0)[:, None]

    return value


def moving(stamp_ns: Stamps, *, held: bool = False, velocity: bool = False) -> MadeRecording:
    """Two joints on smooth curves, sampled at any stamps."""
    time = stamp_ns * 1e-9
    position = np.hstack([curve([0.5, 1.3])(time), curve([0.8])(time)])
    speed = np.hstack([curve([0.5, 1.3], 1)(time), curve([0.8], 1)(time)])
    return MadeRecording(stamp_ns, position, 3.0 * position + 0.1, speed if velocity else None, held=held)


def jittered(count: int, period_ns: int, share: float, seed: int = 1) -> Stamps:
    """Stamps off a regular grid by up to a share of its period."""
    off = np.random.default_rng(seed).uniform(-share, share, count) * period_ns
    return np.arange(count) * period_ns + np.rint(off).astype(np.int64)


def whole(recording: Recording, samples: int = BLOCK_SAMPLES) -> Block:
    """All samples at once."""
    return join(list(recording.blocks(samples)))


def segments_of(pieces: Iterator[UniformRun]) -> list[Block]:
    """One block a segment; the marks of start and end have to fit."""
    found: list[list[Block]] = []
    ended = True
    for piece in pieces:
        assert len(piece.block.stamp_ns)
        assert piece.start == ended
        if piece.start:
            found.append([])
        found[-1].append(piece.block)
        ended = piece.end
    assert ended
    return [join(blocks) for blocks in found]


def write_bag(path: Path, topic: str, names: Sequence[str], block: Block, *, twice: int | None = None) -> Path:
    """A ROS 2 bag in MCAP from an independent writer; `twice` is a sample that is delivered two times."""
    with path.open("wb") as stream:
        writer = BagWriter(stream)
        schema = writer.register_msgdef(JOINT_STATE, DEFINITIONS[JOINT_STATE].decode())
        for k, stamp in enumerate(block.stamp_ns.tolist()):
            seconds, nanoseconds = divmod(stamp, 10**9)
            message = {
                "header": {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": ""},
                "name": list(names),
                "position": block.position[k].tolist(),
                "velocity": [] if block.velocity is None else block.velocity[k].tolist(),
                "effort": block.torque[k].tolist(),
            }
            for _ in range(2 if k == twice else 1):
                writer.write_message(topic, schema, message, stamp)
        writer.finish()
    return path
