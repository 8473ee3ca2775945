"""Show arms: the list, one with the steps of its commissioning, and the acts of a person at it.

Read from the registry and the arm's folder at each request, so that it is right after any restart. Steps count from the
last description on: a new description begins them anew. Jobs of a re-identification count for its own step alone. That
step comes next whenever something is due or a drift alarm stands, and it can be done.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, Literal

from fastapi import APIRouter, Response
from markupsafe import Markup

from ident_service import __version__
from ident_service.config.arm import ArmConfig
from ident_service.daemon.dependencies import Operator, Service, Serving, Viewer
from ident_service.daemon.errors import status_of
from ident_service.daemon.jobs.commands import JOBS
from ident_service.daemon.jobs.outcome import process_output
from ident_service.daemon.jobs.requests import KINDS, MOVES, ArmName, Id
from ident_service.daemon.maintenance.reidentification import (
    known_reidentification,
    reidentifications,
    require_comparable,
)
from ident_service.daemon.routes import arms, jobs
from ident_service.daemon.web.arm_facts import (
    ArmFacts,
    arm_facts,
    extent,
    facts_of,
    home_svg,
    joint_facts,
    motion_svg,
)
from ident_service.daemon.web.forms import Form, PageRoute, see_other
from ident_service.daemon.web.reidentification_pages import compared
from ident_service.daemon.web.render import page, picture, when
from ident_service.errors import DriverError, IdentError, MotionRefused, UsageError
from ident_service.motion.command_channel import is_control_file_in_use
from ident_service.motion.ticket import Verdict, read_ticket
from ident_service.operations import maintenance_schedule as planned
from ident_service.operations.acceptance import Acceptance, acceptances
from ident_service.operations.drift_alarms import alarms
from ident_service.operations.maintenance_schedule import pending
from ident_service.registry import arms as known
from ident_service.registry import jobs as rows
from ident_service.registry import motions as known_motions
from ident_service.registry import runs as known_runs
from ident_service.registry.database import Database, Row
from ident_service.registry.motions import motions
from ident_service.registry.runs import EXPORTS, REPORTS
from ident_service.registry.state_folder import arm_fault_store, control_path, ticket_path
from ident_service.registry.tokens import Access

StepState = Literal["done", "skipped", "next", "open", "busy"]
TITLES: Final = {
    "description": "Description",
    "motion": "Motion",
    "check": "Check",
    "rehearse": "Rehearse",
    "run": "Run",
    "identify": "Identify",
    "report": "Report",
    "accept": "Accept",
    "export": "Export",
    "again": "Re-identify",
}


_MAKE_RUNS: Final = ("rehearse", "run", "identify")
_WITHOUT_ARM: Final = ("description", "identify", "report", "accept", "export")  # steps of one with recordings only


@dataclass(frozen=True)
class Step:
    """One step of the commissioning.

    Attributes:
        key: one of `TITLES`.
        title: for people.
        state: `next` for exactly one step, unless a job of a step is under way, which then is `busy`; `skipped` for a
            rehearsal that a run went without.
        words: result so far, in words, or in words and times.
        link: page of the job that is doing it now.
    """

    key: str
    title: str
    state: StepState
    words: str
    link: str | None = None


@dataclass(frozen=True)
class CommissioningWorkflow:
    """All commissioning steps of an arm, and what they are about.

    Attributes:
        steps: steps, in order.
        run: id of the newest run on the arm that came to its end; of an arm with recordings only, its newest recording.
        identified: id of the newest identification of that run.
        accepted: the current acceptance.
        exported: id of the job that exported the accepted parameters.
        reported: whether the identification has its report.
        comparable: whether the arm can be re-identified: something is accepted that it can be compared with.
    """

    steps: tuple[Step, ...]
    run: str | None
    identified: str | None
    accepted: Acceptance | None
    exported: str | None
    reported: bool
    comparable: bool


def commissioning_workflow(db: Database, state: Path, config: ArmConfig) -> CommissioningWorkflow:
    """Return an arm's commissioning steps with their states, as its jobs, runs and acceptances show them.

    Raises:
        ParameterError: the accepted set cannot be read.
    """
    arm = config.name
    row = db.row("SELECT added FROM arms WHERE name = ?", arm)
    since = 0.0 if row is None else float(row["added"])
    again = reidentifications(db, arm, most=500)
    made = {one[key] for one in again for key in ("recorded", "run")} - {None}
    under_way = next((one for one in again if one["state"] == "running"), None)
    there = {one["id"] for one in db.rows("SELECT id FROM runs WHERE arm = ?", arm)}
    jobs = [
        one
        for one in rows.jobs(db, arm=arm, most=500)
        if one["created"] >= since and one["run"] not in made and not _deleted(one, there)
    ]
    movable = config.driver is not None
    run_id = _made(_newest(jobs, "run")) if movable else _newest_recording(db, arm, since)
    identified = _made(next((job for job in jobs if _identifies(job, run_id)), None))
    reported = identified is not None and (state / REPORTS / f"{identified}.html").is_file()
    acts = acceptances(state, arm)
    accepted = acts[-1] if acts else None
    took = identified is not None and any(act.run == identified for act in acts)
    exported = next((job["id"] for job in jobs if accepted and _exports(job, state, accepted.run)), None)
    designed = len(motions(db, arm))
    checked, ticket = _ticket(ticket_path(state, arm), config)
    rehearsed = _newest(jobs, "rehearse")
    comparable, words = _comparable(state, config) if accepted else (False, "accept parameters first")
    asks = _due_reasons(db, arm)
    if comparable:
        words = "; ".join(asks) or _last(again)
    done: dict[str, tuple[bool, str]] = {
        "description": (True, f"by its SHA-256 {config.sha256[:12]}"),
        "motion": (True, f"{designed} designed, and the description's own" if designed else "the description's own"),
        "check": (checked or run_id is not None, ticket),
        "rehearse": (
            rehearsed is not None or run_id is not None,
            "done slowly, while a key was held"
            if rehearsed
            else "slowly, while you hold a key; recommended before a run",
        ),
        "run": (run_id is not None, run_id or "nothing recorded yet"),
        "identify": (identified is not None, identified or _nothing_identified(run_id, movable=movable)),
        "report": (reported, "made" if reported else "not made yet"),
        "accept": (took, _accepted(accepted)),
        "export": (took and exported is not None, "made" if exported else "nothing exported of what is accepted"),
        "again": (False, words),
    }
    live = [job for job in reversed(jobs) if job["state"] in rows.LIVE]
    busy = {_step(job["kind"]): f"/jobs/{job['id']}" for job in live}
    if under_way is not None:
        own = under_way["job"]
        busy = {_step(job["kind"]): f"/jobs/{job['id']}" for job in live if job["id"] != own}
        busy["again"] = f"/reidentifications/{under_way['id']}"
    upcoming = "again" if comparable and asks else next(key for key, (finished, _) in done.items() if not finished)

    def state_of(key: str) -> StepState:
        if key in busy:
            return "busy"
        if done[key][0]:
            return "skipped" if key == "rehearse" and rehearsed is None else "done"
        return "next" if key == upcoming and not busy else "open"

    if not movable:
        done = {key: done[key] for key in _WITHOUT_ARM}
        upcoming = next((key for key, (finished, _) in done.items() if not finished), "")
    steps = tuple(Step(key, TITLES[key], state_of(key), words, busy.get(key)) for key, (_, words) in done.items())
    return CommissioningWorkflow(steps, run_id, identified, accepted, exported, reported, comparable)


def _comparable(state: Path, config: ArmConfig) -> tuple[bool, str]:
    """Return whether the arm can be compared with what is accepted, and if not, why."""
    try:
        require_comparable(state, config)
    except IdentError as error:
        return False, str(error).replace(f"{state}/", "")
    return True, ""


def _due_reasons(db: Database, arm: str) -> list[str]:
    """Return the reasons for a re-identification, in words."""
    due = [f"due: {row['cause']}" for row in pending(db, arm)]
    return [*due, *(["open drift alarm"] if alarms(db, arm, most=1) else [])]


def _last(again: list[Row]) -> str:
    what = "after maintenance or a change in behaviour: preflight, run, identify, compare with the accepted set"
    if not again:
        return what
    return Markup("the last one, {}: {}; {}").format(when(again[0]["begun"]), again[0]["state"], what)


def _newest_recording(db: Database, arm: str, since: float) -> str | None:
    row = db.row(
        "SELECT id FROM runs WHERE arm = ? AND kind = 'recording' AND indexed >= ? ORDER BY created DESC LIMIT 1",
        *(arm, since),
    )
    return None if row is None else str(row["id"])


def _nothing_identified(run: str | None, *, movable: bool) -> str:
    if movable:
        return "no parameters from the newest run yet"
    return "no parameters from the newest recording yet" if run else "upload a recording of the arm: MCAP or CSV"


def _newest(jobs: list[Row], kind: str) -> Row | None:
    return next((job for job in jobs if job["kind"] == kind and job["state"] == "done"), None)


def _deleted(job: Row, there: set[str]) -> bool:
    """Return whether the run that a job has made is deleted."""
    return job["kind"] in _MAKE_RUNS and job["state"] == "done" and job["run"] not in there


def _made(job: Row | None) -> str | None:
    return None if job is None else str(job["run"])


def _identifies(job: Row, run: str | None) -> bool:
    if job["kind"] != "identify" or job["state"] != "done" or run is None:
        return False
    return any(one.get("run") == run for one in job["request"].get("recordings", ()))


def _exports(job: Row, state: Path, run: str) -> bool:
    good = job["kind"] == "export" and job["state"] == "done" and job["request"].get("run") == run
    return bool(good and (state / EXPORTS / str(job["run"])).is_dir())


def _accepted(act: Acceptance | None) -> str:
    if act is None:
        return "nothing accepted yet"
    back = "" if act.origin == act.number else f", a return to {act.origin}"
    return f"number {act.number}{back}, by {act.who}"


def _step(kind: str) -> str:
    return {"design": "motion", "home": "run", "simulate": "again", "judge": "again"}.get(kind, kind)


def _ticket(path: Path, config: ArmConfig) -> tuple[bool, str]:
    """Return whether the last preflight's ticket still looks valid, and words; the run itself checks it again."""
    if not path.is_file():
        return False, "no preflight yet"
    try:
        ticket = read_ticket(path)
    except IdentError:
        return False, "its ticket cannot be read; repeat the preflight"
    until = when(ticket.expires.timestamp())
    if ticket.verdict is not Verdict.PASSED:
        return False, "the last one failed"
    if ticket.subject.arm_sha256 != config.sha256 or ticket.subject.software != f"ident-service {__version__}":
        return False, "the description or the software has changed since"
    if datetime.now(UTC) >= ticket.expires:
        return False, Markup("its ticket ended at {}").format(until)
    return True, Markup("passed, valid until {}").format(until)


router = APIRouter(include_in_schema=False, route_class=PageRoute)
_KINDS: Final = frozenset({"design", "identify", "simulate", "report", "export", "watch"})


@router.get("/")
def list_arms(service: Serving, who: Viewer) -> Response:
    """Show all arms: those that were uploaded or used, the other shipped ones, and what runs, is due or has drifted."""
    db = service.db
    accepted = {
        row["arm"]: row["number"] for row in db.rows("SELECT arm, MAX(number) AS number FROM acceptances GROUP BY arm")
    }
    last = {
        row["arm"]: row for row in db.rows("SELECT arm, id, kind, ending, MAX(created) AS at FROM runs GROUP BY arm")
    }
    worked = last.keys() | accepted.keys() | {row["arm"] for row in db.rows("SELECT DISTINCT arm FROM jobs")}
    busy = rows.jobs(db, states=rows.LIVE, most=50)
    standing, due = _alarms(service, None), planned.pending(db)
    lines = []
    for row in known.arm_names(db):
        name = row["name"]
        problem = arms.shown_control_problem(service, name)
        try:
            faults = len(arm_fault_store(service.state, name).latched())
            moving = is_control_file_in_use(control_path(service.state, name))
        except DriverError:  # `problem` says why
            faults, moving = 0, False
        except IdentError:  # a damaged file prevents motion like a fault
            faults, moving = 1, is_control_file_in_use(control_path(service.state, name))
        facts = arm_facts(service.state, row)
        used = row["source"] != "shipped" or name in worked or faults > 0 or problem is not None
        lines.append(
            {
                **row,
                "facts": facts,
                "used": used,
                "accepted": accepted.get(name),
                "faults": faults,
                "problem": problem,
                "moving": moving,
                "last": last.get(name),
                "alarms": sum(one["arm"] == name for one in standing),
                "dues": sum(one["arm"] == name for one in due),
                "next": _upcoming(service, row, facts) if used else None,
            }
        )
    return page(
        "arms",
        who,
        arms=lines,
        alarms=standing,
        dues=due,
        jobs=[jobs.job_answer_document(service, row) for row in busy],
    )


def _upcoming(service: Service, row: Row, facts: ArmFacts) -> Step | None:
    """Return the step of an arm that comes next, or that is under way; None where none does."""
    if facts.kind == "unreadable":
        return None
    try:
        config = known.known_arm(service.db, service.state, row["name"]).config
        steps = commissioning_workflow(service.db, service.state, config).steps
    except IdentError:
        return None  # the page of the arm says why
    return next((step for step in steps if step.state in ("busy", "next")), None)


@router.get("/arms/{arm}/picture.svg")
def show_picture(service: Serving, _: Viewer, arm: ArmName) -> Response:
    """Draw an arm at home, as an SVG."""
    return picture(home_svg(service, arm))


@router.get("/arms/{arm}/motion.svg")
def show_motion(service: Serving, _: Viewer, arm: ArmName, motion: Id | Literal[""] = "") -> Response:
    """Draw an arm, as an SVG, along the motion of this id; if empty, along its description's identification motion."""
    return picture(motion_svg(service, arm, motion))


@router.get("/new")
def describe(who: Operator) -> Response:
    """Show the form for a new description."""
    return page("new", who, problem="", text="", replace=False)


@router.post("/new")
def take_description(service: Serving, who: Operator, form: Form) -> Response:
    """Add the arm of the form's description, or show every mistake in it."""
    text, replace = form.get("description", "").replace("\r\n", "\n"), "replace" in form
    try:
        added = arms.add_arm(service, who, arms.NewArm(description=text, replace=replace))
    except IdentError as error:
        return page("new", who, status_of(error), problem=str(error), text=text, replace=replace)
    return see_other(f"/arms/{added.name}")


@router.get("/arms/{arm}")
def show_arm(service: Serving, who: Viewer, arm: ArmName) -> Response:
    """Show one arm: its commissioning steps, its runs, and its acceptances."""
    answer = arms.get_arm(service, who, arm)
    config = known.known_arm(service.db, service.state, arm).config
    due = planned.pending(service.db, answer.name)
    scheduled = {row["id"]: row["motion"] for row in planned.schedules(service.db, answer.name)}
    sets = service.db.rows("SELECT run FROM parameter_sets WHERE arm = ?", answer.name)
    return page(
        "arm",
        who,
        arm=answer,
        facts=facts_of(config),
        joints=joint_facts(config),
        seen=_last_look(service, answer.name),
        unread=_failed_look(service, answer.name),
        workflow=commissioning_workflow(service.db, service.state, config),
        motions=known_motions.motions(service.db, answer.name),
        alarms=_alarms(service, answer.name),
        dues=due,
        due_motion=next((motion for row in due if (motion := scheduled.get(row["schedule"]))), ""),
        schedules=len(scheduled),
        maintained=planned.events(service.db, answer.name, most=1),
        agains=reidentifications(service.db, answer.name, most=20),
        runs=known_runs.runs(service.db, answer.name, most=20),
        identified=[row["run"] for row in sets],
        acts=list(reversed(arms.list_acceptances(service, who, arm))),
        jobs=[jobs.job_answer_document(service, row) for row in rows.jobs(service.db, arm=answer.name, most=10)],
    )


@router.post("/arms/{arm}/confirm")
def ask_confirmation(service: Serving, who: Operator, arm: ArmName, form: Form) -> Response:
    """Show what is about to move, and ask for the arm's name."""
    return _confirmation(service, who, arm, form, "")


@router.post("/arms/{arm}/move")
def move(service: Serving, who: Operator, arm: ArmName, form: Form) -> Response:
    """Queue a motion that a person has confirmed; go to the page of its job, which renews its lease."""
    if form.get("kind") == "rehearse":
        raise UsageError("a rehearsal begins when the button of its page is held")
    asked = _requested_job(arm, form)
    body = {"job": asked, "confirm": {"name": form.get("name", ""), "challenge": form.get("challenge", "")}}
    try:
        job = jobs.begin_job(service, who, jobs.JobRequest.model_validate(body))
    except MotionRefused:
        words = "That was not the arm's name, or this page was open for too long. Nothing has moved; try again."
        return _confirmation(service, who, arm, form, words)
    return see_other(f"/jobs/{job.id}?attended=1")


@router.post("/arms/{arm}/jobs")
def compute(service: Serving, who: Operator, arm: ArmName, form: Form) -> Response:
    """Queue a job that moves nothing, and go to its page."""
    if form.get("kind") not in _KINDS:
        raise UsageError("choose an action on the page of the arm")
    job = jobs.begin_job(service, who, jobs.JobRequest.model_validate({"job": _requested_job(arm, form)}))
    return see_other(f"/jobs/{job.id}")


@router.post("/arms/{arm}/ack")
def acknowledge(service: Serving, who: Operator, arm: ArmName, form: Form) -> Response:
    """Acknowledge a fault that a person has read, and go back to the page of the arm."""
    arms.acknowledge(service, who, arm, form.get("code", ""))
    return see_other(f"/arms/{arm}")


@router.post("/arms/{arm}/accept")
def accept(service: Serving, who: Operator, arm: ArmName, form: Form) -> Response:
    """Accept the parameters of a run as the arm's, if the form has the arm's name, typed by a person."""
    _require_name(arm, form)
    arms.accept_run(service, who, arm, arms.Acceptance(run=form.get("run", ""), note=form.get("note", "")))
    return see_other(f"/arms/{arm}#accepted")


@router.post("/arms/{arm}/rollback")
def roll_back(service: Serving, who: Operator, arm: ArmName, form: Form) -> Response:
    """Return to an earlier accepted set, if the form has the arm's name, typed by a person."""
    _require_name(arm, form)
    body = {"note": form.get("note", ""), **({"to": form["to"]} if form.get("to") else {})}
    arms.roll_back(service, who, arm, arms.Rollback.model_validate(body))
    return see_other(f"/arms/{arm}#accepted")


@router.post("/arms/{arm}/pause")
def pause(service: Serving, who: Operator, arm: ArmName, form: Form) -> Response:
    """Pause the motion of an arm or, unless the form's `wanted` is `pause`, resume it; go back to the page."""
    (arms.pause if form.get("wanted") == "pause" else arms.resume)(service, who, arm)
    return _back(service, arm, form)


@router.post("/arms/{arm}/finish")
def finish(service: Serving, who: Operator, arm: ArmName, form: Form) -> Response:
    """End a run early: the arm goes straight back to its start; if that way is not free, the run goes on."""
    arms.finish(service, who, arm)
    return _back(service, arm, form)


@router.post("/arms/{arm}/supported")
def supported(service: Serving, who: Operator, arm: ArmName, form: Form) -> Response:
    """Confirm that an arm that is held is supported, if the form has the arm's name, typed by a person."""
    arms.supported(service, who, arm, arms.Support(confirm=form.get("name", "").strip()))
    return _back(service, arm, form)


def _back(service: Service, arm: str, form: dict[str, str]) -> Response:
    """Redirect to the page that a form came from: of a re-identification, of a job, or of the arm."""
    job, again = form.get("job", ""), form.get("again", "")
    if again:
        return see_other(f"/reidentifications/{known_reidentification(service.db, again)['id']}?attended=1")
    return see_other(f"/jobs/{rows.known_job(service.db, job)['id']}?attended=1" if job else f"/arms/{arm}")


def _last_look(service: Service, arm: str) -> dict[str, Any] | None:
    """Return the newest job that read the arm at rest, with its answer; None where none has."""
    found = service.db.row(
        "SELECT id FROM jobs WHERE arm = ? AND kind = 'watch' AND state = 'done' ORDER BY number DESC LIMIT 1", arm
    )
    if found is None:
        return None
    job = rows.known_job(service.db, found["id"])
    return {"at": job["ended"], "job": job["id"], **process_output(service.state / JOBS / job["id"]).answer}


def _failed_look(service: Service, arm: str) -> dict[str, Any] | None:
    """Return when and why the arm could not be read, if that is the newest attempt that has ended; else None."""
    found = service.db.row(
        "SELECT id, state, ended, detail FROM jobs WHERE arm = ? AND kind = 'watch' AND state IN ('done', 'failed') "
        "ORDER BY number DESC LIMIT 1",
        arm,
    )
    if found is None or found["state"] == "done":
        return None
    row = rows.known_job(service.db, found["id"])
    return {"at": row["ended"], "job": row["id"], "why": jobs.job_answer_document(service, row).detail}


def _alarms(service: Service, arm: str | None) -> list[dict[str, Any]]:
    """Return the open drift alarms of an arm, or of all, each with its comparison, a fleet's with its job."""
    return [
        {
            **row,
            "compared": compared(service.db, service.state, row["run"], row["what"]),
            "job": service.db.row("SELECT id FROM jobs WHERE run = ? AND kind = 'fleet'", row["run"]),
        }
        for row in alarms(service.db, arm, most=50)
    ]


def _requested_job(arm: str, form: dict[str, str]) -> dict[str, Any]:
    """Return the job that a form asks for; empty fields are left out."""
    kind = form.get("kind", "")
    fields = {*KINDS[kind].model_fields, "recording", "validation"} if kind in KINDS else set[str]()
    asked: dict[str, Any] = {key: value for key, value in form.items() if value and key in fields}
    if kind == "export":
        asked["formats"] = [name.removeprefix("format-") for name in form if name.startswith("format-")]
    if kind in ("report", "export"):
        return asked
    if "until" in asked:
        asked["until"] = {"share": asked["until"]}
    if kind == "identify":
        asked["recordings"] = [{"run": asked.pop("recording", "")}]
        if "validation" in asked:
            asked["validate_on"] = [{"run": asked.pop("validation")}]
    return {**asked, "arm": arm}


def _confirmation(service: Service, who: Access, arm: str, form: dict[str, str], problem: str) -> Response:
    if form.get("kind") not in MOVES:
        raise UsageError("choose a motion on the page of the arm")
    given = arms.challenge(service, who, arm)
    fields = {"kind": form["kind"], **{key: form.get(key, "") for key in ("motion", "speed", "until")}}
    motion = known_motions.known_motion(service.db, fields["motion"]) if fields["motion"] else None
    status = 409 if problem else 200
    # A rehearsal begins on its own page while its button is held: the lease would lapse while a page loads.
    moves = form["kind"] in ("run", "rehearse", "check")
    shown = {
        "arm": given.arm,
        "given": given,
        "fields": fields,
        "motion": motion,
        "simulated": facts_of(known.known_arm(service.db, service.state, arm).config).kind == "simulated",
        "extent": extent(service, given.arm, fields["motion"], _speed(fields["speed"])) if moves else None,
    }
    if form["kind"] == "rehearse":
        joints = joint_facts(known.known_arm(service.db, service.state, arm).config)
        return page("rehearse", who, status, joints=joints, **shown)
    return page("confirm", who, status, problem=problem, **shown)


def _speed(given: str) -> float:
    """Return the share of a motion's speed that a form asks for; 1 where it is none, which the job then refuses."""
    try:
        speed = float(given or 1.0)
    except ValueError:
        return 1.0
    return speed if 0.0 < speed <= 1.0 else 1.0


def _require_name(arm: str, form: dict[str, str]) -> None:
    if form.get("name", "").strip() != arm:
        raise UsageError(f"{arm}: type the arm's name to say that you mean this arm; nothing was changed")
