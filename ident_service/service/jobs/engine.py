"""Jobs in the order they came: one motion at a time per arm and per bus, a few that compute beside them.

One thread starts what may run, one per job watches it. All that lasts is in the registry and in the jobs' folders, so
that this process may be killed at any moment: `recovery.py` tells afterwards what became of what ran.

A motion's lease is renewed by whoever asked for it; each renewal goes on to the motion's process as one line. Silence
of either asks for the controlled stop. A scheduled motion's lease is our own.
"""

from __future__ import annotations

import logging
import signal
import sqlite3
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ident_service.errors import IdentError, MotionRefused, UsageError
from ident_service.service.jobs.asked import Asked
from ident_service.service.jobs.child import RENEW, STOP, Child, OwnChild, UnitChild
from ident_service.service.jobs.commands import JOBS, Command, command
from ident_service.service.jobs.keeping import keep
from ident_service.service.jobs.outcome import outcome, said
from ident_service.service.jobs.progress import Progress, progress
from ident_service.service.jobs.reach import finish_arm, moving_arms, pause_arm, stop_arms
from ident_service.service.jobs.recovery import explain_interrupted, mark_interrupted
from ident_service.service.registry import jobs as rows
from ident_service.service.registry.audit import note
from ident_service.service.registry.database import Database, Row
from ident_service.service.registry.motions import new_id

_TICK = 0.05  # s between looks at what runs and what waits
_POLITE = 15.0  # s for a computation that was asked to end
_AGAIN = 1.0  # s between tries to enter what the registry has no room for
LOG = logging.getLogger("ident.jobs")


@dataclass
class _Live:
    """A job that waits or runs, and what only this process knows of it."""

    job: str
    order: Command
    by: str
    own_lease: bool
    renewed: float
    child: Child | None = None
    began: float = 0.0
    asked_to_end: str = ""
    since: float = 0.0
    killed: bool = False
    concluding: bool = False


class Engine:
    """Queues jobs, runs them, and stops arms."""

    def __init__(
        self,
        db: Database,
        state: Path,
        *,
        computing: int = 1,
        motion_door: Path | None = None,
        lease_factor: float = 1.0,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """Nothing runs before `start`.

        Args:
            db: the registry.
            state: the state folder.
            computing: how many jobs compute at a time.
            motion_door: socket of the unit that motions run in; None for processes of our own.
            lease_factor: how much longer than usual the service waits for a renewal before it tells the motion's
                process to stop, which counts by itself; for tests on machines that stall.
            now: the leases' clock [s].
        """
        self.db, self.state = db, state
        self._computing, self._door, self._factor, self._now = computing, motion_door, lease_factor, now
        self._live: dict[str, _Live] = {}
        self._unwritten: set[str] = set()  # jobs whose end waits for room in the registry
        self._stops = Counter[str | None]()
        self._lock = threading.RLock()
        self._wake, self._closing = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._work, name="jobs", daemon=True)
        self._first: Callable[[], Any] = lambda: None
        self.beat = now()

    def start(self, first: Callable[[], Any] = lambda: None) -> None:
        """Tell what was interrupted, then begin to run what is asked for; returns at once.

        Args:
            first: done by the queue's thread before it begins anything.
        """
        self._first = first
        mark_interrupted(self.db, self.state)
        self._requeue()
        self._thread.start()

    @property
    def closing(self) -> bool:
        """Whether it ends."""
        return self._closing.is_set()

    @property
    def healthy(self) -> bool:
        """Whether the queue is being looked after, and the registry can be written."""
        return self._thread.is_alive() and self._now() - self.beat < 30.0 and not self._unwritten

    def create(
        self,
        asked: Asked,
        by: str,
        *,
        own_lease: bool = False,
        stops: int | None = None,
        entering: Callable[[Row], None] = lambda _: None,
    ) -> Row:
        """Queue a job.

        Args:
            asked: by ids.
            by: the name of a token, or `service`.
            own_lease: whether a motion's lease is the service's own, as a scheduled one's is.
            stops: what `stops` answered when a person, or the schedule, began that of which this is a later step.
            entering: writes what belongs to the job in the same transaction.

        Raises:
            UsageError: it names what is not known.
            ConfigError: the arm's description has mistakes.
            MotionRefused: the service is ending, or somebody has asked for a stop meanwhile; or it may not wait, and
                would have to.
        """
        order = command(self.db, self.state, asked)
        if self.closing:
            raise MotionRefused("the service is ending and begins nothing")
        job = new_id(asked.kind)
        (self.state / JOBS / job).mkdir(parents=True)
        with self._lock, self.db.transaction():
            if stops is not None and stops != self.stops(order.arm):
                raise MotionRefused("somebody asked for a stop meanwhile; nothing more is begun")
            if not order.waits and (before := self._before(order)):
                raise MotionRefused(f"{order.arm}: {before} has it or waits for it; ask again when that has ended")
            row = rows.add_job(
                *(self.db, job, asked.kind, order.arm, asked.model_dump(mode="json"), list(order.words), by),
                motion=order.moves,
                run=order.run,
            )
            note(self.db, by, "job created", job, kind=asked.kind, arm=order.arm)
            entering(row)
            self._live[job] = _Live(job, order, by, own_lease, self._now())
        self._wake.set()
        return row

    def stops(self, arm: str | None) -> int:
        """How often a stop of this arm, or of all, has been asked for here."""
        return self._stops[None] + (self._stops[arm] if arm is not None else 0)

    def renew(self, job: str) -> bool:
        """Renew a motion's lease; False where nothing moves or waits under it any more."""
        with self._lock:
            live = self._live.get(job)
            if live is None or not live.order.moves or live.asked_to_end:
                return False
            live.renewed = self._now()
            child = live.child
        if child is not None:
            child.say(RENEW)
        return True

    def cancel(self, job: str, by: str, why: str = "") -> None:
        """Have a job end: a motion by a controlled stop, a computation politely, one that waits at once.

        Raises:
            UsageError: no such job, or it has ended.
        """
        row = rows.known_job(self.db, job)
        with self._lock:
            live = self._live.get(job)
            if live is None:
                raise UsageError(f"the job {job} has ended already: {row['state']}")
            note(self.db, by, "job cancelled", job)
            self._end(live, why or f"cancelled by {by}")

    def stop(self, arm: str | None, by: str) -> dict[str, list[str]]:
        """Bring an arm, or all, to a controlled stop, whoever moves it; what waits to move it is cancelled.

        Waits for nobody: the control file is memory, and the word to our own children a line in a pipe.
        """
        reached, ended = stop_arms(self.state, arm), []
        with self._lock:
            self._stops[arm] += 1
            for live in list(self._live.values()):
                if live.order.moves and arm in (None, live.order.arm):
                    self._end(live, f"{by} asked for a stop")
                    ended.append(live.job)
        try:
            note(self.db, by, "stop", arm or "all arms", reached=reached, jobs=ended)
        except Exception:  # a full disk, say: the arms stop all the same
            LOG.exception("a stop could not be entered in the audit trail")
        return {"arms": reached, "jobs": ended}

    def pause(self, arm: str, by: str, *, wanted: bool) -> bool:
        """Let an arm stand, or go on; whether anybody moves it."""
        reached = pause_arm(self.state, arm, wanted=wanted)
        note(self.db, by, "pause" if wanted else "resume", arm, reached=[arm] if reached else [])
        return reached

    def finish(self, arm: str, by: str) -> bool:
        """Let a run end early, in order, out of a pause too; whether anybody moves the arm."""
        reached = finish_arm(self.state, arm)
        note(self.db, by, "finish", arm, reached=[arm] if reached else [])
        return reached

    def progress(self, row: Row) -> Progress | None:
        """How far a job that runs is; None for one that does not."""
        if row["state"] != "running" or row["started"] is None:
            return None
        typical = rows.typical_seconds(self.db, row["kind"], row["arm"])
        return progress(said(self.state / JOBS / row["id"]).log, time.time() - row["started"], typical)

    def moving(self) -> list[str]:
        """Names of the arms that anybody moves."""
        return moving_arms(self.state)

    def begin_closing(self) -> None:
        """Stop all arms and begin nothing more; returns at once."""
        if self._closing.is_set():
            return
        self._closing.set()
        with self._lock:
            for live in list(self._live.values()):
                self._end(live, "the service ends")
        self._wake.set()

    def close(self, seconds: float = 40.0) -> None:
        """Bring the arms to rest, have the rest end, and wait for it, but not for ever."""
        self.begin_closing()
        if self._thread.ident is not None:
            self._thread.join(seconds)

    # --- what the thread does

    def _work(self) -> None:
        try:
            explain_interrupted(self.db, self.state, self._closing.is_set)
            self._first()
        except Exception:
            LOG.exception("what was interrupted could not be told")
        while True:
            self.beat = self._now()
            try:
                self._look()
            except Exception:  # the queue must go on, whatever one job does to it
                LOG.exception("the queue stumbled")
            with self._lock:
                if self._closing.is_set() and not self._live:
                    return
                idle = not self._live
            self._wake.wait(1.0 if idle else _TICK)
            self._wake.clear()

    def _look(self) -> None:
        with self._lock:
            for live in list(self._live.values()):
                if live.child is None:
                    self._wait(live)
                else:
                    self._watch(live, live.child)

    def _wait(self, live: _Live) -> None:
        """One that is queued: it ends, goes on waiting, or begins."""
        if live.order.moves and not live.own_lease and self._lapsed(live):
            live.asked_to_end = live.asked_to_end or "nobody renewed its lease while it waited; nothing has moved"
        if live.asked_to_end:
            self._finish(live, "cancelled", live.asked_to_end, None)
        elif self._free(live):
            self._begin(live)

    def _free(self, live: _Live) -> bool:
        """Whether nothing stands before it: who came later does not overtake on the same arm or bus."""
        if not live.order.resources:
            running = [one for one in self._live.values() if one.child is not None and not one.order.resources]
            return len(running) < self._computing
        needed, earlier = set(live.order.resources), True
        for other in self._live.values():
            if other is live:
                earlier = False
            elif (earlier or other.child is not None) and needed & set(other.order.resources):
                return False
        return True

    def _before(self, order: Command) -> str:
        """Which job has, or waits for, what this one needs; empty if none."""
        needed = set(order.resources)
        return next((job for job, live in self._live.items() if needed & set(live.order.resources)), "")

    def _begin(self, live: _Live) -> None:
        folder = self.state / JOBS / live.job
        if not rows.started(self.db, live.job, ""):
            self._live.pop(live.job, None)
            return
        try:
            # Where the motions' unit is, the bus is there, too.
            if live.order.resources and self._door is not None:
                live.child = UnitChild(live.order.words, folder, self._door)
            else:
                live.child = OwnChild(live.order.words, folder)
        except (IdentError, OSError) as error:
            self._finish(live, "failed", f"its process could not be started: {error}", None)
            return
        live.began = self._now()
        self.db.write("UPDATE jobs SET process = ? WHERE id = ?", live.child.process, live.job)
        LOG.info("job started", extra={"job": live.job, "arm": live.order.arm})

    def _watch(self, live: _Live, child: Child) -> None:
        """One that runs: its lease, its end."""
        if live.order.moves and not live.asked_to_end:
            if live.own_lease:
                if self._now() - live.renewed > 0.25 * live.order.lease:
                    live.renewed = self._now()
                    child.say(RENEW)
            elif self._lapsed(live):
                self._end(live, f"nobody renewed its lease for {live.order.lease:g} s")
        if live.asked_to_end and not live.order.moves and not live.killed and self._now() - live.since > _POLITE:
            live.killed = True
            child.signal(signal.SIGKILL)
        if child.ended() and not live.concluding:
            # Beside the queue: a long recording has a long hash, and leases are looked after here.
            live.concluding = True
            threading.Thread(target=self._conclude, args=(live, child), name=live.job, daemon=True).start()

    def _conclude(self, live: _Live, child: Child) -> None:
        """One that has ended: enter what it made, then say so."""
        child.close()
        ended = outcome(said(self.state / JOBS / live.job), child.exit_code, live.asked_to_end)
        detail = ended.detail
        try:
            keep(self.db, self.state, rows.known_job(self.db, live.job), live.by)
        except Exception as error:  # whatever stands in its way, the job has ended
            LOG.exception("what a job made could not be entered")
            detail = "; ".join(filter(None, (detail, f"its folder could not be entered: {error}")))
        while True:
            try:
                self._finish(live, ended.state, detail, ended.exit_code)
            except sqlite3.Error:  # a full disk, say; until there is room, nobody may take this service for a sound one
                LOG.exception("the end of a job cannot be entered yet", extra={"job": live.job})
                self._unwritten.add(live.job)
                if self._closing.wait(_AGAIN):
                    return  # the next start finds out what became of it
            else:
                self._unwritten.discard(live.job)
                return

    def _finish(self, live: _Live, state: str, detail: str, code: int | None) -> None:
        with self._lock:
            with self.db.transaction():
                if rows.ended(self.db, live.job, state, detail, code):
                    note(self.db, live.by, "job ended", live.job, state=state, detail=detail)
            self._live.pop(live.job, None)
        LOG.info("job ended", extra={"job": live.job, "state": state, "detail": detail})

    # --- small things

    def _end(self, live: _Live, why: str) -> None:
        """Ask a job to end; the first reason counts."""
        if not live.asked_to_end:
            live.asked_to_end, live.since = why, self._now()
            if live.child is not None and not live.order.moves:
                live.child.signal(signal.SIGTERM)
        if live.child is not None and live.order.moves:
            live.child.say(STOP)
        self._wake.set()

    def _lapsed(self, live: _Live) -> bool:
        return self._now() - live.renewed > self._factor * live.order.lease

    def _requeue(self) -> None:
        """What still waits to compute, in its old place."""
        from pydantic import TypeAdapter

        reader: TypeAdapter[Asked] = TypeAdapter(Asked)
        for row in rows.queue(self.db):
            try:
                order = command(self.db, self.state, reader.validate_python(row["request"]))
            except (IdentError, ValueError) as error:
                rows.ended(self.db, row["id"], "failed", f"it cannot be begun any more: {error}")
                continue
            # Its words and its folder are those that were told when it was asked for.
            order = Command(tuple(row["words"]), order.arm, order.moves, row["run"], order.resources, order.lease)
            self._live[row["id"]] = _Live(row["id"], order, row["created_by"], False, self._now())
