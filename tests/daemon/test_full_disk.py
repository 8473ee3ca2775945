"""A registry without room for a while: the service says so, and the end of a job is entered when there is some."""

from __future__ import annotations

import sqlite3
import time
from typing import Any

import pytest
from daemon.conftest import Asked

from ident_service.service.registry import jobs as rows


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
