"""The state folder is its owner's alone.

Whoever can enter it can read who did what, and can hold a byte of SQLite's write-ahead log that every write waits for.
"""

from __future__ import annotations

import os
from pathlib import Path

from ident_service.errors import UsageError

_OTHERS_ENTER = 0o011


def keep_private(state: Path) -> None:
    """See that nobody else can enter a state folder, and make what this process writes from now on its owner's.

    Args:
        state: the folder, there or not yet.

    Raises:
        UsageError: others can enter it; the remedy is named.
    """
    os.umask(0o077)
    path = state.resolve()
    if not path.is_dir():
        return
    # Who is kept out above it cannot enter it either.
    if all(place.stat().st_mode & _OTHERS_ENTER for place in (path, *path.parents)):
        raise UsageError(f"{state}: others can enter it, and read or block what is in it; close it: chmod 700 {path}")
