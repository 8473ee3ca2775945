"""Read the timing of the control loop from `/cycle` of this package's MCAP recordings."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final

import numpy as np
from numpy.typing import NDArray

from ident_service.errors import RecordingError
from ident_service.recordings import mcap_records as mcap
from ident_service.recordings.cdr import ENCAPSULATION
from ident_service.recordings.files import require_file
from ident_service.recordings.messages import CYCLE

TOPIC: Final = "/cycle"
_COUNT: Final = 44  # where the number of axes stands, behind stamp, empty frame_id, cycle, lateness and compute
_CHUNK: Final = 8192


@dataclass(frozen=True)
class Cycles:
    """Hold the timing and axis status of consecutive cycles of a loop.

    Attributes:
        lateness_ns: how late each began [ns], shape (cycles,).
        compute_ns: how long each computed [ns], shape (cycles,).
        valid: which axes answered, shape (cycles, axes).
        age: cycles since each answered, shape (cycles, axes).
        lost: frames lost so far, shape (cycles,).
    """

    lateness_ns: NDArray[np.int64]
    compute_ns: NDArray[np.int64]
    valid: NDArray[np.bool_]
    age: NDArray[np.uint32]
    lost: NDArray[np.uint32]


def read_cycles(path: Path) -> Iterator[Cycles]:
    """Read `/cycle` in order, some thousand cycles at a time, up to where the file is cut off or damaged.

    Yields nothing from a file that is not MCAP or has no such topic of this package's type.

    Raises:
        UsageError: no such file.
        RecordingError: a message that is not what its type says, or a chunk that expands beyond 64 MiB.
    """
    require_file(path)
    try:
        with path.open("rb") as stream:
            size = stream.seek(0, 2)
            stream.seek(0)
            if stream.read(len(mcap.MAGIC)) == mcap.MAGIC:
                yield from _decoded(path, _payloads(stream, size))
    except (mcap.TooLargeError, OSError) as error:
        raise RecordingError(path, str(error)) from error


def _payloads(stream: IO[bytes], size: int) -> Iterator[bytes]:
    directory = mcap.Directory()

    def choose(channel_id: int) -> bool:
        channel = directory.channels.get(channel_id)
        return channel is not None and channel.topic == TOPIC and directory.schema_of(channel) == CYCLE

    try:
        for run in mcap.contents(stream, size):
            for _, _, payload in mcap.messages(run, directory, choose):
                yield payload
    except mcap.TornError:
        return


def _decoded(path: Path, payloads: Iterator[bytes]) -> Iterator[Cycles]:
    kind: np.dtype[np.void] | None = None
    waiting: list[bytes] = []
    for payload in payloads:
        if kind is None:
            kind = _layout(path, payload)
        if len(payload) != kind.itemsize or payload[: len(ENCAPSULATION)] != ENCAPSULATION:
            raise RecordingError(path, f"{TOPIC} changes its number of axes; it is not a recording of one arm")
        waiting.append(payload)
        if len(waiting) == _CHUNK:
            yield _columns(waiting, kind)
            waiting = []
    if waiting and kind is not None:
        yield _columns(waiting, kind)


def _columns(payloads: list[bytes], kind: np.dtype[np.void]) -> Cycles:
    rows = np.frombuffer(b"".join(payloads), kind)
    return Cycles(rows["lateness"], rows["compute"], rows["valid"] != 0, rows["age"], rows["lost"])


def _layout(path: Path, payload: bytes) -> np.dtype[np.void]:
    """Return the layout of the fields in a payload; the counterpart of `CycleEncoder`."""
    try:
        (axes,) = struct.unpack_from("<I", payload, _COUNT)
    except struct.error:
        axes = 0
    valid = _COUNT + 4
    age = valid + axes + -axes % 4 + 4
    if not axes or len(payload) != age + 4 * axes + 4:
        raise RecordingError(path, f"{TOPIC}: a message that is not {CYCLE}")
    return np.dtype(
        {
            "names": ["lateness", "compute", "valid", "age", "lost"],
            "formats": ["<i8", "<i8", ("u1", (axes,)), ("<u4", (axes,)), "<u4"],
            "offsets": [28, 36, valid, age, age + 4 * axes],
            "itemsize": len(payload),
        }
    )
