"""Drives to which it is a fault that their host leaves or falls silent: checked, moved, moved again, and recovered."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from canopen_run_bench import CONFIGS, SHORT, canopen, described, write
from helpers.makers import SHEETS
from motion.motion_bench import Story

from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm
from ident_service.errors import ArmFault
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import arm_model
from ident_service.motion.arm_factory import make_arm
from ident_service.motion.faults import ActiveFaults
from ident_service.motion.run import run
from ident_service.motion.state_machine import State
from ident_service.motion.ticket import Verdict
from ident_service.operations.recovery import recover
from ident_service.preflight.preflight import preflight
from sim_backend.canopen_device.drive import CanopenDrive
from sim_backend.emulator.faults import DriveFault
from sim_backend.emulator.lock_step import LockStepArm, hold_emulated_arm

LEFT = ["pre operational, switch on disabled"] * 2


def arm_of(folder: Path, eds: Path, rate: float, watchdog: str, **driver: Any) -> ArmConfig:
    """The small arm behind two drives of this file, with another watchdog than for torque frames."""
    tree = canopen(described("left", rate, 225.0, 30.0), {"interface": "lock_step"}, 2)
    tree["motions"] = {"identification": SHORT, "validation": SHORT}
    section = tree["driver"] | {"eds": str(eds), "torque_frames": "single", "measured_torque": "none"} | driver
    section["drives"] = [one | {"rated_torque": 1.2, "max_torque": 1.2} for one in section["drives"]]
    section["drives"] = [one | {"watchdog": watchdog} for one in section["drives"]]
    section["emulation"]["eds"] = [str(eds)]
    return load_arm(write(folder, tree | {"driver": section}))


def without(folder: Path, *indices: str) -> Path:
    """The emulated drive's file without some entries; where `fixed` is one of them, nobody can change its 6007h."""
    text = (CONFIGS / "emulated_drive.eds").read_text(encoding="utf-8")
    if "fixed" in indices:
        text = re.sub(r"(?ms)(^\[6007\].*?)AccessType=rw", r"\1AccessType=ro", text)
    path = folder / f"without_{'_'.join(indices)}.eds"
    path.write_text(re.sub(rf"(?ms)^\[({'|'.join(indices)})\].*?(?=^\[)", "", text), encoding="utf-8")
    return path


HEARTBEATS = {"heartbeats": {"period": 0.02, "timeout": 0.11, "host_timeout": 0.06}}
FAULT = {"reactions": {"abort_connection": 1}}
ANONYMOUS = pytest.mark.skipif(not SHEETS.is_dir(), reason="the makers' data sheets are not beside this checkout")
KINDS = [
    pytest.param(("e35.eds", 125.0, "node_guarding", {"guarding": {"period": 0.03, "factor": 3}}), marks=ANONYMOUS),
    pytest.param(("e35.eds", 250.0, "node_guarding", {"guarding": {"period": 0.1, "factor": 10}}), marks=ANONYMOUS),
    # None holds emergencies back (1015h), whose reason would come too late for preflight.
    pytest.param(("6007 1015", 250.0, "heartbeat", HEARTBEATS), id="heartbeat"),
    pytest.param(("1015 fixed", 250.0, "heartbeat", HEARTBEATS | FAULT), id="fixed"),
    # One that is told so: only the silence of preflight's own test leaves a fault behind.
    pytest.param(("1015", 250.0, "heartbeat", HEARTBEATS | FAULT), id="reaction"),
]


@pytest.fixture(params=KINDS)
def config(request: pytest.FixtureRequest, tmp_path: Path) -> ArmConfig:
    name, rate, watchdog, driver = request.param
    eds = SHEETS / name if name.endswith("eds") else without(tmp_path, *name.split())
    return arm_of(tmp_path, eds, rate, watchdog, **driver)


@pytest.fixture
def behind(config: ArmConfig) -> Iterator[LockStepArm]:
    with hold_emulated_arm(config) as arm:
        yield arm


def moved(config: ArmConfig, latch: ActiveFaults) -> State:
    model = arm_model(config)
    with make_arm(config) as arm:
        state = run(
            arm, model, excitation(model, "identification"), Story(), active_faults=latch, hold_seconds=0.1
        ).state
    assert arm.unconfirmed() == ()
    return state


def test_an_arm_is_checked_moved_and_moved_again(config: ArmConfig, behind: LockStepArm) -> None:
    model = arm_model(config)
    motion = excitation(model, "identification")
    told = preflight(make_arm(config), model, motion, confirm=lambda question: config.name, idle_seconds=0.2)
    assert told.verdict is Verdict.PASSED, [one.reason for one in told.checks if one.reason]
    assert list(behind.emulator.states) == LEFT
    for _ in range(2):
        assert moved(config, ActiveFaults()) is State.DONE
        behind.settle(behind.clock.now_ns() + 2 * 10**9)
        assert list(behind.emulator.states) == LEFT


def test_a_fault_stops_a_run_by_its_name_and_recover_ends_it(
    config: ArmConfig, behind: LockStepArm, tmp_path: Path
) -> None:
    with make_arm(config) as arm:
        arm.enable()
        behind.inject(DriveFault("emergency", 0, size=0x4310))
        for _ in range(20):
            arm.exchange(None)
    assert behind.emulator.states[0].startswith("pre operational, fault")
    latch = ActiveFaults()
    with pytest.raises(ArmFault, match=r"is in the state fault.*only a reset clears it") as ended:
        moved(config, latch)
    assert ended.value.code == "drive_fault"
    assert [one.code for one in latch.faults] == ["drive_fault"]
    found = recover(config, tmp_path / "state")
    assert found.usable, found.steps
    assert list(behind.emulator.states) == LEFT
    assert recover(config, tmp_path / "state").reset == ()


@pytest.mark.parametrize("config", KINDS[2:3], indirect=True)
def test_one_that_stays_in_the_fault_is_named_when_its_arm_is_closed(config: ArmConfig, behind: LockStepArm) -> None:
    face = behind.emulator.faces[1]
    assert isinstance(face, CanopenDrive)
    face.power.reset_fault = lambda: None  # type: ignore[method-assign]
    with make_arm(config) as arm:
        left_ns = behind.clock.now_ns()
    assert behind.clock.now_ns() - left_ns < 10**9
    (words,) = arm.unconfirmed()
    assert words.endswith("drive 2: is in the state fault since it was left")


@pytest.mark.parametrize("config", KINDS[2:3], indirect=True)
def test_a_fault_of_its_own_that_comes_with_the_farewell_is_not_reset_away(
    config: ArmConfig, behind: LockStepArm
) -> None:
    face = behind.emulator.faces[0]
    assert isinstance(face, CanopenDrive)
    tripped = face.power.trip

    def trips(*, coasting: bool = False) -> None:
        face.emergency.add_error(0x4310)
        tripped(coasting=coasting)

    face.power.trip = trips  # type: ignore[method-assign]
    with make_arm(config) as arm:
        pass
    (words,) = arm.unconfirmed()
    assert words.endswith("drive 1: is in the state fault since it was left")
    assert behind.emulator.states[0].endswith("fault, error 0x4310")
