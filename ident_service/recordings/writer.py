"""Write one recording: MCAP, profile `ros2`, in chunks that reach the file soon enough to survive a kill -9.

A chunk ends before it passes 64 KiB or 100 ms of sample time and is handed to the operating system at once, so that a
process that is killed loses less than 0.2 s. While it grows the file is called `<path>.partial`; `finish` gives it its
name. Messages are stamped in UTC, the monotonic stamp plus `utc_offset_ns`, which stands in the metadata record
`ident`; that record is written at the start and again, with the verdict `complete`, at the end (the last one counts).
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import IO, Final, Protocol, Self, cast

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from ident_service import __version__
from ident_service.errors import RecordingError, UsageError
from ident_service.recordings.cdr import CycleEncoder, JointStateEncoder, encode_log, encode_string
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.messages import DEFINITIONS, TOPICS

METADATA_NAME: Final = "ident"
CHUNK_BYTES: Final = 64 * 1024
CHUNK_NS: Final = 100_000_000

_RECORD_HEAD: Final = 31  # what MCAP puts before each message's payload
_RESERVED: Final = frozenset({"utc_offset_ns", "torque_hold", "software", "complete"})
_MEDIA_TYPES: Final = {".json": "application/json", ".yaml": "application/yaml", ".yml": "application/yaml"}

Vector = NDArray[np.float64]


class _McapWriter(Protocol):
    """Define the part of `mcap.writer.Writer` used here, with the return types that it leaves out."""

    def start(self, profile: str) -> None: ...
    def register_schema(self, name: str, encoding: str, data: bytes) -> int: ...
    def register_channel(self, topic: str, message_encoding: str, schema_id: int) -> int: ...
    def add_message(self, channel_id: int, log_time: int, data: bytes, publish_time: int, sequence: int) -> None: ...
    def add_metadata(self, name: str, data: dict[str, str]) -> None: ...
    def add_attachment(self, create_time: int, log_time: int, name: str, media_type: str, data: bytes) -> None: ...
    def flush(self) -> None: ...
    def finish(self) -> None: ...


class RecordingWriter:
    """Write a recording as a context manager: entering opens `<path>.partial`, leaving finishes it as `path`.

    A motion that ended in an exception is worth reading too: its recording is finished the same way, with
    `complete = "false"` in the metadata. Only a file that can no longer be written stays under its `.partial` name.
    """

    def __init__(
        self,
        path: Path | str,
        joint_names: Sequence[str],
        robot_description: str,
        utc_offset_ns: int,
        attachments: Mapping[str, bytes] | None = None,
        metadata: Mapping[str, str] | None = None,
    ) -> None:
        """Check the request; nothing is written before the context is entered.

        Args:
            path: the finished file; neither it nor `<path>.partial` may exist.
            joint_names: in the order of every vector.
            robot_description: URDF, as text.
            utc_offset_ns: offset from a stamp to UTC [ns since 1970].
            attachments: file name to content, such as the arm's configuration and the excitation.
            metadata: added to the record `ident`.

        Raises:
            UsageError: no joints, a name twice, a metadata key that the writer sets itself.
        """
        self.path = Path(path)
        self.partial = self.path.with_name(self.path.name + ".partial")
        self.joint_names = tuple(joint_names)
        if not self.joint_names or len(set(self.joint_names)) != len(self.joint_names):
            raise UsageError(f"{self.path}: joint names {self.joint_names} are empty or not unique")
        metadata = dict(metadata or {})
        if taken := _RESERVED & metadata.keys():
            raise UsageError(f"{self.path}: metadata {sorted(taken)} is set by the recording itself")
        self._metadata = {
            "utc_offset_ns": str(utc_offset_ns),
            "torque_hold": "zero_order",
            "software": f"ident-service {__version__}",
            **metadata,
        }
        self._attachments = dict(attachments or {})
        self._description = encode_string(robot_description)
        self._utc_offset_ns = utc_offset_ns
        self._states = JointStateEncoder(self.joint_names)
        self._cycles = CycleEncoder(len(self.joint_names))
        self._file: IO[bytes] | None = None
        self._described = False
        self._sequence = 0
        self._chunk_start_ns: int | None = None
        self._chunk_bytes = 0

    def __enter__(self) -> Self:
        """Create the file.

        Raises:
            UsageError: it exists, finished or partial; an earlier recording is never overwritten.
            RecordingError: it cannot be created.
        """
        if self.path.exists():
            raise UsageError(f"{self.path}: exists already; recordings are never overwritten")
        try:
            self._file = self.partial.open("xb")
        except FileExistsError as error:
            raise UsageError(f"{self.partial}: left by an interrupted recording; rename or remove it") from error
        except OSError as error:
            raise RecordingError(self.partial, f"cannot be created: {error.strerror}") from error
        with self._writing():
            # Chunks are ended here, by time as well as size; the library's own limit only has to be out of the way.
            self._mcap = cast(
                _McapWriter, Writer(self._file, chunk_size=4 * CHUNK_BYTES, compression=CompressionType.ZSTD)
            )
            self._mcap.start(profile="ros2")
            schemas = {
                name: self._mcap.register_schema(name, "ros2msg", text) for name, text in sorted(DEFINITIONS.items())
            }
            self._channels = {
                topic: self._mcap.register_channel(topic, "cdr", schemas[name]) for topic, name in TOPICS.items()
            }
            self._mcap.add_metadata(METADATA_NAME, {**self._metadata, "complete": "false"})
            for name, data in self._attachments.items():
                media_type = _MEDIA_TYPES.get(Path(name).suffix, "application/octet-stream")
                self._mcap.add_attachment(0, 0, name, media_type, data)
            self._mcap.flush()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Finish; a second error while finishing after a first one becomes a note on the first."""
        try:
            self.finish(complete=kind is None)
        except RecordingError as second:
            if error is None:
                raise
            error.add_note(f"the recording could not be finished either: {second}")

    def sample(self, cycle: Cycle) -> None:
        """Write one cycle to `/joint_states`, `/joint_commands`, `/cycle` and, where drives measure, `/joint_torques`.

        Raises:
            RecordingError: the file cannot be written.
            ValueError: an array of another shape.
        """
        utc_ns = cycle.stamp_ns + self._utc_offset_ns
        state = self._states.encode(utc_ns, cycle.position, cycle.velocity, cycle.torque)
        command = self._states.encode(utc_ns, cycle.reference_position, cycle.reference_velocity, None)
        timing = self._cycles.encode(
            utc_ns, cycle.cycle, cycle.lateness_ns, cycle.compute_ns, cycle.valid, cycle.age, cycle.lost
        )
        messages = [("/joint_states", state), ("/joint_commands", command), ("/cycle", timing)]
        if cycle.measured_torque is not None:
            messages.append(("/joint_torques", self._states.encode_effort(utc_ns, cycle.measured_torque)))
        self._add(cycle.stamp_ns, messages, sequence=cycle.cycle)

    def event(self, stamp_ns: int, level: int, message: str) -> None:
        """Write one line to `/events`; `level` is 10 (debug), 20 (info), 30 (warning), 40 (error) or 50 (fatal)."""
        log = encode_log(stamp_ns + self._utc_offset_ns, level, METADATA_NAME, message)
        self._add(stamp_ns, (("/events", log),))

    def finish(self, *, complete: bool = True) -> None:
        """Write the end of the file, force it to the disk and rename it; does nothing the second time.

        Raises:
            RecordingError: one of these failed; what was written stays in `<path>.partial`.
        """
        if self._file is None:
            return
        with self._writing():
            self._mcap.add_metadata(METADATA_NAME, {**self._metadata, "complete": str(complete).lower()})
            self._mcap.finish()
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
            self._file = None
            self.partial.replace(self.path)
            folder = os.open(self.path.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)

    def _add(self, stamp_ns: int, messages: Sequence[tuple[str, bytes]], sequence: int | None = None) -> None:
        if self._file is None:
            raise RecordingError(self.path, "is not open for writing")
        utc_ns = stamp_ns + self._utc_offset_ns
        if not self._described:
            self._described = True
            # Stamped with the first message: at zero, every viewer would show a recording since 1970.
            self._add(stamp_ns, (("/robot_description", self._description),))
        size = sum(_RECORD_HEAD + len(data) for _, data in messages)
        if self._chunk_start_ns is None:
            self._chunk_start_ns = stamp_ns
        with self._writing():
            if self._chunk_bytes + size > CHUNK_BYTES or stamp_ns - self._chunk_start_ns >= CHUNK_NS:
                self._mcap.flush()
                self._chunk_start_ns = stamp_ns
                self._chunk_bytes = 0
            self._chunk_bytes += size
            for topic, data in messages:
                self._mcap.add_message(
                    self._channels[topic], utc_ns, data, utc_ns, self._sequence if sequence is None else sequence
                )
        self._sequence += 1

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Turn a failure of the disk into a RecordingError and leave `.partial` as it is."""
        try:
            yield
        except OSError as error:
            if self._file is not None:
                with suppress(OSError):
                    self._file.close()
                self._file = None
            raise RecordingError(self.partial, f"cannot be written: {error.strerror or error}") from error
