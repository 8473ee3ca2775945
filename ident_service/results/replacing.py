"""Replace a folder of results as a whole, and nothing but an earlier result.

What an earlier result left behind would stand beside a manifest that does not name it; a file of the same name that a
person has put there, or a recording, would be lost. So a folder that holds anything else is refused.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ident_service.errors import ParameterError, UsageError
from ident_service.results.files import exchange_folders, staging_beside
from ident_service.results.manifest import MANIFEST, file_sha256, named_files

# Endings of files of identifications and payloads; never of recordings, which are made once.
_MADE = (".json", ".urdf", ".txt", ".html", ".py", ".dat-s")
_TOLD = 3


def require_replaceable(folder: Path) -> None:
    """Refuse a folder that results may not be written to.

    Raises:
        UsageError: it is a file, or holds what is no earlier result; with what it is, and the remedy.
    """
    if not folder.exists():
        return
    if not folder.is_dir():
        raise UsageError(f"{folder}: is a file, not a folder")
    if not (others := _others(folder)):
        return
    told = ", ".join(others[:_TOLD]) + (f" and {len(others) - _TOLD} more" if len(others) > _TOLD else "")
    raise UsageError(
        f"{folder}: holds what is not of an earlier result: {told}; give a folder that does not exist, or move that"
        " elsewhere"
    )


def _others(folder: Path) -> list[str]:
    """Return the names of what a folder holds beside an unchanged earlier result, with the reasons."""
    found = sorted(path.name for path in folder.iterdir())
    try:
        named = dict(named_files(folder)) if MANIFEST in found else {}
    except ParameterError:
        named = {}
    ours = {name for name, sha256 in named.items() if name.endswith(_MADE) and _is(folder / name, sha256)}
    ours |= {MANIFEST} if named else set()
    return [name if name not in named else _why(folder / name, name) for name in found if name not in ours]


def _is(path: Path, sha256: str) -> bool:
    return path.is_file() and not path.is_symlink() and file_sha256(path) == sha256


def _why(path: Path, name: str) -> str:
    return name if not name.endswith(_MADE) or path.is_symlink() else f"{name} (changed since)"


@contextmanager
def replacing_folder(folder: Path) -> Iterator[Path]:
    """Yield a place to build a folder of results in, which replaces an earlier result when the block ends well.

    Raises:
        UsageError: the folder holds anything but an earlier result, before or after the block, or cannot be written.
    """
    require_replaceable(folder)
    with staging_beside(folder) as staging:
        yield staging
        require_replaceable(folder)
        place = folder.resolve()
        try:
            if place.exists():
                exchange_folders(staging, place)
                shutil.rmtree(staging)
            else:
                staging.rename(place)
        except OSError as error:
            what = f"{folder}: cannot be replaced: {error.strerror}"
            raise UsageError(f"{what}; give a folder that does not exist") from None
