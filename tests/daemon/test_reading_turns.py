"""Requests that are read in pieces: none is lost, none waits for ever, and no flood of them holds up the event loop."""

from __future__ import annotations

import asyncio
import hashlib
import random
import re
import socket
import ssl
import struct
import subprocess
from asyncio import sslproto
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from daemon.conftest import serving
from hypothesis import given, settings
from hypothesis import strategies as st
from uvicorn.server import ServerState

from ident_service.daemon import connections
from ident_service.daemon.connections import Connections, FairReader, Listener, ReadingTurns
from ident_service.daemon.serve import _MOST_HEADERS

App = Callable[[Any, Any, Any], Awaitable[None]]
SOON = 30.0  # s: a reader that was forgotten would wait for ever
START = {"type": "http.response.start", "status": 200}


@asynccontextmanager
async def served(
    app: App, readers: list[FairReader] | None = None, tls: ssl.SSLContext | None = None
) -> AsyncIterator[int]:
    """Serve an application by `FairReader` on a port of its own, as the daemon does."""
    config = uvicorn.Config(
        app, log_config=None, ws="none", lifespan="off", h11_max_incomplete_event_size=_MOST_HEADERS
    )
    config.load()
    state, turns, urgent = ServerState(), ReadingTurns(), ReadingTurns()

    def reader() -> FairReader:
        made = FairReader(config=config, server_state=state, app_state={}, turns=turns, urgent=urgent)
        if readers is not None:
            readers.append(made)
        return made

    server = await asyncio.get_running_loop().create_server(reader, "127.0.0.1", 0, ssl=tls)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        server.close()
        for one in list(state.connections):
            one.transport.abort()
        for task in list(state.tasks):
            task.cancel()
        await asyncio.sleep(0)


async def answered(port: int, data: list[bytes], count: int, tls: ssl.SSLContext | None = None) -> list[bytes]:
    """Send pieces of requests and return the bodies of so many answers."""
    read, write = await asyncio.open_connection("127.0.0.1", port, ssl=tls)

    async def send() -> None:
        for piece in data:
            write.write(piece)
            await write.drain()
            await asyncio.sleep(0)

    sending = asyncio.create_task(send())
    try:
        bodies = []
        for _ in range(count):
            head = await read.readuntil(b"\r\n\r\n")
            (length,) = re.findall(rb"content-length: (\d+)", head)
            bodies.append(await read.readexactly(int(length)))
        return bodies
    finally:
        sending.cancel()
        write.close()


async def respond(send: Any, body: bytes) -> None:
    await send({**START, "headers": [(b"content-length", str(len(body)).encode())]})
    await send({"type": "http.response.body", "body": body})


async def digest(scope: Any, receive: Any, send: Any) -> None:
    """Answer with path and digest of the body; below /unread without reading the body, below /slow after a while."""
    body = b""
    if scope["path"].startswith("/slow"):
        await asyncio.sleep(0.002)
    while not scope["path"].startswith("/unread"):
        message = await receive()
        if message["type"] == "http.disconnect":
            return
        body += message["body"]
        if not message["more_body"]:
            break
    await respond(send, f"{scope['path']} {hashlib.sha256(body).hexdigest()}".encode())


def request(rng: random.Random, number: int) -> tuple[bytes, bytes]:
    """Return a request and its answer."""
    path = f"{rng.choice(('/read', '/unread', '/slow', '/a/stop', '/a/lease'))}".encode()
    body = rng.randbytes(rng.choice((0, 0, 5, 700, 70_000, 200_000)) if number else 10)
    head = b"POST " + path + b" HTTP/1.1\r\nHost: x\r\n"
    match rng.randrange(3):
        case 0:
            data = head + b"Content-Length: %d\r\n\r\n" % len(body) + body
        case 1:
            size = rng.choice((1000, 50_000))
            chunks = [body[k : k + size] for k in range(0, len(body), size)]
            text = b"".join(b"%x\r\n%s\r\n" % (len(chunk), chunk) for chunk in chunks)
            data = head + b"Transfer-Encoding: chunked\r\n\r\n" + text + b"0\r\n\r\n"
        case _:
            body = b""
            data = head.replace(b"POST", b"GET") + b"\r\n"
    read = b"" if path == b"/unread" else body
    return data, path + b" " + hashlib.sha256(read).hexdigest().encode()


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_every_request_is_answered_in_its_order(seed: int) -> None:
    rng = random.Random(seed)  # noqa: S311 - no secret

    async def one(port: int) -> None:
        requests = [request(rng, number) for number in range(rng.randint(1, 8))]
        text, size = b"".join(data for data, _ in requests), rng.choice((7000, 100_000, 10**7))
        pieces = [text[k : k + size] for k in range(0, len(text), size)]
        if rng.random() < 0.2:  # goes away in the middle
            with suppress(asyncio.IncompleteReadError, TimeoutError, ConnectionError):
                await asyncio.wait_for(answered(port, pieces[: len(pieces) // 2], len(requests)), 0.05)
        else:
            assert await answered(port, pieces, len(requests)) == [answer for _, answer in requests]

    async def all_of_them() -> None:
        async with served(digest) as port, asyncio.timeout(SOON):
            await asyncio.gather(*(one(port) for _ in range(12)))

    asyncio.run(all_of_them())


@pytest.mark.parametrize("path", [b"/nothing", b"/a/lease"])
def test_a_flood_begins_a_few_requests_in_each_turn_of_the_loop(path: bytes) -> None:
    # Before, the next of the requests that a connection had sent at once began as soon as one was answered, and so did
    # every renewal of a lease: 250 connections held each turn of the loop for 0.2 s.
    turn, begun, most = 0, Counter[int](), 0
    readers = list[FairReader]()

    async def count(scope: Any, receive: Any, send: Any) -> None:
        nonlocal most
        begun[turn] += 1
        most = max(most, *(len(one._received) + len(one.conn.trailing_data[0]) for one in readers))
        await respond(send, b"done")

    async def flood() -> None:
        async def ticking() -> None:
            nonlocal turn
            while True:
                turn += 1
                await asyncio.sleep(0)

        ticks = asyncio.create_task(ticking())
        data = b"POST " + path + b" HTTP/1.1\r\nHost: x\r\n\r\n"
        async with served(count, readers) as port, asyncio.timeout(SOON):
            answers = await asyncio.gather(*(answered(port, [data * 1, data * 400], 20) for _ in range(50)))
        ticks.cancel()
        assert all(bodies == [b"done"] * 20 for bodies in answers)

    asyncio.run(flood())
    # Four urgent ones and four others; a turn of ours may see the ends of two of the loop's.
    assert max(begun.values()) <= 16
    assert most < 2 * connections._AT_A_TIME


def test_a_body_of_known_length_is_read_in_large_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    pieces, read = list[int](), FairReader.read_piece

    def count(reader: FairReader) -> bool:
        pieces.append(len(reader._received))
        return read(reader)

    monkeypatch.setattr(FairReader, "read_piece", count)

    async def ask() -> list[bytes]:
        body = b" " * 2**20
        head = b"POST /read HTTP/1.1\r\nHost: x\r\nContent-Length: %d\r\n\r\n" % len(body)
        async with served(digest) as port, asyncio.timeout(SOON):
            return await answered(port, [head + body], 1)

    assert asyncio.run(ask()) == [b"/read " + hashlib.sha256(b" " * 2**20).hexdigest().encode()]
    assert len(pieces) < 250  # of 1 kB they would be a thousand, and an upload would take five times the processor


def test_tls_decrypts_little_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sslproto.SSLProtocol, "max_size", sslproto.SSLProtocol.max_size)  # set back at the end
    connections.receive_little_of_tls()
    words = "req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -subj /CN=localhost"
    files = ["-keyout", str(tmp_path / "key"), "-out", str(tmp_path / "cert")]
    subprocess.run(["openssl", *words.split(), *files], check=True, capture_output=True)
    ours, theirs = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), ssl.create_default_context(cafile=str(tmp_path / "cert"))
    ours.load_cert_chain(tmp_path / "cert", tmp_path / "key")
    theirs.check_hostname = False
    sizes, received = list[int](), FairReader.data_received
    monkeypatch.setattr(
        FairReader, "data_received", lambda one, data: (sizes.append(len(data)), received(one, data))[1]
    )

    async def ask() -> list[bytes]:
        data = b"POST /unread HTTP/1.1\r\nHost: x\r\nContent-Length: 0\r\n\r\n" * 5000
        async with served(digest, tls=ours) as port, asyncio.timeout(SOON):
            return await answered(port, [data], 200, theirs)

    assert asyncio.run(ask()) == [b"/unread " + hashlib.sha256(b"").hexdigest().encode()] * 200
    assert max(sizes) <= 2 * connections._AT_A_TIME


def test_connections_whose_clients_have_gone_are_no_protocols_any_more() -> None:
    # Clients that connect and go, 20,000 a second, held up stops by seconds.
    book = Connections()
    with Listener(socket.AF_INET, book) as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen(100)
        listening.setblocking(False)
        for k in range(100):
            with socket.create_connection(listening.getsockname()) as gone:
                if k % 2:  # as a client that is killed
                    gone.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        with socket.create_connection(listening.getsockname()) as silent:
            accepted = list[socket.socket]()
            for _ in range(2):  # turns of the event loop
                with suppress(BlockingIOError):
                    while True:
                        accepted.append(listening.accept()[0])
            assert [one.getpeername() for one in accepted] == [silent.getsockname()]
            assert book.count == 1
        with socket.create_connection(listening.getsockname()) as asked:
            asked.sendall(b"POST /api/v1/stop")  # and is gone: it is heard all the same
        accepted.append(listening.accept()[0])
        assert accepted[-1].recv(100) == b"POST /api/v1/stop"
        for one in accepted:
            one.close()


def test_addresses_take_turns() -> None:
    order = list[str]()

    class Waiting:
        def __init__(self, host: str) -> None:
            self.host = host

        def read_piece(self) -> bool:
            order.append(self.host)
            return True

    async def read() -> None:
        turns = ReadingTurns()
        for host in [*["flood"] * 20, "quiet", "other"]:
            turns.wait(Waiting(host))  # type: ignore[arg-type]
        for _ in range(10):
            await asyncio.sleep(0)

    asyncio.run(read())
    assert order == ["flood", "quiet", "other", *["flood"] * 19]


@pytest.mark.parametrize("method", [b"GET /", b"POST /a/stop"])
def test_a_head_of_thousands_of_lines_is_refused_unread(method: bytes) -> None:
    async def ask() -> bytes:
        async with served(digest) as port, asyncio.timeout(SOON):
            read, write = await asyncio.open_connection("127.0.0.1", port)
            write.write(method + b" HTTP/1.1\r\nHost: x\r\n" + b"a:\r\n" * 3900 + b"\r\n")
            answer = await read.read()
            write.close()
            assert await answered(port, [method + b" HTTP/1.1\r\nHost: x\r\n" + b"a:\r\n" * 90 + b"\r\n"], 1)
            return answer

    answer = asyncio.run(ask())
    assert answer.startswith(b"HTTP/1.1 400 ")
    assert answer.endswith(b"a request has 100 lines of headers at most")


def test_trailers_of_thousands_of_lines_end_the_connection() -> None:
    async def ask() -> bytes:
        async with served(digest) as port, asyncio.timeout(SOON):
            read, write = await asyncio.open_connection("127.0.0.1", port)
            head = b"POST / HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n"
            write.write(head + b"a:\r\n" * 3900 + b"\r\n")
            try:
                return await read.read()
            except ConnectionResetError:
                return b""
            finally:
                write.close()

    assert asyncio.run(ask()) == b""


def test_a_request_that_raises_while_it_waits_for_its_turn_ends_its_connection() -> None:
    # A chunk that is none, after the answer has begun: uvicorn cannot say so any more.
    async def begin(scope: Any, receive: Any, send: Any) -> None:
        await send({**START, "headers": [(b"content-length", b"100")]})
        await asyncio.sleep(SOON)

    errors = list[object]()

    async def ask() -> bytes:
        asyncio.get_running_loop().set_exception_handler(lambda loop, context: errors.append(context))
        async with served(begin) as port, asyncio.timeout(SOON / 3):
            read, write = await asyncio.open_connection("127.0.0.1", port)
            write.write(b"POST / HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n")
            head = await read.readuntil(b"\r\n\r\n")
            write.write(b"bb8\r\n" + b" " * 3000 + b"\r\nnone\r\n")
            try:
                return head[:12] + await read.read()
            except ConnectionResetError:
                return head[:12]
            finally:
                write.close()

    assert asyncio.run(ask()) == b"HTTP/1.1 200"
    assert errors == []  # no traceback for a mistake of a client's


def test_a_torn_request_is_reported_once_and_without_a_traceback(caplog: pytest.LogCaptureFixture) -> None:
    async def ask() -> bytes:
        async with served(digest) as port, asyncio.timeout(SOON):
            read, write = await asyncio.open_connection("127.0.0.1", port)
            write.write(b"POST /unread HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\nnone\r\n")
            answer = await read.read()
            write.close()
            return answer

    assert asyncio.run(ask()).startswith(b"HTTP/1.1 400 ")
    assert [record.levelname for record in caplog.records if record.name.startswith("uvicorn")] == ["WARNING"]


def test_only_a_stop_and_a_renewal_pass_a_busy_service(state: Any) -> None:
    with serving(state) as daemon:
        daemon.app.user_middleware[0].kwargs["connections"].__class__ = type(
            "Busy", (Connections,), {"busy": lambda *_: True}
        )
        for path in ("/api/v1/arms/stop", "/api/v1/jobs/lease"):
            assert daemon.get(path).status_code == 503
