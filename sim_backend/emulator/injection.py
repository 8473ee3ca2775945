"""Apply faults to emulated drives, their motors, the arm, and the frames on their way to the host."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from drivers.can.can_frame import Frame
from sim_backend.emulator.body import Body
from sim_backend.emulator.face import Face, Traffic
from sim_backend.emulator.faults import PuckFault
from sim_backend.emulator.motor import Defects

POWER_STAGE = 0x5400  # CiA 402-2, table 16: output stages
# linux/can/error.h: bus-off; problems of the controller, which are error passive on both sides.
BUS_OFF = Frame(0x040, bytes(8), error=True)
ERROR_PASSIVE = Frame(0x004, bytes([0, 0x30, 0, 0, 0, 0, 0, 0]), error=True)
_CUT_OFF = ("bus_gone", "bus_off")


@dataclass(frozen=True)
class Sent:
    """Represent a frame on its way.

    Attributes:
        bus: index of the bus.
        drive: index of the drive that sends it; None for what no drive sends.
        frame: sent.
        ready_ns: when its node wants to send it.
    """

    bus: int
    drive: int | None
    frame: Frame
    ready_ns: int


class Injection:
    """Hold the faults that act at present, and apply them.

    Attributes:
        active: in the order in which they came.
    """

    def __init__(self, body: Body, faces: Sequence[Face], buses: Sequence[int]) -> None:
        """Start without faults.

        Args:
            body: the arm.
            faces: the drives' protocol implementations, in the order of the motors.
            buses: index of each one's bus.
        """
        self._body, self._faces, self._buses = body, faces, buses
        self.active: list[PuckFault] = []
        self._dead: frozenset[int] = frozenset()

    @property
    def cut_off(self) -> bool:
        """Return whether no frame gets through."""
        return any(fault.kind in _CUT_OFF for fault in self.active)

    def dead(self, drive: int) -> bool:
        """Return whether a node neither receives nor sends anything."""
        return drive in self._dead

    def begin(self, fault: PuckFault, now_ns: int) -> list[Sent]:
        """Begin a fault; returns the frames that the drives send because of it."""
        self.active.append(fault)
        return self._changed(fault, now_ns, begins=True)

    def end(self, fault: PuckFault, now_ns: int) -> list[Sent]:
        """End a fault; returns the frames that the drives send because of it."""
        self.active.remove(fault)
        return self._changed(fault, now_ns, begins=False)

    def on_the_way(self, drive: int, frames: Sequence[Frame], now_ns: int) -> list[Sent]:
        """Apply faults to the frames that a drive has sent; returns those that get through."""
        bus = self._buses[drive]
        if not self.active:
            return [Sent(bus, drive, frame, now_ns) for frame in frames]
        if self.cut_off or drive in self._dead:
            return []
        sent: list[Sent] = []
        for frame in frames:
            sent += self._falsified(drive, frame, now_ns)
        return sent

    def _falsified(self, drive: int, frame: Frame, now_ns: int) -> list[Sent]:
        traffic = self._faces[drive].traffic(frame)
        delay, sent = 0, []
        for fault in self.active:
            if fault.drive not in (None, drive):
                continue
            if traffic is Traffic.HEARTBEAT and fault.kind == "heartbeat_lost":
                return []
            if traffic is not Traffic.FEEDBACK:
                continue
            match fault.kind:
                case "lost_feedback":
                    return []
                case "delayed_feedback":
                    delay = max(delay, round(fault.size * 1e9))
                case "short_frame":
                    frame = frame._replace(data=frame.data[:-1])
                case "wrong_node":
                    # Another controller cannot know of the first; it is an axis that stands at 0.
                    sent.append(Sent(self._buses[drive], None, frame._replace(data=bytes(len(frame.data))), now_ns))
        return [Sent(self._buses[drive], drive, frame, now_ns + delay), *sent]

    def _changed(self, fault: PuckFault, now_ns: int, *, begins: bool) -> list[Sent]:
        drives = range(len(self._faces)) if fault.drive is None else range(fault.drive, fault.drive + 1)
        sent: list[Sent] = []
        match fault.kind:
            case "load_attached":
                self._body.changes(now_ns)
                self._body.plant.load(tuple((f.size, f.offset) for f in self.active if f.kind == "load_attached"))
            case "bus_off" | "error_passive" if begins:
                error = BUS_OFF if fault.kind == "bus_off" else ERROR_PASSIVE
                return [Sent(bus, None, error, now_ns) for bus in sorted(set(self._buses))]
        self._dead = frozenset(
            drive
            for f in self.active
            if f.kind == "node_silent"
            for drive in (range(len(self._faces)) if f.drive is None else (f.drive,))
        )
        for drive in drives:
            frames = self._drive_changed(fault, drive, now_ns, begins=begins)
            self._faces[drive].motor.defects = self._defects(drive)
            if drive not in self._dead:
                self._faces[drive].evaluate(now_ns)
            sent += self.on_the_way(drive, frames, now_ns)
        return sent

    def _drive_changed(self, fault: PuckFault, drive: int, now_ns: int, *, begins: bool) -> list[Frame]:
        """Apply the immediate effect of a fault, or of its end, to a drive."""
        face = self._faces[drive]
        match fault.kind, begins:
            case "drive_fault", True:
                return face.fail(POWER_STAGE, now_ns, lasting=True)
            case "drive_fault", False:
                face.repaired()
            case "emergency", True:
                return face.fail(int(fault.size), now_ns)
            case "emergency_stop", _:
                return face.supply(not begins, now_ns)
            case "watchdog_ignored", _:
                face.ignore_watchdogs(begins)
            case "warning", _:
                return face.warn(begins, now_ns)
            case "reboot", True:
                return face.reboot(now_ns)
            case "node_silent", True:
                face.motor.switch_off(now_ns)
            case "node_silent", False:
                face.power_up(now_ns)
        return []

    def _defects(self, drive: int) -> Defects:
        """Return all defects of a motor."""
        motor = self._faces[drive].motor
        # A joint's position, as if this motor moved it alone.
        counts = motor.counts_per_turn * self._body.gears.ratios[drive] / (2.0 * math.pi)
        found = Defects()
        for fault in self.active:
            if fault.drive not in (None, drive):
                continue
            match fault.kind:
                case "hidden_delay":
                    found.delay_ns += round(fault.size * 1e9)
                case "encoder_jump" | "encoder_offset":
                    found.shift += round(fault.size * counts)
                case "frozen_encoder":
                    found.frozen = True
                case "position_sign":
                    found.mirrored = not found.mirrored
                case "stuck_torque":
                    found.stuck = True
                case "torque_sign":
                    found.reversed = not found.reversed
                case "torque_saturation":
                    found.torque_share = min(found.torque_share, fault.size)
                case "torque_fraction":
                    found.torque_fraction = min(found.torque_fraction, fault.size)
        return found
