"""Serve the page of an arm's maintenance: what is due, schedules, past maintenance; and acknowledge drift alarms.

A form with a mistake comes back as it was filled in, with the words that the API has for it.
"""

from __future__ import annotations

from typing import Any, Final

from fastapi import APIRouter, Response
from pydantic import ValidationError

from ident_service.daemon.dependencies import Operator, Service, Serving, Viewer
from ident_service.daemon.errors import status_of
from ident_service.daemon.jobs.requests import ArmName
from ident_service.daemon.routes import arms, maintenance
from ident_service.daemon.routes.maintenance import Number
from ident_service.daemon.web.forms import Form, PageRoute, see_other, words_of
from ident_service.daemon.web.render import page
from ident_service.errors import IdentError, UsageError
from ident_service.operations import maintenance_schedule as planned
from ident_service.registry import motions as known_motions
from ident_service.registry.database import LONGEST_NOTE, Row
from ident_service.registry.runs import operating_seconds
from ident_service.registry.tokens import Access

router = APIRouter(include_in_schema=False, route_class=PageRoute)
_HOURS: Final = "hours:"
_HOUR = 3600.0


@router.get("/arms/{arm}/maintenance")
def show(service: Serving, who: Viewer, arm: ArmName) -> Response:
    """Show what is due, by which schedules, and what maintenance was done."""
    return _page(service, who, arm)


@router.post("/arms/{arm}/schedules")
def add_schedule(service: Serving, who: Operator, arm: ArmName, form: Form) -> Response:
    """Add the form's schedule, or show the page again with what is wrong in the form."""
    when = form.get("when", "")
    body: dict[str, Any] = {"arm": arm, "maintenance": when == "maintenance"}
    if when in ("cron", "hours"):
        body[when] = form.get(when, "").strip()
    if form.get("motion"):
        body["motion"] = form["motion"]
    try:
        maintenance.add_schedule(service, who, maintenance.NewSchedule.model_validate(body))
    except (IdentError, ValidationError) as error:
        return _page(service, who, arm, form, error, "schedule")
    return see_other(f"/arms/{arm}/maintenance#schedules")


@router.post("/schedules/{number}/enabled")
def enable_schedule(service: Serving, who: Operator, number: Number, form: Form) -> Response:
    """Enable a schedule from now on if the form's `wanted` is `enable`, else disable it."""
    wanted = maintenance.Enabled(enabled=form.get("wanted") == "enable")
    row = maintenance.enable_schedule(service, who, number, wanted)
    return see_other(f"/arms/{row.arm}/maintenance#schedules")


@router.post("/schedules/{number}/remove")
def remove_schedule(service: Serving, who: Operator, number: Number, form: Form) -> Response:
    """Remove a schedule."""
    del form  # reading the form has checked that it comes from a page of this service
    arm = planned.known_schedule(service.db, number)["arm"]
    maintenance.remove_schedule(service, who, number)
    return see_other(f"/arms/{arm}/maintenance#schedules")


@router.post("/arms/{arm}/maintenance")
def add_maintenance(service: Serving, who: Operator, arm: ArmName, form: Form) -> Response:
    """Enter maintenance that was done; schedules that follow maintenance become due."""
    body = {"what": form.get("what", "").strip(), "note": form.get("note", "").strip()}
    try:
        maintenance.add_maintenance(service, who, arm, maintenance.Event.model_validate(body))
    except (IdentError, ValidationError) as error:
        return _page(service, who, arm, form, error, "event")
    return see_other(f"/arms/{arm}/maintenance#due")


@router.post("/due/{number}/dismiss")
def dismiss(service: Serving, who: Operator, number: Number, form: Form) -> Response:
    """Dismiss a due re-identification, on a person's decision."""
    arm = next((row["arm"] for row in planned.pending(service.db) if row["id"] == number), None)
    if arm is None:
        raise UsageError(f"nothing of number {number} is due any more")
    maintenance.dismiss_due(service, who, number, maintenance.Remark(note=form.get("note", "").strip()))
    return see_other(f"/arms/{arm}/maintenance#due")


@router.post("/alarms/{number}/ack")
def acknowledge(service: Serving, who: Operator, number: Number, form: Form) -> Response:
    """Acknowledge a drift alarm for a person; the accepted set stays as it is."""
    body = maintenance.Remark(note=form.get("note", "").strip())
    return see_other(f"/arms/{maintenance.acknowledge_alarm(service, who, number, body).arm}")


def _page(
    service: Service,
    who: Access,
    arm: str,
    form: dict[str, str] | None = None,
    problem: IdentError | ValidationError | None = None,
    where: str = "",
) -> Response:
    """Return the page; after a mistake with the form as it was filled in, and the error beside it."""
    answer = arms.get_arm(service, who, arm)
    driven = operating_seconds(service.db, answer.name)
    status = 200 if problem is None else 422 if isinstance(problem, ValidationError) else status_of(problem)
    return page(
        "maintenance",
        who,
        status,
        arm=answer,
        dues=planned.pending(service.db, answer.name),
        schedules=[_line(row, driven) for row in planned.schedules(service.db, answer.name)],
        events=planned.events(service.db, answer.name, most=50),
        motions=known_motions.motions(service.db, answer.name),
        hours=driven / _HOUR,
        filled=form or {},
        problem="" if problem is None else words_of(problem),
        where=where,
        longest={"what": planned.LONGEST_WHAT, "note": LONGEST_NOTE},
    )


def _line(row: Row, driven: float) -> dict[str, Any]:
    """Return a schedule with words on when it is due, and what comes next."""
    if row["cron"]:
        return {**row, "words": f"at {row['cron']}", "coming": None}
    if not row["trigger"].startswith(_HOURS):
        return {**row, "words": "after maintenance", "coming": "when maintenance is entered"}
    hours = float(row["trigger"].removeprefix(_HOURS))
    left = max(0.0, hours - (driven - row["counted"]) / _HOUR)
    return {**row, "words": f"every {hours:g} operating hours", "coming": f"in {left:.3g} operating hours"}
