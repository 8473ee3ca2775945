"""Where samples and the story of a run go; `record.recorder_process.RecorderProcess` is one."""

from __future__ import annotations

from typing import Protocol

from ident_service.record.cycle import Cycle


class Sink(Protocol):
    """Keeps the disk away from the loop."""

    @property
    def error(self) -> str:
        """Why nothing is recorded any more; empty as long as something is, or nobody knows."""

    def put(self, cycle: Cycle) -> bool:
        """Take one cycle; False when the sink cannot keep up."""

    def event(self, stamp_ns: int, level: int, message: str) -> bool:
        """Take one line of the story."""
