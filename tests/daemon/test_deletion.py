"""Runs, motions and arms are deleted when nothing uses them; what refers to them is named first."""

from __future__ import annotations

import json
import shutil
import sqlite3
from pathlib import Path
from typing import Any

import pytest
from daemon.conftest import Asked, known_arm, quick_text, serving

from ident_service.cli import main
from ident_service.config.load import load_arm
from ident_service.daemon.web.arm_pages import commissioning_workflow
from ident_service.motion.command_channel import ControlFile
from ident_service.operations import deletion
from ident_service.operations.acceptance import accept
from ident_service.operations.maintenance_schedule import DueRule, add_schedule, known_schedule
from ident_service.registry import jobs
from ident_service.registry.database import Database, audit_log
from ident_service.registry.runs import index_run, operating_seconds
from ident_service.registry.state_folder import arm_fault_store, control_path

FIRST, SECOND, THIRD = (f"2026010{day}T000000Z-quick" for day in (1, 2, 3))


@pytest.fixture
def filled(daemon: Asked, commissioned: Path) -> Asked:
    """A service with the arm `quick`, two runs and a motion of it."""
    db, state = daemon.service.db, daemon.service.state
    known_arm(daemon, quick_text())
    for run in (FIRST, SECOND):
        shutil.copytree(commissioned, state / "runs" / run)
        index_run(db, state, run)
    return daemon


def delete(daemon: Asked, path: str) -> tuple[int, Any]:
    answer = daemon.ask("DELETE", f"/api/v1/{path}")
    return answer.status_code, answer.json()


def uploaded_motion(daemon: Asked, commissioned: Path) -> str:
    motion = (commissioned / "identification.excitation.json").read_text()
    answer = daemon.post("/api/v1/motions", {"arm": "quick", "motion": motion})
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


def test_a_run_that_nothing_refers_to_goes_with_its_files(filled: Asked) -> None:
    state = filled.service.state
    assert delete(filled, f"runs/{FIRST}") == (200, {"deleted": FIRST, "dependents": []})
    assert filled.get(f"/api/v1/runs/{FIRST}").status_code == 404
    assert [path.name for path in (state / "runs").iterdir()] == [SECOND]
    assert delete(filled, f"runs/{FIRST}")[0] == 404
    assert (audit_log(filled.service.db)[0]["what"], audit_log(filled.service.db)[0]["about"]) == ("run deleted", FIRST)


def test_what_refers_to_a_run_is_named_and_kept(filled: Asked) -> None:
    db, state = filled.service.db, filled.service.state
    accept(db, state, state / "runs" / FIRST, "good", "test")
    status, answer = delete(filled, f"runs/{FIRST}")
    wanted = [{"kind": "acceptance", "id": "1", "becomes": "kept"}]
    assert (status, answer["error"]["kind"], answer["error"]["dependents"]) == (409, "InUse", wanted)
    assert answer["error"]["message"].endswith("acceptance 1; `?anyway=true` deletes it all the same")
    assert filled.get(f"/api/v1/runs/{FIRST}").status_code == 200
    assert delete(filled, f"runs/{FIRST}?anyway=true") == (200, {"deleted": FIRST, "dependents": wanted})
    assert (state / "arms" / "quick" / "current" / "parameters.json").is_file()
    assert filled.get("/api/v1/arms/quick").json()["accepted"]["run"] == FIRST


def test_operating_hours_still_count_what_is_deleted(filled: Asked) -> None:
    db = filled.service.db
    db.write("UPDATE runs SET seconds = 3600.0")
    number = add_schedule(db, "quick", DueRule(hours=1.5), "test", 0.0)["id"]
    db.write("UPDATE schedules SET counted = 3600.0")
    assert operating_seconds(db, "quick") - known_schedule(db, number)["counted"] == 3600.0
    assert delete(filled, f"runs/{SECOND}")[0] == 200
    assert operating_seconds(db, "quick") - known_schedule(db, number)["counted"] == 3600.0


def test_the_page_of_the_arm_forgets_what_is_deleted(filled: Asked) -> None:
    db = filled.service.db
    for number, (kind, run) in enumerate((("run", FIRST), ("identify", SECOND))):
        asked = {"recordings": [{"run": FIRST}]} if kind == "identify" else {}
        jobs.add_job(db, f"j{number}", kind, "quick", asked, [], "test", motion=False, run_id=run)
        assert jobs.mark_ended(db, f"j{number}", "done", "")
    arm = load_arm(
        filled.service.state / str(db.rows("SELECT folder FROM arms WHERE name = 'quick'")[0]["folder"]) / "arm.yaml"
    )
    workflow = commissioning_workflow(db, filled.service.state, arm)
    assert (workflow.run, workflow.identified) == (FIRST, SECOND)
    assert [one["kind"] for one in delete(filled, f"runs/{FIRST}")[1]["error"]["dependents"]] == ["identification"]
    assert delete(filled, f"runs/{SECOND}")[0] == 200
    workflow = commissioning_workflow(db, filled.service.state, arm)
    assert (workflow.run, workflow.identified) == (FIRST, None)
    assert delete(filled, f"runs/{FIRST}?anyway=true")[0] == 200
    assert commissioning_workflow(db, filled.service.state, arm).run is None


def test_what_is_in_use_is_not_deleted(filled: Asked, monkeypatch: pytest.MonkeyPatch) -> None:
    state = filled.service.state
    with monkeypatch.context() as patched:
        patched.setattr(filled.service.engine, "_look", lambda: None)  # the job waits
        job = filled.begin({"kind": "report", "run": FIRST})["id"]
        for path in (f"runs/{FIRST}", f"runs/{FIRST}?anyway=true", "arms/quick?anyway=true"):
            status, answer = delete(filled, path)
            assert (status, answer["error"]["dependents"], job in answer["error"]["message"]) == (409, [], True)
        assert delete(filled, f"runs/{SECOND}")[0] == 200
        assert filled.post(f"/api/v1/jobs/{job}/cancel").status_code == 200
    filled.follow(job)
    arm_fault_store(state, "quick").latch("overspeed", "too fast")
    status, answer = delete(filled, "arms/quick?anyway=true")
    assert (status, "overspeed" in answer["error"]["message"]) == (409, True)
    arm_fault_store(state, "quick").acknowledge("overspeed")
    with ControlFile.take(control_path(state, "quick"), None):
        status, answer = delete(filled, "arms/quick?anyway=true")
        assert (status, "being moved" in answer["error"]["message"]) == (409, True)
    assert delete(filled, "arms/quick?anyway=true")[0] == 200


def test_an_arm_takes_with_it_what_is_its_own(filled: Asked, commissioned: Path) -> None:
    db, state = filled.service.db, filled.service.state
    motion = uploaded_motion(filled, commissioned)
    accept(db, state, state / "runs" / FIRST, "good", "test")
    add_schedule(db, "quick", DueRule(hours=1.5), "test", 0.0, motion)
    kinds = [("run", FIRST), ("run", SECOND), ("motion", motion), ("schedule", "1"), ("acceptance", "1")]
    status, answer = delete(filled, "arms/quick")
    assert (status, [(one["kind"], one["id"]) for one in answer["error"]["dependents"]]) == (409, kinds)
    assert delete(filled, "arms/quick?anyway=true")[0] == 200
    for path in ("arms/quick", f"runs/{FIRST}", f"motions/{motion}", "schedules/1"):
        assert filled.get(f"/api/v1/{path}").status_code in (404, 405), path
    assert db.rows("SELECT * FROM schedules") == db.rows("SELECT * FROM acceptances") == []
    left = [path for name in ("runs", "motions", "arms", "descriptions") for path in (state / name).iterdir()]
    assert left == []
    # An arm of that name begins anew.
    assert filled.post("/api/v1/arms", {"description": quick_text()}).status_code == 201
    assert filled.get("/api/v1/arms/quick").json()["accepted"] is None


def test_a_run_that_comes_while_its_arm_is_deleted_keeps_the_arm(
    filled: Asked, commissioned: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    db, state = filled.service.db, filled.service.state
    real = deletion.forget_run

    def while_another_comes(*words: Any) -> None:
        real(*words)
        if not (state / "runs" / THIRD).exists():
            shutil.copytree(commissioned, state / "runs" / THIRD)
            index_run(db, state, THIRD)

    with monkeypatch.context() as patched:
        patched.setattr(deletion, "forget_run", while_another_comes)
        status, answer = delete(filled, "arms/quick?anyway=true")
    assert (status, "came meanwhile" in answer["error"]["message"]) == (409, True)
    assert filled.get("/api/v1/arms/quick").status_code == 200
    assert [run["id"] for run in filled.get("/api/v1/runs").json()] == [THIRD]
    assert delete(filled, "arms/quick?anyway=true")[0] == 200


def test_shipped_arms_stay(filled: Asked) -> None:
    assert delete(filled, "arms/planar2")[0] == 400
    text = quick_text("planar2")
    assert filled.post("/api/v1/arms", {"description": text, "replace": True}).json()["source"] == "uploaded"
    assert delete(filled, "arms/planar2")[0] == 200
    assert filled.get("/api/v1/arms/planar2").json()["source"] == "shipped"


def test_a_motion_takes_its_schedules_with_it(filled: Asked, commissioned: Path) -> None:
    motion = uploaded_motion(filled, commissioned)
    add_schedule(filled.service.db, "quick", DueRule(hours=1.5), "test", 0.0, motion)
    status, answer = delete(filled, f"motions/{motion}")
    wanted = [{"kind": "schedule", "id": "1", "becomes": "deleted"}]
    assert (status, answer["error"]["dependents"]) == (409, wanted)
    assert delete(filled, f"motions/{motion}?anyway=true")[0] == 200
    assert filled.get("/api/v1/schedules").json() == []


def test_viewers_delete_nothing(filled: Asked, viewer: str) -> None:
    filled.as_token(viewer)
    assert [delete(filled, path)[0] for path in (f"runs/{FIRST}", "motions/m", "arms/quick")] == [403, 403, 403]


def test_a_deletion_that_broke_off_is_completed(state: Path, commissioned: Path) -> None:
    for run in (FIRST, SECOND):
        shutil.copytree(commissioned, state / "runs" / run)
    with Database(state) as db:
        for run in (FIRST, SECOND):
            index_run(db, state, run)
    state.chmod(0o700)
    (state / "runs" / FIRST).rename(state / "runs" / f".{FIRST}.deleted")  # and then it was killed
    with serving(state) as daemon:
        assert [path.name for path in (state / "runs").iterdir()] == [SECOND]
        assert delete(daemon, f"runs/{FIRST}")[0] == 200
        assert [run["id"] for run in daemon.get("/api/v1/runs").json()] == [SECOND]


def test_a_deletion_that_the_registry_has_no_room_for_changes_nothing(
    filled: Asked, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = filled.service.state
    known_arm(filled, quick_text("other"))
    described = [path.name for path in (state / "descriptions").iterdir()]
    (state / "arms" / "other").mkdir(parents=True)

    def full(*_: object, **__: object) -> None:
        error = sqlite3.OperationalError("database or disk is full")
        error.sqlite_errorcode = sqlite3.SQLITE_FULL
        raise error

    with monkeypatch.context() as patched:
        patched.setattr(deletion, "note", full)
        for path in (f"runs/{FIRST}?anyway=true", "arms/other"):
            status, answer = delete(filled, path)
            assert (status, answer["error"]["kind"]) == (507, "DiskFull")
    assert (state / "runs" / FIRST / "manifest.json").is_file()
    assert (state / "arms" / "other").is_dir()
    assert [path.name for path in (state / "descriptions").iterdir()] == described
    assert filled.get(f"/api/v1/runs/{FIRST}").status_code == 200
    assert delete(filled, f"runs/{FIRST}?anyway=true")[0] == 200
    assert not list((state / "runs").glob(f"*{FIRST}*"))


def test_the_command_deletes_and_names(state: Path, commissioned: Path, capsys: pytest.CaptureFixture[str]) -> None:
    state.mkdir(mode=0o700, parents=True)
    shutil.copytree(commissioned, state / "runs" / FIRST)
    with Database(state) as db:
        index_run(db, state, FIRST)
        accept(db, state, state / "runs" / FIRST, "good", "test")
    words = ["delete", "run", FIRST, "--state", str(state)]
    assert main(words) == 2
    said = f"the run {FIRST} is referred to by acceptance 1; to delete it all the same: "
    assert capsys.readouterr().err == f"ident: {said}`ident runs delete {FIRST} --anyway`\n"
    assert main([*words, "--anyway", "--json", "--by", "ann"]) == 0
    assert json.loads(capsys.readouterr().out)["dependents"] == [{"kind": "acceptance", "id": "1", "becomes": "kept"}]
    with Database(state) as db:
        assert audit_log(db)[0]["who"] == "terminal:ann"
    assert main(words) == 2
