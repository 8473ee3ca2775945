"""Describe the state of a bus: errors with their remedies, the host's controller, events beside the samples.

Sources: errno values of the kernel's `net/can/raw.c` and `drivers/net/can/dev`; python-can hands them on in
`CanError.error_code` or as the cause.
`CanError.error_code` or as the cause.
"""

from __future__ import annotations

import errno
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from typing import Literal

from drivers.arm import SetupCheck
from drivers.axis_status import AxisEventCode
from drivers.can.can_frame import Frame
from ident_service.errors import DriverError

Kind = Literal["absent", "down", "off", "full", "gone", "refused"]

# linux/can/error.h: classes, in the identifier of an error frame.
CONTROLLER, BUS_OFF, RESTARTED, COUNTERS = 0x004, 0x040, 0x100, 0x200
# Its details for CONTROLLER, in byte 1.
RX_OVERFLOW, WARNING_RX, WARNING_TX, PASSIVE_RX, PASSIVE_TX, ACTIVE = 0x01, 0x04, 0x08, 0x10, 0x20, 0x40

_UP = "bring it up: `ip link set {name} up type can bitrate {bitrate}`"
_REMEDY: dict[Kind, str] = {
    "absent": "no such CAN interface; plug the adapter in, look with `ip -br link`, "
    "or correct driver.buses in the arm's file",
    "down": "the interface is down; " + _UP,
    "off": "the controller has left the bus after too many errors (bus-off); check wiring, termination and bit rate, "
    "then restart it: `ip link set {name} down`, and " + _UP,
    "full": "the transmit queue is full: no node acknowledges, or the bus is overloaded; check that the drives have "
    "power and the same bit rate, that the bus is terminated, and `ident bus load`",
    "gone": "the interface has gone; check the adapter and its cable",
    "refused": "cannot be used; check driver.buses in the arm's file",
}
_KINDS: dict[int, Kind] = {
    errno.ENODEV: "absent",
    errno.ENXIO: "gone",
    errno.ENETDOWN: "down",
    errno.ENETUNREACH: "down",
    errno.ENOBUFS: "full",
    errno.EAGAIN: "full",
    errno.EPIPE: "gone",
    errno.ECONNRESET: "gone",
    errno.ENOTCONN: "gone",
    errno.EBADF: "gone",
}


class BusError(DriverError):
    """Report that a bus cannot be opened, or can no longer be used.

    Attributes:
        kind: `absent` no such interface; `down` not brought up; `off` bus-off; `full` nothing more can be sent; `gone`
            vanished while in use; `refused` anything else.
    """

    def __init__(
        self, kind: Kind, name: str, bitrate: int = 1_000_000, detail: str = "", *, remedy: str | None = None
    ) -> None:
        """Describe what is wrong and what to do.

        Args:
            kind: of the error.
            name: of the bus, as it is configured.
            bitrate: bit rate for the command that brings an interface up.
            detail: the system's own word.
            remedy: instead of the usual one, where it does not fit the interface.
        """
        self.kind: Kind = kind
        said = f" ({detail})" if detail else ""
        super().__init__(f"{name}: {remedy or _REMEDY[kind].format(name=name, bitrate=bitrate)}{said}")


def kind_of(errno_value: int | None, default: Kind = "refused") -> Kind:
    """Return the kind of bus error that an errno means; `default` for None and for any other errno.

    Args:
        errno_value: the errno, None where there is none.
        default: kind of any other errno; `gone` says that the bus is in use, so that it existed before.
    """
    kind = _KINDS.get(errno_value or 0, default)
    return "gone" if (kind, default) == ("absent", "gone") else kind


class BusOffWatch:
    """Track from error frames whether the controller has left the bus.

    The kernel accepts frames of a controller that is bus-off and drops them silently, so that the link itself must
    refuse. Receiving goes on: only so can a restart be heard.
    """

    def __init__(self) -> None:
        self.off = False

    def observe(self, frame: Frame) -> None:
        """Update `off` by an error frame: bus-off sets it, a restart clears it; ignore other frames."""
        if frame.error:
            self.off = (self.off or bool(frame.identifier & BUS_OFF)) and not frame.identifier & RESTARTED


# Error class bits of the identifier.
_LOST_ARBITRATION, _CONTROLLER, _ACKNOWLEDGE, _BUS_OFF, _RESTARTED = 0x002, 0x004, 0x020, 0x040, 0x100
_CLASSES = {
    0x001: "a frame was not sent in time",
    _LOST_ARBITRATION: "arbitration lost",
    0x008: "protocol violated on the wire",
    0x010: "transceiver",
    _ACKNOWLEDGE: "no node acknowledges: no other node, no power, or a broken cable",
    0x080: "bus error",
}
# Bits of the second data byte, when the class bit of the controller is set.
_OVERFLOW, _WARNING, _PASSIVE, _ACTIVE = 0x03, 0x0C, 0x30, 0x40


class ControllerState(IntEnum):
    """Name the states of a CAN controller (ISO 11898-1, fault confinement)."""

    ACTIVE = 0
    WARNING = 1
    PASSIVE = 2
    BUS_OFF = 3


def controller_state(frame: Frame, before: ControllerState) -> ControllerState:
    """Return the controller's state after an error frame; from bus-off only a restart leads back."""
    kind, detail = frame.identifier, frame.data[1] if len(frame.data) > 1 else 0
    if kind & _BUS_OFF:
        return ControllerState.BUS_OFF
    if kind & _RESTARTED:
        return ControllerState.ACTIVE
    if before is ControllerState.BUS_OFF or not kind & _CONTROLLER:
        return before
    if detail & _PASSIVE:
        return ControllerState.PASSIVE
    if detail & _WARNING:
        return ControllerState.WARNING
    return ControllerState.ACTIVE if detail & _ACTIVE else before


LEFT_NORMAL = {ControllerState.PASSIVE: "error-passive", ControllerState.BUS_OFF: "bus-off"}
"""States in which nothing may be moved, in words: such a controller's frames are destroyed by others, or not sent."""


def controller_checks(channel: str, state: ControllerState) -> tuple[SetupCheck, ...]:
    """Return the check of a host's controller that is error-passive or bus-off; none of any other.

    Args:
        channel: channel of the bus, as it is configured.
        state: of the host's controller on it.
    """
    if state not in LEFT_NORMAL:
        return ()
    remedy = (
        f"Check termination, connectors, cable and bit rate of every node on {channel}, and that drives have power; "
        f"then bring the interface down and up (`ip -details link show {channel}` tells its state)."
    )
    return (SetupCheck(f"the host's CAN controller on {channel}", LEFT_NORMAL[state], "error-active", remedy),)


def overflowed(frame: Frame) -> bool:
    """Return whether an error frame says that frames were lost in this controller."""
    return bool(frame.identifier & _CONTROLLER and len(frame.data) > 1 and frame.data[1] & _OVERFLOW)


def error_words(frame: Frame) -> str:
    """Describe an error frame for people; empty where it only tells the controller's state."""
    return ", ".join(words for bit, words in _CLASSES.items() if frame.identifier & bit)


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
    DRIVE_PASSIVE = "drive_passive"  # a drive's controller is error-passive
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

BUS_EVENTS = {
    EventCode.EMERGENCY: AxisEventCode.EMERGENCY_MESSAGE,
    EventCode.BOOT_UP: AxisEventCode.DRIVE_RESTARTED,
    EventCode.DRIVE_WARNING: AxisEventCode.DRIVE_WARNING,
    EventCode.SECOND_HOST: AxisEventCode.SECOND_HOST,
    EventCode.ERROR_PASSIVE: AxisEventCode.BUS_DEGRADED,
    EventCode.DRIVE_PASSIVE: AxisEventCode.BUS_DEGRADED,
    EventCode.BUS_OFF: AxisEventCode.BUS_OFF,
    **dict.fromkeys(MILD, AxisEventCode.STRANGE_FRAME),
}
"""Events that any drives on CAN have, as events of the arm's axes."""


@dataclass(frozen=True, slots=True)
class Event:
    """Represent an event on a bus.

    Attributes:
        code: of the event.
        node: node of the event; `HOST` for the bus as a whole.
        words: description for people, without the node.
    """

    code: EventCode
    node: int
    words: str
