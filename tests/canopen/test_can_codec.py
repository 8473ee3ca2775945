"""Bytes in, state out; torques in, bytes out: vectors, one answer a cycle, events, and frames of any kind."""

from __future__ import annotations

import struct
from collections.abc import Iterator

import pytest
from can_arms import wam_driver
from hypothesis import example, given, settings
from hypothesis import strategies as st

from drivers.can.bus_state import HOST, ControllerState, Event, EventCode
from drivers.can.can_frame import Frame
from drivers.canopen.cia402 import DriveState, NmtCommand, NmtState
from drivers.canopen.pdo_codec import BusCodec
from drivers.canopen.pdo_mapping import bus_profiles
from ident_service.errors import DriverError

TORQUES = [1, -2, 300, -400, 5000, -6000, 32_767]


def codec(**changes: object) -> BusCodec:
    (profile,) = bus_profiles(wam_driver(**changes), 1000.0)
    return BusCodec(profile)


def position(node: int, counts: int) -> Frame:
    return Frame(0x180 + node, struct.pack("<i", counts))


def status(node: int, word: int, torque: int = 0) -> Frame:
    return Frame(0x280 + node, struct.pack("<Hh", word, torque))


def told(bus: BusCodec) -> list[tuple[EventCode, int]]:
    return [(event.code, event.node) for event in bus.take_events()]


def test_shared_torque_frames_are_those_of_the_wam() -> None:
    assert codec().torque_frames(TORQUES) == [
        Frame(0x201, bytes.fromhex("0100 feff 2c01 70fe")),
        Frame(0x205, bytes.fromhex("8813 90e8 ff7f")),
    ]


def test_single_torque_frames_go_to_one_drive_each() -> None:
    sent = codec(torque_frames="single").torque_frames(TORQUES)
    assert [frame.identifier for frame in sent] == list(range(0x201, 0x208))
    assert [struct.unpack("<h", frame.data)[0] for frame in sent] == TORQUES


def test_what_else_is_sent() -> None:
    bus = codec()
    assert bus.sync_frame() == Frame(0x080)
    assert bus.heartbeat_frame() == Frame(0x77F, b"\x05")
    assert bus.heartbeat_frame(NmtState.PRE_OPERATIONAL) == Frame(0x77F, b"\x7f")
    assert bus.control_frame(3, 0x000F, 10) == Frame(0x303, b"\x0f\x00\x0a")
    assert bus.nmt_frame(NmtCommand.START) == Frame(0x000, b"\x01\x00")
    assert bus.nmt_frame(NmtCommand.ENTER_PRE_OPERATIONAL, 4) == Frame(0x000, b"\x80\x04")


@pytest.mark.parametrize("bad", [[0] * 6, [0] * 6 + [32_768], [0] * 6 + [-32_769], [0] * 6 + [0.5], [None] * 7])
def test_torques_that_no_frame_holds_are_refused(bad: list[int]) -> None:
    with pytest.raises(DriverError, match="bus 0"):
        codec().torque_frames(bad)


def test_a_cycle_takes_one_position_of_each_drive() -> None:
    bus = codec()
    bus.receive(position(1, 111))
    assert not bus.drives[0].seen
    assert bus.drives[0].late == 1  # no cycle has begun
    for cycle in range(3):
        bus.begin_cycle(cycle)
        for node in range(1, 8):
            assert not bus.complete
            bus.receive(position(node, -1000 * node + cycle))
        assert bus.complete
        bus.receive(position(2, 7))
        bus.end_cycle()
        bus.receive(position(3, 7))
        assert [drive.position for drive in bus.drives] == [-1000 * node + cycle for node in range(1, 8)]
    assert [drive.answers for drive in bus.drives] == [3] * 7
    assert [drive.duplicates for drive in bus.drives] == [0, 3, 0, 0, 0, 0, 0]
    assert [drive.late for drive in bus.drives] == [1, 0, 3, 0, 0, 0, 0]
    assert told(bus) == [(EventCode.LATE, 1)] + [(EventCode.DUPLICATE, 2), (EventCode.LATE, 3)] * 3


def test_a_silent_drive_grows_old_and_keeps_its_position() -> None:
    bus = codec()
    for cycle in range(5):
        bus.begin_cycle()
        for node in range(1, 8):
            if node != 4 or cycle == 1:
                bus.receive(position(node, cycle))
        bus.end_cycle()
    assert [drive.age for drive in bus.drives] == [0, 0, 0, 3, 0, 0, 0]
    assert [drive.answered for drive in bus.drives] == [True, True, True, False, True, True, True]
    assert bus.drives[3].position == 1


def test_status_words_are_reported_when_they_change() -> None:
    bus = codec()
    for word in (0x1637, 0x1637, 0x1E37, 0x1637, 0x16B7, 0x0218):
        bus.receive(status(5, word, -123))
    drive = bus.drives[4]
    assert (drive.status, drive.torque, drive.state) == (0x0218, -123, DriveState.FAULT)
    events = bus.take_events()
    assert [event.code for event in events] == [
        EventCode.DRIVE_STATE,
        EventCode.TORQUE_LIMITED,
        EventCode.OVER,
        EventCode.DRIVE_WARNING,
        EventCode.DRIVE_FAULT,
        EventCode.OVER,
    ]
    assert events[0].words == "operation enabled (status word 1637h)"
    assert events[4].words == "fault (status word 0218h), was operation enabled"
    assert {event.node for event in events} == {5}
    assert bus.take_events() == []


def test_emergencies_come_in_words() -> None:
    bus = codec()
    bus.receive(Frame(0x082, bytes.fromhex("5082 11 0102030405")))
    assert bus.take_events() == [
        Event(
            EventCode.EMERGENCY,
            2,
            "8250h RPDO timeout: no torque frame came in time (error register: generic, communication),"
            " vendor's bytes 01 02 03 04 05",
        )
    ]
    assert bus.drives[1].emergency is not None
    assert (bus.drives[1].emergency.code, bus.drives[1].emergency.register) == (0x8250, 0x11)
    bus.receive(Frame(0x082, bytes(8)))
    assert told(bus) == [(EventCode.EMERGENCY_RESET, 2)]
    assert bus.drives[1].emergency is None


def test_a_torn_emergency_is_one_nevertheless() -> None:
    bus = codec()
    bus.receive(Frame(0x083, bytes.fromhex("3081")))
    assert told(bus) == [(EventCode.WRONG_LENGTH, 3), (EventCode.EMERGENCY, 3)]
    bus.receive(Frame(0x083, b"\x30"))
    assert told(bus) == [(EventCode.WRONG_LENGTH, 3)]


def test_heartbeats_tell_who_lives_and_who_has_booted() -> None:
    bus = codec()
    for node in range(1, 7):
        bus.receive(Frame(0x700 + node, b"\x05", stamp_ns=1_000_000_000))
    assert bus.silent(1_100_000_000) == [7]
    bus.begin_cycle(1_300_000_000)
    bus.receive(Frame(0x701, b"\x05"))  # nobody stamped it: it is of this cycle
    assert bus.silent(1_300_000_000) == [7]
    assert bus.silent(1_300_000_001) == [2, 3, 4, 5, 6, 7]
    assert told(bus) == []
    bus.receive(Frame(0x702, b"\x00", stamp_ns=1_310_000_000))
    bus.receive(Frame(0x702, b"\x7f", stamp_ns=1_320_000_000))
    bus.receive(Frame(0x703, b"\x04", stamp_ns=1_330_000_000))
    events = bus.take_events()
    assert [(event.code, event.node) for event in events] == [
        (EventCode.BOOT_UP, 2),
        (EventCode.LEFT, 2),
        (EventCode.LEFT, 3),
    ]
    assert events[2].words == "NMT state stopped, was operational"
    assert bus.drives[1].boots == 1
    assert bus.drives[1].nmt == NmtState.PRE_OPERATIONAL


def test_strangers_and_a_second_host_are_reported_once() -> None:
    bus = codec()
    for _ in range(3):
        bus.receive(position(9, 1))
        bus.receive(Frame(0x201, bytes(8)))
        bus.receive(Frame(0x77F, b"\x05"))
        bus.receive(Frame(0x583, bytes(8)))  # an SDO's reply belongs to the configuration plane
    events = bus.take_events()
    assert [(event.code, event.node) for event in events] == [
        (EventCode.STRANGER, 9),
        (EventCode.SECOND_HOST, HOST),
        (EventCode.SECOND_HOST, HOST),
    ]
    assert bus.counters.strangers == 9
    assert bus.counters.ignored == 3
    bus.forget_events()
    bus.receive(Frame(0x201, bytes(8)))
    assert told(bus) == [(EventCode.SECOND_HOST, HOST)]  # still there after what was expected


def controller(identifier: int, *data: int) -> Frame:
    return Frame(identifier, bytes(data).ljust(8, b"\0"), error=True)


def test_the_controllers_state_follows_its_error_frames() -> None:
    bus = codec()
    steps = [
        (controller(0x004, 0, 0x08), ControllerState.WARNING),
        (controller(0x004, 0, 0x20), ControllerState.PASSIVE),
        (controller(0x004, 0, 0x40), ControllerState.ACTIVE),
        (controller(0x2000_0040), ControllerState.BUS_OFF),
        (controller(0x004, 0, 0x40), ControllerState.BUS_OFF),
        (controller(0x100), ControllerState.ACTIVE),
    ]
    for frame, state in steps:
        bus.receive(frame)
        assert bus.controller is state
    assert [code for code, node in told(bus) if node == HOST] == [
        EventCode.CONTROLLER,
        EventCode.ERROR_PASSIVE,
        EventCode.CONTROLLER,
        EventCode.BUS_OFF,
        EventCode.CONTROLLER,
    ]
    bus.receive(controller(0x004, 0, 0x01))
    bus.receive(controller(0x020))
    events = bus.take_events()
    assert [event.code for event in events] == [EventCode.OVERFLOW, EventCode.BUS_ERROR]
    assert "cable" in events[1].words
    assert bus.counters.errors == 8


def test_a_flood_of_events_is_bounded_and_counted() -> None:
    bus = codec()
    for _ in range(10_000):
        bus.receive(Frame(0x181, b"\x00"))
    assert len(bus.take_events()) + bus.counters.events_lost == 10_000
    assert bus.counters.events_lost > 9000
    bus.receive(Frame(0x181, b"\x00"))
    assert len(bus.take_events()) == 1


def test_a_flood_hides_neither_an_emergency_nor_a_second_host() -> None:
    bus = codec()
    for identifier in range(0x400, 0x500):
        bus.receive(Frame(identifier))
    for _ in range(1000):
        bus.receive(Frame(0x181, b"\x00"))
    bus.receive(Frame(0x082, struct.pack("<HB5x", 0x5400, 1)))
    bus.receive(Frame(0x080))
    events = bus.take_events()
    assert [event.code for event in events[-2:]] == [EventCode.EMERGENCY, EventCode.SECOND_HOST]
    assert len(events) < 300


def test_a_drive_that_stops_following_its_torque_is_reported() -> None:
    bus = codec()
    for status in (0x0227, 0x1227, 0x0227, 0x1227, 0x0221):
        bus.receive(Frame(0x281, struct.pack("<Hh", status, 0)))
    codes = [event.code for event in bus.take_events()]
    assert codes.count(EventCode.DEAF) == 1  # neither before it followed nor when it was switched off


def test_what_a_drive_reported_before_it_booted_is_no_longer_true() -> None:
    bus = codec()
    bus.receive(Frame(0x281, struct.pack("<Hh", 0x1227, 0)))
    assert bus.drives[0].state is DriveState.OPERATION_ENABLED
    bus.receive(Frame(0x701, b"\x00"))
    assert bus.drives[0].state is DriveState.UNKNOWN


def test_wrong_lengths_change_nothing() -> None:
    bus = codec()
    bus.begin_cycle()
    for length in (0, 1, 3, 5, 8):
        bus.receive(Frame(0x181, bytes(range(1, length + 1))))
    bus.receive(Frame(0x281, b"\x01\x02\x03"))
    bus.receive(Frame(0x701, b""))
    drive = bus.drives[0]
    assert (drive.seen, drive.answered, drive.status, drive.nmt) == (False, False, None, None)
    assert told(bus) == [(EventCode.WRONG_LENGTH, 1)] * 7


def test_frames_that_canopen_does_not_have_are_not_taken_for_its_own() -> None:
    bus = codec()
    bus.begin_cycle()
    for frame in (position(1, 5), status(1, 0x1637), Frame(0x701, b"\x05"), Frame(0x081, b"\x50\x82" + bytes(6))):
        bus.receive(frame._replace(remote=True))
        bus.receive(frame._replace(extended=True))
    drive = bus.drives[0]
    assert (drive.seen, drive.status, drive.nmt, drive.emergency) == (False, None, None, None)
    assert bus.take_events() == []
    assert bus.counters.ignored == 8


def test_a_crowd_of_strangers_is_counted_but_not_remembered() -> None:
    bus = codec()
    for identifier in range(0x400, 0x500):
        bus.receive(Frame(identifier, b""))
    assert bus.counters.strangers == 0x100
    assert len(bus.take_events()) == 64


@st.composite
def any_frame(draw: st.DrawFn) -> Frame:
    """Frames of ours, of others, torn, remote, extended and error frames."""
    base = draw(st.sampled_from((0x000, 0x080, 0x180, 0x200, 0x280, 0x300, 0x580, 0x600, 0x700)))
    identifier = draw(st.one_of(st.integers(0, 0x7FF), st.integers(0, 9).map(lambda node: base + node)))
    return Frame(
        draw(st.one_of(st.just(identifier), st.integers(0, 2**32 - 1))),
        draw(st.binary(max_size=8)) if draw(st.integers(0, 9)) else draw(st.binary(max_size=64)),
        remote=draw(st.integers(0, 9)) == 0,
        error=draw(st.integers(0, 9)) == 0,
        extended=draw(st.integers(0, 9)) == 0,
        stamp_ns=draw(st.integers(0, 2**62)),
    )


def stirred(bus: BusCodec, frames: list[Frame]) -> Iterator[list[Frame]]:
    for number, frame in enumerate(frames):
        if number % 3 == 0:
            bus.begin_cycle(number)
        bus.receive(frame)
        if number % 3 == 1:
            bus.end_cycle()
        yield bus.torque_frames(TORQUES)


LISTS = st.lists(any_frame(), min_size=20, max_size=20)


@pytest.mark.campaign
@settings(max_examples=500)
@given(LISTS)
def test_no_frame_of_many_raises_and_none_changes_a_torque(frames: list[Frame]) -> None:
    change_nothing(frames)


@pytest.mark.slow
@settings(max_examples=50)
@given(LISTS)
@example([Frame(0x040, b"", error=True), Frame(0x081, b""), Frame(2**32 - 1, b"\xff" * 64, extended=True)])
def test_no_frame_raises_and_none_changes_a_torque(frames: list[Frame]) -> None:
    change_nothing(frames)


def change_nothing(frames: list[Frame]) -> None:
    bus = codec()
    expected = codec().torque_frames(TORQUES)
    for sent in stirred(bus, frames):
        assert sent == expected
    assert bus.sync_frame() == Frame(0x080)
    assert bus.heartbeat_frame() == Frame(0x77F, b"\x05")
    for drive in bus.drives:
        good = [
            frame
            for frame in frames
            if frame.identifier == 0x180 + drive.node
            and len(frame.data) == 4
            and not (frame.error or frame.remote or frame.extended)
        ]
        assert drive.answers + drive.duplicates + drive.late == len(good)
        assert -(2**31) <= drive.position < 2**31
        assert not drive.seen or struct.pack("<i", drive.position) in [frame.data for frame in good]
    assert all(isinstance(event, Event) and event.words for event in bus.take_events())


def test_only_requested_uploads_are_kept() -> None:
    """Another tool's conversation with a drive is not ours; a flood of it must not be kept."""
    bus = codec()
    drive = bus.drives[0]
    for index in range(0x1000, 0x1400):
        bus.receive(Frame(0x580 + drive.node, struct.pack("<BHBI", 0x43, index, 0, 7)))
        bus.receive(Frame(0x580 + drive.node, b"\x43"))
    assert drive.uploads == {}
    assert bus.counters.ignored == 2 * 0x400
    bus.receive(Frame(0x580 + drive.node, struct.pack("<BHBHxx", 0x4B, 0x6041, 0, 0x1637)))
    assert (drive.status, drive.uploads) == (0x1637, {0x604100: b"\x37\x16"})
    bus.asked.add(0x606100)
    bus.receive(Frame(0x580 + drive.node, struct.pack("<BHBbxxx", 0x4F, 0x6061, 0, 10)))
    assert drive.uploads[0x606100] == b"\x0a"
    for torn in (b"", b"\x4b", b"\x4b\x41\x60\x00\x00", bytes(8), b"\x80\x41\x60\x00\x00\x00\x02\x06"):
        bus.receive(Frame(0x580 + drive.node, torn))
    assert drive.status == 0x1637


def test_a_control_word_by_sdo_is_a_download_of_two_bytes() -> None:
    frame = codec().control_download(3, 0x0002)
    assert (frame.identifier, frame.data) == (0x603, bytes((0x2B, 0x40, 0x60, 0, 2, 0, 0, 0)))
