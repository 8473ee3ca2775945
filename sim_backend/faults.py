"""Define faults to inject into the simulated arm, so that supervision of a motion can be tested.

`FAULT_RULES` says in words what each kind does. What it does to readings is the table `_SHOWN` here, to drives
`machine.py`, to the body `machine.py`, to time `machine.py`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from drivers.arm import Counts, Flags, Vector
from ident_service.config.simulation import FAULT_RULES, SimulatedFault
from ident_service.config.simulation import FaultKind as FaultKind
from ident_service.errors import DriverError

LONGEST_DELAY = 1000  # cycles of positions kept for delayed feedback


@dataclass(frozen=True)
class Fault:
    """Describe one fault to inject.

    Attributes:
        at_cycle: first cycle it strikes, counted from `open`; in a separate process in real time, first period.
        kind: of the fault.
        joint: index of the axis, None for all.
        duration: cycles it lasts; None for one cycle or for good, as `FAULT_RULES` says.
        size: quantity that `FAULT_RULES` defines.
        offset: offset of a load, in the frame of the last link [m].
    """

    at_cycle: int
    kind: FaultKind
    joint: int | None = None
    duration: int | None = None
    size: float = 0.0
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def axes(self) -> slice:
        """Return the slice of axes that the fault strikes: one, or all."""
        return slice(None) if self.joint is None else slice(self.joint, self.joint + 1)

    def strikes(self, cycle: int) -> bool:
        """Return whether the fault strikes in this cycle; without a duration once or for good, by its kind's rule."""
        if cycle < self.at_cycle:
            return False
        if self.duration is None:
            return FAULT_RULES[self.kind].stays or cycle == self.at_cycle
        return cycle < self.at_cycle + self.duration


def active_faults(faults: Sequence[Fault], cycle: int) -> tuple[Fault, ...]:
    """Return the faults that strike in this cycle."""
    return tuple([fault for fault in faults if fault.strikes(cycle)]) if faults else ()


def configured_faults(faults: Sequence[SimulatedFault], names: Sequence[str], period: float) -> tuple[Fault, ...]:
    """Convert configured faults to ones by cycle and joint number; DriverError for an unknown joint.

    Args:
        faults: faults of the driver section.
        names: of the joints.
        period: of the control loop [s].

    Raises:
        DriverError: a joint that the arm does not have.
    """
    found = []
    for fault in faults:
        if fault.joint is not None and fault.joint not in names:
            raise DriverError(f"driver.faults: joint {fault.joint!r} is none of {', '.join(names)}")
        at_cycle = fault.cycle if fault.cycle is not None else round((fault.at or 0.0) / period)
        found.append(
            Fault(
                at_cycle,
                fault.kind,
                None if fault.joint is None else list(names).index(fault.joint),
                None if fault.duration is None else max(1, round(fault.duration / period)),
                fault.size or 0.0,
                fault.offset or (0.0, 0.0, 0.0),
            )
        )
    return tuple(found)


# New position of the axes struck, from (the fresh position, the last one shown, the one of `size` seconds ago).
_SHOWN: dict[FaultKind, Callable[[Vector, Vector, Vector, float], Vector]] = {
    FaultKind.LOST_FEEDBACK: lambda fresh, last, old, size: last,
    FaultKind.NODE_SILENT: lambda fresh, last, old, size: last,
    FaultKind.DELAYED_FEEDBACK: lambda fresh, last, old, size: old,
    FaultKind.HIDDEN_DELAY: lambda fresh, last, old, size: old,
    FaultKind.ENCODER_JUMP: lambda fresh, last, old, size: fresh + size,
    FaultKind.ENCODER_OFFSET: lambda fresh, last, old, size: fresh + size,
    FaultKind.FROZEN_ENCODER: lambda fresh, last, old, size: last,
    FaultKind.NAN_POSITION: lambda fresh, last, old, size: np.full_like(fresh, np.nan),
    FaultKind.POSITION_SIGN: lambda fresh, last, old, size: -fresh,
}
_UNANSWERED = (FaultKind.LOST_FEEDBACK, FaultKind.NODE_SILENT)


class Feedback:
    """Hold what the receiving side knows of the axes: last positions and status words, their ages, frames lost."""

    def __init__(self, joints: int, period: float) -> None:
        """Start without any answer.

        Args:
            joints: number of joints.
            period: period of the cycles [s], in which delays are counted.
        """
        # An axis that never answered has no position to repeat.
        self._last = np.full(joints, np.nan)
        self._age = np.zeros(joints, dtype=np.int64)
        self._period = period
        self._history: deque[Vector] = deque(maxlen=LONGEST_DELAY + 1)
        self._status = (0,) * joints
        self.lost = 0

    def receive(
        self, measured_position: Vector, status: tuple[int, ...], faults: Sequence[Fault]
    ) -> tuple[Vector, Flags, Counts, tuple[int, ...]]:
        """Return positions, validity, ages and status words of a cycle as its faults show them, and remember them.

        Args:
            measured_position: positions that the encoders show [rad or m], shape (joints,); kept.
            status: status words of the drives, per axis.
            faults: active faults.

        Returns:
            Positions, validity, age and status words as a sample holds them, arrays new and of shape (joints,).
        """
        self._history.append(measured_position)
        answered = np.ones(measured_position.shape, dtype=bool)
        if not faults:
            self._age = np.zeros_like(self._age)
            self._last, self._status = measured_position, status
            return measured_position.copy(), answered, self._age.copy(), status
        shown, delayed = measured_position.copy(), np.zeros_like(self._age)
        for fault in faults:
            if (effect := _SHOWN.get(fault.kind)) is None:
                continue
            axes, old = fault.axes, measured_position
            if fault.kind in (FaultKind.DELAYED_FEEDBACK, FaultKind.HIDDEN_DELAY):
                cycles = min(round(fault.size / self._period), len(self._history) - 1)
                old = self._history[-1 - cycles]
                if fault.kind is FaultKind.DELAYED_FEEDBACK:
                    delayed[axes] = cycles
            shown[axes] = effect(shown[axes], self._last[axes], old[axes], fault.size)
            if fault.kind in _UNANSWERED:
                answered[axes] = False
        self._age = np.where(answered, delayed, self._age + 1)
        self.lost += int(answered.size - np.count_nonzero(answered))
        if not answered.all():
            status = tuple(
                new if heard else before
                for new, before, heard in zip(status, self._status, answered.tolist(), strict=True)
            )
        self._last, self._status = shown, status
        return shown.copy(), answered & (delayed == 0), self._age.copy(), status
