BEGIN TRANSACTION;
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
INSERT INTO "acceptances" VALUES('bench2',1,'20261101T080000-bench2',1,'1212121212121212121212121212121212121212121212121212121212121212','first set',1793520200.0,'terminal:ann');
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
INSERT INTO "arms" VALUES('kuka_lwr4','','','shipped',NULL,'["arm kuka_lwr4"]',0,1793519000.0,'service');
INSERT INTO "arms" VALUES('planar2','','','shipped',NULL,'["arm planar2"]',0,1793519000.0,'service');
INSERT INTO "arms" VALUES('sixaxis','','','shipped',NULL,'["arm sixaxis"]',0,1793519000.0,'service');
INSERT INTO "arms" VALUES('threelink','','','shipped',NULL,'["arm threelink"]',0,1793519000.0,'service');
INSERT INTO "arms" VALUES('tx40','','','shipped',NULL,'["arm tx40"]',0,1793519000.0,'service');
INSERT INTO "arms" VALUES('ur10','','','shipped',NULL,'["arm ur10"]',0,1793519000.0,'service');
INSERT INTO "arms" VALUES('wam7','','','shipped',NULL,'["arm wam7"]',0,1793519000.0,'service');
INSERT INTO "arms" VALUES('wam7_canopen','','','shipped',NULL,'["arm wam7_canopen"]',0,1793519000.0,'service');
INSERT INTO "arms" VALUES('wam7_canopen_500hz','','','shipped',NULL,'["arm wam7_canopen_500hz"]',0,1793519000.0,'service');
INSERT INTO "arms" VALUES('wam7_sim','','','shipped',NULL,'["arm wam7_sim"]',0,1793519000.0,'service');
INSERT INTO "arms" VALUES('bench2','9566cdbe64ab4a3ce8d2500bec0eb20daf14a2fcf711fc2320dcb1ddb0bf10bc','planar arm of two links, gravity in its plane','uploaded','descriptions/bench2-9566cdbe64ab4a3c','["arm bench2"]',0,1793519000.0,'owner');
CREATE TABLE audit (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    at REAL NOT NULL,
    who TEXT NOT NULL,
    what TEXT NOT NULL,
    about TEXT NOT NULL,
    detail TEXT NOT NULL               -- JSON
) STRICT;
INSERT INTO "audit" VALUES(1,1793519000.0,'service','token added','owner','{"role": "operator"}');
INSERT INTO "audit" VALUES(2,1793519000.0,'terminal:ann','token added','bench','{"role": "viewer"}');
INSERT INTO "audit" VALUES(3,1793519000.0,'owner','arm added','bench2','{"sha256": "9566cdbe64ab4a3ce8d2500bec0eb20daf14a2fcf711fc2320dcb1ddb0bf10bc"}');
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
INSERT INTO "jobs" VALUES(1,'run-1','run','bench2','done',1,'{"kind": "run", "arm": "bench2"}','["run", "bench2"]','20261101T080000-bench2',1793519000.0,'owner',1793519000.0,1793519000.0,'4242 77',0,'');
CREATE TABLE maintenance_events (
    id INTEGER PRIMARY KEY,
    arm TEXT NOT NULL,
    what TEXT NOT NULL,
    note TEXT NOT NULL,
    at REAL NOT NULL,
    who TEXT NOT NULL
) STRICT;
INSERT INTO "maintenance_events" VALUES(1,'bench2','gear oil changed','',1793520300.0,'owner');
CREATE TABLE motions (
    id TEXT PRIMARY KEY,
    arm TEXT NOT NULL,
    name TEXT NOT NULL,
    duration REAL NOT NULL,            -- s
    sha256 TEXT NOT NULL,
    added REAL NOT NULL,
    added_by TEXT NOT NULL
) STRICT;
CREATE TABLE parameter_sets (
    run TEXT PRIMARY KEY REFERENCES runs (id) ON DELETE CASCADE,
    sha256 TEXT NOT NULL,
    arm TEXT NOT NULL,
    method TEXT NOT NULL,
    feasible INTEGER CHECK (feasible IN (0, 1)),
    relative_error_percent REAL
) STRICT;
INSERT INTO "parameter_sets" VALUES('20261101T080000-bench2','1212121212121212121212121212121212121212121212121212121212121212','bench2','wls',1,3.25);
CREATE TABLE recordings (
    run TEXT NOT NULL REFERENCES runs (id) ON DELETE CASCADE,
    name TEXT NOT NULL,
    sha256 TEXT NOT NULL,
    bytes INTEGER NOT NULL,
    deleted REAL,
    PRIMARY KEY (run, name)
) STRICT;
INSERT INTO "recordings" VALUES('20261101T080000-bench2','run.mcap','efefefefefefefefefefefefefefefefefefefefefefefefefefefefefefefef',123456,NULL);
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
INSERT INTO "runs" VALUES('20261101T080000-bench2','identification','bench2','abababababababababababababababababababababababababababababababab',1793520000.0,'done','cdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcd',1793520100.0);
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
INSERT INTO "schedules" VALUES(1,'bench2','0 6 * * 1',NULL,'{}',1,NULL,1793600000.0,1793520400.0,'owner');
CREATE TABLE tokens (
    name TEXT PRIMARY KEY,
    role TEXT NOT NULL CHECK (role IN ('viewer', 'operator')),
    sha256 TEXT NOT NULL UNIQUE,
    created REAL NOT NULL,
    revoked REAL
) STRICT;
INSERT INTO "tokens" VALUES('owner','operator','e9f46bed9158451cd3b6ccd4014b46bd8fff775183b2d8bc70aaa7334486177d',1793519000.0,NULL);
INSERT INTO "tokens" VALUES('bench','viewer','52acd7060676e2c24b653c432b3c5dd597123dccbd2d89d646433a29ecc0d983',1793519000.0,NULL);
CREATE INDEX jobs_by_state ON jobs (state, number);
CREATE TRIGGER audit_stays BEFORE UPDATE ON audit BEGIN SELECT RAISE(ABORT, 'the audit trail is append-only'); END;
CREATE TRIGGER audit_keeps BEFORE DELETE ON audit BEGIN SELECT RAISE(ABORT, 'the audit trail is append-only'); END;
COMMIT;
PRAGMA user_version = 1;
