"""The tables, as numbered steps: `PRAGMA user_version` says how many a database has seen.

A step that has been released is never changed; a new one is appended. Times are seconds since 1970 in UTC.
"""

from __future__ import annotations

from typing import Final

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

MIGRATIONS: Final[tuple[str, ...]] = (_FIRST,)
