"""Arms of every backend for the contract: two joints in virtual time, with an eye on what really moves.

A backend joins by a function in BACKENDS that builds such an arm, not yet open, with the faults injected that it is
given.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivers.arm import Arm
from ident_service.config.arm import ArmConfig

PERIOD_NS = 2_000_000


@dataclass(frozen=True)
class Bench:
    """An arm of two weightless, frictionless joints of 1 kg m^2 and 1 kg, and the truth about it."""

    arm: Arm
    velocity: Callable[[], np.ndarray]
    position: Callable[[], np.ndarray]
    enabled: Callable[[], None] = lambda: None


def bench_config(**driver: Any) -> ArmConfig:
    truth = {"m1": 0.5, "Lxx1": 0.1, "Lyy1": 0.1, "Lzz1": 1.0, "m2": 1.0}
    options = {"encoder_resolution": 1e-4, "torque_resolution": [0.25, 0.0]} | driver
    return ArmConfig.model_validate(
        {
            "format": "ident-arm",
            "version": 1,
            "name": "bench",
            # The second joint slides along the first one's axis, so that neither moves the other.
            "kinematics": {"dh": {"convention": "standard", "joints": {"turn": {}, "slide": {"type": "prismatic"}}}},
            "gravity": (0.0, 0.0, 0.0),
            "joints": {"turn": {"torque": 10.0, "home": 0.5}, "slide": {"torque": 5.0, "position": (0.1, 1.0)}},
            "control": {"rate": 500.0},
            "driver": {"kind": "simulated", "truth": truth, **options},
        }
    )


def simulated(**driver: Any) -> Bench:
    from sim_backend.arm import from_config

    arm = from_config(bench_config(**driver))
    return Bench(arm, lambda: arm.plant.velocity, lambda: arm.plant.position)


def separate(**driver: Any) -> Bench:
    from sim_backend.arm import from_config

    arm = from_config(bench_config(process="separate", **driver))
    return Bench(arm, lambda: arm.truth.velocity, lambda: arm.truth.position)


def canopen_config(**driver: Any) -> ArmConfig:
    """The bench behind two drives with gears of 1, on a bus in virtual time; a thousandth is 1 mN m or 1 mN."""
    eds = (Path(__file__).parents[2] / "configs" / "emulated_drive.eds").read_text()
    drive = {"counts": 65536, "rated_torque": 1.0, "max_speed": 6000.0}
    section = {
        "kind": "canopen",
        "eds": {"name": "emulated_drive.eds", "text": eds},
        "buses": [{"interface": "lock_step", "channel": "bench"}],
        "drives": [drive | {"node": 1, "max_torque": 10.0}, drive | {"node": 2, "max_torque": 5.0}],
        # An arm that is looked at, or reset, must not be moved by what it falls or slides on by.
        "emulation": {"truth": bench_config().model_dump(mode="json")["driver"]["truth"], "windings_off": "shorted"},
    }
    content = bench_config().model_dump(mode="json", exclude={"driver"}) | {
        "transmission": {"ratios": [1.0, 1.0], "drive_terms": "joints"},
        "driver": section | driver,
    }
    return ArmConfig.model_validate(content)


def relative_config() -> ArmConfig:
    """The drives' encoders count from where they were when power came; home is on whole counts, for exact positions."""
    content = canopen_config(zero="at_home").model_dump(mode="json")
    for joint, counts in zip(content["joints"].values(), (5216, 1044), strict=True):
        joint["home"] = 2.0 * np.pi / 65536 * counts  # 0.5 and 0.1
    return ArmConfig.model_validate(content)


def relative(faults: Sequence[dict[str, Any]] = ()) -> Bench:
    """An arm that a person has zeroed."""
    bench = canopen(faults, relative_config())
    bench.arm.zero()
    return bench


def canopen(faults: Sequence[dict[str, Any]] = (), config: ArmConfig | None = None) -> Bench:
    """Two emulated drives; opening takes cycles too, so that faults are counted from the end of enabling here."""
    from drivers.canopen.driver import CanopenArm
    from ident_service.config.simulation import SimulatedFault
    from sim_backend.emulator.faults import configured
    from sim_backend.emulator.lock_step import LockStepArm
    from sim_backend.machine import Truth

    config = config or canopen_config()
    behind = LockStepArm(config)
    truths: list[Truth] = []
    behind.emulator.observer = truths.append
    arm = CanopenArm(config, lambda _: [behind.link(0)])
    wanted = [SimulatedFault.model_validate(fault) for fault in faults]
    strike = configured(wanted, ("turn", "slide"), PERIOD_NS * 1e-9)
    return Bench(arm, lambda: truths[-1].velocity, lambda: truths[-1].position, lambda: behind.inject(*strike))


def fd(faults: Sequence[dict[str, Any]] = ()) -> Bench:
    """Drives on a bus of CAN FD."""
    bus = {"interface": "lock_step", "channel": "bench", "bitrate": 1_000_000, "data_bitrate": 4_000_000}
    return canopen(faults, canopen_config(buses=[bus]))


def pucks_config(*, firmware: int = 200, **driver: Any) -> ArmConfig:
    """The bench behind two pucks with gears of 1, whose counts are whole parts of its limits; home on whole counts."""
    content = bench_config().model_dump(mode="json", exclude={"driver"})
    for joint, counts in zip(content["joints"].values(), (5216, 1044), strict=True):
        joint["home"] = 2.0 * np.pi / 65536 * counts  # 0.5 and 0.1
    emulation = {
        "truth": bench_config().model_dump(mode="json")["driver"]["truth"],
        "firmware": firmware,
        "operator": 0.05,
    }
    section = {
        "kind": "barrett",
        "bus": {"interface": "lock_step", "channel": "bench"},
        "pucks": [
            {"node": 1, "cts": 65536, "ipnm": 512, "mt": 5120},
            {"node": 5, "cts": 65536, "ipnm": 512, "mt": 2560},
        ],
        "emulation": emulation,
    }
    section |= driver | {"emulation": emulation | driver.get("emulation", {})}
    transmission = {"ratios": [1.0, 1.0], "drive_terms": "joints"}
    return ArmConfig.model_validate(content | {"transmission": transmission, "driver": section})


def pucks(faults: Sequence[dict[str, Any]] = (), config: ArmConfig | None = None, *, zeroed: bool = True) -> Bench:
    """Two emulated pucks, zeroed by a person; another one presses Shift-Activate whenever it is waited for."""
    from drivers.barrett.driver import BarrettArm
    from ident_service.config.simulation import SimulatedFault
    from sim_backend.emulator.faults import configured
    from sim_backend.emulator.lock_step import LockStepArm
    from sim_backend.machine import Truth

    config = config or pucks_config()
    behind = LockStepArm(config)
    truths: list[Truth] = []
    behind.emulator.observer = truths.append
    arm = BarrettArm(config, lambda _: [behind.link(0)])
    wanted = [SimulatedFault.model_validate(fault) for fault in faults]
    strike = configured(wanted, ("turn", "slide"), PERIOD_NS * 1e-9)
    if zeroed:
        arm.zero()
    return Bench(arm, lambda: truths[-1].velocity, lambda: truths[-1].position, lambda: behind.inject(*strike))


def old_pucks(faults: Sequence[dict[str, Any]] = ()) -> Bench:
    """Pucks with firmware whose properties have other numbers."""
    return pucks(faults, pucks_config(firmware=40))


BACKENDS: dict[str, Callable[..., Bench]] = {
    "canopen": canopen,
    "fd": fd,
    "old pucks": old_pucks,
    "pucks": pucks,
    "relative": relative,
    "separate": separate,
    "simulated": simulated,
}
