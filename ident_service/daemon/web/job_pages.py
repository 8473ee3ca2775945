"""Serve the pages of jobs: the list, one with its progress and log, live data of a motion, exported files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Query, Response
from fastapi.responses import FileResponse

from ident_service.daemon.dependencies import Operator, Service, Serving, Viewer
from ident_service.daemon.jobs.requests import FileName, Id
from ident_service.daemon.live_stream import RECORDED, log_of
from ident_service.daemon.routes import jobs
from ident_service.daemon.web.forms import Form, PageRoute, seen
from ident_service.daemon.web.render import page
from ident_service.errors import UnknownId
from ident_service.registry import jobs as rows
from ident_service.registry.database import Row
from ident_service.registry.runs import EXPORTS

router = APIRouter(include_in_schema=False, route_class=PageRoute)


@router.get("/jobs")
def list_jobs(service: Serving, who: Viewer, before: Annotated[int, Query(ge=0, lt=2**62)] | None = None) -> Response:
    """List jobs, the newest first."""
    found = rows.jobs(service.db, before=before, most=50)
    return page("jobs", who, jobs=[jobs.job_answer_document(service, row) for row in found], more=len(found) == 50)


@router.get("/jobs/{job}")
def show_job(service: Serving, who: Viewer, job: Id, attended: bool = False) -> Response:
    """Show one job; `attended` where this page is to keep the lease of its motion."""
    row = rows.known_job(service.db, job)
    live = row["state"] in rows.LIVE
    attends = attended and live and bool(row["motion"]) and row["created_by"] == who.name and who.role == "operator"
    attends = attends and row["kind"] != "rehearse"  # its lease is kept by the held button on its own page
    return page(
        "job",
        who,
        job=jobs.job_answer_document(service, row),
        live=live,
        lease="keep" if attends else "",
        recorded=row["kind"] in RECORDED,
        log=log_of(service, row),
        entered=row["run"] is not None and service.db.row("SELECT 1 FROM runs WHERE id = ?", row["run"]) is not None,
        exports=_exported(service, row),
    )


@router.post("/jobs/{job}/cancel")
def cancel(service: Serving, who: Operator, job: Id, form: Form) -> Response:
    """Cancel a job."""
    del form  # reading the form has checked that it comes from a page of this service
    jobs.cancel_job(service, who, job)
    return seen(f"/jobs/{job}")


@router.get("/exports/{job}/{name}")
def get_export(service: Serving, _: Viewer, job: Id, name: FileName) -> Response:
    """Download a file that an export made, never shown as a page."""
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
