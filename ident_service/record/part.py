"""A recording without its first and last seconds: approach and return, or whatever else does not belong to it."""

from __future__ import annotations

from collections.abc import Iterator

from ident_service.record.grid import trimmed
from ident_service.record.recording import BLOCK_SAMPLES, Block, Recording


class TrimmedRecording:
    """Part of another recording behind the same protocol; the hash is the whole file's."""

    def __init__(self, whole: Recording, start: float, end: float) -> None:
        """Leave out `start` seconds at the beginning and `end` seconds at the end of `whole`."""
        self.path = whole.path
        self.sha256 = whole.sha256
        self.joint_names = whole.joint_names
        self.joints = whole.joints
        self.torque_held = whole.torque_held
        self.torn = whole.torn
        self._whole, self._trim = whole, (start, end)

    def blocks(self, samples: int = BLOCK_SAMPLES) -> Iterator[Block]:
        """Read the samples in order; see `Recording.blocks`. Blocks at the ends are shorter."""
        return trimmed(self._whole.blocks(samples), self._trim)
