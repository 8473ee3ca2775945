"""What a run that does not end well says and leaves: the fault before anything else, and never a traceback."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from helpers.small_disk import run_on_small_disk
from helpers.tickets import write_checked_ticket
from kill_bench import TAG, VICTIMS, tagged, wait_for
from runs.conftest import written

from ident_service.cli import main
from ident_service.config.load import load_arm
from ident_service.errors import ArmError, ArmFault, MotionRefused
from ident_service.motion.command_channel import ControlFile, is_control_file_in_use
from ident_service.motion.control_loop import LOWERS, WAITS
from ident_service.operations.motion_run import ProcessResult
from ident_service.registry.state_folder import arm_fault_store, control_path, ticket_path

Capture = pytest.CaptureFixture[str]


pytestmark = pytest.mark.usefixtures("hangups_are_heard")


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    """The planar arm in virtual time with short motions."""
    return written(tmp_path / "arm.yaml", "{kind: seeded, seed: 1, base_frequency: 0.4, harmonics: 2, periods: 1}")


@pytest.fixture
def words(arm: Path, tmp_path: Path) -> list[str]:
    """Of a run of the arm, which has been checked."""
    write_checked_ticket(load_arm(arm), tmp_path / "state")
    return ["run", str(arm), "--out", str(tmp_path / "run"), "--state", str(tmp_path / "state")]


def when(monkeypatch: pytest.MonkeyPatch, then: dict[str, Callable[[], None]]) -> list[str]:
    """Do something when the command tells a state; all that it tells."""
    said: list[str] = []

    def told(_: object, line: str) -> None:
        said.append(line)
        then.get(line, lambda: None)()

    monkeypatch.setattr("ident_service.cli.motion_commands.tell", told)
    return said


@pytest.mark.slow
@pytest.mark.parametrize("form", ["text", pytest.param("json", marks=pytest.mark.campaign)])
def test_a_full_disk_is_the_fault_that_it_is(
    form: str, words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    # Long enough for a busy machine: a recording that is nearly whole when the disk fills has failed without a fault.
    arm = written(tmp_path / "arm.yaml", "{kind: seeded, seed: 1, base_frequency: 0.4, harmonics: 2, periods: 6}")
    write_checked_ticket(load_arm(arm), tmp_path / "state")
    monkeypatch.setenv(TAG, "disk")
    run = tmp_path / "run"

    def fill() -> None:
        (recorder,) = (pid for pid, command in tagged("disk").items() if VICTIMS["recorder"] in command)
        resource.prlimit(recorder, resource.RLIMIT_FSIZE, (4096, 4096))
        for name in ("ended.json", "manifest.json"):
            (run / name).mkdir()  # so that neither can be written

    when(monkeypatch, {"approaching": fill})
    capsys.readouterr()
    assert main([*words, *(["--json"] if form == "json" else [])]) == 4
    out, err = capsys.readouterr()
    ((code, cause),) = arm_fault_store(tmp_path / "state", "planar2").latched().items()
    assert code == "recorder_behind"
    assert "File too large" in cause
    lines = [line for line in err.splitlines() if not line.startswith("next: ")]
    assert lines[0] == f"ident: {code}: {cause}"
    assert f"{run / 'manifest.json'}: cannot be written: Is a directory" in lines
    assert f"recording until the fault: {run / 'run.mcap.partial'}" in lines
    names = sorted(path.name for path in run.iterdir())
    assert lines[-len(names) - 1 :] == [f"files: {run}", *(f"  {name}" for name in names)]
    if form == "json":
        document = json.loads(out)
        assert document["error"] == {"kind": "ArmFault", "message": f"{code}: {cause}"}
        assert document["exit_code"] == 4
        assert document["folder"] == str(run)
        assert document["faults"] == [{"code": code, "cause": cause}]
        assert document["files"] == names
        assert document["recording"] == str(run / "run.mcap.partial")


FILLED = """
import json, os, sys
from pathlib import Path
from ident_service.cli import main, motion_commands
from ident_service.registry.state_folder import arm_fault_store
arm, disk = sys.argv[1], Path(sys.argv[2])

def fill(_, line):
    if line == "exciting":
        with (disk / "other").open("wb", buffering=0) as other:
            while other.write(bytes(4096)) == 4096:
                pass

def filled(answer, line):
    try:
        fill(answer, line)
    except OSError:
        assert os.statvfs(disk).f_bavail == 0

motion_commands.tell = filled
code = main(["run", arm, "--out", str(disk / "run"), "--state", str(disk / "state")])
faults = arm_fault_store(disk / "state", "planar2")
latched = faults.latched()
stored = (disk / "state/arms/planar2/faults.json").exists()
(disk / "other").unlink()
for fault in latched:
    faults.acknowledge(fault)
print("\\n" + json.dumps({"code": code, "latched": latched, "stored": stored, "left": faults.latched()}))
"""


@pytest.mark.slow
def test_a_disk_that_is_really_full_keeps_the_cause_of_the_fault(arm: Path, tmp_path: Path) -> None:
    write_checked_ticket(load_arm(arm), tmp_path / "kept" / "state")
    disk = tmp_path / "disk"
    script = f'cp -r {tmp_path}/kept/state {disk} && exec "$0" -c "$1" {arm} {disk}'
    ended = run_on_small_disk(disk, "4m", script, sys.executable, FILLED)
    said = json.loads(ended.stdout.splitlines()[-1])
    assert (said["code"], list(said["latched"])) == (4, ["recorder_behind"]), ended.stderr
    assert "No space left on device" in said["latched"]["recorder_behind"]
    assert not said["stored"]  # it was in the mark alone
    assert said["left"] == {}


@pytest.mark.slow
def test_a_second_ctrl_c_waits_for_the_stop_and_tells_the_truth(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    def interrupt() -> None:
        signal.raise_signal(signal.SIGINT)

    said = when(monkeypatch, {"exciting": interrupt, "stopping": interrupt})
    before = signal.getsignal(signal.SIGINT)
    assert main(words) == 1
    assert signal.getsignal(signal.SIGINT) is before
    assert "interrupted: the arm is being stopped under control; waiting 30 s at most" in said
    assert said[-1] == "stopped"
    out, err = capsys.readouterr()
    assert "stopped after" in out
    assert "virtual time: nothing was timed\n" in out
    assert err == ""
    ended = json.loads((tmp_path / "run" / "ended.json").read_text())
    assert (ended["state"], ended["lateness"], ended["compute"]) == ("stopped", None, None)
    assert arm_fault_store(tmp_path / "state", "planar2").latched() == {}


@pytest.mark.slow
def test_a_terminal_that_closes_stops_the_arm_under_control(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def hang_up() -> None:
        signal.raise_signal(signal.SIGHUP)

    when(monkeypatch, {"exciting": hang_up, "stopping": hang_up})
    assert main(words) == 1
    assert json.loads((tmp_path / "run" / "ended.json").read_text())["state"] == "stopped"
    assert arm_fault_store(tmp_path / "state", "planar2").latched() == {}


@pytest.mark.slow
def test_a_reader_that_goes_ends_no_motion(words: list[str], tmp_path: Path) -> None:
    command = [sys.executable, "-m", "ident_service", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait(60) == 0
    assert json.loads((tmp_path / "run" / "ended.json").read_text())["state"] == "done"


def nowhere(words: list[str]) -> list[str]:
    return [word if not word.endswith("/run") else "/proc/foo" for word in words]


def test_a_folder_that_cannot_be_made_is_one_sentence(words: list[str], capsys: Capture) -> None:
    capsys.readouterr()
    assert main(nowhere(words)) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert err.startswith("ident: /proc/foo: cannot be written")


def age(ticket: dict[str, Any]) -> None:
    ticket["created"], ticket["expires"] = (ticket[key].replace("20", "19", 1) for key in ("created", "expires"))


def another_arm(ticket: dict[str, Any]) -> None:
    ticket["subject"]["arm_sha256"] = "0" * 64


def another_drive(ticket: dict[str, Any]) -> None:
    ticket["subject"]["identities"] = ["somebody else's"]


@pytest.mark.parametrize(
    ("change", "reason", "announced"),
    [
        (age, "it expired at", False),
        (another_arm, "the arm's description has changed", False),
        pytest.param(another_drive, "the drives are not those", True, marks=pytest.mark.slow),
    ],
)
def test_a_run_that_is_refused_leaves_no_folder(
    change: Callable[[dict[str, Any]], None],
    reason: str,
    announced: bool,
    words: list[str],
    tmp_path: Path,
    capsys: Capture,
) -> None:
    path = ticket_path(tmp_path / "state", "planar2")
    ticket = json.loads(path.read_text())
    change(ticket)
    path.write_text(json.dumps(ticket))
    capsys.readouterr()
    assert main(words) == 3
    out, err = capsys.readouterr()
    assert reason in err
    # Only what the arm alone can tell is found out after the run has begun.
    assert ("into" in out) == announced
    assert not (tmp_path / "run").exists()


def test_a_state_that_cannot_be_written_is_found_before_anything_moves(
    words: list[str], arm: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "state" / "arms" / load_arm(arm).name
    monkeypatch.setattr("ident_service.operations.motion_run.arm_folder", lambda *_: folder / "ticket.json" / "below")
    capsys.readouterr()
    assert main(words) == 2
    out, err = capsys.readouterr()
    assert (out, err) == ("", f"ident: {folder}/ticket.json/below: cannot be written: Not a directory\n")
    assert not (tmp_path / "run").exists()


def test_the_first_fault_is_the_error_and_the_others_are_its_notes(tmp_path: Path) -> None:
    faults = arm_fault_store(tmp_path, "planar2")
    for code, cause in (("drive_fault", "a cable"), ("following_error", "elbow"), ("bus_silent", "nothing")):
        faults.latch(code, cause)
    ending = ProcessResult({}, {"kind": "ArmFault", "code": "bus_silent", "message": "bus_silent: nothing"}, 4)
    with pytest.raises(ArmFault, match=r"^drive_fault: a cable") as raised:
        ending.raise_for(faults)
    assert raised.value.code == "drive_fault"
    assert raised.value.__notes__ == ["also active: following_error: elbow", "also active: bus_silent: nothing"]


def test_a_fault_that_could_not_be_latched_is_still_the_error(tmp_path: Path) -> None:
    ending = ProcessResult(
        {}, {"kind": "ArmFault", "code": "runaway", "message": "runaway: a sign; it could not be latched"}
    )
    with pytest.raises(ArmFault, match=r"^runaway: a sign; it could not be latched$"):
        ending.raise_for(arm_fault_store(tmp_path, "planar2"))


def test_a_refusal_stays_one_and_a_death_without_a_word_is_none(tmp_path: Path) -> None:
    faults = arm_fault_store(tmp_path, "planar2")
    with pytest.raises(MotionRefused, match=r"^not at rest$"):
        ProcessResult({}, {"kind": "MotionRefused", "message": "not at rest"}).raise_for(faults)
    with pytest.raises(ArmError, match=r"without a message \(SIGKILL\) before it opened the arm"):
        ProcessResult({}, {}, -signal.SIGKILL).raise_for(faults)
    ProcessResult({"state": "done"}, {}, os.EX_OK).raise_for(faults)


@pytest.fixture
def loose(tmp_path: Path) -> list[str]:
    """Words of a run of an arm without brakes, which is held after a stop."""
    path = written(tmp_path / "loose.yaml", "{kind: seeded, seed: 1, base_frequency: 0.4, harmonics: 2, periods: 1}")
    text = path.read_text().replace("{rate: 125}", "{rate: 125, after_stop: hold}")
    path.write_text(text.replace("{kp:", "{brake: false, kp:"))
    write_checked_ticket(load_arm(path), tmp_path / "state")
    return ["run", str(path), "--out", str(tmp_path / "run"), "--state", str(tmp_path / "state")]


@pytest.mark.slow
def test_an_arm_without_brakes_is_held_until_a_person_confirms(
    loose: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    state = ["--state", str(tmp_path / "state")]

    def confirm() -> None:
        assert main(["supported", "planar2", "--confirm", "planar2", *state]) == 0

    said = when(monkeypatch, {"exciting": lambda: signal.raise_signal(signal.SIGINT), WAITS: confirm})
    assert main(["supported", loose[1], *state]) == 2  # nobody moves it, and its drives do not hold it
    assert main(loose) == 1
    assert said[-3:] == ["stopped", WAITS, LOWERS]
    assert "planar2: support confirmed\n" in capsys.readouterr().out
    assert arm_fault_store(tmp_path / "state", "planar2").latched() == {}


@pytest.mark.slow
def test_a_held_arm_does_not_fall_with_whoever_requested_the_motion(loose: list[str], tmp_path: Path) -> None:
    control = control_path(tmp_path / "state", "planar2")
    command = [sys.executable, "-m", "ident_service", *loose]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as parent:
        assert parent.stdout is not None
        while "exciting" not in (line := parent.stdout.readline()):
            assert line, "it ended"
        parent.kill()
    with ControlFile.reach(control) as controls:
        wait_for(lambda: controls.waiting, "it is not held")
        time.sleep(1.0)
        assert is_control_file_in_use(control)
        controls.confirm_support()
    wait_for(lambda: not is_control_file_in_use(control), "it is not let go")
    assert list(arm_fault_store(tmp_path / "state", "planar2").latched()) == ["lease_lost"]
