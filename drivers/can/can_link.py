"""Send and receive frames on a bus: the contract of a link, and the lock that one driver holds on a bus.

A link belongs to one bus and one user: it receives what others send, never its own frames. It may be python-can, a CAN
socket of the kernel, or emulated drives in this process; which, `open_links` finds by the configured interface in the
entry-point group `ident_service.can_links`, so that this package does not know the emulator.

The address is abstract (unix(7)): it has no file, so no folder and no permissions, and processes of all users meet at
it, under systemd too. It belongs to the network namespace, as the names of CAN interfaces do. It vanishes with the
process that holds it, however that ends. It keeps a second driver of this machine away, also one with another
description of the arm; another machine on the same bus shows by its frames (`SECOND_HOST`). Decision 0048.
"""

from __future__ import annotations

import errno
import hashlib
import socket
import struct
from collections.abc import Sequence
from contextlib import suppress
from importlib.metadata import entry_points
from typing import Protocol, cast

from drivers.can.can_frame import Frame
from drivers.clock import Clock
from ident_service.config.arm import ArmConfig
from ident_service.config.can_bus import CanBus
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
    """Open every bus of an arm, and return the links in the order of the configuration; all closed on an error.

    Args:
        config: the arm's.

    Raises:
        DriverError: the driver section has no CAN bus, or one that cannot be had; nothing stays open.
    """
    if not config.can_buses:
        raise DriverError(f"{config.name}: the driver has no CAN bus")
    links: list[Link] = []
    try:
        for number, bus in enumerate(config.can_buses):
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


_CREDENTIALS = struct.Struct("3i")  # struct ucred: pid, uid, gid
_LONGEST = 64  # of a name that stands in the address as it is, of the 107 bytes that an address has


class BusLock:
    """Hold the lock of one bus from construction to `close`."""

    def __init__(self, bus: CanBus) -> None:
        """Lock the bus.

        Raises:
            DriverError: another process has it, or no lock can be made.
        """
        address = _address(bus)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.bind(address)
            self._socket.listen()  # so that others can ask the kernel who holds it
        except OSError as error:
            self._socket.close()
            if error.errno != errno.EADDRINUSE:
                raise DriverError(f"the bus {bus.channel} cannot be locked: {error.strerror}") from None
            raise DriverError(f"the bus {bus.channel} is in use by process {_owner_pid(address)}") from None

    def close(self) -> None:
        """Release the lock; any number of times."""
        self._socket.close()


def _address(bus: CanBus) -> bytes:
    medium = bus.medium
    if medium == "kernel":
        with suppress(OSError):  # an interface has several names (`ip link property add`), and one index
            return f"\0ident-can-kernel-{socket.if_nametoindex(bus.channel)}".encode()
    name = f"{medium}-{bus.channel}".encode()
    return b"\0ident-can-" + (name if len(name) <= _LONGEST else hashlib.sha256(name).hexdigest().encode())


def _owner_pid(address: bytes) -> str:
    """Return the id of the process that holds an address; `unknown` where the kernel does not tell."""
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
        asking.setblocking(False)
        asking.connect(address)
        pid = _CREDENTIALS.unpack(asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))[0]
        return str(pid) if pid > 0 else "unknown"  # 0: of a container whose processes are not visible here
    return "unknown"
