"""One process at a time has an arm: whoever checks it moves it too, and whoever looks says who has it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cli.conftest import Ident

from drivers.arm import Arm
from ident_service.config.load import load_arm
from ident_service.errors import DriverError
from ident_service.motion.control_file import ControlFile
from ident_service.motion.factory import make_arm
from ident_service.motion.stoppable import StoppableArm
from ident_service.service.arm_state import control_path, fault_file


@pytest.mark.parametrize("verb", ["check", "watch"])
def test_an_arm_that_moves_is_neither_checked_nor_watched(ident: Ident, state: Path, verb: str) -> None:
    with ControlFile.take(control_path(state, "planar2"), None) as mover:
        ended = ident(verb, "planar2", "--json")
        assert ended.code == 1
        assert f"process {mover.pid}" in ended.json["error"]["message"]
    assert not (state / "arms" / "planar2" / "ticket.json").exists()


@pytest.mark.slow
def test_an_arm_whose_description_is_a_daemons_is_stopped_by_its_name(ident: Ident, state: Path) -> None:
    assert ident("stop", "uploaded").code == 2
    assert not (state / "arms" / "uploaded").exists()
    with ControlFile.take(control_path(state, "uploaded"), None) as mover:
        for word in ("pause", "finish", "stop"):
            assert ident(word, "uploaded").code == 0
        assert (mover.stop, mover.finish) == (True, True)
    fault_file(state, "uploaded").latch("lease_lost", "nobody was there")
    assert ident("ack", "uploaded", "lease_lost").code == 0
    assert ident("stop", "../uploaded").code == 2


@pytest.mark.slow
def test_a_check_comes_after_the_faults(ident: Ident, state: Path) -> None:
    fault_file(state, "planar2").latch("lease_lost", "nobody was there")
    ended = ident("check", "planar2", "--confirm", "planar2")
    assert ended.code == 3
    assert "`ident ack planar2 lease_lost`" in ended.err
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
    arm: Arm = StoppableArm(make_arm(load_arm("planar2")), lambda: bool(asked))
    with arm:
        arm.enable()
        arm.exchange(np.zeros(2))
        asked.append(True)
        arm.exchange(None)
        with pytest.raises(DriverError, match="somebody asked for a stop"):
            arm.exchange(np.zeros(2))
