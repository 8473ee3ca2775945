"""Simulate everything beyond the bus: body, drives, encoders and faults, cycle by cycle.

Two ways to be late. Where the plant only moves with cycles, the schedule moves back by the lateness and stamps stay
exactly one period apart. Where the plant moves by the machine's clock, a period that is over is skipped, and the
stamps say so. Neither ever catches up with a burst of short cycles.

Faults of time act here (late cycles, jumps of the clock).

A drive is on, off, or idle. Off, an axis coasts, unless its windings are shorted then or it has a brake. Idle, its
windings are shorted and brake it like viscous friction, `tau = -b dq`; after the ramp of a quick stop it is as when it
is off, and so it is at once where the power was taken from outside. Without a torque frame for the watchdog's time,
whatever the host believes, all drives go idle and stay so until they are enabled again. A drive's own fault and an
emergency stop stay latched until `reset`, which leaves their axes idle.

The torque of a period is known at its beginning and constant until its end, so a period can be computed as soon as it
has begun: `cycle` (or `hold`, when no frame came) begins one, `advance` moves the body to its end.

`arm.py` and `plant_process.py` add clock, process and contract.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version

import numpy as np

from drivers.arm import ArmDescription, Counts, Flags, StopKind, Vector, read_only
from drivers.axis_status import AxisStatus
from drivers.clock import Clock
from ident_service.errors import DriverError
from sim_backend.faults import LONGEST_DELAY, Fault, FaultKind, Feedback, active_faults
from sim_backend.plant import Imperfections, Plant


class Schedule:
    """Schedule cycles one period apart on one clock."""

    def __init__(self, clock: Clock, period_ns: int, *, skips: bool) -> None:
        """Start before the first cycle.

        Args:
            clock: the loop's.
            period_ns: time from cycle to cycle [ns].
            skips: whether periods that are over are skipped, instead of moving the schedule back.
        """
        self._clock = clock
        self._period_ns = period_ns
        self._skips = skips
        self.restart()

    def restart(self) -> None:
        """Start again: the next cycle is the first, whenever it comes."""
        self._first_ns: int | None = None
        self.stamp_ns = self._slip_ns = 0

    @property
    def tick(self) -> int:
        """Return the number of periods from the first stamp to the present one."""
        return 0 if self._first_ns is None else (self.stamp_ns - self._first_ns) // self._period_ns

    def wait(self, faults: Sequence[Fault]) -> int:
        """Wait for the next cycle to begin; returns its true stamp [ns]."""
        now = self._clock.now_ns()
        if self._first_ns is None:
            self._first_ns = self.stamp_ns = now
        else:
            self.stamp_ns += self._period_ns
            if not self._skips:
                self._slip_ns = max(self._slip_ns, now - self.stamp_ns)
        late = sum(fault.size for fault in active_faults(faults, self.tick) if fault.kind is FaultKind.LATE_CYCLE)
        self._clock.sleep_until_ns(self.stamp_ns + self._slip_ns + round(late * 1e9))
        if self._skips:
            self.stamp_ns += max(0, self._clock.now_ns() - self.stamp_ns) // self._period_ns * self._period_ns
        return self.stamp_ns

    def sample_stamp_ns(self, faults: Sequence[Fault]) -> int:
        """Return the stamp that a sample gives for the present cycle [ns]: the true one plus clock-jump faults."""
        jumps = [fault.size for fault in active_faults(faults, self.tick) if fault.kind is FaultKind.CLOCK_JUMP]
        return self.stamp_ns + round(sum(jumps) * 1e9)


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
        damping: damping of idle axes [N m s/rad or N s/m], shape (joints,), read-only.
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
            noise: random generator, of which one draw is taken per period that the drives are on, if there is noise at
                all.
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
        self._none = read_only(np.zeros(joints))
        self._off = self._none if unpowered is None else read_only(unpowered)
        # A power stage that failed shorts nothing; a brake, which holds more than shorted windings do, closes without.
        self._failed = read_only(np.where(self._off > braking, self._off, 0.0))
        self._after_ramp = braking if unpowered is None else unpowered
        self._ramp = ramp
        self._braked = np.zeros(joints, dtype=np.int64)  # periods that each axis has been idle
        self._trips = np.zeros(joints, dtype=np.int64)
        self._full = read_only(np.ones(joints))
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
    def watchdog_expired(self) -> bool:
        """Return whether the watchdog's time has passed without a torque frame."""
        return self._silent >= self._watchdog

    @property
    def status(self) -> tuple[int, ...]:
        """Return the `AxisStatus` bits of each axis, as of the last `latch` or `hold`."""
        return self._words

    @property
    def latched(self) -> tuple[int, ...]:
        """Return the indices of the axes that can be enabled again only after `reset`."""
        return tuple(np.flatnonzero(self._trips & int(AxisStatus.FAULT | AxisStatus.EMERGENCY_STOP)).tolist())

    def reset(self) -> None:
        """Forget faults, emergency stop and watchdog; their axes are left idle, that is braked."""
        self._trips[self._trips != 0] = int(AxisStatus.IDLE)
        self._silent = 0

    def enable(self) -> None:
        """Energise without torque, and clear all that is latched, and the watchdog."""
        self._forget()
        self._trips[:] = 0
        self._braked[:] = 0
        self._silent = 0
        self.on = True

    def release(self, kind: StopKind) -> None:
        """Switch off after this period, dropping waiting torques; a quick stop leaves axes idle until enabled."""
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
        """Queue a torque (None: the last one again) and begin a period; return the torque acting in it after the delay.

        Args:
            torque: demanded torque [N m or N], shape (joints,); None asks for the last one again, and is no torque
                frame.
            faults: active faults.

        Returns:
            `acting`.
        """
        if torque is not None:
            self._command = read_only(self._imperfections.quantize_torque(torque))
        self._silent = self._silent + 1 if torque is None and self.on else 0
        self._queue.append(self._command)
        self._wanted = self._queue.popleft()
        return self._begin(faults)

    def hold(self, faults: Sequence[Fault]) -> None:
        """Begin a period in which no frame came at all, which counts for the watchdog."""
        self._silent += 1
        self._begin(faults)

    def output(self) -> Vector:
        """Return the torque, with freshly drawn noise, that moves the plant in a period [N m or N], shape (joints,)."""
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
        self.acting, self.torque = read_only(told), read_only(really)
        idle = (trips & int(AxisStatus.IDLE)) != 0
        self._braked = np.where(idle, self._braked + 1, 0)
        # An axis that lost its power, by the emergency stop or by itself, has no ramp.
        ramping = idle & (self._braked <= self._ramp) & ((trips & _POWERLESS) == 0)
        off = np.where(idle, self._after_ramp, self._off)
        failed = (trips & int(AxisStatus.FAULT)) != 0
        self.damping = read_only(
            np.where(ramping, self._braking, np.where((trips == 0) & self.on, 0.0, np.where(failed, self._failed, off)))
        )
        self._powered = read_only(np.where((trips == 0) & self.on, 1.0, 0.0))
        words = np.where(trips == 0, int(self.on), trips & ~_SILENT)
        self._words = tuple(words.tolist())
        return self.acting


# An arm that loses its power farther from its stand than this many times how far it sinks onto it falls beside it.
_STAND_REACH = 6.0
_DELAYS = (FaultKind.DELAYED_FEEDBACK, FaultKind.HIDDEN_DELAY)


@dataclass(frozen=True, slots=True)
class Truth:
    """Hold the true motion of the plant, for scoring only.

    Attributes:
        stamp_ns: the sample's stamp [ns], right even where the sample's is not.
        position: true position at the stamp, as no encoder sees it [rad or m], shape (joints,).
        velocity: true velocity at the stamp [rad/s or m/s], shape (joints,).
        acceleration: mean acceleration over the period before the stamp [rad/s^2 or m/s^2], shape (joints,).
        torque: torque that acts from the stamp on, without its noise and without braking [N m or N], shape (joints,).
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
        sinking: travel of the joint that sinks farthest until the arm rests on it [rad or m].
        damping: damping with which the stand holds [N m s/rad or N s/m], shape (joints,).
    """

    sinking: float
    damping: Vector


class SimulatedHardware:
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
            delay_cycles: delay from a sample to the first stamp at which a torque computed from it can act [cycles].
            watchdog: time without a torque frame after which the drives go idle [s].
            braking: damping of idle axes [N m s/rad or N s/m], shape (joints,); None for no braking.
            unpowered: damping of axes that are off, and of idle ones after a quick stop's ramp [N m s/rad or N s/m],
                shape (joints,); None for axes that coast when off and are braked while idle.
            stand: stand that an arm rests on that nothing holds; None for none.
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
        self.watchdog, self.delay_cycles = watchdog, delay_cycles
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
        """Return whether the host has energised the drives since its last stop; True also once they have tripped."""
        return self._drives.on

    @property
    def watchdog_expired(self) -> bool:
        """Return whether the drives have received no torque frame for their watchdog's time."""
        return self._drives.watchdog_expired

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
        """Energise with zero torque; raises DriverError where a fault strikes or is latched, and switches off then.

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
        """Clear the faults that drives have latched, energising nothing; DriverError if enabled or a cause persists.

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
        """Begin a period with a frame, with or without torque, and return its reading; DriverError if the bus is gone.

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
        fresh = self.imperfections.quantize_position(self.plant.position)
        position, valid, age, status = self._feedback.receive(fresh, self._drives.status, faults)
        return Reading(position, acting, valid, age, self._feedback.lost, status, int(age.max()))

    def hold(self) -> None:
        """Begin a period in which no frame came, which counts for the watchdog."""
        self._drives.hold(self._begin())

    def advance(self) -> None:
        """Move the body to the end of the period that has begun; it stands until the first torque, supported.

        Raises:
            DriverError: the plant ran away; it stays where it was.
        """
        if not self.supported:
            self.plant.set_braking(
                self.stand.damping if self.stand and self._has_sunk_onto_support(self.stand) else self._drives.damping
            )
            self.plant.step(self._drives.output())

    def _has_sunk_onto_support(self, stand: Stand) -> bool:
        """Return whether an arm that lost its power near its stand has sunk onto it."""
        sunk = float(np.abs(self.plant.position - self._found).max())
        if self.enabled and not self.watchdog_expired:
            self._near = sunk < _STAND_REACH * stand.sinking
            return False
        return self._near and sunk > stand.sinking

    def truth(self, stamp_ns: int) -> Truth:
        """Return the present motion, stamped `stamp_ns`; its acceleration is the mean over the period before."""
        plant = self.plant
        return Truth(stamp_ns, plant.position, plant.velocity, plant.acceleration, self._drives.torque)

    def _begin(self) -> tuple[Fault, ...]:
        faults = active_faults(self.faults, self.tick)
        self.tick += 1
        loads = [fault for fault in faults if fault.kind is FaultKind.LOAD_ATTACHED]
        self.plant.attach_loads(tuple((fault.size, fault.offset) for fault in loads))
        return faults


def checked_torque(torque: Vector | None, enabled: bool, joints: int) -> Vector | None:
    """Return the torque as an array, or None for None; DriverError if not enabled, misshapen or not finite.

    Raises:
        DriverError: a torque for an arm that is not enabled, of another shape, or not finite.
    """
    if torque is None:
        return None
    if not enabled:
        raise DriverError("a torque for an arm that is not enabled")
    value = np.asarray(torque, dtype=float)
    if value.shape != (joints,):
        raise DriverError(f"{value.shape=} but the arm has {joints} joints")
    if not np.isfinite(value).all():
        raise DriverError(f"a torque that is not finite: {value}")
    return value


def description(machine: SimulatedHardware) -> ArmDescription:
    """Return the description of a simulated arm: joints, rate, torque limits, resolutions, watchdog and delay."""
    names = machine.plant.chain.names
    return ArmDescription(
        joint_names=names,
        rate=1e9 / round(machine.plant.period * 1e9),
        torque_limit=machine.imperfections.torque_limit,
        torque_resolution=machine.imperfections.torque_resolution,
        position_resolution=machine.imperfections.encoder_resolution,
        identities=tuple(f"simulated axis {name}, seed {machine.seed}" for name in names),
        software=f"sim_backend {version('ident-service')}",
        scheduled_stamps=True,
        watchdog=machine.watchdog,
        delay_cycles=machine.delay_cycles,
    )
