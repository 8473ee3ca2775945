"""Run the daemon: one per state folder, listening until it is told to end, with its log and its service manager.

The protocol is a datagram of lines to the socket that `$NOTIFY_SOCKET` names.

A thread of its own writes them, so that a reader of standard error that does not read delays no request, least of all a
stop. Lines that do not fit the queue are dropped, and so are lines that are repeated too often.
"""

from __future__ import annotations

import asyncio
import atexit
import functools
import gc
import json
import logging
import os
import queue
import signal
import socket
import ssl
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from types import FrameType
from typing import Any, Final, TextIO

import uvicorn
from fastapi import FastAPI
from fastapi.concurrency import run_in_threadpool

from ident_service.daemon.app import create_app
from ident_service.daemon.connections import (
    Connections,
    FairReader,
    Listener,
    ReadingTurns,
    raise_connection_limit,
    receive_little_of_tls,
)
from ident_service.daemon.settings import Settings
from ident_service.errors import UsageError
from ident_service.recordings.files import write_atomically
from ident_service.registry.state_folder import URL_FILE, require_private, single_instance


def notify_systemd(line: str) -> bool:
    """Send systemd a line such as `READY=1` without waiting; return False only if its queue is full.

    Returns:
        False where the manager's queue is full and the line was dropped; it may be sent again. True otherwise, also
        where there is no manager.
    """
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return True
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK) as link:
            link.sendto(line.encode(), f"\0{address[1:]}" if address.startswith("@") else address)
    except BlockingIOError:
        return False
    except OSError:
        pass  # a manager that cannot be reached changes nothing
    return True


def watchdog_seconds() -> float | None:
    """Return the period of watchdog notices [s], half of the manager's timeout; None if it has no watchdog."""
    try:
        length, pid = int(os.environ.get("WATCHDOG_USEC", "")), int(os.environ.get("WATCHDOG_PID", os.getpid()))
    except ValueError:
        return None
    return length / 2e6 if length > 0 and pid == os.getpid() else None


_OURS: Final = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName", "color_message"}
_MOST_WAITING: Final = 1000  # lines that are queued while the reader does not read
_MOST_ALIKE, _WINDOW = 100, 10.0  # lines in so many seconds
_MOST_KINDS: Final = 1000
_LAST_LINES = 1.0  # s for the queued lines when the process ends


class JsonLines(logging.Formatter):
    """Formatter that writes one record as one line of JSON."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the record as a JSON object; a value that is not JSON is written as its text."""
        line = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **{key: value for key, value in vars(record).items() if key not in _OURS and value is not None},
        }
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


class RepeatFilter(logging.Filter):
    """Filter that drops lines repeated too often; the next one that passes has the number of dropped ones."""

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._now, self._lock = now, threading.Lock()
        self._kinds: dict[tuple[str, str, object], tuple[float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether to write a line: False after `_MOST_ALIKE` of its logger, template and status within 10 s."""
        kind = (record.name, str(record.msg)[:80], getattr(record, "status", None))
        with self._lock:
            if len(self._kinds) > _MOST_KINDS:
                self._kinds.clear()
            since, count = self._kinds.get(kind, (self._now(), 0))
            if self._now() - since > _WINDOW:
                if count > _MOST_ALIKE:
                    record.left_out = count - _MOST_ALIKE
                since, count = self._now(), 0
            self._kinds[kind] = since, count + 1
        return count < _MOST_ALIKE


class QueuedHandler(logging.Handler):
    """Handler that passes lines to a thread of its own, which writes them; it never waits for that thread."""

    def __init__(self, stream: TextIO) -> None:
        """Start the writing thread, the only one that writes to `stream`."""
        super().__init__()
        self._stream, self._lines = stream, queue.Queue[str | None](_MOST_WAITING)
        self._thread = threading.Thread(target=self._work, name="log", daemon=True)
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        """Pass one line to the writing thread, or drop it if the queue is full."""
        with suppress(queue.Full):
            self._lines.put_nowait(self.format(record))

    def close(self) -> None:
        """Let the thread write the queued lines, for about a second at most."""
        with suppress(queue.Full):
            self._lines.put(None, timeout=_LAST_LINES)
            self._thread.join(_LAST_LINES)
        super().close()

    def _work(self) -> None:
        while (line := self._lines.get()) is not None:
            with suppress(OSError, ValueError):  # standard error is gone, so that nothing can be reported
                self._stream.write(line + "\n")
                if self._lines.empty():
                    self._stream.flush()


def log_as_json() -> None:
    """Log to stderr as JSON lines from now on, except floods of alike lines and uvicorn's access log."""
    handler = QueuedHandler(sys.stderr)
    handler.setFormatter(JsonLines())
    handler.addFilter(RepeatFilter())
    atexit.register(handler.close)
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)
    # Each request has its line already (`request_guard.py`).
    logging.getLogger("uvicorn.access").disabled = True


_MOST_HEADERS = 16 * 1024  # bytes
_SWITCH = 0.0005  # s
_LAST_ANSWERS = 5  # s for requests that are being answered when the service ends
_READY_AGAIN = 0.1  # s until READY=1 is sent again to a manager whose queue was full
_LOG = logging.getLogger("ident.serve")


def serve(settings: Settings, tell: Callable[[str], None] = lambda _: None) -> None:
    """Serve pages and API until a signal ends it; meanwhile the state folder's `serve.url` holds the address.

    Args:
        settings: settings of the service.
        tell: called with the address, when it answers.

    Raises:
        UsageError: another service has the state folder, others can enter it, the address cannot be had, or TLS cannot
            be spoken with its certificate and key.
    """
    _require_tls(settings)
    require_private(settings.state)
    book = Connections(raise_connection_limit())
    receive_little_of_tls()
    with single_instance(settings.state), _listening(settings, book) as listening:
        host, port = listening.getsockname()[:2]
        url = f"{'https' if settings.tls else 'http'}://{f'[{host}]' if ':' in host else host}:{port}"

        def ready() -> None:
            # In the file for programs that start the service and let it choose the port.
            write_atomically(settings.state / URL_FILE, url + "\n")
            tell(url)

        app = create_app(settings, book)
        config = uvicorn.Config(
            app,
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,
            ws="none",
            lifespan="on",
            # Called for each connection.
            http=functools.partial(FairReader, turns=ReadingTurns(), urgent=ReadingTurns()),  # type: ignore[arg-type]
            loop="asyncio",  # this loop accepts connections from `Listener`
            h11_max_incomplete_event_size=_MOST_HEADERS,
            timeout_graceful_shutdown=_LAST_ANSWERS,
            ssl_certfile=settings.tls_cert,
            ssl_keyfile=settings.tls_key,
        )
        # A stop takes several turns of the event loop; each waits up to this long for a computing thread.
        sys.setswitchinterval(_SWITCH)
        server = _Server(config, app, book, ready)
        try:
            server.run(sockets=[listening])
        finally:
            (settings.state / URL_FILE).unlink(missing_ok=True)


class _Server(uvicorn.Server):
    """uvicorn server that stops the arms as soon as it is to end, and sends notices to the service manager."""

    def __init__(self, config: uvicorn.Config, app: FastAPI, book: Connections, ready: Callable[[], None]) -> None:
        super().__init__(config)
        self._app, self._service, self._book, self._ready = app, app.state.service, book, ready

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen, and only then report ready, so that clients who wait for that are not refused."""
        await _make_routes(self._app)
        # Objects made so far are kept for good: a full collection would delay the first stops by 0.1 s.
        gc.collect()
        gc.freeze()
        await super().startup(sockets)
        if self.started:
            self._ready()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Handle a signal: stop the arms first; a second interrupt also skips waiting for open requests."""
        notify_systemd("STOPPING=1")
        # Not in the signal handler: the interrupted code may hold the lock that is needed.
        if not self.should_exit:
            threading.Thread(target=self._service.engine.begin_closing, name="closing", daemon=True).start()
        # uvicorn would raise the signal again at the end; here it is a regular end.
        self.force_exit = self.should_exit and sig == signal.SIGINT
        self.should_exit = True

    async def on_tick(self, counter: int) -> bool:
        """Close connections that wait too long without a request; called ten times a second."""
        self._book.sweep()
        return await super().on_tick(counter)

    async def main_loop(self) -> None:
        """Serve; report ready to the service manager, then feed its watchdog while the queue is looked after."""
        task = asyncio.create_task(self._notify_systemd())
        try:
            await super().main_loop()
        finally:
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task

    async def _notify_systemd(self) -> None:
        # Without READY=1 the manager would count the service as failed; any other line may be lost.
        while not notify_systemd("READY=1"):
            await asyncio.sleep(_READY_AGAIN)
        seconds = watchdog_seconds()
        while seconds is not None:
            if self._service.engine.healthy:
                notify_systemd("WATCHDOG=1")
            else:
                _LOG.error("the queue is not looked after")
            await asyncio.sleep(seconds)


async def _make_routes(app: FastAPI) -> None:
    """Send a request for a missing path, so that FastAPI builds its routes now and not during the first stop."""

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": b"", "more_body": False}

    async def send(_: Any) -> None:
        pass

    scope = {"type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": "POST", "scheme": "http"}
    place = {"path": "/nothing", "raw_path": b"/nothing", "query_string": b"", "root_path": "", "headers": []}
    await app.router({**scope, **place}, receive, send)
    await run_in_threadpool(lambda: None)  # loads what the first use of a thread needs (50 ms)


def _require_tls(settings: Settings) -> None:
    """Refuse a certificate or a key with which nobody could be answered.

    Raises:
        UsageError: a file cannot be read, is no PEM, or the key is another certificate's, or encrypted.
    """
    if settings.tls_cert is None or settings.tls_key is None:
        return
    for path in (settings.tls_cert, settings.tls_key):
        try:
            path.read_bytes()
        except OSError as error:
            raise UsageError(f"{path}: cannot be read: {error.strerror}; the daemon's user needs it") from None
    asked = list[bool]()

    def password() -> str:
        asked.append(True)
        return ""

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        # Without a word of ours, OpenSSL would ask the terminal for one.
        context.load_cert_chain(settings.tls_cert, settings.tls_key, password)
    except (ssl.SSLError, ValueError, OSError) as error:
        why = "the key is encrypted; give one without a password" if asked else _tls_words(error)
        raise UsageError(f"{settings.tls_cert}, {settings.tls_key}: TLS cannot be spoken with these: {why}") from None


def _tls_words(error: Exception) -> str:
    reason = getattr(error, "reason", None)
    if reason == "KEY_VALUES_MISMATCH":
        return "the key is not that of the certificate"
    return f"--tls-cert takes a certificate chain and --tls-key its key, both PEM ({reason or error})"


@contextmanager
def _listening(settings: Settings, book: Connections) -> Iterator[socket.socket]:
    """Yield a socket that is bound to the service's address.

    Raises:
        UsageError: it cannot be had.
    """
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    listening = Listener(family, book)
    try:
        try:
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listening.bind((settings.host, settings.port))
        except (OSError, OverflowError) as error:
            why = getattr(error, "strerror", None) or error
            raise UsageError(f"{settings.host}:{settings.port}: cannot be listened on: {why}") from None
        yield listening
    finally:
        listening.close()
