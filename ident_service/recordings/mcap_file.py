"""Read JointState recordings in MCAP: this package's own, and ROS 2 bags from anywhere.

This package's files say in their metadata how far UTC is from the monotonic clock, and that torque is held from stamp
to stamp; for a bag neither is known. A file that was cut off is read up to the cut, so is one with a damaged chunk.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Final

import numpy as np
from mcap.opcode import Opcode

from ident_service.config.recording import RecordingFormat
from ident_service.errors import RecordingError
from ident_service.recordings import mcap_records as mcap
from ident_service.recordings.assemble import assemble
from ident_service.recordings.extras import Extras, read_extras
from ident_service.recordings.files import require_file, sha256
from ident_service.recordings.joint_state import JointStateDecoder, Layout, PayloadError
from ident_service.recordings.messages import JOINT_STATE
from ident_service.recordings.recording import BLOCK_SAMPLES, Block, Matrix, Stamps
from ident_service.recordings.writer import METADATA_NAME

# 292 years: what is beyond cannot be a log time, and would not fit an int64.
_MAX_STAMP: Final = (1 << 63) - 1


class McapRecording:
    """Represent a recording in an MCAP file.

    Attributes:
        path: the file.
        sha256: of the bytes it had when opened; bytes that a writer adds later are not read.
        joint_names: in the order of the block's columns.
        joints: number of joints.
        torque_held: True for our own recordings.
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
            topic: with sensor_msgs/msg/JointState on it; None takes `/joint_states`, or in a bag what `bag` says.
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
        self.sha256 = sha256(self.path, self._size)
        self._verify()
        self._offset_ns = self._utc_offset()
        self.torque_held = self.metadata.get("torque_hold") == "zero_order"
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
            velocity=_has_velocity(layout, payload),
        )

    def blocks(self, samples: int = BLOCK_SAMPLES) -> Iterator[Block]:
        """Read the samples in order, `samples` at a time (the last block is shorter).

        Velocity is there when the first message has one; a first velocity of nothing but NaN counts as none.

        Raises:
            RecordingError: values that are not finite, stamps that run backwards or repeat with other values,
                messages whose joints change; names the first one.
        """
        pieces = self._pieces(min(samples, BLOCK_SAMPLES))
        return assemble(pieces, samples, self.path, self.joint_names, skip_missing=self._skip_missing)

    def read_extras(self) -> Extras:
        """Read what stands beside the samples: metadata, attachments, events, the arm's description.

        Raises:
            RecordingError: attachments of more than 64 MiB.
        """
        with self._open() as stream:
            return read_extras(self.path, stream, self._size, self._offset_ns)

    def measured(self, topic: str) -> tuple[Stamps, Matrix]:
        """Read the torques that drives measured.

        Args:
            topic: with sensor_msgs/msg/JointState that have effort only.

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
        payloads: list[bytes] = []
        log_times: list[int] = []
        read = 0
        for log_time, payload in self._payloads():
            payloads.append(payload)
            log_times.append(min(log_time, _MAX_STAMP))
            if len(payloads) == max(samples, 1):
                yield self._decode(payloads, log_times, read)
                read += len(payloads)
                payloads, log_times = [], []
        if payloads:
            yield self._decode(payloads, log_times, read)

    def _decode(self, payloads: Sequence[bytes], log_times: Sequence[int], before: int) -> Block:
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
        directory, topic = directory or mcap.Directory(), topic or self._topic

        def choose(channel_id: int) -> bool:
            return self._is_chosen(channel_id, directory, topic)

        try:
            with self._open() as stream:
                for run in mcap.contents(stream, self._size):
                    for _, log_time, payload in mcap.messages(run, directory, choose):
                        yield log_time, payload
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

    def _verify(self) -> None:
        """Read every chunk and every metadata record once, so that `torn` is known from the start."""
        try:
            with self._open() as stream:
                for opcode, content in mcap.records(stream, self._size, {Opcode.CHUNK, Opcode.METADATA}):
                    if opcode == Opcode.CHUNK:
                        mcap.expand(content)
                    elif (record := mcap.metadata(content)).name == METADATA_NAME:
                        self.metadata.update(record.metadata)
        except mcap.TornError as error:
            self._tear(error)
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
