"""Find due re-identifications, begin those that may begin unattended, advance their steps, send notices.

A re-identification begins unattended only where the description says `unattended_motion: allowed`, and then only on
time. One that is late, or was due before this process began, and one of an arm that has a latched fault, is moved or is
waited for, needs a person. That is decided once, so that neither an acknowledged fault nor a new description sets an
arm in motion later.
"""

from __future__ import annotations

import logging
import sqlite3
import threading
import time
from collections.abc import Callable
from typing import Any

from ident_service.daemon.jobs.queue import Engine
from ident_service.daemon.maintenance.reidentification import SERVICE, ReidentificationRequest, Reidentifications
from ident_service.daemon.maintenance.webhook import Webhook
from ident_service.errors import IdentError
from ident_service.motion.command_channel import is_control_file_in_use
from ident_service.operations.drift_alarms import alarms
from ident_service.operations.maintenance_schedule import LATE, mark_due, pending, schedules
from ident_service.registry.arms import known_arm
from ident_service.registry.database import Row, note
from ident_service.registry.jobs import LIVE, jobs
from ident_service.registry.state_folder import arm_fault_store, control_path

_TICK = 0.5  # s between passes
LOG = logging.getLogger("ident.maintenance")


class MaintenanceScheduler:
    """Scheduler of a service's re-identifications."""

    def __init__(self, engine: Engine, webhook: Webhook | None = None, now: Callable[[], float] = time.time) -> None:
        """Create the scheduler; nothing is checked before `start`.

        Args:
            engine: engine that runs the jobs.
            webhook: webhook that notices are sent by; None for no notices.
            now: s since 1970 in UTC.
        """
        self.reidentifications = Reidentifications(engine, now)
        self._engine, self._db, self._state = engine, engine.db, engine.state
        self._webhook, self._now = webhook, now
        self._looked: float | None = None
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._work, name="maintenance", daemon=True)

    def start(self) -> None:
        """Start the scheduler's thread and return at once; call it after `Engine.start` has marked interrupted jobs."""
        self._thread.start()

    @property
    def healthy(self) -> bool:
        """Return whether the scheduler's thread is alive."""
        return self._thread.is_alive()

    def close(self) -> None:
        """Stop the scheduler's thread and the webhook."""
        self._ending.set()
        if self._thread.ident is not None:
            self._thread.join(30.0)
        if self._webhook is not None:
            self._webhook.close()

    def do_pass(self) -> None:
        """Do one pass: mark what is due, advance re-identifications, begin those allowed (arms move), send notices."""
        now = self._now()
        mark_due(self._db, now)
        self.reidentifications.advance()
        for row in pending(self._db):
            if not row["tried"] and not self._engine.closing:
                self._decide(row, now)
        self._looked = now
        self._tell()

    def _work(self) -> None:
        while not self._ending.is_set():
            try:
                self.do_pass()
            except sqlite3.Error as error:  # a full disk, say
                LOG.error("what is due waits for the registry: %s", error)
            except Exception:  # the next pass may succeed
                LOG.exception("what is due could not be looked at")
            self._ending.wait(_TICK)

    def _decide(self, row: Row, now: float) -> None:
        """Decide once whether a due re-identification begins unattended; it is marked before anything moves."""
        self._db.write("UPDATE dues SET tried = 1 WHERE id = ?", row["id"])
        try:
            why = self._reason_against_unattended(row, now)
            if not why:
                found = next(one for one in schedules(self._db, row["arm"]) if one["id"] == row["schedule"])
                self.reidentifications.begin(
                    ReidentificationRequest(row["arm"], found["motion"], unattended=True), SERVICE
                )
        except IdentError as error:
            why = str(error)
        if why:
            note(self._db, SERVICE, "due asks for a person", row["arm"], due=row["id"], why=why)

    def _reason_against_unattended(self, row: Row, now: float) -> str:
        """Return why a due re-identification must not begin without a person; empty if nothing prevents it."""
        arm = row["arm"]
        found = [one for one in schedules(self._db, arm) if one["id"] == row["schedule"]]
        if known_arm(self._db, self._state, arm).config.unattended_motion != "allowed":
            return "the arm's description does not allow motion without a person"
        if self._looked is None:
            return "it was due when the service began"
        if row["late"] or not 0.0 <= now - row["at"] <= LATE or not 0.0 <= now - self._looked <= LATE:
            return "it is late, or the clock was changed"
        if not found or not found[0]["enabled"]:
            return "its schedule was removed or disabled"
        if arm_fault_store(self._state, arm).latched():
            return "a fault waits to be acknowledged"
        waiting = any(one["motion"] for one in jobs(self._db, states=LIVE, arm=arm, most=1000))
        if waiting or is_control_file_in_use(control_path(self._state, arm)):
            return "somebody moves it, or waits to"
        return ""

    def _tell(self) -> None:
        """Send each notice once; it is stored in the transaction that marks it as sent."""
        for table, rows in (("dues", pending(self._db)), ("alarms", alarms(self._db))):
            for row in rows:
                if row["told"]:
                    continue
                with self._db.transaction():
                    if self._webhook is not None:
                        self._webhook.send(*_notice(table, row))
                    self._db.write(f"UPDATE {table} SET told = 1 WHERE id = ?", row["id"])  # noqa: S608 - ours


def _notice(table: str, row: Row) -> tuple[str, float, dict[str, Any]]:
    due = table == "dues"
    data = {"id": row["id"], "arm": row["arm"], "what": row["cause"] if due else row["what"]}
    return "arm.due" if due else "arm.drift_alarm", row["at"], data
