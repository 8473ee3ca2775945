"""Emulate process data objects: when they are sent, what they do on reception, how values lie in them.

A dummy object takes its bytes and stands for nothing.

Received: transmission types up to 240 act at the next SYNC, 254 and 255 at once. An RPDO with an event timer must come
again within it. Sent: type 0 at a SYNC after a change, 1 to 240 at every so many SYNCs, 254 and 255 on a change, not
within the inhibit time, and again after the event timer.

All of this happens only while the node is operational.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

from sim_backend.canopen_device.emergency import Emergency
from sim_backend.canopen_device.node import Node
from sim_backend.canopen_device.objects import (
    NO_OBJECT,
    NOT_MAPPABLE,
    PDO_LENGTH,
    WRONG_STATE,
    WRONG_VALUE,
    Objects,
    SdoAbort,
)

INVALID = 1 << 31
EXTENDED = 1 << 29
COMMUNICATION = (range(0x1400, 0x1404), range(0x1800, 0x1804))
MAPPING = (range(0x1600, 0x1604), range(0x1A00, 0x1A04))
MOST_MAPPED = 64  # entries of a PDO (CiA 301, 1600h): of one bit each
# Identifiers that are no PDO's (CiA 301, table 24).
_RESTRICTED = (
    range(0x080),
    range(0x080, 0x081),
    range(0x101, 0x181),
    range(0x581, 0x600),
    range(0x601, 0x680),
    range(0x6E0, 0x700),
    range(0x701, 0x800),
)


@dataclass(frozen=True)
class Layout:
    """Hold the byte layout of one PDO.

    Attributes:
        packing: packing of all its bytes.
        keys: keys of the objects, in order, without dummies.
    """

    packing: struct.Struct
    keys: tuple[int, ...]


def layout(objects: Objects, index: int, count: int | None = None) -> Layout:
    """Return a PDO's byte layout by its mapping parameter `index`, of `count` entries; SdoAbort where it cannot be.

    Args:
        objects: object dictionary that holds the mapping.
        index: of the mapping parameter.
        count: entries that count; by default as sub-index 0 says.

    Raises:
        SdoAbort: an entry that cannot be mapped, or more than 8 bytes.
    """
    receives = index in MAPPING[0]
    form, keys = "<", []
    for subindex in range(1, min(objects.number(index) if count is None else count, MOST_MAPPED) + 1):
        entry = objects.number(index, subindex)
        key, bits = entry >> 8, entry & 0xFF
        if receives and key & 0xFF == 0 and bits and objects.dummies.get(key >> 8, 0) * 8 == bits:
            form += f"{bits // 8}x"
            continue
        mapped = objects.entries.get(key)
        if mapped is None:
            raise SdoAbort(NO_OBJECT)
        allowed = mapped.writable if receives else mapped.readable
        if not (mapped.mappable and allowed) or mapped.form is None or mapped.size * 8 != bits:
            raise SdoAbort(NOT_MAPPABLE)
        form += mapped.form
        keys.append(key)
    packing = struct.Struct(form)
    if packing.size > 8:
        raise SdoAbort(PDO_LENGTH)
    return Layout(packing, tuple(keys))


def check_write(objects: Objects, key: int, value: int) -> None:
    """Raise SdoAbort where a host may not write `value` into the PDO parameter `key` (index << 8 | sub-index) now.

    A PDO's identifier and mapping only change while it does not exist (bit 31), entries only while there are none.
    Where the identifier is fixed, the number of entries alone says whether it exists.
    """
    index, subindex = key >> 8, key & 0xFF
    if any(index in indices for indices in COMMUNICATION):
        if subindex == 1:
            _check_identifier(objects, key, value)
        elif subindex == 2 and 241 <= value <= 253:  # reserved, or on remote frames only
            raise SdoAbort(WRONG_VALUE)
        elif subindex in (3, 6) and _exists(objects, index):
            raise SdoAbort(WRONG_STATE)
    elif any(index in indices for indices in MAPPING):
        if _exists(objects, index - 0x200):
            raise SdoAbort(WRONG_STATE)
        if subindex == 0:
            layout(objects, index, value)
        elif objects.number(index):
            raise SdoAbort(WRONG_STATE)


def _exists(objects: Objects, index: int) -> bool:
    changes = (entry := objects.entries.get(index << 8 | 1)) is not None and entry.writable
    return changes and not objects.number(index, 1) & INVALID


def _check_identifier(objects: Objects, key: int, value: int) -> None:
    before = objects.values[key]
    identifier = value & 0x7FF
    if value & EXTENDED or value & 0x1FFF_F800:
        raise SdoAbort(WRONG_VALUE)
    if value & INVALID:
        return
    if any(identifier in forbidden for forbidden in _RESTRICTED):
        raise SdoAbort(WRONG_VALUE)
    if isinstance(before, int) and not before & INVALID and before & 0x7FF != identifier:
        raise SdoAbort(WRONG_STATE)


PDO_SHORT, PDO_LONG, RPDO_TIMEOUT = 0x8210, 0x8220, 0x8250
_MS, _INHIBIT_NS = 1_000_000, 100_000
_SYNCHRONOUS = 240
_US = 1000
_WINDOW = 0x1007  # after SYNC, in which synchronous RPDOs are taken; 0 for always (CiA 301, 7.5.2.7)
_DEADLINE, _EVENT, _INHIBITED = "rpdo deadline ", "tpdo event ", "tpdo inhibited "


@dataclass
class _Received:
    number: int
    identifier: int
    synchronous: bool
    deadline_ns: int
    layout: Layout
    waiting: bytes | None = None


@dataclass
class _Sent:
    number: int
    identifier: int
    kind: int
    inhibit_ns: int
    event_ns: int
    layout: Layout
    last: bytes | None = None
    syncs: int = 0


class Pdos:
    """Emulate all PDOs of one node."""

    def __init__(
        self, node: Node, emergency: Emergency, received: Callable[[tuple[int, ...]], None], late: Callable[[], None]
    ) -> None:
        """Start with PDOs that do not exist yet.

        Args:
            node: node of the PDOs.
            emergency: errors of the node, to which wrong lengths and missed deadlines are added.
            received: called with the keys of objects that an RPDO has set.
            late: called when an RPDO has stayed away for longer than its event timer.
        """
        self._node, self._emergency = node, emergency
        self._received, self._late = received, late
        self.rpdos: dict[int, list[_Received]] = {}
        self._tpdos: list[_Sent] = []
        self._active = False
        self._synced_ns = 0

    def configure(self) -> None:
        """Read the communication and mapping parameters again, after one has changed."""
        objects = self._node.objects
        waiting = {p.number: p.waiting for group in self.rpdos.values() for p in group}
        lasts = {p.number: p for p in self._tpdos}
        self.rpdos, self._tpdos = {}, []
        for number, index in enumerate(COMMUNICATION[0]):
            identifier = objects.number(index, 1)
            if not identifier or identifier & INVALID or (where := self._layout(MAPPING[0][number])) is None:
                self._node.stop_timer(f"{_DEADLINE}{number}")
                continue
            rpdo = _Received(
                number,
                identifier & 0x7FF,
                objects.number(index, 2) <= _SYNCHRONOUS,
                objects.number(index, 5) * _MS,
                where,
                waiting.get(number),
            )
            self.rpdos.setdefault(rpdo.identifier, []).append(rpdo)
        for number, index in enumerate(COMMUNICATION[1]):
            identifier = objects.number(index, 1)
            if not identifier or identifier & INVALID or (where := self._layout(MAPPING[1][number])) is None:
                self._node.stop_timer(f"{_EVENT}{number}")
                continue
            before = lasts.get(number)
            self._tpdos.append(
                _Sent(
                    number,
                    identifier & 0x7FF,
                    objects.number(index, 2),
                    objects.number(index, 3) * _INHIBIT_NS,
                    objects.number(index, 5) * _MS,
                    where,
                    before.last if before else None,
                    before.syncs if before else 0,
                )
            )

    def start(self) -> None:
        """Start PDOs as the node becomes operational; those sent on a change go out once by the next `send_changes`."""
        self._active = True
        for tpdo in self._tpdos:
            tpdo.last, tpdo.syncs = None, 0

    def stop(self) -> None:
        """Stop PDOs when the node is not operational any more."""
        self._active = False
        for group in self.rpdos.values():
            for rpdo in group:
                rpdo.waiting = None
        for name in [name for name in self._node.timers if name.startswith((_DEADLINE, _EVENT, _INHIBITED))]:
            self._node.stop_timer(name)

    def receive(self, identifier: int, data: bytes) -> bool:
        """Process an RPDO's frame; return False where nothing has changed: its data wait for SYNC, or PDOs are off."""
        changed = bool(self._emergency.active)
        if not self._active:
            return False
        for rpdo in self.rpdos.get(identifier, ()):
            size = rpdo.layout.packing.size
            if len(data) < size:
                self._emergency.add_error(PDO_SHORT)
                changed = True
                continue
            if len(data) > size:
                self._emergency.add_error(PDO_LONG)
                changed = True
            elif self._emergency.active:
                self._emergency.remove_errors(PDO_SHORT, PDO_LONG, RPDO_TIMEOUT)
            if rpdo.deadline_ns:
                self._node.start_timer(f"{_DEADLINE}{rpdo.number}", rpdo.deadline_ns)
            window = self._node.objects.number(_WINDOW) * _US
            if rpdo.synchronous and window and self._node.now_ns - self._synced_ns > window:
                continue
            if rpdo.synchronous:
                rpdo.waiting = data[:size]
            else:
                self._act(rpdo, data[:size])
                changed = True
        return changed

    def sync_arrived(self) -> None:
        """Process a SYNC: send synchronous TPDOs with present values; `apply_received` follows."""
        self._synced_ns = self._node.now_ns
        if not self._active:
            return
        for tpdo in self._tpdos:
            if tpdo.kind > _SYNCHRONOUS:
                continue
            tpdo.syncs += 1
            data = self._packed(tpdo)
            if tpdo.kind == 0 and data == tpdo.last:
                continue
            if tpdo.syncs >= tpdo.kind:
                tpdo.syncs, tpdo.last = 0, data
                self._node.send(tpdo.identifier, data)

    def apply_received(self) -> None:
        """Apply what synchronous RPDOs have received since the last SYNC."""
        for group in self.rpdos.values():
            for rpdo in group:
                if rpdo.waiting is not None:
                    data, rpdo.waiting = rpdo.waiting, None
                    self._act(rpdo, data)

    def send_changes(self) -> None:
        """Send the TPDOs that are sent on a change, where their values have changed and no inhibit time runs."""
        if not self._active:
            return
        for tpdo in self._tpdos:
            if tpdo.kind > _SYNCHRONOUS and f"{_INHIBITED}{tpdo.number}" not in self._node.timers:
                data = self._packed(tpdo)
                if data != tpdo.last:
                    self._event(tpdo, data)

    def timer_ran_out(self, timer: str) -> None:
        """Act on `timer`, which ran out: an RPDO's deadline, a TPDO's event; the inhibited wait for `send_changes`."""
        if timer.startswith(_DEADLINE):
            self._emergency.add_error(RPDO_TIMEOUT)
            self._late()
        elif timer.startswith(_EVENT):
            tpdo = next(t for t in self._tpdos if t.number == int(timer.removeprefix(_EVENT)))
            if f"{_INHIBITED}{tpdo.number}" in self._node.timers:
                self._node.start_timer(timer, tpdo.event_ns)
            else:
                self._event(tpdo, self._packed(tpdo))

    def _event(self, tpdo: _Sent, data: bytes) -> None:
        tpdo.last = data
        self._node.send(tpdo.identifier, data)
        if tpdo.inhibit_ns:
            self._node.start_timer(f"{_INHIBITED}{tpdo.number}", tpdo.inhibit_ns)
        if tpdo.event_ns:
            self._node.start_timer(f"{_EVENT}{tpdo.number}", tpdo.event_ns)

    def _act(self, rpdo: _Received, data: bytes) -> None:
        values = self._node.objects.values
        for key, value in zip(rpdo.layout.keys, rpdo.layout.packing.unpack(data), strict=True):
            values[key] = value
        self._received(rpdo.layout.keys)

    def _packed(self, tpdo: _Sent) -> bytes:
        objects, keys = self._node.objects, tpdo.layout.keys
        try:
            return tpdo.layout.packing.pack(*[objects.values[key] for key in keys])
        except struct.error:  # the file gives an entry a type that does not hold what the firmware keeps there
            return b"".join(map(objects.packed, keys))

    def _layout(self, index: int) -> Layout | None:
        """Return the layout of a PDO, None for one that maps nothing and so does not exist."""
        try:
            found = layout(self._node.objects, index)
        except SdoAbort:
            return None
        return found if found.packing.size else None
