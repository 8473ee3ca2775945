"""One process at a time has an arm: whoever checks it moves it too, and whoever looks says who has it."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
import pytest
from cli.conftest import COARSE, Ident, quick_arm
from helpers.tickets import write_checked_ticket

from drivers.arm import Arm
from ident_service.config.load import load_arm
from ident_service.errors import DriverError
from ident_service.motion.arm_factory import make_arm
from ident_service.motion.command_channel import ControlFile, Homing, InterruptibleArm
from ident_service.registry.state_folder import arm_fault_store, control_path


@pytest.mark.parametrize("verb", ["check", "watch"])
def test_an_arm_that_moves_is_neither_checked_nor_watched(ident: Ident, state: Path, verb: str) -> None:
    with ControlFile.take(control_path(state, "planar2"), None) as mover:
        ended = ident(verb, "planar2", "--json")
        assert ended.code == 1
        assert f"process {mover.pid}" in ended.json["error"]["message"]
    assert not (state / "arms" / "planar2" / "ticket.json").exists()


@pytest.mark.parametrize("verb", ["check", "watch"])
def test_an_arm_of_which_nobody_can_tell_whether_it_moves_is_not_opened(ident: Ident, state: Path, verb: str) -> None:
    path = control_path(state, "planar2")
    path.parent.mkdir(parents=True, mode=0o700)
    state.chmod(0o700)
    path.symlink_to(path)
    ended = ident(verb, "planar2", "--json")
    assert ended.code == 1
    assert "it cannot be told whether the arm moves" in ended.json["error"]["message"]


@pytest.mark.slow
def test_a_run_of_an_arm_that_another_process_has_leaves_no_folder(ident: Ident, state: Path, tmp_path: Path) -> None:
    arm = quick_arm(tmp_path, *COARSE)
    state.mkdir(mode=0o700)
    write_checked_ticket(load_arm(arm), state)
    with ControlFile.take(control_path(state, "planar2"), None) as mover:
        pid, ended = mover.pid, ident("run", arm)
    assert ended.code == 1
    assert f"in use by process {pid}" in ended.err
    assert "recording" not in ended.err
    assert not (state / "runs").exists() or not list((state / "runs").iterdir())


def test_what_lets_go_of_an_arm_that_is_held_is_named(ident: Ident, state: Path) -> None:
    """A process may outlive whoever began the motion, and hold the arm: another stop changes nothing then."""
    with ControlFile.take(control_path(state, "planar2"), None):
        assert "`ident supported` lets go of one that is held" in ident("preflight", "planar2").err
        assert "`ident supported planar2`, if it is held" in ident("recover", "planar2").out


@pytest.mark.slow
def test_an_arm_whose_description_is_a_daemons_is_stopped_by_its_name(ident: Ident, state: Path) -> None:
    assert ident("stop", "uploaded").code == 2
    assert not (state / "arms" / "uploaded").exists()
    with ControlFile.take(control_path(state, "uploaded"), None) as mover:
        for word in ("pause", "finish", "stop"):
            assert ident(word, "uploaded").code == 0
        assert (mover.stop, mover.finish) == (True, True)
    # Nobody moves it any more: what was wanted is so, as for `ident stop` of all.
    again = ident("stop", "uploaded", "--json")
    assert (again.code, again.json["pid"]) == (0, None)
    assert "uploaded is not moving" in ident("stop", "uploaded").out
    arm_fault_store(state, "uploaded").latch("lease_lost", "nobody was there")
    assert ident("ack", "uploaded", "lease_lost").code == 0
    assert ident("stop", "../uploaded").code == 2


def test_that_an_arm_is_supported_takes_its_typed_name(ident: Ident, state: Path) -> None:
    with ControlFile.take(control_path(state, "planar2"), None) as holder:
        holder.announce_hold()
        for words in ((), ("--confirm", "planar"), ("--json",)):
            ended = ident("supported", "planar2", *words)
            assert (ended.code, holder.supported) == (2, False)
        assert "by its name: --confirm planar2" in ended.out + ended.err
        assert ident("supported", "planar2", "--confirm", "planar2").code == 0
        assert holder.supported


def test_drives_that_hold_an_arm_are_not_released_without_its_name(
    ident: Ident, monkeypatch: pytest.MonkeyPatch
) -> None:
    let_go: list[str] = []
    monkeypatch.setattr(
        "ident_service.operations.recovery.release_held_drives", lambda config, _: let_go.append(config.name) or ("j1",)
    )
    assert ident("supported", "planar2").code == 2
    assert let_go == []
    assert ident("supported", "planar2", "--confirm", "planar2").code == 0
    assert let_go == ["planar2"]


@pytest.mark.parametrize(("answer", "code"), [(Homing.ENDED, 0), (Homing.REFUSED, 1)])
def test_home_leads_an_arm_that_another_process_holds(ident: Ident, state: Path, answer: Homing, code: int) -> None:
    with ControlFile.take(control_path(state, "planar2"), None) as holder:
        holder.announce_hold()
        holder.request_stop()
        stops = []

        def hold() -> None:
            while holder.homing is not Homing.ASKED:
                time.sleep(0.01)
            stops.append(holder.stop)
            holder.tell_homing(answer)

        loop = threading.Thread(target=hold, daemon=True)
        loop.start()
        ended = ident("home", "planar2", "--json")
        loop.join(10.0)
        assert ended.code == code
        assert ended.json["ended"] == answer.name.lower()
        assert stops == [False]


@pytest.mark.campaign
@pytest.mark.slow
def test_a_check_comes_after_the_faults(ident: Ident, state: Path) -> None:
    arm_fault_store(state, "planar2").latch("lease_lost", "nobody was there")
    ended = ident("check", "planar2", "--confirm", "planar2")
    assert ended.code == 3
    assert "`ident acknowledge planar2 lease_lost`" in ended.err
    assert ident("ack", "planar2", "lease_lost").code == 0
    assert ident("check", "planar2", "--confirm", "planar2").code == 0


def test_a_state_folder_that_cannot_be_is_refused_before_anything_moves(
    ident: Ident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    monkeypatch.setenv("IDENT_STATE", str(tmp_path / "file" / "below"))
    ended = ident("check", "planar2", "--confirm", "planar2")
    assert ended.code == 2
    assert "cannot be" in ended.err


def test_a_stop_ends_a_preflight(state: Path) -> None:
    asked: list[bool] = []
    arm: Arm = InterruptibleArm(make_arm(load_arm("planar2")), lambda: bool(asked))
    with arm:
        arm.enable()
        arm.exchange(np.zeros(2))
        asked.append(True)
        arm.exchange(None)
        with pytest.raises(DriverError, match="a stop was requested"):
            arm.exchange(np.zeros(2))
