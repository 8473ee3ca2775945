"""Hold the jobs that wait or run in memory: their leases, their stops, and their order.

The lock guards memory, and lines into pipes that never wait. So a stop or a renewal waits neither for the registry, nor
for a disk, nor for the queue.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from ident_service.daemon.jobs.child_process import RENEW, STOP, Child
from ident_service.daemon.jobs.commands import Command
from ident_service.errors import MotionRefused

TICK: Final = 0.05  # s between checks of leases, and of running and waiting jobs


@dataclass
class LiveJob:
    """Job that waits or runs, with the state that only this process knows.

    Attributes:
        job: its id.
        order: the command of its process.
        by: who asked for it.
        own_lease: whether a motion's lease is the service's own.
        renewed: when that was renewed last [s].
        asked_ns: when it was asked for, on the machine's monotonic clock, which stops at terminals tell, too [ns].
        entered: whether the registry knows it; before, it keeps its place and nothing else.
        child: its process, once it runs.
        asked_to_end: why it is to end; empty while it is not.
        since: when that was asked [s].
        told: whether a computation was sent SIGTERM.
        killed: whether it was ended by force.
        concluding: whether its end is being entered.
    """

    job: str
    order: Command
    by: str
    own_lease: bool
    renewed: float
    asked_ns: int = 0
    entered: bool = False
    child: Child | None = None
    asked_to_end: str = ""
    since: float = 0.0
    told: bool = False
    killed: bool = False
    concluding: bool = False


class LiveJobs:
    """Table of live jobs in the order they came; may be used from any thread."""

    def __init__(
        self, lease_factor: float, now: Callable[[], float], renewed: Callable[[float], None] = lambda _: None
    ) -> None:
        """Begin without jobs.

        Args:
            lease_factor: how much longer than usual the service waits for a renewal.
            now: the leases' clock [s].
            renewed: hears how old a lease was that is renewed [s]; does not wait.
        """
        self._renewed = renewed
        self.changed = threading.Event()
        self._jobs: dict[str, LiveJob] = {}
        self._stops = Counter[str | None]()
        self._lock = threading.Lock()
        self.lease_factor, self._now = lease_factor, now
        self._closing, self._over = False, threading.Event()
        self._thread = threading.Thread(target=self._keep_leases, name="leases", daemon=True)

    def start(self) -> None:
        """Start the thread that watches leases."""
        self._thread.start()

    def close(self) -> None:
        """Stop the thread that watches leases."""
        self._over.set()

    @property
    def healthy(self) -> bool:
        """Return whether the thread that watches leases is alive."""
        return self._thread.is_alive()

    def add(self, live: LiveJob, stops: int | None = None) -> None:
        """Add a job in its place; from now on a stop finds it.

        Args:
            live: the job.
            stops: result of `stops` when the sequence began of which this job is a step; None for a single job.

        Raises:
            MotionRefused: nothing is begun any more; somebody has asked for a stop meanwhile; or it may not wait, and
                would have to.
        """
        with self._lock:
            if self._closing:
                raise MotionRefused("the service is ending and begins nothing")
            if stops is not None and stops != self.stops(live.order.arm):
                raise MotionRefused("somebody asked for a stop meanwhile; nothing more is begun")
            needed = set(live.order.resources)
            before = next((one.job for one in self._jobs.values() if needed & set(one.order.resources)), "")
            if before and not live.order.waits:
                raise MotionRefused(f"{live.order.arm}: {before} has it or waits for it; ask again when that has ended")
            self._jobs[live.job] = live

    def enter(self, live: LiveJob) -> None:
        """Let a job that the registry knows begin when its turn comes; its lease begins."""
        with self._lock:
            live.renewed, live.entered = self._now(), True
        self.changed.set()

    def remove(self, live: LiveJob) -> None:
        """Remove a job that has ended, or was not accepted."""
        with self._lock:
            self._jobs.pop(live.job, None)

    def entered(self) -> list[LiveJob]:
        """Return the jobs that the registry knows."""
        with self._lock:
            return [live for live in self._jobs.values() if live.entered]

    def __bool__(self) -> bool:
        """Return whether there are any jobs."""
        return bool(self._jobs)

    def __contains__(self, live: LiveJob) -> bool:
        """Return whether a job has not ended yet."""
        return live.job in self._jobs

    def free(self, live: LiveJob, computing: int) -> bool:
        """Return whether a job may begin: a later job does not overtake an earlier one on the same arm or bus.

        Args:
            live: the job.
            computing: how many jobs compute at a time.
        """
        with self._lock:
            if not live.order.resources:
                running = [one for one in self._jobs.values() if one.child is not None and not one.order.resources]
                return len(running) < computing
            needed, earlier = set(live.order.resources), True
            for other in self._jobs.values():
                if other is live:
                    earlier = False
                elif (earlier or other.child is not None) and needed & set(other.order.resources):
                    return False
            return True

    def began(self, live: LiveJob, child: Child) -> None:
        """Store the process of a job; pass on a stop that was asked for while it was being started."""
        with self._lock:
            live.child = child
            if live.asked_to_end:
                _say_stop(live)

    def conclude(self, live: LiveJob, child: Child) -> None:
        """Close the input of a process that has ended."""
        with self._lock:
            child.close()

    # --- leases and stops

    def lease_holder(self, job: str) -> str | None:
        """Return who requested a motion that waits or moves, and so renews its lease; None without a lease."""
        live = self._jobs.get(job)
        return None if live is None or not live.order.moves else live.by

    def renew(self, job: str) -> float | None:
        """Renew a motion's lease.

        Returns:
            How long it lasts now [s]; None where nothing moves or waits under it any more.
        """
        with self._lock:
            live = self._jobs.get(job)
            if live is None or not live.order.moves or live.asked_to_end:
                return None
            before, live.renewed = live.renewed, self._now()
            if live.child is not None:
                live.child.say(RENEW)
            age, lease = live.renewed - before, live.order.lease
        self._renewed(age)
        return lease

    def stop(self, arm: str | None, why: str) -> list[str]:
        """Ask the motions of an arm, or all, to stop; those that wait are not begun.

        Returns:
            Their ids.
        """
        with self._lock:
            self._stops[arm] += 1
            found = [one for one in self._jobs.values() if one.order.moves and arm in (None, one.order.arm)]
            for live in found:
                self._end(live, why)
        return [live.job for live in found]

    def stops(self, arm: str | None) -> int:
        """Return the number of stops asked for so far that concern an arm: those of all arms plus its own."""
        return self._stops[None] + (self._stops[arm] if arm is not None else 0)

    def end(self, job: str, why: str) -> bool:
        """Ask one job to end, a motion by a controlled stop; return whether the job is live."""
        with self._lock:
            live = self._jobs.get(job)
            if live is not None:
                self._end(live, why)
        return live is not None

    def end_all(self, why: str) -> None:
        """Ask all jobs to end, and accept no more."""
        with self._lock:
            self._closing = True
            for live in self._jobs.values():
                self._end(live, why)

    def _end(self, live: LiveJob, why: str) -> None:
        """Ask a job to end; the first reason counts."""
        if not live.asked_to_end:
            live.asked_to_end, live.since = why, self._now()
        _say_stop(live)
        self.changed.set()

    def _keep_leases(self) -> None:
        """Renew the leases that are the service's own; stop motions whose lease nobody has renewed in time."""
        while not self._over.wait(TICK):
            with self._lock:
                for live in self._jobs.values():
                    if live.order.moves and live.entered and not live.asked_to_end:
                        self._keep_lease(live, self._now() - live.renewed)

    def _keep_lease(self, live: LiveJob, silent: float) -> None:
        if live.own_lease:
            if live.child is not None and silent > 0.25 * live.order.lease:
                live.renewed = self._now()
                live.child.say(RENEW)
        elif silent > self.lease_factor * live.order.lease:
            moved = f"for {live.order.lease:g} s"
            waited = "while it waited; nothing has moved"
            self._end(live, f"nobody renewed its lease {waited if live.child is None else moved}")


def _say_stop(live: LiveJob) -> None:
    """Send the stop to a motion's process, if it runs; a computation is ended by the queue."""
    if live.child is not None and live.order.moves:
        live.child.say(STOP)
