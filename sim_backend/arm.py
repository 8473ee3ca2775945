"""Implement the Arm contract with a simulated plant, in real or in virtual time.

Time. Cycle k waits for its deadline, moves the plant from stamp k-1 to stamp k under the torque that acts between them,
shows the positions, and latches the new torque, which acts from stamp k on. Simulated time only passes with cycles:
stamps of consecutive cycles are exactly one period apart, as far as the plant has really moved, whatever the clock did.
When a deadline has passed before its cycle is asked for, that cycle begins at once and the whole schedule moves back by
the lateness, instead of a burst of short cycles catching up; how late a cycle is, is the loop's to measure, on the
clock and from one cycle to the next.

`from_config` is the one place that knows where a plant can live: here, or behind a socket (`remote_arm.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from drivers.arm import Arm, ArmDescription, Sample, StopKind, Vector
from drivers.clock import Clock, RealClock, VirtualClock
from ident_service.config.arm import ArmConfig
from ident_service.config.simulation import SimulatedDriver
from ident_service.errors import DriverError
from sim_backend.build import build_machine
from sim_backend.faults import Fault
from sim_backend.machine import Schedule, SimulatedHardware, Stand, checked_torque, description
from sim_backend.machine import Truth as Truth
from sim_backend.plant import Imperfections, Plant
from sim_backend.remote_arm import RemoteArm


class SimulatedArm(Arm):
    """Simulate an arm: a plant, its imperfections and its faults; the same seed gives the same samples bit for bit."""

    def __init__(
        self,
        plant: Plant,
        imperfections: Imperfections,
        clock: Clock,
        *,
        seed: int = 0,
        delay_cycles: int = 1,
        watchdog: float = 0.01,
        braking: Vector | None = None,
        unpowered: Vector | None = None,
        stand: Stand | None = None,
        faults: Sequence[Fault] = (),
        observer: Callable[[Truth], None] | None = None,
    ) -> None:
        """Assemble the simulated arm; one cycle is one period of the plant.

        Args:
            plant: body of the arm.
            imperfections: imperfections of encoders and drives.
            clock: the loop's.
            seed: seed of the torque noise.
            delay_cycles: delay from a sample to the first stamp at which a torque computed from it can act [cycles]; 1
                is the contract's, each further one a cycle that torques wait in a queue.
            watchdog: time without a torque after which enabled drives go idle [s].
            braking: damping of idle axes [N m s/rad or N s/m], shape (joints,); None for none.
            unpowered: damping of axes that are off, as `SimulatedHardware` has it.
            stand: stand that the arm rests on, as `SimulatedHardware` has it; None for none.
            faults: faults to inject, by cycle since `open`.
            observer: called with the truth of every cycle.

        Raises:
            DriverError: pieces that do not fit each other.
        """
        self.clock = clock
        self.observer = observer
        self._machine = SimulatedHardware(
            plant,
            imperfections,
            seed=seed,
            delay_cycles=delay_cycles,
            watchdog=watchdog,
            braking=braking,
            unpowered=unpowered,
            stand=stand,
            faults=faults,
        )
        self._schedule = Schedule(clock, round(plant.period * 1e9), skips=False)
        self._open = False

    @property
    def plant(self) -> Plant:
        """Return the simulated body."""
        return self._machine.plant

    @property
    def imperfections(self) -> Imperfections:
        """Return the imperfections of encoders and drives."""
        return self._machine.imperfections

    @property
    def faults(self) -> tuple[Fault, ...]:
        """Return the faults to inject, by cycle since `open`."""
        return self._machine.faults

    @faults.setter
    def faults(self, faults: Sequence[Fault]) -> None:
        """Set the faults to inject, by cycle since `open`, in place of those before."""
        self._machine.faults = tuple(faults)

    def open(self) -> None:
        """Open the arm; its cycles count from 0, its plant stays where it was."""
        if self._open:
            raise DriverError("the simulated arm is already open")
        self._machine.restart()
        self._schedule.restart()
        self._open = True

    def describe(self) -> ArmDescription:
        """Return the description of the simulated arm; raises DriverError when not open."""
        self._require_open()
        return description(self._machine)

    def enable(self) -> None:
        """Energise with zero torque; raises DriverError when not open, or when a fault keeps a drive from it."""
        self._require_open()
        self._machine.enable()

    def reset(self) -> None:
        """Clear the faults that the drives have latched; DriverError when not open, enabled, or a cause persists."""
        self._require_open()
        self._machine.reset()

    def exchange(self, torque: Vector | None) -> Sample:
        """Advance the plant by one cycle, then queue the torque (None: the last one again); return the new sample.

        Raises:
            DriverError: as in the contract; or the plant ran away, or a fault took the bus, both of which use up
                the cycle with the last torque acting on.
        """
        self._require_open()
        machine = self._machine
        command = checked_torque(torque, machine.enabled, self.plant.chain.joints)
        stamp_ns, cycle = self._schedule.wait(machine.faults), machine.tick
        if cycle > 0:
            try:
                machine.advance()
            except DriverError:
                machine.hold()
                raise
        reading = machine.cycle(command)
        if self.observer is not None:
            self.observer(machine.truth(stamp_ns))
        sample_stamp_ns = self._schedule.sample_stamp_ns(machine.faults)
        r = reading
        return Sample(
            cycle,
            sample_stamp_ns,
            r.position,
            None,
            r.torque,
            r.valid,
            r.age,
            r.lost,
            r.status,
            status_age=r.status_age,
        )

    def stop(self, kind: StopKind) -> None:
        """End torque when the last sample's period ends; then the drives are off, or brake first, by the kind."""
        self._machine.stop(kind)

    def close(self) -> None:
        """Take the torque off and release the arm; any number of times."""
        self.stop(StopKind.TORQUE_OFF)
        self._open = False

    def _require_open(self) -> None:
        if not self._open:
            raise DriverError("the simulated arm is not open")


def from_config(
    config: ArmConfig,
    clock: Clock | None = None,
    *,
    faults: Sequence[Fault] = (),
    observer: Callable[[Truth], None] | None = None,
) -> SimulatedArm | RemoteArm:
    """Create the arm of a simulated driver, at home and at rest; its plant in another process where so configured.

    Args:
        config: configuration; its driver's truth, or else its prior, becomes the plant.
        clock: the loop's; by default what `driver.time` asks for. A plant in a process of its own moves by the
            machine's clock, or in lock-step with a clock that is.
        faults: to inject besides those of the configuration.
        observer: called with the truth of every cycle.

    Raises:
        DriverError: the driver is not a simulated one, values for another number of joints, or no parameters.
        ModelError: no mechanism, or parameters that no real body has.
        ParameterError: true parameters that the arm does not have.
    """
    driver = config.driver
    if not isinstance(driver, SimulatedDriver):
        raise DriverError(f"{config.name}: the driver is not a simulated one")
    if clock is None:
        clock = VirtualClock() if driver.time == "virtual" else RealClock()
    if driver.process == "separate":
        return RemoteArm(config, clock, faults=faults, observer=observer)
    pieces = build_machine(config, faults)
    return SimulatedArm(
        pieces.plant,
        pieces.imperfections,
        clock,
        seed=pieces.seed,
        delay_cycles=driver.delay_cycles,
        watchdog=driver.watchdog,
        braking=pieces.braking,
        unpowered=pieces.unpowered,
        stand=pieces.stand,
        faults=pieces.faults,
        observer=observer,
    )
