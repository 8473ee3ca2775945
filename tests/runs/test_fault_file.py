"""Faults on the disk: latched until acknowledged by name, and what a process leaves that is killed while it moves."""

from __future__ import annotations

import resource
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
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


@contextmanager
def files_grow_no_further(than: Path) -> Iterator[None]:
    """In the block, no file of this process grows beyond the size of another, as on a disk that is full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (than.stat().st_size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_fault_that_finds_no_room_is_stored_in_the_mark(folder: Path) -> None:
    faults, cause = FaultStore(folder), "the disk is full; " * 400
    mark = folder / "moving.json"
    with ControlFile.take(folder / CONTROLS, None):
        faults.began(Path("runs/7"))
        with files_grow_no_further(mark):
            faults.latch("recorder_behind", cause)
            faults.latch("recorder_behind", "another cause; " * 400)
            assert not (folder / "faults.json").exists()
            assert faults.latched() == {"recorder_behind": f"{cause[:300]}..."}  # while the arm is held, too
            faults.ended()
    assert faults.latched() == {"recorder_behind": f"{cause[:300]}..."}
    with (
        ControlFile.take(folder / CONTROLS, None),
        pytest.raises(MotionRefused, match="unacknowledged faults: recorder_behind"),
    ):
        faults.began(Path("runs/8"))
    assert faults.acknowledge("recorder_behind") == f"{cause[:300]}..."
    assert faults.latched() == {}
    assert not mark.exists()


def test_faults_of_the_mark_and_of_the_file_are_one_list(folder: Path) -> None:
    faults = FaultStore(folder)
    with ControlFile.take(folder / CONTROLS, None):
        faults.began(Path("runs/7"))
        with files_grow_no_further(folder / "moving.json"):
            faults.latch("recorder_behind", "full " * 2000)
        faults.latch("recorder_behind", "again")
        faults.latch("driver", "a cable")
        faults.ended()
    assert list(faults.latched()) == ["recorder_behind", "driver"]
    assert faults.acknowledge("driver") == "a cable"
    assert faults.latched() == {"recorder_behind": f"{('full ' * 2000)[:300]}..."}
    assert not (folder / "moving.json").exists()


def test_a_mark_with_faults_that_nobody_ended_is_a_process_that_died_as_well(folder: Path) -> None:
    faults = FaultStore(folder)
    with ControlFile.take(folder / CONTROLS, None):
        faults.began(Path("runs/7"))
        with files_grow_no_further(folder / "moving.json"):
            faults.latch("recorder_behind", "full " * 2000)
    assert list(faults.latched()) == ["recorder_behind", "motion_process"]
    faults.acknowledge("recorder_behind")
    assert list(faults.latched()) == ["motion_process"]
    faults.acknowledge("motion_process")
    assert faults.latched() == {}


@pytest.mark.parametrize("cut", ["{", '{"code": "recorder_beh', '{"code": "a"}', "[]", "\0\0"])
def test_a_line_of_the_mark_in_pieces_leaves_the_fault_of_a_process_that_died(folder: Path, cut: str) -> None:
    faults, mark = FaultStore(folder), folder / "moving.json"
    with ControlFile.take(folder / CONTROLS, None):
        faults.began(Path("runs/7"))
        first, blanks = mark.read_text().split("\n")
        mark.write_text(f"{first}\n{cut}{blanks[len(cut) :]}")
    assert list(faults.latched()) == ["motion_process"]


def test_a_mark_of_earlier_software_has_no_room_and_says_that_it_has_none(folder: Path) -> None:
    faults, mark = FaultStore(folder), folder / "moving.json"
    folder.mkdir(parents=True)
    mark.write_text('{\n "pid": 7,\n "run": "runs/7",\n "began": 1.5\n}\n')
    assert list(faults.latched()) == ["motion_process"]
    with files_grow_no_further(mark), pytest.raises(UsageError, match=r"moving\.json: has no room left"):
        faults.latch("recorder_behind", "full " * 2000)


@pytest.mark.parametrize("name", ["faults.json", "moving.json"])
@pytest.mark.parametrize(
    "content",
    [
        *("", "[]", "{}", '{"faults": [3], "pid": null}', '{"faults": {}, "pid": {}}', '{"faults": "", "pid": ""}'),
        pytest.param("[" * 100_000, id="deep"),
        pytest.param('{"faults": [{"code": "a", "cause": "b", "written": 1' + "0" * 400 + "}]}", id="number"),
        pytest.param('{"pid": 1, "run": "7", "began": 1' + "0" * 400 + "}", id="time"),
    ],
)
def test_a_damaged_file_is_not_taken_for_none(folder: Path, name: str, content: str) -> None:
    folder.mkdir(parents=True)
    (folder / name).write_text(content)
    for ask in (FaultStore(folder).latched, lambda: FaultStore(folder).began(Path("run"))):
        with pytest.raises(UsageError, match=f"{name}: cannot be read .* check the arm, then remove the file"):
            ask()
