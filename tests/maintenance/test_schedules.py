"""What falls due and when, in a time that the test sets; rows of a real registry."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from maintenance.conftest import ARM, MONDAY, Clock

from ident_service.errors import UnknownId, UsageError
from ident_service.operations.drift_alarms import acknowledge_alarm, alarms, raise_alarm, raise_fleet_alarms
from ident_service.operations.maintenance_schedule import (
    DueRule,
    add_event,
    add_schedule,
    dismiss,
    enable_schedule,
    events,
    known_schedule,
    mark_due,
    pending,
    remove_schedule,
    schedules,
)
from ident_service.registry.arms import add_arm
from ident_service.registry.database import Database, audit_log
from ident_service.registry.runs import _driven

HOUR, DAY = 3600.0, 86400.0


def drove(db: Database, run: str, hours: float) -> None:
    """A run of the registry drove the arm."""
    db.write(
        "INSERT INTO runs (id, kind, arm, created, ending, indexed, seconds) VALUES (?, 'motion', ?, 0, 'done', 0, ?)",
        *(run, ARM, hours * HOUR),
    )


def done(db: Database) -> int:
    """How many are due; they are done now."""
    rows = pending(db, ARM)
    for row in rows:
        dismiss(db, row["id"], "done", "me", 0.0)
    return len(rows)


def test_a_time_comes_once_however_often_somebody_looks(db: Database, clock: Clock) -> None:
    row = add_schedule(db, ARM, DueRule(cron="0 6 * * *"), "me", clock())
    assert row["next"] == MONDAY + 6 * HOUR
    for _ in range(3):
        mark_due(db, clock())
    assert pending(db) == []
    clock.forward(6 * HOUR)
    for _ in range(3):
        mark_due(db, clock())
    assert [(one["cause"], one["late"]) for one in pending(db)] == [("cron 0 6 * * *", 0)]
    clock.forward(5 * DAY)  # due still, and not five times
    mark_due(db, clock())
    assert done(db) == 1
    mark_due(db, clock())
    assert pending(db) == []
    clock.forward(DAY)
    mark_due(db, clock())
    assert done(db) == 1


def test_times_that_were_missed_are_due_once_and_late(db: Database, clock: Clock) -> None:
    add_schedule(db, ARM, DueRule(cron="0 * * * *"), "me", clock())
    clock.forward(30 * DAY + HOUR / 2)
    mark_due(db, clock())
    assert [one["late"] for one in pending(db)] == [1]
    assert done(db) == 1
    mark_due(db, clock())
    assert pending(db) == []
    assert known_schedule(db, 1)["next"] == MONDAY + 30 * DAY + HOUR


def test_a_clock_that_is_put_back_makes_nothing_due_again(db: Database, clock: Clock) -> None:
    add_schedule(db, ARM, DueRule(cron="0 6 * * *"), "me", clock())
    clock.forward(6 * HOUR)
    mark_due(db, clock())
    assert done(db) == 1
    clock.forward(-HOUR)
    for _ in range(13):
        mark_due(db, clock())
        clock.forward(HOUR / 6)
    assert pending(db) == []
    clock.at = MONDAY + DAY + 6 * HOUR
    mark_due(db, clock())
    assert done(db) == 1


def test_a_clock_that_was_wrong_by_years_silences_nothing(db: Database, clock: Clock) -> None:
    add_schedule(db, ARM, DueRule(cron="0 6 * * *"), "me", clock())
    clock.forward(20 * 365 * DAY)
    mark_due(db, clock())
    assert done(db) == 1
    clock.at = MONDAY
    mark_due(db, clock())
    assert pending(db) == []
    clock.forward(6 * HOUR)
    mark_due(db, clock())
    assert done(db) == 1


def test_operating_hours_count_from_when_it_was_due_last(db: Database, clock: Clock) -> None:
    drove(db, "before", 100.0)
    add_schedule(db, ARM, DueRule(hours=10.0), "me", clock())
    drove(db, "a", 9.9)
    mark_due(db, clock())
    assert pending(db) == []
    drove(db, "b", 0.2)
    mark_due(db, clock())
    assert [one["cause"] for one in pending(db)] == ["10 operating hours"]
    assert done(db) == 1
    drove(db, "c", 9.9)
    mark_due(db, clock())
    assert pending(db) == []
    drove(db, "d", 35.0)
    mark_due(db, clock())
    assert done(db) == 1


def test_hours_are_those_that_a_run_was_driven() -> None:
    assert _driven({"control": {"rate": 500.0}}, {"state": "done", "cycles": 1500}) == 3.0
    assert _driven({"control": {"rate": 500.0}}, {"error": "a fault"}) is None
    assert _driven({}, None) is None


def test_maintenance_makes_due_what_is_scheduled_after_it(db: Database, clock: Clock) -> None:
    assert add_event(db, ARM, " gear oil changed ", "joint 2", "me", clock())["what"] == "gear oil changed"
    assert pending(db) == []
    add_schedule(db, ARM, DueRule(maintenance=True), "me", clock())
    add_schedule(db, ARM, DueRule(cron="0 6 * * *"), "me", clock())
    add_event(db, ARM, "belt changed", "", "me", clock())
    add_event(db, ARM, "and the other", "", "me", clock())
    assert [one["cause"] for one in pending(db)] == ["maintenance: belt changed"]
    assert [one["what"] for one in events(db, ARM)] == ["and the other", "belt changed", "gear oil changed"]
    for what, note in (("", ""), (" ", ""), ("x" * 201, ""), ("x", "y" * 2001)):
        with pytest.raises(UsageError, match="describe what was done"):
            add_event(db, ARM, what, note, "me", clock())


def test_disabled_ones_count_nothing_and_enabled_ones_count_from_then(db: Database, clock: Clock) -> None:
    for when in (DueRule(cron="0 6 * * *"), DueRule(hours=1.0), DueRule(maintenance=True)):
        number = add_schedule(db, ARM, when, "me", clock())["id"]
        enable_schedule(db, number, "me", clock(), enabled=False)
    clock.forward(2 * DAY)
    drove(db, "a", 5.0)
    add_event(db, ARM, "belt", "", "me", clock())
    mark_due(db, clock())
    assert pending(db) == []
    for row in schedules(db):
        enable_schedule(db, row["id"], "me", clock(), enabled=True)
    mark_due(db, clock())
    assert pending(db) == []
    clock.forward(7 * HOUR)
    drove(db, "b", 1.0)
    mark_due(db, clock())
    assert sorted(one["schedule"] for one in pending(db)) == [1, 2]


def test_what_cannot_be_meant_is_refused(db: Database, state: Path, clock: Clock) -> None:
    for when in (
        DueRule(),
        DueRule(cron="0 6 * * *", maintenance=True),
        DueRule(hours=0.0),
        DueRule(hours=float("nan")),
    ):
        with pytest.raises(UsageError):
            add_schedule(db, ARM, when, "me", clock())
    with pytest.raises(UnknownId):
        add_schedule(db, ARM, DueRule(maintenance=True), "me", clock(), "nothing")
    add_arm(
        db,
        state,
        (state / next(iter(db.rows("SELECT folder FROM arms WHERE name = 'quick'")))["folder"] / "arm.yaml")
        .read_text()
        .replace("name: quick", "name: other"),
        {},
        "me",
    )
    add_schedule(db, "other", DueRule(maintenance=True), "me", clock())
    assert schedules(db, ARM) == []
    for act in (lambda: known_schedule(db, 9), lambda: remove_schedule(db, 9, "me")):
        with pytest.raises(UnknownId):
            act()
    with pytest.raises(UsageError, match="the reason"):
        dismiss(db, 1, " ", "me", clock())


def test_a_number_never_comes_twice_and_the_trail_names_who(db: Database, clock: Clock) -> None:
    first = add_schedule(db, ARM, DueRule(maintenance=True), "ann", clock())["id"]
    add_event(db, ARM, "belt", "", "bob", clock())
    remove_schedule(db, first, "carl")
    assert add_schedule(db, ARM, DueRule(maintenance=True), "ann", clock())["id"] != first
    assert len(pending(db)) == 1  # what was due by the one that is gone still is
    told = {line["what"]: line["who"] for line in audit_log(db)}
    assert told["schedule added"] == "ann"
    assert told["maintenance"] == "bob"
    assert told["schedule removed"] == "carl"
    assert told["due"] == "service"


def test_a_change_that_a_fleet_shows_is_an_alarm_once(db: Database, clock: Clock) -> None:
    change: dict[str, Any] = {
        "arm": ARM,
        "what": "friction of joint elbow",
        "kind": "step",
        "after": "2026-01-15T00:00:00+00:00",
        "until": "2026-01-22T00:00:00+00:00",
        "joint": "elbow",
        "torque_share": 0.12,
        "sigma": 19.1,
    }
    week = 7 * 86_400.0
    begin = datetime.fromisoformat(change["until"]).timestamp()

    def told(now: float, **other: str) -> list[str]:
        before = {row["id"] for row in alarms(db, closed=True)}
        raise_fleet_alarms(db, {"changes": [change | other]}, "export", now)
        return [row["what"] for row in alarms(db, closed=True) if row["id"] not in before]

    assert told(begin + week) == [
        "changed: friction of joint elbow, as its recordings in a fleet show: a step between 2026-01-15 and "
        "2026-01-22, 12 % of the torque of joint elbow, 19.1 sigma"
    ]
    assert told(begin + 2 * week) == [], "one stands"
    assert len(told(begin + 2 * week, what="friction of joint shoulder")) == 1
    assert len(told(begin + 2 * week, arm="other")) == 1
    acknowledge_alarm(db, 1, "the seal is dry", "me", begin + 2 * week)
    assert told(begin + 3 * week) == [], "somebody knows of it"
    later = datetime.fromtimestamp(begin + 4 * week, UTC).isoformat()
    assert len(told(begin + 5 * week, until=later)) == 1, "another change"


def test_an_alarm_stands_until_a_person_says_why_it_may_go(db: Database, clock: Clock) -> None:
    raise_alarm(db, ARM, "r", "run", "friction of joint elbow", clock())
    for remark in ("", "  ", "x" * 2001):
        with pytest.raises(UsageError, match="note"):
            acknowledge_alarm(db, 1, remark, "me", clock())
    assert [row["what"] for row in alarms(db, ARM)] == ["friction of joint elbow"]
    assert acknowledge_alarm(db, 1, "seal replaced next week", "me", clock())["closed_by"] == "me"
    assert alarms(db) == []
    assert len(alarms(db, closed=True)) == 1
    with pytest.raises(UnknownId):
        acknowledge_alarm(db, 1, "again", "me", clock())
