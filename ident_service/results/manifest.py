"""Write files whole or not at all; name and verify those of a folder by SHA-256.

Nothing is believed of a folder that is read before every file has the hash that its manifest names.

What an earlier result left behind would stand beside a manifest that does not name it; a file of the same name that a
person has put there, or a recording, would be lost. So a folder that holds anything else is refused.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from ident_service import __version__
from ident_service.errors import ParameterError, UsageError
from ident_service.recordings.files import (
    write_atomically as write_atomically,  # what motion writes, too, appears whole
)

_EXCHANGE = 2  # RENAME_EXCHANGE


def require_writable_place(folder: Path) -> None:
    """Raise UsageError if a folder is a file or could not be written, before work is done for it; makes nothing.

    Raises:
        UsageError: it is a file, or lies where nothing can be written.
    """
    place = folder
    while not place.exists() and place != place.parent:
        place = place.parent
    if not place.is_dir():
        raise UsageError(f"{place}: is a file, not a folder")
    if not os.access(place, os.W_OK | os.X_OK) or place.resolve().is_relative_to("/proc"):
        raise UsageError(f"{folder}: cannot be written: no permission in {place}")


def require_folder_of(file: Path) -> None:
    """Raise UsageError if the folder that a file is to be written into is not there, before work is done for it.

    Raises:
        UsageError: there is no such folder.
    """
    if not file.parent.is_dir():
        raise UsageError(f"{file}: there is no folder {file.parent}; make it first, or give another place")


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """Yield a place to build a folder's content in; after the block it becomes the folder, or fills an existing one.

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
    """Yield a new folder beside another to build its content in, for the caller to rename; removed after an error.

    Raises:
        UsageError: the folder's place cannot be written, or is a file.
    """
    require_writable_place(folder)
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


def exchange_folders(first: Path, second: Path) -> None:
    """Exchange the names of two folders of one file system, at once where the kernel can (renameat2, Linux 3.15).

    Elsewhere a kill may come between two renames; nothing is lost then, but `second` stands under a hidden name.

    Raises:
        OSError: they cannot be renamed; nothing is changed.
    """
    renameat2 = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    # Absolute: what they are relative to is not used.
    names = [os.fsencode(path.absolute()) for path in (first, second)]
    if renameat2 is not None and renameat2(0, names[0], 0, names[1], _EXCHANGE) == 0:
        return
    between = second.with_name(f".{second.name}.{secrets.token_hex(4)}.old")
    second.rename(between)
    try:
        first.rename(second)
    except OSError:
        between.rename(second)
        raise
    between.rename(first)


MANIFEST: Final = "manifest.json"
_MAX_BYTES = 64 * 2**20
_REMEDY = "identify again, or copy the folder again"


def named_files(folder: Path) -> Mapping[str, str]:
    """Return name to SHA-256, as the manifest says; no file is read but the manifest.

    Raises:
        UsageError: no such folder, or no manifest in it.
        ParameterError: the manifest is torn or foreign, or names something outside its folder.
    """
    if folder.is_file():
        raise UsageError(f"{folder}: is a file; give its folder")
    if not folder.is_dir():
        raise UsageError(f"{folder}: no such folder; give one that `ident identify` or `ident simulate` made")
    path = folder / MANIFEST
    if not path.is_file():
        raise UsageError(f"{folder}: no {MANIFEST} in it; give a folder that `ident identify` or `ident simulate` made")
    if path.stat().st_size > _MAX_BYTES:
        raise ParameterError(f"{path}: larger than {_MAX_BYTES} bytes")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        kind, files = content["format"], dict(content["files"].items())
    except KeyError as error:
        raise ParameterError(f"{path}: not a manifest: it has no {error}; {_REMEDY}") from None
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise ParameterError(f"{path}: not a manifest: {error}; {_REMEDY}") from None
    if kind != "ident-run":
        raise ParameterError(f"{path}: not the manifest of a run: its format is {kind!r:.60}, not 'ident-run'")
    for name, wanted in files.items():
        if Path(name).name != name or name in (".", "..", MANIFEST):
            raise ParameterError(f"{path}: not the manifest of a run: {name!r:.60} is no name of a file; {_REMEDY}")
        if not isinstance(wanted, str):
            raise ParameterError(f"{path}: not the manifest of a run: the hash of {name!r:.60} is no text; {_REMEDY}")
    return files


def verified_files(folder: Path, *, may_be_gone: frozenset[str] = frozenset()) -> Mapping[str, str]:
    """Return name to SHA-256 of a manifest's files; raise unless each has that hash, or is in `may_be_gone` and gone.

    Args:
        folder: folder to be read.
        may_be_gone: names that may be gone, because a retention policy let them go.

    Raises:
        UsageError, ParameterError: as `named_files`; or a file is missing, a link, or not what the manifest names.
    """
    files = named_files(folder)
    for name, wanted in files.items():
        path = folder / name
        if path.is_symlink():
            raise ParameterError(f"{path}: a link; a folder of results holds its own files")
        if not path.is_file():
            if name in may_be_gone and not path.exists():
                continue
            raise ParameterError(f"{path}: named by the manifest, but not there; {_REMEDY}")
        if file_sha256(path) != wanted:
            raise ParameterError(f"{path}: not what the manifest names; it was changed, or is torn; {_REMEDY}")
    return files


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file's content."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def write_manifest(folder: Path) -> None:
    """Write the manifest of a folder: name and SHA-256 of every file in it but hidden ones and those in subfolders."""
    manifest = {
        "format": "ident-run",
        "version": 1,
        "software": f"ident-service {__version__}",
        "files": hashes(folder),
    }
    write_atomically(folder / MANIFEST, json.dumps(manifest, indent=1) + "\n")


def hashes(folder: Path) -> dict[str, str]:
    """Return name to SHA-256 of every file in a folder but its manifest and hidden ones."""
    paths = [path for path in sorted(folder.iterdir()) if path.is_file() and not path.name.startswith(".")]
    return {path.name: file_sha256(path) for path in paths if path.name != MANIFEST}


# Endings of files of identifications and payloads; never of recordings, which are made once.
_MADE = (".json", ".urdf", ".txt", ".html", ".py", ".dat-s")
_NAMED = 3


def require_replaceable(folder: Path) -> None:
    """Raise UsageError if a folder cannot be written or holds anything but an unchanged earlier result; absent is fine.

    Raises:
        UsageError: it is a file, lies where nothing can be written, or holds what is no earlier result; with what it
            is, and the remedy.
    """
    require_writable_place(folder)
    if not folder.exists():
        return
    if not (others := _others(folder)):
        return
    names = ", ".join(others[:_NAMED]) + (f" and {len(others) - _NAMED} more" if len(others) > _NAMED else "")
    raise UsageError(
        f"{folder}: holds files that are not of an earlier result: {names}; give a folder that does not exist, or move "
        "them elsewhere"
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
def replacing_folder(folder: Path, require: Callable[[Path], None] = require_replaceable) -> Iterator[Path]:
    """Yield a place to build a folder of results in, which replaces an earlier result when the block ends well.

    Args:
        folder: of the results.
        require: function that raises where the folder holds anything but an earlier result; called before and after the
            block.

    Raises:
        UsageError: the folder may not be replaced, or cannot be written.
    """
    require(folder)
    with staging_beside(folder) as staging:
        yield staging
        require(folder)
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
