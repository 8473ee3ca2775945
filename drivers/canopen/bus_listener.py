"""Listen on the buses of an arm without sending: NMT states from heartbeats, restarts, and another host."""

from __future__ import annotations

from collections.abc import Sequence

from drivers.can.can_frame import Frame
from drivers.can.can_link import Link
from drivers.canopen.cia402 import NmtState, nmt_words
from drivers.canopen.pdo_mapping import HEARTBEAT, SDO_REPLY, SYNC
from drivers.canopen.polling import Place

LONGER = 1.2  # times a heartbeat's period, in which one must come


class Overheard:
    """Listen on every bus of an arm.

    Attributes:
        nmt: state of each node's last heartbeat, and when it came [ns of the links' clock].
        booted: nodes whose last heartbeat was a boot-up message, which makes them pre-operational.
        restarted: nodes that sent a boot-up message since this was last cleared.
        answered: nodes that sent an SDO reply for which no request waited.
        streaming: buses on which another host sends SYNC.
    """

    def __init__(self) -> None:
        self.nmt: dict[Place, tuple[int, int]] = {}
        self.booted: set[Place] = set()
        self.restarted: set[Place] = set()
        self.answered: set[Place] = set()
        self.streaming: set[int] = set()

    def take(self, bus: int, frame: Frame) -> None:
        """Process one received frame of any kind."""
        if frame.error or frame.remote or frame.extended:
            return
        node = frame.identifier - HEARTBEAT
        if frame.identifier == SYNC:
            self.streaming.add(bus)
        elif 1 <= node <= 127 and len(frame.data) == 1:
            state = frame.data[0] & 0x7F  # bit 7 belongs to node guarding
            self.booted.discard((bus, node))
            if state == NmtState.BOOT_UP:
                self.booted.add((bus, node))
                self.restarted.add((bus, node))
                state = NmtState.PRE_OPERATIONAL
            self.nmt[bus, node] = state, frame.stamp_ns
        elif 1 <= frame.identifier - SDO_REPLY <= 127:
            self.answered.add((bus, frame.identifier - SDO_REPLY))

    def listen(self, links: Sequence[Link], period: float) -> None:
        """Listen long enough for every heartbeat of this period [s]; raises DriverError when a bus is gone."""
        until_ns = links[0].clock.now_ns() + round(LONGER * period * 1e9)
        for bus, link in enumerate(links):
            while (frame := link.receive(until_ns)) is not None:
                self.take(bus, frame)

    def drain(self, links: Sequence[Link]) -> None:
        """Process the frames that wait; raises DriverError when a bus is gone."""
        for bus, link in enumerate(links):
            for frame in link.drain():
                self.take(bus, frame)

    def nmt_words(self, place: Place, now_ns: int, patience_ns: int) -> str:
        """Describe a node's NMT state for people, as of now.

        Args:
            place: bus and node.
            now_ns: of the links' clock.
            patience_ns: after which a heartbeat that was there is missed [ns].
        """
        if place not in self.nmt:
            return "sends no heartbeat"
        state, stamp_ns = self.nmt[place]
        if place in self.booted:
            return f"{nmt_words(state)} since it booted"
        words = nmt_words(state)
        return f"{words}, heartbeat missing" if now_ns - stamp_ns > patience_ns else words
