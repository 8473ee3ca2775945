"""Serve event streams: of all arms and jobs with the samples of runs that are being recorded, and of one job."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator
from typing import Annotated, Any

from fastapi import APIRouter, Header, Query, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import StreamingResponse

from ident_service.daemon.dependencies import Service, Serving, Viewer, WhileAuthorized
from ident_service.daemon.errors import failures, operation_id
from ident_service.daemon.jobs.requests import Id
from ident_service.daemon.live import LiveRuns
from ident_service.daemon.live_stream import RECORDED, live_events
from ident_service.daemon.news import EventPoller, ViewerEvent, ViewerPosition
from ident_service.registry import jobs as rows
from ident_service.registry.runs import RUNS

router = APIRouter(prefix="/api/v1", responses=failures(), generate_unique_id_function=operation_id)
_LOOK = 0.1  # s between news
_STATE = 0.5  # s between queries for runs that are being recorded
_BREATH = 10.0  # s without news, after which a comment shows that the connection is up
_AGAIN = 1000  # ms after which a browser reconnects
_STREAM: dict[int | str, dict[str, Any]] = {
    200: {"content": {"text/event-stream": {}}, "description": "Events."},
    **failures(),
}
LastEvent = Annotated[
    int | None,
    Header(
        alias="Last-Event-ID",
        ge=0,
        lt=2**62,
        description="the last `id` that was seen; everything that has happened since comes first",
    ),
]
After = Annotated[int | None, Query(ge=0, lt=2**62, description="the same, for whoever cannot send that header")]
Samples = Annotated[bool, Query(description="also `samples` and `doubt` of runs that are recorded")]


@router.get("/events", tags=["events"], response_class=StreamingResponse, responses=_STREAM)
async def watch_all(
    service: Serving,
    _: Viewer,
    while_known: WhileAuthorized,
    request: Request,
    last_event_id: LastEvent = None,
    after: After = None,
    samples: Samples = False,
) -> StreamingResponse:
    """Watch all arms and jobs by server-sent events.

    `happened` is a line of the audit trail, with its number as `id`; `job` and `arm` say how one stands, first as it is
    and then whenever that changes. With `samples`, there are `samples` and `doubt` as in the live stream of a job, each
    with its `job`.
    """
    watch: EventPoller = request.app.state.watch
    # The header counts first: a browser that comes again sends it with the address of the first time.
    seen = await run_in_threadpool(watch.begin, after if last_event_id is None else last_event_id)
    live = request.app.state.live if samples else None
    return StreamingResponse(while_known(_events(service, watch, seen, live)), media_type="text/event-stream")


@router.get("/jobs/{job}/live", tags=["jobs"], response_class=StreamingResponse, responses=_STREAM | failures(404))
async def watch_live(
    service: Serving, _: Viewer, while_known: WhileAuthorized, request: Request, job: Id
) -> StreamingResponse:
    """Watch a job and the run that it records, by server-sent events.

    `job` has its state and log; `samples` has time, position, torque and following error of every joint, one every
    20 ms; `doubt` has the standard deviations of the parameters so far.
    """
    row = await run_in_threadpool(rows.known_job, service.db, job)
    return StreamingResponse(
        while_known(live_events(service, request.app.state.live, row)), media_type="text/event-stream"
    )


async def _events(
    service: Service, watch: EventPoller, seen: ViewerPosition, live: LiveRuns | None
) -> AsyncIterator[str]:
    # A number without data: a client that reconnects before the first event resumes from here.
    yield f"retry: {_AGAIN}\nid: {seen.line}\n\n"
    silent, recorded = 0.0, _Recorded(service, live)
    while not service.engine.closing:
        if watch.due:
            await run_in_threadpool(watch.poll)
        while watch.behind(seen):
            for one in await run_in_threadpool(watch.earlier, seen):
                yield _event(one)
        news = [_event(one) for one in watch.since(seen)]
        if live is not None:
            news += await run_in_threadpool(recorded.news)
        for text in news:
            yield text
        silent = 0.0 if news else silent + _LOOK
        if silent > _BREATH:
            silent = 0.0
            yield ": still here\n\n"
        await asyncio.sleep(_LOOK)


class _Recorded:
    """Follower of the runs that are being recorded, for one viewer."""

    def __init__(self, service: Service, live: LiveRuns | None) -> None:
        self._service, self._live = service, live
        self._jobs, self._looked = dict[str, tuple[str, int]](), 0.0

    def news(self) -> list[str]:
        """Return new samples of each run as events; one file is read once for all viewers."""
        assert self._live is not None  # noqa: S101 - asked for with samples only
        now = time.monotonic()
        if now - self._looked >= _STATE:
            self._looked = now
            found = rows.jobs(self._service.db, states=("running",), most=100)
            runs = {row["id"]: row["run"] for row in found if row["kind"] in RECORDED and row["run"] is not None}
            for ended in self._jobs.keys() - runs.keys():
                self._live.forget(ended)
            self._jobs = {job: self._jobs.get(job, (run, 0)) for job, run in runs.items()}
        while_known = []
        for job, (run, number) in self._jobs.items():
            for frame in self._live.run(job, self._service.state / RUNS / run).since(number):
                self._jobs[job] = (run, frame.number)
                while_known.append(f'event: {frame.kind}\ndata: {{"job": {json.dumps(job)}, {frame.data[1:]}\n\n')
        return while_known


def _event(one: ViewerEvent) -> str:
    number = "" if one.number is None else f"id: {one.number}\n"
    return f"{number}event: {one.kind}\ndata: {one.data}\n\n"
