"""Tell what configuring an arm's drives would change, without changing it.

The same code configures drives (`drivers.canopen.drive_setup`), with objects that note what they are to write.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from drivers.can.bus_state import BusError
from drivers.can.can_link import Link, open_links
from drivers.canopen.bus_scan import asking, hearing
from drivers.canopen.capabilities import required, where
from drivers.canopen.drive_setup import DriveConfiguration, configure, identify, motor_limits, quick_stop_option
from drivers.canopen.motor_units import coordinates
from drivers.canopen.pdo_mapping import bus_profiles
from drivers.canopen.sdo import Change, DryRunObjects
from drivers.canopen.stored_zero import zeros_of
from ident_service.config.arm import ArmConfig
from ident_service.config.canopen import CanopenDriver
from ident_service.config.eds import DataSheet
from ident_service.errors import DriverError, UsageError


@dataclass(frozen=True)
class PlannedDrive:
    """Hold what configuring one drive would write.

    Attributes:
        number: of the drive, from 1.
        node: its node number.
        changes: in the order in which they would be written.
        refused: why the drive would be refused, then or before; empty where it would not.
    """

    number: int
    node: int
    changes: tuple[Change, ...]
    refused: str


def planned_configuration(
    config: ArmConfig, open_bus: Callable[[ArmConfig], list[Link]] = open_links
) -> tuple[PlannedDrive, ...]:
    """Return what opening an arm would write into its drives, by SDO uploads alone.

    Args:
        config: of the arm.
        open_bus: gives the links, in the order of the buses.

    Raises:
        UsageError: the arm has no CANopen drives.
        DriverError: a bus is in use, by another host too, cannot be opened, or is lost.
    """
    driver, gears = require_drives(config), config.transmission
    if gears is None:
        raise UsageError(f"{config.name}: the description has no transmission")
    profiles = {profile.number: profile for profile in bus_profiles(driver, config.control.rate)}
    found, zeros, option = coordinates(driver, gears), zeros_of(config), quick_stop_option(config)
    planned = []
    with asking(config, open_bus) as (_, links, heard):
        every = [
            DryRunObjects(links[one.bus], one.node, hearing(heard, one.bus), _fixed(sheet))
            for one, sheet in zip(driver.drives, driver.sheets, strict=True)
        ]
        if zeros is not None:
            held = [zeros.held(objects, number) for number, objects in enumerate(every)]
            if known := [counts for counts in held if counts is not None]:
                found = found.zeroed(known, zeros.home) if len(known) == len(held) else found
        motors = motor_limits(config, found)
        for number, (drive, objects) in enumerate(zip(driver.drives, every, strict=True)):
            refused = ""
            try:
                identify(objects, drive.identity)
                own = driver.reactions, option, motors[number], required(objects, driver, number)
                configure(objects, DriveConfiguration(drive, profiles[drive.bus], *own))
            except BusError:
                raise
            except DriverError as error:
                refused = str(error)
            planned.append(PlannedDrive(number + 1, drive.node, tuple(objects.changes), refused))
    return tuple(planned)


def _fixed(sheet: DataSheet) -> frozenset[int]:
    return frozenset(key for key, entry in sheet.entries.items() if not entry.writable)


def require_drives(config: ArmConfig) -> CanopenDriver:
    """Return the driver's section of an arm; raises UsageError where its drives are not CANopen's."""
    if isinstance(config.driver, CanopenDriver):
        return config.driver
    kind = "no driver" if config.driver is None else f"driver {config.driver.kind!r}"
    raise UsageError(f"{config.name} has {kind}; only CANopen drives (driver.kind: canopen) are configured")


def planned_text(config: ArmConfig, planned: Sequence[PlannedDrive]) -> str:
    """Format a dry run as text, with a last line break."""
    lines = [f"{config.name}: what opening would write; nothing was written, and nothing moved"]
    for one in planned:
        lines += ["", f"drive {one.number}, node {one.node}: {_count(one)}", *_change_lines(one.changes)]
        lines += [f"  {'REFUSED':<16}{one.refused}"] if one.refused else []
    return "\n".join(lines) + "\n"


def _count(one: PlannedDrive) -> str:
    return f"{len(one.changes)} entries would be written" if one.changes else "has everything already"


def _change_lines(changes: Sequence[Change]) -> Iterator[str]:
    for change in changes:
        before = "?" if change.before is None else f"{change.before} ({_hex(change, change.before)})"
        after = f"{change.after} ({_hex(change, change.after)})"
        yield f"  {where(change.entry):<16}{before} -> {after}  {change.entry.name}"


def _hex(change: Change, value: int) -> str:
    size = change.entry.kind.size
    return f"{value & (1 << 8 * size) - 1:0{2 * size}X}h"


def planned_document(config: ArmConfig, planned: Sequence[PlannedDrive]) -> dict[str, Any]:
    """Return a dry run as JSON values."""
    return {
        "arm": config.name,
        "written": False,
        "drives": [
            {
                "drive": one.number,
                "node": one.node,
                "refused": one.refused,
                "changes": list(map(_document, one.changes)),
            }
            for one in planned
        ],
    }


def _document(change: Change) -> dict[str, Any]:
    entry = change.entry
    return {"entry": where(entry), "name": entry.name, "before": change.before, "after": change.after}
