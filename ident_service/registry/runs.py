"""List runs and exports by id: what each folder holds, how it ended, and the recordings in it.

The folder is the truth: rows are made from its manifest, and can be made again.

An id counts if a job that has ended made it, a name if the folder has such a file of its own: neither is ever joined to
a path before.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Final

from ident_service.errors import IdentError, ParameterError, UnknownId, UsageError
from ident_service.motion.ending import ENDED
from ident_service.registry.database import LONGEST_NOTE, Database, Row, note
from ident_service.results.manifest import MANIFEST, file_sha256, named_files, verified_files

RUNS, REPORTS, EXPORTS = "runs", "reports", "exports"
DOWNLOADABLE_KINDS: Final = frozenset({"export", "figures", "payload", "correct", "fleet"})
"""Kinds of jobs that make files for download, in a folder of their own below `EXPORTS`."""
UPLOAD, COLUMNS = "upload.json", "columns.yaml"
"""Files of a run that is an uploaded recording: its announcement, and the layout of its columns."""
KILLED: Final = "killed"
_ARM, _PARAMETERS, _SCORE = "arm.json", "parameters.json", "score.json"
_MOST_BYTES = 64 * 2**20
_RECORDING = ".mcap"


def index_run(db: Database, state: Path, run: str) -> Row:
    """Enter a run with its recordings and parameters, or renew it; return its row; raises where a file was altered.

    Raises:
        UsageError: no such folder, or no arm in it.
        ParameterError: its files are not what its manifest names.
    """
    folder = state / RUNS / run
    # A run without a manifest was killed.
    whole = (folder / MANIFEST).is_file()
    gone = frozenset(row["name"] for row in db.rows("SELECT name FROM recordings WHERE run = ? AND deleted > 0", run))
    files = dict(verified_files(folder, may_be_gone=gone)) if whole else {}
    arm = _document(folder / _ARM)
    ended = _document(folder / ENDED) if (folder / ENDED).is_file() else None
    own = str(_document(folder / UPLOAD).get("name")) if UPLOAD in files else ""
    sizes = {
        name: (folder / name).stat().st_size
        for name in files
        if (name.endswith(_RECORDING) or name == own) and name not in gone
    }
    table = _document(folder / _PARAMETERS) if _PARAMETERS in files else None
    name = str(arm.get("name", ""))
    if not name:
        raise UsageError(f"{folder / _ARM}: names no arm")
    with db.transaction():
        values = (
            *(_kind(files), name, None if table is None else table.get("arm", {}).get("sha256")),
            *(_began(folder), _ending(files, ended), file_sha256(folder / MANIFEST) if whole else None, time.time()),
            _driven(arm, ended),
        )
        db.write(
            "INSERT INTO runs VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?) ON CONFLICT (id) DO UPDATE SET kind = excluded.kind, "
            "arm = excluded.arm, arm_sha256 = excluded.arm_sha256, ending = excluded.ending, manifest_sha256 = "
            "excluded.manifest_sha256, indexed = excluded.indexed, seconds = excluded.seconds",
            *(run, *values),
        )
        for recording, size in sizes.items():
            db.write(
                "INSERT OR REPLACE INTO recordings VALUES (?, ?, ?, ?, NULL)", run, recording, files[recording], size
            )
        if table is not None:
            db.write(
                "INSERT OR REPLACE INTO parameter_sets VALUES (?, ?, ?, ?, ?, ?)",
                *(run, files[_PARAMETERS], name, str(table.get("method", "")), _feasible(table)),
                table.get("fit", {}).get("relative_error_percent"),
            )
    return known_run(db, run)


def rebuild_runs(db: Database, state: Path) -> list[str]:
    """Enter run folders that the registry does not know, but of running jobs; return `NAME: why` of unreadable ones."""
    known = {row["id"] for row in db.rows("SELECT id FROM runs")}
    busy = {row["run"] for row in db.rows("SELECT run FROM jobs WHERE state = 'running' AND run IS NOT NULL")}
    unreadable = []
    place = state / RUNS
    for folder in sorted(place.iterdir()) if place.is_dir() else ():
        if folder.name.startswith(".") or folder.name in known | busy or folder.is_symlink():
            continue
        try:
            index_run(db, state, folder.name)
        except (IdentError, OSError) as error:
            unreadable.append(f"{folder.name}: {error}")
    return unreadable


def known_run(db: Database, run: str) -> Row:
    """Return the row of the run of this id; raise UnknownId where there is none.

    Raises:
        UnknownId: there is none.
    """
    return db.known("runs", "run", run)


def runs(db: Database, arm: str | None = None, *, before: str | None = None, most: int = 100) -> list[Row]:
    """Return at most `most` runs, of an arm if named, the newest first, starting with the one older than `before`."""
    return db.newest("runs", "run", "created", arm, before, most)


def recordings(db: Database, run: str) -> list[Row]:
    """Return name, hash, size and time of deletion, None if kept, of each recording of a run, by name."""
    return db.rows("SELECT name, sha256, bytes, deleted FROM recordings WHERE run = ? ORDER BY name", run)


def recordings_of(db: Database, arm_patterns: Sequence[str]) -> list[Row]:
    """Return run, arm and name of every recording that is kept of motions and uploads of some arms, by run.

    Args:
        db: the registry.
        arm_patterns: names of arms, with the wildcards of file names.
    """
    found = db.rows(
        "SELECT runs.id AS run, arm, name FROM recordings JOIN runs ON runs.id = recordings.run "
        "WHERE deleted IS NULL AND kind IN ('motion', 'recording') ORDER BY runs.id, name"
    )
    return [row for row in found if any(fnmatchcase(str(row["arm"]), pattern) for pattern in arm_patterns)]


def recording_name(db: Database, run: str) -> str:
    """Return the name of the only recording of a run; `run.mcap` where it has several, or none.

    Raises:
        UnknownId: no such run.
    """
    names = [row["name"] for row in recordings(db, str(known_run(db, run)["id"]))]
    return str(names[0]) if len(names) == 1 else "run.mcap"


def parameter_set(db: Database, run: str) -> Row | None:
    """Return the registry's row on the parameters that a run holds; None where it holds none."""
    return db.row("SELECT * FROM parameter_sets WHERE run = ?", run)


MOST_TAGS: Final = 16
_TAG = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.:+-]{0,39}")


def label_run(db: Database, run: str, tags: Sequence[str], run_note: str, requester: str) -> Row:
    """Replace the tags and the note of a run, and return its new labels.

    Args:
        db: the registry.
        run: id.
        tags: words by which runs are found again; an empty list takes the tags away.
        run_note: the note; may be empty.
        requester: name of the requester.

    Returns:
        The labels (`run_labels`).

    Raises:
        UnknownId: no such run.
        UsageError: too many tags, one that is no plain word, or too long a note.
    """
    known = str(known_run(db, run)["id"])
    chosen = list(dict.fromkeys(tags))
    if len(chosen) > MOST_TAGS:
        raise UsageError(f"{len(chosen)} tags are too many; a run has {MOST_TAGS} at most")
    if bad := [tag for tag in chosen if not _TAG.fullmatch(tag)]:
        raise UsageError(f"{bad[0]!r}: a tag is one word of letters, digits and _ . : + -, 40 characters at most")
    if len(run_note) > LONGEST_NOTE:
        raise UsageError(f"the note has {len(run_note)} characters; {LONGEST_NOTE} at most")
    with db.transaction():
        db.write(
            "INSERT INTO run_labels VALUES (?, ?, ?, ?, ?) ON CONFLICT (run) DO UPDATE SET "
            "tags = excluded.tags, note = excluded.note, at = excluded.at, who = excluded.who",
            *(known, json.dumps(chosen), run_note, time.time(), requester),
        )
        note(db, requester, "run labelled", known, tags=chosen, note=run_note)
    return run_labels(db, known)[known]


def run_labels(db: Database, run: str | None = None) -> dict[str, Row]:
    """Return the labels of a run, or of all: per run its `tags`, `note`, and `who` gave them `at` what time."""
    found = db.rows("SELECT * FROM run_labels WHERE ? IS NULL OR run = ?", run, run)
    return {row["run"]: {**row, "tags": json.loads(row["tags"])} for row in found}


def shown_labels(labels: Mapping[str, Row], run: str) -> dict[str, Any]:
    """Return `tags` and `note` of a run from what `run_labels` found; empty ones where nobody gave it any."""
    row = labels.get(run, {"tags": [], "note": ""})
    return {"tags": row["tags"], "note": row["note"]}


def run_folder(db: Database, state: Path, run: str) -> Path:
    """Return the path of a run's folder, from the registry's id and no text of a request; raise UnknownId for none."""
    return state / RUNS / str(known_run(db, run)["id"])


def run_files(db: Database, state: Path, run: str) -> dict[str, str]:
    """Return name and SHA-256 of the files of a run that its manifest names and that exist."""
    folder = run_folder(db, state, run)
    if not (folder / MANIFEST).is_file():
        return {}
    return {name: sha256 for name, sha256 in named_files(folder).items() if _own(folder / name)}


def run_file(db: Database, state: Path, run: str, name: str) -> Path:
    """Return the path of a file that the manifest of a run names; raise UnknownId for any other name.

    Raises:
        UnknownId: no such run, or no such file in it.
    """
    if name not in run_files(db, state, run):
        gone = db.row("SELECT deleted FROM recordings WHERE run = ? AND name = ? AND deleted > 0", run, name)
        if gone is not None:
            when = datetime.fromtimestamp(gone["deleted"], UTC).strftime("%Y-%m-%d")
            raise UnknownId(
                f"the recording {name} of the run {run} was deleted on {when} to make room (`ident prune`); what was "
                "identified from it stays, and another recording is needed for more"
            )
        raise UnknownId(f"the run {run} has no file {name!r}; its manifest names them")
    return run_folder(db, state, run) / name


def _own(path: Path) -> bool:
    return path.is_file() and not path.is_symlink()


def _document(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ParameterError(f"{path}: larger than {_MOST_BYTES} bytes")
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise ParameterError(f"{path}: not JSON: {error}") from None
    if not isinstance(content, dict):
        raise ParameterError(f"{path}: not a JSON object")
    return content


def _kind(files: dict[str, str]) -> str:
    if UPLOAD in files:
        return "recording"
    if _SCORE in files:
        return "simulation"
    return "identification" if _PARAMETERS in files else "motion"


def _ending(files: dict[str, str], ended: dict[str, Any] | None) -> str:
    if ended is not None:
        return str(ended.get("error") or ended.get("state") or "unknown")
    return "uploaded" if UPLOAD in files else "done" if _PARAMETERS in files else KILLED


def _driven(arm: dict[str, Any], ended: dict[str, Any] | None) -> float | None:
    """Return how long the control loop drove the arm [s]; None where that is not recorded."""
    cycles, rate = (ended or {}).get("cycles"), arm.get("control", {}).get("rate")
    return cycles / rate if isinstance(cycles, int | float) and isinstance(rate, int | float) and rate > 0 else None


def operating_seconds(db: Database, arm: str) -> float:
    """Return how long the runs of this registry drove an arm in total [s]; other use is not counted."""
    row = db.row("SELECT TOTAL(seconds) AS seconds FROM runs WHERE arm = ?", arm)
    return float(row["seconds"]) if row is not None else 0.0


def _feasible(table: dict[str, Any]) -> int | None:
    feasible = table.get("feasibility", {}).get("feasible")
    return None if feasible is None else int(bool(feasible))


def _began(folder: Path) -> float:
    return min((path.stat().st_mtime for path in folder.iterdir()), default=time.time())


_ENDED = ("done", "refused")  # a payload job that found no load has files, too


def known_export(db: Database, export: str) -> Row:
    """Return the row of the job that made the export of this id; raise UnknownId where there is none.

    Raises:
        UnknownId: there is none, or it made nothing.
    """
    kinds, states = sorted(DOWNLOADABLE_KINDS), _ENDED
    row = db.row(
        f"SELECT id, kind, arm, run, created_by, ended FROM jobs WHERE run = ? AND kind IN ({_marks(kinds)}) "  # noqa: S608
        f"AND state IN ({_marks(states)})",
        *(export, *kinds, *states),
    )
    if row is None:
        raise UnknownId(f"no export {export!r} is known; the job that made one names it as its run")
    return row


def export_files(db: Database, state: Path, export: str) -> dict[str, int]:
    """Return the files of an export, name to size [bytes].

    Raises:
        UnknownId: no such export.
    """
    folder = state / EXPORTS / str(known_export(db, export)["run"])
    found = sorted(folder.iterdir()) if folder.is_dir() else []
    return {path.name: path.stat().st_size for path in found if path.is_file() and not path.is_symlink()}


def export_file(db: Database, state: Path, export: str, name: str) -> Path:
    """Return the path of one file of an export; raise UnknownId where there is no such file.

    Raises:
        UnknownId: no such export, or no such file in it.
    """
    if name not in export_files(db, state, export):
        raise UnknownId(f"the export {export} has no file {name!r}; its list names them")
    return state / EXPORTS / str(known_export(db, export)["run"]) / name


def _marks(values: tuple[str, ...] | list[str]) -> str:
    return ", ".join("?" * len(values))
