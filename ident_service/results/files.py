"""Write files and folders so that they appear whole or not at all."""

from __future__ import annotations

import ctypes
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ident_service.errors import UsageError
from ident_service.recordings.files import (
    write_atomically as write_atomically,  # what motion writes, too, appears whole
)

_EXCHANGE = 2  # RENAME_EXCHANGE


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
    """Yield a place to build a folder's content in, which gets its name when the block ends without an error.

    A folder that exists keeps its other files; files of the same name are replaced one by one.

    Raises:
        UsageError: the folder's place cannot be written, or is a file.
    """
    with staging_beside(folder) as staging:
        yield staging
        if folder.exists():
            for path in sorted(staging.iterdir()):
                path.replace(folder / path.name)
            staging.rmdir()
        else:
            staging.rename(folder)


@contextmanager
def staging_beside(folder: Path) -> Iterator[Path]:
    """Yield a place beside a folder to build its content in; removed with its content after an error.

    Raises:
        UsageError: the folder's place cannot be written, or is a file.
    """
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder}: is a file, not a folder")
    place = folder.resolve()  # a link to a folder stays one, and "." has a name
    staging = place.with_name(f".{place.name}.{secrets.token_hex(4)}.partial")
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        staging.mkdir()
    except OSError as error:
        raise UsageError(f"{folder}: cannot be written: {error.strerror}") from None
    try:
        yield staging
    except BaseException:
        shutil.rmtree(staging, ignore_errors=True)
        raise


def exchange_folders(one: Path, other: Path) -> None:
    """Exchange the names of two folders of one file system, at once where the kernel can (renameat2, Linux 3.15).

    Elsewhere a kill may come between two renames; nothing is lost then, but `other` stands under a hidden name.

    Raises:
        OSError: they cannot be renamed; nothing is changed.
    """
    renameat2 = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    names = [os.fsencode(path.absolute()) for path in (one, other)]  # absolute: what they are relative to is not used
    if renameat2 is not None and renameat2(0, names[0], 0, names[1], _EXCHANGE) == 0:
        return
    between = other.with_name(f".{other.name}.{secrets.token_hex(4)}.old")
    other.rename(between)
    try:
        one.rename(other)
    except OSError:
        between.rename(other)
        raise
    between.rename(one)
