"""Build the emulator of a configuration's CANopen drives and of the arm behind them.

The arm is the simulated one's: same plant, same noise, same braking of idle axes, which the motors share so that no
joint is braked less than asked while all brake.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from ident_service.config.arm import ArmConfig
from ident_service.config.canopen import CanopenDrive, CanopenDriver
from ident_service.config.simulation import SimulatedDriver
from ident_service.errors import DriverError
from ident_service.model.arm_model import arm_model
from sim_backend.build import build_machine
from sim_backend.canopen_device.drive import CanopenDrive as Drive
from sim_backend.canopen_device.drive import Tuning
from sim_backend.canopen_device.personality import personality_of
from sim_backend.emulator.body import Body, Gears
from sim_backend.emulator.emulator import Emulator
from sim_backend.emulator.faults import DriveFault, configured
from sim_backend.emulator.motor import Motor, Power


def build_emulator(config: ArmConfig, faults: Sequence[DriveFault] = ()) -> Emulator:
    """Build the drives that a configuration describes, on an arm at its home position and at rest, without power.

    Args:
        config: its section `driver.emulation` says what the arm really is.
        faults: to inject besides those of the configuration.

    Raises:
        DriverError: the driver is not CANopen's, no gears, an EDS that cannot be read, or a fault that no drive can
            have.
        ModelError: no mechanism, or parameters that no real body has.
        ParameterError: true parameters that the arm does not have.
    """
    driver = config.driver
    if not isinstance(driver, CanopenDriver):
        raise DriverError(f"{config.name}: the driver is not CANopen's, so there is no drive to emulate")
    if config.transmission is None:
        raise DriverError(f"{config.name}: drives need the section transmission")
    emulation = driver.emulation
    simulated = SimulatedDriver(
        kind="simulated",
        seed=emulation.seed,
        truth=emulation.truth,
        torque_noise=emulation.torque_noise,
        braking=emulation.braking,
        windings_off=emulation.windings_off,
    )
    machine = build_machine(config.model_copy(update={"driver": simulated}))
    names = arm_model(config).chain.names
    gears = Gears(config.transmission, len(names))
    body = Body(machine.plant, gears, machine.imperfections.torque_noise, machine.seed)
    braking = gears.motor_damping(machine.braking).tolist()
    braked = np.array([config.has_brake(name) for name in names])
    off = Power.BRAKE if emulation.windings_off == "shorted" else Power.COAST
    unpowered = [Power.HELD if braked[row != 0.0].any() else off for row in gears.matrix]
    body.motors = tuple(
        Motor(
            body,
            number,
            counts=drive.counts,
            scale=drive.torque_scale,
            braking=braking[number],
            relative=driver.zero == "at_home",
            unpowered=unpowered[number],
        )
        for number, drive in enumerate(driver.drives)
    )
    tuned = _tuned(body)
    own = itertools.cycle(emulation.eds or (None,))
    faces = [
        Drive(driver.eds.text, drive.node, motor, _identity(drive), tuning=tuning)
        if sheet is None
        else Drive(
            sheet.text, drive.node, motor, like=personality_of(sheet.text, drive, driver.families), tuning=tuning
        )
        for drive, motor, sheet, tuning in zip(driver.drives, body.motors, own, tuned, strict=False)
    ]
    at_first = configured(emulation.faults, names, machine.plant.period)
    return Emulator(body, faces, [drive.bus for drive in driver.drives], names, (*at_first, *faults))


_BANDWIDTH = 2.0 * np.pi * 12.0  # rad/s of position loops, as a maker's tool would tune them at this arm
_SETTLES = 0.2  # of the bandwidth, of their integral part


def _tuned(body: Body) -> list[Tuning]:
    """Return the gains of every drive's position loop, for the inertia that its motor feels where the arm stands."""
    to_joints = np.linalg.inv(body.gears.matrix)
    felt = np.diag(to_joints.T @ np.diag(body.plant.inertia) @ to_joints)
    return [
        Tuning(
            float(inertia * _BANDWIDTH**2),
            float(1.6 * inertia * _BANDWIDTH),
            float(_SETTLES * inertia * _BANDWIDTH**3),
        )
        for inertia in felt
    ]


def _identity(drive: CanopenDrive) -> dict[int, int]:
    """Return the configured identity as values of 1018h, by key."""
    asked = drive.identity
    values = (asked.vendor, asked.product, asked.revision, asked.serial)
    return {0x101800 | sub: value for sub, value in enumerate(values, 1) if value is not None}
