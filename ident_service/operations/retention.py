"""Let recordings go when the disk fills: those that no accepted set stems from, the oldest first, and nothing else.

Parameters, reports, tickets and manifests stay, and so does the row of a recording that was let go, with its hash.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path

from ident_service.errors import UsageError
from ident_service.operations.acceptance import accepted_recordings, accepted_runs, settle
from ident_service.registry.audit import note
from ident_service.registry.database import Database
from ident_service.registry.runs import run_folder


@dataclass(frozen=True)
class Expendable:
    """Recording that the retention policy allows to delete.

    Attributes:
        run: id.
        name: of the file.
        bytes: its size.
    """

    run: str
    name: str
    bytes: int


def expendable(db: Database, state: Path, newest: int) -> list[Expendable]:
    """Recordings that the policy lets go.

    Kept are those of accepted runs, those of other runs that an accepted set was identified from or judged on, those of
    each arm's `newest` runs, and those that a job which waits or runs has or reads.

    Raises:
        UsageError: a number below 0.
        ParameterError: an accepted set was changed, so that nobody knows what it stems from.
    """
    if newest < 0:
        raise UsageError("the number of newest runs that keep their recordings is 0 or more")
    settle(db, state)
    kept = accepted_runs(db)
    busy = _busy(db)
    rows = db.rows(
        "SELECT recordings.run, name, sha256, bytes, rank FROM recordings JOIN (SELECT id, ROW_NUMBER() OVER "
        "(PARTITION BY arm ORDER BY created DESC, id DESC) AS rank FROM runs "
        "WHERE id IN (SELECT run FROM recordings WHERE deleted IS NULL)) ON id = recordings.run "
        "WHERE deleted IS NULL ORDER BY rank DESC, recordings.run, name"
    )
    needed = accepted_recordings(state) - {row["sha256"] for row in rows if row["run"] in kept}
    return [
        Expendable(row["run"], row["name"], row["bytes"])
        for row in rows
        if row["rank"] > newest and row["run"] not in kept | busy and row["sha256"] not in needed
    ]


def _busy(db: Database) -> set[str]:
    """Ids of the runs that a job which waits or runs makes, or reads recordings of."""
    found = set[str]()
    for job in db.rows("SELECT run, request FROM jobs WHERE state IN ('queued', 'running')"):
        found.add(str(job["run"]))
        request = json.loads(job["request"])
        for key in ("recordings", "validate_on", "after"):
            found |= {str(one.get("run")) for one in request.get(key) or ()}
    for again in db.rows("SELECT recorded, run FROM reidentifications WHERE state = 'running'"):
        found |= {str(again["recorded"]), str(again["run"])}
    return found


def let_go(db: Database, state: Path, newest: int, who: str) -> list[Expendable]:
    """Delete the recordings that `expendable` returns; each row is marked first, so that a kill does no damage."""
    gone = expendable(db, state, newest)
    for one in gone:
        with db.transaction():
            db.write("UPDATE recordings SET deleted = ? WHERE run = ? AND name = ?", time.time(), one.run, one.name)
            note(db, who, "recording deleted", one.run, name=one.name, bytes=one.bytes)
        (run_folder(db, state, one.run) / one.name).unlink(missing_ok=True)
    return gone
