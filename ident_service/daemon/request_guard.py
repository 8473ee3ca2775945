"""Check Host, Origin, size and number of requests before any route sees them; add security headers.

Every answer gets its security headers here.

Pure ASGI, so that bodies are counted as they come and streams are not held back.
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

from fastapi import HTTPException

from ident_service.daemon.connections import Connections, Peer
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


class _TooLarge(HTTPException):
    """Error for a body that has more bytes than allowed."""

    def __init__(self, most: int) -> None:
        super().__init__(413, f"a request has {most} bytes at most")


class _Busy(HTTPException):
    """Error for a request while as many are being answered as may be."""

    def __init__(self) -> None:
        super().__init__(503, "too many requests at a time; try again", {"Retry-After": "1"})


class RequestGuardMiddleware:
    """ASGI middleware: check Host, Origin, body size and load; add security headers; count and log requests."""

    def __init__(self, app: App, settings: Settings, metrics: Metrics, connections: Connections) -> None:
        self._app, self._metrics, self._connections = app, metrics, connections
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
        urgent = scope["path"].endswith(_URGENT)
        busy = not urgent and self._connections.busy(peer)
        self._connections.headers_received(peer, body=_has_body(scope))

        async def answer(message: Message) -> None:
            nonlocal status, started
            if message["type"] == "http.response.start":
                status, started = message["status"], True
                given = {name for name, _ in message.get("headers", ())}
                more = [(name, value) for name, value in self._headers if name not in given]
                if b"cache-control" not in given:
                    more.append((b"cache-control", b"no-store"))
                message["headers"] = [*message.get("headers", ()), *more]
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
                await self._app(scope, self._counted(scope, receive, urgent=urgent), answer)
            except (_TooLarge, _Busy) as error:
                if not started:
                    kind = "TooLarge" if isinstance(error, _TooLarge) else "Busy"
                    await _refuse(answer, error.status_code, kind, error.detail)
        finally:
            self._connections.answered(peer)
            stop = scope["method"] == "POST" and scope["path"].endswith("/stop")
            self._metrics.request(scope["method"], status, time.perf_counter() - began, stop=stop)
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

    def _counted(self, scope: Scope, receive: Receive, *, urgent: bool) -> Receive:
        most, seen, peer = _body_limit(scope["method"], scope["path"]), 0, scope.get("client")
        whole = not _has_body(scope)

        async def counted() -> Message:
            nonlocal seen, whole
            message = await receive()
            if message["type"] == "http.request":
                seen += len(message.get("body", b""))
                if seen > most:
                    raise _TooLarge(most)
                if not whole and not message.get("more_body", False):
                    whole = True
                    # While the body arrived, other requests may have used up the places.
                    if not urgent and self._connections.busy(peer):
                        raise _Busy
                    self._connections.request_received(peer)
            return message

        return counted


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
