"""`ident run --can-log` on emulated CANopen drives in virtual time: every frame of the run in its folder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from helpers.replay import read_session
from helpers.tickets import write_checked_ticket

from ident_service.cli import DONE, FAILED, USAGE, main
from ident_service.config.load import load_arm, shipped_arms


@pytest.fixture
def drives_arm(tmp_path: Path) -> Path:
    """Two joints whose axes point along gravity, on emulated drives; a motion of two seconds."""
    shipped = shipped_arms()["planar2"]
    motion = {"kind": "seeded", "seed": 1, "base_frequency": 0.5, "harmonics": 3, "periods": 1}
    drive = {"rated_torque": 0.5, "max_torque": 10.0, "max_speed": 3000.0}
    tree = {
        "extends": str(shipped),
        "name": "drives2",
        "gravity": [0.0, 0.0, -9.81],
        "control": {"rate": 250},
        "motions": {"identification": motion, "validation": dict(motion)},
        "transmission": {"ratios": [40.0, 20.0], "drive_terms": "joints"},
        "driver": {
            "kind": "canopen",
            "eds": str(shipped.parent / "emulated_drive.eds"),
            "buses": [{"interface": "lock_step"}],
            "drives": [drive | {"node": 1}, drive | {"node": 2}],
        },
    }
    path = tmp_path / "drives2.yaml"
    path.write_text(yaml.safe_dump(tree))
    return path


@pytest.mark.slow
def test_every_frame_of_a_run_is_in_its_folder(
    drives_arm: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    state, folder = ["--state", str(tmp_path / "state")], tmp_path / "run"
    assert main(["check", str(drives_arm), "--confirm", "drives2", *state]) == DONE
    capsys.readouterr()
    assert main(["run", str(drives_arm), "--out", str(folder), "--can-log", "--json", *state]) == DONE
    report = json.loads(capsys.readouterr().out)["report"]
    frames = read_session(folder / "can.log")
    assert report["frames_logged"] == f"{len(frames)} frames"
    syncs = sum(logged.sent and logged.frame.identifier == 0x080 for logged in frames)
    positions = sum(not logged.sent and logged.frame.identifier in (0x181, 0x182) for logged in frames)
    assert syncs > report["cycles"]  # those of opening, enabling and leaving, too
    assert positions == 2 * syncs
    assert "can.log" in json.loads((folder / "manifest.json").read_text())["files"]


@pytest.mark.slow
def test_it_is_refused_where_nothing_moves_or_no_frames_are(
    virtual_arm: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    state = ["--state", str(tmp_path / "state")]
    assert main(["recover", "planar2", "--can-log", *state]) == USAGE
    assert "--can-log is for --leave-limit" in capsys.readouterr().err
    # The simulated arm has no fieldbus: said by the motion process, before it is opened.
    write_checked_ticket(load_arm(virtual_arm), tmp_path / "state")
    assert main(["run", str(virtual_arm), "--can-log", "--out", str(tmp_path / "run"), *state]) == FAILED
    assert "no fieldbus whose frames could be logged" in capsys.readouterr().err
