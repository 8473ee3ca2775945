"""The kernel's CAN sockets: what is said where there are none, and the link's own half over a stand-in.

A pair of local packet sockets stands in for the kernel: it carries the same structures. What only the kernel can show
(filters, error frames of a controller, queues) is tested on real SocketCAN, in a virtual machine where need be.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator

import pytest
from link_bench import arm_on_bus, soon

from drivers.can.bus_state import BUS_OFF, BusError, ControllerState, controller_state
from drivers.can.can_frame import Frame, from_kernel, to_kernel
from drivers.can.can_link import open_links
from drivers.can.socketcan_link import RawLink, controller_state_frame, state_in_link_message
from ident_service.errors import DriverError


def has_can() -> bool:
    try:
        socket.socket(29, socket.SOCK_RAW, 1).close()
    except OSError:
        return False
    return True


@pytest.fixture
def ends() -> Iterator[tuple[RawLink, socket.socket]]:
    """A link and the kernel's side of its socket."""
    mine, kernel = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    link = RawLink(mine, "can7", 500_000)
    yield link, kernel
    link.close()
    kernel.close()


def test_the_message_where_the_interface_or_the_kernel_has_none() -> None:
    says = "no such CAN interface" if has_can() else "no CAN sockets; load the modules: `modprobe can-raw`"
    with pytest.raises(BusError, match=f"nowhere0: .*{says}"):
        open_links(arm_on_bus(interface="raw", channel="nowhere0"))


def attribute(kind: int, data: bytes) -> bytes:
    """An attribute of netlink: length and type of 16 bits, padded to 4 bytes (linux/netlink.h)."""
    return struct.pack("=HH", 4 + len(data), kind) + data + bytes(-len(data) % 4)


def link_message(state: int) -> bytes:
    """Return the kernel's answer about a CAN interface, shortened (linux/rtnetlink.h, if_link.h, can/netlink.h)."""
    of_can = attribute(1, bytes(32)) + attribute(4, struct.pack("=I", state)) + attribute(6, struct.pack("=I", 100))
    info = attribute(1, b"can\0") + attribute(2, of_can)
    body = struct.pack("=BxHiII", 0, 280, 5, 0x100C1, 0) + attribute(3, b"can0\0") + attribute(0x8000 | 18, info)
    return struct.pack("=IHHII", 16 + len(body), 16, 0, 1, 0) + body


def test_the_kernel_tells_the_state_of_a_controller_that_had_it_before() -> None:
    states = {}
    for number in range(6):
        frame = state_in_link_message(link_message(number))
        states[number] = None if frame is None else controller_state(frame, ControllerState.ACTIVE)
    assert {number: state for number, state in states.items() if state} == {
        2: ControllerState.PASSIVE,
        3: ControllerState.BUS_OFF,
    }
    whole = link_message(2)
    for length in range(len(whole)):
        state_in_link_message(whole[:length])  # never raises
    assert controller_state_frame("lo") is None  # asks this kernel, whose answer has no such state
    assert controller_state_frame("nowhere0") is None


def test_what_the_kernel_tells_beside_the_socket_is_received_first(ends: tuple[RawLink, socket.socket]) -> None:
    link, kernel = ends
    kernel.send(to_kernel(Frame(0x181, b"1234")))
    off = state_in_link_message(link_message(3))
    assert off is not None
    link.hear(off)
    assert [(frame.error, frame.identifier) for frame in link.drain()] == [(True, BUS_OFF), (False, 0x181)]
    with pytest.raises(BusError, match="bus-off"):
        link.send(Frame(0x201))


def test_options_are_refused() -> None:
    with pytest.raises(DriverError, match="interface raw has none, found fd"):
        open_links(arm_on_bus(interface="raw", channel="nowhere0", options={"fd": True}))


def test_frames_go_and_come(ends: tuple[RawLink, socket.socket]) -> None:
    link, kernel = ends
    link.send(Frame(0x201, b"\1\2"))
    assert from_kernel(kernel.recv(100)) == Frame(0x201, b"\1\2")
    sent = [Frame(0x181, b"1234"), Frame(0x701, remote=True), Frame(0x4, bytes(8), error=True)]
    before = link.clock.now_ns()
    for frame in sent:
        kernel.send(to_kernel(frame))
    first = link.receive(soon())
    assert first is not None
    assert before <= first.stamp_ns <= link.clock.now_ns()
    assert [frame._replace(stamp_ns=0) for frame in (first, *link.drain())] == sent
    assert link.drain() == ()
    assert link.receive(link.clock.now_ns() + 1_000_000) is None


def test_a_full_queue_is_one_typed_error(ends: tuple[RawLink, socket.socket]) -> None:
    link, _ = ends

    def without_end() -> None:
        for _ in range(100_000):
            link.send(Frame(0x201, bytes(8)))

    with pytest.raises(BusError, match="can7: the transmit queue is full") as caught:
        without_end()
    assert caught.value.kind == "full"


def test_an_interface_that_vanishes_is_one_typed_error(ends: tuple[RawLink, socket.socket]) -> None:
    link, kernel = ends
    kernel.close()
    for call in (lambda: link.send(Frame(0x080)), lambda: link.receive(soon()), link.drain):
        with pytest.raises(BusError, match="can7: the interface has gone") as caught:
            call()
        assert caught.value.kind == "gone"


def test_after_bus_off_sending_is_refused(ends: tuple[RawLink, socket.socket]) -> None:
    link, kernel = ends
    kernel.send(to_kernel(Frame(BUS_OFF, bytes(8), error=True)))
    assert link.receive(soon()) is not None
    with pytest.raises(BusError, match="bitrate 500000") as caught:
        link.send(Frame(0x080))
    assert caught.value.kind == "off"
