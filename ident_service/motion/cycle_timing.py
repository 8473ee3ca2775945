"""Judge whether cycles come when they should, and count how late they were.

A cycle begins at its stamp: torque begins to act and positions are taken. The answers come back now sooner, now later,
which is the driver's business as long as the next cycle begins in time; so an arm that stamps by the clock is judged by
its stamps alone. Stamps of a schedule say nothing of that; there, the end of the exchange is what can be measured.

Cycles are held against the schedule of the typical cycle, which it follows slowly, and not against that of the quickest
one: a loop that loses more than `LATE * FOLLOWS` of every period still falls behind it by more than is allowed.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Iterable
from typing import Any

from drivers.arm import Watchdog
from ident_service.motion.faults import Fault, FaultCounter

_EDGES_US = (1, 2, 5, 10, 20, 50, 100, 150, 200, 300, 500, 1000, 2000, 5000, 10_000, 20_000, 50_000, 100_000)


class Histogram:
    """Count times in fixed bins.

    Attributes:
        count: number of entries.
        worst_ns: the longest [ns].
    """

    def __init__(self) -> None:
        self.count = 0
        self.worst_ns = 0
        self._edges = [1000 * edge for edge in _EDGES_US]
        self._counts = [0] * (len(_EDGES_US) + 1)

    def add(self, time_ns: int) -> None:
        """Count one time [ns]."""
        self.count += 1
        if time_ns > self.worst_ns:
            self.worst_ns = time_ns
        self._counts[bisect_left(self._edges, time_ns)] += 1

    def quantile_us(self, share: float) -> float:
        """Return the bin edge [us] that `share` of all times do not exceed; the longest time if in the last bin."""
        if self.count == 0:
            return 0.0
        seen = 0
        for edge, number in zip(_EDGES_US, self._counts, strict=False):
            seen += number
            if seen >= share * self.count:
                return float(edge)
        return self.worst_ns / 1e3

    def document(self) -> dict[str, Any]:
        """Return counts, bin edges, worst time and quantiles [us] as a dict for JSON."""
        return {
            "count": self.count,
            "worst_us": self.worst_ns / 1e3,
            "median_below_us": self.quantile_us(0.5),
            "p99_below_us": self.quantile_us(0.99),
            "p999_below_us": self.quantile_us(0.999),
            "edges_us": list(_EDGES_US),
            "counts": list(self._counts),
        }


# A stall that is survived, and the share of the cycles of a second that may be late or lost: the last torque stands
# meanwhile. libfranka goes on through 20 lost packets at 1 kHz, and calls a success rate below 95 % too low.
LONGEST_STALL, SUCCESS = 0.010, 0.95  # s, or one period where that is longer
LATE = 0.25  # periods late that a cycle may be (FIELDBUS.md: OWD counts periods above 1.25 times the nominal one)
FOLLOWS = 1.0 / 32.0  # of the difference from the schedule that the schedule takes over, each cycle
_MOST_UNKNOWN = 3  # cycles in a row without a velocity: two stalls, one after the other
LONGEST_GAP = 20  # periods without a cycle, in which the arm is not supervised (libfranka's lost packets)


def longest_stall(configured_stall: float | None, period: float, watchdogs: Iterable[Watchdog]) -> float:
    """Return the longest tolerated stall [s]: as configured or default, at most half of any watchdog and 19 periods.

    Args:
        configured_stall: `control.longest_stall` of the arm's description [s].
        period: of the loop [s].
        watchdogs: watchdogs of the drives. Half of the shortest time is the most: what comes late must not come too
            late. Nor is it more than nearly the gap that is called silence.
    """
    times = [one.seconds for one in watchdogs if one.seconds is not None]
    asked = max(LONGEST_STALL, period) if configured_stall is None else configured_stall
    return min([asked, (LONGEST_GAP - 1) * period, *(0.5 * time for time in times)])


class Elapsed:
    """Measure the seconds from one sample to the next, by their stamps.

    Where cycles come late or are skipped, velocities are differences over what has really passed. Stamps that make no
    sense are the guard's matter and are never divided by.

    Attributes:
        known: whether both samples were taken when their stamps say, so that a velocity can be told from them. Where
            that is not so again and again, stamps are believed all the same: a loop without a velocity has no damping.
    """

    def __init__(self, period: float) -> None:
        """Start with the loop's `period` [s]."""
        self._period, self._period_ns = period, round(period * 1e9)
        self._before_ns: int | None = None
        self._doubt_ns = self._unknown = 0
        self.known = True

    def __call__(self, stamp_ns: int, doubt_ns: int = 0) -> float:
        """Return the time since the last call's stamp [s], half a period to `LONGEST_GAP` periods; a period at first.

        Args:
            stamp_ns: stamp of a sample [ns].
            doubt_ns: how much earlier than its stamp the sample may have been taken [ns]; the time from one that was is
                the longest possible.
        """
        gap_ns = self._period_ns if self._before_ns is None else stamp_ns - self._before_ns
        self._unknown = 0 if doubt_ns == self._doubt_ns == 0 else self._unknown + 1
        self.known = self._unknown == 0 or self._unknown > _MOST_UNKNOWN
        gap_ns += 0 if self.known else self._doubt_ns
        self._before_ns, self._doubt_ns = stamp_ns, doubt_ns
        return (
            self._period
            if gap_ns == self._period_ns
            else self._period * min(max(gap_ns / self._period_ns, 0.5), LONGEST_GAP)
        )


class Deadlines:
    """Watch the timing of one loop from its first cycle on.

    Attributes:
        lateness_ns: lateness of the last cycle against the typical one of those before it [ns].
        elapsed: time between the last two samples, at most [s], see `Elapsed`.
        known: whether `elapsed` is the true time between them.
        lost: cycles that were late or never came, so far.
    """

    def __init__(
        self,
        findings: FaultCounter,
        period: float,
        *,
        scheduled_stamps: bool = False,
        longest_stall: float = LONGEST_STALL,
    ) -> None:
        """Start before the first cycle.

        Args:
            findings: counter that makes the faults.
            period: of the loop [s].
            scheduled_stamps: whether stamps are those of a schedule (`ArmDescription`).
            longest_stall: longest stall that a motion survives [s].
        """
        self.lateness_ns = self.lost = 0
        self.elapsed = period
        self._stall_ns = round(1e9 * longest_stall)
        self._most_lost = (1.0 - SUCCESS) / period
        self._recent: deque[tuple[int, int]] = deque()  # stamps [ns] of the last second, and cycles lost before each
        self._recently = 0
        self._of = Elapsed(period)
        self._findings = findings
        self._scheduled = scheduled_stamps
        self._period_ns = round(period * 1e9)
        self._late_ns = round(LATE * period * 1e9)
        self._stamp_ns: int | None = None
        self._woken_ns = self._doubt_ns = 0
        self._expected_ns: int | None = None

    @property
    def elapsed_is_exact(self) -> bool:
        """Return whether `elapsed` is the true time between the last two samples, else the longest it may be."""
        return self._of.known

    def judge_cycle(self, stamp_ns: int, woken_ns: int, stamp_doubt_ns: int = 0) -> Fault | None:
        """Judge a cycle's timing; return its fault if it is late, after a silence or its stamp jumped, else None.

        Args:
            stamp_ns: of its sample [ns].
            woken_ns: the loop's clock after the exchange [ns].
            stamp_doubt_ns: how much earlier than its stamp the sample may have been taken [ns].
        """
        period = self._period_ns
        self.elapsed = self._of(stamp_ns, stamp_doubt_ns)
        came_ns = woken_ns if self._scheduled else stamp_ns
        off = 0 if self._expected_ns is None else came_ns - self._expected_ns
        self.lateness_ns = lateness = max(0, off)
        # Slots that were left out are not caught up with: the schedule goes on from the nearest one.
        beside = off - round(lateness / period) * period
        self._expected_ns = came_ns - beside + round(FOLLOWS * beside) + period
        doubted_ns, self._doubt_ns = self._doubt_ns, stamp_doubt_ns
        before, self._stamp_ns = self._stamp_ns, stamp_ns
        woken_before, self._woken_ns = self._woken_ns, woken_ns
        if before is None:
            return None
        gap, slept = stamp_ns - before, woken_ns - woken_before
        in_time = gap <= period + self._late_ns and lateness <= self._late_ns and not stamp_doubt_ns
        if in_time and gap + doubted_ns > 0:
            return None
        if gap + doubted_ns <= 0:
            return self._findings.count_fault("clock_jump", f"consecutive stamps are {gap * 1e-6:g} ms apart")
        if slept > LONGEST_GAP * period:
            return self._findings.count_fault("bus_silent", f"for {slept * 1e-6:g} ms there was no cycle")
        if gap > LONGEST_GAP * period:
            return self._findings.count_fault("clock_jump", f"consecutive stamps are {gap * 1e-6:g} ms apart")
        return self._late(stamp_ns, max(gap - period, lateness, stamp_doubt_ns))

    def _late(self, stamp_ns: int, late_ns: int) -> Fault:
        """Count a late cycle and the cycles lost before it; too long a stall, or too many lost cycles, are a fault."""
        lost = max(1, round(late_ns / self._period_ns))
        self.lost += lost
        self._recent.append((stamp_ns, lost))
        self._recently += lost
        while self._recent[0][0] <= stamp_ns - 1_000_000_000:
            self._recently -= self._recent.popleft()[1]
        found = self._findings.count_fault("late_cycle", f"a cycle came {late_ns * 1e-6:g} ms late")
        if late_ns > self._stall_ns:
            what = f"this computer stalled for {late_ns * 1e-6:.3g} ms, {self._stall_ns * 1e-6:g} ms are tolerated"
            return self._findings.count_fault("late_cycles", what)
        if self._recently > self._most_lost:
            within = f"{self._recently} of the {1e9 / self._period_ns:.0f} cycles of a second"
            what = f"this computer delayed or lost {within}, {self._most_lost:.0f} are tolerated"
            return self._findings.count_fault("late_cycles", what)
        return found
