"""Send notices of due re-identifications and drift alarms to a webhook, by the convention of standardwebhooks.com.

Each notice is a row of the registry before it counts as sent. Failed attempts are repeated at growing intervals for
three days, also after a restart; then the notice is given up with a line in the audit trail. A thread of its own sends,
so that a failure delays nothing else. Only https, or http to this machine; redirections are not followed.

The receiver verifies `webhook-signature` with a library of the convention and the shared secret, refuses old
timestamps, and tells repetitions by `webhook-id`, which is the same for all attempts.
"""

from __future__ import annotations

import base64
import http.client
import ipaddress
import json
import logging
import os
import secrets
import sqlite3
import ssl
import threading
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from http import HTTPStatus
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

from standardwebhooks.webhooks import Webhook as Signer

from ident_service.errors import UsageError
from ident_service.registry.database import Database, Row, note

WAITS: Final = (5.0, 300.0, 1800.0, 7200.0, 18_000.0, 36_000.0, 50_400.0, 72_000.0, 86_400.0)
"""After each attempt that failed [s]: the schedule that the convention recommends, about three days in all."""
KEPT: Final = 30 * 24 * 3600.0  # s that a delivered notice stays in the registry
_PATIENCE = 5.0  # s for connecting, and for each answer
_LOOK = 0.5  # s between checks for notices to send
_LEAST_SECRET, _MOST_SECRET = 16, 1024  # bytes
_PREFIX: Final = "whsec_"
SERVICE: Final = "service"
LOG = logging.getLogger("ident.webhook")


class Webhook:
    """Sender of notices to one address."""

    def __init__(
        self,
        db: Database,
        url: str,
        secret: bytes,
        *,
        waits: tuple[float, ...] = WAITS,
        now: Callable[[], float] = time.time,
    ) -> None:
        """Start sending the notices that wait in the registry, also those of an earlier process.

        Args:
            db: the registry.
            url: URL of the receiver: https, or http to a loopback address.
            secret: secret shared with the receiver, 16 bytes or more.
            waits: waiting times after failed attempts [s]; after one more failure the notice is given up.
            now: s since 1970 in UTC.

        Raises:
            UsageError: another address, or a secret that is too short.
        """
        require_address(url)
        if len(secret) < _LEAST_SECRET:
            raise UsageError(f"a webhook's secret has {_LEAST_SECRET} bytes at least")
        self._db, self._url, self._signer = db, url, Signer(secret)
        self._waits, self._now = waits, now
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._work, name="webhook", daemon=True)
        self._thread.start()

    def send(self, kind: str, event_time: float, event_data: Mapping[str, Any]) -> str:
        """Write a notice into the registry, from where a thread sends it later, and return the notice's id.

        Args:
            kind: `arm.due` and so on.
            event_time: time of the event [s since 1970 in UTC].
            event_data: JSON values.
        """
        when = datetime.fromtimestamp(event_time, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        body = json.dumps({"type": kind, "timestamp": when, "data": dict(event_data)}, allow_nan=False)
        name = f"msg_{secrets.token_hex(12)}"
        self._db.write(
            "INSERT INTO deliveries (id, arm, body, created, next) VALUES (?, ?, ?, ?, ?)",
            *(name, str(event_data.get("arm", "")), body, self._now(), self._now()),
        )
        return name

    def close(self) -> None:
        """Stop sending; waiting notices are sent after the next start."""
        self._ending.set()
        self._thread.join(3 * _PATIENCE)

    def _work(self) -> None:
        while not self._ending.wait(_LOOK):
            try:
                while not self._ending.is_set() and (row := self._due()) is not None:
                    self._attempt(row)
            except sqlite3.Error as error:
                LOG.error("notices wait for the registry: %s", error)
            except Exception:  # the next notice must be sent all the same
                LOG.exception("the webhook stumbled")

    def _due(self) -> Row | None:
        return self._db.row("SELECT * FROM deliveries WHERE next <= ? ORDER BY next, number LIMIT 1", self._now())

    def _attempt(self, row: Row) -> None:
        """Try to send a notice once, and enter the result before another attempt."""
        tries, why, status = row["tries"] + 1, "", 0
        try:
            status = self._post(row["id"], row["body"])
        except (OSError, http.client.HTTPException, ValueError) as error:
            why = f"{type(error).__name__}: {error}"[:500]
        now = self._now()
        if 200 <= status < 300:
            self._write(row, tries, None, now, "")
            self._db.write("DELETE FROM deliveries WHERE next IS NULL AND created < ?", now - KEPT)
            return
        why = why or f"answered {status}"
        # By the convention, status 410 says that the receiver wants no more notices.
        if status != HTTPStatus.GONE and tries <= len(self._waits):
            self._write(row, tries, now + self._waits[tries - 1], None, why)
            return
        LOG.warning("a notice could not be delivered: %s", why)
        with self._db.transaction():
            self._write(row, tries, None, None, why)
            note(self._db, SERVICE, "webhook failed", row["arm"], delivery=row["id"], tries=tries, why=why)

    def _write(self, row: Row, tries: int, following: float | None, delivered: float | None, why: str) -> None:
        self._db.write(
            "UPDATE deliveries SET tries = ?, next = ?, delivered = ?, why = ? WHERE number = ?",
            *(tries, following, delivered, why, row["number"]),
        )

    def _post(self, name: str, body: str) -> int:
        parts, at = urlsplit(self._url), datetime.fromtimestamp(int(self._now()), UTC)
        host = parts.hostname or ""
        connection = (
            http.client.HTTPSConnection(host, parts.port, timeout=_PATIENCE, context=ssl.create_default_context())
            if parts.scheme == "https"
            else http.client.HTTPConnection(host, parts.port, timeout=_PATIENCE)
        )
        headers = {
            "Content-Type": "application/json",
            "webhook-id": name,
            "webhook-timestamp": str(int(at.timestamp())),
            "webhook-signature": self._signer.sign(name, at, body),
        }
        path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
        try:
            connection.request("POST", path, body.encode(), headers)
            return connection.getresponse().status
        finally:
            connection.close()


def deliveries(db: Database, *, before: int | None = None, most: int = 100) -> list[Row]:
    """Return at most `most` notices with their results, the newest first, only those numbered below `before`."""
    return db.rows(
        "SELECT * FROM deliveries WHERE number < ? ORDER BY number DESC LIMIT ?",
        *(2**62 if before is None else before, most),
    )


def require_address(url: str) -> None:
    """Raise UsageError unless the URL is https, or http to this machine.

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
    """Return the key that signs notices, from a file that only its owner can read; else raise UsageError.

    Args:
        path: of the file: `whsec_` and the key in base 64, as the convention has it, or the key itself.

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
    if secret.startswith(_PREFIX.encode()):
        try:
            secret = base64.b64decode(secret[len(_PREFIX) :], validate=True)
        except ValueError:
            raise UsageError(f"{path}: after {_PREFIX} stands a key in base 64, and this is none") from None
    if not _LEAST_SECRET <= len(secret) <= _MOST_SECRET:
        raise UsageError(f"{path}: a webhook's secret has {_LEAST_SECRET} to {_MOST_SECRET} bytes")
    return secret


def _loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
