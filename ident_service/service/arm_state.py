"""What is remembered of an arm between runs, in the state folder: its controls, its faults, its ticket."""

from __future__ import annotations

from pathlib import Path

from ident_service.motion.fault_file import CONTROLS, FaultFile


def arm_folder(state: Path, arm: str) -> Path:
    """Where things of one arm are."""
    return state / "arms" / arm


def known_arms(state: Path) -> list[str]:
    """Names of the arms that a state folder remembers something of."""
    place = state / "arms"
    return sorted(path.name for path in place.iterdir() if not path.name.startswith(".")) if place.is_dir() else []


def control_path(state: Path, arm: str) -> Path:
    """The arm's control file (`motion/control_file.py`)."""
    return arm_folder(state, arm) / CONTROLS


def ticket_path(state: Path, arm: str) -> Path:
    """The arm's last preflight ticket."""
    return arm_folder(state, arm) / "ticket.json"


def fault_file(state: Path, arm: str) -> FaultFile:
    """The arm's faults, until a person acknowledges them (`motion/fault_file.py`)."""
    return FaultFile(arm_folder(state, arm))
