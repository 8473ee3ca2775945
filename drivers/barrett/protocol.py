"""Encode and decode the frames of Barrett's pucks, and know their properties by firmware version and role.

Identifier `G FFFFF TTTTT`: G says that the destination T is a group, F is the sender (the host is 0). Data of a GET is
one byte, the property; of a SET, and of the reply to a GET, the property with its highest bit set, a zero, the value
in 2 or 4 bytes, little-endian. Two kinds of frames are packed, big-endian, and know no property by name: positions (to
group 3) are two's complement of 22 bits, torques (to groups 1 and 2) four times 14 bits without gaps.

Sources: libbarrett (`property_list.cpp`, `motor_puck.cpp`), Barrett's wiki and manual, OWD and btclient, as gathered in
docs/wam.md. There is no I/O here. Decoders take any bytes and return None for what is none of theirs.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, NamedTuple

from drivers.can.can_frame import Frame
from ident_service.errors import DriverError

HOST: Final = 0
_GROUP, _SENDER, _DESTINATION = 0x400, 0x3E0, 0x01F
_SET = 0x80
POSITION_BITS: Final = 22
_TORQUE_BITS, _SLOTS = 14, 4
MOST_TORQUE: Final = (1 << _TORQUE_BITS - 1) - 1  # 8191 counts; -8192 has no opposite
LEAST_TORQUE: Final = -MOST_TORQUE - 1


class Group(IntEnum):
    """Name the groups of pucks that one frame reaches."""

    ALL = 0  # all but the safety puck
    LOWER = 1  # torques of pucks 1 to 4
    UPPER = 2  # torques of pucks 5 to 7
    POSITIONS = 3  # what pucks answer to a GET of their position
    ARM = 4  # pucks 1 to 7
    PROPERTIES = 6  # what pucks answer to any other GET
    ENCODERS = 7  # joint encoders, of firmware that sends them apart


class Status(IntEnum):
    """Name the values of STAT."""

    RESET = 0  # in its monitor: properties 0 to 10 only
    ERROR = 1
    READY = 2


class Mode(IntEnum):
    """Name the values of MODE of a motor puck that matter to a WAM."""

    IDLE = 0  # windings shorted: it brakes, torque is ignored
    TORQUE = 2


class SafetyMode(IntEnum):
    """Name the values of MODE of the safety puck."""

    ESTOP = 0
    IDLE = 1
    ACTIVE = 2


class Role(IntEnum):
    """Name the roles that matter here, the lowest five bits of ROLE."""

    MOTOR = 0
    SAFETY = 2
    WRAPTOR = 3
    HAND = 5


ROLE_MASK: Final = 0x1F
ABSOLUTE_ENCODER: Final = 0x0100  # option bit of ROLE: a serial magnetic encoder, which knows its angle within a turn
ABSOLUTE_SINCE: Final = 118  # firmware that uses it
_MOTORS = (Role.MOTOR, Role.WRAPTOR, Role.HAND)

# In every firmware and role; in the monitor (STAT 0) there are only these, with LOCK, SAVE and LOAD as 8, 9 and 10.
_FIXED = {"VERS": 0, "ROLE": 1, "SN": 2, "ID": 3, "ERROR": 4, "STAT": 5, "ADDR": 6, "VALUE": 7, "MODE": 8}
MONITOR: Final = range(8)

# First version of the firmware from which on a property has a number, for motor pucks.
_HISTORY: dict[str, tuple[tuple[int, int], ...]] = {
    "T": ((32, 10), (50, 9), (61, 42)),
    "P": ((32, 26), (61, 48)),
    "MT": ((32, 16), (61, 43)),
    "V": ((32, 12), (50, 10), (61, 44), (114, 106), (119, 44)),
    "CTS": ((32, 30), (61, 65), (64, 66), (65, 68)),
    "MECH": ((32, 28), (61, 63), (64, 64), (65, 66)),
    "IPNM": ((33, 57), (36, 108), (61, 83), (65, 86)),
    "HALLS": ((44, 109), (61, 84), (64, 86), (65, 89), (68, 87)),
    "HALLH": ((44, 110), (61, 85), (64, 84), (65, 87), (68, 88)),
    "POLES": ((44, 112), (61, 87), (65, 90)),
    "GRPA": ((32, 51), (61, 26)),
    "GRPB": ((32, 52), (61, 27)),
    "GRPC": ((32, 53), (61, 28)),
    "PIDX": ((32, 54), (61, 67), (64, 68), (65, 70)),
    "JIDX": ((33, 55), (36, 107), (61, 82), (65, 85)),
    "MOFST": ((32, 20), (61, 58), (64, 59), (65, 61)),
    "IOFST": ((32, 21), (61, 59), (64, 60), (65, 62)),
    "KP": ((32, 65), (33, 67), (36, 65), (61, 76), (65, 79)),
    "TSTOP": ((32, 64), (33, 66), (36, 64), (61, 75), (65, 78)),
    "ACCEL": ((32, 69), (33, 71), (36, 69), (61, 79), (65, 82)),
    "OT": ((32, 34), (61, 54)),
    "TEMP": ((32, 39), (61, 9)),
    "OTEMP": ((32, 40), (61, 11)),
    "THERM": ((32, 46), (61, 20)),
    "VBUS": ((32, 47), (61, 21)),
    "SAVE": ((32, 87), (33, 89), (36, 87), (61, 30)),
    "LOAD": ((32, 88), (33, 90), (36, 88), (61, 31)),
    "DEF": ((32, 89), (33, 91), (36, 89), (61, 32)),
    "ECMAX": ((44, 113), (61, 91), (65, 96), (125, 100), (132, 101)),
    "ECMIN": ((44, 114), (61, 92), (65, 97), (125, 101), (132, 102)),
    "EN": ((32, 63), (33, 65), (36, 63), (61, 74), (65, 77), (132, 94)),
    "HOLD": ((65, 94), (132, 77)),
    "JP": ((125, 96),),
    "TIE": ((65, 95), (132, 100)),
}
# The safety puck's own, before version 61 and since; versions 33 to 35 have the old ones two later, ZERO one later.
_SAFETY_OLD = {
    "ZERO": 55,
    "PEN": 85,
    "SAFE": 86,
    "VL1": 90,
    "VL2": 91,
    "TL1": 92,
    "TL2": 93,
    "VOLTL1": 94,
    "VOLTL2": 95,
    "VOLTH1": 96,
    "VOLTH2": 97,
    "MAXPWR": 98,
    "PWR": 99,
    "IFAULT": 100,
    "VNOM": 104,
}
_SAFETY_NEW = {
    "ZERO": 42,
    "PEN": 43,
    "SAFE": 44,
    "VL1": 45,
    "VL2": 46,
    "TL1": 47,
    "TL2": 48,
    "VOLTL1": 49,
    "VOLTL2": 50,
    "VOLTH1": 51,
    "VOLTH2": 52,
    "PWR": 53,
    "MAXPWR": 54,
    "IFAULT": 55,
    "VNOM": 56,
}
# Those of a motor puck that a safety puck has as well, at the same numbers.
_COMMON = ("GRPA", "GRPB", "GRPC", "TEMP", "OTEMP", "THERM", "VBUS", "SAVE", "LOAD", "DEF")
# Values of 32 bits; all others have 16.
_WIDE = frozenset({"P", "E", "MECH", "CTS", "DP", "OT", "CT", "HALLH", "M", "IOFF", "EN", "JP", "JOFST", "PEN"})
OLDEST: Final = 32


class Properties:
    """Map the names of a puck's properties to their numbers.

    Attributes:
        version: version of its firmware (VERS).
        role: role of the puck (ROLE), without option bits.
    """

    def __init__(self, version: int, role: int) -> None:
        """Choose the table of a firmware version and a role.

        Raises:
            DriverError: firmware older than any table.
        """
        if version < OLDEST:
            raise DriverError(f"firmware {version} is older than {OLDEST}, the oldest whose properties are known")
        self.version, self.role = version, role & ROLE_MASK
        numbers = dict(_FIXED)
        is_motor, is_safety = self.role in _MOTORS, self.role == Role.SAFETY
        for name, history in _HISTORY.items():
            place = bisect_right(history, version, key=lambda entry: entry[0]) - 1
            if place >= 0 and (is_motor or (is_safety and name in _COMMON)):
                numbers[name] = history[place][1]
        if is_safety:
            later = 2 if 33 <= version <= 35 else 0
            old = {name: number + later for name, number in _SAFETY_OLD.items()}
            old["ZERO"] = 56 if later else 55
            numbers |= _SAFETY_NEW if version >= 61 else old
        self._numbers = numbers
        self._names = {number: name for name, number in numbers.items()}

    def __contains__(self, name: str) -> bool:
        return name in self._numbers

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of all known properties."""
        return tuple(self._numbers)

    def number(self, name: str) -> int:
        """Return a property's number; raises DriverError for one that this firmware does not have."""
        try:
            return self._numbers[name]
        except KeyError:
            raise DriverError(f"firmware {self.version} in role {self.role} has no property {name}") from None

    def name(self, number: int) -> str | None:
        """Return the name of the property of a number; None for an unknown one."""
        return self._names.get(number)

    @staticmethod
    def is_wide(name: str) -> bool:
        """Return whether values of this property have 32 bits, not 16."""
        return name in _WIDE


class Address(NamedTuple):
    """Hold the parts of an identifier: sender, destination, and whether that is a group."""

    sender: int
    destination: int
    group: bool

    @property
    def identifier(self) -> int:
        """Return the identifier of a frame with this address."""
        return (_GROUP if self.group else 0) | self.sender << 5 | self.destination


def address_of(identifier: int) -> Address:
    """Return the address in an identifier of 11 bits."""
    return Address((identifier & _SENDER) >> 5, identifier & _DESTINATION, bool(identifier & _GROUP))


@dataclass(frozen=True, slots=True)
class Request:
    """Represent a GET (`value` None) or a SET of a property's number."""

    number: int
    value: int | None = None


@dataclass(frozen=True, slots=True)
class Reply:
    """Represent a puck's answer to a GET."""

    node: int
    number: int
    value: int


@dataclass(frozen=True, slots=True)
class Position:
    """Represent a puck's position, and its joint encoder's where it has one [counts of 22 bits, signed]."""

    node: int
    counts: int
    encoder: int | None = None


def get_frame(destination: int, property_number: int, *, group: bool = False) -> Frame:
    """Return the frame that asks a puck, or a group of pucks, for a property."""
    return Frame(Address(HOST, destination, group).identifier, bytes([property_number & 0x7F]))


def set_frame(destination: int, property_number: int, value: int, *, group: bool = False, sender: int = HOST) -> Frame:
    """Return the frame that sets a property, always of 6 bytes, as libbarrett and OWD send; DriverError beyond 32 bits.

    Raises:
        DriverError: a value that 32 bits do not hold.
    """
    if not -(1 << 31) <= value < 1 << 31:
        raise DriverError(f"property {property_number}: {value} does not fit 32 bits")
    data = bytes([_SET | property_number & 0x7F, 0]) + value.to_bytes(4, "little", signed=True)
    return Frame(Address(sender, destination, group).identifier, data)


def reply_frame(node: int, property_number: int, value: int, *, wide: bool) -> Frame:
    """Return the frame by which a puck answers a GET: 6 bytes for a value of 32 bits, else 4."""
    size = 4 if wide else 2
    bits = value & (1 << 8 * size) - 1
    data = bytes([_SET | property_number & 0x7F, 0]) + bits.to_bytes(size, "little")
    return Frame(Address(node, Group.PROPERTIES, group=True).identifier, data)


def request_of(data: bytes) -> Request | None:
    """Return the GET or SET in a frame's data; None where it is neither."""
    if len(data) == 1:
        return Request(data[0] & 0x7F)
    if len(data) in (4, 6) and data[0] & _SET:
        return Request(data[0] & 0x7F, int.from_bytes(data[2:], "little", signed=True))
    return None


def decoded(frame: Frame) -> Reply | Position | None:
    """Decode a puck's frame: its reply to a GET or its position; None for any other frame."""
    if frame.error or frame.remote or frame.extended:
        return None
    address, data = address_of(frame.identifier), frame.data
    if not address.group or address.sender == HOST:
        return None
    if address.destination == Group.PROPERTIES:
        found = request_of(data)
        if found is None or found.value is None or data[1] != 0:
            return None
        return Reply(address.sender, found.number, found.value)
    if address.destination == Group.POSITIONS and len(data) in (3, 6):
        return Position(address.sender, _position(data[:3]), _position(data[3:]) if len(data) == 6 else None)
    return None


def position_frame(node: int, counts: int, encoder: int | None = None) -> Frame:
    """Return the frame by which a puck tells its position, and its joint encoder's [counts]; 22 bits of each go out."""
    data = _packed_position(counts) + (b"" if encoder is None else _packed_position(encoder))
    return Frame(Address(node, Group.POSITIONS, group=True).identifier, data)


def _packed_position(counts: int) -> bytes:
    return (counts & (1 << POSITION_BITS) - 1).to_bytes(3, "big")


def _position(data: bytes) -> int:
    bits = int.from_bytes(data, "big") & (1 << POSITION_BITS) - 1  # of the first byte, two bits are not the position's
    return bits - (1 << POSITION_BITS) if bits >> POSITION_BITS - 1 else bits


def torque_frame(group_number: int, property_number: int, counts: Sequence[int]) -> Frame:
    """Return the frame that carries up to four torques to a group.

    Args:
        group_number: `Group.LOWER` or `Group.UPPER`.
        property_number: number of the property T in the pucks' firmware, the same in all of them.
        counts: torque of the pucks by their slots (PIDX); slots that are left out get zero.

    Raises:
        DriverError: too many torques, or one that 14 bits do not hold: nothing is to be sent then.
    """
    if len(counts) > _SLOTS or not all(LEAST_TORQUE <= count <= MOST_TORQUE for count in counts):
        raise DriverError(f"torques {list(counts)} do not fit four times 14 bits")
    packed = 0
    for slot in range(_SLOTS):
        count = counts[slot] if slot < len(counts) else 0
        packed = packed << _TORQUE_BITS | count & (1 << _TORQUE_BITS) - 1
    data = bytes([_SET | property_number & 0x7F]) + packed.to_bytes(7, "big")
    return Frame(Address(HOST, group_number, group=True).identifier, data)


def torques_of(data: bytes) -> tuple[int, tuple[int, int, int, int]] | None:
    """Return the property's number and the four torques in a frame's data; None where it has none."""
    if len(data) != 8 or not data[0] & _SET:
        return None
    packed, half = int.from_bytes(data[1:], "big"), 1 << _TORQUE_BITS - 1
    bits = [packed >> _TORQUE_BITS * (_SLOTS - 1 - slot) & 2 * half - 1 for slot in range(_SLOTS)]
    first, second, third, fourth = ((one + half) % (2 * half) - half for one in bits)
    return data[0] & 0x7F, (first, second, third, fourth)


# The safety puck's PEN: from its lowest bits on a field of three bits a cause, one of safe, warning and fault.
_CAUSES = ("velocity", "torque", "voltage", "heartbeat", "e-stop")
_BUTTONS = {0b11: "none", 0b10: "idle", 0b01: "activate", 0b00: "e-stop"}
_SEGMENTS = {0x3F: "0", 0x06: "1", 0x5B: "2", 0x4F: "3", 0x66: "4", 0x6D: "5", 0x7D: "6", 0x07: "7"} | {
    0x77: "A",
    0x79: "E",
    0x76: "H",
    0x38: "L",
}
_ACTIVATE_LIGHT, _IDLE_LIGHT = 25, 24
_SAFE, _WARNS, _FAULT = 1, 2, 4


@dataclass(frozen=True)
class Pendant:
    """Represent what the pendant shows.

    Attributes:
        warnings: causes that are close to their limits.
        faults: causes that took the arm out of ACTIVE.
        button: button that is pressed.
        activate_light: whether the light of Activate is on.
        idle_light: whether the light of Idle is on.
        digit: digit on its display; empty for an unknown one.
    """

    warnings: tuple[str, ...] = ()
    faults: tuple[str, ...] = ()
    button: str = "none"
    activate_light: bool = False
    idle_light: bool = False
    digit: str = ""

    def __str__(self) -> str:
        told = [*(f"{cause} fault" for cause in self.faults), *(f"{cause} warning" for cause in self.warnings)]
        return ", ".join(told) or "no fault"


def pendant_of(value: int) -> Pendant:
    """Decode what the pendant shows, its warnings, faults and lights, from the safety puck's PEN, 32 bits."""
    fields = [(cause, value >> 3 * place & 0b111) for place, cause in enumerate(_CAUSES)]
    return Pendant(
        tuple(cause for cause, bits in fields if bits & _WARNS),
        tuple(cause for cause, bits in fields if bits & _FAULT),
        _BUTTONS[value >> 26 & 0b11],
        bool(value >> _ACTIVATE_LIGHT & 1),
        bool(value >> _IDLE_LIGHT & 1),
        _SEGMENTS.get(value >> 16 & 0xFF, ""),
    )


def pendant_value(pendant: Pendant) -> int:
    """Encode what a pendant shows as the safety puck's PEN; the inverse of `pendant_of`."""
    value = 0
    for place, cause in enumerate(_CAUSES):
        shown = _FAULT if cause in pendant.faults else _WARNS if cause in pendant.warnings else _SAFE
        value |= shown << 3 * place
    value |= next(code for code, name in _BUTTONS.items() if name == pendant.button) << 26
    value |= pendant.activate_light << _ACTIVATE_LIGHT | pendant.idle_light << _IDLE_LIGHT
    return value | next((code for code, digit in _SEGMENTS.items() if digit == pendant.digit), 0) << 16
