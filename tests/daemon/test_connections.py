"""Half requests, idle lines and floods: who goes, who stays, and what the log says of it."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import socket
import ssl
import subprocess
import threading
import time
from http.client import HTTPConnection
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from daemon.conftest import Asked, serving
from daemon.served import daemon_process

from benchmarks import stops
from ident_service.client import IdentClient
from ident_service.daemon import connections
from ident_service.daemon.connections import BODY_SECONDS, HEADER_SECONDS, Connection, Connections
from ident_service.daemon.serve import JsonLines, QueuedHandler, RepeatFilter
from ident_service.errors import ArmError

NEAR, FAR = "127.0.0.1", "203.0.113.9"


class Book(Connections):
    """Counts real sockets whose other ends the test holds, under addresses that it chooses."""

    def __init__(self, most: int) -> None:
        self.at = 0.0
        super().__init__(most, lambda: self.at)
        self.theirs: dict[tuple[str, int], socket.socket] = {}
        self.ours: dict[tuple[str, int], Connection] = {}

    def come(self, host: str, port: int) -> bool:
        """Let a newcomer come; tell whether it was let in."""
        ours, theirs = socket.socketpair()
        peer = (host, port)
        self.theirs[peer], self.ours[peer] = theirs, Connection.of(ours, peer, self)
        theirs.settimeout(0.0)
        admitted = self.admit(self.ours[peer])
        if not admitted:
            self.ours[peer].close()
        return admitted

    def gone(self) -> list[tuple[str, int]]:
        """List those whose connection was ended."""
        return [peer for peer, theirs in self.theirs.items() if _ended(theirs)]

    def end(self) -> None:
        """Close everything."""
        for end in (*self.theirs.values(), *self.ours.values()):
            end.close()
        assert (self.count, self.full, self.busy(None)) == (0, False, False)


def _ended(theirs: socket.socket) -> bool:
    try:
        return theirs.recv(1) == b""
    except BlockingIOError:
        return False


def test_a_newcomer_takes_the_place_of_who_has_waited_longest() -> None:
    book = Book(8)
    for port in range(4):
        book.at += 1.0
        assert book.come(FAR, port)
    book.headers_received((FAR, 0), body=True)
    book.request_received((FAR, 0))  # is being answered
    book.headers_received((FAR, 1), body=True)
    assert book.come(FAR, 4)  # half of all places are full with this address
    assert book.gone() == [(FAR, 2)]
    book.answered((FAR, 0))  # and waits for another request, as the last of all
    for port in range(4):
        assert book.come(NEAR, port)
    assert book.gone() == [(FAR, 2)]
    assert book.come("10.0.0.1", 1)  # all places are full: the longest wait of any address
    assert book.gone() == [(FAR, 2), (FAR, 3)]
    assert book.count == 8
    book.end()


def test_what_is_answered_stays_and_leaves_places_for_a_stop() -> None:
    book = Book(8)
    for port in range(4):
        assert book.come(FAR, port)
        book.headers_received((FAR, port), body=False)
        assert not book.busy((NEAR, 0))
    assert not book.come(FAR, 9)  # nobody of this address can go
    for port in range(2):
        assert book.come(NEAR, port)
        book.headers_received((NEAR, port), body=False)
    assert book.busy((NEAR, 9))  # three quarters: the doors refuse all but stops and leases
    assert book.gone() == [(FAR, 9)]
    book.end()


def test_headers_bodies_and_idle_lines_have_a_time() -> None:
    book = Book(8)
    for port in range(4):
        assert book.come(NEAR, port)
    book.at += HEADER_SECONDS - 1.0
    book.headers_received((NEAR, 1), body=True)
    book.headers_received((NEAR, 2), body=False)
    book.headers_received((NEAR, 3), body=False)
    book.answered((NEAR, 3))
    book.at += 2.0
    book.sweep()
    assert book.gone() == [(NEAR, 0)]
    book.at += HEADER_SECONDS
    book.sweep()
    assert book.gone() == [(NEAR, 0), (NEAR, 3)]
    book.at += BODY_SECONDS
    book.sweep()
    assert book.gone() == [(NEAR, 0), (NEAR, 1), (NEAR, 3)]  # not who is answered, however long that takes
    book.ours[NEAR, 0].close()
    book.end()


def test_a_request_that_comes_before_the_last_one_is_reported_keeps_its_time() -> None:
    book = Book(8)
    assert book.come(NEAR, 0)
    book.headers_received((NEAR, 0), body=False)
    book.headers_received((NEAR, 0), body=False)  # a stream, say
    book.answered((NEAR, 0))
    book.at += 2 * HEADER_SECONDS
    book.sweep()
    assert book.gone() == []
    book.answered((NEAR, 0))
    book.at += 2 * HEADER_SECONDS
    book.sweep()
    assert book.gone() == [(NEAR, 0)]
    book.end()


def test_a_busy_service_answers_stops_and_leases_alone(state: Path) -> None:
    with serving(state) as daemon:
        daemon.app.user_middleware[0].kwargs["connections"].__class__ = type(
            "Busy", (Connections,), {"busy": lambda *_: True}
        )
        answer = daemon.get("/api/v1/arms")
        assert (answer.status_code, answer.headers["retry-after"]) == (503, "1")
        assert daemon.post("/api/v1/stop").status_code == 200
        assert daemon.post("/api/v1/arms/planar2/stop").status_code == 200
        assert daemon.post("/api/v1/jobs/none/lease").status_code == 404
        assert daemon.post("/stop").status_code == 200


@pytest.mark.slow
def test_ten_stops_at_once_while_everything_waits(tmp_path: Path) -> None:
    measured = stops.measure(tmp_path, 3)
    # A tenth of a second on a machine that does nothing else (`make bench-stops`); tests have company.
    assert max(measured.obeyed) < 5.0
    assert len(measured.obeyed) == 30
    assert measured.checked > 0
    assert measured.log_bytes < 1e6


@pytest.mark.slow
def test_a_line_without_a_request_is_closed(state: Path) -> None:
    with daemon_process(state) as (_, client):
        parts = urlsplit(client.url)
        lines = []
        for begun in (b"", b"GET / HT", b"POST /api/v1/login HTTP/1.1\r\nHost: 127.0.0.1\r\n"):
            lines.append(socket.create_connection((str(parts.hostname), int(parts.port or 0)), timeout=60))
            lines[-1].sendall(begun)
        began, kept = time.monotonic(), HTTPConnection(str(parts.hostname), parts.port, timeout=60)
        kept.connect()
        line_kept = kept.sock
        while time.monotonic() - began < HEADER_SECONDS + 2.0:
            for method, path in (("GET", "/healthz"), ("POST", "/api/v1/stop")):
                kept.request(method, path)
                answer = kept.getresponse()
                assert (answer.status, bool(answer.read())) == (200, True)
            assert kept.sock is line_kept  # one line, asked all the time
            time.sleep(0.2)
        kept.close()
        for line in lines:
            line.settimeout(0.0)
            assert line.recv(100) == b""
            line.close()


@pytest.mark.slow
def test_handshakes_that_do_not_go_on_have_a_time_too(state: Path, tmp_path: Path) -> None:
    pem = tmp_path / "pem"
    words = "req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN=localhost -addext subjectAltName=IP:127.0.0.1"
    subprocess.run(
        ["openssl", *words.split(), "-keyout", str(pem), "-out", str(tmp_path / "cert")],
        check=True,
        capture_output=True,
    )
    os.environ["SSL_CERT_FILE"] = str(tmp_path / "cert")
    try:
        with daemon_process(state, "--tls-cert", str(tmp_path / "cert"), "--tls-key", str(pem)) as (_, client):
            parts = urlsplit(client.url)
            silent = socket.create_connection((str(parts.hostname), int(parts.port or 0)), timeout=60)
            context = ssl.create_default_context(cafile=str(tmp_path / "cert"))
            with socket.create_connection((str(parts.hostname), int(parts.port or 0)), timeout=60) as raw:
                half = context.wrap_socket(raw, server_hostname="127.0.0.1")
                half.sendall(b"GET / HTTP/1.1\r\n")
                assert half.recv(100) == b""
                half.close()
            assert silent.recv(100) == b""
            silent.close()
            assert client.post("/api/v1/stop") == {"arms": [], "jobs": []}
            del os.environ["SSL_CERT_FILE"]
            with pytest.raises(ArmError, match=r"SSL_CERT_FILE=FILE\.pem"), IdentClient(client.url, "none") as stranger:
                stranger.arms()
    finally:
        os.environ.pop("SSL_CERT_FILE", None)


def test_a_log_that_nobody_reads_keeps_nobody() -> None:
    reader, writer = os.pipe()
    log, lines = logging.Logger("test"), list[str]()
    with os.fdopen(reader) as read, os.fdopen(writer, "w") as stream:
        handler = QueuedHandler(stream)
        handler.setFormatter(JsonLines())
        log.addHandler(handler)
        for k in range(5000):
            log.info("line", extra={"number": k, "filler": "x" * 200})  # at all: a pipe holds 64 kB
        reading = threading.Thread(target=lambda: lines.extend(read))
        reading.start()
        while not handler._lines.empty():  # `close` waits for a second at most, however busy the machine is
            time.sleep(0.01)
        handler.close()
        handler._thread.join()
        stream.close()
        reading.join()
    numbers = [json.loads(line)["number"] for line in lines]
    # The queue holds the first thousand. Then the pipe fills, line by line, whenever the writing thread gets its turn:
    # which lines find room until both are full depends on when that is.
    assert numbers[:1000] == list(range(1000))
    assert numbers == sorted(set(numbers))
    assert len(numbers) < 5000


def test_repeated_log_messages_are_left_out_and_counted() -> None:
    now, kept = [0.0], list[logging.LogRecord]()
    log = logging.Logger("test")
    handler = logging.Handler()
    handler.emit = kept.append  # type: ignore[method-assign]
    handler.addFilter(RepeatFilter(lambda: now[0]))
    log.addHandler(handler)
    for _ in range(1000):
        log.warning("again %s", "and again")
        log.info("request", extra={"status": 401})
    assert len(kept) == 200
    log.info("request", extra={"status": 200})
    log.warning("something else")
    now[0] = 11.0
    log.warning("again %s", "and again")
    assert [vars(record).get("left_out") for record in kept[200:]] == [None, None, 900]


def test_descriptors_are_raised_and_leave_a_reserve(monkeypatch: pytest.MonkeyPatch) -> None:
    limits, given = (1024, 1 << 20), list[tuple[int, int]]()
    monkeypatch.setattr(connections.resource, "getrlimit", lambda _: limits)
    monkeypatch.setattr(connections.resource, "setrlimit", lambda _, wanted: given.append(wanted))
    assert connections.raise_connection_limit() == 512
    assert given == [(4096, 1 << 20)]
    for hard, most in ((1024, 512), (512, 256), (64, 16)):
        limits = (hard, hard)
        assert connections.raise_connection_limit() == most
    assert len(given) == 1


def test_the_request_guard_knows_who_waits(daemon: Asked) -> None:
    book = daemon.app.user_middleware[0].kwargs["connections"]
    peer = ("127.0.0.1", 5)
    ours, theirs = socket.socketpair()
    with theirs, Connection.of(ours, peer, book) as connection:
        assert book.admit(connection)
        for answer in (daemon.get("/healthz"), daemon.post("/api/v1/login", {"token": "x"})):
            assert answer.status_code in (200, 401)
            assert list(book._waiting) == [peer]
    assert book.count == 0


class _Reader:
    """A connection with one piece of a request to read."""

    def __init__(self, *, torn: bool = False) -> None:
        self.host, self.torn, self.has_read = NEAR, torn, False

    def read_piece(self) -> bool:
        self.has_read = True
        if self.torn:
            raise RuntimeError("torn")
        return False


def test_a_request_that_raises_while_it_is_read_keeps_no_other_from_its_turn() -> None:
    readers = [_Reader(torn=True), _Reader(), _Reader()]

    async def read() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda loop, context: None)
        turns = connections.ReadingTurns()
        for reader in readers:
            turns.wait(reader)  # type: ignore[arg-type]
        for _ in range(5):
            await asyncio.sleep(0)

    asyncio.run(read())
    assert [reader.has_read for reader in readers] == [True, True, True]
