"""The whole job over emulated CANopen drives in virtual time: it finds what the simulated arm's does."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from canopen_run_bench import canopen, checked, described, simulated, write

from ident_service.cli import main
from ident_service.recordings.open import open_recording

SHEETS = Path(__file__).parents[3] / "shared" / "data" / "eds"
RATE, KP, KD = 250.0, 225.0, 30.0


def found(folder: Path, name: str, arm: Path) -> tuple[np.ndarray, np.ndarray]:
    """Base parameters and their standard deviations, from preflight to the parameter file."""
    state, run, out = folder / f"{name}-state", folder / f"{name}-run", folder / f"{name}-out"
    assert checked(arm, name, state)
    assert main(["run", str(arm), "--out", str(run), "--state", str(state)]) == 0
    recording = open_recording(run / "run.mcap", ("shoulder", "elbow"))
    blocks = list(recording.blocks())
    # All cycles, on one grid, each with everybody's answer.
    stamps = np.concatenate([block.stamp_ns for block in blocks])
    np.testing.assert_array_equal(np.diff(stamps), round(1e9 / RATE))
    assert main(["identify", str(run / "run.mcap"), "--arm", str(arm), "--out", str(out), "--state", str(state)]) == 0
    document = json.loads((out / "parameters.json").read_text())["base_parameters"]
    return np.array(document["values"]), np.array(document["standard_deviations"])


def of_makers(tree: dict[str, Any]) -> dict[str, Any]:
    """The same arm behind drives of two makers, by their files, each with the watchdog and the mode that it has."""
    files = [str(SHEETS / name) for name in ("maxon_epos4_50-5_0170h.eds", "elmo_simpliq.dcf")]
    drive = {"counts": 65536, "rated_torque": 0.35, "max_torque": 1.05, "max_speed": 6000.0, "watchdog": "heartbeat"}
    section = {
        "eds": files[0],
        "torque_frames": "single",
        "drives": [drive | {"node": node, "eds": file} for node, file in enumerate(files, 1)],
        "heartbeats": {"period": 0.02, "timeout": 0.11, "host_timeout": 0.06},
        "status": {"period": 0.1, "inhibit": 0.01},
    }
    found = canopen(tree, {"interface": "lock_step"}, 2, **section)
    found["driver"]["emulation"]["eds"] = files
    return found


@pytest.mark.campaign
@pytest.mark.slow
@pytest.mark.parametrize("name", ["drives", "makers"])
def test_arms_have_the_same_parameters_within_their_standard_deviations(name: str, tmp_path: Path) -> None:
    if name == "makers" and not SHEETS.is_dir():
        pytest.skip("the makers' data sheets are not beside this checkout")
    plain, tree = write(tmp_path, simulated(described("plain", RATE, KP, KD), 1)), described(name, RATE, KP, KD)
    arm = write(tmp_path, of_makers(tree) if name == "makers" else canopen(tree, {"interface": "lock_step"}, 2))
    one, one_deviation = found(tmp_path, "plain", plain)
    two, two_deviation = found(tmp_path, name, arm)
    assert one.shape == two.shape == (13,)
    doubt = np.hypot(one_deviation, two_deviation)
    assert (doubt > 0.0).all()
    z = (one - two) / doubt
    # 13 figures of unit variance: none beyond what one in ten thousand is, nor all of them together.
    assert np.abs(z).max() < 4.0, z
    assert z @ z < 35.0, z
    # The doubts themselves mean something: most parameters are known within about a tenth.
    assert np.median(doubt / np.maximum(np.abs(one), 1e-3)) < 0.12
