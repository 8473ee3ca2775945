"""Setting interfaces of the kernel up, and another socket on the bus, with nothing of the driver's."""

from __future__ import annotations

import socket
import struct
import subprocess

from drivers.can.can_frame import Frame

_KERNEL = struct.Struct("=IB3x8s")  # struct can_frame, once more and not the link's own
EXTENDED, REMOTE, ERROR = 1 << 31, 1 << 30, 1 << 29


def command(*words: str) -> None:
    """Run it, or say why it fails."""
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, f"{' '.join(words)}: {done.stderr}"


class Neighbour:
    """A socket without filters and without errors."""

    def __init__(self, channel: str) -> None:
        self.socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self.socket.bind((channel,))

    def send(self, word: int, data: bytes = b"") -> None:
        """Word: identifier with its flags."""
        self.socket.send(_KERNEL.pack(word, len(data), data))

    def heard(self) -> list[tuple[int, bytes]]:
        """Words and data of all that waits: on a vcan what was sent has arrived."""
        found = []
        while True:
            try:
                word, length, data = _KERNEL.unpack(self.socket.recv(16, socket.MSG_DONTWAIT))
            except BlockingIOError:
                return found
            found.append((word, data[:length]))


def content(frames: list[Frame] | tuple[Frame, ...]) -> list[Frame]:
    """Without stamps."""
    return [frame._replace(stamp_ns=0) for frame in frames]
