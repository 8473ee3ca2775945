"""Find exports by id: files that jobs made for download, each export a folder below the state folder.

An id counts if a job that has ended made it, a name if the folder has such a file of its own: neither is ever joined to
a path before.
"""

from __future__ import annotations

from pathlib import Path

from ident_service.errors import UnknownId
from ident_service.registry.database import Database, Row
from ident_service.registry.runs import EXPORTS, TAKEN_AWAY

_ENDED = ("done", "refused")  # a payload job that found no load has files, too


def known_export(db: Database, export: str) -> Row:
    """Return the job that made the export of this id.

    Raises:
        UnknownId: there is none, or it made nothing.
    """
    kinds, states = sorted(TAKEN_AWAY), _ENDED
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
    """Return the path of one file of an export.

    Raises:
        UnknownId: no such export, or no such file in it.
    """
    if name not in export_files(db, state, export):
        raise UnknownId(f"the export {export} has no file {name!r}; its list names them")
    return state / EXPORTS / str(known_export(db, export)["run"]) / name


def _marks(values: tuple[str, ...] | list[str]) -> str:
    return ", ".join("?" * len(values))
