"""A small arm behind pucks, run from end to end by the commands that people use."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from canopen_run_bench import TORQUE_NOISE, described, truth

GEARS = {"ratios": [20.0, -20.0], "coupling": [[1.0, -0.5], [1.0, 0.5]], "drive_terms": "joints"}
PUCK = {"cts": 65536, "ipnm": 2700, "mt": 8100, "poles": 12}
# Home on whole counts, so that arms that were zeroed there stand where they think.


def puck_arm(name: str, rate: float, kp: float, kd: float, bus: dict[str, Any], **driver: Any) -> dict[str, Any]:
    """planar2 behind a differential and two pucks, with its motions made short."""
    emulation = {
        "seed": 2,
        "truth": truth(),
        "torque_noise": TORQUE_NOISE,
        "operator": 0.1,
        "zeroed": True,
    }
    section = {
        "kind": "barrett",
        "bus": bus,
        "pucks": [PUCK | {"node": 1}, PUCK | {"node": 2}],
        "limits": {"velocity": 7.0, "torque": 8191},
        "watchdog_reason": "an emulated arm behind a machine that stalls",
    }
    section |= driver | {"emulation": emulation | driver.get("emulation", {})}
    return described(name, rate, kp, kd) | {"transmission": GEARS, "driver": section}


def state_of(folder: Path, name: str) -> Path:
    return folder / f"{name}-state"
