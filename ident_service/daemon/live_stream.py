"""Stream a job as server-sent events: state, log, and samples of the run that it records or the arm that it reads."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from typing import Final

from fastapi.concurrency import run_in_threadpool

from ident_service.daemon.dependencies import Service
from ident_service.daemon.jobs.commands import JOBS
from ident_service.daemon.jobs.outcome import printed_samples, process_output
from ident_service.daemon.live import LiveRuns
from ident_service.daemon.routes import jobs
from ident_service.registry import jobs as rows
from ident_service.registry.database import Row
from ident_service.registry.runs import RUNS

RECORDED: Final = frozenset({"run", "rehearse", "home"})
READ: Final = "watch"  # the kind of job that reads an arm at rest
_LOOK = 0.1  # s between news
_STATE = 0.5  # s between reads of the job itself
_BREATH = 10.0  # s without news, after which a comment shows that the connection is up
_LOG_BYTES = 64 * 1024


def log_of(service: Service, row: Row) -> str:
    """Return the end of what a job's process has printed, its arm by name, paths relative to the state folder."""
    return str(jobs.named_values(process_output(service.state / JOBS / row["id"], _LOG_BYTES).log, service, row))


def _shown(service: Service, row: Row) -> str:
    answer = jobs.job_answer_document(service, row)
    return json.dumps({"job": answer.model_dump(mode="json"), "log": log_of(service, row)[-4096:]})


async def live_events(service: Service, live: LiveRuns, row: Row) -> AsyncIterator[str]:
    """Yield server-sent events until the job ends: `job` on changes, `samples` of a run or watch, `doubt` of a run."""
    run = None
    if row["kind"] in RECORDED and row["run"] is not None and row["state"] in rows.LIVE:
        run = live.run(row["id"], service.state / RUNS / str(row["run"]))
    last, number, offset, silent, since = "", 0, 0, 0.0, _STATE
    while True:
        news = []
        if run is not None:
            for frame in await run_in_threadpool(run.since, number):
                number = frame.number
                news.append(f"event: {frame.kind}\ndata: {frame.data}\n\n")
        if row["kind"] == READ:
            found, offset = await run_in_threadpool(printed_samples, service.state / JOBS / row["id"], offset)
            news += [f"event: samples\ndata: {json.dumps(one)}\n\n" for one in found]
        if since >= _STATE:
            since = 0.0
            row = await run_in_threadpool(rows.known_job, service.db, row["id"])
            shown = await run_in_threadpool(_shown, service, row)
            if shown != last:
                last = shown
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
