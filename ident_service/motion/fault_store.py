"""Store the faults of one arm on disk until a person acknowledges each by its code.

The process that moves the arm first marks that it does (`moving.json`), and removes the mark when the arm is without
torque and every fault is in `faults.json`. A process that is killed in between, alone or with its children, thus leaves
the mark; a mark without a process that holds the arm's control file is the fault `motion_process`.
"""

from __future__ import annotations

import fcntl
import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from ident_service.errors import MotionRefused, UsageError
from ident_service.motion.command_channel import in_use
from ident_service.recordings.files import write_atomically

CONTROLS: Final = "control"  # the arm's control file, in its folder
UNFINISHED: Final = "motion_process"


@dataclass(frozen=True)
class StoredFault:
    """Represent an unacknowledged fault on disk.

    Attributes:
        code: its name.
        cause: one plain sentence.
        since: when it was latched [s since 1970 in UTC]; of a motion that was killed, when it began.
    """

    code: str
    cause: str
    since: float


class FaultStore:
    """Store the faults that ended runs of one arm."""

    def __init__(self, folder: Path) -> None:
        """Use the arm's `folder` below the state folder; it is named like the arm."""
        self._arm = folder.name
        self._faults, self._mark, self._controls = folder / "faults.json", folder / "moving.json", folder / CONTROLS

    def latched(self) -> dict[str, str]:
        """Return the cause of each stored fault by code, the earliest first; raises as `remembered`."""
        return {one.code: one.cause for one in self.remembered()}

    def remembered(self) -> tuple[StoredFault, ...]:
        """Return all stored faults, the earliest first.

        Raises:
            UsageError: a file is damaged.
        """
        return self._remembered(moving=in_use(self._controls))

    def began(self, run: Path) -> None:
        """Mark that this process, which has taken the control file, is about to move the arm.

        Args:
            run: folder of the run.

        Raises:
            MotionRefused: there is an unacknowledged fault.
            UsageError: a file is damaged, or cannot be written.
        """
        self.require_none({one.code: one.cause for one in self._remembered(moving=False)})
        self._mark.parent.mkdir(parents=True, exist_ok=True)
        mark = {"pid": os.getpid(), "run": str(run), "began": time.time()}
        write_atomically(self._mark, json.dumps(mark, indent=1) + "\n")

    def ended(self) -> None:
        """Remove the mark of a moving arm: the arm is without torque, and its faults are stored."""
        self._mark.unlink(missing_ok=True)

    def require_none(self, faults: dict[str, str]) -> None:
        """Raise MotionRefused, which names the faults, if there are any."""
        if faults:
            words = "; ".join(f"{code} ({cause})" for code, cause in faults.items())
            acks = ", ".join(f"`ident acknowledge {self._arm} {code}`" for code in faults)
            raise MotionRefused(f"{self._arm}: unacknowledged faults: {words}; {acks}")

    def latch(self, code: str, cause: str) -> None:
        """Store a fault; one that is stored already keeps its first cause.

        Raises:
            UsageError: the file is damaged, or cannot be written.
        """
        with self._alone():
            rows = self._rows()
            if all(row.code != code for row in rows):
                self._write((*rows, StoredFault(code, cause, time.time())))

    def acknowledge(self, code: str) -> str:
        """Remove a fault from the store; returns its cause.

        Raises:
            UsageError: no fault of this name is latched, or a file was damaged by somebody; or the arm is still held
                after it, whereupon it would be latched again.
        """
        with self._alone():
            return self._acknowledged(code)

    def _acknowledged(self, code: str) -> str:
        faults = self.latched()
        if code not in faults:
            known = ", ".join(faults) or "none"
            raise UsageError(f"{self._arm}: no active fault {code!r} (active: {known})")
        if in_use(self._controls):
            raise UsageError(
                f"{self._arm}: a process still controls the arm; stop and support it (`ident stop`, `ident "
                "supported`), then acknowledge"
            )
        self._write(tuple(row for row in self._rows() if row.code != code))
        if code == UNFINISHED:
            self.ended()
        return faults[code]

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Let one process at a time read the faults and write them."""
        try:
            self._faults.parent.mkdir(parents=True, exist_ok=True)
            fd = os.open(self._faults.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except OSError as error:
            raise UsageError(f"{self._faults}: cannot be written: {error.strerror}") from None
        try:
            fcntl.flock(fd, fcntl.LOCK_EX)
            yield
        finally:
            fcntl.flock(fd, fcntl.LOCK_UN)  # a process that is being started has the open folder, too
            os.close(fd)

    def _remembered(self, *, moving: bool) -> tuple[StoredFault, ...]:
        rows = self._rows()
        if moving or (mark := self._read(self._mark)) is None or any(row.code == UNFINISHED for row in rows):
            return rows
        try:
            pid, run, began = int(mark["pid"]), str(mark["run"]), float(mark["began"])
        except (KeyError, TypeError, ValueError) as error:
            raise self._damaged(self._mark, error) from None
        return *rows, StoredFault(
            UNFINISHED,
            f"process {pid} died, or could not store why it stopped, while it had the arm, in the run {run}",
            began,
        )

    def _rows(self) -> tuple[StoredFault, ...]:
        content = self._read(self._faults)
        try:
            rows = [] if content is None else content["faults"]
            return tuple(StoredFault(str(row["code"]), str(row["cause"]), float(row["written"])) for row in rows)
        except (KeyError, TypeError, ValueError) as error:
            raise self._damaged(self._faults, error) from None

    def _read(self, path: Path) -> Any:
        """Return the JSON content of a file, None when there is no file."""
        try:
            return json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            raise self._damaged(path, error) from None

    def _damaged(self, path: Path, error: Exception) -> UsageError:
        return UsageError(f"{path}: cannot be read ({error}); check the arm, then remove the file")

    def _write(self, faults: tuple[StoredFault, ...]) -> None:
        self._faults.parent.mkdir(parents=True, exist_ok=True)
        rows = [{"code": one.code, "cause": one.cause, "written": one.since} for one in faults]
        write_atomically(self._faults, json.dumps({"faults": rows}, indent=1) + "\n")
