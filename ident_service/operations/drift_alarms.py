"""Judge a comparison with the accepted set, and raise, keep and close drift alarms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Final

from ident_service.errors import UnknownId, UsageError
from ident_service.registry.database import LONGEST_NOTE, Database, Row, note

FLEET: Final = "fleet.json"
"""File of a fleet's results that says which arms have changed."""
_MOST = 4000  # characters


@dataclass(frozen=True)
class Verdict:
    """Verdict of a re-identification.

    Attributes:
        state: `unchanged`, `changed` or `impossible`.
        words: what changed, by how many sigma, what it may mean, and torque errors.
    """

    state: str
    words: str


def verdict_of(document: Mapping[str, Any]) -> Verdict:
    """Return state and words of the verdict in a `comparison.json`: findings, torque errors on the recording.

    Args:
        document: `comparison.json`.
    """
    state, pair = str(document["verdict"]), document["compared"][0]
    parts = [_finding(one) for one in pair["findings"]] or ([pair["reason"]] if pair["reason"] else [])
    errors = pair["torque_error_percent"]
    if errors is not None:
        parts.append(
            f"torque error on the new recording: accepted parameters {errors['reference']['whole']:.3g} %, "
            f"its own {errors['own']['whole']:.3g} %"
        )
    return Verdict(state, f"{state}: {'; '.join(parts)}"[:_MOST] if parts else state)


def _finding(one: Mapping[str, Any]) -> str:
    size = f", {one['size']}" if one["size"] else ""
    return f"{one['what']} ({one['sigma']:.1f} sigma{size}): {one['meaning']}"


def raise_alarm(db: Database, arm: str, reidentification: str, run: str, findings: str, now: float) -> None:
    """Write a new open drift alarm into the registry and the audit trail.

    Args:
        db: the registry.
        arm: name.
        reidentification: id; empty where a fleet shows the change.
        run: id of the run that differs from the accepted set, or of the fleet's results.
        findings: the findings, in words.
        now: s since 1970 in UTC.
    """
    with db.transaction():
        db.write(
            "INSERT INTO alarms (arm, reidentification, run, what, at) VALUES (?, ?, ?, ?, ?)",
            *(arm, reidentification, run, findings, now),
        )
        note(db, "service", "drift alarm", arm, run=run, found=findings)


def raise_fleet_alarms(db: Database, document: Mapping[str, Any], results_id: str, now: float) -> None:
    """Raise an alarm for each change in a fleet unless one for it is open or was raised since the change.

    An alarm is for the change if it is of that arm and group, and is open or was raised after the change. What goes on
    drifting after somebody acknowledged it raises another one.

    Args:
        db: the registry.
        document: `fleet.json`.
        results_id: id of the fleet's results.
        now: s since 1970 in UTC.
    """
    with db.transaction():
        for one in document["changes"]:
            begin = f"changed: {one['what']},"
            until = datetime.fromisoformat(one["until"]).timestamp()
            earlier = [row for row in alarms(db, one["arm"], closed=True, most=1000) if row["what"].startswith(begin)]
            if any(row["closed"] is None or row["at"] >= until for row in earlier):
                continue
            words = (
                f"{begin} as its recordings in a fleet show: a {one['kind']} between {one['after'][:10]} and "
                f"{one['until'][:10]}, {100.0 * one['torque_share']:.2g} % of the torque of joint {one['joint']}, "
                f"{one['sigma']:.1f} sigma"
            )
            raise_alarm(db, one["arm"], "", results_id, words, now)


def alarms(
    db: Database, arm: str | None = None, *, closed: bool = False, before: int | None = None, most: int = 100
) -> list[Row]:
    """Return at most `most` open alarms, or `closed` ones too, the newest first, only those numbered below `before`."""
    return db.rows(
        "SELECT * FROM alarms WHERE (? IS NULL OR arm = ?) AND (? OR closed IS NULL) AND id < ? "
        "ORDER BY id DESC LIMIT ?",
        *(arm, arm, int(closed), 2**62 if before is None else before, most),
    )


def acknowledge_alarm(db: Database, alarm_number: int, remark: str, by: str, now: float) -> Row:
    """Close an open alarm with the remark of a person who acknowledges it; return its row.

    Raises:
        UsageError: no note.
        UnknownId: no such alarm stands.
    """
    remark = remark.strip()
    if not remark or len(remark) > LONGEST_NOTE:
        raise UsageError(f"describe what was found in a note of 1 to {LONGEST_NOTE} characters")
    with db.transaction():
        row = db.row("SELECT * FROM alarms WHERE id = ? AND closed IS NULL", alarm_number)
        if row is None:
            raise UnknownId(f"no open alarm {alarm_number}; see the list of alarms")
        db.write("UPDATE alarms SET closed = ?, closed_by = ?, how = ? WHERE id = ?", now, by, remark, alarm_number)
        note(db, by, "alarm acknowledged", row["arm"], alarm=alarm_number, note=remark)
    return db.rows("SELECT * FROM alarms WHERE id = ?", alarm_number)[0]


def end_alarms(db: Database, arm: str, reason: str, by: str, now: float) -> None:
    """Close all open alarms of an arm: its accepted set has been replaced, as `reason` says."""
    db.write(
        "UPDATE alarms SET closed = ?, closed_by = ?, how = ? WHERE arm = ? AND closed IS NULL", now, by, reason, arm
    )
