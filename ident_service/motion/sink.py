"""Define where samples and events of a run go; `record.recorder_process.RecorderProcess` is one such sink."""

from __future__ import annotations

from typing import Protocol

from ident_service.recordings.cycle import Cycle


class Sink(Protocol):
    """Define a sink of samples and events that keeps the disk away from the loop."""

    @property
    def error(self) -> str:
        """Return why nothing is recorded any more; empty as long as something is, or the reason is unknown."""

    def put(self, cycle: Cycle) -> bool:
        """Take one cycle; returns False when the sink cannot keep up."""

    def event(self, stamp_ns: int, level: int, message: str) -> bool:
        """Take one line of the run's story; returns False when the sink cannot keep up."""
