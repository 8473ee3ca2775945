"""Count the connections of the service's listener, and close those that wait too long without a request.

A new connection is always admitted. Where there are too many, of one address or of all, the connection is closed that
has waited longest without a complete request: half a request, a TLS handshake that does not go on, an idle connection.
So a stop always finds a place, whoever keeps connections open. Requests that are being answered keep theirs; they are
fewer than the places, of one address and of all, because the middleware refuses more (`busy`), a stop and a lease
excepted. A client that does not read its answer is closed, too; one without a token gives way to newcomers as if it had
not asked, and has a minute for all of it.

uvicorn's own `limit_concurrency` counts idle connections and would refuse the stop; it has no deadline for a request.

Reading takes the event loop's time, too: of 256 kB that are one-byte chunks a second and more. So requests are read in
small pieces, and in each turn of the loop all connections together have a few milliseconds for it and begin a few
requests. The heads of stops and of leases' renewals have as much for themselves, and are read at once where there is no
flood of them. A request that was sent behind another one waits for its turn as well (`ReadingTurns`, `FairReader`).
"""

from __future__ import annotations

import asyncio
import re
import resource
import socket
import time
from asyncio import sslproto
from collections import Counter, deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final, Self

import h11
from uvicorn.protocols.http.flow_control import FlowControl
from uvicorn.protocols.http.h11_impl import H11Protocol

HEADER_SECONDS: Final = 10.0  # for a handshake and the headers of a request
BODY_SECONDS: Final = 60.0  # for 16 MiB over 2.2 Mbit/s
ANSWER_SECONDS: Final = 60.0  # s for a client to read the next piece of an answer
_MOST, _FEWEST = 512, 16
_DESCRIPTORS = 4096  # descriptors that are asked for, if the hard limit of the process allows it
_RESERVE = 256  # descriptors for files, pipes of jobs, and connections that are being closed
_LEAVING = 64
_AT_ONCE, _GONE_AT_ONCE = 8, 64  # connections accepted before the event loop turns to other work; whose client has gone
_TURN: Final = 0.002  # s of the processor for reading requests in each turn of the event loop
_PIECES: Final = 16  # that are read in each turn; behind one, TLS may have 16 kB of one-byte records to decrypt
_REQUESTS: Final = 4  # that begin, or whose bodies become whole, in each turn; JSON of 64 kB takes 3 ms to read
_PIECE = 1024  # bytes; of one-byte chunks or empty headers 2 ms to read
_URGENT: Final = re.compile(rb"POST [^ ?]*/(?:stop|lease)[ ?]")
_URGENT_BYTES: Final = 4096  # of the head of such a request
_AT_A_TIME: Final = 16 * 1024  # bytes received of a connection before they are read
_MOST_LINES: Final = 100  # of a head; of 16 kB that are four thousand, 50 ms to read
Peer = tuple[str, int]


def raise_connection_limit() -> int:
    """Raise this process's limit of open files as far as allowed; return how many connections to accept at a time."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, _DESCRIPTORS)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
        soft = wanted
    return _MOST if soft == resource.RLIM_INFINITY else max(_FEWEST, min(_MOST, soft - _RESERVE))


def receive_little_of_tls() -> None:
    """Make asyncio decrypt at most `_AT_A_TIME` bytes of any TLS connection at once; more blocks the loop."""
    sslproto.SSLProtocol.max_size = _AT_A_TIME


class Connections:
    """Table of the open connections and of their deadlines."""

    def __init__(self, most: int = _MOST, now: Callable[[], float] = time.monotonic) -> None:
        """Begin without connections.

        Args:
            most: largest number of connections; half as many of one address.
            now: clock of the deadlines [s].
        """
        self._most, self._most_of_one, self._now = most, max(most // 2, 1), now
        self._open: dict[Peer, Connection] = {}
        self._waiting: dict[Peer, float] = {}  # peer to deadline, the longest waiting first
        self._sending: dict[Peer, float] = {}  # to the deadline
        self._of_one, self._requests = Counter[str](), Counter[Peer]()
        self._leaving = 0

    @property
    def full(self) -> bool:
        """Return whether no more connections are accepted, because too many are open or not yet wholly closed."""
        return len(self._open) + self._leaving >= self._most + _LEAVING

    def busy(self, peer: Peer | None) -> bool:
        """Return whether 3/4 of the connections allowed in all, or to this peer's address, are being answered."""
        if len(self._open) - len(self._waiting) >= 3 * self._most // 4:
            return True
        most, host = 3 * self._most_of_one // 4, None if peer is None else peer[0]
        if host is None or self._of_one[host] < most:
            return False
        return self._of_one[host] - sum(one[0] == host for one in self._waiting) >= most

    @property
    def count(self) -> int:
        """Return the number of open connections."""
        return len(self._open)

    def admit(self, connection: Connection) -> bool:
        """Admit a new connection, if full in place of the one that waits longest for a request; False if none does."""
        host = connection.peer[0]
        if self._of_one[host] >= self._most_of_one:
            longest = next((peer for peer in self._waiting if peer[0] == host), None)
        elif len(self._open) >= self._most:
            longest = next(iter(self._waiting), None)
        else:
            longest = connection.peer
        if longest is None:
            return False
        if longest != connection.peer:
            self._let_go(longest)
        self._open[connection.peer] = connection
        self._of_one[host] += 1
        self._waiting[connection.peer] = self._now() + HEADER_SECONDS
        return True

    def headers_received(self, peer: Peer | None, *, body: bool) -> None:
        """Note that a request's headers are complete; with a body its deadline begins, else it is being answered."""
        if peer in self._open:
            # The next request of a connection may arrive before the end of this one is noted.
            self._requests[peer] += 1
            self._waiting.pop(peer, None)
            if body:
                self._waiting[peer] = self._now() + BODY_SECONDS

    def request_received(self, peer: Peer | None) -> None:
        """Note that a request has been received whole: no deadline until its answer begins to be sent."""
        if peer is not None:
            self._waiting.pop(peer, None)

    def answering_stranger(self, peer: Peer | None) -> None:
        """Note that an answer to a client without a token begins: it has a deadline, and gives way to newcomers."""
        if peer in self._open:
            self._waiting.pop(peer, None)
            self._waiting[peer] = self._now() + ANSWER_SECONDS

    def sending(self, peer: Peer | None) -> None:
        """Note that a piece of an answer is being sent; the client's deadline to read it begins."""
        if peer in self._open:
            self._sending[peer] = self._now() + ANSWER_SECONDS

    def sent(self, peer: Peer | None) -> None:
        """Note that the client's end has taken the piece of the answer."""
        if peer is not None:
            self._sending.pop(peer, None)

    def answered(self, peer: Peer | None) -> None:
        """Note that a request is answered; if it was the connection's last, the deadline for the next one begins."""
        if peer in self._open:
            self._requests[peer] -= 1
            if self._requests[peer] <= 0:
                self._waiting.pop(peer, None)
                self._waiting[peer] = self._now() + HEADER_SECONDS

    def closed(self, connection: Connection) -> None:
        """Remove a connection that is closed from the table."""
        if self._open.get(connection.peer) is connection:
            self._forget(connection.peer)
        elif connection.leaving:
            self._leaving -= 1

    def sweep(self) -> None:
        """Close the connections whose deadline has passed."""
        now = self._now()
        for table in (self._waiting, self._sending):
            for peer in [peer for peer, deadline in table.items() if deadline < now]:
                self._let_go(peer)

    def _let_go(self, peer: Peer) -> None:
        connection = self._forget(peer)
        connection.leaving = True
        self._leaving += 1
        # The event loop then reads the end of the stream, during a TLS handshake too, and closes the socket.
        with suppress(OSError):
            connection.shutdown(socket.SHUT_RDWR)

    def _forget(self, peer: Peer) -> Connection:
        connection = self._open.pop(peer)
        self._waiting.pop(peer, None)
        self._sending.pop(peer, None)
        self._requests.pop(peer, None)
        self._of_one[peer[0]] -= 1
        if not self._of_one[peer[0]]:
            del self._of_one[peer[0]]
        return connection


class Connection(socket.socket):
    """Accepted socket that tells the table of connections when it is closed."""

    peer: Peer
    leaving = False
    book: Connections

    @classmethod
    def of(cls, accepted: socket.socket, peer: Peer, book: Connections) -> Self:
        """Make a connection of an accepted socket, whose file descriptor it takes over."""
        made = cls(accepted.family, accepted.type, accepted.proto, fileno=accepted.detach())
        made.peer, made.book = peer, book
        return made

    def close(self) -> None:
        """Close the socket and, the first time, remove it from the table of connections."""
        gone = self.fileno() < 0
        super().close()
        if not gone:
            self.book.closed(self)


class Listener(socket.socket):
    """Listening socket that counts its connections before anything is read from them."""

    def __init__(self, family: int, book: Connections) -> None:
        """Create the listening socket; it is not bound yet.

        Args:
            family: address family, such as `socket.AF_INET`.
            book: counter of the connections.
        """
        super().__init__(family, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
        self._book, self._accepted, self._gone = book, 0, 0

    def accept(self) -> tuple[socket.socket, Any]:
        """Return (socket, address) of the next admitted connection, closing others; BlockingIOError if none or enough.

        Raises:
            BlockingIOError: nobody waits, or it is somebody else's turn in the event loop.
        """
        while True:
            if self._accepted >= _AT_ONCE or self._gone >= _GONE_AT_ONCE or self._book.full:
                self._accepted = self._gone = 0
                raise BlockingIOError
            accepted, address = super().accept()
            if _gone(accepted):  # without the half millisecond that a protocol for it takes
                self._gone += 1
                accepted.close()
                continue
            self._accepted += 1
            connection = Connection.of(accepted, (str(address[0]), int(address[1])), self._book)
            if self._book.admit(connection):
                return connection, address
            connection.close()


def _gone(accepted: socket.socket) -> bool:
    """Return whether the client has closed a connection on which it had sent nothing."""
    try:
        return not accepted.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
    except BlockingIOError:
        return False
    except OSError:
        return True


class ReadingTurns:
    """Turns of the connections that wait to have the next piece of a request read.

    Addresses take turns, and so do the connections of one address: a flood from one delays no other.
    """

    def __init__(self) -> None:
        """Begin without connections."""
        self._spent, self._requests, self._scheduled = 0.0, 0, False
        self._pieces = 0
        self._waiting: dict[str, deque[FairReader]] = {}  # by address, the one whose turn it is first

    @property
    def free(self) -> bool:
        """Return whether a piece may be read at once: nobody waits, and there is time left in this turn."""
        return not self._waiting and self._goes_on

    @property
    def _goes_on(self) -> bool:
        return self._spent < _TURN and self._requests < _REQUESTS and self._pieces < _PIECES

    def read(self, reader: FairReader) -> None:
        """Let a connection read and handle one piece of its input now, and count the time against this turn."""
        began = time.thread_time()
        try:
            self._requests += reader.read_piece()
        finally:
            self._spent += time.thread_time() - began
            self._pieces += 1
            self._schedule()

    def wait(self, reader: FairReader) -> None:
        """Queue a connection, behind others of its host, to read its next piece when its turn comes."""
        self._waiting.setdefault(reader.host, deque()).append(reader)
        self._schedule()

    def _schedule(self) -> None:
        if not self._scheduled:
            self._scheduled = True
            asyncio.get_running_loop().call_soon(self._turn)

    def _turn(self) -> None:
        self._scheduled, self._spent, self._requests, self._pieces = False, 0.0, 0, 0
        try:
            while self._waiting and self._goes_on:
                self.read(self._next())
        finally:  # whatever one connection's request ends in, the others have their turn
            if self._waiting:
                self._schedule()

    def _next(self) -> FairReader:
        host = next(iter(self._waiting))
        queue = self._waiting.pop(host)
        reader = queue.popleft()
        if queue:
            self._waiting[host] = queue
        return reader


class FairReader(H11Protocol):
    """HTTP protocol of one connection that reads its requests in pieces, each in its turn.

    A piece is what has been received, or a request behind the one that was answered. While one waits, nothing more is
    received.
    """

    def __init__(self, *settings: Any, turns: ReadingTurns, urgent: ReadingTurns, **more: Any) -> None:
        """Take uvicorn's settings, and the turns that all connections share: of urgent heads, and of all else."""
        super().__init__(*settings, **more)
        self._turns, self._urgent_turns, self.host = turns, urgent, ""
        self._received, self._piece = bytearray(), _PIECE
        self._more_requests = self._queued = self._reading = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Prepare a new connection: note the client's address, limit its TLS buffer, set up flow control."""
        super().connection_made(transport)
        self.host = self.client[0] if self.client else ""
        if hasattr(transport, "max_size"):  # with TLS as `receive_little_of_tls` says
            transport.max_size = _AT_A_TIME
        self.flow = _ReaderFlow(transport, self)

    def data_received(self, data: bytes) -> None:
        """Store what has come, and handle its first piece at once if nobody else waits; else queue for a turn."""
        urgent = not self._waits and self._urgent(data)
        self._received += data
        if not self._queued:
            self._piece = _URGENT_BYTES if urgent else _PIECE
            turns = self._urgent_turns if urgent else self._turns
            if turns.free and not self.flow.read_paused:
                turns.read(self)
            else:
                self._wait(turns)

    def handle_events(self) -> None:
        """Handle what has been read; a request behind the one that was answered waits for its turn."""
        if self._reading:
            super().handle_events()
        elif self.conn.trailing_data[0]:
            self._more_requests = True
            self.go_on()

    def send_400_response(self, msg: str) -> None:
        """Answer 400 to a mistake of the client, and drop what the application answers to the broken request."""
        super().send_400_response(msg)
        self._drop_answer()

    def connection_lost(self, exc: Exception | None) -> None:
        """Drop what has been received of a lost connection and not been handled."""
        self._forget()
        super().connection_lost(exc)

    def read_piece(self) -> bool:
        """Handle the next piece of the received input; return whether a request has begun or become whole by it.

        Returns:
            Whether a request has begun, or has become whole, so that the application goes to work.

        Raises:
            Exception: whatever else than a mistake of the client the request ends in; the connection is closed.
        """
        self._queued, self._reading = False, True
        before = self.cycle, self.conn.their_state
        try:
            if self.transport.is_closing():
                self._forget()
            elif self._more_requests:
                self._more_requests = False
                super().handle_events()
            elif self._received:
                size = max(self._piece, self._plain_bytes())
                piece = bytes(self._received[:size])
                del self._received[:size]
                super().data_received(piece)
            self._require_few_lines()
        except h11.ProtocolError:  # a mistake of the client after its answer has begun: it cannot be told any more
            self.logger.warning("an invalid request was broken off")
            self._break_off()
        except BaseException:
            self._break_off()
            raise
        finally:
            self._reading, self._piece = False, _PIECE
        self.go_on()
        return before != (self.cycle, self.conn.their_state)

    def go_on(self) -> None:
        """Queue for the next turn if received input is left, else let the transport receive more."""
        if self._waits:
            self._wait(self._turns)
        elif not self.flow.read_paused and not self.transport.is_closing():
            self.transport.resume_reading()

    @property
    def _waits(self) -> bool:
        return bool(self._received) or self._more_requests

    def _wait(self, turns: ReadingTurns) -> None:
        self.transport.pause_reading()
        # The application takes what came before first (`_ReaderFlow`).
        if not self._queued and (self._more_requests or not self.flow.read_paused):
            self._queued = True
            turns.wait(self)

    def _forget(self) -> None:
        self._received.clear()
        self._more_requests = False

    def _drop_answer(self) -> None:
        if self.cycle is not None and not self.cycle.response_complete:
            self.cycle.disconnected = True
            self.cycle.message_event.set()

    def _break_off(self) -> None:
        self._forget()
        self._drop_answer()
        self.transport.abort()

    def _plain_bytes(self) -> int:
        """Return how much follows of a body whose length was told; h11 reads any amount of it at once."""
        return int(getattr(getattr(self.conn, "_reader", None), "_remaining", 0))

    def _require_few_lines(self) -> None:
        """Refuse a head, or trailers, of so many lines that reading them would take long; h11 reads all at once."""
        if self.conn.their_state not in (h11.IDLE, h11.SEND_BODY):
            return
        if self.conn.trailing_data[0].count(b"\n") <= _MOST_LINES or self.transport.is_closing():
            return
        self.logger.warning("a request with too many lines of headers was refused")
        if self.conn.our_state is h11.IDLE:
            self.send_400_response(f"a request has {_MOST_LINES} lines of headers at most")
        else:
            self._break_off()

    def _urgent(self, data: bytes) -> bool:
        """Return whether this is the whole head of a stop or a lease's renewal, on a connection that waits for one."""
        return (
            len(data) <= _URGENT_BYTES
            and _URGENT.match(data) is not None
            and b"\r\n\r\n" in data
            and b"chunked" not in data.lower()
            and data.count(b"\n") <= _MOST_LINES
            and self.conn.their_state is h11.IDLE
        )


class _ReaderFlow(FlowControl):
    """Flow control that does not receive more while something waits to be read."""

    def __init__(self, transport: asyncio.Transport, reader: FairReader) -> None:
        super().__init__(transport)
        self._reader = reader

    def resume_reading(self) -> None:
        """Let the application take more: first what waits to be read, then what is received."""
        if self.read_paused:
            self.read_paused = False
            self._reader.go_on()
