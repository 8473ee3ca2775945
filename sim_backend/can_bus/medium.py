"""Simulate a CAN bus without sockets: ports with queues, arbitration, pace, errors and their counters.

An error while sending counts 8, while receiving 1; a success takes one back. From 96 the controller warns, from 128 it
is error-passive, a send counter above 255 takes it off the bus until it is restarted.

Changes of state come out as the error frames that the kernel would pass on (linux/can/error.h).

Whenever the wire is free, the first frame of every port's queue contends; the one whose arbitration field has the first
dominant bit where others have a recessive one wins (ISO 11898-1). A port's own frames keep their order, as in the
kernel's queue of an interface. With a pace each frame occupies the wire for its bits and is heard at its end.

A CAN FD frame on a wire that is classic, or with a classic controller on it, is destroyed each time: to that controller
its bit FDF is a broken frame. Its sender goes on trying until it is off the bus.

It runs on any clock; so the pace is exact in virtual time, however late its host may be.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from typing import Final, Literal

from drivers.can.bus_state import (
    ACTIVE,
    BUS_OFF,
    CONTROLLER,
    COUNTERS,
    PASSIVE_RX,
    PASSIVE_TX,
    RESTARTED,
    RX_OVERFLOW,
    WARNING_RX,
    WARNING_TX,
)
from drivers.can.can_frame import Frame

State = Literal["active", "warning", "passive", "off"]
_WARNING, _PASSIVE, _OFF = 96, 128, 256
_PASSIVE_SUCCESS: Final = 127  # what a success sets the receive counter of a passive controller to


class ErrorCounters:
    """Count send and receive errors of a controller, and derive its state.

    Attributes:
        sending, receiving: the counters, each at most 256.
        state: state of the controller.
    """

    def __init__(self) -> None:
        self.sending = self.receiving = 0
        self.state: State = "active"

    def set(self, send_errors: int, receive_errors: int, stamp_ns: int) -> Frame | None:
        """Set both counters; return an error frame if the controller's state changes, else None."""
        self.sending, self.receiving = min(max(send_errors, 0), _OFF), min(max(receive_errors, 0), _OFF)
        return self._change(stamp_ns)

    def send_error(self, stamp_ns: int) -> Frame | None:
        """Add 8 send errors, for its own frame destroyed; return an error frame if the state changes, else None."""
        return self.set(self.sending + 8, self.receiving, stamp_ns)

    def receive_error(self, stamp_ns: int) -> Frame | None:
        """Add 1 receive error, for another's frame destroyed; return an error frame if the state changes, else None."""
        return self.set(self.sending, self.receiving + 1, stamp_ns)

    def sent(self, stamp_ns: int) -> Frame | None:
        """Lower the send errors by 1 for a frame sent; return an error frame if the state changes, else None."""
        return self.set(self.sending - 1, self.receiving, stamp_ns) if self.sending else None

    def received(self, stamp_ns: int) -> Frame | None:
        """Lower the receive errors by 1, to 127 at most; return an error frame if the state changes, else None."""
        return self.set(self.sending, min(self.receiving - 1, _PASSIVE_SUCCESS), stamp_ns) if self.receiving else None

    def restart(self, stamp_ns: int) -> Frame:
        """Return to the bus with both counters zero; returns the error frame that says so."""
        self.sending = self.receiving = 0
        self.state = "active"
        return Frame(RESTARTED, bytes(8), error=True, stamp_ns=stamp_ns)

    def _change(self, stamp_ns: int) -> Frame | None:
        most = max(self.sending, self.receiving)
        state: State = "active"
        if self.state == "off" or self.sending >= _OFF:
            state = "off"
        elif most >= _PASSIVE:
            state = "passive"
        elif most >= _WARNING:
            state = "warning"
        if state == self.state:
            return None
        self.state = state
        if state == "off":
            return Frame(BUS_OFF, bytes(8), error=True, stamp_ns=stamp_ns)
        detail = ACTIVE
        if state != "active":
            send, receive = (PASSIVE_TX, PASSIVE_RX) if state == "passive" else (WARNING_TX, WARNING_RX)
            limit = _PASSIVE if state == "passive" else _WARNING
            detail = (send if self.sending >= limit else 0) | (receive if self.receiving >= limit else 0)
        counters = (min(self.sending, 255), min(self.receiving, 255))
        return Frame(CONTROLLER | COUNTERS, bytes((0, detail, 0, 0, 0, 0, *counters)), error=True, stamp_ns=stamp_ns)


QUEUE = 128  # frames of a port that may wait to be sent
INBOX = 1024  # frames that may wait to be taken; then the newest are lost, as in a full receive queue


def priority(frame: Frame) -> tuple[int, int, int, int, int]:
    """Return the arbitration field in the order of its bits; the smallest wins.

    A standard data frame wins over its remote frame, and both over extended frames that begin with its identifier.
    """
    if frame.extended:
        return frame.identifier >> 18, 1, 1, frame.identifier & 0x3FFFF, int(frame.remote)
    return frame.identifier, int(frame.remote), 0, 0, 0


class BusEndpoint:
    """Represent one controller on the wire.

    Attributes:
        label: name of the controller, for people and for injecting errors.
        pid: id of its process.
        counters: error counters of its controller.
        inbox: frames that it received and that are not taken yet, each with whether it was its own.
        fd: whether its controller knows CAN FD; one that does not destroys such frames of others.
        lost: frames that found its inbox full.
    """

    def __init__(
        self,
        label: str,
        pid: int = 0,
        *,
        own: bool = False,
        filters: Iterable[tuple[int, int]] = (),
        fd: bool = True,
    ) -> None:
        """Create a port that is not on any wire yet.

        Args:
            label: name for people.
            pid: id of the process behind it.
            own: whether the port hears its own frames.
            filters: identifier and mask, any of which lets a standard frame pass; none lets all frames pass.
            fd: whether its controller knows CAN FD.
        """
        self.label, self.pid, self.own, self.fd = label, pid, own, fd
        self.counters = ErrorCounters()
        self.pending: deque[tuple[int, Frame]] = deque()
        self.inbox: list[tuple[Frame, bool]] = []
        self.lost = 0
        self._overflowed = False
        chosen = tuple(filters)
        self._passes = (
            bytes(any(k & mask == wanted & mask for wanted, mask in chosen) for k in range(0x800)) if chosen else None
        )

    def hear(self, frame: Frame, sent_by_itself: bool = False) -> None:
        """Put a frame into the inbox, with whether it is its own, if it passes the filters and finds room."""
        if self._passes is not None and not frame.error and (frame.extended or not self._passes[frame.identifier]):
            return
        if len(self.inbox) >= INBOX:
            self.lost += 1
            self._overflowed = True
            return
        if self._overflowed:
            self._overflowed = False
            self.inbox.append((overflow(frame.stamp_ns), False))
        self.inbox.append((frame, sent_by_itself))

    def take(self) -> list[tuple[Frame, bool]]:
        """Return the received frames, each with whether it was its own, and empty the inbox."""
        frames, self.inbox = self.inbox, []
        return frames


def overflow(stamp_ns: int) -> Frame:
    """Return the error frame that says that frames before it were lost, because the inbox was full."""
    return Frame(CONTROLLER, bytes((0, RX_OVERFLOW, 0, 0, 0, 0, 0, 0)), error=True, stamp_ns=stamp_ns)


class Medium:
    """Emulate the wire and its ports.

    Attributes:
        ports: ports in the order in which they came.
        sent: frames that all ports received.
        destroyed: frames that no port received.
        collisions: frames that met one with the same arbitration field from another port: two nodes with one number.
    """

    def __init__(
        self, duration_ns: Callable[[Frame], int] | None = None, error_ns: int = 0, *, fd: bool = True
    ) -> None:
        """Create a wire without ports.

        Args:
            duration_ns: function that returns the time for which a frame occupies the wire [ns]; None: no time, and all
                that waits contends at once.
            error_ns: time for which an error frame occupies the wire [ns].
            fd: whether the wire itself carries CAN FD.
        """
        self.ports: list[BusEndpoint] = []
        self.sent = self.destroyed = self.collisions = 0
        self._duration_ns, self._error_ns, self._fd = duration_ns, error_ns, fd
        self._to_destroy: dict[BusEndpoint | None, int] = {}
        self._current: tuple[BusEndpoint, Frame, int] | None = None
        self._free_ns = 0

    @property
    def end_ns(self) -> int | None:
        """Return when the frame that is being sent ends [ns], None while the bus is free."""
        return None if self._current is None else self._current[2]

    def add(self, port: BusEndpoint) -> None:
        """Add a port, a controller, to the simulated bus."""
        self.ports.append(port)

    def remove(self, port: BusEndpoint) -> None:
        """Remove a port; the frame it was sending breaks off, and its queued frames are dropped."""
        if port in self.ports:
            self.ports.remove(port)
        if self._current is not None and self._current[0] is port:
            self._current = None
        port.pending.clear()
        self._to_destroy.pop(port, None)

    def room(self, port: BusEndpoint) -> int:
        """Return how many more frames a port may queue."""
        return QUEUE - len(port.pending)

    def offer(self, port: BusEndpoint, frame: Frame, now_ns: int) -> bool:
        """Queue a frame; return False where the queue is full; a controller that is off drops it and returns True."""
        if port.counters.state == "off":
            return True
        if len(port.pending) >= QUEUE:
            return False
        port.pending.append((now_ns, frame))
        return True

    def advance(self, now_ns: int) -> None:
        """Send what can be sent until `now_ns`; received frames go into the inboxes, stamped with their end."""
        while True:
            if self._current is None and not self._start(now_ns):
                return
            if self._current is None or self._current[2] > now_ns:
                return
            port, frame, end = self._current
            self._current, self._free_ns = None, end
            self._finish(port, frame, end)

    def destroy_next(self, count: int, port: BusEndpoint | None = None) -> None:
        """Have the next `count` frames, of one port or of any, destroyed by an error; their senders repeat them."""
        self._to_destroy[port] = count

    def set_counters(self, port: BusEndpoint, send_errors: int, receive_errors: int, now_ns: int) -> None:
        """Set a controller's error counters, and its state by them: 256 send errors are bus-off, until `restart`."""
        self._note(port, port.counters.set(send_errors, receive_errors, now_ns))

    def restart(self, port: BusEndpoint, now_ns: int) -> None:
        """Return a controller to the bus with its error counters at 0, and tell it so by an error frame."""
        self._note(port, port.counters.restart(now_ns))

    def _start(self, now_ns: int) -> bool:
        heads = [(port, *port.pending[0]) for port in self.ports if port.pending]
        if not heads:
            return False
        if self._duration_ns is None:
            begin = now_ns
        else:
            begin = max(self._free_ns, min(arrival for _, arrival, _ in heads))
            if begin > now_ns:
                return False
            heads = [head for head in heads if head[1] <= begin]
        port, arrival, frame = min(heads, key=lambda head: priority(head[2])) if len(heads) > 1 else heads[0]
        self.collisions += sum(priority(other[2]) == priority(frame) for other in heads) - 1 if len(heads) > 1 else 0
        port.pending.popleft()
        end = begin + self._duration_ns(frame) if self._duration_ns else max(self._free_ns, arrival)
        self._current = (port, frame, end)
        return True

    def _finish(self, sender: BusEndpoint, frame: Frame, end: int) -> None:
        for key in (sender, None) if self._to_destroy else ():
            if self._to_destroy.get(key, 0):
                self._to_destroy[key] -= 1
                self._destroyed(sender, frame, end)
                return
        if frame.fd and not (self._fd and all(port.fd or port.counters.state == "off" for port in self.ports)):
            self._destroyed(sender, frame, end)
            return
        self.sent += 1
        identifier, data, remote, error, extended, _, fd = frame
        heard = Frame(identifier, data, remote, error, extended, end, fd)  # `_replace` takes three times as long
        if sender.counters.sending:
            self._note(sender, sender.counters.sent(end))
        for port in self.ports:
            if port.counters.state == "off":
                continue
            if port is not sender and port.counters.receiving:
                self._note(port, port.counters.received(end))
            if port is not sender or port.own:
                port.hear(heard, port is sender)

    def _destroyed(self, sender: BusEndpoint, frame: Frame, end: int) -> None:
        self.destroyed += 1
        self._free_ns = end + self._error_ns
        sender.pending.appendleft((end, frame))
        self._note(sender, sender.counters.send_error(end))
        for port in self.ports:
            if port is not sender and port.counters.state != "off":
                self._note(port, port.counters.receive_error(end))

    def _note(self, port: BusEndpoint, error: Frame | None) -> None:
        if error is not None:
            if port.counters.state == "off":
                port.pending.clear()
            port.hear(error)
