"""Emulate a bus in virtual time: one frame after another, the lowest identifier first, each for its duration.

A frame is as long as the standard says without stuff bits, with its space (`drivers/canopen/frame_bits.py`), on a bus of CAN
FD that of CAN FD; remote frames have no data. Nodes have priority mailboxes: of what one drive wants to send, the
lowest identifier goes first, too.
"""

from __future__ import annotations

from drivers.can.can_frame import Frame
from drivers.canopen.frame_bits import unstuffed
from sim_backend.emulator.injection import Sent

_CLASSIC = 8  # bytes of a classic frame, at most


class Wire:
    """Emulate one bus."""

    def __init__(self, bitrate: int, data_bitrate: int | None = None) -> None:
        """Start with an idle bus of these bit rates [bit/s]; `data_bitrate` None for one without CAN FD."""
        self._rates, self.fd = (bitrate, data_bitrate), data_bitrate is not None
        self._durations: dict[tuple[int, bool], int] = {}
        self._free_ns = 0
        self._waiting: list[tuple[int, int, Sent]] = []
        self._count = 0
        self._found: tuple[int, tuple[int, int, Sent]] | None = None  # the next frame, while it is known

    def as_sent(self, frame: Frame) -> Frame:
        """Return a frame as it is on this bus."""
        return frame._replace(fd=True) if self.fd and not (frame.remote or frame.error) else frame

    def duration_ns(self, frame: Frame) -> int:
        """Return the duration of a frame [ns]."""
        # A length that only CAN FD has takes its bits on any bus: tests send such frames, no controller does.
        kind = len(frame.data), len(frame.data) > _CLASSIC or (self.fd and not (frame.remote or frame.error))
        if (known := self._durations.get(kind)) is None:
            bits, (bitrate, data_bitrate) = unstuffed(kind[0], fd=kind[1]), self._rates
            known = self._durations[kind] = round(1e9 * bits.seconds(bitrate, data_bitrate or bitrate))
        return known

    def occupy(self, now_ns: int, frame: Frame) -> None:
        """Occupy the wire by a frame of the host as soon as it is free."""
        self._free_ns = max(self._free_ns, now_ns) + self.duration_ns(frame)
        self._found = None

    def put(self, sent: Sent) -> None:
        """Queue a frame that a drive wants to send."""
        self._waiting.append((sent.ready_ns, self._count, sent))
        self._count += 1
        self._found = None

    @property
    def next_ns(self) -> int | None:
        """Return when the next frame will have been received; None when none waits."""
        found = self._next()
        return None if found is None else found[0]

    def take(self) -> Sent:
        """Return the frame that `next_ns` is about; it occupies the wire until then."""
        found = self._next()
        assert found is not None  # noqa: S101 the caller has checked `next_ns`
        self._free_ns, item = found
        self._waiting.remove(item)
        self._found = None
        return item[2]

    def _next(self) -> tuple[int, tuple[int, int, Sent]] | None:
        """Return the frame that wins arbitration once the wire is free, with its end; None if none waits."""
        if self._found is not None or not self._waiting:
            return self._found
        start = max(self._free_ns, min(ready for ready, _, _ in self._waiting))
        winner = min(
            (item for item in self._waiting if item[0] <= start), key=lambda item: (item[2].frame.identifier, item[1])
        )
        self._found = start + self.duration_ns(winner[2].frame), winner
        return self._found
