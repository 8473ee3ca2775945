"""What may begin without a person, and what a restart makes of it: a real queue that nobody works off."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable
from pathlib import Path

import pytest
from maintenance.conftest import ARM, MONDAY, Clock, description

from ident_service.config.load import load_arm
from ident_service.daemon.jobs.commands import JOBS
from ident_service.daemon.jobs.outcome import explain_interrupted, mark_interrupted, outcome, process_output
from ident_service.daemon.jobs.queue import Engine
from ident_service.daemon.jobs.requests import Check, Run
from ident_service.daemon.maintenance.reidentification import ReidentificationRequest, reidentifications
from ident_service.daemon.maintenance.scheduler import MaintenanceScheduler
from ident_service.daemon.maintenance.webhook import deliveries
from ident_service.errors import MotionRefused, UsageError
from ident_service.operations.acceptance import accepted_set, rollback
from ident_service.operations.maintenance_schedule import (
    DueRule,
    add_event,
    add_schedule,
    enable_schedule,
    pending,
    schedules,
)
from ident_service.registry import jobs
from ident_service.registry.arms import add_arm
from ident_service.registry.database import Database, Row, audit_log
from ident_service.registry.state_folder import arm_fault_store

HOUR = 3600.0
pytestmark = pytest.mark.slow  # one commissioning for all of them


class Scene:
    """A registry with an accepted arm, its queue, and a scheduler in the test's time."""

    def __init__(self, db: Database, state: Path, clock: Clock) -> None:
        self.db, self.state, self.clock = db, state, clock
        self.restart()
        self.scheduler.do_pass()

    def restart(self) -> None:
        """Another process on the same state folder."""
        self.engine = Engine(self.db, self.state)
        self.scheduler = MaintenanceScheduler(self.engine, None, self.clock)
        mark_interrupted(self.db, self.state)

    def allow(self, **changes: object) -> None:
        add_arm(self.db, self.state, description(unattended="allowed", **changes), {}, "me", replace=True)

    def at_six(self) -> None:
        """A schedule of six o'clock, and its time has come."""
        add_schedule(self.db, ARM, DueRule(cron="0 6 * * *"), "me", self.clock())
        self.clock.at = MONDAY + 6 * HOUR - 0.5
        self.scheduler.do_pass()
        self.clock.forward(1.0)

    def ended(self, state: str = "done", answer: object = None, detail: str = "") -> None:
        """The job of the step has ended, as its process would leave it."""
        job = self.only["job"]
        if answer is not None:
            (self.state / JOBS / job / "answer.json").write_text(json.dumps(answer))
        jobs.mark_ended(self.db, job, state, detail)
        self.engine.live._jobs.pop(job)
        self.scheduler.do_pass()

    @property
    def only(self) -> Row:
        (row,) = reidentifications(self.db)
        return row

    @property
    def queued(self) -> list[tuple[str, bool]]:
        """Kind, and whether its lease is the service's own."""
        rows = {row["id"]: row["kind"] for row in jobs.queued_jobs(self.db)}
        return [(rows[live.job], live.own_lease) for live in self.engine.live.entered() if live.job in rows]

    @property
    def why(self) -> list[str]:
        """Why persons were asked."""
        return [line["detail"]["why"] for line in audit_log(self.db) if line["what"] == "due asks for a person"]


@pytest.fixture
def scene(db: Database, state: Path, clock: Clock, accepted: str) -> Scene:
    return Scene(db, state, clock)


def test_an_arm_whose_description_says_nothing_never_moves_by_itself(scene: Scene) -> None:
    assert load_arm("planar2").unattended_motion == "refused"
    scene.at_six()
    for _ in range(3):
        scene.scheduler.do_pass()
    assert len(pending(scene.db, ARM)) == 1
    assert scene.queued == []
    assert reidentifications(scene.db) == []
    assert scene.why == ["the arm's description does not allow motion without a person"]
    with pytest.raises(MotionRefused, match="does not allow"):
        scene.scheduler.reidentifications.begin(ReidentificationRequest(ARM, unattended=True), "service")
    # A description that allows it later does not set off what waits already.
    scene.allow()
    scene.scheduler.do_pass()
    assert scene.queued == []


def test_only_an_allowed_arm_begins_and_by_a_preflight_under_our_own_lease(scene: Scene) -> None:
    scene.allow()
    scene.at_six()
    for _ in range(3):
        scene.scheduler.do_pass()
    assert scene.queued == [("check", True)]
    assert (scene.only["begun_by"], scene.only["unattended"], scene.only["against"]) == ("service", 1, 1)
    scene.ended()
    assert (scene.only["step"], scene.queued) == ("run", [("run", True)])


def test_a_preflight_that_is_refused_begins_no_run_and_asks_for_a_person(scene: Scene) -> None:
    scene.allow()
    scene.at_six()
    scene.scheduler.do_pass()
    scene.ended("refused", detail="gravity torque is not the model's")
    for _ in range(3):
        scene.scheduler.do_pass()
    assert (scene.only["state"], scene.queued) == ("refused", [])
    assert "gravity torque" in scene.only["detail"]
    assert len(pending(scene.db, ARM)) == 1


def test_a_run_that_was_refused_is_not_named(scene: Scene) -> None:
    scene.scheduler.reidentifications.begin(ReidentificationRequest(ARM), "ann")
    scene.ended("done")
    scene.scheduler.do_pass()
    assert (scene.only["step"], scene.only["recorded"] is None) == ("run", False)
    scene.ended("refused", detail="the arm is in use")
    scene.scheduler.do_pass()
    assert scene.only["state"] == "refused"
    assert (scene.only["recorded"], scene.only["run"]) == (None, None)


def _faulted(scene: Scene) -> str:
    arm_fault_store(scene.state, ARM).latch("late_cycle", "a cycle was late")
    return "a fault waits"


def _waited_for(scene: Scene) -> str:
    scene.engine.create(Run(kind="run", arm=ARM), "ann")
    return "waits to"


def _disabled(scene: Scene) -> str:
    add_event(scene.db, ARM, "belt", "", "me", scene.clock())
    for row in schedules(scene.db):
        enable_schedule(scene.db, row["id"], "me", scene.clock(), enabled=False)
    return "removed or disabled"


def _late(scene: Scene) -> str:
    scene.clock.forward(3 * HOUR)
    return "late"


def _restarted(scene: Scene) -> str:
    scene.restart()
    return "when the service began"


@pytest.mark.parametrize("spoil", [_faulted, _waited_for, _disabled, _late, _restarted])
def test_what_stands_against_it_asks_for_a_person_for_good(scene: Scene, spoil: Callable[[Scene], str]) -> None:
    scene.allow()
    add_schedule(scene.db, ARM, DueRule(maintenance=True), "me", scene.clock())
    if spoil is not _disabled:
        scene.at_six()
    words = spoil(scene)
    scene.scheduler.do_pass()
    assert scene.why
    assert all(words in why for why in scene.why)
    # Neither an acknowledged fault nor a free arm sets off what was refused before.
    for file in (arm_fault_store(scene.state, ARM),):
        for code in file.latched():
            file.acknowledge(code)
    for row in jobs.queued_jobs(scene.db):
        jobs.mark_ended(scene.db, row["id"], "cancelled", "")
    scene.clock.forward(1.0)
    scene.scheduler.do_pass()
    assert reidentifications(scene.db) == []


def test_a_stop_between_the_steps_is_a_stop(scene: Scene) -> None:
    scene.scheduler.reidentifications.begin(ReidentificationRequest(ARM), "ann")
    job = scene.only["job"]
    jobs.mark_ended(scene.db, job, "done", "")
    scene.engine.live._jobs.pop(job)
    assert scene.engine.stop(ARM, "bob") == {"arms": [], "jobs": []}  # nothing moves at this moment
    scene.scheduler.do_pass()
    assert (scene.only["state"], scene.queued) == ("cancelled", [])
    assert "a stop was requested" in scene.only["detail"]
    # The next one is not stopped by it.
    scene.scheduler.reidentifications.begin(ReidentificationRequest(ARM), "ann")
    assert scene.queued == [("check", False)]


def test_one_at_a_time(scene: Scene) -> None:
    scene.scheduler.reidentifications.begin(ReidentificationRequest(ARM), "ann")
    with pytest.raises(MotionRefused, match="already"):
        scene.scheduler.reidentifications.begin(ReidentificationRequest(ARM), "bob")
    assert scene.queued == [("check", False)]  # the second one's was not entered either


def test_a_restart_after_the_preflight_does_not_begin_the_run(scene: Scene) -> None:
    scene.scheduler.reidentifications.begin(ReidentificationRequest(ARM), "ann")
    jobs.mark_ended(scene.db, scene.only["job"], "done", "")
    scene.restart()
    scene.scheduler.do_pass()
    assert (scene.only["state"], scene.queued) == ("interrupted", [])
    assert "nothing has moved since" in scene.only["detail"]


@pytest.mark.parametrize("running", [False, True])
def test_a_restart_during_a_motion_is_reported_when_it_is_known(scene: Scene, running: bool) -> None:
    scene.scheduler.reidentifications.begin(ReidentificationRequest(ARM), "ann")
    if running:
        jobs.mark_started(scene.db, scene.only["job"], "")
    scene.restart()
    scene.scheduler.do_pass()
    if running:  # its process is being looked for
        assert scene.only["state"] == "running"
        explain_interrupted(scene.db, scene.state)
        scene.scheduler.do_pass()
        assert "the service died while it ran" in scene.only["detail"]
    else:
        assert "nothing has moved" in scene.only["detail"]
    assert (scene.only["state"], scene.queued) == ("interrupted", [])


def test_a_restart_before_what_only_computes_goes_on(scene: Scene, accepted: str) -> None:
    scene.scheduler.reidentifications.begin(ReidentificationRequest(ARM), "ann")
    scene.ended()
    jobs.mark_ended(scene.db, scene.only["job"], "done", "")
    # The run that a process would have left: the accepted one's recording.
    folder = scene.state / "runs" / accepted
    (folder / "identification.mcap").rename(folder / "run.mcap")
    from ident_service.registry.runs import index_run
    from ident_service.results.manifest import write_manifest

    write_manifest(folder)
    index_run(scene.db, scene.state, accepted)
    scene.db.write("UPDATE reidentifications SET recorded = ?", accepted)
    scene.restart()
    scene.scheduler.do_pass()
    assert (scene.only["state"], scene.only["step"], scene.queued) == ("running", "identify", [("identify", False)])
    (row,) = jobs.queued_jobs(scene.db)
    # By the description that was accepted, and not by today's.
    assert row["words"][row["words"].index("--arm") + 1].endswith("accepted/0001/arm.json")
    # And a kill of what computes leaves a word of where the recording is.
    jobs.mark_started(scene.db, row["id"], "")
    scene.restart()
    explain_interrupted(scene.db, scene.state)
    scene.scheduler.do_pass()
    assert scene.only["state"] == "interrupted"
    assert accepted in scene.only["detail"]


def test_what_was_stopped_is_no_verdict(scene: Scene) -> None:
    scene.scheduler.reidentifications.begin(ReidentificationRequest(ARM), "ann")
    stopped = {"exit_code": 0, "report": {"state": "stopped"}}
    (scene.state / JOBS / scene.only["job"] / "answer.json").write_text(json.dumps(stopped))
    assert outcome(process_output(scene.state / JOBS / scene.only["job"]), 0, "").state == "cancelled"
    scene.ended("cancelled", detail="a stop was requested")
    assert (scene.only["state"], scene.queued) == ("cancelled", [])


def test_nothing_accepted_or_another_mechanism_cannot_be_compared(scene: Scene) -> None:
    add_arm(scene.db, scene.state, description(name="new"), {}, "me")
    with pytest.raises(UsageError, match="nothing has been accepted"):
        scene.scheduler.reidentifications.begin(ReidentificationRequest("new"), "ann")
    longer = description().replace("shoulder: {a: 0.5}", "shoulder: {a: 0.6}")
    add_arm(scene.db, scene.state, longer, {}, "me", replace=True)
    with pytest.raises(UsageError, match="kinematics"):
        scene.scheduler.reidentifications.begin(ReidentificationRequest(ARM), "ann")
    assert scene.queued == []


def test_an_accepted_set_that_was_changed_on_the_disk_is_compared_with_nothing(scene: Scene) -> None:
    _, folder = accepted_set(scene.state, ARM)
    (folder / "parameters.json").write_text("{}")
    with pytest.raises(ValueError, match="was changed since"):
        scene.scheduler.reidentifications.begin(ReidentificationRequest(ARM), "ann")


def test_what_is_rolled_back_to_is_the_same_to_the_last_bit(scene: Scene, accepted: str) -> None:
    from ident_service.operations.acceptance import accept
    from ident_service.results.manifest import write_manifest

    current = scene.state / "arms" / ARM / "current"
    before = {path.name: path.read_bytes() for path in current.iterdir()}
    folder = scene.state / "runs" / accepted
    document = json.loads((folder / "parameters.json").read_text())
    (folder / "parameters.json").write_text(json.dumps(document | {"method": "huber"}))
    write_manifest(folder)
    with pytest.raises(UsageError, match="the name of who accepts"):
        accept(scene.db, scene.state, folder, "better", " ")
    accept(scene.db, scene.state, folder, "better", "ann")
    assert {path.name: path.read_bytes() for path in current.iterdir()} != before
    with pytest.raises(UsageError, match="the name of who accepts"):
        rollback(scene.db, scene.state, ARM, "worse", "")
    rollback(scene.db, scene.state, ARM, "worse", "bob")
    assert {path.name: path.read_bytes() for path in current.iterdir()} == before
    kept = sorted(path.name for path in (scene.state / "arms" / ARM / "accepted").iterdir())
    assert kept == ["0001", "0002", "0003"]


def test_a_notice_is_kept_with_the_record_of_its_delivery(scene: Scene) -> None:
    class Broken:
        broken = True

        def send(self, *_: object) -> None:
            scene.db.write("INSERT INTO deliveries (id, arm, body, created) VALUES ('m', 'quick', '{}', 0)")
            if self.broken:
                raise sqlite3.OperationalError("database or disk is full")

    broken = Broken()
    scene.scheduler._webhook = broken
    scene.at_six()
    with pytest.raises(sqlite3.OperationalError):
        scene.scheduler.do_pass()
    assert ([row["told"] for row in pending(scene.db)], deliveries(scene.db)) == ([0], [])
    broken.broken = False
    for _ in range(3):
        scene.scheduler.do_pass()
    assert ([row["told"] for row in pending(scene.db)], len(deliveries(scene.db))) == ([1], 1)


def test_a_check_by_hand_is_untouched(scene: Scene) -> None:
    scene.at_six()
    scene.scheduler.do_pass()
    scene.engine.create(Check(kind="check", arm=ARM), "ann")
    assert scene.queued == [("check", False)]
