"""Log every frame of a session to a file that other tools read: candump's `.log`, Vector's `.asc` and `.blf`.

The file is written by a process of its own. A thread would be simpler, but it shares Python's interpreter lock: while
it formats, the loop waits, at worst a switch interval of 5 ms. What the loop pays is appending to a list, and one
system call per 16 frames, which never waits: what the process is too slow for is lost and counted. When this process is
killed, the other one finishes the file.
"""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

from drivers.can.can_frame import Frame, pack_frames
from drivers.can.can_link import BusLock, Link
from drivers.clock import Clock
from ident_service.config.arm import ArmConfig
from ident_service.errors import DriverError

SUFFIXES: Final = (".log", ".asc", ".blf")
_BATCH: Final = 16
_HOLD_NS: Final = 20_000_000
_START_S: Final = 30.0
_FINISH_S: Final = 60.0


@dataclass(frozen=True)
class LogReport:
    """Describe how a log ended: frames in the file, frames that are not, and what went wrong, if anything."""

    written: int
    lost: int
    error: str = ""

    def __str__(self) -> str:
        """Return the report in words."""
        lost = f", {self.lost} LOST" if self.lost else ""
        return f"{self.written} frames{lost}" + (f"; {self.error}" if self.error else "")


def require_format(path: Path | str) -> Path:
    """Return the path of a log whose suffix names a format; raises DriverError for another one."""
    if Path(path).suffix.lower() not in SUFFIXES:
        raise DriverError(f"{path}: a log of CAN frames ends in {', '.join(SUFFIXES)}")
    return Path(path)


def logged_links(links: Sequence[Link], log_file: Path, fd: Sequence[bool]) -> tuple[SessionLog, list[Link]]:
    """Wrap links to log frames to a new file; return the log, to be closed last, and these; an error closes `links`.

    Args:
        links: of all buses.
        log_file: of the file.
        fd: whether the data frames of each bus are sent as CAN FD's.

    Raises:
        DriverError: the file cannot be created; the links are closed then.
    """
    try:
        log = SessionLog(log_file, links[0].clock)
    except BaseException:
        for link in links:
            link.close()
        raise
    return log, [log.link(link, number, fd=is_fd) for number, (link, is_fd) in enumerate(zip(links, fd, strict=True))]


class BusSession:
    """Hold what an arm has of its buses beside the links, between `open` and `close`: locks, and a log."""

    def __init__(self, config: ArmConfig, open_bus: Callable[[ArmConfig], list[Link]]) -> None:
        """Use the arm's description; nothing is opened.

        Args:
            config: configuration with a driver on CAN buses.
            open_bus: function that opens the links, in the order of the buses.
        """
        self._config, self._open_bus = config, open_bus
        self._locks: list[BusLock] = []
        self._path: Path | None = None
        self._log: SessionLog | None = None

    def log_frames(self, path: Path) -> None:
        """Have the next session log every frame to this file; DriverError unless it ends in `.log`, `.asc`, `.blf`."""
        self._path = require_format(path)

    def logged(self) -> str:
        """Describe how the log of frames of the last session ended, in words; empty where none was kept."""
        return "" if self._log is None or self._log.report is None else str(self._log.report)

    def open(self, *, locks: bool) -> list[Link]:
        """Lock the buses if `locks`, open their links, logged if asked for, and return them; the caller closes them.

        Raises:
            DriverError: a bus is in use or cannot be had, or the log cannot be created; to be closed then, too.
        """
        self._log = None
        if locks:
            # One by one, so that those had are let go of where another is in use.
            for bus in self._config.can_buses:
                self._locks.append(BusLock(bus))
        links = self._open_bus(self._config)
        if self._path is not None:
            fd = [bus.data_bitrate is not None for bus in self._config.can_buses]
            self._log, links = logged_links(links, self._path, fd)
            self._path = None
        return links

    def close(self) -> None:
        """Release the locks and finish the log, which may take a while: call it last, when the drives are off."""
        for lock in self._locks:
            lock.close()
        self._locks = []
        if self._log is not None:
            self._log.close()


class SessionLog:
    """Write a log of one or several buses; a context manager.

    Attributes:
        path: of the file.
        lost: frames that were dropped because the writing process was behind or gone.
        report: report of the end of the log, None until it has ended.
    """

    def __init__(self, path: Path | str, clock: Clock) -> None:
        """Start the writing process and create the file, which must not exist.

        Args:
            path: path, which ends in one of `SUFFIXES`; `.asc` does not keep what kind of error an error frame tells.
            clock: clock of the stamps.

        Raises:
            DriverError: another suffix, or the file cannot be created.
        """
        self.path = require_format(path)
        self.lost = 0
        self.report: LogReport | None = None
        self._clock = clock
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            # Not from the working directory; in a session of its own, so that Ctrl-C does not cut the log off.
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "drivers.can.frame_log_process"],
                stdin=theirs.fileno(),
                stdout=subprocess.DEVNULL,  # this process' own may be a pipe whose end means that this process is gone
                start_new_session=True,
            )
        request = {"path": str(self.path.absolute()), "utc_offset_ns": clock.utc_offset_ns}
        self._socket.send(json.dumps(request).encode())
        answer = self._answer(_START_S)
        if answer.get("error") != "":
            self._end()
            raise DriverError(f"{path}: {answer.get('error', 'the process that writes the log did not start')}")
        # Time that stands still may wait for the file; a machine's may not.
        self._socket.settimeout(_FINISH_S if clock.lock_step else 0.0)

    def __enter__(self) -> Self:
        """Return this log."""
        return self

    def __exit__(self, *_: object) -> None:
        """Finish the file."""
        self.close()

    def write(self, bus: int, frames: Sequence[tuple[Frame, bool]]) -> None:
        """Send frames of one bus, each with whether it was sent, to the writing process; drops them if it lags."""
        try:
            self._socket.send(bytes((bus,)) + pack_frames(frames))
        except OSError:
            self.lost += len(frames)

    def link(self, link: Link, bus: int = 0, *, fd: bool = False) -> LoggedLink:
        """Return a link around this one, by which all frames sent and received are logged.

        Args:
            link: link of the bus; closed with the returned link.
            bus: number of the bus in the file.
            fd: whether data frames are sent as CAN FD's.
        """
        return LoggedLink(link, self, bus, fd)

    def close(self) -> None:
        """Wait, a minute at most, until the writing process has finished the file, and set `report`."""
        if self.report is not None:
            return
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_WR)
        answer = self._answer(_FINISH_S)
        self.report = LogReport(
            int(str(answer.get("written", 0))),
            self.lost + int(str(answer.get("lost", 0))),
            str(answer.get("error", "the process that writes the log has died; the file may be torn")),
        )
        self._end()

    def _answer(self, seconds: float) -> dict[str, object]:
        self._socket.settimeout(seconds)
        try:
            answer = json.loads(self._socket.recv(65536))
        except (OSError, ValueError):
            return {}
        return answer if isinstance(answer, dict) else {}

    def _end(self) -> None:
        self._socket.close()
        try:
            self._process.wait(_START_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class LoggedLink:
    """Log the frames of a link; sent ones are stamped when they were handed over."""

    def __init__(self, link: Link, log: SessionLog, bus: int, fd: bool) -> None:
        """Wrap a link."""
        self.clock = link.clock
        self._link, self._log, self._bus, self._fd = link, log, bus, fd
        self._held: list[tuple[Frame, bool]] = []
        self._since_ns = 0

    def send(self, frame: Frame) -> None:
        """Send a frame over the link and log it; a frame that the link refuses is not logged."""
        self._link.send(frame)
        self._hold(frame._replace(stamp_ns=self.clock.now_ns(), fd=self._fd and not frame.remote), True)

    def receive(self, deadline_ns: int) -> Frame | None:
        """Receive a frame from the link and log it."""
        frame = self._link.receive(deadline_ns)
        if frame is not None:
            self._hold(frame, False)
        return frame

    def drain(self) -> Sequence[Frame]:
        """Drain the link and log its frames."""
        frames = self._link.drain()
        for frame in frames:
            self._hold(frame, False)
        return frames

    def close(self) -> None:
        """Send the last frames to the log and close the link."""
        self._flush()
        self._link.close()

    def _hold(self, frame: Frame, sent: bool) -> None:
        if not self._held:
            self._since_ns = self.clock.now_ns()
        self._held.append((frame, sent))
        if len(self._held) >= _BATCH or self.clock.now_ns() - self._since_ns > _HOLD_NS:
            self._flush()

    def _flush(self) -> None:
        if self._held:
            held, self._held = self._held, []
            self._log.write(self._bus, held)
