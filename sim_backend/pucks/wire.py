"""An emulated bus in virtual time: one frame after another, the lowest identifier first, each for as long as it takes.

A frame is as long as the standard says without stuff bits, 47 + 8 n bits with its space (FIELDBUS.md 2.1); remote
frames have no data. Nodes have priority mailboxes: of what one drive wants to send, the
lowest identifier goes first, too.

Boundary: order and times of what drives send to the host; what a frame does is `lock_step.py`.
"""

from __future__ import annotations

from sim_backend.pucks.injection import Sent

_OVERHEAD_BITS = 47


class Wire:
    """One bus."""

    def __init__(self, bitrate: int) -> None:
        """An idle bus of this bitrate [1/s]."""
        self._bitrate = bitrate
        self._free_ns = 0
        self._waiting: list[tuple[int, int, Sent]] = []
        self._count = 0
        self._found: tuple[int, tuple[int, int, Sent]] | None = None  # who is next, while it is known

    def duration_ns(self, size: int) -> int:
        """How long a frame of this many bytes takes [ns]."""
        return (_OVERHEAD_BITS + 8 * size) * 1_000_000_000 // self._bitrate

    def occupy(self, now_ns: int, size: int) -> None:
        """A frame of the host's goes out as soon as the wire is free."""
        self._free_ns = max(self._free_ns, now_ns) + self.duration_ns(size)
        self._found = None

    def put(self, sent: Sent) -> None:
        """A drive wants to send."""
        self._waiting.append((sent.ready_ns, self._count, sent))
        self._count += 1
        self._found = None

    @property
    def next_ns(self) -> int | None:
        """When the next frame will have been received; None when none waits."""
        found = self._next()
        return None if found is None else found[0]

    def take(self) -> Sent:
        """The frame that `next_ns` is about; it takes the wire until then."""
        found = self._next()
        assert found is not None  # noqa: S101 whoever takes has looked
        self._free_ns, item = found
        self._waiting.remove(item)
        self._found = None
        return item[2]

    def _next(self) -> tuple[int, tuple[int, int, Sent]] | None:
        """Who wins when the wire is free and somebody wants it."""
        if self._found is not None or not self._waiting:
            return self._found
        start = max(self._free_ns, min(ready for ready, _, _ in self._waiting))
        winner = min(
            (item for item in self._waiting if item[0] <= start), key=lambda item: (item[2].frame.identifier, item[1])
        )
        self._found = start + self.duration_ns(len(winner[2].frame.data)), winner
        return self._found
