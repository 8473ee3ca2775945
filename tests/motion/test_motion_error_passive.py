"""A CAN controller of the host that is error-passive before the arm is enabled: told before anything moves."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from campaign_canopen import bench_canopen_config
from campaign_pucks import bench_puck_config
from helpers.emulated_arms import Tapped
from motion_bench import Story

from drivers.arm import Arm, StopKind
from drivers.axis_status import AxisEventCode
from drivers.barrett.driver import BarrettArm
from drivers.can.bus_state import ACTIVE, CONTROLLER, PASSIVE_TX
from drivers.can.can_frame import Frame
from drivers.canopen.driver import CanopenArm
from ident_service.config.arm import ArmConfig
from ident_service.errors import ArmFault, DriverError
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import arm_model
from ident_service.motion.faults import ActiveFaults
from ident_service.motion.run import run
from ident_service.motion.ticket import Verdict
from ident_service.preflight.preflight import preflight
from sim_backend.canopen_device.drive import CanopenDrive
from sim_backend.emulator.faults import DriveFault
from sim_backend.emulator.lock_step import LockStepArm

SAID = "the host's CAN controller on bench is error-passive, expected error-active"
PASSIVE, RECOVERED = (
    Frame(CONTROLLER, bytes((0, what, 0, 0, 0, 0, 0, 0)), error=True) for what in (PASSIVE_TX, ACTIVE)
)
KINDS = pytest.mark.parametrize(
    ("build", "config"),
    [
        pytest.param(CanopenArm, bench_canopen_config, id="canopen"),
        pytest.param(BarrettArm, bench_puck_config, id="pucks"),
    ],
)
Build = Callable[..., Arm]


def passive_bus(config: ArmConfig, build: Build) -> tuple[Arm, list[Tapped]]:
    """An arm, not open, whose link tells first of all that the controller is error-passive."""
    behind, taps = LockStepArm(config), list[Tapped]()

    def links(_: ArmConfig) -> list[Tapped]:
        taps[:] = [Tapped(behind.link(0))]
        taps[0].disturb([PASSIVE], drives_hear=False)
        return taps

    return build(config, links), taps


@contextmanager
def opened(config: ArmConfig, build: Build) -> Iterator[tuple[Arm, Tapped]]:
    arm, taps = passive_bus(config, build)
    with arm:
        yield arm, taps[0]


@KINDS
def test_a_run_is_refused_before_anything_is_energised_and_its_recording_says_why(
    build: Build, config: Callable[[], ArmConfig]
) -> None:
    described, story, latch = config(), Story(), ActiveFaults()
    model = arm_model(described)
    with opened(described, build) as (arm, _):
        with pytest.raises(DriverError, match=SAID) as refused:
            run(arm, model, excitation(model, "identification"), story, active_faults=latch)
        assert "Check termination, connectors, cable and bit rate of every node on bench" in str(refused.value)
        assert not any(word & 1 for word in arm.exchange(None).status)
    assert story.samples == []
    assert SAID in story.events[-1][2]
    assert SAID in latch.faults[0].cause


@KINDS
def test_preflight_says_so_before_a_person_is_asked_for_anything(build: Build, config: Callable[[], ArmConfig]) -> None:
    described, asked = config(), list[str]()
    arm, _ = passive_bus(described, build)
    ticket = preflight(arm, arm_model(described), None, confirm=lambda text: asked.append(text) or "", idle_seconds=0.2)
    (check,) = [one for one in ticket.checks if one.verdict is Verdict.FAILED]
    assert (check.code, check.reason) == ("identities", SAID)
    assert check.remedy.startswith("Check termination")
    assert asked == []


@KINDS
def test_a_controller_that_has_recovered_is_no_reason(build: Build, config: Callable[[], ArmConfig]) -> None:
    with opened(config(), build) as (arm, tap):
        arm.exchange(None)
        tap.disturb([RECOVERED], drives_hear=False)
        arm.exchange(None)
        assert all(check.good for check in arm.setup_checks())
        arm.enable()


@KINDS
def test_one_that_becomes_so_while_drives_are_enabled_shows_in_the_first_cycle(
    build: Build, config: Callable[[], ArmConfig]
) -> None:
    with opened(config(), build) as (arm, tap):
        tap.disturb([RECOVERED], drives_hear=False)
        told = [event.code for _ in range(3) for event in arm.exchange(None).events]
        assert told == [AxisEventCode.BUS_DEGRADED]  # what was found when it was opened
        send, tap.sent = tap.send, []

        def sends(frame: Frame) -> None:
            if len(tap.sent) == 10:
                tap.disturb([PASSIVE], drives_hear=False)
            send(frame)

        tap.send = sends  # type: ignore[method-assign]
        arm.enable()
        found = [(event.code, event.words) for event in arm.exchange(None).events]
    assert found == [(AxisEventCode.BUS_DEGRADED, "bench: the host's CAN controller is passive")]


def drive_says(code: int, register: int) -> Frame:
    """An emergency message of the second drive."""
    return Frame(0x082, bytes((code & 0xFF, code >> 8, register, 0, 0, 0, 0, 0)))


@pytest.mark.parametrize(
    ("over", "tells"),
    [
        (None, True),
        (drive_says(0x0000, 0x11), True),  # another error is over
        (drive_says(0x4310, 0x19), True),  # another one came
        (drive_says(0x0000, 0x00), False),
        (drive_says(0x0000, 0x08), False),  # a temperature is still too high
    ],
)
def test_a_drive_that_is_error_passive_is_told_anew_of_an_enabled_arm_until_it_is_over(
    over: Frame | None, tells: bool
) -> None:
    config = bench_canopen_config()
    taps = [Tapped(LockStepArm(config).link(0))]
    with CanopenArm(config, lambda _: taps) as arm:
        taps[0].disturb([drive_says(0x8120, 0x11), *([] if over is None else [over])], drives_hear=False)
        assert AxisEventCode.BUS_DEGRADED in [event.code for event in arm.exchange(None).events]
        for _ in range(2):  # whoever enables it again is told again
            arm.enable()
            events = [event for _ in range(5) for event in arm.exchange(np.zeros(2)).events]
            found = [(event.code, event.axis, event.words) for event in events if "8120h" in event.words]
            words = "node 2: 8120h CAN controller in error passive, and not over yet"
            assert found == ([(AxisEventCode.BUS_DEGRADED, 1, words)] if tells else [])
            arm.stop(StopKind.TORQUE_OFF)


@pytest.mark.parametrize("over", [None, drive_says(0x0000, 0x00)])
@pytest.mark.parametrize("when", ["while it is idle", "while it is enabled"])
def test_an_emergency_of_a_drive_that_goes_on_is_told_anew_of_an_enabled_arm_until_it_is_over(
    when: str, over: Frame | None
) -> None:
    config = bench_canopen_config()
    taps = [Tapped(LockStepArm(config).link(0))]
    frames = [drive_says(0x4310, 0x09), *([] if over is None else [over])]
    with CanopenArm(config, lambda _: taps) as arm:
        taps[0].disturb(frames, drives_hear=False)
        if when == "while it is idle":
            assert AxisEventCode.EMERGENCY_MESSAGE in [event.code for event in arm.exchange(None).events]
        arm.enable()
        events = [event for _ in range(5) for event in arm.exchange(np.zeros(2)).events]
        found = [(event.code, event.axis, event.words) for event in events]
        words = "node 2: 4310h drive too hot (error register: generic, temperature), and not over yet"
        assert found == ([] if over else [(AxisEventCode.EMERGENCY_MESSAGE, 1, words)])


def test_an_emergency_of_a_fault_that_was_reset_is_over() -> None:
    """Also of a drive that does not say so."""
    config = bench_canopen_config()
    behind = LockStepArm(config)
    taps = [Tapped(behind.link(0))]
    with CanopenArm(config, lambda _: taps) as arm:
        arm.enable()
        taps[0].misses = lambda frame: frame.identifier == 0x082 and frame.data[:2] == b"\0\0"
        behind.inject(DriveFault("emergency", 1, duration=20e-3, size=0x4310))
        for _ in range(50):
            arm.exchange(np.zeros(2))
        arm.stop(StopKind.TORQUE_OFF)
        told = [drive.emergency for drive in arm._open().drives]
        assert told[1] is not None
        arm.reset()
        arm.enable()
        assert [event for _ in range(5) for event in arm.exchange(np.zeros(2)).events] == []


@pytest.mark.parametrize("when", ["before it was opened", "while it was idle"])
def test_a_run_over_a_drive_that_is_error_passive_stops_under_control(when: str) -> None:
    described, story = bench_canopen_config(), Story()
    model, behind = arm_model(described), LockStepArm(described)
    taps = [Tapped(behind.link(0))]
    if when == "before it was opened":
        face = behind.emulator.faces[1]
        assert isinstance(face, CanopenDrive)
        face.emergency.add_error(0x8120)
    with CanopenArm(described, lambda _: taps) as arm:
        if when == "while it was idle":
            taps[0].disturb([drive_says(0x8120, 0x11)], drives_hear=False)
            arm.exchange(None)
        with pytest.raises(ArmFault, match="8120h CAN controller in error passive") as ended:
            run(arm, model, excitation(model, "identification"), story, hold_seconds=0.1)
    assert ended.value.code == "bus_degraded"
    assert story.states[-2:] == ["stopping", "stopped"]
