"""Follow one of this package's recordings while it grows: read what the recorder has flushed, each sample once.

Each read goes on from where the last one ended, a bounded number of bytes at most, and stops before an incomplete
record. The file is opened once and so stays readable when the finished recording gets its name.
"""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from ident_service.errors import RecordingError
from ident_service.recordings import mcap_records as mcap
from ident_service.recordings.mcap_reader import Event, Layout, PayloadError, decode_event
from ident_service.recordings.recording import Matrix, Stamps

MOST_BYTES: Final = 1 << 20
MOST_EVENTS: Final = 500
_HEAD: Final = struct.Struct("<BQ")
_STATES, _COMMANDS, _TORQUES, _EVENTS = "/joint_states", "/joint_commands", "/joint_torques", "/events"
_EXCITING = "exciting"  # value of `State.EXCITING` in `motion/state_machine.py`


@dataclass(frozen=True)
class Samples:
    """Hold consecutive cycles of a growing recording.

    Attributes:
        stamp_ns: [ns since 1970 in UTC], shape (samples,).
        position: measured position [rad or m], shape (samples, joints).
        torque: commanded torque after clipping [N m or N], shape (samples, joints).
        reference: position that was asked for [rad or m], shape (samples, joints).
        measured: torque that drives measured [N m or N], NaN where none was told, shape (samples, joints); None where
            the recording has none in these cycles.
    """

    stamp_ns: Stamps
    position: Matrix
    torque: Matrix
    reference: Matrix
    measured: Matrix | None = None


class RecordingFollower:
    """Read a recording as it grows.

    Attributes:
        ended: whether the recording's data has come to its end.
        joint_names: names of the joints, in the order of the columns; empty before the first sample.
        exciting_ns: time when the motion itself began [ns since 1970 in UTC]; None before.
        events: lines that were logged so far, at most `MOST_EVENTS`, stamps in ns since 1970 in UTC.
    """

    def __init__(self, path: Path) -> None:
        """Open the file.

        Raises:
            FileNotFoundError: it is not there (yet).
            OSError: it cannot be read.
        """
        self._path, self._stream = path, path.open("rb", buffering=0)
        self._directory = mcap.Directory()
        self._position = len(mcap.MAGIC)
        self.ended, self.joint_names = False, tuple[str, ...]()
        self.exciting_ns: int | None = None
        self.events: list[Event] = []

    def read(self, most_bytes: int = MOST_BYTES) -> Samples | None:
        """Return the next samples that the recorder has flushed, each once; None while there are no new ones.

        At most `most_bytes` bytes of the file are read at a time, or one record.

        Raises:
            RecordingError: the file is damaged, or no recording of this package.
        """
        stamps: list[int] = []
        states: list[bytes] = []
        commands: list[bytes] = []
        torques: list[bytes] = []
        while not stamps and not self.ended:
            try:
                records = self._records(os.pread(self._stream.fileno(), most_bytes, self._position))
            except OSError as error:
                raise RecordingError(self._path, f"cannot be read: {error.strerror}") from None
            if not records:
                return None
            for opcode, record in records:
                if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                    self.ended = True
                    break
                self._sort(opcode, record, stamps, states, commands, torques)
        whole = min(len(states), len(commands))
        if not whole:
            return None
        try:
            # One for every cycle, or none: what is between cannot be told which cycle it is of.
            measured = torques[:whole] if len(torques) == len(states) else []
            return self._decoded(stamps[:whole], states[:whole], commands[:whole], measured)
        except (PayloadError, ValueError) as error:
            raise RecordingError(self._path, f"is no recording of ours: {error}") from None

    def close(self) -> None:
        """Close the file that is followed."""
        self._stream.close()

    def _records(self, content: bytes) -> list[tuple[int, bytes]]:
        """Return the whole records of what was read; one that is longer is read by itself."""
        found, position = list[tuple[int, bytes]](), 0
        while position + _HEAD.size <= len(content):
            opcode, length = _HEAD.unpack_from(content, position)
            if length > mcap.MAX_RECORD:
                raise RecordingError(self._path, f"a record of {length} bytes is above the limit of {mcap.MAX_RECORD}")
            start, end = position + _HEAD.size, position + _HEAD.size + length
            if end > len(content):
                if found:
                    break
                content = os.pread(self._stream.fileno(), end, self._position)
                if end > len(content):
                    break
            found.append((opcode, content[start:end]))
            position = end
        self._position += position
        return found

    def _sort(
        self,
        opcode: int,
        record: bytes,
        stamps: list[int],
        states: list[bytes],
        commands: list[bytes],
        torques: list[bytes],
    ) -> None:
        try:
            if opcode == Opcode.CHUNK:
                run = mcap.expand(record)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                run = _HEAD.pack(opcode, len(record)) + record
            else:
                return
            for channel, stamp, payload in mcap.messages(run, self._directory):
                known = self._directory.channels.get(channel)
                topic = "" if known is None else known.topic
                if topic == _STATES:
                    stamps.append(stamp)
                    states.append(payload)
                elif topic == _COMMANDS:
                    commands.append(payload)
                elif topic == _TORQUES:
                    torques.append(payload)
                elif topic == _EVENTS and len(self.events) < MOST_EVENTS:
                    self.events.append(decode_event(payload, 0))
                    if self.exciting_ns is None and self.events[-1].message == _EXCITING:
                        self.exciting_ns = stamp
        except (mcap.TornError, mcap.TooLargeError, struct.error) as error:
            raise RecordingError(self._path, str(error)) from None

    def _decoded(self, stamps: list[int], states: list[bytes], commands: list[bytes], torques: list[bytes]) -> Samples:
        state, command = Layout.parse(states[0]), Layout.parse(commands[0])
        if state.position is None or state.effort is None or command.position is None:
            raise PayloadError("a position or a torque is missing")
        self.joint_names = state.names
        order = np.arange(len(state.names))
        of_states, of_commands = _rows(states), _rows(commands)
        return Samples(
            np.array(stamps, np.int64),
            state.columns(of_states, state.position, order),
            state.columns(of_states, state.effort, order),
            command.columns(of_commands, command.position, order),
            self._measured(torques, order) if torques else None,
        )

    @staticmethod
    def _measured(torques: list[bytes], order: NDArray[np.intp]) -> Matrix:
        layout = Layout.parse(torques[0])
        if layout.effort is None:
            raise PayloadError("a measured torque is missing")
        return layout.columns(_rows(torques), layout.effort, order)


def _rows(payloads: list[bytes]) -> NDArray[np.uint8]:
    """Return payloads of one length as rows; raises ValueError where lengths differ."""
    return np.frombuffer(b"".join(payloads), np.uint8).reshape(len(payloads), len(payloads[0]))
