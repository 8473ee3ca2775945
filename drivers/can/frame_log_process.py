"""Write a session log in a process of its own: packets of frames come on standard input, python-can writes the file.

Frames come in batches per bus, and a received one is stamped before it was read; they are put in the order of their
stamps over half a second. The end of the input is the end of the file, whoever caused it.
"""

from __future__ import annotations

import heapq
import json
import os
import socket
import sys
from contextlib import suppress
from itertools import count as numbers_from
from pathlib import Path
from typing import IO, Any, Final, Protocol, cast

import can
from can.io.canutils import CanutilsLogWriter

from drivers.can.can_frame import ERROR, MAX_PACKET_BYTES, Frame, unpack_frames
from ident_service.errors import DriverError

_WINDOW_NS: Final = 500_000_000


class _Writer(Protocol):
    file: IO[Any]

    def on_message_received(self, msg: can.Message) -> None: ...

    def stop(self) -> None: ...


class CandumpWriter(CanutilsLogWriter):
    """Write candump logs like python-can, but with the details of error frames, as `candump -L` writes them."""

    def on_message_received(self, msg: can.Message) -> None:
        """Write one frame to the file, an error frame with its details."""
        if msg.is_error_frame:
            word, data = msg.arbitration_id | ERROR, bytes(msg.data).hex().upper()
            self.file.write(f"({msg.timestamp:f}) can{msg.channel} {word:08X}#{data}\n")
        else:
            super().on_message_received(msg)


def to_can_message(frame: Frame, bus: int, sent: bool, utc_offset_ns: int) -> can.Message:
    """Convert a frame to the message that python-can's writers take."""
    return can.Message(
        timestamp=(frame.stamp_ns + utc_offset_ns) * 1e-9,
        arbitration_id=frame.identifier,
        is_extended_id=frame.extended,
        is_remote_frame=frame.remote,
        is_error_frame=frame.error,
        is_fd=frame.fd,
        bitrate_switch=frame.fd,
        data=None if frame.remote else frame.data,
        channel=bus,
        is_rx=not sent,
    )


class OrderedLog:
    """Write a file whose frames are in the order of their stamps.

    Attributes:
        written: frames in the file.
    """

    def __init__(self, path: Path, utc_offset_ns: int) -> None:
        """Create the file, which must not exist.

        Raises:
            OSError: it cannot be created.
        """
        suffix = path.suffix.lower()
        kind = {".asc": can.ASCWriter, ".blf": can.BLFWriter, ".log": CandumpWriter}[suffix]
        stream: IO[Any] = path.open("xb") if suffix == ".blf" else path.open("x", encoding="utf-8")
        self._writer = cast(_Writer, kind(cast(Any, stream)))
        self._utc_offset_ns = utc_offset_ns
        self._heap: list[tuple[int, int, Frame, int, bool]] = []
        self._numbers = numbers_from()
        self.written = 0

    def add(self, bus: int, frames: list[tuple[Frame, bool]]) -> None:
        """Add frames of one bus; write, in the order of stamps, all that are a fixed time older than the newest."""
        for frame, sent in frames:
            heapq.heappush(self._heap, (frame.stamp_ns, next(self._numbers), frame, bus, sent))
        newest = max(frame.stamp_ns for frame, _ in frames)
        self._write_until(newest - _WINDOW_NS)

    def close(self) -> None:
        """Write the rest and finish the file."""
        self._write_until(None)
        self._writer.stop()

    def _write_until(self, stamp_ns: int | None) -> None:
        count = 0
        while self._heap and (stamp_ns is None or self._heap[0][0] <= stamp_ns):
            _, _, frame, bus, sent = heapq.heappop(self._heap)
            self._writer.on_message_received(to_can_message(frame, bus, sent, self._utc_offset_ns))
            count += 1
        if count:
            self._writer.file.flush()
            self.written += count  # only now, since the disk may have refused


def main() -> int:
    """Write one log of the frame packets from the socket on standard input; return 0 when all are in it, else 1."""
    _step_back()
    with socket.socket(fileno=sys.stdin.fileno()) as source:
        return _serve(source)


def _step_back() -> None:
    """Give up the real-time priority and the core that children of the loop's process inherit."""
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    with suppress(OSError):
        os.sched_setaffinity(0, range(os.cpu_count() or 1))


def _serve(source: socket.socket) -> int:
    log: OrderedLog | None = None
    error, taken = "", 0
    try:
        request = json.loads(source.recv(65536))
        log = OrderedLog(Path(request["path"]), request["utc_offset_ns"])
        _send_answer(source, {"error": ""})
        while packet := source.recv(MAX_PACKET_BYTES + 1):
            frames = unpack_frames(packet[1:])
            taken += len(frames)
            log.add(packet[0], frames)
    except FileExistsError:
        error = "exists already; take another name"
    except (OSError, DriverError) as found:
        error = getattr(found, "strerror", None) or str(found)
    if log is not None:
        if error:  # what is left unread when the socket closes would hide the answer
            with suppress(OSError, DriverError):
                while packet := source.recv(MAX_PACKET_BYTES + 1):
                    taken += len(unpack_frames(packet[1:]))
        try:
            log.close()
        except OSError as found:
            error = error or found.strerror or str(found)
    written = 0 if log is None else log.written
    _send_answer(source, {"error": error, "written": written, "lost": taken - written})
    return 1 if error else 0


def _send_answer(source: socket.socket, answer: dict[str, object]) -> None:
    with suppress(OSError):  # the session's process may be gone
        source.send(json.dumps(answer).encode())


if __name__ == "__main__":
    sys.exit(main())
