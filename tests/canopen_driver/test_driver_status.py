"""Test status reports that stay away, and emergencies that only inform."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from helpers.emulated_arms import EDS, Tapped, tapped, weightless_config
from pydantic import ValidationError

from drivers.axis_status import AxisEvent, AxisEventCode, AxisStatus
from drivers.can.can_frame import Frame
from drivers.canopen.bus_load import budget
from drivers.canopen.driver import CanopenArm
from ident_service.config.arm import ArmConfig
from ident_service.errors import DriverError
from sim_backend.emulator.lock_step import LockStepArm

ZERO = np.zeros(2)
PERIOD = 0.002  # s, of a cycle
REPORTS = 0.1  # s, between two status reports


@pytest.fixture
def running() -> Iterator[tuple[CanopenArm, Tapped]]:
    config = weightless_config()
    taps = tapped(LockStepArm(config), config)
    with CanopenArm(config, lambda _: taps) as arm:
        arm.enable()
        yield arm, taps[0]


def told(arm: CanopenArm, seconds: float) -> list[tuple[float, AxisEvent]]:
    """Events of so many seconds, and when each came."""
    found = []
    for cycle in range(round(seconds / PERIOD)):
        found += [(cycle * PERIOD, event) for event in arm.exchange(ZERO).events]
    return found


def is_status(frame: Frame) -> bool:
    return frame.identifier in (0x281, 0x282)


def test_a_drive_whose_status_report_stays_away_is_reported_after_two_to_three_periods(
    running: tuple[CanopenArm, Tapped],
) -> None:
    arm, tap = running
    for _ in range(2):
        tap.misses = lambda frame: frame.identifier == 0x282
        ((when, event),) = told(arm, 1.0)
        assert event == AxisEvent(AxisEventCode.STATUS_STALE, 1, "node 2: no status report for 0.25 s")
        # The last report came up to a period before they stayed away.
        assert 1.0 * REPORTS <= when <= 3.0 * REPORTS
        tap.misses = lambda frame: False
        assert told(arm, 0.5) == []


def test_a_heartbeat_that_an_idle_arm_has_missed_is_missed_again_by_the_enabled_one() -> None:
    """While a motion is planned nobody acts upon events; a state that lasts must not be lost with them."""
    config = weightless_config()
    taps = tapped(LockStepArm(config), config)
    with CanopenArm(config, lambda _: taps) as arm:
        taps[0].misses = lambda frame: frame.identifier == 0x702
        idle = [event.code for _ in range(round(0.5 / PERIOD)) for event in arm.exchange(None).events]
        assert idle == [AxisEventCode.DRIVE_SILENT]
        arm.enable()
        ((when, event),) = told(arm, 0.5)
        assert event == AxisEvent(AxisEventCode.DRIVE_SILENT, 1, "node 2: no heartbeat for 0.3 s")
        assert when <= 10 * PERIOD


def test_one_lost_status_report_is_nothing(running: tuple[CanopenArm, Tapped]) -> None:
    arm, tap = running
    for _ in range(3):
        lost: set[int] = set()

        def first(frame: Frame, lost: set[int] = lost) -> bool:
            new = is_status(frame) and frame.identifier not in lost
            lost.add(frame.identifier)
            return new

        tap.misses = first
        assert told(arm, 0.5) == []
        assert lost >= {0x281, 0x282}


def emergency(code: int, register: int) -> Frame:
    return Frame(0x082, bytes([code & 0xFF, code >> 8, register, 1, 2, 3, 4, 5]))


@pytest.mark.parametrize(
    ("frame", "code"),
    [
        (emergency(0xFF01, 0x00), AxisEventCode.DRIVE_NOTICE),
        (emergency(0x7500, 0x01), AxisEventCode.DRIVE_NOTICE),  # on the drive's list
        (emergency(0xFF01, 0x80), AxisEventCode.EMERGENCY_MESSAGE),
        (emergency(0x8250, 0x00), AxisEventCode.EMERGENCY_MESSAGE),  # it does not hear us, whatever its register says
        (emergency(0x8120, 0x00), AxisEventCode.BUS_DEGRADED),
        (Frame(0x082, bytes([0x01, 0xFF])), AxisEventCode.EMERGENCY_MESSAGE),  # torn: nobody knows its register
        (emergency(0x7500, 0x01)._replace(identifier=0x081), AxisEventCode.EMERGENCY_MESSAGE),  # another drive's list
    ],
)
def test_an_emergency_that_only_informs_is_another_event(frame: Frame, code: AxisEventCode) -> None:
    plain = weightless_config()
    drives = plain.model_dump(mode="json", by_alias=True)["driver"]["drives"]
    drives[1]["notices"] = [0x7500]
    config = weightless_config(drives=drives)
    taps = tapped(LockStepArm(config), config)
    with CanopenArm(config, lambda _: taps) as arm:
        arm.enable()
        before = arm.exchange(ZERO)
        taps[0].disturb([frame], drives_hear=False)
        sample = arm.exchange(ZERO)
        node = frame.identifier - 0x080
        event = next(event for event in sample.events if event.code is code)
        assert (event.axis, event.words[:8]) == (node - 1, f"node {node}: ")
        if code is AxisEventCode.DRIVE_NOTICE:
            assert sample.status == before.status
            assert "vendor's bytes 01 02 03 04 05" in event.words


@pytest.mark.parametrize("code", [0x8120, 0x8130, 0x8250])
def test_a_lost_host_is_never_a_mere_notice(code: int) -> None:
    drives = weightless_config().model_dump(mode="json", by_alias=True)["driver"]["drives"]
    drives[0]["notices"] = [code]
    with pytest.raises(ValidationError, match=f"{code:04X}h tells that the drive does not hear its host"):
        weightless_config(drives=drives)


def test_a_drive_without_position_limits_is_none_the_worse() -> None:
    """607Dh is of the position modes; in torque mode it protects nothing, and need not be there."""
    config = weightless_config()
    behind = LockStepArm(config)
    drive = behind.emulator.faces[1]
    for subindex in (1, 2):
        del drive.objects.entries[0x607D00 | subindex]  # type: ignore[attr-defined]
    with CanopenArm(config, lambda _: tapped(behind, config)) as arm:
        arm.enable()
        arm.exchange(ZERO)


def without(text: str, *indices: str) -> str:
    """A data sheet without some objects."""
    return re.sub(rf"(?ims)^\[({'|'.join(indices)})(sub\w+)?\].*?(?=^\[|\Z)", "", text)


ONE_TPDO = without(EDS, "1801", "1A01")


def of_one_tpdo(**driver: Any) -> ArmConfig:
    """Drives whose files have one TPDO."""
    file = {"name": "one_tpdo.eds", "text": ONE_TPDO}
    emulation = {"truth": {"m1": 0.5, "Lxx1": 0.1, "Lyy1": 0.1, "Lzz1": 1.0, "m2": 1.0}}
    return weightless_config(**{"eds": file, "emulation": emulation} | driver)


@pytest.mark.parametrize("measured", ["status", "cyclic", "none"])
def test_a_drive_with_one_tpdo_tells_its_status_beside_its_position(measured: str) -> None:
    config = of_one_tpdo(measured_torque=measured)
    taps = tapped(behind := LockStepArm(config), config)
    with CanopenArm(config, lambda _: taps) as arm:
        lengths = {len(frame.data) for frame in behind_frames(arm, taps)}
        assert lengths == {6 if measured == "none" else 8}
        arm.enable()
        assert [event for _, event in told(arm, 0.5)] == []
        behind.emulator.faces[1].fail(0x4310, behind.clock.now_ns())
        arm.exchange(ZERO)  # no inhibit time holds it back
        assert arm.drive_status()[1] & AxisStatus.FAULT
        assert not arm.drive_status()[0] & AxisStatus.FAULT
        measures = arm.exchange(ZERO).measured_torque
        assert (measures is None) is (measured == "none")
    with CanopenArm(config, lambda _: tapped(behind, config)) as arm:
        assert arm.describe().report_delay == 0.0


def behind_frames(arm: CanopenArm, taps: list[Tapped]) -> list[Frame]:
    """Return the position frames that the drives send in some cycles."""
    found: list[Frame] = []
    for tap in taps:
        tap.misses = lambda frame: 0x180 < frame.identifier < 0x200 and bool(found.append(frame))
    for _ in range(3):
        arm.exchange(None)
    for tap in taps:
        tap.misses = lambda frame: False
    return found


def test_drives_of_which_one_turns_out_to_have_no_second_tpdo_say_what_to_write() -> None:
    """The file promises it; the drive has the last word, and nothing has been written."""
    config, real = weightless_config(), of_one_tpdo()
    taps = tapped(LockStepArm(real), config)
    with pytest.raises(DriverError, match=r"driver.status.frame: 1801h:01 is missing, .*: set it to position"):
        CanopenArm(config, lambda _: taps).open()
    assert not [frame for frame in taps[0].sent if 0x600 < frame.identifier < 0x680 and frame.data[0] >> 5 == 1]
    told_so = weightless_config(status={"frame": "position"})
    with CanopenArm(told_so, lambda _: tapped(LockStepArm(of_one_tpdo()), told_so)) as arm:
        arm.enable()
        assert arm.exchange(ZERO).valid.all()


def test_the_bus_budget_is_of_the_map_with_the_status_beside_the_position() -> None:
    """FIELDBUS.md 2.2: 989 typical bits and 1130 at worst of seven drives with 6 bytes; three TPDOs less here."""
    (own,), (beside,) = (budget(config.driver, 500.0).buses for config in (weightless_config(), of_one_tpdo()))  # type: ignore[arg-type]
    assert "status reports" in [line.name for line in own.lines]
    assert "status reports" not in [line.name for line in beside.lines]
    (line,) = [line for line in beside.lines if line.name == "positions with status"]
    assert line.length == 8
    plain = next(line for line in own.lines if line.name == "positions")
    assert line.load.worst > 1.3 * plain.load.worst
