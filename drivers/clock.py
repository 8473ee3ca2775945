"""Define the clocks that a loop can run on: the machine's, or a virtual one that jumps to each deadline.

Everything that knows time takes one of these, so that leases, watchdogs and deadlines agree and a loop behaves the
same in real and in virtual time.
"""

from __future__ import annotations

import os
import time
from typing import Final, Protocol

from ident_service.errors import UsageError

EPOCH: Final = "SOURCE_DATE_EPOCH"  # of reproducible-builds.org: s since 1970


class Clock(Protocol):
    """Define a clock of monotonic time in integer nanoseconds."""

    @property
    def lock_step(self) -> bool:
        """Return whether time stands still until it is told to move, so that a consumer may be waited for."""

    @property
    def utc_offset_ns(self) -> int:
        """Return what to add to `now_ns` to get nanoseconds since 1970 in UTC."""

    def now_ns(self) -> int:
        """Return the monotonic time [ns]."""

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Wait until `deadline_ns`; return at once when it has passed."""


class RealClock:
    """Read the machine's monotonic clock."""

    lock_step = False

    def __init__(self) -> None:
        self.utc_offset_ns = time.time_ns() - time.monotonic_ns()

    def now_ns(self) -> int:
        """Return the monotonic time [ns]."""
        return time.monotonic_ns()

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Sleep until the absolute deadline."""
        while (remaining := deadline_ns - time.monotonic_ns()) > 0:
            time.sleep(remaining * 1e-9)


class VirtualClock:
    """Simulate time that jumps to whatever is waited for; `utc_offset_ns` is fixed so that runs repeat to the byte."""

    lock_step = True

    def __init__(self, start_ns: int = 0, utc_offset_ns: int = 0) -> None:
        self._now = start_ns
        self.utc_offset_ns = utc_offset_ns

    def now_ns(self) -> int:
        """Return the virtual time [ns]."""
        return self._now

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Move time forward to the deadline; time never runs backwards."""
        self._now = max(self._now, deadline_ns)


def utc_offset_of_recording_ns(clock: Clock) -> int:
    """Return the offset from a clock's stamps to UTC [ns]; it puts virtual time at now, or at SOURCE_DATE_EPOCH.

    Virtual time begins at zero, which viewers and `ros2 bag` show as 1970. Its recordings are laid so that now is now,
    or the second that the environment variable SOURCE_DATE_EPOCH names, for recordings that repeat to the byte.

    Raises:
        UsageError: the variable is no number of seconds.
    """
    if not clock.lock_step or clock.utc_offset_ns:
        return clock.utc_offset_ns
    if (text := os.environ.get(EPOCH)) is None:
        return time.time_ns() - clock.now_ns()
    if not (text.isascii() and text.isdigit() and len(text) <= 10):
        raise UsageError(f"{EPOCH} is {text[:40]!r}; give whole seconds since 1970")
    return int(text) * 1_000_000_000 - clock.now_ns()
