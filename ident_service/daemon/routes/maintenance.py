"""Route requests about re-identification: schedules, maintenance, what is due, alarms."""

from __future__ import annotations

import time
from typing import Annotated, Literal

from fastapi import HTTPException, Path
from fastapi.concurrency import run_in_threadpool
from pydantic import BaseModel, Field

from ident_service.daemon.dependencies import LeaseKeeper, Operator, Service, Serving, Viewer
from ident_service.daemon.errors import api_router
from ident_service.daemon.jobs.requests import ArmName, Id, RequestBody
from ident_service.daemon.maintenance.reidentification import (
    ReidentificationRequest,
    known_reidentification,
    reidentifications,
)
from ident_service.daemon.maintenance.webhook import deliveries
from ident_service.daemon.responses import PAGES, BeforeId, BeforeNumber, LeaseAnswer, Most, Page
from ident_service.daemon.routes.jobs import Confirmation, require_confirmed, without_paths
from ident_service.motion.command_channel import LEASE_SECONDS
from ident_service.operations import drift_alarms as raised
from ident_service.operations import maintenance_schedule as planned
from ident_service.registry.arms import known_arm
from ident_service.registry.database import LONGEST_NOTE, Row


class ScheduleAnswer(BaseModel):
    """Schedule of re-identifications.

    One of `cron` (five fields, UTC) and `trigger` (`hours:NUMBER` or `maintenance`) is set. `next` is when it is due
    by cron; `motion` null is the description's own.
    """

    id: int
    arm: str
    cron: str | None
    trigger: str | None
    motion: str | None
    enabled: bool
    last: float | None
    next: float | None
    created: float
    created_by: str


class DeliveryAnswer(BaseModel):
    """Notice to the webhook.

    `next` is when it is tried; without it and without `delivered` it was given up. `why` is the last error.
    """

    number: int
    id: str
    arm: str
    created: float
    tries: int
    next: float | None
    delivered: float | None
    why: str


class EventAnswer(BaseModel):
    """Maintenance that was done."""

    id: int
    arm: str
    what: str
    note: str
    at: float
    who: str


class DueAnswer(BaseModel):
    """Re-identification that is due; it waits for a person unless it has begun by itself.

    `accepted` says whether its arm has an accepted set to compare with.
    """

    id: int
    arm: str
    schedule: int
    cause: str
    at: float
    accepted: bool


class ReidentificationAnswer(BaseModel):
    """Re-identification and its outcome.

    `against` is the number of the acceptance; `job` that of the step; `recorded` the run with the recording and `run`
    the one with the parameters and the comparison. `detail` says what has changed, or why there is no verdict.
    """

    id: str
    arm: str
    step: Literal["check", "run", "identify", "judge"]
    state: Literal[
        "running", "unchanged", "changed", "impossible", "refused", "failed", "faulted", "cancelled", "interrupted"
    ]
    motion: str | None
    against: int
    unattended: bool
    job: str | None
    recorded: str | None
    run: str | None
    detail: str
    begun: float
    begun_by: str
    ended: float | None


class AlarmAnswer(BaseModel):
    """Drift alarm: what has changed, in words; it stands while `closed` is null, `how` says how it ended."""

    id: int
    arm: str
    reidentification: str
    run: str
    what: str
    at: float
    closed: float | None
    closed_by: str | None
    how: str


router = api_router("maintenance", 404, 409)
Number = Annotated[int, Path(ge=1, lt=2**62)]
Words = Annotated[str, Field(min_length=1, max_length=LONGEST_NOTE)]


class NewSchedule(RequestBody):
    """Schedule of an arm's re-identification: exactly one of cron (UTC), operating hours, maintenance."""

    arm: ArmName
    cron: Annotated[str, Field(max_length=200)] | None = None
    hours: Annotated[float, Field(gt=0, lt=1e6)] | None = None
    maintenance: bool = False
    motion: Id | None = None


class Enabled(RequestBody):
    """State of a schedule: enabled or disabled."""

    enabled: bool


class Event(RequestBody):
    """Maintenance that was done."""

    what: Annotated[str, Field(min_length=1, max_length=planned.LONGEST_WHAT)]
    note: Annotated[str, Field(max_length=LONGEST_NOTE)] = ""


class Remark(RequestBody):
    """Decision of a person, with a reason."""

    note: Words


class NewReidentification(RequestBody):
    """Request to re-identify an arm now; it moves twice, for the preflight and for the run."""

    arm: ArmName
    motion: Id | None = None
    confirm: Confirmation | None = None


@router.get("/schedules")
def list_schedules(service: Serving, _: Viewer, arm: ArmName | None = None) -> list[ScheduleAnswer]:
    """List schedules, or those of an arm."""
    return [ScheduleAnswer(**row) for row in planned.schedules(service.db, arm)]


@router.post("/schedules", status_code=201)
def add_schedule(service: Serving, who: Operator, body: NewSchedule) -> ScheduleAnswer:
    """Schedule the re-identification of an arm by cron, operating hours or maintenance."""
    when = planned.DueRule(body.cron, body.hours, body.maintenance)
    row = planned.add_schedule(service.db, _arm(service, body.arm), when, who.name, time.time(), body.motion)
    return ScheduleAnswer(**row)


@router.post("/schedules/{number}/enabled")
def enable_schedule(service: Serving, who: Operator, number: Number, body: Enabled) -> ScheduleAnswer:
    """Enable a schedule from now on, or disable it."""
    row = planned.enable_schedule(service.db, number, who.name, time.time(), enabled=body.enabled)
    return ScheduleAnswer(**row)


@router.delete("/schedules/{number}", status_code=204)
def remove_schedule(service: Serving, who: Operator, number: Number) -> None:
    """Remove a schedule."""
    planned.remove_schedule(service.db, number, who.name)


@router.get("/arms/{arm}/maintenance", responses=PAGES)
def list_maintenance(
    page: Page, service: Serving, _: Viewer, arm: ArmName, before: BeforeNumber = None, most: Most = 100
) -> list[EventAnswer]:
    """List the maintenance of an arm, the newest first."""
    name = _arm(service, arm)
    found = page(most, lambda n: planned.events(service.db, name, before=before, most=n))
    return [EventAnswer(**row) for row in found]


@router.post("/arms/{arm}/maintenance", status_code=201)
def add_maintenance(service: Serving, who: Operator, arm: ArmName, body: Event) -> EventAnswer:
    """Enter maintenance that was done; re-identifications that are scheduled after maintenance fall due.

    They may begin by themselves where that is allowed.
    """
    row = planned.add_event(service.db, _arm(service, arm), body.what, body.note, who.name, time.time())
    return EventAnswer(**row)


@router.get("/due")
def list_due(service: Serving, _: Viewer, arm: ArmName | None = None) -> list[DueAnswer]:
    """List re-identifications that are due and neither dismissed nor done since, the earliest first."""
    return [DueAnswer(**row) for row in planned.pending_with_accepted(service.db, service.state, arm)]


@router.post("/due/{number}/dismiss", status_code=204)
def dismiss_due(service: Serving, who: Operator, number: Number, body: Remark) -> None:
    """Dismiss a due re-identification, on a person's decision."""
    planned.dismiss(service.db, number, body.note, who.name, time.time())


@router.get("/reidentifications", responses=PAGES)
def list_reidentifications(
    page: Page, service: Serving, _: Viewer, arm: ArmName | None = None, before: BeforeId = None, most: Most = 100
) -> list[ReidentificationAnswer]:
    """List re-identifications, the newest first."""
    found = page(most, lambda n: reidentifications(service.db, arm, before=before, most=n))
    return [_answer(service, row) for row in found]


@router.post("/reidentifications", status_code=201)
def begin_reidentification(service: Serving, who: Operator, body: NewReidentification) -> ReidentificationAnswer:
    """Begin to re-identify an arm, confirmed as a motion is: preflight, run, identify, compare with the accepted set.

    The lease is renewed until the arm has come to rest.
    """
    arm = _arm(service, body.arm)
    require_confirmed(service, arm, body.confirm, who.name)
    return _answer(
        service, service.scheduler.reidentifications.begin(ReidentificationRequest(arm, body.motion), who.name)
    )


@router.get("/reidentifications/{name}")
def get_reidentification(service: Serving, _: Viewer, name: Id) -> ReidentificationAnswer:
    """Show a re-identification."""
    return _answer(service, known_reidentification(service.db, name))


@router.post("/reidentifications/{name}/lease")
async def renew_reidentification(service: Serving, who: LeaseKeeper, name: Id) -> LeaseAnswer:
    """Renew the lease of a re-identification's present step; if that moves nothing, only answer the same."""
    step = service.scheduler.reidentifications.present_step(name)
    if step is None:
        row = await run_in_threadpool(known_reidentification, service.db, name)
        step = row["begun_by"], row["job"]
    if step[0] != who.name:
        raise HTTPException(403, "only the requester of a motion renews its lease")
    if step[1] is not None:
        service.engine.live.renew(step[1])
    return LeaseAnswer(job=step[1] or "", seconds=LEASE_SECONDS)


@router.get("/alarms", responses=PAGES)
def list_alarms(
    page: Page,
    service: Serving,
    _: Viewer,
    arm: ArmName | None = None,
    closed: bool = False,
    before: BeforeNumber = None,
    most: Most = 100,
) -> list[AlarmAnswer]:
    """List drift alarms that stand, or with `closed` all that ever were raised, the newest first."""
    found = page(most, lambda n: raised.alarms(service.db, arm, closed=closed, before=before, most=n))
    return [AlarmAnswer(**row) for row in found]


@router.post("/alarms/{number}/ack")
def acknowledge_alarm(service: Serving, who: Operator, number: Number, body: Remark) -> AlarmAnswer:
    """Acknowledge a drift alarm, on a person's decision; the accepted set stays as it is."""
    return AlarmAnswer(**raised.acknowledge_alarm(service.db, number, body.note, who.name, time.time()))


@router.get("/deliveries", responses=PAGES)
def list_deliveries(
    page: Page, service: Serving, _: Viewer, before: BeforeNumber = None, most: Most = 100
) -> list[DeliveryAnswer]:
    """List notices to the webhook and what became of them, the newest first."""
    found = page(most, lambda n: deliveries(service.db, before=before, most=n), "number")
    return [DeliveryAnswer(**row) for row in found]


def _arm(service: Service, arm: str) -> str:
    return known_arm(service.db, service.state, arm).name


def _answer(service: Service, row: Row) -> ReidentificationAnswer:
    return ReidentificationAnswer(**{**row, "detail": without_paths(row["detail"], str(service.state))})
