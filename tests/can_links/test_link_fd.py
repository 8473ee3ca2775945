"""CAN FD on the wire: what it carries, how long that takes, and what a classic controller does to it."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import can
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from link_bench import PATIENCE, arm_on_bus, content, end_of, frames, soon, wait_for

from drivers.can.bus_load import exact_bits
from drivers.can.bus_state import BUS_OFF, BusError
from drivers.can.can_frame import FD_LENGTHS, Frame, pack_frames, unpack_frames
from drivers.can.can_link import open_links
from ident_service.errors import DriverError
from sim_backend.can_bus.host import WireThread
from sim_backend.can_bus.hub import ERROR_BITS, CanBusServer
from sim_backend.can_bus.medium import BusEndpoint, Medium

SLOW, FAST = 500_000, 2_000_000


@pytest.fixture
def fd_wire(name: str) -> Iterator[CanBusServer]:
    with WireThread(CanBusServer(name, fd=True)) as thread:
        yield thread.wire


@given(drawn=st.lists(frames(fd=True), min_size=1, max_size=30))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30)
def test_frames_of_all_lengths_reach_the_others_as_what_they_are(fd_wire: CanBusServer, drawn: list[Frame]) -> None:
    with can.Bus(interface="ident_wire", channel=fd_wire.name) as sender:
        listener = end_of(fd_wire.name)
        for frame in drawn:
            sender.send(
                can.Message(
                    arbitration_id=frame.identifier,
                    data=None if frame.remote else frame.data,
                    is_extended_id=frame.extended,
                    is_remote_frame=frame.remote,
                    is_fd=frame.fd,
                )
            )
        for frame in drawn:
            assert content(listener.receive(soon())) == frame
        listener.close()


def test_a_configured_link_sends_fd_and_python_can_sees_it(fd_wire: CanBusServer) -> None:
    (link,) = open_links(arm_on_bus(interface="ident_wire", channel=fd_wire.name, data_bitrate=4_000_000))
    with can.Bus(interface="ident_wire", channel=fd_wire.name) as bus:
        for length in sorted(FD_LENGTHS):
            link.send(Frame(0x201, bytes(length)))
        link.send(Frame(0x701, remote=True))
        for length in sorted(FD_LENGTHS):
            message = bus.recv(PATIENCE)
            assert message is not None
            assert (len(message.data), message.is_fd, message.bitrate_switch) == (length, True, True)
        message = bus.recv(PATIENCE)
        assert message is not None
        assert (message.is_remote_frame, message.is_fd) == (True, False)
        with pytest.raises(DriverError, match="cannot have 9"):
            link.send(Frame(0x201, bytes(9)))
    link.close()


def test_its_pace_is_that_of_both_bit_rates(name: str) -> None:
    frame = Frame(0x201, bytes(range(64)), fd=True)
    bits = exact_bits(frame, fd=True)
    with WireThread(CanBusServer(name, SLOW, FAST)):
        sender, listener = end_of(name), end_of(name)
        sender.send_all([frame] * 5)
        stamps = [found.stamp_ns for found in (listener.receive(soon()) for _ in range(5)) if found is not None]
        sender.close()
        listener.close()
    expected = bits.nominal * 2_000 + bits.data * 500  # ns
    assert [b - a for a, b in pairwise(stamps)] == [expected] * 4
    # 64 bytes in data bits, hardly more than 8 bytes take a classic frame.
    assert expected < 2.5 * 111 * 2_000
    with pytest.raises(DriverError, match="needs its data bit rate"):
        CanBusServer(name, SLOW, fd=True)


def test_a_classic_controller_destroys_them_until_their_sender_is_off_the_bus() -> None:
    """ISO 11898-1, fault confinement: 8 counts a frame, bus-off beyond 255, so after 32 tries."""
    medium = Medium(lambda frame: 15_000, 20_000)
    sender, classic, other = BusEndpoint("sender"), BusEndpoint("classic", fd=False), BusEndpoint("other")
    for port in (sender, classic, other):
        medium.add(port)
    medium.offer(sender, Frame(0x201, bytes(2), fd=True), 0)
    medium.advance(10**9)
    assert (medium.sent, medium.destroyed, sender.counters.state) == (0, 32, "off")
    assert (classic.counters.receiving, other.counters.receiving) == (32, 32)
    last, own = sender.take()[-1]
    assert (last.error, last.identifier, own) == (True, BUS_OFF, False)
    assert last.stamp_ns == 32 * 15_000 + 31 * 20_000
    assert not [frame for frame, _ in other.take() if not frame.error]
    # What is classic goes through, also from those who know both.
    medium.offer(other, Frame(0x182, b"\1"), 10**9)
    medium.advance(2 * 10**9)
    assert [content(frame) for frame, _ in classic.take() if not frame.error] == [Frame(0x182, b"\1")]


@pytest.mark.slow
@pytest.mark.parametrize("wire_is_fd", [False, True])
def test_a_driver_and_a_wire_that_disagree_end_in_bus_off(name: str, wire_is_fd: bool) -> None:
    with WireThread(CanBusServer(name, SLOW, FAST if wire_is_fd else None)) as thread:
        data_bitrate = None if wire_is_fd else FAST
        bus = {"interface": "ident_wire", "channel": name, "bitrate": SLOW, "data_bitrate": data_bitrate}
        (driver,) = open_links(arm_on_bus(**bus))
        drive = end_of(name, "drive")
        sender, listener = (drive, driver) if wire_is_fd else (driver, drive)
        sender.send(Frame(0x201, bytes(2)))
        wait_for(lambda: thread.wire.medium.destroyed >= 32)
        told = sender.receive(soon())
        while told is not None and told.identifier != BUS_OFF:  # it warns, and is passive, before
            assert told.error
            told = sender.receive(soon())
        with pytest.raises(BusError, match="CAN FD"):
            sender.send(Frame(0x201, bytes(2)))
        assert not [frame for frame in listener.drain() if not frame.error]
        driver.close()
        drive.close()
    assert thread.wire.medium.sent == 0


def test_a_packet_with_a_frame_that_is_neither_is_refused() -> None:
    for bad in (Frame(1, bytes(12)), Frame(1, remote=True, fd=True), Frame(1, bytes(9), fd=True)):
        with pytest.raises(DriverError):
            unpack_frames(pack_frames([(bad, False)]))


def test_an_error_lasts_as_long_on_either_wire(name: str) -> None:
    for data_bitrate in (None, FAST):
        medium = CanBusServer(name, SLOW, data_bitrate).medium
        sender, listener = BusEndpoint("sender"), BusEndpoint("listener")
        medium.add(sender)
        medium.add(listener)
        medium.destroy_next(1)
        frame = Frame(0x201, bytes(8), fd=data_bitrate is not None)
        medium.offer(sender, frame, 0)
        medium.advance(10**9)
        ((heard, _),) = listener.take()
        once = exact_bits(frame, fd=frame.fd).seconds(SLOW, data_bitrate)
        assert heard.stamp_ns == pytest.approx(2e9 * once + ERROR_BITS * 1e9 / SLOW, abs=2)
