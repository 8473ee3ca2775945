"""Check Host, Origin, size and number of requests before any route sees them; add security headers.

Every answer gets its security headers here.

Pure ASGI, so that bodies are counted as they come and streams are not held back. FastAPI reads a body before it asks
who sends it, and reads JSON in the event loop: so more than a little is taken of operators only, and of no body so many
values that reading them would delay a stop.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Awaitable, Callable, MutableMapping
from contextlib import suppress
from http import HTTPStatus
from typing import Any, Final
from urllib.parse import urlsplit

from fastapi import HTTPException, Request
from fastapi.concurrency import run_in_threadpool

from ident_service.daemon.authentication import Authenticator
from ident_service.daemon.connections import Connections, Peer
from ident_service.daemon.dependencies import COOKIE, unknown
from ident_service.daemon.metrics import Metrics
from ident_service.daemon.settings import Settings

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

MOST_BODY: Final = 64 * 1024
MOST_UPLOAD: Final = 16 * 2**20
MOST_PIECE: Final = 8 * 2**20  # of a recording
UPLOADS: Final = ("/api/v1/arms", "/api/v1/motions", "/api/v1/descriptions/check", "/api/v1/descriptions/new")
_MOST_VALUES: Final = 250_000  # commas and brackets of a body of JSON; 30 ms of reading
_MOST_HELD: Final = 128 * 2**20  # bytes of all large bodies that are being received or answered
_PIECES: Final = "/api/v1/uploads/"
_URGENT: Final = ("/stop", "/lease")  # ends of paths that are answered however busy the service is
_SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
_LOG = logging.getLogger("ident.http")
_HEADERS: Final = (
    (
        b"content-security-policy",
        b"default-src 'self'; img-src 'self' data:; object-src 'none'; base-uri 'none'; form-action 'self'; "
        b"frame-ancestors 'none'",
    ),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"permissions-policy", b"camera=(), geolocation=(), microphone=()"),
)


class _Refused(HTTPException):
    """Error for a request whose body is not taken, or not now."""

    kind = "TooLarge"


class _Busy(_Refused):
    """Error for a request while as many are being answered as may be."""

    kind = "Busy"

    def __init__(self) -> None:
        super().__init__(503, "too many requests at a time; try again", {"Retry-After": "1"})


class RequestGuardMiddleware:
    """ASGI middleware: check Host, Origin, body size and load; add security headers; count and log requests."""

    def __init__(
        self, app: App, settings: Settings, metrics: Metrics, connections: Connections, authenticator: Authenticator
    ) -> None:
        self._app, self._metrics, self._connections = app, metrics, connections
        self._bodies = _Bodies(connections, authenticator)
        self._hosts, self._scheme = settings.hosts, "https" if settings.tls else "http"
        hsts = ((b"strict-transport-security", b"max-age=31536000"),) if settings.tls else ()
        self._headers = (*_HEADERS, *hsts)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            return  # the service has no other protocols
        began, status, started = time.perf_counter(), 500, False
        peer: Peer | None = scope.get("client")
        urgent = scope["method"] == "POST" and scope["path"].endswith(_URGENT)
        busy = not urgent and self._connections.busy(peer)
        self._connections.headers_received(peer, body=_has_body(scope))
        body = _Body(scope, receive, self._bodies, urgent=urgent)

        async def answer(message: Message) -> None:
            nonlocal status, started
            if message["type"] == "http.response.start":
                status, started = message["status"], True
                given = {name for name, _ in message.get("headers", ())}
                more = [(name, value) for name, value in self._headers if name not in given]
                if b"cache-control" not in given:
                    more.append((b"cache-control", b"no-store"))
                message["headers"] = [*message.get("headers", ()), *more]
                if not scope.get("state", {}).get("who"):
                    self._connections.answering_stranger(peer)
            self._connections.sending(peer)
            await send(message)
            self._connections.sent(peer)

        try:
            if (refused := self._refusal(scope)) is not None:
                await _refuse(answer, *refused)
                return
            if busy:
                await _refuse(answer, 503, "Busy", _Busy().detail)
                return
            try:
                await self._app(scope, body.receive, answer)
            except _Refused as error:
                if not started:
                    await _refuse(answer, error.status_code, error.kind, error.detail)
        finally:
            self._bodies.held -= body.held
            self._connections.answered(peer)
            stop = scope["method"] == "POST" and scope["path"].endswith("/stop")
            self._metrics.record_request(scope["method"], status, time.perf_counter() - began, is_stop=stop)
            _LOG.info(
                "request",
                extra={
                    "method": scope["method"],
                    "path": scope["path"],
                    "status": status,
                    "seconds": round(time.perf_counter() - began, 6),
                    "who": scope.get("state", {}).get("who"),
                },
            )

    def _refusal(self, scope: Scope) -> tuple[int, str, str] | None:
        """Return status, kind and message with which a request for another host or origin is refused, else None."""
        headers = scope["headers"]
        hosts = [value for name, value in headers if name == b"host"]
        host = hosts[0].decode("latin-1") if len(hosts) == 1 else ""
        if _name(host) not in self._hosts:
            return 421, "WrongHost", "wrong host name; use the address or name that the service was started with"
        origins = [value.decode("latin-1") for name, value in headers if name == b"origin"]
        if any(origin.lower() != f"{self._scheme}://{host.lower()}" for origin in origins):
            return 403, "WrongOrigin", "requests from pages of other origins are refused"
        sites = [value for name, value in headers if name == b"sec-fetch-site"]
        if scope["method"] not in _SAFE and any(site not in (b"same-origin", b"none") for site in sites):
            return 403, "WrongOrigin", "requests from pages of other origins are refused"
        return None


class _Bodies:
    """Hold what all bodies share: the connections, who may send more than a little, and the bytes in memory."""

    def __init__(self, connections: Connections, authenticator: Authenticator) -> None:
        self.connections, self.authenticator, self.held = connections, authenticator, 0


class _Body:
    """Body of one request: counted as it comes."""

    def __init__(self, scope: Scope, receive: Receive, bodies: _Bodies, *, urgent: bool) -> None:
        self._scope, self._receive, self._bodies, self._urgent = scope, receive, bodies, urgent
        self._most, self._whole = _body_limit(scope["method"], scope["path"]), not _has_body(scope)
        self._pieces = scope["method"] == "PATCH"  # written to a file as they come, by a route that has asked who sends
        self._seen, self._values, self.held = 0, 0, 0

    async def receive(self) -> Message:
        """Return the next message of the request.

        Raises:
            HTTPException: the body is too large or not this caller's to send, or the service is busy.
        """
        message = await self._receive()
        if message["type"] == "http.request":
            await self._count(message.get("body", b""))
            if not self._whole and not message.get("more_body", False):
                self._whole = True
                peer = self._scope.get("client")
                # While the body arrived, other requests may have used up the places.
                if not self._urgent and self._bodies.connections.busy(peer):
                    raise _Busy
                self._bodies.connections.request_received(peer)
        return message

    async def _count(self, data: bytes) -> None:
        self._seen += len(data)
        if self._seen > self._most:
            raise _Refused(413, f"a request has {self._most} bytes at most")
        if self._pieces:
            return
        self._values += sum(data.count(mark) for mark in (b",", b"[", b"{"))
        if self._values > _MOST_VALUES:
            raise _Refused(413, f"a request has {_MOST_VALUES} commas and brackets at most")
        if self._seen > MOST_BODY:
            if not self.held:
                await self._require_operator()
            self._bodies.held += self._seen - self.held
            self.held = self._seen
            if self._bodies.held > _MOST_HELD:
                raise _Busy

    async def _require_operator(self) -> None:
        request, authenticator = Request(self._scope), self._bodies.authenticator
        kind, _, secret = request.headers.get("authorization", "").partition(" ")
        caller = (secret if kind.lower() == "bearer" else None, request.cookies.get(COOKIE))
        if (found := authenticator.known(*caller)) is None:
            await run_in_threadpool(authenticator.refresh)  # it may have been made a moment ago
            if (found := authenticator.known(*caller)) is None:
                raise unknown()
        if found.role != "operator":
            raise HTTPException(403, f"the token {found.name!r} may only read; this needs the role operator")


def _body_limit(method: str, path: str) -> int:
    if method == "PATCH" and path.startswith(_PIECES):
        return MOST_PIECE
    return MOST_UPLOAD if method == "POST" and path in UPLOADS else MOST_BODY


def _has_body(scope: Scope) -> bool:
    return any(
        name == b"transfer-encoding" or (name == b"content-length" and value.strip(b"0"))
        for name, value in scope["headers"]
    )


def _name(host: str) -> str:
    """Return the name in a Host header, without port and brackets; empty where it is not one."""
    with suppress(ValueError):
        parts = urlsplit(f"//{host}")
        if not (parts.path or parts.query or parts.fragment or parts.username or parts.password):
            _ = parts.port
            return parts.hostname or ""
    return ""


async def _refuse(send: Send, status: int, kind: str, words: str) -> None:
    body = json.dumps({"error": {"kind": kind, "message": words}}).encode()
    length = str(len(body)).encode()
    # The rest of the body is not read: the connection ends with the answer.
    headers = [(b"content-type", b"application/json"), (b"content-length", length), (b"connection", b"close")]
    if status == HTTPStatus.SERVICE_UNAVAILABLE:
        headers.append((b"retry-after", b"1"))
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})
