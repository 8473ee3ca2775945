"""Connect to a simulated bus: its address, and a link on it that needs no python-can.

A name is an abstract socket address of this user, which vanishes with its process. A channel with a slash is a socket
file, which only its owner can open. Either way both sides check that the other runs as the same user or as root:
abstract addresses have no permissions.

One system call a frame, or for several at once; the stamp of a frame is the wire's, when the frame ended on it, and the
clock is the same in all processes of a machine.
"""

from __future__ import annotations

import errno
import os
import select
import socket
import struct
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from drivers.can.bus_state import BusError, BusOffWatch, kind_of
from drivers.can.can_frame import (
    MAX_PACKET_BYTES,
    MAX_PACKET_FRAMES,
    MOST_AT_ONCE,
    RECEIVE_FILTER,
    Frame,
    check_sendable,
    pack_frames,
    unpack_frames,
)
from drivers.clock import RealClock
from ident_service.config.arm import ArmConfig
from ident_service.errors import DriverError
from sim_backend.can_bus import packets

_CREDENTIALS = struct.Struct("=3i")  # pid, uid, gid
_MAX_ADDRESS = 100


def address_of(channel: str) -> str:
    """Return the socket address of a simulated bus: `channel` if it is a path, else an abstract one of this user.

    Raises:
        BusError: a channel that cannot be one.
    """
    address = channel if "/" in channel else f"\0ident-wire-{os.getuid()}-{channel}"
    if not channel or "\0" in channel or len(address.encode()) > _MAX_ADDRESS:
        raise BusError("refused", repr(channel), remedy="the name of a wire has 1 to 60 characters, or is a path")
    return address


def listen(channel: str) -> socket.socket:
    """Open and return the listening socket of a simulated bus; BusError where another process hosts that bus.

    Raises:
        BusError: another process runs this wire, or the address cannot be had.
    """
    address = address_of(channel)
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        try:
            _bind_private(sock, address)
        except OSError as error:
            if error.errno != errno.EADDRINUSE or not _is_stale_socket(address):
                raise
            Path(address).unlink()
            _bind_private(sock, address)
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
    """Connect to a simulated bus and return the socket; BusError if nobody hosts it, or another user does.

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
    if not peer_is_trusted(sock):
        sock.close()
        raise BusError("refused", name, remedy="another user runs this wire; take another channel")
    return sock


def peer_is_trusted(sock: socket.socket) -> bool:
    """Return whether the process on the other side runs as this user or as root."""
    _, uid, _ = _CREDENTIALS.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
    return uid in (os.getuid(), 0)


def peer_pid(sock: socket.socket) -> int:
    """Return the id of the process on the other side."""
    return int(_CREDENTIALS.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))[0])


def forget(channel: str, sock: socket.socket) -> None:
    """Close the listening socket of a simulated bus, and remove its file where `channel` is a path."""
    sock.close()
    if "/" in channel:
        with suppress(OSError):
            Path(channel).unlink()


def _bind_private(sock: socket.socket, address: str) -> None:
    os.fchmod(sock.fileno(), 0o600)  # before the bind, so that the file never has other permissions
    sock.bind(address)


def _is_stale_socket(address: str) -> bool:
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


_WELCOME_S = 10.0  # the host of a wire may still be loading a model
_ANSWERS = {
    packets.OTHER_VERSION: "runs in another version of this software; restart it",
    packets.CROWDED: "has no room for another end; close one",
}


def from_config(config: ArmConfig, bus_number: int) -> WireLink:
    """Open and return the link of one simulated bus of an arm; entry point `ident_wire`.

    Raises:
        BusError: no process runs the wire, or it refuses.
        DriverError: the driver section has no CAN bus, or an unknown option; `pace` is the host's.
    """
    if not config.can_buses:
        raise DriverError(f"{config.name}: the driver has no CAN bus")
    bus = config.can_buses[bus_number]
    if unknown := sorted(set(bus.options) - {"pace"}):
        raise DriverError(f"driver.buses.{bus_number}.options: ident_wire has only pace, found {', '.join(unknown)}")
    fd = bus.data_bitrate is not None
    return WireLink(Connection(bus.channel, packets.Hello("driver", filters=RECEIVE_FILTER, fd=fd)), fd=fd)


class Connection:
    """Connect to a wire and exchange greetings.

    Attributes:
        name: of the bus, for messages.
        welcome: answer of the wire, with its properties.
    """

    def __init__(self, channel: str, hello: packets.Hello) -> None:
        """Connect to the wire and greet it.

        Args:
            channel: name or path of the wire.
            hello: label, filters and CAN FD of this end.

        Raises:
            BusError: no process runs the wire, or it refuses.
        """
        self.name = f"ident_wire {channel}"
        self._socket = connect(channel)
        self._socket.settimeout(_WELCOME_S)
        try:
            self._socket.send(packets.pack_hello(hello))
            self.welcome = packets.unpack_welcome(self._socket.recv(MAX_PACKET_BYTES))
        except (OSError, DriverError) as error:
            self._socket.close()
            raise BusError("refused", self.name, remedy=f"does not answer as a wire does: {error}") from None
        if self.welcome.answer != packets.ACCEPTED:
            self._socket.close()
            raise BusError("refused", self.name, remedy=_ANSWERS.get(self.welcome.answer, "refuses"))
        self._socket.setblocking(False)

    def fileno(self) -> int:
        """Return the socket's descriptor, -1 when closed."""
        return self._socket.fileno()

    def send(self, frames: Sequence[Frame]) -> None:
        """Send frames in their order, 64 at most a packet, stamped with now; BusError where the bus takes no more.

        Raises:
            BusError: the wire is gone, or takes no more.
        """
        now = time.monotonic_ns()
        try:
            for first in range(0, len(frames), MAX_PACKET_FRAMES):
                some = frames[first : first + MAX_PACKET_FRAMES]
                self._socket.send(pack_frames([(frame._replace(stamp_ns=now), False) for frame in some]))
        except OSError as error:
            raise self._failure(error) from None

    def take(self, until_ns: int = 0) -> list[tuple[Frame, bool]]:
        """Return the frames of the next packet, each with whether this end sent it; empty if none by `until_ns`.

        Raises:
            BusError: the wire is gone.
        """
        while True:
            try:
                data = self._socket.recv(MAX_PACKET_BYTES)
            except BlockingIOError:
                remaining = until_ns - time.monotonic_ns()
                if remaining <= 0:
                    return []
                self._wait(remaining * 1e-9)
                continue
            except OSError as error:
                raise self._failure(error) from None
            if not data:
                raise BusError("gone", self.name, remedy="the process that runs this wire has ended; start it again")
            return unpack_frames(data)

    def close(self) -> None:
        """Close the connection to the simulated bus."""
        self._socket.close()

    def _wait(self, seconds: float) -> None:
        try:
            select.select([self._socket], [], [], seconds)
        except (OSError, ValueError) as error:
            raise self._failure(error) from None

    def _failure(self, error: OSError | ValueError) -> BusError:
        if isinstance(error, BlockingIOError):
            remedy = "the wire takes no more frames: its pace is too slow for what is sent, or its host hangs"
            return BusError("full", self.name, remedy=remedy)
        code = error.errno if isinstance(error, OSError) else None
        return BusError(kind_of(code, "gone"), self.name, remedy="the wire has gone", detail=str(error))


class WireLink:
    """Implement a Link on a connection; the thread that opened it is its only user."""

    def __init__(self, connection: Connection, *, fd: bool | None = None) -> None:
        """Use an open connection, and close it with the link.

        Args:
            connection: connection that has been greeted.
            fd: whether data frames are sent as CAN FD's; by default where the wire carries them.
        """
        self.clock = RealClock()
        self._connection = connection
        self._fd = connection.welcome.fd if fd is None else fd
        self._waiting: deque[Frame] = deque()
        self._watch = BusOffWatch()

    def send(self, frame: Frame) -> None:
        """Send one frame to the simulated bus; BusError where that is gone or takes no more.

        Raises:
            BusError: bus-off, the wire is gone or takes no more.
            DriverError: a frame that cannot exist.
        """
        self.send_all((frame,))

    def send_all(self, frames: Sequence[Frame]) -> None:
        """Send frames in their order, 64 to a system call; a frame that cannot exist raises before any is sent."""
        for frame in frames:
            check_sendable(frame, fd=self._fd)
        if self._watch.off:
            remedy = "bus-off: some ends know CAN FD (data_bitrate) and some do not, or errors were injected"
            raise BusError("off", self._connection.name, remedy=remedy)
        if self._fd:
            frames = [frame if frame.remote else frame._replace(fd=True) for frame in frames]
        self._connection.send(frames)

    def receive(self, deadline_ns: int) -> Frame | None:
        """Return the next frame, None when there is none until the deadline [ns of the clock].

        Raises:
            BusError: the wire is gone.
        """
        if not self._waiting:
            self._keep(self._connection.take(deadline_ns))
        return self._waiting.popleft() if self._waiting else None

    def drain(self) -> Sequence[Frame]:
        """Return all frames that wait, hardly more than `MOST_AT_ONCE`; does not wait.

        Raises:
            BusError: the wire is gone.
        """
        while len(self._waiting) < MOST_AT_ONCE and (taken := self._connection.take()):
            self._keep(taken)
        frames = tuple(self._waiting)
        self._waiting.clear()
        return frames

    def close(self) -> None:
        """Close the connection to the simulated bus."""
        self._connection.close()

    def _keep(self, taken: list[tuple[Frame, bool]]) -> None:
        for frame, _ in taken:
            if frame.error:
                self._watch.observe(frame)
            self._waiting.append(frame)
