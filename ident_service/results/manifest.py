"""Write and verify the manifest of a folder: name and SHA-256 of every file in it.

Nothing is believed of a folder that is read before every file has the hash that its manifest names.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from ident_service import __version__
from ident_service.errors import ParameterError, UsageError
from ident_service.results.files import write_atomically

MANIFEST: Final = "manifest.json"
_MAX_BYTES = 64 * 2**20
_REMEDY = "identify again, or copy the folder again"


def named_files(folder: Path) -> Mapping[str, str]:
    """Return name to SHA-256, as the manifest says; no file is read but the manifest.

    Raises:
        UsageError: no such folder, or no manifest in it.
        ParameterError: the manifest is torn or foreign, or names something outside its folder.
    """
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


def verified_files(folder: Path, *, but: frozenset[str] = frozenset()) -> Mapping[str, str]:
    """Return name to SHA-256, each verified on a regular file, not on a link.

    Args:
        folder: to be read.
        but: names that may be gone, because a retention policy let them go.

    Raises:
        UsageError, ParameterError: as `named_files`; or a file is missing, a link, or not what the manifest names.
    """
    files = named_files(folder)
    for name, wanted in files.items():
        path = folder / name
        if path.is_symlink():
            raise ParameterError(f"{path}: a link; a folder of results holds its own files")
        if not path.is_file():
            if name in but and not path.exists():
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
    """Write name and SHA-256 of every file in the folder, for verification on another machine."""
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
