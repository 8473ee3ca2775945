"""Uploads from many nodes at once: in bursts that a small queue holds, and whatever is answered."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.can.can_frame import Frame
from drivers.canopen import object_dictionary as od
from drivers.canopen.sdo import BURST, Answers, poll, upload_request
from drivers.clock import VirtualClock

MS = 1_000_000


class Nodes:
    """A bus whose nodes answer by a function, one frame every millisecond."""

    def __init__(self, clock: VirtualClock, answer: Callable[[int], Frame | None]) -> None:
        self.clock, self.answer = clock, answer
        self.waiting: list[Frame] = []
        self.unanswered = 0
        self.most = 0

    def send(self, frame: Frame) -> None:
        assert frame == Frame(frame.identifier, upload_request(od.POSITION))
        self.unanswered += 1
        self.most = max(self.most, self.unanswered)
        if (reply := self.answer(frame.identifier - 0x600)) is not None:
            self.waiting.append(reply)

    def receive(self, deadline_ns: int) -> Frame | None:
        if self.waiting and self.clock.now_ns() + MS <= deadline_ns:
            self.clock.sleep_until_ns(self.clock.now_ns() + MS)
            self.unanswered -= 1
            return self.waiting.pop(0)
        self.clock.sleep_until_ns(deadline_ns)
        self.unanswered = 0
        return None

    def drain(self) -> Sequence[Frame]:
        return ()

    def close(self) -> None:
        """Nothing."""


def position(node: int, value: int) -> Frame:
    return Frame(0x580 + node, struct.pack("<BHBi", 0x43, 0x6064, 0, value))


def test_many_nodes_are_queried_in_bursts_on_both_buses() -> None:
    clock = VirtualClock()
    links = [Nodes(clock, lambda n: position(n, 10 * n)), Nodes(clock, lambda n: position(n, -n) if n % 5 else None)]
    places = [(bus, node) for bus in (0, 1) for node in range(1, 21)]
    found = poll(links, places, od.POSITION, 300 * MS)
    assert found.values == {(0, n): 10 * n for n in range(1, 21)} | {(1, n): -n for n in range(1, 21) if n % 5}
    assert found.aborts == {}
    assert max(link.most for link in links) == BURST
    assert clock.now_ns() <= 300 * MS


def test_who_does_not_answer_costs_the_time_that_was_given_and_no_more() -> None:
    clock = VirtualClock(7 * MS)
    assert poll([Nodes(clock, lambda _: None)], [(0, 1), (0, 2)], od.POSITION, 50 * MS) == Answers()
    assert clock.now_ns() == 50 * MS
    assert poll([Nodes(clock, lambda _: None)], [], od.POSITION, 90 * MS) == Answers()
    assert clock.now_ns() == 50 * MS


@pytest.mark.parametrize(
    ("data", "value", "abort"),
    [
        (struct.pack("<BHBi", 0x43, 0x6064, 0, -5), -5, None),
        (struct.pack("<BHBi", 0x42, 0x6064, 0, -5), -5, None),  # without a size: as many bytes as the type has
        (struct.pack("<BHBI", 0x80, 0x6064, 0, 0x08000022), None, 0x08000022),
        (struct.pack("<BHBi", 0x4B, 0x6064, 0, 5), None, 0),  # two bytes for a type of four
        (struct.pack("<BHBi", 0x41, 0x6064, 0, 5), None, 0),  # would come in segments
        (struct.pack("<BHBi", 0x60, 0x6064, 0, 5), None, None),  # the answer to a download
        (struct.pack("<BHBi", 0x43, 0x6041, 0, 5), None, None),  # of another entry, late
        (struct.pack("<BHBi", 0x43, 0x6064, 1, 5), None, None),
        (b"\x43\x64\x60", None, None),
    ],
)
def test_only_an_answer_to_the_question_is_one(data: bytes, value: int | None, abort: int | None) -> None:
    others: list[tuple[int, Frame]] = []
    frame = Frame(0x581, data)
    link = Nodes(VirtualClock(), lambda _: frame)
    found = poll([link], [(0, 1)], od.POSITION, 10 * MS, lambda bus, other: others.append((bus, other)))
    assert found.values == ({} if value is None else {(0, 1): value})
    assert found.aborts == ({} if abort is None else {(0, 1): abort})
    assert others == ([(0, frame)] if value is None and abort is None else [])


@given(
    identifier=st.integers(0, 0x7FF),
    data=st.binary(max_size=8),
    kind=st.sampled_from(["", "remote", "error", "extended"]),
)
def test_any_frame_may_come_meanwhile(identifier: int, data: bytes, kind: str) -> None:
    frame = Frame(identifier, data, **({kind: True} if kind else {}))
    link = Nodes(VirtualClock(), lambda _: frame)
    found = poll([link], [(0, 1)], od.POSITION, 10 * MS)
    assert found.values.keys() | found.aborts.keys() <= {(0, 1)}
    assert not (found.values and kind)
