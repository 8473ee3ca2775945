"""Delete recordings of runs that nobody accepted, the oldest first, to make room on the disk; nothing else.

Parameters, reports, tickets and manifests stay, and so does the row of a recording that was let go, with its hash.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from ident_service.errors import UsageError
from ident_service.service.acceptance import accepted_runs, settle
from ident_service.service.registry.audit import note
from ident_service.service.registry.database import Database
from ident_service.service.registry.runs import run_folder


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
    """Return the recordings that may be deleted: not accepted, not of an arm's `newest` runs, not of a live job.

    Raises:
        UsageError: a number below 0.
    """
    if newest < 0:
        raise UsageError("the number of newest runs that keep their recordings is 0 or more")
    settle(db, state)
    kept = accepted_runs(db)
    busy = {row["run"] for row in db.rows("SELECT run FROM jobs WHERE state IN ('queued', 'running')")}
    rows = db.rows(
        "SELECT recordings.run, name, bytes, rank FROM recordings JOIN (SELECT id, ROW_NUMBER() OVER "
        "(PARTITION BY arm ORDER BY created DESC, id DESC) AS rank FROM runs "
        "WHERE id IN (SELECT run FROM recordings WHERE deleted IS NULL)) ON id = recordings.run "
        "WHERE deleted IS NULL AND rank > ? ORDER BY rank DESC, recordings.run, name",
        newest,
    )
    return [
        Expendable(row["run"], row["name"], row["bytes"])
        for row in rows
        if row["run"] not in kept and row["run"] not in busy
    ]


def let_go(db: Database, state: Path, newest: int, who: str) -> list[Expendable]:
    """Delete the recordings that `expendable` returns; each row is marked first, so that a kill does no damage."""
    gone = expendable(db, state, newest)
    for one in gone:
        with db.transaction():
            db.write("UPDATE recordings SET deleted = ? WHERE run = ? AND name = ?", time.time(), one.run, one.name)
            note(db, who, "recording deleted", one.run, name=one.name, bytes=one.bytes)
        (run_folder(db, state, one.run) / one.name).unlink(missing_ok=True)
    return gone
