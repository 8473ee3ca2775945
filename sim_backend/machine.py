"""Simulate everything beyond the bus: body, drives, encoders and faults, one period at a time.

The torque of a period is known at its beginning and constant until its end, so a period can be computed as soon as it
has begun: `cycle` (or `hold`, when no frame came) begins one, `advance` moves the body to its end.

`arm.py` and `plant_process.py` add clock, process and contract.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivers.arm import Counts, Flags, StopKind, Vector
from ident_service.errors import DriverError
from sim_backend.drives import RAMP, Drives
from sim_backend.faults import LONGEST_DELAY, Fault, FaultKind, Feedback, active_faults
from sim_backend.imperfections import Imperfections
from sim_backend.plant import Plant

# An arm that loses its power farther from its stand than this many times how far it sinks onto it falls beside it.
_STAND_REACH = 6.0
_DELAYS = (FaultKind.DELAYED_FEEDBACK, FaultKind.HIDDEN_DELAY)


@dataclass(frozen=True, slots=True)
class Truth:
    """Hold the true motion of the plant, for scoring only.

    Attributes:
        stamp_ns: the sample's stamp [ns], right even where the sample's is not.
        position: at the stamp, as no encoder sees it [rad or m], shape (joints,).
        velocity: at the stamp [rad/s or m/s], shape (joints,).
        acceleration: mean over the period before the stamp [rad/s^2 or m/s^2], shape (joints,).
        torque: acts from the stamp on, without its noise and without braking [N m or N], shape (joints,).
    """

    stamp_ns: int
    position: Vector
    velocity: Vector
    acceleration: Vector
    torque: Vector


@dataclass(frozen=True, slots=True)
class Reading:
    """Hold what the bus brings in one cycle; the fields are those of a `Sample`."""

    position: Vector
    torque: Vector
    valid: Flags
    age: Counts
    lost: int
    status: tuple[int, ...]
    status_age: int


@dataclass(frozen=True)
class Stand:
    """Support under the posture in which an arm is found, as a person puts it there before anything is energised.

    Attributes:
        sinking: of the joint that sinks farthest until the arm rests on it [rad or m].
        damping: with which it holds [N m s/rad or N s/m], shape (joints,).
    """

    sinking: float
    damping: Vector


class Machine:
    """Simulate a plant, its drives, encoders and faults; the same seed gives the same readings bit for bit."""

    def __init__(
        self,
        plant: Plant,
        imperfections: Imperfections,
        *,
        seed: int = 0,
        delay_cycles: int = 1,
        watchdog: float = 0.01,
        braking: Vector | None = None,
        unpowered: Vector | None = None,
        stand: Stand | None = None,
        faults: Sequence[Fault] = (),
    ) -> None:
        """Assemble the machine; one cycle is one period of the plant.

        Args:
            plant: body of the arm.
            imperfections: of encoders and drives.
            seed: of the torque noise.
            delay_cycles: from a sample to the first stamp at which a torque computed from it can act.
            watchdog: of the drives [s].
            braking: damping of idle axes [N m s/rad or N s/m], shape (joints,); None for no braking.
            unpowered: damping of axes that are off, and of idle ones after a quick stop's ramp [N m s/rad or N s/m],
                shape (joints,); None for axes that coast when off and are braked while idle.
            stand: what an arm rests on that nothing holds; None for nothing.
            faults: to inject, by period since `restart`.

        Raises:
            DriverError: pieces that do not fit each other.
        """
        joints = plant.chain.joints
        if imperfections.torque_limit.shape != (joints,):
            raise DriverError(f"{imperfections.torque_limit.shape=} but the plant has {joints} joints")
        if delay_cycles < 1:
            raise DriverError(f"{delay_cycles=}, but no torque can act before it is computed")
        if braking is not None and not (braking.shape == (joints,) and (braking >= 0.0).all()):
            raise DriverError(f"braking must be {joints} numbers, none negative, is {braking}")
        for fault in faults:
            if fault.joint is not None and not 0 <= fault.joint < joints:
                raise DriverError(f"{fault} names no joint of {joints}")
            if fault.kind in _DELAYS and fault.size > LONGEST_DELAY * plant.period:
                raise DriverError(f"{fault.kind.value} of {fault.size:g} s is longer than {LONGEST_DELAY} cycles")
            reach = imperfections.torque_limit[fault.axes]
            if fault.kind is FaultKind.TORQUE_SATURATION and not np.isfinite(reach).all():
                raise DriverError("torque_saturation: a share of a torque limit that the arm does not have")
        self.plant = plant
        self.imperfections = imperfections
        self.seed = seed
        self.faults = tuple(faults)
        # Rounding must not make the watchdog one period slower than it is.
        periods = max(1, int(np.ceil(watchdog / plant.period - 1e-6)))
        self.braking = np.zeros(joints) if braking is None else braking
        self.unpowered = unpowered
        self._drives = Drives(
            imperfections,
            delay_cycles,
            np.random.default_rng(seed),
            self.braking,
            periods,
            unpowered,
            max(1, round(RAMP / plant.period)),
        )
        self.stand = stand
        self._found, self._near = plant.position.copy(), True
        self.supported = True
        self.restart()

    @property
    def enabled(self) -> bool:
        """Return whether the host has energised the drives."""
        return self._drives.on

    @property
    def gave_up(self) -> bool:
        """Return whether the drives have received no torque frame for their watchdog's time."""
        return self._drives.gave_up

    @property
    def torque(self) -> Vector:
        """Return the torque that acts in the present period, without noise and braking [N m or N], shape (joints,)."""
        return self._drives.torque

    def restart(self) -> None:
        """Count periods and faults from 0 again, with drives off; the body stays where it is."""
        self.tick = 0
        self._feedback = Feedback(self.plant.chain.joints, self.plant.period)
        self._drives.restart()

    def enable(self) -> None:
        """Energise with zero torque.

        Raises:
            DriverError: a fault forbids it that struck in the last cycle or is latched; the drives are off then.
        """
        names = self.plant.chain.names
        why = self._drives.refusal(active_faults(self.faults, self.tick - 1), names)
        if why is None and (latched := self._drives.latched):
            which = ", ".join(names[axis] for axis in latched)
            why = f"{which}: a fault or an emergency stop is latched; `ident recover` resets it"
        if why is not None:
            self._drives.release(StopKind.TORQUE_OFF)
            raise DriverError(f"cannot be enabled: {why}")
        self._drives.enable()

    def reset(self) -> None:
        """Clear what the drives have latched; nothing is energised.

        Raises:
            DriverError: enabled, or the cause of a fault is still there.
        """
        if self.enabled:
            raise DriverError("drives are reset before they are enabled, not while")
        why = self._drives.refusal(active_faults(self.faults, self.tick - 1), self.plant.chain.names)
        if why is not None:
            raise DriverError(f"cannot be reset: {why}")
        self._drives.reset()

    def stop(self, kind: StopKind) -> None:
        """End torque with this period: drives are off after a torque off, and brake first after a quick stop."""
        self._drives.release(kind)

    def cycle(self, torque: Vector | None) -> Reading:
        """Begin a period with a frame.

        Args:
            torque: finite [N m or N], shape (joints,), or None to look.

        Raises:
            DriverError: a fault took the bus; the period has begun without a frame.
        """
        faults = self._begin()
        if any(fault.kind is FaultKind.BUS_GONE for fault in faults):
            self._drives.hold(faults)
            raise DriverError(f"cycle {self.tick - 1}: no axis answers, the bus is gone")
        acting = self._drives.latch(torque, faults)
        if torque is not None:
            self.supported = False
        fresh = self.imperfections.encode(self.plant.position)
        position, valid, age, status = self._feedback.receive(fresh, self._drives.status, faults)
        return Reading(position, acting, valid, age, self._feedback.lost, status, int(age.max()))

    def hold(self) -> None:
        """Begin a period in which no frame came."""
        self._drives.hold(self._begin())

    def advance(self) -> None:
        """Move the body to the end of the period that has begun; it stands until the first torque, supported.

        Raises:
            DriverError: the plant ran away; it stays where it was.
        """
        if not self.supported:
            self.plant.brake(self.stand.damping if self.stand and self._on_stand(self.stand) else self._drives.damping)
            self.plant.step(self._drives.output())

    def _on_stand(self, stand: Stand) -> bool:
        """Return whether an arm that lost its power near its stand has sunk onto it."""
        sunk = float(np.abs(self.plant.position - self._found).max())
        if self.enabled and not self.gave_up:
            self._near = sunk < _STAND_REACH * stand.sinking
            return False
        return self._near and sunk > stand.sinking

    def truth(self, stamp_ns: int) -> Truth:
        """Return the truth at the beginning of the present period, which is at `stamp_ns`."""
        plant = self.plant
        return Truth(stamp_ns, plant.position, plant.velocity, plant.acceleration, self._drives.torque)

    def _begin(self) -> tuple[Fault, ...]:
        faults = active_faults(self.faults, self.tick)
        self.tick += 1
        loads = [fault for fault in faults if fault.kind is FaultKind.LOAD_ATTACHED]
        self.plant.load(tuple((fault.size, fault.offset) for fault in loads))
        return faults
