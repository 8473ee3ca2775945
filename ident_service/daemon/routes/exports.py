"""Serve the routes about exports: the files that jobs of the kinds export, figures, payload and correct made."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter
from fastapi.responses import FileResponse
from pydantic import BaseModel

from ident_service.daemon.dependencies import Serving, Viewer
from ident_service.daemon.errors import failures, operation_id
from ident_service.daemon.jobs.requests import FileName, Id
from ident_service.registry import runs

router = APIRouter(
    prefix="/api/v1", tags=["exports"], responses=failures(404), generate_unique_id_function=operation_id
)
_BINARY: dict[int | str, dict[str, Any]] = {
    200: {"content": {"application/octet-stream": {}}, "description": "The file."},
    **failures(404),
}


class ExportAnswer(BaseModel):
    """Export: the job that made it, and the size of each file [bytes]."""

    id: str
    kind: str
    arm: str | None
    job: str
    made: float | None
    made_by: str
    files: dict[str, int]


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
