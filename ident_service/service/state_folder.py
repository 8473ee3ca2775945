"""Keep the state folder private to its owner, and served by one daemon at a time.

Whoever can enter it can read who did what, and can hold a byte of SQLite's write-ahead log that every write waits for.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from ident_service.errors import UsageError

LOCK: Final = "serve.lock"
URL_FILE: Final = "serve.url"
RESTORING: Final = ".restoring"
"""Name of a folder that exists while a restore replaces the state."""
_OTHERS_ENTER = 0o011


def keep_private(state: Path) -> None:
    """Check that nobody else can enter a state folder, and let only its owner read files written from now on.

    Args:
        state: the folder, there or not yet.

    Raises:
        UsageError: others can enter it; the remedy is named.
    """
    os.umask(0o077)
    path = state.resolve()
    if not path.is_dir():
        return
    # A parent folder that others cannot enter protects it, too.
    if all(place.stat().st_mode & _OTHERS_ENTER for place in (path, *path.parents)):
        raise UsageError(f"{state}: others can enter it, and read or block what is in it; close it: chmod 700 {path}")


def require_whole(state: Path) -> None:
    """Refuse a state folder in which a restore was interrupted.

    Raises:
        UsageError: a restore was interrupted.
    """
    if (state / RESTORING).exists():
        raise UsageError(f"{state}: a restore broke off here; run `ident restore` again, it loses nothing")


@contextmanager
def single_instance(state: Path) -> Iterator[None]:
    """Hold the state folder's lock during the block; it vanishes with this process, however that ends.

    Raises:
        UsageError: another process holds it, or it cannot be made.
    """
    path = state / LOCK
    try:
        state.mkdir(mode=0o700, parents=True, exist_ok=True)
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    except OSError as error:
        raise UsageError(f"{path}: cannot be made: {error.strerror}; give another state folder") from None
    try:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            pid = os.pread(fd, 20, 0).decode("ascii", "replace").strip() or "unknown"
            raise UsageError(f"{state}: process {pid} serves this state folder already") from None
        os.ftruncate(fd, 0)
        os.pwrite(fd, str(os.getpid()).encode(), 0)
        yield
    finally:
        os.close(fd)
