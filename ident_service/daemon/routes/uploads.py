"""Serve the routes about uploads: a recording arrives in pieces, and becomes a run that jobs can use."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Any, Final

from fastapi import Header, HTTPException, Request
from fastapi.concurrency import run_in_threadpool
from pydantic import BaseModel, Field
from starlette.requests import ClientDisconnect

from ident_service.daemon import uploads
from ident_service.daemon.dependencies import Operator, Serving, Viewer
from ident_service.daemon.errors import api_router, failures
from ident_service.daemon.jobs.requests import ArmName, FileName, Id, RequestBody
from ident_service.errors import IdentError

router = api_router("uploads", 404)
_PIECE: Final[dict[str, Any]] = {
    "requestBody": {
        "required": True,
        "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
    }
}
Offset = Annotated[int, Header(ge=0, lt=2**62, description="of the piece's first byte in the recording")]


class NewUpload(RequestBody):
    """Recording that is to be uploaded.

    `columns` is YAML that says how a CSV is laid out (`docs/recordings.md`), where the arm's description does not.
    """

    arm: ArmName
    name: FileName
    bytes: Annotated[int, Field(ge=1, le=uploads.MOST_BYTES)]
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    columns: Annotated[str, Field(max_length=uploads.MOST_COLUMNS)] = ""


class UploadAnswer(BaseModel):
    """Upload: `received` is the offset of the next piece, `run` the id of the run that it has become."""

    id: str
    arm: str
    name: str
    bytes: int
    sha256: str
    received: int
    run: str | None


@router.post("/uploads", status_code=201)
def begin_upload(service: Serving, who: Operator, body: NewUpload) -> UploadAnswer:
    """Begin to upload a recording, or resume the same person's; return how much has arrived, or the run it became."""
    announced = uploads.Announced(**body.model_dump(), by=who.name)
    try:
        return _answer(uploads.begin_upload(service.db, service.state, announced))
    except uploads.NoRoom as error:
        raise HTTPException(507, error.strerror) from None


@router.get("/uploads")
def list_uploads(service: Serving, _: Viewer) -> list[UploadAnswer]:
    """List the uploads that are under way."""
    return [_answer(one) for one in uploads.uploads(service.state)]


@router.get("/uploads/{upload}")
def get_upload(service: Serving, _: Viewer, upload: Id) -> UploadAnswer:
    """Show how much of a recording has arrived."""
    return _answer(uploads.known_upload(service.state, upload))


@router.patch("/uploads/{upload}", responses=failures(404, 409), openapi_extra=_PIECE)
async def add_piece(request: Request, service: Serving, _: Operator, upload: Id, upload_offset: Offset) -> UploadAnswer:
    """Send the next piece of a recording, 8 MiB at most; what came of a broken-off one stays, of a refused one not."""
    with await run_in_threadpool(uploads.Piece, service.state, upload, upload_offset) as piece:
        try:
            async for data in request.stream():
                await run_in_threadpool(piece.write, data)
        except ClientDisconnect:
            raise HTTPException(400, "the piece broke off; go on after what has arrived of it") from None
        except (IdentError, HTTPException):  # more bytes than were announced, or than a piece may have
            await run_in_threadpool(piece.withdraw)
            raise
    await run_in_threadpool(uploads.require_header, service.db, service.state, upload)
    return _answer(await run_in_threadpool(uploads.known_upload, service.state, upload))


@router.post("/uploads/{upload}/complete", status_code=201, responses=failures(404, 409))
def complete_upload(service: Serving, who: Operator, upload: Id) -> UploadAnswer:
    """Check the hash of a recording that has arrived, and make a run of it; a wrong one is deleted."""
    return _answer(uploads.complete_upload(service.db, service.state, upload, who.name))


@router.delete("/uploads/{upload}", status_code=204)
def delete_upload(service: Serving, _: Operator, upload: Id) -> None:
    """Delete what has arrived of a recording that is not wanted any more."""
    uploads.delete_upload(service.state, upload)


def _answer(seen: uploads.Upload) -> UploadAnswer:
    return UploadAnswer(**asdict(seen.announced), id=seen.id, received=seen.received, run=seen.run)
