"""The controls that a second terminal reaches, and who may have them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from ident_service.cli import main
from ident_service.errors import DriverError, UsageError
from ident_service.motion.command_channel import ControlFile, is_control_file_in_use, stop_requested_ns
from ident_service.operations.moving_arms import ask_arm, is_held, moving_arms, stop_arms
from ident_service.registry.state_folder import arm_fault_store, control_path


class Time:
    """A clock that a test moves."""

    def __init__(self) -> None:
        self.now = 5_000_000_000

    def __call__(self) -> int:
        return self.now


def test_what_one_side_asks_the_other_reads(tmp_path: Path) -> None:
    with ControlFile.take(tmp_path / "arm" / "control", None) as loop, ControlFile.reach(loop_path(tmp_path)) as person:
        assert (loop.stop, loop.pause, loop.finish) == (False, False, False)
        person.request_pause(True)
        assert loop.pause
        person.request_pause(False)
        assert not loop.pause
        person.request_finish()
        assert (loop.stop, loop.pause, loop.finish) == (False, False, True)
        person.request_pause(True)
        person.request_pause(False)
        assert (loop.pause, loop.finish) == (False, True)
        person.request_stop()
        assert loop.stop
        assert person.pid == loop.pid


def test_support_is_confirmed_only_where_the_arm_waits_for_it(tmp_path: Path) -> None:
    with ControlFile.take(loop_path(tmp_path), None) as loop, ControlFile.reach(loop_path(tmp_path)) as person:
        assert (loop.waiting, loop.supported) == (False, False)
        with pytest.raises(UsageError, match="not held"):
            person.confirm_support()
        assert not loop.supported
        loop.announce_hold()
        assert (person.waiting, loop.supported) == (True, False)
        person.confirm_support()
        assert loop.supported
    with ControlFile.take(loop_path(tmp_path), None) as loop:  # the next motion waits for nothing
        assert (loop.waiting, loop.supported) == (False, False)


def loop_path(folder: Path) -> Path:
    return folder / "arm" / "control"


def test_a_lease_lapses_unless_it_is_renewed(tmp_path: Path) -> None:
    time = Time()
    with (
        ControlFile.take(loop_path(tmp_path), 2.0, time) as loop,
        ControlFile.reach(loop_path(tmp_path), time) as parent,
    ):
        time.now += 1_900_000_000
        assert loop.lease_is_valid()
        parent.renew()
        time.now += 1_900_000_000
        assert loop.lease_is_valid()
        time.now += 200_000_000
        assert not loop.lease_is_valid()


def test_a_run_without_a_lease_has_none_to_lose(tmp_path: Path) -> None:
    time = Time()
    with ControlFile.take(loop_path(tmp_path), None, time) as loop:
        time.now += 10**15
        assert loop.lease_is_valid()


def test_a_second_one_who_wants_to_move_the_arm_is_refused_by_name(tmp_path: Path) -> None:
    with ControlFile.take(loop_path(tmp_path), None) as first:
        with pytest.raises(DriverError, match=f"in use by process {first.pid}"):
            ControlFile.take(loop_path(tmp_path), None)
        assert not first.stop


def test_nobody_is_reached_when_nobody_moves_the_arm(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="the arm is not moving"):
        ControlFile.reach(loop_path(tmp_path))
    ControlFile.take(loop_path(tmp_path), None).close()
    with pytest.raises(UsageError, match="left from a run that has ended"):
        ControlFile.reach(loop_path(tmp_path))


def test_a_killed_process_leaves_no_lock(tmp_path: Path) -> None:
    code = (
        "import sys, os, signal; from pathlib import Path\n"
        "from ident_service.motion.command_channel import ControlFile\n"
        "ControlFile.take(Path(sys.argv[1]), None).request_stop(); os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", code, str(loop_path(tmp_path))], check=False)
    with ControlFile.take(loop_path(tmp_path), None) as again:
        assert not again.stop  # what was asked of the dead run is not asked of this one


@pytest.mark.parametrize(("asked", "stops"), [(-1, True), (0, True), (1, False), (None, False)])
def test_a_stop_reaches_a_motion_that_was_requested_before_it(tmp_path: Path, asked: int | None, stops: bool) -> None:
    time = Time()
    assert ControlFile.stop_motions(loop_path(tmp_path), time) is None
    requested_ns = None if asked is None else time.now + asked
    time.now += 2_000_000_000
    with ControlFile.take(loop_path(tmp_path), 2.0, time, requested_ns) as loop:
        assert loop.stop == stops
        assert not loop.pause
        assert loop.lease_is_valid()


def test_a_stop_before_the_machine_was_started_anew_is_none(tmp_path: Path) -> None:
    time = Time()
    ControlFile.stop_motions(loop_path(tmp_path), time)
    time.now -= 3_000_000_000
    with ControlFile.take(loop_path(tmp_path), None, time, motion_requested_ns=time.now - 1) as loop:
        assert not loop.stop


def test_a_stop_reaches_who_moves_the_arm_and_who_waits_for_it(tmp_path: Path) -> None:
    time = Time()
    requested_ns = time.now
    with ControlFile.take(loop_path(tmp_path), None, time) as loop:
        time.now += 1
        assert ControlFile.stop_motions(loop_path(tmp_path), time) == loop.pid
        assert loop.stop
    time.now += 1
    with ControlFile.take(loop_path(tmp_path), None, time, requested_ns) as waited:
        assert waited.stop
    with ControlFile.take(loop_path(tmp_path), None, time, time.now) as later:
        assert not later.stop


def test_a_stop_that_cannot_be_written_says_so(tmp_path: Path) -> None:
    (tmp_path / "arm").write_text("", encoding="utf-8")
    with pytest.raises(UsageError, match="cannot be written"):
        ControlFile.stop_motions(loop_path(tmp_path))


def test_an_arm_whose_controls_cannot_be_opened_is_not_said_to_be_at_rest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its process would not have been stopped. Others are, in the same call."""
    state = tmp_path / "state"
    for name in ("before", "moving", "unknown", "within"):
        control_path(state, name).parent.mkdir(parents=True)
    for name in ("before", "unknown", "within"):
        control_path(state, name).mkdir()  # nobody can open it as a file, whoever they are
    blocked = control_path(state, "unknown")
    with pytest.raises(DriverError, match="it cannot be told whether the arm moves"):
        ControlFile.stop_motions(blocked)
    with pytest.raises(DriverError, match="cannot be opened: Is a directory"):
        ControlFile.reach(blocked)
    with pytest.raises(DriverError, match=r"cannot be opened: Is a directory.* then make it a file"):
        ControlFile.take(blocked, None)  # another state folder would be another lock
    with pytest.raises(DriverError, match="cannot be opened: Is a directory"):
        arm_fault_store(state, "unknown").latched()
    with ControlFile.take(control_path(state, "moving"), None) as loop:
        reached, failures = stop_arms(state, None)
        assert reached == ["moving"]
        assert [name for name in ("before", "unknown", "within") if name in str(failures)] == [
            "before",
            "unknown",
            "within",
        ]
        assert "use the emergency stop" in str(failures[0])
        assert loop.stop
        assert main(["stop", "--state", str(state)]) == 1
        assert "stopped: moving\n" in capsys.readouterr().err
        assert moving_arms(state) == ["before", "moving", "unknown", "within"]  # which may move
    assert not is_held(state, "unknown")
    assert stop_requested_ns(blocked) == 0  # a daemon asks that of every arm that waits
    with pytest.raises(DriverError, match="cannot be opened"):
        ask_arm(state, "unknown", "pause")
    blocked.rmdir()
    blocked.symlink_to(blocked)
    with pytest.raises(DriverError, match="Too many levels of symbolic links"):
        is_control_file_in_use(blocked)


def test_a_stop_that_comes_while_the_controls_are_taken_is_not_lost(tmp_path: Path) -> None:
    time, requested_ns, looks = Time(), 5_000_000_000, [0]
    ControlFile.take(loop_path(tmp_path), None, time).close()

    def now() -> int:
        looks[0] += 1
        read = time.now
        time.now += 1
        if looks[0] == 1:  # the clock has been read, and the controls are not written yet
            ControlFile.stop_motions(loop_path(tmp_path), time)
        return read

    with ControlFile.take(loop_path(tmp_path), None, now, requested_ns) as loop:
        assert loop.stop


RENEWER = """
import sys
from pathlib import Path
from ident_service.motion.command_channel import ControlFile
with ControlFile.reach(Path(sys.argv[1])) as controls:
    print("renewing", flush=True)
    while True:
        controls.renew()
"""


def test_a_lease_that_is_renewed_without_pause_never_looks_lapsed(tmp_path: Path) -> None:
    """A word that is written in parts shows a reader times of decades ago, or yet to come."""
    path = tmp_path / "control"
    with ControlFile.take(path, 60.0) as loop:
        command = [sys.executable, "-c", RENEWER, str(path)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2]) as parent:
            try:
                assert parent.stdout is not None
                assert parent.stdout.readline() == "renewing\n"
                lapsed = sum(not loop.lease_is_valid() for _ in range(100_000))
            finally:
                parent.kill()
    assert lapsed == 0
