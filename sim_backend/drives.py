"""Simulate drives: which torque acts from which stamp on, its noise, and when the watchdog stops the drives.

A drive is on, off, or idle. Off, an axis coasts, unless its windings are shorted then or it has a brake. Idle, its
windings are shorted and brake it like viscous friction, `tau = -b dq`; after the ramp of a quick stop it is as when it
is off, and so it is at once where the power was taken from outside. Without a torque frame for the watchdog's time,
whatever the host believes, all drives go idle and stay so until they are enabled again. A drive's own fault and an
emergency stop stay latched until `reset`, which leaves their axes idle.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from drivers.arm import StopKind, Vector
from drivers.axis_status import AxisStatus
from sim_backend.faults import Fault, FaultKind
from sim_backend.imperfections import Imperfections

RAMP = 0.1  # s for which a quick stop brakes before the power stage is off
_SILENT = 1 << 16  # an axis that no longer talks; no host ever reads this bit
# What a fault latches in the axes it strikes. All but a drive's own fault leave the axis idle.
_TRIPS: dict[FaultKind, int] = {
    FaultKind.DRIVE_FAULT: AxisStatus.FAULT,
    FaultKind.EMERGENCY_STOP: AxisStatus.EMERGENCY_STOP | AxisStatus.IDLE,
    FaultKind.NODE_SILENT: _SILENT | AxisStatus.IDLE,
}
_POWERLESS = _SILENT | int(AxisStatus.EMERGENCY_STOP)
_WHY = {
    FaultKind.DRIVE_FAULT: "its drive has a fault",
    FaultKind.EMERGENCY_STOP: "the emergency stop is pressed",
    FaultKind.NODE_SILENT: "it does not answer",
}


class Drives:
    """Simulate the drives of all axes, as a latch behind a queue; they start without torque.

    Attributes:
        acting: torque that a sample says acts from the last stamp on, without noise [N m or N], shape (joints,),
            read-only.
        torque: torque that really acts, where the two differ; as `acting`.
        damping: of idle axes [N m s/rad or N s/m], shape (joints,), read-only.
        on: whether the host has energised the drives.
    """

    def __init__(
        self,
        imperfections: Imperfections,
        delay_cycles: int,
        noise: np.random.Generator,
        braking: Vector,
        watchdog: int,
        unpowered: Vector | None = None,
        ramp: int = 1,
    ) -> None:
        """Set up the queue.

        Args:
            imperfections: clip, steps and noise.
            delay_cycles: 1 for torques that act from the stamp of their cycle on, more to let them wait.
            noise: draws once per period that the drives are on, if there is noise at all.
            braking: damping of an idle axis [N m s/rad or N s/m], shape (joints,).
            watchdog: periods without a torque frame after which the drives go idle.
            unpowered: damping of an axis that is off, and of an idle one after `ramp` periods [N m s/rad or N s/m],
                shape (joints,); None for one that coasts when off and is braked for as long as it is idle.
            ramp: periods for which an axis that goes idle is braked.
        """
        self._imperfections = imperfections
        self._waiting = delay_cycles - 1
        self._noise = noise
        self._noisy = bool(imperfections.torque_noise.any())
        self._braking = braking
        self._watchdog = watchdog
        joints = imperfections.torque_limit.size
        self._none = _frozen(np.zeros(joints))
        self._off = self._none if unpowered is None else _frozen(unpowered)
        # A power stage that failed shorts nothing; a brake, which holds more than shorted windings do, closes without.
        self._failed = _frozen(np.where(self._off > braking, self._off, 0.0))
        self._after_ramp = braking if unpowered is None else unpowered
        self._ramp = ramp
        self._braked = np.zeros(joints, dtype=np.int64)  # periods that each axis has been idle
        self._trips = np.zeros(joints, dtype=np.int64)
        self._full = _frozen(np.ones(joints))
        self._powered = self._none
        self._energised = False
        self._silent = 0
        self.on = False
        self.acting = self.torque = self.damping = self._none
        self._words = (0,) * joints
        self._command = self._wanted = self._none
        self._queue: deque[Vector] = deque()
        self._forget()

    @property
    def gave_up(self) -> bool:
        """Return whether the watchdog's time has passed without a frame."""
        return self._silent >= self._watchdog

    @property
    def status(self) -> tuple[int, ...]:
        """Return the bits of `AxisStatus` per axis."""
        return self._words

    @property
    def latched(self) -> tuple[int, ...]:
        """Return the axes that can be enabled again only after `reset`."""
        return tuple(np.flatnonzero(self._trips & int(AxisStatus.FAULT | AxisStatus.EMERGENCY_STOP)).tolist())

    def reset(self) -> None:
        """Forget faults, emergency stop and watchdog; their axes are left idle, that is braked."""
        self._trips[self._trips != 0] = int(AxisStatus.IDLE)
        self._silent = 0

    def enable(self) -> None:
        """Energise without torque, and clear the watchdog."""
        self._forget()
        self._trips[:] = 0
        self._braked[:] = 0
        self._silent = 0
        self.on = True

    def release(self, kind: StopKind) -> None:
        """Drop every torque that has not begun to act; a quick stop leaves all axes idle until enabled again."""
        self._forget()
        self.on = False
        if kind is StopKind.QUICK_STOP:
            self._trips |= int(AxisStatus.IDLE)

    def restart(self) -> None:
        """Restart with the drives off; drives whose watchdog struck stay as they are until enabled."""
        self.release(StopKind.TORQUE_OFF)
        self._silent = 0
        self.acting = self.torque = self._none
        self.damping = self._off

    def refusal(self, faults: Sequence[Fault], names: Sequence[str]) -> str | None:
        """Return why the drives cannot be enabled while these faults strike; None if they can."""
        for fault in faults:
            if fault.kind in _WHY:
                which = "all axes" if fault.joint is None else names[fault.joint]
                return f"{which}: {_WHY[fault.kind]}"
        return None

    def latch(self, torque: Vector | None, faults: Sequence[Fault]) -> Vector:
        """Begin the period from this stamp to the next.

        Args:
            torque: asked for [N m or N], shape (joints,); None asks for the last one again, and is no torque frame.
            faults: those active.

        Returns:
            `acting`.
        """
        if torque is not None:
            self._command = _frozen(self._imperfections.drive(torque))
        self._silent = self._silent + 1 if torque is None and self.on else 0
        self._queue.append(self._command)
        self._wanted = self._queue.popleft()
        return self._begin(faults)

    def hold(self, faults: Sequence[Fault]) -> None:
        """Begin a period in which no frame came at all."""
        self._silent += 1
        self._begin(faults)

    def output(self) -> Vector:
        """Return the torque with its noise that moves the plant for one period [N m or N], shape (joints,)."""
        if not (self._noisy and self._energised):
            return self.torque
        noise = self._imperfections.torque_noise * self._noise.standard_normal(self.torque.size)
        return self.torque + noise * self._powered

    def _forget(self) -> None:
        self._command = self._wanted = self._none
        self._queue = deque([self._command] * self._waiting)

    def _begin(self, faults: Sequence[Fault]) -> Vector:
        trips, wanted = self._trips, self._wanted
        self._energised = self.on
        if self._silent >= self._watchdog:
            trips |= int(AxisStatus.IDLE | AxisStatus.WATCHDOG if self.on else AxisStatus.IDLE)
        for fault in faults:
            trips[fault.axes] |= _TRIPS.get(fault.kind, 0)
        if not faults and not trips.any():
            self.acting = self.torque = wanted
            self.damping = self._none if self.on else self._off
            self._powered = self._full if self.on else self._none
            self._words = (int(self.on),) * wanted.size
            return wanted
        told = wanted.copy()
        for fault in faults:
            axes = fault.axes
            if fault.kind is FaultKind.STUCK_TORQUE:
                told[axes] = self.acting[axes]
            elif fault.kind is FaultKind.TORQUE_SATURATION:
                reach = fault.size * self._imperfections.torque_limit[axes]
                told[axes] = np.clip(told[axes], -reach, reach)
        told[(trips & ~(_SILENT | int(AxisStatus.IDLE))) != 0] = 0.0
        told[trips == int(AxisStatus.IDLE)] = 0.0
        really = np.where(trips != 0, 0.0, told)
        for fault in faults:
            if fault.kind is FaultKind.TORQUE_SIGN:
                really[fault.axes] *= -1.0
        self.acting, self.torque = _frozen(told), _frozen(really)
        idle = (trips & int(AxisStatus.IDLE)) != 0
        self._braked = np.where(idle, self._braked + 1, 0)
        # An axis that lost its power, by the emergency stop or by itself, has no ramp.
        ramping = idle & (self._braked <= self._ramp) & ((trips & _POWERLESS) == 0)
        off = np.where(idle, self._after_ramp, self._off)
        failed = (trips & int(AxisStatus.FAULT)) != 0
        self.damping = _frozen(
            np.where(ramping, self._braking, np.where((trips == 0) & self.on, 0.0, np.where(failed, self._failed, off)))
        )
        self._powered = _frozen(np.where((trips == 0) & self.on, 1.0, 0.0))
        words = np.where(trips == 0, int(self.on), trips & ~_SILENT)
        self._words = tuple(words.tolist())
        return self.acting


def _frozen(array: Vector) -> Vector:
    array.setflags(write=False)
    return array
