"""Judge what a drive can against what this driver needs, by its family and by SDO uploads.

A drive's answer counts before its family (`profiles/`), the family before the file. What is indispensable and missing
is a problem, with the object and the reason; what is optional and missing is noted with what happens instead. Of
alternatives the first of the family's list is taken. Whether an entry can be written shows when `drive_setup.py` writes
it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

from drivers.can.bus_state import BusError
from drivers.canopen import object_dictionary as od
from drivers.canopen.object_dictionary import Entry, Kind, pdo_entry
from drivers.canopen.sdo import DOES_NOT_EXIST, Objects, SdoRefused
from ident_service.config.canopen import CanopenDrive, CanopenDriver, WatchdogKind
from ident_service.config.drive_family import (
    Family,
    PositionPath,
    TorqueLimit,
    TorquePath,
    TorqueUnit,
    parse_family,
)
from ident_service.config.eds import DataSheet
from ident_service.errors import DriverError, UnsuitableDrive

_FOLDER = Path(__file__).parent / "profiles"
GENERIC = "generic402"


@lru_cache(maxsize=1)
def shipped_families() -> tuple[Family, ...]:
    """Return the families that come with the driver, the generic one last."""
    files = sorted(_FOLDER.glob("*.yaml"), key=lambda path: (path.stem == GENERIC, path.stem))
    return tuple(parse_family(path.name, path.read_text(encoding="utf-8")) for path in files)


def family_of(identity: Mapping[str, int], own_families: Sequence[Family] = ()) -> Family:
    """Return a drive's family by vendor and product, its gaps filled from the generic one; else the generic one.

    Args:
        identity: values of 1018h, by the keys `vendor` and `product`.
        own_families: families of the arm's description, which count before the shipped ones.
    """
    vendor, product = identity.get("vendor"), identity.get("product")
    *shipped, generic = shipped_families()
    makers = [one for one in (*own_families, *shipped) if one.match.vendor is not None and one.match.vendor == vendor]
    exact = [one for one in makers if product in one.match.product]
    found = [*exact, *(one for one in makers if not one.match.product)]
    return found[0].completed_by(generic) if found else generic


def parse_entry(text: str, name: str, unit: str = "") -> Entry:
    """Parse an entry as a family writes it, index:sub/type, such as `6071:0/i16`."""
    where, kind = text.split("/")
    index, sub = where.split(":")
    return Entry(int(index, 16), int(sub, 16), Kind[kind.upper()], name, unit)


DRIVE_PROFILE = 402  # low word of 1000h
TORQUE_UNITS = {"mNm": 1e-3, "uNm": 1e-6, "cNm": 1e-2, "mA": 1e-3, "own": 1.0}
_TURNS, _STEPS, _MINUTES, _SECONDS = 0xB4, 0xB5, 0x47, 0x03  # of 60A9h (CiA 303-2)
_SAME = 0.01  # of a torque's unit: rounding, not another unit
_ABSURD = 5.0  # between two sayings of one rated torque
_MOST_TIMES = 20.0  # the rated torque, which no drive's peak torque comes near
_POWERS = range(1, 7)

# Why a drive without these cannot be driven.
_INDISPENSABLE: Sequence[tuple[Entry, str]] = (
    (od.VENDOR, "its maker is unknown"),
    (od.CONTROL_WORD, "it cannot be enabled or disabled"),
    (od.STATUS_WORD, "it does not report its state"),
    (od.MODE, "its mode of operation cannot be set"),
    (od.MODE_DISPLAY, "it does not report its mode of operation"),
    (od.POSITION, "it does not report its position"),
    (od.RPDO_COB_ID, "torques have no frame"),
    (od.RPDO_COUNT, "torques have no frame"),
    (pdo_entry(od.RPDO_COB_ID, 2), "control words have no frame"),
    (od.TPDO_COB_ID, "positions have no frame"),
    (od.TPDO_COUNT, "positions have no frame"),
)
# What happens without these.
_OPTIONAL: Sequence[tuple[Entry, str]] = (
    (od.SYNC_COB_ID, "SYNC is taken to be 080h; a position proves it"),
    (od.SYNC_PERIOD, "its cycle time cannot be set"),
    (od.PERIOD_NUMBER, "its interpolation period cannot be set"),
    (od.EMERGENCY_COB_ID, "emergencies are taken to be 080h + node"),
    (od.EMERGENCY_INHIBIT, "emergencies are not rate-limited"),
    (od.ERROR_BEHAVIOUR, "a lost host may end `operational`: without status reports its watchdog cannot be tested"),
    (od.ABORT_CONNECTION, "its reaction to a lost host is the maker's"),
    (od.QUICK_STOP_OPTION, "`disable voltage` is the only stop that is known"),
    (od.FAULT_OPTION, "its reaction to a fault is the maker's"),
    (od.LOWER_LIMIT, "it has no position limits (which would not stop a drive in torque mode either)"),
    (od.ZERO_COUNTS, "it cannot store a zero (`zero: at_home`)"),
)
_OTHERS: Sequence[Entry] = (
    *(od.DEVICE_TYPE, od.PRODUCT, od.REVISION, od.SERIAL, od.SYNC_WINDOW, od.SYNC_OVERFLOW, od.GUARD_TIME),
    *(od.LIFE_FACTOR, od.HEARTBEAT_CONSUMER, od.HEARTBEAT_PRODUCER, od.RPDO_DEADLINE, pdo_entry(od.TPDO_PERIOD, 2)),
    *(pdo_entry(od.TPDO_COB_ID, 2), od.VELOCITY_UNIT, od.SECOND_AXIS),
    *(od.TARGET_POSITION, od.TORQUE_ACTUAL, od.RATED_CURRENT, od.SUPPORTED_MODES, od.ENCODER_COUNTS, od.ENCODER_TURNS),
)


@dataclass(frozen=True)
class DriveEntries:
    """Hold what is known of a drive's object dictionary.

    Attributes:
        there: keys (index << 8 | sub-index) of entries that it has.
        values: values of the entries, by key, where known.
        unread: reason why an entry that it seems to have could not be read, by key.
        asked: whether the drive was asked; else its data sheet foretells.
        firmware: software version of the drive (100Ah), empty where it does not tell it.
    """

    there: frozenset[int]
    values: Mapping[int, int]
    unread: Mapping[int, str] = field(default_factory=dict)
    asked: bool = True
    firmware: str = ""

    def has(self, entry: Entry) -> bool:
        """Return whether the drive is known to have an entry."""
        return entry.key in self.there

    def get(self, entry: Entry) -> int | None:
        """Return the value that an entry is known to hold; None where none is known."""
        return self.values.get(entry.key)

    @property
    def identity(self) -> dict[str, int]:
        """Return a dict of `vendor` and `product` (1018h), each only where it is known."""
        said = {"vendor": self.get(od.VENDOR), "product": self.get(od.PRODUCT)}
        return {name: value for name, value in said.items() if value is not None}


@dataclass(frozen=True)
class Problem:
    """Describe what is indispensable and missing: the object's index [h], and why it is needed, in words."""

    where: str
    why: str

    def __str__(self) -> str:
        return f"{self.where}: {self.why}"


@dataclass(frozen=True)
class Capabilities:
    """Hold what one drive can do, and which of the alternatives are used.

    Attributes:
        family: drive family that it belongs to.
        found: entries that the drive has.
        torque: way in which torques, or positions, are streamed (`driver.streams`); None for no way.
        count: a count of the target [N m]; None where nothing tells it.
        limit: torque limit in the drive; None for none.
        speed: entry of the largest speed; None where the drive has none, or nobody knows its unit.
        speed_size: number of its units in a turn per minute.
        watchdogs: kinds of watchdogs that it has, the most trusted first.
        more_trusted: name of a watchdog that is more trusted than the described one, in words; empty where none is.
        event: whether it has an event timer for status reports; else they come with every n-th SYNC.
        beside: whether its status is sent with its position.
        dummies: indices of what may take the room of others' torques, in the order in which they are tried.
        shares: whether its data sheet or its family lets it share torque frames.
        problems: reasons why it cannot be driven.
        changes: changes that the description needs, with reasons.
        notes: missing optional entries, and what happens instead.
    """

    family: Family
    found: DriveEntries
    torque: TorquePath | PositionPath | None
    count: float | None
    limit: TorqueLimit | None
    speed: Entry | None
    speed_size: float
    watchdogs: tuple[WatchdogKind, ...]
    more_trusted: str
    event: bool
    beside: bool
    dummies: tuple[int, ...]
    shares: bool
    problems: tuple[Problem, ...]
    changes: tuple[Problem, ...]
    notes: tuple[str, ...]

    @property
    def summary(self) -> str:
        """Describe in one line the drive's family, torque mode and unit, limits, watchdogs and status reports."""
        unknown = "unknown"
        torque = unknown if self.torque is None else f"mode {self.torque.mode} by {readable_entry(self.torque.target)}"
        count = unknown if self.count is None else f"{self.count:.6g} N m"
        if self.family.unit is not None and self.family.unit.writable:
            count = "as described"  # from opening on: what the drive held before is gone
        limit = unknown if self.limit is None else readable_entry(self.limit.entry)
        speed = "none" if self.speed is None else entry_text(self.speed)
        status = "with the position" if self.beside else "by timer" if self.event else "by SYNC"
        return (
            f"{self.family.name}, {torque}, a count {count}, torque limit {limit}, speed limit {speed}, "
            f"watchdogs {' '.join(self.watchdogs) or 'none'}, status {status}"
        )

    def require(self, node: int) -> None:
        """Raise UnsuitableDrive, with everything that is wrong, where the drive or its description has a problem."""
        if wrong := (*self.problems, *self.changes):
            told = "; ".join(map(str, wrong))
            raise UnsuitableDrive(f"node {node}: cannot be driven ({self.family.name}): {told}")


def capabilities(objects: Objects, driver: CanopenDriver, drive_index: int) -> Capabilities:
    """Read a drive's entries by SDO uploads alone; return what it can do, and its problems.

    Args:
        objects: of the drive.
        driver: the arm's section.
        drive_index: of the drive.

    Raises:
        DriverError: it does not answer, or the bus is gone.
    """
    drive = driver.drives[drive_index]
    family, found = read_entries(objects, drive, driver.families)
    return assess(found, family, drive, driver, driver.sheets[drive_index])


def require_capabilities(objects: Objects, driver: CanopenDriver, drive_index: int) -> Capabilities:
    """Return `capabilities` of a drive; raises UnsuitableDrive, with everything wrong, if it cannot be driven."""
    can = capabilities(objects, driver, drive_index)
    can.require(objects.node)
    return can


def read_entries(
    objects: Objects, drive: CanopenDrive, own_families: Sequence[Family] = ()
) -> tuple[Family, DriveEntries]:
    """Read all entries that matter from a drive by SDO uploads; return its family and these entries.

    Args:
        objects: of the drive.
        drive: section of the description for the drive.
        own_families: families of the description.

    Raises:
        DriverError: it does not answer, or the bus is gone.
    """
    objects.read_bytes(od.DEVICE_TYPE.index, 0, od.DEVICE_TYPE.name)  # one that is silent is not asked for all the rest
    first = _read_entries(objects, (od.DEVICE_TYPE, od.VENDOR, od.PRODUCT))
    family = family_of(first.identity, own_families)
    return family, replace(_read_entries(objects, _entries(family, drive)), firmware=_firmware(objects))


def _firmware(objects: Objects) -> str:
    try:
        return objects.read_bytes(od.FIRMWARE_INDEX, 0, "software version").decode("ascii", "replace").strip("\0 ")
    except BusError:
        raise
    except DriverError:
        return ""


def entries_from_sheet(
    sheet: DataSheet, drive: CanopenDrive, own_families: Sequence[Family] = ()
) -> tuple[Family, DriveEntries]:
    """Return a drive's family and entries from its data sheet, without asking it; arguments as for `read_entries`."""
    told = {0x101800 | sub: value for sub, value in sheet.identity.items()}
    family = family_of(DriveEntries(frozenset(), told).identity, own_families)
    values = {key: value for key, one in sheet.entries.items() if (value := one.number(drive.node)) is not None}
    return family, DriveEntries(frozenset(sheet.entries), values | told, asked=False)


def _entries(family: Family, drive: CanopenDrive) -> dict[int, Entry]:
    texts = [path.target for path in family.torque] + [path.slope for path in family.torque if path.slope]
    texts += [text for path in family.torque for text in path.writes]
    texts += [text for path in family.torque if path.by for text in (path.by.entry, path.by.display)]
    texts += [text for one in family.torque_limit for text in (one.entry, one.per, one.negative) if text]
    texts += [*family.speed_limit, *([family.unit.rated] if family.unit and family.unit.rated else [])]
    texts += [family.watchdog.entry] if family.watchdog else []
    texts += [family.brake] if family.brake else []
    texts += [family.position.target] if family.position else []
    entries = [*(entry for entry, _ in (*_INDISPENSABLE, *_OPTIONAL)), *_OTHERS]
    entries += [parse_entry(text, "entry of its family") for text in texts]
    if (mine := drive.watchdog_entry) is not None:
        entries.append(parse_entry(f"{mine.index:04X}:{mine.sub:X}/{mine.type}", "watchdog"))
    return {entry.key: entry for entry in reversed(entries)}


def _read_entries(objects: Objects, entries: Mapping[int, Entry] | Sequence[Entry]) -> DriveEntries:
    there, values, unread = set(), {}, {}
    for entry in entries.values() if isinstance(entries, Mapping) else entries:
        try:
            values[entry.key] = objects.read(entry)
        except BusError:
            raise
        except SdoRefused as refused:
            if refused.code in DOES_NOT_EXIST:
                continue
            unread[entry.key] = str(refused)
        except DriverError as error:
            unread[entry.key] = str(error)
        there.add(entry.key)
    return DriveEntries(frozenset(there), values, unread)


def assess(
    entries: DriveEntries, family: Family, drive: CanopenDrive, driver: CanopenDriver, sheet: DataSheet | None
) -> Capabilities:
    """Compare the entries that a drive has with what is needed; return its capabilities with all problems.

    Args:
        entries: entries that the drive has.
        family: drive family that it belongs to.
        drive: section of the description for the drive.
        driver: the section that has it.
        sheet: data sheet of the drive, None where none is known.
    """
    problems = [
        Problem(entry_text(entry), f"missing; {why}") for entry, why in _INDISPENSABLE if not entries.has(entry)
    ]
    notes = [f"{entry_text(entry)} is missing: {words}" for entry, words in _OPTIONAL if not entries.has(entry)]
    notes += [f"cannot be read: {why}" for why in entries.unread.values()]
    positions = driver.streams == "position"
    paths = ([family.position] if family.position else []) if positions else family.torque
    torque = next((path for path in paths if _streams(path, entries)), None)
    kind = entries.get(od.DEVICE_TYPE)
    if kind is not None and kind & 0xFFFF != DRIVE_PROFILE:
        problems = [Problem("1000h", f"is {kind:08X}h, which is no drive of CiA 402")]
    elif torque is None:
        problems = [
            Problem("6502h", _no_position(entries) if positions else family.refuse or _no_torque(family, entries))
        ]
    elif kind is None and entries.asked:
        problems.insert(0, Problem("1000h", "does not report to be a drive of CiA 402"))
    count = _count(family, entries, drive)
    limit = next((one for one in family.torque_limit if _limits(one, entries)), None)
    if entries.has(od.SECOND_AXIS):
        notes.append("6841h is there: of its axes only the first one (6041h) is driven")
    notes += _other_limits(family, entries, drive, limit)
    speed, size = None, 1.0
    for entry in [parse_entry(text, "largest speed") for text in family.speed_limit]:
        if entries.has(entry) and (own := speed_units_per_rpm(entry, entries.get(od.VELOCITY_UNIT), drive)) is not None:
            speed, size = entry, own
            break
    if speed is None:
        notes.append("no speed limit in the drive: only the host monitors it")
    watchdogs = tuple(_watchdogs(family, entries, drive))
    changes: list[Problem] = []
    if torque is not None:
        if positions and (family.unit is None or family.unit.rated is None):
            problems.append(Problem("6077h", "nobody knows what a count of the torque that it measures is"))
        problems += _unit_problems(family, entries, count)
        changes += _unit_changes(family, entries, drive, count)
        changes += _frame_changes(torque, drive)
        if limit is None:
            tried = ", ".join(sorted({readable_entry(one.entry) for one in family.torque_limit})) or "none is known"
            problems.append(Problem(tried, "missing; the drive itself must limit the torque"))
        if not watchdogs:
            problems.append(
                Problem("1400h:05, 1016h:01, 100Ch", "missing; nothing would stop it when its host is gone")
            )
        elif drive.watchdog not in watchdogs:
            words = f"{drive.watchdog}: this drive lacks it; it has {', '.join(watchdogs)}"
            changes.append(Problem("drives.watchdog", words))
        if driver.zero == "at_home" and not entries.has(od.ZERO_COUNTS):
            words = "at_home: it has no 1020h to keep a zero in; its encoder must know its position (absolute)"
            changes.append(Problem("driver.zero", words))
        if driver.torque_reports != "none" and not entries.has(od.TORQUE_ACTUAL):
            changes.append(Problem("driver.measured_torque", "it does not report its torque (6077h): set it to none"))
    event, beside = entries.has(pdo_entry(od.TPDO_PERIOD, 2)), driver.status_frame == "position"
    if not (beside or entries.has(pdo_entry(od.TPDO_COB_ID, 2))):
        words = "1801h:01 is missing, so that its status has no frame of its own: set it to position"
        changes.append(Problem("driver.status.frame", words))
    elif not (beside or event):
        notes.append("1801h:05 is missing: status reports come with every n-th SYNC")
    listed = frozenset() if sheet is None else sheet.dummies
    dummies = sorted((int(text, 16) for text in family.dummies or ()), key=lambda dummy: dummy not in listed)
    return Capabilities(
        family,
        entries,
        torque,
        count,
        limit,
        speed,
        size,
        watchdogs,
        _more_trusted(watchdogs, drive),
        event,
        beside,
        tuple(dummies),
        any(dummy in listed for dummy in dummies) and _identifier_is_free(sheet),
        tuple(problems),
        tuple(changes),
        tuple(notes),
    )


def entry_text(entry: Entry) -> str:
    """Return an entry as people write it: `6410h:02`, or `6410h` for sub-index 0."""
    return f"{entry.index:04X}h" + (f":{entry.sub:02X}" if entry.sub else "")


def readable_entry(text: str) -> str:
    """Rewrite a family's entry, such as `6410:2/u32`, as people write it: `6410h:02`."""
    return entry_text(parse_entry(text, ""))


def _streams(path: TorquePath | PositionPath, found: DriveEntries) -> bool:
    """Return whether a drive supports a way of streaming; where 6502h is unknown, it may."""
    needed = [path.target, *([path.slope] if path.slope else []), *([path.by.entry] if path.by else [])]
    modes = found.get(od.SUPPORTED_MODES)
    supported = path.supported is None or modes is None or bool(modes >> path.supported & 1)
    return supported and all(found.has(parse_entry(text, "")) for text in needed)


def _no_torque(family: Family, found: DriveEntries) -> str:
    modes = found.get(od.SUPPORTED_MODES)
    said = "has no value" if modes is None else f"is {modes:X}h"
    lacking = sorted({readable_entry(p.target) for p in family.torque if not found.has(parse_entry(p.target, ""))})
    return f"no torque mode: 6502h {said}" + (f", {', '.join(lacking)} missing" if lacking else "")


def _no_position(found: DriveEntries) -> str:
    modes = found.get(od.SUPPORTED_MODES)
    said = "has no value" if modes is None else f"is {modes:X}h"
    return f"no cyclic synchronous position mode: 6502h {said}" + (
        "" if found.has(od.TARGET_POSITION) else ", 607Ah missing"
    )


def _frame_changes(path: TorquePath | PositionPath, drive: CanopenDrive) -> Iterator[Problem]:
    """Tell where torque frames, which the description decides, are not as the drive's target needs them."""
    if isinstance(path, PositionPath):
        return
    needed = path.shift if path.wide else None
    if drive.torque_shift != needed:
        words = "takes 16 bits: leave it out" if needed is None else f"takes 32 bits: set it to {needed}"
        yield Problem("drives.torque_shift", f"{readable_entry(path.target)} {words}")


def speed_units_per_rpm(entry: Entry, unit: int | None, drive: CanopenDrive) -> float | None:
    """Return how many units of a speed entry one turn per minute is; None where nobody knows.

    Args:
        entry: entry of the largest speed; the largest profile velocity (607Fh) is in the unit of velocities, by CiA
            402-2 counts per second.
        unit: unit of that speed by 60A9h, as CiA 303-2 numbers units; None or 0 where it says nothing.
        drive: section of the description for the drive.
    """
    if entry.index != od.MAX_VELOCITY.index:
        return 1.0
    per_second = drive.counts / 60.0
    if not unit:
        return per_second
    prefix, what, time = (unit >> shift & 0xFF for shift in (24, 16, 8))
    plain = {(_TURNS, _MINUTES): 1.0, (_TURNS, _SECONDS): 1.0 / 60.0, (_STEPS, _SECONDS): per_second}.get((what, time))
    return None if plain is None else plain / 10.0 ** ((prefix ^ 0x80) - 0x80)


def _limits(limit: TorqueLimit, found: DriveEntries) -> bool:
    return all(found.has(parse_entry(text, "")) for text in (limit.entry, limit.per, limit.negative) if text)


def _other_limits(
    family: Family, found: DriveEntries, drive: CanopenDrive, chosen: TorqueLimit | None
) -> Iterator[str]:
    """Tell of further limits that are below the described torque: a drive keeps the lowest (Nanotec, 6071h)."""
    most = 1000.0 * drive.max_torque / drive.rated_torque
    for limit in family.torque_limit:
        held = None if limit is chosen or limit.per else found.get(parse_entry(limit.entry, ""))
        if held is not None and limit.entry_or_limit(held) < most:
            share = limit.entry_or_limit(held) * drive.rated_torque / 1000.0
            yield f"{readable_entry(limit.entry)} is {held}: it may keep to {share:.4g} N m, below drives.max_torque"


def _count(family: Family, found: DriveEntries, drive: CanopenDrive) -> float | None:
    """Return the torque of one count of the target [N m]; None where it is unknown."""
    unit = family.unit
    if unit is None or next(_unknown(unit, drive), None):
        return None
    factor = torque_unit_size(unit, drive)
    if unit.rated is None:
        return factor * (unit.count or 0.0)
    held = found.get(parse_entry(unit.rated, ""))
    return None if not held else held * factor * 1e-3


def torque_unit_size(unit: TorqueUnit, drive: CanopenDrive) -> float:
    """Return the size of one unit of a torque [N m]; factors that the description lacks count as 1."""
    constant = drive.torque_constant or 1.0 if unit.counts_are_current else 1.0
    return TORQUE_UNITS[unit.unit] * constant * (drive.current_unit or 1.0 if unit.unit == "own" else 1.0)


def _unknown(unit: TorqueUnit, drive: CanopenDrive) -> Iterator[Problem]:
    """Tell what a description lacks to convert counts of a current to torques."""
    of = "a count" if unit.rated is None else readable_entry(unit.rated)
    if unit.counts_are_current and drive.torque_constant is None:
        yield Problem("drives.torque_constant", f"{of} is of a current: give it [N m/A]")
    if unit.unit == "own" and drive.current_unit is None:
        yield Problem("drives.current_unit", f"{of} is in the drive's own unit of current: give it [A]")


def _unit_problems(family: Family, found: DriveEntries, count: float | None) -> Iterator[Problem]:
    unit = family.unit
    if unit is None or unit.writable or unit.rated is None or not found.asked:
        return
    if count is None and not found.get(parse_entry(unit.rated, "")):
        words = "is 0 or not there, so the value of a count is unknown: enter the motor data with the maker's tool"
        yield Problem(readable_entry(unit.rated), words)


def _unit_changes(family: Family, found: DriveEntries, drive: CanopenDrive, count: float | None) -> Iterator[Problem]:
    """Compare a count's torque in the drive with the description, and with its current and torque constant."""
    unit = family.unit
    if unit is None or unit.writable:
        return
    yield from _unknown(unit, drive)
    if count is None or not found.asked:
        return
    thousand = 1e3 * count
    if factor := _factor(thousand, drive.rated_torque, _SAME):
        words = f"{drive.rated_torque:g} N m, but a thousand counts are {thousand:g} N m by the drive{factor}"
        yield Problem("drives.rated_torque", words)
    if drive.max_torque > _MOST_TIMES * thousand:
        words = f"{drive.max_torque:g} N m are {drive.max_torque / thousand:.3g} times what a thousand counts are"
        yield Problem("drives.max_torque", f"{words}, more than any drive gives; is it of the motor, in N m?")
    current = found.get(od.RATED_CURRENT)
    if not unit.counts_are_current and current and drive.torque_constant is not None:
        by_current = 1e-3 * current * drive.torque_constant
        if factor := _factor(thousand, by_current, _ABSURD - 1.0):
            words = f"with 6075h it makes {by_current:g} N m, but a thousand counts are {thousand:g} N m{factor}"
            yield Problem("drives.torque_constant", words)


def _factor(first: float, second: float, tolerance: float) -> str:
    """Return by which factor two torques differ, in words; nothing where they do not."""
    ratio = max(first / second, second / first)
    if ratio <= 1.0 + tolerance:
        return ""
    power = next((10**k for k in _POWERS if abs(ratio / 10**k - 1.0) < _SAME), None)
    return f": wrong by {ratio:.3g}" if power is None else f": wrong by {power}, which is another unit"


def _watchdogs(family: Family, found: DriveEntries, drive: CanopenDrive) -> Iterator[WatchdogKind]:
    if found.has(od.RPDO_DEADLINE):
        yield "rpdo_timer"
    mine = drive.watchdog_entry
    theirs = family.watchdog and found.has(parse_entry(family.watchdog.entry, ""))
    own = mine is not None and mine.index << 8 | mine.sub in found.there
    if own if drive.watchdog == "vendor" else theirs:
        yield "vendor"
    if drive.watchdog == "sync_loss":  # which no standard entry shows: the description states it
        yield "sync_loss"
    if found.has(od.HEARTBEAT_CONSUMER):
        yield "heartbeat"
    if found.has(od.GUARD_TIME) and found.has(od.LIFE_FACTOR):
        yield "node_guarding"


def _more_trusted(watchdogs: Sequence[WatchdogKind], drive: CanopenDrive) -> str:
    """Tell of a watchdog that misses the data itself where the described one misses a process, which may outlive it."""
    best = next(iter(watchdogs), drive.watchdog)
    by_data = best in ("rpdo_timer", "vendor", "sync_loss") and drive.watchdog in ("heartbeat", "node_guarding")
    return (
        f"{best} misses the frames themselves, {drive.watchdog} (drives.watchdog) only their sender" if by_data else ""
    )


def _identifier_is_free(sheet: DataSheet | None) -> bool:
    """Return whether the COB-ID of torque frames can be changed; a fixed one cannot be shared with other drives."""
    entry = None if sheet is None else sheet.entries.get(od.RPDO_COB_ID.key)
    return entry is None or entry.writable
