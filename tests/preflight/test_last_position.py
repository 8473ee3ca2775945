"""Where an arm stood when it was closed, and an encoder that is whole turns off when it is opened again."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from canopen_run.canopen_run_bench import canopen, described, write

from drivers.canopen.driver import CanopenArm
from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm
from ident_service.errors import MotionRefused, UsageError
from ident_service.model.arm_model import arm_model
from ident_service.motion import last_position
from ident_service.motion.last_position import FILE, LastPosition, PositionFile, whole_turns_text
from ident_service.motion.ticket import Check, Verdict
from ident_service.operations.recovery import set_home
from ident_service.preflight.preflight import preflight
from sim_backend.emulator.faults import parse_fault
from sim_backend.emulator.lock_step import LockStepArm

WHEN = datetime(2026, 5, 4, 3, 2, tzinfo=UTC)


def planar(folder: Path, **driver: Any) -> ArmConfig:
    tree = canopen(described("planar_turns", 250.0, 225.0, 30.0), {"interface": "lock_step"}, 1, **driver)
    tree["transmission"] = {"ratios": [20.0, 20.0]}
    return load_arm(write(folder, tree))


@pytest.fixture
def config(tmp_path: Path) -> ArmConfig:
    return planar(tmp_path)


@pytest.fixture
def behind(config: ArmConfig, monkeypatch: pytest.MonkeyPatch) -> LockStepArm:
    # These drives outlive a session, as real ones do, though their time is virtual.
    monkeypatch.setattr(last_position, "is_new_every_time", lambda arm, config: False)
    return LockStepArm(config)


def opened_by(behind: LockStepArm, config: ArmConfig) -> CanopenArm:
    return CanopenArm(config, lambda _: [behind.link(0)])


def moved(config: ArmConfig, *motor_turns: float) -> str:
    """What is said of an arm of which each motor has turned so much."""
    gears = config.transmission
    assert gears is not None
    count = len(config.joints)
    coupling = np.eye(count) if gears.coupling is None else np.array(gears.coupling)
    turns = np.array([*motor_turns, *[0.0] * (count - len(motor_turns))])
    last = np.linspace(-0.5, 0.7, count)
    away = np.linalg.solve(np.diag(gears.ratios) @ coupling, 2.0 * np.pi * turns)
    return whole_turns_text(LastPosition(last, WHEN), last + away, config)


def test_whole_turns_of_a_motor_are_named_and_what_a_hand_does_is_not() -> None:
    wam = load_arm("wam7_canopen")
    said = moved(wam, 1.0)
    assert said.startswith(
        "motor 1 stands 1 whole turn from where it stood when the arm was closed at 2026-05-04 03:02"
    )
    assert "(j1 " in said
    said = moved(wam, 0.0, -2.02, 1.0)  # of the differential
    assert "motor 2 stands 2 whole turns" in said
    assert "motor 3 stands 1 whole turn " in said
    assert "(j2 " in said
    assert "j3 " in said
    for unmoved in ((), (0.02,), (0.5,), (1.1,), (1.0, 0.3), (0.2, 0.4, 3.0)):
        assert moved(wam, *unmoved) == ""


def test_an_arm_without_gears_has_no_turns() -> None:
    planar2 = load_arm("planar2")
    assert planar2.transmission is None
    assert whole_turns_text(LastPosition(np.zeros(2), WHEN), np.array([2.0 * np.pi, 0.0]), planar2) == ""


def test_the_position_is_kept_after_the_arm_was_closed_and_compared_when_it_is_opened(
    config: ArmConfig, behind: LockStepArm, tmp_path: Path
) -> None:
    kept = PositionFile(tmp_path, config)
    assert kept.read() is None
    kept.keep(opened_by(behind, config))
    last = kept.read()
    assert last is not None
    assert np.abs(last.position - behind.emulator.body.plant.position).max() < 1e-3
    with opened_by(behind, config) as arm:
        kept.require_no_lost_turns(arm)
        behind.inject(parse_fault(f"encoder_offset joint=elbow size={2.0 * np.pi / 20.0}", tuple(config.joints)))
        arm.exchange(None)
        with pytest.raises(MotionRefused, match=r"motor 2 stands 1 whole turn .*elbow [+]0[.]314.*Look at the arm"):
            kept.require_no_lost_turns(arm)
    kept.forget()
    assert kept.read() is None


def checks(behind: LockStepArm, config: ArmConfig, closed: LastPosition | None) -> dict[str, Check]:
    """What preflight says up to where it would hold the arm, which nobody confirms."""
    arm = opened_by(behind, config)
    ticket = preflight(arm, arm_model(config), None, idle_seconds=0.2, last_position=closed)
    return {check.code: check for check in ticket.checks}


@pytest.mark.slow
def test_preflight_refuses_an_arm_that_stands_whole_turns_elsewhere(
    config: ArmConfig, behind: LockStepArm, tmp_path: Path
) -> None:
    kept = PositionFile(tmp_path, config)
    kept.keep(opened_by(behind, config))
    closed = kept.read()
    assert closed is not None
    sound = checks(behind, config, closed)["at_rest"]
    assert sound.verdict is Verdict.PASSED
    assert [one.what for one in sound.measures].count("moved since it was closed last") == 2
    kept.keep(opened_by(behind, config))  # without power it sinks a little in every session
    closed = kept.read()
    assert closed is not None
    behind.inject(parse_fault(f"encoder_offset joint=shoulder size={-2.0 * np.pi / 20.0}", tuple(config.joints)))
    wrong = checks(behind, config, closed)
    assert wrong["at_rest"].verdict is Verdict.FAILED
    assert wrong["at_rest"].reason.startswith("motor 1 stands 1 whole turn ")
    assert "ident watch" in wrong["at_rest"].remedy
    assert wrong["gravity"].verdict is Verdict.SKIPPED  # nothing was energised
    # Led on by hand, as the remedy says, there is nothing to compare with.
    by_hand = LastPosition(closed.position + np.array([0.1, 0.0]), WHEN)
    assert checks(behind, config, by_hand)["at_rest"].verdict is Verdict.PASSED


def test_an_arm_that_moves_or_does_not_answer_leaves_no_position(
    config: ArmConfig, behind: LockStepArm, tmp_path: Path
) -> None:
    kept = PositionFile(tmp_path, config)
    kept.keep(opened_by(behind, config))
    assert (tmp_path / FILE).exists()
    arm = opened_by(behind, config)
    listening = 0.4  # s after which drives are asked for the first time, less than half a second later the last
    behind.inject(parse_fault(f"encoder_offset joint=elbow at={listening} size=0.2", tuple(config.joints)))
    kept.keep(arm)
    assert not (tmp_path / FILE).exists()
    behind.inject(parse_fault("bus_gone", tuple(config.joints)))
    kept.keep(opened_by(behind, config))
    assert kept.read() is None


def test_a_simulated_arm_is_new_every_time_and_keeps_none(tmp_path: Path) -> None:
    from ident_service.motion.arm_factory import make_arm

    config = load_arm("planar2")
    kept = PositionFile(tmp_path, config)
    kept.keep(make_arm(config))
    assert list(tmp_path.iterdir()) == []


def test_a_position_of_other_gears_is_none_and_a_damaged_file_is_stated(
    config: ArmConfig, behind: LockStepArm, tmp_path: Path
) -> None:
    kept = PositionFile(tmp_path, config)
    kept.keep(opened_by(behind, config))
    gears = config.model_dump(mode="json", by_alias=True)
    gears["transmission"]["ratios"][1] = 40.0
    assert PositionFile(tmp_path, ArmConfig.model_validate(gears)).read() is None
    document = json.loads((tmp_path / FILE).read_text())
    for text in ("{", json.dumps(document | {"position": [0.0]}), json.dumps(document | {"when": 3}), "[]"):
        (tmp_path / FILE).write_text(text)
        with pytest.raises(UsageError, match=f"{FILE}: cannot be read .* check the arm, then remove the file"):
            kept.read()


def test_a_new_zero_forgets_where_the_arm_stood(behind: LockStepArm, tmp_path: Path) -> None:
    config = planar(tmp_path, zero="at_home")
    folder = tmp_path / "arms" / config.name
    folder.mkdir(parents=True)
    (folder / FILE).write_text("{}")
    set_home(config, tmp_path, lambda question: config.name, opened_by(LockStepArm(config), config))
    assert not (folder / FILE).exists()
