"""Define the interface to one CAN bus: send, receive until a deadline, drain; and open the links of an arm.

A link belongs to one bus and one user: it receives what others send, never its own frames. It may be python-can, a CAN
socket of the kernel, or emulated drives in this process; which, `open_links` finds by the configured interface in the
entry-point group `ident_service.can_links`, so that this package does not know the emulator.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import entry_points
from typing import Protocol, cast

from drivers.can.can_frame import Frame
from drivers.clock import Clock
from ident_service.config.canopen import CanopenDriver
from ident_service.config.schema import ArmConfig
from ident_service.errors import DriverError

GROUP = "ident_service.can_links"


class Link(Protocol):
    """Define a link to one bus; every method raises DriverError when the bus is gone (bus-off, interface down)."""

    @property
    def clock(self) -> Clock:
        """Return the clock of `stamp_ns` and deadlines; virtual where time waits for the drives."""

    def send(self, frame: Frame) -> None:
        """Queue one frame for transmission, in the order of the calls; never waits for the wire."""

    def receive(self, deadline_ns: int) -> Frame | None:
        """Return the next received frame, None when there is none until the deadline [ns of the clock]."""

    def drain(self) -> Sequence[Frame]:
        """Return all frames that have been received and not returned yet; never waits."""

    def close(self) -> None:
        """Close the link; any number of times."""


def open_links(config: ArmConfig) -> list[Link]:
    """Open every bus of an arm, in the order of the configuration.

    Args:
        config: the arm's.

    Raises:
        DriverError: the driver section is not CANopen's, or a bus that cannot be had; nothing stays open.
    """
    if not isinstance(config.driver, CanopenDriver):
        raise DriverError(f"{config.name}: the driver is not CANopen's")
    links: list[Link] = []
    try:
        for number, bus in enumerate(config.driver.buses):
            special = entry_points(group=GROUP, name=bus.interface)
            entry = next(iter(special or entry_points(group=GROUP, name="python_can")), None)
            if entry is None:
                raise DriverError(f"{config.name}: no link for interface {bus.interface!r}; reinstall ident-service")
            links.append(cast(Link, entry.load()(config, number)))
    except BaseException:
        for link in links:
            link.close()
        raise
    return links
