"""Delete runs, motions and arms; entries that refer to one are listed first, and nothing in use is deleted.

A folder is renamed to a hidden name before its row is deleted, and back where that fails. A kill in between leaves a
row without a folder, and deleting again completes it. Renamed folders are also removed at the next start. The audit
trail stays.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Final, Literal

from ident_service.errors import Dependent, DriverError, InUse, UsageError
from ident_service.motion.command_channel import ControlFile
from ident_service.operations.maintenance_schedule import remove_schedule
from ident_service.registry.arms import DESCRIPTIONS, register_shipped_arms
from ident_service.registry.database import Database, Row, note
from ident_service.registry.jobs import LIVE
from ident_service.registry.motions import MOTIONS, known_motion
from ident_service.registry.runs import REPORTS, RUNS, known_run
from ident_service.registry.state_folder import arm_fault_store, arm_folder, control_path

_GONE: Final = ".deleted"
_PLACES: Final = (RUNS, MOTIONS, DESCRIPTIONS, "arms")


def delete_run(db: Database, state: Path, run: str, who: str, *, anyway: bool = False) -> list[Dependent]:
    """Delete a run, its folder and its report; raise InUse if anything refers to it, unless `anyway`; return that.

    Acceptances keep their copy of its parameters, and operating hours still count it.

    Args:
        db: the registry.
        state: the state folder.
        run: id.
        who: name of the requester.
        anyway: whether to delete it although something refers to it.

    Returns:
        What refers to it.

    Raises:
        UnknownId: no such run.
        InUse: a job that waits or runs is about it; or something refers to it, and it is not deleted anyway.
    """
    row = known_run(db, run)
    found = _of_run(db, row)
    _require_idle(f"the run {run}", _jobs_about(db, row["arm"], run))
    _require_no_dependents(f"the run {run}", found, anyway=anyway)
    forget_run(db, state, run, who)
    return found


def delete_motion(db: Database, state: Path, motion: str, who: str, *, anyway: bool = False) -> list[Dependent]:
    """Delete a motion and the schedules that would run it, raising InUse for them unless `anyway`; return them.

    Arguments as `delete_run`.
    """
    row = known_motion(db, motion)
    found = [Dependent("schedule", str(one), "deleted") for one in _schedules_of(db, row)]
    _require_idle(f"the motion {motion}", _jobs_about(db, row["arm"], motion))
    _require_no_dependents(f"the motion {motion}", found, anyway=anyway)
    _delete_motion(db, state, row, who)
    return found


def delete_arm(db: Database, state: Path, arm: str, who: str, *, anyway: bool = False) -> list[Dependent]:
    """Delete an uploaded arm, its runs, motions, schedules, acceptances; InUse for any unless `anyway`; return them.

    A shipped arm of the same name is there again afterwards.

    Raises:
        UsageError: it is a shipped one.
        InUse: as above; or it is being moved, or has a fault that nobody has acknowledged.
    """
    row = db.known("arms", "arm", arm, "name")
    if row["source"] == "shipped":
        raise UsageError(f"{arm} comes with this software; it cannot be deleted")
    live = db.rows(f"SELECT id FROM jobs WHERE arm = ? AND state IN {LIVE}", arm)  # noqa: S608 - ours
    live += db.rows("SELECT id FROM reidentifications WHERE arm = ? AND state = 'running'", arm)
    _require_idle(f"the arm {arm}", [one["id"] for one in live])
    if faults := arm_fault_store(state, arm).latched():
        raise InUse(f"the arm {arm} has unacknowledged faults: {', '.join(faults)}")
    runs = db.rows("SELECT * FROM runs WHERE arm = ? ORDER BY id", arm)
    motions = db.rows("SELECT * FROM motions WHERE arm = ? ORDER BY id", arm)
    found = [
        *(Dependent("run", one["id"], "deleted") for one in runs),
        *(Dependent("motion", one["id"], "deleted") for one in motions),
        *_numbered(db, "schedule", "SELECT id FROM schedules WHERE arm = ? ORDER BY id", arm),
        *_numbered(db, "acceptance", "SELECT number AS id FROM acceptances WHERE arm = ? ORDER BY number", arm),
    ]
    _require_no_dependents(f"the arm {arm}", found, anyway=anyway)
    with ExitStack() as held:
        try:  # held, so that nobody at a terminal can move the arm
            held.enter_context(ControlFile.take(control_path(state, arm), None))
        except DriverError as error:
            raise InUse(f"the arm {arm} is being moved: {error}") from None
        for one in runs:
            forget_run(db, state, one["id"], who)
        for one in motions:
            _delete_motion(db, state, one, who)
        place, own = state / DESCRIPTIONS, re.compile(re.escape(arm) + r"-[0-9a-f]{16}")
        with ExitStack() as hiding, db.transaction():
            if db.row("SELECT id FROM runs WHERE arm = ?", arm):
                raise InUse(f"a run of the arm {arm} came meanwhile; delete the arm again")
            # Within the transaction, so that adding the arm again sees its description either complete or gone.
            described = [path for path in (place.iterdir() if place.is_dir() else ()) if own.fullmatch(path.name)]
            hiding.enter_context(_hidden([arm_folder(state, arm), *described]))
            for table in ("schedules", "dues", "alarms", "acceptances", "reidentifications", "maintenance_events"):
                db.write(f"DELETE FROM {table} WHERE arm = ?", arm)  # noqa: S608 - ours
            db.write("DELETE FROM arms WHERE name = ?", arm)
            note(db, who, "arm deleted", arm, with_it=[asdict(one) for one in found[:100]])
            register_shipped_arms(db)
    return found


def remove_deleted(state: Path) -> None:
    """Remove the hidden folders of deletions that a killed process left unfinished."""
    for place in (state / name for name in _PLACES):
        _remove(path for path in (place.iterdir() if place.is_dir() else ()) if path.name.endswith(_GONE))


def _of_run(db: Database, row: Row) -> list[Dependent]:
    run, arm = row["id"], row["arm"]
    again = "SELECT id FROM reidentifications WHERE ? IN (recorded, run) ORDER BY id"
    return [
        *_numbered(db, "acceptance", "SELECT number AS id FROM acceptances WHERE run = ? ORDER BY number", run, "kept"),
        *(Dependent("identification", one, "kept") for one in _made_from(db, arm, run)),
        *_numbered(db, "re-identification", again, run, "kept"),
        *_numbered(db, "alarm", "SELECT id FROM alarms WHERE run = ? AND closed IS NULL", run, "kept"),
    ]


def _schedules_of(db: Database, row: Row) -> list[int]:
    rows = db.rows("SELECT id, request FROM schedules WHERE arm = ? ORDER BY id", row["arm"])
    return [one["id"] for one in rows if json.loads(one["request"]).get("motion") == row["id"]]


def _numbered(
    db: Database, kind: str, sql: str, about: str, becomes: Literal["deleted", "kept"] = "deleted"
) -> list[Dependent]:
    return [Dependent(kind, str(one["id"]), becomes) for one in db.rows(sql, about)]


def _made_from(db: Database, arm: str, run: str) -> list[str]:
    """Return the ids of runs and exports that were made from the recordings of a run."""
    return [
        job["run"]
        for job in db.rows("SELECT * FROM jobs WHERE arm = ? AND state = 'done' ORDER BY number", arm)
        if job["run"] not in (None, run)
        and any(
            one.get("run") == run
            for key in ("recordings", "validate_on", "after")
            for one in json.loads(job["request"]).get(key) or ()
        )
    ]


def _jobs_about(db: Database, arm: str, name: str) -> list[str]:
    rows = db.rows(f"SELECT id, run, request FROM jobs WHERE arm = ? AND state IN {LIVE}", arm)  # noqa: S608 - ours
    found = [one["id"] for one in rows if one["run"] == name or f'"{name}"' in one["request"]]
    again = "SELECT id FROM reidentifications WHERE state = 'running' AND ? IN (motion, recorded, run)"
    return found + [one["id"] for one in db.rows(again, name)]


def _require_idle(what: str, busy: list[str]) -> None:
    if busy:
        raise InUse(f"{what} is used by {', '.join(busy[:10])}; wait for the end, or cancel it")


def _require_no_dependents(what: str, found: list[Dependent], *, anyway: bool) -> None:
    if found and not anyway:
        names = ", ".join(f"{one.kind} {one.id}" for one in found[:10]) + (", ..." if len(found) > 10 else "")
        raise InUse(f"{what} is referred to by {names}", found)


def forget_run(db: Database, state: Path, run: str, who: str) -> None:
    """Delete a run's folder, row and report without asking what refers to it; raises UnknownId."""
    row = known_run(db, run)
    with _hidden([state / RUNS / run]), db.transaction():
        # The operating hours of the run still count for the arm's schedules.
        db.write("UPDATE schedules SET counted = counted - ? WHERE arm = ?", row["seconds"] or 0.0, row["arm"])
        db.write("DELETE FROM runs WHERE id = ?", run)
        note(db, who, "run deleted", run, arm=row["arm"], manifest_sha256=row["manifest_sha256"])
    (state / REPORTS / f"{run}.html").unlink(missing_ok=True)


def _delete_motion(db: Database, state: Path, row: Row, who: str) -> None:
    motion = row["id"]
    with _hidden([state / MOTIONS / motion]), db.transaction():
        for schedule in _schedules_of(db, row):
            remove_schedule(db, schedule, who)
        db.write("DELETE FROM motions WHERE id = ?", motion)
        note(db, who, "motion deleted", motion, arm=row["arm"], sha256=row["sha256"])


@contextmanager
def _hidden(folders: Iterable[Path]) -> Iterator[None]:
    """Hide folders for the block and remove them after it; put them back where it raises, as on a full disk."""
    moved: list[tuple[Path, Path]] = []
    try:
        for folder in folders:
            hidden = folder.with_name(f".{folder.name}{_GONE}")
            if folder.exists():
                shutil.rmtree(hidden, ignore_errors=True)
                folder.rename(hidden)
                moved.append((folder, hidden))
        yield
    except BaseException:
        for folder, hidden in reversed(moved):
            with suppress(OSError):
                hidden.rename(folder)
        raise
    _remove(hidden for _, hidden in moved)


def _remove(folders: Iterable[Path]) -> None:
    for folder in list(folders):
        shutil.rmtree(folder, ignore_errors=True)
