"""Send HTTP requests to a daemon, and raise its refusals as errors of `ident_service.errors`."""

from __future__ import annotations

import json
import re
import ssl
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Self
from urllib.parse import urlsplit

import httpx

from ident_service import errors

_PATIENCE = 30.0  # s for one answer
_MOST = 64 * 2**20  # bytes of one answer
NOTHING: Final[Mapping[str, Any]] = MappingProxyType({})
_OF_HTTP: Final[dict[str, type[errors.IdentError]]] = {
    **dict.fromkeys(("Unauthorized", "Forbidden", "TooManyRequests", "WrongHost", "WrongOrigin"), errors.AccessRefused),
    **dict.fromkeys(("BadRequest", "MethodNotAllowed", "TooLarge"), errors.InvalidRequest),
    "NotFound": errors.UnknownId,
    **dict.fromkeys(("Busy", "ServiceUnavailable"), errors.Unavailable),
    "InsufficientStorage": errors.DiskFull,
    "InternalError": errors.IdentError,
    "Interrupted": errors.IdentError,
}
"""What refuses a request before it reaches anything that has an error of its own, by the kind that it is told with."""
_UNAUTHORIZED: Final = (
    "takes no request without a valid token, and this one is not: it was revoked, or is of another daemon, or none was "
    "given; `ident tokens add NAME --role operator` makes one at the daemon's machine"
)
_PLACE: Final = re.compile(r"(?P<path>.+?):(?P<line>\d+):(?P<column>\d+): (?P<message>.*)", re.DOTALL)


class Connection:
    """HTTP connection to a daemon for JSON requests; may be used from any thread."""

    def __init__(self, url: str, token: str | None = None, *, patience: float = _PATIENCE) -> None:
        """Create the connection; no request is sent yet.

        Args:
            url: of the daemon: scheme, host and port.
            token: token that authenticates the caller, white space around it left out; None for a stop on the daemon's
                own machine.
            patience: how long to wait for an answer [s].

        Raises:
            UsageError: not such an address; or one that would send the token in the clear over a network.
        """
        try:
            parts = urlsplit(url)
            host, _ = parts.hostname or "", parts.port
        except ValueError as error:
            raise errors.UsageError(f"{url}: not an address: {error}") from None
        if parts.scheme not in ("http", "https") or not host or parts.path.strip("/") or parts.query or parts.username:
            raise errors.UsageError(f"{url}: give scheme, host and port, such as https://robot.example:8470")
        if parts.scheme == "http" and host not in ("127.0.0.1", "::1", "localhost"):
            raise errors.UsageError(f"{url}: a token is sent to other machines over https only")
        self.url = url.rstrip("/")
        headers = {} if token is None else {"Authorization": f"Bearer {_plain(token, url)}"}
        secure = parts.scheme == "https"
        # Without TLS no certificate is checked; an empty context is quicker to make.
        verify = ssl.create_default_context() if secure else ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        try:
            self._http = httpx.Client(
                base_url=self.url, headers=headers, timeout=patience, verify=verify, trust_env=False
            )
        except (ValueError, httpx.HTTPError, httpx.InvalidURL) as error:
            raise errors.UsageError(f"{url}: cannot be asked: {error}") from None

    def get(self, path: str) -> Any:
        """Send GET for a path and return the answer's JSON values; raise IdentError if it fails."""
        return self.ask("GET", path)

    def post(self, path: str, body: Any = None, headers: Mapping[str, str] = NOTHING) -> Any:
        """Send POST to a path, an empty object if there is no body; return the answer's JSON values, or raise."""
        return self.ask("POST", path, {} if body is None else body, headers)

    def delete(self, path: str) -> Any:
        """Send DELETE for a path and return the answer's JSON values; raise IdentError if it fails."""
        return self.ask("DELETE", path)

    def ask(
        self,
        method: str,
        path: str,
        body: Any = None,
        headers: Mapping[str, str] = NOTHING,
        *,
        timeout_seconds: float | None = None,
    ) -> Any:
        """Send one request, wait for its answer and return that as JSON values; raise the error that the daemon names.

        Args:
            method: HTTP method.
            path: path on the daemon, from the root.
            body: JSON values, or bytes that are sent as they are.
            headers: headers besides those of the body.
            timeout_seconds: how long to wait for the answer [s]; as for every other request if None.

        Raises:
            IdentError: the daemon refused, with its own error; or it cannot be reached.
        """
        return self._document(*self._exchange(method, path, body, headers, timeout_seconds)[:2])

    def pages(self, path: str) -> Iterator[Any]:
        """Yield the entries of a paged list, requesting page by page to its end; raise IdentError if that fails."""
        after: str | None = path
        while after is not None:
            status, content, after = self._exchange("GET", after, None, {})
            yield from self._document(status, content)

    def content(self, path: str) -> bytes:
        """Download a file and return its bytes; raise IdentError if it is refused, or has 64 MiB or more.

        Raises:
            IdentError: as `ask`; or it is larger than what is taken.
        """
        status, content, _ = self._exchange("GET", path, None, {})
        if status >= 400:
            self._document(status, content)
        if len(content) >= _MOST:
            raise errors.ArmError(f"{self.url}{path}: has {_MOST} bytes or more; fetch it by other means")
        return content

    def close(self) -> None:
        """Close the HTTP connections."""
        self._http.close()

    def __enter__(self) -> Self:
        """Return the connection itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the connection."""
        self.close()

    def stream(self, path: str, headers: Mapping[str, str] = NOTHING) -> Iterator[tuple[str, int | None, Any]]:
        """Yield server-sent events as (kind, number, JSON value) until the daemon ends the stream.

        An event without a number has None, one without a value is told for its number alone.

        Raises:
            IdentError: as `ask`; or the line was cut.
        """
        try:
            with self._http.stream("GET", path, headers=dict(headers)) as answer:
                if answer.status_code >= 400:
                    self._document(answer.status_code, answer.read())
                kind, number, data = "", None, None
                for line in answer.iter_lines():
                    name, _, value = line.partition(": ")
                    if name == "event":
                        kind = value
                    elif name == "id":
                        number = int(value)
                    elif name == "data":
                        data = json.loads(value)
                    elif not line and (data is not None or number is not None):
                        yield kind, number, data
                        kind, number, data = "", None, None
        except (httpx.HTTPError, ValueError) as error:
            raise self._connection_error(error) from None

    def _exchange(
        self, method: str, path: str, body: Any, headers: Mapping[str, str], patience: float | None = None
    ) -> tuple[int, bytes, str | None]:
        """Return status, body (at most `_MOST` bytes) and the path of the next page."""
        raw = isinstance(body, bytes)
        content = body if raw or body is None else json.dumps(body).encode()
        kind = {} if body is None else {"Content-Type": f"application/{'octet-stream' if raw else 'json'}"}
        sent, timeout = {**headers, **kind}, httpx.USE_CLIENT_DEFAULT if patience is None else patience
        # An idle connection may have been closed meanwhile: requests that only read are sent again.
        for last in (False, True) if method == "GET" else (True,):
            try:
                with self._http.stream(method, path, content=content, headers=sent, timeout=timeout) as answer:
                    taken = bytearray()
                    for piece in answer.iter_bytes():
                        taken += piece
                        if len(taken) >= _MOST:
                            break
                    after = answer.links.get("next", {}).get("url")
                    return answer.status_code, bytes(taken[:_MOST]), after
            except (httpx.HTTPError, httpx.InvalidURL) as error:
                if last or isinstance(error, httpx.ConnectError):
                    raise self._connection_error(error) from None
        raise AssertionError("the second try ends the loop")

    def _connection_error(self, error: Exception) -> errors.ArmError:
        # httpx has no class of its own for this.
        unknown = "CERTIFICATE_VERIFY_FAILED" in str(error)
        hint = "; SSL_CERT_FILE=FILE.pem names the authority that signed the daemon's certificate" if unknown else ""
        if isinstance(error, httpx.ConnectError) and "refused" in str(error):
            hint = "; nobody listens there: the daemon (`ident serve`) has ended, or listens elsewhere"
        said = str(error).rstrip(".") or type(error).__name__  # sentences go on after it
        return errors.ArmError(f"{self.url}: cannot be reached: {said}{hint}")

    def _document(self, status: int, content: bytes) -> Any:
        try:
            document = json.loads(content) if content else None
        except ValueError:
            raise errors.ArmError(f"{self.url}: answered {status} with what is not JSON; is it the daemon?") from None
        if status >= 400:
            raise _error(self.url, status, document)
        return document


def _plain(token: str, url: str) -> str:
    """Return a token without white space around it; no message repeats it."""
    plain = token.strip()
    if not plain:
        raise errors.UsageError(
            f"{url}: the token is empty; give what `ident tokens add` has printed, or None for a stop"
        )
    if not plain.isascii() or not plain.isprintable() or " " in plain:
        raise errors.UsageError(
            f"{url}: the token has characters that no token has; give what `ident tokens add` has printed"
        )
    return plain


def error_of(kind: str, message: str, dependents: Sequence[Mapping[str, Any]] = ()) -> errors.IdentError:
    """Make, without raising it, the error of the class named `kind`; `IdentError` itself where there is no such class.

    Args:
        kind: name of the error.
        message: message of the error.
        dependents: things that refer to what was to be deleted, for `InUse`.
    """
    if kind == errors.InUse.__name__:
        return errors.InUse(message, [errors.Dependent(**one) for one in dependents])
    if kind == errors.ConfigError.__name__:
        return errors.ConfigError(list(_problems(message)))
    if kind == errors.SolverError.__name__:
        problem, _, status = message.partition(": the solver stopped with status ")
        return errors.SolverError(problem, status)
    found = _OF_HTTP.get(kind) or getattr(errors, kind, None)
    if not (isinstance(found, type) and issubclass(found, errors.IdentError)):
        found = errors.IdentError
    if issubclass(found, errors.RecordingError | errors.StorageError | errors.ArmFault):
        about, _, words = message.partition(": ")
        return found(about, words)
    return found(message)


def _problems(message: str) -> Iterator[errors.Problem]:
    """Read what `ConfigError` writes: a line for each mistake, the place first."""
    rest: list[str] = []
    for line in message.splitlines():
        if _PLACE.fullmatch(line) or not rest:
            yield from _problem(rest)
            rest = [line]
        else:  # words of several lines
            rest.append(line)
    yield from _problem(rest)


def _problem(lines: Sequence[str]) -> Iterator[errors.Problem]:
    if found := _PLACE.fullmatch("\n".join(lines)):
        yield errors.Problem(Path(found["path"]), int(found["line"]), int(found["column"]), found["message"])
    elif lines:
        yield errors.Problem(Path("description"), 1, 1, "\n".join(lines))


def _error(url: str, status: int, document: Any) -> errors.IdentError:
    said = document.get("error", {}) if isinstance(document, dict) else {}
    kind, message = str(said.get("kind", "")), str(said.get("message", f"answered {status}"))
    if not kind:
        return errors.ArmError(f"{url}: answered {status}; is it the daemon?")
    if kind == "Unauthorized":
        return errors.AccessRefused(f"{url}: {_UNAUTHORIZED}")
    refused = kind in _OF_HTTP  # of which nothing says yet whose words they are
    return error_of(kind, f"{url}: {message}" if refused else message, said.get("dependents") or ())
