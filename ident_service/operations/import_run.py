"""Import a run folder from another machine below the state folder: verify it, copy it, enter it.

Only what the manifest names is copied, by plain names, into a folder of a plain name: nothing in it can lead elsewhere.
"""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path
from typing import Final

from ident_service.errors import ParameterError, UsageError
from ident_service.registry.audit import note
from ident_service.registry.database import Database, Row
from ident_service.registry.runs import RUNS, index_run, known_run
from ident_service.results.files import appearing_folder
from ident_service.results.manifest import MANIFEST, named_files, verified_files

MOST_BYTES: Final = 64 * 2**30
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,119}")


def import_run(db: Database, state: Path, folder: Path, who: str) -> Row:
    """Import a run folder into the state folder and the registry.

    Args:
        db: the registry.
        state: the state folder.
        folder: with a manifest; files that it does not name are left behind.
        who: asks.

    Returns:
        The run; one that is there already, with the same manifest, is only entered again.

    Raises:
        UsageError: no such folder, a name that no run can have, or another run of that name is there.
        ParameterError: torn, changed or foreign; nothing is kept of it then.
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
    with appearing_folder(target) as staging:
        for name in (*named_files(folder), MANIFEST):
            # Without following a link that was put there since the verification.
            fd = os.open(folder / name, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
            with os.fdopen(fd, "rb") as reading, (staging / name).open("xb") as writing:
                shutil.copyfileobj(reading, writing, 1 << 20)
                writing.flush()
                os.fsync(writing.fileno())
        # Verifies the copy, which nobody else can change.
        verified_files(staging)
