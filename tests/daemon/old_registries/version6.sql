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
INSERT INTO "alarms" VALUES(1,'bench2','again-1','20261101T080000-bench2','fv2 has grown',1793520800.0,0,NULL,NULL,'');
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
INSERT INTO "arms" VALUES('bench2','accde79b02012bcff29704942044eaa5112b6b210208837f03d378aaada4eb46','planar arm of two links, gravity in its plane','uploaded','descriptions/bench2-accde79b02012bcf','["arm bench2"]',0,1793519000.0,'owner');
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
INSERT INTO "audit" VALUES(3,1793519000.0,'owner','arm added','bench2','{"sha256": "accde79b02012bcff29704942044eaa5112b6b210208837f03d378aaada4eb46"}');
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
INSERT INTO "deliveries" VALUES(1,'msg_0123456789abcdef01234567','bench2','{"type": "arm.due", "timestamp": "2026-11-01T06:00:00.000Z", "data": {"id": 1, "arm": "bench2", "what": "cron 0 6 * * 1"}}',1793520000.0,2,1793520305.0,NULL,'answered 500');
INSERT INTO "deliveries" VALUES(2,'msg_76543210fedcba9876543210','bench2','{"type": "arm.due", "timestamp": "2026-11-01T06:00:00.000Z", "data": {"id": 1, "arm": "bench2", "what": "cron 0 6 * * 1"}}',1793510000.0,1,NULL,1793510001.0,'');
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
INSERT INTO "dues" VALUES(1,'bench2',1,'cron 0 6 * * 1',1793520700.0,0,0,0,NULL,NULL,'');
CREATE TABLE idempotency_keys (
    who TEXT NOT NULL,                 -- name of the token
    key TEXT NOT NULL,
    request TEXT NOT NULL,             -- SHA-256 of what was asked with it
    job TEXT NOT NULL,
    at REAL NOT NULL,
    PRIMARY KEY (who, key)
) STRICT;
INSERT INTO "idempotency_keys" VALUES('owner','k1','abababababababababababababababababababababababababababababababab','run-1',1793519000.0);
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
INSERT INTO "reidentifications" VALUES('again-1','bench2','judge','changed',NULL,1,0,NULL,'20261101T080000-bench2','20261101T080000-bench2','',1793520500.0,'owner',1793520600.0);
CREATE TABLE runs (
    id TEXT PRIMARY KEY,
    kind TEXT NOT NULL,
    arm TEXT NOT NULL,
    arm_sha256 TEXT,
    created REAL NOT NULL,
    ending TEXT NOT NULL,              -- done, stopped, an error in words, or 'killed'
    manifest_sha256 TEXT,              -- NULL: killed before it had one
    indexed REAL NOT NULL
, seconds REAL) STRICT;
INSERT INTO "runs" VALUES('20261101T080000-bench2','identification','bench2','abababababababababababababababababababababababababababababababab',1793520000.0,'done','cdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcd',1793520100.0,41.5);
CREATE TABLE run_labels (
    run TEXT PRIMARY KEY REFERENCES runs (id) ON DELETE CASCADE,
    tags TEXT NOT NULL,                -- JSON list
    note TEXT NOT NULL,
    at REAL NOT NULL,
    who TEXT NOT NULL
) STRICT;
INSERT INTO "run_labels" VALUES('20261101T080000-bench2','["belt","warm"]','before the belt was changed',1793521000.0,'owner');
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
    created_by TEXT NOT NULL, counted REAL NOT NULL DEFAULT 0,
    CHECK ((cron IS NULL) <> (trigger IS NULL))
) STRICT;
INSERT INTO "schedules" VALUES(1,'bench2','0 6 * * 1',NULL,'{}',1,NULL,1793600000.0,1793520400.0,'owner',0.0);
CREATE TABLE sessions (
    sha256 TEXT PRIMARY KEY,           -- of the word in the browser's cookie
    token TEXT NOT NULL,               -- SHA-256 of the token that it was exchanged for
    until REAL NOT NULL
) STRICT;
INSERT INTO "sessions" VALUES('aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa','bbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbb',2000000000.0);
CREATE TABLE tokens (
    name TEXT PRIMARY KEY,
    role TEXT NOT NULL CHECK (role IN ('viewer', 'operator')),
    sha256 TEXT NOT NULL UNIQUE,
    created REAL NOT NULL,
    revoked REAL
) STRICT;
INSERT INTO "tokens" VALUES('owner','operator','daaf0c4cea1b9335026fd99db1e91a4244edb1e5e812869ceaf204f088ed8994',1793519000.0,NULL);
INSERT INTO "tokens" VALUES('bench','viewer','090efe9316f8cbf443f211c83dfd73629b9bb8d43f882847c4e2125971b1ed96',1793519000.0,NULL);
CREATE INDEX jobs_by_state ON jobs (state, number);
CREATE TRIGGER audit_stays BEFORE UPDATE ON audit BEGIN SELECT RAISE(ABORT, 'the audit trail is append-only'); END;
CREATE TRIGGER audit_keeps BEFORE DELETE ON audit BEGIN SELECT RAISE(ABORT, 'the audit trail is append-only'); END;
CREATE UNIQUE INDEX one_reidentification ON reidentifications (arm) WHERE state = 'running';
CREATE UNIQUE INDEX one_due ON dues (schedule) WHERE closed IS NULL;
CREATE INDEX deliveries_by_next ON deliveries (next);
COMMIT;
PRAGMA user_version = 6;
