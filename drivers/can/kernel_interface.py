"""Query the kernel about a CAN interface, in the network namespace of this process (netdevice(7))."""

from __future__ import annotations

import errno
import fcntl
import socket
import struct

from drivers.can.bus_errors import BusError
from drivers.can.kernel_frame import FD_BYTES
from ident_service.config.canopen import CanBus

# Values of the kernel's headers; Python defines the CAN ones only where it was built with them.
AF_CAN, CAN_RAW = 29, 1
_SIOCGIFMTU = 0x8921
_REQUEST, _LONGEST_NAME = struct.Struct("16si20x"), 15  # struct ifreq, IFNAMSIZ less its zero


def check_interface(bus: CanBus) -> None:
    """Refuse an interface whose defect would show late: python-can would leave a socket open, CAN FD fail in a cycle.

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


def _largest_packet(channel: str) -> int:
    """Return the largest packet of an interface [bytes]; raises OSError where the kernel does not say."""
    with socket.socket(AF_CAN, socket.SOCK_RAW, CAN_RAW) as sock:
        request = _REQUEST.pack(channel.encode()[:_LONGEST_NAME], 0)
        return int(_REQUEST.unpack(fcntl.ioctl(sock, _SIOCGIFMTU, request))[1])
