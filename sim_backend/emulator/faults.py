"""Define faults to inject into emulated drives: their kinds, notation, and times.

`PUCK_FAULTS` says what each kind does. Where the simulated arm has a kind too, it is of the same name and means the
same, seen through a bus.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from ident_service.config.simulation import FAULT_RULES, FaultRule, SimulatedFault
from ident_service.errors import DriverError

# Without a time of its own, a fault of one cycle lasts for one nominal period.
PUCK_FAULTS: dict[str, FaultRule] = {
    "lost_feedback": FaultRule("position frames do not come"),
    "delayed_feedback": FaultRule("position frames come late", "delay [s]", stays=True),
    "hidden_delay": FaultRule("old positions, as if they were fresh", "delay [s]", stays=True),
    "encoder_jump": FaultRule("size added to the position", "[rad or m at the joint]"),
    "encoder_offset": FaultRule("size added to the position for good", "[rad or m at the joint]", stays=True),
    "frozen_encoder": FaultRule("the last position again, as if it were fresh"),
    "position_sign": FaultRule("the encoder counts the wrong way", stays=True),
    "stuck_torque": FaultRule("the power stage goes on with what it does"),
    "torque_sign": FaultRule("the opposite torque acts, and the drive does not say so", stays=True),
    "torque_saturation": FaultRule("torque held below the limit; the drive says so", "share of the limit", stays=True),
    "torque_fraction": FaultRule(
        "this share of what it is told; only the torque that it measures says so", "share of the torque", stays=True
    ),
    "drive_fault": FaultRule("the power stage fails: emergency message, fault, the motor coasts", stays=True),
    "node_silent": FaultRule("no frames, and no power for the motor; the node boots when the fault ends", stays=True),
    "emergency_stop": FaultRule("the motors' power is taken", of_joint=False, stays=True),
    "load_attached": FaultRule("a point mass on the last link", "mass [kg]", of_joint=False, stays=True),
    "bus_gone": FaultRule("no frame gets through, in either direction", of_joint=False, stays=True),
    # Only drives on a bus can have these.
    "emergency": FaultRule("emergency message and the drive's own fault reaction", "error code, such as 0x4310"),
    "warning": FaultRule("the warning bit of the status", stays=True),
    "watchdog_ignored": FaultRule("it goes on, although its host is gone", stays=True),
    "heartbeat_lost": FaultRule("no heartbeat, while everything else goes on", stays=True),
    "reboot": FaultRule("the node's firmware starts again"),
    "wrong_node": FaultRule("a second node sends position frames under the same identifier", stays=True),
    "short_frame": FaultRule("position frames lack their last byte"),
    "bus_off": FaultRule("the host hears of bus-off, no frame gets through", of_joint=False, stays=True),
    "error_passive": FaultRule("the host's controller tells of error passive", of_joint=False),
}
_NO_COUNTERPART = {
    "nan_position": "an encoder's count is always a number",
    "late_cycle": "the cycle is the host's own; delay feedback instead",
    "clock_jump": "the clock is the host's own",
}
_KEYS = ("joint", "at", "duration", "size", "offset")
_LARGEST_CODE = 0xFFFF


@dataclass(frozen=True)
class PuckFault:
    """Describe one fault to inject.

    Attributes:
        kind: a key of `PUCK_FAULTS`.
        drive: index of the drive; None for all.
        at: its beginning, from the moment it is counted from [s].
        duration: how long [s]; None for one cycle or for good, as `PUCK_FAULTS` says.
        size: quantity that `PUCK_FAULTS` defines.
        offset: of a load, in the frame of the last link [m].
    """

    kind: str
    drive: int | None = None
    at: float = 0.0
    duration: float | None = None
    size: float = 0.0
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def window(self, start_ns: int, period_ns: int) -> tuple[int, int | None]:
        """Return the first and last moment of the fault [ns]; None where it stays.

        Args:
            start_ns: moment that `at` counts from.
            period_ns: of a nominal cycle.
        """
        begins = start_ns + round(self.at * 1e9)
        if self.duration is not None:
            return begins, begins + max(1, round(self.duration * 1e9))
        return begins, None if PUCK_FAULTS[self.kind].stays else begins + period_ns


def configured(faults: Sequence[SimulatedFault], names: Sequence[str], period: float) -> tuple[PuckFault, ...]:
    """Convert the faults of a configuration.

    Args:
        faults: of the section `driver.emulation`.
        names: of the joints.
        period: of the control loop [s], by which faults given by cycle are timed.

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
        found.append(PuckFault(kind, drive, at, fault.duration, fault.size or 0.0, fault.offset or (0.0, 0.0, 0.0)))
    return tuple(found)


def parse_fault(text: str, names: Sequence[str]) -> PuckFault:
    """Parse a fault as people write it: `KIND [joint=NAME] [at=S] [duration=S] [size=X] [offset=X,Y,Z]`.

    Args:
        text: the words.
        names: of the joints.

    Raises:
        DriverError: what is wrong with it, and what would be right.
    """
    kind, *words = text.split()[:16] or [""]
    rule = PUCK_FAULTS.get(kind)
    if rule is None:
        raise DriverError(f"no fault is called {kind!r}; there are {', '.join(PUCK_FAULTS)}")
    fault = PuckFault(kind)
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
            fault = PuckFault(
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


def _check_range(fault: PuckFault) -> None:
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
