"""Read JointState recordings in MCAP: our own, and ROS 2 bags from anywhere.

Messages of one publisher differ in the stamp and the numbers only, so one is parsed field by field and the rest are
read as columns, after a check that their names and counts are byte for byte the same.

This package's files say in their metadata how far UTC is from the monotonic clock, and that torque is held from stamp
to stamp; for a bag neither is known. A file that was cut off is read up to the cut, so is one with a damaged chunk.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import IO, Final, Self

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from ident_service.config.recording import RecordingFormat
from ident_service.errors import RecordingError
from ident_service.recordings import mcap_records as mcap
from ident_service.recordings.files import require_file, sha256
from ident_service.recordings.mcap_writer import (
    CYCLE,
    DIFFERENCE,
    ENCAPSULATION,
    JOINT_STATE,
    LOG,
    METADATA_NAME,
    STRING,
    VELOCITY,
)
from ident_service.recordings.recording import BLOCK_SAMPLES, Block, Matrix, Stamps, assemble

_LITTLE_ENDIAN_CDR: Final = b"\x00\x01"
_BODY: Final = 4  # bytes of the encapsulation header, from behind which alignment counts
_UINT32: Final = struct.Struct("<I")
_STAMP: Final = slice(4, 12)
_MAX_LAYOUTS: Final = 16


class PayloadError(ValueError):
    """Report a payload that is no JointState, or not the expected one; `index` counts within the call."""

    def __init__(self, message: str, index: int = 0) -> None:
        self.index = index
        super().__init__(message)


@dataclass(frozen=True)
class Layout:
    """Describe where the numbers stand in a payload of a given length and given joint names.

    Attributes:
        names: of the joints, in the payload's order.
        position: offset of the first value [bytes], None where the sequence is empty; velocity and effort likewise.
        fixed: offsets of all bytes that make it this layout, shape (bytes,).
        expected: values of these bytes, shape (bytes,).
    """

    names: tuple[str, ...]
    position: int | None
    velocity: int | None
    effort: int | None
    fixed: NDArray[np.intp]
    expected: NDArray[np.uint8]

    @classmethod
    def parse(cls, payload: bytes) -> Self:
        """Find where the values stand in one JointState payload; raises PayloadError if it is none or inconsistent.

        Raises:
            PayloadError: not a JointState in little-endian CDR, or its sequences differ in length.
        """
        if payload[:2] != _LITTLE_ENDIAN_CDR:
            raise PayloadError(f"encapsulation {payload[:2].hex()} is not little-endian CDR (0001)")
        fixed = [np.arange(2)]
        position = _STAMP.stop

        def count() -> int:
            nonlocal position
            position += (_BODY - position) % 4
            if position + 4 > len(payload):
                raise PayloadError("the message ends too early")
            fixed.append(np.arange(position, position + 4))
            value: int = _UINT32.unpack_from(payload, position)[0]
            position += 4
            if value > len(payload):
                raise PayloadError("the message ends too early")
            return value

        # The frame's length moves everything behind it; its content is not used.
        frame = count()
        position += frame
        names = []
        for _ in range(count()):
            start, length = position, count()
            start, position = position, position + length
            fixed.append(np.arange(start, position))
            names.append(payload[start : position - 1].decode("utf-8", errors="replace"))
        starts: dict[str, int | None] = {}
        for what in ("position", "velocity", "effort"):
            values = count()
            if values == 0:
                starts[what] = None
                continue
            if values != len(names):
                raise PayloadError(f"{len(names)} joint names but {values} values of {what}")
            position += (_BODY - position) % 8
            starts[what] = position
            position += 8 * values
        if position > len(payload):
            raise PayloadError("the message ends too early")
        if len(set(names)) != len(names):
            raise PayloadError(f"a joint name appears twice in {names}")
        where = np.concatenate(fixed)
        return cls(tuple(names), **starts, fixed=where, expected=np.frombuffer(payload, np.uint8)[where])

    def matches(self, payload_rows: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Return a mask of the payloads, one a row of bytes, that have this layout."""
        same: NDArray[np.bool_] = (payload_rows[:, self.fixed] == self.expected).all(axis=1)
        return same

    def columns(self, payload_rows: NDArray[np.uint8], start_byte: int, joint_order: NDArray[np.intp]) -> Matrix:
        """Return the float64 sequence at `start_byte` of all payloads, in `joint_order`, shape (payloads, joints)."""
        values = payload_rows[:, start_byte : start_byte + 8 * len(self.names)]
        return np.ascontiguousarray(values).view("<f8")[:, joint_order].astype(np.float64, copy=False)


class JointStateDecoder:
    """Decode payloads into columns of chosen joints.

    Args:
        names: joints wanted, in the order of the columns.
        others: whether payloads may hold more joints than these, or none of them (another publisher on the same
            topic; such payloads are left out).
        velocity: whether velocity is wanted; it must then be in every payload.
    """

    def __init__(self, names: Sequence[str], *, others: bool, velocity: bool) -> None:
        self._names = tuple(names)
        self._others = others
        self._velocity = velocity

    def decode(self, payloads: Sequence[bytes] | NDArray[np.uint8], log_times: Sequence[int] | Stamps) -> Block:
        """Decode JointState payloads into one block, in order, but those of foreign joints; PayloadError with `index`.

        Args:
            payloads: JointState messages; of those of one length also as rows, shape (messages, bytes).
            log_times: [ns], for those whose header has no stamp.

        Raises:
            PayloadError: a payload that cannot be used; `index` says which.
        """
        n, joints = len(payloads), len(self._names)
        stamp: Stamps = np.zeros(n, np.int64)
        position: Matrix = np.empty((n, joints))
        velocity: Matrix = np.empty((n, joints))
        effort: Matrix = np.empty((n, joints))
        used = np.zeros(n, np.bool_)
        for left, rows in _by_length(payloads):
            for _ in range(_MAX_LAYOUTS):
                try:
                    layout = Layout.parse(rows[0].tobytes())
                    order = self._order(layout)
                except PayloadError as error:
                    raise PayloadError(str(error), int(left[0])) from error
                same = layout.matches(rows)
                if order is not None:
                    here, part = left[same], rows[same]
                    used[here] = True
                    seconds, nanoseconds = np.ascontiguousarray(part[:, _STAMP]).view("<u4").T
                    stamp[here] = seconds.view(np.int32).astype(np.int64) * 1_000_000_000 + nanoseconds
                    for start, values in (
                        (layout.position, position),
                        (layout.velocity if self._velocity else None, velocity),
                        (layout.effort, effort),
                    ):
                        if start is not None:
                            values[here] = layout.columns(part, start, order)
                left, rows = left[~same], rows[~same]
                if not len(left):
                    break
            else:
                raise PayloadError("the joint names change from message to message", int(left[0]))
        stamp = np.where(stamp == 0, np.asarray(log_times, np.int64), stamp)
        return Block(stamp[used], position[used], effort[used], velocity[used] if self._velocity else None)

    def _order(self, layout: Layout) -> NDArray[np.intp] | None:
        """Return the indices in the payload of the wanted joints, None for a payload to leave out."""
        present = set(layout.names)
        missing = [name for name in self._names if name not in present]
        if self._others and len(missing) == len(self._names):
            return None
        if missing:
            raise PayloadError(f"lacks joints {missing}; it has {list(layout.names)}")
        if not self._others and len(present) != len(self._names):
            raise PayloadError(f"has joints {list(layout.names)} where the first has {list(self._names)}")
        if layout.position is None or layout.effort is None:
            raise PayloadError(f"has no {'position' if layout.position is None else 'effort (torque)'}")
        if self._velocity and layout.velocity is None:
            raise PayloadError("has no velocity where the first has one")
        return np.array([layout.names.index(name) for name in self._names], np.intp)


def _joined(payloads: Sequence[bytes | NDArray[np.uint8]]) -> list[bytes] | NDArray[np.uint8]:
    """Return payloads as rows, shape (payloads, bytes), where they are of one length, else one by one."""
    lengths = {len(one) if isinstance(one, bytes) else one.shape[1] for one in payloads}
    if len(lengths) == 1 and lengths != {0}:
        return np.concatenate(
            [np.frombuffer(one, np.uint8)[None] if isinstance(one, bytes) else one for one in payloads]
        )
    whole: list[bytes] = []
    for one in payloads:
        whole += [one] if isinstance(one, bytes) else [row.tobytes() for row in one]
    return whole


def _by_length(
    payloads: Sequence[bytes] | NDArray[np.uint8],
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.uint8]]]:
    """Yield of payloads of each length their places and their bytes, shape (payloads, bytes)."""
    if isinstance(payloads, np.ndarray):
        yield np.arange(len(payloads)), payloads
        return
    lengths = np.fromiter(map(len, payloads), np.int64, len(payloads))
    for length in np.unique(lengths):
        places = np.flatnonzero(lengths == length)
        joined = b"".join([payloads[int(i)] for i in places])
        yield places, np.frombuffer(joined, np.uint8).reshape(len(places), length)


_EVENTS: Final = "/events"
_DESCRIPTION: Final = "/robot_description"
_READ: Final = {(_EVENTS, LOG), (_DESCRIPTION, STRING)}
_LOG_TEXTS: Final = 13  # encapsulation header, stamp, level


@dataclass(frozen=True)
class Event:
    """Represent a line that was logged while recording.

    Attributes:
        stamp_ns: stamp on the recording's time axis [ns].
        level: 10 debug, 20 information, 30 warning, 40 error, 50 fatal.
        name: of the logger.
        message: text that was logged.
    """

    stamp_ns: int
    level: int
    name: str
    message: str


@dataclass(frozen=True)
class Extras:
    """Hold metadata, attachments, events and robot description of a recording.

    Attributes:
        metadata: entries by name of the record; of several of one name the later entries count.
        attachments: content by name.
        events: events, in the order of the file.
        robot_description: URDF, None where the file has none.
    """

    metadata: dict[str, dict[str, str]]
    attachments: dict[str, bytes]
    events: tuple[Event, ...]
    robot_description: str | None


def read_extras(
    path: Path, stream: IO[bytes], size: int, utc_offset_ns: int, expanded_chunks: Iterable[bytes] | None = None
) -> Extras:
    """Return metadata, attachments, events and the URDF from an open file, up to any damage.

    Args:
        path: for messages.
        stream: the file.
        size: how many bytes of it to read.
        utc_offset_ns: offset to subtract from the events' stamps [ns].
        expanded_chunks: bytes of the file's records, where they have been expanded already; None reads the file.

    Raises:
        RecordingError: attachments of more than 64 MiB, or a chunk that expands beyond that.
    """
    metadata: dict[str, dict[str, str]] = {}
    attachments: dict[str, bytes] = {}
    events: list[Event] = []
    description: str | None = None
    directory = mcap.Directory()

    def kind(channel_id: int) -> str:
        channel = directory.channels.get(channel_id)
        if channel is None:
            raise mcap.TornError("a message of a channel that was never announced")
        return channel.topic if (channel.topic, directory.schema_of(channel)) in _READ else ""

    try:
        for opcode, content in mcap.records(stream, size, {Opcode.METADATA, Opcode.ATTACHMENT}):
            if opcode == Opcode.METADATA:
                record = mcap.metadata(content)
                metadata.setdefault(record.name, {}).update(record.metadata)
            else:
                attachment = mcap.attachment(content)
                attachments[attachment.name] = attachment.data
                if sum(map(len, attachments.values())) > mcap.MAX_RECORD:
                    raise mcap.TooLargeError(f"attachments are above the limit of {mcap.MAX_RECORD} bytes")
    except mcap.TornError:
        pass
    except mcap.TooLargeError as error:
        raise RecordingError(path, str(error)) from error
    try:
        for run in mcap.contents(stream, size) if expanded_chunks is None else expanded_chunks:
            for channel_id, _, payload in mcap.messages(run, directory, lambda channel_id: bool(kind(channel_id))):
                if kind(channel_id) == _EVENTS:
                    events.append(decode_event(payload, utc_offset_ns))
                else:
                    description = _string(payload, 4)[0]
    except mcap.TornError:
        pass
    except (mcap.TooLargeError, struct.error) as error:
        raise RecordingError(path, f"{_EVENTS} or {_DESCRIPTION}: {error}") from error
    return Extras(metadata, attachments, tuple(events), description)


def decode_event(payload: bytes, utc_offset_ns: int) -> Event:
    """Decode a message of `/events`, its stamp less `utc_offset_ns` [ns]; raises struct.error if malformed."""
    seconds, nanoseconds, level = struct.unpack_from("<iIB", payload, 4)
    name, position = _string(payload, _LOG_TEXTS)
    message, _ = _string(payload, position)
    return Event(seconds * 1_000_000_000 + nanoseconds - utc_offset_ns, level, name, message)


def _string(payload: bytes, position: int) -> tuple[str, int]:
    """Decode a string at the next multiple of four from `position`; returns it and the position behind it."""
    position += -position % 4
    (length,) = struct.unpack_from("<I", payload, position)
    end = position + 4 + length
    return payload[position + 4 : end].rstrip(b"\x00").decode("utf-8", errors="replace"), end


TOPIC: Final = "/cycle"
_COUNT: Final = 44  # where the number of axes stands, behind stamp, empty frame_id, cycle, lateness and compute
_CHUNK: Final = 8192


@dataclass(frozen=True)
class Cycles:
    """Hold the timing and axis status of consecutive cycles of a loop.

    Attributes:
        lateness_ns: how late each began [ns], shape (cycles,).
        compute_ns: how long each computed [ns], shape (cycles,).
        valid: mask of the axes that answered, shape (cycles, axes).
        age: number of cycles since each axis answered, shape (cycles, axes).
        lost: frames lost so far, shape (cycles,).
    """

    lateness_ns: NDArray[np.int64]
    compute_ns: NDArray[np.int64]
    valid: NDArray[np.bool_]
    age: NDArray[np.uint32]
    lost: NDArray[np.uint32]


def read_cycles(path: Path) -> Iterator[Cycles]:
    """Yield the records of `/cycle` in order, thousands at a time, up to where the file is cut off or damaged.

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
                yield from _decoded(path, _payloads(mcap.contents(stream, size)))
    except (mcap.TooLargeError, OSError) as error:
        raise RecordingError(path, str(error)) from error


def _payloads(runs: Iterable[bytes]) -> Iterator[bytes]:
    directory = mcap.Directory()

    def choose(channel_id: int) -> bool:
        channel = directory.channels.get(channel_id)
        return channel is not None and channel.topic == TOPIC and directory.schema_of(channel) == CYCLE

    try:
        for run in runs:
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


# 292 years: what is beyond cannot be a log time, and would not fit an int64.
_MAX_STAMP: Final = (1 << 63) - 1
_KEPT: Final = 64 << 20  # bytes of expanded records of one recording: minutes of seven joints at 1 kHz


class McapRecording:
    """Represent a recording in an MCAP file.

    Attributes:
        path: the file.
        sha256: hash of the bytes that the file had when opened; bytes that a writer adds later are not read.
        joint_names: names of the joints, in the order of the block's columns.
        joints: number of joints.
        torque_zero_order_hold: True for our own recordings.
        torn: whether the file ends, or is damaged, before its end mark.
        metadata: the record `ident`, empty for a bag.
        own: whether this package wrote it; topic, names and sides are then its own whatever the arm's bags are like.
        damage: description of the damage where the file is torn, else empty.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        topic: str | None = None,
        order: Sequence[str] | None = None,
        bag: RecordingFormat | None = None,
    ) -> None:
        """Open the file, check all of its chunks and find the joints.

        Args:
            path: the file.
            topic: topic with sensor_msgs/msg/JointState; None takes `/joint_states`, or in a bag what `bag` says.
            order: joints to read, in the order of the columns; None takes the first message's.
            bag: topic of a bag, its own names for joints that have others, and what to do with missing values.

        Raises:
            UsageError: no such file.
            RecordingError: not MCAP, no such topic or joints, no position or effort.
        """
        self.path = Path(path)
        self.torn = False
        self.damage = ""
        self.metadata: dict[str, str] = {}
        require_file(self.path)
        with self._open() as stream:
            self._size = stream.seek(0, 2)
            stream.seek(0)
            if stream.read(len(mcap.MAGIC)) != mcap.MAGIC:
                raise RecordingError(self.path, "is not an MCAP file")
            stream.seek(0)
            content = self._read(stream) if self._size <= _KEPT else None
        # From memory, records are found in half the time.
        self.sha256 = sha256(self.path, self._size) if content is None else hashlib.sha256(content).hexdigest()
        with self._open() if content is None else BytesIO(content) as stream:
            self._runs = self._verify(stream)
        self._offset_ns = self._utc_offset()
        self.torque_zero_order_hold = self.metadata.get("torque_hold") == "zero_order"
        self.own = bool(self.metadata)
        form = RecordingFormat() if self.own or bag is None else bag
        self._topic = form.topic if topic is None else topic
        self._skip_missing = form.missing == "skip"
        theirs = form.joint_names
        wanted = None if order is None else tuple(theirs.get(name, name) for name in order)
        layout, payload = self._first(wanted)
        ours = {their: our for our, their in theirs.items()}
        self.joint_names = tuple(order) if order is not None else tuple(ours.get(name, name) for name in layout.names)
        self.joints = len(self.joint_names)
        self._decoder = JointStateDecoder(
            layout.names if wanted is None else wanted,
            others=wanted is not None,
            # What the writer made of the positions is nothing that was measured.
            velocity=self.metadata.get(VELOCITY) != DIFFERENCE and _has_velocity(layout, payload),
        )

    def blocks(self, samples: int = BLOCK_SAMPLES) -> Iterator[Block]:
        """Yield the samples in blocks of `samples` (the last is shorter); raises RecordingError for bad values.

        Velocity is there when the first message has one; a first velocity of nothing but NaN counts as none.

        Raises:
            RecordingError: values that are not finite, stamps that run backwards or repeat with other values,
                messages whose joints change; names the first one.
        """
        pieces = self._pieces(min(samples, BLOCK_SAMPLES))
        return assemble(pieces, samples, self.path, self.joint_names, skip_missing=self._skip_missing)

    def read_extras(self) -> Extras:
        """Return what stands beside the samples: metadata, attachments, events, the URDF.

        Raises:
            RecordingError: attachments of more than 64 MiB.
        """
        with self._open() as stream:
            return read_extras(self.path, stream, self._size, self._offset_ns, self._runs)

    def read_cycles(self) -> Iterator[Cycles]:
        """Yield the records of `/cycle` in order, as `mcap_reader.read_cycles`; from memory where expanded already.

        Raises:
            RecordingError: likewise.
        """
        yield from read_cycles(self.path) if self._runs is None else _decoded(self.path, _payloads(self._runs))

    def measured(self, topic: str) -> tuple[Stamps, Matrix]:
        """Return stamps [ns] and torques [N m or N] of a topic's measured torques, NaN where missing; may be empty.

        Args:
            topic: topic with sensor_msgs/msg/JointState that have effort only.

        Returns:
            Stamps on the recording's time axis [ns], shape (messages,), and torques in the order of the joints [N m or
            N], NaN where none was told, shape (messages, joints); nothing where the topic has no messages.

        Raises:
            RecordingError: messages that are no such joint states, or of other joints.
        """
        payloads = [payload for _, payload in self._payloads(topic=topic)]
        if not payloads:
            return np.zeros(0, np.int64), np.zeros((0, self.joints))
        try:
            return self._efforts(payloads)
        except (PayloadError, ValueError) as error:
            raise RecordingError(self.path, f"{topic}: {error}") from None

    def _efforts(self, payloads: list[bytes]) -> tuple[Stamps, Matrix]:
        layout = Layout.parse(payloads[0])
        if layout.effort is None or set(self.joint_names) - set(layout.names):
            raise PayloadError(f"has no effort of {', '.join(self.joint_names)}")
        rows = np.frombuffer(b"".join(payloads), np.uint8).reshape(len(payloads), len(payloads[0]))
        if not layout.matches(rows).all():
            raise PayloadError("the joint names change from message to message")
        order = np.array([layout.names.index(name) for name in self.joint_names], np.intp)
        seconds, nanoseconds = np.ascontiguousarray(rows[:, 4:12]).view("<u4").T
        stamps = seconds.view(np.int32).astype(np.int64) * 1_000_000_000 + nanoseconds - self._offset_ns
        return stamps, layout.columns(rows, layout.effort, order)

    def _pieces(self, samples: int) -> Iterator[Block]:
        waiting: list[bytes | NDArray[np.uint8]] = []
        log_times: list[int] = []
        read = 0
        for found in self._series():
            if isinstance(found, mcap.Series):
                waiting.append(found.payloads)
                log_times.extend(np.minimum(found.log_times, _MAX_STAMP).tolist())
            else:
                waiting.append(found[2])
                log_times.append(min(found[1], _MAX_STAMP))
            if len(log_times) >= max(samples, 1):
                yield self._decode(_joined(waiting), log_times, read)
                read += len(log_times)
                waiting, log_times = [], []
        if waiting:
            yield self._decode(_joined(waiting), log_times, read)

    def _decode(self, payloads: Sequence[bytes] | NDArray[np.uint8], log_times: Sequence[int], before: int) -> Block:
        try:
            block = self._decoder.decode(payloads, log_times)
        except PayloadError as error:
            raise RecordingError(
                self.path,
                f"message {before + error.index} on {self._topic} {error}; choose the joints or another topic",
            ) from error
        return Block(block.stamp_ns - self._offset_ns, block.position, block.torque, block.velocity)

    def _payloads(
        self, directory: mcap.Directory | None = None, topic: str | None = None
    ) -> Iterator[tuple[int, bytes]]:
        """Yield log time [ns] and payload of each message on a topic (None: that of the states), up to the damage."""
        for found in self._series(directory, topic):
            if isinstance(found, mcap.Series):
                yield from zip(found.log_times.tolist(), map(np.ndarray.tobytes, found.payloads), strict=True)
            else:
                yield found[1], found[2]

    def _series(
        self, directory: mcap.Directory | None = None, topic: str | None = None
    ) -> Iterator[mcap.Message | mcap.Series]:
        """Yield what `_payloads` does, with many at once where they repeat."""
        directory, topic = directory or mcap.Directory(), topic or self._topic

        def choose(channel_id: int) -> bool:
            return self._is_chosen(channel_id, directory, topic)

        try:
            for run in self._contents():
                yield from mcap.series(run, directory, choose)
        except mcap.TornError as error:
            self._tear(error)
        except (mcap.TooLargeError, OSError) as error:
            raise RecordingError(self.path, str(error)) from error

    def _is_chosen(self, channel_id: int, directory: mcap.Directory, topic: str) -> bool:
        channel = directory.channels.get(channel_id)
        if channel is None:
            raise mcap.TornError("a message of a channel that was never announced")
        if channel.topic != topic:
            return False
        if (schema := directory.schema_of(channel)) != JOINT_STATE or channel.message_encoding != "cdr":
            raise RecordingError(
                self.path, f"{topic} carries {schema} as {channel.message_encoding}, not {JOINT_STATE} as cdr"
            )
        return True

    def _first(self, order: Sequence[str] | None) -> tuple[Layout, bytes]:
        """Return the first message that has one of the wanted joints, and its layout."""
        directory = mcap.Directory()
        seen: dict[str, None] = {}
        for index, (_, payload) in enumerate(self._payloads(directory)):
            try:
                layout = Layout.parse(payload)
            except PayloadError as error:
                raise RecordingError(self.path, f"message {index} on {self._topic}: {error}") from error
            seen.update(dict.fromkeys(layout.names))
            if not layout.names:
                raise RecordingError(self.path, f"message {index} on {self._topic} names no joints")
            if order is None or not seen.keys().isdisjoint(order):
                self._require(order, layout)
                return layout, payload
        if seen:
            raise RecordingError(self.path, f"{self._topic} has joints {list(seen)} but none of {list(order or ())}")
        topics = sorted({c.topic for c in directory.channels.values() if directory.schema_of(c) == JOINT_STATE})
        cut = f" before the damage ({self.damage})" if self.torn else ""
        raise RecordingError(self.path, f"no message on {self._topic}{cut}; topics with joint states: {topics}")

    def _require(self, order: Sequence[str] | None, layout: Layout) -> None:
        if missing := [name for name in order or () if name not in layout.names]:
            raise RecordingError(self.path, f"{self._topic} lacks joints {missing}; it has {list(layout.names)}")
        if layout.position is None or layout.effort is None:
            what = "position" if layout.position is None else "effort, which is the torque"
            raise RecordingError(self.path, f"{self._topic} has no {what}; identification needs both")

    def _contents(self) -> Iterator[bytes]:
        if self._runs is not None:
            yield from self._runs
            return
        with self._open() as stream:
            yield from mcap.contents(stream, self._size)

    def _read(self, stream: IO[bytes]) -> bytes:
        try:
            return stream.read(self._size)
        except OSError as error:
            raise RecordingError(self.path, f"cannot be read: {error.strerror}") from error

    def _verify(self, stream: IO[bytes]) -> tuple[bytes, ...] | None:
        """Read every chunk and every metadata record once, so that `torn` is known from the start.

        Args:
            stream: the file, or its content.

        Returns:
            The runs of records in the chunks and outside; None where they are more than `_KEPT` bytes, or torn.
        """
        runs: list[bytes] = []
        kept = 0
        try:
            for opcode, content in mcap.records(stream, self._size, {*mcap.CONTENTS, Opcode.METADATA}):
                if opcode != Opcode.METADATA:
                    run = mcap.expanded_records(opcode, content)
                    kept += len(run)
                    if kept > _KEPT:
                        runs.clear()
                    else:
                        runs.append(run)
                elif (record := mcap.metadata(content)).name == METADATA_NAME:
                    self.metadata.update(record.metadata)
            return tuple(runs) if kept <= _KEPT else None
        except mcap.TornError as error:
            self._tear(error)
            return None
        except (mcap.TooLargeError, OSError) as error:
            raise RecordingError(self.path, str(error)) from error

    def _tear(self, error: mcap.TornError) -> None:
        self.torn = True
        self.damage = str(error)

    def _utc_offset(self) -> int:
        text = self.metadata.get("utc_offset_ns", "0")
        try:
            offset = int(text)
            np.int64(offset)
        except (ValueError, OverflowError) as error:
            raise RecordingError(self.path, f"metadata utc_offset_ns is {text[:40]!r}, not nanoseconds") from error
        return offset

    def _open(self) -> IO[bytes]:
        try:
            return self.path.open("rb")
        except OSError as error:
            raise RecordingError(self.path, f"cannot be read: {error.strerror}") from error


def _has_velocity(layout: Layout, payload: bytes) -> bool:
    if layout.velocity is None:
        return False
    values = np.frombuffer(payload, "<f8", len(layout.names), layout.velocity)
    return not bool(np.isnan(values).all())
