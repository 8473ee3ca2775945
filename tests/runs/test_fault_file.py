"""Faults on the disk: latched until acknowledged by name, and what a process leaves that is killed while it moves."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from ident_service.errors import MotionRefused, UsageError
from ident_service.motion.command_channel import ControlFile
from ident_service.motion.fault_store import CONTROLS, FaultStore

KILLED = """
import os, signal, sys
from pathlib import Path
from ident_service.motion.command_channel import ControlFile
from ident_service.motion.fault_store import CONTROLS, FaultStore
folder = Path(sys.argv[1])
ControlFile.take(folder / CONTROLS, None)
FaultStore(folder).began(Path("runs/7"))
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "arms" / "small"


def test_a_fault_stays_until_it_is_acknowledged_by_name(folder: Path) -> None:
    faults = FaultStore(folder)
    assert faults.latched() == {}
    faults.latch("runaway", "a sign")
    faults.latch("driver", "a cable")
    faults.latch("runaway", "another cause")
    assert list(FaultStore(folder).latched().items()) == [("runaway", "a sign"), ("driver", "a cable")]
    with pytest.raises(
        MotionRefused, match=r"small: unacknowledged faults: runaway \(a sign\); driver \(a cable\); `ident acknowledge"
    ):
        faults.began(Path("run"))
    with pytest.raises(UsageError, match=r"small: no active fault 'far_outside' \(active: runaway, driver\)"):
        faults.acknowledge("far_outside")
    assert faults.acknowledge("runaway") == "a sign"
    assert faults.latched() == {"driver": "a cable"}


def test_who_is_killed_while_the_arm_moves_leaves_a_fault(folder: Path) -> None:
    subprocess.run([sys.executable, "-c", KILLED, str(folder)], check=False)
    faults = FaultStore(folder)
    (cause,) = faults.latched().values()
    assert cause.endswith("while it had the arm, in the run runs/7")
    with ControlFile.take(folder / CONTROLS, None), pytest.raises(MotionRefused, match="motion_process"):
        faults.began(Path("runs/8"))
    assert faults.acknowledge("motion_process") == cause
    assert faults.latched() == {}
    assert list(folder.glob("moving*")) == []


def test_an_arm_that_moves_has_no_fault_yet_and_one_that_ended_has_none(folder: Path) -> None:
    faults = FaultStore(folder)
    with ControlFile.take(folder / CONTROLS, None):
        faults.began(Path("run"))
        assert faults.latched() == {}
        with pytest.raises(UsageError, match="no active fault 'motion_process'"):
            faults.acknowledge("motion_process")
        faults.ended()
    assert faults.latched() == {}


@pytest.mark.parametrize("name", ["faults.json", "moving.json"])
@pytest.mark.parametrize("content", ["", "[]", "{}", '{"faults": [3], "pid": null}'])
def test_a_damaged_file_is_not_taken_for_none(folder: Path, name: str, content: str) -> None:
    folder.mkdir(parents=True)
    (folder / name).write_text(content)
    for ask in (FaultStore(folder).latched, lambda: FaultStore(folder).began(Path("run"))):
        with pytest.raises(UsageError, match=f"{name}: cannot be read .* check the arm, then remove the file"):
            ask()
