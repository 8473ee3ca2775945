"""Compare the capabilities of an arm's drives with what the driver needs; format them as text and as JSON values.

Drives are read by SDO uploads alone; for a drive that does not answer, and for files without a drive, the capabilities
are derived from the data sheet.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from drivers.can.bus_errors import BusError
from drivers.can.can_link import Link, open_links
from drivers.canopen.bus_load import budget
from drivers.canopen.bus_scan import asking, hearing
from drivers.canopen.capabilities import Capabilities, capabilities, foretold, judged, named, where
from drivers.canopen.drive_setup import IDENTITY
from drivers.canopen.pdo_mapping import bus_profiles
from drivers.canopen.sdo import Objects
from ident_service.config.canopen import CanopenDriver
from ident_service.config.eds import data_sheet
from ident_service.config.quantities import TextFile
from ident_service.config.schema import ArmConfig
from ident_service.errors import DriverError, UsageError


@dataclass(frozen=True)
class Probed:
    """Capabilities of one drive, or of one data sheet.

    Attributes:
        title: `drive N`, or the name of the file.
        node: number of the drive, as the description has it.
        silent: why it was not asked, or did not answer; empty for one that did.
        can: its capabilities; None where neither the drive nor a file tells them.
    """

    title: str
    node: int
    silent: str
    can: Capabilities | None

    @property
    def drivable(self) -> bool:
        """Return whether the drive can be driven as the description stands."""
        return self.can is not None and not (self.silent or self.can.problems or self.can.changes)


@dataclass(frozen=True)
class Probe:
    """Capabilities of all drives of an arm, or of all data sheets.

    Attributes:
        probed: the drives in the arm's order, or the files.
        shares: whether all of them can share torque frames, as far as files and families know.
        rates: cycles per second that the buses carry at most, by kind of torque frames (`shared`, `single`).
        status_syncs: SYNCs from one status report to the next, of drives without a timer for them.
    """

    probed: tuple[Probed, ...]
    shares: bool
    rates: dict[str, int]
    status_syncs: int

    @property
    def good(self) -> bool:
        """Return whether every drive can be driven."""
        return all(one.drivable for one in self.probed)

    @property
    def highest_rate(self) -> int:
        """Return the highest rate with the torque frames that the drives allow [Hz]."""
        return self.rates["shared" if self.shares else "single"]


def bus_probe(
    config: ArmConfig,
    files: Sequence[TextFile] = (),
    open_bus: Callable[[ArmConfig], list[Link]] = open_links,
) -> Probe:
    """Read the capabilities of an arm's drives; nothing is changed.

    Args:
        config: the arm's.
        files: data sheets, judged in place of the drives without any bus.
        open_bus: gives the links, in the order of the buses.

    Raises:
        UsageError: the arm's driver has no bus.
        DriverError: a bus is in use, by another host too, cannot be opened, or is lost.
    """
    driver = config.driver
    if not isinstance(driver, CanopenDriver):
        kind = "no driver" if driver is None else f"driver {driver.kind!r}"
        raise UsageError(f"{config.name} has {kind}; a bus probe is of CANopen drives (driver.kind: canopen)")
    if files:
        probed = [_of_file(driver, number % len(driver.drives), one) for number, one in enumerate(files)]
    else:
        with asking(config, open_bus) as (_, links, heard):
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
    return Probe(tuple(probed), shares, rates, bus_profiles(driver, rate)[0].status_syncs)


def _of_drive(driver: CanopenDriver, number: int, objects: Objects) -> Probed:
    drive = driver.drives[number]
    title = f"drive {number + 1}"
    try:
        return Probed(title, drive.node, "", capabilities(objects, driver, number))
    except BusError:
        raise
    except DriverError as error:
        return Probed(title, drive.node, str(error), _foretold(driver, number, driver.sheet_file(number)))


def _of_file(driver: CanopenDriver, number: int, file: TextFile) -> Probed:
    mistake = data_sheet(file.text).mistake
    why = f"is no EDS: {mistake}" if mistake else ""
    return Probed(file.name, driver.drives[number].node, why, _foretold(driver, number, file))


def _foretold(driver: CanopenDriver, number: int, file: TextFile) -> Capabilities | None:
    sheet, drive = data_sheet(file.text), driver.drives[number]
    if not sheet.entries:
        return None
    family, found = foretold(sheet, drive, driver.families)
    return judged(found, family, drive, driver, sheet)


def probe_text(config: ArmConfig, found: Probe) -> str:
    """Format a probe as text, with a last line break."""
    bad = [one for one in found.probed if not one.drivable]
    verdict = f"{len(bad)} of {len(found.probed)} NOT AS IT IS" if bad else "every drive can be driven"
    lines = [f"{config.name}: {verdict}; nothing was written"]
    for one in found.probed:
        lines += ["", *_lines(one, found)]
    frames = "shared" if found.shares else "single"
    lines += ["", f"highest rate: {found.highest_rate} Hz, with {frames} torque frames (driver.torque_frames)"]
    if found.shares:
        lines.append(f"with single ones: {found.rates['single']} Hz")
    if config.control.rate > found.highest_rate:
        lines.append(f"control.rate is {config.control.rate:g} Hz, which is TOO MUCH")
    return "\n".join(lines) + "\n"


def _lines(one: Probed, found: Probe) -> Iterator[str]:
    can = one.can
    if can is None:
        yield f"{one.title}, node {one.node}: {one.silent}"
        return
    verdict = "CANNOT BE DRIVEN" if can.problems else "not as described" if can.changes else "can be driven"
    by = "" if can.found.asked else ", foretold by its data sheet"
    yield f"{one.title}, node {one.node}: {can.family.name}: {verdict}{by}"
    if one.silent:
        yield f"  {one.silent}"
    for problem in can.problems:
        yield f"  {'REFUSED':<16}{problem}"
    for change in can.changes:
        yield f"  {'to change':<16}{change}"
    for name, words in _facts(one, found).items():
        yield f"  {name.replace('_', ' '):<16}{words}"
    for note in can.notes if can.torque is not None else ():
        yield f"  {'lacks':<16}{note}"
    if can.family.notes:
        yield f"  {'family':<16}{can.family.notes}"


def _facts(one: Probed, found: Probe) -> dict[str, str]:
    """Return the chosen torque path, limits, watchdogs and frames of a drive, in words."""
    can = one.can
    if can is None:
        return {}
    values = {name: can.found.get(entry) for name, entry in IDENTITY.items()}
    facts = {"identity": ", ".join(f"{name} {value:08X}h" for name, value in values.items() if value is not None)}
    if can.torque is None:
        return facts
    unit = can.family.unit
    of = "" if unit is None or unit.rated is None else f", by {named(unit.rated)} in {unit.unit}"
    count = "unknown" if can.count is None else f"{can.count:.4g} N m"
    mode = f"mode {can.torque.mode}" + (f" ({named(can.torque.by.entry)})" if can.torque.by else "")
    facts["torque"] = f"{mode}, {named(can.torque.target)}; a count is {count}{of}"
    facts["torque_limit"] = "none" if can.limit is None else named(can.limit.entry)
    facts["speed_limit"] = "the host's alone" if can.speed is None else where(can.speed)
    facts["watchdogs"] = ", ".join(can.watchdogs) or "none"
    dummies = ", ".join(f"{dummy:04X}h" for dummy in can.dummies)
    shares = f"can be shared; foreign slots by {dummies}" if can.shares else "single"
    facts["torque_frames"] = f"{shares}, as far as its file and family know"
    facts["status_reports"] = "on change and by timer" if can.event else f"every {found.status_syncs} SYNCs"
    facts["proved"] = "on hardware" if can.family.proved else "not on hardware"
    return facts


def probe_document(config: ArmConfig, found: Probe) -> dict[str, Any]:
    """Return a probe as JSON values."""
    return {
        "arm": config.name,
        "good": found.good,
        "shares": found.shares,
        "rates": found.rates,
        "highest_rate": found.highest_rate,
        "drives": [_document(one, found) for one in found.probed],
    }


def _document(one: Probed, found: Probe) -> dict[str, Any]:
    document: dict[str, Any] = {"title": one.title, "node": one.node, "drivable": one.drivable, "silent": one.silent}
    can = one.can
    if can is None:
        return {**document, "can": None}
    return {
        **document,
        "can": {
            "family": can.family.name,
            "proved": can.family.proved,
            "asked": can.found.asked,
            "identity": {name: can.found.get(entry) for name, entry in IDENTITY.items()},
            "mode": None if can.torque is None else can.torque.mode,
            "target": None if can.torque is None else can.torque.target,
            "count": can.count,
            "torque_limit": None if can.limit is None else can.limit.entry,
            "speed_limit": None if can.speed is None else where(can.speed),
            "watchdogs": list(can.watchdogs),
            "shares": can.shares,
            "dummies": list(can.dummies),
            "status_timer": can.event,
            "problems": [{"where": problem.where, "why": problem.why} for problem in can.problems],
            "changes": [{"where": change.where, "why": change.why} for change in can.changes],
            "missing": list(can.notes),
        },
        "facts": _facts(one, found),
    }
