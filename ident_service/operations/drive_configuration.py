"""Tell what configuring an arm's drives would change; import a DCF into them, have them store or restore parameters.

The same code configures drives (`drivers.canopen.drive_setup`), with objects that note what they are to write.

What a maker's tool has written into a drive stays, except for what opening an arm must set. A DCF of that tool is
imported entry by entry: compared, written where it differs, read back; where one is refused, all that were written
are set back. What opening sets anyway is left to it. Drives store parameters, or forget them, only when a person says
so, and only while they are off.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

from drivers.can.bus_state import BusError
from drivers.can.can_link import Link, open_links
from drivers.canopen import object_dictionary as od
from drivers.canopen.bus_scan import buses_to_ask, hearing
from drivers.canopen.capabilities import entry_text, require_capabilities
from drivers.canopen.cia402 import POWER_OFF, state_of
from drivers.canopen.drive_setup import DriveConfiguration, configure, identify, motor_limits, quick_stop_option
from drivers.canopen.motor_units import coordinates
from drivers.canopen.object_dictionary import Entry, Kind
from drivers.canopen.pdo_mapping import Write, bus_profiles
from drivers.canopen.sdo import Change, DryRunObjects, Objects, none_if_missing
from drivers.canopen.stored_zero import zeros_of
from ident_service.config.arm import ArmConfig
from ident_service.config.canopen import CanopenDriver
from ident_service.config.eds import DataSheet, DataSheetEntry, data_sheet
from ident_service.config.quantities import TextFile
from ident_service.errors import DriverError, FileCutOff, UsageError


@dataclass(frozen=True)
class PlannedDrive:
    """Hold what configuring one drive would write.

    Attributes:
        drive: number of the drive, from 1.
        node: node number of the drive.
        changes: changes, in the order in which they would be written.
        refused: reason why the drive would be refused, then or before; empty where it would not.
    """

    drive: int
    node: int
    changes: tuple[Change, ...]
    refused: str


def planned_configuration(
    config: ArmConfig, open_bus: Callable[[ArmConfig], list[Link]] = open_links
) -> tuple[PlannedDrive, ...]:
    """Return what opening an arm would write into each of its drives; the drives are only read, by SDO uploads.

    Args:
        config: of the arm.
        open_bus: function that opens the links, in the order of the buses.

    Raises:
        UsageError: the arm has no CANopen drives.
        DriverError: a bus is in use, by another host too, cannot be opened, or is lost.
    """
    driver, gears = require_drives(config), config.transmission
    if gears is None:
        raise UsageError(f"{config.name}: the description has no transmission")
    profiles = {profile.number: profile for profile in bus_profiles(driver, config.control.rate)}
    found, zeros, option = coordinates(driver, gears), zeros_of(config), quick_stop_option(config)
    planned: list[PlannedDrive] = []
    with buses_to_ask(config, open_bus) as (_, links, heard):
        every = [
            DryRunObjects(links[one.bus], one.node, hearing(heard, one.bus), _fixed(sheet))
            for one, sheet in zip(driver.drives, driver.sheets, strict=True)
        ]
        if zeros is not None:
            held = [zeros.stored_counts(objects, number) for number, objects in enumerate(every)]
            if known := [counts for counts in held if counts is not None]:
                found = found.zeroed(known, zeros.home) if len(known) == len(held) else found
        motors = motor_limits(config, found)
        for number, (drive, objects) in enumerate(zip(driver.drives, every, strict=True)):
            with _planning(number, objects, planned):
                identify(objects, drive.identity)
                own = driver.reactions, option, motors[number], require_capabilities(objects, driver, number)
                configure(objects, DriveConfiguration(drive, profiles[drive.bus], *own))
    return tuple(planned)


def planned_zero(
    config: ArmConfig, open_bus: Callable[[ArmConfig], list[Link]] = open_links
) -> tuple[PlannedDrive, ...]:
    """Return what setting the present posture as home would write into each drive; the drives are only read.

    Args:
        config: of the arm.
        open_bus: function that opens the links, in the order of the buses.

    Raises:
        UsageError: the arm has no CANopen drives.
        DriverError: their encoders know their position, or as `planned_configuration`.
    """
    driver = require_drives(config)
    if (zeros := zeros_of(config)) is None:
        raise DriverError(f"{config.name}: its encoders know their position (driver.zero: absolute); no home is set")
    planned: list[PlannedDrive] = []
    with buses_to_ask(config, open_bus) as (_, links, heard):
        for number, drive in enumerate(driver.drives):
            objects = DryRunObjects(links[drive.bus], drive.node, hearing(heard, drive.bus))
            with _planning(number, objects, planned):
                _require_off(objects)
                zeros.require_volatile_storage(objects)
                zeros.store(objects, number, objects.read(od.POSITION))
    return tuple(planned)


@contextmanager
def _planning(number: int, objects: DryRunObjects, planned: list[PlannedDrive]) -> Iterator[None]:
    """Add to `planned` what is written to a drive meanwhile, and why it is refused, if it is."""
    refused = ""
    try:
        yield
    except BusError:
        raise
    except DriverError as error:
        refused = str(error)
    planned.append(PlannedDrive(number + 1, objects.node, tuple(objects.changes), refused))


def _fixed(sheet: DataSheet) -> frozenset[int]:
    return frozenset(key for key, entry in sheet.entries.items() if not entry.writable)


def require_drives(config: ArmConfig, refusal: str = "only CANopen drives are configured") -> CanopenDriver:
    """Return the `driver` section of an arm if it is CANopen; else raise UsageError with the words `refusal`."""
    if isinstance(config.driver, CanopenDriver):
        return config.driver
    kind = "no driver" if config.driver is None else f"driver {config.driver.kind!r}"
    raise UsageError(f"{config.name} has {kind}; {refusal} (driver.kind: canopen)")


_NUMBERS = {1: Kind.U8, 2: Kind.I8, 3: Kind.I16, 4: Kind.I32, 5: Kind.U8, 6: Kind.U16, 7: Kind.U32}  # CiA 301, table 44
_BOOLEAN = 1
# Those of the other types whose names people know.
_TYPES = {0x08: "REAL32", 0x09: "VISIBLE_STRING", 0x0A: "OCTET_STRING", 0x0B: "UNICODE_STRING", 0x0F: "DOMAIN"}
_TYPES |= {0x11: "REAL64", 0x15: "INTEGER64", 0x1B: "UNSIGNED64"}
_SHOWN = 3  # mistakes of a file that are told
_IDENTITY = {"vendor": (od.VENDOR, 1), "product": (od.PRODUCT, 2)}
# Of the host, at every opening or in every cycle.
_OURS = frozenset(
    {
        *(0x1003, 0x1005, 0x1006, 0x1007, 0x100C, 0x100D, 0x1010, 0x1011, 0x1014, 0x1015, 0x1016, 0x1017, 0x1018),
        *(0x1019, 0x1020, 0x1029, *range(0x1400, 0x1C00), 0x6007, 0x6040, 0x605A, 0x605E, 0x6060, 0x6071, 0x6072),
        *(0x607A, 0x607D, 0x6080, 0x6085, 0x60C2),
    }
)
_SAVE, _LOAD = 0x65766173, 0x64616F6C  # "save" and "load", little-endian (CiA 301, 7.5.2.13 and 14)
_FLASH = 10.0  # s that a drive may take to store its parameters


@dataclass(frozen=True)
class ImportedDrive:
    """Hold what importing a DCF has changed, or would change, in one drive.

    Attributes:
        drive: number of the drive, from 1.
        node: node number of the drive.
        file: name of the DCF.
        changes: changes that were written, or would be.
        same: number of entries that had their value already.
        left: number of entries that are left to opening, which sets them.
        left_out: entries whose value in the DCF cannot be imported, and why, in words.
    """

    drive: int
    node: int
    file: str
    changes: tuple[Change, ...]
    same: int
    left: int
    left_out: Mapping[str, str]


def import_configuration(
    config: ArmConfig,
    files: Sequence[TextFile],
    *,
    dry: bool,
    open_bus: Callable[[ArmConfig], list[Link]] = open_links,
) -> tuple[ImportedDrive, ...]:
    """Write the values of DCFs, one per drive in order, into the drives, or with `dry` only list them; return changes.

    A drive that refuses one of them, or keeps another value, is set back to what it held, and so are those before it;
    so are all after an interrupt or any other error. The error says so, itself or in a note.

    Args:
        config: of the arm.
        files: the DCFs.
        dry: whether the changes are only listed.
        open_bus: function that opens the links, in the order of the buses.

    Raises:
        UsageError: no CANopen drives, not a file each, or a file that configures nothing, or has a value that is no
            number or that its entry cannot hold; no bus has been opened.
        FileCutOff: the end of a file is missing, with other values maybe; no bus has been opened.
        DriverError: a bus is in use, or lost; a drive is on, or another than the file's; nothing has been written. Or
            an entry was refused, or the import interrupted; values that could not be set back are named.
    """
    driver = require_drives(config)
    if len(files) != len(driver.drives):
        raise UsageError(f"{len(files)} files for {len(driver.drives)} drives; give one DCF for each, in their order")
    wanted = [_configured(file, drive.node) for file, drive in zip(files, driver.drives, strict=True)]
    left_out = [_left_out(file) for file in files]
    with buses_to_ask(config, open_bus) as (_, links, heard):
        every = [
            (DryRunObjects if dry else Objects)(links[one.bus], one.node, hearing(heard, one.bus))
            for one in driver.drives
        ]
        for file, objects in zip(files, every, strict=True):
            _require_off(objects)
            _require_same(file, objects)
        done: list[ImportedDrive] = []
        touched: list[tuple[Objects, list[Change]]] = []
        try:
            for number, (file, objects, writes) in enumerate(zip(files, every, wanted, strict=True), 1):
                changes: list[Change] = []
                touched.append((objects, changes))
                ours = {key for key in writes if key >> 8 in _OURS}
                for key, write in writes.items():
                    if key not in ours and not objects.holds(write):
                        changes.append(Change(write.entry, objects.read(write.entry), write.value))
                        objects.write_verified(write)
                same = len(writes) - len(ours) - len(changes)
                outcome = tuple(changes), same, len(ours), left_out[number - 1]
                done.append(ImportedDrive(number, objects.node, file.name, *outcome))
        except BaseException as error:  # an interrupt, or a mistake here, leaves no drive half-configured either
            end = _all_set_back(touched)
            if isinstance(error, KeyboardInterrupt):
                raise DriverError(f"interrupted; {end}") from None
            if isinstance(error, DriverError) and not isinstance(error, BusError):
                raise DriverError(f"{error}; {end}") from None
            error.add_note(end)
            raise
    return tuple(done)


def _configured(file: TextFile, node: int) -> dict[int, Write]:
    """Return the values that a DCF gives to its drive, by key.

    Raises:
        UsageError: one is wrong, or there are none.
        FileCutOff: further ones may be missing.
    """
    sheet = data_sheet(file.text)
    if sheet.cut_off:
        raise FileCutOff(
            f"{file.name} seems to end too early: {sheet.cut_off}; get the whole file; nothing was written"
        )
    found, wrong = {}, []
    for key, entry in sorted(sheet.entries.items()):
        kind = _NUMBERS.get(entry.kind)
        if not (entry.configured and entry.writable and entry.readable) or kind is None:
            continue
        try:
            found[key] = Write(Entry(key >> 8, key & 0xFF, kind, "value of the DCF"), _value(key, entry, kind, node))
        except ValueError as error:
            wrong.append(f"{entry.place}={(entry.text or '')[:40]}: {error}")
    if wrong:
        more = f"; and {len(wrong) - _SHOWN} more" if len(wrong) > _SHOWN else ""
        raise UsageError(f"{file.name}: {'; '.join(wrong[:_SHOWN])}{more}; nothing was written")
    if not found:
        why = sheet.mistake or "no entry has a ParameterValue; an EDS describes a kind of drive, a DCF configures one"
        if left_out := _left_out(file):
            why = f"none of its values can be imported: {_listed(left_out)}"
        raise UsageError(f"{file.name}: configures no drive: {why}")
    return found


def _left_out(file: TextFile) -> dict[str, str]:
    """Return the entries whose value in a DCF cannot be imported, and why."""
    found = {}
    for key, entry in sorted(data_sheet(file.text).entries.items()):
        if not entry.place or key >> 8 in _OURS:
            continue
        name = entry_text(Entry(key >> 8, key & 0xFF, Kind.U32, ""))
        if not entry.writable:
            found[name] = "read-only"
        elif not entry.readable:
            found[name] = "write-only: it could be neither compared nor set back"
        elif entry.kind not in _NUMBERS:
            found[name] = f"{_TYPES.get(entry.kind, f'type {entry.kind:04X}h')} is not imported"
        elif not entry.configured:
            found[name] = "of a node number, which is the drive's own"
    return found


def _listed(left_out: Mapping[str, str]) -> str:
    """Return entries with their reasons, in words, those of one reason together."""
    why: dict[str, list[str]] = {}
    for name, reason in left_out.items():
        why.setdefault(reason, []).append(name)
    return "; ".join(f"{', '.join(names)} ({reason})" for reason, names in why.items())


def _value(key: int, entry: DataSheetEntry, kind: Kind, node: int) -> int:
    """Return the value that a DCF gives to an entry; raises ValueError in words where the entry cannot hold it."""
    if (value := entry.standard_number(node)) is None:
        raise ValueError("is no whole number; write 100, 0x64, 0144 (octal) or $NODEID+0x64")
    bits = 8 * kind.size
    signed = kind in (Kind.I8, Kind.I16, Kind.I32)
    least, greatest = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
    if entry.kind == _BOOLEAN:
        greatest = 1

    def held(number: int) -> int:
        return number - (1 << bits) if signed and 1 << bits - 1 <= number < 1 << bits else number

    value, of = held(value) if entry.hexadecimal else value, "its type"
    limits = [None if one is None else held(one) for one in (entry.low, entry.high)]
    # Files have limits that no value can fit; those of what is not written here do not matter.
    low, high = (bound if one is None else one for one, bound in zip(limits, (least, greatest), strict=True))
    if key >> 8 not in _OURS and least <= low < high <= greatest and (low, high) != (least, greatest):
        least, greatest, of = low, high, "the file's LowLimit and HighLimit"
    if not least <= value <= greatest:
        raise ValueError(f"{entry_text(Entry(key >> 8, key & 0xFF, kind, ''))} holds {least} to {greatest}, by {of}")
    return value


def _require_off(objects: Objects) -> None:
    state = state_of(objects.read(od.STATUS_WORD))
    if state not in POWER_OFF:
        raise DriverError(f"node {objects.node}: is {state}; its parameters are only changed while it is off")


def _require_same(file: TextFile, objects: Objects) -> None:
    sheet = data_sheet(file.text).identity
    for name, (entry, sub) in _IDENTITY.items():
        if sub in sheet and (held := objects.read(entry)) != sheet[sub]:
            raise DriverError(f"node {objects.node}: {name} is {held:08X}h, but {file.name} is for {sheet[sub]:08X}h")


def _all_set_back(touched: Sequence[tuple[Objects, Sequence[Change]]]) -> str:
    """Set drives back to what they held before these changes, the last one first; return the outcome in words."""
    if not any(changes and not objects.dry for objects, changes in touched):
        return "nothing was written"
    lost = [
        f"node {objects.node} {entry_text(change.entry)}"
        for objects, changes in reversed(touched)
        for change in reversed(changes)
        if not _is_set_back(objects, change)
    ]
    return f"NOT set back: {', '.join(lost)}" if lost else "every drive holds again what it held"


def _is_set_back(objects: Objects, change: Change) -> bool:
    if change.before is None:
        return False
    for _ in range(2):
        with suppress(Exception, KeyboardInterrupt):  # whatever it is, the others have to be set back too
            objects.ensure(Write(change.entry, change.before))
            return True
        with suppress(Exception, KeyboardInterrupt):
            objects.discard_answers()  # that of a request which was interrupted, for one
    return False


def store_or_restore(
    config: ArmConfig, *, store: bool, dry: bool = False, open_bus: Callable[[ArmConfig], list[Link]] = open_links
) -> tuple[int, ...]:
    """Make all drives store their configuration (1010h) or restore the delivered one (1011h), unless `dry`; list nodes.

    What is restored takes effect when the drives' power has been switched off and on.

    Args:
        config: of the arm.
        store: whether to store; else to restore.
        dry: whether drives are only asked whether they can.
        open_bus: function that opens the links, in the order of the buses.

    Returns:
        The node numbers of the drives.

    Raises:
        UsageError: no CANopen drives.
        DriverError: a bus is in use, or lost; a drive is on, lacks the entry, or holds a zero that must not be stored:
            nothing has been written. Or one refused it: the message names those that have done it.
    """
    driver, entry = require_drives(config), od.STORED if store else od.RESTORE
    with buses_to_ask(config, open_bus) as (_, links, heard):
        kind = DryRunObjects if dry else Objects
        every = [kind(links[one.bus], one.node, hearing(heard, one.bus)) for one in driver.drives]
        for objects in every:
            _require_off(objects)
            if none_if_missing(objects.read, entry) is None:
                raise DriverError(f"node {objects.node}: has no {entry_text(entry)}; use its maker's tool")
            mark: int | None = none_if_missing(objects.read, od.ZERO_MARK)
            if store and mark:
                raise DriverError(
                    f"node {objects.node}: holds a zero (1020h), which must be lost with its power: switch the drives"
                    " off and on, store, and then zero the arm again"
                )
        if dry:
            return tuple(objects.node for objects in every)
        done: list[int] = []
        for objects in every:
            objects.patience = _FLASH
            try:
                objects.write(Write(entry, _SAVE if store else _LOAD))
            except DriverError as error:
                ending = f"; done in nodes {', '.join(map(str, done))}" if done else "; no drive has done it"
                raise DriverError(f"{error}{ending}") from None
            done.append(objects.node)
    return tuple(done)


def imported_text(config: ArmConfig, imported: Sequence[ImportedDrive], *, dry: bool) -> str:
    """Format what an import has changed, or would change, in each drive as text, with a last line break."""
    lines = [f"{config.name}: {'what importing would change; nothing was written' if dry else 'imported'}"]
    for one in imported:
        lines += ["", f"drive {one.drive}, node {one.node}, by {one.file}: {len(one.changes)} entries changed"]
        lines += [*_change_lines(one.changes)]
        lines += [f"  {'left out':<16}{_listed(one.left_out)}"] if one.left_out else []
        lines.append(f"  {one.same} had their value already; {one.left} are set whenever the arm is opened")
    return "\n".join(lines) + "\n"


def planned_text(config: ArmConfig, planned: Sequence[PlannedDrive], action: str = "opening") -> str:
    """Format what an action, named in words, would write into each drive as text, with a last line break."""
    lines = [f"{config.name}: what {action} would write; nothing was written, and nothing moved"]
    for one in planned:
        lines += ["", f"drive {one.drive}, node {one.node}: {_count(one)}", *_change_lines(one.changes)]
        lines += [f"  {'REFUSED':<16}{one.refused}"] if one.refused else []
    return "\n".join(lines) + "\n"


def _count(one: PlannedDrive) -> str:
    if one.changes:
        return f"{len(one.changes)} entries would be written" + (", then it is refused" if one.refused else "")
    return "would be refused, and nothing written" if one.refused else "has everything already"


def _change_lines(changes: Sequence[Change]) -> Iterator[str]:
    for change in changes:
        before = "?" if change.before is None else f"{change.before} ({_hex(change, change.before)})"
        after = f"{change.after} ({_hex(change, change.after)})"
        yield f"  {entry_text(change.entry):<16}{before} -> {after}  {change.entry.name}"


def _hex(change: Change, value: int) -> str:
    size = change.entry.kind.size
    return f"{value & (1 << 8 * size) - 1:0{2 * size}X}h"


def drives_document(
    config: ArmConfig, drives: Sequence[PlannedDrive | ImportedDrive], *, written: bool = False
) -> dict[str, Any]:
    """Return the changes of each drive by a dry run or an import as JSON values."""
    shown = [vars(one) | {"changes": list(map(_document, one.changes))} for one in drives]
    return {"arm": config.name, "written": written, "drives": shown}


def _document(change: Change) -> dict[str, Any]:
    entry = change.entry
    return {"entry": entry_text(entry), "name": entry.name, "before": change.before, "after": change.after}
