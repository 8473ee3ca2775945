"""Keep all buses of an arm in step, cycle by cycle, and take its drives through the states of CiA 402 at once.

A cycle begins one period after the one before; periods that are over are skipped, never made up for. While positions
are missing, one that began late waits for them half a period, or as long as its frames need on the wire: positions
carry no number, and of which SYNC one is that comes after the next is not certain. On every bus the
torques go first, then SYNC on all of them back to back, so that all drives act and sample at one time. Our heartbeat is
sent behind the answers, by this loop alone: drives notice a loop that stops.

Ready, switched on, a few cycles with zero torque and every position received, enabled: each step has one deadline for
all drives. Commands go to the drives that have not come so far, and again where one was lost.

The last step is taken when the drives may report it at once: a status report is not sent within the inhibit time of the
one before, and an arm without brakes would sink unnoticed, and without torque, until it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

from drivers.can.bus_load import most_bits
from drivers.can.bus_state import EventCode
from drivers.can.can_frame import Frame
from drivers.can.can_link import Link
from drivers.canopen import object_dictionary as od
from drivers.canopen.cia402 import (
    DISABLE_VOLTAGE,
    ENABLE,
    FAULTS,
    RESET_FAULT,
    STAY_IN_QUICK_STOP,
    TOWARDS_ENABLED,
    DriveState,
    NmtCommand,
    NmtState,
    emergency_words,
)
from drivers.canopen.object_dictionary import CST, Entry, OperationMode
from drivers.canopen.pdo_codec import BusCodec, Drive
from drivers.canopen.pdo_mapping import GUARD_EARLY, HEARTBEAT, SDO_REPLY, SDO_REQUEST, BusProfile
from drivers.canopen.sdo import TIMEOUT, Objects, upload_request
from drivers.clock import Clock
from ident_service.errors import DriveFaulted, DriverError

RECEIVE = 0.97  # of a period, within which a position counts for its cycle (FIELDBUS.md: the last is on the wire then)
HUSH = 0.02  # s in which the last frames of an earlier session may still be on their way
LISTEN = 0.12  # s before we send anything; another host's heartbeat comes within it
AWAKE = 2.0  # s within which every drive must answer
LEAST = 0.5  # of a period, from SYNC on, that positions are waited for in any case
SETTLED = 5  # cycles in a row with everybody's position before an arm counts as open
# A bus that is 90 % full has room for one frame in a cycle at 1 kHz: a question in each would leave none for answers.
_ASK_EVERY_NS = 5_000_000
_SILENT = 2  # cycles without a position, after which a drive may have left `operational`
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
        stamp_doubt_ns: uncertainty of the last cycle's stamp, see `Sample`.
        modes: mode of operation of each drive; control words come with it.
        withheld: kinds of watchdogs that are not fed, so that their reaction can be seen.
        enabled: whether the drives have been energised in this session; from then on those that miss cycles are asked
            for their status word, and stopped by SDO too.
    """

    def __init__(self, profiles: Sequence[BusProfile], links: Sequence[Link], period_ns: int) -> None:
        """Use the given links, which `close` closes.

        Args:
            profiles: of the buses.
            links: links to the buses, in the same order.
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
        self.modes = [OperationMode(CST, od.MODE_DISPLAY, CST)] * len(self.drives)
        self._period_ns = period_ns
        wire = max(_on_the_wire(profile) for profile in profiles)
        self._least_ns = round(min(max(LEAST * period_ns, 1e9 * wire), RECEIVE * period_ns))
        self._heartbeat_period_ns = min(round(0.5e9 * profile.heartbeat_host) for profile in profiles)
        self._heartbeat_ns = 0
        self.withheld: set[str] = set()
        self.enabled = False
        self._asked = self._ask_again_ns = 0
        # When each guarded drive is asked next, one after the other: remote frames in a row would delay a cycle.
        self._guards: dict[int, GuardedNode] = {}
        for number, (codec, _) in self._at.items():
            period, node = codec.profile.guarding[0], drives[number].node
            if node in codec.profile.guarded_nodes:
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

    def command_drive(self, drive_index: int, command: NmtCommand) -> None:
        """Send an NMT command to one drive."""
        codec, link = self._at[drive_index]
        link.send(codec.nmt_frame(command, self.drives[drive_index].node))

    def control(self, drive_index: int, word: int) -> None:
        """Send a control word to one drive; one that enables it has the bits that its mode needs."""
        codec, link = self._at[drive_index]
        mode = self.modes[drive_index]
        word |= mode.enabling if word == ENABLE else 0
        link.send(codec.control_frame(self.drives[drive_index].node, word, mode.sent))

    def control_stop(self, drive_index: int, word: int, *, deaf: bool = False) -> None:
        """Send a control word that stops a drive; by SDO too if it is `deaf`, or may have left `operational`.

        Args:
            drive_index: of the drive.
            word: control word that stops the drive.
            deaf: whether it has not obeyed such a word before.
        """
        self.control(drive_index, word)
        codec, link = self._at[drive_index]
        drive = self.drives[drive_index]
        gone = self.enabled and (drive.age >= _SILENT or drive.nmt not in (None, NmtState.OPERATIONAL))
        if deaf or gone:
            link.send(codec.control_download(drive.node, word))

    def request_upload(self, drive_index: int, entry: Entry) -> None:
        """Request an entry of up to four bytes by SDO; the answer comes with a later cycle (`Drive.uploads`)."""
        codec, link = self._at[drive_index]
        codec.asked.add(entry.key)
        link.send(Frame(SDO_REQUEST + self.drives[drive_index].node, upload_request(entry)))

    def mode_shown(self, drive_index: int) -> int | None:
        """Return the mode of operation by a drive's last answer to `request_upload`; None before one."""
        display = self.modes[drive_index].display
        data = self.drives[drive_index].uploads.get(display.key)
        return display.unpack(data) if data is not None and len(data) == display.kind.size else None

    def other_modes(self) -> dict[int, str]:
        """Describe each drive that does not report its wanted mode, by number; now and then ask one of them again."""
        found = {}
        for number, mode in enumerate(self.modes):
            if (shown := self.mode_shown(number)) != mode.wanted:
                told = "tells no mode" if shown is None else f"is in mode {shown}"
                found[number] = f"{told} ({mode.display.index:04X}h) although {mode.wanted} was set"
        now_ns = self.clock.now_ns()
        if found and now_ns >= self._ask_again_ns:
            self._asked, self._ask_again_ns = self._asked + 1, now_ns + _ASK_EVERY_NS
            number = list(found)[self._asked % len(found)]
            self.request_upload(number, self.modes[number].display)
        return found

    def forget_modes(self) -> None:
        """Discard what drives have reported of their modes of operation."""
        for drive, mode in zip(self.drives, self.modes, strict=True):
            drive.uploads.pop(mode.display.key, None)

    def link(self, drive_index: int) -> Link:
        """Return the link to the bus that a drive is on."""
        return self._at[drive_index][1]

    def receive_one(self, drive_index: int, deadline_ns: int) -> None:
        """Wait for one frame on the bus of a drive, and decode it; raises DriverError on a dead bus."""
        codec, link = self._at[drive_index]
        if (frame := link.receive(deadline_ns)) is not None:
            codec.receive(frame)

    def objects(self, drive_index: int) -> Objects:
        """Return the object dictionary of one drive, usable as long as nothing streams."""
        codec, link = self._at[drive_index]
        return Objects(link, self.drives[drive_index].node, codec.receive)

    def objects_in_cycles(self, drive_index: int, target_counts: Sequence[int] | None) -> Objects:
        """Return one drive's object dictionary, whose requests run cycles of all drives while they wait.

        Args:
            drive_index: of the drive.
            target_counts: sent in the cycles that go on, see `cycle`.
        """
        return Objects(_RepliesInCycles(self, drive_index, target_counts), self.drives[drive_index].node)

    def profile(self, drive_index: int) -> BusProfile:
        """Return the profile of the bus that a drive is on."""
        return self._at[drive_index][0].profile

    def restarted(self, drive_index: int) -> Callable[[], bool]:
        """Return a function that tells whether a drive has sent a boot-up message since the buses were opened."""
        drive = self.drives[drive_index]
        return lambda: drive.boots > 0

    def listen(self) -> None:
        """Listen on all buses, without sending; raises DriverError where another host drives this arm.

        Raises:
            DriverError: one does; nothing has been sent.
        """
        self.clock.sleep_until_ns(self.clock.now_ns() + round(HUSH * 1e9))
        self._discard_received()
        self.clock.sleep_until_ns(self.clock.now_ns() + round(LISTEN * 1e9))
        for codec, link in self._pairs:
            for frame in link.drain():
                codec.receive(frame)
            others = [event.words for event in codec.take_events() if event.code is EventCode.SECOND_HOST]
            if others:
                raise DriverError(
                    f"bus {codec.profile.bus.channel}: {'; '.join(others)}: another program or device drives this arm"
                )

    def _discard_received(self) -> None:
        """Discard what has been received so far, but for what the host's controller says of itself."""
        for codec, link in self._pairs:
            for frame in link.drain():
                if frame.error:
                    codec.receive(frame)

    def wake_drives(self) -> None:
        """Bring every drive to pre-operational, and wait until all answer by SDO; raises DriverError if some do not.

        A drive that was just switched on may still boot, one whose last host died may be operational. Communication is
        not reset: by CiA 402 that is a lost connection, which a drive may answer with a fault (6007h).

        Raises:
            DriverError: some do not answer; the message names them.
        """
        self._discard_received()
        self.command(NmtCommand.ENTER_PRE_OPERATIONAL)
        missing = [set(codec.profile.nodes) for codec in self.codecs]  # two buses may have drives of one number
        last = self.clock.now_ns() + round(AWAKE * 1e9)
        while any(missing) and (now_ns := self.clock.now_ns()) < last:
            for (codec, link), asked in zip(self._pairs, missing, strict=True):
                for node in sorted(asked):
                    link.send(Frame(SDO_REQUEST + node, _ASK))
                again = now_ns + round(TIMEOUT * 1e9)
                while asked and (frame := link.receive(again)) is not None:
                    asked.discard(frame.identifier - SDO_REPLY)
                    codec.receive(frame)
        if any(missing):
            silent = ", ".join(
                f"{node} on {codec.profile.bus.channel}" if len(self.codecs) > 1 else str(node)
                for codec, nodes in zip(self.codecs, missing, strict=True)
                for node in sorted(nodes)
            )
            raise DriverError(
                f"no answer of drives {silent} within {AWAKE:g} s; check power, cable and bit rate (`ident bus scan`)"
            )

    def start_pdos(self) -> None:
        """Start PDOs once drives and host are configured, and wait until all drives answer every SYNC in time.

        At first every drive reports its state, which takes the bus longer than a cycle. Whether answers are of the SYNC
        before them shows when one is left out.

        Raises:
            DriverError: some do not get there.
        """
        self.command(NmtCommand.START)
        for drive in self.drives:
            drive.nmt = None
        slowest = max(codec.profile.heartbeat_drives for codec in self.codecs)
        last = self.clock.now_ns() + round((AWAKE + slowest) * 1e9)
        settled, late = 0, [0] * len(self.drives)
        while settled < SETTLED:
            if self.clock.now_ns() > last:
                bad = [one.node for one in self.drives if one.nmt != NmtState.OPERATIONAL or not one.answered]
                bad = bad or [one.node for one, before in zip(self.drives, late, strict=True) if one.late > before]
                raise DriverError(
                    f"drives {', '.join(map(str, bad)) or 'of all kinds'} do not answer every SYNC in time"
                )
            self.cycle(None)
            there = all(drive.nmt == NmtState.OPERATIONAL and drive.answered for drive in self.drives)
            settled = settled + 1 if there else 0
            if settled == SETTLED:
                late = [drive.late for drive in self.drives]
                self._next_ns = (self._next_ns or 0) + self._period_ns
                self.cycle(None)
                settled = SETTLED if late == [drive.late for drive in self.drives] else 0
        self.forget_events()

    def forget_events(self) -> None:
        """Discard all events so far, so that conditions that persist are reported again; count lost answers from 0."""
        for codec in self.codecs:
            codec.forget_events()
        self.lost = 0

    def cycle(self, target_counts: Sequence[int] | None) -> int:
        """Wait for the next cycle and exchange its frames; return when SYNC was sent [ns of the links' clock].

        Args:
            target_counts: torque of every drive [per mille of rated torque]; None for SYNC alone.

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
        torques = [[] if target_counts is None else codec.torque_frames(target_counts) for codec in self.codecs]
        for (codec, link), frames in zip(self._pairs, torques, strict=True):
            for heard in link.drain():
                codec.receive(heard)
            for frame in frames:
                link.send(frame)
        before_ns = self.clock.now_ns()
        if "sync_loss" not in self.withheld:
            for codec, link in self._pairs:
                link.send(codec.sync_frame())
        # Not before: a drive acts when it hears SYNC.
        stamp_ns = self.clock.now_ns()
        self.stamp_doubt_ns = stamp_ns - before_ns if stamp_ns - before_ns > _DOUBT * self._period_ns else 0
        for codec in self.codecs:
            codec.begin_cycle(stamp_ns, positions_requested="sync_loss" not in self.withheld)
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
            self._ask_silent()
        self.keep_alive()
        return stamp_ns

    def _ask_silent(self) -> None:
        """Ask the drive that reports nothing any more for its status word: out of `operational` it still answers SDOs.

        A drive whose watchdog was tried may end there, and whether it has let go must be heard of. One drive a cycle;
        none that has booted, as it has no power and must be configured first.
        """
        silent = [number for number, drive in enumerate(self.drives) if drive.age >= _SILENT and not drive.boots]
        if self.enabled and silent:
            self._asked += 1
            self.request_upload(silent[self._asked % len(silent)], od.STATUS_WORD)

    def keep_alive(self) -> None:
        """Send the host's heartbeat when due, and poll a guarded drive that is due, but not what is withheld."""
        now_ns = self.clock.now_ns()
        self._send_node_guarding(now_ns)
        if now_ns >= self._heartbeat_ns and "heartbeat" not in self.withheld:
            self._heartbeat_ns = now_ns + self._heartbeat_period_ns
            for codec, link in self._pairs:
                link.send(codec.heartbeat_frame(NmtState.OPERATIONAL))

    def _send_node_guarding(self, now_ns: int) -> None:
        """Ask the guarded drive that has waited longest, where its time has come; in one cycle no more than one."""
        if not self._guards or "node_guarding" in self.withheld:
            return
        number, guard = min(self._guards.items(), key=lambda one: one[1].due_ns)
        if now_ns >= guard.due_ns:
            guard.due_ns = now_ns + guard.period_ns
            self._at[number][1].send(Frame(HEARTBEAT + guard.node, b"", remote=True))


class _RepliesInCycles:
    """Wait for one drive's answers to SDO requests by cycles; one that has vanished takes nothing from the others."""

    def __init__(self, buses: Buses, number: int, counts: Sequence[int] | None) -> None:
        """Use open buses; arguments as for `Buses.objects_in_cycles`."""
        self._buses, self._number, self._counts = buses, number, counts
        self.clock = buses.clock

    def send(self, frame: Frame) -> None:
        """Send a request; raises DriverError on a dead bus."""
        self._buses.drives[self._number].reply = None
        self._buses.link(self._number).send(frame)

    def receive(self, deadline_ns: int) -> Frame | None:
        """Return the answer, None when there is none until the deadline; raises DriverError on a dead bus."""
        drive = self._buses.drives[self._number]
        while drive.reply is None and self.clock.now_ns() < deadline_ns:
            try:
                self._buses.cycle(self._counts)
            except DriverError:  # of the other bus, maybe, which must not keep this one from it
                self._buses.receive_one(self._number, deadline_ns)
        found, drive.reply = drive.reply, None
        return found


def _on_the_wire(profile: BusProfile) -> float:
    """Return how long the frames of a cycle take at most [s]."""
    lengths = [
        0,
        *(frame.length for frame in profile.torque_frames),
        *(sum(slot.kind.size for slot in profile.position_slots) for _ in profile.nodes),
    ]
    bus = profile.bus
    return sum(most_bits(length, fd=profile.fd).seconds(bus.bitrate, bus.data_bitrate) for length in lengths)


MODE_PATIENCE = 5.0  # s that a mode of operation may take once drives are switched on (ros2_canopen waits as long)
SEEDED = 5  # cycles in a row with zero torque and all positions before anything is enabled
REPEAT = 0.05  # s after which a command that had no effect is sent again
_WAY = (DriveState.READY_TO_SWITCH_ON, DriveState.SWITCHED_ON, DriveState.OPERATION_ENABLED)


class EnableSequence:
    """Lead drives from switched off to `operation enabled`."""

    def __init__(
        self,
        drives: Sequence[Drive],
        names: Sequence[str],
        step: float,
        now_ns: int,
        reports: tuple[float, float],
        quick_stop: int,
        other_modes: Callable[[], Mapping[int, str]],
    ) -> None:
        """Start with drives that are switched off.

        Args:
            drives: drives of all buses, as their codecs know them.
            names: of the drives, for people.
            step: how long all drives together may take for one step [s].
            now_ns: present time of the links' clock [ns].
            reports: least and longest time between two status reports of a drive [s].
            quick_stop: 605Ah; drives that stay in quick stop hold the arm, and are enabled out of it with the others.
            other_modes: function that asks drives for their mode, and returns the answers of those in another one, by
                number.
        """
        self._other_modes = other_modes
        self._stays = quick_stop in STAY_IN_QUICK_STOP
        self._drives, self._names = drives, names
        self._inhibit_ns, self._report_ns = (round(seconds * 1e9) for seconds in reports)
        self._reported_ns = [now_ns] * len(drives)
        self._ready_ns: int | None = None
        self._step_ns = round(step * 1e9)
        self._deadline_ns = now_ns + self._step_ns
        self._target = 0
        self._seeded = 0
        self._sent: dict[int, tuple[DriveState, int]] = {}
        self._in_other_mode = dict.fromkeys(range(len(drives)), "")  # until each has told otherwise

    @property
    def done(self) -> bool:
        """Return whether all drives are enabled."""
        return self._target == len(_WAY)

    def commands(self, now_ns: int) -> list[tuple[int, int]]:
        """Return (drive number, control word) pairs to send in this cycle; DriverError on a fault or a step too slow.

        Raises:
            DriveFaulted: a drive has a fault; which, and why as far as it is known.
            DriverError: the step's time is over; likewise.
        """
        if bad := [drive for drive in self._drives if drive.state in FAULTS]:
            raise DriveFaulted(
                f"{_states_text(self._drives, self._names, bad)}; only a reset clears it (`ident recover`)"
            )
        for number, drive in enumerate(self._drives):
            if drive.status_age <= 1:  # came in this cycle, or before it
                self._reported_ns[number] = now_ns
        fresh = all(drive.answered for drive in self._drives)
        self._seeded = self._seeded + 1 if fresh else 0
        while not self.done and self._all_in_state():
            if self._target == 1 and not self._may_enable(now_ns):
                break
            self._target += 1
            self._deadline_ns = now_ns + self._step_ns
        if self.done:
            return []
        if now_ns > self._deadline_ns:
            late = [drive for drive in self._drives if not self._there(drive)] or list(self._drives)
            if self._target == 1 and self._in_other_mode and late == list(self._drives):
                told = "; ".join(f"{self._names[number]} {words}" for number, words in self._in_other_mode.items())
                raise DriverError(f"not enabled: {told}")
            states = _states_text(self._drives, self._names, late)
            raise DriverError(f"not {_WAY[self._target]} within {self._step_ns * 1e-9:g} s: {states}")
        words = []
        for number, drive in enumerate(self._drives):
            if self._there(drive):  # and waits for the others, or for the seed
                continue
            stopped = drive.state is DriveState.QUICK_STOP
            if stopped and not self._stays:
                continue  # its ramp ends by itself
            word = ENABLE if stopped else TOWARDS_ENABLED.get(drive.state, DISABLE_VOLTAGE)
            state, sent_ns = self._sent.get(number, (None, 0))
            if state is not drive.state or now_ns - sent_ns > REPEAT * 1e9:
                self._sent[number] = drive.state, now_ns
                words.append((number, word))
        return words

    def _may_enable(self, now_ns: int) -> bool:
        """Check that seed cycles have passed and no drive's next report would be held back; the latter not for ever."""
        if self._seeded < SEEDED:
            return False
        if self._in_other_mode:
            self._in_other_mode = dict(self._other_modes())
        if self._ready_ns is None:  # a mode may take effect only now that the drives are switched on
            self._ready_ns, self._deadline_ns = now_ns, now_ns + round(MODE_PATIENCE * 1e9)
        if self._in_other_mode:
            return False
        ages = [now_ns - reported for reported in self._reported_ns]
        soon = min(ages) >= self._inhibit_ns and max(ages) < self._report_ns - self._inhibit_ns // 10
        return soon or now_ns - self._ready_ns > 3 * self._report_ns

    def _all_in_state(self) -> bool:
        return all(self._there(drive) for drive in self._drives)

    def _there(self, drive: Drive) -> bool:
        holds = self._stays and drive.state is DriveState.QUICK_STOP and self._target < len(_WAY) - 1
        return holds or drive.state in _WAY[self._target :]


class Resetting:
    """Lead drives out of the state `fault`: a rising edge of bit 7, nothing else; the drives stay off."""

    def __init__(self, drives: Sequence[Drive], names: Sequence[str], step: float, now_ns: int) -> None:
        """Begin; arguments as for `EnableSequence`."""
        self._drives, self._names = drives, names
        self._deadline_ns = now_ns + round(step * 1e9)
        self._edge: dict[int, int] = {}

    @property
    def done(self) -> bool:
        """Return whether no drive is in a fault any more, nor in an unknown state."""
        return all(drive.state not in (*FAULTS, DriveState.UNKNOWN) for drive in self._drives)

    def commands(self, now_ns: int) -> list[tuple[int, int]]:
        """Return (drive number, control word) pairs to send in this cycle; DriverError if a fault outlasts the time."""
        if self.done:
            return []
        if now_ns > self._deadline_ns:
            kept = [drive for drive in self._drives if drive.state in (*FAULTS, DriveState.UNKNOWN)]
            raise DriverError(f"the cause is still there: {_states_text(self._drives, self._names, kept)}")
        words = []
        for number, drive in enumerate(self._drives):
            if drive.state is DriveState.FAULT:
                # Two cycles low, two high, since some drives read one of two words within a millisecond; then again.
                phase = self._edge.get(number, 0)
                self._edge[number] = phase + 1
                words.append((number, RESET_FAULT if phase // 2 % 2 else DISABLE_VOLTAGE))
        return words


def any_in_quick_stop(drives: Sequence[Drive]) -> bool:
    """Return whether at least one of the drives is in quick stop by its last status word."""
    return any(drive.state is DriveState.QUICK_STOP for drive in drives)


def _states_text(drives: Sequence[Drive], names: Sequence[str], chosen: Sequence[Drive]) -> str:
    """Describe the states and emergencies of the chosen drives."""
    words = []
    for name, drive in zip(names, drives, strict=True):
        if drive in chosen:
            last = drive.emergency
            why = "" if last is None else f" ({emergency_words(last.code, last.register, last.vendor)})"
            silent = "has sent no status word" + (" since it booted" if drive.boots else "")
            says = silent if drive.status is None else f"is in the state {drive.state}{why}"
            words.append(f"{name} {says}")
    return "; ".join(words)
