"""Keep the service's memory in one SQLite file: opened, migrated, written in short transactions, with its audit log.

A step that has been released is never changed; a new one is appended. Times are seconds since 1970 in UTC.

Write-ahead logging with full synchronisation: what a transaction has written is on the disk when it ends, and a kill at
any moment loses nothing of it. Other processes of the same machine (`ident accept`) may use the file at the same time.
One connection writes and another one reads: who reads does not wait for who writes, here or in another process.

What was done at a terminal while the registry was kept waits as a file below `STATE/audit.waiting`. The daemon enters
it, or the next act at a terminal, with the time of the act.
"""

from __future__ import annotations

import errno
import json
import logging
import math
import os
import re
import secrets
import sqlite3
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final, Self

from ident_service.errors import DiskFull, IdentError, RegistryBusy, UnknownId, UsageError
from ident_service.recordings.files import write_atomically
from ident_service.registry.state_folder import give_to_owner, require_no_interrupted_restore

_FIRST = """
CREATE TABLE arms (
    name TEXT PRIMARY KEY,
    sha256 TEXT NOT NULL,
    description TEXT NOT NULL,
    source TEXT NOT NULL CHECK (source IN ('shipped', 'uploaded')),
    folder TEXT,                       -- below the state folder, of an uploaded description
    resources TEXT NOT NULL,           -- JSON list: what one motion at a time may have (arm, buses)
    unattended INTEGER NOT NULL DEFAULT 0 CHECK (unattended IN (0, 1)),
    added REAL NOT NULL,
    added_by TEXT NOT NULL
) STRICT;

CREATE TABLE motions (
    id TEXT PRIMARY KEY,
    arm TEXT NOT NULL,
    name TEXT NOT NULL,
    duration REAL NOT NULL,            -- s
    sha256 TEXT NOT NULL,
    added REAL NOT NULL,
    added_by TEXT NOT NULL
) STRICT;

CREATE TABLE jobs (
    number INTEGER PRIMARY KEY AUTOINCREMENT,
    id TEXT NOT NULL UNIQUE,
    kind TEXT NOT NULL,
    arm TEXT,
    state TEXT NOT NULL CHECK (state IN
        ('queued', 'running', 'done', 'refused', 'failed', 'faulted', 'cancelled', 'interrupted')),
    motion INTEGER NOT NULL CHECK (motion IN (0, 1)),
    request TEXT NOT NULL,             -- JSON
    words TEXT NOT NULL,               -- JSON list: the command's
    run TEXT,                          -- id of the folder that it makes
    created REAL NOT NULL,
    created_by TEXT NOT NULL,
    started REAL,
    ended REAL,
    process TEXT,                      -- pid and start, to find it again after a crash of ours
    exit_code INTEGER,
    detail TEXT NOT NULL DEFAULT ''
) STRICT;
CREATE INDEX jobs_by_state ON jobs (state, number);

CREATE TABLE runs (
    id TEXT PRIMARY KEY,
    kind TEXT NOT NULL,
    arm TEXT NOT NULL,
    arm_sha256 TEXT,
    created REAL NOT NULL,
    ending TEXT NOT NULL,              -- done, stopped, an error in words, or 'killed'
    manifest_sha256 TEXT,              -- NULL: killed before it had one
    indexed REAL NOT NULL
) STRICT;

CREATE TABLE recordings (
    run TEXT NOT NULL REFERENCES runs (id) ON DELETE CASCADE,
    name TEXT NOT NULL,
    sha256 TEXT NOT NULL,
    bytes INTEGER NOT NULL,
    deleted REAL,
    PRIMARY KEY (run, name)
) STRICT;

CREATE TABLE parameter_sets (
    run TEXT PRIMARY KEY REFERENCES runs (id) ON DELETE CASCADE,
    sha256 TEXT NOT NULL,
    arm TEXT NOT NULL,
    method TEXT NOT NULL,
    feasible INTEGER CHECK (feasible IN (0, 1)),
    relative_error_percent REAL
) STRICT;

CREATE TABLE acceptances (
    arm TEXT NOT NULL,
    number INTEGER NOT NULL,
    run TEXT NOT NULL,
    origin INTEGER NOT NULL,           -- the acceptance whose set it is: its own number, or that rolled back to
    parameters_sha256 TEXT NOT NULL,
    note TEXT NOT NULL,
    at REAL NOT NULL,
    who TEXT NOT NULL,
    PRIMARY KEY (arm, number)
) STRICT;

CREATE TABLE schedules (
    id INTEGER PRIMARY KEY,
    arm TEXT NOT NULL,
    cron TEXT,
    trigger TEXT,
    request TEXT NOT NULL,             -- JSON of the job
    enabled INTEGER NOT NULL DEFAULT 1 CHECK (enabled IN (0, 1)),
    last REAL,
    next REAL,
    created REAL NOT NULL,
    created_by TEXT NOT NULL,
    CHECK ((cron IS NULL) <> (trigger IS NULL))
) STRICT;

CREATE TABLE maintenance_events (
    id INTEGER PRIMARY KEY,
    arm TEXT NOT NULL,
    what TEXT NOT NULL,
    note TEXT NOT NULL,
    at REAL NOT NULL,
    who TEXT NOT NULL
) STRICT;

CREATE TABLE tokens (
    name TEXT PRIMARY KEY,
    role TEXT NOT NULL CHECK (role IN ('viewer', 'operator')),
    sha256 TEXT NOT NULL UNIQUE,
    created REAL NOT NULL,
    revoked REAL
) STRICT;

CREATE TABLE audit (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    at REAL NOT NULL,
    who TEXT NOT NULL,
    what TEXT NOT NULL,
    about TEXT NOT NULL,
    detail TEXT NOT NULL               -- JSON
) STRICT;
CREATE TRIGGER audit_stays BEFORE UPDATE ON audit BEGIN SELECT RAISE(ABORT, 'the audit trail is append-only'); END;
CREATE TRIGGER audit_keeps BEFORE DELETE ON audit BEGIN SELECT RAISE(ABORT, 'the audit trail is append-only'); END;
"""

_MAINTENANCE = """
ALTER TABLE runs ADD COLUMN seconds REAL;  -- that the arm was driven; NULL: its folder does not say
ALTER TABLE schedules ADD COLUMN counted REAL NOT NULL DEFAULT 0; -- operating seconds when it was last due

CREATE TABLE reidentifications (
    id TEXT PRIMARY KEY,
    arm TEXT NOT NULL,
    step TEXT NOT NULL CHECK (step IN ('check', 'run', 'identify', 'judge')),
    state TEXT NOT NULL CHECK (state IN ('running', 'unchanged', 'changed', 'impossible',
        'refused', 'failed', 'faulted', 'cancelled', 'interrupted')),
    motion TEXT,
    against INTEGER NOT NULL,          -- number of the acceptance
    unattended INTEGER NOT NULL CHECK (unattended IN (0, 1)),
    job TEXT,                          -- of the step; NULL where a terminal does them
    recorded TEXT,                     -- id of the run with the recording
    run TEXT,                          -- id of the run with the parameters and the comparison
    detail TEXT NOT NULL DEFAULT '',
    begun REAL NOT NULL,
    begun_by TEXT NOT NULL,
    ended REAL
) STRICT;
CREATE UNIQUE INDEX one_reidentification ON reidentifications (arm) WHERE state = 'running';

CREATE TABLE dues (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    arm TEXT NOT NULL,
    schedule INTEGER NOT NULL,
    cause TEXT NOT NULL,
    at REAL NOT NULL,
    late INTEGER NOT NULL CHECK (late IN (0, 1)), -- found long after its time
    told INTEGER NOT NULL DEFAULT 0 CHECK (told IN (0, 1)),
    tried INTEGER NOT NULL DEFAULT 0 CHECK (tried IN (0, 1)), -- whether it was decided if it begins by itself
    closed REAL,
    closed_by TEXT,
    how TEXT NOT NULL DEFAULT ''
) STRICT;
CREATE UNIQUE INDEX one_due ON dues (schedule) WHERE closed IS NULL;

CREATE TABLE alarms (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    arm TEXT NOT NULL,
    reidentification TEXT NOT NULL,
    run TEXT NOT NULL,
    what TEXT NOT NULL,                -- findings, in words
    at REAL NOT NULL,
    told INTEGER NOT NULL DEFAULT 0 CHECK (told IN (0, 1)),
    closed REAL,
    closed_by TEXT,
    how TEXT NOT NULL DEFAULT ''
) STRICT;
"""

_SESSIONS = """
CREATE TABLE sessions (
    sha256 TEXT PRIMARY KEY,           -- of the word in the browser's cookie
    token TEXT NOT NULL,               -- SHA-256 of the token that it was exchanged for
    until REAL NOT NULL
) STRICT;
"""

_KEYS = """
CREATE TABLE idempotency_keys (
    who TEXT NOT NULL,                 -- name of the token
    key TEXT NOT NULL,
    request TEXT NOT NULL,             -- SHA-256 of what was asked with it
    job TEXT NOT NULL,
    at REAL NOT NULL,
    PRIMARY KEY (who, key)
) STRICT;
"""

_DELIVERIES = """
CREATE TABLE deliveries (
    number INTEGER PRIMARY KEY AUTOINCREMENT,
    id TEXT NOT NULL UNIQUE,           -- webhook-id
    arm TEXT NOT NULL,
    body TEXT NOT NULL,                -- JSON, as it is signed and sent
    created REAL NOT NULL,
    tries INTEGER NOT NULL DEFAULT 0,
    next REAL,                         -- when it is tried; NULL: delivered, or given up
    delivered REAL,
    why TEXT NOT NULL DEFAULT ''       -- the last try failed
) STRICT;
CREATE INDEX deliveries_by_next ON deliveries (next);
"""

_LABELS = """
CREATE TABLE run_labels (
    run TEXT PRIMARY KEY REFERENCES runs (id) ON DELETE CASCADE,
    tags TEXT NOT NULL,                -- JSON list
    note TEXT NOT NULL,
    at REAL NOT NULL,
    who TEXT NOT NULL
) STRICT;
"""

MIGRATIONS: Final[tuple[str, ...]] = (_FIRST, _MAINTENANCE, _SESSIONS, _KEYS, _DELIVERIES, _LABELS)


FILE: Final = "registry.sqlite"
LONGEST_NOTE: Final = 2000  # characters, of a person's note or reason
_BUSY = 10.0  # s to wait for another process that writes
_IDLE = 2.0  # s
Row = Mapping[str, Any]


_WANTED = 2**16  # bytes; SQLite's shared index of its log takes half of them, and calls their lack an input error


def registry_error(path: Path, error: Exception) -> IdentError:
    """Return, without raising it, the error that tells a user of one of SQLite: busy, disk full, damaged or not usable.

    Args:
        path: the registry's file.
        error: error of SQLite or the operating system.
    """
    if (short := shortage(path, error)) is not None:
        return short
    code = _primary(error)
    if code in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB):
        return UsageError(f"{path}: is damaged ({error}); put a backup back: `ident restore FILE --replace`")
    return UsageError(f"{path}: cannot be used: {error}; see who owns it, or give another state folder")


def shortage(path: Path, error: BaseException) -> RegistryBusy | DiskFull | None:
    """Return, without raising it, RegistryBusy or DiskFull where an error says so; None for any other error.

    Args:
        path: the registry's file.
        error: an error of SQLite or of the operating system.
    """
    code = _primary(error)
    if code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
        return RegistryBusy(f"{path}: another process has locked the registry; nothing is lost, try again later")
    full = code == sqlite3.SQLITE_FULL or getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT)
    if code in (sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN) and not full:
        with suppress(OSError):
            disk = os.statvfs(path.parent)
            full = disk.f_bavail * disk.f_frsize < _WANTED or 0 == disk.f_favail < disk.f_files
    if full:
        return DiskFull(f"{path.parent}: its disk is full; free disk space, then try again")
    return None


def _primary(error: BaseException) -> int:
    """Return the primary code of SQLite's extended ones; 0 for no error of SQLite."""
    return int(getattr(error, "sqlite_errorcode", None) or 0) & 0xFF


class Database:
    """Two connections to the registry, one for writing and one for reading, each used by one thread at a time."""

    def __init__(self, state: Path, migrations: Sequence[str] = MIGRATIONS, *, busy: float = _BUSY) -> None:
        """Open the registry of a state folder; create and migrate it where necessary.

        Args:
            state: the state folder.
            migrations: SQL scripts, the oldest first.
            busy: how long a write waits for another process that writes [s].

        Raises:
            UsageError: it cannot be made, is damaged, or was written by newer software; or a restore broke off.
            RegistryBusy: another process keeps it.
            DiskFull: there is no room for it.
        """
        require_no_interrupted_restore(state)
        self._path, self._lock, self._read_lock = state / FILE, threading.RLock(), threading.Lock()
        self._writer: int | None = None  # the thread whose transaction is open
        self._busy, self._wrote = busy, math.inf  # when the last write was that is only in the log [s]
        try:
            state.mkdir(mode=0o700, parents=True, exist_ok=True)
            with suppress(FileExistsError):  # SQLite gives its other files the mode of this one
                os.close(os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600))
            self._connection = self._connect(busy)
            self._reader = self._connect(busy)
        except (OSError, sqlite3.Error) as error:
            raise registry_error(self._path, error) from None
        try:
            for pragma in ("journal_mode = WAL", "synchronous = FULL", "foreign_keys = ON"):
                self._connection.execute(f"PRAGMA {pragma}")
            self._migrate(migrations)
            self._checkpointed()
            self._reader.execute("PRAGMA query_only = ON")
            for ending in ("", "-wal", "-shm"):  # older software made these files with other modes
                with suppress(FileNotFoundError):
                    self._path.with_name(self._path.name + ending).chmod(0o600)
        except sqlite3.Error as error:
            self.close()
            raise registry_error(self._path, error) from None
        except IdentError:
            self.close()
            raise

    def _connect(self, busy: float) -> sqlite3.Connection:
        connection = sqlite3.connect(
            self._path, timeout=busy, isolation_level=None, check_same_thread=False, cached_statements=256
        )
        connection.row_factory = sqlite3.Row
        return connection

    def _migrate(self, migrations: Sequence[str]) -> None:
        with self.transaction():
            version = int(self._connection.execute("PRAGMA user_version").fetchone()[0])
            if version > len(migrations):
                raise UsageError(
                    f"{self._path}: written by newer software (version {version}, this one knows {len(migrations)}); "
                    "use that, or another state folder"
                )
            for number, script in enumerate(migrations[version:], version + 1):
                for statement in _statements(script):
                    self._connection.execute(statement)
                self._connection.execute(f"PRAGMA user_version = {number:d}")

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Write all statements of the block, or none of them; nested blocks belong to the outer one."""
        # A thread waits here hardly longer than the thread before it may wait for another process.
        if not self._lock.acquire(timeout=self._busy + 1.0):
            busy = sqlite3.OperationalError("other threads have written for too long")
            busy.sqlite_errorcode, busy.sqlite_errorname = sqlite3.SQLITE_BUSY, "SQLITE_BUSY"
            raise busy
        try:
            if self._writer is not None:
                yield
                return
            self._connection.execute("BEGIN IMMEDIATE")
            self._writer, before = threading.get_ident(), self._connection.total_changes
            try:
                yield
            except BaseException:
                if self._connection.in_transaction:  # a full disk has ended it already
                    self._connection.execute("ROLLBACK")
                raise
            else:
                self._connection.execute("COMMIT")
                if self._connection.total_changes != before:
                    self._wrote = time.monotonic()
            finally:
                self._writer = None
        finally:
            self._lock.release()

    def write(self, sql: str, *values: Any) -> int:
        """Execute one statement; return how many rows it changed."""
        with self.transaction():
            return self._connection.execute(sql, values).rowcount

    def rows(self, sql: str, *values: Any) -> list[Row]:
        """Return all rows of a query as mappings of column to value; within a transaction, with what it has written."""
        if self._writer == threading.get_ident():
            return [dict(row) for row in self._connection.execute(sql, values)]
        with self._read_lock:
            return [dict(row) for row in self._reader.execute(sql, values)]

    def row(self, sql: str, *values: Any) -> Row | None:
        """Return the first row of a query, or None."""
        return next(iter(self.rows(sql, *values)), None)

    def known(self, table: str, noun: str, value: str, column: str = "id") -> Row:
        """Return the row of this id, or with `value` in another unique `column`; raise UnknownId where there is none.

        Raises:
            UnknownId: there is none.
        """
        row = self.row(f"SELECT * FROM {table} WHERE {column} = ?", value)  # noqa: S608 - ours
        if row is None:
            raise UnknownId(f"no {noun} {value!r} is known; see the list of {noun}s")
        return row

    def newest(
        self, table: str, noun: str, time_column: str, arm: str | None, before_id: str | None, max_rows: int
    ) -> list[Row]:
        """Return at most `max_rows` rows, or those of an arm, the newest first, all older than row `before_id`.

        Args:
            table: table of the rows.
            noun: name of the rows, for the error.
            time_column: column with the rows' time.
            arm: name; all arms when None.
            before_id: id of the row before the first; the first of all when None.
            max_rows: largest number of rows.

        Raises:
            UnknownId: there is no row of that id.
        """
        last = None if before_id is None else self.known(table, noun, before_id)[time_column]
        return self.rows(
            f"SELECT * FROM {table} WHERE (? IS NULL OR arm = ?) "  # noqa: S608 - ours
            f"AND (? IS NULL OR {time_column} < ? OR {time_column} = ? AND id > ?) "
            f"ORDER BY {time_column} DESC, id LIMIT ?",
            *(arm, arm, last, last, last, before_id, max_rows),
        )

    def is_intact(self) -> bool:
        """Return whether SQLite finds nothing wrong in the whole file."""
        return self.rows("PRAGMA integrity_check") == [{"integrity_check": "ok"}] and not self.rows(
            "PRAGMA foreign_key_check"
        )

    def checkpoint_when_idle(self) -> None:
        """Move the log into the main file once nothing has been written for two seconds; waits for nobody.

        Until then the last transactions are in SQLite's log beside it, which whoever copies one file leaves behind.
        """
        if time.monotonic() - self._wrote < _IDLE or not self._lock.acquire(blocking=False):
            return
        try:
            if self._writer is None and self._checkpointed():
                self._wrote = math.inf
        finally:
            self._lock.release()

    def _checkpointed(self) -> bool:
        """Move the log into the main file unless another process uses it; return whether all of it was moved."""
        self._connection.execute("PRAGMA busy_timeout = 0")
        try:
            busy, *_ = self._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
        except sqlite3.OperationalError:
            return False
        finally:
            self._connection.execute(f"PRAGMA busy_timeout = {int(1000 * self._busy):d}")
        return not busy

    def close(self) -> None:
        """Move the log into the main file, and close both connections."""
        with self._lock, self._read_lock:
            self._reader.close()
            with suppress(sqlite3.Error):  # damaged, or closed already
                self._checkpointed()
            self._connection.close()

    def __enter__(self) -> Self:
        """Return the database itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the database."""
        self.close()


def _statements(script: str) -> Iterator[str]:
    """Yield the statements of a script one by one; `executescript` would end the transaction."""
    statement = ""
    for piece in re.findall(r"[^;]*;|[^;]+$", script):
        statement += piece
        if sqlite3.complete_statement(statement):
            yield statement
            statement = ""
    if statement.strip():
        yield statement


_AGAIN: Final = 1.0  # s between attempts to enter a line that the registry cannot take
_MOST_WAITING: Final = 10_000
_WAITING: Final = "audit.waiting"
LOG = logging.getLogger("ident.audit")
_Line = tuple[float, str, str, str, str]


def note(db: Database, actor: str, action: str, subject: str, **detail: Any) -> None:
    """Add a line to the audit trail: at the present time, `actor` did `action` to `subject`.

    Args:
        db: the registry.
        actor: the name of a token, `terminal:NAME`, or `service`.
        action: one word or two: `job created`, `accepted`.
        subject: id of the arm, job or run.
        detail: JSON values.
    """
    _enter(db, _line(actor, action, subject, detail))


def note_later(state: Path, actor: str, action: str, subject: str, **detail: Any) -> None:
    """Store a line of the audit trail, as for `note`, in a file, from which `write_deferred_entries` enters it.

    Args:
        state: the state folder.
        actor: as for `note`.
        action: as for `note`.
        subject: as for `note`.
        detail: as for `note`.

    Raises:
        OSError, UsageError: it cannot be written either.
    """
    path = state / _WAITING / f"{time.time_ns()}-{secrets.token_hex(4)}.json"
    path.parent.mkdir(mode=0o700, exist_ok=True)
    write_atomically(path, json.dumps(_line(actor, action, subject, detail)))
    give_to_owner(state, path)


def write_deferred_entries(db: Database, state: Path) -> None:
    """Enter the lines that `note_later` has stored in files, each once, and delete the files."""
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

    def note(self, actor: str, action: str, subject: str, **detail: Any) -> None:
        """Queue a line for the audit trail, without waiting; it is lost, with an error logged, if too many wait."""
        line = _line(actor, action, subject, detail)
        with self._changed:
            if len(self._lines) < _MOST_WAITING:
                self._lines.append(line)
                self._changed.notify_all()
                return
        LOG.error("a line of the audit trail is lost, because too many wait: %s", line)

    def flush(self, timeout: float) -> bool:
        """Wait until every line is entered, at most `timeout` [s]; return whether all are."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._lines, timeout)

    def close(self, timeout: float = 5.0) -> None:
        """Enter the queued lines, as far as the registry takes them in `timeout` [s], and end the thread."""
        self.flush(timeout)
        self._ending.set()
        with self._changed:
            self._changed.notify_all()
        self._thread.join(timeout)
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


def audit_log(db: Database, *, before_id: int | None = None, max_lines: int = 100) -> list[Row]:
    """Return lines of the audit trail, the newest first, from the one before the id `before_id`."""
    rows = db.rows(
        "SELECT * FROM audit WHERE id < ? ORDER BY id DESC LIMIT ?",
        2**62 if before_id is None else before_id,
        max_lines,
    )
    return [{**row, "detail": json.loads(row["detail"])} for row in rows]


def audit_entries_after(db: Database, after_id: int, max_lines: int = 500) -> list[Row]:
    """Return lines of the audit trail after the one of this id, the earliest first."""
    rows = db.rows("SELECT * FROM audit WHERE id > ? ORDER BY id LIMIT ?", after_id, max_lines)
    return [{**row, "detail": json.loads(row["detail"])} for row in rows]


def newest_line_id(db: Database) -> int:
    """Return the id of the newest line of the audit trail; 0 where there is none."""
    row = db.row("SELECT MAX(id) AS id FROM audit")
    return int(row["id"] or 0) if row is not None else 0
