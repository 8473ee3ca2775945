"""Positions that come later than a period, or not at all: their age is what it truly is, on either fieldbus."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import pytest
from contract_bench import PERIOD_NS, canopen_config, pucks_config

from drivers.arm import Arm, Sample
from drivers.axis_status import AxisEventCode
from drivers.barrett.driver import BarrettArm
from drivers.barrett.protocol import position_frame
from drivers.can.can_frame import Frame
from drivers.canopen.driver import CanopenArm
from drivers.clock import Clock
from ident_service.errors import DriverError
from sim_backend.emulator.lock_step import LockStepArm, LockStepLink

NONE = np.zeros(2)
POSITIONS = (0x181, position_frame(1, 0).identifier)  # of the first joint's drive or puck


class DelayingLink:
    """A bus on which the first joint's positions take longer, or get lost.

    Attributes:
        delay: how much longer one takes, None for one that is lost [ns].
    """

    def __init__(self, inner: LockStepLink) -> None:
        self._inner = inner
        self._held: list[Frame] = []
        self.delay: Callable[[Frame], int | None] = lambda frame: 0

    @property
    def clock(self) -> Clock:
        return self._inner.clock

    def send(self, frame: Frame) -> None:
        self._inner.send(frame)

    def receive(self, deadline_ns: int) -> Frame | None:
        while True:
            until_ns = min(deadline_ns, self._held[0].stamp_ns) if self._held else deadline_ns
            frame = self._inner.receive(until_ns)
            if frame is not None and self._passes(frame):
                return frame
            if frame is None and self._held and self._held[0].stamp_ns <= self.clock.now_ns():
                return self._held.pop(0)
            if frame is None and until_ns == deadline_ns:
                return None

    def drain(self) -> Sequence[Frame]:
        heard = [frame for frame in self._inner.drain() if self._passes(frame)]
        while self._held and self._held[0].stamp_ns <= self.clock.now_ns():
            heard.append(self._held.pop(0))
        return heard

    def close(self) -> None:
        self._inner.close()

    def _passes(self, frame: Frame) -> bool:
        if frame.identifier not in POSITIONS or frame.error:
            return True
        delay = self.delay(frame)
        if delay:
            self._held.append(frame._replace(stamp_ns=frame.stamp_ns + delay))
        return delay == 0


@contextmanager
def running(kind: str, *, late: int = 0) -> Iterator[tuple[Arm, DelayingLink]]:
    """An enabled arm, and its bus, whose positions are `late` [ns] from the beginning."""
    config = canopen_config() if kind == "canopen" else pucks_config(emulation={"zeroed": True})
    behind, links = LockStepArm(config), list[DelayingLink]()

    def opened(_: object) -> list[DelayingLink]:
        links.append(DelayingLink(behind.link(0)))
        links[0].delay = lambda frame: late
        return links

    with CanopenArm(config, opened) if kind == "canopen" else BarrettArm(config, opened) as arm:
        arm.enable()
        for _ in range(100):
            arm.exchange(np.array([5.0, 0.0]))
        arm.exchange(NONE)  # at 1 rad/s, 2 mrad a cycle
        yield arm, links[0]


def ages(samples: Sequence[Sample]) -> list[int]:
    return [int(sample.age[0]) for sample in samples]


KINDS = pytest.mark.parametrize("kind", ["canopen", "pucks"])


@KINDS
@pytest.mark.parametrize("cycles", [1, 2])
def test_a_node_whose_answers_have_become_late_by_cycles_is_told_to_be_that_old(kind: str, cycles: int) -> None:
    with running(kind) as (arm, link):
        link.delay = lambda frame: round((cycles + 0.4) * PERIOD_NS)
        samples = [arm.exchange(NONE) for _ in range(12)]
        link.delay = lambda frame: 0
        after = [arm.exchange(NONE) for _ in range(3)]
    # Two of them may have been an answer behind lost ones, and count as one; no more.
    assert ages(samples) == [*range(1, cycles + 1), 0, 0, *[cycles] * (10 - cycles)]
    assert all(bool(sample.valid[0]) == (sample.age[0] == 0) for sample in samples)
    assert all(bool(sample.valid[1]) for sample in samples)
    told = [event for sample in samples[cycles + 2 :] for event in sample.events]
    assert {(event.code, event.axis) for event in told} == {(AxisEventCode.STRANGE_FRAME, 0)}
    assert told[-1].words.endswith(f"its position is {cycles} cycles old")
    assert ages(after) == [0, 0, 0]
    # The arm moves at constant speed without torque: a position that is late is where it was then.
    late, now = samples[-1].position[0], after[0].position[0]
    speed = after[1].position[0] - now
    assert speed > 1e-3
    assert now - late == pytest.approx((cycles + 1) * speed, abs=3e-4)


@KINDS
def test_an_answer_behind_a_lost_one_is_as_new_as_ever(kind: str) -> None:
    with running(kind) as (arm, link):
        found = []
        for _ in range(5):
            link.delay = lambda frame: None
            found.append(arm.exchange(NONE))
            link.delay = lambda frame: 0
            found.append(arm.exchange(NONE))
    assert ages(found) == [1, 0] * 5
    assert not [event for sample in found for event in sample.events]


@KINDS
def test_of_a_late_answer_and_one_in_time_the_second_counts(kind: str) -> None:
    with running(kind) as (arm, link):
        sample = arm.exchange(NONE)
        before, soon = sample.position[0], sample.stamp_ns + round(2.02 * PERIOD_NS)
        link.delay = lambda frame: soon - frame.stamp_ns  # in the next cycle, sooner than an answer to it can come
        missed = arm.exchange(NONE)
        link.delay = lambda frame: round(0.3 * PERIOD_NS)
        both = arm.exchange(NONE)
        link.delay = lambda frame: 0
        after = arm.exchange(NONE).position[0]
    assert ages([missed, both]) == [1, 0]
    assert after - before > 3e-3
    assert both.position[0] - before == pytest.approx(2 / 3 * (after - before), abs=3e-4)


@KINDS
def test_a_node_that_stalls_and_answers_the_last_request_alone_is_not_late(kind: str) -> None:
    """Take one answer at an unusual time for the latest: a drive whose processor was busy gives only that one."""
    with running(kind) as (arm, link):
        link.delay = lambda frame: None
        silent = [arm.exchange(NONE) for _ in range(2)]
        link.delay = lambda frame: round(0.5 * PERIOD_NS)
        first = arm.exchange(NONE)
        link.delay = lambda frame: 0
        after = [arm.exchange(NONE) for _ in range(5)]
    assert ages([*silent, first, *after]) == [1, 2, 0, 0, 0, 0, 0, 0]


@KINDS
def test_answers_that_are_late_from_the_beginning_open_no_arm(kind: str) -> None:
    with pytest.raises(DriverError, match=r"answer .*in time"), running(kind, late=round(1.2 * PERIOD_NS)):
        pass
