"""Authenticate requests and provide the routes' dependencies: the service, and the caller's name and role.

A token comes as `Authorization: Bearer`, or a session of the page as a cookie. Browsers send cookies by themselves, so
a request with a cookie that changes anything must also have an Origin header (`request_guard.py` has checked that it is
this service's).
"""

from __future__ import annotations

import ipaddress
import math
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

from fastapi import Depends, HTTPException, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.security import APIKeyCookie, HTTPAuthorizationCredentials, HTTPBearer

from ident_service.daemon.authentication import Authenticator, Throttled
from ident_service.daemon.jobs.queue import Engine
from ident_service.daemon.maintenance.scheduler import MaintenanceScheduler
from ident_service.daemon.metrics import Metrics
from ident_service.daemon.routes.checks import Checks
from ident_service.daemon.settings import Settings
from ident_service.registry.database import Database
from ident_service.registry.tokens import Access

COOKIE: Final = "ident_session"
_SAFE = frozenset({"GET", "HEAD"})


WhileKnown = Callable[[AsyncIterator[str]], AsyncIterator[str]]


@dataclass(frozen=True)
class Service:
    """Components that the routes work with, as `app.state.service`."""

    settings: Settings
    db: Database
    engine: Engine
    authenticator: Authenticator
    metrics: Metrics
    scheduler: MaintenanceScheduler
    checks: Checks

    @property
    def state(self) -> Path:
        """Return the state folder."""
        return self.settings.state


def service_of(request: Request) -> Service:
    """Return the service that this request reached."""
    service = request.app.state.service
    assert isinstance(service, Service)  # noqa: S101 - `create_app` put it there
    return service


async def serving(request: Request) -> Service:
    """Return the service, as a dependency; a coroutine, so that a stop does not wait for a shared worker thread."""
    return service_of(request)


_bearer = HTTPBearer(auto_error=False, description="a token, as `ident tokens add` prints it")
_cookie = APIKeyCookie(name=COOKIE, auto_error=False, description="a session, from /api/v1/login")
Bearer = Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)]
Cookie = Annotated[str | None, Depends(_cookie)]


def address_of(request: Request) -> str:
    """Return the client address of a request; empty where it is not known."""
    return request.client.host if request.client else ""


async def access_of(request: Request, bearer: Bearer = None, cookie: Cookie = None) -> Access | None:
    """Return the caller's name and role by token or session; None without token or valid session; 401 for a bad token.

    Raises:
        HTTPException: 401 for an unknown token, 429 after too many failed attempts, 403 for a changing request with a
            session and without an Origin header.
    """
    service, found = service_of(request), None
    if bearer is not None:
        try:
            found = await run_in_threadpool(service.authenticator.by_token, bearer.credentials, address_of(request))
        except Throttled as error:
            raise throttled(error) from None
        if found is None:
            raise unknown()
    elif cookie is not None:
        found = await run_in_threadpool(service.authenticator.by_session, cookie)
        if found is not None:
            _require_page(request)
    if found is not None:
        request.state.who = found.name
    return found


def _require_page(request: Request) -> None:
    if request.method not in _SAFE and "origin" not in request.headers:
        raise HTTPException(403, "a request with a session says which page it comes from")


async def viewer(found: Annotated[Access | None, Depends(access_of)]) -> Access:
    """Return the caller, who needs a token or a session; raises 401 for others."""
    if found is None:
        raise unknown()
    return found


async def operator(found: Annotated[Access, Depends(viewer)]) -> Access:
    """Return the caller, who needs the role operator; raises 403 for others."""
    if found.role != "operator":
        raise HTTPException(403, f"the token {found.name!r} may only read; this needs the role operator")
    return found


async def local_or_authenticated(request: Request, bearer: Bearer = None, cookie: Cookie = None) -> str:
    """Return the name of a stop's caller; without valid token or session `anybody` at loopback, elsewhere raise 401.

    A stop does no harm, and whoever needs it may have no token at hand, or one that is out of date, or be throttled.
    From another machine it takes a token of any role, so that strangers on a network cannot keep an arm from working.
    Memory is asked. The registry is where a stranger's token may be one that was made a moment ago.
    """
    service = service_of(request)
    near = _loopback(address_of(request)) and service.settings.loopback
    secret = None if bearer is None else bearer.credentials
    found = service.authenticator.known(secret, cookie)
    if found is None and not near:
        await run_in_threadpool(service.authenticator.refresh)
        if (found := service.authenticator.known(secret, cookie)) is None:
            raise unknown()
    request.state.who = "anybody" if found is None else found.name
    return str(request.state.who)


async def lease_keeper(request: Request, bearer: Bearer = None, cookie: Cookie = None) -> Access:
    """Return the operator who renews a lease, known from memory if possible, so that the registry is not waited for.

    Raises:
        HTTPException: as `operator`.
    """
    secret = None if bearer is None else bearer.credentials
    found = service_of(request).authenticator.known(secret, cookie)
    if found is None:
        return await operator(await viewer(await access_of(request, bearer, cookie)))
    if secret is None:
        _require_page(request)
    request.state.who = found.name
    return await operator(found)


async def while_authorised(request: Request, bearer: Bearer = None, cookie: Cookie = None) -> WhileKnown:
    """Return a filter that ends an event stream, at its next event, once its token or session is no longer valid."""
    authenticator, secret = service_of(request).authenticator, None if bearer is None else bearer.credentials

    async def while_known(events: AsyncIterator[str]) -> AsyncIterator[str]:
        async for one in events:
            if authenticator.known(secret, cookie) is None:
                return
            yield one

    return while_known


def unknown() -> HTTPException:
    """Return the error for a caller without a valid token or session (401)."""
    return HTTPException(401, "give a valid token: Authorization: Bearer TOKEN", headers={"WWW-Authenticate": "Bearer"})


def throttled(error: Throttled) -> HTTPException:
    """Return the error for too many failed attempts (429)."""
    return HTTPException(429, str(error), headers={"Retry-After": str(math.ceil(error.seconds))})


def _loopback(address: str) -> bool:
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return False


Serving = Annotated[Service, Depends(serving)]
Near = Annotated[str, Depends(local_or_authenticated)]
LeaseKeeper = Annotated[Access, Depends(lease_keeper)]
Viewer = Annotated[Access, Depends(viewer)]
WhileAuthorized = Annotated[WhileKnown, Depends(while_authorised)]
Operator = Annotated[Access, Depends(operator)]
"""Dependencies that routes declare."""
