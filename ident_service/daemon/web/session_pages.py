"""Serve login and logout, the static files of pages, and the stop that works without scripts."""

from __future__ import annotations

from typing import Annotated, Final
from urllib.parse import urlsplit

from fastapi import APIRouter, HTTPException, Query, Request, Response

from ident_service.daemon.dependencies import Cookie, Near, Serving
from ident_service.daemon.routes import about
from ident_service.daemon.routes.jobs import stop_all
from ident_service.daemon.web.forms import Form, PageRoute, local_path, see_other
from ident_service.daemon.web.render import (
    STATIC,
    VENDORED,
    VIEWER,
    page,
    static_files,
    static_version,
    viewer_file,
    viewer_page,
    viewer_version,
)

router = APIRouter(include_in_schema=False, route_class=PageRoute)
_KEPT: Final = {"Cache-Control": "public, max-age=31536000, immutable"}
Next = Annotated[str, Query(alias="next", max_length=500)]


@router.get("/login")
def show_login(where: Next = "/") -> Response:
    """Show the form that asks for a token."""
    return page("login", None, where=local_path(where), problem="")


@router.post("/login")
def log_in(service: Serving, request: Request, form: Form) -> Response:
    """Exchange the form's token for a session and go to the page asked for, or show the form again."""
    where, answer = local_path(form.get("next", "/")), see_other(local_path(form.get("next", "/")))
    try:
        about.login(service, request, answer, about.Login(token=form.get("token", "").strip()[:200] or "none"))
    except HTTPException as error:
        words = "This token is not valid." if error.status_code == 401 else str(error.detail)
        return page("login", None, error.status_code, where=where, problem=words)
    return answer


@router.post("/logout")
def log_out(service: Serving, form: Form, cookie: Cookie = None) -> Response:
    """End the session."""
    del form  # reading the form has checked that it comes from a page of this service
    answer = see_other("/login")
    about.logout(service, answer, cookie)
    return answer


@router.get("/api/docs")
def show_api() -> Response:
    """Show the description of the API, which anybody may read."""
    return viewer_page()


@router.get("/static/{version}/{name}")
def static_file(version: str, name: str) -> Response:
    """Return a style sheet or script, for browsers to keep; 404 unless the address has the present version."""
    if (version, name) == (viewer_version(), VIEWER):
        return Response(viewer_file(), media_type="text/javascript", headers=_KEPT)
    kind = {**STATIC, **VENDORED}.get(name)
    if kind is None or version != static_version():
        raise HTTPException(404, "no such file; load the page again")
    return Response(static_files()[name], media_type=kind, headers=_KEPT)


@router.post("/stop")
async def stop(service: Serving, request: Request, near: Near, cookie: Cookie = None) -> Response:
    """Bring all arms to a controlled stop and show a page of those reached; whoever may by the API may here."""
    done = await stop_all(service, near)
    back = local_path(urlsplit(request.headers.get("referer", "")).path or "/")
    who = service.authenticator.known(None, cookie)
    return page("stopped", who, arms=done.arms, jobs=done.jobs, back="/" if back == "/stop" else back)
