"""Read the record layer of an MCAP file (https://mcap.dev/spec), forwards and up to the first damage.

The index at the end of a file is not used: a recording that was cut off has none. Everything is bounded before it is
expanded: a record and an expanded chunk to 64 MiB each, a chunk to the size it declares.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Collection, Iterator, Sequence
from io import BytesIO
from typing import IO, TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

if TYPE_CHECKING:  # these load for 0.04 s, and who identifies from CSV opens no MCAP
    from mcap.records import Attachment, Channel, Metadata

MAGIC: Final = b"\x89MCAP0\r\n"
MAX_RECORD: Final = 64 << 20

_HEAD: Final = struct.Struct("<BQ")
_MESSAGE: Final = struct.Struct("<BQHIQQ")
_MESSAGE_HEAD: Final = struct.Struct("<BQH")
_A_MESSAGE: Final = int(Opcode.MESSAGE)
_MESSAGE_FIELDS: Final = _MESSAGE.size - _HEAD.size
_LOG_TIME: Final = _MESSAGE_HEAD.size + 4  # where it stands in a message record
_LONGEST: Final = 64  # records that a period may have
_FEW: Final = 8  # repetitions, below which looking for them costs more than it saves
CONTENTS: Final = frozenset({Opcode.CHUNK, Opcode.MESSAGE, Opcode.CHANNEL, Opcode.SCHEMA})

Message = tuple[int, int, bytes]


class Series(NamedTuple):
    """Hold messages of one channel that have one length.

    Attributes:
        channel: id of the channel.
        log_times: [ns], shape (messages,).
        payloads: shape (messages, bytes).
    """

    channel: int
    log_times: NDArray[np.uint64]
    payloads: NDArray[np.uint8]


class TornError(Exception):
    """Report that the file ends, or is not valid, from some position on."""


class TooLargeError(Exception):
    """Report a record or chunk beyond the bounds of size."""


class Period(NamedTuple):
    """Hold the messages of one cycle of a loop, of which whole runs consist.

    Attributes:
        length: length of all of its records [bytes].
        where: places in the period of its records' kinds, lengths and channels, shape (bytes,).
        expected: bytes that stand there, shape (bytes,).
        wanted: places of those of its messages that are read, at most one.
    """

    length: int
    where: NDArray[np.intp]
    expected: NDArray[np.uint8]
    wanted: tuple[int, ...]

    @classmethod
    def of(cls, record_bytes: bytes, message_offsets: Sequence[int], end: int, wanted_offsets: Sequence[int]) -> Period:
        """Build the repeating pattern of messages at the offsets `message_offsets` in a run of bytes, up to `end`."""
        start, length = message_offsets[0], end - message_offsets[0]
        where = np.add.outer(np.array(message_offsets) - start, np.arange(_MESSAGE_HEAD.size)).ravel()
        expected = np.frombuffer(record_bytes, np.uint8, length, start)[where]
        return cls(length, where, expected, tuple(at - start for at in wanted_offsets))

    def repeats(self, record_bytes: bytes, position: int) -> int:
        """Return how often in a row the pattern stands in `record_bytes` from `position` on."""
        length = self.length
        rows = np.frombuffer(
            record_bytes, np.uint8, (len(record_bytes) - position) // length * length, position
        ).reshape(-1, length)
        same = (rows[:, self.where] == self.expected).all(axis=1)
        return len(rows) if same.all() else int(np.argmin(same))


class Directory:
    """The channels and schemas met so far, by id, which channels are read, and the period of a run that had one."""

    def __init__(self) -> None:
        self.channels: dict[int, Channel] = {}
        self.schemas: dict[int, str] = {}
        self.chosen: dict[int, bool] = {}
        self.period: Period | None = None

    def schema_of(self, channel: Channel) -> str:
        """Return the name of the channel's message type, empty where the file does not say."""
        return self.schemas.get(channel.schema_id, "")


def records(stream: IO[bytes], size: int, wanted_opcodes: Collection[int]) -> Iterator[tuple[int, bytes]]:
    """Yield (opcode, content) of the wanted records of a file in order; raises TornError at the first damage.

    Args:
        stream: the file, from its first byte on.
        size: how many of its bytes to read at most.
        wanted_opcodes: opcodes to read; the others are stepped over.

    Raises:
        TornError: the bytes end before the closing magic, or cannot be records.
        TooLargeError: a wanted record above 64 MiB.
    """
    stream.seek(len(MAGIC))
    position = len(MAGIC)
    while True:
        head = stream.read(_HEAD.size)
        if len(head) < _HEAD.size:
            raise TornError("the file ends without its end mark")
        opcode, length = _HEAD.unpack(head)
        position += _HEAD.size + length
        if opcode == 0 or position > size:
            raise TornError("the file ends within a record")
        if opcode == Opcode.FOOTER:
            stream.seek(position)
            if position + len(MAGIC) > size or stream.read(len(MAGIC)) != MAGIC:
                raise TornError("the file ends within its end mark")
            return
        if opcode not in wanted_opcodes:
            stream.seek(position)
            continue
        if length > MAX_RECORD:
            raise TooLargeError(f"a record of {length} bytes is above the limit of {MAX_RECORD}")
        content = stream.read(length)
        if len(content) < length:
            raise TornError("the file ends within a record")
        yield opcode, content


def contents(stream: IO[bytes], size: int) -> Iterator[bytes]:
    """Yield each chunk of a file, expanded and checked, as bytes of records; records outside chunks singly.

    Raises:
        TornError: as `records`, or a chunk that is damaged.
        TooLargeError: as `records`, or a chunk that expands beyond 64 MiB.
    """
    for opcode, content in records(stream, size, CONTENTS):
        yield expanded_records(opcode, content)


def expanded_records(opcode: int, content: bytes) -> bytes:
    """Return the bytes of the records in a chunk, expanded; of any other record, that record itself."""
    return expand(content) if opcode == Opcode.CHUNK else _HEAD.pack(opcode, len(content)) + content


def expand(content: bytes) -> bytes:
    """Return the decompressed records of a chunk; raises TornError where its size or CRC is wrong."""
    import lz4.frame  # type: ignore[import-untyped]
    import zstandard
    from mcap.records import Chunk

    chunk: Chunk = _parse(Chunk, content)
    size = chunk.uncompressed_size
    if size > MAX_RECORD:
        raise TooLargeError(f"a chunk expands to {size} bytes, above the limit of {MAX_RECORD}")
    try:
        if chunk.compression == "zstd":
            # A frame that states its size is expanded to it whatever limit is given, so the size is checked first.
            if zstandard.frame_content_size(chunk.data) > size:
                raise TornError("a chunk expands beyond the size it declares")
            data = zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=size)
        elif chunk.compression == "lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
        elif not chunk.compression:
            data = chunk.data
        else:
            raise TooLargeError(f"chunks compressed with {chunk.compression!r} cannot be read, only zstd and lz4")
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise TornError(f"a chunk does not decompress: {error}") from error
    if len(data) != size or (chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc):
        raise TornError("a chunk is damaged: its size or checksum is wrong")
    return bytes(data)


def messages(
    record_bytes: bytes, directory: Directory, choose_channel: Callable[[int], bool] = lambda _: True
) -> Iterator[Message]:
    """Yield channel id, log time [ns] and payload of each message of chosen channels in bytes of records."""
    for found in series(record_bytes, directory, choose_channel):
        if isinstance(found, Series):
            for stamp, row in zip(found.log_times.tolist(), found.payloads, strict=True):
                yield found.channel, stamp, row.tobytes()
        else:
            yield found


def series(
    record_bytes: bytes, directory: Directory, choose_channel: Callable[[int], bool] = lambda _: True
) -> Iterator[Message | Series]:
    """Yield the messages of chosen channels in bytes of records, like ones as a `Series`; fill in `directory`.

    Where records repeat in kind, length and channel, as those of a loop do, all of them are found at once.

    Args:
        record_bytes: run of records.
        directory: directory of the file so far.
        choose_channel: function that says which channels to read, called at each one's first message.

    Yields:
        Channel id, log time [ns] and payload; or several of one channel at once.

    Raises:
        TornError: the bytes cannot be records.
    """
    from mcap.records import Channel, Schema

    position, end, chosen = 0, len(record_bytes), directory.chosen
    if (known := directory.period) is not None and end % known.length == 0 < end:
        count = end // known.length
        if known.repeats(record_bytes, 0) == count:
            yield from (_gathered(record_bytes, offset, 0, known.length, count) for offset in known.wanted)
            return
    head, unpack = _HEAD.size, _MESSAGE_HEAD.unpack_from  # three messages a cycle: what is looked up here counts
    # The head of the message that a period may begin with, and where its messages begin.
    regular, first = True, b""
    begins: list[int] = []
    try:
        while position < end:
            if record_bytes[position] == _A_MESSAGE:
                if regular and record_bytes[position : position + _MESSAGE_HEAD.size] == first:
                    last, begins = begins, []
                    slots = [at for at in last if chosen[unpack(record_bytes, at)[2]]]
                    period = Period.of(record_bytes, last, position, slots)
                    count = period.repeats(record_bytes, position) if len(slots) < 2 else 0
                    regular = count >= _FEW
                    first = b""
                    if regular:
                        directory.period = period
                    if slots and count:
                        yield _gathered(record_bytes, slots[0] - last[0], position, period.length, count)
                    position += count * period.length
                    if count:
                        continue
                _, length, channel = unpack(record_bytes, position)
                begin = position
                position += head + length
                if length < _MESSAGE_FIELDS or position > end:
                    raise TornError("a chunk ends within a message")
                if (wanted := chosen.get(channel)) is None:
                    wanted = chosen[channel] = choose_channel(channel)
                if regular:
                    if not first or len(begins) == _LONGEST:
                        first, begins = record_bytes[begin : begin + _MESSAGE_HEAD.size], []
                    begins.append(begin)
                if wanted:
                    log_time = _MESSAGE.unpack_from(record_bytes, begin)[4]
                    yield channel, log_time, record_bytes[begin + _MESSAGE.size : position]
                continue
            opcode, length = _HEAD.unpack_from(record_bytes, position)
            start = position + _HEAD.size
            position = start + length
            if position > end:
                raise TornError("a chunk ends within a record")
            first, begins = b"", []
            if opcode == Opcode.CHANNEL:
                found: Channel = _parse(Channel, record_bytes[start:position])
                directory.channels[found.id] = found
            elif opcode == Opcode.SCHEMA:
                schema: Schema = _parse(Schema, record_bytes[start:position])
                directory.schemas[schema.id] = schema.name
    except struct.error as error:
        raise TornError("a chunk ends within a record") from error


def _gathered(run: bytes, offset: int, position: int, period: int, count: int) -> Series:
    """Return the messages `offset` bytes from the begin of each of `count` periods from `position` on."""
    rows = np.frombuffer(run, np.uint8, count * period, position).reshape(count, period)
    _, length, channel = _MESSAGE_HEAD.unpack_from(run, position + offset)
    start = offset + _MESSAGE.size
    times = np.ascontiguousarray(rows[:, offset + _LOG_TIME : offset + _LOG_TIME + 8]).view("<u8")[:, 0]
    return Series(channel, times, rows[:, start : offset + _HEAD.size + length])


def metadata(content: bytes) -> Metadata:
    """Parse a metadata record's content into an mcap `Metadata`."""
    from mcap.records import Metadata

    parsed: Metadata = _parse(Metadata, content)
    return parsed


def attachment(content: bytes) -> Attachment:
    """Parse an attachment record's content into an mcap `Attachment`."""
    from mcap.records import Attachment

    parsed: Attachment = _parse(Attachment, content)
    return parsed


def _parse(kind: Any, content: bytes) -> Any:
    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import McapError

    try:
        return kind.read(ReadDataStream(BytesIO(content)))
    except (McapError, struct.error, UnicodeDecodeError, OverflowError) as error:
        raise TornError(f"a {kind.__name__.lower()} record is damaged") from error
