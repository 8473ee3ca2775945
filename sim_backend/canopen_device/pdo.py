"""Emulate a node's process data objects: when they are sent, and when received ones act (CiA 301, 7.2.2, 7.5.2.35).

Received: transmission types up to 240 act at the next SYNC, 254 and 255 at once. An RPDO with an event timer must come
again within it. Sent: type 0 at a SYNC after a change, 1 to 240 at every so many SYNCs, 254 and 255 on a change, not
within the inhibit time, and again after the event timer.

All of this happens only while the node is operational.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from sim_backend.canopen_device.emergency import Emergency
from sim_backend.canopen_device.mapping import COMMUNICATION, INVALID, MAPPING, Layout, layout
from sim_backend.canopen_device.node import Node
from sim_backend.canopen_device.objects import SdoAbort

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
            node: whose they are.
            emergency: is told of wrong lengths and missed deadlines.
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
                self._node.stop(f"{_DEADLINE}{number}")
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
                self._node.stop(f"{_EVENT}{number}")
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
        """Start PDOs when the node is operational: each is sent once."""
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
            self._node.stop(name)

    def receive(self, identifier: int, data: bytes) -> None:
        """Process a frame with the identifier of an RPDO."""
        if not self._active:
            return
        for rpdo in self.rpdos.get(identifier, ()):
            size = rpdo.layout.packing.size
            if len(data) < size:
                self._emergency.occurs(PDO_SHORT)
                continue
            if len(data) > size:
                self._emergency.occurs(PDO_LONG)
            elif self._emergency.active:
                self._emergency.is_over(PDO_SHORT, PDO_LONG, RPDO_TIMEOUT)
            if rpdo.deadline_ns:
                self._node.after(f"{_DEADLINE}{rpdo.number}", rpdo.deadline_ns)
            window = self._node.objects.number(_WINDOW) * _US
            if rpdo.synchronous and window and self._node.now_ns - self._synced_ns > window:
                continue
            if rpdo.synchronous:
                rpdo.waiting = data[:size]
            else:
                self._act(rpdo, data[:size])

    def sync(self) -> None:
        """Process a SYNC: send synchronous TPDOs with present values, then let received torques act."""
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
        for group in self.rpdos.values():
            for rpdo in group:
                if rpdo.waiting is not None:
                    data, rpdo.waiting = rpdo.waiting, None
                    self._act(rpdo, data)

    def changes(self) -> None:
        """Send the TPDOs that are sent on a change, where their values have changed."""
        if not self._active:
            return
        for tpdo in self._tpdos:
            if tpdo.kind > _SYNCHRONOUS and f"{_INHIBITED}{tpdo.number}" not in self._node.timers:
                data = self._packed(tpdo)
                if data != tpdo.last:
                    self._event(tpdo, data)

    def due(self, name: str) -> None:
        """Handle the due timer of this name; inhibited TPDOs are sent with the next `changes`."""
        if name.startswith(_DEADLINE):
            self._emergency.occurs(RPDO_TIMEOUT)
            self._late()
        elif name.startswith(_EVENT):
            tpdo = next(t for t in self._tpdos if t.number == int(name.removeprefix(_EVENT)))
            if f"{_INHIBITED}{tpdo.number}" in self._node.timers:
                self._node.after(name, tpdo.event_ns)
            else:
                self._event(tpdo, self._packed(tpdo))

    def _event(self, tpdo: _Sent, data: bytes) -> None:
        tpdo.last = data
        self._node.send(tpdo.identifier, data)
        if tpdo.inhibit_ns:
            self._node.after(f"{_INHIBITED}{tpdo.number}", tpdo.inhibit_ns)
        if tpdo.event_ns:
            self._node.after(f"{_EVENT}{tpdo.number}", tpdo.event_ns)

    def _act(self, rpdo: _Received, data: bytes) -> None:
        values = self._node.objects.values
        for key, value in zip(rpdo.layout.keys, rpdo.layout.packing.unpack(data), strict=True):
            values[key] = value
        self._received(rpdo.layout.keys)

    def _packed(self, tpdo: _Sent) -> bytes:
        values = self._node.objects.values
        return tpdo.layout.packing.pack(*[values[key] for key in tpdo.layout.keys])

    def _layout(self, index: int) -> Layout | None:
        """Return the layout of a PDO, None for one that maps nothing and so does not exist."""
        try:
            found = layout(self._node.objects, index)
        except SdoAbort:
            return None
        return found if found.packing.size else None
