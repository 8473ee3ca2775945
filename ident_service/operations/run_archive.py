"""Import run folders from other machines, and prune recordings.

An import copies only what the manifest names. File and folder names must be plain, so that no path leads elsewhere.
Pruning leaves parameters, reports, tickets, manifests, and the row of each recording with its hash.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from ident_service.errors import ParameterError, UsageError
from ident_service.operations.acceptance import accepted_recordings, accepted_runs, synchronise
from ident_service.registry.database import Database, Row, note
from ident_service.registry.runs import RUNS, index_run, known_run, run_folder
from ident_service.results.manifest import MANIFEST, atomic_folder, named_files, verified_files

MOST_BYTES: Final = 64 * 2**30
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,119}")


def import_run(db: Database, state: Path, folder: Path, who: str) -> Row:
    """Verify a run folder, copy it into the state folder and enter it in the registry; return its row.

    Args:
        db: the registry.
        state: the state folder.
        folder: folder with a manifest; files that it does not name are left behind.
        who: name of the requester.

    Returns:
        The run; one that is there already, with the same manifest, is only entered again.

    Raises:
        UsageError: no such folder, a name that no run can have, or another run of that name is there.
        ParameterError: the folder is truncated, changed or foreign; nothing is kept of it then.
    """
    name = folder.resolve().name
    if not _NAME.fullmatch(name):
        raise UsageError(f"{folder}: a run's folder has a plain name: letters, digits, and _ . - between them")
    if folder.is_symlink():
        raise UsageError(f"{folder}: a link; give the folder itself")
    files = verified_files(folder)
    if (size := sum((folder / file).stat().st_size for file in files)) > MOST_BYTES:
        raise ParameterError(f"{folder}: {size} bytes, more than the {MOST_BYTES} of the largest run")
    target = state / RUNS / name
    if target.exists():
        if not (target / MANIFEST).is_file() or named_files(target) != files:
            raise UsageError(f"{target}: another run of this name is there; rename the folder that is imported")
    else:
        _copy(folder, target)
    try:
        row = index_run(db, state, name)
    except BaseException:
        if not db.row("SELECT 1 FROM runs WHERE id = ?", name):
            shutil.rmtree(target, ignore_errors=True)
        raise
    note(db, who, "run imported", name, manifest_sha256=row["manifest_sha256"])
    return known_run(db, name)


def _copy(folder: Path, target: Path) -> None:
    with atomic_folder(target) as staging:
        for name in (*named_files(folder), MANIFEST):
            # Without following a link that was put there since the verification.
            fd = os.open(folder / name, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
            with os.fdopen(fd, "rb") as reading, (staging / name).open("xb") as writing:
                shutil.copyfileobj(reading, writing, 1 << 20)
                writing.flush()
                os.fsync(writing.fileno())
        # Verifies the copy, which nobody else can change.
        verified_files(staging)


@dataclass(frozen=True)
class PrunableRecording:
    """Recording that the retention policy allows to delete.

    Attributes:
        run: id.
        name: of the file.
        bytes: size of the file [bytes].
    """

    run: str
    name: str
    bytes: int


def prunable_recordings(db: Database, state: Path, runs_to_keep: int) -> list[PrunableRecording]:
    """Return the recordings that `prune` would delete: all but those of each arm's newest runs, acceptances, live jobs.

    Kept are those of accepted runs, those of other runs that an accepted set was identified from or judged on, those of
    each arm's `runs_to_keep` runs, and those that a waiting or running job makes or reads.

    Raises:
        UsageError: a number below 0.
        ParameterError: an accepted set was changed, so that nobody knows what it stems from.
    """
    if runs_to_keep < 0:
        raise UsageError("the number of newest runs that keep their recordings is 0 or more")
    synchronise(db, state)
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
        PrunableRecording(row["run"], row["name"], row["bytes"])
        for row in rows
        if row["rank"] > runs_to_keep and row["run"] not in kept | busy and row["sha256"] not in needed
    ]


def _busy(db: Database) -> set[str]:
    """Return the ids of runs that a waiting or running job makes, or reads recordings of."""
    found = set[str]()
    for job in db.rows("SELECT run, request FROM jobs WHERE state IN ('queued', 'running')"):
        found.add(str(job["run"]))
        request = json.loads(job["request"])
        for key in ("recordings", "validate_on", "after"):
            found |= {str(one.get("run")) for one in request.get(key) or ()}
    for again in db.rows("SELECT recorded, run FROM reidentifications WHERE state = 'running'"):
        found |= {str(again["recorded"]), str(again["run"])}
    return found


def prune(db: Database, state: Path, runs_to_keep: int, who: str) -> list[PrunableRecording]:
    """Delete the recordings that `prunable_recordings` returns, and return them; a kill on the way does no damage."""
    gone = prunable_recordings(db, state, runs_to_keep)
    for one in gone:
        with db.transaction():
            db.write("UPDATE recordings SET deleted = ? WHERE run = ? AND name = ?", time.time(), one.run, one.name)
            note(db, who, "recording deleted", one.run, name=one.name, bytes=one.bytes)
        (run_folder(db, state, one.run) / one.name).unlink(missing_ok=True)
    return gone
