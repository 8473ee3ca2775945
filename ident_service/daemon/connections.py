"""Count the connections of the service's listener, and close those that wait too long without a request.

A new connection is always admitted. Where there are too many, of one address or of all, the connection is closed that
has waited longest without a complete request: half a request, a TLS handshake that does not go on, an idle connection.
So a stop always finds a place, whoever keeps connections open. Requests that are being answered keep theirs; they are
fewer than the places, of one address and of all, because the middleware refuses more (`busy`), a stop and a lease
excepted. A client that does not read its answer is closed, too.

uvicorn's own `limit_concurrency` counts idle connections and would refuse the stop; it has no deadline for a request.
"""

from __future__ import annotations

import resource
import socket
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final, Self

HEADER_SECONDS: Final = 10.0  # for a handshake and the headers of a request
BODY_SECONDS: Final = 60.0  # for 16 MiB over 2.2 Mbit/s
ANSWER_SECONDS: Final = 60.0  # s for a client to read the next piece of an answer
_MOST, _FEWEST = 512, 16
_DESCRIPTORS = 4096  # descriptors that are asked for, if the hard limit of the process allows it
_RESERVE = 256  # descriptors for files, pipes of jobs, and connections that are being closed
_LEAVING = 64
_AT_ONCE = 16  # connections accepted before the event loop turns to other work
Peer = tuple[str, int]


def raise_connection_limit() -> int:
    """Raise the limit of open files as far as allowed, and return how many connections it leaves room for."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, _DESCRIPTORS)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
        soft = wanted
    return _MOST if soft == resource.RLIM_INFINITY else max(_FEWEST, min(_MOST, soft - _RESERVE))


class Connections:
    """Table of the open connections and of their deadlines."""

    def __init__(self, most: int = _MOST, now: Callable[[], float] = time.monotonic) -> None:
        """Begin without connections.

        Args:
            most: how many there may be; half as many of one address.
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
        """Return whether even the connections that are being closed have not been closed yet."""
        return len(self._open) + self._leaving >= self._most + _LEAVING

    def busy(self, peer: Peer | None) -> bool:
        """Return whether as many requests are being answered as may be, of all addresses or of this peer's."""
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
        """Admit a new connection, closing the longest waiting one if necessary; False where none can be closed."""
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
        """Note that a request is complete."""
        if peer is not None:
            self._waiting.pop(peer, None)

    def sending(self, peer: Peer | None) -> None:
        """Note that a piece of an answer is being sent; the client's deadline to read it begins."""
        if peer in self._open:
            self._sending[peer] = self._now() + ANSWER_SECONDS

    def sent(self, peer: Peer | None) -> None:
        """Note that the client's end has taken the piece of the answer."""
        if peer is not None:
            self._sending.pop(peer, None)

    def answered(self, peer: Peer | None) -> None:
        """Note that a request is answered; the connection's deadline for the next one begins."""
        if peer in self._open:
            self._requests[peer] -= 1
            if self._requests[peer] <= 0:
                self._waiting.pop(peer, None)
                self._waiting[peer] = self._now() + HEADER_SECONDS

    def closed(self, connection: Connection) -> None:
        """Remove a connection that is closed."""
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
        """Make a connection of an accepted socket."""
        made = cls(accepted.family, accepted.type, accepted.proto, fileno=accepted.detach())
        made.peer, made.book = peer, book
        return made

    def close(self) -> None:
        """Close the socket, and tell the table once."""
        gone = self.fileno() < 0
        super().close()
        if not gone:
            self.book.closed(self)


class Listener(socket.socket):
    """Listening socket that counts its connections before anything is read from them."""

    def __init__(self, family: int, book: Connections) -> None:
        """Create the listening socket; it is not bound yet.

        Args:
            family: of addresses.
            book: counts.
        """
        super().__init__(family, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
        self._book, self._accepted = book, 0

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept the next connection that is admitted.

        Raises:
            BlockingIOError: nobody waits, or it is somebody else's turn in the event loop.
        """
        while True:
            self._accepted += 1
            if self._accepted > _AT_ONCE or self._book.full:
                self._accepted = 0
                raise BlockingIOError
            accepted, address = super().accept()
            connection = Connection.of(accepted, (str(address[0]), int(address[1])), self._book)
            if self._book.admit(connection):
                return connection, address
            connection.close()
