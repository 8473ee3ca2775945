"""Pages of jobs: the list, one with its progress and log, what it shows while an arm moves, and what it exported."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Annotated, Final

from fastapi import APIRouter, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import FileResponse, StreamingResponse

from ident_service.errors import UnknownId
from ident_service.service.api import jobs
from ident_service.service.api.asking import Operator, Service, Serving, Viewer
from ident_service.service.jobs.asked import FileName, Id
from ident_service.service.jobs.commands import EXPORTS, JOBS
from ident_service.service.jobs.outcome import said
from ident_service.service.live import LiveRuns
from ident_service.service.pages.asking import Form, PageRoute, seen
from ident_service.service.pages.render import page
from ident_service.service.registry import jobs as rows
from ident_service.service.registry.database import Row
from ident_service.service.registry.runs import RUNS

router = APIRouter(include_in_schema=False, route_class=PageRoute)
RECORDED: Final = frozenset({"run", "rehearse", "home"})
_LOOK = 0.1  # s between news
_STATE = 0.5  # s between looks at the job itself
_BREATH = 10.0  # s without news, after which a comment shows that the line is up
_LOG_BYTES = 64 * 1024


@router.get("/jobs")
def list_jobs(service: Serving, who: Viewer, before: Annotated[int, Query(ge=0, lt=2**62)] | None = None) -> Response:
    """Jobs, the newest first."""
    found = rows.jobs(service.db, before=before, most=50)
    return page("jobs", who, jobs=[jobs.answer_of(service, row) for row in found], more=len(found) == 50)


@router.get("/jobs/{job}")
def show_job(service: Serving, who: Viewer, job: Id, attended: bool = False) -> Response:
    """One job; `attended` where this page is to keep the lease of its motion."""
    row = rows.known_job(service.db, job)
    live = row["state"] in rows.LIVE
    attends = attended and live and bool(row["motion"]) and row["created_by"] == who.name and who.role == "operator"
    attends = attends and row["kind"] != "rehearse"  # whose lease is kept by a hand on its own page
    return page(
        "job",
        who,
        job=jobs.answer_of(service, row),
        live=live,
        lease="keep" if attends else "",
        recorded=row["kind"] in RECORDED,
        log=log_of(service, row),
        entered=row["run"] is not None and service.db.row("SELECT 1 FROM runs WHERE id = ?", row["run"]) is not None,
        exports=_exported(service, row),
    )


@router.get("/jobs/{job}/live")
async def watch(service: Serving, _: Viewer, request: Request, job: Id) -> Response:
    """Server-sent events until the job ends: `job`, and `samples` and `doubt` of a run that is recorded."""
    row = await run_in_threadpool(rows.known_job, service.db, job)
    return StreamingResponse(_events(service, request.app.state.live, row), media_type="text/event-stream")


@router.post("/jobs/{job}/cancel")
def cancel(service: Serving, who: Operator, job: Id, form: Form) -> Response:
    """Have it end."""
    del form  # that it came from a page of ours is all that counts
    jobs.cancel_job(service, who, job)
    return seen(f"/jobs/{job}")


@router.get("/exports/{job}/{name}")
def get_export(service: Serving, _: Viewer, job: Id, name: FileName) -> Response:
    """A file that an export made; as something to be kept, never as a page."""
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


def log_of(service: Service, row: Row) -> str:
    """The last of what the process of a job said."""
    log: str = jobs.without_paths(said(service.state / JOBS / row["id"], _LOG_BYTES).log, str(service.state))
    return log


def _shown(service: Service, row: Row) -> str:
    answer = jobs.answer_of(service, row)
    return json.dumps({"job": answer.model_dump(mode="json"), "log": log_of(service, row)[-4096:]})


async def _events(service: Service, live: LiveRuns, row: Row) -> AsyncIterator[str]:
    run = None
    if row["kind"] in RECORDED and row["run"] is not None and row["state"] in rows.LIVE:
        run = live.run(row["id"], service.state / RUNS / str(row["run"]))
    told, number, silent, since = "", 0, 0.0, _STATE
    while True:
        news = []
        if run is not None:
            for frame in await run_in_threadpool(run.since, number):
                number = frame.number
                news.append(f"event: {frame.kind}\ndata: {frame.data}\n\n")
        if since >= _STATE:
            since = 0.0
            row = await run_in_threadpool(rows.known_job, service.db, row["id"])
            shown = await run_in_threadpool(_shown, service, row)
            if shown != told:
                told = shown
                news.append(f"event: job\ndata: {shown}\n\n")
        for one in news:
            yield one
        silent = 0.0 if news else silent + _LOOK
        if silent > _BREATH:
            silent = 0.0
            yield ": still here\n\n"
        if row["state"] not in rows.LIVE or service.engine.closing:
            live.forget(row["id"])
            return
        await asyncio.sleep(_LOOK)
        since += _LOOK
