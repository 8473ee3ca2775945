"""Keep the audit log: who did what, and when; rows are added and never changed (a trigger of the database).

What was done at a terminal while the registry was kept waits as a file below `STATE/audit.waiting`. The daemon enters
it, or the next act at a terminal, with the time of the act.
"""

from __future__ import annotations

import json
import logging
import secrets
import sqlite3
import threading
import time
from collections import deque
from pathlib import Path
from typing import Any, Final

from ident_service.operations.state_folder import leave_to_owner
from ident_service.recordings.files import write_atomically
from ident_service.registry.database import Database, Row

_AGAIN: Final = 1.0  # s between attempts to enter a line that the registry cannot take
_MOST_WAITING: Final = 10_000
_WAITING: Final = "audit.waiting"
LOG = logging.getLogger("ident.audit")
_Line = tuple[float, str, str, str, str]


def note(db: Database, who: str, what: str, about: str, **detail: Any) -> None:
    """Add one line to the audit trail.

    Args:
        db: the registry.
        who: the name of a token, `terminal:NAME`, or `service`.
        what: one word or two: `job created`, `accepted`.
        about: id of the arm, job or run.
        detail: JSON values.
    """
    _enter(db, _line(who, what, about, detail))


def note_later(state: Path, who: str, what: str, about: str, **detail: Any) -> None:
    """Leave one line, with the time of now, for whoever can write the registry next; as `note`.

    Args:
        state: the state folder.
        who: as for `note`.
        what: as for `note`.
        about: as for `note`.
        detail: as for `note`.

    Raises:
        OSError, UsageError: it cannot be written either.
    """
    path = state / _WAITING / f"{time.time_ns()}-{secrets.token_hex(4)}.json"
    path.parent.mkdir(mode=0o700, exist_ok=True)
    write_atomically(path, json.dumps(_line(who, what, about, detail)))
    leave_to_owner(state, path)


def enter_waiting(db: Database, state: Path) -> None:
    """Enter the lines that `note_later` has left; each once, whoever is killed meanwhile."""
    place = state / _WAITING
    for path in sorted(place.glob("*.json")) if place.is_dir() else ():
        try:
            at, *words = json.loads(path.read_text(encoding="utf-8"))
            who, what, about, detail = map(str, words)
            line = (float(at), who, what, about, detail)
        except (OSError, ValueError, TypeError) as error:  # another process was first, or somebody's file
            LOG.warning("%s: not entered: %s", path, error)
            continue
        with db.transaction():
            if db.row("SELECT 1 FROM audit WHERE (at, who, what, about) = (?, ?, ?, ?)", *line[:4]) is None:
                _enter(db, line)
        path.unlink(missing_ok=True)


class AuditQueue:
    """Queue of audit lines that a thread enters: whoever stops an arm waits neither for a disk nor for a process."""

    def __init__(self, db: Database) -> None:
        """Start the thread."""
        self._db, self._lines, self._changed = db, deque[_Line](), threading.Condition()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._work, name="audit", daemon=True)
        self._thread.start()

    def note(self, who: str, what: str, about: str, **detail: Any) -> None:
        """Queue one line with the present time; never waits."""
        line = _line(who, what, about, detail)
        with self._changed:
            if len(self._lines) < _MOST_WAITING:
                self._lines.append(line)
                self._changed.notify_all()
                return
        LOG.error("a line of the audit trail is lost, because too many wait: %s", line)

    def flush(self, seconds: float) -> bool:
        """Wait until every line is entered, at most `seconds`; return whether all are."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._lines, seconds)

    def close(self, seconds: float = 5.0) -> None:
        """Enter the queued lines, as far as the registry takes them in `seconds`, and end the thread."""
        self.flush(seconds)
        self._ending.set()
        with self._changed:
            self._changed.notify_all()
        self._thread.join(seconds)
        for line in self._lines:
            LOG.error("a line of the audit trail is lost, because the registry cannot be written: %s", line)

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._lines or self._ending.is_set())
                if self._ending.is_set():
                    return
                line = self._lines[0]
            try:
                _enter(self._db, line)
            except sqlite3.Error as error:
                LOG.error("the audit trail cannot be written yet: %s", error)
                self._ending.wait(_AGAIN)
                continue
            with self._changed:
                self._lines.popleft()
                self._changed.notify_all()


def _line(who: str, what: str, about: str, detail: dict[str, Any]) -> _Line:
    return time.time(), who, what, about, json.dumps(detail, allow_nan=False)


def _enter(db: Database, line: _Line) -> None:
    db.write("INSERT INTO audit (at, who, what, about, detail) VALUES (?, ?, ?, ?, ?)", *line)


def trail(db: Database, *, before: int | None = None, most: int = 100) -> list[Row]:
    """Return lines of the audit trail, the newest first, from the one before the id `before`."""
    rows = db.rows(
        "SELECT * FROM audit WHERE id < ? ORDER BY id DESC LIMIT ?", 2**62 if before is None else before, most
    )
    return [{**row, "detail": json.loads(row["detail"])} for row in rows]


def trail_after(db: Database, line: int, most: int = 500) -> list[Row]:
    """Return lines of the audit trail after the one of this id, the earliest first."""
    rows = db.rows("SELECT * FROM audit WHERE id > ? ORDER BY id LIMIT ?", line, most)
    return [{**row, "detail": json.loads(row["detail"])} for row in rows]


def last_line(db: Database) -> int:
    """Return the id of the newest line; 0 where there is none."""
    row = db.row("SELECT MAX(id) AS id FROM audit")
    return int(row["id"] or 0) if row is not None else 0
