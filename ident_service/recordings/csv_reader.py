"""Read CSV recordings: header `t,q1..qN,tau1..tauN`, optional `dq1..dqN`, or any header by a map of columns.

Time `t` becomes integer nanoseconds as if by decimal arithmetic, so that a UTC time keeps all its digits. A column map
(`RecordingFormat.columns`) reads other names and units, and no other columns than those it names.
Torque counts as sampled at its stamp. A CSV file has no end mark: a row that does not fit is an error, not a tear.
"""

from __future__ import annotations

import gzip
import re
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from decimal import Decimal
from operator import methodcaller
from pathlib import Path
from typing import IO, Final, cast

import numpy as np
from numpy.typing import NDArray
from pydantic_core import from_json

from ident_service.config.recording import Column
from ident_service.errors import RecordingError
from ident_service.recordings.files import require_file, sha256
from ident_service.recordings.recording import BLOCK_SAMPLES, Block, Matrix, Stamps, assemble

_TOLD = 5  # columns that appear twice, one by one
_MOST_COLUMNS: Final = 4096
_NAME: Final = re.compile(r"(q|dq|tau)([1-9]\d{0,3})")


@dataclass(frozen=True)
class CsvColumns:
    """Hold the column index, and the scale to SI, of each quantity in a row.

    Attributes:
        names: names of all columns, as the file has them.
        time: index of the time.
        position: indices of the positions, joint 1 first, shape (joints,).
        torque: indices of the torques, shape (joints,).
        velocity: indices of the velocities, shape (joints,), or None.
        nanoseconds: nanoseconds in one unit of the time column.
        scale: factor from each column's unit to SI, shape (fields,); None where all are in SI.
        used: indices of all columns above, in the order of the file.
    """

    names: tuple[str, ...]
    time: int
    position: NDArray[np.intp]
    torque: NDArray[np.intp]
    velocity: NDArray[np.intp] | None
    nanoseconds: Decimal
    scale: NDArray[np.float64] | None
    used: tuple[int, ...]

    @property
    def fields(self) -> int:
        """Return the number of fields in a row."""
        return len(self.names)

    @property
    def joints(self) -> int:
        """Return the number of joints."""
        return len(self.position)


def parse_header(path: Path, header: str, columns: Mapping[str, Column] | None = None) -> CsvColumns:
    """Find the columns of a CSV recording in its first line; raises RecordingError that lists all problems.

    Args:
        path: for messages.
        header: the first line.
        columns: the file's column for each standard name, where it has others; None reads standard names, in SI.

    Raises:
        RecordingError: the message lists all problems.
    """
    names = tuple(name.strip() for name in header.split(","))
    if not header.strip():
        raise RecordingError(path, "is empty; expected a header t,q1..qN,tau1..tauN")
    if "\r" in header.strip():
        raise RecordingError(path, "lines end in a carriage return alone; save it with line feeds")
    if len(names) > _MOST_COLUMNS:
        raise RecordingError(path, f"line 1: {len(names)} columns; a recording has {_MOST_COLUMNS} at most")
    if wrong := _no_header(header, names):
        raise RecordingError(path, f"line 1: {wrong}")
    twice = [name for name, count in sorted(Counter(names).items()) if count > 1]
    problems = [f"column {name!r} appears twice" for name in twice[:_TOLD]]
    problems += [f"{len(twice) - _TOLD} more columns appear twice"] if len(twice) > _TOLD else []
    if columns is None:
        place = {name: index for index, name in enumerate(names)}
    else:
        place = {ours: names.index(one.column) for ours, one in columns.items() if one.column in names}
        if absent := [f"{one.column!r} for {ours}" for ours, one in columns.items() if ours not in place]:
            problems += [f"no {_listed('column', absent, 3)}", "the description or --columns names them so"]
            raise RecordingError(path, f"line 1: {'; '.join(problems)}; {_what_then(names, columns)}")
    numbers: dict[str, set[int]] = {"q": set(), "dq": set(), "tau": set()}
    for name in place:
        if match := _NAME.fullmatch(name):
            numbers[match[1]].add(int(match[2]))
    if unknown := [name for name in place if name != "t" and not _NAME.fullmatch(name)]:
        problems.append(f"unknown {_listed('column', [repr(name) for name in unknown])}")
    if "t" not in place:
        problems.append("no column 't' (time in seconds)")
    joints = max((number for found in numbers.values() for number in found), default=0)
    if joints == 0:
        problems.append("no joints")
    for kind, found in numbers.items():
        missing = [f"{kind}{number}" for number in range(1, joints + 1) if number not in found]
        if missing and (found or kind != "dq"):
            problems.append(f"missing {_listed('', missing)}")
    if problems:
        raise RecordingError(path, f"line 1: {'; '.join(problems)}; {_what_then(names, columns)}")

    def indices(kind: str) -> NDArray[np.intp]:
        return np.array([place[f"{kind}{number}"] for number in range(1, joints + 1)], np.intp)

    velocity = indices("dq") if numbers["dq"] else None
    nanoseconds, scale = Decimal(10**9), np.ones(len(names))
    for ours, one in (columns or {}).items():
        if ours == "t":
            # Powers of ten and short decimals, as they are written: times keep all their digits.
            nanoseconds *= Decimal(repr(one.si_factor(ours)))
        else:
            scale[place[ours]] = one.si_factor(ours)
    return CsvColumns(
        names=names,
        time=place["t"],
        position=indices("q"),
        torque=indices("tau"),
        velocity=velocity,
        nanoseconds=nanoseconds,
        scale=None if (scale == 1.0).all() else scale,
        used=tuple(sorted(place.values())),
    )


def _no_header(header: str, names: Sequence[str]) -> str:
    """Return what is wrong with a first line that is no header at all; empty where it may be one."""
    if names and all(_is_number(name) for name in names):
        return "is numbers; put a line with the names of the columns above it: t,q1..qN,tau1..tauN"
    if header.lstrip().startswith(("#", "%")):
        return "is a comment; remove what stands before the names of the columns"
    if header.lstrip().startswith("<"):
        return "is HTML or XML, a page and no recording; download the file itself"
    if any(name.startswith(('"', "'")) for name in names):
        return "names are in quotation marks; write names and numbers without them"
    separators = {";": "semicolons", "\t": "tabs", "|": "bars", " ": "spaces"}
    if len(names) == 1:
        for separator, words in separators.items():
            if separator in header.strip():
                return f"columns are separated by {words}; separate them by commas, and write decimals with points"
    return ""


def _listed(what: str, names: Sequence[str], most: int = 8) -> str:
    plural = f"{what}{'s' if len(names) > 1 else ''} " if what else ""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{plural}{', '.join(names[:most])}{more}"


def _what_then(names: Sequence[str], columns: Mapping[str, Column] | None) -> str:
    if columns is not None:
        return f"the file has the {_listed('column', names, 40)}"
    if any(_NAME.fullmatch(name.lower()) and not _NAME.fullmatch(name) for name in names):
        return "write the names in small letters: t,q1..qN,tau1..tauN"
    return (
        "expected a header t,q1..qN,tau1..tauN, or the names of these columns in recording.columns of the description"
        " (or --columns): columns: {t: NAME, q1: NAME, tau1: NAME, ...}"
    )


GZIP_MAGIC: Final = b"\x1f\x8b"
MAX_EXPANDED: Final = 4 << 30
MAX_RATIO: Final = 200

_STEP: Final = 1 << 20
_RATIO_FROM: Final = 64 << 20
_MAX_SECONDS: Final = 9.2e9
_MISSING: Final = frozenset({"", "nan", "na", "n/a", "null", "none"})
_FIRST_ROW: Final = 2  # line numbers count from 1, and the header is line 1
_OF_NUMBERS: Final = b"0123456789+-.eE, \t\r"
# Nanoseconds below which a product of two doubles is off by less than 0.002, and what the next whole number may be
# away so that rounding goes there all the same.
_EXACT_BELOW: Final = 2.0**43
_SURELY: Final = 0.49


class CsvRecording:
    """A Recording in a CSV file; its columns are the joints 1..N, which the file does not name.

    Attributes:
        path: the file.
        sha256: hash of the file's bytes; of a compressed file, that of the compressed bytes.
        joint_names: names of the joints that the file was opened with, else empty.
        joints: number of joints.
        torque_zero_order_hold: False.
        torn: False; what does not fit raises.
    """

    torque_zero_order_hold = False
    torn = False

    def __init__(
        self,
        path: Path | str,
        *,
        columns: Mapping[str, Column] | None = None,
        joints: Sequence[str] | None = None,
        skip_missing: bool = False,
    ) -> None:
        """Open the file and read its header.

        Args:
            path: the file.
            columns: column of a file with another header for each of `t`, `q1`, `tau1`, ...; columns that are not named
                here are then left out.
            joints: names of the joints 1..N, where they are known.
            skip_missing: whether to leave out rows in which a value other than the time is missing (an empty field,
                `nan`, `NA`, `null`).

        Raises:
            UsageError: no such file.
            RecordingError: the header does not fit, and the message has all that is wrong with it; another number of
                joints.
        """
        self.path = Path(path)
        require_file(self.path)
        self._size = self.path.stat().st_size
        self.sha256 = sha256(self.path, self._size)
        first = next(self._lines(), [b""])
        try:
            header = first[0].decode("utf-8-sig")
        except UnicodeDecodeError as error:
            raise RecordingError(self.path, "line 1: the header is not text") from error
        self._skip_missing = skip_missing
        self._columns: CsvColumns = parse_header(self.path, header, columns)
        self.joints = self._columns.joints
        self.joint_names: tuple[str, ...] = tuple(joints or ())
        if joints is not None and self.joints != len(joints):
            raise RecordingError(self.path, f"has {self.joints} joints but the arm has {len(joints)}")

    def blocks(self, samples: int = BLOCK_SAMPLES) -> Iterator[Block]:
        """Yield the rows in blocks of `samples`, checked; raises RecordingError with the line of the first bad one.

        Raises:
            RecordingError: a row with too few or too many fields, a field that is no finite number, a time that
                runs backwards or repeats with other values, a damaged or oversized gzip file; names the line.
        """
        names = self.joint_names or [str(joint + 1) for joint in range(self.joints)]
        return assemble(
            self._pieces(),
            samples,
            self.path,
            names,
            sample_words=lambda index: f"line {index + _FIRST_ROW}",
            skip_missing=self._skip_missing,
        )

    def _pieces(self) -> Iterator[Block]:
        line = 1
        blank: int | None = None
        for lines in self._lines():
            start = 1 if line == 1 else 0
            rows = lines[start:]
            first = line + start
            line += len(lines)
            # Empty lines at the very end are no rows; in the middle they are rows that got lost.
            while rows and not rows[-1].strip():
                blank = first + len(rows) - 1 if blank is None else min(blank, first + len(rows) - 1)
                rows.pop()
            if not rows:
                continue
            if blank is not None and blank < first + len(rows):
                raise RecordingError(self.path, f"line {blank}: is empty; a row is missing, remove the line")
            for begin in range(0, len(rows), BLOCK_SAMPLES):
                yield self._parse(rows[begin : begin + BLOCK_SAMPLES], first + begin)

    def _parse(self, rows: list[bytes], first: int) -> Block:
        """Parse rows to a block; `first` is the line number of the first one."""
        columns = self._columns
        separators = columns.fields - 1
        if set(map(methodcaller("count", b","), rows)) != {separators}:
            self._explain(rows, first)
        text = b",".join(rows)
        try:
            values = self._numbers(text, len(rows))
        except ValueError:
            self._explain(rows, first)
        # Python reads 1_000 as a number, and digits of other scripts; in a data file they are slips.
        if not text.isascii() or b"_" in text:
            self._explain(rows, first)
        stamps = self._stamps(values[:, columns.time], text, first)
        if columns.scale is not None:
            values *= columns.scale
        velocity = None if columns.velocity is None else values[:, columns.velocity]
        return Block(stamps, values[:, columns.position], values[:, columns.torque], velocity)

    def _numbers(self, text: bytes, rows: int) -> Matrix:
        """Parse the fields of some rows, shape (rows, fields), what is not read being anything.

        Raises:
            ValueError: one that is read is no number.
        """
        columns = self._columns
        if not text.translate(None, _OF_NUMBERS):
            # Four times as fast as float(), and rounded as it does.
            with suppress(ValueError, OverflowError):  # .5 and +1, that JSON has not
                return np.array(from_json(b"[" + text + b"]"), np.float64).reshape(rows, columns.fields)
        fields = text.decode("utf-8", errors="replace").split(",")
        if len(columns.used) == columns.fields and not self._skip_missing:
            return np.array(list(map(float, fields))).reshape(rows, columns.fields)
        values = np.zeros((rows, columns.fields))
        for index in columns.used:
            words = fields[index :: columns.fields]
            if self._skip_missing and index != columns.time:
                words = ["nan" if _is_missing(word) else word for word in words]
            values[:, index] = list(map(float, words))
        return values

    def _stamps(self, times: Matrix, text: bytes, first: int) -> Stamps:
        """Round times to nanoseconds as they are written; `first` is the line number of the first row."""
        columns = self._columns
        bad = ~(np.abs(times) < _MAX_SECONDS * 1e9 / float(columns.nanoseconds))
        if bad.any():
            index = int(np.argmax(bad))
            # The unit in which it is a time of this century.
            size = abs(float(times[index])) / _MAX_SECONDS
            unit = "ms" if size < 1e3 else "us" if size < 1e6 else "ns"
            raise RecordingError(
                self.path,
                f"line {first + index}: time t is {self._words(text)[index].strip()}; not in seconds? "
                f"Name its unit: recording.columns: {{t: {{column: NAME, unit: {unit}}}}}",
            )
        nanoseconds = times * float(columns.nanoseconds)
        whole = np.rint(nanoseconds)
        if np.abs(nanoseconds).max() < _EXACT_BELOW and np.abs(nanoseconds - whole).max() < _SURELY:
            return whole.astype(np.int64)
        # Decimal has no exponents as low as some that a double takes for zero.
        pairs = zip(times.tolist(), self._words(text), strict=True)
        return np.array([round(Decimal(word) * columns.nanoseconds) if time else 0 for time, word in pairs], np.int64)

    def _words(self, text: bytes) -> list[str]:
        """Give the times of some rows as they are written."""
        return text.decode("utf-8", errors="replace").split(",")[self._columns.time :: self._columns.fields]

    def _explain(self, rows: list[bytes], first: int) -> None:
        """Raise for the first row that does not fit; return where none of the columns that are read is wrong."""
        names, used = self._columns.names, set(self._columns.used)
        for line, row in enumerate(rows, first):
            if not row.strip():
                raise RecordingError(self.path, f"line {line}: is empty; a row is missing, remove the line")
            fields = row.decode("utf-8", errors="replace").split(",")
            if len(fields) != len(names):
                # A whole number has no comma.
                twice = len(names) < len(fields) <= 2 * len(names) and len(fields) > 1.5 * len(names)
                what = (
                    "are decimals written with commas? Write points"
                    if twice
                    else "the row is torn or malformed, remove it if it is the last one"
                )
                raise RecordingError(
                    self.path, f"line {line}: has {len(fields)} fields but the header has {len(names)}; {what}"
                )
            for index, (name, field) in enumerate(zip(names, fields, strict=True)):
                missing = _is_missing(field) and index != self._columns.time
                if index in used and not _is_number(field) and not (missing and self._skip_missing):
                    hint = "; recording.missing: skip leaves such rows out" if missing else ""
                    raise RecordingError(self.path, f"line {line}: {name} is {field[:40]!r}, not a number{hint}")

    def _lines(self) -> Iterator[list[bytes]]:
        """Yield the file's lines, some at a time, without their ends."""
        tail = b""
        for data in self._expanded():
            lines = (tail + data).split(b"\n")
            tail = lines.pop()
            if len(tail) > _STEP:
                raise RecordingError(self.path, f"a line of more than {_STEP} bytes; this is no CSV file")
            if lines:
                yield lines
        if tail:
            yield [tail]

    def _expanded(self) -> Iterator[bytes]:
        """Yield the file's bytes, decompressed where needed, a bounded number in all."""
        total = 0
        try:
            with self.path.open("rb") as raw:
                compressed = raw.read(len(GZIP_MAGIC)) == GZIP_MAGIC
                raw.seek(0)
                stream = cast(IO[bytes], gzip.GzipFile(fileobj=raw)) if compressed else raw
                while data := stream.read(_STEP):
                    total += len(data)
                    if compressed and (
                        total > MAX_EXPANDED or (total > _RATIO_FROM and total > MAX_RATIO * self._size)
                    ):
                        raise RecordingError(self.path, f"expands {self._size} bytes to more than {total}; refused")
                    yield data
        except (EOFError, zlib.error, OSError) as error:
            # gzip's own BadGzipFile is an OSError.
            raise RecordingError(self.path, f"cannot be read beyond {total} bytes of text: {error}") from error


def _is_missing(field: str) -> bool:
    return field.strip().lower() in _MISSING


def _is_number(field: str) -> bool:
    if "_" in field or not field.isascii():
        return False
    try:
        float(field)
    except ValueError:
        return False
    return True
