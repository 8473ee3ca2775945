"""Read the entries of an EDS or DCF (CiA 306-1) as far as possible, in spite of oddities in makers' files."""

from __future__ import annotations

import configparser
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final

LONGEST: Final = 2**19  # characters; an ini reader takes about a second for them

_OBJECT = re.compile(r"^([0-9a-f]{4})(?:sub([0-9a-f]{1,2}))?$", re.IGNORECASE)
_NODE = re.compile(r"\+?\$NODEID\+?", re.IGNORECASE)
_NUMBER_OF_ENTRIES = 0x05  # type of sub-index 0
_MOST_SUBS = 0xFE


@dataclass(frozen=True)
class DataSheetEntry:
    """One entry of a data sheet.

    Attributes:
        kind: code of its data type (CiA 301, table 44); 0 where the file says none.
        access: `ro`, `wo`, `rw`, `rww`, `rwr` or `const`.
        mappable: into a PDO.
        low: least value, None where the file says none.
        high: greatest value, likewise.
        text: its value as the file has it, None where it says none; that of a DCF before the default.
        configured: whether that is a value which a DCF gives to this drive, not the default of its kind.
    """

    kind: int
    access: str = "ro"
    mappable: bool = False
    low: int | None = None
    high: int | None = None
    text: str | None = None
    configured: bool = False

    @property
    def writable(self) -> bool:
        """Return whether a host may write the entry."""
        return self.access in ("rw", "rww", "rwr", "wo")

    def number(self, node: int) -> int | None:
        """Return the entry's value as a number, None where it has none.

        Args:
            node: that COB-IDs are relative to.
        """
        return None if self.text is None else _number(self.text, node)


@dataclass(frozen=True)
class DataSheet:
    """Contents of an EDS or DCF file.

    Attributes:
        entries: by `index << 8 | sub-index`.
        dummies: indices of the dummies that can be mapped (CiA 306-1, `DummyUsage`).
        identity: what 1018h answers by sub-index, where the file tells it.
        mistake: why the text is no EDS; None where it may be one.
    """

    entries: Mapping[int, DataSheetEntry] = field(default_factory=dict)
    dummies: frozenset[int] = frozenset()
    identity: Mapping[int, int] = field(default_factory=dict)
    mistake: str | None = None

    def has(self, index: int, sub: int | None = None) -> bool:
        """Return whether the data sheet lists an object, or one sub-index of it."""
        return any(key >> 8 == index for key in self.entries) if sub is None else index << 8 | sub in self.entries


@lru_cache(maxsize=32)
def data_sheet(text: str) -> DataSheet:
    """Parse the text of an EDS or DCF; never raises, what cannot be read is left out."""
    if len(text) > LONGEST:
        return DataSheet(mistake=f"longer than {LONGEST} characters")
    if why := _strange_line(text):
        return DataSheet(mistake=why)
    parser = configparser.RawConfigParser(strict=False, inline_comment_prefixes=(";",))
    try:
        parser.read_string(text)
    except configparser.Error as error:
        return DataSheet(mistake=str(error).splitlines()[0].removesuffix(" file: '<string>'"))
    sections = {name.lower(): parser[name] for name in parser.sections()}
    entries: dict[int, DataSheetEntry] = {}
    for name, section in sections.items():
        if match := _OBJECT.match(name):
            index, sub = int(match[1], 16), match[2]
            if sub is not None or "subnumber" not in section:
                entries.update((index << 8 | at, one) for at, one in _listed(section, int(sub or "0", 16)))
    usage: Mapping[str, str] = sections.get("dummyusage", {})
    dummies = frozenset(k for k in range(1, 8) if _number(usage.get(f"dummy{k:04d}", "0"), 0) == 1)
    told = {1: "vendornumber", 2: "productnumber", 3: "revisionnumber"}
    info: Mapping[str, str] = sections.get("deviceinfo", {})
    mistake = None if "deviceinfo" in sections else "it has no section [DeviceInfo]"
    identity = {sub: _number(info.get(key, ""), 0) for sub, key in told.items()}
    identity |= {s: n for s in told if (one := entries.get(0x1018 << 8 | s)) and (n := one.number(0)) is not None}
    return DataSheet(entries, dummies, {sub: value for sub, value in identity.items() if value is not None}, mistake)


def _listed(section: Mapping[str, str], sub: int) -> Iterator[tuple[int, DataSheetEntry]]:
    """Yield the entries of one section: one, or all elements of a compact array."""
    text = section.get("defaultvalue") or None
    own = section.get("parametervalue") or None
    if own is not None and not (text is not None and _NODE.search(text)):  # that is another node's
        text = own
    low, high = (_number(section.get(key, ""), 0) for key in ("lowlimit", "highlimit"))
    kind = _number(section.get("datatype", ""), 0) or 0
    access = section.get("accesstype", "ro").strip().lower()
    mappable, configured = bool(_number(section.get("pdomapping", ""), 0)), own is not None and text is own
    found = DataSheetEntry(kind, access, mappable, low, high, text, configured)
    if many := min(_number(section.get("compactsubobj", ""), 0) or 0, _MOST_SUBS):
        yield 0, DataSheetEntry(_NUMBER_OF_ENTRIES, text=str(many))
        yield from ((number, found) for number in range(1, many + 1))
    else:
        yield sub, found


def _number(text: str, node: int) -> int | None:
    plain, relative = _NODE.subn("", text.replace(" ", ""))
    try:
        return int(plain or "0" if relative else plain, 0) + (node if relative else 0)
    except ValueError:
        return None


def _strange_line(eds: str) -> str | None:
    """Return what is wrong with the first line that is not ini syntax, as configparser is quadratic in such lines."""
    begun = False
    level: int | None = None  # indentation of the option that deeper lines continue
    for number, line in enumerate(eds.split("\n"), 1):
        text = line.strip()
        indent = len(line) - len(line.lstrip())
        if not text or text[0] in "#;" or (level is not None and indent > level):
            continue
        section, at = re.match(r"\[.+\]", text), re.search("[=:]", text)
        begun = begun or section is not None
        if not begun:
            return None  # configparser reports it at once
        if section is None and at is None:
            return f"line {number} is neither a section nor a key with a value: {text[:40]!r}"
        if at is not None and at.start() == 0:
            return f"line {number} has no key: {text[:40]!r}"
        level = None if section else indent
    return None
