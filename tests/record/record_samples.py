"""Samples that all tests of this room share: smooth, distinct in every entry, of any number of joints."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ident_service.recordings.cycle import Cycle
from ident_service.recordings.mcap_writer import RecordingWriter
from ident_service.recordings.recording import Block, Recording

OFFSET_NS = 1_700_000_000_123_456_789
START_NS = 55_000_000_000
STEP_NS = 1_000_000
JOINTS = ("shoulder", "elbow", "wrist_roll")
URDF = '<robot name="three"/>'


def position(k: int, joints: int) -> np.ndarray:
    return np.sin(0.01 * k + np.arange(joints))


def write_samples(writer: RecordingWriter, count: int, *, velocity: bool = False, first: int = 0) -> None:
    joints = len(writer.joint_names)
    for k in range(first, first + count):
        q = position(k, joints)
        writer.sample(
            Cycle(
                START_NS + k * STEP_NS,
                q,
                q + 10.0 if velocity else None,
                q + 20.0,
                q + 30.0,
                q + 40.0,
                k,
                100 + k,
                200 + k,
                np.arange(joints) != 1,
                np.arange(joints) + k,
                k // 2,
            )
        )


def write_recording(
    path: Path, count: int, joints: Sequence[str] = JOINTS, *, velocity: bool = False, offset_ns: int = OFFSET_NS
) -> Path:
    with RecordingWriter(path, joints, URDF, offset_ns, {"arm.yaml": b"name: three"}, {"run": "7"}) as writer:
        write_samples(writer, count, velocity=velocity)
    return path


def read_all(recording: Recording, samples: int = 4096) -> Block:
    """All blocks as one, with the promise about their lengths checked."""
    blocks = list(recording.blocks(samples))
    if not blocks:
        return Block(np.empty(0, np.int64), np.empty((0, recording.joints)), np.empty((0, recording.joints)))
    assert all(len(block.stamp_ns) == samples for block in blocks[:-1])
    velocities = [block.velocity for block in blocks if block.velocity is not None]
    assert len(velocities) in (0, len(blocks))
    return Block(
        np.concatenate([block.stamp_ns for block in blocks]),
        np.concatenate([block.position for block in blocks]),
        np.concatenate([block.torque for block in blocks]),
        np.concatenate(velocities) if velocities else None,
    )
