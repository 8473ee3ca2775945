"""Work out what an arm's CANopen frames cost on each bus, and whether they fit (`drivers/can/bus_load.py`).

Typical values are positions within ten motor turns of zero, and torques of a tenth of rated torque. A cycle has SYNC,
torque frames and positions; beside it there are heartbeats, status reports as often as their inhibit time allows, and
one emergency a second and drive (`EMERGENCY_INHIBIT`). SDOs flow before streaming only, control words once.

Frames of the background have the lower priority (but for emergencies), so that they wait for the cycle, not the cycle
for them.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from functools import lru_cache

from drivers.can.bus_load import ROUND_RATES, Budget, BusLoad, Line, line_of, load_text, mean_bits
from drivers.canopen import object_dictionary as od
from drivers.canopen.cia402 import NmtState
from drivers.canopen.object_dictionary import Entry, Kind
from drivers.canopen.pdo_mapping import (
    EMERGENCY,
    EMERGENCY_INHIBIT,
    GUARD_EARLY,
    HEARTBEAT,
    SYNC,
    TPDO1,
    TPDO2,
    BusProfile,
    bus_profiles,
)
from ident_service.config.can_bus import CanBus
from ident_service.config.canopen import CanopenDriver

_FD_FACTOR = 4  # data bit rate over bit rate of the remedy with CAN FD

HEARTBEAT_STATE = Entry(0x1017, 0, Kind.U8, "NMT state")  # not an entry: what a heartbeat frame carries
VENDOR_BYTE = Entry(0x1003, 0, Kind.U8, "vendor's byte of an emergency")
EMERGENCY_SLOTS = (od.LAST_EMERGENCY, od.ERROR_REGISTER, *(VENDOR_BYTE,) * 5)

_VALUES: dict[Entry, Callable[[random.Random], int]] = {
    od.POSITION: lambda draw: draw.randint(-40_000, 40_000),
    od.TARGET_TORQUE: lambda draw: draw.randint(-100, 100),
    od.TARGET_TORQUE_WIDE: lambda draw: draw.randint(-100, 100) << 16,
    od.TARGET_POSITION: lambda draw: draw.randint(-40_000, 40_000),
    od.TORQUE_ACTUAL: lambda draw: draw.randint(-100, 100),
    od.STATUS_WORD: lambda draw: draw.choice((0x1637, 0x1E37)),
    od.LAST_EMERGENCY: lambda draw: draw.choice((0x2310, 0x3220, 0x4310, 0x7305, 0x8130, 0x8250, 0x8611)),
    od.ERROR_REGISTER: lambda draw: 1 << draw.randrange(5) | 1,
    HEARTBEAT_STATE: lambda draw: NmtState.OPERATIONAL,
    VENDOR_BYTE: lambda draw: 0,
}


def budget(driver: CanopenDriver, rate: float) -> Budget:
    """Return the loads of an arm's frames on its buses at a rate [Hz], with remedies where one does not fit.

    Args:
        driver: the arm's section `driver`.
        rate: cycles per second.
    """
    plain = _budget(driver, rate)
    return plain if plain.fits else Budget(rate, plain.buses, tuple(_remedies(driver, rate, plain)))


def frame_line(
    name: str,
    cob_ids: tuple[int, ...],
    entries: tuple[Entry, ...],
    per_second: float,
    bus: CanBus,
    *,
    cyclic: bool = False,
) -> Line:
    """Return the line of frames with these contents: their cost on a bus; `entries` decide length and typical bits."""
    length, fd = sum(slot.kind.size for slot in entries), bus.data_bitrate is not None
    return line_of(name, cob_ids, length, per_second, bus, lambda one: _mean_bits(one, entries, fd), cyclic=cyclic)


@lru_cache(maxsize=512)
def _mean_bits(cob_id: int, slots: tuple[Entry, ...], fd: bool) -> tuple[float, float]:
    def draw(source: random.Random) -> bytes:
        return b"".join(slot.pack(_VALUES[slot](source)) for slot in slots)

    return mean_bits(cob_id, draw, fd=fd)


def _budget(driver: CanopenDriver, rate: float) -> Budget:
    return Budget(rate, tuple(BusLoad(one.number, one.bus, tuple(_lines(one))) for one in bus_profiles(driver, rate)))


def _lines(profile: BusProfile) -> Iterator[Line]:
    nodes, rate = profile.nodes, profile.rate
    yield _line(profile, "SYNC", (SYNC,), (), rate, cyclic=True)
    alone: dict[Entry, list[int]] = {}
    for frame in profile.torque_frames:
        if len(frame.nodes) == 1:
            alone.setdefault(frame.target, []).append(frame.cob_id)
    for frame in profile.torque_frames:
        if len(frame.nodes) > 1:
            whose = f"torques of nodes {', '.join(map(str, frame.nodes))}"
            yield _line(profile, whose, (frame.cob_id,), (frame.target,) * len(frame.nodes), rate, cyclic=True)
    for target, ids in alone.items():
        whose = "target positions" if target is od.TARGET_POSITION else "torques"
        yield _line(profile, f"{whose}, one drive each", tuple(ids), (target,), rate, cyclic=True)
    name = "positions" if profile.status_slots else "positions with status"
    yield _line(profile, name, tuple(TPDO1 + n for n in nodes), profile.position_slots, rate, cyclic=True)
    if status := profile.status_slots:
        yield _line(profile, "status reports", tuple(TPDO2 + n for n in nodes), status, 1.0 / profile.status_inhibit)
    guarded = tuple(HEARTBEAT + n for n in profile.guarded_nodes)
    if beats := tuple(HEARTBEAT + n for n in nodes if HEARTBEAT + n not in guarded):
        yield _line(profile, "heartbeats of the drives", beats, (HEARTBEAT_STATE,), 1.0 / profile.heartbeat_drives)
    if guarded:
        often = 1.0 / (GUARD_EARLY * profile.guarding[0])
        yield _line(profile, "requests of node guarding", guarded, (), often)
        yield _line(profile, "answers to them", guarded, (HEARTBEAT_STATE,), often)
    yield _line(
        profile, "heartbeat of the host", (HEARTBEAT + profile.host,), (HEARTBEAT_STATE,), 1.0 / profile.heartbeat_host
    )
    errors = tuple(EMERGENCY + n for n in nodes)
    yield _line(profile, "emergencies", errors, EMERGENCY_SLOTS, 1.0 / EMERGENCY_INHIBIT)


def _line(
    profile: BusProfile,
    name: str,
    cob_ids: tuple[int, ...],
    slots: tuple[Entry, ...],
    per_second: float,
    *,
    cyclic: bool = False,
) -> Line:
    return frame_line(name, cob_ids, slots, per_second, profile.bus, cyclic=cyclic)


def _remedies(driver: CanopenDriver, rate: float, plain: Budget) -> Iterator[str]:
    """Yield single changes that would make the load fit, in words, with the load that they lead to."""
    if slower := next((r for r in ROUND_RATES if r <= min(plain.highest_rate, rate)), None):
        yield f"run at {slower} Hz (control.rate): {_left(_budget(driver, float(slower)))}"
    for words, changed in _variants(driver):
        if (other := _budget(changed, rate)).fits:
            yield f"{words}: {_left(other)}"


def _variants(driver: CanopenDriver) -> Iterator[tuple[str, CanopenDriver]]:
    if driver.torque_frames == "single" and driver.streams == "torque" and driver.sheets_allow_short_dummies:
        words = "let up to four drives share a torque frame (driver.torque_frames: shared)"
        yield words, driver.model_copy(update={"torque_frames": "shared"})
    if len(driver.buses) == 1 and len(driver.drives) > 1:
        # The longer half first, as four drives fill a shared frame.
        first = (len(driver.drives) + 1) // 2
        halves = tuple(d.model_copy(update={"bus": int(k >= first)}) for k, d in enumerate(driver.drives))
        words = "give the drives two buses (driver.buses, and bus of each drive)"
        yield words, driver.model_copy(update={"buses": driver.buses * 2, "drives": halves})
    if all(bus.data_bitrate is None for bus in driver.buses):
        faster = tuple(b.model_copy(update={"data_bitrate": _FD_FACTOR * b.bitrate}) for b in driver.buses)
        words = f"use CAN FD with data at {_FD_FACTOR} times the bit rate, where interface and drives have it"
        yield f"{words} (driver.buses, data_bitrate)", driver.model_copy(update={"buses": faster})


def _left(other: Budget) -> str:
    return load_text(max(other.buses, key=lambda bus: bus.load.worst))
