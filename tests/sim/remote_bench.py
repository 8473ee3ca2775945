"""Plants in processes of their own, clients to be killed, and an eye on what is left of both."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from helpers.changed_arms import truth_of

from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm
from ident_service.errors import DriverError
from ident_service.model.arm_model import arm_model
from ident_service.model.pinocchio_models import InverseDynamics
from sim_backend.plant_status import PlantStatus, read_status

PATIENCE = 30.0


def remote_config(name: str = "planar2", **driver: Any) -> ArmConfig:
    """A shipped arm whose plant lives in its own process."""
    config = load_arm(name)
    return ArmConfig.model_validate(
        config.model_dump() | {"driver": config.driver.model_dump() | {"process": "separate"} | driver}
    )


def alive(pid: int) -> bool:
    """Whether the process runs; one that only waits to be collected does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def listening(pid_or_bus: str) -> bool:
    """Whether anything still listens on, or is connected to, an address of that name."""
    return pid_or_bus in Path("/proc/net/unix").read_text()


def wait_for(what: Callable[[], bool]) -> bool:
    """Wait until it is true, or too long."""
    ends = time.monotonic() + PATIENCE
    while not what():
        if time.monotonic() > ends:
            return False
        time.sleep(0.005)
    return True


def ended(path: Path) -> PlantStatus:
    """The last words of a plant that ends by itself."""
    ticks, moved = -1, time.monotonic()
    while True:
        with suppress(DriverError):
            status = read_status(path)
            if status.ended:
                break
            if status.ticks != ticks:  # however slowly, it goes on
                ticks, moved = status.ticks, time.monotonic()
        assert time.monotonic() < moved + PATIENCE, read_status(path)
        time.sleep(0.005)
    status = read_status(path)
    assert wait_for(lambda: not alive(status.pid))
    return status


# Swings both joints about, as fast as it may, until it is killed; says when it begins to move.
CLIENT = """
import sys
import numpy as np
from ident_service.config.arm import ArmConfig
from sim_backend.arm import from_config
arm = from_config(ArmConfig.model_validate_json(sys.stdin.read()))
arm.open()
limit = arm.describe().torque_limit
sample = arm.exchange(None)
arm.enable()
home = last = sample.position
k = 0
while True:
    phase = 0.004 * k
    reference = home + 0.25 * (1 - np.cos(phase))
    speed = (sample.position - last) * arm.describe().rate
    last = sample.position
    sample = arm.exchange(np.clip(8.0 * limit * (reference - last) - 0.3 * limit * speed, -0.9 * limit, 0.9 * limit))
    k += 1
    if k == 50:
        print("moving", flush=True)
"""


class Client:
    """A process that drives an arm, and whose plant is its child."""

    def __init__(self, config: ArmConfig) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", CLIENT], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=dict(os.environ)
        )
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(config.model_dump_json().encode())
        self.process.stdin.close()
        assert self.process.stdout.readline() == b"moving\n"

    def kill(self) -> None:
        """With no chance to say anything."""
        self.process.kill()
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()


def speed_of_held_torque(config: ArmConfig, status: PlantStatus, seconds: float) -> np.ndarray:
    """Return how much faster each joint can become while the last torque, and gravity, act on for some time.

    The inertia is the smallest that a joint has anywhere the arm was.
    """
    model = arm_model(config)
    truth, names = truth_of(config), model.layout.names
    dynamics = InverseDynamics(model.chain, model.layout, np.array([truth.get(name, 0.0) for name in names]))
    still, most = np.zeros(model.chain.joints), np.zeros(model.chain.joints)
    for share in np.random.default_rng(0).random((100, model.chain.joints)):
        position = status.lowest + share * (status.highest - status.lowest)
        acting = status.silent_peak_torque + np.abs(dynamics.torque(position, still, still))
        most = np.maximum(most, np.abs(np.linalg.inv(dynamics.mass_matrix(position))) @ acting)
    return most * seconds


def limits(config: ArmConfig) -> tuple[np.ndarray, np.ndarray]:
    """Largest speed and torque of each joint."""
    joints = config.joints.values()
    return np.array([joint.velocity for joint in joints]), np.array([joint.torque for joint in joints])
