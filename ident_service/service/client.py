"""A daemon somewhere else, asked over HTTP: what `ident ... --server URL` and programs use.

The standard library alone. A certificate is checked as the system does (`SSL_CERT_FILE` names another authority).
"""

from __future__ import annotations

import http.client
import json
import socket
import ssl
from typing import Any, Final
from urllib.parse import urlsplit

from ident_service.errors import (
    AlreadyThere,
    ArmError,
    ConfigError,
    IdentError,
    MotionRefused,
    ParameterError,
    RecordingError,
    UnknownId,
    UsageError,
)

_PATIENCE = 30.0  # s for one answer
_MOST = 64 * 2**20
_KINDS: Final[dict[str, type[IdentError]]] = {
    kind.__name__: kind for kind in (UsageError, UnknownId, AlreadyThere, MotionRefused, ParameterError, ArmError)
}


class Client:
    """One connection, kept open; for one thread."""

    def __init__(self, url: str, token: str | None, *, patience: float = _PATIENCE) -> None:
        """Nothing is asked yet.

        Args:
            url: of the daemon: scheme, host and port.
            token: to say who asks; None for a stop on the daemon's own machine.
            patience: how long to wait for an answer [s].

        Raises:
            UsageError: not such an address; or one that would send the token in the clear over a network.
        """
        try:
            parts = urlsplit(url)
            host, port = parts.hostname or "", parts.port
        except ValueError as error:
            raise UsageError(f"{url}: not an address: {error}") from None
        if parts.scheme not in ("http", "https") or not host or parts.path.strip("/") or parts.query or parts.username:
            raise UsageError(f"{url}: give scheme, host and port, such as https://robot.example:8470")
        if parts.scheme == "http" and host not in ("127.0.0.1", "::1", "localhost"):
            raise UsageError(f"{url}: a token is sent to other machines over https only")
        self._url, self._headers = url.rstrip("/"), {} if token is None else {"Authorization": f"Bearer {token}"}
        self._connection: http.client.HTTPConnection = (
            http.client.HTTPSConnection(host, port, timeout=patience, context=ssl.create_default_context())
            if parts.scheme == "https"
            else http.client.HTTPConnection(host, port, timeout=patience)
        )

    def get(self, path: str) -> Any:
        """What stands at a path."""
        return self.ask("GET", path)

    def post(self, path: str, body: Any = None) -> Any:
        """Have something done."""
        return self.ask("POST", path, {} if body is None else body)

    def content(self, path: str) -> bytes:
        """A file that stands at a path.

        Raises:
            IdentError: as `ask`; or it is larger than what is taken.
        """
        status, content = self._exchange("GET", path, None)
        if status >= 400:
            raise _error(self._url, status, self._document(status, content))
        if len(content) >= _MOST:
            raise ArmError(f"{self._url}{path}: has {_MOST} bytes or more; fetch it by other means")
        return content

    def ask(self, method: str, path: str, body: Any = None) -> Any:
        """One request; its answer as JSON values.

        Raises:
            IdentError: the daemon refused, with its own error; or it cannot be reached.
        """
        status, content = self._exchange(method, path, body)
        document = self._document(status, content)
        if status >= 400:
            raise _error(self._url, status, document)
        return document

    def _exchange(self, method: str, path: str, body: Any) -> tuple[int, bytes]:
        """Status and body of an answer, of which `_MOST` bytes are read."""
        content = None if body is None else json.dumps(body).encode()
        headers = self._headers if content is None else {**self._headers, "Content-Type": "application/json"}
        # A connection that lay idle may have been closed meanwhile: what only reads is asked again.
        for last in (False, True) if method == "GET" else (True,):
            try:
                self._connection.request(method, path, content, headers)
                answer = self._connection.getresponse()
                status, text = answer.status, answer.read(_MOST)
                break
            except (OSError, http.client.HTTPException) as error:
                self._connection.close()
                if last or isinstance(error, socket.gaierror | ssl.SSLError):
                    raise ArmError(f"{self._url}: cannot be reached: {error or type(error).__name__}") from None
        return status, text

    def _document(self, status: int, content: bytes) -> Any:
        try:
            return json.loads(content) if content else None
        except ValueError:
            raise ArmError(f"{self._url}: answered {status} with what is not JSON; is it the daemon?") from None

    def close(self) -> None:
        """End the connection."""
        self._connection.close()


def _error(url: str, status: int, document: Any) -> IdentError:
    said = document.get("error", {}) if isinstance(document, dict) else {}
    kind, message = str(said.get("kind", "")), str(said.get("message", f"answered {status}"))
    if kind == ConfigError.__name__:
        return UsageError(message)
    if kind == RecordingError.__name__ or kind not in _KINDS:
        kinds: dict[int, type[IdentError]] = {401: UsageError, 403: UsageError, 404: UnknownId, 422: UsageError}
        return kinds.get(status, ArmError)(f"{url}: {message}")
    return _KINDS[kind](message)
