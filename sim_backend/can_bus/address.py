"""Find the socket address of a wire, and check whether the process on the other side may be trusted.

A name is an abstract socket address of this user, which vanishes with its process. A channel with a slash is a socket
file, which only its owner can open. Either way both sides check that the other runs as the same user or as root:
abstract addresses have no permissions.
"""

from __future__ import annotations

import errno
import os
import socket
import struct
from contextlib import suppress
from pathlib import Path

from drivers.can.bus_errors import BusError

_CREDENTIALS = struct.Struct("=3i")  # pid, uid, gid
_MAX_ADDRESS = 100


def address_of(channel: str) -> str:
    """Return the socket address of a channel.

    Raises:
        BusError: a channel that cannot be one.
    """
    address = channel if "/" in channel else f"\0ident-wire-{os.getuid()}-{channel}"
    if not channel or "\0" in channel or len(address.encode()) > _MAX_ADDRESS:
        raise BusError("refused", repr(channel), remedy="the name of a wire has 1 to 60 characters, or is a path")
    return address


def listen(channel: str) -> socket.socket:
    """Open the socket of a wire that takes connections.

    Raises:
        BusError: another process runs this wire, or the address cannot be had.
    """
    address = address_of(channel)
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        try:
            _bind(sock, address)
        except OSError as error:
            if error.errno != errno.EADDRINUSE or not _forsaken(address):
                raise
            Path(address).unlink()
            _bind(sock, address)
        sock.listen(64)
        sock.setblocking(False)
    except OSError as error:
        sock.close()
        if error.errno == errno.EADDRINUSE:
            remedy = "another process runs this wire; end it, or take another channel"
        else:
            remedy = f"cannot be made: {error.strerror}"
        raise BusError("refused", f"ident_wire {channel}", remedy=remedy) from None
    return sock


def connect(channel: str) -> socket.socket:
    """Connect to the wire.

    Raises:
        BusError: no process runs it, or one of another user does.
    """
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    name = f"ident_wire {channel}"
    try:
        sock.connect(address_of(channel))
    except OSError as error:
        sock.close()
        if isinstance(error, BusError):
            raise
        remedy = (
            "nobody runs this wire; start `ident emulate ARM` first, "
            f"or a wire alone: `python -m sim_backend.can_bus {channel}`"
        )
        raise BusError("absent", name, remedy=remedy, detail=error.strerror or "") from None
    if not trusted(sock):
        sock.close()
        raise BusError("refused", name, remedy="another user runs this wire; take another channel")
    return sock


def trusted(sock: socket.socket) -> bool:
    """Return whether the process on the other side runs as this user or as root."""
    _, uid, _ = _CREDENTIALS.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
    return uid in (os.getuid(), 0)


def peer_pid(sock: socket.socket) -> int:
    """Return the id of the process on the other side."""
    return int(_CREDENTIALS.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))[0])


def forget(channel: str, sock: socket.socket) -> None:
    """Close a listening socket, and remove its file."""
    sock.close()
    if "/" in channel:
        with suppress(OSError):
            Path(channel).unlink()


def _bind(sock: socket.socket, address: str) -> None:
    os.fchmod(sock.fileno(), 0o600)  # before the bind, so that the file never has other permissions
    sock.bind(address)


def _forsaken(address: str) -> bool:
    """Return whether a socket file is left of a process that is gone."""
    if address.startswith("\0") or not Path(address).is_socket():
        return False
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
        try:
            probe.connect(address)
        except ConnectionRefusedError:
            return True
        except OSError:
            return False
        return False
