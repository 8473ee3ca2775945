"""Whether cycles come when they should, by the loop's clock and by the samples' stamps.

An exchange ends when its answers have come, and on a bus they come now sooner, now later, while SYNC goes out on time.
So the schedule of the loop's clock is that of the typical cycle, which it follows slowly, and not that of the quickest
one: a loop that loses more than `LATE * FOLLOWS` of every period still falls behind it by more than is allowed.
"""

from __future__ import annotations

from ident_service.motion.faults import Fault, Findings

LATE = 0.25  # periods late that a cycle may be (FIELDBUS.md: OWD counts periods above 1.25 times the nominal one)
FOLLOWS = 1.0 / 32.0  # of the difference from the schedule that the schedule takes over, each cycle
LONGEST_GAP = 20  # periods without a cycle, through which nobody guarded the arm (libfranka's lost packets)


class Deadlines:
    """Watches one loop from its first cycle on.

    Attributes:
        lateness_ns: of the last cycle, against the typical one of those before it [ns].
    """

    def __init__(self, findings: Findings, period: float) -> None:
        """`period` [s] of the loop."""
        self.lateness_ns = 0
        self._findings = findings
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
        off = 0 if self._expected_ns is None else woken_ns - self._expected_ns
        self.lateness_ns = lateness = max(0, off)
        # After a whole period's lateness the schedule begins anew: nobody catches up with bursts.
        self._expected_ns = woken_ns - off + round(FOLLOWS * off) + period if lateness < period else None
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
