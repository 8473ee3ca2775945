"""Compute the bus budget of an arm and format it as text and as JSON values; refuse one that does not fit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from drivers.canopen.bus_load import MOST_TYPICAL, MOST_WORST, Budget, BusLoad, Cost, Line, budget
from ident_service.config.canopen import CanBus, CanopenDriver
from ident_service.config.load import mistake
from ident_service.config.schema import ArmConfig
from ident_service.errors import UsageError

_HEAD = f"  {'frames':<28}{'COB-IDs':<12}{'bytes':>6}{'Hz':>7}{'one of them, us':>24}{'load of all, %':>24}"
_UNDER = f"  {'':<53}{'least':>8}{'typical':>8}{'worst':>8}{'least':>8}{'typical':>8}{'worst':>8}"


def bus_load(config: ArmConfig, rate: float | None = None) -> Budget:
    """Return what an arm's frames cost on its buses.

    Args:
        config: the arm's.
        rate: cycles per second; by default the arm's.

    Raises:
        UsageError: the arm's driver has no bus that frames could be counted on.
    """
    if not isinstance(config.driver, CanopenDriver):
        kind = "no driver" if config.driver is None else f"driver {config.driver.kind!r}"
        raise UsageError(f"{config.name} has {kind}; a bus load is that of CANopen drives (driver.kind: canopen)")
    return budget(config.driver, config.control.rate if rate is None else rate)


def require_budget(arm: str | Path, config: ArmConfig) -> Budget | None:
    """Return the bus budget of an arm with CANopen drives, which must fit; None for other arms.

    Args:
        arm: its file, or its name if it is shipped.
        config: what stands there.

    Raises:
        ConfigError: over budget; the mistake has the place of the driver, and the remedies.
    """
    if not isinstance(config.driver, CanopenDriver):
        return None
    found = bus_load(config)
    if not found.fits:
        raise mistake(arm, ("driver",), f"{found.reason}. {found.remedy}")
    return found


def bus_lines(found: Budget) -> str:
    """Format the verdict as one line per bus."""
    return "".join(
        f"bus {bus.profile.number} ({bus.profile.bus.channel}): {100 * bus.load.worst:.1f} % worst,"
        f" {100 * bus.load.typical:.1f} % typical at {found.rate:g} Hz; up to {bus.highest_rate} Hz\n"
        for bus in found.buses
    )


def bus_text(name: str, found: Budget) -> str:
    """Format the budget as text, with a last line break."""
    lines = [f"{name} at {found.rate:g} Hz: {'fits' if found.fits else 'DOES NOT FIT'}"]
    for bus in found.buses:
        lines += ["", *_bus_lines(bus)]
    if not found.fits:
        lines += ["", f"{found.reason}.", "Any of these helps:", *(f"  - {remedy}" for remedy in found.remedies)]
    return "\n".join(lines) + "\n"


def bus_document(name: str, found: Budget) -> dict[str, Any]:
    """Return the budget as JSON values."""
    return {
        "arm": name,
        "rate": found.rate,
        "fits": found.fits,
        "highest_rate": found.highest_rate,
        "reason": found.reason,
        "remedies": list(found.remedies),
        "buses": [_bus_document(bus) for bus in found.buses],
    }


def _bus_lines(bus: BusLoad) -> list[str]:
    cycle, load = bus.cycle, bus.load
    lines = [f"bus {bus.profile.number}: {_described(bus.profile.bus)}", _HEAD, _UNDER]
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
    profile = bus.profile
    return {
        "number": profile.number,
        "interface": profile.bus.interface,
        "channel": profile.bus.channel,
        "bitrate": profile.bus.bitrate,
        "data_bitrate": profile.bus.data_bitrate,
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
