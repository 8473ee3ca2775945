"""Notices to a program elsewhere: what is due, and drift alarms, by HTTP POST, signed.

A failure harms nothing: a thread of its own sends, what waits is bounded, each notice is tried a few times and then
given up with a line in the audit trail. What is due and which alarms stand is the registry's to say; a notice is only
that. Only https, or http to this machine; redirections are not followed.

The receiver checks `X-Ident-Signature: sha256=HEX`, which is the HMAC-SHA256 (RFC 2104) of `X-Ident-Timestamp`, a dot
and the body under the shared secret, and refuses old timestamps. `X-Ident-Delivery` is the same for all attempts.
"""

from __future__ import annotations

import hashlib
import hmac
import http.client
import ipaddress
import json
import logging
import os
import queue
import secrets
import ssl
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

from ident_service.errors import UsageError

MOST_WAITING: Final = 64
WAITS: Final = (1.0, 5.0, 30.0, 120.0)  # s after each attempt that failed
_PATIENCE = 5.0  # s for connecting, and for each answer
_LEAST_SECRET, _MOST_SECRET = 16, 1024  # bytes
LOG = logging.getLogger("ident.webhook")


class Webhook:
    """Sends notices to one address."""

    def __init__(
        self,
        url: str,
        secret: bytes,
        gave_up: Callable[[Mapping[str, Any], str], None] = lambda *_: None,
        *,
        waits: tuple[float, ...] = WAITS,
        now: Callable[[], float] = time.time,
    ) -> None:
        """Begin to wait for notices.

        Args:
            url: https, or http to a loopback address.
            secret: shared with the receiver, 16 bytes or more.
            gave_up: called with a notice that could not be delivered, and why.
            waits: after each attempt that failed but the last [s].
            now: s since 1970 in UTC.

        Raises:
            UsageError: another address, or a secret that is too short.
        """
        require_address(url)
        if len(secret) < _LEAST_SECRET:
            raise UsageError(f"a webhook's secret has {_LEAST_SECRET} bytes at least")
        self._url, self._secret, self._gave_up = url, secret, gave_up
        self._waits, self._now = waits, now
        self._waiting: queue.Queue[Mapping[str, Any]] = queue.Queue(MOST_WAITING)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._work, name="webhook", daemon=True)
        self._thread.start()

    def send(self, notice: Mapping[str, Any]) -> bool:
        """Have a notice sent; False where too many wait already. Returns at once."""
        try:
            self._waiting.put_nowait(dict(notice))
        except queue.Full:
            return False
        return True

    def close(self) -> None:
        """Send nothing more; what waits is given up."""
        self._ending.set()
        self._thread.join(3 * _PATIENCE)

    def _work(self) -> None:
        while not self._ending.is_set():
            try:
                notice = self._waiting.get(timeout=0.2)
            except queue.Empty:
                continue
            try:
                if why := self._deliver(notice):
                    LOG.warning("a notice could not be delivered: %s", why)
                    self._gave_up(notice, why)
            except Exception:  # the next notice is sent all the same
                LOG.exception("the webhook stumbled")

    def _deliver(self, notice: Mapping[str, Any]) -> str:
        """Empty when it was taken, else why it was not."""
        delivery, body = secrets.token_hex(8), json.dumps(notice, allow_nan=False).encode()
        why = ""
        for wait in (0.0, *self._waits):
            if self._ending.wait(wait):
                return f"the service ended; {why}"
            try:
                status = self._post(delivery, body)
            except (OSError, http.client.HTTPException, ValueError) as error:
                why = f"{type(error).__name__}: {error}"
                continue
            if 200 <= status < 300:
                return ""
            why = f"answered {status}"
        return why

    def _post(self, delivery: str, body: bytes) -> int:
        parts, at = urlsplit(self._url), f"{self._now():.0f}"
        host = parts.hostname or ""
        connection = (
            http.client.HTTPSConnection(host, parts.port, timeout=_PATIENCE, context=ssl.create_default_context())
            if parts.scheme == "https"
            else http.client.HTTPConnection(host, parts.port, timeout=_PATIENCE)
        )
        headers = {
            "Content-Type": "application/json",
            "X-Ident-Delivery": delivery,
            "X-Ident-Timestamp": at,
            "X-Ident-Signature": f"sha256={signature(self._secret, at, body)}",
        }
        try:
            connection.request("POST", (parts.path or "/") + (f"?{parts.query}" if parts.query else ""), body, headers)
            return connection.getresponse().status
        finally:
            connection.close()


def signature(secret: bytes, at: str, body: bytes) -> str:
    """What the header says, in hexadecimal digits."""
    return hmac.new(secret, at.encode("ascii") + b"." + body, hashlib.sha256).hexdigest()


def require_address(url: str) -> None:
    """See whether notices may be sent there.

    Raises:
        UsageError: not https, nor http to this machine.
    """
    try:
        parts = urlsplit(url)
        host, _ = parts.hostname or "", parts.port
    except ValueError as error:
        raise UsageError(f"{url}: not an address: {error}") from None
    good = parts.scheme in ("http", "https") and host and parts.username is None and not parts.fragment
    if not good or not url.isascii() or not url.isprintable() or " " in url:
        raise UsageError(f"{url}: a webhook is https://HOST/PATH, or http to this machine")
    if parts.scheme == "http" and not _loopback(host):
        raise UsageError(f"{url}: notices are sent to other machines over https only")


def read_secret(path: Path) -> bytes:
    """The secret in a file that only its owner can read, without white space around it.

    Raises:
        UsageError: others can read it, or it is not there, or too short or long.
    """
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from None
    with os.fdopen(fd, "rb") as stream:
        if os.fstat(fd).st_mode & 0o077:
            raise UsageError(f"{path}: others can read it; chmod 600, and a new secret")
        secret = stream.read(_MOST_SECRET + 1).strip()
    if not _LEAST_SECRET <= len(secret) <= _MOST_SECRET:
        raise UsageError(f"{path}: a webhook's secret has {_LEAST_SECRET} to {_MOST_SECRET} bytes")
    return secret


def _loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
