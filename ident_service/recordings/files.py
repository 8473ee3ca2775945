"""Check that files exist and can be written, hash them, and write them atomically."""

from __future__ import annotations

import hashlib
import math
import os
import re
import secrets
from contextlib import suppress
from pathlib import Path
from typing import Final

from ident_service.errors import RecordingError, UsageError

_STEP: Final = 1 << 20
_RANGE: Final = re.compile(r"^(?P<path>.+)@(?P<start>\d+(?:\.\d*)?)?:(?P<end>\d+(?:\.\d*)?)?$")


def split_range(path_and_range: str) -> tuple[str, tuple[float, float] | None]:
    """Split `FILE@START:END` into the path and (start, end) [s], None without a range; no file is looked at.

    Raises:
        UsageError: the range ends before it begins.
    """
    match = _RANGE.match(path_and_range)
    if match is None:
        return path_and_range, None
    start, end = float(match["start"] or 0.0), float(match["end"] or math.inf)
    if not start < end:
        raise UsageError(
            f"{path_and_range}: a range ends after it begins; FILE@START:END are the seconds of the recording that are "
            "read (to leave out seconds at the ends: recording.trim)"
        )
    return match["path"], (start, end)


def require_file(path: Path) -> None:
    """Raise UsageError unless `path` is an existing file; return nothing."""
    if not path.is_file():
        why = "is a folder, not a recording" if path.is_dir() else "no such file"
        partial = path.with_name(f"{path.name}.partial")
        hint = f" (there is {partial.name}, left by an interrupted recording)" if partial.is_file() else ""
        file = path.with_name(path.name.rpartition("@")[0] or path.name)
        if file != path and file.is_file():
            hint = f"; a range of {file} is {file}@START:END, in seconds from 0, such as {file}@5:60"
        raise UsageError(f"{path}: {why}{hint}")


def require_writable(folder: Path) -> None:
    """Create a folder and raise UsageError unless a file can be written into it, by writing one for a moment.

    Raises:
        UsageError: it cannot be made, or nothing can be written into it.
    """
    probe = folder / f".{secrets.token_hex(4)}.probe"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        try:
            probe.write_bytes(b"\n")
        finally:
            probe.unlink(missing_ok=True)
    except OSError as error:
        raise UsageError(f"{folder}: cannot be written: {error.strerror}") from None


def sha256(path: Path, first_bytes: int) -> str:
    """Return the SHA-256 (hex) of a file's beginning, `first_bytes` long, so that a growing file can be hashed.

    Raises:
        RecordingError: the file cannot be read.
    """
    digest = hashlib.sha256()
    try:
        with path.open("rb") as stream:
            while first_bytes > 0 and (data := stream.read(min(_STEP, first_bytes))):
                digest.update(data)
                first_bytes -= len(data)
    except OSError as error:
        raise RecordingError(path, f"cannot be read: {error.strerror}") from error
    return digest.hexdigest()


def write_atomically(path: Path, text: str) -> None:
    """Write UTF-8 text to a hidden file, force it to disk, then rename it to `path`; raises UsageError.

    Raises:
        UsageError: the folder does not exist or cannot be written.
    """
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
    try:
        with partial.open("x", encoding="utf-8") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
        partial.replace(path)
    except OSError as error:
        raise UsageError(f"{path}: cannot be written: {error.strerror}") from None
    finally:
        with suppress(OSError):  # after the replacement there is none
            partial.unlink()
