"""What every reader asks of a file before it looks inside: that it is there, and its hash."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Final

from ident_service.errors import RecordingError, UsageError

_STEP: Final = 1 << 20


def require_file(path: Path) -> None:
    """Raise UsageError unless `path` is a file."""
    if not path.is_file():
        raise UsageError(f"{path}: {'is a folder, not a recording' if path.is_dir() else 'no such file'}")


def sha256(path: Path, size: int) -> str:
    """SHA-256 of the first `size` bytes, so that a file that is still growing has a hash of what is read of it.

    Raises:
        RecordingError: the file cannot be read.
    """
    digest = hashlib.sha256()
    try:
        with path.open("rb") as stream:
            while size > 0 and (data := stream.read(min(_STEP, size))):
                digest.update(data)
                size -= len(data)
    except OSError as error:
        raise RecordingError(path, f"cannot be read: {error.strerror}") from error
    return digest.hexdigest()
