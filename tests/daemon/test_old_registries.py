"""State folders of earlier versions: what their own software wrote is upgraded, kept and served.

`old_registries/versionN.sql` was dumped from a registry that the software of that schema had made and filled.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from daemon.conftest import serving

from ident_service.config.yaml_source import shipped_arms
from ident_service.registry.database import FILE, MIGRATIONS, Database
from ident_service.registry.tokens import add_token

SAMPLES = sorted((Path(__file__).parent / "old_registries").glob("*.sql"))
RUN = "20261101T080000-bench2"


def old_state(state: Path, sample: Path) -> Path:
    """Make a state folder as it was left by that version."""
    state.mkdir(mode=0o700, parents=True)
    with closing(sqlite3.connect(state / FILE)) as made:
        made.executescript(sample.read_text())
        made.execute("PRAGMA journal_mode = WAL")
        (folder,) = made.execute("SELECT folder FROM arms WHERE name = 'bench2'").fetchone()
    (state / folder).mkdir(parents=True)
    text = shipped_arms()["planar2"].read_text().replace("name: planar2", "name: bench2")
    (state / folder / "arm.yaml").write_text(text)
    return state


def columns(db: sqlite3.Connection) -> dict[str, set[str]]:
    tables = [name for (name,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
    return {table: {row[1] for row in db.execute(f"PRAGMA table_info({table})")} for table in tables}


def all_of(table: str) -> str:
    return f"SELECT * FROM {table}"  # noqa: S608 - a table of ours


def test_every_schema_has_its_sample() -> None:
    assert [sample.stem for sample in SAMPLES] == [f"version{number + 1}" for number in range(len(MIGRATIONS))]


@pytest.mark.parametrize("sample", SAMPLES, ids=lambda sample: sample.stem)
def test_an_upgrade_keeps_every_value_and_makes_the_newest_tables(tmp_path: Path, sample: Path) -> None:
    state = old_state(tmp_path / "state", sample)
    with closing(sqlite3.connect(state / FILE)) as raw:
        raw.row_factory = sqlite3.Row
        before = {table: [dict(row) for row in raw.execute(all_of(table))] for table in columns(raw)}
    with Database(state) as db:
        assert db.is_intact()
        assert db.row("PRAGMA user_version") == {"user_version": len(MIGRATIONS)}
        for table, rows in before.items():
            now = db.rows(all_of(table))
            assert [{key: row[key] for key in old} for row, old in zip(now, rows, strict=True)] == rows, table
    Database(tmp_path / "new").close()
    with closing(sqlite3.connect(tmp_path / "new" / FILE)) as new, closing(sqlite3.connect(state / FILE)) as upgraded:
        assert columns(upgraded) == columns(new)


@pytest.mark.slow
@pytest.mark.parametrize("sample", SAMPLES, ids=lambda sample: sample.stem)
def test_an_upgraded_state_is_served(state: Path, sample: Path) -> None:
    old_state(state, sample)
    with serving(state) as daemon:
        daemon.as_token(add_token(daemon.service.db, "new", "operator", "test"))
        assert daemon.get("/api/v1/arms/bench2").json()["source"] == "uploaded"
        assert [run["id"] for run in daemon.get("/api/v1/runs").json()] == [RUN]
        assert [(job["id"], job["state"]) for job in daemon.get("/api/v1/jobs").json()] == [("run-1", "done")]
        assert [one["cron"] for one in daemon.get("/api/v1/schedules").json()] == ["0 6 * * 1"]
        assert {line["what"] for line in daemon.get("/api/v1/audit").json()} >= {"arm added", "token added"}
        for place in ("due", "alarms", "reidentifications", "tokens", "motions"):
            answer = daemon.get(f"/api/v1/{place}")
            assert answer.status_code == 200, (place, answer.text)
