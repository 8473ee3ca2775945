"""Both links over the kernel's CAN sockets: what only a real kernel can show of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing

import pytest
from can_links.link_bench import arm_on_bus, soon
from socketcan_bench import ERROR, EXTENDED, REMOTE, Neighbour, command, content

from drivers.can.bus_state import BUS_OFF, CONTROLLER, PASSIVE_TX, RESTARTED, RX_OVERFLOW, BusError
from drivers.can.can_frame import RECEIVE_FILTER, Frame
from drivers.can.can_link import Link, open_links
from ident_service.errors import DriverError

Open = Callable[..., Link]
pytestmark = pytest.mark.timeout(900)  # of the guest's time, which goes on while it waits for a file of the host


@pytest.fixture(params=["raw", "socketcan"])
def opened(request: pytest.FixtureRequest) -> Iterator[Open]:
    """Opens links of either kind."""
    with ExitStack() as stack:

        def open_one(channel: str, **bus: object) -> Link:
            (link,) = open_links(arm_on_bus(interface=request.param, channel=channel, **bus))
            return stack.enter_context(closing(link))

        yield open_one


@pytest.fixture
def link(opened: Open, vcan: str) -> Link:
    """One on this test's interface."""
    return opened(vcan)


def test_the_kernel_lets_pass_what_the_filters_say(link: Link, neighbour: Neighbour) -> None:
    heard: list[Frame] = []
    for identifier in range(0x800):
        neighbour.send(identifier)
        neighbour.send(identifier | EXTENDED)
        if identifier % 64 == 63:  # before the queue is full
            heard += link.drain()
    wanted = [k for k in range(0x800) if any(k & mask == value & mask for value, mask in RECEIVE_FILTER)]
    assert {0x000, 0x080, 0x181, 0x281, 0x581, 0x701} <= set(wanted)
    assert content(heard) == [Frame(k) for k in wanted]


def test_frames_of_every_length_go_and_come(link: Link, neighbour: Neighbour) -> None:
    frames = [Frame(0x181 + n, bytes(range(n))) for n in range(9)] + [Frame(0x701, remote=True)]
    for frame in frames:
        link.send(frame)
    words = [(frame.identifier | REMOTE * frame.remote, frame.data) for frame in frames]
    assert neighbour.heard() == words
    before = link.clock.now_ns()
    for word, data in words:
        neighbour.send(word, data)
    heard = [link.receive(soon()) for _ in frames]
    assert content([frame for frame in heard if frame is not None]) == frames
    stamps = [frame.stamp_ns for frame in heard if frame is not None]
    assert stamps == sorted(stamps)
    # The clocks of wall and machine are read one after the other, so they may disagree by a little.
    assert before - 10_000_000 < stamps[0]
    assert stamps[-1] <= link.clock.now_ns()


def test_a_link_hears_another_of_this_machine_and_never_itself(opened: Open, vcan: str) -> None:
    one, other = opened(vcan), opened(vcan)
    one.send(Frame(0x080))
    assert content(tuple(other.drain())) == [Frame(0x080)]
    assert list(one.drain()) == []
    begun = time.monotonic_ns()
    assert one.receive(begun + 20_000_000) is None
    assert time.monotonic_ns() - begun >= 20_000_000


def test_error_frames_pass_the_filters_and_bus_off_ends_sending_until_a_restart(
    link: Link, neighbour: Neighbour
) -> None:
    # What a controller would say; a vcan has none, but hands on what is sent with this flag.
    passive = bytes((0, PASSIVE_TX, 0, 0, 0, 0, 130, 0))
    neighbour.send(ERROR | CONTROLLER, passive)
    assert content(tuple(link.drain())) == [Frame(CONTROLLER, passive, error=True)]
    link.send(Frame(0x080))
    neighbour.send(ERROR | BUS_OFF, bytes(8))
    assert content(tuple(link.drain())) == [Frame(BUS_OFF, bytes(8), error=True)]
    neighbour.heard()
    with pytest.raises(BusError, match="bus-off") as caught:
        link.send(Frame(0x080))
    assert caught.value.kind == "off"
    assert neighbour.heard() == []
    neighbour.send(ERROR | RESTARTED, bytes(8))
    assert content(tuple(link.drain())) == [Frame(RESTARTED, bytes(8), error=True)]
    link.send(Frame(0x080))
    assert neighbour.heard() == [(0x080, b"")]


def test_an_interface_that_goes_down_is_reported_with_the_remedy_and_works_again(
    link: Link, vcan: str, neighbour: Neighbour
) -> None:
    remedy = f"{vcan}: the interface is down; bring it up: `ip link set {vcan} up type can bitrate 1000000`"
    command("ip", "link", "set", vcan, "down")
    for call in (lambda: link.receive(soon()), lambda: link.send(Frame(0x080))):
        with pytest.raises(BusError, match=remedy) as caught:
            call()
        assert caught.value.kind == "down"
    command("ip", "link", "set", vcan, "up")
    with pytest.raises(OSError, match="Network is down"):  # it was told as well
        neighbour.heard()
    link.send(Frame(0x080))
    assert neighbour.heard() == [(0x080, b"")]
    neighbour.send(0x181)
    frame = link.receive(soon())
    assert frame is not None
    assert frame.identifier == 0x181


def test_an_interface_that_is_down_or_absent_cannot_be_opened(opened: Open, vcan: str) -> None:
    command("ip", "link", "set", vcan, "down")
    with pytest.raises(BusError, match="the interface is down; bring it up") as caught:
        opened(vcan)
    assert caught.value.kind == "down"
    for name in ("nowhere0", "a_name_that_is_longer_than_the_kernel_allows"):
        with pytest.raises(BusError, match=f"{name}: no such CAN interface") as caught:
            opened(name)
        assert caught.value.kind == "absent"


def test_an_interface_that_is_removed_has_gone(link: Link, vcan: str) -> None:
    command("ip", "link", "del", vcan)
    for call in (lambda: link.receive(soon()), lambda: link.send(Frame(0x080))):
        with pytest.raises(BusError, match=f"{vcan}: the interface has gone") as caught:
            call()
        assert caught.value.kind == "gone"


def test_a_full_transmit_queue_is_reported(link: Link, vcan: str, neighbour: Neighbour) -> None:
    # A queue without room for a single frame: each is refused with ENOBUFS, as by an adapter that nobody acknowledges.
    command("tc", "qdisc", "add", "dev", vcan, "root", "pfifo", "limit", "0")
    with pytest.raises(BusError, match="the transmit queue is full: no node acknowledges") as caught:
        link.send(Frame(0x080))
    assert caught.value.kind == "full"
    command("tc", "qdisc", "del", "dev", vcan, "root")
    link.send(Frame(0x080))
    assert neighbour.heard() == [(0x080, b"")]


def test_can_fd_is_refused_by_a_classic_interface_and_goes_over_the_other(opened: Open, vcan: str) -> None:
    with pytest.raises(BusError, match=f"{vcan}: carries no CAN FD: .*dbitrate 5000000 fd on`, or leave data_bitrate"):
        opened(vcan, data_bitrate=5_000_000)
    with pytest.raises(DriverError, match="at most 8 bytes, not 12"):
        opened(vcan).send(Frame(0x201, bytes(12)))
    command("ip", "link", "set", vcan, "down")
    command("ip", "link", "set", vcan, "mtu", "72", "up")
    one, other = (opened(vcan, data_bitrate=5_000_000) for _ in range(2))
    for frame in (Frame(0x201, bytes(range(64))), Frame(0x202, b"1234"), Frame(0x701, remote=True)):
        one.send(frame)
    # CAN FD has no remote frames (ISO 11898-1).
    assert content(tuple(other.drain())) == [
        Frame(0x201, bytes(range(64)), fd=True),
        Frame(0x202, b"1234", fd=True),
        Frame(0x701, remote=True),
    ]


def test_frames_that_nobody_fetched_in_time_are_reported_as_an_overflow(vcan: str, neighbour: Neighbour) -> None:
    (link,) = open_links(arm_on_bus(interface="raw", channel=vcan))
    with closing(link):
        for _ in range(4000):
            neighbour.send(0x181, bytes(8))
        kept = [frame for _ in range(10) for frame in link.drain()]
        assert 100 < len(kept) < 4000
        neighbour.send(0x182)  # the count comes with the next frame
        told = content(tuple(link.drain()))
        assert told == [Frame(CONTROLLER, bytes((0, RX_OVERFLOW, 0, 0, 0, 0, 0, 0)), error=True), Frame(0x182)]
        neighbour.send(0x183)
        assert content(tuple(link.drain())) == [Frame(0x183)]
