"""Late cycles are measured and counted; gaps in time end the motion."""

from __future__ import annotations

import numpy as np
import pytest

from ident_service.motion.deadlines import LATE, LONGEST_GAP, Deadlines
from ident_service.motion.faults import FAULTS, WINDOW, Fault, Findings

MS = 1_000_000


class Times:
    """Deadlines, and cycles that come one period after another unless something else is said."""

    def __init__(self) -> None:
        self.deadlines = Deadlines(Findings(), 1e-3)
        self.stamp = self.woken = 0
        self.cycle()

    def cycle(self, stamp: int = MS, woken: int = MS) -> Fault | None:
        self.stamp += stamp
        self.woken += woken
        self.deadlines._findings.cycle += 1
        return self.deadlines.cycle(self.stamp, self.woken)


def code(fault: Fault | None) -> str | None:
    return None if fault is None else fault.code


def test_cycles_in_time_are_nothing() -> None:
    times = Times()
    assert [times.cycle() for _ in range(1000)] == [None] * 1000
    assert times.deadlines.lateness_ns == 0


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_the_threshold_of_lateness(share: float) -> None:
    late = round(share * LATE * MS)
    for stamp, woken in ((MS, MS + late), (MS + late, MS + late), (MS + late, MS)):
        times = Times()
        fault = times.cycle(stamp, woken)
        assert code(fault) == ("late_cycle" if share > 1.0 else None)
        assert times.deadlines.lateness_ns == woken - MS


def test_lateness_counts_from_the_schedule_and_a_burst_is_not_late() -> None:
    times = Times()
    assert code(times.cycle(MS, MS + 400_000)) == "late_cycle"
    assert times.cycle(MS, MS - 400_000) is None
    assert times.cycle() is None


def test_after_a_whole_period_the_schedule_begins_anew() -> None:
    times = Times()
    assert code(times.cycle(MS, 4 * MS)) == "late_cycle"
    assert times.deadlines.lateness_ns == 3 * MS
    assert [times.cycle() for _ in range(5)] == [None] * 5


@pytest.mark.parametrize("apart", [20, 5])
def test_every_twentieth_cycle_may_be_late_but_not_more(apart: int) -> None:
    times, late = Times(), {0: 400_000, 1: -400_000}
    found = [code(times.cycle(MS, MS + late.get(cycle % apart, 0))) for cycle in range(10 * WINDOW)]
    if apart == 20:
        assert set(found) == {None, "late_cycle"}
    else:
        assert found.index("late_cycles") == 25
    assert FAULTS["late_cycle"].often == 5


@pytest.mark.parametrize(("gap", "told"), [(0, "0 ms"), (-MS, "-1 ms"), (LONGEST_GAP * MS + 1, "20 ms")])
def test_stamps_that_jump_cannot_be_trusted(gap: int, told: str) -> None:
    fault = Times().cycle(gap, MS)
    assert code(fault) == "clock_jump"
    assert fault is not None
    assert told in fault.message


def test_a_long_silence_is_one_whatever_the_stamps_say() -> None:
    for stamp in (MS, LONGEST_GAP * MS + 1):
        assert code(Times().cycle(stamp, LONGEST_GAP * MS + 1)) == "bus_silent"
    assert code(Times().cycle(LONGEST_GAP * MS, LONGEST_GAP * MS)) == "late_cycle"


def test_the_first_cycle_has_no_schedule() -> None:
    deadlines = Deadlines(Findings(), 1e-3)
    assert deadlines.cycle(10**12, 10**15) is None
    assert deadlines.lateness_ns == 0


def test_answers_that_come_now_sooner_now_later_are_not_late_while_stamps_are_in_time() -> None:
    times, draw = Times(), np.random.default_rng(1)
    after = draw.uniform(-0.2, 0.2, 5000) * MS
    steps = np.rint(MS + np.diff(after, prepend=0.0)).astype(int).tolist()
    assert {code(times.cycle(MS, step)) for step in steps[500:]} == {None}


@pytest.mark.parametrize(("lost", "keeps"), [(0.002, True), (0.02, False)])
def test_a_loop_that_loses_a_little_of_every_period_does_not_keep_the_rate(lost: float, keeps: bool) -> None:
    times = Times()
    found = {code(times.cycle(MS, MS + round(lost * MS))) for _ in range(1000)}
    assert ("late_cycles" not in found) == keeps
