"""Decode the state of the host's own CAN controller from error frames (linux/can/error.h)."""

from __future__ import annotations

from enum import IntEnum

from drivers.can.can_frame import Frame

# Error class bits of the identifier.
_LOST_ARBITRATION, _CONTROLLER, _ACKNOWLEDGE, _BUS_OFF, _RESTARTED = 0x002, 0x004, 0x020, 0x040, 0x100
_CLASSES = {
    0x001: "a frame was not sent in time",
    _LOST_ARBITRATION: "arbitration lost",
    0x008: "protocol violated on the wire",
    0x010: "transceiver",
    _ACKNOWLEDGE: "nobody acknowledges: no other node, no power, or a broken cable",
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


def overflowed(frame: Frame) -> bool:
    """Return whether an error frame says that frames were lost in this controller."""
    return bool(frame.identifier & _CONTROLLER and len(frame.data) > 1 and frame.data[1] & _OVERFLOW)


def error_words(frame: Frame) -> str:
    """Describe an error frame for people; empty where it only tells the controller's state."""
    return ", ".join(words for bit, words in _CLASSES.items() if frame.identifier & bit)
