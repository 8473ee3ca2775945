"""Answer for an arm's buses: their load, who is on them, and what their drives can.

Drives are read by SDO uploads alone; for a drive that does not answer, and for files without a drive, the capabilities
are derived from the data sheet.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from enum import StrEnum
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile

from drivers.can.bus_load import MOST_TYPICAL, MOST_WORST, Budget, BusLoad, Cost, Line
from drivers.can.bus_state import BusError
from drivers.can.can_link import Link, open_links
from drivers.can.frame_log import SessionLog, logged_links
from drivers.canopen.bus_load import budget
from drivers.canopen.bus_scan import FoundNode, buses_to_ask, hearing, scan
from drivers.canopen.capabilities import (
    Capabilities,
    assess,
    capabilities,
    entries_from_sheet,
    entry_text,
    parse_entry,
    readable_entry,
)
from drivers.canopen.cia402 import drive_words, emergency_words, register_words, state_of
from drivers.canopen.drive_setup import IDENTITY, identity_differences
from drivers.canopen.pdo_mapping import bus_profiles
from drivers.canopen.sdo import Objects
from ident_service.config.arm import ArmConfig
from ident_service.config.can_bus import CanBus
from ident_service.config.canopen import CanopenDrive, CanopenDriver
from ident_service.config.eds import data_sheet
from ident_service.config.load import config_error
from ident_service.config.quantities import TextFile
from ident_service.errors import DriverError, UsageError
from ident_service.motion.arm_factory import make_arm
from ident_service.operations.drive_configuration import (
    drives_document,
    planned_configuration,
    planned_text,
    require_drives,
)
from ident_service.recordings.files import write_atomically

_HEAD = f"  {'frames':<28}{'COB-IDs':<12}{'bytes':>6}{'Hz':>7}{'one of them, us':>24}{'load of all, %':>24}"
_UNDER = f"  {'':<53}{'least':>8}{'typical':>8}{'worst':>8}{'least':>8}{'typical':>8}{'worst':>8}"


def bus_load(config: ArmConfig, rate: float | None = None) -> Budget:
    """Return the load of each CAN bus of an arm by its frames at a rate, and whether it fits.

    Args:
        config: the arm's.
        rate: cycles per second; by default the arm's.

    Raises:
        UsageError: the arm's driver has no bus that frames could be counted on.
    """
    found = make_arm(config).bus_budget(rate) if config.can_buses else None
    if found is None:
        kind = "no driver" if config.driver is None else f"driver {config.driver.kind!r}"
        raise UsageError(f"{config.name} has {kind}; a bus load is that of drives on CAN (canopen, barrett)")
    return found


def require_budget(description: str | Path, config: ArmConfig) -> Budget | None:
    """Return the bus budget of an arm with drives on CAN, or None for other arms; raise ConfigError if it does not fit.

    Args:
        description: file of the description, or name of a shipped one.
        config: content of the description.

    Raises:
        ConfigError: over budget; the mistake has the place of the driver, and the remedies.
    """
    if not config.can_buses:
        return None
    found = bus_load(config)
    if not found.fits:
        raise config_error(description, ("driver",), f"{found.reason}. {found.remedy}")
    return found


def bus_lines(budget: Budget) -> str:
    """Format load and highest rate of each bus as one line a bus."""
    return "".join(
        f"bus {bus.number} ({bus.bus.channel}): {100 * bus.load.worst:.1f} % worst,"
        f" {100 * bus.load.typical:.1f} % typical at {budget.rate:g} Hz; up to {bus.highest_rate} Hz\n"
        for bus in budget.buses
    )


def bus_text(arm_name: str, budget: Budget) -> str:
    """Format whether the budget fits, the load of each bus and remedies as text, with a last line break."""
    lines = [f"{arm_name} at {budget.rate:g} Hz: {'fits' if budget.fits else 'DOES NOT FIT'}"]
    for bus in budget.buses:
        lines += ["", *_bus_lines(bus)]
    if not budget.fits:
        lines += ["", f"{budget.reason}.", "Any of these helps:", *(f"  - {remedy}" for remedy in budget.remedies)]
    return "\n".join(lines) + "\n"


def bus_document(arm_name: str, budget: Budget) -> dict[str, Any]:
    """Return the budget as JSON values."""
    return {
        "arm": arm_name,
        "rate": budget.rate,
        "fits": budget.fits,
        "highest_rate": budget.highest_rate,
        "reason": budget.reason,
        "remedies": list(budget.remedies),
        "buses": [_bus_document(bus) for bus in budget.buses],
    }


def _bus_lines(bus: BusLoad) -> list[str]:
    cycle, load = bus.cycle, bus.load
    lines = [f"bus {bus.number}: {_described(bus.bus)}", _HEAD, _UNDER]
    lines += [_row(line.name, _ids(line), f"{line.length}", f"{line.per_second:.4g}", line) for line in bus.lines]
    return [
        *lines,
        f"  {'one cycle, until the last position':<53}{_numbers(cycle, 1e6)} us",
        f"  {'in all':<77}{_numbers(load, 100)}",
        f"  {'allowed':<77}{'':>8}{100 * MOST_TYPICAL:>8.1f}{100 * MOST_WORST:>8.1f}",
        f"  highest rate: {bus.highest_rate} Hz",
    ]


def _row(name: str, ids: str, length: str, rate: str, line: Line) -> str:
    words = f"  {name:<28}{ids:<12}{length:>6}{rate:>7}"
    return words + _numbers(line.each, 1e6) + _numbers(line.load, 100)


def _numbers(cost: Cost, unit: float) -> str:
    return "".join(f"{unit * each:>8.1f}" for each in cost)


def _described(bus: CanBus) -> str:
    data = "" if bus.data_bitrate is None else f", data {bus.data_bitrate / 1e6:g} Mbit/s"
    return f"{bus.interface} {bus.channel}, {bus.bitrate / 1e6:g} Mbit/s{data}"


def _ids(line: Line) -> str:
    first, last = line.cob_ids[0], line.cob_ids[-1]
    return f"{first:03X}" if first == last else f"{first:03X} .. {last:03X}"


def _bus_document(bus: BusLoad) -> dict[str, Any]:
    return {
        "number": bus.number,
        **bus.bus.model_dump(exclude={"options"}),
        "fits": bus.fits,
        "highest_rate": bus.highest_rate,
        "cycle_us": _values(bus.cycle, 1e6),
        "load_percent": _values(bus.load, 100),
        "frames": [
            {
                "name": line.name,
                "cob_ids": list(line.cob_ids),
                "bytes": line.length,
                "per_second": line.per_second,
                "cyclic": line.cyclic,
                "us": _values(line.each, 1e6),
                "load_percent": _values(line.load, 100),
            }
            for line in bus.lines
        ],
    }


def _values(cost: Cost, unit: float) -> dict[str, float]:
    return {key: round(unit * value, 4) for key, value in cost._asdict().items()}


class Match(StrEnum):
    """Result of comparing a node with the configuration."""

    CONFIGURED = "configured"
    OTHER = "another one"  # than the configured one
    SILENT = "does not answer"  # but is heard
    MISSING = "missing"
    UNKNOWN = "not configured"


_GOOD = (Match.CONFIGURED, Match.UNKNOWN)


@dataclass(frozen=True)
class ScannedNode:
    """One node, or a configured drive that is missing.

    Attributes:
        bus: number of its bus, from 0.
        node: node number.
        drive: number of the configured drive, from 1; None for a node that is none.
        match: result of the comparison with the configuration.
        why: difference from the configuration, in words; empty where there is none.
        found: identity, state and errors of the node; None where it is missing.
    """

    bus: int
    node: int
    drive: int | None
    match: Match
    why: str
    found: FoundNode | None


@dataclass(frozen=True)
class Scan:
    """Nodes on all buses of an arm.

    Attributes:
        lines: nodes and missing drives, by bus and node number.
        complete: whether every configured drive is there and is the configured one.
    """

    lines: tuple[ScannedNode, ...]

    @property
    def complete(self) -> bool:
        """Return whether every configured drive is there and is the configured one; further nodes do not count."""
        return all(line.match in _GOOD for line in self.lines)


def bus_scan(config: ArmConfig, open_bus: Callable[[ArmConfig], list[Link]] = open_links) -> Scan:
    """Find the nodes on every bus of an arm and compare each with the description; nothing is changed.

    Args:
        config: the arm's.
        open_bus: function that opens the links, in the order of the buses.

    Raises:
        UsageError: the arm's driver has no bus to scan.
        DriverError: as `drivers.canopen.bus_scan.scan`.
    """
    driver = require_drives(config, "a bus scan is of CANopen drives")
    found = {(node.bus, node.node): node for node in scan(config, open_bus)}
    wanted = {(drive.bus, drive.node): (number, drive) for number, drive in enumerate(driver.drives, 1)}
    lines = []
    for place in sorted({*found, *wanted}):
        node = found.get(place)
        if place in wanted:
            number, drive = wanted[place]
            lines.append(ScannedNode(*place, number, *_judged(node, drive), node))
        else:
            lines.append(ScannedNode(*place, None, Match.UNKNOWN, "", node))
    return Scan(tuple(lines))


def _judged(node: FoundNode | None, drive: CanopenDrive) -> tuple[Match, str]:
    if node is None:
        return Match.MISSING, "silent"
    if not node.answers:
        return Match.SILENT, "sends frames, but answers no SDO request"
    if not node.is_drive:
        kind = "not told" if node.device_type is None else f"{node.device_type:08X}h"
        return Match.OTHER, f"no drive of CiA 402 (1000h is {kind})"
    if others := identity_differences(node.identity, drive.identity):
        return Match.OTHER, ", ".join(others)
    return Match.CONFIGURED, ""


def scan_text(config: ArmConfig, scan: Scan) -> str:
    """Format a scan as text, with a last line break."""
    lines = [f"{config.name}: {_verdict(scan)}"]
    assert isinstance(config.driver, CanopenDriver)  # noqa: S101 - bus_scan has seen to it
    for number, bus in enumerate(config.driver.buses):
        lines += ["", f"bus {number}: {bus.interface} {bus.channel}, {bus.bitrate / 1e6:g} Mbit/s"]
        lines.append(f"  {'node':>4}  {'drive':<6}{'configuration':<17}{'drive state':<28}NMT state")
        for line in scan.lines:
            if line.bus == number:
                lines += _node_lines(line)
    return "\n".join(lines) + "\n"


def _verdict(found: Scan) -> str:
    bad = [f"node {line.node} on bus {line.bus} {_MATCHES[line.match]}" for line in found.lines if _is_unexpected(line)]
    return "; ".join(bad) if bad else "every configured drive is there"


_MATCHES = {Match.MISSING: "IS MISSING", Match.OTHER: "IS ANOTHER ONE", Match.SILENT: "DOES NOT ANSWER"}


def _is_unexpected(line: ScannedNode) -> bool:
    return line.match not in _GOOD


def _node_lines(line: ScannedNode) -> Iterator[str]:
    drive = "-" if line.drive is None else str(line.drive)
    node = line.found
    state = "-" if node is None or node.status is None else drive_words(node.status)
    match = line.match.upper() if _is_unexpected(line) else line.match
    yield f"  {line.node:>4}  {drive:<6}{match:<17}{state:<28}{'-' if node is None else node.nmt}".rstrip()
    if line.why:
        yield f"{'':8}{line.why}"
    if node is None or not node.answers:
        return
    identity = ", ".join(f"{name} {value:08X}h" for name, value in node.identity.items())
    yield f"{'':8}{node.name or 'no device name'}, firmware {node.firmware or 'not told'}; {identity or 'no identity'}"
    if node.error_register:
        code = f"; 603Fh: {emergency_words(node.last_error)}" if node.last_error else ""
        yield f"{'':8}has errors: {register_words(node.error_register)}{code}"
    if node.history:
        yield f"{'':8}history, latest first: {'; '.join(emergency_words(entry & 0xFFFF) for entry in node.history)}"
    for words in node.unread:
        yield f"{'':8}{words}"


def scan_document(config: ArmConfig, scan: Scan) -> dict[str, Any]:
    """Return a scan as JSON values."""
    return {
        "arm": config.name,
        "complete": scan.complete,
        "nodes": [_node_document(line) for line in scan.lines],
    }


def _node_document(line: ScannedNode) -> dict[str, Any]:
    document = asdict(line) | {"match": line.match.name.lower()}
    if (node := line.found) is not None:
        said = {key: value for key, value in document["found"].items() if key not in ("bus", "node", "status")}
        document["found"] = said | {
            "status_word": node.status,
            "state": None if node.status is None else str(state_of(node.status)),
            "last_error": _error(node.last_error),
            "history": [_error(entry & 0xFFFF) for entry in node.history],
        }
    return document


def _error(code: int | None) -> dict[str, Any] | None:
    return {"code": code, "words": emergency_words(code)} if code else None


@dataclass(frozen=True)
class Probed:
    """Capabilities of one drive, or of one data sheet.

    Attributes:
        title: `drive N`, or the name of the file.
        node: number of the drive, as the description has it.
        silent: reason why it was not asked, or did not answer; empty for one that did.
        can: capabilities of the drive; None where neither the drive nor a file tells them.
        cut_off: reason why its file seems to be cut off, in words; empty where it seems to be whole.
        moves_by_position: whether it could be driven with `streams: position` where it cannot with torques.
    """

    title: str
    node: int
    silent: str
    can: Capabilities | None
    cut_off: str = ""
    moves_by_position: bool = False

    @property
    def drivable(self) -> bool:
        """Return whether the drive answered, and can be driven without any change of the description."""
        return self.can is not None and not (self.silent or self.can.problems or self.can.changes)


@dataclass(frozen=True)
class Probe:
    """Capabilities of all drives of an arm, or of all data sheets.

    Attributes:
        probed: the drives in the arm's order, or the files.
        shares: whether all of them can share torque frames, as far as files and families know.
        rates: cycles per second that the buses carry at most, by kind of torque frames (`shared`, `single`).
        status_syncs: number of SYNCs from one status report to the next, for drives without a timer for them.
        of_files: whether files were judged, and no drive was asked.
    """

    probed: tuple[Probed, ...]
    shares: bool
    rates: dict[str, int]
    status_syncs: int
    of_files: bool = False

    @property
    def good(self) -> bool:
        """Return whether every drive has answered and can be driven without any change of the description."""
        return all(one.drivable for one in self.probed)

    @property
    def readable(self) -> bool:
        """Return whether every file could be read as a data sheet; true where drives were asked."""
        return not self.of_files or all(one.can is not None for one in self.probed)

    @property
    def highest_rate(self) -> int:
        """Return the highest rate that the buses carry [Hz]: torque frames shared if every drive can, else single."""
        return self.rates["shared" if self.shares else "single"]


def bus_probe(
    config: ArmConfig,
    data_sheets: Sequence[TextFile] = (),
    open_bus: Callable[[ArmConfig], list[Link]] = open_links,
) -> Probe:
    """Read what an arm's drives can do, or what `data_sheets` (EDS or DCF texts) say, and judge it; nothing is changed.

    Args:
        config: the arm's.
        data_sheets: data sheets, judged in place of the drives without any bus.
        open_bus: function that opens the links, in the order of the buses.

    Raises:
        UsageError: the arm's driver has no bus.
        DriverError: a bus is in use, by another host too, cannot be opened, or is lost.
    """
    driver = require_drives(config, "a bus probe is of CANopen drives")
    if data_sheets:
        probed = [_of_file(driver, number % len(driver.drives), one) for number, one in enumerate(data_sheets)]
    else:
        with buses_to_ask(config, open_bus) as (_, links, heard):
            probed = []
            for number, drive in enumerate(driver.drives):
                objects = Objects(links[drive.bus], drive.node, hearing(heard, drive.bus))
                probed.append(_of_drive(driver, number, objects))
    rate = config.control.rate
    rates = {
        frames: budget(driver.model_copy(update={"torque_frames": frames}), rate).highest_rate
        for frames in ("shared", "single")
    }
    shares = all(one.can is not None and one.can.shares for one in probed)
    return Probe(tuple(probed), shares, rates, bus_profiles(driver, rate)[0].status_syncs, bool(data_sheets))


def _of_drive(driver: CanopenDriver, number: int, objects: Objects) -> Probed:
    file, silent = driver.sheet_file(number), ""
    can: Capabilities | None
    try:
        can = capabilities(objects, driver, number)
    except BusError:
        raise
    except DriverError as error:
        silent, can = str(error), _capabilities_from_sheet(driver, number, file)
    return _probed_one(f"drive {number + 1}", silent, can, driver, number, file)


def _of_file(driver: CanopenDriver, number: int, file: TextFile) -> Probed:
    sheet = data_sheet(file.text)
    mistake = sheet.mistake or ("" if sheet.entries else "it lists no object")
    why = f"is no EDS: {mistake}" if mistake else ""
    return _probed_one(file.name, why, _capabilities_from_sheet(driver, number, file), driver, number, file)


def _probed_one(
    title: str, silent: str, can: Capabilities | None, driver: CanopenDriver, number: int, file: TextFile
) -> Probed:
    drive, sheet = driver.drives[number], data_sheet(file.text)
    other = False
    if can is not None and can.problems and driver.streams != "position":
        positions = driver.model_copy(update={"streams": "position"})
        other = not assess(can.found, can.family, drive, positions, sheet).problems
    return Probed(title, drive.node, silent, can, sheet.cut_off, other)


def _capabilities_from_sheet(driver: CanopenDriver, number: int, file: TextFile) -> Capabilities | None:
    sheet, drive = data_sheet(file.text), driver.drives[number]
    if not sheet.entries:
        return None
    family, found = entries_from_sheet(sheet, drive, driver.families)
    return assess(found, family, drive, driver, sheet)


def cut_sheets(config: ArmConfig) -> tuple[str, ...]:
    """Return a sentence for each data sheet of a drive that seems to be cut off; none for drives without sheets."""
    if not isinstance(config.driver, CanopenDriver):
        return ()
    files = dict.fromkeys(config.driver.sheet_file(number) for number in range(len(config.driver.drives)))
    found = ((file.name, data_sheet(file.text).cut_off) for file in files)
    return tuple(f"{name} seems to end too early: {why}; get the whole file" for name, why in found if why)


def probe_text(config: ArmConfig, probe: Probe) -> str:
    """Format a probe as text, with a last line break."""
    bad = [one for one in probe.probed if not one.drivable]
    verdict = f"{len(bad)} of {len(probe.probed)} NOT as described" if bad else "every drive can be driven"
    lines = [f"{config.name}: {verdict}; nothing was written"]
    for one in probe.probed:
        lines += ["", *_lines(one, probe)]
    frames = "shared" if probe.shares else "single"
    if all(one.can is not None and not one.can.problems for one in probe.probed):
        lines += ["", f"highest rate: {probe.highest_rate} Hz, with {frames} torque frames (driver.torque_frames)"]
        if probe.shares:
            lines.append(f"with single ones: {probe.rates['single']} Hz")
        if config.control.rate > probe.highest_rate:
            lines.append(f"control.rate is {config.control.rate:g} Hz, which is TOO MUCH")
    if advice := probe_advice(probe):
        lines += ["", "what helps:", *(f"  {line}" for line in advice)]
    return "\n".join(lines) + "\n"


def probe_advice(probe: Probe) -> list[str]:
    """Return what helps where drives or files cannot be driven as described, one sentence for all that are alike."""
    advice: dict[str, list[str]] = {}
    for one in probe.probed:
        if not one.drivable:
            advice.setdefault(_advice(one, probe), []).append(one.title)
    return [f"{', '.join(titles)}: {words}" for words, titles in advice.items()]


def _advice(one: Probed, found: Probe) -> str:
    if found.of_files and one.can is None:
        return "take the EDS or DCF of the drive's maker, undamaged"
    if one.silent or one.can is None:
        return (
            "check power, cable, 60 ohm between CAN_H and CAN_L, bit rate and node number; `ident bus scan ARM` lists "
            "who answers"
        )
    if one.cut_off and found.of_files:
        return "get the whole file, and probe it again"
    if one.can.problems and one.moves_by_position:
        return (
            "positions can be streamed: `driver: {streams: position, ...}` at 100 to 500 Hz "
            '(docs/fieldbus.md, "Drives that are given positions")'
        )
    if one.can.problems:
        report = "" if found.of_files else "; `ident bus report ARM` writes what others need to see why"
        return f"another drive is needed, for the reasons above{report}"
    return "write what `to change` says into the description, and probe again"


def _lines(one: Probed, found: Probe) -> Iterator[str]:
    can = one.can
    if can is None:
        yield f"{one.title}, node {one.node}: {one.silent}"
        return
    file = "it" if found.of_files else "its EDS"
    torn = f"  {'CUT OFF':<16}{file} seems to end too early: {one.cut_off}" if one.cut_off else ""
    verdict = "CANNOT BE DRIVEN" if can.problems else "not as described" if can.changes else "can be driven"
    by = "" if can.found.asked else ", predicted from its EDS"
    yield f"{one.title}, node {one.node}: {can.family.name}: {verdict}{by}"
    if one.silent:
        yield f"  {one.silent}"
    if torn:
        yield torn
    for problem in can.problems:
        yield f"  {'REFUSED':<16}{problem}"
    for change in can.changes:
        yield f"  {'to change':<16}{change}"
    for name, words in _capability_rows(one, found).items():
        yield f"  {name.replace('_', ' '):<16}{words}"
    for note in can.notes if can.torque is not None else ():
        yield f"  {'lacks':<16}{note}"
    if can.family.notes:
        yield f"  {'family':<16}{can.family.notes}"


def _capability_rows(one: Probed, found: Probe) -> dict[str, str]:
    """Return the chosen torque path, limits, watchdogs and frames of a drive, in words."""
    can = one.can
    if can is None:
        return {}
    values = {name: can.found.get(entry) for name, entry in IDENTITY.items()}
    facts = {"identity": ", ".join(f"{name} {value:08X}h" for name, value in values.items() if value is not None)}
    if can.torque is None:
        return facts
    unit = can.family.unit
    of = "" if unit is None or unit.rated is None else f", by {readable_entry(unit.rated)} in {unit.unit}"
    count = "unknown" if can.count is None else f"{can.count:.4g} N m"
    mode = f"mode {can.torque.mode}" + (f" ({readable_entry(can.torque.by.entry)})" if can.torque.by else "")
    facts["torque"] = f"{mode}, {readable_entry(can.torque.target)}; a count is {count}{of}"
    facts["torque_limit"] = "none" if can.limit is None else readable_entry(can.limit.entry)
    facts["speed_limit"] = "set by the host" if can.speed is None else entry_text(can.speed)
    better = can.more_trusted
    facts["watchdogs"] = (", ".join(can.watchdogs) or "none") + (f"; {better}" if better else "")
    dummies = ", ".join(f"{dummy:04X}h" for dummy in can.dummies)
    shares = f"can be shared; foreign slots by {dummies}" if can.shares else "single"
    facts["torque_frames"] = f"{shares}, as far as its file and family know"
    by_itself = "on change and by timer" if can.event else f"every {found.status_syncs} SYNCs"
    facts["status_reports"] = "with each position" if can.beside else by_itself
    if (brake := can.family.brake) is not None:
        held = can.found.get(parse_entry(brake, ""))
        facts["brake"] = f"{readable_entry(brake)}, set up by the maker's tool: {'not known' if held is None else held}"
    facts["proved"] = "on hardware" if can.family.proved else "not on hardware"
    return facts


def probe_document(config: ArmConfig, probe: Probe) -> dict[str, Any]:
    """Return a probe as JSON values."""
    return {
        "arm": config.name,
        "good": probe.good,
        "shares": probe.shares,
        "rates": probe.rates,
        "highest_rate": probe.highest_rate,
        "advice": probe_advice(probe),
        "drives": [_document(one, probe) for one in probe.probed],
    }


def _document(one: Probed, found: Probe) -> dict[str, Any]:
    document: dict[str, Any] = {"title": one.title, "node": one.node, "drivable": one.drivable, "silent": one.silent}
    document |= {"cut_off": one.cut_off, "moves_by_position": one.moves_by_position}
    can = one.can
    if can is None:
        return {**document, "can": None}
    return {
        **document,
        "can": {
            "family": can.family.name,
            "proved": can.family.proved,
            "asked": can.found.asked,
            "firmware": can.found.firmware,
            "identity": {name: can.found.get(entry) for name, entry in IDENTITY.items()},
            "mode": None if can.torque is None else can.torque.mode,
            "target": None if can.torque is None else can.torque.target,
            "count": can.count,
            "torque_limit": None if can.limit is None else can.limit.entry,
            "speed_limit": None if can.speed is None else entry_text(can.speed),
            "watchdogs": list(can.watchdogs),
            "shares": can.shares,
            "dummies": list(can.dummies),
            "status_timer": can.event,
            "status_with_position": can.beside,
            "problems": [{"where": problem.where, "why": problem.why} for problem in can.problems],
            "changes": [{"where": change.where, "why": change.why} for change in can.changes],
            "missing": list(can.notes),
        },
        "facts": _capability_rows(one, found),
    }


FILE = "drives.json"  # in an arm's folder
_KEPT_FORMAT = "ident-drives"


def store_probe_outcome(probe_file: Path, document: dict[str, Any]) -> list[str]:
    """Store in a file what a probe found of an arm's drives; return what differs from the probe before, in words.

    Args:
        probe_file: the file, one for each arm.
        document: `probe_document` of drives that were asked; those that did not answer keep what was known of them.

    Raises:
        UsageError: the file was damaged by somebody.
    """
    try:
        before = json.loads(probe_file.read_text(encoding="utf-8"))
        known = dict(before["drives"]) if before["format"] == _KEPT_FORMAT else {}
    except FileNotFoundError:
        known = {}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"{probe_file}: cannot be read ({error}); remove the file, and probe again") from None
    now = datetime.now(UTC).isoformat(timespec="seconds")
    words = list[str]()
    for one in document["drives"]:
        if one["silent"] or one["can"] is None:
            continue
        old, place = known.get(one["title"]), f"{one['title']}, node {one['node']}"
        if old is not None:
            words += [f"{place}: {what} (probe of {old['when']})" for what in _different(old["can"], one["can"])]
        known[one["title"]] = {"when": now, "node": one["node"], "can": one["can"]}
    probe_file.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(probe_file, json.dumps({"format": _KEPT_FORMAT, "version": 1, "drives": known}, indent=1) + "\n")
    return words


# The rest of a probe is what the description makes of it.
_OF_THE_DRIVE = (
    *("family", "firmware", "mode", "target", "count"),
    *("torque_limit", "speed_limit", "watchdogs", "status_timer"),
)


def _different(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    if old["identity"] != new["identity"]:
        return ["another drive than at the last probe"]
    return [f"{key} was {old.get(key)!r}, is {new.get(key)!r}" for key in _OF_THE_DRIVE if old.get(key) != new.get(key)]


_PACKAGES = ("ident-service", "python-can", "canopen", "numpy")
_OF_A_DRIVE = (
    "node",
    "bus",
    "identity",
    "counts",
    "rated_torque",
    "torque_scale",
    "max_torque",
    "max_speed",
    "watchdog",
)


def bus_report(
    config: ArmConfig,
    report_file: Path,
    ticket_file: Path | None = None,
    frame_log: Path | None = None,
    open_bus: Callable[[ArmConfig], list[Link]] = open_links,
) -> list[str]:
    """Write a ZIP file to find out why drives do not work, without secrets and names; return its files' names.

    Drives are only read. Where they cannot be, the report says why.

    Args:
        config: of the arm.
        report_file: the ZIP file, which must not exist.
        ticket_file: ticket of the last preflight, left out where the file does not exist.
        frame_log: a log of frames of a run, likewise.
        open_bus: function that opens the links, in the order of the buses.

    Returns:
        The names of the files in it.

    Raises:
        UsageError: no CANopen drives, the file exists, or it cannot be written.
    """
    driver = require_drives(config, "a report is of CANopen drives")
    if report_file.exists():
        raise UsageError(f"{report_file} exists; give another name")
    try:
        report_file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{report_file}: cannot be written: {error.strerror}") from None
    found: dict[str, str] = {
        "versions.json": _as_json(_versions()),
        "description.json": _as_json(_description(config, driver)),
    }
    with TemporaryDirectory(prefix="ident-") as folder:
        for name, text, document in _read(config, driver, Path(folder) / "probe.log", open_bus):
            found[f"{name}.txt"] = text
            if document is not None:
                found[f"{name}.json"] = _as_json(document)
        for name, file in (
            ("probe.log", Path(folder) / "probe.log"),
            ("ticket.json", ticket_file),
            ("can.log", frame_log),
        ):
            if file is not None and file.is_file():
                found[name] = file.read_text(encoding="utf-8", errors="replace")
    part = report_file.with_name(f".{report_file.name}.part")
    try:
        with ZipFile(part, "x", ZIP_DEFLATED) as archive:
            for name, text in found.items():
                archive.writestr(name, text)
        part.replace(report_file)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise UsageError(f"{report_file}: cannot be written: {error.strerror}") from None
    return sorted(found)


def _read(
    config: ArmConfig, driver: CanopenDriver, log: Path, open_bus: Callable[[ArmConfig], list[Link]]
) -> Iterator[tuple[str, str, dict[str, Any] | None]]:
    """Yield what the drives tell, by name, as text and document; the frames of the first reading are logged."""
    logs: list[SessionLog] = []

    def logged(config: ArmConfig) -> list[Link]:
        one, links = logged_links(open_bus(config), log, [bus.data_bitrate is not None for bus in driver.buses])
        logs.append(one)
        return links

    try:
        probe = bus_probe(config, (), logged)
        yield "probe", probe_text(config, probe), probe_document(config, probe)
    except DriverError as error:
        yield "probe", f"no probe: {error}\n", None
    finally:
        for one in logs:
            one.close()
    try:
        planned = planned_configuration(config, open_bus)
        yield "configuration", planned_text(config, planned), drives_document(config, planned)
    except DriverError as error:
        yield "configuration", f"nothing was read: {error}\n", None


def _versions() -> dict[str, str]:
    known = {}
    for name in _PACKAGES:
        with suppress(PackageNotFoundError):
            known[name] = version(name)
    return known | {"python": platform.python_version(), "kernel": platform.release(), "machine": platform.machine()}


def _description(config: ArmConfig, driver: CanopenDriver) -> dict[str, Any]:
    """Return what matters of a description: no options of interfaces, which may hold a password, and no path."""
    drives = [drive.model_dump(mode="json", include=set(_OF_A_DRIVE)) for drive in driver.drives]
    sheets = [driver.sheet_file(number) for number in range(len(drives))]
    return {
        "rate": config.control.rate,
        "streams": driver.streams,
        "torque_frames": driver.torque_frames,
        "measured_torque": driver.torque_reports,
        "buses": [{"interface": bus.interface, "bitrate": bus.bitrate, "fd": bus.data_bitrate} for bus in driver.buses],
        "drives": [
            drive | {"eds": {"name": Path(sheet.name).name, "sha256": sha256(sheet.text.encode()).hexdigest()}}
            for drive, sheet in zip(drives, sheets, strict=True)
        ],
        "profiles": {Path(one.name).name: one.text for one in driver.profiles},
    }


def _as_json(document: dict[str, Any]) -> str:
    return json.dumps(document, indent=1) + "\n"
