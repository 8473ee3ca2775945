"""A recording whose samples stay in memory once they have been read, so that decoding is paid for once.

With them stays what was computed from them last, of each kind: their stamps' grid, and the smoothed samples.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from ident_service.config.payload import Payload
from ident_service.recordings.recording import BLOCK_SAMPLES, Block, Matrix, Recording, Stamps, cut, join

MAX_BYTES: Final = 128 << 20  # a quarter of an hour of seven joints at 1 kHz


class Memory:
    """Memory of what was computed from unchanging samples, the last of each kind."""

    def __init__(self, max_bytes: int = MAX_BYTES) -> None:
        """Keep nothing that is larger than `max_bytes`."""
        self.max_bytes = max_bytes
        self._kept: dict[str, tuple[object, Any]] = {}

    def recall(self, kind: str, key: object) -> Any:
        """Return the value remembered for `kind` if its key equals this one; else None."""
        of, value = self._kept.get(kind, (None, None))
        return value if of == key else None

    def remember(self, kind: str, key: object, value: Any) -> None:
        """Keep a value under `kind` with its key, in place of the last of that kind; it must not be written to."""
        self._kept[kind] = (key, value)


def memory_of(recording: Recording) -> Memory | None:
    """Return the memory for computed results of a recording that keeps its samples (or range of it); else None."""
    found = getattr(recording, "memory", None)
    return found if isinstance(found, Memory) else None


def payload_of(recording: Recording) -> Payload | None:
    """Return the known load that the arm carried in a recording, or a range of one; None for none."""
    found = getattr(recording, "payload", None)
    return found if isinstance(found, Payload) else None


class CachedRecording:
    """Cache another recording behind the same protocol; one larger than a bound is read from its file every time.

    Attributes:
        payload: known load that the arm carried, beside that of its description; None for none.
    """

    def __init__(self, whole: Recording, max_bytes: int = MAX_BYTES) -> None:
        """Wrap `whole`, and cache at most `max_bytes` of its samples."""
        self.path: Path = whole.path
        self.sha256 = whole.sha256
        self.joint_names = whole.joint_names
        self.joints = whole.joints
        self.torque_zero_order_hold = whole.torque_zero_order_hold
        self.whole: Recording = whole
        self._whole, self._max_bytes = whole, max_bytes
        self._kept: Block | None = None
        self.memory = Memory(max_bytes)
        self.payload: Payload | None = None

    @property
    def torn(self) -> bool:
        """Return whether the file is damaged or lacks its end mark, and is read up to there; always False for CSV."""
        return self._whole.torn

    @torn.setter
    def torn(self, torn: bool) -> None:
        """Mark the recording that is read from as torn, or not."""
        self._whole.torn = torn

    def blocks(self, samples: int = BLOCK_SAMPLES) -> Iterator[Block]:
        """Yield blocks of `samples` from memory or, the first time, from the file, and then keep them if they fit."""
        if self._kept is not None:
            for start in range(0, len(self._kept.stamp_ns), samples):
                yield cut(self._kept, start, start + samples)
            return
        blocks: list[Block] | None = []
        size = 0
        for block in self._whole.blocks(samples):
            for array in _arrays(block):
                array.setflags(write=False)
                size += array.nbytes
            if blocks is not None and size <= self._max_bytes:
                blocks.append(block)
            else:
                blocks = None
            yield block
        if blocks:
            self._kept = join(blocks)
            for array in _arrays(self._kept):
                array.setflags(write=False)


def _arrays(block: Block) -> list[Matrix | Stamps]:
    arrays: list[Matrix | Stamps] = [block.stamp_ns, block.position, block.torque]
    return arrays if block.velocity is None else [*arrays, block.velocity]
