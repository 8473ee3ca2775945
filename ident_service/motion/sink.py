"""Where samples and the story of a run go; `record.recorder.Recorder` is one."""

from __future__ import annotations

from typing import Protocol

from drivers.arm import Counts, Flags, Vector


class Sink(Protocol):
    """Keeps the disk away from the loop."""

    @property
    def error(self) -> str:
        """Why nothing is recorded any more; empty as long as something is, or nobody knows."""

    def put(
        self,
        stamp_ns: int,
        position: Vector,
        velocity: Vector | None,
        torque: Vector,
        reference_position: Vector,
        reference_velocity: Vector,
        cycle: int,
        lateness_ns: int,
        compute_ns: int,
        valid: Flags,
        age: Counts,
        lost: int,
    ) -> bool:
        """Take one cycle; False when the sink cannot keep up."""

    def event(self, stamp_ns: int, level: int, message: str) -> bool:
        """Take one line of the story."""
