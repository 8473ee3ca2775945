"""Turn errors into one model of failure with the fitting HTTP status."""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Callable
from dataclasses import asdict
from http import HTTPStatus
from typing import Any, Final

from fastapi import APIRouter, FastAPI, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.routing import APIRoute
from starlette.exceptions import HTTPException

from ident_service import errors
from ident_service.daemon.responses import FAILURE_SCHEMA
from ident_service.registry.database import FILE, shortage

_STATUS: Final[tuple[tuple[type[errors.IdentError], int], ...]] = (
    (errors.UnknownId, 404),
    (errors.AlreadyThere, 409),
    (errors.InUse, 409),
    (errors.UsageError, 400),
    (errors.ConfigError, 422),
    (errors.ModelError, 422),
    (errors.ParameterError, 422),
    (errors.RecordingError, 422),
    (errors.MotionRefused, 409),
    (errors.DiskFull, 507),
    (errors.Unavailable, 503),
    (errors.ArmError, 409),
)
_KINDS: Final = {413: "TooLarge"}  # whose phrase is another one in each version of Python
_LOG = logging.getLogger("ident.http")
_WORDS: Final = {
    400: "The request is invalid.",
    401: "No token or session, or an invalid one.",
    403: "Not allowed for this role, or not from this page.",
    404: "Not found.",
    405: "Method not allowed.",
    409: "Not possible at present: a fault, a lease, another motion, a name that is taken, or references to it.",
    413: "Too large.",
    421: "Wrong host name.",
    422: "The request has mistakes; the message names them.",
    429: "Too many failed attempts.",
    503: "Temporarily impossible: try again after `Retry-After` seconds.",
    507: "The disk, or the registry's share of it, is full.",
}


ANYWAY: Final = "; `?anyway=true` deletes it all the same"


def failures(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI `responses` of a route: these failure statuses and those that any route may have.

    They refer to `Failure`; with that as their model, FastAPI would make a validator of each status of each route.
    """
    every = sorted({400, 401, 403, 413, 421, 422, 429, 503, 507, *statuses})
    content = {"application/json": {"schema": {"$ref": FAILURE_SCHEMA}}}
    return {status: {"description": _WORDS[status], "content": content} for status in every}


def operation_id(route: APIRoute) -> str:
    """Return the function's name as the operation id of a route, for generated clients."""
    return route.name


def api_router(tag: str, *statuses: int) -> APIRouter:
    """Return a router of `/api/v1` whose routes may have these failure statuses besides those that any may have."""
    return APIRouter(
        prefix="/api/v1", tags=[tag], responses=failures(*statuses), generate_unique_id_function=operation_id
    )


def status_of(error: errors.IdentError) -> int:
    """Return the HTTP status for an error by its class; 500 for a class that has none."""
    return next((status for kind, status in _STATUS if isinstance(error, kind)), 500)


def install_error_handlers(app: FastAPI, failure_page: Callable[[Request, int, str], Response]) -> None:
    """Install the exception handlers that turn every error into a `Failure`, or an unknown page into a page.

    Args:
        app: the application.
        failure_page: function that renders a failure from a request, a status and words.
    """

    async def _resources(request: Request, error: Exception) -> JSONResponse:
        if (short := _short_of(request, error)) is None:
            raise error  # a mistake of ours: the last handler tells it
        status, kind, words, headers = short
        _LOG.error("%s: %s", words, error, extra={"path": request.url.path})
        return _answer(status, kind, words, headers)

    app.add_exception_handler(sqlite3.Error, _resources)
    app.add_exception_handler(OSError, _resources)

    @app.exception_handler(errors.IdentError)
    async def _ident(request: Request, error: errors.IdentError) -> JSONResponse:
        for cause in (error, error.__context__):
            if (
                isinstance(cause, OSError | sqlite3.Error | errors.Unavailable)
                and _short_of(request, cause) is not None
            ):
                return await _resources(request, cause)
        status = status_of(error)
        if status == HTTPStatus.INTERNAL_SERVER_ERROR:
            _LOG.error("an answer failed", exc_info=error)
        more = {"dependents": [asdict(one) for one in error.dependents]} if isinstance(error, errors.InUse) else {}
        hint = ANYWAY if more.get("dependents") else ""
        return _answer(status, type(error).__name__, f"{error}{hint}", more=more)

    @app.exception_handler(RequestValidationError)
    async def _invalid(_: Request, error: RequestValidationError) -> JSONResponse:
        said = "; ".join(
            f"{'.'.join(map(str, one['loc']))}: {errors.plain_mistake(one)}" for one in error.errors()[:10]
        )
        return _answer(422, "InvalidRequest", said)

    @app.exception_handler(HTTPException)
    async def _http(request: Request, error: HTTPException) -> Response:
        path, accepted = request.url.path, request.headers.get("accept", "")
        if error.status_code == HTTPStatus.NOT_FOUND and "text/html" in accepted and not path.startswith("/api/"):
            return await run_in_threadpool(failure_page, request, 404, f"There is no page {path} here.")
        kind = _KINDS.get(error.status_code) or HTTPStatus(error.status_code).phrase.title().replace(" ", "")
        return _answer(error.status_code, kind, str(error.detail), dict(error.headers or {}))

    @app.exception_handler(Exception)
    async def _ours(_: Request, error: Exception) -> JSONResponse:
        _LOG.error("an answer failed", exc_info=error)
        return _answer(500, "InternalError", "the service failed; its log says how")


def _short_of(request: Request, error: Exception) -> tuple[int, str, str, dict[str, str]] | None:
    """Return the answer for a lack of a resource (locked registry, full disk); None for any other error."""
    found = error
    if not isinstance(error, errors.Unavailable):
        found = shortage(request.app.state.service.state / FILE, error) or error
    if isinstance(found, errors.RegistryBusy):
        return 503, "RegistryBusy", "another process has locked the registry; try again", {"Retry-After": "2"}
    if isinstance(found, errors.DiskFull):
        return 507, "DiskFull", "the disk of the state folder is full; free space, then try again", {}
    return None


def _answer(
    status: int, kind: str, message: str, headers: dict[str, str] | None = None, more: dict[str, Any] | None = None
) -> JSONResponse:
    # The request may hold characters that cannot be encoded; they must not prevent an answer.
    message = message.encode("utf-8", "replace").decode("utf-8")
    return JSONResponse({"error": {"kind": kind, "message": message, **(more or {})}}, status, headers=headers)
