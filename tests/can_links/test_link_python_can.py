"""Interfaces of python-can as links: what they hear of themselves, what they say when they cannot."""

from __future__ import annotations

import errno
import os
import socket
import time
from collections.abc import Iterator

import can
import pytest
from hypothesis import HealthCheck, given, settings
from link_bench import arm_on_bus, frames, soon

from drivers.can import python_can_link
from drivers.can.bus_state import BUS_OFF, RESTARTED, BusError
from drivers.can.can_frame import MOST_AT_ONCE, Frame
from drivers.can.can_link import Link, open_links
from drivers.can.python_can_link import PythonCanLink, bus_error
from ident_service.config.can_bus import CanBus
from ident_service.errors import DriverError

GROUP, PORT = "239.74.163.77", 43200 + os.getpid() % 2000


def udp() -> PythonCanLink:
    options = {"port": PORT, "hop_limit": 0}
    (link,) = open_links(arm_on_bus(interface="udp_multicast", channel=GROUP, options=options))
    assert isinstance(link, PythonCanLink)
    return link


def virtual(channel: str = "links") -> PythonCanLink:
    (link,) = open_links(arm_on_bus(interface="virtual", channel=channel))
    assert isinstance(link, PythonCanLink)
    return link


@pytest.fixture(params=["virtual", "udp_multicast"])
def pair(request: pytest.FixtureRequest) -> Iterator[tuple[Link, Link]]:
    """Two links on one bus."""
    make = virtual if request.param == "virtual" else udp
    one, other = make(), make()
    yield one, other
    one.close()
    other.close()
    one.close()


@given(frame=frames())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=50)
def test_a_frame_arrives_at_the_other_and_not_at_its_sender(pair: tuple[Link, Link], frame: Frame) -> None:
    one, other = pair
    one.send(frame)
    last = Frame(0x123, b"last")
    one.send(last)
    heard = []
    while (found := other.receive(soon())) is not None:
        assert 0 <= time.monotonic_ns() - found.stamp_ns < 30 * 10**9
        heard.append(found._replace(stamp_ns=0))
        if heard[-1] == last:
            break
    assert heard == ([last] if frame.extended else [frame, last])
    assert one.drain() == []


def test_a_foreign_frame_equal_to_ones_own_is_heard(pair: tuple[Link, Link]) -> None:
    one, other = pair
    for link in (one, other):
        link.send(Frame(0x080))
    for link in (one, other):
        found = link.receive(soon())
        assert found is not None
        assert found.identifier == 0x080
        assert link.receive(link.clock.now_ns() + 20_000_000) is None


def test_stamps_are_of_the_monotonic_clock(pair: tuple[Link, Link]) -> None:
    one, other = pair
    before = one.clock.now_ns()
    one.send(Frame(0x181))
    found = other.receive(soon())
    assert found is not None
    # The clocks of wall and machine are read one after the other, so they may disagree by a little.
    assert before - 10_000_000 < found.stamp_ns <= other.clock.now_ns()


def test_drain_takes_all_and_never_waits(pair: tuple[Link, Link]) -> None:
    one, other = pair
    for k in range(5):
        one.send(Frame(0x180 + k))
    assert other.receive(soon()) is not None
    heard: list[int] = []
    while len(heard) < 4:
        heard += [frame.identifier for frame in other.drain()]
    assert heard == [0x181, 0x182, 0x183, 0x184]
    assert other.drain() == []


def test_a_flood_does_not_hold_a_drain() -> None:
    one, other = virtual("flood"), virtual("flood")
    for _ in range(MOST_AT_ONCE + 7):
        one.send(Frame(0x080))
    assert [len(other.drain()) for _ in range(3)] == [MOST_AT_ONCE, 7, 0]
    one.close()
    other.close()


def test_anything_sent_to_the_multicast_group_stops_nobody() -> None:
    one, other = udp(), udp()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        for noise in (b"", b"\xff" * 50, b"\x81\xa1a\x01"):
            sock.sendto(noise, (GROUP, PORT))
    one.send(Frame(0x123))
    found = other.receive(soon())
    assert found is not None
    assert found.identifier == 0x123
    one.close()
    other.close()


def test_a_closed_link_says_so(pair: tuple[Link, Link]) -> None:
    one, _ = pair
    one.close()
    with pytest.raises(BusError) as caught:
        one.receive(0)
    assert caught.value.kind == "gone"
    with pytest.raises(DriverError):
        one.drain()


def test_data_frames_are_fd_with_rate_switch_where_a_data_bit_rate_is_given() -> None:
    (link,) = open_links(arm_on_bus(interface="virtual", channel="fd", data_bitrate=5_000_000))
    with can.Bus(interface="virtual", channel="fd", ignore_config=True) as other:
        link.send(Frame(0x201, bytes(24)))
        link.send(Frame(0x701, remote=True))
        first, second = other.recv(1), other.recv(1)
        assert first is not None
        assert second is not None
        assert (first.is_fd, first.bitrate_switch, len(first.data)) == (True, True, 24)
        assert (second.is_fd, second.is_remote_frame) == (False, True)
    link.close()
    classic = virtual()
    with pytest.raises(DriverError, match="at most 8 bytes, not 24"):
        classic.send(Frame(0x201, bytes(24)))
    classic.close()


def test_after_bus_off_sending_is_refused_until_a_restart() -> None:
    link = virtual("off")
    with can.Bus(interface="virtual", channel="off", ignore_config=True) as other:
        for kind in (BUS_OFF, RESTARTED):
            other.send(
                can.Message(arbitration_id=kind, is_error_frame=True, is_extended_id=False, dlc=8, data=bytes(8))
            )
            found = link.receive(soon())
            assert found is not None
            assert (found.error, found.identifier, len(found.data)) == (True, kind, 8)
            if kind == BUS_OFF:
                with pytest.raises(BusError, match="ip link set off up type can bitrate 1000000") as caught:
                    link.send(Frame(0x080))
                assert caught.value.kind == "off"
        link.send(Frame(0x080))
    link.close()


@pytest.mark.parametrize(
    ("error", "kind", "says"),
    [
        (can.CanOperationError("Failed to transmit", errno.ENETDOWN), "down", "ip link set can3 up type can bitrate 5"),
        (can.CanOperationError("Failed to transmit", errno.ENOBUFS), "full", "no node acknowledges"),
        (can.CanOperationError("Transmit buffer full"), "full", "no node acknowledges"),
        (can.CanOperationError("Failed to receive", errno.ENODEV), "gone", "the interface has gone.*Failed to receive"),
        (can.CanOperationError("something new"), "gone", "something new"),
        (can.CanInterfaceNotImplementedError("no library", errno.ENODEV), "gone", "no library"),
    ],
)
def test_errors_of_python_can_become_ours_with_a_remedy(error: Exception, kind: str, says: str) -> None:
    found = bus_error(error, CanBus(channel="can3", bitrate=5))
    assert found.kind == kind
    with pytest.raises(DriverError, match=says):
        raise found


def test_a_device_that_was_never_there_is_absent() -> None:
    found = bus_error(OSError(errno.ENODEV, "No such device"), CanBus(channel="can3"), "refused")
    assert found.kind == "absent"
    assert "no such CAN interface" in str(found)


def test_an_interface_that_nobody_has_is_refused() -> None:
    with pytest.raises(BusError, match="python-can knows no interface 'carrier_pigeon'"):
        open_links(arm_on_bus(interface="carrier_pigeon"))


def test_an_interface_whose_hardware_is_missing_is_refused_in_a_sentence() -> None:
    for interface in ("socketcan", "slcan", "pcan", "kvaser", "serial"):
        with pytest.raises(BusError, match=rf"^nowhere0: .*\({interface}: .+\)$"):
            open_links(arm_on_bus(interface=interface, channel="nowhere0"))


def test_what_the_link_decides_cannot_be_an_option() -> None:
    with pytest.raises(DriverError, match=r"driver\.buses\.0\.options: receive_own_messages cannot be set here"):
        open_links(arm_on_bus(interface="virtual", options={"receive_own_messages": True}))


def test_a_bus_that_cannot_be_had_leaves_none_open() -> None:
    config = arm_on_bus(interface="virtual", channel="both")
    driver = config.model_dump()["driver"]
    driver["buses"] = [driver["buses"][0], {"interface": "carrier_pigeon"}]
    driver["drives"][1]["bus"] = 1
    from can.interfaces import virtual as python_can_virtual

    with pytest.raises(BusError):
        open_links(type(config).model_validate(config.model_dump() | {"driver": driver}))
    assert "both" not in python_can_virtual.channels


def test_an_arm_without_canopen_has_no_links() -> None:
    from ident_service.config.load import load_arm

    with pytest.raises(DriverError, match="has no CAN bus"):
        python_can_link.from_config(load_arm("planar2"), 0)
