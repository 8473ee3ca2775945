"""Host a wire: take connections, and move frames between their sockets and the medium.

Whoever hosts a wire calls `poll` in its loop: emulated drives, which also have a `LocalPort` on it without any socket;
a thread (`WireThread`); or a process of its own (`python -m sim_backend.can_bus NAME`). An end that sends malformed
packets is disconnected, one that vanishes is forgotten, one that does not read loses frames and is told so; none can
stop the wire. Order, pace and errors are the medium's.
"""

from __future__ import annotations

import os
import select
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from threading import RLock
from typing import Final, Self

from drivers.can.bus_load import exact_bits
from drivers.can.bus_state import BusError
from drivers.can.can_frame import MAX_PACKET_BYTES, MAX_PACKET_FRAMES, Frame, pack_frames, unpack_frames
from ident_service.errors import DriverError
from sim_backend.can_bus import link, packets
from sim_backend.can_bus.medium import BusEndpoint, Medium, overflow

MOST_ENDS: Final = 32
LATEST_NS: Final = 500_000_000  # that a wire makes up for when its host was late
ERROR_BITS: Final = 20  # flag and delimiter of an error, and the interframe space; superposed flags make it up to 26
BEFORE_FDF: Final = 15  # start, identifier, RRS, IDE, and the bit that a classic controller takes for an error
_SELECT_LIMIT: Final = 1024  # descriptors that select, whose timeout alone is finer than milliseconds, can watch


class _End:
    """Hold a connection, and the port it has once it has greeted."""

    def __init__(self, sock: socket.socket) -> None:
        self.socket, self.dropped = sock, False
        self.port: BusEndpoint | None = None
        self.heard_ns = 0  # when its last frame came


class CanBusServer:
    """Emulate a CAN bus for the processes of one user; a context manager.

    Attributes:
        medium: ports, counters of frames, and the errors that can be injected (under `lock`, from another thread).
        lock: held whenever the medium is touched.
        expelled: ends that were disconnected because they sent malformed packets.
    """

    def __init__(
        self,
        name: str,
        bitrate: int = 0,
        data_bitrate: int | None = None,
        *,
        fd: bool = False,
        duration_ns: Callable[[Frame], int] | None = None,
    ) -> None:
        """Configure a wire; nobody can connect before the context is entered.

        Args:
            name: channel that ends connect to: a name, or the path of a socket file.
            bitrate: pace to keep [bit/s]; 0: none.
            data_bitrate: bit rate of the data of CAN FD's frames [bit/s]; None: the wire has none, but for `fd`.
            fd: whether frames may be CAN FD's although there is no pace.
            duration_ns: function that returns the time for which a frame occupies the wire [ns], instead of its bits at
                these rates.

        Raises:
            DriverError: a pace for CAN FD without its data bit rate.
        """
        self.fd = fd or data_bitrate is not None
        if self.fd and bitrate and duration_ns is None and data_bitrate is None:
            raise DriverError(f"ident_wire {name}: the pace of CAN FD needs its data bit rate")
        self.name, self.bitrate, self.data_bitrate = name, bitrate, data_bitrate
        error_ns = 0
        if bitrate:
            duration_ns = duration_ns or _pace(bitrate, data_bitrate)
            error_ns = ERROR_BITS * 1_000_000_000 // bitrate
        self.medium = Medium(duration_ns, error_ns, fd=self.fd)
        self.lock = RLock()
        self.expelled = 0
        self._ends: dict[int, _End] = {}
        self._listener: socket.socket | None = None
        self._wake = -1

    def __enter__(self) -> Self:
        """Listen for connections from now on.

        Raises:
            BusError: another process runs this wire, or its address cannot be had.
        """
        self._listener = link.listen(self.name)
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        return self

    def __exit__(self, *_: object) -> None:
        """Close the wire and all its connections."""
        self.close()

    def close(self) -> None:
        """Close the simulated bus and all its connections; any number of times."""
        with self.lock:
            if self._listener is None:
                return
            for end in list(self._ends.values()):
                self._drop(end)
            link.forget(self.name, self._listener)
            self._listener = None
            os.close(self._wake)

    def wake(self) -> None:
        """Make a `poll` that waits in another thread return."""
        with suppress(OSError):
            os.eventfd_write(self._wake, 1)

    def poll(self, deadline_ns: int) -> None:
        """Wait until the deadline for something to do, then read sockets, move frames and deliver them, once.

        Args:
            deadline_ns: how long to wait for something to do [ns, monotonic]; one in the past only looks.

        Raises:
            BusError: the wire is closed.
        """
        if self._listener is None:
            raise BusError("gone", f"ident_wire {self.name}", remedy="this wire is closed")
        listener = self._listener.fileno()
        watched, end_ns = self.watched()
        until = deadline_ns if end_ns is None else min(deadline_ns, end_ns)
        remaining = max(0, until - time.monotonic_ns())
        ready = select.select(watched, [], [], remaining * 1e-9)[0]
        with self.lock:
            now = time.monotonic_ns()
            for number in ready:
                if number == listener:
                    self._accept()
                elif number == self._wake:
                    with suppress(BlockingIOError):
                        os.eventfd_read(self._wake)
                elif (end := self._ends.get(number)) is not None:
                    self._read(end, now)
            self.advance_to(time.monotonic_ns())

    def watched(self) -> tuple[list[int], int | None]:
        """Return the descriptors to wait for (none once closed), and when the frame under way ends [ns] or None."""
        with self.lock:
            if self._listener is None:
                return [], None
            # A port whose queue is full is not read: its socket fills up, and its sender gets an error.
            ends = [
                number
                for number, end in self._ends.items()
                if end.port is None or self.medium.room(end.port) >= MAX_PACKET_FRAMES
            ]
            return [self._listener.fileno(), self._wake, *ends], self.medium.end_ns

    def advance_to(self, now_ns: int) -> None:
        """Advance the simulated bus to `now_ns` and deliver received frames, without reading any socket."""
        self.medium.advance(now_ns)
        for end in list(self._ends.values()):
            if end.port is not None and end.port.inbox:
                self._deliver(end, end.port, now_ns)

    def _accept(self) -> None:
        if self._listener is None:
            return
        try:
            sock = self._listener.accept()[0]
        except OSError:
            return
        sock.setblocking(False)
        # A refused end is told in answer to its greeting: closed before, its unread greeting would hide the answer.
        if link.peer_is_trusted(sock) and len(self._ends) < 2 * MOST_ENDS and sock.fileno() < _SELECT_LIMIT:
            self._ends[sock.fileno()] = _End(sock)
        else:
            sock.close()

    def _read(self, end: _End, now: int) -> None:
        try:
            data = end.socket.recv(MAX_PACKET_BYTES + 1)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop(end)
            return
        try:
            if end.port is None:
                self._greet(end, packets.unpack_hello(data))
                return
            for frame, _ in unpack_frames(data):
                if frame.error:
                    raise DriverError("a frame that no controller sends")
                # The queue had room for a whole packet. A frame came when it was sent, however late this process is.
                end.heard_ns = max(end.heard_ns, min(now, max(frame.stamp_ns, now - LATEST_NS)))
                self.medium.offer(end.port, frame, end.heard_ns)
        except DriverError:
            if end.port is None and data.startswith(packets.MAGIC):
                self._answer(end, packets.OTHER_VERSION)
            self.expelled += 1
            self._drop(end)

    def _greet(self, end: _End, hello: packets.Hello) -> None:
        crowded = sum(other.port is not None for other in self._ends.values()) >= MOST_ENDS
        if not self._answer(end, packets.CROWDED if crowded else packets.ACCEPTED) or crowded:
            self._drop(end)
            return
        end.port = BusEndpoint(
            hello.label, link.peer_pid(end.socket), own=hello.own, filters=hello.filters, fd=hello.fd
        )
        self.medium.add(end.port)

    def _answer(self, end: _End, answer: int) -> bool:
        try:
            end.socket.send(
                packets.pack_welcome(packets.Welcome(answer, self.bitrate, self.fd, self.data_bitrate or 0))
            )
        except OSError:
            return False
        return True

    def _deliver(self, end: _End, port: BusEndpoint, now: int) -> None:
        frames = port.take()
        if end.dropped:
            frames.insert(0, (overflow(now), False))
        try:
            for first in range(0, len(frames), MAX_PACKET_FRAMES):
                end.socket.send(pack_frames(frames[first : first + MAX_PACKET_FRAMES]))
                end.dropped = False
        except BlockingIOError:
            port.lost += len(frames) - first
            end.dropped = True
        except OSError:
            self._drop(end)

    def _drop(self, end: _End) -> None:
        self._ends.pop(end.socket.fileno(), None)
        end.socket.close()
        if end.port is not None:
            self.medium.remove(end.port)


def _pace(bitrate: int, data_bitrate: int | None) -> Callable[[Frame], int]:
    """Return the function for how long a frame occupies a wire of these bit rates [ns]."""

    def duration_ns(frame: Frame) -> int:
        if not frame.fd:
            return exact_bits(frame).nominal * 1_000_000_000 // bitrate
        if data_bitrate is None:  # it is destroyed there
            return BEFORE_FDF * 1_000_000_000 // bitrate
        return round(1e9 * exact_bits(frame, fd=True).seconds(bitrate, data_bitrate))

    return duration_ns
