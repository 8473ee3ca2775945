"""What is remembered of an arm between runs, in the state folder: its controls, its faults, its ticket."""

from __future__ import annotations

import json
import time
from pathlib import Path

from ident_service.errors import UsageError
from ident_service.results.files import write_atomically


def arm_folder(state: Path, arm: str) -> Path:
    """Where things of one arm are."""
    return state / "arms" / arm


def control_path(state: Path, arm: str) -> Path:
    """The arm's control file (`motion/control_file.py`)."""
    return arm_folder(state, arm) / "control"


def ticket_path(state: Path, arm: str) -> Path:
    """The arm's last preflight ticket."""
    return arm_folder(state, arm) / "ticket.json"


class FaultFile:
    """Faults that ended runs, until a person acknowledges each by its name."""

    def __init__(self, state: Path, arm: str) -> None:
        self._arm = arm
        self._path = arm_folder(state, arm) / "faults.json"

    def latched(self) -> dict[str, str]:
        """Cause by code, the earliest first.

        Raises:
            UsageError: the file was damaged by somebody.
        """
        try:
            content = json.loads(self._path.read_text(encoding="utf-8"))
            return {str(one["code"]): str(one["cause"]) for one in content["faults"]}
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UsageError(f"{self._path}: cannot be read ({error}); look at the arm, then remove the file") from None

    def latch(self, code: str, cause: str) -> None:
        """Remember a fault; one that is latched already keeps its first cause."""
        self._write({**self.latched(), code: self.latched().get(code, cause)})

    def acknowledge(self, code: str) -> str:
        """Forget a fault; returns its cause.

        Raises:
            UsageError: no fault of this name is latched.
        """
        faults = self.latched()
        if code not in faults:
            known = ", ".join(faults) or "none"
            raise UsageError(f"{self._arm}: no fault {code!r} is latched (latched: {known})")
        cause = faults.pop(code)
        self._write(faults)
        return cause

    def _write(self, faults: dict[str, str]) -> None:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        rows = [{"code": code, "cause": cause, "written": time.time()} for code, cause in faults.items()]
        write_atomically(self._path, json.dumps({"faults": rows}, indent=1) + "\n")
