"""A folder with the shipped descriptions and a drive's EDS."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from can_arms import EDS

SHIPPED = Path(__file__).resolve().parents[2] / "configs"


@pytest.fixture
def arms(tmp_path: Path) -> Path:
    """The shipped arm descriptions, to extend or to spoil; with an EDS that can share torque frames."""
    folder = tmp_path / "configs"
    shutil.copytree(SHIPPED, folder)
    if not (folder / "emulated_drive.eds").exists():
        (folder / "emulated_drive.eds").write_text(EDS, encoding="utf-8")
    return folder
