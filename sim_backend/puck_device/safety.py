"""Emulate the safety puck with its pendant, and the person who presses its keys.

It watches the positions and torques that pass, leaves ACTIVE by itself, and lets only a person raise its mode. Its
velocity is that of the fastest joint frame's origin, which for a WAM are elbow and flange; before the arm is zeroed it
watches joint velocities alone. That it counts as a heartbeat whatever is packed, positions and torques, is what public
sources say; its time is this emulation's. How it tells the pucks their MODE is not documented. Here a frame from
node 10 to group 0 does; of such a broadcast only the identifier is known.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from drivers.barrett.protocol import (
    Group,
    Mode,
    Pendant,
    Properties,
    Role,
    SafetyMode,
    Status,
    address_of,
    pendant_value,
    reply_frame,
    request_of,
    set_frame,
    torques_of,
)
from drivers.can.can_frame import Frame

_UNIT = 4096.0  # counts of VL1 and VL2 per m/s
_SLOWS = 500_000_000  # ns in which an arm that was too fast must be slower, or its power is taken
_LONGEST = 100_000_000  # ns between two positions of which a velocity is made
_JOINT_SPEED = 4.0  # rad/s, of an arm that is not zeroed
_STREAMS = 100_000_000  # ns without a torque frame after which nobody asks for the arm to be activated any more
_DEFAULTS = {"VL1": 2048, "VL2": 4096, "TL1": 4731, "TL2": 5204, "IFAULT": 0, "ZERO": 0}
_SERIAL = 1010


class EmulatedSafetyPuck:
    """Emulate the safety puck of one arm.

    Attributes:
        number: node number.
        mode: MODE.
        lowered_by_host: whether the host has asked for IDLE since the arm was active.
        ignores_heartbeat: whether the puck goes on although nobody talks to the pucks.
    """

    def __init__(
        self,
        number: int,
        version: int,
        points: Callable[[Sequence[int]], tuple[NDArray[np.float64], NDArray[np.float64]]],
        *,
        heartbeat: float,
        operator: float | None,
        zeroed: bool,
        velocity: float | None = None,
    ) -> None:
        """Assemble a safety puck without power.

        Args:
            number: node number.
            version: of its firmware.
            points: function from motor positions [counts] to joint positions [rad or m] and points of the arm [m].
            heartbeat: time without positions and torques after which it leaves ACTIVE [s].
            operator: time of torque frames after which a person presses Shift-Activate [s]; None for nobody.
            zeroed: whether the arm has been zeroed before.
            velocity: speed at which it trips, whatever limit it was told [m/s]; None for the limit that it was told.
        """
        self.number = number
        self.mode = SafetyMode.IDLE
        self.lowered_by_host = True
        self.ignores_heartbeat = False
        self._properties = Properties(version, Role.SAFETY)
        self._points = points
        self._heartbeat_ns = round(heartbeat * 1e9)
        self._velocity = velocity
        self._operator_ns = None if operator is None else round(operator * 1e9)
        self._values = {"VERS": version, "ROLE": int(Role.SAFETY), "SN": _SERIAL, "ID": number, "ERROR": 0}
        self._values |= _DEFAULTS | {"ZERO": int(zeroed), "STAT": Status.READY if zeroed else Status.RESET}
        self._motors: list[Callable[[Mode, int], None]] = []
        self._out: list[Frame] = []
        self._now_ns = 0
        self._traffic_ns: int | None = None
        self._torques_ns = self._asked_ns = -_STREAMS
        self._fast_ns: int | None = None
        self._faults: list[str] = []
        self._warnings: list[str] = []
        self._pressed = self._low_supply = False
        self._counts: list[int | None] = []
        self._before: tuple[int, NDArray[np.float64], NDArray[np.float64]] | None = None

    def supervise(self, set_mode: Callable[[Mode, int], None]) -> int:
        """Supervise one more motor puck, by a function that sets its mode; returns its place among them."""
        self._motors.append(set_mode)
        self._counts.append(None)
        return len(self._motors) - 1

    @property
    def state(self) -> str:
        """Describe mode and pendant, for people."""
        asleep = "" if self._values["STAT"] == Status.READY else "asleep, "
        return f"{asleep}{self.mode.name}, pendant: {self._pendant}, {'' if self._values['ZERO'] else 'not '}zeroed"

    @property
    def next_deadline_ns(self) -> int | None:
        """Return when `tick` is next due [ns]: heartbeat, overspeed, a key press or waiting frames; None for never."""
        due = [self._now_ns] if self._out else []
        if self.mode is SafetyMode.ACTIVE and self._traffic_ns is not None and not self.ignores_heartbeat:
            due.append(self._traffic_ns + self._heartbeat_ns)
        if self._fast_ns is not None:
            due.append(self._fast_ns + _SLOWS)
        if self._operator_due is not None:
            due.append(self._operator_due)
        return min(due, default=None)

    def power_up(self, now_ns: int) -> None:
        """Start the firmware at this time; mode, pendant and faults stay as they are."""
        self._now_ns = now_ns

    def listens(self, identifier: int) -> bool:
        """Return whether a frame is for this puck, or carries torques that it watches."""
        address = address_of(identifier)
        if address.group:
            return address.destination in (Group.LOWER, Group.UPPER)
        return address.destination == self.number

    def receive(self, frame: Frame, now_ns: int) -> list[Frame]:
        """Process a frame: watch its torques, set a property, or answer a GET; return the frames to send."""
        self._now_ns = now_ns
        if frame.error or frame.remote or frame.extended:
            return self._taken()
        if address_of(frame.identifier).group:
            self._watch_torques(frame.data, now_ns)
        elif (request := request_of(frame.data)) is not None:
            name = self._properties.name(request.number)
            asleep = self._values["STAT"] == Status.RESET
            if name is None or (asleep and name not in ("VERS", "ROLE", "SN", "ID", "ERROR", "STAT")):
                return self._taken()
            if request.value is None:
                value, wide = self._value(name), self._properties.is_wide(name)
                return [*self._taken(), reply_frame(self.number, request.number, value, wide=wide)]
            self._set(name, request.value, now_ns)
        return self._taken()

    def tick(self, now_ns: int) -> list[Frame]:
        """Process a missed heartbeat, lasting overspeed or a key press that is due; return the frames to send."""
        self._now_ns = now_ns
        silent = self._traffic_ns is not None and now_ns - self._traffic_ns >= self._heartbeat_ns
        if self.mode is SafetyMode.ACTIVE and silent and not self.ignores_heartbeat:
            self._fault("heartbeat", now_ns)
        if self._fast_ns is not None and now_ns - self._fast_ns >= _SLOWS:
            self._fast_ns = None
            self._fault("velocity", now_ns)
            self._enter(SafetyMode.ESTOP, now_ns)
        if self._operator_due is not None and now_ns >= self._operator_due:
            if self._faults:
                self.press("idle", now_ns)
            self.press("activate", now_ns)
            self._asked_ns = now_ns
        return self._taken()

    def press(self, key: str, now_ns: int) -> None:
        """Press a pendant key: `idle` clears faults, `activate` needs IDLE and no fault; neither works in an e-stop."""
        self._now_ns = now_ns
        if self._pressed:
            return
        if key == "idle":
            self._faults.clear()
            self._fast_ns = None
            self._enter(SafetyMode.IDLE, now_ns)
        elif key == "activate" and self.mode is SafetyMode.IDLE and not self._faults:
            self._traffic_ns = now_ns
            self.lowered_by_host = False
            self._enter(SafetyMode.ACTIVE, now_ns)

    def emergency_stop(self, pressed: bool, now_ns: int) -> None:
        """Press or release the emergency stop; once released, the mode ESTOP lasts until the key `idle` is pressed."""
        self._now_ns = now_ns
        if pressed and not self._pressed:
            self._fault("e-stop", now_ns)
            self._enter(SafetyMode.ESTOP, now_ns)
        self._pressed = pressed

    def set_low_supply(self, is_low: bool) -> None:
        """Begin or end a supply voltage that is low enough for a warning."""
        self._low_supply = is_low

    def watch_position(self, puck_index: int, counts: int, now_ns: int) -> None:
        """Count a motor puck's position as traffic, and check the speed once all have sent theirs."""
        self._traffic_ns = now_ns
        self._counts[puck_index] = counts
        if puck_index == len(self._counts) - 1 and None not in self._counts:
            self._watch_velocity([count for count in self._counts if count is not None], now_ns)

    @property
    def _operator_due(self) -> int | None:
        """Return when a person presses keys [ns]: torque frames stream, and nothing forbids it."""
        streams = self._now_ns - self._torques_ns < _STREAMS
        sound = self.mode is SafetyMode.IDLE and not self._pressed and set(self._faults) <= {"heartbeat"}
        if self._operator_ns is None or not streams or not sound:
            return None
        return self._asked_ns + self._operator_ns

    @property
    def _pendant(self) -> Pendant:
        warnings = (*self._warnings, *(("voltage",) if self._low_supply else ()))
        return Pendant(
            tuple(one for one in warnings if one not in self._faults),
            tuple(self._faults),
            "e-stop" if self._pressed else "none",
            activate_light=self.mode is SafetyMode.ACTIVE,
            idle_light=self.mode is SafetyMode.IDLE,
            digit="E" if self.mode is SafetyMode.ESTOP else "0",
        )

    def _value(self, name: str) -> int:
        if name == "MODE":
            return self.mode
        if name == "PEN":
            return pendant_value(self._pendant)
        return self._values.get(name, 0)

    def _set(self, name: str, value: int, now_ns: int) -> None:
        if name == "MODE":
            if value <= self.mode and value in (SafetyMode.IDLE, SafetyMode.ESTOP):  # the host may only lower
                self.lowered_by_host = True
                self._torques_ns = now_ns - _STREAMS  # nobody asks any more for the arm to be activated
                self._enter(SafetyMode(value), now_ns)
            return
        if name == "ZERO" and value != self._values["ZERO"]:
            self._before = None
        if name in self._values and name not in ("VERS", "ROLE", "SN", "ID"):
            self._values[name] = value

    def _enter(self, mode: SafetyMode, now_ns: int) -> None:
        if mode is self.mode:
            return
        self.mode = mode
        motors = Mode.TORQUE if mode is SafetyMode.ACTIVE else Mode.IDLE
        for set_mode in self._motors:
            set_mode(motors, now_ns)
        self._out.append(set_frame(Group.ALL, self._properties.number("MODE"), motors, group=True, sender=self.number))

    def _fault(self, cause: str, now_ns: int) -> None:
        if cause not in self._faults:
            self._faults.append(cause)
        if self.mode is SafetyMode.ACTIVE:
            self.lowered_by_host = False
            self._asked_ns = now_ns  # whoever is at the pendant sees it first
            self._enter(SafetyMode.IDLE, now_ns)

    def _watch_torques(self, data: bytes, now_ns: int) -> None:
        if (found := torques_of(data)) is None:
            return
        self._traffic_ns = now_ns
        if now_ns - self._torques_ns >= _STREAMS or self.mode is not SafetyMode.IDLE:
            self._asked_ns = now_ns
        self._torques_ns = now_ns
        most = max(map(abs, found[1]))
        self._warn("torque", most > self._values["TL1"])
        if self._values["TL2"] and most > self._values["TL2"]:
            self._fault("torque", now_ns)

    def _watch_velocity(self, counts: Sequence[int], now_ns: int) -> None:
        joints, points = self._points(counts)
        before, self._before = self._before, (now_ns, joints, points)
        if before is None or not 0 < now_ns - before[0] <= _LONGEST:
            return
        seconds = (now_ns - before[0]) * 1e-9
        if self._values["ZERO"]:
            fastest = float(np.linalg.norm(points - before[2], axis=1).max()) / seconds
            fault, warning = self._values["VL2"] / _UNIT, self._values["VL1"] / _UNIT
            if self._velocity is not None:
                fault = warning = self._velocity
        else:
            fastest, fault = float(np.abs(joints - before[1]).max()) / seconds, _JOINT_SPEED
            warning = fault
        self._warn("velocity", fastest > warning)
        if not fault or fastest <= fault:
            self._fast_ns = None
        elif self._values["IFAULT"] > 0:
            self._values["IFAULT"] -= 1
        else:
            if self.mode is SafetyMode.ACTIVE:
                self._fast_ns = now_ns
            self._fault("velocity", now_ns)

    def _warn(self, cause: str, on: bool) -> None:
        if on != (cause in self._warnings):
            self._warnings = [one for one in self._warnings if one != cause] + ([cause] if on else [])

    def _taken(self) -> list[Frame]:
        out, self._out = self._out, []
        return out
