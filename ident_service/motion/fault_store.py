"""Store the faults of one arm on disk until a person acknowledges each by its code.

The process that moves the arm first marks that it does (`moving.json`), and removes the mark when the arm is without
torque and every fault is in `faults.json`. A process that is killed in between, alone or with its children, thus leaves
the mark; a mark without a process that holds the arm's control file is the fault `motion_process`.

A disk may fill while the arm moves, so the mark has room for the faults: a JSON object, and after it `_ROOM` blanks,
which are overwritten by a line of JSON for each. That takes no new block where files are overwritten in place (ext4,
xfs, tmpfs); a file system that copies on write may refuse it, which leaves `motion_process`. They count as those in
`faults.json` do, and move there when one of them is acknowledged.
"""

from __future__ import annotations

import fcntl
import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Self

from ident_service.errors import MotionRefused, UsageError
from ident_service.motion.command_channel import is_control_file_in_use
from ident_service.recordings.files import write_atomically

CONTROLS: Final = "control"  # the arm's control file, in its folder
UNFINISHED: Final = "motion_process"
_ROOM: Final = 4096  # bytes of the mark for faults: ten and more
_LONGEST: Final = 300  # characters of a cause there, so that none takes the room of all
_ENDED: Final = {"ended": True}  # the mark's last line: all faults are stored, the arm is without torque
_LAST_LINE: Final = 32  # bytes that are kept for it
_UNREADABLE: Final = (
    KeyError,
    TypeError,
    ValueError,
    OverflowError,
    RecursionError,
)  # what JSON of anybody may lead to


@dataclass(frozen=True)
class StoredFault:
    """Represent an unacknowledged fault on disk.

    Attributes:
        code: name of the fault.
        cause: one plain sentence.
        since: time when it was latched [s since 1970 in UTC]; of a motion that was killed, time when it began.
    """

    code: str
    cause: str
    since: float

    def document(self) -> dict[str, Any]:
        """Return the fault as a dict for JSON: `code`, `cause` and `written`, its time."""
        return {"code": self.code, "cause": self.cause, "written": self.since}

    @classmethod
    def from_document(cls, document: Any) -> Self:
        """Create the fault from a dict as `document` returns it; raises KeyError or ValueError, say, for another."""
        return cls(str(document["code"]), str(document["cause"]), float(document["written"]))


@dataclass(frozen=True)
class _Mark:
    """Represent the mark of a moving arm.

    Attributes:
        begun: the fault of a motion whose process is gone without a word.
        faults: faults for which there was no other room.
        ended: whether these faults are all, and the arm was without torque.
        free: offset of the first blank [bytes].
        size: of the file [bytes].
    """

    begun: StoredFault
    faults: tuple[StoredFault, ...]
    ended: bool
    free: int
    size: int


class FaultStore:
    """Store the faults that ended runs of one arm."""

    def __init__(self, folder: Path) -> None:
        """Use the arm's `folder` below the state folder; it is named like the arm."""
        self._arm = folder.name
        self._faults, self._mark, self._controls = folder / "faults.json", folder / "moving.json", folder / CONTROLS

    def latched(self) -> dict[str, str]:
        """Return a dict from code to cause of all stored faults, a killed motion's last; UsageError if damaged."""
        return {one.code: one.cause for one in self.remembered()}

    def remembered(self) -> tuple[StoredFault, ...]:
        """Return all stored faults, the earliest first, and last one for a motion whose process died.

        Raises:
            UsageError: a file is damaged.
        """
        return self._read_stored(moving=is_control_file_in_use(self._controls))

    def began(self, run_folder: Path) -> None:
        """Write a mark that this process is about to move the arm; MotionRefused while a fault is unacknowledged.

        Args:
            run_folder: folder of the run.

        Raises:
            MotionRefused: there is an unacknowledged fault.
            UsageError: a file is damaged, or cannot be written.
        """
        self.require_none({one.code: one.cause for one in self._read_stored(moving=False)})
        self._mark.parent.mkdir(parents=True, exist_ok=True)
        mark = {"pid": os.getpid(), "run": str(run_folder), "began": time.time()}
        write_atomically(self._mark, json.dumps(mark) + "\n" + " " * _ROOM)

    def ended(self) -> None:
        """Remove the mark that `began` wrote; one in which faults are stored stays, with a note that the motion ended.

        A mark that stores faults stays until they are acknowledged.

        Raises:
            UsageError: a file is damaged, or cannot be written.
        """
        with self._locked():
            mark = self._marked()
            if mark is not None and mark.faults:
                self._write_into_mark(mark, json.dumps(_ENDED), mark.size)
            else:
                self._mark.unlink(missing_ok=True)

    def require_none(self, faults: dict[str, str]) -> None:
        """Raise MotionRefused, which names the given faults (code to cause), unless there are none."""
        if faults:
            words = "; ".join(f"{code} ({cause})" for code, cause in faults.items())
            acks = ", ".join(f"`ident acknowledge {self._arm} {code}`" for code in faults)
            raise MotionRefused(f"{self._arm}: unacknowledged faults: {words}; {acks}")

    def latch(self, code: str, cause: str) -> None:
        """Store a fault on disk; one whose code is stored already keeps its first cause.

        Where there is no room on the disk, it is stored in the mark of the moving arm, a long cause without its end.

        Raises:
            UsageError: the file is damaged, or neither can be written.
        """
        fault = StoredFault(code, cause, time.time())
        with self._locked():
            try:
                rows = self._rows()
                if all(row.code != code for row in rows):
                    self._write((*rows, fault))
            except UsageError:
                if (mark := self._marked()) is None:
                    raise
                if all(one.code != code for one in mark.faults):
                    short = cause if len(cause) <= _LONGEST else f"{cause[:_LONGEST]}..."
                    line = json.dumps(replace(fault, cause=short).document())
                    self._write_into_mark(mark, line, mark.size - _LAST_LINE)

    def acknowledge(self, code: str) -> str:
        """Remove a fault from the store and return its cause; UsageError if not stored or a process controls the arm.

        Raises:
            UsageError: no fault of this name is latched, or a file was damaged by somebody; or a process still controls
                the arm, as one that holds it after the fault does, and would latch it again.
        """
        with self._locked():
            return self._acknowledged(code)

    def _acknowledged(self, code: str) -> str:
        faults = self.latched()
        if code not in faults:
            known = ", ".join(faults) or "none"
            raise UsageError(f"{self._arm}: no active fault {code!r} (active: {known})")
        if is_control_file_in_use(self._controls):
            raise UsageError(
                f"{self._arm}: a process still controls the arm; stop and support it (`ident stop`, `ident "
                "supported`), then acknowledge"
            )
        mark = self._marked()
        self._write(tuple(row for row in self._stored(mark) if row.code != code))
        if mark is None:
            return faults[code]
        if mark.ended or code == UNFINISHED:
            self._mark.unlink(missing_ok=True)
        elif mark.faults:  # they are in the other file now
            write_atomically(self._mark, self._mark.read_text(encoding="utf-8").splitlines()[0] + "\n")
        return faults[code]

    @contextmanager
    def _locked(self) -> Iterator[None]:
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

    def _read_stored(self, *, moving: bool) -> tuple[StoredFault, ...]:
        mark = self._marked()
        rows = self._stored(mark)
        if moving or mark is None or mark.ended:
            return rows
        return *rows, mark.begun

    def _stored(self, mark: _Mark | None) -> tuple[StoredFault, ...]:
        """Return the faults of both files, each with its first cause."""
        rows = self._rows()
        if mark is None or not mark.faults:
            return rows
        first: dict[str, StoredFault] = {}
        for one in sorted((*rows, *mark.faults), key=lambda one: one.since):
            first.setdefault(one.code, one)
        return tuple(first.values())

    def _marked(self) -> _Mark | None:
        """Return the mark of a moving arm, None where there is none."""
        if (text := self._text(self._mark)) is None:
            return None
        try:
            document, end = json.JSONDecoder().raw_decode(text)
            pid, run, began = int(document["pid"]), str(document["run"]), float(document["began"])
        except _UNREADABLE as error:
            raise self._damaged(self._mark, error) from None
        faults: list[StoredFault] = []
        ended, free = False, end + 1
        for line in text[free:].split("\n"):
            try:
                row = json.loads(line)
                ended = ended or row == _ENDED
                if not ended:
                    faults.append(StoredFault.from_document(row))
            except _UNREADABLE:
                break  # blanks, or a line that a failing machine left in pieces: what it meant is `motion_process` then
            free += len(line) + 1
        cause = f"process {pid} died, or could not store why it stopped, while it had the arm, in the run {run}"
        return _Mark(StoredFault(UNFINISHED, cause, began), tuple(faults), ended, free, len(text))

    def _write_into_mark(self, mark: _Mark, line: str, end: int) -> None:
        """Overwrite blanks of the mark with a line; raises UsageError where they do not reach up to `end` [bytes]."""
        data = line.encode() + b"\n"
        if mark.free + len(data) > end:
            raise UsageError(f"{self._mark}: has no room left")
        try:
            fd = os.open(self._mark, os.O_WRONLY | os.O_CLOEXEC)
            try:
                os.pwrite(fd, data, mark.free)
                os.fsync(fd)
            finally:
                os.close(fd)
        except OSError as error:
            raise UsageError(f"{self._mark}: cannot be written: {error.strerror}") from None

    def _rows(self) -> tuple[StoredFault, ...]:
        if (text := self._text(self._faults)) is None:
            return ()
        try:
            rows = json.loads(text)["faults"]
            if not isinstance(rows, list):  # of which nobody knows whether it stands for faults
                raise TypeError("faults is no list")
            return tuple(StoredFault.from_document(row) for row in rows)
        except _UNREADABLE as error:
            raise self._damaged(self._faults, error) from None

    def _text(self, path: Path) -> str | None:
        """Return the content of a file, None when there is no file."""
        try:
            return path.read_text(encoding="utf-8")
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            raise self._damaged(path, error) from None

    def _damaged(self, path: Path, error: Exception) -> UsageError:
        return UsageError(f"{path}: cannot be read ({error}); check the arm, then remove the file")

    def _write(self, faults: tuple[StoredFault, ...]) -> None:
        self._faults.parent.mkdir(parents=True, exist_ok=True)
        rows = [one.document() for one in faults]
        write_atomically(self._faults, json.dumps({"faults": rows}, indent=1) + "\n")
