"""Serve the live event stream of one job."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import StreamingResponse

from ident_service.daemon.dependencies import Serving, Viewer, WhileAuthorized
from ident_service.daemon.errors import failures, operation_id
from ident_service.daemon.jobs.requests import Id
from ident_service.daemon.live_stream import live_events
from ident_service.registry import jobs as rows

router = APIRouter(prefix="/api/v1", tags=["jobs"], responses=failures(404), generate_unique_id_function=operation_id)
_STREAM: dict[int | str, dict[str, Any]] = {
    200: {"content": {"text/event-stream": {}}, "description": "Events."},
    **failures(404),
}


@router.get("/jobs/{job}/live", response_class=StreamingResponse, responses=_STREAM)
async def watch_live(
    service: Serving, _: Viewer, told: WhileAuthorized, request: Request, job: Id
) -> StreamingResponse:
    """Watch a job and the run that it records, by server-sent events.

    `job` has its state and log; `samples` has time, position, torque and following error of every joint, one every
    20 ms; `doubt` has the standard deviations of the parameters so far.
    """
    row = await run_in_threadpool(rows.known_job, service.db, job)
    return StreamingResponse(told(live_events(service, request.app.state.live, row)), media_type="text/event-stream")
