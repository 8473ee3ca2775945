"""Compute the load of an arm's frames on each bus, whether it fits, and remedies where it does not.

Every frame takes its bits without stuffing at least, those of the worst case at most; typical is the mean over real
identifiers, real checksums and values as a moving arm has them (positions within ten motor turns of zero, torques of
a tenth of rated torque). A cycle has SYNC, torque frames and positions; beside it there are heartbeats, status reports
as often as their inhibit time allows, and one emergency a second and drive (`EMERGENCY_INHIBIT`). SDOs flow before
streaming only, control words once.

The rule: at most 100 % of a bus in the worst case, at most 90 % typically. Frames of the background have the lower
priority (but for emergencies), so that they wait for the cycle, not the cycle for them.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import floor
from typing import NamedTuple

from drivers.can.can_frame import Frame
from drivers.canopen import object_dictionary as od
from drivers.canopen.cia402 import NmtState
from drivers.canopen.frame_bits import exact, unstuffed, worst
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
from ident_service.config.canopen import CanBus, CanopenDriver

MOST_WORST, MOST_TYPICAL = 1.0, 0.9  # of a bus
ROUND_RATES = (1000, 800, 500, 400, 250, 200, 125, 100, 50)  # Hz
_FD_FACTOR = 4  # data bit rate over bit rate of the remedy with CAN FD
_DRAWN = 256  # frames behind one mean

HEARTBEAT_STATE = Entry(0x1017, 0, Kind.U8, "NMT state")  # not an entry: what a heartbeat frame carries
VENDOR_BYTE = Entry(0x1003, 0, Kind.U8, "vendor's byte of an emergency")
EMERGENCY_SLOTS = (od.LAST_EMERGENCY, od.ERROR_REGISTER, *(VENDOR_BYTE,) * 5)

_VALUES: dict[Entry, Callable[[random.Random], int]] = {
    od.POSITION: lambda draw: draw.randint(-40_000, 40_000),
    od.TARGET_TORQUE: lambda draw: draw.randint(-100, 100),
    od.TORQUE_ACTUAL: lambda draw: draw.randint(-100, 100),
    od.STATUS_WORD: lambda draw: draw.choice((0x1637, 0x1E37)),
    od.LAST_EMERGENCY: lambda draw: draw.choice((0x2310, 0x3220, 0x4310, 0x7305, 0x8130, 0x8250, 0x8611)),
    od.ERROR_REGISTER: lambda draw: 1 << draw.randrange(5) | 1,
    HEARTBEAT_STATE: lambda draw: NmtState.OPERATIONAL,
    VENDOR_BYTE: lambda draw: 0,
}


class Cost(NamedTuple):
    """Hold one quantity without stuffing, in the mean, and in the worst case."""

    unstuffed: float
    typical: float
    worst: float

    def times(self, factor: float) -> Cost:
        """Return the cost multiplied by a factor."""
        return Cost(*(factor * each for each in self))


@dataclass(frozen=True)
class Line:
    """Describe the frames of one sort.

    Attributes:
        name: of the sort.
        cob_ids: identifiers, one frame each.
        length: bytes of one.
        per_second: how often each is sent, at most.
        cyclic: whether each is sent once a cycle.
        each: time of one on the wire, intermission included [s]; the mean over `cob_ids`.
    """

    name: str
    cob_ids: tuple[int, ...]
    length: int
    per_second: float
    cyclic: bool
    each: Cost

    @property
    def load(self) -> Cost:
        """Return the share of the bus that all frames of this sort take."""
        return self.each.times(len(self.cob_ids) * self.per_second)


@dataclass(frozen=True)
class BusLoad:
    """Describe the load of one bus.

    Attributes:
        profile: frames of the bus.
        lines: their load, by sort.
    """

    profile: BusProfile
    lines: tuple[Line, ...]

    @property
    def cycle(self) -> Cost:
        """Return the time on the wire of the frames of one cycle [s], within which the last position has come."""
        return _sum(line.each.times(len(line.cob_ids)) for line in self.lines if line.cyclic)

    @property
    def background(self) -> Cost:
        """Return the share of the bus that does not depend on the rate."""
        return _sum(line.load for line in self.lines if not line.cyclic)

    @property
    def load(self) -> Cost:
        """Return the share of the bus taken by all frames."""
        return _sum(line.load for line in self.lines)

    @property
    def fits(self) -> bool:
        """Return whether the bus keeps the rule: at most `MOST_WORST` and `MOST_TYPICAL` of it."""
        return self.load.worst <= MOST_WORST and self.load.typical <= MOST_TYPICAL

    @property
    def highest_rate(self) -> int:
        """Return the most whole cycles per second that keep the rule; 0 where the background alone breaks it."""
        cycle, background = self.cycle, self.background
        most = min((MOST_WORST - background.worst) / cycle.worst, (MOST_TYPICAL - background.typical) / cycle.typical)
        return max(0, floor(most + 1e-9))


@dataclass(frozen=True)
class Budget:
    """Describe the load of all buses of an arm.

    Attributes:
        rate: cycles per second.
        buses: in the order of the configuration.
        remedies: changes of which each alone would make the load fit, in words; empty where it fits.
    """

    rate: float
    buses: tuple[BusLoad, ...]
    remedies: tuple[str, ...] = ()

    @property
    def fits(self) -> bool:
        """Return whether every bus keeps the rule."""
        return all(bus.fits for bus in self.buses)

    @property
    def highest_rate(self) -> int:
        """Return the most whole cycles per second that every bus carries."""
        return min(bus.highest_rate for bus in self.buses)

    @property
    def reason(self) -> str:
        """Describe in words which buses are over budget; empty where none is."""
        return "; ".join(
            f"bus {bus.profile.number} ({bus.profile.bus.channel}) is over budget at {self.rate:g} Hz: {_shares(bus)}"
            for bus in self.buses
            if not bus.fits
        )

    @property
    def remedy(self) -> str:
        """Return one sentence that says what to do; empty where nothing has to be done."""
        return f"Do one of these: {'; '.join(self.remedies)}." if self.remedies else ""


def budget(driver: CanopenDriver, rate: float) -> Budget:
    """Compute the bus loads of an arm's frames at a rate.

    Args:
        driver: the arm's section `driver`.
        rate: cycles per second.
    """
    plain = _budget(driver, rate)
    return plain if plain.fits else Budget(rate, plain.buses, tuple(_remedies(driver, rate, plain)))


def frame_cost(cob_id: int, slots: Sequence[Entry], bus: CanBus) -> Cost:
    """Return the time of one frame with these contents on a bus, intermission included [s].

    Args:
        cob_id: its identifier.
        slots: entries that it carries; they decide its length and which values are typical.
        bus: its bit rates.
    """
    length, fd = sum(slot.kind.size for slot in slots), bus.data_bitrate is not None
    rates = bus.bitrate, bus.data_bitrate
    nominal, data = _mean_bits(cob_id, tuple(slots), fd)
    typical = nominal / bus.bitrate + (data / bus.data_bitrate if bus.data_bitrate is not None else 0.0)
    return Cost(unstuffed(length, fd=fd).seconds(*rates), typical, worst(length, fd=fd).seconds(*rates))


@lru_cache(maxsize=512)
def _mean_bits(cob_id: int, slots: tuple[Entry, ...], fd: bool) -> tuple[float, float]:
    """Return the mean length over typical values, at the nominal and at the data bit rate; the same on every call."""
    draw = random.Random(cob_id)  # noqa: S311 - values, not secrets
    nominal = data = 0
    for _ in range(_DRAWN):
        bits = exact(Frame(cob_id, b"".join(slot.pack(_VALUES[slot](draw)) for slot in slots)), fd=fd)
        nominal, data = nominal + bits.nominal, data + bits.data
    return nominal / _DRAWN, data / _DRAWN


def _budget(driver: CanopenDriver, rate: float) -> Budget:
    return Budget(rate, tuple(BusLoad(profile, tuple(_lines(profile))) for profile in bus_profiles(driver, rate)))


def _lines(profile: BusProfile) -> Iterator[Line]:
    nodes, rate = profile.nodes, profile.rate
    yield _line(profile, "SYNC", (SYNC,), (), rate, cyclic=True)
    alone = tuple(frame.cob_id for frame in profile.torque_frames if len(frame.nodes) == 1)
    for frame in profile.torque_frames:
        if len(frame.nodes) > 1:
            whose = f"torques of nodes {', '.join(map(str, frame.nodes))}"
            yield _line(profile, whose, (frame.cob_id,), (od.TARGET_TORQUE,) * len(frame.nodes), rate, cyclic=True)
    if alone:
        yield _line(profile, "torques, one drive each", alone, (od.TARGET_TORQUE,), rate, cyclic=True)
    yield _line(profile, "positions", tuple(TPDO1 + n for n in nodes), profile.position_slots, rate, cyclic=True)
    status = profile.status_slots
    yield _line(profile, "status reports", tuple(TPDO2 + n for n in nodes), status, 1.0 / profile.status_inhibit)
    guarded = tuple(HEARTBEAT + n for n in profile.guarded)
    if beats := tuple(HEARTBEAT + n for n in nodes if HEARTBEAT + n not in guarded):
        yield _line(profile, "heartbeats of the drives", beats, (HEARTBEAT_STATE,), 1.0 / profile.heartbeat_drives)
    if guarded:
        often = 1.0 / (GUARD_EARLY * profile.guarding[0])
        yield _line(profile, "questions of node guarding", guarded, (), often)
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
    costs = [frame_cost(cob_id, slots, profile.bus) for cob_id in cob_ids]
    mean = _sum(costs).times(1.0 / len(costs))
    return Line(name, cob_ids, sum(slot.kind.size for slot in slots), per_second, cyclic, mean)


def _remedies(driver: CanopenDriver, rate: float, plain: Budget) -> Iterator[str]:
    """Yield single changes that would make the load fit, in words, with the load that they lead to."""
    if slower := next((r for r in ROUND_RATES if r <= min(plain.highest_rate, rate)), None):
        yield f"run at {slower} Hz (control.rate): {_left(_budget(driver, float(slower)))}"
    for words, changed in _variants(driver):
        if (other := _budget(changed, rate)).fits:
            yield f"{words}: {_left(other)}"


def _variants(driver: CanopenDriver) -> Iterator[tuple[str, CanopenDriver]]:
    if driver.torque_frames == "single" and driver.shares_by_sheet:
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
    return f"{_shares(max(other.buses, key=lambda bus: bus.load.worst))}"


def _shares(bus: BusLoad) -> str:
    return f"{100 * bus.load.worst:.1f} % worst, {100 * bus.load.typical:.1f} % typical"


def _sum(costs: Iterator[Cost] | Sequence[Cost]) -> Cost:
    every = list(costs)
    return Cost(*(sum(column) for column in zip(*every, strict=True))) if every else Cost(0.0, 0.0, 0.0)
