"""From what a bus tells to what the guard hears of it."""

from __future__ import annotations

import struct

import pytest
from can_arms import wam_driver

from drivers.axis_status import AxisEventCode
from drivers.can.can_frame import Frame
from drivers.canopen.driver import axis_events
from drivers.canopen.pdo_codec import BusCodec
from drivers.canopen.pdo_mapping import bus_profiles

JOINTS = {node: node - 1 for node in range(1, 8)}


def heard(*frames: Frame) -> list[tuple[AxisEventCode, int | None, str]]:
    codec = BusCodec(bus_profiles(wam_driver(), 1000.0)[0])
    for frame in frames:
        codec.receive(frame)
    return [(event.code, event.axis, event.words) for event in axis_events(codec.take_events(), codec, JOINTS)]


def status(word: int) -> Frame:
    return Frame(0x282, struct.pack("<Hh", word, 0))


def controller(identifier: int, detail: int = 0) -> Frame:
    return Frame(identifier, bytes([0, detail, 0, 0, 0, 0, 0, 0]), error=True)


@pytest.mark.parametrize(
    ("frames", "code", "words"),
    [
        ([Frame(0x082, bytes.fromhex("00 54 01 00 00 00 00 00"))], AxisEventCode.EMERGENCY_MESSAGE, "5400h power"),
        ([Frame(0x082, bytes.fromhex("20 81 11 00 00 00 00 00"))], AxisEventCode.BUS_DEGRADED, "8120h CAN controller"),
        ([Frame(0x702, b"\x00")], AxisEventCode.DRIVE_RESTARTED, "has booted"),
        ([Frame(0x702, b"\x05"), Frame(0x702, b"\x7f")], AxisEventCode.DRIVE_LEFT, "pre-operational, was operational"),
        ([status(0x1237), status(0x0237)], AxisEventCode.TORQUE_IGNORED, "does not follow its target torque"),
        ([status(0x0237), status(0x0A37)], AxisEventCode.TORQUE_LIMITED, "limits its torque"),
        ([status(0x0237), status(0x02B7)], AxisEventCode.DRIVE_WARNING, "warns"),
        ([Frame(0x182, b"\x00")], AxisEventCode.STRANGE_FRAME, "position frame 182h of 1 bytes instead of 4"),
    ],
)
def test_what_a_drive_tells_names_its_node_and_its_joint(frames: list[Frame], code: AxisEventCode, words: str) -> None:
    ((found, axis, text),) = heard(*frames)
    assert (found, axis) == (code, 1)
    assert text.startswith("node 2: ")
    assert words in text


@pytest.mark.parametrize(
    ("frames", "code", "words"),
    [
        ([controller(0x040)], AxisEventCode.BUS_OFF, "bus-off"),
        # Over before anybody asked, but the arm went without a host for a while.
        ([controller(0x040), controller(0x100)], AxisEventCode.BUS_OFF, "bus-off"),
        ([controller(0x004, 0x20), controller(0x004, 0x40)], AxisEventCode.BUS_DEGRADED, "passive"),
        ([Frame(0x080)], AxisEventCode.SECOND_HOST, "080h, which only this host may"),
        ([Frame(0x205, bytes(6))], AxisEventCode.SECOND_HOST, "205h"),
        ([Frame(0x304, bytes(3))], AxisEventCode.SECOND_HOST, "304h"),
        ([Frame(0x000, b"\x82\x00")], AxisEventCode.SECOND_HOST, "000h"),
    ],
)
def test_what_is_of_the_bus_names_the_bus(frames: list[Frame], code: AxisEventCode, words: str) -> None:
    ((found, axis, text),) = heard(*frames)
    assert (found, axis) == (code, None)
    assert text.startswith("can0: ")
    assert words in text


def test_what_is_over_is_no_fault() -> None:
    begun = [status(0x0AB7), Frame(0x082, bytes.fromhex("00 54 01 00 00 00 00 00"))]
    over = [status(0x0237), Frame(0x082, bytes(8)), Frame(0x702, b"\x7f"), Frame(0x702, b"\x05")]
    assert len(heard(*begun)) == 3
    assert heard(*begun, *over) == heard(*begun)
