"""Use a CAN socket of the kernel without python-can (interface `raw`), and ask the kernel about its interfaces.

Error frames tell changes of a controller's state only. What it is when a link is opened the kernel tells by rtnetlink,
as `ip -details link show` does (linux/rtnetlink.h, linux/if_link.h, linux/can/netlink.h); drivers of adapters that are
no network interfaces do not tell it.

One system call a frame. Stamps are the kernel's, taken when the frame arrived, turned from wall-clock to monotonic time
by their age. Frames that the kernel dropped are reported as an error frame of receive overflow.
"""

from __future__ import annotations

import errno
import fcntl
import os
import select
import socket
import struct
import sys
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress

from drivers.can.bus_state import (
    BUS_OFF,
    CONTROLLER,
    PASSIVE_RX,
    PASSIVE_TX,
    RX_OVERFLOW,
    BusError,
    BusOffWatch,
    kind_of,
)
from drivers.can.can_frame import (
    EXTENDED,
    FD_BYTES,
    MOST_AT_ONCE,
    RECEIVE_FILTER,
    Frame,
    check_sendable,
    from_kernel,
    to_kernel,
)
from drivers.clock import RealClock
from ident_service.config.arm import ArmConfig
from ident_service.config.can_bus import CanBus
from ident_service.errors import DriverError

# Values of the kernel's headers; Python defines the CAN ones only where it was built with them.
AF_CAN, CAN_RAW = 29, 1
_SIOCGIFMTU = 0x8921
_REQUEST, _LONGEST_NAME = struct.Struct("16si20x"), 15  # struct ifreq, IFNAMSIZ less its zero


def check_interface(bus: CanBus) -> None:
    """Raise BusError where the interface is missing, or CAN FD is configured that it is not set up for.

    Where the kernel has no CAN sockets nothing is refused; opening says so.

    Raises:
        BusError: no such interface, or a data bit rate is configured for one that is set up for classic frames.
    """
    try:
        largest = _largest_packet(bus.channel)
    except OSError as error:
        if error.errno == errno.ENODEV:
            raise BusError("absent", bus.channel, bus.bitrate, f"{bus.interface}: {error.strerror}") from None
        return
    if bus.data_bitrate is not None and largest < FD_BYTES:
        remedy = (
            f"carries no CAN FD: `ip link set {bus.channel} up type can bitrate {bus.bitrate}"
            f" dbitrate {bus.data_bitrate} fd on`, or leave data_bitrate out"
        )
        raise BusError("refused", bus.channel, remedy=remedy)


_NETLINK_ROUTE, _GET_LINK, _NEW_LINK, _IS_REQUEST = 0, 18, 16, 1
_HEADER, _LINK, _ATTRIBUTE = struct.Struct("=IHHII"), struct.Struct("=BxHiII"), struct.Struct("=HH")
_LINK_INFO, _INFO_DATA, _CAN_STATE, _TYPE = 18, 2, 4, 0x3FFF  # attributes, and the bits that are an attribute's type
_MOST_BYTES, _PATIENCE = 1 << 16, 0.5  # s that the kernel may take to answer
# enum can_state; an interface that is stopped or asleep says so when it is used.
_STATES = {
    2: Frame(CONTROLLER, bytes((0, PASSIVE_TX | PASSIVE_RX)) + bytes(6), error=True),
    3: Frame(BUS_OFF, bytes(8), error=True),
}


def controller_state_frame(channel: str) -> Frame | None:
    """Return an error frame if an interface's controller is error-passive or bus-off; None otherwise, and if unknown.

    Args:
        channel: name of the interface.

    Returns:
        An error frame if the controller is error-passive or bus-off; None for any other state, and where the kernel
        knows none, as of virtual interfaces.
    """
    try:
        request = _LINK.pack(0, 0, socket.if_nametoindex(channel), 0, 0)
        with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, _NETLINK_ROUTE) as sock:
            sock.settimeout(_PATIENCE)
            sock.send(_HEADER.pack(_HEADER.size + len(request), _GET_LINK, _IS_REQUEST, 1, 0) + request)
            answer = sock.recv(_MOST_BYTES)
    except OSError:  # the link itself says what is wrong with its interface
        return None
    return state_in_link_message(answer)


def state_in_link_message(message: bytes) -> Frame | None:
    """Return the error frame for the controller's state in an rtnetlink answer; None for a good or unknown state."""
    if len(message) < _HEADER.size or _HEADER.unpack_from(message)[1] != _NEW_LINK:
        return None
    found = message[_HEADER.size + _LINK.size :]
    for wanted in (_LINK_INFO, _INFO_DATA, _CAN_STATE):
        found = _attributes(found).get(wanted, b"")
    return _STATES.get(int.from_bytes(found, sys.byteorder)) if len(found) == 4 else None


def _attributes(data: bytes) -> dict[int, bytes]:
    """Return attributes of netlink by their type; each begins at a multiple of 4 bytes."""
    found = {}
    while len(data) >= _ATTRIBUTE.size:
        length, kind = _ATTRIBUTE.unpack_from(data)
        if length < _ATTRIBUTE.size:
            break
        found[kind & _TYPE] = data[_ATTRIBUTE.size : length]
        data = data[(length + 3) & ~3 :]
    return found


def _largest_packet(channel: str) -> int:
    """Return the largest packet of an interface [bytes]; raises OSError where the kernel does not say."""
    with socket.socket(AF_CAN, socket.SOCK_RAW, CAN_RAW) as sock:
        request = _REQUEST.pack(channel.encode()[:_LONGEST_NAME], 0)
        return int(_REQUEST.unpack(fcntl.ioctl(sock, _SIOCGIFMTU, request))[1])


# Values of the kernel's headers; Python defines the CAN ones only where it was built with them.
_SOL_CAN_RAW = 101
_RAW_FILTER, _RAW_ERR_FILTER, _RAW_LOOPBACK, _RAW_RECV_OWN, _RAW_FD_FRAMES = 1, 2, 3, 4, 5
_SO_TIMESTAMPNS, _SO_RXQ_OVFL = 35, 40
_ALL_ERRORS = 0x1FFF_FFFF
_RECEIVE_BUFFER = 1 << 20  # some hundred frames more than the default, while the loop does not read
_TIMESPEC, _COUNT = struct.Struct("@ll"), struct.Struct("=I")
_ANCILLARY = socket.CMSG_SPACE(_TIMESPEC.size) + socket.CMSG_SPACE(_COUNT.size)
_PLAUSIBLE_NS = 10_000_000_000  # a stamp older than this, or in the future, comes from a clock that was set


def from_config(config: ArmConfig, bus_number: int) -> RawLink:
    """Open and return the link of one bus of an arm; entry point `raw`.

    Raises:
        BusError: the interface is missing, down, or without the CAN FD asked for, or this kernel has no CAN sockets.
        DriverError: the driver section has no CAN bus, or it has options, which this interface does not know.
    """
    if not config.can_buses:
        raise DriverError(f"{config.name}: the driver has no CAN bus")
    bus = config.can_buses[bus_number]
    if bus.options:
        raise DriverError(f"driver.buses.{bus_number}.options: interface raw has none, found {', '.join(bus.options)}")
    check_interface(bus)
    fd = bus.data_bitrate is not None
    link = RawLink(open_socket(bus.channel, bus.bitrate, fd=fd), bus.channel, bus.bitrate, fd=fd)
    if (state := controller_state_frame(bus.channel)) is not None:
        link.hear(state)
    return link


def open_socket(channel: str, bitrate: int = 1_000_000, *, fd: bool = False) -> socket.socket:
    """Open a CAN socket for 11-bit frames of others and controller errors; `bitrate` is for messages only, not set.

    Args:
        channel: network interface, as `ip link` names it.
        bitrate: bit rate for the remedy in messages only; the interface is configured outside.
        fd: whether CAN FD frames may come and go.

    Raises:
        BusError: the interface is missing or down, or this kernel has no CAN sockets.
    """
    try:
        sock = socket.socket(AF_CAN, socket.SOCK_RAW, CAN_RAW)
    except OSError as error:
        detail = "this kernel has no CAN sockets; load the modules: `modprobe can-raw`, or choose another interface"
        raise BusError("refused", channel, bitrate, f"{detail}: {error.strerror}") from None
    try:
        # Until the bind nothing arrives, so that no frame passes an unset filter.
        filters = b"".join(struct.pack("=II", wanted, mask | EXTENDED) for wanted, mask in RECEIVE_FILTER)
        sock.setsockopt(_SOL_CAN_RAW, _RAW_FILTER, filters)
        sock.setsockopt(_SOL_CAN_RAW, _RAW_ERR_FILTER, _ALL_ERRORS)
        sock.setsockopt(_SOL_CAN_RAW, _RAW_LOOPBACK, 1)
        sock.setsockopt(_SOL_CAN_RAW, _RAW_RECV_OWN, 0)
        if fd:
            sock.setsockopt(_SOL_CAN_RAW, _RAW_FD_FRAMES, 1)
        sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        sock.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
        with suppress(OSError):
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
        sock.bind((channel,))
        # The bind succeeds on an interface that is down; the error waits.
        if code := sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            raise OSError(code, os.strerror(code))
    except OSError as error:
        sock.close()
        raise BusError(kind_of(error.errno), channel, bitrate, error.strerror or str(error)) from None
    return sock


class RawLink:
    """Implement a Link on a socket of kernel frames; the thread that opened it is its only user."""

    def __init__(self, sock: socket.socket, name: str, bitrate: int = 1_000_000, *, fd: bool = False) -> None:
        """Use a bound socket, and close it with the link.

        Args:
            sock: bound; closed with the link.
            name: of the interface, for messages.
            bitrate: bit rate for messages.
            fd: whether data frames are sent as CAN FD.
        """
        sock.setblocking(False)
        self.clock = RealClock()
        self._socket, self._name, self._bitrate, self._fd = sock, name, bitrate, fd
        self._watch = BusOffWatch()
        self._waiting: deque[Frame] = deque()
        self._dropped = 0

    def send(self, frame: Frame) -> None:
        """Hand one frame to the kernel's queue and return at once; BusError where the bus is off, gone or full.

        Raises:
            BusError: bus-off, interface down or gone, queue full.
            DriverError: a frame that cannot exist.
        """
        check_sendable(frame, fd=self._fd)
        if self._watch.off:
            raise BusError("off", self._name, self._bitrate)
        try:
            self._socket.send(to_kernel(frame, fd=self._fd))
        except OSError as error:
            raise self._failure(error) from None

    def receive(self, deadline_ns: int) -> Frame | None:
        """Return the next frame; None where none has come by the deadline [ns of the link's clock].

        Raises:
            BusError: interface down or gone.
        """
        while True:
            if self._waiting:
                return self._waiting.popleft()
            if (frame := self._take()) is not None:
                self._waiting.append(frame)
                continue
            remaining = deadline_ns - time.monotonic_ns()
            if remaining <= 0:
                return None
            try:
                select.select([self._socket], [], [], remaining * 1e-9)
            except (OSError, ValueError) as error:
                raise self._failure(error) from None

    def drain(self) -> Sequence[Frame]:
        """Return all frames that wait, at most `MOST_AT_ONCE`; does not wait.

        Raises:
            BusError: interface down or gone.
        """
        while len(self._waiting) < MOST_AT_ONCE and (frame := self._take()) is not None:
            self._waiting.append(frame)
        frames = tuple(self._waiting)
        self._waiting.clear()
        return frames

    def hear(self, frame: Frame) -> None:
        """Queue a frame of the controller's state, stamped now, to be returned by a later `receive` or `drain`."""
        self._watch.observe(frame)
        self._waiting.append(frame._replace(stamp_ns=time.monotonic_ns()))

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _take(self) -> Frame | None:
        try:
            data, ancillary, _, _ = self._socket.recvmsg(FD_BYTES, _ANCILLARY)
        except BlockingIOError:
            return None
        except OSError as error:
            raise self._failure(error) from None
        if not data:
            raise BusError("gone", self._name, self._bitrate)
        now, stamp = time.monotonic_ns(), 0
        for level, kind, value in ancillary:
            if level != socket.SOL_SOCKET:
                continue
            if kind == _SO_TIMESTAMPNS and len(value) == _TIMESPEC.size:
                seconds, nanoseconds = _TIMESPEC.unpack(value)
                stamp = seconds * 1_000_000_000 + nanoseconds
            elif kind == _SO_RXQ_OVFL and len(value) == _COUNT.size:
                self._note_dropped(_COUNT.unpack(value)[0], now)
        age = time.time_ns() - stamp
        frame = from_kernel(data, now - age if 0 <= age < _PLAUSIBLE_NS else now)
        self._watch.observe(frame)
        return frame

    def _note_dropped(self, count: int, now: int) -> None:
        if count != self._dropped:
            self._dropped = count
            details = bytes((0, RX_OVERFLOW, 0, 0, 0, 0, 0, 0))
            self._waiting.append(Frame(CONTROLLER, details, error=True, stamp_ns=now))

    def _failure(self, error: OSError | ValueError) -> BusError:
        code = error.errno if isinstance(error, OSError) else None
        return BusError(kind_of(code, "gone"), self._name, self._bitrate, getattr(error, "strerror", "") or str(error))
