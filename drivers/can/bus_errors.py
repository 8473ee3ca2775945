"""Represent failures of a bus as a whole as one typed error with a remedy.

Sources: errno values of the kernel's `net/can/raw.c` and `drivers/net/can/dev`; python-can hands them on in
`CanError.error_code` or as the cause.
`CanError.error_code` or as the cause.
"""

from __future__ import annotations

import errno
from typing import Literal

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
    "full": "the transmit queue is full: nobody acknowledges, or the bus is overloaded; check that the drives have "
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
            bitrate: for the command that brings an interface up.
            detail: the system's own word.
            remedy: instead of the usual one, where it does not fit the interface.
        """
        self.kind: Kind = kind
        said = f" ({detail})" if detail else ""
        super().__init__(f"{name}: {remedy or _REMEDY[kind].format(name=name, bitrate=bitrate)}{said}")


def kind_of(code: int | None, otherwise: Kind = "refused") -> Kind:
    """Return the kind of bus error that an errno means.

    Args:
        code: the errno, None where there is none.
        otherwise: kind of any other errno; `gone` says that the bus is in use, so that it existed before.
    """
    kind = _KINDS.get(code or 0, otherwise)
    return "gone" if (kind, otherwise) == ("absent", "gone") else kind


class BusOffWatch:
    """Track from error frames whether the controller has left the bus.

    The kernel accepts frames of a controller that is bus-off and drops them silently, so that the link itself must
    refuse. Receiving goes on: only so can a restart be heard.
    """

    def __init__(self) -> None:
        self.off = False

    def heard(self, frame: Frame) -> None:
        """Note an error frame; ignore other frames."""
        if frame.error:
            self.off = (self.off or bool(frame.identifier & BUS_OFF)) and not frame.identifier & RESTARTED
