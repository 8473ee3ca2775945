"""Schedule re-identification by cron (cronsim, UTC), operating hours or maintenance, and tell what is due.

Times are UTC: no hour comes twice or never. Beside numbers, ranges, steps, lists and English names in three letters,
cronsim knows `L` (last day of the month, `5L`: last Friday) and `1#2` (second Monday).

A time that was missed, because nothing ran or the clock was wrong, is due once. It stays due until a re-identification
of the arm came to a verdict, or a person dismisses it; meanwhile its schedule adds nothing. Operating hours count only
the time in which runs of this registry drove the arm.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from cronsim import CronSim, CronSimError

from ident_service.errors import UnknownId, UsageError
from ident_service.operations.acceptance import acceptances
from ident_service.registry.database import LONGEST_NOTE, Database, Row, note
from ident_service.registry.motions import known_motion
from ident_service.registry.runs import operating_seconds

_FIELDS: Final = 5
_LONGEST: Final = 200  # characters


@dataclass(frozen=True)
class Cron:
    """Times given by cron's five fields.

    Attributes:
        text: the five fields as they were given, with single spaces.
    """

    text: str

    def after(self, seconds: float) -> float:
        """Return the first time after `seconds` that the five fields match in UTC; both times [s since 1970 in UTC].

        Raises:
            UsageError: no such day comes within fifty years.
        """
        found = next(CronSim(self.text, datetime.fromtimestamp(seconds, UTC)), None)
        if found is None:
            raise UsageError(f"{self.text!r}: there is no such day")
        return found.timestamp()


def parse_cron(text: str) -> Cron:
    """Parse and check cron's five fields: minute, hour, day of month, month, day of week; others raise UsageError.

    Raises:
        UsageError: they are not; the message names the field.
    """
    words = text.split() if len(text) <= _LONGEST else []
    if len(words) != _FIELDS:
        raise UsageError(f"{text[:_LONGEST]!r}: cron has five fields: minute, hour, day of month, month, day of week")
    cron = Cron(" ".join(words))
    try:
        cron.after(0.0)
    except CronSimError as error:
        # cronsim names the field: "Bad day-of-month", also for a day that its months never have.
        raise UsageError(f"{cron.text!r}: {str(error).lower()} in cron's five fields") from None
    return cron


MAINTENANCE: Final = "maintenance"
LONGEST_WHAT: Final = 200
MOST_SCHEDULES: Final = 100  # of an arm
LATE: Final = 600.0  # s after which a due re-identification does not begin without a person any more
_HOUR = 3600.0
_DAY = 86400.0
_HOURS = "hours:"


@dataclass(frozen=True)
class DueRule:
    """Rule for when a re-identification is due; exactly one of these.

    Attributes:
        cron: cron expression of five fields in UTC; None otherwise.
        hours: operating hours from one due time to the next [h]; None otherwise.
        maintenance: whether it is due after each maintenance event.
    """

    cron: str | None = None
    hours: float | None = None
    maintenance: bool = False


def add_schedule(db: Database, arm: str, when: DueRule, by: str, now: float, motion: str | None = None) -> Row:
    """Add a schedule of re-identification that counts from now; return its row.

    Args:
        db: the registry.
        arm: name of an arm that it knows.
        when: rule for when the re-identification is due.
        by: name of the requester.
        now: s since 1970 in UTC.
        motion: id; the description's own if None.

    Raises:
        UsageError: not exactly one time or trigger, an invalid one, too many schedules, or a motion for another arm.
    """
    if sum((when.cron is not None, when.hours is not None, when.maintenance)) != 1:
        raise UsageError("give one of: cron, operating hours, maintenance")
    if when.hours is not None and not 0.0 < when.hours < 1e6:
        raise UsageError("operating hours are a number above 0")
    if motion is not None and known_motion(db, motion)["arm"] != arm:
        raise UsageError(f"the motion {motion} was made for another arm than {arm}")
    cron = None if when.cron is None else parse_cron(when.cron)
    trigger = None if cron else MAINTENANCE if when.hours is None else f"{_HOURS}{when.hours!r}"
    with db.transaction():
        if len(schedules(db, arm)) >= MOST_SCHEDULES:
            raise UsageError(f"{arm}: has {MOST_SCHEDULES} schedules already; remove some")
        number = 1 + max(
            int((db.row(f"SELECT COALESCE(MAX({column}), 0) AS id FROM {table}") or {"id": 0})["id"])  # noqa: S608
            for table, column in (("schedules", "id"), ("dues", "schedule"))  # no number comes twice
        )
        db.write(
            "INSERT INTO schedules (id, arm, cron, trigger, request, next, created, created_by, counted) "
            "VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
            *(number, arm, cron and cron.text, trigger, json.dumps({"motion": motion})),
            *(cron and cron.after(now), now, by, operating_seconds(db, arm)),
        )
        note(db, by, "schedule added", arm, schedule=number, when=cron.text if cron else trigger)
    return known_schedule(db, number)


def schedules(db: Database, arm: str | None = None) -> list[Row]:
    """Return all schedules, or those of an arm, the earliest first; each row's `motion` is an id or None."""
    rows = db.rows("SELECT * FROM schedules WHERE ? IS NULL OR arm = ? ORDER BY id", arm, arm)
    return [{**row, "motion": json.loads(row["request"]).get("motion")} for row in rows]


def known_schedule(db: Database, schedule_number: int) -> Row:
    """Return the row of the schedule of this number; raise UnknownId where there is none.

    Raises:
        UnknownId: there is none.
    """
    found = [row for row in schedules(db) if row["id"] == schedule_number]
    if not found:
        raise UnknownId(f"no schedule {schedule_number} is known; see the list of schedules")
    return found[0]


def enable_schedule(db: Database, schedule_number: int, by: str, now: float, *, enabled: bool) -> Row:
    """Enable a schedule from now on, or disable it; what is already due by it stays due.

    Raises:
        UnknownId: there is none.
    """
    with db.transaction():
        row = known_schedule(db, schedule_number)
        if bool(row["enabled"]) is not enabled:
            following = parse_cron(row["cron"]).after(now) if row["cron"] and enabled else row["next"]
            db.write(
                "UPDATE schedules SET enabled = ?, next = ?, counted = ? WHERE id = ?",
                *(int(enabled), following, operating_seconds(db, row["arm"]), schedule_number),
            )
            note(db, by, "schedule enabled" if enabled else "schedule disabled", row["arm"], schedule=schedule_number)
    return known_schedule(db, schedule_number)


def remove_schedule(db: Database, schedule_number: int, by: str) -> None:
    """Remove a schedule; what is already due by it stays due.

    Raises:
        UnknownId: there is none.
    """
    with db.transaction():
        row = known_schedule(db, schedule_number)
        db.write("DELETE FROM schedules WHERE id = ?", schedule_number)
        note(db, by, "schedule removed", row["arm"], schedule=schedule_number, when=row["cron"] or row["trigger"])


def add_event(db: Database, arm: str, work_done: str, remark: str, by: str, now: float) -> Row:
    """Enter maintenance that was done, mark the schedules that follow maintenance as due, return the event's row.

    Args:
        db: the registry.
        arm: name of an arm that it knows.
        work_done: what was done, in a few words.
        remark: further remark; may be empty.
        by: name of the person who reports it.
        now: s since 1970 in UTC.

    Raises:
        UsageError: nothing was said, or too much.
    """
    work_done, remark = work_done.strip(), remark.strip()
    if not work_done or len(work_done) > LONGEST_WHAT or len(remark) > LONGEST_NOTE:
        raise UsageError(f"describe what was done in 1 to {LONGEST_WHAT} characters; a note has {LONGEST_NOTE} at most")
    with db.transaction():
        db.write(
            "INSERT INTO maintenance_events (arm, what, note, at, who) VALUES (?, ?, ?, ?, ?)",
            *(arm, work_done, remark, now, by),
        )
        note(db, by, "maintenance", arm, done=work_done)
        for row in schedules(db, arm):
            if row["enabled"] and row["trigger"] == MAINTENANCE:
                _falls_due(db, row, f"maintenance: {work_done}", now)
    return events(db, arm, most=1)[0]


def events(db: Database, arm: str, *, before: int | None = None, most: int = 100) -> list[Row]:
    """Return at most `most` maintenance events of an arm, the newest first, only those numbered below `before`."""
    last = 2**62 if before is None else before
    return db.rows(
        "SELECT * FROM maintenance_events WHERE arm = ? AND id < ? ORDER BY id DESC LIMIT ?", arm, last, most
    )


def mark_due(db: Database, now: float) -> None:
    """Enter what has become due by cron or by operating hours until now [s since 1970 in UTC]."""
    with db.transaction():
        for row in schedules(db):
            if not row["enabled"]:
                continue
            if row["cron"]:
                _by_cron(db, row, now)
            elif row["trigger"].startswith(_HOURS):
                _by_hours(db, row, now)


def _by_cron(db: Database, row: Row, now: float) -> None:
    cron = parse_cron(row["cron"])
    coming = row["next"]
    if coming <= now:
        _falls_due(db, row, f"cron {row['cron']}", now, late=now - coming > LATE)
        db.write("UPDATE schedules SET last = ?, next = ? WHERE id = ?", now, cron.after(now), row["id"])
        return
    # If the clock was put back, a past time is not due again. But a clock that was more than a day ahead must not
    # silence the schedule until that time comes.
    last = row["last"] or 0.0
    right = cron.after(max(now, last) if last - now <= _DAY else now)
    if right < coming:
        db.write("UPDATE schedules SET next = ? WHERE id = ?", right, row["id"])


def _by_hours(db: Database, row: Row, now: float) -> None:
    hours, total = float(row["trigger"].removeprefix(_HOURS)), operating_seconds(db, row["arm"])
    if total - row["counted"] >= hours * _HOUR:
        _falls_due(db, row, f"{hours:g} operating hours", now)
        db.write("UPDATE schedules SET last = ?, counted = ? WHERE id = ?", now, total, row["id"])


def _falls_due(db: Database, row: Row, cause: str, now: float, *, late: bool = False) -> None:
    """Enter a schedule as due, unless it is due already."""
    if db.write(
        "INSERT INTO dues (arm, schedule, cause, at, late) VALUES (?, ?, ?, ?, ?) ON CONFLICT DO NOTHING",
        *(row["arm"], row["id"], cause, now, int(late)),
    ):
        note(db, "service", "due", row["arm"], schedule=row["id"], cause=cause)


def pending(db: Database, arm: str | None = None) -> list[Row]:
    """Return the re-identifications that are due and neither done nor dismissed, the earliest first."""
    return db.rows("SELECT * FROM dues WHERE closed IS NULL AND (? IS NULL OR arm = ?) ORDER BY id", arm, arm)


def pending_with_accepted(db: Database, state: Path, arm: str | None = None) -> list[dict[str, Any]]:
    """Return the rows of `pending`, each with `accepted`: whether the arm has an accepted set to compare with."""
    return [{**row, "accepted": bool(acceptances(state, row["arm"]))} for row in pending(db, arm)]


def dismiss(db: Database, due_number: int, reason: str, by: str, now: float) -> None:
    """Close a due entry that is not to be done, on a person's decision.

    Raises:
        UsageError: no reason, or too long a one.
        UnknownId: no such entry is due.
    """
    reason = reason.strip()
    if not reason or len(reason) > LONGEST_NOTE:
        raise UsageError(f"give the reason, in 1 to {LONGEST_NOTE} characters")
    with db.transaction():
        row = db.row("SELECT arm FROM dues WHERE id = ? AND closed IS NULL", due_number)
        if row is None:
            raise UnknownId(f"nothing of number {due_number} is due; see the list of due entries")
        db.write("UPDATE dues SET closed = ?, closed_by = ?, how = ? WHERE id = ?", now, by, reason, due_number)
        note(db, by, "due dismissed", row["arm"], due=due_number, note=reason)


def close_dues(db: Database, arm: str, due_until: float, reason: str, by: str, now: float) -> None:
    """Close an arm's entries due until `due_until` [s since 1970 in UTC], because a re-identification did them."""
    db.write(
        "UPDATE dues SET closed = ?, closed_by = ?, how = ? WHERE arm = ? AND at <= ? AND closed IS NULL",
        *(now, by, reason, arm, due_until),
    )
