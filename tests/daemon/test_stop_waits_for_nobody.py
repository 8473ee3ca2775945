"""Stops and leases while another process keeps the registry, and while every thread of the service waits for it."""

from __future__ import annotations

import os
import pwd
import sqlite3
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from daemon.conftest import Asked, checked_before, patient_text, serving

from ident_service.cli import main
from ident_service.daemon.jobs.requests import Run
from ident_service.motion.command_channel import ControlFile
from ident_service.registry import jobs as rows
from ident_service.registry.database import FILE, audit_log
from ident_service.registry.state_folder import arm_fault_store, control_path

FAR = "203.0.113.9"
SOON = 8.0  # s: less than the ten that a write waits for another process
MAINTENANCE = ("/api/v1/arms/planar2/maintenance", {"what": "belt"})


@contextmanager
def locked(state: Path) -> Iterator[None]:
    """Keep a write transaction open on another connection, as a backup does."""
    other = sqlite3.connect(state / FILE, isolation_level=None)
    try:
        other.execute("BEGIN IMMEDIATE")
        yield
        other.execute("ROLLBACK")
    finally:
        other.close()


def test_a_stop_and_what_is_read_do_not_wait_for_who_writes(daemon: Asked, state: Path, viewer: str) -> None:
    owner = dict(daemon.headers)
    with ControlFile.take(control_path(state, "planar2"), None) as mover, locked(state):
        began = time.monotonic()
        # Nobody known, a token, a session that counts no more, and a token from afar that this process has never seen.
        for headers, address in (
            ({}, "127.0.0.1"),
            (owner, "127.0.0.1"),
            ({"Cookie": "ident_session=old"}, "127.0.0.1"),
            ({"Authorization": f"Bearer {viewer}"}, FAR),
        ):
            daemon.headers = dict(headers)
            mover._memory[16] = 0  # the arm begins anew
            assert daemon.post("/api/v1/stop", address=address).json() == {"arms": ["planar2"], "jobs": []}
            assert mover.stop
        daemon.headers = owner
        assert daemon.get("/api/v1/arms").status_code == 200
        assert time.monotonic() - began < SOON
    assert daemon.service.engine.audit.flush(10.0)
    lines = [line for line in audit_log(daemon.service.db) if line["what"] == "stop"]
    assert [line["who"] for line in lines] == ["looks", "anybody", "owner", "anybody"]
    # Each has the time of the act, not that of its entry.
    assert all(line["detail"] == {"reached": ["planar2"], "jobs": []} for line in lines)
    assert max(line["at"] for line in lines) - min(line["at"] for line in lines) < SOON


def test_a_stop_of_no_arm_is_reported_and_no_look_up_refuses_one(
    daemon: Asked, state: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = daemon.post("/api/v1/arms/none/stop")
    assert (answer.status_code, answer.json()["error"]["kind"]) == (404, "UnknownId")
    assert daemon.post("/api/v1/arms/planar2/stop").json() == {"arms": [], "jobs": []}
    # An arm that the registry does not know, but a process at a terminal moves.
    with ControlFile.take(control_path(state, "own"), None) as mover:
        assert daemon.post("/api/v1/arms/own/stop").json() == {"arms": ["own"], "jobs": []}
        assert mover.stop
    assert daemon.post("/api/v1/arms/own/stop").json() == {"arms": [], "jobs": []}
    # A registry that cannot be read, or not soon, refuses nobody.
    answering = threading.Event()
    for names in (lambda _: answering.wait(30.0), lambda db: db.rows("SELECT nothing")):
        monkeypatch.setattr("ident_service.daemon.routes.jobs.arm_names", names)
        began = time.monotonic()
        assert daemon.post("/api/v1/arms/none/stop").status_code == 200
        assert time.monotonic() - began < SOON
    answering.set()


@pytest.mark.slow
def test_a_stop_needs_no_thread_that_others_may_keep(daemon: Asked, state: Path) -> None:
    with (
        ControlFile.take(control_path(state, "planar2"), None) as mover,
        ThreadPoolExecutor(60) as clients,
    ):
        with locked(state):
            waiting = [clients.submit(daemon.post, *MAINTENANCE) for _ in range(60)]
            time.sleep(0.5)
            assert not any(one.done() for one in waiting)
            began = time.monotonic()
            stops = [threading.Thread(target=daemon.post, args=("/api/v1/stop",)) for _ in range(10)]
            for one in stops:
                one.start()
            for one in stops:
                one.join(SOON)
            assert mover.stop
            assert not any(one.is_alive() for one in stops)
            assert time.monotonic() - began < SOON
            assert not any(one.done() for one in waiting)
        assert {one.result().status_code for one in waiting} == {201}


def test_a_lease_is_renewed_by_memory_and_a_stop_reaches_what_waits(state: Path) -> None:
    with serving(state, lease_factor=1.0) as daemon, ThreadPoolExecutor(1) as thread:
        engine = daemon.service.engine
        daemon.get("/api/v1/arms/planar2")  # whose description is known from now on
        with locked(state):
            # The registry does not take the job yet; a stop finds it all the same.
            made = thread.submit(engine.create, Run(kind="run", arm="planar2"), "owner")
            until = time.monotonic() + SOON
            while not engine.live and time.monotonic() < until:
                time.sleep(0.01)
            (job,) = engine.live._jobs
            assert daemon.post(f"/api/v1/jobs/{job}/lease").json() == {"job": job, "seconds": 2.0}
            running = {"state": "running", "started": time.time(), "id": job, "kind": "run", "arm": "planar2"}
            (state / "jobs" / job / "log").write_text("planar2: motion of 60 s\n")
            assert (before := engine.progress(running)) is not None
            assert before.remaining == pytest.approx(60.0, abs=5.0)
            assert daemon.post("/api/v1/arms/planar2/stop").json() == {"arms": [], "jobs": [job]}
            # It ends when the arm rests, which may take longer than the motion.
            assert engine.progress(running) == replace(before, fraction=None, remaining=None)
            assert not made.done()
            other = sqlite3.connect(state / FILE)
            assert other.execute("SELECT COUNT(*) FROM jobs").fetchone() == (0,)
            other.close()
        assert made.result()["id"] == job
        assert daemon.follow(job)["detail"] == "owner asked for a stop"


@pytest.mark.slow
def test_a_motion_outlives_a_registry_that_is_kept_and_hears_its_stop(state: Path) -> None:
    checked_before(state, patient_text())
    with serving(state, lease_factor=1.0) as daemon:
        daemon.post("/api/v1/arms", {"description": patient_text()})
        job = daemon.begin({"kind": "run", "arm": "quick"}, confirmed=True)["id"]
        path = f"/api/v1/jobs/{job}"
        while daemon.get(path).json()["state"] != "running":
            daemon.post(f"{path}/lease")
            time.sleep(0.1)
        with locked(state):
            until = time.monotonic() + 4.0  # two leases
            while time.monotonic() < until:
                assert daemon.post(f"{path}/lease").status_code == 200
                time.sleep(0.2)
            assert daemon.get(path).json()["state"] == "running"
            assert daemon.post("/api/v1/stop").json()["jobs"] == [job]
            refused = daemon.post(f"{path}/lease")
            assert refused.status_code == 409
            assert f"the job {job} has no lease to renew: it is ending (owner asked for a stop)" in refused.text
        ended = daemon.follow(job)
        assert ended["state"] == "cancelled"
        assert ended["detail"].startswith("owner asked for a stop")


def test_a_stop_at_a_terminal_reaches_what_waits_in_the_daemon(
    daemon: Asked, state: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with ControlFile.take(control_path(state, "planar2"), None):
        # The arm is in use, and something else has its place in the queue: neither of them begins.
        daemon.service.engine.live.may_begin = lambda live, most_computing: False  # type: ignore[method-assign]
        jobs = [daemon.begin({"kind": "home", "arm": arm}, confirmed=True)["id"] for arm in ("planar2", "sixaxis")]
        assert main(["stop", "planar2", "--state", str(state)]) == 0
        assert daemon.follow(jobs[0])["detail"] == "a stop was requested"
        assert rows.known_job(daemon.service.db, jobs[1])["state"] == "queued"
        assert main(["stop", "--state", str(state)]) == 0
    capsys.readouterr()


@pytest.mark.slow
def test_acts_at_a_terminal_are_entered_under_a_name(
    daemon: Asked, state: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with ControlFile.take(control_path(state, "planar2"), None) as mover:
        for words in (["pause", "planar2"], ["resume", "planar2"], ["finish", "planar2"], ["stop", "planar2"]):
            assert main([*words, "--state", str(state)]) == 0
        with locked(state):  # a stop is done first, and said to be
            mover._memory[16] = 0
            assert main(["stop", "--state", str(state)]) == 0
            assert mover.stop
    assert "its line in the audit trail is written later" in capsys.readouterr().err
    assert main(["stop", "--state", str(state)]) == 0  # nobody moves: what was wanted is so
    assert "no arm is moving" in capsys.readouterr().out
    arm_fault_store(state, "planar2").latch("late_cycle", "a cycle was late")
    assert main(["ack", "planar2", "late_cycle", "--by", "ann", "--state", str(state)]) == 0
    assert main(["token", "add", "bob", "--role", "viewer", "--by", "ann", "--state", str(state)]) == 0
    assert main(["token", "revoke", "bob", "--state", str(state)]) == 0
    lines = [line for line in daemon.get("/api/v1/audit").json() if line["who"].startswith("terminal")]
    here = f"terminal:{pwd.getpwuid(os.getuid()).pw_name}"
    assert [(line["who"], line["what"], line["about"]) for line in reversed(lines)] == [
        *((here, what, "planar2") for what in ("pause", "resume", "finish", "stop")),
        *((here, "stop", "all arms"),) * 2,  # that which the registry did not take then, too
        ("terminal:ann", "fault acknowledged", "planar2"),
        ("terminal:ann", "token added", "bob"),
        (here, "token revoked", "bob"),
    ]
