"""Write one recording: MCAP of profile `ros2`, in chunks that reach the file while the arm moves.

A reader that knows nothing of ROS packages finds here all it needs: after the message's own definition comes each
type it uses, behind a line of `=` and a line `MSG: package/Type`. `ident_msgs/msg/Cycle` is our own.

A payload is the encapsulation header `00 01 00 00` and then the fields, each aligned to its own size counted from
behind that header. All that is equal from sample to sample is laid out once per recording.

A chunk ends before it passes 64 KiB or 100 ms of sample time and is handed to the operating system at once, so that a
process that is killed loses less than 0.2 s. While it grows the file is called `<path>.partial`; `finish` gives it its
name. Messages are stamped in UTC, the monotonic stamp plus `utc_offset_ns`, which stands in the metadata record
`ident`; that record is written at the start and again, with the verdict `complete`, at the end (the last one counts).

The channels say what quality of service a replay is to offer, so that `ros2 bag play` latches `/robot_description`. The
record `rosbag2` without content tells rosbag2 that the policies are numbers, as before version 9 of its metadata.

Where a drive tells no velocity, `/joint_states` has the difference of successive positions behind a low-pass filter
of first order, and the metadata key `velocity` says so. It is for people who look: readers here take it for none.
"""

from __future__ import annotations

import os
import struct
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import IO, Final, Protocol, Self, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ident_service import __version__
from ident_service.errors import RecordingError, RecordingNotWritten, UsageError
from ident_service.recordings.cycle import Cycle

_SEPARATOR: Final = "=" * 80

_TIME: Final = "int32 sec\nuint32 nanosec\n"
_HEADER: Final = "builtin_interfaces/Time stamp\nstring frame_id\n"

_JOINT_STATE: Final = """\
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
"""

_LOG: Final = """\
byte DEBUG=10
byte INFO=20
byte WARN=30
byte ERROR=40
byte FATAL=50
builtin_interfaces/Time stamp
uint8 level
string name
string msg
string file
string function
uint32 line
"""

_CYCLE: Final = """\
std_msgs/Header header
uint64 cycle
int64 lateness_ns
int64 compute_ns
bool[] valid
uint32[] age
uint32 lost
"""


def _definition(own: str, *dependencies: tuple[str, str]) -> bytes:
    parts = [own, *(f"{_SEPARATOR}\nMSG: {name}\n{text}" for name, text in dependencies)]
    return "".join(parts).encode()


_TIME_ENTRY: Final = ("builtin_interfaces/Time", _TIME)
_HEADER_ENTRY: Final = ("std_msgs/Header", _HEADER)

JOINT_STATE: Final = "sensor_msgs/msg/JointState"
STRING: Final = "std_msgs/msg/String"
LOG: Final = "rcl_interfaces/msg/Log"
CYCLE: Final = "ident_msgs/msg/Cycle"

DEFINITIONS: Final[dict[str, bytes]] = {
    JOINT_STATE: _definition(_JOINT_STATE, _HEADER_ENTRY, _TIME_ENTRY),
    STRING: _definition("string data\n"),
    LOG: _definition(_LOG, _TIME_ENTRY),
    CYCLE: _definition(_CYCLE, _HEADER_ENTRY, _TIME_ENTRY),
}

TOPICS: Final[dict[str, str]] = {
    "/joint_states": JOINT_STATE,
    "/joint_commands": JOINT_STATE,
    "/joint_torques": JOINT_STATE,
    "/joint_encoders": JOINT_STATE,
    "/cycle": CYCLE,
    "/events": LOG,
    "/robot_description": STRING,
}

# Numbers of rmw's enumerations: keep last, reliable, volatile or transient local, automatic liveliness; a time of
# zero means none.
_QOS: Final = """\
- history: 1
  depth: {depth}
  reliability: 1
  durability: {durability}
  deadline: {{sec: 0, nsec: 0}}
  lifespan: {{sec: 0, nsec: 0}}
  liveliness: 1
  liveliness_lease_duration: {{sec: 0, nsec: 0}}
  avoid_ros_namespace_conventions: false
"""
_TRANSIENT_LOCAL, _VOLATILE = 1, 2
_LATCHED: Final = frozenset({"/robot_description"})


def _offered_qos(topic: str) -> str:
    latched = topic in _LATCHED
    return _QOS.format(depth=1 if latched else 10, durability=_TRANSIENT_LOCAL if latched else _VOLATILE)


ENCAPSULATION: Final = b"\x00\x01\x00\x00"
_STAMP: Final = struct.Struct("<iI")
_NO_ELEMENTS: Final = struct.pack("<I", 0)


class CdrBuilder:
    """Append fields one after the other, each at its alignment."""

    def __init__(self) -> None:
        self._data = bytearray()

    def align(self, size: int) -> None:
        """Append zeros up to the next multiple of `size` [bytes]."""
        self._data.extend(bytes(-len(self._data) % size))

    def uint8(self, value: int) -> None:
        """Append one byte."""
        self._data.append(value)

    def uint32(self, value: int) -> None:
        """Append four bytes, little-endian, at the next multiple of four."""
        self.align(4)
        self._data += struct.pack("<I", value)

    def stamp(self, utc_ns: int) -> None:
        """Append a builtin_interfaces/Time, aligned to four bytes, from nanoseconds since 1970."""
        self.align(4)
        self._data += stamp_bytes(utc_ns)

    def string(self, value: str) -> None:
        """Append a CDR string: aligned length with the closing zero, the bytes in UTF-8, and the zero."""
        encoded = value.encode()
        self.uint32(len(encoded) + 1)
        self._data += encoded + b"\x00"

    def body(self) -> bytes:
        """Return the bytes appended so far, without the encapsulation header."""
        return bytes(self._data)

    def payload(self) -> bytes:
        """Return the whole message: encapsulation header, then the bytes appended so far."""
        return ENCAPSULATION + self._data


def stamp_bytes(utc_ns: int) -> bytes:
    """Return the eight bytes of a builtin_interfaces/Time: seconds rounded down, and nanoseconds."""
    return _STAMP.pack(*divmod(utc_ns, 1_000_000_000))


def encode_string(data: str) -> bytes:
    """Return the payload of a std_msgs/msg/String."""
    builder = CdrBuilder()
    builder.string(data)
    return builder.payload()


def encode_log(utc_ns: int, level: int, logger_name: str, message: str) -> bytes:
    """Return the payload of a rcl_interfaces/msg/Log; `level` is 10 (debug), 20, 30, 40 or 50 (fatal)."""
    builder = CdrBuilder()
    builder.stamp(utc_ns)
    builder.uint8(level)
    for text in (logger_name, message, "", ""):
        builder.string(text)
    builder.uint32(0)
    return builder.payload()


def _until_values(joint_names: Sequence[str], frame_id: str, *counts: int) -> bytes:
    """Encode a JointState from behind its stamp to its first values; `counts` of position, velocity and so on."""
    builder = CdrBuilder()
    builder.stamp(0)
    builder.string(frame_id)
    builder.uint32(len(joint_names))
    for name in joint_names:
        builder.string(name)
    for count in counts:
        builder.uint32(count)
    builder.align(8)
    return builder.body()[_STAMP.size :]


class JointStateEncoder:
    """Encode sensor_msgs/msg/JointState of always the same joints and frame."""

    def __init__(self, joint_names: Sequence[str], frame_id: str = "") -> None:
        self._joints = len(joint_names)
        self._until_position = _until_values(joint_names, frame_id, self._joints)
        self._until_effort = _until_values(joint_names, frame_id, 0, 0, self._joints)
        # Behind 8-byte values a count needs four bytes more to the next ones; behind an empty sequence's count, none.
        self._count = struct.pack("<I", self._joints)
        self._count_aligned = struct.pack("<I4x", self._joints)

    def encode_effort(self, utc_ns: int, effort: ArrayLike) -> bytes:
        """Return the payload of a JointState that has only effort, no position or velocity.

        Args:
            utc_ns: stamp [ns since 1970].
            effort: [N m or N], shape (joints,).

        Raises:
            ValueError: an array of another shape.
        """
        return b"".join((ENCAPSULATION, stamp_bytes(utc_ns), self._until_effort, self._floats(effort)))

    def encode(self, utc_ns: int, position: ArrayLike, velocity: ArrayLike | None, effort: ArrayLike | None) -> bytes:
        """Return the payload of a JointState; velocity or effort of None become empty sequences.

        Args:
            utc_ns: stamp [ns since 1970].
            position: [rad or m], shape (joints,).
            velocity: [rad/s or m/s], shape (joints,), or None for an empty sequence.
            effort: [N m or N], shape (joints,), or None for an empty sequence.

        Raises:
            ValueError: an array of another shape.
        """
        parts = [ENCAPSULATION, stamp_bytes(utc_ns), self._until_position, self._floats(position)]
        if velocity is None:
            parts.append(_NO_ELEMENTS)
        else:
            parts += (self._count_aligned, self._floats(velocity))
        if effort is None:
            parts.append(_NO_ELEMENTS)
        else:
            parts += (self._count if velocity is None else self._count_aligned, self._floats(effort))
        return b"".join(parts)

    def _floats(self, values: ArrayLike) -> bytes:
        array: NDArray[np.float64] = np.asarray(values, dtype="<f8")
        if array.shape != (self._joints,):
            raise ValueError(f"{array.shape=} but the recording has {self._joints} joints")
        return array.tobytes()


class CycleEncoder:
    """Encode ident_msgs/msg/Cycle of a fixed number of axes, with an empty frame_id."""

    def __init__(self, axes: int) -> None:
        self._axes = axes
        self._struct = struct.Struct(f"<4s iI I1x 3x Qqq I{axes}s{-axes % 4}x I{4 * axes}s I")

    def encode(
        self,
        utc_ns: int,
        cycle: int,
        lateness_ns: int,
        compute_ns: int,
        valid: ArrayLike,
        age: ArrayLike,
        lost: int,
    ) -> bytes:
        """Return the payload of one `/cycle` message: lateness, computing time, validity and age per axis.

        Args:
            utc_ns: stamp [ns since 1970].
            cycle: number of the cycle.
            lateness_ns: how late the cycle began [ns].
            compute_ns: how long it computed [ns].
            valid: mask of the axes that answered, shape (axes,).
            age: number of cycles since each axis answered, shape (axes,).
            lost: frames lost so far.

        Raises:
            ValueError: an array of another shape.
        """
        flags = np.asarray(valid, dtype=np.bool_)
        ages = np.asarray(age).astype("<u4")
        if flags.shape != (self._axes,) or ages.shape != (self._axes,):
            raise ValueError(f"{flags.shape=}, {ages.shape=} but the recording has {self._axes} axes")
        seconds, nanoseconds = divmod(utc_ns, 1_000_000_000)
        return self._struct.pack(
            *(ENCAPSULATION, seconds, nanoseconds, 1, cycle, lateness_ns, compute_ns),
            *(self._axes, flags.tobytes(), self._axes, ages.tobytes(), lost),
        )


METADATA_NAME: Final = "ident"
VELOCITY: Final = "velocity"  # key of the metadata record
DIFFERENCE: Final = "position_difference"  # its value where the drives told no velocity
_LOW_PASS_S: Final = 1.0 / (2.0 * np.pi * 20.0)  # of a cut-off at 20 Hz: an encoder's step in 1 ms is 0.1 rad/s
CHUNK_BYTES: Final = 64 * 1024
CHUNK_NS: Final = 100_000_000

_RECORD_HEAD: Final = 31  # what MCAP puts before each message's payload
_RESERVED: Final = frozenset({"utc_offset_ns", "torque_hold", "software", "complete", VELOCITY})
_MEDIA_TYPES: Final = {".json": "application/json", ".yaml": "application/yaml", ".yml": "application/yaml"}

Vector = NDArray[np.float64]


class _McapWriter(Protocol):
    """Define the part of `mcap.writer.Writer` used here, with the return types that it leaves out."""

    def start(self, profile: str) -> None: ...
    def register_schema(self, name: str, encoding: str, data: bytes) -> int: ...
    def register_channel(self, topic: str, message_encoding: str, schema_id: int, metadata: dict[str, str]) -> int: ...
    def add_message(self, channel_id: int, log_time: int, data: bytes, publish_time: int, sequence: int) -> None: ...
    def add_metadata(self, name: str, data: dict[str, str]) -> None: ...
    def add_attachment(self, create_time: int, log_time: int, name: str, media_type: str, data: bytes) -> None: ...
    def flush(self) -> None: ...
    def finish(self) -> None: ...


class _VelocityEstimate:
    """Differentiate positions as they come."""

    def __init__(self) -> None:
        self._stamp_ns = 0
        self._position: Vector | None = None
        self._velocity: Vector = np.zeros(0)

    def at(self, stamp_ns: int, position: Vector) -> Vector:
        """Return the velocity [rad/s or m/s], shape (joints,), zero at the first position."""
        if self._position is None:
            self._velocity = np.zeros(len(position))
        elif (step := (stamp_ns - self._stamp_ns) * 1e-9) > 0.0:
            share = step / (step + _LOW_PASS_S)
            self._velocity += share * ((position - self._position) / step - self._velocity)
        self._stamp_ns, self._position = stamp_ns, np.array(position)
        return self._velocity


def root_link(urdf: str) -> str:
    """Return the name of a URDF's link that no joint carries; empty where the text is no XML or has none."""
    try:
        robot = ET.fromstring(urdf)  # noqa: S314 - written by this package, or by the caller for its own file
    except ET.ParseError:
        return ""
    carried = {child.get("link") for child in robot.iterfind("joint/child")}
    return next((name for link in robot.iterfind("link") if (name := link.get("name", "")) not in carried), "")


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
            joint_names: names of the joints, in the order of every vector.
            robot_description: URDF, as text.
            utc_offset_ns: offset from a stamp to UTC [ns since 1970].
            attachments: file name to content, such as the arm's configuration and the excitation.
            metadata: entries added to the record `ident`.

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
        self._states = JointStateEncoder(self.joint_names, root_link(robot_description))
        self._estimate: _VelocityEstimate | None = None
        self._sampled = False
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
        from mcap.writer import CompressionType, Writer  # loads for 0.04 s, and readers share this module's names

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
                topic: self._mcap.register_channel(
                    topic, "cdr", schemas[name], {"offered_qos_profiles": _offered_qos(topic)}
                )
                for topic, name in TOPICS.items()
            }
            self._mcap.add_metadata("rosbag2", {"serialized_metadata": ""})
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
        """Write one cycle: `/joint_states`, `/joint_commands`, `/cycle`, and measured torque and encoders if given.

        Raises:
            RecordingNotWritten: the file cannot be written.
            ValueError: an array of another shape.
        """
        if not self._sampled:
            self._sampled = True
            if cycle.velocity is None:
                self._estimate_velocity()
        velocity = cycle.velocity if self._estimate is None else self._estimate.at(cycle.stamp_ns, cycle.position)
        utc_ns = cycle.stamp_ns + self._utc_offset_ns
        state = self._states.encode(utc_ns, cycle.position, velocity, cycle.torque)
        command = self._states.encode(utc_ns, cycle.reference_position, cycle.reference_velocity, cycle.torque)
        timing = self._cycles.encode(
            utc_ns, cycle.cycle, cycle.lateness_ns, cycle.compute_ns, cycle.valid, cycle.age, cycle.lost
        )
        messages = [("/joint_states", state), ("/joint_commands", command), ("/cycle", timing)]
        if cycle.measured_torque is not None:
            messages.append(("/joint_torques", self._states.encode_effort(utc_ns, cycle.measured_torque)))
        if cycle.joint_position is not None:
            messages.append(("/joint_encoders", self._states.encode(utc_ns, cycle.joint_position, None, None)))
        self._add(cycle.stamp_ns, messages, sequence=cycle.cycle)

    def event(self, stamp_ns: int, level: int, message: str) -> None:
        """Write a line to `/events`; `level` is 10 (debug), 20 (info), 30 (warning), 40 (error) or 50 (fatal)."""
        log = encode_log(stamp_ns + self._utc_offset_ns, level, METADATA_NAME, message)
        self._add(stamp_ns, (("/events", log),))

    def finish(self, *, complete: bool = True) -> None:
        """Write `complete` as metadata, end the file, force it to disk, rename `<path>.partial` to `path`; once only.

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

    def _estimate_velocity(self) -> None:
        """Say before the first sample that velocities are none of the drives', also in a file that is cut off later."""
        if self._file is None:
            raise RecordingError(self.path, "is not open for writing")
        self._estimate = _VelocityEstimate()
        self._metadata[VELOCITY] = DIFFERENCE
        with self._writing():
            self._mcap.add_metadata(METADATA_NAME, {**self._metadata, "complete": "false"})

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
            raise RecordingNotWritten(self.partial, f"cannot be written: {error.strerror or error}") from error
