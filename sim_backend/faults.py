"""Faults to inject into the simulated arm, so that whoever guards a motion can be seen to notice them.

Boundary: which fault strikes when, and what it does to one cycle's readings; the arm asks, nothing here has a clock.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from drivers.arm import Counts, Flags, Vector


class FaultKind(Enum):
    """What can go wrong."""

    LOST_FEEDBACK = "lost_feedback"  # no answer: invalid, ageing, the last position repeated
    ENCODER_JUMP = "encoder_jump"  # `size` added to the position while it lasts
    FROZEN_ENCODER = "frozen_encoder"  # the last position repeated, as if it were fresh
    NAN_POSITION = "nan_position"  # not a number, as if it were one
    STUCK_TORQUE = "stuck_torque"  # the torque of the cycle before goes on acting
    BUS_GONE = "bus_gone"  # exchange raises, the torque of the cycle before goes on acting
    LATE_CYCLE = "late_cycle"  # exchange returns `size` seconds after its deadline


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes:
        at_cycle: first cycle it strikes.
        kind: what goes wrong.
        joint: index of the axis, None for all.
        duration: cycles it lasts.
        size: of a jump [rad or m], of a delay [s].
    """

    at_cycle: int
    kind: FaultKind
    joint: int | None = None
    duration: int = 1
    size: float = 0.0

    @property
    def axes(self) -> slice:
        """The axes it strikes."""
        return slice(None) if self.joint is None else slice(self.joint, self.joint + 1)


def active_faults(faults: Sequence[Fault], cycle: int) -> tuple[Fault, ...]:
    """The faults that strike in this cycle."""
    return tuple(fault for fault in faults if fault.at_cycle <= cycle < fault.at_cycle + fault.duration)


# What becomes of (the fresh position, the last one shown) of the axes struck, given the fault's size.
_SHOWN: dict[FaultKind, Callable[[Vector, Vector, float], Vector]] = {
    FaultKind.LOST_FEEDBACK: lambda fresh, last, size: last,
    FaultKind.ENCODER_JUMP: lambda fresh, last, size: fresh + size,
    FaultKind.FROZEN_ENCODER: lambda fresh, last, size: last,
    FaultKind.NAN_POSITION: lambda fresh, last, size: np.full_like(fresh, np.nan),
}


class Feedback:
    """What the receiving side knows of the axes: last positions, their ages, frames lost."""

    def __init__(self, joints: int) -> None:
        # An axis that never answered has no position to repeat.
        self._last = np.full(joints, np.nan)
        self._age = np.zeros(joints, dtype=np.int64)
        self.lost = 0

    def receive(self, fresh: Vector, faults: Sequence[Fault]) -> tuple[Vector, Flags, Counts]:
        """Pass one cycle's positions through the faults of that cycle.

        Args:
            fresh: what the encoders show [rad or m], shape (joints,); may be written into.
            faults: those active.

        Returns:
            Positions, validity and age as a sample holds them, new arrays of shape (joints,).
        """
        answered = np.ones(fresh.shape, dtype=bool)
        for fault in faults:
            if (shown := _SHOWN.get(fault.kind)) is not None:
                fresh[fault.axes] = shown(fresh[fault.axes], self._last[fault.axes], fault.size)
            if fault.kind is FaultKind.LOST_FEEDBACK:
                answered[fault.axes] = False
        self._age = np.where(answered, 0, self._age + 1)
        self.lost += int(answered.size - np.count_nonzero(answered))
        self._last = fresh
        return fresh.copy(), answered, self._age.copy()
