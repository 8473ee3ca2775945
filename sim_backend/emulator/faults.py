"""Inject faults into emulated drives: kinds, how they are written, and what each does to drives, arm and frames.

`DRIVE_FAULTS` says what each kind does. Where the simulated arm has a kind too, it is of the same name and means the
same, seen through a bus.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from drivers.can.can_frame import Frame
from ident_service.config.simulation import FAULT_RULES, FaultRule, SimulatedFault
from ident_service.errors import DriverError
from sim_backend.emulator.body import Body
from sim_backend.emulator.face import EmulatedDevice, Traffic
from sim_backend.emulator.motor import Defects

# Without a time of its own, a fault of one cycle lasts for one nominal period.
DRIVE_FAULTS: dict[str, FaultRule] = {
    "lost_feedback": FaultRule("position frames do not come"),
    "delayed_feedback": FaultRule("position frames come late", "delay [s]", stays=True),
    "hidden_delay": FaultRule("old positions are sent as new", "delay [s]", stays=True),
    "encoder_jump": FaultRule("size added to the position", "[rad or m at the joint]"),
    "encoder_offset": FaultRule("size added to the position for good", "[rad or m at the joint]", stays=True),
    "frozen_encoder": FaultRule("the last position is sent again as new"),
    "position_sign": FaultRule("the encoder counts the wrong way", stays=True),
    "stuck_torque": FaultRule("the power stage goes on with what it does"),
    "torque_sign": FaultRule("the opposite torque acts, and the drive does not say so", stays=True),
    "torque_saturation": FaultRule("torque held below the limit; the drive says so", "share of the limit", stays=True),
    "torque_fraction": FaultRule(
        "this share of the commanded torque acts; only the measured torque shows it", "share of the torque", stays=True
    ),
    "drive_fault": FaultRule("the power stage fails: emergency message, fault, the motor coasts", stays=True),
    "node_silent": FaultRule("no frames, and no power for the motor; the node boots when the fault ends", stays=True),
    "emergency_stop": FaultRule("the motors' power is taken", of_joint=False, stays=True),
    "load_attached": FaultRule("a point mass on the last link", "mass [kg]", of_joint=False, stays=True),
    "bus_gone": FaultRule("no frame gets through, in either direction", of_joint=False, stays=True),
    # Only drives on a bus can have these.
    "emergency": FaultRule("emergency message and the drive's own fault reaction", "error code, such as 0x4310"),
    "warning": FaultRule("the warning bit of the status", stays=True),
    "watchdog_ignored": FaultRule("it goes on although its host is gone", stays=True),
    "heartbeat_lost": FaultRule("no heartbeat, while everything else goes on", stays=True),
    "reboot": FaultRule("the node's firmware starts again"),
    "wrong_node": FaultRule("a second node sends position frames under the same identifier", stays=True),
    "short_frame": FaultRule("position frames lack their last byte"),
    "bus_off": FaultRule("the host's controller reports bus-off, no frame gets through", of_joint=False, stays=True),
    "error_passive": FaultRule("the host's controller reports error passive", of_joint=False),
}
_NO_COUNTERPART = {
    "nan_position": "an encoder's count is always a number",
    "late_cycle": "the cycle is the host's own; delay feedback instead",
    "clock_jump": "the clock is the host's own",
}
_KEYS = ("joint", "at", "duration", "size", "offset")
_LARGEST_CODE = 0xFFFF


@dataclass(frozen=True)
class DriveFault:
    """Describe one fault to inject.

    Attributes:
        kind: a key of `DRIVE_FAULTS`.
        drive: index of the drive; None for all.
        at: beginning of the fault, from the moment it is counted from [s].
        duration: duration of the fault [s]; None for one cycle or for good, as `DRIVE_FAULTS` says.
        size: quantity that `DRIVE_FAULTS` defines.
        offset: offset of a load, in the frame of the last link [m].
    """

    kind: str
    drive: int | None = None
    at: float = 0.0
    duration: float | None = None
    size: float = 0.0
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def window(self, start_ns: int, period_ns: int) -> tuple[int, int | None]:
        """Return when the fault, counted from `start_ns`, begins and ends [ns]; the end is None where it stays.

        Args:
            start_ns: moment that `at` counts from.
            period_ns: of a nominal cycle.
        """
        begins = start_ns + round(self.at * 1e9)
        if self.duration is not None:
            return begins, begins + max(1, round(self.duration * 1e9))
        return begins, None if DRIVE_FAULTS[self.kind].stays else begins + period_ns


def configured(faults: Sequence[SimulatedFault], names: Sequence[str], period: float) -> tuple[DriveFault, ...]:
    """Convert a configuration's faults to drive faults; DriverError for an unknown joint or an unsuitable kind.

    Args:
        faults: faults of the section `driver.emulation`.
        names: of the joints.
        period: period of the control loop [s], by which faults given by cycle are timed.

    Raises:
        DriverError: a kind that drives on a bus cannot have, or a joint that the arm does not have.
    """
    found = []
    for fault in faults:
        kind = fault.kind.value
        if kind in _NO_COUNTERPART:
            raise DriverError(f"driver.emulation.faults: {kind}: {_NO_COUNTERPART[kind]}")
        at = fault.at if fault.at is not None else (fault.cycle or 0) * period
        drive = None if fault.joint is None else _joint(fault.joint, names)
        found.append(DriveFault(kind, drive, at, fault.duration, fault.size or 0.0, fault.offset or (0.0, 0.0, 0.0)))
    return tuple(found)


def parse_fault(text: str, names: Sequence[str]) -> DriveFault:
    """Parse a fault, `KIND [joint=NAME] [at=S] [duration=S] [size=X] [offset=X,Y,Z]`; DriverError for a wrong one.

    Args:
        text: the words.
        names: of the joints.

    Raises:
        DriverError: what is wrong with it, and what would be right.
    """
    kind, *words = text.split()[:16] or [""]
    rule = DRIVE_FAULTS.get(kind)
    if rule is None:
        raise DriverError(f"no fault is called {kind!r}; there are {', '.join(DRIVE_FAULTS)}")
    fault = DriveFault(kind)
    given = set()
    for word in words:
        key, equals, value = word.partition("=")
        if not equals or key not in _KEYS or key in given:
            raise DriverError(f"{kind}: {word!r} is not one of {', '.join(f'{key}=' for key in _KEYS)}, each once")
        given.add(key)
        if key == "joint":
            fault = replace(fault, drive=_joint(value, names))
        elif key == "offset":
            parts = [_number(kind, key, part) for part in value.split(",")]
            if len(parts) != 3:
                raise DriverError(f"{kind}: an offset has three numbers, such as 0,0,0.1, not {value}")
            fault = replace(fault, offset=(parts[0], parts[1], parts[2]))
        else:
            number = _number(kind, key, value)
            fault = DriveFault(
                kind,
                fault.drive,
                number if key == "at" else fault.at,
                number if key == "duration" else fault.duration,
                number if key == "size" else fault.size,
                fault.offset,
            )
    if (rule.size is not None) != ("size" in given):
        raise DriverError(f"{kind} needs size=: {rule.size}" if rule.size else f"{kind} has no size")
    if fault.drive is not None and not rule.of_joint:
        raise DriverError(f"{kind} strikes the whole arm; it has no joint")
    if "offset" in given and kind != "load_attached":
        raise DriverError(f"{kind} has no offset")
    _check_range(fault)
    return fault


def _check_range(fault: DriveFault) -> None:
    if fault.at < 0.0 or (fault.duration is not None and fault.duration <= 0.0):
        raise DriverError(f"{fault.kind}: at must not be negative, and duration must be above 0")
    same = {kind.value for kind in FAULT_RULES}
    one_sided = (fault.kind in same and fault.kind not in ("encoder_jump", "encoder_offset")) or "torque" in fault.kind
    if one_sided and fault.size < 0.0:
        raise DriverError(f"{fault.kind}: size {fault.size:g} is negative")
    if fault.kind in ("torque_saturation", "torque_fraction") and fault.size > 1.0:
        raise DriverError(f"{fault.kind}: size {fault.size:g} is above 1; it is a share")
    if fault.kind == "emergency" and not (fault.size.is_integer() and 1 <= fault.size <= _LARGEST_CODE):
        raise DriverError(f"emergency: an error code is from 0x0001 to 0xFFFF, not {fault.size:g}")


def _joint(name: str, names: Sequence[str]) -> int:
    if name not in names:
        raise DriverError(f"joint {name!r} is none of {', '.join(names)}")
    return list(names).index(name)


def _number(kind: str, key: str, value: str) -> float:
    try:
        number = float(int(value, 16)) if value.lower().startswith("0x") else float(value)
    except ValueError:
        number = float("nan")
    if not abs(number) < 1e9:
        raise DriverError(f"{kind}: {key}={value} is not a number")
    return number


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
        frame: frame to be sent.
        ready_ns: time when its node wants to send it [ns].
    """

    bus: int
    drive: int | None
    frame: Frame
    ready_ns: int


class Injection:
    """Hold the faults that act at present, and apply them.

    Attributes:
        active: active faults, in the order in which they came.
    """

    def __init__(self, body: Body, faces: Sequence[EmulatedDevice], buses: Sequence[int]) -> None:
        """Start without faults.

        Args:
            body: the arm.
            faces: the drives' protocol implementations, in the order of the motors.
            buses: index of each one's bus.
        """
        self._body, self._faces, self._buses = body, faces, buses
        self.active: list[DriveFault] = []
        self._dead: frozenset[int] = frozenset()

    @property
    def cut_off(self) -> bool:
        """Return whether a fault acts by which no frame of any drive gets through."""
        return any(fault.kind in _CUT_OFF for fault in self.active)

    def dead(self, drive: int) -> bool:
        """Return whether a fault has silenced this drive: it neither receives nor sends anything."""
        return drive in self._dead

    def begin(self, fault: DriveFault, now_ns: int) -> list[Sent]:
        """Begin a fault; returns the frames that the drives send because of it."""
        self.active.append(fault)
        return self._changed(fault, now_ns, begins=True)

    def end(self, fault: DriveFault, now_ns: int) -> list[Sent]:
        """End a fault; returns the frames that the drives send because of it."""
        self.active.remove(fault)
        return self._changed(fault, now_ns, begins=False)

    def apply_to_frames(self, drive: int, frames: Sequence[Frame], now_ns: int) -> list[Sent]:
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
        traffic = self._faces[drive].traffic_kind(frame)
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

    def _changed(self, fault: DriveFault, now_ns: int, *, begins: bool) -> list[Sent]:
        drives = range(len(self._faces)) if fault.drive is None else range(fault.drive, fault.drive + 1)
        sent: list[Sent] = []
        match fault.kind:
            case "load_attached":
                self._body.advance_before_change(now_ns)
                self._body.plant.attach_loads(
                    tuple((f.size, f.offset) for f in self.active if f.kind == "load_attached")
                )
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
            sent += self.apply_to_frames(drive, frames, now_ns)
        return sent

    def _drive_changed(self, fault: DriveFault, drive: int, now_ns: int, *, begins: bool) -> list[Frame]:
        """Apply the immediate effect of a fault, or of its end, to a drive."""
        face = self._faces[drive]
        match fault.kind, begins:
            case "drive_fault", True:
                return face.fail(POWER_STAGE, now_ns, lasting=True)
            case "drive_fault", False:
                face.end_lasting_fault()
            case "emergency", True:
                return face.fail(int(fault.size), now_ns)
            case "emergency_stop", _:
                return face.switch_supply(not begins, now_ns)
            case "watchdog_ignored", _:
                face.ignore_watchdogs(begins)
            case "warning", _:
                return face.set_warning(begins, now_ns)
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
