"""Serve the routes about runs: their records, recordings, parameters, files, reports and exports, and what is deleted.

Old recordings are listed first, and deleted only with `yes`; a run in use is deleted only with `anyway`.
"""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Request, Response
from fastapi.responses import FileResponse
from pydantic import BaseModel, Field

from ident_service.daemon import responses as answers
from ident_service.daemon.dependencies import Operator, Serving, Viewer
from ident_service.daemon.errors import api_router, failures
from ident_service.daemon.jobs.requests import ArmName, FileName, Id, RequestBody
from ident_service.daemon.routes.jobs import without_paths
from ident_service.daemon.run_series import series
from ident_service.errors import UnknownId
from ident_service.operations import deletion, run_archive
from ident_service.registry import runs
from ident_service.registry.database import LONGEST_NOTE
from ident_service.registry.runs import REPORTS

router = api_router("runs", 404)
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


class Labels(RequestBody):
    """Tags and note of a run, by which it is found in lists."""

    tags: Annotated[tuple[Annotated[str, Field(max_length=40)], ...], Field(max_length=runs.MOST_TAGS)] = ()
    note: Annotated[str, Field(max_length=LONGEST_NOTE)] = ""


class ExportAnswer(BaseModel):
    """Export: the job that made it, and the size of each file [bytes]."""

    id: str
    kind: str
    arm: str | None
    job: str
    made: float | None
    made_by: str
    files: dict[str, int]


class Pruning(RequestBody):
    """Number of each arm's newest runs whose recordings are kept; nothing is deleted without `yes`."""

    keep: Annotated[int, Field(ge=1, le=1_000_000)]
    yes: Annotated[bool, Field(strict=True)] = False


class PrunedRecording(BaseModel):
    """Recording that may be deleted, or was."""

    run: str
    name: str
    bytes: int


class PruningAnswer(BaseModel):
    """Recordings that were deleted, or would be; `left_alone` says which folders could not be read, and why."""

    deleted: bool
    bytes: int
    recordings: list[PrunedRecording]
    left_alone: list[str]


@router.get("/runs", responses=answers.PAGES)
def list_runs(
    page: answers.Page,
    service: Serving,
    _: Viewer,
    arm: ArmName | None = None,
    before: answers.BeforeId = None,
    most: answers.Most = 100,
) -> list[answers.RunLine]:
    """List runs, the newest first."""
    labels = runs.run_labels(service.db)
    found = page(most, lambda n: runs.runs(service.db, arm, before=before, most=n))
    return [answers.RunLine(**row, **runs.shown_labels(labels, row["id"])) for row in found]


@router.get("/runs/{run}")
def get_run(service: Serving, _: Viewer, run: Id) -> answers.RunAnswer:
    """Show a run: its ending, files, recordings and parameters."""
    row, found = runs.known_run(service.db, run), runs.parameter_set(service.db, run)
    return answers.RunAnswer(
        **row,
        **runs.shown_labels(runs.run_labels(service.db, row["id"]), row["id"]),
        files=runs.run_files(service.db, service.state, run),
        recordings=[answers.RecordingAnswer(**one) for one in runs.recordings(service.db, run)],
        parameters=None if found is None else answers.ParametersAnswer(**found),
    )


@router.post("/runs/{run}/labels")
def label_run(service: Serving, who: Operator, run: Id, body: Labels) -> answers.RunAnswer:
    """Replace the tags and the note of a run."""
    runs.label_run(service.db, run, body.tags, body.note, who.name)
    return get_run(service, who, run)


@router.get("/runs/{run}/series", response_model=answers.SeriesAnswer)
def get_series(service: Serving, _: Viewer, request: Request, run: Id, name: FileName | None = None) -> Response:
    """Show a recording of a run, thinned for display: the named one, by default its only one or `run.mcap`."""
    chosen = name or runs.recording_name(service.db, run)
    path = runs.run_file(service.db, service.state, run, chosen)
    sha256 = runs.run_files(service.db, service.state, run)[chosen]
    key = (str(path.parent), sha256)
    text = request.app.state.series.document(key, lambda: series(path.parent, chosen))
    return Response(text, media_type="application/json")


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


@router.delete("/runs/{run}", responses=failures(404, 409))
def delete_run(service: Serving, who: Operator, run: Id, anyway: answers.Anyway = False) -> answers.DeletionAnswer:
    """Delete a run with its recordings and its report, if nothing refers to it or with `anyway`."""
    return answers.deletion_answer(run, deletion.delete_run(service.db, service.state, run, who.name, anyway=anyway))


@router.post("/recordings/prune")
def prune(service: Serving, who: Operator, body: Pruning) -> PruningAnswer:
    """List recordings beyond each arm's `keep` newest runs that nobody accepted or needs; `yes` deletes."""
    unreadable = runs.rebuild_runs(service.db, service.state)
    gone = (
        run_archive.prune(service.db, service.state, body.keep, who.name)
        if body.yes
        else run_archive.prunable_recordings(service.db, service.state, body.keep)
    )
    return PruningAnswer(
        deleted=body.yes,
        bytes=sum(one.bytes for one in gone),
        recordings=[PrunedRecording(run=one.run, name=one.name, bytes=one.bytes) for one in gone],
        left_alone=without_paths(unreadable, str(service.state)),
    )


@router.get("/exports/{export}")
def get_export(service: Serving, _: Viewer, export: Id) -> ExportAnswer:
    """Show an export and its files, by the id that its job names as its run."""
    row = runs.known_export(service.db, export)
    return ExportAnswer(
        id=row["run"],
        kind=row["kind"],
        arm=row["arm"],
        job=row["id"],
        made=row["ended"],
        made_by=row["created_by"],
        files=runs.export_files(service.db, service.state, export),
    )


@router.get("/exports/{export}/files/{name}", response_class=FileResponse, responses=_BINARY)
def get_exported_file(service: Serving, _: Viewer, export: Id, name: FileName) -> FileResponse:
    """Download a file of an export; as something to be kept, never as a page."""
    path = runs.export_file(service.db, service.state, export, name)
    return FileResponse(path, media_type="application/octet-stream", filename=name)
