"""Serve the routes about runs: their records, recordings, parameters, files and reports."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Request, Response
from fastapi.responses import FileResponse
from pydantic import BaseModel, ConfigDict, Field

from ident_service.daemon.dependencies import Operator, Serving, Viewer
from ident_service.daemon.errors import failures, operation_id
from ident_service.daemon.jobs.requests import ArmName, FileName, Id
from ident_service.daemon.responses import (
    PAGES,
    BeforeId,
    Most,
    Page,
    ParametersAnswer,
    RecordingAnswer,
    RunAnswer,
    RunLine,
    SeriesAnswer,
)
from ident_service.errors import UnknownId
from ident_service.registry import runs
from ident_service.registry.database import Row
from ident_service.registry.runs import REPORTS

router = APIRouter(prefix="/api/v1", tags=["runs"], responses=failures(404), generate_unique_id_function=operation_id)
_REPORT = "report.html"
_BINARY: dict[int | str, dict[str, Any]] = {
    200: {"content": {"application/octet-stream": {}}, "description": "The file."},
    **failures(404),
}
# Content security policy of the report: its inline style and script run in a sandbox and can reach nothing.
_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:; frame-ancestors 'self'; "
    "sandbox allow-scripts allow-downloads"
)
_PAGE: dict[int | str, dict[str, Any]] = {
    200: {"content": {"text/html": {}}, "description": "The report."},
    **failures(404),
}


class Labels(BaseModel):
    """Tags and note of a run: whoever looks for it finds it again by them."""

    model_config = ConfigDict(extra="forbid")
    tags: Annotated[list[Annotated[str, Field(max_length=40)]], Field(max_length=runs.MOST_TAGS)] = []
    note: Annotated[str, Field(max_length=runs.LONGEST_NOTE)] = ""


@router.get("/runs", responses=PAGES)
def list_runs(
    page: Page, service: Serving, _: Viewer, arm: ArmName | None = None, before: BeforeId = None, most: Most = 100
) -> list[RunLine]:
    """List runs, the newest first."""
    labels = runs.run_labels(service.db)
    found = page(most, lambda n: runs.runs(service.db, arm, before=before, most=n))
    return [RunLine(**row, **_labelled(labels.get(row["id"]))) for row in found]


@router.get("/runs/{run}")
def get_run(service: Serving, _: Viewer, run: Id) -> RunAnswer:
    """Show a run: its ending, files, recordings and parameters."""
    row, found = runs.known_run(service.db, run), runs.parameter_set(service.db, run)
    return RunAnswer(
        **row,
        **_labelled(runs.run_labels(service.db, row["id"]).get(row["id"])),
        files=runs.run_files(service.db, service.state, run),
        recordings=[RecordingAnswer(**one) for one in runs.recordings(service.db, run)],
        parameters=None if found is None else ParametersAnswer(**found),
    )


@router.post("/runs/{run}/labels")
def label_run(service: Serving, who: Operator, run: Id, body: Labels) -> RunAnswer:
    """Give a run its tags and its note, in place of those that it had."""
    runs.label_run(service.db, run, body.tags, body.note, who.name)
    return get_run(service, who, run)


@router.get("/runs/{run}/series", response_model=SeriesAnswer)
def get_series(service: Serving, _: Viewer, request: Request, run: Id, name: FileName | None = None) -> Response:
    """Show the recording of a run, thinned for display."""
    chosen = name or runs.recording_name(service.db, run)
    path = runs.run_file(service.db, service.state, run, chosen)
    sha256 = runs.run_files(service.db, service.state, run)[chosen]
    return Response(request.app.state.series.document(path.parent, chosen, sha256), media_type="application/json")


@router.get("/runs/{run}/files/{name}", response_class=FileResponse, responses=_BINARY)
def get_file(service: Serving, _: Viewer, run: Id, name: FileName) -> FileResponse:
    """Download a file that the manifest of a run names; never shown as a page."""
    path = runs.run_file(service.db, service.state, run, name)
    return FileResponse(path, media_type="application/octet-stream", filename=name)


@router.get("/runs/{run}/report.html", response_class=FileResponse, responses=_PAGE)
def get_report(service: Serving, _: Viewer, run: Id) -> FileResponse:
    """Show the report of a run: the newest that a job of the kind `report` has made, else the run's own."""
    path = service.state / REPORTS / f"{runs.known_run(service.db, run)['id']}.html"
    if not path.is_file() and _REPORT in runs.run_files(service.db, service.state, run):
        path = runs.run_file(service.db, service.state, run, _REPORT)
    if not path.is_file():
        raise UnknownId(f"the run {run} has no report yet; ask for a job of the kind report")
    return FileResponse(path, media_type="text/html", headers={"Content-Security-Policy": _POLICY})


def _labelled(row: Row | None) -> dict[str, Any]:
    return {} if row is None else {"tags": row["tags"], "note": row["note"]}
