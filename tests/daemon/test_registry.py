"""The registry: migrated forwards only, whole transactions or none, an audit trail that stays."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from ident_service.daemon.jobs.outcome import ProcessOutput, outcome
from ident_service.errors import UnknownId, UsageError
from ident_service.registry import jobs
from ident_service.registry.database import FILE, MIGRATIONS, Database, audit_log, note
from ident_service.registry.runs import recordings_of
from ident_service.registry.tokens import TOKEN_FILE, access, add_token, first_token, read_token, revoke_token, tokens


def test_a_database_is_migrated_step_by_step_and_keeps_what_it_had(tmp_path: Path) -> None:
    steps = ("CREATE TABLE a (x INTEGER); INSERT INTO a VALUES (7);", "ALTER TABLE a ADD COLUMN y INTEGER DEFAULT 8;")
    with Database(tmp_path, steps[:1]) as db:
        assert db.rows("SELECT * FROM a") == [{"x": 7}]
    with Database(tmp_path, steps) as db:
        assert db.rows("SELECT * FROM a") == [{"x": 7, "y": 8}]
        assert db.row("PRAGMA user_version") == {"user_version": 2}
    with Database(tmp_path, steps) as db:
        assert db.rows("SELECT * FROM a") == [{"x": 7, "y": 8}]


def test_a_step_that_fails_changes_nothing(tmp_path: Path) -> None:
    good = "CREATE TABLE a (x INTEGER);"
    with Database(tmp_path, (good,)) as db:
        db.write("INSERT INTO a VALUES (1)")
    with pytest.raises(UsageError, match="no such table"):
        Database(tmp_path, (good, "CREATE TABLE b (x INTEGER); INSERT INTO nowhere VALUES (1);"))
    with Database(tmp_path, (good,)) as db:
        assert db.rows("SELECT name FROM sqlite_master WHERE name = 'b'") == []


def test_a_newer_database_is_refused_and_left_alone(tmp_path: Path) -> None:
    Database(tmp_path).close()
    with sqlite3.connect(tmp_path / FILE) as raw:
        raw.execute(f"PRAGMA user_version = {len(MIGRATIONS) + 1}")
    raw.close()
    before = (tmp_path / FILE).read_bytes()
    with pytest.raises(UsageError, match="written by newer software"):
        Database(tmp_path)
    assert (tmp_path / FILE).read_bytes() == before


def test_what_is_no_database_is_refused_in_words(tmp_path: Path) -> None:
    (tmp_path / FILE).write_bytes(b"not a database, but long enough to be taken for one" * 100)
    with pytest.raises(UsageError, match=FILE):
        Database(tmp_path)


def test_a_transaction_is_whole_or_nothing(tmp_path: Path) -> None:
    with Database(tmp_path) as db:

        def half() -> None:
            with db.transaction():
                note(db, "me", "began", "x")
                with db.transaction():
                    note(db, "me", "inner", "x")
                raise ZeroDivisionError

        with pytest.raises(ZeroDivisionError):
            half()
        assert audit_log(db) == []


def test_the_audit_trail_can_be_neither_changed_nor_shortened(tmp_path: Path) -> None:
    with Database(tmp_path) as db:
        note(db, "me", "did", "x", how="so")
        for sql in ("UPDATE audit SET who = 'you'", "DELETE FROM audit"):
            with pytest.raises(sqlite3.IntegrityError, match="append-only"):
                db.write(sql)
        (line,) = audit_log(db)
        assert (line["who"], line["what"], line["about"], line["detail"]) == ("me", "did", "x", {"how": "so"})


def test_threads_do_not_lose_each_others_rows(tmp_path: Path) -> None:
    with Database(tmp_path) as db:
        threads = [
            threading.Thread(target=lambda k=k: [note(db, f"t{k}", "did", str(i)) for i in range(25)]) for k in range(4)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        counted = db.rows("SELECT who, COUNT(*) AS n FROM audit GROUP BY who ORDER BY who")
        assert counted == [{"who": f"t{k}", "n": 25} for k in range(4)]


def test_what_was_written_survives_a_kill(tmp_path: Path) -> None:
    script = (
        "import os, sys; from pathlib import Path\n"
        "from ident_service.registry.database import Database\n"
        "from ident_service.registry.database import note\n"
        "db = Database(Path(sys.argv[1]))\n"
        "note(db, 'me', 'written', 'x')\n"
        "with db.transaction():\n"
        "    note(db, 'me', 'not yet', 'x')\n"
        "    os.kill(os.getpid(), 9)\n"
    )
    assert subprocess.run([sys.executable, "-c", script, tmp_path], check=False).returncode == -9
    with Database(tmp_path) as db:
        assert [line["what"] for line in audit_log(db)] == ["written"]
        assert db.is_intact()


def test_a_job_ends_once(tmp_path: Path) -> None:
    with Database(tmp_path) as db:
        jobs.add_job(db, "j", "run", "a", {}, [], "me", motion=True, run_id=None)
        assert jobs.mark_started(db, "j", "")
        assert not jobs.mark_started(db, "j", "")
        assert jobs.mark_ended(db, "j", "faulted", "why", 4)
        assert not jobs.mark_ended(db, "j", "done", "")
        assert jobs.known_job(db, "j")["state"] == "faulted"
        with pytest.raises(UnknownId):
            jobs.known_job(db, "k")


def test_typical_durations_are_medians_of_what_came_to_its_end(tmp_path: Path) -> None:
    with Database(tmp_path) as db:
        assert jobs.typical_seconds(db, "run", "a") is None
        for number, (seconds, state) in enumerate([(10, "done"), (12, "done"), (500, "done"), (1, "failed")]):
            jobs.add_job(db, str(number), "run", "a", {}, [], "me", motion=True, run_id=None)
            db.write("UPDATE jobs SET state = ?, started = 0, ended = ? WHERE id = ?", state, seconds, str(number))
        jobs.add_job(db, "waited", "run", "a", {}, [], "me", motion=True, run_id=None)
        assert jobs.mark_ended(db, "waited", "refused", "its confirmation was too old")
        assert jobs.typical_seconds(db, "run", "a") == 12
        assert jobs.typical_seconds(db, "run", "b") is None


def test_recordings_of_arms_are_those_of_motions_and_uploads(tmp_path: Path) -> None:
    with Database(tmp_path) as db:
        for kind in ("motion", "recording", "identification", "simulation"):
            for arm in ("bench1", "other"):
                run, values = f"{kind}-{arm}", "(?, ?, ?, NULL, 1.0, 'done', NULL, 2.0, 3.0)"
                db.write(f"INSERT INTO runs VALUES {values}", run, kind, arm)  # noqa: S608
                db.write("INSERT INTO recordings VALUES (?, 'run.mcap', 'a', 1, NULL)", run)
        db.write("INSERT INTO recordings VALUES ('motion-bench1', 'gone.mcap', 'a', 1, 2.0)")
        found = [(row["run"], row["name"]) for row in recordings_of(db, ["bench*"])]
        assert found == [("motion-bench1", "run.mcap"), ("recording-bench1", "run.mcap")]


def test_only_the_hash_of_a_token_is_kept(tmp_path: Path) -> None:
    with Database(tmp_path) as db:
        secret = add_token(db, "ann", "viewer", "me")
        found = access(db, secret)
        assert found is not None
        assert (found.name, found.role) == ("ann", "viewer")
        assert access(db, secret[:-1]) is None
        with pytest.raises(UsageError, match="there is"):
            add_token(db, "ann", "operator", "me")
        revoke_token(db, "ann", "me")
        assert access(db, secret) is None
        with pytest.raises(UsageError, match="there is, or was"):
            add_token(db, "ann", "operator", "me")
    assert all(secret.encode() not in path.read_bytes() for path in tmp_path.iterdir())


def test_the_first_token_is_its_owners_alone(tmp_path: Path) -> None:
    with Database(tmp_path) as db:
        path = first_token(db, tmp_path)
        assert path.stat().st_mode & 0o777 == 0o600
        secret = read_token(path)
        assert secret is not None
        found = access(db, secret)
        assert found is not None
        assert found.role == "operator"
        assert first_token(db, tmp_path) == path
        assert read_token(path) == secret
        # One that counts no more is replaced, and the trail names both.
        revoke_token(db, found.name, "me")
        first_token(db, tmp_path)
        assert read_token(path) != secret
        assert len(tokens(db)) == 2
        path.chmod(0o644)
        with pytest.raises(UsageError, match="others can read it"):
            read_token(path)


def test_a_token_file_is_not_read_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").write_text("ident_x")
    (tmp_path / TOKEN_FILE).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UsageError, match="cannot be read"):
        read_token(tmp_path / TOKEN_FILE)


def test_a_refusal_says_why_in_the_jobs_own_line() -> None:
    def detail(**answer: Any) -> str:
        found = outcome(ProcessOutput({"exit_code": 3, **answer}), 3, "")
        assert found.state == "refused"
        return found.detail

    failed = {"code": "gravity", "verdict": "failed", "reason": "elbow: 9 N m more", "remedy": "Look at the load."}
    person = {"code": "watchdog", "verdict": "needs_person", "reason": "nobody answered", "remedy": ""}
    good = {"code": "noise", "verdict": "passed", "reason": "", "remedy": ""}
    assert detail(ticket={"checks": [good, failed, person]}) == (
        "gravity: elbow: 9 N m more (Look at the load.); watchdog: nobody answered"
    )
    assert detail(feasible=True, unusable=["the data pull against the mass of link 2"]) == (
        "the data pull against the mass of link 2"
    )
    assert detail(feasible=False, unusable=[]) == "these parameters are not feasible"
    assert detail(objections=["too fast"], error=None) == "too fast"
    assert (
        detail(error={"kind": "MotionRefused", "message": "no preflight ticket"}, objections=["x"])
        == "no preflight ticket"
    )
    for odd in ({"ticket": 3}, {"ticket": {"checks": 3}}, {"ticket": {"checks": [3]}}, {"unusable": "x"}):
        assert detail(**odd) == ""
