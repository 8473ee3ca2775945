"""Keep the audit trail, who did what and when: rows are added and, by a trigger of the database, never changed."""

from __future__ import annotations

import json
import logging
import sqlite3
import threading
import time
from collections import deque
from typing import Any, Final

from ident_service.service.registry.database import Database, Row

_AGAIN: Final = 1.0  # s between attempts to enter a line that the registry cannot take
_MOST_WAITING: Final = 10_000
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
