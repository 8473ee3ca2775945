"""The wire without sockets, in virtual time: bits, arbitration, pace, error confinement."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from link_bench import frames

from drivers.can.bus_load import exact_bits
from drivers.can.bus_state import BUS_OFF, CONTROLLER, COUNTERS, PASSIVE_RX, PASSIVE_TX, RESTARTED, WARNING_TX
from drivers.can.can_frame import RECEIVE_FILTER, Frame
from sim_backend.can_bus.hub import ERROR_BITS
from sim_backend.can_bus.medium import INBOX, QUEUE, BusEndpoint, Medium, priority


def bits_of(frame: Frame) -> str:
    """Start of frame to length code as ISO 11898-1 draws it, bit by bit."""
    remote = "1" if frame.remote else "0"
    if frame.extended:
        identifier = f"{frame.identifier:029b}"
        return f"0{identifier[:11]}11{identifier[11:]}{remote}00{len(frame.data):04b}"
    return f"0{frame.identifier:011b}{remote}00{len(frame.data):04b}"


def counted_bits(frame: Frame) -> int:
    """The same count, slowly: a shift register for the CRC, a counter for the stuffing."""
    bits = bits_of(frame) + "".join(f"{byte:08b}" for byte in frame.data)
    register = [0] * 15
    taps = (14, 10, 8, 7, 4, 3, 0)
    for bit in bits:
        feed = register[14] ^ int(bit)
        register = [feed if k == 0 else register[k - 1] ^ (feed if k in taps else 0) for k in range(15)]
    bits += "".join(str(bit) for bit in reversed(register))
    total, run, last = 0, 0, ""
    for bit in bits:
        run = run + 1 if bit == last else 1
        last, total = bit, total + 1
        if run == 5:
            last, run, total = "1" if bit == "0" else "0", 1, total + 1
    return total + 1 + 1 + 1 + 7 + 3


@given(frames())
def test_bits_of_a_frame_are_those_of_a_bit_by_bit_count(frame: Frame) -> None:
    assert exact_bits(frame).nominal == counted_bits(frame)


@given(frames())
def test_bits_of_a_standard_frame_lie_between_the_formulas(frame: Frame) -> None:
    if not frame.extended:
        n = len(frame.data)
        assert 47 + 8 * n <= exact_bits(frame).nominal <= 47 + 8 * n + (33 + 8 * n) // 4


def test_bits_of_a_sync() -> None:
    assert exact_bits(Frame(0x080)).nominal == 51  # FIELDBUS 2.1


@given(frames(), frames())
def test_who_wins_is_who_sends_the_first_dominant_bit(one: Frame, other: Frame) -> None:
    # Up to and including RTR of the longer; compared as text, 0 is dominant.
    first, second = bits_of(one)[:33], bits_of(other)[:33]
    decided = next(((a, b) for a, b in zip(first, second, strict=False) if a != b), None)
    if decided is not None and priority(one) != priority(other):
        assert (priority(one) < priority(other)) == (decided[0] < decided[1])


def on_wire(count: int, bitrate: int = 0) -> tuple[Medium, list[BusEndpoint]]:
    duration = (lambda frame: exact_bits(frame).nominal * 1_000_000_000 // bitrate) if bitrate else None
    medium = Medium(duration, ERROR_BITS * 1_000_000_000 // bitrate if bitrate else 0)
    ports = [BusEndpoint(f"port {k}") for k in range(count)]
    for port in ports:
        medium.add(port)
    return medium, ports


def heard(port: BusEndpoint) -> list[Frame]:
    return [frame for frame, _ in port.take()]


queues = st.lists(st.lists(frames(), max_size=12), min_size=1, max_size=5)


@given(queues, st.sampled_from([0, 125_000, 1_000_000]))
def test_waiting_frames_go_out_by_arbitration_of_the_first_of_each(drawn: list[list[Frame]], bitrate: int) -> None:
    medium, ports = on_wire(len(drawn) + 1, bitrate)
    for port, queue in zip(ports, drawn, strict=False):
        for frame in queue:
            assert medium.offer(port, frame, 0)
    medium.advance(10**12)
    expected, waiting = [], [list(queue) for queue in drawn]
    while any(waiting):
        best = min((queue for queue in waiting if queue), key=lambda queue: priority(queue[0]))
        expected.append(best.pop(0))
    found = heard(ports[-1])
    assert [frame._replace(stamp_ns=0) for frame in found] == expected
    assert medium.sent == len(expected)
    # Nobody hears itself, everybody hears all others.
    for port, queue in zip(ports, drawn, strict=False):
        assert len(heard(port)) == len(expected) - len(queue)


@pytest.mark.slow
@given(st.lists(frames(), min_size=1, max_size=40), st.lists(st.integers(0, 3000_000), min_size=40, max_size=40))
def test_the_pace_is_exact_however_late_the_host_looks(drawn: list[Frame], looks: list[int]) -> None:
    medium, (sender, listener) = on_wire(2, 1_000_000)
    for frame in drawn:
        medium.offer(sender, frame, 5_000)
    for now in sorted(looks):
        medium.advance(now)
        assert medium.end_ns is None or medium.end_ns > now
    medium.advance(10**12)
    found, end = heard(listener), 5_000
    for frame in found:
        end += counted_bits(frame) * 1000
        assert frame.stamp_ns == end
    assert len(found) == len(drawn)


def test_a_frame_under_way_is_not_broken_off_and_a_late_one_waits_its_turn() -> None:
    medium, (first, second, listener) = on_wire(3, 1_000_000)
    medium.offer(first, Frame(0x700), 0)
    medium.offer(first, Frame(0x701), 0)
    medium.advance(0)
    medium.offer(second, Frame(0x080), 10_000)  # more important than both, but the first one is under way
    medium.advance(10**9)
    assert [frame.identifier for frame in heard(listener)] == [0x700, 0x080, 0x701]


def test_a_frame_is_not_heard_before_its_end() -> None:
    medium, (sender, listener) = on_wire(2, 1_000_000)
    medium.offer(sender, Frame(0x080), 0)
    medium.advance(50_999)
    assert heard(listener) == []
    medium.advance(51_000)
    assert heard(listener) == [Frame(0x080, stamp_ns=51_000)]


def test_a_full_queue_takes_no_more() -> None:
    medium, (sender, _) = on_wire(2, 1_000_000)
    assert [medium.offer(sender, Frame(0x100), 0) for _ in range(QUEUE + 2)] == [True] * QUEUE + [False] * 2


def test_who_does_not_listen_loses_frames_and_is_warned_before_the_next_one() -> None:
    medium, (sender, listener) = on_wire(2)
    for k in range(INBOX + 5):
        medium.offer(sender, Frame(k % 0x700), k)
        medium.advance(k)
    assert listener.lost == 5
    assert len(heard(listener)) == INBOX
    medium.offer(sender, Frame(0x123), 10**9)
    medium.advance(10**9)
    told, frame = heard(listener)
    assert told.error
    assert (told.identifier, told.data[1]) == (CONTROLLER, 0x01)
    assert frame.identifier == 0x123


@pytest.mark.parametrize(
    ("filters", "wanted"), [(RECEIVE_FILTER, range(0x800)), (((0x080, 0x700), (0x700, 0x7FF)), (*range(0x100), 0x700))]
)
def test_a_port_hears_what_its_filters_say(filters: tuple[tuple[int, int], ...], wanted: Sequence[int]) -> None:
    medium = Medium()
    sender, listener = BusEndpoint("all"), BusEndpoint("driver", filters=filters)
    medium.add(sender)
    medium.add(listener)
    passed = []
    for identifier in range(0x800):
        medium.offer(sender, Frame(identifier), 0)
        medium.advance(0)
        passed += [frame.identifier for frame in heard(listener)]
    assert passed == list(wanted)
    medium.offer(sender, Frame(0x100, extended=True), 0)
    medium.advance(0)
    assert heard(listener) == []


def test_a_destroyed_frame_is_sent_again_and_costs_its_time() -> None:
    medium, (sender, listener) = on_wire(2, 1_000_000)
    medium.destroy_next(1, sender)
    medium.offer(sender, Frame(0x080), 0)
    medium.advance(10**9)
    assert heard(listener) == [Frame(0x080, stamp_ns=51_000 + 20_000 + 51_000)]
    assert (sender.counters.sending, listener.counters.receiving, medium.destroyed) == (7, 0, 1)


def test_a_controller_that_never_succeeds_warns_turns_passive_and_leaves_the_bus() -> None:
    medium, (sender, listener) = on_wire(2, 1_000_000)
    medium.destroy_next(1000, sender)
    medium.offer(sender, Frame(0x080), 0)
    medium.advance(10**12)
    told = heard(sender)
    assert [frame.identifier for frame in told] == [CONTROLLER | COUNTERS, CONTROLLER | COUNTERS, BUS_OFF]
    assert [frame.data[1] for frame in told[:2]] == [WARNING_TX, PASSIVE_TX]
    assert [frame.data[6] for frame in told[:2]] == [96, 128]
    assert all(a.stamp_ns < b.stamp_ns for a, b in pairwise(told))
    assert medium.destroyed == 32  # 256 / 8
    assert listener.counters.receiving == 32
    assert heard(listener) == []
    # Off the bus it neither sends nor hears, and knows nothing of it.
    assert medium.offer(sender, Frame(0x100), 10**12)
    medium.offer(listener, Frame(0x200), 10**12)
    medium.advance(2 * 10**12)
    assert heard(sender) == []
    assert heard(listener) == []
    medium.destroy_next(0, sender)
    medium.restart(sender, 3 * 10**12)
    medium.offer(sender, Frame(0x100), 3 * 10**12)
    medium.advance(4 * 10**12)
    assert [frame.identifier for frame in heard(sender)] == [RESTARTED]
    assert [frame.identifier for frame in heard(listener)] == [0x100]


def test_counters_set_by_hand_tell_the_state() -> None:
    medium, (port,) = on_wire(1)
    medium.set_counters(port, 0, 130, 5)
    (told,) = heard(port)
    assert (told.data[1], told.data[7], told.stamp_ns, port.counters.state) == (PASSIVE_RX, 130, 5, "passive")
    medium.set_counters(port, 0, 0, 6)
    assert heard(port)[0].data[1] == 0x40  # CAN_ERR_CRTL_ACTIVE


def test_two_nodes_of_one_number_are_counted() -> None:
    medium, (one, other, _) = on_wire(3)
    medium.offer(one, Frame(0x181, b"a"), 0)
    medium.offer(other, Frame(0x181, b"b"), 0)
    medium.advance(0)
    assert medium.collisions == 1


@pytest.mark.parametrize("bitrate", [0, 1_000_000])
def test_a_port_that_is_taken_off_leaves_the_others_working(bitrate: int) -> None:
    medium, (one, other, listener) = on_wire(3, bitrate)
    for _ in range(3):
        medium.offer(one, Frame(0x100), 0)
        medium.offer(other, Frame(0x200), 0)
    medium.advance(0)
    medium.remove(one)
    medium.advance(10**9)
    assert [frame.identifier for frame in heard(listener)].count(0x200) == 3
