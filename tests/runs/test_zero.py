"""`ident set-home`: a person says that the arm stands at its home; and what later steps make of it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from ident_service.cli import main
from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm, shipped_arms
from ident_service.errors import ConfigError, DriverError, MotionRefused, PositionUnknown, UsageError
from ident_service.model.arm_model import arm_model
from ident_service.motion.arm_factory import make_arm
from ident_service.motion.command_channel import ControlFile
from ident_service.motion.ticket import Ticket, Verdict, subject_of
from ident_service.operations.recovery import home_posture, recover, set_home
from ident_service.preflight.preflight import preflight
from ident_service.registry.state_folder import arm_fault_store, control_path, ticket_path
from sim_backend.emulator.faults import DriveFault
from sim_backend.emulator.lock_step import LockStepArm, hold_emulated_arm

HOME = np.array([0.3, -0.2])
GEARS = {"ratios": [20.0, -20.0], "coupling": [[1.0, -0.5], [1.0, 0.5]], "drive_terms": "joints"}
GAINS = {"kp": 225.0, "kd": 30.0, "following_error": 0.4}


def written(folder: Path, homes: tuple[float | None, ...] = (0.3, -0.2), **driver: Any) -> Path:
    planar = shipped_arms()["planar2"]
    truth = yaml.safe_load(planar.read_text())["driver"]["truth"]
    drive = {"counts": 65536, "rated_torque": 0.1, "max_torque": 3.0, "max_speed": 6000.0}
    section = {
        "kind": "canopen",
        "zero": "at_home",
        "eds": str(planar.parent / "emulated_drive.eds"),
        "buses": [{"interface": "lock_step"}],
        "drives": [drive | {"node": 1}, drive | {"node": 2}],
        "emulation": {"seed": 1, "truth": truth},
    }
    tree = {
        "extends": str(planar),
        "name": "drives2",
        "control": {"rate": 250, "velocity_cutoff": 30},
        "joints": {joint: GAINS | {"home": home} for joint, home in zip(("shoulder", "elbow"), homes, strict=True)},
        "transmission": GEARS,
        "driver": section | driver,
    }
    path = folder / "drives2.yaml"
    path.write_text(yaml.safe_dump(tree))
    return path


@pytest.fixture
def config(tmp_path: Path) -> ArmConfig:
    return load_arm(written(tmp_path))


@pytest.fixture
def behind(config: ArmConfig) -> Iterator[LockStepArm]:
    with hold_emulated_arm(config) as arm:
        arm.settle(arm.clock.now_ns() + 50_000_000)
        yield arm


@pytest.fixture
def state(tmp_path: Path) -> Path:
    return tmp_path / "state"


def sure(question: str) -> str:
    assert "drives2" in question
    return "drives2"


def lead(behind: LockStepArm, position: np.ndarray) -> None:
    behind.emulator.body.lead(position, behind.clock.now_ns())


def checked(config: ArmConfig) -> Ticket:
    return preflight(make_arm(config), arm_model(config), None, confirm=lambda question: config.name)


def test_a_person_who_says_so_makes_the_arm_usable(config: ArmConfig, behind: LockStepArm, state: Path) -> None:
    found = recover(config, state)
    assert not found.usable
    assert found.unreachable == ""
    assert "drives 1, 2 do not know where the arm stands" in found.zero_lost
    assert any("`ident set-home drives2`" in step for step in found.steps), found.steps
    assert not any("Check power" in step for step in found.steps), found.steps
    done = set_home(config, state, sure)
    assert [(one.joint, one.position, one.unit) for one in done.posture] == [
        ("shoulder", HOME[0], "rad"),
        ("elbow", HOME[1], "rad"),
    ]
    assert str(done.posture[0]) == "shoulder at 0.3 rad (17.2 degrees)"
    assert done.drives == ("node 1: switch on disabled", "node 2: switch on disabled")
    found = recover(config, state)
    assert found.usable, found.steps
    assert found.seen is not None
    np.testing.assert_allclose(found.seen.position, HOME, atol=1e-4)


@pytest.mark.slow
def test_a_zeroed_arm_passes_its_preflight_and_is_moved(config: ArmConfig, behind: LockStepArm, state: Path) -> None:
    set_home(config, state, sure)
    ticket = checked(config)
    assert ticket.verdict is Verdict.PASSED, [check.reason for check in ticket.checks]
    with make_arm(config) as arm:
        np.testing.assert_allclose(arm.exchange(None).position, behind.emulator.body.plant.position, atol=1e-4)


@pytest.mark.slow
def test_a_ticket_dies_with_the_zero_that_it_was_made_for(config: ArmConfig, behind: LockStepArm, state: Path) -> None:
    assert not set_home(config, state, sure).ticket_removed
    ticket = checked(config)
    path = ticket_path(state, config.name)
    path.write_text(ticket.to_json())
    lead(behind, HOME + 0.01)
    assert set_home(config, state, sure).ticket_removed
    assert not path.exists()
    with make_arm(config) as arm:  # where the file of another state folder was left
        why = ticket.objections_to(subject_of(arm_model(config), None, arm.describe()), ticket.created)
    assert any("not those that were checked" in reason for reason in why), why


@pytest.mark.slow
def test_no_ticket_outlives_a_zeroing_that_is_cut_short(
    config: ArmConfig, behind: LockStepArm, state: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Switched off and on, drives count from 0 again, so that a ticket cannot tell one zero from the other."""
    set_home(config, state, sure)
    ticket = checked(config)
    path = ticket_path(state, config.name)
    path.write_text(ticket.to_json())
    arm = make_arm(config)
    zero = arm.zero

    def cut_short() -> tuple[str, ...]:
        zero()
        raise KeyboardInterrupt

    monkeypatch.setattr(arm, "zero", cut_short)
    with pytest.raises(KeyboardInterrupt):
        set_home(config, state, sure, arm)
    assert not path.exists()


def test_nothing_changes_when_nobody_says_so(config: ArmConfig, behind: LockStepArm, state: Path) -> None:
    for typed in ("", "yes", "pucks"):
        with pytest.raises(MotionRefused, match="nothing has changed"):
            set_home(config, state, lambda question, typed=typed: typed)
    with (
        ControlFile.take(control_path(state, config.name), None),
        pytest.raises(DriverError, match="in use by process"),
    ):
        set_home(config, state, lambda question: pytest.fail("asked while a process moves the arm"))
    with pytest.raises(PositionUnknown):
        make_arm(config).open()


def test_latched_faults_are_stated(config: ArmConfig, behind: LockStepArm, state: Path) -> None:
    set_home(config, state, sure)
    arm_fault_store(state, config.name).latch("drive_restarted", "node 2: has booted")
    behind.inject(DriveFault("reboot", 1))
    behind.settle(behind.clock.now_ns() + 100_000_000)
    found = recover(config, state)
    assert "drives 2 do not know" in found.zero_lost
    acknowledged = next(
        k for k, step in enumerate(found.steps) if "`ident acknowledge drives2 drive_restarted`" in step
    )
    zeroed = next(k for k, step in enumerate(found.steps) if "`ident set-home" in step)
    assert acknowledged < zeroed < len(found.steps) - 1
    done = set_home(config, state, sure)
    assert [fault.code for fault in done.faults] == ["drive_restarted"]
    assert not recover(config, state).usable
    arm_fault_store(state, config.name).acknowledge("drive_restarted")
    assert recover(config, state).usable


def test_the_command_moves_nothing_and_says_the_posture(
    tmp_path: Path, state: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path)
    words = ["home", str(path), "--zero", "--state", str(state)]
    assert main([*words, "--confirm", "drives2"]) == 0
    said = capsys.readouterr().out
    assert "nothing will move" in said
    assert "elbow at -0.2 rad (-11.5 degrees)" in said
    assert main([*words, "--json", "--confirm", "drives2"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["posture"][1] == {"joint": "elbow", "position": -0.2, "unit": "rad"}
    assert document["faults"] == []
    for more in ((), ("--json",), ("--confirm", "pucks")):
        assert main([*words, *more]) == 3
    assert main([*words, "--out", str(tmp_path / "run")]) == 2
    assert main(["home", str(path), "--confirm", "drives2", "--state", str(state)]) == 2
    shutil.rmtree(state)
    assert main(["home", "planar2", "--zero", "--confirm", "planar2", "--state", str(state)]) == 2
    assert "needs no home" in capsys.readouterr().err


def test_encoders_that_know_their_position_are_not_zeroed(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="zero: at_home"):
        home_posture(load_arm(written(tmp_path, zero="absolute")))


def test_a_description_without_a_home_is_refused_with_its_place(tmp_path: Path) -> None:
    path = written(tmp_path, (0.3, None))
    with pytest.raises(ConfigError, match=r"driver.zero: at_home needs every joint's home.*joints.elbow.home") as wrong:
        load_arm(path)
    assert "shoulder.home" not in str(wrong.value)
