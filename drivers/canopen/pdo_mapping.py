"""Derive the frames between an arm's drives and their host: COB-IDs, contents, and when each is sent.

The communication profile of WAM-style drives in cyclic synchronous torque mode: SYNC starts a cycle, each drive answers
it with its position (TPDO1) and lets the torque of the frames before it act (RPDO1, synchronous). Up to four drives
share a torque frame: in each of them the slots of the others are mapped to a dummy (CiA 301, 0003h), so that the
mapped length is the frame's. Control words (RPDO2), status reports (TPDO2, on change), emergencies and heartbeats come
as they must; SDOs flow before streaming only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from drivers.canopen import object_dictionary as od
from drivers.canopen.object_dictionary import Entry, pdo_entry
from ident_service.config.can_bus import CanBus
from ident_service.config.canopen import CanopenDrive, CanopenDriver, WatchdogKind

NMT, SYNC, EMERGENCY = 0x000, 0x080, 0x080
TPDO1, RPDO1, TPDO2, RPDO2 = 0x180, 0x200, 0x280, 0x300
SDO_REPLY, SDO_REQUEST, HEARTBEAT = 0x580, 0x600, 0x700

_NOT_VALID, _NO_REMOTE = 1 << 31, 1 << 30  # bits of a PDO's COB-ID entry
_EVERY_SYNC, _ON_RECEPTION, _ON_CHANGE = 1, 255, 255
_UNUSED = ((False, 3), (True, 3), (False, 4), (True, 4))  # some drives command their axis by these out of the box
_MOST_16 = 0xFFFF
_MOST_SYNCS = 240  # of a synchronous transmission type
_STAYS_OPERATIONAL = 1  # 1029h:01 (CiA 301, 7.5.2.32)
_STATUS_PATIENCE = 2.5  # periods without a status report: one was lost, and the next one is late as well

# One emergency a second and drive (1015h): a drive with a storm of errors must not take the bus from the others.
EMERGENCY_INHIBIT = 1.0
GUARD_EARLY = 0.7  # of the guard time, after which a drive is asked again: questions come one a cycle


@dataclass(frozen=True)
class Write:
    """Represent one SDO download: the value of an entry, and the bits in which another value is as good."""

    entry: Entry
    value: int
    ignored: int = 0

    def is_held_by(self, held_value: int) -> bool:
        """Return whether a value that an entry holds is this one, but for the ignored bits."""
        return not (held_value ^ self.value) & ~self.ignored

    @property
    def data(self) -> bytes:
        """Return the value's bytes."""
        return self.entry.pack(self.value)


@dataclass(frozen=True)
class TorqueFrame:
    """Represent a frame with the targets of some drives: torques, or positions.

    Attributes:
        cob_id: of the frame.
        drives: indices, in the arm's list of drives, of those whose targets it carries, in the order of its slots.
        nodes: the same drives as node numbers.
        target: entry that each of them takes from it.
        shift: bits by which counts are shifted in it.
    """

    cob_id: int
    drives: tuple[int, ...]
    nodes: tuple[int, ...]
    target: Entry = od.TARGET_TORQUE
    shift: int = 0

    @property
    def length(self) -> int:
        """Return the frame's length [bytes]."""
        return self.target.kind.size * len(self.drives)


@dataclass(frozen=True)
class Pdo:
    """Represent one PDO of one drive as it is to be configured.

    Attributes:
        number: number of the PDO, from 1.
        sent: whether the drive sends it (TPDO); otherwise it receives it (RPDO).
        cob_id: of its frame.
        type: transmission type.
        slots: entries that it maps, in order.
        inhibit: least time between two [100 us]; of TPDOs.
        timer: event timer of a TPDO, or deadline of an RPDO [ms]; 0 for none.
    """

    number: int
    sent: bool
    cob_id: int
    type: int
    slots: tuple[Entry, ...]
    inhibit: int = 0
    timer: int = 0

    def writes(self) -> list[Write]:
        """Return the downloads that configure the PDO, in order: off, no mapping, mapping, type and times, on.

        The order is that of CiA 301, 7.5.2.36.
        """
        clear, *mapping = self.mapping
        return [self.off, clear, *mapping, *self.parameters, self.on]

    @property
    def on(self) -> Write:
        """Return the write that makes the PDO valid."""
        return Write(self._entry(0), self.cob_id | (_NO_REMOTE if self.sent else 0), _NO_REMOTE)

    @property
    def off(self) -> Write:
        """Return the write that makes the PDO invalid."""
        return Write(self._entry(0), self.on.value | _NOT_VALID, _NO_REMOTE)

    @property
    def mapping(self) -> list[Write]:
        """Return the downloads of the mapping: no entries, the entries, their number."""
        slots = [Write(self._entry(3, sub), mapped.mapping) for sub, mapped in enumerate(self.slots, 1)]
        return [Write(self._entry(2), 0), *slots, Write(self._entry(2), len(self.slots))]

    @property
    def parameters(self) -> list[Write]:
        """Return the downloads of transmission type and times."""
        todo = [Write(self._entry(1), self.type)]
        if self.sent and self.type == _ON_CHANGE:
            todo.append(Write(pdo_entry(od.TPDO_INHIBIT, self.number), self.inhibit))
        return [*todo, self.timing] if self.timer else todo

    @property
    def timing(self) -> Write:
        """Return the download of a TPDO's event timer or an RPDO's deadline [ms]; its value is 0 for none."""
        return Write(self._entry(4), self.timer)

    def _entry(self, which: int, sub: int | None = None) -> Entry:
        return pdo_entry((_TPDO if self.sent else _RPDO)[which], self.number, sub)


_RPDO = (od.RPDO_COB_ID, od.RPDO_TYPE, od.RPDO_COUNT, od.RPDO_MAPPING, od.RPDO_DEADLINE)
_TPDO = (od.TPDO_COB_ID, od.TPDO_TYPE, od.TPDO_COUNT, od.TPDO_MAPPING, od.TPDO_PERIOD)


@dataclass(frozen=True)
class BusProfile:
    """Describe the frames on one bus of an arm.

    Attributes:
        number: of the bus, from 0.
        bus: section of the configuration for the bus.
        rate: cycles per second.
        host: node number of the host.
        drives: indices of the arm's drives that are on it, in the arm's order.
        nodes: the same drives as node numbers.
        notices: emergency codes by which each of these drives only informs.
        torque_frames: frames that carry the drives' torques, or their positions.
        heartbeat_host: period of the host's heartbeat [s].
        heartbeat_drives: period of each drive's heartbeat [s].
        heartbeat_timeout: time for which the host waits for a drive's heartbeat [s].
        heartbeat_wait: time for which drives whose watchdog it is wait for the host's heartbeat [s]; None for
            `heartbeat_timeout`.
        watchdogs: signal that each drive watches (`CanopenDrive.watchdog`).
        guarding: guard time [s] and life time factor of drives that are guarded.
        torque_deadline: time after which a drive without torque frames stops by itself [s].
        status_period: period of a drive's status report without a change [s].
        status_inhibit: least time between two of them [s].
        position_slots: entries that a drive sends at every SYNC.
        status_slots: entries of its status report; none where the status is sent with the position.
    """

    number: int
    bus: CanBus
    rate: float
    host: int
    drives: tuple[int, ...]
    nodes: tuple[int, ...]
    notices: tuple[frozenset[int], ...]
    torque_frames: tuple[TorqueFrame, ...]
    heartbeat_host: float
    heartbeat_drives: float
    heartbeat_timeout: float
    torque_deadline: float
    status_period: float
    status_inhibit: float
    position_slots: tuple[Entry, ...]
    status_slots: tuple[Entry, ...]
    watchdogs: tuple[WatchdogKind, ...] = ()
    guarding: tuple[float, int] = (0.02, 3)
    heartbeat_wait: float | None = None

    def watchdog(self, node: int) -> WatchdogKind:
        """Return the kind of signal that a drive's watchdog watches."""
        return self.watchdogs[self.nodes.index(node)] if self.watchdogs else "rpdo_timer"

    @property
    def guarded_nodes(self) -> tuple[int, ...]:
        """Return the nodes of the drives whose watchdog is node guarding."""
        return tuple(node for node in self.nodes if self.watchdog(node) == "node_guarding")

    @property
    def fd(self) -> bool:
        """Return whether frames are those of CAN FD."""
        return self.bus.data_bitrate is not None

    @property
    def status_timeout(self) -> float:
        """Return after how long a status report counts as missing [s]: 2.5 times its period or longer inhibit time."""
        return _STATUS_PATIENCE * max(self.status_period, self.status_inhibit)

    def pdos(self, node: int) -> list[Pdo]:
        """Return the PDOs of one drive; raises KeyError for a node that is not on this bus."""
        frame = next((frame for frame in self.torque_frames if node in frame.nodes), None)
        if frame is None:
            raise KeyError(node)
        slots = tuple(frame.target if other == node else od.DUMMY_INT16 for other in frame.nodes)
        deadline = _whole(self.torque_deadline, 1e-3) if self.watchdog(node) == "rpdo_timer" else 0
        inhibit, period = _whole(self.status_inhibit, 1e-4), _whole(self.status_period, 1e-3)
        found = [
            Pdo(1, False, frame.cob_id, _EVERY_SYNC, slots, timer=deadline),
            Pdo(2, False, RPDO2 + node, _ON_RECEPTION, (od.CONTROL_WORD, od.MODE)),
            Pdo(1, True, TPDO1 + node, _EVERY_SYNC, self.position_slots),
        ]
        if self.status_slots:
            found.append(Pdo(2, True, TPDO2 + node, _ON_CHANGE, self.status_slots, inhibit, period))
        return found

    def identifiers(self, node: int) -> list[Write]:
        """Return the downloads of the COB-IDs of SYNC and emergencies, and of the emergencies' inhibit time."""
        return [
            Write(od.SYNC_COB_ID, SYNC, _NO_REMOTE),
            Write(od.EMERGENCY_COB_ID, EMERGENCY + node, _NO_REMOTE),
            Write(od.EMERGENCY_INHIBIT, _whole(EMERGENCY_INHIBIT, 1e-4)),
        ]

    def heartbeat(self, node: int) -> Write:
        """Return the download of a drive's heartbeat period, 0 for a guarded one, which can send none (CiA 301)."""
        return Write(od.HEARTBEAT_PRODUCER, 0 if node in self.guarded_nodes else _whole(self.heartbeat_drives, 1e-3))

    @property
    def status_syncs(self) -> int:
        """Return the number of SYNCs between status reports of drives without a timer for them (1801h:05)."""
        return min(max(1, round(self.status_inhibit * self.rate)), _MOST_SYNCS)

    def host_supervision(self, node: int) -> list[Write]:
        """Return the downloads that make a drive supervise its host by heartbeat and, where guarded, by guarding."""
        own = self.heartbeat_wait if self.watchdog(node) == "heartbeat" else None  # of the others it is a second one
        wait = self.host << 16 | _whole(own or self.heartbeat_timeout, 1e-3)
        todo = [Write(od.HEARTBEAT_CONSUMER, wait)]
        if self.watchdog(node) in ("heartbeat", "node_guarding"):  # or its reaction could not be received
            todo.append(Write(od.ERROR_BEHAVIOUR, _STAYS_OPERATIONAL))
        if node in self.guarded_nodes:
            period, factor = self.guarding
            todo += [Write(od.GUARD_TIME, _whole(period, 1e-3)), Write(od.LIFE_FACTOR, factor)]
        return todo

    def unused_pdos(self, node: int) -> list[Pdo]:
        """Return the PDOs that this profile does not use, to be switched off, with their default COB-IDs."""
        return [
            Pdo(number, sent, (TPDO1 if sent else RPDO1) + (number - 1) * 0x100 + node, _ON_RECEPTION, ())
            for sent, number in (*(() if self.status_slots else ((True, 2),)), *_UNUSED)
        ]


def bus_profiles(driver: CanopenDriver, rate: float) -> list[BusProfile]:
    """Return the profile of the frames on each bus of an arm.

    Args:
        driver: the arm's section `driver`.
        rate: cycles per second.

    Returns:
        One profile for each bus that has drives, in the order of the configuration.
    """
    return [_profile(driver, rate, number, bus) for number, bus in enumerate(driver.buses)]


def _profile(driver: CanopenDriver, rate: float, number: int, bus: CanBus) -> BusProfile:
    drives = [k for k, drive in enumerate(driver.drives) if drive.bus == number]
    slots, target = driver.drives_per_frame, od.TARGET_POSITION if driver.streams == "position" else od.TARGET_TORQUE
    status = (od.STATUS_WORD, od.TORQUE_ACTUAL) if driver.torque_reports == "status" else (od.STATUS_WORD,)
    measured = (od.TORQUE_ACTUAL,) if driver.torque_reports == "cyclic" else ()
    own = driver.status_frame == "own"
    together = [drives[first : first + slots] for first in range(0, len(drives), slots)]
    return BusProfile(
        number,
        bus,
        rate,
        driver.heartbeats.node,
        tuple(drives),
        _nodes(driver.drives, drives),
        tuple(frozenset(driver.drives[k].notices) for k in drives),
        tuple(_torque_frame(driver.drives, frame, target) for frame in together),
        driver.heartbeats.period,
        driver.heartbeats.drives,
        driver.heartbeats.timeout,
        driver.torque_deadline,
        driver.status.period,
        driver.status.inhibit,
        (od.POSITION, *(() if own else status), *measured),
        status if own else (),
        tuple(driver.drives[k].watchdog for k in drives),
        (driver.guarding.period, driver.guarding.factor),
        driver.heartbeats.host_timeout,
    )


def _torque_frame(drives: Sequence[CanopenDrive], chosen: Sequence[int], target: Entry) -> TorqueFrame:
    nodes, shift = _nodes(drives, chosen), drives[chosen[0]].torque_shift
    if shift is not None and target is od.TARGET_TORQUE:
        return TorqueFrame(RPDO1 + nodes[0], tuple(chosen), nodes, od.TARGET_TORQUE_WIDE, shift)
    return TorqueFrame(RPDO1 + nodes[0], tuple(chosen), nodes, target)


def _nodes(drives: Sequence[CanopenDrive], chosen: Sequence[int]) -> tuple[int, ...]:
    return tuple(drives[k].node for k in chosen)


def _whole(seconds: float, unit: float) -> int:
    """Convert a time to a whole number of units, at least one and at most what 16 bits hold."""
    return min(max(1, round(seconds / unit)), _MOST_16)
