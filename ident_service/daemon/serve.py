"""Run the daemon: one per state folder, listening until a signal ends it; arms come to rest first."""

from __future__ import annotations

import asyncio
import gc
import logging
import signal
import socket
import ssl
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

import uvicorn
from fastapi import FastAPI

from ident_service.daemon.app import create_app
from ident_service.daemon.connections import Connections, Listener, most_connections
from ident_service.daemon.service_manager import tell_manager, watchdog_seconds
from ident_service.daemon.settings import Settings
from ident_service.errors import UsageError
from ident_service.operations.state_folder import URL_FILE, keep_private, single_instance
from ident_service.recordings.files import write_atomically

_MOST_HEADERS = 32 * 1024  # bytes
_SWITCH = 0.0005  # s
_LAST_ANSWERS = 5  # s for requests that are being answered when the service ends
_READY_AGAIN = 0.1  # s until READY=1 is sent again to a manager whose queue was full
_LOG = logging.getLogger("ident.serve")


def serve(settings: Settings, tell: Callable[[str], None] = lambda _: None) -> None:
    """Serve the API until a signal ends the process.

    Args:
        settings: how.
        tell: called with the address, when it answers.

    Raises:
        UsageError: another service has the state folder, others can enter it, the address cannot be had, or TLS cannot
            be spoken with its certificate and key.
    """
    _require_tls(settings)
    keep_private(settings.state)
    book = Connections(most_connections())
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
            http="h11",
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
        tell_manager("STOPPING=1")
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
        task = asyncio.create_task(self._tell_manager())
        try:
            await super().main_loop()
        finally:
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task

    async def _tell_manager(self) -> None:
        # Without READY=1 the manager would count the service as failed; any other line may be lost.
        while not tell_manager("READY=1"):
            await asyncio.sleep(_READY_AGAIN)
        seconds = watchdog_seconds()
        while seconds is not None:
            if self._service.engine.healthy:
                tell_manager("WATCHDOG=1")
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
