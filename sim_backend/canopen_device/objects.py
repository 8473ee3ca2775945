"""Keep the object dictionary of an emulated drive, and serve it over SDO (CiA 301).

It is made from an EDS or DCF (CiA 306). Values are integers, or bytes for types that are not numbers here, and may be
any bytes; a key is `index << 8 | subindex`. Limits of 1016h are not checked: a maker's file has 65535, which no entry
of it fits. The effect of a value is its reader's; `veto` and `written` inform the drive of a host's writes.

Block transfers are refused with an abort code, as a server without them does.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

from ident_service.config.eds import DataSheetEntry, data_sheet
from ident_service.errors import DriverError

Value = int | bytes

# Data types of CiA 301, table 44, that are numbers here.
_FORMATS = {0x01: "?", 0x02: "b", 0x03: "h", 0x04: "i", 0x05: "B", 0x06: "H", 0x07: "I"}
# Bytes of those that are none.
_BYTES = {0x08: 4, 0x0C: 6, 0x0D: 6, 0x10: 3, 0x11: 8, 0x12: 5, 0x13: 6, 0x14: 7, 0x15: 8, 0x16: 3}
_BYTES |= {0x18: 5, 0x19: 6, 0x1A: 7, 0x1B: 8}
_VISIBLE_STRING = 0x09
_OF_NO_NUMBER = 4  # bytes of what the firmware keeps in an entry whose type is none of a number
# Store and restore themselves, the mark of a configuration, and commands.
_NOT_STORED = (0x1010, 0x1011, 0x1020, 0x2030, 0x6040, 0x6060, 0x6071, 0x607A, 0x60B2)
_FIRST, _HEARTBEAT_CONSUMERS = 0x1000, 0x1016


class SdoAbort(Exception):
    """Report a transfer that the drive refuses; `code` is one of CiA 301, 7.2.4.3.17."""

    def __init__(self, code: int) -> None:
        super().__init__(f"0x{code:08X}")
        self.code = code


TOGGLE = 0x05030000
COMMAND = 0x05040001
WRITE_ONLY = 0x06010001
READ_ONLY = 0x06010002
NO_OBJECT = 0x06020000
NOT_MAPPABLE = 0x06040041
PDO_LENGTH = 0x06040042
TOO_LONG = 0x06070012
TOO_SHORT = 0x06070013
NO_SUBINDEX = 0x06090011
WRONG_VALUE = 0x06090030
TOO_HIGH = 0x06090031
TOO_LOW = 0x06090032
WRONG_STATE = 0x08000022


@dataclass(frozen=True)
class Entry:
    """Describe one value of the dictionary.

    Attributes:
        form: struct format character; None for what is no number here.
        size: bytes; 0 for any number of them.
        readable: whether a host may read it.
        writable: whether a host may write it.
        mappable: into a PDO.
        low: least value, where the EDS says one.
        high: greatest value, where the EDS says one.
        default: value after power-up.
    """

    form: str | None
    size: int
    readable: bool
    writable: bool
    mappable: bool
    low: int | None
    high: int | None
    default: Value


class Objects:
    """Hold all values of one node.

    Attributes:
        entries: entries by key.
        values: values by key; the firmware reads and writes here, past all rules.
        dummies: sizes [bytes] of the dummy objects by index (CiA 301, 7.4.7.1).
        before_read: called with the key before a host reads.
        veto: called with key and value before a host's write; raises SdoAbort to refuse.
        written: called with the key after it.
    """

    def __init__(self, text: str, node: int, own: Mapping[int, int] | None = None) -> None:
        """Read an EDS.

        Args:
            text: of the file.
            node: node number, for defaults that depend on it.
            own: numbers that entries have instead of what the file says, by key, cut off at what their types hold.

        Raises:
            DriverError: not an EDS, or one that lists nothing.
        """
        entries, dummies = _read(text, node)
        self.entries, self.dummies = dict(entries), dict(dummies)
        for key, value in (own or {}).items():
            if (entry := entries.get(key)) is not None and entry.form is not None:
                self.entries[key] = replace(entry, default=_cut(entry.form, value))
        self._indices = {key >> 8 for key in self.entries}
        self._factory = dict(self.entries)
        self.values: dict[int, Value] = {}
        self.before_read: Callable[[int], None] = lambda key: None
        self.veto: Callable[[int, int], None] = lambda key, value: None
        self.written: Callable[[int], None] = lambda key: None
        self.reset()

    def reset(self, first: int = 0x1000, last: int = 0xFFFF) -> None:
        """Reset the objects of these indices to their values after power-up."""
        for key, entry in self.entries.items():
            if first <= key >> 8 <= last:
                self.values[key] = entry.default

    def store(self) -> None:
        """Make the present values of what a host can write, but for commands, the values after a reset."""
        for key, entry in self.entries.items():
            if entry.writable and key >> 8 not in _NOT_STORED:
                self.entries[key] = replace(entry, default=self.values[key])

    def restore(self) -> None:
        """Make the data sheet's values those after a reset again; present values stay until then."""
        self.entries.update(self._factory)

    def number(self, index: int, subindex: int = 0) -> int:
        """Return a value that is a number; 0 where the EDS has no such object, or one of another type."""
        value = self.values.get(index << 8 | subindex, 0)
        return value if isinstance(value, int) else 0

    def put(self, index: int, value: int, subindex: int = 0) -> None:
        """Set a number from inside the drive, limited to its type; does nothing where the EDS has no such object."""
        key = index << 8 | subindex
        entry = self.entries.get(key)
        if entry is None or entry.form is None:
            return
        self.values[key] = _cut(entry.form, value)

    def read(self, index: int, subindex: int) -> bytes:
        """Return the bytes of a value for a host's upload; SdoAbort where there is none, or it is not readable."""
        key = index << 8 | subindex
        entry = self._entry(index, subindex)
        if not entry.readable:
            raise SdoAbort(WRITE_ONLY)
        self.before_read(key)
        return self.packed(key)

    def packed(self, key: int) -> bytes:
        """Return the bytes of entry `key` (index << 8 | sub-index), little-endian; overlong numbers are truncated."""
        value = self.values[key]
        if isinstance(value, bytes):
            return value
        entry = self.entries[key]
        if entry.form == "?":
            return bytes([bool(value)])
        size = entry.size or _OF_NO_NUMBER
        return (value & (1 << 8 * size) - 1).to_bytes(size, "little")

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Set a value by a host's download; raises SdoAbort, and then nothing has changed."""
        key = index << 8 | subindex
        entry = self._entry(index, subindex)
        if not entry.writable:
            raise SdoAbort(READ_ONLY)
        if entry.form is None:
            self.values[key] = data
            self.written(key)
            return
        if len(data) != entry.size:
            raise SdoAbort(TOO_LONG if len(data) > entry.size else TOO_SHORT)
        value = int(struct.unpack(f"<{entry.form}", data)[0])
        if entry.high is not None and value > entry.high:
            raise SdoAbort(TOO_HIGH)
        if entry.low is not None and value < entry.low:
            raise SdoAbort(TOO_LOW)
        self.veto(key, value)
        self.values[key] = value
        self.written(key)

    def size(self, index: int, subindex: int) -> int:
        """Return the size of an integer of up to 32 bits [bytes], 0 for another type; SdoAbort when there is none."""
        return self._entry(index, subindex).size

    def _entry(self, index: int, subindex: int) -> Entry:
        entry = self.entries.get(index << 8 | subindex)
        if entry is None:
            raise SdoAbort(NO_SUBINDEX if index in self._indices else NO_OBJECT)
        return entry


@lru_cache(maxsize=32)
def _read(text: str, node: int) -> tuple[Mapping[int, Entry], Mapping[int, int]]:
    """Read entries by key and sizes of dummy objects by index, once for the many times that a node is made."""
    sheet = data_sheet(text)
    if sheet.mistake or not sheet.entries:
        raise DriverError(f"not an EDS: {sheet.mistake or 'it lists no object'}")
    dummies = {index: struct.calcsize(_FORMATS[index]) for index in sheet.dummies}
    return {key: _entry(key, one, node) for key, one in sheet.entries.items() if key >> 8 >= _FIRST}, dummies


def _entry(key: int, listed: DataSheetEntry, node: int) -> Entry:
    form = _FORMATS.get(listed.kind)
    low = high = None
    if form is None:
        plain = listed.text or ""
        default: Value = plain.encode("ascii", "replace") if listed.kind == _VISIBLE_STRING else b""
        default = default or bytes(_BYTES.get(listed.kind, 0))
    else:
        default = _as(form, listed.number(node) or 0)
        if key >> 8 != _HEARTBEAT_CONSUMERS:
            low, high = (None if limit is None else _as(form, limit) for limit in (listed.low, listed.high))
    return Entry(
        form=form,
        size=struct.calcsize(f"<{form}") if form else 0,
        readable=listed.access != "wo",
        writable=listed.writable,
        mappable=listed.mappable,
        low=low,
        high=high,
        default=default,
    )


def _bounds(form: str) -> tuple[int, int]:
    bits = 8 * struct.calcsize(f"<{form}")
    return (-(1 << bits - 1), (1 << bits - 1) - 1) if form.islower() else (0, (1 << bits) - 1)


def _cut(form: str, value: int) -> int:
    low, high = _bounds(form)
    return min(max(value, low), high)


def _as(form: str, value: int) -> int:
    """Return a number of a file as its type holds it: negative ones may stand there as unsigned digits."""
    low, high = _bounds(form)
    return _cut(form, value + 2 * low if low and value > high else value)


_LARGEST = 4096  # bytes of a segmented download; no object is larger


class SdoServer:
    """Serve one client."""

    def __init__(self, objects: Objects) -> None:
        """Serve the given objects."""
        self._objects = objects
        self.reset()

    def reset(self) -> None:
        """Discard a transfer that is under way."""
        self._multiplexer = (0, 0)
        self._upload: bytes | None = None
        self._download: bytearray | None = None
        self._announced: int | None = None
        self._toggle = 0

    def answer(self, request: bytes) -> bytes | None:
        """Return the response to one request; None where there is none (wrong length, a client's abort)."""
        if len(request) != 8:
            return None
        command = request[0] >> 5
        if command == 4:
            self.reset()
            return None
        try:
            match command:
                case 0:
                    return self._download_segment(request)
                case 1:
                    return self._initiate_download(request)
                case 2:
                    return self._initiate_upload(request)
                case 3:
                    return self._upload_segment(request)
            self._multiplexer = struct.unpack_from("<HB", request, 1)
            raise SdoAbort(COMMAND)
        except SdoAbort as abort:
            index, subindex = self._multiplexer
            self.reset()
            return struct.pack("<BHBI", 0x80, index, subindex, abort.code)

    def _initiate_download(self, request: bytes) -> bytes:
        self.reset()
        first, index, subindex = struct.unpack_from("<BHB", request)
        self._multiplexer = (index, subindex)
        expedited, sized = first & 2, first & 1
        if expedited:
            # Without a size, all four bytes count, of which the object takes as many as it has.
            length = 4 - (first >> 2 & 3) if sized else self._objects.size(index, subindex) or 4
            self._objects.write(index, subindex, request[4 : 4 + length])
        else:
            self._announced = struct.unpack_from("<I", request, 4)[0] if sized else None
            if self._announced is not None and self._announced > _LARGEST:
                raise SdoAbort(TOO_LONG)
            self._objects.size(index, subindex)
            self._download = bytearray()
        return struct.pack("<BHBI", 0x60, index, subindex, 0)

    def _download_segment(self, request: bytes) -> bytes:
        if self._download is None:
            raise SdoAbort(COMMAND)
        toggle = self._checked_toggle_bit(request)
        self._download += request[1 : 8 - (request[0] >> 1 & 7)]
        if len(self._download) > _LARGEST:
            raise SdoAbort(TOO_LONG)
        if request[0] & 1:
            data, self._download = bytes(self._download), None
            if self._announced is not None and len(data) != self._announced:
                raise SdoAbort(TOO_LONG if len(data) > self._announced else TOO_SHORT)
            self._objects.write(*self._multiplexer, data)
        return struct.pack("<B7x", 0x20 | toggle)

    def _initiate_upload(self, request: bytes) -> bytes:
        self.reset()
        index, subindex = struct.unpack_from("<HB", request, 1)
        self._multiplexer = (index, subindex)
        data = self._objects.read(index, subindex)
        if 1 <= len(data) <= 4:
            return struct.pack("<BHB4s", 0x43 | (4 - len(data)) << 2, index, subindex, data)
        self._upload = data
        return struct.pack("<BHBI", 0x41, index, subindex, len(data))

    def _upload_segment(self, request: bytes) -> bytes:
        if self._upload is None:
            raise SdoAbort(COMMAND)
        toggle = self._checked_toggle_bit(request)
        part, rest = self._upload[:7], self._upload[7:]
        self._upload = rest or None
        return struct.pack("<B7s", toggle | (7 - len(part)) << 1 | (not rest), part)

    def _checked_toggle_bit(self, request: bytes) -> int:
        """Return the toggle bit, which must alternate from 0."""
        toggle = request[0] & 0x10
        if toggle != self._toggle:
            raise SdoAbort(TOGGLE)
        self._toggle ^= 0x10
        return toggle
