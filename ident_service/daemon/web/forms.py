"""Parse the forms of page routes, and render their failures as pages.

A form must come from a page of this service: besides the cookie, which other sites do not send, its Origin header must
be present and this service's (`daemon/request_guard.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from http import HTTPStatus
from typing import Annotated, Any
from urllib.parse import parse_qsl, quote

from fastapi import Depends, HTTPException, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import RedirectResponse
from fastapi.routing import APIRoute
from pydantic import ValidationError

from ident_service.daemon.dependencies import COOKIE, service_of
from ident_service.daemon.errors import status_of
from ident_service.daemon.web.render import page
from ident_service.errors import IdentError, plain_mistake

_MOST_FIELDS = 64


async def form_of(request: Request) -> dict[str, str]:
    """Return the fields of a form, the last of each name; raise 403 without an Origin header, 400 if it is no form.

    Raises:
        HTTPException: 403 where it does not say which page it comes from, 400 where it is none.
    """
    if "origin" not in request.headers:
        raise HTTPException(403, "a form says which page it comes from; use the pages of this service")
    try:
        return dict(
            parse_qsl((await request.body()).decode("utf-8"), keep_blank_values=True, max_num_fields=_MOST_FIELDS)
        )
    except ValueError:
        raise HTTPException(400, "not a form of this service") from None


Form = Annotated[dict[str, str], Depends(form_of)]


class PageRoute(APIRoute):
    """Route whose failures are pages; a caller who is not logged in is sent to the login page."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Return the handler, wrapped so that its errors become pages, and a 401 a redirect to the login page."""
        handler = super().get_route_handler()

        async def handle(request: Request) -> Response:
            try:
                return await handler(request)
            except HTTPException as error:
                if error.status_code == HTTPStatus.UNAUTHORIZED:
                    return RedirectResponse(_login_url(request), 303)
                return failure(request, error.status_code, str(error.detail))
            except (RequestValidationError, ValidationError) as error:
                return failure(request, 422, words_of(error))
            except IdentError as error:
                return failure(request, status_of(error), str(error))

        return handle


def words_of(error: IdentError | RequestValidationError | ValidationError) -> str:
    """Return what is wrong with a request in words: the error's own, or up to five mistakes found by pydantic."""
    if isinstance(error, IdentError):
        return str(error)
    found = [(".".join(str(part) for part in one["loc"] if part != "query"), one) for one in error.errors()[:5]]
    return "; ".join(f"{place}: {plain_mistake(one)}" for place, one in found)


def failure(request: Request, status: int, words: str) -> Response:
    """Return a failure as a page."""
    service = service_of(request)
    cookie = request.cookies.get(COOKIE)
    who = service.authenticator.known(None, cookie)
    title = HTTPStatus(status).phrase
    words = words.replace(f"{service.state}/", "").encode("utf-8", "replace").decode()
    return page("failure", who, status, title=title, words=words)


def see_other(address: str) -> RedirectResponse:
    """Redirect to an address after a form (303 See Other)."""
    return RedirectResponse(address, 303)


def local_path(address: str) -> str:
    """Return the address if it is a path on this service, else `/`."""
    good = address.startswith("/") and not address.startswith("//") and "\\" not in address and address.isprintable()
    return address if good else "/"


def _login_url(request: Request) -> str:
    where = request.url.path if request.method == "GET" else "/"
    query = f"?{request.url.query}" if request.method == "GET" and request.url.query else ""
    return f"/login?next={quote(where + query, safe='')}"
