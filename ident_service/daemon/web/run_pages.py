"""Serve the pages of runs: history, one run with its files and actions, comparison; and the audit trail."""

from __future__ import annotations

from typing import Annotated, Final

from fastapi import APIRouter, Query, Response
from fastapi.responses import HTMLResponse

from ident_service.daemon.dependencies import Serving, Viewer
from ident_service.daemon.jobs.requests import ArmName, Id
from ident_service.daemon.responses import BeforeId
from ident_service.daemon.routes import runs
from ident_service.daemon.routes.about import AUDIT_SECONDS
from ident_service.daemon.web.forms import PageRoute
from ident_service.daemon.web.render import page
from ident_service.errors import UsageError
from ident_service.registry import runs as known
from ident_service.registry.database import audit_log
from ident_service.registry.runs import REPORTS

router = APIRouter(include_in_schema=False, route_class=PageRoute)
# `POLICY` is for a page with an inline style that loads nothing else.
_RUNS: Final = 200  # of one page
POLICY: Final = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'none'; sandbox"


@router.get("/runs")
def list_runs(service: Serving, who: Viewer, arm: ArmName | None = None, before: BeforeId = None) -> Response:
    """List runs, the newest first."""
    sets = {row["run"]: row for row in service.db.rows("SELECT * FROM parameter_sets")}
    found = known.runs(service.db, arm, before=before, most=_RUNS + 1)
    return page("runs", who, arm=arm, runs=found[:_RUNS], more=len(found) > _RUNS, sets=sets)


@router.get("/runs/{run}")
def show_run(service: Serving, who: Viewer, run: Id) -> Response:
    """Show one run."""
    answer = runs.get_run(service, who, run)
    sets = service.db.rows("SELECT run FROM parameter_sets WHERE arm = ? AND run <> ?", answer.arm, answer.id)
    reported = (service.state / REPORTS / f"{answer.id}.html").is_file()
    recorded = service.db.rows(
        "SELECT id FROM runs WHERE arm = ? AND id <> ? AND kind IN ('motion', 'recording') "
        "ORDER BY created DESC LIMIT 50",
        *(answer.arm, answer.id),
    )
    others = [row["run"] for row in sets]
    return page("run", who, run=answer, reported=reported, others=others, recorded=recorded)


@router.get("/compare")
def compare(service: Serving, who: Viewer, reference: Id, other: Id) -> Response:
    """Show the comparison of two runs' parameters, as `ident compare` writes it."""
    # Imported only when a comparison is asked for, so that the service starts without these modules.
    from ident_service.operations.parameter_files import compare_files
    from ident_service.results.comparison.presentation import comparison_html

    if reference == other:
        raise UsageError("choose two different runs to compare")
    comparison, _ = compare_files([known.run_folder(service.db, service.state, one) for one in (reference, other)])
    text = comparison_html(comparison).replace(f"{service.state / known.RUNS}/", "")
    return HTMLResponse(text, headers={"Content-Security-Policy": POLICY})


@router.get("/audit")
def audit(service: Serving, who: Viewer, before: Annotated[int, Query(ge=0, lt=2**62)] | None = None) -> Response:
    """List the lines of the audit trail, the newest first."""
    service.engine.audit.flush(AUDIT_SECONDS)
    lines = audit_log(service.db, before=before, most=100)
    return page("audit", who, lines=lines, more=len(lines) == 100)
