"""The simulated arm: a plant behind the Arm contract, in real or in virtual time.

Time. Cycle k waits for its deadline, moves the plant from stamp k-1 to stamp k under the torque that acts between them,
shows the positions, and latches the new torque, which acts from stamp k on. Simulated time only passes with cycles:
stamps of consecutive cycles are exactly one period apart, as far as the plant has really moved, whatever the clock did.
When a deadline has passed before its cycle is asked for, that cycle begins at once and the whole schedule moves back by
the lateness, instead of a burst of short cycles catching up; how late a cycle is, is the loop's to measure, on the
clock and from one cycle to the next.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version

import numpy as np

from drivers.arm import Arm, ArmDescription, Sample, StopKind, Vector
from drivers.clock import Clock, RealClock, VirtualClock
from ident_service.config.schema import ArmConfig, PerJoint, SimulatedDriver
from ident_service.errors import DriverError
from ident_service.model.arm_model import arm_model
from sim_backend.drives import Drives
from sim_backend.faults import Fault, FaultKind, Feedback, active_faults
from sim_backend.imperfections import Imperfections
from sim_backend.plant import Plant


@dataclass(frozen=True, slots=True)
class Truth:
    """What the plant really did, for scoring only.

    Attributes:
        stamp_ns: the sample's stamp [ns].
        position: at the stamp, as no encoder sees it [rad or m], shape (joints,).
        velocity: at the stamp [rad/s or m/s], shape (joints,).
        acceleration: mean over the period before the stamp [rad/s^2 or m/s^2], shape (joints,).
        torque: acts from the stamp on, without its noise [N m or N], shape (joints,).
    """

    stamp_ns: int
    position: Vector
    velocity: Vector
    acceleration: Vector
    torque: Vector


class SimulatedArm(Arm):
    """A plant, its imperfections and its faults as an Arm; the same seed gives the same samples bit for bit."""

    def __init__(
        self,
        plant: Plant,
        imperfections: Imperfections,
        clock: Clock,
        *,
        seed: int = 0,
        delay_cycles: int = 1,
        faults: Sequence[Fault] = (),
        observer: Callable[[Truth], None] | None = None,
    ) -> None:
        """Put the pieces together; one cycle is one period of the plant.

        Args:
            plant: what moves.
            imperfections: of encoders and drives.
            clock: the loop's.
            seed: of the torque noise.
            delay_cycles: from a sample to the first stamp at which a torque computed from it can act; 1 is the
                contract's, each further one a cycle that torques wait in a queue.
            faults: to inject, by cycle since `open`.
            observer: called with the truth of every cycle.

        Raises:
            DriverError: pieces that do not fit each other.
        """
        joints = plant.chain.joints
        if imperfections.torque_limit.shape != (joints,):
            raise DriverError(f"{imperfections.torque_limit.shape=} but the plant has {joints} joints")
        if delay_cycles < 1:
            raise DriverError(f"{delay_cycles=}, but no torque can act before it is computed")
        if bad := [fault for fault in faults if fault.joint is not None and not 0 <= fault.joint < joints]:
            raise DriverError(f"{bad[0]} names no joint of {joints}")
        self.clock = clock
        self.plant = plant
        self.imperfections = imperfections
        self.seed = seed
        self.faults = tuple(faults)
        self.observer = observer
        self._period_ns = round(plant.period * 1e9)
        self._delay_cycles = delay_cycles
        self._noise = np.random.default_rng(seed)
        self._open = self._enabled = False
        self._supported = True
        self._restart()

    def open(self) -> None:
        """Take the arm; its cycles count from 0, its plant stays where it was."""
        if self._open:
            raise DriverError("the simulated arm is already open")
        self._restart()
        self._open = True

    def describe(self) -> ArmDescription:
        """Say what is simulated; raises DriverError when not open."""
        self._require_open()
        names = self.plant.chain.names
        return ArmDescription(
            joint_names=names,
            rate=1e9 / self._period_ns,
            torque_limit=self.imperfections.torque_limit,
            torque_resolution=self.imperfections.torque_resolution,
            position_resolution=self.imperfections.encoder_resolution,
            identities=tuple(f"simulated axis {name}, seed {self.seed}" for name in names),
            software=f"sim_backend {version('ident-service')}",
        )

    def enable(self) -> None:
        """Energise with zero torque; raises DriverError when not open."""
        self._require_open()
        self._drives.forget()
        self._enabled = True

    def exchange(self, torque: Vector | None) -> Sample:
        """One cycle, as the contract has it; None while enabled lets the last torque act on, as drives do.

        Raises:
            DriverError: as in the contract; or the plant ran away, or a fault took the bus, both of which use up
                the cycle with the last torque acting on.
        """
        self._require_open()
        command = None if torque is None else self._checked(torque)
        cycle, faults = self._cycle, active_faults(self.faults, self._cycle)
        self._wait(sum(fault.size for fault in faults if fault.kind is FaultKind.LATE_CYCLE))
        self._cycle += 1
        if cycle > 0 and not self._supported:
            self.plant.step(self._drives.output())
        if any(fault.kind is FaultKind.BUS_GONE for fault in faults):
            raise DriverError(f"cycle {cycle}: no axis answers, the bus is gone")
        position, valid, age = self._feedback.receive(self.imperfections.encode(self.plant.position), faults)
        acting = self._drives.latch(command, faults, self._enabled)
        if command is not None:
            self._supported = False
        if self.observer is not None:
            plant = self.plant
            self.observer(Truth(self._stamp_ns, plant.position, plant.velocity, plant.acceleration, acting))
        return Sample(cycle, self._stamp_ns, position, None, acting, valid, age, lost=self._feedback.lost)

    def stop(self, kind: StopKind) -> None:
        """No torque, whatever the kind: what the last sample reported acts until its period ends, then nothing."""
        self._enabled = False
        self._drives.forget()

    def close(self) -> None:
        """Torque off and released; any number of times."""
        self.stop(StopKind.TORQUE_OFF)
        self._open = False

    def _restart(self) -> None:
        self._cycle = self._stamp_ns = self._slip_ns = 0
        self._feedback = Feedback(self.plant.chain.joints)
        self._drives = Drives(self.imperfections, self._delay_cycles, self._noise)

    def _require_open(self) -> None:
        if not self._open:
            raise DriverError("the simulated arm is not open")

    def _checked(self, torque: Vector) -> Vector:
        if not self._enabled:
            raise DriverError("a torque for an arm that is not enabled")
        value = np.asarray(torque, dtype=float)
        if value.shape != (self.plant.chain.joints,):
            raise DriverError(f"{value.shape=} but the arm has {self.plant.chain.joints} joints")
        if not np.isfinite(value).all():
            raise DriverError(f"a torque that is not finite: {value}")
        return value

    def _wait(self, lateness: float) -> None:
        now = self.clock.now_ns()
        if self._cycle == 0:
            self._stamp_ns = now
        else:
            self._stamp_ns += self._period_ns
            self._slip_ns = max(self._slip_ns, now - self._stamp_ns)
        self.clock.sleep_until_ns(self._stamp_ns + self._slip_ns + round(lateness * 1e9))


def from_config(
    config: ArmConfig,
    clock: Clock | None = None,
    *,
    faults: Sequence[Fault] = (),
    observer: Callable[[Truth], None] | None = None,
) -> SimulatedArm:
    """The arm a configuration with a simulated driver describes, at its home position and at rest.

    Args:
        config: its driver's truth, or else its prior, becomes the plant.
        clock: the loop's; by default what `driver.time` asks for.
        faults: to inject.
        observer: called with the truth of every cycle.

    Raises:
        DriverError: the driver is not a simulated one, values for another number of joints, or no parameters.
        ModelError: no mechanism, or parameters that no real body has.
        ParameterError: true parameters that the arm does not have.
    """
    driver = config.driver
    if not isinstance(driver, SimulatedDriver):
        raise DriverError(f"{config.name}: the driver is not a simulated one")
    model = arm_model(config)
    truth = model.prior if driver.truth is None else model.layout.vector(driver.truth)
    if truth is None:
        raise DriverError(f"{config.name}: a simulated arm needs driver.truth, or a prior to take for the truth")
    joints = [config.joints.get(name) for name in model.chain.names]
    home = np.zeros(len(joints))
    limit = np.full(len(joints), np.inf)
    for index, joint in enumerate(joints):
        if joint is None:
            continue
        if joint.home is not None:
            home[index] = joint.home
        elif joint.position is not None:
            home[index] = np.clip(0.0, *joint.position)
        if joint.torque is not None:
            limit[index] = joint.torque
    imperfections = Imperfections(
        encoder_resolution=_per_joint("encoder_resolution", driver.encoder_resolution, len(joints)),
        torque_resolution=_per_joint("torque_resolution", driver.torque_resolution, len(joints)),
        torque_noise=_per_joint("torque_noise", driver.torque_noise, len(joints)),
        torque_limit=limit,
    )
    # Stamps are whole nanoseconds, and the plant must move by exactly as much.
    plant = Plant(model.chain, model.layout, truth, home, round(1e9 / config.control.rate) * 1e-9)
    if clock is None:
        clock = VirtualClock() if driver.time == "virtual" else RealClock()
    return SimulatedArm(
        plant,
        imperfections,
        clock,
        seed=driver.seed,
        delay_cycles=driver.delay_cycles,
        faults=faults,
        observer=observer,
    )


def _per_joint(name: str, value: PerJoint, joints: int) -> Vector:
    if isinstance(value, tuple) and len(value) != joints:
        raise DriverError(f"driver.{name} has {len(value)} values but the arm has {joints} joints")
    return np.broadcast_to(np.asarray(value, dtype=float), (joints,)).copy()
