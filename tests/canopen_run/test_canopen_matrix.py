"""Every data sheet of a real drive that is at hand: probed, checked, moved, stopped, broken and identified, or refused.

Bring-up entry by entry, watchdogs and single faults of each file are in `tests/canopen_driver/test_driver_makers.py`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from canopen_run_bench import MIDST, canopen, checked, described, moved_arm, truth, write
from helpers.makers import CAPABLE, REFUSED, SHEETS

from ident_service.cli import USAGE, VERDICT_NO, main
from ident_service.config.load import load_arm
from ident_service.model.arm_model import arm_model
from ident_service.model.base_parameters import base_parameters
from ident_service.operations.fieldbus import bus_probe, probe_text
from sim_backend.emulator.lock_step import LockStepArm

RATE, KP, KD = 125.0, 225.0, 30.0
FILES = sorted(path.name for path in SHEETS.glob("*.[ed][dc][sf]"))
# Where thousandths are of a current: of 1 A for EPOS2, of the rated current for Elmo Gold.
OWN = {
    "maxon_epos2_50-5_2126h.eds": {"rated_torque": 0.2, "torque_constant": 0.2},
    "elmo_gold_V002.dcf": {"torque_constant": 0.1},
}
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not FILES, reason="the makers' data sheets are not beside this checkout"),
]


def arm_of(name: str) -> dict[str, Any]:
    """The small arm behind two drives that are made from this file, described as they are."""
    file, watchdog = str(SHEETS / name), CAPABLE.get(name, ("heartbeat",))[0]
    drive = {"counts": 65536, "rated_torque": 1.2, "max_torque": 1.2, "max_speed": 6000.0, "watchdog": watchdog}
    section = {
        "eds": file,
        "torque_frames": "single",
        "drives": [drive | OWN.get(name, {}) | {"node": node} for node in (1, 2)],
        "guarding": {"period": 0.024},
        "heartbeats": {"period": 0.02, "timeout": 0.11, "host_timeout": 0.06},
        "status": {"period": 0.1, "inhibit": 0.01},
        "measured_torque": "none",
    }
    tree = canopen(described("matrix", RATE, KP, KD), {"interface": "lock_step"}, 2, **section)
    tree["driver"]["emulation"]["eds"] = [file]
    return tree


def test_every_file_is_in_the_matrix() -> None:
    assert set(FILES) == {*CAPABLE, *REFUSED}


# One whose thousandths are of a current; all are brought up, moved and stopped by other tests for every change.
WHOLE = [pytest.param(name, marks=[] if name == next(iter(OWN)) else [pytest.mark.campaign]) for name in CAPABLE]


@pytest.mark.parametrize("name", WHOLE)
def test_a_drive_with_a_torque_mode_is_commissioned(name: str, tmp_path: Path) -> None:
    arm, state = write(tmp_path, arm_of(name)), tmp_path / "state"
    run, out = tmp_path / "run", tmp_path / "out"
    config = load_arm(arm)
    behind = LockStepArm(config)
    probe = bus_probe(config, (), lambda _: [behind.link(0)])
    assert probe.good, probe_text(config, probe)
    assert checked(arm, "matrix", state)
    ticket = json.loads((state / "arms" / "matrix" / "ticket.json").read_text())
    # What was found of each drive is part of it.
    assert all("; " in one and "watchdogs " in one for one in ticket["subject"]["identities"])
    assert main(["run", str(arm), "--out", str(run), "--state", str(state)]) == 0
    assert main(["identify", str(run / "run.mcap"), "--arm", str(arm), "--out", str(out), "--state", str(state)]) == 0
    found = json.loads((out / "parameters.json").read_text())["base_parameters"]
    model = arm_model(config)
    base = base_parameters(model.chain, model.layout)
    expected = base.K @ np.array([truth().get(one, 0.0) for one in model.layout.names])
    z = (np.array(found["values"]) - expected) / np.array(found["standard_deviations"])
    # 13 figures: none beyond what one in ten thousand is, nor all of them together.
    assert np.abs(z).max() < 4.0, dict(zip(base.expressions, z, strict=True))
    assert z @ z < 35.0, dict(zip(base.expressions, z, strict=True))


FAULTS: dict[str, set[str]] = {
    "drive_fault joint=elbow": {"drive_emergency", "drive_fault"},
    "lost_feedback joint=elbow duration=1": {"feedback_gone"},
    "bus_gone": {"driver", "feedback_gone", "bus_silent", "bus_off"},
    "": set(),
}


@pytest.mark.parametrize(
    ("name", "fault", "codes"),
    [
        # Every file has two of them for every change, and all at night.
        pytest.param(name, fault, codes, marks=() if (file + number) % 2 else pytest.mark.campaign)
        for file, name in enumerate(CAPABLE)
        for number, (fault, codes) in enumerate(FAULTS.items())
    ],
)
def test_its_motion_is_stopped_by_a_person_and_by_faults(
    name: str, fault: str, codes: set[str], tmp_path: Path
) -> None:
    came = moved_arm(tmp_path, arm_of(name), fault, None if fault else MIDST)
    if codes:
        assert came.fault is not None
        assert came.fault.code in codes, came.fault
    else:
        assert came.story.states[-2:] == ["stopping", "stopped"]
    assert came.off


@pytest.mark.parametrize("name", REFUSED)
def test_a_drive_without_one_is_refused_by_every_verb(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arm, state = write(tmp_path, arm_of(name)), str(tmp_path / "state")
    assert main(["bus", "probe", str(arm), "--eds", str(SHEETS / name), "--state", state]) == VERDICT_NO
    assert "no torque mode" in capsys.readouterr().out
    assert main(["check", str(arm), "--confirm", "matrix", "--state", state]) == VERDICT_NO
    assert "no torque mode" in capsys.readouterr().out
    assert main(["run", str(arm), "--out", str(tmp_path / "run"), "--state", state]) in (USAGE, VERDICT_NO)
    assert not (tmp_path / "run").exists()
