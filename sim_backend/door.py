"""Check torques and describe arms, for both simulated arms."""

from __future__ import annotations

from importlib.metadata import version

import numpy as np

from drivers.arm import ArmDescription, Vector
from ident_service.errors import DriverError
from sim_backend.machine import Machine


def checked_torque(torque: Vector | None, enabled: bool, joints: int) -> Vector | None:
    """Return a torque that may be sent, or None for a cycle without torque.

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


def description(machine: Machine) -> ArmDescription:
    """Return the description of a simulated arm."""
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
    )
