"""Serve the route that deletes old recordings: they are listed first, and deleted only with `yes`."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter
from pydantic import BaseModel, ConfigDict, Field

from ident_service.daemon.dependencies import Operator, Serving
from ident_service.daemon.errors import failures, operation_id
from ident_service.daemon.routes.jobs import without_paths
from ident_service.operations import run_archive
from ident_service.registry.runs import rebuild_runs

router = APIRouter(prefix="/api/v1", tags=["runs"], responses=failures(), generate_unique_id_function=operation_id)


class Pruning(BaseModel):
    """Number of each arm's newest runs whose recordings are kept; nothing is deleted without `yes`."""

    model_config = ConfigDict(extra="forbid")
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


@router.post("/recordings/prune")
def prune(service: Serving, who: Operator, body: Pruning) -> PruningAnswer:
    """Delete old recordings of runs that nobody accepted and no job needs."""
    untold = rebuild_runs(service.db, service.state)
    gone = (
        run_archive.prune(service.db, service.state, body.keep, who.name)
        if body.yes
        else run_archive.expendable(service.db, service.state, body.keep)
    )
    return PruningAnswer(
        deleted=body.yes,
        bytes=sum(one.bytes for one in gone),
        recordings=[PrunedRecording(run=one.run, name=one.name, bytes=one.bytes) for one in gone],
        left_alone=without_paths(untold, str(service.state)),
    )
