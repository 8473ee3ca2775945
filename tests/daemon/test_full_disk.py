"""A registry that is kept, or without room, for a while: the service says so, and goes on when that is over."""

from __future__ import annotations

import errno
import logging
import os
import sqlite3
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import httpx
import pytest
from daemon.conftest import Asked

from ident_service.service.registry import jobs as rows
from ident_service.service.registry.audit import note
from ident_service.service.registry.database import FILE, Database, RegistryBusy


@pytest.mark.slow
def test_the_end_of_a_job_waits_for_room(daemon: Asked, monkeypatch: pytest.MonkeyPatch) -> None:
    ended, full = rows.ended, [True]

    def without_room(*arguments: Any) -> bool:
        if full[0]:
            raise sqlite3.OperationalError("database or disk is full")
        return ended(*arguments)

    monkeypatch.setattr(rows, "ended", without_room)
    monkeypatch.setattr("ident_service.service.jobs.engine._AGAIN", 0.05)
    assert daemon.get("/healthz").status_code == 200
    job = daemon.begin({"kind": "base", "arm": "planar2"})
    until = time.monotonic() + 60.0
    while daemon.get("/healthz").status_code == 200 and time.monotonic() < until:
        time.sleep(0.05)
    assert daemon.get("/healthz").status_code == 503
    assert daemon.get(f"/api/v1/jobs/{job['id']}").json()["state"] == "running"
    full[0] = False
    assert daemon.follow(job["id"])["state"] == "done"
    while daemon.get("/healthz").status_code != 200 and time.monotonic() < until:
        time.sleep(0.05)
    assert daemon.get("/healthz").status_code == 200


MAINTENANCE: tuple[str, dict[str, str]] = ("/api/v1/arms/planar2/maintenance", {"what": "oil"})


def short_of(daemon: Asked, caplog: pytest.LogCaptureFixture, path: str, body: dict[str, str]) -> httpx.Response:
    """Ask for something that there is no room for, or no registry: it is one line in the log, without a traceback."""
    caplog.clear()
    answer = daemon.post(path, body)
    # What is due waits for the registry, too, and says so by itself.
    lines = [one for one in caplog.records if one.levelno >= logging.ERROR and one.name != "ident.maintenance"]
    assert [(one.name, one.exc_info) for one in lines] == [("ident.http", None)], lines
    return answer


def test_a_registry_that_is_kept_is_busy(daemon: Asked, caplog: pytest.LogCaptureFixture) -> None:
    daemon.service.db._connection.execute("PRAGMA busy_timeout = 50")
    with closing(sqlite3.connect(daemon.service.state / FILE)) as other:
        other.execute("BEGIN IMMEDIATE")
        answer = short_of(daemon, caplog, *MAINTENANCE)
        assert (answer.status_code, answer.headers["retry-after"]) == (503, "2")
        assert answer.json()["error"]["kind"] == "RegistryBusy"
        assert daemon.post("/api/v1/stop").status_code == 200
        other.execute("ROLLBACK")
    assert daemon.post(*MAINTENANCE).status_code == 201


def test_who_waits_behind_a_writer_waits_no_longer_than_it(tmp_path: Path) -> None:
    with Database(tmp_path, busy=0.05) as db, ThreadPoolExecutor(1) as thread:
        db.write("CREATE TABLE a (x)")
        begun, ending = threading.Event(), threading.Event()

        def keep() -> None:
            with db.transaction():
                begun.set()
                ending.wait(30.0)

        kept = thread.submit(keep)
        begun.wait(30.0)
        with pytest.raises(RegistryBusy):
            db.write("INSERT INTO a VALUES (1)")
        ending.set()
        kept.result()
        db.write("INSERT INTO a VALUES (1)")


def test_a_full_registry_has_no_room(daemon: Asked, caplog: pytest.LogCaptureFixture) -> None:
    connection = daemon.service.db._connection
    (pages,) = connection.execute("PRAGMA page_count").fetchone()
    connection.execute(f"PRAGMA max_page_count = {pages}")
    with suppress(sqlite3.OperationalError):
        while True:
            note(daemon.service.db, "me", "did", "x" * 1000)
    while daemon.post(*MAINTENANCE).status_code == 201:  # in the page that is left
        pass
    answer = short_of(daemon, caplog, *MAINTENANCE)
    assert (answer.status_code, answer.json()["error"]["kind"]) == (507, "DiskFull")
    connection.execute("PRAGMA max_page_count = 1000000")
    assert daemon.post(*MAINTENANCE).status_code == 201


@pytest.mark.slow
def test_a_full_disk_has_no_room(
    daemon: Asked, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr("pathlib.Path.write_text", full)
        answer = short_of(daemon, caplog, "/api/v1/arms", {"description": "extends: planar2\nname: other\n"})
    assert (answer.status_code, answer.json()["error"]["kind"]) == (507, "DiskFull")
    assert daemon.post("/api/v1/arms", {"description": "extends: planar2\nname: other\n"}).status_code == 201
