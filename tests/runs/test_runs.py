"""`ident run`, and what a second terminal may ask of it; what is left when it is killed is `test_kills.py`.

Runs of processes against the machine's clock belong to the campaign: a stall of the machine is a fault of the arm.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.tickets import write_checked_ticket
from kill_bench import TRIES

from ident_service.cli import main
from ident_service.config.load import load_arm
from ident_service.errors import MotionRefused
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import arm_model
from ident_service.motion.ticket import read_ticket
from ident_service.operations.motion_run import run_motion
from ident_service.recordings.mcap_reader import McapRecording
from ident_service.recordings.open import open_recording
from ident_service.registry.state_folder import arm_fault_store, ticket_path

Command = "subprocess.Popen[str]"


def ident(*words: object) -> list[str]:
    return [sys.executable, "-m", "ident_service", *map(str, words)]


def wait_for(what: Any, seconds: float = 30.0) -> Any:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if answer := what():
            return answer
        time.sleep(0.05)
    raise AssertionError("it never happened")


class Started:
    """An `ident run` in the background."""

    def __init__(self, arm: Path, folder: Path, state: Path) -> None:
        self.folder = folder
        self.process = subprocess.Popen(
            ident("run", arm, "--out", folder, "--state", state),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def reaches(self, word: str) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.strip() == word:
                return
        raise AssertionError(f"never {word}: {self.process.stderr.read() if self.process.stderr else ''}")

    def end(self) -> tuple[int, str, str]:
        out, err = self.process.communicate(timeout=60)
        return self.process.returncode, out, err


@pytest.fixture
def started(real_arm: Path, tmp_path: Path) -> Iterator[Started]:
    words = ["check", str(real_arm), "--confirm", "planar2", "--state", str(tmp_path / "state")]
    assert any(main(words) == 0 for _ in range(TRIES))  # a machine that stalls does not keep the rate
    run = Started(real_arm, tmp_path / "run", tmp_path / "state")
    yield run
    if run.process.poll() is None:
        run.process.kill()
    run.process.communicate()


def readable(folder: Path) -> int:
    """Samples that the recording of a run gives, torn or whole."""
    names = ("shoulder", "elbow")
    path = folder / "run.mcap"
    path = path if path.exists() else folder / "run.mcap.partial"
    return sum(len(block.position) for block in open_recording(path, names).blocks())


def checked(arm: Path, state: Path) -> list[str]:
    """The words that a run of a checked arm needs."""
    write_checked_ticket(load_arm(arm), state)
    return ["--state", str(state)]


@pytest.mark.slow
def test_a_run_in_virtual_time_is_the_run_that_was_requested(virtual_arm: Path, tmp_path: Path) -> None:
    words = checked(virtual_arm, tmp_path / "state")
    assert main(["run", str(virtual_arm), "--out", str(tmp_path / "run"), *words]) == 0
    names = sorted(path.name for path in (tmp_path / "run").iterdir())
    assert names == ["arm.json", "ended.json", "excitation.json", "manifest.json", "run.mcap", "ticket.json"]
    ended = json.loads((tmp_path / "run" / "ended.json").read_text())
    assert ended["state"] == "done"
    assert (ended["lateness"], ended["compute"]) == (None, None)
    assert 0 < readable(tmp_path / "run") <= ended["cycles"]
    recording = open_recording(tmp_path / "run" / "run.mcap")
    assert isinstance(recording, McapRecording)
    assert recording.metadata["complete"] == "true"


@pytest.mark.slow
def test_a_machine_that_stalls_in_virtual_time_loses_no_lease(virtual_arm: Path, tmp_path: Path) -> None:
    state = tmp_path / "state"
    checked(virtual_arm, state)
    config = load_arm(virtual_arm)
    motion = excitation(arm_model(config), "identification")
    ticket = read_ticket(ticket_path(state, config.name))
    # Every switch between two processes is longer than this lease.
    ran = run_motion(config, motion, tmp_path / "run", state, ticket, lease_seconds=1e-3)
    assert ran.report["state"] == "done"


@pytest.mark.slow
def test_a_stop_while_a_run_is_being_prepared_keeps_it_from_beginning(virtual_arm: Path, tmp_path: Path) -> None:
    state = tmp_path / "state"
    checked(virtual_arm, state)
    config = load_arm(virtual_arm)
    motion = excitation(arm_model(config), "identification")
    ticket, requested_ns = read_ticket(ticket_path(state, config.name)), time.monotonic_ns()
    assert main(["stop", str(virtual_arm), "--state", str(state)]) == 0  # nobody moves it yet
    with pytest.raises(MotionRefused, match="a stop was requested before the arm was energised"):
        run_motion(config, motion, tmp_path / "run", state, ticket, requested_ns=requested_ns)
    assert not (tmp_path / "run").exists()
    assert not arm_fault_store(state, config.name).latched()
    assert run_motion(config, motion, tmp_path / "run", state, ticket).report["state"] == "done"


@pytest.mark.campaign
def test_a_parent_that_hangs_loses_its_lease(started: Started, tmp_path: Path) -> None:
    started.reaches("exciting")
    faults = arm_fault_store(tmp_path / "state", "planar2")
    started.process.send_signal(signal.SIGSTOP)
    try:
        wait_for(lambda: "lease_lost" in faults.latched())
    finally:
        started.process.send_signal(signal.SIGCONT)
    code, _, err = started.end()
    assert code == 4
    assert err.startswith("ident: lease_lost: ")
    assert set(faults.latched()) == {"lease_lost"}


@pytest.mark.campaign
@pytest.mark.slow
def test_a_rehearsal_is_the_same_path_at_a_fifth_of_the_speed(virtual_arm: Path, tmp_path: Path) -> None:
    words = ["--out", str(tmp_path / "run"), *checked(virtual_arm, tmp_path / "state")]
    assert main(["rehearse", str(virtual_arm), "--no-key", *words]) == 0
    limits = load_arm(virtual_arm).joints
    recording = open_recording(tmp_path / "run" / "run.mcap", tuple(limits))
    position = np.concatenate([block.position for block in recording.blocks()])
    fastest = np.abs(np.diff(position, axis=0)).max(axis=0) * 125.0
    assert (fastest < 0.35 * np.array([joint.velocity for joint in limits.values()])).all()


def test_a_folder_that_exists_is_not_written_over(virtual_arm: Path, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    words = checked(virtual_arm, tmp_path / "state")
    assert main(["run", str(virtual_arm), "--out", str(tmp_path / "run"), *words]) == 2


def test_an_arm_that_was_not_checked_does_not_move(
    virtual_arm: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--out", str(tmp_path / "run"), "--state", str(tmp_path / "state")]
    assert main(["run", str(virtual_arm), *words]) == 3
    assert "no preflight ticket" in capsys.readouterr().err
    checked(virtual_arm, tmp_path / "state")
    virtual_arm.write_text(virtual_arm.read_text() + "description: another\n")
    assert main(["run", str(virtual_arm), *words]) == 3
    assert "the arm's description has changed since" in capsys.readouterr().err


@pytest.mark.campaign
def test_a_second_terminal_pauses_resumes_and_stops(started: Started, real_arm: Path, tmp_path: Path) -> None:
    started.reaches("exciting")
    for word, reached in (("pause", "paused"), ("resume", "exciting"), ("stop", "stopped")):
        assert main([word, str(real_arm), "--state", str(tmp_path / "state")]) == 0
        started.reaches(reached)
    code, out, err = started.end()
    assert code == 1, err
    assert out.startswith("stopped after")
    assert readable(started.folder) > 0


@pytest.mark.campaign
def test_a_second_run_is_refused_while_the_first_one_moves(started: Started, real_arm: Path, tmp_path: Path) -> None:
    started.reaches("exciting")
    words = ["--out", str(tmp_path / "other"), "--state", str(tmp_path / "state")]
    assert main(["run", str(real_arm), *words]) != 0
    # The first one has not noticed, and goes on until it is stopped.
    started.process.send_signal(signal.SIGINT)
    assert "stopped" in started.end()[1]


@pytest.mark.campaign
def test_ctrl_c_stops_the_arm_under_control(started: Started) -> None:
    started.reaches("exciting")
    started.process.send_signal(signal.SIGINT)
    code, out, err = started.end()
    assert code == 1, err
    assert "stopped after" in out
