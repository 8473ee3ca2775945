"""Run all buses of an arm in step: when a cycle begins, the order of its frames, and until when answers count.

A cycle begins one period after the one before; periods that are over are skipped, never made up for. While positions
are missing, one that began late waits for them half a period, or as long as its frames need on the wire: positions
carry no number, and one that came after the next SYNC would count for it. On every bus the
torques go first, then SYNC on all of them back to back, so that all drives act and sample at one time. Our heartbeat is
sent behind the answers, by this loop alone: drives notice a loop that stops.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

from drivers.can.bus_event import EventCode
from drivers.can.can_frame import Frame
from drivers.can.can_link import Link
from drivers.canopen.cia402 import NmtCommand, NmtState
from drivers.canopen.frame_bits import worst
from drivers.canopen.object_dictionary import CST
from drivers.canopen.pdo_codec import BusCodec, Drive
from drivers.canopen.pdo_mapping import GUARD_EARLY, HEARTBEAT, SDO_REPLY, SDO_REQUEST, BusProfile
from drivers.canopen.sdo import TIMEOUT, Objects
from drivers.clock import Clock
from ident_service.errors import DriverError

RECEIVE = 0.97  # of a period, within which a position counts for its cycle (FIELDBUS.md: the last is on the wire then)
HUSH = 0.02  # s in which the last frames of an earlier session may still be on their way
LISTEN = 0.12  # s before we send anything; another host's heartbeat comes within it
AWAKE = 2.0  # s within which every drive must answer
LEAST = 0.5  # of a period, from SYNC on, that positions are waited for in any case
SETTLED = 5  # cycles in a row with everybody's position before an arm counts as open
_MISSED = 0.25  # of a period late, and the slot is left to the next
_DOUBT = 0.25  # of a period: sending a SYNC takes less, unless this computer stalls
_ASK = bytes([0x40, 0x00, 0x10, 0x00, 0, 0, 0, 0])  # SDO upload of the device type, which every node has


@dataclass
class GuardedNode:
    """Represent a drive that misses its host when it is not asked in time: node, period of asking, next time [ns]."""

    node: int
    period_ns: int
    due_ns: int = 0


class Buses:
    """Run the open buses of one arm.

    Attributes:
        codecs: one a bus.
        drives: the state of every drive, in the arm's order.
        clock: of the links.
        complete: whether every drive answered in the last cycle.
        lost: positions that did not come in their cycle, so far.
        stamp_doubt_ns: of the last cycle, see `Sample`.
        modes: of operation, that control words of each drive come with.
        withheld: kinds of watchdogs that are not fed, so that they can be seen to act.
    """

    def __init__(self, profiles: Sequence[BusProfile], links: Sequence[Link], period_ns: int) -> None:
        """Use the given links, which `close` closes.

        Args:
            profiles: of the buses.
            links: to them, in the same order.
            period_ns: of a cycle [ns].
        """
        self.codecs = [BusCodec(profile) for profile in profiles]
        self.clock: Clock = links[0].clock
        self.complete = False
        self.lost = self.stamp_doubt_ns = 0
        self._links = list(links)
        self._pairs = list(zip(self.codecs, self._links, strict=True))
        self._at: dict[int, tuple[BusCodec, Link]] = {}
        drives: dict[int, Drive] = {}
        for codec, link in self._pairs:
            for number, drive in zip(codec.profile.drives, codec.drives, strict=True):
                drives[number], self._at[number] = drive, (codec, link)
        self.drives = [drives[number] for number in range(len(drives))]
        self.modes = [CST] * len(self.drives)
        self._period_ns = period_ns
        wire = max(_on_the_wire(profile) for profile in profiles)
        self._least_ns = round(min(max(LEAST * period_ns, 1e9 * wire), RECEIVE * period_ns))
        self._heartbeat_period_ns = min(round(0.5e9 * profile.heartbeat_host) for profile in profiles)
        self._heartbeat_ns = 0
        self.withheld: set[str] = set()
        # When each guarded drive is asked next, one after the other: remote frames in a row would delay a cycle.
        self._guards: dict[int, GuardedNode] = {}
        for number, (codec, _) in self._at.items():
            period, node = codec.profile.guarding[0], drives[number].node
            if node in codec.profile.guarded:
                self._guards[number] = GuardedNode(node, round(1e9 * period * GUARD_EARLY))
        self._next_ns: int | None = None

    def close(self) -> None:
        """Close all links; never raises."""
        for link in self._links:
            with suppress(Exception):
                link.close()

    def command(self, command: NmtCommand) -> None:
        """Send an NMT command to the arm's drives, not to other nodes on the bus."""
        for number in range(len(self.drives)):
            self.command_drive(number, command)

    def command_drive(self, number: int, command: NmtCommand) -> None:
        """Send an NMT command to one drive."""
        codec, link = self._at[number]
        link.send(codec.nmt(command, self.drives[number].node))

    def control(self, number: int, word: int) -> None:
        """Send a control word to one drive."""
        codec, link = self._at[number]
        link.send(codec.control_word(self.drives[number].node, word, self.modes[number]))

    def objects(self, number: int) -> Objects:
        """Return the object dictionary of one drive, usable as long as nothing streams."""
        codec, link = self._at[number]
        return Objects(link, self.drives[number].node, codec.receive)

    def profile(self, number: int) -> BusProfile:
        """Return the profile of the bus that a drive is on."""
        return self._at[number][0].profile

    def restarted(self, number: int) -> Callable[[], bool]:
        """Return a function that tells whether a drive has sent a boot-up message since the buses were opened."""
        drive = self.drives[number]
        return lambda: drive.boots > 0

    def listen(self) -> None:
        """Listen whether another host drives this arm, before anything is sent that could disturb it.

        Raises:
            DriverError: one does; nothing has been sent.
        """
        self.clock.sleep_until_ns(self.clock.now_ns() + round(HUSH * 1e9))
        for link in self._links:
            link.drain()
        self.clock.sleep_until_ns(self.clock.now_ns() + round(LISTEN * 1e9))
        for codec, link in self._pairs:
            for frame in link.drain():
                codec.receive(frame)
            others = [event.words for event in codec.take_events() if event.code is EventCode.SECOND_HOST]
            if others:
                raise DriverError(
                    f"bus {codec.profile.bus.channel}: {'; '.join(others)}: another program or device drives this arm"
                )

    def call(self) -> None:
        """Bring every drive to the NMT state in which it is configured, and wait until all of them answer.

        A drive that was just switched on may still boot, one whose last host died may be operational. Communication is
        not reset: by CiA 402 that is a lost connection, which a drive may answer with a fault (6007h).

        Raises:
            DriverError: some do not answer; the message names them.
        """
        for link in self._links:
            link.drain()
        self.command(NmtCommand.ENTER_PRE_OPERATIONAL)
        missing = {drive.node for drive in self.drives}
        last = self.clock.now_ns() + round(AWAKE * 1e9)
        while missing and (now_ns := self.clock.now_ns()) < last:
            for codec, link in self._pairs:
                asked = missing & set(codec.profile.nodes)
                for node in sorted(asked):
                    link.send(Frame(SDO_REQUEST + node, _ASK))
                again = now_ns + round(TIMEOUT * 1e9)
                while asked and (frame := link.receive(again)) is not None:
                    asked.discard(frame.identifier - SDO_REPLY)
                    codec.receive(frame)
                missing -= set(codec.profile.nodes) - asked
        if missing:
            nodes = ", ".join(map(str, sorted(missing)))
            raise DriverError(
                f"no answer of drives {nodes} within {AWAKE:g} s; check power, cable and bit rate (`ident bus scan`)"
            )

    def begin(self) -> None:
        """Start PDOs once drives and host are configured, and wait until all drives answer every SYNC in time.

        At first every drive reports its state, which takes the bus longer than a cycle.

        Raises:
            DriverError: some do not get there.
        """
        self.command(NmtCommand.START)
        for drive in self.drives:
            drive.nmt = None
        slowest = max(codec.profile.heartbeat_drives for codec in self.codecs)
        last = self.clock.now_ns() + round((AWAKE + slowest) * 1e9)
        settled = 0
        while settled < SETTLED:
            if self.clock.now_ns() > last:
                bad = [drive.node for drive in self.drives if drive.nmt != NmtState.OPERATIONAL or not drive.answered]
                raise DriverError(
                    f"drives {', '.join(map(str, bad)) or 'of all kinds'} do not answer every SYNC in time"
                )
            self.cycle(None)
            there = all(drive.nmt == NmtState.OPERATIONAL and drive.answered for drive in self.drives)
            settled = settled + 1 if there else 0
        self.forget_events()

    def forget_events(self) -> None:
        """Discard the events so far: they were expected, or have been reported otherwise."""
        for codec in self.codecs:
            codec.forget_events()
        self.lost = 0

    def cycle(self, counts: Sequence[int] | None) -> int:
        """Wait for the next cycle and exchange its frames.

        Args:
            counts: torque of every drive [per mille of rated torque]; None for SYNC alone.

        Returns:
            When SYNC was sent, on the link's clock [ns].

        Raises:
            DriverError: a bus is gone, or torques that cannot be sent, of which none has been.
        """
        begin_ns = self.clock.now_ns() if self._next_ns is None else self._next_ns
        self.clock.sleep_until_ns(begin_ns)
        while (late_ns := self.clock.now_ns() - begin_ns) > _MISSED * self._period_ns:
            # Drives go on with the torque that they have.
            begin_ns += -(-late_ns // self._period_ns) * self._period_ns
            self.clock.sleep_until_ns(begin_ns)
        self._next_ns = begin_ns + self._period_ns
        torques = [[] if counts is None else codec.torque_frames(counts) for codec in self.codecs]
        for (codec, link), frames in zip(self._pairs, torques, strict=True):
            for heard in link.drain():
                codec.receive(heard)
            for frame in frames:
                link.send(frame)
        before_ns = self.clock.now_ns()
        if "sync_loss" not in self.withheld:
            for codec, link in self._pairs:
                link.send(codec.sync())
        # Not before: a drive acts when it hears SYNC.
        stamp_ns = self.clock.now_ns()
        self.stamp_doubt_ns = stamp_ns - before_ns if stamp_ns - before_ns > _DOUBT * self._period_ns else 0
        for codec in self.codecs:
            codec.begin_cycle(stamp_ns)
        deadline = max(begin_ns + round(RECEIVE * self._period_ns), stamp_ns + self._least_ns)
        for codec, link in self._pairs:
            while not codec.complete:
                answer = link.receive(deadline)
                if answer is None:
                    break
                codec.receive(answer)
            codec.end_cycle()
        self.complete = all(codec.complete for codec in self.codecs)
        if not self.complete:
            self.lost += sum(not drive.answered for drive in self.drives)
        self.keep_alive()
        return stamp_ns

    def keep_alive(self) -> None:
        """Send the host's heartbeat at half of its period, so that a late one is not missed; poll guarded drives."""
        now_ns = self.clock.now_ns()
        self._ask_guarded(now_ns)
        if now_ns >= self._heartbeat_ns and "heartbeat" not in self.withheld:
            self._heartbeat_ns = now_ns + self._heartbeat_period_ns
            for codec, link in self._pairs:
                link.send(codec.heartbeat(NmtState.OPERATIONAL))

    def _ask_guarded(self, now_ns: int) -> None:
        """Ask the guarded drive that has waited longest, where its time has come; in one cycle no more than one."""
        if not self._guards or "node_guarding" in self.withheld:
            return
        number, guard = min(self._guards.items(), key=lambda one: one[1].due_ns)
        if now_ns >= guard.due_ns:
            guard.due_ns = now_ns + guard.period_ns
            self._at[number][1].send(Frame(HEARTBEAT + guard.node, b"", remote=True))


def _on_the_wire(profile: BusProfile) -> float:
    """Return how long the frames of a cycle take at most [s]."""
    lengths = [
        0,
        *(2 * len(frame.drives) for frame in profile.torque_frames),
        *(sum(slot.kind.size for slot in profile.position_slots) for _ in profile.nodes),
    ]
    bus = profile.bus
    return sum(worst(length, fd=profile.fd).seconds(bus.bitrate, bus.data_bitrate) for length in lengths)
