"""Define the object dictionary entries that this driver reads and writes: index, type, unit.

From CiA 301 (communication, 1000h to 1FFFh) and CiA 402 (drives, 6000h to 67FFh).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from enum import Enum


class Kind(Enum):
    """Name the types of CiA 301, table 44, with their `struct` codes, little-endian."""

    I8 = "<b"
    I16 = "<h"
    I32 = "<i"
    U8 = "<B"
    U16 = "<H"
    U32 = "<I"

    @property
    def size(self) -> int:
        """Return the size of one value [bytes]."""
        return struct.calcsize(self.value)


@dataclass(frozen=True)
class Entry:
    """Represent one entry of an object dictionary.

    Attributes:
        index: 1000h to 9FFFh; below, the dummies of PDO mapping.
        sub: sub-index.
        kind: type of its value.
        name: name in words.
        unit: unit of the value; empty for codes and numbers.
    """

    index: int
    sub: int
    kind: Kind
    name: str
    unit: str = ""

    @property
    def mapping(self) -> int:
        """Return the word that maps the entry into a PDO: index, sub-index, bits (CiA 301, 1600h)."""
        return self.index << 16 | self.sub << 8 | 8 * self.kind.size

    @property
    def key(self) -> int:
        """Return index and sub-index in one number, `index << 8 | sub`."""
        return self.index << 8 | self.sub

    def at_sub_index(self, sub: int) -> Entry:
        """Return the same entry at another sub-index."""
        return replace(self, sub=sub)

    def pack(self, value: int) -> bytes:
        """Encode a value as bytes; raises ValueError where the type does not hold it."""
        try:
            return struct.pack(self.kind.value, value)
        except struct.error:
            raise ValueError(f"{self}: {value} is no {self.kind.name}") from None

    def unpack(self, data: bytes) -> int:
        """Decode a value from bytes; raises ValueError for another number of bytes than the type has."""
        if len(data) != self.kind.size:
            raise ValueError(f"{self}: {len(data)} bytes, but {self.kind.name} has {self.kind.size}")
        value: int = struct.unpack(self.kind.value, data)[0]
        return value

    def __str__(self) -> str:
        return f"{self.index:04X}h:{self.sub:02X} {self.name}"


DUMMY_INT16 = Entry(0x0003, 0, Kind.I16, "dummy of 16 bits")  # maps a slot of a PDO that belongs to another node

DEVICE_TYPE = Entry(0x1000, 0, Kind.U32, "device type")
ERROR_REGISTER = Entry(0x1001, 0, Kind.U8, "error register")
ERROR_COUNT = Entry(0x1003, 0, Kind.U8, "number of errors in the history")
LAST_ERROR = Entry(0x1003, 1, Kind.U32, "latest error of the history")
SYNC_COB_ID = Entry(0x1005, 0, Kind.U32, "COB-ID of SYNC")
SYNC_PERIOD = Entry(0x1006, 0, Kind.U32, "period of SYNC", "us")
SYNC_WINDOW = Entry(0x1007, 0, Kind.U32, "window after SYNC", "us")
DEVICE_NAME_INDEX, FIRMWARE_INDEX = 0x1008, 0x100A  # texts of any length
GUARD_TIME = Entry(0x100C, 0, Kind.U16, "guard time", "ms")
LIFE_FACTOR = Entry(0x100D, 0, Kind.U8, "guard times without a request")
EMERGENCY_COB_ID = Entry(0x1014, 0, Kind.U32, "COB-ID of EMCY")
EMERGENCY_INHIBIT = Entry(0x1015, 0, Kind.U16, "inhibit time of EMCY", "100 us")
HEARTBEAT_CONSUMER = Entry(0x1016, 1, Kind.U32, "heartbeat to wait for", "node << 16 | ms")
HEARTBEAT_PRODUCER = Entry(0x1017, 0, Kind.U16, "period of the heartbeat", "ms")
VENDOR = Entry(0x1018, 1, Kind.U32, "vendor")
PRODUCT = Entry(0x1018, 2, Kind.U32, "product")
REVISION = Entry(0x1018, 3, Kind.U32, "revision")
SERIAL = Entry(0x1018, 4, Kind.U32, "serial number")
SYNC_OVERFLOW = Entry(0x1019, 0, Kind.U8, "counter in SYNC, 0 for none")
# A host may store two numbers of its own here (CiA 301, "verify configuration"); see `stored_zero.py`.
STORED = Entry(0x1010, 1, Kind.U32, "what is stored when")
RESTORE = Entry(0x1011, 1, Kind.U32, "what is restored when")
ZERO_COUNTS = Entry(0x1020, 1, Kind.U32, "counts at home", "counts, as 32 bits")
ZERO_MARK = Entry(0x1020, 2, Kind.U32, "mark of the counts at home")
ERROR_BEHAVIOUR = Entry(0x1029, 1, Kind.U8, "state after a communication error")

# The first of 512 alike; `pdo_entry` has the others.
RPDO_COB_ID = Entry(0x1400, 1, Kind.U32, "COB-ID of an RPDO")
RPDO_TYPE = Entry(0x1400, 2, Kind.U8, "transmission type of an RPDO")
RPDO_DEADLINE = Entry(0x1400, 5, Kind.U16, "deadline of an RPDO", "ms")
RPDO_COUNT = Entry(0x1600, 0, Kind.U8, "entries in an RPDO")
RPDO_MAPPING = Entry(0x1600, 1, Kind.U32, "mapped entry of an RPDO")
TPDO_COB_ID = Entry(0x1800, 1, Kind.U32, "COB-ID of a TPDO")
TPDO_TYPE = Entry(0x1800, 2, Kind.U8, "transmission type of a TPDO")
TPDO_INHIBIT = Entry(0x1800, 3, Kind.U16, "inhibit time of a TPDO", "100 us")
TPDO_PERIOD = Entry(0x1800, 5, Kind.U16, "event timer of a TPDO", "ms")
TPDO_COUNT = Entry(0x1A00, 0, Kind.U8, "entries in a TPDO")
TPDO_MAPPING = Entry(0x1A00, 1, Kind.U32, "mapped entry of a TPDO")

ABORT_CONNECTION = Entry(0x6007, 0, Kind.I16, "reaction to a lost connection")
LAST_EMERGENCY = Entry(0x603F, 0, Kind.U16, "last error code")
CONTROL_WORD = Entry(0x6040, 0, Kind.U16, "control word")
STATUS_WORD = Entry(0x6041, 0, Kind.U16, "status word")
QUICK_STOP_OPTION = Entry(0x605A, 0, Kind.I16, "reaction to quick stop")
FAULT_OPTION = Entry(0x605E, 0, Kind.I16, "reaction to a fault")
MODE = Entry(0x6060, 0, Kind.I8, "mode of operation")
MODE_DISPLAY = Entry(0x6061, 0, Kind.I8, "mode of operation in effect")
POSITION = Entry(0x6064, 0, Kind.I32, "position", "counts")
TARGET_TORQUE = Entry(0x6071, 0, Kind.I16, "target torque", "per mille of rated torque")
TARGET_TORQUE_WIDE = Entry(0x6071, 0, Kind.I32, "target torque of 32 bits", "shifted counts")  # of makers
TARGET_POSITION = Entry(0x607A, 0, Kind.I32, "target position", "counts")
RATED_CURRENT = Entry(0x6075, 0, Kind.U32, "rated current", "mA")
TORQUE_ACTUAL = Entry(0x6077, 0, Kind.I16, "torque", "per mille of rated torque")
LOWER_LIMIT = Entry(0x607D, 1, Kind.I32, "lowest position", "counts")
UPPER_LIMIT = Entry(0x607D, 2, Kind.I32, "highest position", "counts")
MAX_VELOCITY = Entry(0x607F, 0, Kind.U32, "largest velocity", "drive's unit")
QUICK_STOP_DECELERATION = Entry(0x6085, 0, Kind.U32, "deceleration of quick stop", "drive's unit")
ENCODER_COUNTS = Entry(0x608F, 1, Kind.U32, "encoder counts", "per ENCODER_TURNS")
ENCODER_TURNS = Entry(0x608F, 2, Kind.U32, "turns of the motor for ENCODER_COUNTS")
GEAR_MOTOR = Entry(0x6091, 1, Kind.U32, "turns of the motor for GEAR_SHAFT")
GEAR_SHAFT = Entry(0x6091, 2, Kind.U32, "turns of the driving shaft")
VELOCITY_UNIT = Entry(0x60A9, 0, Kind.U32, "unit of velocities", "prefix, unit, unit of time")
PERIOD_NUMBER = Entry(0x60C2, 1, Kind.U8, "interpolation period", "10^PERIOD_POWER s")
PERIOD_POWER = Entry(0x60C2, 2, Kind.I8, "power of ten of the interpolation period")
SECOND_AXIS = Entry(0x6841, 0, Kind.U16, "status word of a second axis")  # 800h further for each (CiA 402-2)
SUPPORTED_MODES = Entry(0x6502, 0, Kind.U32, "supported modes")


@dataclass(frozen=True)
class OperationMode:
    """Represent a mode of operation: the value sent with control words (6060h), and the entry that shows it in effect.

    Attributes:
        sent: value sent in 6060h.
        display: entry that tells the mode in effect.
        wanted: value of `display` in that mode.
        enabling: bits of the control word without which the drive does not follow its target in that mode.
        at_once: whether its target acts when its frame comes, not at SYNC, so that the host's delays are in it.
    """

    sent: int
    display: Entry
    wanted: int
    enabling: int = 0
    at_once: bool = False


CST = 10  # cyclic synchronous torque, in 6060h and 6061h


def pdo_entry(entry: Entry, pdo_number: int, sub: int | None = None) -> Entry:
    """Return an entry of PDO 1 as that of PDO `pdo_number` (from 1), at another sub-index if one is given."""
    return replace(entry, index=entry.index + pdo_number - 1, sub=entry.sub if sub is None else sub)
