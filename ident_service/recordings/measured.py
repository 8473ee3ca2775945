"""Replace the commanded torque of a recording by the torque that the drives measured.

A measured torque is reported with the positions of a stamp and acted until it, so that the torque which acts from stamp
k until the next one is that reported at k+1. A sample whose next one lacks a measurement of some joint is left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from ident_service.errors import RecordingError
from ident_service.recordings.mcap_file import McapRecording
from ident_service.recordings.recording import BLOCK_SAMPLES, Block

TOPIC: Final = "/joint_torques"
ENOUGH: Final = 0.99  # of the samples; fewer are reports now and then, for people and for judging drives


class MeasuredRecording:
    """Wrap a recording of this package and replace its torque by the measured one.

    Attributes:
        share: of the samples, that have a measured torque of all joints.
    """

    def __init__(self, whole: McapRecording) -> None:
        """Read the measured torques.

        Args:
            whole: a recording of this package.

        Raises:
            RecordingError: the file cannot be read.
        """
        self.path: Path = whole.path
        self.sha256 = whole.sha256
        self.joint_names = whole.joint_names
        self.joints = whole.joints
        self.torque_held = whole.torque_held
        self._whole = whole
        self._stamps, self._torque = whole.measured(TOPIC)
        usable = np.isfinite(self._torque).all(axis=1)
        self._stamps, self._torque = self._stamps[usable], self._torque[usable]
        self.share = 0.0
        if len(self._stamps):
            samples = sum(len(block.stamp_ns) for block in whole.blocks())
            self.share = len(self._stamps) / max(samples, 1)

    @property
    def torn(self) -> bool:
        """Return whether the file ended in the middle of a record and was read up to there."""
        return self._whole.torn

    @torn.setter
    def torn(self, torn: bool) -> None:
        self._whole.torn = torn

    def blocks(self, samples: int = BLOCK_SAMPLES) -> Iterator[Block]:
        """Read the samples in order; see `Recording.blocks`.

        Raises:
            RecordingError: as the recording's, or no sample has a measured torque.
        """
        found = False
        before: Block | None = None
        for block in self._whole.blocks(samples):
            # The first sample of the next block has the torque that acted at the end of this one.
            if before is not None:
                part = self._with_measured(before, int(block.stamp_ns[0]))
                found = found or bool(len(part.stamp_ns))
                yield part
            before = block
        if before is not None:
            part = self._with_measured(before, None)
            found = found or bool(len(part.stamp_ns))
            yield part
        if not found:
            raise RecordingError(self.path, "has no torque that drives measured; identification.torque: commanded")

    def _with_measured(self, block: Block, then_ns: int | None) -> Block:
        nexts = block.stamp_ns[1:] if then_ns is None else np.append(block.stamp_ns[1:], then_ns)
        places = np.searchsorted(self._stamps, nexts)
        there = places < len(self._stamps)
        there[there] = self._stamps[places[there]] == nexts[there]
        rows = np.flatnonzero(there)
        velocity = None if block.velocity is None else block.velocity[rows]
        return Block(block.stamp_ns[rows], block.position[rows], self._torque[places[rows]], velocity, block.repeats)
