"""`ident recover` with emulated CANopen drives: it looks without a command, and resets what is latched."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml

from drivers.arm import StopKind
from drivers.axis_status import TRIPPED
from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm, shipped_arms
from ident_service.errors import UsageError
from ident_service.motion.arm_factory import make_arm
from ident_service.operations.recovery import recover, release_held_drives
from ident_service.registry.state_folder import arm_fault_store
from sim_backend.emulator.faults import DriveFault
from sim_backend.emulator.lock_step import LockStepArm, hold_emulated_arm


@pytest.fixture
def config(tmp_path: Path) -> ArmConfig:
    drive = {"rated_torque": 1.0, "max_torque": 10.0, "max_speed": 3000.0}
    tree = {
        "extends": str(shipped_arms()["planar2"]),
        "name": "drives2",
        "gravity": [0.0, 0.0, -9.81],
        "transmission": {"ratios": [40.0, 20.0], "drive_terms": "joints"},
        "driver": {
            "kind": "canopen",
            "eds": str(shipped_arms()["planar2"].parent / "emulated_drive.eds"),
            "buses": [{"interface": "lock_step"}],
            "drives": [drive | {"node": 1}, drive | {"node": 2}],
        },
    }
    path = tmp_path / "drives2.yaml"
    path.write_text(yaml.safe_dump(tree))
    return load_arm(path)


@pytest.fixture
def behind(config: ArmConfig) -> Iterator[LockStepArm]:
    with hold_emulated_arm(config) as arm:
        yield arm


@pytest.fixture
def state(tmp_path: Path) -> Path:
    return tmp_path / "state"


def states(behind: LockStepArm) -> list[str]:
    return [face.state for face in behind.emulator.faces]


def session(config: ArmConfig, behind: LockStepArm, *faults: DriveFault) -> None:
    """An arm that was enabled, had these faults, and was stopped."""
    with make_arm(config) as arm:
        arm.enable()
        behind.inject(*faults)
        for _ in range(50):
            arm.exchange(np.zeros(2))
        arm.stop(StopKind.QUICK_STOP)
    behind.settle(behind.clock.now_ns() + 10**9)


def test_after_an_ordinary_session_nothing_is_in_the_way(config: ArmConfig, behind: LockStepArm, state: Path) -> None:
    session(config, behind)
    found = recover(config, state)
    assert found.usable, found.steps
    assert found.reset == ()
    assert found.seen is not None
    assert all("switch on disabled, pre-operational" in words for words in found.seen.drives)


def test_a_latched_drive_fault_is_reset_when_it_is_acknowledged(
    config: ArmConfig, behind: LockStepArm, state: Path
) -> None:
    session(config, behind, DriveFault("emergency", 1, size=0x4310))
    assert "fault, error 0x4310" in states(behind)[1]
    faults = arm_fault_store(state, config.name)
    faults.latch("drive_fault", "elbow: the drive reports a fault")
    found = recover(config, state)
    assert not found.usable
    assert found.tripped == {"elbow": "fault"}
    assert found.seen is not None
    assert "4310h drive too hot" in found.seen.drives[1]
    assert "fault, error 0x4310" in states(behind)[1]  # looked at, not touched
    faults.acknowledge("drive_fault")
    found = recover(config, state)
    assert found.reset == ("elbow",)
    assert found.usable, found.steps
    assert states(behind) == ["pre operational, switch on disabled"] * 2


@pytest.mark.slow
def test_a_cause_that_lasts_is_not_reset_away(config: ArmConfig, behind: LockStepArm, state: Path) -> None:
    session(config, behind, DriveFault("drive_fault", 1))
    found = recover(config, state)
    assert not found.usable
    assert found.tripped == {"elbow": "fault"}
    assert any("the cause is still there" in step for step in found.steps), found.steps


def test_drives_whose_host_died_are_usable_again(config: ArmConfig, behind: LockStepArm, state: Path) -> None:
    arm = make_arm(config)
    arm.open()
    arm.enable()
    for _ in range(20):
        arm.exchange(np.zeros(2))
    behind.leave(0)  # as a kill does: no word to the drives
    behind.settle(behind.clock.now_ns() + 10**9)
    assert all("error 0x8130" in words for words in states(behind))
    found = recover(config, state)
    assert found.reset == ("shoulder", "elbow")
    assert found.usable, found.steps
    assert found.seen is not None
    assert not any(word & TRIPPED for word in found.seen.status)
    assert states(behind) == ["pre operational, switch on disabled"] * 2


def test_drives_that_hold_the_arm_let_it_go_when_a_person_says_so(config: ArmConfig, state: Path) -> None:
    config = config.model_copy(update={"control": config.control.model_copy(update={"after_stop": "hold"})})
    with hold_emulated_arm(config) as behind:
        with pytest.raises(UsageError, match="its drives do not hold it"):
            release_held_drives(config, state)
        session(config, behind)
        assert all("quick stop active" in words for words in states(behind))
        found = recover(config, state)
        assert found.steps[0].startswith(f"Support the arm, then `ident supported {config.name}`")
        assert all("quick stop active" in words for words in states(behind))  # looked at, not touched
        assert release_held_drives(config, state) == tuple(config.joints)
        assert all("switch on disabled" in words for words in states(behind))
        assert recover(config, state).usable
