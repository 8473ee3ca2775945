"""Encode and decode the cyclic frames of one bus: torques to frames, frames to the state of every drive.

Cycle: torque frames and SYNC go out, `begin_cycle` opens it, the frames that are received go through `receive`, and
`end_cycle` closes it. A drive answers once a cycle: a second position is a duplicate, one outside a cycle is late, and
neither is used. One that comes behind a missing one may be of an earlier SYNC (`drivers/can/answer_order.py`). What
must not be missed is reported as events (`take_events`), in words and with a code for the guard.

There is no I/O, no clock and no decision here. `receive` takes any frame and never raises; nothing that is received
changes a torque. This runs in every cycle: `struct` and one look-up by identifier, no arrays.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from drivers.axis_status import AxisStatus
from drivers.can.answer_order import AnswerOrder, settle_uncertain
from drivers.can.bus_state import (
    HOST,
    LEFT_NORMAL,
    MILD,
    ControllerState,
    Event,
    EventCode,
    controller_state,
    error_words,
    overflowed,
)
from drivers.can.can_frame import Frame
from drivers.canopen import object_dictionary as od
from drivers.canopen.cia402 import (
    COMMUNICATION_ERROR,
    ERROR_PASSIVE,
    FOLLOWS,
    INTERNAL_LIMIT,
    WARNING,
    DriveState,
    NmtCommand,
    NmtState,
    axis_status,
    emergency_words,
    nmt_words,
    state_of,
)
from drivers.canopen.object_dictionary import Entry
from drivers.canopen.pdo_mapping import (
    EMERGENCY,
    HEARTBEAT,
    NMT,
    RPDO2,
    SDO_REPLY,
    SDO_REQUEST,
    SYNC,
    TPDO1,
    TPDO2,
    BusProfile,
)
from ident_service.config.canopen import BUS_EMERGENCIES
from ident_service.errors import DriverError

_CONTROL = struct.Struct("<Hb")
_CONTROL_DOWNLOAD, _DOWNLOAD_2 = struct.Struct("<BHBHxx"), 0x2B  # expedited SDO download of two bytes
_MULTIPLEXER, _UPLOADED = struct.Struct("<BHB"), 0x43  # expedited SDO upload that tells its size
_EMERGENCY_BYTES = 8
_MOST_EVENTS = 256  # that wait to be taken; a flood must neither eat the memory nor hide what matters
_FOLLOWED = 64  # identifiers of strangers that are remembered


@dataclass(frozen=True, slots=True)
class Emergency:
    """Represent the latest emergency of a drive: error code, error register (1001h), the vendor's bytes."""

    code: int
    register: int
    vendor: bytes


@dataclass(slots=True)
class Drive:
    """Hold the last reported state of one drive.

    Attributes:
        node: node number.
        position: position of the last answer [counts], as a signed number of 32 bits that wraps around.
        seen: whether it has ever answered.
        answered: whether it has answered in this cycle.
        age: cycles since the SYNC that `position` is of, 0 where that is the latest one.
        order: order that tells which SYNC an answer belongs to.
        answers: positions that were accepted.
        duplicates: positions that came second in a cycle.
        late: positions that came outside of the cycle that they are of.
        status: the last status word (6041h), None before the first.
        let_go: status word with which an enabled drive reported that it is not enabled any more; kept, whatever later
            ones say, until whoever acts upon it clears it.
        torque: last torque that it measured [per mille of rated torque] (6077h).
        torques: number of reports of that torque.
        status_age: number of cycles since the last status word.
        nmt: state of its last heartbeat, None before the first.
        heartbeat_ns: time of that heartbeat [ns of the link's clock].
        boots: number of boot-up messages.
        emergency: latest emergency, None before the first and after a reset.
        error_passive: whether it has reported that its CAN controller is error-passive, and not since that this is
            over.
        reply: last answer to an SDO request, of any kind; None until one came since whoever asks has cleared it.
        uploads: last value of each entry that it was asked for by one frame, by `index << 8 | sub-index`.
    """

    node: int
    position: int = 0
    seen: bool = False
    answered: bool = False
    age: int = 0
    order: AnswerOrder = field(default_factory=AnswerOrder)
    answers: int = 0
    duplicates: int = 0
    late: int = 0
    status: int | None = None
    let_go: int | None = None
    torque: int = 0
    torques: int = 0
    status_age: int = 0
    nmt: int | None = None
    heartbeat_ns: int = 0
    boots: int = 0
    emergency: Emergency | None = None
    error_passive: bool = False
    reply: Frame | None = None
    uploads: dict[int, bytes] = field(default_factory=dict)

    @property
    def state(self) -> DriveState:
        """Return the state of CiA 402 by the last status word; UNKNOWN before one, and after a boot-up."""
        return DriveState.UNKNOWN if self.status is None else state_of(self.status)

    @property
    def axis_status(self) -> AxisStatus:
        """Return status flags by the status word that told that the drive let go (`let_go`), else by the last one."""
        error = 0 if self.emergency is None else self.emergency.code
        status = self.status if self.let_go is None else self.let_go
        return AxisStatus(0) if status is None else axis_status(status, error)


@dataclass(slots=True)
class Counters:
    """Count frames that were received but not used, since the beginning.

    Attributes:
        ignored: remote frames, 29-bit identifiers, SDO replies and heartbeats of others.
        wrong_length: frames of a drive with another length than its profile has.
        strangers: frames of nodes that should not be on the bus.
        errors: error frames of the host's controller.
        events_lost: events that were dropped because too many waited.
    """

    ignored: int = 0
    wrong_length: int = 0
    strangers: int = 0
    errors: int = 0
    events_lost: int = 0


@dataclass(slots=True)
class _Packed:
    """Describe a torque frame and how its bytes are packed."""

    cob_id: int
    drives: tuple[int, ...]
    pack: Callable[..., bytes] = field(repr=False)
    shift: int


def _packing(slots: Sequence[Entry]) -> struct.Struct:
    return struct.Struct("<" + "".join(slot.kind.value[1:] for slot in slots))


# Bits of the status word whose setting and clearing are reported as events.
_BITS = (
    (WARNING, EventCode.DRIVE_WARNING, "warns"),
    (INTERNAL_LIMIT, EventCode.TORQUE_LIMITED, "limits its torque"),
)
_CONTROLLER = {ControllerState.PASSIVE: EventCode.ERROR_PASSIVE, ControllerState.BUS_OFF: EventCode.BUS_OFF}


class BusCodec:
    """Encode and decode the frames of the drives of one bus.

    Attributes:
        profile: frames of the bus.
        drives: the state of each, in the order of `profile.drives`.
        controller: state of the host's CAN controller.
        counters: frames that were not used.
        asked: entries whose uploads are kept, by `index << 8 | sub-index`.
    """

    def __init__(self, profile: BusProfile) -> None:
        self.profile = profile
        self.asked = {od.STATUS_WORD.key}
        self.drives = tuple(Drive(node, order=AnswerOrder(1.0 / profile.rate)) for node in profile.nodes)
        self.controller = ControllerState.ACTIVE
        self.counters = Counters()
        self._open = False
        self._missing = len(self.drives)  # answers that have not come in this cycle
        self._now_ns = 0
        self._events: list[Event] = []
        self._status_cycles = math.ceil(profile.status_timeout * profile.rate)
        # With the torque that it measures, a report is one number longer.
        positions, self._reports = _packing(profile.position_slots), _packing(profile.status_slots)
        self._position_bytes, self._unpack_position = positions.size, positions.unpack
        self._tells_status, self._tells_torque = (
            entry in profile.position_slots for entry in (od.STATUS_WORD, od.TORQUE_ACTUAL)
        )
        self._notices = dict(zip(profile.nodes, profile.notices, strict=True))
        self._strangers: set[int] = set()
        self._foreign: set[int] = set()
        self._frames = [
            _Packed(frame.cob_id, frame.drives, _packing((frame.target,) * len(frame.drives)).pack, frame.shift)
            for frame in profile.torque_frames
        ]
        self._sync = Frame(SYNC)
        self._handlers: dict[int, tuple[Callable[[Drive, Frame], None], Drive]] = {}
        for drive in self.drives:
            for base, handler in (
                (TPDO1, self._on_position),
                *(((TPDO2, self._on_status),) if profile.status_slots else ()),
                (EMERGENCY, self._on_emergency),
                (HEARTBEAT, self._on_heartbeat),
                (SDO_REPLY, self._on_upload),
            ):
                self._handlers[base + drive.node] = handler, drive
        # Before streaming these belong to the configuration plane; they are neither used nor strange.
        self._others = {SDO_REQUEST + node for node in profile.nodes}
        self._ours = {NMT, SYNC, HEARTBEAT + profile.host, *(RPDO2 + node for node in profile.nodes)}
        self._ours |= {frame.cob_id for frame in profile.torque_frames}

    def torque_frames(self, target_counts: Sequence[int]) -> list[Frame]:
        """Return frames with this bus's torques, or positions, out of the whole arm's; DriverError for one too big.

        Args:
            target_counts: torques of all drives of the arm [per mille of rated torque, or counts], in the arm's order.

        Raises:
            DriverError: a value that its bits do not hold, or too few of them; nothing is to be sent then.
        """
        try:
            frames = []
            for one in self._frames:
                values = [target_counts[k] for k in one.drives]
                if one.shift:
                    values = [value << one.shift for value in values]
                frames.append(Frame(one.cob_id, one.pack(*values)))
            return frames
        except (struct.error, IndexError, TypeError) as error:
            raise DriverError(
                f"bus {self.profile.number}: targets {list(target_counts)} cannot be sent: {error}"
            ) from None

    def sync_frame(self) -> Frame:
        """Return the SYNC frame, which starts a cycle: drives latch torques and sample positions."""
        return self._sync

    def heartbeat_frame(self, state: NmtState = NmtState.OPERATIONAL) -> Frame:
        """Return the host's own heartbeat, which keeps the drives' watchdogs quiet."""
        return Frame(HEARTBEAT + self.profile.host, bytes([state]))

    def control_frame(self, node: int, word: int, mode: int) -> Frame:
        """Return the frame with a control word (6040h) and a mode of operation (6060h) for one drive (RPDO2)."""
        return Frame(RPDO2 + node, _CONTROL.pack(word, mode))

    def control_download(self, node: int, word: int) -> Frame:
        """Return the SDO download of a control word: a drive that has left `operational` takes no RPDO."""
        return Frame(SDO_REQUEST + node, _CONTROL_DOWNLOAD.pack(_DOWNLOAD_2, od.CONTROL_WORD.index, 0, word))

    def nmt_frame(self, command: NmtCommand, node: int = 0) -> Frame:
        """Return the frame with an NMT command for one node, or for all (0)."""
        return Frame(NMT, bytes([command, node]))

    def begin_cycle(self, now_ns: int = 0, *, positions_requested: bool = True) -> None:
        """Begin a cycle after SYNC was sent: each drive may answer once, and its data is a cycle older.

        Args:
            now_ns: time of SYNC [ns of the link's clock], for frames without a stamp.
            positions_requested: whether SYNC, which requests positions, has been sent in it at all.
        """
        self._open, self._now_ns, self._missing = True, now_ns, len(self.drives)
        for drive in self.drives:
            drive.answered = False
            drive.age += 1
            drive.status_age += 1
            drive.order.behind += positions_requested

    def end_cycle(self) -> None:
        """End the cycle at its deadline: uncertain answers are decided on, and answers from now on are late."""
        self._open = False
        if self._missing:
            self._missing -= settle_uncertain(self.drives, self._tell)

    @property
    def complete(self) -> bool:
        """Return whether every drive has answered in this cycle."""
        return self._missing == 0

    def silent(self, now_ns: int) -> list[int]:
        """Return the nodes whose heartbeat has been missing for longer than configured, or was never received."""
        oldest = now_ns - round(self.profile.heartbeat_timeout * 1e9)
        return [drive.node for drive in self.drives if drive.nmt is None or drive.heartbeat_ns < oldest]

    def stale(self) -> list[int]:
        """Return the nodes whose status report has been missing for longer than the profile's `status_timeout`."""
        return [drive.node for drive in self.drives if drive.status_age > self._status_cycles]

    def take_events(self) -> list[Event]:
        """Return the events since the last call, oldest first, and forget them."""
        if not self._events:
            return []
        taken, self._events = self._events, []
        return taken

    def forget_events(self) -> None:
        """Discard events and drives' `let_go`; tell again what is not over: emergencies, controllers in trouble."""
        self._events = []
        self._strangers.clear()
        self._foreign.clear()
        if self.controller in LEFT_NORMAL:
            self._tell_controller()
        for drive in self.drives:
            drive.let_go = None
            if drive.error_passive:
                self._tell(EventCode.DRIVE_PASSIVE, drive.node, f"{emergency_words(ERROR_PASSIVE)}, and not over yet")
            if (last := drive.emergency) is not None and last.code != ERROR_PASSIVE:
                words = emergency_words(last.code, last.register, last.vendor)
                self._tell(EventCode.EMERGENCY, drive.node, f"{words}, and not over yet")

    def receive(self, frame: Frame) -> None:
        """Take one received frame, whatever it is, into the drives' states and the events; never raises."""
        if frame.error:
            self._on_error(frame)
            return
        if frame.extended or frame.remote:
            self.counters.ignored += 1
            return
        known = self._handlers.get(frame.identifier)
        if known is not None:
            known[0](known[1], frame)
        else:
            self._on_other(frame)

    def _on_position(self, drive: Drive, frame: Frame) -> None:
        data = frame.data
        if len(data) != self._position_bytes:
            self._wrong_length(drive, frame, "position", self._position_bytes)
        elif not self._open:
            drive.late += 1
            drive.order.take_late()
            self._tell(EventCode.LATE, drive.node, "its position came after its cycle")
        elif (age := drive.order.take_answer(frame.stamp_ns - self._now_ns if frame.stamp_ns else None)) is None:
            drive.duplicates += 1
            self._tell(EventCode.DUPLICATE, drive.node, "a second position in one cycle")
        else:
            values = self._unpack_position(data)
            drive.position = values[0]
            if len(values) > 1:
                if self._tells_torque:
                    drive.torque, drive.torques = values[-1], drive.torques + 1
                if self._tells_status:
                    self._take_status(drive, values[1])
            drive.seen = True
            drive.age = age
            drive.answers += 1
            if age == 0:
                drive.answered = True
                self._missing -= 1

    def _on_status(self, drive: Drive, frame: Frame) -> None:
        if len(frame.data) != self._reports.size:
            self._wrong_length(drive, frame, "status", self._reports.size)
            return
        status, *measured = self._reports.unpack(frame.data)
        if measured:
            drive.torque, drive.torques = measured[0], drive.torques + 1
        self._take_status(drive, status)

    def _on_upload(self, drive: Drive, frame: Frame) -> None:
        """Keep the answer to a question of one frame (`sdo.upload_request`); others are neither used nor strange."""
        data, drive.reply = frame.data, frame
        _, index, sub = _MULTIPLEXER.unpack_from(data.ljust(_MULTIPLEXER.size, b"\0"))
        if len(data) != 8 or data[0] & 0xE3 != _UPLOADED or index << 8 | sub not in self.asked:
            self.counters.ignored += 1
            return
        drive.uploads[index << 8 | sub] = value = data[4 : 8 - (data[0] >> 2 & 3)]
        if (index, sub, len(value)) == (od.STATUS_WORD.index, 0, 2):
            self._take_status(drive, od.STATUS_WORD.unpack(value))

    def _take_status(self, drive: Drive, status: int) -> None:
        before, drive.status, drive.status_age = drive.status, status, 0
        if before == status:
            return
        state, was = state_of(status), None if before is None else state_of(before)
        if state is not was:
            if was is DriveState.OPERATION_ENABLED:
                drive.let_go = status
            if was is DriveState.FAULT and not drive.error_passive:
                drive.emergency = None  # it was the fault's, whether or not the drive says that it is over
            bad = state in (DriveState.FAULT, DriveState.FAULT_REACTION)
            words = f"{state} (status word {status:04X}h)" + ("" if was is None else f", was {was}")
            self._tell(EventCode.DRIVE_FAULT if bad else EventCode.DRIVE_STATE, drive.node, words)
        changed = status ^ (before or 0)
        for bit, code, words in _BITS:
            if changed & bit:
                on = bool(status & bit)
                self._tell(code if on else EventCode.OVER, drive.node, words if on else f"{words} no longer")
        if changed & FOLLOWS and not status & FOLLOWS and state is was is DriveState.OPERATION_ENABLED:
            self._tell(EventCode.DEAF, drive.node, "does not follow its target torque any more (status word, bit 12)")

    def _on_emergency(self, drive: Drive, frame: Frame) -> None:
        data = frame.data
        if len(data) != _EMERGENCY_BYTES:
            self._wrong_length(drive, frame, "emergency", _EMERGENCY_BYTES)
            if len(data) < 2:
                return
        # A torn emergency is one nevertheless.
        code, register, vendor = data[0] | data[1] << 8, data[2] if len(data) > 2 else 0, bytes(data[3:8])
        if code == ERROR_PASSIVE:
            drive.error_passive = True
            drive.emergency = Emergency(code, register, vendor)
            self._tell(EventCode.DRIVE_PASSIVE, drive.node, emergency_words(code, register, vendor))
        elif code == 0:
            # Another error may be over: of those that remain the register tells.
            drive.error_passive = drive.error_passive and bool(register & COMMUNICATION_ERROR)
            drive.emergency = None
            self._tell(EventCode.EMERGENCY_RESET, drive.node, "error reset")
        elif self._is_notice(drive.node, code, data):
            self._tell(EventCode.NOTICE, drive.node, emergency_words(code, register, vendor))
        else:
            drive.emergency = Emergency(code, register, vendor)
            self._tell(EventCode.EMERGENCY, drive.node, emergency_words(code, register, vendor))

    def _is_notice(self, node: int, code: int, data: bytes) -> bool:
        """Return whether an emergency only informs: no bit of the error register, or a code that the drive's list has.

        A torn one lacks its register and is none, and neither is one that tells of a lost host.
        """
        silent = len(data) == _EMERGENCY_BYTES and data[2] == 0
        return code not in BUS_EMERGENCIES and (silent or code in self._notices[node])

    def _on_heartbeat(self, drive: Drive, frame: Frame) -> None:
        if len(frame.data) != 1:
            self._wrong_length(drive, frame, "heartbeat", 1)
            return
        state, before = frame.data[0] & 0x7F, drive.nmt  # bit 7 belongs to node guarding
        drive.nmt, drive.heartbeat_ns = state, frame.stamp_ns or self._now_ns
        if state == NmtState.BOOT_UP:
            drive.boots += 1
            drive.error_passive = False
            drive.status = None  # the drive has lost its configuration; its last status is no longer true
            self._tell(EventCode.BOOT_UP, drive.node, "has booted")
        elif before != state and before is not None:
            words = f"NMT state {nmt_words(state)}, was {nmt_words(before)}"
            self._tell(EventCode.NMT_STATE if state == NmtState.OPERATIONAL else EventCode.LEFT, drive.node, words)

    def _on_other(self, frame: Frame) -> None:
        identifier = frame.identifier
        if identifier in self._others:
            self.counters.ignored += 1
            return
        self.counters.strangers += 1
        if identifier in self._ours:
            if identifier not in self._foreign:
                self._foreign.add(identifier)
                words = f"another host sends frames {identifier:03X}h, which only this host may"
                self._tell(EventCode.SECOND_HOST, HOST, words)
        elif identifier not in self._strangers and len(self._strangers) < _FOLLOWED:
            self._strangers.add(identifier)
            self._tell(EventCode.STRANGER, identifier & 0x7F, f"frames {identifier:03X}h of an unknown node")

    def _on_error(self, frame: Frame) -> None:
        self.counters.errors += 1
        before, self.controller = self.controller, controller_state(frame, self.controller)
        if self.controller is not before:
            self._tell_controller()
        if overflowed(frame):
            self._tell(EventCode.OVERFLOW, HOST, "frames were lost in the host's CAN controller")
        if words := error_words(frame):
            self._tell(EventCode.BUS_ERROR, HOST, words)

    def _tell_controller(self) -> None:
        words = f"the host's CAN controller is {self.controller.name.lower().replace('_', '-')}"
        self._tell(_CONTROLLER.get(self.controller, EventCode.CONTROLLER), HOST, words)

    def _wrong_length(self, drive: Drive, frame: Frame, what: str, length: int) -> None:
        self.counters.wrong_length += 1
        words = f"{what} frame {frame.identifier:03X}h of {len(frame.data)} bytes instead of {length}"
        self._tell(EventCode.WRONG_LENGTH, drive.node, words)

    def _tell(self, code: EventCode, node: int, words: str) -> None:
        if len(self._events) >= (_MOST_EVENTS if code in MILD else 2 * _MOST_EVENTS):
            self.counters.events_lost += 1
            return
        self._events.append(Event(code, node, words))
