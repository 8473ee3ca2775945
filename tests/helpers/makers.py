"""Drives made from the data sheets of real ones, on a small weightless arm."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

from helpers.emulated_arms import Tapped, tapped, weightless_config

from drivers.canopen.driver import CanopenArm
from ident_service.config.arm import ArmConfig
from sim_backend.emulator.lock_step import LockStepArm

SHEETS = Path(__file__).parents[3] / "shared" / "data" / "eds"
# File, watchdog that the drive has, mode of operation, N m of a thousand counts where it is not the rated torque.
CAPABLE = {
    "maxon_epos4_50-8_0110h.eds": ("heartbeat", 10, {}),
    "maxon_epos4_50-5_0170h.eds": ("heartbeat", 10, {}),
    "maxon_epos2_50-5_2126h.eds": ("heartbeat", -3, {"rated_torque": 0.05, "torque_constant": 0.05, "max_torque": 0.4}),
    "elmo_gold_V002.dcf": ("heartbeat", 10, {"torque_constant": 0.1}),
    "elmo_simpliq.dcf": ("heartbeat", 4, {}),
    "e35.eds": ("node_guarding", 10, {}),
}
REFUSED = {
    "schunk_prl120_0_63.dcf": r"no torque mode: 6502h is 43h, 6071h missing",
    "faulhaber_mcdc_605.3150.68-B.eds": r"it has no torque mode",
    "trinamic_TMCM-1270.eds": r"it has no torque mode",
}


def sheet(name: str) -> dict[str, str]:
    """One of the files, as a description has it."""
    return {"name": name, "text": (SHEETS / name).read_text(encoding="latin-1")}


def arm_of(*names: str, text: str | None = None, drive: dict[str, Any] | None = None, **changes: Any) -> ArmConfig:
    """Two drives made from these files, described as they are; `text` and keys of `drive` are in place of theirs."""
    drives = []
    files = [sheet(name) if text is None else {"name": "strange.eds", "text": text} for name in names]
    for node, name, file in zip((1, 2), names * 2, files * 2, strict=False):
        guard, _, own = CAPABLE.get(name, ("heartbeat", 0, {}))
        one = {"node": node, "counts": 65536, "rated_torque": 1.0, "max_torque": 2.0, "max_speed": 6000.0}
        drives.append(one | {"watchdog": guard, "eds": file} | own | (drive or {}))
    section = {
        "drives": drives,
        "eds": files[0],
        "torque_frames": "single",
        "heartbeats": {"period": 0.02, "timeout": 0.11, "host_timeout": 0.06, "drives": 0.1},
        "emulation": {
            "truth": {"m1": 0.5, "Lxx1": 0.1, "Lyy1": 0.1, "Lzz1": 1.0, "m2": 1.0},
            "eds": files,
        },
    }
    return weightless_config(**section | changes)


class Bench:
    """Emulated drives, the driver, and what it sends."""

    def __init__(self, config: ArmConfig, real: ArmConfig | None = None) -> None:
        self.behind = LockStepArm(real or config)
        self.taps: list[Tapped] = []
        self.arm = CanopenArm(config, self.links)

    def links(self, config: ArmConfig) -> list[Tapped]:
        """Taps on the buses, as the driver opens them."""
        self.taps = tapped(self.behind, config)
        return self.taps

    def downloads(self) -> list[tuple[int, int, int]]:
        """Node, index and sub-index of what has been written since the buses were opened."""
        ours = [frame for frame in self.taps[0].sent if 0x600 < frame.identifier < 0x680 and frame.data[0] >> 5 == 1]
        return [(frame.identifier - 0x600, *struct.unpack_from("<HB", frame.data, 1)) for frame in ours]

    @property
    def states(self) -> list[str]:
        """Of the drives, by CiA 402."""
        return [state.split(", ")[1] for state in self.behind.emulator.states]
