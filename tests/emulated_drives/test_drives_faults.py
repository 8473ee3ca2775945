"""Every fault that can be injected into emulated drives, as a host on the bus sees it."""

from __future__ import annotations

import math
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from drives_bench import MS, Host, drives_config

from ident_service.config.simulation import FAULT_RULES, FaultKind
from ident_service.errors import DriverError
from sim_backend.emulator.faults import _NO_COUNTERPART, DRIVE_FAULTS, DriveFault, parse_fault
from sim_backend.emulator.motor import Power

NAMES = ("shoulder", "elbow")
PER_RADIAN = 4096 / (2 * math.pi)


def inject(host: Host, text: str) -> None:
    host.arm.inject(parse_fault(text, NAMES))


def true_counts(host: Host) -> list[float]:
    body = host.arm.emulator.body
    return (body.gears.motor_position(body.plant.position) * PER_RADIAN).tolist()


def test_every_kind_of_the_simulated_arm_is_there_or_reported_as_impossible() -> None:
    simulated = {kind.value for kind in FaultKind}
    assert simulated == (simulated & set(DRIVE_FAULTS)) | set(_NO_COUNTERPART)
    for kind in simulated & set(DRIVE_FAULTS):
        rule, ours = FAULT_RULES[FaultKind(kind)], DRIVE_FAULTS[kind]
        assert (rule.size is None, rule.of_joint) == (ours.size is None, ours.of_joint), kind


def test_lost_feedback(enabled: Host) -> None:
    inject(enabled, "lost_feedback joint=shoulder duration=0.0025")
    assert [set(enabled.cycle(0, 0)) for _ in range(4)] == [{2}, {2}, {2}, {1, 2}]


def test_faults_that_are_cleared_before_the_first_sync_do_not_begin(enabled: Host) -> None:
    enabled.arm.emulator.add_configured([parse_fault("lost_feedback joint=shoulder", NAMES)])
    enabled.arm.emulator.clear(enabled.now)
    assert [set(enabled.cycle(0, 0)) for _ in range(3)] == [{1, 2}] * 3


def test_delayed_feedback_arrives_after_the_others(enabled: Host) -> None:
    inject(enabled, "delayed_feedback joint=shoulder size=0.0015")
    truth = round(true_counts(enabled)[0])
    enabled.cycle(0, 0)
    enabled.torques(0, 0)
    enabled.send(0x080)
    begun = enabled.now
    late = next(f for f in enabled.listen(1) if f.identifier == 0x181)
    assert 0.5 * MS < late.stamp_ns - begun < 0.75 * MS
    assert abs(struct.unpack("<i", late.data)[0] - truth) <= 1


def test_hidden_delay_shows_old_positions(enabled: Host) -> None:
    shown, truths = [], []
    enabled.arm.emulator.observer = lambda truth: truths.append(
        enabled.arm.emulator.body.gears.motor_position(truth.position)[0] * PER_RADIAN
    )
    for cycle in range(200):
        if cycle == 50:
            inject(enabled, "hidden_delay joint=shoulder size=0.01")
        shown.append(enabled.cycle(200, 0)[1])
    assert shown[40] == round(truths[40])
    assert shown[150:] == [round(old) for old in truths[140:190]]


@pytest.mark.parametrize(("kind", "after"), [("encoder_jump", 0), ("encoder_offset", 1)])
def test_steps_of_the_encoder(enabled: Host, kind: str, after: int) -> None:
    inject(enabled, f"{kind} joint=shoulder size=0.1")
    step = round(0.1 * 20.0 * PER_RADIAN)
    for factor in (1, after):
        shown = enabled.cycle(0, 0)
        assert shown[1] - true_counts(enabled)[0] == pytest.approx(factor * step, abs=1)
        assert shown[2] - true_counts(enabled)[1] == pytest.approx(0, abs=1)


def test_a_frozen_and_a_mirrored_encoder(enabled: Host) -> None:
    before = [enabled.cycle(200, 0)[1] for _ in range(100)][-1]
    inject(enabled, "frozen_encoder joint=shoulder duration=0.05")
    assert {enabled.cycle(200, 0)[1] for _ in range(49)} == {before}
    for _ in range(3):
        enabled.cycle(200, 0)
    inject(enabled, "position_sign joint=shoulder")
    assert enabled.cycle(200, 0)[1] == pytest.approx(-true_counts(enabled)[0], abs=1)


def test_torque_with_the_wrong_sign_is_reported_with_the_right_one(enabled: Host) -> None:
    inject(enabled, "torque_sign joint=elbow")
    enabled.cycle(100, 100)
    assert [m.torque for m in enabled.arm.emulator.body.motors] == pytest.approx([0.1, -0.1])
    assert enabled.read(2, 0x6077, 0, "h") == 100


def test_stuck_torque(enabled: Host) -> None:
    enabled.cycle(100, 100)
    inject(enabled, "stuck_torque joint=elbow duration=0.01")
    motor = enabled.arm.emulator.body.motors[1]
    for cycle in range(14):
        enabled.cycle(50, 50)
        assert motor.torque == pytest.approx(0.1 if cycle < 9 else 0.05)
        if cycle == 8:
            enabled.cycle(50, 50)


def test_saturation_is_reported(enabled: Host) -> None:
    inject(enabled, "torque_saturation joint=elbow size=0.01")
    enabled.cycle(1000, 1000)
    assert [enabled.read(n, 0x6077, 0, "h") for n in (1, 2)] == [1000, 300]
    assert [bool(word & 0x0800) for word in enabled.statuswords()] == [False, True]


def test_a_drive_fault_coasts_and_cannot_be_reset_while_it_lasts(enabled: Host) -> None:
    inject(enabled, "drive_fault joint=elbow duration=0.02")
    enabled.cycle(100, 100)
    assert enabled.emergencies() == [(2, 0x5400)]
    assert enabled.arm.emulator.body.motors[1].power is Power.COAST
    for attempt in range(2):
        enabled.control(0x00, (2,))
        enabled.control(0x80, (2,))
        assert enabled.read(2, 0x6041, 0, "H") & 0x4F == (0x08, 0x40)[attempt]
        for _ in range(25):
            enabled.cycle(0, 0)


def test_a_silent_node_coasts_and_boots_again(enabled: Host) -> None:
    inject(enabled, "node_silent joint=elbow duration=0.02")
    assert set(enabled.cycle(0, 0)) == {1}
    assert enabled.arm.emulator.body.motors[1].power is Power.COAST
    assert enabled.arm.emulator.states[1] == "dead"
    enabled.heard.clear()
    for _ in range(25):
        enabled.cycle(0, 0)
    assert [f.data for f in enabled.heard if f.identifier == 0x702] == [b"\0"]
    assert enabled.arm.emulator.states[1] == "pre operational, switch on disabled"


def test_emergency_stop_takes_power_until_it_ends(enabled: Host) -> None:
    inject(enabled, "emergency_stop duration=0.02")
    enabled.cycle(0, 0)
    assert [word & 0x7F for word in enabled.statuswords()] == [0x40, 0x40]  # bit 4: no voltage
    assert [m.power for m in enabled.arm.emulator.body.motors] == [Power.COAST] * 2
    for word in (0x06, 0x07):
        enabled.control(word)
    assert [word & 0x6F for word in enabled.statuswords()] == [0x21, 0x21]
    for _ in range(25):
        enabled.cycle(0, 0)
    enabled.control(0x07)
    assert [word & 0x7F for word in enabled.statuswords()] == [0x33, 0x33]


def test_a_load_is_felt_by_the_arm(enabled: Host) -> None:
    ends = []
    for loaded in (False, True):
        if loaded:
            inject(enabled, "load_attached size=1.5 offset=0,0,0")
        body = enabled.arm.emulator.body
        state = (body.plant.position, body.plant.velocity)
        needed = body.plant.inverse_dynamics(state[0], np.zeros(2), np.zeros(2))
        enabled.cycle(0, 0)
        ends.append((needed, body.plant._inverse.torque(state[0], np.zeros(2), np.zeros(2))))
    assert np.abs(ends[1][1] - ends[0][1]).max() > 1.0


def test_heartbeats_alone_may_be_lost(enabled: Host) -> None:
    assert enabled.write(1, 0x1017, 0, "H", 10) == 0
    enabled.cycle(0, 0)  # the first one is on its way already
    inject(enabled, "heartbeat_lost joint=shoulder duration=0.1")
    enabled.heard.clear()
    assert all(set(enabled.cycle(0, 0)) == {1, 2} for _ in range(99))
    assert [f for f in enabled.heard if f.identifier == 0x701] == []
    for _ in range(20):
        enabled.cycle(0, 0)
    assert [f for f in enabled.heard if f.identifier == 0x701] != []


def test_a_node_reboots_in_the_middle_of_a_run(enabled: Host) -> None:
    inject(enabled, "reboot joint=shoulder")
    assert set(enabled.cycle(100, 100)) == {2}
    for _ in range(30):
        enabled.cycle(100, 100)
    assert [f.data for f in enabled.heard if f.identifier == 0x701] == [b"\0"]
    assert enabled.read(1, 0x6041, 0, "H") & 0x6F == 0x40
    assert enabled.read(1, 0x6072, 0, "H") == 1000  # configured no more


def test_a_second_node_under_the_same_number(enabled: Host) -> None:
    inject(enabled, "wrong_node joint=shoulder")
    enabled.torques(0, 0)
    enabled.send(0x080)
    frames = [f for f in enabled.listen(1) if f.identifier == 0x181]
    assert len(frames) == 2
    assert bytes(4) in [f.data for f in frames]


def test_short_frames_and_warnings(enabled: Host) -> None:
    inject(enabled, "short_frame joint=shoulder")
    enabled.send(0x080)
    assert sorted(len(f.data) for f in enabled.listen(0.9) if f.identifier in (0x181, 0x182)) == [3, 4]
    inject(enabled, "warning joint=elbow duration=0.002")
    assert [bool(word & 0x80) for word in enabled.statuswords()] == [False, True]
    enabled.cycle(0, 0)
    enabled.cycle(0, 0)
    enabled.cycle(0, 0)
    assert not any(word & 0x80 for word in enabled.statuswords())


def test_the_controller_tells_of_its_errors(enabled: Host) -> None:
    inject(enabled, "error_passive")
    (frame,) = [f for f in enabled.listen(1) if f.error]
    assert (frame.identifier, frame.data[1]) == (0x004, 0x30)
    inject(enabled, "bus_off duration=0.05")
    frames = enabled.listen(20)
    assert [(f.identifier, f.error) for f in frames] == [(0x040, True)]
    assert all("quick stop" in state or "disabled" in state for state in enabled.arm.emulator.states)
    assert enabled.cycle(0, 0) == {}


def test_a_bus_that_is_gone_is_an_error_of_the_link(enabled: Host) -> None:
    inject(enabled, "bus_gone duration=0.03")
    with pytest.raises(DriverError, match="bus 0 is gone"):
        enabled.send(0x080)
    with pytest.raises(DriverError, match="bus 0 is gone"):
        enabled.link.receive(enabled.now + MS)
    enabled.arm.settle(enabled.now + 31 * MS)
    assert set(enabled.cycle()) == {1, 2}
    assert all("0x8250" in state for state in enabled.arm.emulator.states)


def test_faults_of_the_configuration_count_from_the_first_sync(tmp_path: Path) -> None:
    faults = [
        {"kind": "lost_feedback", "joint": "elbow", "cycle": 5},
        {"kind": "drive_fault", "joint": "shoulder", "at": 0.02},
    ]
    host = Host.on(drives_config(tmp_path, emulation={"faults": faults}))
    host.configure()
    host.listen(100)
    answers = [set(host.cycle()) for _ in range(30)]
    assert [cycle for cycle, heard in enumerate(answers) if heard != {1, 2}] == [5]
    assert host.emergencies() == [(1, 0x5400)]


@pytest.mark.parametrize("fault", [{"kind": "nan_position", "at": 1.0}, {"kind": "clock_jump", "size": 1.0, "at": 0.0}])
def test_faults_that_no_drive_can_have_are_refused(tmp_path: Path, fault: dict[str, object]) -> None:
    with pytest.raises(DriverError, match=r"driver\.emulation\.faults: "):
        Host.on(drives_config(tmp_path, emulation={"faults": [fault]}))


def test_a_fault_in_words() -> None:
    assert parse_fault("encoder_jump joint=elbow at=1.5 duration=0.2 size=-0.1", NAMES) == DriveFault(
        "encoder_jump", 1, 1.5, 0.2, -0.1
    )
    assert parse_fault("emergency size=0x4310", NAMES).size == 0x4310
    assert parse_fault("load_attached size=2 offset=0,0.1,-0.2", NAMES).offset == (0.0, 0.1, -0.2)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "no fault is called ''"),
        ("explosion", "no fault is called 'explosion'; there are lost_feedback"),
        ("reboot joint=wrist", "joint 'wrist' is none of shoulder, elbow"),
        ("reboot knee=1", "'knee=1' is not one of joint="),
        ("reboot at=1 at=2", "'at=2' is not one of"),
        ("reboot at", "'at' is not one of"),
        ("reboot at=soon", "at=soon is not a number"),
        ("reboot at=nan", "at=nan is not a number"),
        ("reboot at=-1", "at must not be negative"),
        ("reboot duration=0", "duration must be above 0"),
        ("reboot size=1", "reboot has no size"),
        ("encoder_jump", "encoder_jump needs size="),
        ("torque_saturation size=2", "above 1"),
        ("hidden_delay size=-1", "negative"),
        ("emergency size=0", "from 0x0001"),
        ("emergency_stop joint=elbow", "strikes the whole arm"),
        ("load_attached size=1 offset=1,2", "three numbers"),
        ("reboot offset=1,2,3", "reboot has no offset"),
    ],
)
def test_a_fault_that_nobody_understands(text: str, complaint: str) -> None:
    with pytest.raises(DriverError) as refused:
        parse_fault(text, NAMES)
    assert complaint in str(refused.value)


def test_the_document_lists_every_fault_as_it_is() -> None:
    text = (Path(__file__).parents[2] / "docs" / "fieldbus.md").read_text(encoding="utf-8")
    listed = dict(re.findall(r"^\| `(\w+)` \| (.*?) \| .*? \| (?:a drive, or all|the arm) \| ", text, re.MULTILINE))
    assert listed == {kind: rule.does for kind, rule in DRIVE_FAULTS.items()}
