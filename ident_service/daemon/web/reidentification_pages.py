"""Show re-identifications: a person's word for one, its steps with their jobs, and its outcome.

The registry's text is the verdict that was concluded. The comparison in the run's folder has the same content in more
detail; it is shown only if the manifest names it with its hash, and if it leads to that same text.

A person confirms by typing the arm's name, as for any motion; a note may say why, and is entered in the audit trail.
The page that then opens renews the lease of both motions.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

from fastapi import APIRouter, Response
from fastapi.responses import HTMLResponse

from ident_service.daemon.dependencies import Operator, Service, Serving, Viewer
from ident_service.daemon.jobs.requests import ArmName, Id
from ident_service.daemon.live_stream import log_of
from ident_service.daemon.maintenance.reidentification import known_reidentification, require_comparable
from ident_service.daemon.routes import arms, jobs, maintenance
from ident_service.daemon.web.arm_facts import joint_facts
from ident_service.daemon.web.forms import Form, PageRoute, see_other
from ident_service.daemon.web.render import page
from ident_service.daemon.web.run_pages import POLICY
from ident_service.errors import IdentError, MotionRefused, UnknownId, UsageError
from ident_service.operations.drift_alarms import verdict_of
from ident_service.registry import jobs as rows
from ident_service.registry import motions as known_motions
from ident_service.registry import runs
from ident_service.registry.arms import known_arm
from ident_service.registry.database import LONGEST_NOTE, Database, Row, note
from ident_service.registry.tokens import Access
from ident_service.results.manifest import file_sha256

TITLES: Final = {"check": "Check", "run": "Run", "identify": "Identify", "judge": "Compare"}
WORDS: Final = {
    "check": "preflight; the arm moves a little",
    "run": "the arm moves along the motion and is recorded",
    "identify": "its parameters, by the description that was accepted",
    "judge": "against the accepted set",
}
MOVES: Final = frozenset({"check", "run"})
DOCUMENT, PAGE = "comparison.json", "comparison.html"  # as `ident compare --keep` writes them
_VERDICTS = ("unchanged", "changed", "impossible")
_MOST_BYTES = 16 * 2**20

StepState = Literal["done", "busy", "open", "ended"]


@dataclass(frozen=True)
class Step:
    """One step of a re-identification.

    Attributes:
        key: one of `TITLES`.
        title: for people.
        words: description of the step.
        state: `ended` where the whole ended badly.
        job: id of its job; None where it has none yet, or was done at a terminal.
    """

    key: str
    title: str
    words: str
    state: StepState
    job: str | None


@dataclass(frozen=True)
class Compared:
    """Comparison that a verdict was concluded from.

    Attributes:
        folder: folder of the run that keeps the comparison.
        findings: changes: `what` and of which joint or link; `joint`, whose torque changes most for its size; `sigma`,
            the change in standard deviations; `size`, in words; `meaning`. Joint and size may be empty.
        errors: torque error on the new recording with the accepted parameters and with its own [%]; None if unknown.
    """

    folder: Path
    findings: tuple[dict[str, Any], ...]
    errors: tuple[float, float] | None


def steps(db: Database, row: Row) -> tuple[Step, ...]:
    """Return the steps of a re-identification in order, with jobs: each done, busy, open, or ended without a verdict.

    Args:
        db: the registry.
        row: of the re-identification.
    """
    made = _jobs(db, row) if row["job"] is not None else {}
    order = list(TITLES)
    at = order.index(row["step"])
    here: StepState = "busy" if row["state"] == "running" else "done" if row["state"] in _VERDICTS else "ended"
    states: list[StepState] = ["done" if place < at else here if place == at else "open" for place in range(len(order))]
    return tuple(
        Step(key, TITLES[key], WORDS[key], state, made.get(key)) for key, state in zip(order, states, strict=True)
    )


def compared(db: Database, state: Path, run_id: str | None, verdict_words: str) -> Compared | None:
    """Return a run's stored comparison if its verdict has these words; None if missing, changed or replaced since.

    Args:
        db: the registry.
        state: the state folder.
        run_id: id of the run with the parameters.
        verdict_words: words of the conclusion, as the registry has them.
    """
    try:
        named = {} if run_id is None else runs.run_files(db, state, run_id)
        if run_id is None or not {DOCUMENT, PAGE} <= set(named):
            return None
        folder = runs.run_folder(db, state, run_id)
        if (folder / DOCUMENT).stat().st_size > _MOST_BYTES:
            return None
        if any(file_sha256(folder / name) != named[name] for name in (DOCUMENT, PAGE)):
            return None
        document = json.loads((folder / DOCUMENT).read_bytes())
        return _comparison(folder, document["compared"][0]) if verdict_of(document).words == verdict_words else None
    except (IdentError, OSError, ValueError, LookupError, TypeError):
        return None


def _comparison(folder: Path, pair: dict[str, Any]) -> Compared:
    found = [{key: one[key] for key in ("what", "joint", "sigma", "size", "meaning")} for one in pair["findings"]]
    errors = pair["torque_error_percent"]
    both = None if errors is None else (float(errors["reference"]["whole"]), float(errors["own"]["whole"]))
    return Compared(folder, tuple(found), both)


def _jobs(db: Database, row: Row) -> dict[str, str]:
    """Return the job id of each step that has a job, by the step's key.

    A step's job is found by the run that it made. A check makes none: it is the one whose creation time is nearest to
    the beginning of the re-identification.
    """
    found = {
        key: job["id"]
        for key, made in (("run", row["recorded"]), ("identify", row["run"]), ("judge", row["run"]))
        if made is not None
        and (job := db.row("SELECT id FROM jobs WHERE kind = ? AND run = ? ORDER BY number DESC LIMIT 1", key, made))
    }
    check = db.row(
        "SELECT id FROM jobs WHERE kind = 'check' AND arm = ? AND created_by = ? ORDER BY ABS(created - ?) LIMIT 1",
        *(row["arm"], row["begun_by"], row["begun"]),
    )
    return {**({} if check is None else {"check": check["id"]}), **found, row["step"]: row["job"]}


router = APIRouter(include_in_schema=False, route_class=PageRoute)
_NOTED = "re-identification note"


@router.post("/arms/{arm}/reidentify/confirm")
def ask_confirmation(service: Serving, who: Operator, arm: ArmName, form: Form) -> Response:
    """Show what is about to move, and what it is compared with; ask for the arm's name."""
    return _confirmation(service, who, arm, form, "")


@router.post("/arms/{arm}/reidentify")
def begin(service: Serving, who: Operator, arm: ArmName, form: Form) -> Response:
    """Begin a re-identification that a person has confirmed; its page keeps the lease from then on."""
    remark = form.get("note", "").strip()
    if len(remark) > LONGEST_NOTE:
        raise UsageError(f"a note has {LONGEST_NOTE} characters at most; nothing has moved")
    body = {"arm": arm, "confirm": {"name": form.get("name", ""), "challenge": form.get("challenge", "")}}
    if form.get("motion"):
        body["motion"] = form["motion"]
    wanted = maintenance.NewReidentification.model_validate(body)
    try:
        begun = maintenance.begin_reidentification(service, who, wanted)
    except MotionRefused as error:
        if service.db.row("SELECT 1 FROM reidentifications WHERE arm = ? AND state = 'running'", arm) is not None:
            raise
        words = f"Nothing has moved: that was not the arm's name, this page was open for too long, or: {error}"
        return _confirmation(service, who, arm, form, words)
    if remark:
        note(service.db, who.name, _NOTED, begun.id, note=remark)
    return see_other(f"/reidentifications/{begun.id}?attended=1")


@router.get("/reidentifications/{name}")
def show(service: Serving, who: Viewer, name: Id, attended: bool = False) -> Response:
    """Show the page of a re-identification; with `attended` it renews the lease, if the caller began that."""
    row = known_reidentification(service.db, name)
    live, job = row["state"] == "running", None if row["job"] is None else rows.known_job(service.db, row["job"])
    attends = attended and live and not row["unattended"] and row["begun_by"] == who.name and who.role == "operator"
    remark = [one["detail"] for one in service.db.rows(_REMARK, _NOTED, row["id"])]
    return page(
        "again",
        who,
        again=maintenance.get_reidentification(service, who, name),
        steps=steps(service.db, row),
        moves=sorted(MOVES),
        live=live,
        lease="keep" if attends else "",
        job=None if job is None else jobs.job_answer_document(service, job),
        joints=joint_facts(known_arm(service.db, service.state, row["arm"]).config) if live else [],
        log="" if job is None else log_of(service, job),
        note=remark[0] if remark else "",
        compared=compared(service.db, service.state, row["run"], row["detail"]),
        known={
            run for run in (row["recorded"], row["run"]) if service.db.row("SELECT 1 FROM runs WHERE id = ?", run or "")
        },
    )


@router.post("/reidentifications/{name}/cancel")
def cancel(service: Serving, who: Operator, name: Id, form: Form) -> Response:
    """Cancel the present job of a re-identification, a motion by a controlled stop; between jobs, stop its arm."""
    del form  # reading the form has checked that it comes from a page of this service
    row = known_reidentification(service.db, name)
    if row["state"] != "running" or row["job"] is None:
        raise UsageError(f"this re-identification has ended already: {row['state']}")
    try:
        jobs.cancel_job(service, who, row["job"])
    except UsageError:
        # Between two steps there is no job to cancel; a stop makes sure that no motion begins any more.
        service.engine.stop(row["arm"], who.name)
    return see_other(f"/reidentifications/{name}?attended=1")


@router.get("/reidentifications/{name}/comparison")
def show_comparison(service: Serving, _: Viewer, name: Id) -> Response:
    """Show the stored comparison of a re-identification."""
    row = known_reidentification(service.db, name)
    found = compared(service.db, service.state, row["run"], row["detail"])
    if found is None:
        raise UnknownId(f"the re-identification {name} has no comparison, or its run holds another one now")
    text = (found.folder / PAGE).read_text(encoding="utf-8").replace(f"{service.state}/", "")
    return HTMLResponse(text, headers={"Content-Security-Policy": POLICY})


_REMARK = "SELECT json_extract(detail, '$.note') AS detail FROM audit WHERE what = ? AND about = ? ORDER BY id LIMIT 1"


def _confirmation(service: Service, who: Access, arm: str, form: dict[str, str], problem: str) -> Response:
    config = known_arm(service.db, service.state, arm).config
    against = require_comparable(service.state, config)  # checked here, before a person types the name
    given = arms.challenge(service, who, arm)
    motion = known_motions.known_motion(service.db, form["motion"]) if form.get("motion") else None
    return page(
        "reidentify",
        who,
        409 if problem else 200,
        arm=given.arm,
        given=given,
        motion=motion,
        against=against,
        note=form.get("note", ""),
        longest=LONGEST_NOTE,
        steps=[(TITLES[key], WORDS[key]) for key in TITLES],
        problem=problem,
    )
