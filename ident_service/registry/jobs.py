"""Store jobs by id: the request, who made it, the outcome; their numbers are the order of the queue.

| state | what it means |
|---|---|
| queued | waits for an arm, a bus or a processor |
| running | its process lives |
| done | exit code 0, and a motion that went to its end |
| refused | exit code 3: done, but the verdict is no |
| failed | exit code 1 or 2, or no answer |
| faulted | exit code 4: a fault stopped the arm |
| cancelled | somebody stopped it, or its lease was not renewed |
| interrupted | the service died meanwhile; `detail` says what its folder shows |
"""

from __future__ import annotations

import json
import time
from typing import Any, Final

from ident_service.errors import AlreadyThere
from ident_service.registry.database import Database, Row

STATES: Final = ("queued", "running", "done", "refused", "failed", "faulted", "cancelled", "interrupted")
KEY_SECONDS: Final = 24 * 3600.0
LIVE: Final = ("queued", "running")
SAMPLES: Final = "\x1e"  # before a line of a job's log that is a sample, as JSON text sequences have it (RFC 7464)


def add_job(
    db: Database,
    job_id: str,
    kind: str,
    arm: str | None,
    request: dict[str, Any],
    arguments: list[str],
    requester: str,
    *,
    motion: bool,
    run_id: str | None,
) -> Row:
    """Enter a queued job; return its row. `arguments` are the words of its command after `ident`."""
    db.write(
        "INSERT INTO jobs (id, kind, arm, state, motion, request, words, run, created, created_by) "
        "VALUES (?, ?, ?, 'queued', ?, ?, ?, ?, ?, ?)",
        *(job_id, kind, arm, int(motion), json.dumps(request), json.dumps(arguments), run_id, time.time(), requester),
    )
    return known_job(db, job_id)


def known_job(db: Database, job_id: str) -> Row:
    """Return the row of the job of this id; raise UnknownId where there is none.

    Raises:
        UnknownId: there is none.
    """
    return _read(db.known("jobs", "job", job_id))


def jobs(
    db: Database,
    *,
    states: tuple[str, ...] = STATES,
    arm: str | None = None,
    before: int | None = None,
    most: int = 100,
) -> list[Row]:
    """Return at most `most` jobs in `states`, of an arm if named, the newest first, below the number `before`."""
    marks = ", ".join("?" * len(states))
    rows = db.rows(
        f"SELECT * FROM jobs WHERE state IN ({marks}) AND (? IS NULL OR arm = ?) AND number < ? "  # noqa: S608 - marks
        "ORDER BY number DESC LIMIT ?",
        *(*states, arm, arm, 2**62 if before is None else before, most),
    )
    return [_read(row) for row in rows]


def queued_jobs(db: Database) -> list[Row]:
    """Return the queued jobs, the earliest first."""
    return [_read(row) for row in db.rows("SELECT * FROM jobs WHERE state = 'queued' ORDER BY number")]


def mark_started(db: Database, job_id: str, process: str) -> bool:
    """Mark a queued job as running, by `process`; return False, and change nothing, where it is not queued any more."""
    return bool(
        db.write(
            "UPDATE jobs SET state = 'running', started = ?, process = ? WHERE id = ? AND state = 'queued'",
            *(time.time(), process, job_id),
        )
    )


def mark_ended(db: Database, job_id: str, state: str, detail: str, exit_code: int | None = None) -> bool:
    """Set a job's last state, detail and exit code; return False, and change nothing, where it has ended already."""
    return bool(
        db.write(
            "UPDATE jobs SET state = ?, detail = ?, exit_code = ?, ended = ? "
            "WHERE id = ? AND state IN ('queued', 'running')",
            *(state, detail, exit_code, time.time(), job_id),
        )
    )


def clear_folder_id(db: Database, job_id: str) -> None:
    """Clear the id of the folder that a job was to make, and has not made: it leads nowhere."""
    db.write("UPDATE jobs SET run = NULL WHERE id = ?", job_id)


def set_detail(db: Database, job_id: str, detail: str) -> None:
    """Replace the `detail` of a job, such as of one that has ended; its state is not looked at."""
    db.write("UPDATE jobs SET detail = ? WHERE id = ?", detail, job_id)


def store_idempotency_key(db: Database, token_name: str, key: str, request_sha256: str, job_id: str) -> None:
    """Store for a day that a request with an idempotency key made a job.

    Args:
        db: the registry.
        token_name: name of the token.
        key: idempotency key of the request; each token has its own keys.
        request_sha256: SHA-256 of the request's content.
        job_id: id.

    Raises:
        sqlite3.IntegrityError: the key has made a job already.
    """
    db.write("DELETE FROM idempotency_keys WHERE at < ?", time.time() - KEY_SECONDS)
    db.write(
        "INSERT INTO idempotency_keys VALUES (?, ?, ?, ?, ?)", token_name, key, request_sha256, job_id, time.time()
    )


def job_of_idempotency_key(db: Database, token_name: str, key: str, request_sha256: str) -> Row | None:
    """Return the job that this key made within a day, or None; raise AlreadyThere if that was for another request.

    Raises:
        AlreadyThere: the key was used to ask for something else.
    """
    row = db.row(
        "SELECT request, job FROM idempotency_keys WHERE who = ? AND key = ? AND at >= ?",
        *(token_name, key, time.time() - KEY_SECONDS),
    )
    if row is None:
        return None
    if row["request"] != request_sha256:
        raise AlreadyThere(f"the idempotency key {key!r} was used for another request; give each its own")
    return known_job(db, row["job"])


def typical_seconds(db: Database, kind: str, arm: str | None) -> float | None:
    """Return the median duration of the last nine done or refused jobs of a kind and arm [s]; None before any."""
    rows = db.rows(
        "SELECT ended - started AS seconds FROM jobs WHERE kind = ? AND arm IS ? AND state IN ('done', 'refused') "
        "AND started IS NOT NULL ORDER BY number DESC LIMIT 9",
        *(kind, arm),
    )
    lengths = sorted(row["seconds"] for row in rows)
    return lengths[len(lengths) // 2] if lengths else None


def _read(row: Row) -> Row:
    return {**row, "request": json.loads(row["request"]), "words": json.loads(row["words"])}
