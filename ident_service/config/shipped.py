"""Find the arm descriptions that come with this package: in a wheel inside it, in a checkout beside it."""

from __future__ import annotations

from pathlib import Path

_FOLDERS = (Path(__file__).parent.parent / "configs", Path(__file__).parent.parent.parent / "configs")


def shipped_arms() -> dict[str, Path]:
    """Return names and files of the arm descriptions that come with this package."""
    folder = next((folder for folder in _FOLDERS if folder.is_dir()), None)
    return {} if folder is None else {path.stem: path for path in sorted(folder.glob("*.yaml"))}
