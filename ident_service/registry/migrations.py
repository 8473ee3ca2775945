"""Define the tables in numbered migrations: `PRAGMA user_version` says how many a database has seen.

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

MIGRATIONS: Final[tuple[str, ...]] = (_FIRST, _MAINTENANCE, _SESSIONS, _KEYS, _DELIVERIES)
