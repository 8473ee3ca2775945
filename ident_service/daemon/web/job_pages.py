"""Serve the pages of jobs: the list, one with its progress and log, live data of a motion, exported files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Final

from fastapi import APIRouter, Query, Response
from fastapi.responses import FileResponse

from ident_service.daemon.dependencies import Operator, Service, Serving, Viewer
from ident_service.daemon.jobs.requests import FileName, Id
from ident_service.daemon.live_stream import READ, RECORDED, log_of
from ident_service.daemon.routes import jobs
from ident_service.daemon.web.arm_facts import joint_facts
from ident_service.daemon.web.forms import Form, PageRoute, see_other
from ident_service.daemon.web.render import page
from ident_service.daemon.web.run_pages import identified_set, run_facts
from ident_service.errors import IdentError, UnknownId
from ident_service.motion.ticket import ticket_from_json
from ident_service.registry import jobs as rows
from ident_service.registry.arms import known_arm
from ident_service.registry.database import Row
from ident_service.registry.runs import EXPORTS
from ident_service.registry.tokens import Access

router = APIRouter(include_in_schema=False, route_class=PageRoute)


@router.get("/jobs")
def list_jobs(service: Serving, who: Viewer, before: Annotated[int, Query(ge=0, lt=2**62)] | None = None) -> Response:
    """List jobs, the newest first."""
    found = rows.jobs(service.db, before=before, most=50)
    return page("jobs", who, jobs=[jobs.job_answer_document(service, row) for row in found], more=len(found) == 50)


@router.get("/jobs/{job}")
def show_job(service: Serving, who: Viewer, job: Id, attended: bool = False) -> Response:
    """Show the page of a job; with `attended` it renews the lease of a motion that the caller began."""
    row = rows.known_job(service.db, job)
    live = row["state"] in rows.LIVE
    attends = attended and live and bool(row["motion"]) and row["created_by"] == who.name and who.role == "operator"
    attends = attends and row["kind"] != "rehearse"  # its lease is kept by the held button on its own page
    ending = live and bool(service.engine.live.end_reason(row["id"]))
    entered = row["run"] is not None and service.db.row("SELECT 1 FROM runs WHERE id = ?", row["run"]) is not None
    said = jobs.get_result(service, _NOBODY, row["id"])
    answer = {} if live else said.answer
    return page(
        "job",
        who,
        job=jobs.job_answer_document(service, row),
        live=live,
        lease="keep" if attends and not ending else "",
        ending=ending,
        recorded=row["kind"] in RECORDED,
        read=row["kind"] == READ,
        log=log_of(service, row),
        entered=entered,
        exports=_exported(service, row),
        answer=answer,
        text="" if live else said.text.strip(),
        checks=_checks(answer),
        found=identified_set(service, row["run"]) if entered and not live else None,
        facts=run_facts(service, row["run"]) if entered and not live else None,
        joints=live_joints(service, row),
    )


def live_joints(service: Service, row: Row) -> list[dict[str, Any]]:
    """Return name, unit and limits of each joint of a live job that streams samples; an empty list for other jobs."""
    if row["state"] not in rows.LIVE or row["kind"] not in {*RECORDED, READ}:
        return []
    try:
        return joint_facts(known_arm(service.db, service.state, str(row["arm"])).config)
    except IdentError:
        return []


def _checks(answer: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the checks of a preflight, each with its title and the measure nearest to its limit."""
    from ident_service.operations.arm_checks import TITLES, nearest_measure

    try:
        checks = ticket_from_json(json.dumps(answer["ticket"])).checks if "ticket" in answer else ()
    except IdentError:
        return []
    return [
        {
            "title": TITLES.get(check.code, check.code),
            "verdict": check.verdict.value,
            "reason": check.reason,
            "remedy": check.remedy,
            "nearest": "" if (nearest := nearest_measure(check)) is None else str(nearest),
            "measures": [str(one) for one in check.measures],
        }
        for check in checks
    ]


_NOBODY: Final = Access("page", "viewer")


@router.post("/jobs/{job}/cancel")
def cancel(service: Serving, who: Operator, job: Id, form: Form) -> Response:
    """Cancel a job and go back to its page."""
    del form  # reading the form has checked that it comes from a page of this service
    jobs.cancel_job(service, who, job)
    return see_other(f"/jobs/{job}")


@router.get("/exports/{job}/{name}")
def get_export(service: Serving, _: Viewer, job: Id, name: FileName) -> Response:
    """Download a file that the export job of this id made, never shown as a page."""
    row = rows.known_job(service.db, job)
    if name not in _exported(service, row):
        raise UnknownId(f"the job {job} has exported no file {name!r}; its page names them")
    path = service.state / EXPORTS / str(row["run"]) / name
    return FileResponse(path, media_type="application/octet-stream", filename=name)


def _exported(service: Service, row: Row) -> list[str]:
    if row["kind"] != "export" or row["state"] != "done" or row["run"] is None:
        return []
    place: Path = service.state / EXPORTS / str(row["run"])
    return (
        sorted(path.name for path in place.iterdir() if path.is_file() and not path.is_symlink())
        if (place.is_dir())
        else []
    )
