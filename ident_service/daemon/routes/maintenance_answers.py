"""Define the answers about schedules, maintenance and re-identification; times as in `daemon/responses.py`."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel


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
    """Re-identification that is due; it waits for a person unless it has begun by itself."""

    id: int
    arm: str
    schedule: int
    cause: str
    at: float


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
