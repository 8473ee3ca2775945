"""Late cycles are measured and counted; gaps in time end the motion."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from drivers.arm import Watchdog
from ident_service.motion.cycle_timing import LATE, LONGEST_GAP, LONGEST_STALL, Deadlines, Elapsed, longest_stall
from ident_service.motion.faults import WINDOW, Fault, FaultCounter

MS = 1_000_000


class Times:
    """Deadlines, and cycles that come one period after another unless something else is said."""

    def __init__(self, *, scheduled: bool = True) -> None:
        self.deadlines = Deadlines(FaultCounter(), 1e-3, scheduled_stamps=scheduled)
        self.stamp = self.woken = 0
        self.cycle()

    def cycle(self, stamp: int = MS, woken: int = MS) -> Fault | None:
        self.stamp += stamp
        self.woken += woken
        self.deadlines._findings.cycle += 1
        return self.deadlines.judge_cycle(self.stamp, self.woken)


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


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_stamps_of_the_clock_say_all_about_lateness(share: float) -> None:
    late = round(share * LATE * MS)
    times = Times(scheduled=False)
    assert code(times.cycle(MS + late, MS)) == ("late_cycle" if share > 1.0 else None)
    assert times.deadlines.lateness_ns == late


def test_answers_that_come_late_are_not_late_cycles_while_the_next_cycle_begins_in_time() -> None:
    times = Times(scheduled=False)
    answers = [0, 0.9, 0.1, 0.6, 0.0] * 40  # of a period after the stamp
    for before, after in itertools.pairwise(answers):
        assert times.cycle(MS, MS + round((after - before) * MS)) is None
        assert times.deadlines.lateness_ns == 0


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
        assert found.index("late_cycles") == 5 * 50  # more than a twentieth of the 1000 cycles of a second


def test_a_stall_of_ten_milliseconds_is_survived_and_a_longer_one_is_named() -> None:
    for scheduled in (False, True):
        times = Times(scheduled=scheduled)
        assert code(times.cycle(11 * MS, 11 * MS)) == "late_cycle"
        assert times.deadlines.lost == 10
        fault = times.cycle(11 * MS + 1, 11 * MS + 1)
        assert code(fault) == "late_cycles"
        assert fault is not None
        assert fault.message.startswith("this computer stalled for 10 ms, 10 ms are tolerated")


@pytest.mark.parametrize("skipped", [0.9, 1.0, 1.1, 2.95])
def test_a_slot_that_is_left_out_makes_no_cycle_after_it_late(skipped: float) -> None:
    times, step = Times(scheduled=False), round((1.0 + skipped) * MS)
    assert code(times.cycle(step)) == "late_cycle"
    assert {code(times.cycle()) for _ in range(100)} == {None}
    assert times.deadlines.lost == round(skipped)


def test_stalls_of_a_second_are_added_up_and_forgotten_after_it() -> None:
    times = Times(scheduled=False)
    for _ in range(5):
        assert code(times.cycle(11 * MS)) == "late_cycle"
        assert {code(times.cycle()) for _ in range(150)} == {None}
    assert {code(times.cycle()) for _ in range(300)} == {None}  # the first of the five is more than a second ago
    assert code(times.cycle(11 * MS)) == "late_cycle"
    assert {code(times.cycle()) for _ in range(50)} == {None}
    fault = times.cycle(3 * MS)
    assert code(fault) == "late_cycles"
    assert fault is not None
    assert fault.message.startswith("this computer delayed or lost 52 of the 1000 cycles of a second, 50 are")


@pytest.mark.parametrize(
    ("described", "period", "watchdogs", "longest"),
    [
        (None, 0.002, (), LONGEST_STALL),
        (None, 0.02, (), 0.02),
        (0.004, 0.002, (None, 0.1), 0.004),
        (0.02, 0.002, (0.1, 0.03), 0.015),
        (0.02, 0.001, (), 0.019),
        (None, 0.0004, (), 0.0076),
    ],
)
def test_the_longest_stall_is_described_and_never_more_than_half_of_what_drives_wait(
    described: float | None, period: float, watchdogs: tuple[float | None, ...], longest: float
) -> None:
    drives = [Watchdog("drive", "rpdo_timer", seconds) for seconds in watchdogs]
    assert longest_stall(described, period, drives) == pytest.approx(longest)


def test_a_stamp_that_may_be_too_late_tells_no_velocity() -> None:
    elapsed = Elapsed(2e-3)
    assert (elapsed(0), elapsed.known) == (2e-3, True)
    # Stamped 13 ms after the sample may have been taken; the next one comes soon after that stamp.
    assert elapsed(15 * MS, 13 * MS) == pytest.approx(15e-3)
    assert not elapsed.known
    assert elapsed(17 * MS) == pytest.approx(15e-3)
    assert not elapsed.known
    assert (elapsed(19 * MS), elapsed.known) == (2e-3, True)


def test_a_computer_that_is_always_in_doubt_is_too_late_and_its_stamps_are_believed_at_last() -> None:
    deadlines, known, codes = Deadlines(FaultCounter(), 1e-3), [], []
    for cycle in range(100):
        codes.append(code(deadlines.judge_cycle(cycle * MS, cycle * MS + MS // 2, 300_000 if cycle else 0)))
        known.append(deadlines.elapsed_is_exact)
    assert codes.index("late_cycles") == 51
    assert known == [True] + 3 * [False] + 96 * [True]
    assert deadlines.elapsed == 1e-3


@pytest.mark.parametrize(("gap", "told"), [(0, "0 ms"), (-MS, "-1 ms"), (LONGEST_GAP * MS + 1, "20 ms")])
def test_stamps_that_jump_cannot_be_trusted(gap: int, told: str) -> None:
    fault = Times().cycle(gap, MS)
    assert code(fault) == "clock_jump"
    assert fault is not None
    assert told in fault.message


def test_a_long_silence_is_one_whatever_the_stamps_say() -> None:
    for stamp in (MS, LONGEST_GAP * MS + 1):
        assert code(Times().cycle(stamp, LONGEST_GAP * MS + 1)) == "bus_silent"
    assert code(Times().cycle(LONGEST_GAP * MS, LONGEST_GAP * MS)) == "late_cycles"


@pytest.mark.parametrize("scheduled", [False, True])
def test_the_first_cycle_has_no_schedule(scheduled: bool) -> None:
    deadlines = Deadlines(FaultCounter(), 1e-3, scheduled_stamps=scheduled)
    assert deadlines.judge_cycle(10**12, 10**15) is None
    assert deadlines.lateness_ns == 0


def test_answers_that_come_now_sooner_now_later_are_not_late_while_stamps_are_in_time() -> None:
    times, draw = Times(), np.random.default_rng(1)
    after = draw.uniform(-0.2, 0.2, 5000) * MS
    steps = np.rint(MS + np.diff(after, prepend=0.0)).astype(int).tolist()
    assert {code(times.cycle(MS, step)) for step in steps[500:]} == {None}


@pytest.mark.parametrize(("lost", "keeps"), [(0.002, True), (0.02, False)])
@pytest.mark.parametrize("scheduled", [False, True])
def test_a_loop_that_loses_a_little_of_every_period_does_not_keep_the_rate(
    scheduled: bool, lost: float, keeps: bool
) -> None:
    times, late = Times(scheduled=scheduled), MS + round(lost * MS)
    found = {code(times.cycle(MS if scheduled else late, late)) for _ in range(1000)}
    assert ("late_cycles" not in found) == keeps


def test_the_time_between_samples_is_that_of_their_stamps() -> None:
    elapsed = Elapsed(2e-3)
    assert elapsed(10**15) == 2e-3
    assert elapsed(10**15 + 2 * MS) == 2e-3
    assert elapsed(10**15 + 9 * MS) == pytest.approx(7e-3)


@pytest.mark.parametrize(("gap", "periods"), [(0, 0.5), (-5 * MS, 0.5), (10**12, LONGEST_GAP)])
def test_nobody_divides_by_stamps_that_make_no_sense(gap: int, periods: float) -> None:
    elapsed = Elapsed(2e-3)
    elapsed(10**15)
    assert elapsed(10**15 + gap) == pytest.approx(periods * 2e-3)
