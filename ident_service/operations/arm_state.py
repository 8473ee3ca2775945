"""Locate the files of an arm in the state folder that last between runs: controls, faults, preflight ticket."""

from __future__ import annotations

from pathlib import Path

from ident_service.motion.fault_file import CONTROLS, FaultFile


def arm_folder(state: Path, arm: str) -> Path:
    """Return the folder of one arm in the state folder."""
    return state / "arms" / arm


def known_arms(state: Path) -> list[str]:
    """Names of the arms that a state folder remembers something of."""
    place = state / "arms"
    return sorted(path.name for path in place.iterdir() if not path.name.startswith(".")) if place.is_dir() else []


def control_path(state: Path, arm: str) -> Path:
    """Return the path of the arm's control file (`motion/control_file.py`)."""
    return arm_folder(state, arm) / CONTROLS


def ticket_path(state: Path, arm: str) -> Path:
    """Return the path of the arm's last preflight ticket."""
    return arm_folder(state, arm) / "ticket.json"


def fault_file(state: Path, arm: str) -> FaultFile:
    """Return the store of the arm's faults that no person has acknowledged (`motion/fault_file.py`)."""
    return FaultFile(arm_folder(state, arm))
