"""Read the entries of an EDS or DCF (CiA 306-1) as far as possible, in spite of oddities in makers' files.

Lines that are none of an ini file are passed over, and so is every value that is none: the drive has the last word. The
loop over lines is our own, because neither `canopen` nor `configparser` reads such files ([decision 0064]).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Final

LONGEST: Final = 2**21  # characters; the largest files of makers have about half of them

_SECTION = re.compile(r"\[([^\]]*)\]")
_OBJECT = re.compile(r"([0-9a-f]{4})(?:sub([0-9a-f]{1,2}))?")
_REMARK = re.compile(r"\s;")
_NODE = re.compile(r"\$?NODE-?ID", re.IGNORECASE)
_OCTAL = re.compile(r"-?0[0-7]+")
_BARE_HEXADECIMAL = re.compile(r"([0-9a-f]*[a-f][0-9a-f]*)h?|([0-9a-f]+)h", re.IGNORECASE)  # 1F4, 1F4h
# As CiA 306-1 has numbers; what is relative to a node number may stand on either side of `+`.
_DIGITS, _OWN = "0x[0-9a-f]+|0[0-7]*|[1-9][0-9]*", r"\$?NODE-?ID"
_STANDARD = re.compile(
    rf"(?P<after>{_OWN})(?:\s*(?P<more>\+\s*(?:{_DIGITS})))?|(?P<plain>[+-]?(?:{_DIGITS}))(?P<before>\s*\+\s*{_OWN})?",
    re.IGNORECASE,
)
_LONGEST_NUMBER = 100  # characters, leading zeros included
_LARGEST = 2**64  # which no number of an object dictionary reaches
_MOST_ENTRIES = 2**17
_UNSIGNED8, _UNSIGNED16, _UNSIGNED32 = 0x05, 0x06, 0x07  # data types (CiA 301, table 44)
_CONTAINERS = (8, 9)  # object types of arrays and records, whose entries have sections of their own
_MOST_SUBS, _MOST_PDOS, _MOST_MAPPED = 0xFE, 512, 8
# Of `CompactPDO`: sub-index of a PDO's parameters and its type, for each bit of the mask.
_COMPACT = {1: _UNSIGNED32, 2: _UNSIGNED8, 3: _UNSIGNED16, 5: _UNSIGNED16, 6: _UNSIGNED8}
_YES = ("true", "yes")
_LISTS = ("mandatoryobjects", "optionalobjects", "manufacturerobjects")  # of all objects (CiA 306-1)
_UNLISTED = 0.03  # of the announced objects, of which whole files of makers lack one or two in two hundred


@dataclass(frozen=True)
class DataSheetEntry:
    """One entry of a data sheet.

    Attributes:
        kind: code of its data type (CiA 301, table 44); 0 where the file says none.
        access: `ro`, `wo`, `rw`, `rww`, `rwr` or `const`.
        mappable: into a PDO.
        low: least value, None where the file says none.
        high: greatest value, likewise.
        text: value in the file's own words, None where it says none; that of a DCF before the default.
        configured: whether the value is one which a DCF gives to this drive, not the default of its kind.
        place: section and key of the value that a DCF gives, as `[6083] ParameterValue`; empty where it gives none.
    """

    kind: int
    access: str = "ro"
    mappable: bool = False
    low: int | None = None
    high: int | None = None
    text: str | None = None
    configured: bool = False
    place: str = ""

    @property
    def writable(self) -> bool:
        """Return whether the entry's access type lets a host write it: rw, rww, rwr or wo."""
        return self.access in ("rw", "rww", "rwr", "wo")

    @property
    def readable(self) -> bool:
        """Return whether a host may read the entry: its access type is not `wo`; True for an unknown one."""
        return self.access != "wo"

    def number(self, node_id: int) -> int | None:
        """Return the DCF's value, else the default, as a number in any maker's notation; else None.

        Args:
            node_id: node number that COB-IDs are relative to.
        """
        return None if self.text is None else _number(self.text, node_id)

    def standard_number(self, node_id: int) -> int | None:
        """Return the entry's value if in a notation of CiA 306-1 (10, 017, 0xA, $NODEID+0xA); None for others.

        What is written otherwise has no certain meaning: is 1e5 a hundred thousand, or 485?
        """
        match = _STANDARD.fullmatch(self.text or "") if len(self.text or "") <= _LONGEST_NUMBER else None
        if match is None:
            return None
        digits = "".join((match["more"] or match["plain"] or "0").split()).lower()
        plain = digits.lstrip("+-")
        base = 16 if plain.startswith("0x") else 8 if plain.startswith("0") else 10
        return int(digits, base) + (node_id if match["after"] or match["before"] else 0)

    @property
    def hexadecimal(self) -> bool:
        """Return whether the text of the value contains `0x`; such digits may be those of a negative number."""
        return "0x" in (self.text or "").lower()


@dataclass(frozen=True)
class DataSheet:
    """Contents of an EDS or DCF file.

    Attributes:
        entries: by `index << 8 | sub-index`.
        dummies: indices of the dummies that can be mapped (CiA 306-1, `DummyUsage`).
        identity: values of 1018h by sub-index, where the file has them.
        mistake: reason why the text is no EDS; None where it may be one.
        cut_off: reason why its end seems to be missing, in words; empty where the file seems to be whole.
    """

    entries: Mapping[int, DataSheetEntry] = field(default_factory=dict)
    dummies: frozenset[int] = frozenset()
    identity: Mapping[int, int] = field(default_factory=dict)
    mistake: str | None = None
    cut_off: str = ""

    def has(self, index: int, subindex: int | None = None) -> bool:
        """Return whether the data sheet lists the object `index`, or, with `subindex`, this one sub-index of it."""
        if subindex is None:
            return any(key >> 8 == index for key in self.entries)
        return index << 8 | subindex in self.entries


@lru_cache(maxsize=32)
def data_sheet(text: str) -> DataSheet:
    """Parse an EDS or DCF; never raises: unreadable entries are left out, `mistake` says why a whole text is no EDS."""
    if len(text) > LONGEST:
        return DataSheet(mistake=f"longer than {LONGEST} characters")
    sections = _sections(text)
    objects = {place: section for name, section in sections.items() if (place := _place(name)) is not None}
    divided = {index for index, sub in objects if sub is not None}
    entries: dict[int, DataSheetEntry] = {}
    # What an object says of all its entries comes before what the section of one of them says.
    for (index, sub), section in sorted(objects.items(), key=lambda one: one[0][1] is not None):
        if sub is None and _is_container(section, index in divided):
            continue
        values = sections.get(f"{index:04x}value", {})
        entries.update((index << 8 | at, one) for at, one in _listed(section, index, sub, values))
        if len(entries) > _MOST_ENTRIES:
            return DataSheet(mistake=f"it lists more than {_MOST_ENTRIES} entries")
    info: Mapping[str, str] = sections.get("deviceinfo", {})
    entries = _compact_pdos(info) | entries
    usage: Mapping[str, str] = sections.get("dummyusage", {})
    dummies = frozenset(k for k in range(1, 8) if _is_set(usage.get(f"dummy{k:04d}", "0")))
    wanted = {1: "vendornumber", 2: "productnumber", 3: "revisionnumber"}
    mistake = None if entries or "deviceinfo" in sections else "it lists no object and has no section [DeviceInfo]"
    identity = {sub: _number(info.get(key, ""), 0) for sub, key in wanted.items()}
    identity |= {s: n for s in wanted if (one := entries.get(0x1018 << 8 | s)) and (n := one.number(0)) is not None}
    known = {sub: value for sub, value in identity.items() if value is not None}
    return DataSheet(entries, dummies, known, mistake, _cut_off(sections, {index for index, _ in objects}))


def _cut_off(sections: Mapping[str, Mapping[str, str]], there: set[int]) -> str:
    """Return why a file's end seems to be missing: lists of objects, or sections of many that are listed."""
    lists = [sections[name] for name in _LISTS if name in sections]
    if not lists:
        return ""
    if len(lists) < len(_LISTS):
        return "it lists mandatory objects, and not all others" if _LISTS[0] in sections else ""
    announced = sum(max(_number(one.get("supportedobjects", ""), 0) or 0, len(one) - 1) for one in lists)
    listed = {_number(value, 0) for one in lists for key, value in one.items() if key.isdecimal()}
    missing = min(announced, 0x10000) - len(listed & there)
    return f"of {announced} announced objects {missing} are missing" if missing > _UNLISTED * announced else ""


def _sections(text: str) -> dict[str, dict[str, str]]:
    """Return the keys and values of each section by its name, all names in lower case; the last of two alike counts."""
    found: dict[str, dict[str, str]] = {}
    section: dict[str, str] = {}
    for line in text.replace("\r", "\n").split("\n"):
        plain = line.strip("\ufeff\0 \t")
        if plain.startswith("["):
            # Below a heading that is torn, keys belong to no section.
            name = _SECTION.match(plain)
            section = {} if name is None else found.setdefault("".join(name[1].split()).lower(), {})
        elif plain[:1] not in (";", "#"):
            key, equals, value = plain.partition("=")
            if equals:
                section[key.strip().lower()] = _REMARK.split(value, maxsplit=1)[0].strip()
    return found


def _place(name: str) -> tuple[int, int | None] | None:
    """Return index and sub-index (None for an object's own) of a section; None for a section of another kind."""
    match = _OBJECT.fullmatch(name)
    return None if match is None else (int(match[1], 16), None if match[2] is None else int(match[2], 16))


def _is_container(section: Mapping[str, str], divided: bool) -> bool:
    """Return whether an object's own section only announces sections of its entries.

    Files give `SubNumber=0` to plain variables too, and leave out what the standard wants.
    """
    kind, subs = (_number(section.get(key, ""), 0) for key in ("objecttype", "subnumber"))
    if _number(section.get("compactsubobj", ""), 0):
        return False
    if kind in _CONTAINERS:
        return divided or bool(subs) or "datatype" not in section
    return (divided and "datatype" not in section) or (kind is None and bool(subs))


def _listed(
    section: Mapping[str, str], index: int, sub: int | None, values: Mapping[str, str]
) -> Iterator[tuple[int, DataSheetEntry]]:
    """Yield the entries of one section: one, or all elements of a compact array, with those of its values in a DCF."""
    text = section.get("defaultvalue") or None
    own = section.get("parametervalue") or None
    if own is not None and not (text is not None and _NODE.search(text)):  # that is another node's
        text = own
    low, high = (_number(section.get(key, ""), 0) for key in ("lowlimit", "highlimit"))
    kind = _number(section.get("datatype", ""), 0) or 0
    access = section.get("accesstype", "ro").strip().lower()
    mappable, configured = _is_set(section.get("pdomapping", "")), own is not None and text is own
    name = f"{index:04X}" if sub is None else f"{index:04X}sub{sub:X}"
    place = "" if own is None else f"[{name}] ParameterValue"
    found = DataSheetEntry(kind, access, mappable, low, high, text, configured, place)
    if (many := min(_number(section.get("compactsubobj", ""), 0) or 0, _MOST_SUBS)) > 0:
        yield 0, DataSheetEntry(_UNSIGNED8, text=str(many))
        for number in range(1, many + 1):
            own = values.get(str(number)) or None
            place = f"[{index:04X}Value] {number}"
            yield number, found if own is None else replace(found, text=own, configured=True, place=place)
    else:
        yield sub or 0, found


def _compact_pdos(info: Mapping[str, str]) -> dict[int, DataSheetEntry]:
    """Return the parameters of PDOs that a file does not list but sums up (`CompactPDO`)."""
    mask = _number(info.get("compactpdo", ""), 0) or 0
    found: dict[int, DataSheetEntry] = {}
    for key, parameters, mapping, base in (("nrofrxpdo", 0x1400, 0x1600, 0x200), ("nroftxpdo", 0x1800, 0x1A00, 0x180)):
        many = min(_number(info.get(key, ""), 0) or 0, _MOST_PDOS) if mask > 0 else 0
        for number in range(many):
            born = f"$NODEID+{base + number * 0x100:#x}" if number < 4 else "0x80000000"
            subs = {sub: kind for sub, kind in _COMPACT.items() if mask >> sub & 1}
            texts = {1: born, 2: "255"}
            found[parameters + number << 8] = DataSheetEntry(_UNSIGNED8, text=str(max(subs, default=0)))
            for sub, kind in subs.items():
                found[parameters + number << 8 | sub] = DataSheetEntry(kind, "rw", text=texts.get(sub, "0"))
            found[mapping + number << 8] = DataSheetEntry(_UNSIGNED8, "rw", text="0")
            for sub in range(1, _MOST_MAPPED + 1):
                found[mapping + number << 8 | sub] = DataSheetEntry(_UNSIGNED32, "rw", text="0")
    return found


def _is_set(text: str) -> bool:
    return bool(_number(text, 0)) or text.strip().lower() in _YES


@lru_cache(maxsize=4096)
def _number(text: str, node: int) -> int | None:
    """Return a number as files write it: decimal, 0x180, octal (017), 180h, 1F4, relative to `$NODEID`; else None."""
    plain, relative = _NODE.subn("", "".join(text.partition(";")[0].split()).strip("\"'()"))
    plain = plain.strip("+").rstrip("uUlL")
    try:
        if bare := _BARE_HEXADECIMAL.fullmatch(plain):
            value = int(bare[1] or bare[2], 16)
        elif _OCTAL.fullmatch(plain):
            value = int(plain, 8)
        else:
            value = int(plain or "0" if relative else plain, 10 if plain.strip("-0").isdecimal() else 0)
    except ValueError:
        return None
    value += node if relative else 0
    return value if abs(value) < _LARGEST else None
