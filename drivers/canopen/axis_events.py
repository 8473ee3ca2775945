"""Translate the events of CANopen buses to events common to all fieldbuses; those for people only are left out."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from drivers.axis_status import AxisEvent, AxisEventCode
from drivers.can.bus_event import HOST, Event, EventCode
from drivers.canopen.pdo_codec import BusCodec
from ident_service.config.canopen import CanopenDriver

_CODES: dict[EventCode, AxisEventCode] = {
    EventCode.EMERGENCY: AxisEventCode.EMERGENCY_MESSAGE,
    EventCode.NOTICE: AxisEventCode.DRIVE_NOTICE,
    EventCode.BOOT_UP: AxisEventCode.DRIVE_RESTARTED,
    EventCode.LEFT: AxisEventCode.DRIVE_LEFT,
    EventCode.DEAF: AxisEventCode.TORQUE_IGNORED,
    EventCode.DRIVE_WARNING: AxisEventCode.DRIVE_WARNING,
    EventCode.TORQUE_LIMITED: AxisEventCode.TORQUE_LIMITED,
    EventCode.DUPLICATE: AxisEventCode.STRANGE_FRAME,
    EventCode.LATE: AxisEventCode.STRANGE_FRAME,
    EventCode.WRONG_LENGTH: AxisEventCode.STRANGE_FRAME,
    EventCode.STRANGER: AxisEventCode.STRANGE_FRAME,
    EventCode.SECOND_HOST: AxisEventCode.SECOND_HOST,
    EventCode.ERROR_PASSIVE: AxisEventCode.BUS_DEGRADED,
    EventCode.BUS_OFF: AxisEventCode.BUS_OFF,
    EventCode.OVERFLOW: AxisEventCode.STRANGE_FRAME,
    EventCode.BUS_ERROR: AxisEventCode.STRANGE_FRAME,
}
# Emergencies of a drive that is in trouble with the bus itself (CiA 301, table 26).
_ERROR_PASSIVE = "8120h"


def axis_events(events: Iterable[Event], codec: BusCodec, joint_of: Mapping[int, int]) -> list[AxisEvent]:
    """Translate the events of one bus.

    events: as the codec reports them. States of drives, errors that were reset and a return to normal are not among
        events: as the codec tells them. States of drives, errors that were reset and a return to normal are not among
            the results.
        codec: of the bus.
        joint_of: first joint that each node moves.
    """
    bus = codec.profile.bus.channel
    found = []
    for event in events:
        code = _CODES.get(event.code)
        if event.code is EventCode.EMERGENCY and event.words.startswith(_ERROR_PASSIVE):
            code = AxisEventCode.BUS_DEGRADED
        if code is not None:
            words = f"{bus}: {event.words}" if event.node == HOST else f"node {event.node}: {event.words}"
            found.append(AxisEvent(code, joint_of.get(event.node), words))
    return found


class Reports:
    """Collect the events of all buses of an arm, cycle by cycle."""

    def __init__(self, driver: CanopenDriver, joints: Mapping[int, int], look_every: int) -> None:
        """Start with nothing reported missing.

        Args:
            driver: the section `driver`.
            joints: first joint that each drive moves, by number.
            look_every: cycles between two checks for missing reports.
        """
        self._joints = [{d.node: joints[k] for k, d in enumerate(driver.drives) if d.bus == bus} for bus in range(4)]
        self._look_every = look_every
        self._missed = MissedReports()

    def new(self, codecs: Iterable[BusCodec], cycle: int, now_ns: int) -> list[AxisEvent]:
        """Return the events since the last call; `cycle` is the cycle's number, `now_ns` of the links' clock [ns]."""
        found: list[AxisEvent] = []
        look = cycle % self._look_every == 0
        for codec in codecs:
            if (events := codec.take_events()) or look:
                joints = self._joints[codec.profile.number]
                found += axis_events(events, codec, joints)
                found += self._missed.new(codec, now_ns, joints) if look else []
        return found


class MissedReports:
    """Report drives whose heartbeat or status report is missing, each once until it is received again."""

    def __init__(self) -> None:
        self._told: set[tuple[int, int, AxisEventCode]] = set()

    def new(self, codec: BusCodec, now_ns: int, joint_of: Mapping[int, int]) -> list[AxisEvent]:
        """Return the reports that have gone missing on one bus since the last call.

        Args:
            codec: of the bus.
            now_ns: of the links' clock [ns].
            joint_of: first joint that each node moves.
        """
        bus, profile = codec.profile.number, codec.profile
        missing = {(bus, node, AxisEventCode.DRIVE_SILENT) for node in codec.silent(now_ns)}
        missing |= {(bus, node, AxisEventCode.STATUS_STALE) for node in codec.stale()}
        new = sorted(missing - self._told)
        self._told = {place for place in self._told if place[0] != bus} | missing
        words = {
            AxisEventCode.DRIVE_SILENT: f"no heartbeat for {profile.heartbeat_timeout:g} s",
            AxisEventCode.STATUS_STALE: f"no status report for {profile.status_timeout:g} s",
        }
        return [AxisEvent(code, joint_of[node], f"node {node}: {words[code]}") for _, node, code in new]
