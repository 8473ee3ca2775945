"""Host a wire within a process: in its own loop, with a port on the wire, or in a thread.

A thread shares Python's interpreter lock with everything else in its process and so disturbs a loop that must be on
time; for that, host the wire in the drives' process or in one of its own.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Self

from drivers.can.bus_state import BusError
from drivers.can.can_frame import Frame, check_sendable
from drivers.clock import RealClock
from sim_backend.can_bus.hub import CanBusServer
from sim_backend.can_bus.medium import BusEndpoint

_LOOK_NS = 1_000_000_000


class LocalPort:
    """Implement a Link in the process that hosts the wire; waiting for a frame is what moves the wire.

    One thread hosts the wire and uses its local ports; there may be several.
    """

    def __init__(self, wire: CanBusServer, label: str) -> None:
        """Add a port to an entered wire.

        Args:
            wire: wire that the port is added to.
            label: label of the port, for people.
        """
        self.clock = RealClock()
        self.port = BusEndpoint(label, fd=wire.fd)
        self._wire = wire
        wire.medium.add(self.port)
        self._waiting: list[Frame] = []

    def send(self, frame: Frame) -> None:
        """Queue one frame; it is on its way when this returns.

        Raises:
            BusError: bus-off, or the queue is full.
            DriverError: a frame that cannot exist.
        """
        self.send_all((frame,))

    def send_all(self, frames: Sequence[Frame]) -> None:
        """Queue several frames at once; BusError at the first that is not taken, those before it stay queued."""
        now = time.monotonic_ns()
        for frame in frames:
            check_sendable(frame, fd=self._wire.fd)
            frame = self._as_sent(frame)
            if self.port.counters.state == "off":
                raise BusError("off", f"ident_wire {self._wire.name}", self._wire.bitrate)
            if not self._wire.medium.offer(self.port, frame, now):
                raise BusError("full", f"ident_wire {self._wire.name}", self._wire.bitrate)
        self._wire.advance_to(now)

    def offer(self, frames: Sequence[Frame]) -> int:
        """Queue frames without raising, until one is not taken or the port is off; return how many were taken."""
        now, taken = time.monotonic_ns(), 0
        for frame in frames:
            if self.port.counters.state == "off" or not self._wire.medium.offer(self.port, self._as_sent(frame), now):
                break
            taken += 1
        self._wire.advance_to(now)
        return taken

    def _as_sent(self, frame: Frame) -> Frame:
        return frame._replace(fd=True) if self._wire.fd and not frame.remote else frame

    def receive(self, deadline_ns: int) -> Frame | None:
        """Return the next frame, None when there is none until the deadline [ns of the clock].

        Raises:
            BusError: the wire is closed.
        """
        while not self._waiting:
            self._wire.poll(deadline_ns)
            self._waiting = [frame for frame, _ in reversed(self.port.take())]
            if not self._waiting and time.monotonic_ns() >= deadline_ns:
                return None
        return self._waiting.pop()

    def drain(self) -> Sequence[Frame]:
        """Return all frames that wait; does not wait.

        Raises:
            BusError: the wire is closed.
        """
        self._wire.poll(0)
        frames = [*reversed(self._waiting), *(frame for frame, _ in self.port.take())]
        self._waiting = []
        return frames

    def close(self) -> None:
        """Remove the port from the simulated bus, which goes on."""
        self._wire.medium.remove(self.port)


class WireThread:
    """Host a wire in a thread; a context manager."""

    def __init__(self, wire: CanBusServer) -> None:
        """Prepare to host a wire that is not entered yet."""
        self.wire = wire
        self._ended = False
        self._thread = threading.Thread(target=self._run, name=f"ident_wire {wire.name}", daemon=True)

    def __enter__(self) -> Self:
        """Open the wire and host it.

        Raises:
            BusError: another process runs this wire, or its address cannot be had.
        """
        self.wire.__enter__()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Close the wire and all its connections."""
        self.close()

    def close(self) -> None:
        """Close the simulated bus and all its connections, and end its thread; any number of times."""
        self._ended = True
        self.wire.wake()
        if self._thread.is_alive():
            self._thread.join()
        self.wire.close()

    def _run(self) -> None:
        with suppress(BusError):
            while not self._ended:
                self.wire.poll(time.monotonic_ns() + _LOOK_NS)
