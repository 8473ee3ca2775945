"""Whether cycles come when they should.

A cycle begins at its stamp: torque begins to act and positions are taken. The answers come back now sooner, now later,
which is the driver's business as long as the next cycle begins in time; so an arm that stamps by the clock is judged by
its stamps alone. Stamps of a schedule say nothing of that; there, the end of the exchange is what can be measured.

Cycles are held against the schedule of the typical cycle, which it follows slowly, and not against that of the quickest
one: a loop that loses more than `LATE * FOLLOWS` of every period still falls behind it by more than is allowed.
"""

from __future__ import annotations

from ident_service.motion.faults import Fault, Findings

LATE = 0.25  # periods late that a cycle may be (FIELDBUS.md: OWD counts periods above 1.25 times the nominal one)
FOLLOWS = 1.0 / 32.0  # of the difference from the schedule that the schedule takes over, each cycle
LONGEST_GAP = 20  # periods without a cycle, through which nobody guarded the arm (libfranka's lost packets)


class Elapsed:
    """Seconds from one sample to the next, by their stamps.

    Where cycles come late or are skipped, velocities are differences over what has really passed. Stamps that make no
    sense are the guard's matter; nobody shall divide by them.
    """

    def __init__(self, period: float) -> None:
        """`period` [s] of the loop."""
        self._period, self._period_ns = period, round(period * 1e9)
        self._before_ns: int | None = None

    def __call__(self, stamp_ns: int) -> float:
        """The time since the last call's stamp [s], from half a period to `LONGEST_GAP`; a period at first."""
        gap_ns = self._period_ns if self._before_ns is None else stamp_ns - self._before_ns
        self._before_ns = stamp_ns
        return (
            self._period
            if gap_ns == self._period_ns
            else self._period * min(max(gap_ns / self._period_ns, 0.5), LONGEST_GAP)
        )


class Deadlines:
    """Watches one loop from its first cycle on.

    Attributes:
        lateness_ns: of the last cycle, against the typical one of those before it [ns].
        elapsed: from the sample before the last one to the last one [s], see `Elapsed`.
    """

    def __init__(self, findings: Findings, period: float, *, scheduled_stamps: bool = False) -> None:
        """Begin.

        Args:
            findings: makes the faults.
            period: of the loop [s].
            scheduled_stamps: what the arm says of its stamps (`ArmDescription`).
        """
        self.lateness_ns = 0
        self.elapsed = period
        self._of = Elapsed(period)
        self._findings = findings
        self._scheduled = scheduled_stamps
        self._period_ns = round(period * 1e9)
        self._late_ns = round(LATE * period * 1e9)
        self._stamp_ns: int | None = None
        self._woken_ns = 0
        self._expected_ns: int | None = None

    def cycle(self, stamp_ns: int, woken_ns: int) -> Fault | None:
        """Judge a cycle.

        Args:
            stamp_ns: of its sample [ns].
            woken_ns: the loop's clock after the exchange [ns].

        Returns:
            The fault found, if any.
        """
        period = self._period_ns
        self.elapsed = self._of(stamp_ns)
        came_ns = woken_ns if self._scheduled else stamp_ns
        off = 0 if self._expected_ns is None else came_ns - self._expected_ns
        self.lateness_ns = lateness = max(0, off)
        # After a whole period's lateness the schedule begins anew: nobody catches up with bursts.
        self._expected_ns = came_ns - off + round(FOLLOWS * off) + period if lateness < period else None
        before, self._stamp_ns = self._stamp_ns, stamp_ns
        woken_before, self._woken_ns = self._woken_ns, woken_ns
        if before is None:
            return None
        gap, slept = stamp_ns - before, woken_ns - woken_before
        if 0 < gap <= period + self._late_ns and lateness <= self._late_ns:
            return None
        if gap <= 0:
            return self._findings.found("clock_jump", f"consecutive stamps are {gap * 1e-6:g} ms apart")
        if slept > LONGEST_GAP * period:
            return self._findings.found("bus_silent", f"for {slept * 1e-6:g} ms there was no cycle")
        if gap > LONGEST_GAP * period:
            return self._findings.found("clock_jump", f"consecutive stamps are {gap * 1e-6:g} ms apart")
        late = max(gap - period, lateness)
        return self._findings.found("late_cycle", f"a cycle came {late * 1e-6:g} ms late")
