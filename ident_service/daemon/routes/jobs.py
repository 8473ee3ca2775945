"""Serve the routes about jobs (create, watch, cancel, renew the lease) and the stop, which needs no role."""

from __future__ import annotations

import asyncio
import hashlib
import json
import sqlite3
from collections.abc import AsyncIterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from types import MappingProxyType
from typing import Annotated, Any, Final, Literal

from fastapi import Header, HTTPException, Query, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import PlainTextResponse, StreamingResponse
from pydantic import Field

from ident_service.daemon import responses as answers
from ident_service.daemon.dependencies import LeaseKeeper, Near, Operator, Service, Serving, Viewer, WhileAuthorized
from ident_service.daemon.errors import api_router, failures
from ident_service.daemon.jobs.commands import JOBS
from ident_service.daemon.jobs.outcome import held_until, is_end_unobserved, process_output
from ident_service.daemon.jobs.requests import MOVES, AnyJobRequest, ArmName, Id, RequestBody
from ident_service.errors import MotionRefused, UnknownId, UsageError
from ident_service.operations.moving_arms import is_held
from ident_service.registry import jobs as rows
from ident_service.registry.arms import arm_names
from ident_service.registry.database import Row
from ident_service.registry.state_folder import arm_folder
from ident_service.registry.tokens import Access

router = api_router("jobs", 404, 409)
MOST_LOG: Final = 2**20
NOTHING: Final[Mapping[str, str]] = MappingProxyType({})
_EVENTS = 0.2  # s between looks at a job that is watched
_BREATH = 10.0  # s without news, after which a comment shows that the line is up
_KNOWN: Final = 0.5  # s for the registry to say whether an arm that nobody moves exists
# Its own threads: whatever else is busy, a stop is not.
_STOPS = ThreadPoolExecutor(4, thread_name_prefix="stop")
_STREAM: dict[int | str, dict[str, Any]] = {
    200: {"content": {"text/event-stream": {}}, "description": "Events."},
    **failures(404, 409),
}
_REPLAYED: Final[dict[str, Any]] = {
    "Idempotent-Replayed": {
        "description": "`true` where the key had made this job before.",
        "schema": {"type": "string"},
    }
}
Key = Annotated[
    str | None,
    Header(
        min_length=1,
        max_length=200,
        pattern=r"^[\x21-\x7e]+$",
        description="of computations: within a day, the same token, key and job are answered with the job that was "
        "made then, and another job with the same key is 409",
    ),
]
State = Literal["queued", "running", "done", "refused", "failed", "faulted", "cancelled", "interrupted"]


class Confirmation(RequestBody):
    """Confirmation of one motion by a person: the arm's name, typed, and the challenge that was given for it."""

    name: Annotated[str, Field(max_length=64)]
    challenge: Annotated[str, Field(max_length=64)]


class JobRequest(RequestBody):
    """Job to be done; one that may move an arm needs the confirmation, and its lease renewed from now on."""

    job: AnyJobRequest
    confirm: Confirmation | None = None


def require_confirmed(service: Service, arm: str, confirm: Confirmation | None, who: str) -> None:
    """Raise MotionRefused unless the typed name is the arm's and the challenge this caller's; uses that up.

    Raises:
        MotionRefused: no confirmation, or one that does not count.
    """
    # The challenge is used up first, so that a name cannot be tried again with it.
    good = confirm is not None and service.authenticator.confirm(confirm.challenge, arm, who)
    if confirm is not None and confirm.name != arm:
        raise MotionRefused(
            f"{arm}: the typed name {confirm.name!r} is not this arm's; nothing moves. To move {arm}, type its name "
            "(the challenge is used up, ask for a new one)"
        )
    if not good:
        raise MotionRefused(
            f"{arm}: a motion needs a fresh challenge of this arm (POST /api/v1/arms/{arm}/challenge), used once, "
            "and the arm's name as a person has typed it"
        )


@router.post("/jobs", status_code=201, responses={201: {"headers": _REPLAYED}})
def create_job(
    service: Serving, who: Operator, body: JobRequest, response: Response, idempotency_key: Key = None
) -> answers.JobAnswer:
    """Begin or queue a job, a motion only if confirmed; a computation with an `Idempotency-Key` is queued once."""
    if idempotency_key is None:
        return begin_job(service, who, body)
    if body.job.kind in MOVES:
        raise UsageError("a motion has no Idempotency-Key: its challenge is valid once, and it must not begin later")
    asked = hashlib.sha256(body.job.model_dump_json().encode()).hexdigest()
    if (row := rows.job_of_idempotency_key(service.db, who.name, idempotency_key, asked)) is None:

        def enter(job: Row) -> None:
            rows.store_idempotency_key(service.db, who.name, idempotency_key, asked, job["id"])

        try:
            return job_answer_document(service, service.engine.create(body.job, who.name, also_write=enter))
        except sqlite3.IntegrityError:  # the same request came twice at once, and the other one was entered first
            row = rows.job_of_idempotency_key(service.db, who.name, idempotency_key, asked)
            if row is None:
                raise
    response.headers["Idempotent-Replayed"] = "true"
    return job_answer_document(service, row)


def begin_job(service: Service, who: Access, body: JobRequest) -> answers.JobAnswer:
    """Queue a job, rights unchecked; a motion, even simulated, needs its challenge and the arm's typed name.

    Raises:
        MotionRefused: a motion that no person has confirmed.
        IdentError: as the engine.
    """
    if body.job.kind in MOVES:
        require_confirmed(service, getattr(body.job, "arm", ""), body.confirm, who.name)
    return job_answer_document(service, service.engine.create(body.job, who.name))


@router.get("/jobs", responses=answers.PAGES)
def list_jobs(
    page: answers.Page,
    service: Serving,
    _: Viewer,
    state: Annotated[list[State] | None, Query()] = None,
    arm: ArmName | None = None,
    before: answers.BeforeNumber = None,
    most: answers.Most = 100,
) -> list[answers.JobAnswer]:
    """List jobs, the newest first."""
    states = tuple(state or rows.STATES)
    found = page(most, lambda n: rows.jobs(service.db, states=states, arm=arm, before=before, most=n), "number")
    return [job_answer_document(service, row) for row in found]


@router.get("/jobs/{job}")
def get_job(service: Serving, _: Viewer, job: Id) -> answers.JobAnswer:
    """Show a job: its state, its progress, and why it ended."""
    return job_answer_document(service, rows.known_job(service.db, job))


@router.get("/jobs/{job}/log", response_class=PlainTextResponse, responses=failures(404, 409))
def get_log(service: Serving, _: Viewer, job: Id) -> PlainTextResponse:
    """Return the end of the log of a job."""
    row = rows.known_job(service.db, job)
    return PlainTextResponse(named_values(process_output(service.state / JOBS / row["id"], MOST_LOG).log, service, row))


@router.get("/jobs/{job}/result")
def get_result(service: Serving, _: Viewer, job: Id) -> answers.JobResult:
    """Return the JSON answer and the text that the command of a job has printed."""
    row = rows.known_job(service.db, job)
    output = process_output(service.state / JOBS / row["id"])
    return answers.JobResult(
        job=row["id"], **named_values({"answer": output.answer, "text": output.text}, service, row)
    )


@router.get("/jobs/{job}/events", response_class=StreamingResponse, responses=_STREAM)
async def watch_job(service: Serving, _: Viewer, while_known: WhileAuthorized, job: Id) -> StreamingResponse:
    """Watch a job by server-sent events; `job` whenever it changes, until it has ended."""
    row = await run_in_threadpool(rows.known_job, service.db, job)
    return StreamingResponse(while_known(_events(service, row["id"])), media_type="text/event-stream")


@router.post("/jobs/{job}/cancel")
def cancel_job(service: Serving, who: Operator, job: Id) -> answers.JobAnswer:
    """Cancel a job, without waiting; a motion comes to a controlled stop, and the job then says what happened."""
    service.engine.cancel(job, who.name)
    return job_answer_document(service, rows.known_job(service.db, job))


@router.post("/jobs/{job}/lease")
async def renew_lease(service: Serving, who: LeaseKeeper, job: Id) -> answers.LeaseAnswer:
    """Renew the lease of a motion; only the caller who asked for the motion can.

    From the moment on in which the motion is to end, whoever asked for that, there is none: 409 says why.
    """
    holder = service.engine.live.lease_holder(job)
    if holder is not None and holder != who.name:
        raise HTTPException(403, "only the requester of a motion renews its lease")
    if (seconds := service.engine.live.renew(job)) is None:
        row = await run_in_threadpool(rows.known_job, service.db, job)
        why = service.engine.live.end_reason(job)
        state = f"it is ending ({why}), which needs none" if why else row["state"]
        raise MotionRefused(f"the job {job} has no lease to renew: {state}")
    return answers.LeaseAnswer(job=job, seconds=seconds)


@router.post("/stop")
async def stop_all(service: Serving, who: Near) -> answers.StopAnswer:
    """Stop all arms, under control, without waiting; by any token, or by none where the service listens at loopback."""
    return await _stop(service, None, who)


@router.post("/arms/{arm}/stop")
async def stop_arm(service: Serving, who: Near, arm: ArmName) -> answers.StopAnswer:
    """Stop one arm, under control, for whoever may stop all; 404 for an unknown arm, no error for one at rest."""
    return await _stop(service, arm, who)


async def _stop(service: Service, arm: str | None, who: str) -> answers.StopAnswer:
    done = await asyncio.get_running_loop().run_in_executor(_STOPS, service.engine.stop, arm, who)
    if arm is not None and not any(done.values()) and not await _may_be_known(service, arm):
        raise UnknownId(f"no arm {arm!r} is known; nothing was stopped. POST /api/v1/stop stops all arms")
    return answers.StopAnswer(**done)


async def _may_be_known(service: Service, arm: str) -> bool:
    """Return whether there is an arm of this name, or that cannot be told soon: the stop has been sent already."""

    def known() -> bool:
        # One that moved once has a folder, an uploaded one of another machine's command too.
        return arm_folder(service.state, arm).exists() or arm in (row["name"] for row in arm_names(service.db))

    try:
        return await asyncio.wait_for(asyncio.to_thread(known), _KNOWN)
    except (TimeoutError, sqlite3.Error, OSError):
        return True


def job_answer_document(service: Service, row: Row) -> answers.JobAnswer:
    """Make the API's answer on a job from its row: state, progress, what it waits for; no paths of this machine."""
    found = service.engine.progress(row)
    shown = {key: value for key, value in row.items() if key in answers.JobAnswer.model_fields}
    shown["detail"] = named_values(row["detail"], service, row)
    progress = None if found is None else named_values(asdict(found), service, row)
    moves = bool(row["motion"]) and (row["state"] == "running" or is_end_unobserved(row))
    held = moves and is_held(service.state, str(row["arm"]))
    if held and progress is not None:  # it ends when a person says so
        progress |= {"fraction": None, "remaining": None}
    if row["state"] == "queued" and (before := service.engine.live.waits_for(row["id"])) is not None:
        other = service.db.row("SELECT arm FROM jobs WHERE id = ? AND motion", before)
        shown["detail"] = f"waits for {before}"
        if other is not None and is_held(service.state, str(other["arm"])):
            shown["detail"] += f", which holds {held_until(other['arm'])}"
    unentered, code = service.engine.live.unentered(row["id"]) if row["state"] == "running" else ("", None)
    if unentered:
        shown["detail"], shown["exit_code"], progress = named_values(unentered, service, row), code, None
    return answers.JobAnswer(**{**shown, "progress": progress, "held": held})


def named_values(value: Any, service: Service, row: Row) -> Any:
    """Return a job's values with its arm by name, in commands too, and paths relative to the state folder."""
    described = {word: row["arm"] for word in row["words"] if word.startswith("/") and word.endswith(".yaml")}
    return without_paths(value, str(service.state), described if row["arm"] is not None else {})


def without_paths(value: Any, state_folder: str, names_by_path: Mapping[str, str] = NOTHING) -> Any:
    """Return JSON values with the state folder's path cut from all texts, and each path of `names_by_path` replaced.

    Args:
        value: JSON values.
        state_folder: the folder.
        names_by_path: texts that replace other paths, by path.
    """
    if isinstance(value, str):
        for place, name in names_by_path.items():
            value = value.replace(place, name)
        return value.replace(f" --state {state_folder}", "").replace(f"{state_folder}/", "")
    if isinstance(value, list):
        return [without_paths(part, state_folder, names_by_path) for part in value]
    if isinstance(value, dict):
        return {key: without_paths(part, state_folder, names_by_path) for key, part in value.items()}
    return value


async def _events(service: Service, job: str) -> AsyncIterator[str]:
    last, silent = "", 0.0
    while True:
        row = await run_in_threadpool(rows.known_job, service.db, job)
        shown = (await run_in_threadpool(job_answer_document, service, row)).model_dump_json()
        if shown != last:
            last, silent = shown, 0.0
            yield f"event: job\ndata: {json.dumps(json.loads(shown))}\n\n"
        elif silent > _BREATH:
            silent = 0.0
            yield ": still here\n\n"
        if row["state"] not in rows.LIVE or (service.engine.closing and row["state"] == "queued"):
            return
        await asyncio.sleep(_EVENTS)
        silent += _EVENTS
