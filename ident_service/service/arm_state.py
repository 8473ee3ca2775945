"""What is remembered of an arm between runs, in the state folder: its controls, its faults, its ticket."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
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


@dataclass(frozen=True)
class Remembered:
    """A fault that nobody has acknowledged.

    Attributes:
        code: its name.
        cause: one plain sentence.
        since: when it was latched [s since 1970 in UTC].
    """

    code: str
    cause: str
    since: float


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
        return {one.code: one.cause for one in self.remembered()}

    def remembered(self) -> tuple[Remembered, ...]:
        """All that is latched, the earliest first.

        Raises:
            UsageError: the file was damaged by somebody.
        """
        try:
            content = json.loads(self._path.read_text(encoding="utf-8"))
            rows = [(str(one["code"]), str(one["cause"]), float(one["written"])) for one in content["faults"]]
            return tuple(Remembered(*row) for row in rows)
        except FileNotFoundError:
            return ()
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UsageError(f"{self._path}: cannot be read ({error}); look at the arm, then remove the file") from None

    def latch(self, code: str, cause: str) -> None:
        """Remember a fault; one that is latched already keeps its first cause and time."""
        faults = self.remembered()
        if all(one.code != code for one in faults):
            self._write((*faults, Remembered(code, cause, time.time())))

    def acknowledge(self, code: str) -> str:
        """Forget a fault; returns its cause.

        Raises:
            UsageError: no fault of this name is latched.
        """
        faults = self.remembered()
        found = next((one for one in faults if one.code == code), None)
        if found is None:
            known = ", ".join(one.code for one in faults) or "none"
            raise UsageError(f"{self._arm}: no fault {code!r} is latched (latched: {known})")
        self._write(tuple(one for one in faults if one is not found))
        return found.cause

    def _write(self, faults: tuple[Remembered, ...]) -> None:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        rows = [{"code": one.code, "cause": one.cause, "written": one.since} for one in faults]
        write_atomically(self._path, json.dumps({"faults": rows}, indent=1) + "\n")
