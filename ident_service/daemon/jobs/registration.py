"""Enter in the registry what a job has made: its run or its motion."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from ident_service.daemon.jobs.commands import FOLDERS
from ident_service.registry.database import Database, Row
from ident_service.registry.motions import MOTION_FILE, MOTIONS, index_motion
from ident_service.registry.runs import EXPORTS, RUNS, index_run
from ident_service.results.manifest import MANIFEST, write_manifest

_MAKES_A_RUN = frozenset({"run", "rehearse", "home", "leave_limit", "identify", "simulate", "judge"})

_ABOUT_A_RUN = frozenset({"report", "verify", "compare", "judge", "feasible"})


def keep(db: Database, state: Path, row: Row, by: str) -> None:
    """Enter the folder that a job's process has left, if any.

    Args:
        db: the registry.
        state: the state folder.
        row: of the job.
        by: who asked for it.

    Raises:
        IdentError: the folder is not what its manifest names, or not one of a run.
    """
    made = row["run"]
    if made is None:
        return
    if row["kind"] in _MAKES_A_RUN and (folder := state / RUNS / made).is_dir():
        # A killed process leaves no manifest. Nothing writes there any more, so the present files are final.
        if not (folder / MANIFEST).is_file():
            write_manifest(folder)
        index_run(db, state, made)
    elif row["kind"] == "design" and (state / MOTIONS / made / MOTION_FILE).is_file():
        index_motion(db, state, made, row["arm"], by)
    elif row["kind"] == "correct":
        with suppress(OSError):  # not empty, or removed already
            (state / EXPORTS / made).rmdir()


def folder_of(state: Path, row: Row) -> Path | None:
    """Return the folder that a job makes, whether it exists or not; None for a job that makes none."""
    if row["run"] is None or row["kind"] in _ABOUT_A_RUN:
        return None
    return state / FOLDERS.get(row["kind"], RUNS) / str(row["run"])
