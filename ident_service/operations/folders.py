"""Name the folders that results go to."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path


def new_run_folder(state: Path, arm: str, kind: str = "runs") -> Path:
    """Return a new folder name under the state folder that no earlier run, or other thing of `kind`, has."""
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    folder, count = state / kind / f"{stamp}-{arm}", 1
    while folder.exists():
        count += 1
        folder = state / kind / f"{stamp}-{arm}-{count}"
    return folder
