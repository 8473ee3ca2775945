"""Compare the nodes on an arm's buses with its configuration; format them as text and as JSON values."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from drivers.can.can_link import Link, open_links
from drivers.canopen.bus_scan import FoundNode, scan
from drivers.canopen.cia402 import drive_words, emergency_words, register_words, state_of
from drivers.canopen.drive_setup import differences
from ident_service.config.canopen import CanopenDrive, CanopenDriver
from ident_service.config.schema import ArmConfig
from ident_service.errors import UsageError


class Match(StrEnum):
    """Result of comparing a node with the configuration."""

    CONFIGURED = "configured"
    OTHER = "another one"  # than the configured one
    SILENT = "does not answer"  # but is heard
    MISSING = "missing"
    UNKNOWN = "not configured"


_GOOD = (Match.CONFIGURED, Match.UNKNOWN)


@dataclass(frozen=True)
class Line:
    """One node, or a configured drive that is missing.

    Attributes:
        bus: number of its bus, from 0.
        node: its number.
        drive: number of the configured drive, from 1; None for a node that is none.
        match: result of the comparison with the configuration.
        why: what is different, in words; empty where nothing is.
        found: its identity, state and errors; None where it is missing.
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
        lines: by bus and node number.
        complete: whether every configured drive is there and is the configured one.
    """

    lines: tuple[Line, ...]

    @property
    def complete(self) -> bool:
        """Return whether every configured drive is there and is the configured one."""
        return all(line.match in _GOOD for line in self.lines)


def bus_scan(config: ArmConfig, open_bus: Callable[[ArmConfig], list[Link]] = open_links) -> Scan:
    """Find and identify the nodes on every bus of an arm; nothing is changed.

    Args:
        config: the arm's.
        open_bus: gives the links, in the order of the buses.

    Raises:
        UsageError: the arm's driver has no bus to scan.
        DriverError: as `drivers.canopen.bus_scan.scan`.
    """
    driver = config.driver
    if not isinstance(driver, CanopenDriver):
        kind = "no driver" if driver is None else f"driver {driver.kind!r}"
        raise UsageError(f"{config.name} has {kind}; a bus scan is of CANopen drives (driver.kind: canopen)")
    found = {(node.bus, node.node): node for node in scan(config, open_bus)}
    wanted = {(drive.bus, drive.node): (number, drive) for number, drive in enumerate(driver.drives, 1)}
    lines = []
    for place in sorted({*found, *wanted}):
        node = found.get(place)
        if place in wanted:
            number, drive = wanted[place]
            lines.append(Line(*place, number, *_judged(node, drive), node))
        else:
            lines.append(Line(*place, None, Match.UNKNOWN, "", node))
    return Scan(tuple(lines))


def _judged(node: FoundNode | None, drive: CanopenDrive) -> tuple[Match, str]:
    if node is None:
        return Match.MISSING, "neither heard nor answering"
    if not node.answers:
        return Match.SILENT, "heard, but answers no SDO request"
    if not node.is_drive:
        kind = "not told" if node.device_type is None else f"{node.device_type:08X}h"
        return Match.OTHER, f"no drive of CiA 402 (1000h is {kind})"
    if others := differences(node.identity, drive.identity):
        return Match.OTHER, ", ".join(others)
    return Match.CONFIGURED, ""


def scan_text(config: ArmConfig, found: Scan) -> str:
    """Format a scan as text, with a last line break."""
    lines = [f"{config.name}: {_verdict(found)}"]
    assert isinstance(config.driver, CanopenDriver)  # noqa: S101 - bus_scan has seen to it
    for number, bus in enumerate(config.driver.buses):
        lines += ["", f"bus {number}: {bus.interface} {bus.channel}, {bus.bitrate / 1e6:g} Mbit/s"]
        lines.append(f"  {'node':>4}  {'drive':<6}{'configuration':<17}{'drive state':<28}NMT state")
        for line in found.lines:
            if line.bus == number:
                lines += _node_lines(line)
    return "\n".join(lines) + "\n"


def _verdict(found: Scan) -> str:
    bad = [f"node {line.node} on bus {line.bus} {_MATCHES[line.match]}" for line in found.lines if _bad(line)]
    return "; ".join(bad) if bad else "every configured drive is there"


_MATCHES = {Match.MISSING: "IS MISSING", Match.OTHER: "IS ANOTHER ONE", Match.SILENT: "DOES NOT ANSWER"}


def _bad(line: Line) -> bool:
    return line.match not in _GOOD


def _node_lines(line: Line) -> Iterator[str]:
    drive = "-" if line.drive is None else str(line.drive)
    node = line.found
    state = "-" if node is None or node.status is None else drive_words(node.status)
    match = line.match.upper() if _bad(line) else line.match
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


def scan_document(config: ArmConfig, found: Scan) -> dict[str, Any]:
    """Return a scan as JSON values."""
    return {
        "arm": config.name,
        "complete": found.complete,
        "nodes": [_node_document(line) for line in found.lines],
    }


def _node_document(line: Line) -> dict[str, Any]:
    said = None
    if (node := line.found) is not None:
        said = {
            "nmt": node.nmt,
            "answers": node.answers,
            "device_type": node.device_type,
            "identity": node.identity,
            "name": node.name,
            "firmware": node.firmware,
            "status_word": node.status,
            "state": None if node.status is None else str(state_of(node.status)),
            "error_register": node.error_register,
            "last_error": _error(node.last_error),
            "history": [_error(entry & 0xFFFF) for entry in node.history],
            "unread": node.unread,
        }
    return {
        "bus": line.bus,
        "node": line.node,
        "drive": line.drive,
        "match": line.match.name.lower(),
        "why": line.why,
        "found": said,
    }


def _error(code: int | None) -> dict[str, Any] | None:
    return {"code": code, "words": emergency_words(code)} if code else None
