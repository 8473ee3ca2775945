"""Emulate one motor puck: its properties, positions of 22 bits, torques of 14 bits, and its power stage.

IDLE shorts the windings. TORQUE follows torque frames, clipped at MT without a report; only the safety puck sets it,
and a host that tries is ignored. In its monitor (STAT 0) a puck knows its first properties only. An error of its own
(STAT 1) leaves the windings open until STAT is set to 2 again; what real pucks do then is not documented.
"""

from __future__ import annotations

from collections.abc import Callable

from drivers.barrett.protocol import (
    HOST,
    MONITOR,
    Group,
    Mode,
    Properties,
    Role,
    SafetyMode,
    Status,
    address_of,
    position_frame,
    reply_frame,
    request_of,
    torques_of,
)
from drivers.can.can_frame import Frame
from ident_service.config.barrett import Puck
from sim_backend.emulator.face import Traffic
from sim_backend.emulator.motor import Motor
from sim_backend.puck_device.safety import EmulatedSafetyPuck

_GROUPS = ("GRPA", "GRPB", "GRPC")
_READ_ONLY = ("VERS", "ROLE", "SN", "ID", "ERROR", "MECH", "P", "T", "MODE", "STAT")
_SERIAL = 1000  # of node 0; any number does


class EmulatedPuck:
    """Emulate one motor puck; see `EmulatedDevice`.

    Attributes:
        motor: motor that it drives.
        values: values of its properties, by name; tests may change them.
    """

    def __init__(
        self,
        puck: Puck,
        motor: Motor,
        safety: EmulatedSafetyPuck,
        *,
        version: int,
        ipnm: int | None = None,
        origin: int | None = None,
        joint: Callable[[int], int] | None = None,
    ) -> None:
        """Assemble a puck without power.

        Args:
            puck: section of the description for the puck.
            motor: motor that it drives.
            safety: the arm's safety puck.
            version: of its firmware.
            ipnm: true counts per N m, where the description says something else.
            origin: position that the motor has at first in an arm that has been zeroed [counts]; None for one that has
                not, and whose pucks have just been switched on.
            joint: function that returns the joint encoder's counts at a time [ns]; None where the puck reads none.
        """
        self.motor = motor
        self._node, self._safety = puck.node, safety
        self._properties = Properties(version, Role.MOTOR)
        self._place = safety.supervise(self.set_mode)
        self._zeroed = origin is not None
        self._offset = origin or 0
        self._joint = joint
        self.values = {
            "VERS": version,
            "ROLE": int(Role.MOTOR),
            "SN": _SERIAL + puck.node,
            "ID": puck.node,
            "ERROR": 0,
            "GRPA": int(Group.ALL),
            "GRPB": puck.group,
            "GRPC": int(Group.ARM),
            "PIDX": puck.slot,
            "CTS": puck.cts,
            "MT": puck.mt,
            "IPNM": ipnm or puck.ipnm,
            "POLES": puck.poles or 12,
            "TEMP": 30,
            "OTEMP": 60,
            "VBUS": 48,
        }
        self._stat, self._mode = Status.READY, Mode.IDLE
        self._told = 0  # counts of the last torque frame
        self._lasting = False

    @property
    def number(self) -> int:
        """Return the node."""
        return self._node

    @property
    def next_deadline_ns(self) -> int | None:
        """Return None: a puck has no timer."""
        return None

    @property
    def state(self) -> str:
        """Describe STAT, MODE and power stage, for people."""
        if self._stat is Status.RESET:
            return "asleep"
        error = f", error {self.values['ERROR']}" if self._stat is Status.ERROR else ""
        return f"{self._mode.name}, motor {self.motor.power.value}{error}"

    @property
    def released(self) -> bool:
        """Return whether the arm is IDLE and its host has asked for that since it was active, or it never was."""
        return self._safety.mode is SafetyMode.IDLE and self._safety.lowered_by_host

    @property
    def sync_identifier(self) -> int:
        """Return the identifier of the requests for positions of the whole arm."""
        return 0x400 | Group.ARM

    def power_up(self, now_ns: int) -> None:
        """Start the firmware: in its monitor, unless the arm has been awake and zeroed before."""
        self.motor.power_up(now_ns)
        self._stat, self._mode = Status.READY if self._zeroed else Status.RESET, Mode.IDLE

    def listens(self, identifier: int) -> bool:
        """Return whether a frame is for this puck, or for one of its groups."""
        address = address_of(identifier)
        if not address.group:
            return address.destination == self._node
        return address.destination in (self.values[name] for name in _GROUPS)

    def traffic_kind(self, frame: Frame) -> Traffic:
        """Return FEEDBACK for a position that this puck has sent, else OTHER."""
        address = address_of(frame.identifier)
        return Traffic.FEEDBACK if address.group and address.destination == Group.POSITIONS else Traffic.OTHER

    def receive(self, frame: Frame, now_ns: int) -> list[Frame]:
        """Process a frame of host or safety puck: take a torque or set a property, or return the answer to a GET."""
        if frame.error or frame.remote or frame.extended:
            return []
        address = address_of(frame.identifier)
        if address.group and address.destination in (Group.LOWER, Group.UPPER):
            self._take_torque(frame.data, now_ns)
            return []
        request = request_of(frame.data)
        if request is None or (self._stat is Status.RESET and request.number not in MONITOR):
            return []
        name = self._properties.name(request.number)
        if name is None:
            return []
        if request.value is not None:
            self._set(name, request.value, now_ns, by_host=address.sender == HOST)
            return []
        if name == "P":
            counts = self.motor.encoder(now_ns) + self._offset
            self._safety.watch_position(self._place, counts, now_ns)
            return [position_frame(self._node, counts, None if self._joint is None else self._joint(now_ns))]
        return [reply_frame(self._node, request.number, self._value(name, now_ns), wide=self._properties.is_wide(name))]

    def finish_sync(self, now_ns: int) -> list[Frame]:
        """Do nothing and return no frames: torques act when they come."""
        return []

    def set_mode(self, mode: Mode, now_ns: int) -> None:
        """Take the mode that the safety puck sets, with zero torque; do nothing while asleep or in error."""
        if self._stat is not Status.READY:
            return
        self._told = 0
        self._mode = mode
        self.evaluate(now_ns)

    def evaluate(self, now_ns: int) -> None:
        """Set the power stage: failed in an error, the limited torque in mode TORQUE, else off."""
        if self._stat is Status.ERROR:
            self.motor.fail(now_ns)
        elif self._mode is Mode.TORQUE:
            reach = round(self.values["MT"] * self.motor.defects.torque_share)
            counts = min(max(self._told, -reach), reach) * self.motor.defects.torque_fraction
            self.motor.drive(counts / self.values["IPNM"], now_ns)
        else:
            self.motor.switch_off(now_ns)

    def tick(self, now_ns: int) -> list[Frame]:
        """Do nothing and return no frames: a puck has no timer."""
        return []

    def watch(self, now_ns: int) -> None:
        """Do nothing: a puck limits torque by its counts alone."""

    def fail(self, code: int, now_ns: int, *, lasting: bool = False) -> list[Frame]:
        """Enter an error (STAT 1, no torque); a host may clear it, if lasting after `end_lasting_fault`; return []."""
        self._stat, self._mode, self._told = Status.ERROR, Mode.IDLE, 0
        self.values["ERROR"] = code & 0x7FFF
        self._lasting = self._lasting or lasting
        self.evaluate(now_ns)
        return []

    def end_lasting_fault(self) -> None:
        """End the cause of a lasting error, which a host may clear then."""
        self._lasting = False

    def ignore_watchdogs(self, ignored: bool) -> None:
        """Set whether the arm's safety puck goes on although the host is gone."""
        self._safety.ignores_heartbeat = ignored

    def set_warning(self, active: bool, now_ns: int) -> list[Frame]:
        """Set or clear the arm's warning of low supply voltage at the safety puck; return no frames."""
        self._safety.set_low_supply(active)
        return []

    def switch_supply(self, on: bool, now_ns: int) -> list[Frame]:
        """Release (on) or press (off) the emergency stop of the whole arm; return no frames."""
        self._safety.emergency_stop(not on, now_ns)
        return []

    def reboot(self, now_ns: int) -> list[Frame]:
        """Restart the firmware: in its monitor, without torque and its position; return no frames."""
        self._stat, self._mode, self._told, self._offset = Status.RESET, Mode.IDLE, 0, 0
        self.motor.power_up(now_ns)
        return []

    def _take_torque(self, data: bytes, now_ns: int) -> None:
        found = torques_of(data)
        if found is None or found[0] != self._properties.number("T") or self._mode is not Mode.TORQUE:
            return
        self._told = found[1][self.values["PIDX"] - 1]
        self.evaluate(now_ns)

    def _value(self, name: str, now_ns: int) -> int:
        match name:
            case "STAT":
                return self._stat
            case "MODE":
                return self._mode
            case "MECH":
                return self.motor.encoder(now_ns) % self.values["CTS"]
            case "T":
                return self._told
            case _:
                return self.values.get(name, 0)

    def _set(self, name: str, value: int, now_ns: int, *, by_host: bool) -> None:
        if name == "STAT" and value == Status.READY and not self._lasting:
            if self._stat is not Status.READY:
                self._stat, self._mode = Status.READY, Mode.IDLE
                self.values["ERROR"] = 0
                self.evaluate(now_ns)
        elif name == "MODE" and by_host and value == Mode.IDLE:  # the safety puck's own frame is seen by `set_mode`
            if self._stat is Status.READY and self._mode is not Mode.IDLE:
                self.set_mode(Mode.IDLE, now_ns)
        elif name == "P":
            self._offset += value - (self.motor.encoder(now_ns) + self._offset)
        elif name not in _READ_ONLY and name in self.values:
            self.values[name] = value
