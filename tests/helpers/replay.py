"""Replay a logged session to a driver, in virtual time: the logged answers of the drives are received again.

What was received after the k-th SYNC of the log is received after the driver's k-th SYNC, with the same delay; what
came before all SYNCs, with its delay from the first frame that was sent. So a driver that computes faster or slower
than the logged one still receives every answer in its cycle.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from drivers.can.can_frame import ERROR, Frame, check_sendable
from drivers.clock import Clock, VirtualClock
from ident_service.errors import RecordingError

SYNC: Final = 0x080
_MOST_FRAMES = 20_000_000
# candump -L: (seconds) interface identifier#data, ##flags for CAN FD, R for a remote frame; then R or T, or nothing.
_LINE = re.compile(
    r"\((\d+)\.(\d{1,9})\) (\S*?)(\d*) ([0-9A-F]{3}|[0-9A-F]{8})#"
    r"(?:(R)\d?|(#[0-9A-F])?((?:[0-9A-F]{2}){0,64}))(?: ([RT]))?",
    re.IGNORECASE,
)


@dataclass(frozen=True, slots=True)
class LoggedFrame:
    """Represent one frame of a log: its bus, whether the host sent it, and the frame, stamped from the first one on."""

    bus: int
    sent: bool
    frame: Frame


def read_session(path: Path | str) -> list[LoggedFrame]:
    """Read all frames of a log, stamped from the first one on.

    Args:
        path: a `.log` of candump or of this package, an `.asc` or `.blf`.

    Raises:
        RecordingError: a file that cannot be read as such, with the line where it is text.
    """
    path = Path(path)
    try:
        frames = _read_candump(path) if path.suffix.lower() == ".log" else _read_other(path)
        found: list[LoggedFrame] = []
        for logged in frames:
            if len(found) >= _MOST_FRAMES:
                raise RecordingError(path, f"more than {_MOST_FRAMES} frames; cut it")
            found.append(logged)
    except OSError as error:
        raise RecordingError(path, error.strerror or str(error)) from None
    found.sort(key=lambda logged: logged.frame.stamp_ns)
    if not found:
        return found
    start = found[0].frame.stamp_ns
    return [
        LoggedFrame(logged.bus, logged.sent, logged.frame._replace(stamp_ns=logged.frame.stamp_ns - start))
        for logged in found
    ]


def _read_candump(path: Path) -> Iterator[LoggedFrame]:
    with path.open(encoding="utf-8", errors="replace") as lines:
        for number, line in enumerate(lines, 1):
            text = line.strip()
            if not text:
                continue
            if (match := _LINE.fullmatch(text)) is None:
                raise RecordingError(path, f"line {number}: not a frame as candump -L writes it: {text[:60]!r}")
            seconds, fraction, _, bus, identifier, remote, fd, data, direction = match.groups()
            word = int(identifier, 16)
            error = len(identifier) == 8 and bool(word & ERROR)
            frame = Frame(
                word & 0x1FFF_FFFF,
                bytes.fromhex(data or ""),
                remote is not None,
                error,
                len(identifier) == 8 and not error,
                int(seconds) * 1_000_000_000 + int(fraction.ljust(9, "0")),
                fd is not None,
            )
            yield LoggedFrame(int(bus or 0), (direction or "R").upper() == "T", frame)


def _read_other(path: Path) -> Iterator[LoggedFrame]:
    import can  # heavy, and not needed for candump's format

    suffix = path.suffix.lower()
    if suffix not in (".asc", ".blf"):
        raise RecordingError(path, "a log of CAN frames ends in .log, .asc or .blf")
    # Opened here, since a reader that refuses a file leaves it open.
    stream: Any = path.open("rb") if suffix == ".blf" else path.open(encoding="utf-8", errors="replace")
    with stream:
        try:
            for message in can.BLFReader(stream) if suffix == ".blf" else can.ASCReader(stream):
                frame = Frame(
                    0 if message.is_error_frame and not message.data else message.arbitration_id,
                    b"" if message.is_remote_frame else bytes(message.data),
                    message.is_remote_frame,
                    message.is_error_frame,
                    message.is_extended_id and not message.is_error_frame,
                    round(message.timestamp * 1e9),
                    message.is_fd,
                )
                bus = message.channel if isinstance(message.channel, int) else 0
                yield LoggedFrame(bus, not message.is_rx, frame)
        except OSError:
            raise
        except Exception as error:  # python-can's readers raise whatever the bytes lead them to
            raise RecordingError(path, f"not a log of CAN frames: {error}") from error


class ReplayLink:
    """Implement a Link that replays one bus of a log.

    Attributes:
        sent: frames that the driver sent, stamped.
        logged: frames that were sent in the log, to compare with.
    """

    def __init__(self, session: Sequence[LoggedFrame], bus: int = 0, clock: Clock | None = None) -> None:
        """Start before the log's first frame.

        Args:
            session: from `read_session`.
            bus: which one to play.
            clock: shared among the buses of an arm; a virtual one of its own by default.
        """
        self.clock: Clock = clock or VirtualClock()
        self.sent: list[Frame] = []
        mine = [logged for logged in session if logged.bus == bus]
        self.logged = [logged.frame for logged in mine if logged.sent]
        self._marks = [frame.stamp_ns for number, frame in enumerate(self.logged) if _marks(number, frame)]
        self._heard: list[tuple[int, Frame]] = []  # after how many marks, and what
        passed = sent = 0
        for logged in mine:
            if not logged.sent:
                self._heard.append((passed, logged.frame))
            else:
                passed += _marks(sent, logged.frame)
                sent += 1
        self._next = 0
        self._shift_ns = [self.clock.now_ns()]  # from the log's time to the clock's, by marks passed

    @property
    def finished(self) -> bool:
        """Return whether all received frames of the log have been replayed."""
        return self._next >= len(self._heard)

    def send(self, frame: Frame) -> None:
        """Record the sent frame; a SYNC releases the answers to it.

        Raises:
            DriverError: a frame that cannot exist.
        """
        check_sendable(frame, fd=True)
        now = self.clock.now_ns()
        if _marks(len(self.sent), frame) and len(self._shift_ns) <= len(self._marks):
            self._shift_ns.append(now - self._marks[len(self._shift_ns) - 1])
        self.sent.append(frame._replace(stamp_ns=now))

    def receive(self, deadline_ns: int) -> Frame | None:
        """Return the next frame of the log, None when none is due until the deadline [ns of the clock]."""
        frame = self._due(deadline_ns)
        self.clock.sleep_until_ns(deadline_ns if frame is None else frame.stamp_ns)
        return frame

    def drain(self) -> Sequence[Frame]:
        """Return all frames that are due."""
        frames = []
        while (frame := self._due(self.clock.now_ns())) is not None:
            frames.append(frame)
        return frames

    def close(self) -> None:
        """Do nothing: the link holds no resource."""

    def _due(self, until_ns: int) -> Frame | None:
        if self.finished:
            return None
        passed, frame = self._heard[self._next]
        if passed >= len(self._shift_ns) or frame.stamp_ns + self._shift_ns[passed] > until_ns:
            return None
        self._next += 1
        return frame._replace(stamp_ns=frame.stamp_ns + self._shift_ns[passed])


def _marks(number: int, frame: Frame) -> bool:
    """Return whether this sent frame, counted from 0, aligns the log's time with the clock's."""
    return number == 0 or (frame.identifier == SYNC and not frame.extended)
