"""Translate codes on the bus to words: emergencies, SDO aborts, drive states, NMT states, error registers.

Tables of CiA 301 (EMCY 7.2.7, SDO 7.2.4.3.17, NMT 7.3.2) and CiA 402-2 (states and commands 8.2 to 8.4).
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum, IntEnum
from typing import Final

from drivers.axis_status import AxisStatus


class NmtState(IntEnum):
    """Name the NMT states of a node, as heartbeats carry them."""

    BOOT_UP = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


class NmtCommand(IntEnum):
    """Name the NMT commands (COB-ID 000h)."""

    START = 1
    STOP = 2
    ENTER_PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


class DriveState(Enum):
    """Name the states of CiA 402 as mask and value of the status word; the first that fits counts."""

    NOT_READY = (0x4F, 0x00)
    SWITCH_ON_DISABLED = (0x4F, 0x40)
    FAULT_REACTION = (0x4F, 0x0F)
    FAULT = (0x4F, 0x08)
    READY_TO_SWITCH_ON = (0x6F, 0x21)
    SWITCHED_ON = (0x6F, 0x23)
    OPERATION_ENABLED = (0x6F, 0x27)
    QUICK_STOP = (0x6F, 0x07)
    UNKNOWN = (0x00, 0x01)  # no status word fits: undefined combinations of bits

    def __str__(self) -> str:
        return self.name.lower().replace("_", " ")


# States in which the power stage is off for certain (CiA 402-2, 6.2). A quick stop may end in `quick stop active`
# (605Ah, 5 to 8), in which the drive holds the motor with power.
POWER_OFF = frozenset(
    {DriveState.NOT_READY, DriveState.SWITCH_ON_DISABLED, DriveState.READY_TO_SWITCH_ON, DriveState.FAULT}
)

FAULTS = frozenset({DriveState.FAULT, DriveState.FAULT_REACTION})

# Values of 605Ah with which a drive stays in quick stop, and may be enabled out of it (transition 16).
STAY_IN_QUICK_STOP = range(5, 9)

# Bits of the status word beside the state.
WARNING, REMOTE, INTERNAL_LIMIT, FOLLOWS = 1 << 7, 1 << 9, 1 << 11, 1 << 12

# Commands: control words without any other bit.
DISABLE_VOLTAGE, QUICK_STOP, SHUTDOWN, SWITCH_ON, ENABLE, RESET_FAULT = 0x0000, 0x0002, 0x0006, 0x0007, 0x000F, 0x0080

# The next command on the way to `operation enabled`. FAULT_REACTION and NOT_READY end by themselves, and so does a
# quick stop in which the drive does not stay: cut short, it would let the arm fall. A fault is reset by a rising edge,
# so that DISABLE_VOLTAGE must have been sent before.
TOWARDS_ENABLED: dict[DriveState, int] = {
    DriveState.FAULT: RESET_FAULT,
    DriveState.SWITCH_ON_DISABLED: SHUTDOWN,
    DriveState.READY_TO_SWITCH_ON: SWITCH_ON,
    DriveState.SWITCHED_ON: ENABLE,
}

EMERGENCIES: dict[int, str] = {
    0x0000: "error reset, or no error",
    0x1000: "generic error",
    0x2000: "current",
    0x2100: "current, input side",
    0x2200: "current inside the device",
    0x2300: "current, output side",
    0x2310: "continuous over-current",
    0x2320: "short circuit or earth leakage",
    0x3000: "voltage",
    0x3100: "mains voltage",
    0x3200: "voltage inside the device",
    0x3210: "over-voltage of the DC link",
    0x3220: "under-voltage of the DC link",
    0x3300: "output voltage",
    0x4000: "temperature",
    0x4100: "ambient temperature",
    0x4200: "device temperature",
    0x4210: "device too hot",
    0x4300: "drive temperature",
    0x4310: "drive too hot",
    0x5000: "hardware of the device",
    0x5100: "supply of the device's electronics",
    0x5400: "power section",
    0x5441: "enable contact open",
    0x6000: "software of the device",
    0x6100: "internal software",
    0x6200: "user software",
    0x6300: "data set",
    0x6320: "parameters",
    0x7000: "additional module",
    0x7100: "power module",
    0x7120: "motor",
    0x7121: "motor blocked",
    0x7122: "motor or commutation",
    0x7200: "measurement circuit",
    0x7300: "sensor",
    0x7305: "incremental encoder",
    0x7500: "communication module",
    0x7600: "data storage",
    0x8000: "monitoring",
    0x8100: "communication",
    0x8110: "CAN overrun: frames were lost",
    0x8120: "CAN controller in error passive",
    0x8130: "life guard or heartbeat",
    0x8140: "recovered from bus-off",
    0x8150: "COB-ID collision: another node sends with its identifier",
    0x81FD: "CAN bus-off (maxon)",
    0x81FE: "CAN receive queue overflow (maxon)",
    0x81FF: "CAN transmit queue overflow (maxon)",
    0x8200: "protocol",
    0x8210: "PDO not processed: it is too short",
    0x8220: "PDO too long",
    0x8230: "destination of a multiplexed PDO not available",
    0x8240: "SYNC of unexpected length",
    0x8250: "RPDO timeout: no torque frame came in time",
    0x8300: "torque control",
    0x8311: "excess torque",
    0x8400: "velocity control",
    0x8500: "position control",
    0x8600: "positioning",
    0x8611: "following error",
    0x8612: "reference limit",
    0x8700: "SYNC missing",
    0x9000: "external error",
    0xF000: "additional functions",
    0xFF00: "specific to the device",
}

# In quick stop the drive brakes by itself, and no torque of the host acts.
_AXIS_STATUS: dict[DriveState, AxisStatus] = {
    DriveState.OPERATION_ENABLED: AxisStatus.POWERED,
    DriveState.QUICK_STOP: AxisStatus.IDLE,
    DriveState.FAULT_REACTION: AxisStatus.FAULT,
    DriveState.FAULT: AxisStatus.FAULT,
}
ERROR_PASSIVE: Final = 0x8120  # a drive whose CAN controller hears and sends badly
_WATCHDOGS = (0x8130, 0x8250, 0x8700)  # the host fell silent: no heartbeat or question, no torque frame, no SYNC

COMMUNICATION_ERROR: Final = 0x10  # of 1001h
# Bits of object 1001h, from the lowest.
ERROR_REGISTER = ("generic", "current", "voltage", "temperature", "communication", "profile", "reserved", "vendor")

ABORTS: dict[int, str] = {
    0x05030000: "toggle bit not alternated",
    0x05040000: "SDO protocol timed out",
    0x05040001: "command not valid or unknown",
    0x05040002: "invalid block size",
    0x05040003: "invalid sequence number",
    0x05040004: "CRC error",
    0x05040005: "out of memory",
    0x06010000: "access not supported",
    0x06010001: "it can only be written",
    0x06010002: "it can only be read",
    0x06020000: "object does not exist",
    0x06040041: "object cannot be mapped into a PDO",
    0x06040042: "the mapped objects are longer than a PDO",
    0x06040043: "parameters incompatible",
    0x06040047: "internal incompatibility in the device",
    0x06060000: "hardware error",
    0x06070010: "length of the value does not fit its type",
    0x06070012: "value too long for its type",
    0x06070013: "value too short for its type",
    0x06090011: "sub-index does not exist",
    0x06090030: "value not allowed",
    0x06090031: "value too high",
    0x06090032: "value too low",
    0x06090036: "maximum is below minimum",
    0x060A0023: "resource not available (SDO connection)",
    0x08000000: "general error",
    0x08000020: "data cannot be transferred or stored",
    0x08000021: "data cannot be transferred or stored: local control",
    0x08000022: "data cannot be transferred or stored in the present state of the device",
    0x08000023: "no object dictionary, or it could not be generated",
    0x08000024: "no data available",
}


def state_of(status: int) -> DriveState:
    """Return the state of CiA 402 that a status word (6041h) has."""
    for state in DriveState:
        mask, value = state.value
        if status & mask == value:
            return state
    return DriveState.UNKNOWN


def axis_status(status: int, emergency: int = 0) -> AxisStatus:
    """Convert a drive's status to the flags common to all fieldbuses; neither object tells of an emergency stop.

    Args:
        status: the status word.
        emergency: error code of its latest emergency, 0 for none.
    """
    found = _AXIS_STATUS.get(state_of(status), AxisStatus(0))
    return found | AxisStatus.WATCHDOG if emergency in _WATCHDOGS else found


def joint_status(drives: Iterable[AxisStatus]) -> AxisStatus:
    """Combine the status of the drives that move a joint: POWERED if all of them are, any other flag if one has it."""
    powered, trouble = True, AxisStatus(0)
    for word in drives:
        powered = powered and bool(word & AxisStatus.POWERED)
        trouble |= word & ~AxisStatus.POWERED
    return trouble | AxisStatus.POWERED if powered else trouble


def is_communication_error(code: int) -> bool:
    """Return whether an emergency is about communication with the host: CiA 301's groups 81h, 82h and 87h."""
    return code >> 8 in (0x81, 0x82, 0x87)


def emergency_words(code: int, register: int = 0, vendor: bytes = b"") -> str:
    """Describe an emergency: `8250h RPDO timeout: no torque frame came in time (error register: communication)`."""
    name = EMERGENCIES.get(code)
    if name is None:
        # Unknown members of a known group, else of a known class.
        group = EMERGENCIES.get(code & 0xFFF0) or EMERGENCIES.get(code & 0xFF00) or EMERGENCIES.get(code & 0xF000)
        name = f"unknown code of the group {group!r}" if group else "unknown code"
    words = f"{code:04X}h {name}"
    if register:
        words += f" (error register: {register_words(register)})"
    return words + (f", vendor's bytes {vendor.hex(' ')}" if any(vendor) else "")


def register_words(register: int) -> str:
    """Describe an error register (1001h): `generic, communication`."""
    return ", ".join(bit for place, bit in enumerate(ERROR_REGISTER) if register >> place & 1)


def drive_words(status: int, emergency: int = 0) -> str:
    """Describe a status word (6041h): `fault, warning (8130h life guard or heartbeat)`.

    Args:
        status: the word.
        emergency: code of the error that the drive has (603Fh), 0 for none.
    """
    bits = ((WARNING, "warning"), (INTERNAL_LIMIT, "limits its torque"))
    words = ", ".join([str(state_of(status)), *(name for bit, name in bits if status & bit)])
    return f"{words} ({emergency_words(emergency)})" if emergency else words


def abort_words(code: int) -> str:
    """Describe an SDO abort code: `06090031h value too high`."""
    return f"{code:08X}h {ABORTS.get(code, 'unknown abort code')}"


def nmt_words(state: int) -> str:
    """Describe an NMT state, as heartbeats carry it, in words: `pre-operational`."""
    try:
        return NmtState(state).name.lower().replace("_", "-")
    except ValueError:
        return f"unknown NMT state {state}"
