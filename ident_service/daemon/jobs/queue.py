"""Run jobs in the order they came: one motion at a time per arm and per bus, leases and stops in memory.

The lock guards memory, and lines into pipes that never wait. So a stop or a renewal waits neither for the registry, nor
for a disk, nor for the queue.

One thread starts what may run and sees its end, one per ended job enters it, one keeps leases. All
that lasts is in the registry and in the jobs' folders, so that this process may be killed at any moment: `outcome.py`
tells afterwards what became of what ran.

A motion's lease is renewed by whoever asked for it; each renewal goes on to the motion's process as one line. Silence
of either asks for the controlled stop. A scheduled motion's lease is our own.

What a person has confirmed begins within `CONFIRMED_SECONDS` or not at all, however faithfully its lease is renewed.
"""

from __future__ import annotations

import json
import logging
import re
import signal
import sqlite3
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from ident_service.daemon.authentication import CHALLENGE_SECONDS
from ident_service.daemon.jobs.child_process import RENEW, STOP, JobProcess, SubprocessJob, UnitChild
from ident_service.daemon.jobs.commands import JOBS, READS_BUS, Command, command_of_request
from ident_service.daemon.jobs.outcome import (
    Orphan,
    explain_interrupted,
    forget_unmade,
    lateness_of,
    mark_interrupted,
    orphans,
    outcome,
    process_output,
    register_outputs,
)
from ident_service.daemon.jobs.requests import AnyJobRequest
from ident_service.daemon.metrics import Metrics
from ident_service.errors import DiskFull, DriverError, IdentError, MotionRefused, UsageError
from ident_service.motion.command_channel import stop_requested_ns
from ident_service.operations.moving_arms import Asked, ask_arm, moving_arms, stop_arms
from ident_service.registry import jobs as rows
from ident_service.registry.database import FILE, AuditQueue, Database, Row, note, shortage
from ident_service.registry.motions import new_id
from ident_service.registry.runs import RUNS
from ident_service.registry.state_folder import control_path

_MOTION = re.compile(r"motion of (?P<seconds>[0-9.e+-]+) s")
_SEARCH = re.compile(r"about (?P<seconds>[0-9]+) s left")
_SURE = 0.99  # a job that still runs is never shown as completed


@dataclass(frozen=True)
class Progress:
    """Progress of a job.

    Attributes:
        phase: last words of the job.
        fraction: share that is done, from 0 to 1; None where it cannot be known.
        remaining: time to the end [s]; None where it cannot be known.
    """

    phase: str
    fraction: float | None
    remaining: float | None


def progress(log_text: str, elapsed_seconds: float, usual_seconds: float | None) -> Progress:
    """Estimate a running job's phase (last log line), share done and time left, by its log or the usual duration.

    Args:
        log_text: output of the job, its last lines at least.
        elapsed_seconds: time since the job began [s].
        usual_seconds: usual duration of such jobs [s]; None before there was one.
    """
    said = (line.strip() for line in log_text.splitlines())
    lines = [line for line in said if line and not line.startswith("next: ")]  # a hint at the end is no phase
    phase = lines[-1] if lines else "starting"
    searches = _SEARCH.findall(log_text)
    if searches:
        return _of(phase, elapsed_seconds, elapsed_seconds + float(searches[-1]))
    motion = _MOTION.search(log_text)
    if usual_seconds is None and motion is None:
        return Progress(phase, None, None)
    # For a first run only the duration of its motion is known, not that of its approach and return.
    return _of(
        phase,
        elapsed_seconds,
        usual_seconds if usual_seconds is not None else float(motion["seconds"]) if motion else 0.0,
    )


def _of(phase: str, elapsed: float, whole: float) -> Progress:
    fraction = min(elapsed / whole, _SURE) if whole > 0.0 else _SURE
    return Progress(phase, max(fraction, 0.0), max(whole - elapsed, 0.0))


CONFIRMED_SECONDS: Final = CHALLENGE_SECONDS  # that a motion may wait: a confirmation counts no longer than its page
TICK: Final = 0.05  # s between checks of leases, and of running and waiting jobs


@dataclass
class LiveJob:
    """Job that waits or runs, with the state that only this process knows.

    Attributes:
        job: id of the job.
        order: the command of its process.
        by: name of the requester.
        own_lease: whether a motion's lease is the service's own.
        renewed: time of the lease's last renewal [s].
        requested_ns: time of the request on the machine's monotonic clock [ns], which stops at terminals use, too.
        requested: time of the request on the leases' clock [s]; a motion was confirmed just before.
        entered: whether the registry knows it; before, it keeps its place and nothing else.
        child: process of the job, once it runs.
        end_reason: reason why it is to end; empty while it is not.
        end_state: state of the job afterwards, if it has not begun.
        since: time when it was asked to end [s].
        terminated: whether a computation was sent SIGTERM.
        killed: whether it was ended by force.
        concluding: whether its end is being entered.
        unentered: how it ended and why the registry cannot take that yet; empty where nothing is in the way.
        exit_code: exit code of its process, as far as it is known.
    """

    job: str
    order: Command
    by: str
    own_lease: bool
    renewed: float
    requested_ns: int = 0
    requested: float = 0.0
    entered: bool = False
    child: JobProcess | None = None
    end_reason: str = ""
    end_state: str = "cancelled"
    since: float = 0.0
    terminated: bool = False
    killed: bool = False
    concluding: bool = False
    unentered: str = ""
    exit_code: int | None = None


class LiveJobs:
    """Table of live jobs in the order they came; may be used from any thread."""

    def __init__(
        self, lease_factor: float, now: Callable[[], float], renewed: Callable[[float], None] = lambda _: None
    ) -> None:
        """Begin without jobs.

        Args:
            lease_factor: how much longer than usual the service waits for a renewal, and a motion for its turn.
            now: the leases' clock [s].
            renewed: called with the age of a lease at its renewal [s]; must not wait.
        """
        self._renewed = renewed
        self.changed = threading.Event()
        self._jobs: dict[str, LiveJob] = {}
        self._orphans: dict[str, frozenset[str]] = {}
        self._stops = Counter[str | None]()
        self._lock = threading.Lock()
        self.lease_factor, self._now = lease_factor, now
        self._closing, self._over = False, threading.Event()
        self._thread = threading.Thread(target=self._keep_leases, name="leases", daemon=True)

    def start(self) -> None:
        """Start the thread that stops motions whose lease is not renewed."""
        self._thread.start()

    def close(self) -> None:
        """Tell the thread that watches leases to end; does not wait for it."""
        self._over.set()

    @property
    def healthy(self) -> bool:
        """Return whether the thread that stops motions whose lease is not renewed is alive."""
        return self._thread.is_alive()

    def add(self, live: LiveJob, stops_at_begin: int | None = None) -> None:
        """Queue a job; MotionRefused while closing, if stopped since `stops_at_begin`, or if it may not wait but must.

        Args:
            live: the job.
            stops_at_begin: result of `stops` when the sequence began of which this job is a step; None for a single
                job.

        Raises:
            MotionRefused: nothing is begun any more; somebody has asked for a stop meanwhile; or it may not wait, and
                would have to.
        """
        with self._lock:
            if self._closing:
                raise MotionRefused("the service is shutting down and starts no jobs")
            if stops_at_begin is not None and stops_at_begin != self.stops(live.order.arm):
                raise MotionRefused("a stop was requested meanwhile; no job is started")
            before = self._before(live)
            if before and not live.order.waits:
                raise MotionRefused(
                    f"{live.order.arm}: {before} uses it or waits for it; try again when that has ended"
                )
            self._jobs[live.job] = live

    def enter(self, live: LiveJob) -> None:
        """Start the lease of a job that is in the registry now, and let it begin when its turn comes."""
        with self._lock:
            live.renewed, live.entered = self._now(), True
        self.changed.set()

    def reserve_for_orphans(self, orphans: Mapping[str, frozenset[str]]) -> None:
        """Set the resources, by job, that processes of the previous service still use; no job that needs one begins."""
        with self._lock:
            self._orphans = dict(orphans)

    def orphan_ended(self, job: str) -> None:
        """Release the resources that a process of the previous service, started for this job, has used."""
        with self._lock:
            self._orphans.pop(job, None)
        self.changed.set()

    def waits_for(self, job: str) -> str | None:
        """Return the id of a job that a queued one waits for; None if there is none, or it has begun or is unknown."""
        with self._lock:
            live = self._jobs.get(job)
            if live is None or live.child is not None:
                return None
            if not live.order.resources:
                return next((one.job for one in self._jobs.values() if one.child and not one.order.resources), None)
            return self._before(live) or None

    def _before(self, live: LiveJob) -> str:
        """Return the id of a job that has, or will have before this one, what it needs; empty where there is none."""
        needed = set(live.order.resources)
        for job, taken in self._orphans.items():
            if needed & taken:
                return job
        earlier = True
        for other in self._jobs.values():
            if other is live:
                earlier = False
            elif (earlier or other.child is not None) and needed & set(other.order.resources):
                return other.job
        return ""

    def remove(self, live: LiveJob) -> None:
        """Remove a job that has ended, or was not accepted, from the queue."""
        with self._lock:
            self._jobs.pop(live.job, None)

    def entered(self) -> list[LiveJob]:
        """Return the live jobs that are in the registry."""
        with self._lock:
            return [live for live in self._jobs.values() if live.entered]

    def __bool__(self) -> bool:
        """Return whether there are any jobs."""
        return bool(self._jobs)

    def __contains__(self, live: LiveJob) -> bool:
        """Return whether a job has not ended yet."""
        return live.job in self._jobs

    def may_begin(self, live: LiveJob, most_computing: int) -> bool:
        """Return whether a job may begin: its resources are free; if it needs none, fewer than `most_computing` run.

        Args:
            live: the job.
            most_computing: how many jobs compute at a time.
        """
        with self._lock:
            if not live.order.resources:
                running = [one for one in self._jobs.values() if one.child is not None and not one.order.resources]
                return len(running) < most_computing
            return not self._before(live)

    def store_process(self, live: LiveJob, child: JobProcess) -> None:
        """Store the process of a job; pass on a stop that was asked for while it was being started."""
        with self._lock:
            live.child = child
            if live.end_reason:
                _send_stop(live)

    def conclude(self, child: JobProcess) -> None:
        """Close the input of a process that has ended."""
        with self._lock:
            child.close()

    def end_reason(self, job: str) -> str:
        """Return why a job has been asked to end, in words; an empty text while nobody has asked."""
        live = self._jobs.get(job)
        return "" if live is None else live.end_reason

    def unentered(self, job: str) -> tuple[str, int | None]:
        """Return (how a job ended and why that cannot be registered yet, exit code); an empty text for others."""
        live = self._jobs.get(job)
        return ("", None) if live is None else (live.unentered, live.exit_code)

    # --- leases and stops

    def lease_holder(self, job: str) -> str | None:
        """Return who requested a motion that waits or moves, and so renews its lease; None without a lease."""
        live = self._jobs.get(job)
        return None if live is None or not live.order.moves else live.by

    def renew(self, job: str) -> float | None:
        """Renew a motion's lease; return its length [s], or None for no live motion or one that was asked to end."""
        with self._lock:
            live = self._jobs.get(job)
            if live is None or not live.order.moves or live.end_reason:
                return None
            before, live.renewed = live.renewed, self._now()
            if live.child is not None:
                live.child.say(RENEW)
            age, lease = live.renewed - before, live.order.lease
        self._renewed(age)
        return lease

    def stop(self, arm: str | None, reason: str) -> list[str]:
        """Ask the motions of an arm, or all if None, to stop, or not to begin; return their ids at once."""
        with self._lock:
            self._stops[arm] += 1
            found = [one for one in self._jobs.values() if one.order.moves and arm in (None, one.order.arm)]
            for live in found:
                self._end(live, reason)
        return [live.job for live in found]

    def stops(self, arm: str | None) -> int:
        """Return the number of stops asked for so far that concern an arm: those of all arms plus its own."""
        return self._stops[None] + (self._stops[arm] if arm is not None else 0)

    def end(self, job: str, reason: str) -> bool:
        """Ask one job to end, a motion by a controlled stop; return whether the job is live."""
        with self._lock:
            live = self._jobs.get(job)
            if live is not None:
                self._end(live, reason)
        return live is not None

    def end_all(self, reason: str) -> None:
        """Ask all jobs to end, and accept no more."""
        with self._lock:
            self._closing = True
            for live in self._jobs.values():
                self._end(live, reason)

    def _end(self, live: LiveJob, why: str, state: str = "cancelled") -> None:
        """Ask a job to end, in a state if it has not begun; the first reason counts."""
        if not live.end_reason:
            live.end_reason, live.end_state, live.since = why, state, self._now()
        _send_stop(live)
        self.changed.set()

    def _keep_leases(self) -> None:
        """Renew the leases that are the service's own; end motions whose lease or confirmation is too old."""
        while not self._over.wait(TICK):
            with self._lock:
                for live in self._jobs.values():
                    if live.order.moves and live.entered and not live.end_reason:
                        self._keep_lease(live, self._now() - live.renewed)

    def _keep_lease(self, live: LiveJob, silent: float) -> None:
        if live.own_lease:
            if live.child is not None and silent > 0.25 * live.order.lease:
                live.renewed = self._now()
                live.child.say(RENEW)
        elif silent > self.lease_factor * live.order.lease:
            moved = f"for {live.order.lease:g} s"
            waited = "while it waited; nothing has moved"
            self._end(live, f"its lease was not renewed {waited if live.child is None else moved}")
        elif live.child is None and self._now() - live.requested > self.lease_factor * CONFIRMED_SECONDS:
            # The arm, and whoever is near it, may be elsewhere by now.
            before = self._before(live)
            waited = f"it waited for {before}" if before else "it waited"
            self._end(
                live,
                f"{waited} until its confirmation was older than {CONFIRMED_SECONDS:g} s; nothing has moved. See that "
                "nobody is within the arm's reach, then ask for the motion again",
                "refused",
            )


def _send_stop(live: LiveJob) -> None:
    """Send the stop to a motion's process, if it runs; a computation is ended by the queue."""
    if live.child is not None and live.order.moves:
        live.child.say(STOP)


_POLITE = 15.0  # s for a computation that was asked to end
_LAST = 5.0  # s for what a process of the previous service has left to be entered
_AGAIN = 1.0  # s between attempts to write to a registry that is full or locked
LOG = logging.getLogger("ident.jobs")


class Engine:
    """Queue of jobs that runs them, and stops arms."""

    def __init__(
        self,
        db: Database,
        state: Path,
        *,
        computing: int = 1,
        motion_socket: Path | None = None,
        lease_factor: float = 1.0,
        now: Callable[[], float] = time.monotonic,
        metrics: Metrics | None = None,
    ) -> None:
        """Create the engine; nothing runs before `start`.

        Args:
            db: the registry.
            state: the state folder.
            computing: how many jobs compute at a time.
            motion_socket: socket of the unit that motions run in; None for processes of our own.
            lease_factor: how much longer than usual the service waits for a renewal before it tells the motion's
                process to stop, which counts by itself, and a motion for its turn; for tests on machines that stall.
            now: the leases' clock [s].
            metrics: counters of jobs and leases; figures of its own if None.
        """
        self.metrics = Metrics() if metrics is None else metrics
        self.db, self.state, self.audit = db, state, AuditQueue(db)
        self.live = LiveJobs(lease_factor, now, self.metrics.record_lease_age)
        self._computing, self._motion_socket, self._now = computing, motion_socket, now
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._work, name="jobs", daemon=True)
        self._following = threading.Thread(target=self._follow_orphans, name="orphans", daemon=True)
        self._orphans: list[Orphan] = []
        self._short = ""  # of what the queue waits for, as it was logged last
        self._first: Callable[[], Any] = lambda: None
        self.beat = now()

    def start(self, before_queue: Callable[[], Any] = lambda: None) -> None:
        """Mark interrupted jobs, requeue waiting computations, then begin to run the queue; returns at once.

        Args:
            before_queue: function that the queue's thread calls before it begins anything.
        """
        self._first = before_queue
        mark_interrupted(self.db, self.state)
        self._orphans = orphans(self.db, self.state)
        self.live.reserve_for_orphans({one.row["id"]: self._resources(one.row) for one in self._orphans})
        self._requeue()
        self._following.start()
        self._thread.start()
        self.live.start()

    @property
    def closing(self) -> bool:
        """Return whether the engine is ending."""
        return self._closing.is_set()

    @property
    def healthy(self) -> bool:
        """Return whether queue and lease threads run, the queue's loop within 30 s, and all job ends are registered."""
        alive = self._thread.is_alive() and self.live.healthy
        return alive and self._now() - self.beat < 30.0 and not any(one.unentered for one in self.live.entered())

    def create(
        self,
        request: AnyJobRequest,
        by: str,
        *,
        own_lease: bool = False,
        stops_at_begin: int | None = None,
        also_write: Callable[[Row], None] = lambda _: None,
    ) -> Row:
        """Queue a job and return its row of the registry.

        Args:
            request: request of the job, its objects named by id.
            by: the name of a token, or `service`.
            own_lease: whether a motion's lease is the service's own, as a scheduled one's is.
            stops_at_begin: value of `live.stops` when a person, or the schedule, began the work of which this job is
                a later step.
            also_write: function that writes what belongs to the job, in the same transaction.

        Raises:
            UsageError: it names what is not known.
            ConfigError: the arm's description has mistakes.
            MotionRefused: the service is ending, or somebody has asked for a stop meanwhile; or it may not wait, and
                would have to.
        """
        order = command_of_request(self.db, self.state, request)
        job = new_id(request.kind)
        now = self._now()
        live = LiveJob(job, order, by, own_lease, now, time.monotonic_ns(), now)
        self.live.add(live, stops_at_begin)
        try:
            (self.state / JOBS / job).mkdir(parents=True)
            with self.db.transaction():
                row = rows.add_job(
                    *(self.db, job, request.kind, order.arm, request.model_dump(mode="json"), list(order.words), by),
                    motion=order.moves,
                    run_id=order.run,
                )
                note(self.db, by, "job created", job, kind=request.kind, arm=order.arm)
                also_write(row)
        except BaseException:
            self.live.remove(live)
            with suppress(OSError):
                (self.state / JOBS / job).rmdir()
            raise
        self.live.enter(live)
        return row

    def cancel(self, job: str, by: str) -> None:
        """Ask a job to end, a motion by a controlled stop, and return at once; UsageError if it has ended already.

        Raises:
            UsageError: no such job, or it has ended.
        """
        if not self.live.end(job, f"cancelled by {by}"):
            raise UsageError(f"the job {job} has ended already: {rows.known_job(self.db, job)['state']}")
        self.audit.note(by, "job cancelled", job)

    def stop(self, arm: str | None, by: str) -> dict[str, list[str]]:
        """Ask for a controlled stop of an arm, or all if None, whoever moves it; return the `arms` and `jobs` reached.

        Waits for nobody: the word to our own children is a line in a pipe, the control file is memory, and what the
        audit trail says of it is entered later.

        Raises:
            DriverError: the control file of an arm cannot be opened, which may move; all others have been reached.
        """
        ended = self.live.stop(arm, f"{by} asked for a stop")
        reached, failures = list[str](), list[DriverError]()
        try:
            reached, failures = stop_arms(self.state, arm)
        finally:
            self.audit.note(by, "stop", arm or "all arms", reached=reached, jobs=ended)
        for failure in failures:
            raise DriverError(f"{failure}; stopped: {', '.join(reached) or 'no other arm'}")
        return {"arms": reached, "jobs": ended}

    def ask(self, arm: str, request: Asked, by: str) -> bool:
        """Send `pause`, `resume` or such to the process that moves or holds an arm; return whether there was one."""
        reached = ask_arm(self.state, arm, request)
        self.audit.note(by, request, arm, reached=[arm] if reached else [])
        return reached

    def progress(self, row: Row) -> Progress | None:
        """Return phase, share done and time left of a running job; None for one that does not run."""
        if row["state"] != "running" or row["started"] is None:
            return None
        typical = rows.typical_seconds(self.db, row["kind"], row["arm"])
        found = progress(process_output(self.state / JOBS / row["id"]).log, time.time() - row["started"], typical)
        return Progress(found.phase, None, None) if self.live.end_reason(row["id"]) else found

    def moving(self) -> list[str]:
        """Return the names of the arms that any process moves or holds."""
        return moving_arms(self.state)

    def begin_closing(self) -> None:
        """Ask all jobs to end, motions by a controlled stop, and begin nothing more; returns at once."""
        self._closing.set()
        self.live.end_all("the service ends")
        self.live.changed.set()

    def close(self, seconds: float = 40.0) -> None:
        """Bring the arms to rest, end the other jobs, and wait for both up to a bound [s]."""
        self.begin_closing()
        if self._thread.ident is not None:
            self._thread.join(seconds)
            self._following.join(_LAST)
        self.live.close()
        self.audit.close()

    # --- what the thread does

    def _follow_orphans(self) -> None:
        """Enter how each process of the previous service ends; until then, what it has is nobody else's."""
        while not self._closing.is_set():
            try:
                explain_interrupted(self.db, self.state, self._orphans, self.live.orphan_ended, self._closing)
            except (sqlite3.Error, OSError) as error:
                LOG.error("the outcome of interrupted jobs cannot be recorded yet: %s", error)
                if self._closing.wait(_LAST):
                    return
                self._orphans = orphans(self.db, self.state)
            except Exception:
                LOG.exception("the outcome of interrupted jobs could not be recorded")
                return
            else:
                return

    def _resources(self, row: Row) -> frozenset[str]:
        """Return what the process of a job has for itself."""
        if not row["motion"] and row["kind"] not in READS_BUS:
            return frozenset()
        known = self.db.row("SELECT resources FROM arms WHERE name = ?", row["arm"])
        return frozenset((f"arm {row['arm']}", *(json.loads(known["resources"]) if known else ())))

    def _work(self) -> None:
        try:
            self._first()
        except Exception:
            LOG.exception("runs could not be entered")
        while True:
            self.beat = self._now()
            try:
                self._look()
            except sqlite3.Error as error:
                if (words := str(error)) != self._short:  # once, however long it lasts
                    self._short = words
                    LOG.error("the queue waits for the registry: %s", error)
                time.sleep(_AGAIN)
            except Exception:  # the queue must go on, whatever one job does to it
                LOG.exception("the queue stumbled")
                time.sleep(_AGAIN)
            else:
                self._short = ""
            if self.closing and not self.live:
                return
            self.live.changed.wait(TICK if self.live else 1.0)
            self.live.changed.clear()

    def _look(self) -> None:
        found = self.live.entered()
        for live in found:
            if live.order.moves and not live.end_reason and self._stopped_at_terminal(live):
                self.live.end(live.job, "a stop was requested")
            # Running jobs first: a waiting one may have to wait for the registry.
            if live.child is not None:
                self._watch(live, live.child)
        for live in found:
            if live.child is None and live in self.live:
                self._wait(live)

    def _stopped_at_terminal(self, live: LiveJob) -> bool:
        """Return whether a stop was asked for after this motion was, possibly not through this service."""
        stamp = stop_requested_ns(control_path(self.state, str(live.order.arm)))
        # A stamp in the future is from before the machine was started.
        return live.requested_ns < stamp <= time.monotonic_ns()

    def _wait(self, live: LiveJob) -> None:
        """Handle a queued job: end it if asked to, begin it if it is its turn."""
        if live.end_reason:
            self._finish(live, live.end_state, live.end_reason, None)
        elif self.live.may_begin(live, self._computing):
            self._begin(live)

    def _begin(self, live: LiveJob) -> None:
        folder = self.state / JOBS / live.job
        if not rows.mark_started(self.db, live.job, ""):
            self.live.remove(live)
            return
        if live.end_reason:  # cancelled while the registry was written
            self._finish(live, live.end_state, live.end_reason, None)
            return
        child: JobProcess
        try:
            # The unit for motions also has access to the buses.
            if live.order.resources and self._motion_socket is not None:
                child = UnitChild(live.order.words, folder, self._motion_socket)
            else:
                child = SubprocessJob(live.order.words, folder, computes=not live.order.resources)
        except (IdentError, OSError) as error:
            self._finish(live, "failed", f"its process could not be started: {error}", None)
            return
        self.live.store_process(live, child)
        self.db.write("UPDATE jobs SET process = ? WHERE id = ?", child.process, live.job)
        LOG.info("job started", extra={"job": live.job, "arm": live.order.arm})

    def _watch(self, live: LiveJob, child: JobProcess) -> None:
        """Check a running job; end a computation by SIGTERM, then by SIGKILL, and conclude a job that has ended."""
        if live.end_reason and not live.order.moves:
            if not live.terminated:
                live.terminated = True
                child.signal(signal.SIGTERM)
            elif not live.killed and self._now() - live.since > _POLITE:
                live.killed = True
                child.signal(signal.SIGKILL)
        if child.ended() and not live.concluding:
            # In a thread of its own: hashing a long recording takes long.
            live.concluding = True
            threading.Thread(target=self._conclude, args=(live, child), name=live.job, daemon=True).start()

    def _conclude(self, live: LiveJob, child: JobProcess) -> None:
        """Enter what an ended job has made, then the job's end."""
        self.live.conclude(child)
        ended = outcome(process_output(self.state / JOBS / live.job), child.exit_code, live.end_reason)
        live.exit_code = ended.exit_code
        while True:
            try:
                self._finish(live, ended.state, self._enter_outputs(live, ended.detail), ended.exit_code)
            except (sqlite3.Error, OSError) as error:
                # For example a full disk; until there is room, the service must not count as healthy.
                if not live.unentered:  # once, however long it lasts
                    LOG.error("the end of a job cannot be entered yet: %s", error, extra={"job": live.job})
                how = ended.state + (f": {ended.detail}" if ended.detail else "")
                live.unentered = f"it has ended ({how}), but that cannot be entered: {self._remedy(error)}"
                if self._closing.wait(_AGAIN):
                    self.live.remove(live)  # the next start determines the job's outcome
                    return
            else:
                return

    def _remedy(self, error: Exception) -> str:
        short = shortage(self.state / FILE, error)
        if isinstance(error, DiskFull) or isinstance(short, DiskFull):
            return "the disk of the daemon's state folder is full; free disk space there, then it is entered by itself"
        if short is not None:
            return "another process has locked the registry; it is entered when that has ended"
        return str(error)

    def _enter_outputs(self, live: LiveJob, detail: str) -> str:
        """Enter what a job made; return `detail`, with the error if that failed."""
        try:
            register_outputs(self.db, self.state, rows.known_job(self.db, live.job), live.by)
        except sqlite3.Error:
            raise  # as for the end of the job itself
        except Exception as error:  # whatever else stands in its way, the job has ended
            for cause in (error, error.__context__):
                if cause is not None and isinstance(short := shortage(self.state / FILE, cause), DiskFull):
                    raise short from None
            LOG.exception("what a job made could not be entered")
            return "; ".join(filter(None, (detail, f"its folder could not be entered: {error}")))
        return detail

    def _finish(self, live: LiveJob, state: str, detail: str, code: int | None) -> None:
        with self.db.transaction():
            entered = rows.mark_ended(self.db, live.job, state, detail, code)
            if entered:
                forget_unmade(self.db, self.state, rows.known_job(self.db, live.job))
                note(self.db, live.by, "job ended", live.job, state=state, detail=detail)
        if entered:
            self._count(live.job)
        self.live.remove(live)
        LOG.info("job ended", extra={"job": live.job, "state": state, "detail": detail})

    def _count(self, job: str) -> None:
        row = rows.known_job(self.db, job)
        began, ended = row["started"] or row["ended"], row["ended"]
        ran = max(ended - began, 0.0) if row["started"] else None
        self.metrics.record_job(row["kind"], row["state"], max(began - row["created"], 0.0), ran)
        if row["motion"] and row["run"] is not None:
            self.metrics.add_lateness(lateness_of(self.state / RUNS / row["run"]))

    def _requeue(self) -> None:
        """Queue computations again that waited when the service ended, in their old order."""
        from pydantic import TypeAdapter

        reader: TypeAdapter[AnyJobRequest] = TypeAdapter(AnyJobRequest)
        for row in rows.queued_jobs(self.db):
            try:
                order = command_of_request(self.db, self.state, reader.validate_python(row["request"]))
            except (IdentError, ValueError) as error:
                rows.mark_ended(self.db, row["id"], "failed", f"it cannot be begun any more: {error}")
                forget_unmade(self.db, self.state, row)
                continue
            # Its arguments and folder are those that were entered when it was requested.
            order = Command(tuple(row["words"]), order.arm, order.moves, row["run"], order.resources, order.lease)
            waiting = LiveJob(row["id"], order, row["created_by"], False, self._now())
            self.live.add(waiting)
            self.live.enter(waiting)
