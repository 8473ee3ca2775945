"""Build the simulated machine beyond the bus from a configuration with a simulated driver.

Missing values are set here: home where none is given, infinite torque limits, and the
braking of idle drives and of drives that are off.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drivers.arm import Vector
from ident_service.config.arm import ArmConfig
from ident_service.config.quantities import PerJoint
from ident_service.config.simulation import SimulatedDriver
from ident_service.errors import DriverError
from ident_service.model.arm_model import arm_model, with_payload
from sim_backend.faults import Fault, configured_faults
from sim_backend.machine import SimulatedHardware, Stand
from sim_backend.plant import Imperfections, Plant

# Where limits do not state a drive's strength, its shorted windings stop the joint in about this time [s].
_BRAKING_TIME = 0.1
_BRAKING_SHARE = 0.5
# A closed brake, times the braking: creeps by mrad/s where idle drives let the joint sink by rad/s.
_HOLDING = 1e3


def build_machine(config: ArmConfig, faults: Sequence[Fault] = ()) -> SimulatedHardware:
    """Build the machine that a configuration describes, at its home position and at rest.

    Args:
        config: configuration; its driver's truth, or else its prior, becomes the plant.
        faults: to inject besides those of the configuration.

    Raises:
        DriverError: the driver is not a simulated one, values for another number of joints, or no parameters.
        ModelError: no mechanism, or parameters that no real body has.
        ParameterError: true parameters that the arm does not have.
    """
    driver = config.driver
    if not isinstance(driver, SimulatedDriver):
        raise DriverError(f"{config.name}: the driver is not a simulated one")
    model = arm_model(config)
    truth = model.prior
    if driver.truth is not None:
        truth = with_payload(config, model.chain.names, model.layout, model.layout.vector(driver.truth))
    if truth is None:
        raise DriverError(f"{config.name}: a simulated arm needs driver.truth, or a prior to take for the truth")
    joints = [config.joints.get(name) for name in model.chain.names]
    count = len(joints)
    home = np.zeros(count)
    limit = np.full(count, np.inf)
    speed = np.full(count, np.nan)
    for index, joint in enumerate(joints):
        if joint is None:
            continue
        if joint.home is not None:
            home[index] = joint.home
        elif joint.position is not None:
            home[index] = np.clip(0.0, *joint.position)
        if joint.torque is not None:
            limit[index] = joint.torque
        if joint.velocity is not None:
            speed[index] = joint.velocity
    imperfections = Imperfections(
        encoder_resolution=_per_joint("encoder_resolution", driver.encoder_resolution, count),
        torque_resolution=_per_joint("torque_resolution", driver.torque_resolution, count),
        torque_noise=_per_joint("torque_noise", driver.torque_noise, count),
        torque_limit=limit,
    )
    # Stamps are whole nanoseconds, and the plant must move by exactly as much.
    plant = Plant(model.chain, model.layout, truth, home, round(1e9 / config.control.rate) * 1e-9)
    if driver.braking is not None:
        braking = _per_joint("braking", driver.braking, count)
    else:
        # A joint at its velocity limit is braked with a share of its torque limit, so that an idle arm whose drives
        # need no more than that share to hold it never sinks faster than it may move.
        known = np.isfinite(limit) & np.isfinite(speed)
        braking = np.where(known, _BRAKING_SHARE * limit, plant.inertia) / np.where(known, speed, _BRAKING_TIME)
    held = np.array([config.has_brake(name) for name in model.chain.names])
    shorted = np.full(count, driver.windings_off == "shorted")
    return SimulatedHardware(
        plant,
        imperfections,
        seed=driver.seed,
        delay_cycles=driver.delay_cycles,
        watchdog=driver.watchdog,
        braking=braking,
        stand=None if driver.stand is None else Stand(driver.stand, _HOLDING * braking),
        unpowered=np.where(held, _HOLDING * braking, np.where(shorted, braking, 0.0)),
        faults=(*configured_faults(driver.faults, model.chain.names, plant.period), *faults),
    )


def _per_joint(name: str, value: PerJoint, joints: int) -> Vector:
    if isinstance(value, tuple) and len(value) != joints:
        raise DriverError(f"driver.{name} has {len(value)} values but the arm has {joints} joints")
    return np.broadcast_to(np.asarray(value, dtype=float), (joints,)).copy()
