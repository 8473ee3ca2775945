"""`ident recover` and `ident home`: what stands in the way, who may be reset when, and that nothing is energised."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.arm import Arm, ArmDescription, Sample, StopKind
from drivers.axis_status import TRIPPED, AxisStatus
from ident_service.cli import main
from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm, shipped_arms
from ident_service.errors import ActionNeeded, DriverError
from ident_service.motion.arm_factory import make_arm
from ident_service.motion.command_channel import ControlFile
from ident_service.operations.recovery import Recovery, _support, recover
from ident_service.registry.state_folder import arm_fault_store, control_path
from sim_backend.arm import from_config
from sim_backend.faults import Fault, FaultKind

LEVEL = "gravity: [0, 0, -9.81]\n"  # along the axes, so that nothing falls without torque


class LookedAt(Arm):
    """An arm that fails a test which energises it or sends a torque, and counts resets."""

    def __init__(self, inner: Arm) -> None:
        self.inner = inner
        self.clock = inner.clock
        self.resets = 0
        self.shown: Callable[[Sample], Sample] = lambda sample: sample

    def open(self) -> None:
        self.inner.open()

    def describe(self) -> ArmDescription:
        return self.inner.describe()

    def enable(self) -> None:
        pytest.fail("recovering energised the arm")

    def reset(self) -> None:
        self.resets += 1
        self.inner.reset()

    def exchange(self, torque: Any) -> Sample:
        assert torque is None
        return self.inner.exchange(None)

    def stop(self, kind: StopKind) -> None:
        self.inner.stop(kind)

    def close(self) -> None:
        self.inner.close()


def config_with(folder: Path, driver: str = "{}", more: str = "") -> ArmConfig:
    path = folder / "arm.yaml"
    path.write_text(f"extends: {shipped_arms()['planar2']}\ndriver: {driver}\n{more}")
    return load_arm(path)


def broken(config: ArmConfig) -> LookedAt:
    """The arm after its elbow's drive had a fault, left as a run leaves it."""
    arm = from_config(config, faults=[Fault(5, FaultKind.DRIVE_FAULT, 1)])
    with arm:
        arm.enable()
        for _ in range(20):
            arm.exchange(np.zeros(2))
        arm.stop(StopKind.QUICK_STOP)
    arm.faults = ()  # the cause is mended
    return LookedAt(arm)


def status(arm: LookedAt) -> tuple[int, ...]:
    with arm.inner:
        return arm.inner.exchange(None).status


@pytest.fixture
def state(tmp_path: Path) -> Path:
    return tmp_path / "state"


def numbered(found: Recovery, *words: str) -> None:
    """Each step contains its words, in this order, and there are no others."""
    assert len(found.steps) == len(words), found.steps
    for step, word in zip(found.steps, words, strict=True):
        assert word in step, found.steps


def test_a_healthy_arm_at_home_only_needs_a_check(tmp_path: Path, state: Path) -> None:
    config = config_with(tmp_path)
    found = recover(config, state, LookedAt(make_arm(config)))
    assert found.usable
    numbered(found, "`ident preflight planar2` for the next motion")
    assert found.seen is not None


def test_drives_are_reset_only_after_every_fault_is_acknowledged(tmp_path: Path, state: Path) -> None:
    config = config_with(tmp_path, more=LEVEL)
    arm, faults = broken(config), arm_fault_store(state, config.name)
    faults.latch("drive_fault", "elbow: the drive reports a fault")
    faults.latch("lease_lost", "the lease was not renewed in time")
    found = recover(config, state, arm)
    assert not found.usable
    assert found.tripped == {"elbow": "fault"}
    assert "Support the arm" in found.steps[0]
    assert "`ident acknowledge planar2 drive_fault`" in found.steps[1]
    assert "`ident acknowledge planar2 lease_lost`" in found.steps[2]
    assert "`ident recover planar2` again" in found.steps[3]
    faults.acknowledge("drive_fault")
    assert not recover(config, state, arm).usable
    assert arm.resets == 0
    assert status(arm)[1] & AxisStatus.FAULT
    faults.acknowledge("lease_lost")
    found = recover(config, state, arm)
    assert arm.resets == 1
    assert found.reset == ("elbow",)
    assert found.usable, found.steps
    assert not any(word & TRIPPED for word in status(arm))
    assert not any(word & AxisStatus.POWERED for word in status(arm))


def test_a_cause_that_lasts_is_not_reset_away(tmp_path: Path, state: Path) -> None:
    config = config_with(tmp_path, "{faults: [{kind: emergency_stop, cycle: 0}]}")
    arm = LookedAt(make_arm(config))
    found = recover(config, state, arm)
    assert not found.usable
    assert found.tripped == {"shoulder": "emergency stop", "elbow": "emergency stop"}
    assert found.reset == ()
    numbered(found, "Support", "Release the emergency stop", "again", "`ident preflight planar2`")


@pytest.mark.parametrize(
    ("refusal", "step"),
    [
        (ActionNeeded("the cabinet is locked: unlock it"), "The cabinet is locked: unlock it."),
        (DriverError("the brake's press is worn"), "Read the drive's own fault code and mend its cause: the brake's"),
    ],
)
def test_what_a_person_has_to_do_is_a_step_as_the_driver_says_it(
    refusal: DriverError, step: str, tmp_path: Path, state: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: LookedAt) -> None:
        raise refusal

    config = config_with(tmp_path, more=LEVEL)
    arm = broken(config)
    monkeypatch.setattr(LookedAt, "reset", refuse)
    found = recover(config, state, arm)
    assert any(words.startswith(step) for words in found.steps), found.steps


def test_a_tripped_watchdog_is_reset(tmp_path: Path, state: Path) -> None:
    config = config_with(tmp_path, more=LEVEL)
    inner = make_arm(config)
    with inner:
        inner.enable()
        for _ in range(5):
            inner.exchange(np.zeros(2))
        for _ in range(20):
            inner.exchange(None)
    arm = LookedAt(inner)
    assert all(word & AxisStatus.WATCHDOG for word in status(arm))
    assert recover(config, state, arm).reset == ("shoulder", "elbow")


def test_an_arm_that_somebody_moves_is_not_even_looked_at(
    tmp_path: Path, state: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = config_with(tmp_path)
    with ControlFile.take(control_path(state, config.name), None):
        assert main(["recover", str(tmp_path / "arm.yaml"), "--state", str(state), "--json"]) == 3
    document = json.loads(capsys.readouterr().out)
    assert document["moved_by"] == os.getpid()
    assert document["seen"] is None
    assert document["steps"][0].startswith(f"`ident stop {tmp_path / 'arm.yaml'}`")  # as it can be typed


@pytest.mark.parametrize(("out", "word"), [(0.15, "--leave-limit"), (0.25, "its zero may be wrong")])
def test_outside_the_limits_the_return_depends_on_how_far(tmp_path: Path, state: Path, out: float, word: str) -> None:
    config = config_with(tmp_path)
    joints = dict(config.joints)
    joints["shoulder"] = joints["shoulder"].model_copy(update={"position": (-3.0, 3.0), "home": 1.8 + out})
    found = recover(config, state, LookedAt(make_arm(config.model_copy(update={"joints": joints}))))
    assert not found.usable
    assert len(found.outside) == 1
    assert found.outside[0].startswith("shoulder at ")
    numbered(found, "Support", word, "`ident home planar2`")


def test_an_arm_that_does_not_answer_is_reported(tmp_path: Path, state: Path) -> None:
    config = config_with(tmp_path)
    arm = make_arm(config)
    with arm:
        found = recover(config, state, LookedAt(arm))
    assert "already open" in found.unreachable
    assert not found.usable
    numbered(found, "Support", "Check power", "again", "`ident home")


def test_a_fault_keeps_its_first_cause_and_time(state: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    faults = arm_fault_store(state, "arm")
    for now, code, cause in ((1000.0, "one", "first"), (2000.0, "two", "second"), (3000.0, "one", "again")):
        monkeypatch.setattr("time.time", lambda now=now: now)
        faults.latch(code, cause)
    assert [(one.code, one.cause, one.since) for one in faults.remembered()] == [
        ("one", "first", 1000.0),
        ("two", "second", 2000.0),
    ]
    faults.acknowledge("one")
    assert [one.since for one in faults.remembered()] == [2000.0]


def test_out_is_for_what_moves(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config_with(tmp_path)
    assert main(["recover", str(tmp_path / "arm.yaml"), "--out", str(tmp_path / "run")]) == 2
    assert "--leave-limit" in capsys.readouterr().err


@pytest.fixture
def ident(tmp_path: Path, state: Path, capsys: pytest.CaptureFixture[str]) -> Iterator[Callable[..., tuple[int, str]]]:
    """The command on a planar arm that is no longer at home by the time it is asked."""
    config_with(tmp_path)

    def run(*words: str) -> tuple[int, str]:
        capsys.readouterr()
        code = main([words[0], str(tmp_path / "arm.yaml"), *words[1:], "--state", str(state)])
        captured = capsys.readouterr()
        return code, captured.out + captured.err

    return run


@pytest.mark.slow
def test_home_keeps_the_rules_of_a_run(ident: Callable[..., tuple[int, str]], tmp_path: Path, state: Path) -> None:
    code, said = ident("home")
    assert code == 3
    assert "no preflight ticket" in said
    assert "keep out of its reach" not in said  # nothing is going to move
    assert ident("check", "--home")[0] == 3
    code, said = ident("home")
    assert code == 3
    assert "as nobody typed the arm's name: gravity, direction, watchdog" in said
    assert "keep out of its reach" not in said
    assert ident("check", "--home", "--confirm", "planar2")[0] == 0
    # A ticket for the path home is none for a motion.
    code, said = ident("run", "--out", str(tmp_path / "run"))
    assert code == 3
    assert "it is for the path home, not for a motion" in said
    code, said = ident("home", "--out", str(tmp_path / "home"))
    assert code == 0
    assert said.index("keep out of its reach") < said.index("armed")
    names = sorted(path.name for path in (tmp_path / "home").iterdir())
    assert names == ["arm.json", "ended.json", "manifest.json", "run.mcap", "ticket.json"]
    assert json.loads((tmp_path / "home" / "ended.json").read_text())["state"] == "done"
    code, said = ident("recover", "--leave-limit", "--out", str(tmp_path / "inside"))
    assert code == 3
    assert "nothing to leave" in said
    arm_fault_store(state, "planar2").latch("following_error", "something pushed")
    code, said = ident("home", "--out", str(tmp_path / "again"))
    assert code == 3
    assert "following_error (something pushed)" in said
    assert not (tmp_path / "again").exists()


@pytest.mark.campaign
@pytest.mark.slow
def test_a_motions_ticket_is_one_for_the_path_home(ident: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    assert ident("check", "--confirm", "planar2")[0] == 0
    assert ident("home", "--out", str(tmp_path / "home"))[0] == 0


def test_a_check_is_for_a_motion_or_for_home(ident: Callable[..., tuple[int, str]]) -> None:
    assert ident("check", "motion.json", "--home")[0] == 2


@pytest.mark.parametrize(
    ("braked", "words"),
    [
        (("shoulder", "elbow"), "Support the arm, or see that its brakes hold it."),
        (("elbow",), "only the brakes of elbow hold it now"),
        ((), "nothing holds it now"),
    ],
)
def test_what_holds_an_arm_without_power_is_told(braked: tuple[str, ...], words: str) -> None:
    document = load_arm("planar2").model_dump(mode="json", by_alias=True)
    document["control"]["after_stop"] = "hold"
    for name, joint in document["joints"].items():
        joint["brake"] = name in braked
    assert words in _support(ArmConfig.model_validate(document))
