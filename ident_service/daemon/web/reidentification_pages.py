"""Serve the pages of re-identifications: confirmation by a person, progress, and findings.

A person confirms by typing the arm's name, as for any motion; a note may say why, and is entered in the audit trail.
The page that then opens renews the lease of both motions.
"""

from __future__ import annotations

from fastapi import APIRouter, Response
from fastapi.responses import HTMLResponse

from ident_service.daemon.dependencies import Operator, Service, Serving, Viewer
from ident_service.daemon.jobs.requests import ArmName, Id
from ident_service.daemon.live_stream import log_of
from ident_service.daemon.maintenance.reidentification import known_reidentification, require_comparable
from ident_service.daemon.routes import arms, jobs, maintenance
from ident_service.daemon.web.forms import Form, PageRoute, seen
from ident_service.daemon.web.reidentification_steps import MOVES, PAGE, TITLES, WORDS, compared, steps
from ident_service.daemon.web.render import page
from ident_service.daemon.web.run_pages import POLICY
from ident_service.errors import MotionRefused, UnknownId, UsageError
from ident_service.registry import jobs as rows
from ident_service.registry import motions as known_motions
from ident_service.registry.arms import known_arm
from ident_service.registry.audit import note
from ident_service.registry.tokens import Access

router = APIRouter(include_in_schema=False, route_class=PageRoute)
_LONGEST_NOTE = 2000
_NOTED = "re-identification note"


@router.post("/arms/{arm}/reidentify/confirm")
def ask_confirmation(service: Serving, who: Operator, arm: ArmName, form: Form) -> Response:
    """Show what is about to move, and what it is compared with; ask for the arm's name."""
    return _confirmation(service, who, arm, form, "")


@router.post("/arms/{arm}/reidentify")
def begin(service: Serving, who: Operator, arm: ArmName, form: Form) -> Response:
    """Begin a re-identification that a person has confirmed; its page keeps the lease from then on."""
    remark = form.get("note", "").strip()
    if len(remark) > _LONGEST_NOTE:
        raise UsageError(f"a note has {_LONGEST_NOTE} characters at most; nothing has moved")
    body = {"arm": arm, "confirm": {"name": form.get("name", ""), "challenge": form.get("challenge", "")}}
    if form.get("motion"):
        body["motion"] = form["motion"]
    wanted = maintenance.NewReidentification.model_validate(body)
    try:
        begun = maintenance.begin_reidentification(service, who, wanted)
    except MotionRefused as error:
        if service.db.row("SELECT 1 FROM reidentifications WHERE arm = ? AND state = 'running'", arm) is not None:
            raise
        words = f"Nothing has moved: that was not the arm's name, this page was open for too long, or else: {error}"
        return _confirmation(service, who, arm, form, words)
    if remark:
        note(service.db, who.name, _NOTED, begun.id, note=remark)
    return seen(f"/reidentifications/{begun.id}?attended=1")


@router.get("/reidentifications/{name}")
def show(service: Serving, who: Viewer, name: Id, attended: bool = False) -> Response:
    """Show one re-identification; `attended` where this page is to keep its lease."""
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
        job=None if job is None else jobs.answer_of(service, job),
        log="" if job is None else log_of(service, job),
        note=remark[0] if remark else "",
        compared=compared(service.db, service.state, row["run"], row["detail"]),
        known={
            run for run in (row["recorded"], row["run"]) if service.db.row("SELECT 1 FROM runs WHERE id = ?", run or "")
        },
    )


@router.post("/reidentifications/{name}/cancel")
def cancel(service: Serving, who: Operator, name: Id, form: Form) -> Response:
    """End a re-identification: its motion by a controlled stop."""
    del form  # reading the form has checked that it comes from a page of this service
    row = known_reidentification(service.db, name)
    if row["state"] != "running" or row["job"] is None:
        raise UsageError(f"this re-identification has ended already: {row['state']}")
    try:
        jobs.cancel_job(service, who, row["job"])
    except UsageError:
        # Between two steps there is no job to cancel; a stop makes sure that no motion begins any more.
        service.engine.stop(row["arm"], who.name)
    return seen(f"/reidentifications/{name}?attended=1")


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
        longest=_LONGEST_NOTE,
        steps=[(TITLES[key], WORDS[key]) for key in TITLES],
        problem=problem,
    )
