"""The commissioning workflow through the API, on the small simulated arm in virtual time, with real processes."""

from __future__ import annotations

import asyncio
import hashlib
import json
import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
from daemon.conftest import Asked, checked_before, known_arm, patient_text, quick_text, serving
from daemon.verbs_bench import with_run

from ident_service.daemon.dependencies import Service
from ident_service.daemon.jobs.child_process import JobProcess
from ident_service.daemon.jobs.commands import Command
from ident_service.daemon.jobs.outcome import printed_samples
from ident_service.daemon.jobs.queue import LiveJob, LiveJobs, Progress, progress
from ident_service.daemon.jobs.requests import Run
from ident_service.daemon.live_stream import live_events
from ident_service.daemon.routes.jobs import job_answer_document
from ident_service.motion.command_channel import ControlFile, is_control_file_in_use
from ident_service.registry import jobs as rows
from ident_service.registry.database import audit_log
from ident_service.registry.state_folder import control_path

pytestmark = pytest.mark.slow
ARM = "quick"


@pytest.fixture
def arm(daemon: Asked) -> str:
    """The small arm, known."""
    return known_arm(daemon, quick_text(ARM))


def run_of(daemon: Asked, kind: str = "simulate") -> str:
    """A job that makes a run, done."""
    ended = daemon.follow(daemon.begin({"kind": kind, "arm": ARM})["id"])
    assert ended["state"] == "done", ended
    return str(ended["run"])


@pytest.fixture
def patient(daemon: Asked) -> str:
    """The same arm with a motion of twenty minutes of its own time, and a ticket for it."""
    checked_before(daemon.service.state, patient_text(ARM))
    return known_arm(daemon, patient_text(ARM))


@pytest.mark.parametrize(
    "asked",
    [
        "by a person who paused",
        *(pytest.param(one, marks=pytest.mark.campaign) for one in ("by a person", "by its target")),
    ],
)
def test_a_run_ends_early(daemon: Asked, patient: str, state: Path, asked: str) -> None:
    until = {"until": {"share": 0.3, "parameters": ["fv1", "fc1"]}} if asked == "by its target" else {}
    job = daemon.begin({"kind": "run", "arm": ARM, **until}, confirmed=True)["id"]
    if not until:
        daemon.follow(job, lease=True, until=lambda seen: "exciting" in str(seen["progress"]))
        words = ["pause", "finish"] if "paused" in asked else ["finish"]
        for word in words:
            answer = daemon.post(f"/api/v1/arms/{ARM}/{word}")
            assert (answer.status_code, answer.json()) == (200, {"arm": ARM, "asked": word, "reached": True})
        assert daemon.service.engine.audit.flush(10.0)
        assert [line["what"] for line in audit_log(daemon.service.db, max_lines=len(words))] == words[::-1]
    ended = daemon.follow(job, lease=True)
    assert ended["state"] == "done", ended
    report = daemon.get(f"/api/v1/jobs/{job}/result").json()["answer"]["report"]
    assert (report["state"], report["finished"]) == ("done", "early")
    assert 0.0 < report["motion_seconds"] < 1200.0
    if until:
        assert report["until"]["parameters"] == ["fv1", "fc1"]
        assert report["until"]["reached"]["share"] <= 0.3
        assert report["until"]["reached"]["seconds"] >= 5.0
    assert not is_control_file_in_use(control_path(state, ARM))


def test_only_operators_finish_and_nobody_is_reached_where_nothing_moves(daemon: Asked, arm: str, viewer: str) -> None:
    for what, body in (("finish", None), ("supported", {"confirm": ARM})):
        answer = daemon.post(f"/api/v1/arms/{ARM}/{what}", body)
        assert (answer.status_code, answer.json()["reached"]) == (200, False)
    for until in ({"share": 1.0}, {"share": 0}, {"share": 0.1, "parameters": [""]}, {"share": 0.1, "more": 1}):
        body = {"job": {"kind": "run", "arm": ARM, "until": until}}
        assert daemon.post("/api/v1/jobs", body).status_code == 422
    daemon.as_token(viewer)
    assert daemon.post(f"/api/v1/arms/{ARM}/finish").status_code == 403
    assert daemon.post(f"/api/v1/arms/{ARM}/supported", {"confirm": ARM}).status_code == 403


def test_a_held_arm_is_let_down_by_its_typed_name_only(daemon: Asked, arm: str, state: Path) -> None:
    with ControlFile.take(control_path(state, ARM), None) as holder:
        early = daemon.post(f"/api/v1/arms/{ARM}/supported", {"confirm": ARM})  # it moves
        assert (early.json()["reached"], holder.supported) == (False, False)
        holder.announce_hold()
        assert daemon.post(f"/api/v1/arms/{ARM}/supported").status_code == 422
        refused = daemon.post(f"/api/v1/arms/{ARM}/supported", {"confirm": "another"})
        assert (refused.status_code, holder.supported) == (409, False)
        assert "typed by a person" in refused.json()["error"]["message"]
        answer = daemon.post(f"/api/v1/arms/{ARM}/supported", {"confirm": ARM})
        assert (answer.status_code, answer.json()["reached"], holder.supported) == (200, True, True)


def test_the_next_command_is_no_phase_of_a_job() -> None:
    """Between the end of its command and its own, a run was at `next: ident recover`."""
    assert progress("approaching\nexciting\nnext: ident recover planar2\n", 1.0, None).phase == "exciting"
    assert progress("", 1.0, None).phase == "starting"


@pytest.mark.parametrize("held", [True, False])
def test_a_job_whose_arm_is_held_shows_no_progress(state: Path, held: bool) -> None:
    """It ends when a person says so; what ends by itself says when."""
    live = SimpleNamespace(unentered=lambda _: ("", None))
    engine = SimpleNamespace(progress=lambda _: Progress("exciting", 0.99, 0.0), live=live)
    numbers = {"number": 1, "motion": 1, "created": 1.0, "started": 2.0, "ended": None, "exit_code": None}
    words = {"id": "j", "kind": "run", "arm": ARM, "state": "running", "run": "r", "created_by": "ann", "detail": ""}
    row = {**numbers, **words, "request": {}, "words": []}
    with ControlFile.take(control_path(state, ARM), None) as holder:
        if held:
            holder.announce_hold()
        answer = job_answer_document(cast(Service, SimpleNamespace(state=state, engine=engine)), row)
    assert answer.held == held
    assert answer.progress is not None
    assert (answer.progress.fraction, answer.progress.remaining) == ((None, None) if held else (0.99, 0.0))


def test_from_an_upload_to_accepted_parameters_and_back(daemon: Asked, state: Path, commissioned: Path) -> None:
    answer = daemon.post("/api/v1/arms", {"description": quick_text(ARM)})
    assert answer.status_code == 201, answer.text
    assert answer.json()["name"] == ARM
    runs = [run_of(daemon), with_run(daemon, state, commissioned)]
    current = state / "arms" / ARM / "current" / "parameters.json"
    assert not current.exists()
    refused = daemon.post(f"/api/v1/arms/{ARM}/acceptances", {"run": runs[0], "note": "  "})
    assert refused.status_code == 400
    taken = []
    for run in runs:
        seen = daemon.get(f"/api/v1/runs/{run}").json()
        assert (seen["kind"], seen["ending"], seen["parameters"]["feasible"]) == ("simulation", "done", True)
        answer = daemon.post(f"/api/v1/arms/{ARM}/acceptances", {"run": run, "note": "drawn twice"})
        assert answer.status_code == 201, answer.text
        taken.append(daemon.get(f"/api/v1/runs/{run}/files/parameters.json").content)
        assert current.read_bytes() == taken[-1]
        assert answer.json()["parameters_sha256"] == hashlib.sha256(taken[-1]).hexdigest()
    assert taken[0] != taken[1]  # when they were made differs, at least
    answer = daemon.post(f"/api/v1/arms/{ARM}/rollback", {"note": "the second was too warm"})
    assert (answer.status_code, answer.json()["number"], answer.json()["origin"]) == (201, 3, 1)
    assert current.read_bytes() == taken[0]
    assert daemon.post(f"/api/v1/arms/{ARM}/rollback", {"note": "again"}).status_code == 400  # nothing before it
    assert daemon.post(f"/api/v1/arms/{ARM}/rollback", {"note": "forth", "to": 2}).status_code == 201
    assert current.read_bytes() == taken[1]
    acts = daemon.get(f"/api/v1/arms/{ARM}/acceptances").json()
    assert [(act["number"], act["origin"], act["who"]) for act in acts] == [
        (1, 1, "owner"),
        (2, 2, "owner"),
        (3, 1, "owner"),
        (4, 2, "owner"),
    ]
    assert daemon.get(f"/api/v1/arms/{ARM}").json()["accepted"] == acts[-1]
    page = daemon.get(f"/api/v1/runs/{runs[0]}/report.html")
    assert page.status_code == 200
    assert page.text.lstrip().lower().startswith("<!doctype html")
    assert "sandbox" in page.headers["content-security-policy"]
    for asked in (
        {"kind": "report", "run": runs[0]},
        {"kind": "export", "run": runs[0], "formats": ["urdf", "csv"]},
        {"kind": "compare", "run": runs[0], "other": runs[1]},
    ):
        made = daemon.follow(daemon.begin(asked)["id"])
        assert made["state"] == "done", made
    assert (state / "reports" / f"{runs[0]}.html").is_file()
    proven = daemon.follow(daemon.begin({"kind": "verify", "run": runs[0]})["id"])
    assert proven["state"] == "done", proven
    assert [line["what"] for line in daemon.get("/api/v1/audit?most=500").json()].count("accepted") == 2
    wrong = daemon.post("/api/v1/arms/planar2/acceptances", {"run": runs[0], "note": "of another arm"})
    assert wrong.status_code == 400


@pytest.mark.campaign
def test_check_run_identify(daemon: Asked, arm: str) -> None:
    # Without a ticket the run is refused, by the same words as at a terminal.
    early = daemon.begin({"kind": "run", "arm": ARM}, confirmed=True)
    ended = daemon.follow(early["id"], lease=True)
    assert (ended["state"], ended["exit_code"]) == ("refused", 3)
    assert "`ident preflight`" in ended["detail"]
    for kind in ("check", "run"):
        job = daemon.begin({"kind": kind, "arm": ARM}, confirmed=True)
        ended = daemon.follow(job["id"], lease=True)
        assert ended["state"] == "done", ended
    run = daemon.get(f"/api/v1/runs/{ended['run']}").json()
    assert run["ending"] == "done"
    ((recording),) = run["recordings"]
    content = daemon.get(f"/api/v1/runs/{run['id']}/files/run.mcap").content
    assert hashlib.sha256(content).hexdigest() == recording["sha256"] == run["files"]["run.mcap"]
    job = daemon.begin({"kind": "identify", "arm": ARM, "recordings": [{"run": run["id"]}]})
    ended = daemon.follow(job["id"])
    assert ended["state"] == "done", ended
    result = daemon.get(f"/api/v1/jobs/{job['id']}/result").json()["answer"]
    assert result["feasible"] is True
    assert daemon.get(f"/api/v1/runs/{ended['run']}").json()["parameters"]["sha256"]
    log = daemon.get(f"/api/v1/jobs/{early['id']}/log").text
    assert "no preflight ticket" in log


@pytest.mark.parametrize(
    ("asked", "state_of_it", "key"),
    [
        ({"kind": "base"}, "done", "base_parameters"),
        ({"kind": "watch", "seconds": 0.1}, "done", "joints"),
        ({"kind": "recover"}, "done", "steps"),
        ({"kind": "preview"}, "done", "warnings"),
    ],
)
def test_what_only_looks_needs_no_word(
    daemon: Asked, arm: str, asked: dict[str, object], state_of_it: str, key: str
) -> None:
    job = daemon.begin({**asked, "arm": arm})
    ended = daemon.follow(job["id"])
    assert ended["state"] == state_of_it, ended
    assert key in daemon.get(f"/api/v1/jobs/{job['id']}/result").json()["answer"]


def test_positions_of_an_arm_at_rest_are_reported_while_they_are_read(daemon: Asked, arm: str, tmp_path: Path) -> None:
    job = daemon.begin({"kind": "watch", "arm": arm, "seconds": 0.5})
    assert daemon.follow(job["id"])["state"] == "done"
    row = rows.known_job(daemon.service.db, job["id"])

    async def events() -> list[str]:
        return [one async for one in live_events(daemon.service, daemon.app.state.live, row)]

    with ThreadPoolExecutor(1) as apart:  # a browser of other tests has its loop in this thread
        seen = apart.submit(asyncio.run, events()).result()
    told = [json.loads(one.partition("data: ")[2]) for one in seen if one.startswith("event: samples")]
    assert [one["time"] for one in told] == [[pytest.approx(0.104 * k, abs=1e-3)] for k in range(5)]  # of 8 ms
    joints = daemon.get(f"/api/v1/jobs/{job['id']}/result").json()["answer"]["joints"]
    for one in told:
        assert one["joints"] == [joint["joint"] for joint in joints]
        for (position,), joint in zip(one["position"], joints, strict=True):
            assert joint["lowest"] - 1e-6 <= position <= joint["highest"] + 1e-6
    assert daemon.get(f"/api/v1/jobs/{job['id']}/log").text == "reading for 0.5 s, without torque\n"
    # A line that is being written is told when it is whole.
    file = daemon.service.state / "jobs" / job["id"] / "log"
    log = file.read_bytes()
    (tmp_path / "log").write_bytes(log[:-10])
    first, offset = printed_samples(tmp_path, 0)
    (tmp_path / "log").write_bytes(log)
    rest, end = printed_samples(tmp_path, offset)
    assert (first, rest, end) == (told[:-1], told[-1:], len(log))
    # Paths of this machine are told to nobody else.
    description = next(word for word in row["words"] if word.endswith(".yaml"))
    file.write_text(f"{daemon.service.state}/runs/x: of {description}\n", encoding="utf-8")
    assert daemon.get(f"/api/v1/jobs/{job['id']}/log").text == f"runs/x: of {arm}\n"


def test_why_an_arm_could_not_be_read_stands_on_its_page(daemon: Asked, arm: str) -> None:
    for state, detail in (("done", ""), ("failed", "the drive of elbow does not answer"), ("queued", "")):
        name = f"j-{state}"
        rows.add_job(daemon.service.db, name, "watch", arm, {}, [], "me", motion=False, run_id=None)
        if state != "queued":
            rows.mark_ended(daemon.service.db, name, state, detail, 1)
    assert "It could not be read at" in (page := daemon.get(f"/arms/{arm}").text)
    assert "the drive of elbow does not answer" in page
    rows.add_job(daemon.service.db, "j-later", "watch", arm, {}, [], "me", motion=False, run_id=None)
    rows.mark_ended(daemon.service.db, "j-later", "done", "", 0)
    assert "It could not be read" not in daemon.get(f"/arms/{arm}").text


@pytest.mark.parametrize("how", ["cancel", "stop", "silence", "shutdown"])
def test_a_motion_ends_with_its_arm_at_rest(state: Path, how: str) -> None:
    factor = 0.5 if how == "silence" else 15.0
    checked_before(state, patient_text(ARM))
    with serving(state, lease_factor=factor) as daemon:
        known_arm(daemon, patient_text(ARM))
        job = daemon.begin({"kind": "run", "arm": ARM}, confirmed=True)
        if how != "silence":
            daemon.follow(job["id"], lease=True, until=lambda _: is_control_file_in_use(control_path(state, ARM)))
        if how == "cancel":
            assert daemon.post(f"/api/v1/jobs/{job['id']}/cancel").status_code == 200
        elif how == "stop":
            daemon.headers.clear()
            assert job["id"] in daemon.post(f"/api/v1/arms/{ARM}/stop").json()["jobs"]
            daemon.as_token((state / "token").read_text().strip())
        if how != "shutdown":
            ended = daemon.follow(job["id"])
    if how == "shutdown":
        with serving(state) as daemon:
            ended = daemon.get(f"/api/v1/jobs/{job['id']}").json()
    words = {
        "cancel": "cancelled by owner",
        "stop": "anybody asked",
        "silence": "lease was not renewed",
        "shutdown": "service",
    }
    assert ended["state"] == "cancelled"
    assert words.get(how, "the service ends") in ended["detail"]
    assert not is_control_file_in_use(control_path(state, ARM))
    assert not (state / "arms" / ARM / "moving.json").exists()
    ending = state / "runs" / job["run"] / "ended.json"
    assert ended["run"] == (job["run"] if ending.parent.exists() else None)
    if ending.exists():  # a lease may lapse before the arm is taken
        assert json.loads(ending.read_text())["state"] == "stopped"
    else:  # or a stop may come while the way is still planned
        assert how == "silence" or "before the arm was energised" in ended["detail"]


def test_one_motion_at_a_time_and_a_lease_while_it_waits(state: Path) -> None:
    with serving(state) as daemon:
        for name in (ARM, "other"):
            known_arm(daemon, quick_text(name))
        db = daemon.service.db
        asked = [daemon.begin({"kind": "check", "arm": name}, confirmed=True)["id"] for name in (ARM, ARM, "other")]
        # The registry tells when each began and ended, which somebody who looks now and then may miss.
        for job in asked[::-1]:
            while rows.known_job(db, job)["state"] in rows.LIVE:
                for one in asked:
                    daemon.post(f"/api/v1/jobs/{one}/lease")
                time.sleep(0.3)
        first, second, elsewhere = (rows.known_job(db, job) for job in asked)
        assert [one["state"] for one in (first, second, elsewhere)] == ["done"] * 3
        assert second["started"] >= first["ended"]
        assert elsewhere["started"] < second["ended"]  # behind neither; a busy machine may delay it beyond the first
        # Whoever waits and falls silent does not move an arm later.
        blocker = daemon.begin({"kind": "check", "arm": ARM}, confirmed=True)
        silent = daemon.begin({"kind": "home", "arm": ARM}, confirmed=True)
        daemon.service.engine.live.lease_factor = 0.1
        ended = daemon.follow(silent["id"])
        assert (ended["state"], ended["started"]) == ("cancelled", None)
        assert "nothing has moved" in ended["detail"]
        daemon.follow(blocker["id"])


def test_a_motion_that_waits_longer_than_its_confirmation_counts_is_refused(
    daemon: Asked, patient: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its lease is renewed all the time: somebody's page is open, and nobody needs to look at the arm any more."""
    running = daemon.begin({"kind": "run", "arm": patient}, confirmed=True)["id"]
    daemon.follow(running, lease=True, until=lambda seen: seen["state"] == "running")
    monkeypatch.setattr("ident_service.daemon.jobs.queue.CONFIRMED_SECONDS", 0.1)
    waiting = daemon.begin({"kind": "check", "arm": patient}, confirmed=True)["id"]
    ended = daemon.follow(waiting, lease=True)
    assert (ended["state"], ended["started"]) == ("refused", None)
    assert ended["detail"].startswith(f"it waited for {running} until its confirmation was older than 0.1 s; nothing")
    assert "ask for the motion again" in ended["detail"]
    # What has begun goes on.
    assert daemon.get(f"/api/v1/jobs/{running}").json()["state"] == "running"
    daemon.post("/api/v1/stop")
    assert daemon.follow(running)["state"] == "cancelled"


def test_what_nobody_confirmed_and_what_has_begun_may_take_longer() -> None:
    clock = [0.0]
    live = LiveJobs(1.0, lambda: clock[0])
    order = Command(("run",), ARM, True, None, (f"arm {ARM}",), 2.0)
    begun, asked, own = (LiveJob(name, order, "ann", name == "own", 0.0) for name in ("begun", "asked", "own"))
    begun.child = cast(JobProcess, SimpleNamespace(say=lambda _: None))
    for one in (begun, asked, own):
        live.add(one)
        live.enter(one)
    for second in range(1, 62):
        clock[0] = float(second)
        live.renew("asked")
        for one in (begun, asked, own):
            live._keep_lease(one, 0.0)
        assert bool(live.end_reason("asked")) == (second > 60)
    assert (asked.end_state, begun.end_reason, own.end_reason) == ("refused", "", "")


def test_the_services_own_lease_carries_a_run_that_nobody_watches(daemon: Asked, arm: str) -> None:
    checked_before(daemon.service.state, quick_text(ARM))
    row = daemon.service.engine.create(Run(kind="run", arm=ARM), "service", own_lease=True)
    assert daemon.follow(row["id"])["state"] == "done"


def test_events_tell_a_job_to_its_end(daemon: Asked, arm: str) -> None:
    job = daemon.begin({"kind": "check", "arm": ARM}, confirmed=True)
    daemon.service.engine.live.renew(job["id"])
    answer = daemon.get(f"/api/v1/jobs/{job['id']}/events")  # lasts as long as the job
    assert answer.headers["content-type"].startswith("text/event-stream")
    told = [json.loads(line[6:])["state"] for line in answer.text.splitlines() if line.startswith("data: ")]
    assert told[-1] == "done"
    assert told == sorted(told, key=["queued", "running", "done"].index)


def test_a_computation_is_cancelled_and_leaves_nothing(daemon: Asked, arm: str, state: Path) -> None:
    job = daemon.begin({"kind": "simulate", "arm": ARM})
    daemon.follow(job["id"], until=lambda seen: (seen["progress"] or {}).get("phase", "").startswith("identification"))
    daemon.post(f"/api/v1/jobs/{job['id']}/cancel")
    ended = daemon.follow(job["id"])
    assert (ended["state"], "cancelled by owner" in ended["detail"]) == ("cancelled", True)
    assert not list((state / "runs").iterdir())


def test_what_dies_without_a_word_has_failed(daemon: Asked, arm: str) -> None:
    job = daemon.begin({"kind": "simulate", "arm": ARM})
    asked = "SELECT process FROM jobs WHERE id = ? AND process <> ''"
    daemon.follow(job["id"], until=lambda _: daemon.service.db.row(asked, job["id"]) is not None)
    row = daemon.service.db.row(asked, job["id"])
    assert row is not None
    os.kill(int(row["process"].split()[0]), 9)
    ended = daemon.follow(job["id"])
    assert ended["state"] == "failed"
    assert "signal 9" in ended["detail"]
    assert [line["detail"]["state"] for line in audit_log(daemon.service.db) if line["what"] == "job ended"] == [
        "failed"
    ]
