"""Build the emulator of a configuration's drives, of CANopen or pucks, and of the arm behind them.

The arm is the simulated one's: same plant, same noise, same braking of idle axes, which the motors share so that no
joint is braked less than asked while all brake.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from drivers.arm import Vector
from ident_service.config.arm import ArmConfig
from ident_service.config.barrett import BarrettDriver, PuckEmulation
from ident_service.config.canopen import CanopenDrive, CanopenDriver, Emulation
from ident_service.config.simulation import SimulatedDriver, WindingsOff
from ident_service.errors import DriverError
from ident_service.model.arm_model import arm_model
from ident_service.model.chain import Chain
from ident_service.model.kinematics import frame_origins
from sim_backend.build import build_machine
from sim_backend.canopen_device.drive import CanopenDrive as Drive
from sim_backend.canopen_device.drive import Tuning
from sim_backend.canopen_device.personality import described_personality, personality_of
from sim_backend.emulator.body import Body, Gears
from sim_backend.emulator.emulator import Emulator
from sim_backend.emulator.faults import DriveFault, configured
from sim_backend.emulator.motor import Motor, Power
from sim_backend.puck_device.puck import EmulatedPuck
from sim_backend.puck_device.safety import EmulatedSafetyPuck


def build_emulator(config: ArmConfig, faults: Sequence[DriveFault] = ()) -> Emulator:
    """Build the drives that a configuration describes, on an arm at its home position and at rest, without power.

    Args:
        config: configuration whose section `driver.emulation` says what the arm really is.
        faults: to inject besides those of the configuration.

    Raises:
        DriverError: the driver is neither CANopen's nor one of pucks, no gears, an EDS that cannot be read, or a fault
            that no drive can have.
        ModelError: no mechanism, or parameters that no real body has.
        ParameterError: true parameters that the arm does not have.
    """
    driver = config.driver
    if isinstance(driver, CanopenDriver):
        return _canopen(config, driver, faults)
    if isinstance(driver, BarrettDriver):
        return _pucks(config, driver, faults)
    raise DriverError(f"{config.name}: the driver has no CAN bus, so there is no drive to emulate")


@dataclass(frozen=True)
class _Behind:
    """Hold the arm behind emulated drives: body, joint names, braking of each motor, which motors a brake holds."""

    body: Body
    chain: Chain
    braking: list[float]
    held: list[bool]


def _behind(config: ArmConfig, emulation: Emulation | PuckEmulation, windings_off: WindingsOff) -> _Behind:
    if config.transmission is None:
        raise DriverError(f"{config.name}: drives need the section transmission")
    simulated = SimulatedDriver(
        kind="simulated",
        seed=emulation.seed,
        truth=emulation.truth,
        torque_noise=emulation.torque_noise,
        braking=emulation.braking,
        windings_off=windings_off,
    )
    machine = build_machine(config.model_copy(update={"driver": simulated}))
    chain = arm_model(config).chain
    gears = Gears(config.transmission, chain.joints)
    body = Body(machine.plant, gears, machine.imperfections.torque_noise, machine.seed)
    braked = np.array([config.has_brake(name) for name in chain.names])
    held = [bool(braked[row != 0.0].any()) for row in gears.matrix]
    return _Behind(body, chain, gears.motor_damping(machine.braking).tolist(), held)


def _canopen(config: ArmConfig, driver: CanopenDriver, faults: Sequence[DriveFault]) -> Emulator:
    emulation = driver.emulation
    behind = _behind(config, emulation, emulation.windings_off)
    body, names = behind.body, behind.chain.names
    off = Power.BRAKE if emulation.windings_off == "shorted" else Power.COAST
    body.motors = tuple(
        Motor(
            body,
            number,
            counts=drive.counts,
            scale=drive.torque_scale,
            braking=behind.braking[number],
            relative=driver.zero == "at_home",
            unpowered=Power.HELD if behind.held[number] else off,
        )
        for number, drive in enumerate(driver.drives)
    )
    tuned = _tuned(body)
    others = emulation.eds
    faces = []
    for number, (drive, motor, tuning) in enumerate(zip(driver.drives, body.motors, tuned, strict=True)):
        if others:
            text, own, like = others[number % len(others)].text, {}, personality_of
        else:
            text, own, like = driver.sheet_file(number).text, _identity(drive), described_personality
        faces.append(Drive(text, drive.node, motor, own, like(text, drive, driver.families), tuning))
    at_first = configured(emulation.faults, names, body.plant.period)
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


def _pucks(config: ArmConfig, driver: BarrettDriver, faults: Sequence[DriveFault]) -> Emulator:
    emulation = driver.emulation
    behind = _behind(config, emulation, "shorted")
    body, chain, pucks = behind.body, behind.chain, driver.pucks
    body.motors = tuple(
        Motor(
            body,
            number,
            counts=puck.cts,
            scale=puck.torque_scale,
            braking=behind.braking[number],
            relative=True,
            unpowered=Power.HELD if behind.held[number] else Power.BRAKE,
        )
        for number, puck in enumerate(pucks)
    )
    radians = 2.0 * np.pi / np.array([puck.cts for puck in pucks])

    def points(counts: Sequence[int]) -> tuple[Vector, Vector]:
        joints = body.gears.joint_position(radians * np.array(counts))
        return joints, frame_origins(chain, joints[None, :])[0]

    def joint_encoder(joint: int, counts: int) -> Callable[[int], int]:
        # Behind the gears: what is wrong with a motor's encoder, or has slipped between them, it does not show.
        def reading(now_ns: int) -> int:
            motors = np.array([body.angle(motor, now_ns) for motor in range(len(pucks))])
            return round(float(body.gears.joint_position(motors)[joint]) * counts / (2.0 * np.pi))

        return reading

    safety = EmulatedSafetyPuck(
        driver.safety_node,
        emulation.firmware,
        points,
        heartbeat=emulation.heartbeat,
        operator=emulation.operator,
        zeroed=emulation.zeroed,
        velocity=emulation.velocity,
    )
    at_home = np.rint(body.gears.motor_position(body.plant.position) / radians).astype(int).tolist()
    ipnm: Sequence[int | None] = emulation.ipnm or (None,) * len(pucks)
    faces = [
        EmulatedPuck(
            puck,
            motor,
            safety,
            version=emulation.firmware,
            ipnm=own,
            origin=origin if emulation.zeroed else None,
            joint=joint_encoder(number, puck.joint_counts) if puck.joint_counts else None,
        )
        for number, (puck, motor, own, origin) in enumerate(zip(pucks, body.motors, ipnm, at_home, strict=True))
    ]
    at_first = configured(emulation.faults, chain.names, body.plant.period)
    return Emulator(body, faces, [0] * len(pucks), chain.names, (*at_first, *faults), [safety])


def _identity(drive: CanopenDrive) -> dict[int, int]:
    """Return the configured identity as values of 1018h, by key."""
    asked = drive.identity
    values = (asked.vendor, asked.product, asked.revision, asked.serial)
    return {0x101800 | sub: value for sub, value in enumerate(values, 1) if value is not None}
