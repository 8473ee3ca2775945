"""Files appear whole or not at all."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ident_service.errors import UsageError
from ident_service.record.files import write_atomically as write_atomically  # what motion writes, too, appears whole


def require_place(folder: Path) -> None:
    """Refuse a folder that could not be written, before work is done for it.

    Raises:
        UsageError: it is a file, or lies where nothing can be written.
    """
    place = folder
    while not place.exists() and place != place.parent:
        place = place.parent
    if not place.is_dir():
        raise UsageError(f"{place}: is a file, not a folder")
    if not os.access(place, os.W_OK | os.X_OK) or str(place.resolve()).startswith("/proc"):
        raise UsageError(f"{folder}: cannot be written: no permission in {place}")


@contextmanager
def appearing_folder(folder: Path) -> Iterator[Path]:
    """A place to build a folder's content in; it appears under its name when the block ends without an error.

    A folder that exists keeps its other files; files of the same name are replaced one by one.

    Raises:
        UsageError: the folder's place cannot be written, or is a file.
    """
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder}: is a file, not a folder")
    staging = folder.with_name(f".{folder.name}.{secrets.token_hex(4)}.partial")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        staging.mkdir()
    except OSError as error:
        raise UsageError(f"{folder}: cannot be written: {error.strerror}") from None
    try:
        yield staging
        if folder.exists():
            for path in sorted(staging.iterdir()):
                path.replace(folder / path.name)
            staging.rmdir()
        else:
            staging.rename(folder)
    except BaseException:
        shutil.rmtree(staging, ignore_errors=True)
        raise
