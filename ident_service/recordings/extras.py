"""Read what accompanies the samples in an MCAP recording: metadata, attachments, events, the arm's description."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final

from mcap.opcode import Opcode

from ident_service.errors import RecordingError
from ident_service.recordings import mcap_records as mcap
from ident_service.recordings.messages import LOG, STRING

_EVENTS: Final = "/events"
_DESCRIPTION: Final = "/robot_description"
_READ: Final = {(_EVENTS, LOG), (_DESCRIPTION, STRING)}
_LOG_TEXTS: Final = 13  # encapsulation header, stamp, level


@dataclass(frozen=True)
class Event:
    """Represent a line that was logged while recording.

    Attributes:
        stamp_ns: on the recording's time axis [ns].
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
        metadata: by name of the record; of several of one name the later entries count.
        attachments: content by name.
        events: in the order of the file.
        robot_description: URDF, None where the file has none.
    """

    metadata: dict[str, dict[str, str]]
    attachments: dict[str, bytes]
    events: tuple[Event, ...]
    robot_description: str | None


def read_extras(path: Path, stream: IO[bytes], size: int, utc_offset_ns: int) -> Extras:
    """Read the extras from an open file, up to the damage where there is some.

    Args:
        path: for messages.
        stream: the file.
        size: how many bytes of it to read.
        utc_offset_ns: offset to subtract from the events' stamps [ns].

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
        for run in mcap.contents(stream, size):
            for channel_id, _, payload in mcap.messages(run, directory, lambda channel_id: bool(kind(channel_id))):
                if kind(channel_id) == _EVENTS:
                    events.append(event(payload, utc_offset_ns))
                else:
                    description = _string(payload, 4)[0]
    except mcap.TornError:
        pass
    except (mcap.TooLargeError, struct.error) as error:
        raise RecordingError(path, f"{_EVENTS} or {_DESCRIPTION}: {error}") from error
    return Extras(metadata, attachments, tuple(events), description)


def event(payload: bytes, utc_offset_ns: int) -> Event:
    """Decode a message of `/events`, its stamp less `utc_offset_ns` [ns]; struct.error where it is malformed."""
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
