"""The simulated drives: which torque acts from which stamp on, and what noise acts with it.

Boundary: torques only, cycle by cycle; who may send one is `arm.py`, what a drive can make of it `imperfections.py`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from drivers.arm import Vector
from sim_backend.faults import Fault, FaultKind
from sim_backend.imperfections import Imperfections


class Drives:
    """A latch behind a queue, for all axes; it starts without torque."""

    def __init__(self, imperfections: Imperfections, delay_cycles: int, noise: np.random.Generator) -> None:
        """Set up the queue.

        Args:
            imperfections: clip, steps and noise.
            delay_cycles: 1 for torques that act from the stamp of their cycle on, more to let them wait.
            noise: draws once per cycle that the drives are on, if there is noise at all.
        """
        self._imperfections = imperfections
        self._waiting = delay_cycles - 1
        self._noise = noise
        self._noisy = bool(imperfections.torque_noise.any())
        self._on = False
        self.acting = _frozen(np.zeros_like(imperfections.torque_limit))
        self.forget()

    def forget(self) -> None:
        """Drop every torque that has not begun to act; nothing acts from the next latch on."""
        self._command = _frozen(np.zeros_like(self.acting))
        self._queue = deque([self._command] * self._waiting)

    def latch(self, torque: Vector | None, faults: Sequence[Fault], on: bool) -> Vector:
        """Begin the period from this stamp to the next.

        Args:
            torque: asked for [N m or N], shape (joints,); None asks for the last one again.
            faults: those active.
            on: whether the drives are energised; noise needs power.

        Returns:
            What acts from this stamp on, without noise [N m or N], shape (joints,), read-only.
        """
        if torque is not None:
            self._command = _frozen(self._imperfections.drive(torque))
        self._queue.append(self._command)
        acting = self._queue.popleft()
        for fault in faults:
            if fault.kind is FaultKind.STUCK_TORQUE:
                acting = acting.copy()
                acting[fault.axes] = self.acting[fault.axes]
        self.acting = _frozen(acting)
        self._on = on
        return self.acting

    def output(self) -> Vector:
        """What moves the plant for one period: the acting torque and its noise [N m or N], shape (joints,)."""
        if not (self._noisy and self._on):
            return self.acting
        return self.acting + self._imperfections.torque_noise * self._noise.standard_normal(self.acting.size)


def _frozen(array: Vector) -> Vector:
    array.setflags(write=False)
    return array
