"""Open and migrate the registry's database, and use it in short transactions from any thread.

Write-ahead logging with full synchronisation: what a transaction has written is on the disk when it ends, and a kill at
any moment loses nothing of it. Other processes of the same machine (`ident accept`) may use the file at the same time.
One connection writes and another one reads: who reads does not wait for who writes, here or in another process.
"""

from __future__ import annotations

import errno
import math
import os
import re
import sqlite3
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from ident_service.errors import DiskFull, IdentError, RegistryBusy, UsageError
from ident_service.operations.state_folder import require_whole
from ident_service.registry.migrations import MIGRATIONS

FILE: Final = "registry.sqlite"
_BUSY = 10.0  # s to wait for another process that writes
_IDLE = 2.0  # s
Row = Mapping[str, Any]


_WANTED = 2**16  # bytes; SQLite's shared index of its log takes half of them, and calls their lack an input error


def registry_error(path: Path, error: Exception) -> IdentError:
    """Return what an error of SQLite, or of the registry's disk, means to whoever asked.

    Args:
        path: the registry's file.
        error: as it was raised, by SQLite or the operating system.
    """
    if (short := shortage(path, error)) is not None:
        return short
    code = _primary(error)
    if code in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB):
        return UsageError(f"{path}: is damaged ({error}); put a backup back: `ident restore FILE --replace`")
    return UsageError(f"{path}: cannot be used: {error}; see who owns it, or give another state folder")


def shortage(path: Path, error: BaseException) -> RegistryBusy | DiskFull | None:
    """Return what is short for a while where an error says so; None where it says something else.

    Args:
        path: the registry's file.
        error: an error of SQLite or of the operating system.
    """
    code = _primary(error)
    if code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
        return RegistryBusy(f"{path}: another process keeps the registry; nothing is lost, ask again when it is done")
    full = code == sqlite3.SQLITE_FULL or getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT)
    if code in (sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN) and not full:
        with suppress(OSError):
            disk = os.statvfs(path.parent)
            full = disk.f_bavail * disk.f_frsize < _WANTED or 0 == disk.f_favail < disk.f_files
    if full:
        return DiskFull(f"{path.parent}: its disk is full; make room, then ask again")
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
        require_whole(state)
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

    def sound(self) -> bool:
        """Return whether SQLite finds nothing wrong in the whole file."""
        return self.rows("PRAGMA integrity_check") == [{"integrity_check": "ok"}] and not self.rows(
            "PRAGMA foreign_key_check"
        )

    def rest(self) -> None:
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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
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
