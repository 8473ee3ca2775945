"""Lock a bus for one driver, by a socket address that only one process can have, named after the bus.

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
from contextlib import suppress

from ident_service.config.canopen import CanBus
from ident_service.errors import DriverError

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
            raise DriverError(f"the bus {bus.channel} is in use by process {_owner(address)}") from None

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


def _owner(address: bytes) -> str:
    """Return the id of the process that holds an address; `unknown` where the kernel does not tell."""
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
        asking.setblocking(False)
        asking.connect(address)
        pid = _CREDENTIALS.unpack(asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))[0]
        return str(pid) if pid > 0 else "unknown"  # 0: of a container whose processes are not visible here
    return "unknown"
