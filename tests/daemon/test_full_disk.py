"""A registry that is kept, or without room, for a while: the service says so, and goes on when that is over."""

from __future__ import annotations

import errno
import logging
import os
import sqlite3
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import httpx
import pytest
from daemon.conftest import Asked, checked_before, patient_text, serving
from daemon.served import daemon_process, listening

from ident_service.cli import main
from ident_service.client import IdentClient
from ident_service.errors import ArmError, ArmFault, UsageError
from ident_service.motion.command_channel import ControlFile, is_control_file_in_use
from ident_service.operations.moving_arms import is_held
from ident_service.registry import jobs as rows
from ident_service.registry.database import FILE, Database, audit_log, note
from ident_service.registry.state_folder import control_path


@pytest.mark.slow
def test_the_end_of_a_job_waits_for_room(
    daemon: Asked, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    ended, full = rows.mark_ended, [True]

    def without_room(*arguments: Any) -> bool:
        if full[0]:
            raise sqlite3.OperationalError("database or disk is full")
        return ended(*arguments)

    monkeypatch.setattr(rows, "mark_ended", without_room)
    monkeypatch.setattr("ident_service.daemon.jobs.queue._AGAIN", 0.05)
    assert daemon.get("/healthz").status_code == 200
    job = daemon.begin({"kind": "base", "arm": "planar2"})
    until = time.monotonic() + 60.0
    while daemon.get("/healthz").status_code == 200 and time.monotonic() < until:
        time.sleep(0.05)
    assert daemon.get("/healthz").status_code == 503
    seen = daemon.get(f"/api/v1/jobs/{job['id']}").json()
    assert (seen["state"], seen["exit_code"], seen["progress"]) == ("running", 0, None)
    assert seen["detail"] == "it has ended (done), but that cannot be entered: database or disk is full"
    full[0] = False
    assert daemon.follow(job["id"])["state"] == "done"
    while daemon.get("/healthz").status_code != 200 and time.monotonic() < until:
        time.sleep(0.05)
    assert daemon.get("/healthz").status_code == 200
    # The end of the service does not wait for room: the next one enters what became of the job.
    full[0] = True
    caplog.clear()
    daemon.begin({"kind": "base", "arm": "planar2"})
    wait_for(lambda: daemon.get("/healthz").status_code == 503)
    time.sleep(0.5)
    began = time.monotonic()
    daemon.service.engine.close()
    assert time.monotonic() - began < 20.0
    assert [one.getMessage() for one in caplog.records if "entered yet" in one.getMessage()] == [
        "the end of a job cannot be entered yet: database or disk is full"
    ]


@pytest.mark.slow
def test_who_waits_for_a_job_is_told_that_its_end_cannot_be_entered(
    state: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ended = rows.mark_ended

    def without_room(*arguments: Any) -> bool:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("ident_service.client.client.UNENTERED", 0.1)
    monkeypatch.setattr("ident_service.daemon.jobs.queue._AGAIN", 0.05)
    with listening(state) as reached, IdentClient(reached.url, reached.token) as client:
        monkeypatch.setattr(rows, "mark_ended", without_room)
        assert main(["base-parameters", "planar2", "--server", client.url]) == 1
        said = capsys.readouterr()
        remedy = "it has ended (done), but that cannot be entered: the disk of the daemon's state folder is full; free"
        assert said.out.count(remedy) == 2  # while it waits, and in its answer
        (job,) = client.jobs()
        assert job.unentered
        assert client.wait(job.id).detail.startswith(remedy)
        # A fault that has stopped an arm keeps its exit code.
        (live,) = reached.service.engine.live.entered()
        live.exit_code = 4
        assert main(["jobs", "watch", job.id, "--server", client.url]) == 4
        monkeypatch.setattr(rows, "mark_ended", ended)
        wait_for(lambda: not client.job(job.id).live)
        assert not client.job(job.id).unentered


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


@pytest.mark.slow
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
        with pytest.raises(sqlite3.OperationalError, match="too long") as caught:
            db.write("INSERT INTO a VALUES (1)")
        assert caught.value.sqlite_errorcode == sqlite3.SQLITE_BUSY
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


@pytest.fixture
def small(tmp_path: Path) -> Iterator[Path]:
    """Mount a disk of 16 megabytes."""
    folder = tmp_path / "small"
    folder.mkdir(mode=0o700)
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=16m,mode=700", "none", str(folder)], check=False)
    if mounted.returncode != 0:
        pytest.skip("a disk can be mounted here by nobody")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def fill(folder: Path) -> Path:
    """Fill a disk to its last byte."""
    path = folder / "filling"
    with suppress(OSError), path.open("wb", buffering=0) as stream:
        while True:
            stream.write(bytes(4096))
    return path


_TOKEN = ("token", "add", "bob", "--role", "viewer")
_WRITING = (_TOKEN, ("prune", "--keep", "1"), ("schedule", "add", "planar2", "--maintenance"), ("token", "list"))


def test_a_verb_at_a_full_disk_says_so(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    state = small / "state"
    assert main([*_TOKEN[:2], "ann", *_TOKEN[3:], "--state", str(state)]) == 0
    with ControlFile.take(control_path(state, "planar2"), None) as mover:
        filling = fill(small)
        assert main(["stop", "planar2", "--state", str(state)]) == 0
        assert mover.stop
        assert "not entered in the audit trail" in capsys.readouterr().err
    for words in (*_WRITING[:3], ("check", "planar2", "--confirm", "planar2")):
        capsys.readouterr()
        assert main([*words, "--state", str(state)]) == 1, words
        said = capsys.readouterr().err
        assert "full" in said or "No space left" in said
        assert "damaged" not in said
        assert "Traceback" not in said
    filling.unlink()
    assert main([*_TOKEN, "--state", str(state)]) == 0


def test_a_verb_at_a_registry_that_is_kept_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    state = tmp_path / "state"
    assert main([*_TOKEN[:2], "ann", *_TOKEN[3:], "--state", str(state)]) == 0
    monkeypatch.setitem(Database.__init__.__kwdefaults__, "busy", 0.05)
    with closing(sqlite3.connect(state / FILE)) as other:
        other.execute("BEGIN EXCLUSIVE")
        for words in _WRITING:
            capsys.readouterr()
            assert main([*words, "--state", str(state)]) == 1, words
            said = capsys.readouterr().err
            assert "another process has locked the registry" in said
            assert "damaged" not in said
    assert main([*_TOKEN, "--state", str(state)]) == 0


def test_a_registry_is_damaged_where_its_bytes_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / FILE).write_bytes(b"not a database" * 1000)
    assert main([*_TOKEN, "--state", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert "is damaged" in said
    assert "ident restore FILE --replace" in said


@pytest.mark.slow
def test_a_stop_that_the_registry_does_not_take_is_entered_later(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ident_service.cli.archive_commands._PATIENCE", 0.05)
    state = tmp_path / "state"
    with serving(state) as daemon, closing(sqlite3.connect(state / FILE)) as other:
        other.execute("BEGIN IMMEDIATE")
        before = time.time()
        assert main(["stop", "--state", str(state)]) == 0
        after = time.time()
        assert "is written later" in capsys.readouterr().err
        assert "stop" not in [line["what"] for line in audit_log(daemon.service.db)]
        other.execute("ROLLBACK")
        until = time.monotonic() + 30.0
        while not (found := [line for line in audit_log(daemon.service.db) if line["what"] == "stop"]):
            assert time.monotonic() < until
            time.sleep(0.05)
    assert len(found) == 1
    assert before <= found[0]["at"] <= after
    assert found[0]["who"].startswith("terminal:")


def held_text() -> str:
    """The arm `quick` without brakes, with motions that outlast a test."""
    text = patient_text().replace("control: {rate: 125}", "control: {rate: 125, after_stop: hold}")
    assert "hold" in text
    return text


def log_of(state: Path) -> str:
    """Return the log of the daemon."""
    return (state.parent / "serve.log").read_text()


def wait_for(found: Callable[[], Any]) -> Any:
    until = time.monotonic() + 60.0
    while not (value := found()):
        assert time.monotonic() < until
        time.sleep(0.05)
    return value


@pytest.mark.slow
def test_a_disk_that_fills_while_an_arm_without_brakes_moves_is_reported_while_it_is_held(small: Path) -> None:
    state = small  # the log of the daemon lies beside it, on another disk
    checked_before(state, held_text())
    with daemon_process(state) as (_, client):
        client.add_arm(held_text())
        filled = list[Path]()
        # Room that the registry's log of writes has already, and would use again, is taken from it.
        reader = sqlite3.connect(state / FILE)
        with (  # noqa: PT012 - it is raised at the end of the block of the motion
            pytest.raises(ArmError, match="held until a person confirms that it is supported"),
            client.arm("quick").run(confirm="quick") as job,
        ):
            for _ in job.live():
                if not filled:
                    reader.execute("PRAGMA wal_checkpoint(TRUNCATE)")
                    reader.execute("BEGIN")
                    reader.execute("SELECT count(*) FROM jobs").fetchone()
                    filled.append(fill(small))
        assert job.ended.held
        assert client.job(job.id).state == "running"
        assert is_held(state, "quick")
        # The disk is still full when the motion ends: its end waits for room, and is told of once.
        client.arm("quick").supported(confirm="quick")
        wait_for(lambda: not is_control_file_in_use(control_path(state, "quick")))
        wait_for(lambda: "cannot be entered yet" in log_of(state))
        time.sleep(2.5)
        assert log_of(state).count("cannot be entered yet") == 1
        assert client.job(job.id).state == "running"
        assert client.job(job.id).detail.startswith("it has ended (faulted: ")
        assert "is full; free disk space there" in client.job(job.id).detail
        assert client.job(job.id).document["exit_code"] == 4
        reader.close()
        filled[0].unlink()
        wait_for(lambda: not client.job(job.id).live)
        assert client.job(job.id).state == "faulted"
        assert [fault["code"] for fault in client.arm("quick").faults()] == ["recorder_behind"]
    for text in (log_of(state), (state / "jobs" / job.id / "log").read_text()):
        assert "Traceback" not in text
        assert "OSError" not in text


@pytest.mark.campaign
@pytest.mark.slow
def test_a_fault_of_an_arm_that_is_held_is_reported_before_it_is_supported(
    state: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    late = "driver:\n  faults: [{kind: late_cycle, at: 100, duration: 1, size: 0.006}]\n"
    text = held_text().replace("driver:\n", late, 1)
    checked_before(state, text)
    with daemon_process(state) as (_, client):
        client.add_arm(text)
        with (
            pytest.raises(ArmFault, match="held until a person confirms") as caught,
            client.arm("quick").run(confirm="quick"),
        ):
            pass
        assert [fault["code"] for fault in client.arm("quick").faults()] == [caught.value.code]
        # It is acknowledged once the arm is let down; before, it would be latched again.
        with pytest.raises(UsageError, match="ident supported"):
            client.arm("quick").acknowledge(caught.value.code)
        job = next(client.jobs())
        assert main(["supported", "quick", "--confirm", "quick", "--state", str(state)]) == 0
        wait_for(lambda: not client.job(job.id).live)
        client.arm("quick").acknowledge(caught.value.code)
        assert client.arm("quick").faults() == []
