"""Schedule the beginnings of cycles, and the stamps of their samples.

Two ways to be late. Where the plant only moves with cycles, the schedule moves back by the lateness and stamps stay
exactly one period apart. Where the plant moves by the machine's clock, a period that is over is skipped, and the
stamps say so. Neither ever catches up with a burst of short cycles.

Faults of time act here (late cycles, jumps of the clock).
"""

from __future__ import annotations

from collections.abc import Sequence

from drivers.clock import Clock
from sim_backend.faults import Fault, FaultKind, active_faults


class Schedule:
    """Schedule cycles one period apart on one clock."""

    def __init__(self, clock: Clock, period_ns: int, *, skips: bool) -> None:
        """Start before the first cycle.

        Args:
            clock: the loop's.
            period_ns: from cycle to cycle [ns].
            skips: whether periods that are over are skipped, instead of moving the schedule back.
        """
        self._clock = clock
        self._period_ns = period_ns
        self._skips = skips
        self.restart()

    def restart(self) -> None:
        """Start again before the first cycle."""
        self._first_ns: int | None = None
        self.stamp_ns = self._slip_ns = 0

    @property
    def tick(self) -> int:
        """Return the periods from the first stamp to the present one."""
        return 0 if self._first_ns is None else (self.stamp_ns - self._first_ns) // self._period_ns

    def wait(self, faults: Sequence[Fault]) -> int:
        """Wait for the next cycle to begin; returns its true stamp [ns]."""
        now = self._clock.now_ns()
        if self._first_ns is None:
            self._first_ns = self.stamp_ns = now
        else:
            self.stamp_ns += self._period_ns
            if not self._skips:
                self._slip_ns = max(self._slip_ns, now - self.stamp_ns)
        late = sum(fault.size for fault in active_faults(faults, self.tick) if fault.kind is FaultKind.LATE_CYCLE)
        self._clock.sleep_until_ns(self.stamp_ns + self._slip_ns + round(late * 1e9))
        if self._skips:
            self.stamp_ns += max(0, self._clock.now_ns() - self.stamp_ns) // self._period_ns * self._period_ns
        return self.stamp_ns

    def shown_ns(self, faults: Sequence[Fault]) -> int:
        """Return the stamp that a sample gives for the present cycle [ns]."""
        jumps = [fault.size for fault in active_faults(faults, self.tick) if fault.kind is FaultKind.CLOCK_JUMP]
        return self.stamp_ns + round(sum(jumps) * 1e9)
