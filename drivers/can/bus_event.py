"""Define the events that a codec reports of its bus beside the state of the drives."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

HOST = 0  # the node of events that are of the bus or the host's own controller


class EventCode(StrEnum):
    """Name the events on a bus."""

    EMERGENCY = "emergency"
    EMERGENCY_RESET = "emergency_reset"
    NOTICE = "notice"  # an emergency message by which a drive only informs
    BOOT_UP = "boot_up"
    NMT_STATE = "nmt_state"  # operational again
    LEFT = "left"  # not operational any more
    DRIVE_FAULT = "drive_fault"  # fault or fault reaction in the status word
    DRIVE_STATE = "drive_state"  # any other change of state
    DRIVE_WARNING = "drive_warning"  # bit 7 of the status word
    TORQUE_LIMITED = "torque_limited"  # bit 11, internal limit active
    DEAF = "deaf"  # bit 12: an enabled drive that followed its torque does not any more
    OVER = "over"  # a warning or a limit has gone
    DUPLICATE = "duplicate"
    LATE = "late"
    WRONG_LENGTH = "wrong_length"
    STRANGER = "stranger"  # a frame of no node that should be on this bus
    SECOND_HOST = "second_host"  # another node sends what only this host may
    ERROR_PASSIVE = "error_passive"  # the host's controller
    BUS_OFF = "bus_off"  # the host's controller
    CONTROLLER = "controller"  # any other change of its state
    BUS_ERROR = "bus_error"
    OVERFLOW = "overflow"  # frames were lost in the host's controller


# A flood of these must not hide the others.
MILD = frozenset(
    {
        *(EventCode.DUPLICATE, EventCode.LATE, EventCode.WRONG_LENGTH, EventCode.STRANGER),
        *(EventCode.BUS_ERROR, EventCode.OVERFLOW),
    }
)


@dataclass(frozen=True, slots=True)
class Event:
    """Represent an event on a bus.

    Attributes:
        code: of the event.
        node: that it is about; `HOST` for the bus as a whole.
        words: for people, without the node.
    """

    code: EventCode
    node: int
    words: str
