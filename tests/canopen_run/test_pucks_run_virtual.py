"""The whole job over emulated pucks in virtual time, by the commands that people use, and what ends it midway."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from canopen_run_bench import checked, truth, write
from puck_run_bench import puck_arm, state_of

from ident_service.cli import main
from ident_service.config.load import load_arm
from ident_service.model.arm_model import arm_model
from ident_service.model.base_parameters import base_parameters
from ident_service.recordings.open import open_recording
from ident_service.registry.state_folder import arm_fault_store

RATE, KP, KD = 250.0, 225.0, 30.0
LOCK_STEP = {"interface": "lock_step", "channel": "pucks"}
NAMES = ("shoulder", "elbow")


def arm(folder: Path, name: str, **driver: Any) -> Path:
    return write(folder, puck_arm(name, RATE, KP, KD, LOCK_STEP, **driver))


@pytest.mark.campaign
@pytest.mark.parametrize("firmware", [40, 200])  # in real time: `test_pucks_run_real`
def test_an_arm_of_pucks_is_checked_run_and_identified(tmp_path: Path, firmware: int, capsys: Any) -> None:
    name = f"pucks{firmware}"
    path, run, out = arm(tmp_path, name, emulation={"firmware": firmware}), tmp_path / "run", tmp_path / "out"
    state = state_of(tmp_path, name)
    assert checked(path, name, state), capsys.readouterr().out
    said = capsys.readouterr()
    assert "Shift-Activate" in said.out
    assert "requests and torques withheld" in said.out
    assert main(["run", str(path), "--out", str(run), "--state", str(state)]) == 0
    assert "waiting for a person: stand clear, then press Shift-Activate" in capsys.readouterr().out
    blocks = list(open_recording(run / "run.mcap", NAMES).blocks())
    np.testing.assert_array_equal(np.diff(np.concatenate([block.stamp_ns for block in blocks])), round(1e9 / RATE))
    assert main(["identify", str(run / "run.mcap"), "--arm", str(path), "--out", str(out), "--state", str(state)]) == 0
    document = json.loads((out / "parameters.json").read_text())["base_parameters"]
    model = arm_model(load_arm(path))
    base = base_parameters(model.chain, model.layout)
    true = base.K @ np.array([truth().get(key, 0.0) for key in model.layout.names])
    z = (np.array(document["values"]) - true) / np.array(document["standard_deviations"])
    assert np.abs(z).max() < 5.0, z


@pytest.mark.campaign
@pytest.mark.slow
def test_a_velocity_fault_in_the_middle_of_a_run_is_latched_and_its_recording_can_be_read(
    tmp_path: Path, capsys: Any
) -> None:
    name = "fast"  # faster than its safety puck admits, which trips earlier than it was told
    path = arm(tmp_path, name, emulation={"velocity": 1.2})
    slow = arm(tmp_path, "slow", limits={"velocity": 1.2, "torque": 8191})
    state, run = state_of(tmp_path, name), tmp_path / "run"
    # What the description says is compared before anything moves.
    assert not checked(slow, "slow", state_of(tmp_path, "slow"))
    refused = capsys.readouterr().out
    assert "speed of elbow and tip of the motion (driver.limits.velocity)" in refused
    assert "raise driver.limits.velocity" in refused
    assert checked(path, name, state), capsys.readouterr().out
    capsys.readouterr()
    assert main(["run", str(path), "--out", str(run), "--state", str(state)]) == 4
    said = capsys.readouterr()
    assert "the pendant shows velocity fault" in said.err
    assert "drive_emergency" in arm_fault_store(state, name).latched()
    blocks = list(open_recording(run / "run.mcap", NAMES).blocks())
    assert sum(len(block.position) for block in blocks) > RATE
    assert main(["run", str(path), "--out", str(tmp_path / "again"), "--state", str(state)]) == 3
    assert "drive_emergency" in capsys.readouterr().err


@pytest.mark.campaign
@pytest.mark.timeout(1800)
def test_the_shipped_wam_of_pucks_is_checked_run_and_identified(tmp_path: Path, capsys: Any) -> None:
    motion = {"kind": "seeded", "base_frequency": 0.2, "harmonics": 3, "periods": 1}
    tree = {
        "extends": "wam7_pucks",
        "name": "wampucks",
        "motions": {"identification": motion | {"seed": 7}, "validation": motion | {"seed": 8}},
        "driver": {"kind": "barrett", "bus": LOCK_STEP, "emulation": {"operator": 0.1, "zeroed": True}},
    }
    path, state, run, out = write(tmp_path, tree), tmp_path / "state", tmp_path / "run", tmp_path / "out"
    assert checked(path, "wampucks", state), capsys.readouterr().out
    assert main(["run", str(path), "--out", str(run), "--state", str(state)]) == 0
    assert main(["identify", str(run / "run.mcap"), "--arm", str(path), "--out", str(out), "--state", str(state)]) == 0
    document = json.loads((out / "parameters.json").read_text())["base_parameters"]
    model = arm_model(load_arm(path))
    truth_of = model.config.driver.emulation.truth  # type: ignore[union-attr]
    base = base_parameters(model.chain, model.layout)
    true = base.K @ model.layout.vector(truth_of)
    z = (np.array(document["values"]) - true) / np.array(document["standard_deviations"])
    assert np.abs(z).max() < 5.0, z
