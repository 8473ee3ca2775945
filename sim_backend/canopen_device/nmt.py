"""Emulate the NMT state machine of a node, its heartbeats, sent and awaited, and guarding (CiA 301, 7.2.8, 7.3.2)."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum

from drivers.can.can_frame import Frame
from sim_backend.canopen_device.node import Node

_MS = 1_000_000
_PRODUCER = "heartbeat"
_CONSUMER = "heartbeat of "
_BOOT = "boot"
_LIFE = "life guarding"
_HOST = 0  # stands for the host that asks by remote frames, which has no number
_CONSUMERS = range(1, 5)


class State(IntEnum):
    """Name the NMT states by their heartbeat values; INITIALISING is sent once, as the boot-up message."""

    INITIALISING = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


class Command(IntEnum):
    """Name the NMT commands by the first byte of their message."""

    START = 0x01
    STOP = 0x02
    PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


_TARGETS = {
    Command.START: State.OPERATIONAL,
    Command.STOP: State.STOPPED,
    Command.PRE_OPERATIONAL: State.PRE_OPERATIONAL,
}


class Nmt:
    """Emulate state and heartbeats of one node.

    Attributes:
        state: the present one.
        silent_nodes: nodes whose heartbeats stay away.
        commanded: whether the last command, or else something of its own, brought it there.
    """

    def __init__(
        self,
        node: Node,
        *,
        boot_ns: int,
        entered: Callable[[State], None],
        reset: Callable[[Command], None],
        lost: Callable[[int], None],
        found: Callable[[int], None],
    ) -> None:
        """Start as a node without power.

        Args:
            node: node whose state it is.
            boot_ns: time from a reset to the boot-up message [ns].
            entered: called with the state before, after a change.
            reset: called when a reset has been asked for, before anything else happens.
            lost: called with a node whose heartbeat stays away.
            found: called with a node whose heartbeat has come back.
        """
        self._node = node
        self._boot_ns = boot_ns
        self._entered, self._reset, self._lost, self._found = entered, reset, lost, found
        self.state = State.INITIALISING
        self.silent_nodes: set[int] = set()
        self.commanded = False
        self._toggle = 0

    def boot(self, delay_ns: int) -> None:
        """Initialise the node, and send the boot-up message after a delay."""
        self.commanded = False
        self._to(State.INITIALISING)
        self._node.stop_timer(_PRODUCER)
        self._node.stop_timer(_LIFE)
        self._toggle = 0
        self.configure_consumers()
        self._node.start_timer(_BOOT, delay_ns)

    def command(self, data: bytes) -> None:
        """Process an NMT message; one of a wrong length, or for another node, has no effect."""
        if len(data) != 2 or data[1] not in (0, self._node.number) or self.state is State.INITIALISING:
            return
        if data[0] in (Command.RESET_NODE, Command.RESET_COMMUNICATION):
            self.reset(Command(data[0]))
        elif data[0] in tuple(_TARGETS):
            self.commanded = True
            self._to(_TARGETS[Command(data[0])])

    def reset(self, command: Command) -> None:
        """Restart the whole node, or its communication, by the command; boot-up follows after its delay."""
        self._reset(command)
        self.boot(self._boot_ns)

    def leave_operational(self) -> None:
        """Enter pre-operational after a communication error; the caller has checked object 1029h:01."""
        self.commanded = False
        self._to(State.PRE_OPERATIONAL)

    def configure_producer(self) -> None:
        """Apply a change of object 1017h: send a heartbeat at once and by the new period from then on; none at 0."""
        self._node.stop_timer(_PRODUCER)
        if self.state is not State.INITIALISING:
            self._send_heartbeat()

    def configure_consumers(self) -> None:
        """Apply a change of object 1016h; awaiting begins with the next heartbeat received (CiA 301, 7.2.8.2.2.3).

        A heartbeat that is awaited no longer, or anew, is not missing.
        """
        for number in range(128):
            self._node.stop_timer(f"{_CONSUMER}{number}")
        while self.silent_nodes:
            self._found(self.silent_nodes.pop())

    def configure_guarding(self) -> None:
        """Apply a change of object 100Ch or 100Dh; guarding begins with the next request (CiA 301, 7.2.8.2.2.1)."""
        self._node.stop_timer(_LIFE)

    def answer_guarding(self) -> None:
        """Answer a remote frame that asks for the state and await the next one; do nothing if heartbeats are sent."""
        objects = self._node.objects
        if objects.number(0x1017):
            return  # a node that sends heartbeats is not guarded
        self._node.send(0x700 + self._node.number, bytes([self._toggle | self.state]))
        self._toggle ^= 0x80
        if life := objects.number(0x100C) * objects.number(0x100D):
            self._node.start_timer(_LIFE, life * _MS)
            if _HOST in self.silent_nodes:
                self.silent_nodes.discard(_HOST)
                self._found(_HOST)

    def heartbeat_arrived(self, frame: Frame) -> None:
        """Process a heartbeat of another node: if it is awaited, start to wait for the next, and end its absence."""
        number = frame.identifier - 0x700
        for subindex in _CONSUMERS:
            entry = self._node.objects.number(0x1016, subindex)
            if entry >> 16 == number and entry & 0xFFFF:
                self._node.start_timer(f"{_CONSUMER}{number}", (entry & 0xFFFF) * _MS)
                if number in self.silent_nodes:
                    self.silent_nodes.discard(number)
                    self._found(number)

    def timer_ran_out(self, timer: str) -> None:
        """Act on `timer`, which ran out: send boot-up or heartbeat, or note that a guard or heartbeat is missing."""
        if timer == _BOOT:
            self._node.send(0x700 + self._node.number, b"\0")
            self._to(State.PRE_OPERATIONAL)
            self._send_heartbeat()
        elif timer == _PRODUCER:
            self._send_heartbeat()
        elif timer == _LIFE:
            self.silent_nodes.add(_HOST)
            self._lost(_HOST)
        elif timer.startswith(_CONSUMER):
            number = int(timer.removeprefix(_CONSUMER))
            self.silent_nodes.add(number)
            self._lost(number)

    def _send_heartbeat(self) -> None:
        if period := self._node.objects.number(0x1017):
            self._node.send(0x700 + self._node.number, bytes([self.state]))
            self._node.start_timer(_PRODUCER, period * _MS)

    def _to(self, state: State) -> None:
        if state is not self.state:
            before, self.state = self.state, state
            self._entered(before)
