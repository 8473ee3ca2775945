"""Count the bits of CAN frames (ISO 11898-1), and what the frames of an arm cost on its buses.

Classical frame with an 11-bit identifier and n bytes: start, identifier, RTR, IDE, r0, DLC, data and CRC-15 are
34 + 8 n bits, among which a bit of the other value is stuffed after five alike; CRC delimiter, acknowledge, end of
frame and three bits of intermission are 13 more. So there are 47 + 8 n bits without stuffing, and at most
floor((33 + 8 n)/4) stuffed ones: the first after five bits, each further one after four, as it begins the next run.

CAN FD, with the bit rate switched: the first 17 bits (start to BRS) and the last 13 last as long as in a classical
frame; ESI, DLC, data and CRC take data bits. Up to the end of the data bits are stuffed as above, but for a run that
ends there; stuff count and CRC (17 bits up to 16 bytes, 21 above) have a fixed stuff bit in front and after every
four bits, so that their values do not change the length.

Every length includes the three bits of intermission. Every frame takes its bits without stuffing at least, those of the
worst case at most; typical is the mean over real identifiers, real checksums and values as a moving arm has them.

The rule: at most 100 % of a bus in the worst case, at most 90 % typically.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from math import floor
from typing import TYPE_CHECKING, NamedTuple

from drivers.can.can_frame import Frame

if TYPE_CHECKING:  # its library of checks would be a third of the time of `ident stop`
    from ident_service.config.can_bus import CanBus

FD_LENGTHS: tuple[int, ...] = (*range(9), 12, 16, 20, 24, 32, 48, 64)
_TAIL = 13  # CRC delimiter, acknowledge slot and delimiter, 7 of end of frame, 3 of intermission
_POLYNOMIAL = 0x4599  # CRC-15, without its highest bit
_FD_ARBITRATION = 17  # start, identifier, RRS, IDE, FDF, res, BRS
_FD_CONTROL = 5  # ESI, DLC


class Bits(NamedTuple):
    """Hold the length of a frame: bits at the arbitration bit rate, and at the data bit rate of CAN FD."""

    nominal: int
    data: int = 0

    def seconds(self, bitrate: int, data_bitrate: int | None = None) -> float:
        """Return how long the bits last [s] at these rates [bit/s]; data bits count only with a `data_bitrate`."""
        return self.nominal / bitrate + (self.data / data_bitrate if data_bitrate is not None else 0.0)


def padded_length(least_length: int) -> int:
    """Return the shortest CAN FD length that holds so many bytes; raises ValueError above 64."""
    for longer in FD_LENGTHS:
        if longer >= least_length:
            return longer
    raise ValueError(f"a frame of CAN FD has at most 64 bytes, not {least_length}")


def unstuffed_bits(data_length: int, *, fd: bool = False) -> Bits:
    """Return the number of bits of an 11-bit identifier's data frame, unstuffed; ValueError for a wrong length."""
    if not fd:
        return Bits(_classical(data_length) + _TAIL)
    return Bits(
        _FD_ARBITRATION + _TAIL, _FD_CONTROL + 8 * padded_length(data_length) + _fd_checksum(padded_length(data_length))
    )


def most_bits(data_length: int, *, fd: bool = False) -> Bits:
    """Return the largest number of bits of an 11-bit identifier's data frame; ValueError for a wrong length."""
    plain = unstuffed_bits(data_length, fd=fd)
    if not fd:
        return Bits(plain.nominal + (_classical(data_length) - 1) // 4)
    stuffable = _FD_ARBITRATION + _FD_CONTROL + 8 * padded_length(data_length)
    early = (_FD_ARBITRATION - 1) // 4
    return Bits(plain.nominal + early, plain.data + (stuffable - 2) // 4 - early)


def exact_bits(frame: Frame, *, fd: bool = False) -> Bits:
    """Return the number of bits of one frame with this content; raises ValueError for a length no frame has.

    Error frames are the controller's and not on the wire: 0 bits. Remote frames count as asking for no data.
    """
    if frame.error:
        return Bits(0)
    if fd:
        return _exact_fd(frame)
    data = frame.data
    _classical(len(data))
    if frame.extended:
        # Start 0, 11 bits, SRR 1, IDE 1, 18 bits, RTR, r1 0, r0 0, DLC.
        high, low = frame.identifier >> 18 & 0x7FF, frame.identifier & 0x3FFFF
        head, count = (high << 2 | 3) << 25 | low << 7 | frame.remote << 6 | len(data), 39
    else:
        head, count = (frame.identifier & 0x7FF) << 7 | frame.remote << 6 | len(data), 19
    value, count = head << 8 * len(data) | int.from_bytes(data, "big"), count + 8 * len(data)
    value, count = value << 15 | crc15(value, count), count + 15
    return Bits(count + _stuffed(value, count) + _TAIL)


def crc15(value: int, bit_count: int) -> int:
    """Return the CRC-15 of the lowest `bit_count` bits, first bit highest (ISO 11898-1:2015, 10.4.2.6)."""
    crc = 0
    # Leading zeros leave a CRC that starts at 0 as it is.
    for byte in value.to_bytes((bit_count + 7) // 8, "big"):
        crc = (crc << 8 & 0x7FFF) ^ _CRC[(crc >> 7) ^ byte]
    return crc


def _exact_fd(frame: Frame) -> Bits:
    length = padded_length(len(frame.data))
    # Start 0, identifier, RRS 0, IDE 0, FDF 1, res 0, BRS 1, ESI 0, DLC; padding is zeros.
    head = (frame.identifier & 0x7FF) << 10 | 0b101 << 5 | FD_LENGTHS.index(length)
    value = head << 8 * length | int.from_bytes(frame.data, "big") << 8 * (length - len(frame.data))
    count = _FD_ARBITRATION + _FD_CONTROL + 8 * length
    early = _stuffed(value >> count - _FD_ARBITRATION, _FD_ARBITRATION)
    # What would be stuffed after the last bit is the fixed stuff bit before the stuff count.
    every = _stuffed(value, count) - _run_ends(value, count)
    plain = unstuffed_bits(length, fd=True)
    return Bits(plain.nominal + early, plain.data + every - early)


def _classical(length: int) -> int:
    """Return the bits from start to CRC of a frame with an 11-bit identifier."""
    if not 0 <= length <= 8:
        raise ValueError(f"a classical frame has 0 to 8 bytes, not {length}")
    return 34 + 8 * length


def _fd_checksum(length: int) -> int:
    """Return the bits of stuff count (4), CRC, and a fixed stuff bit in front and after every four bits."""
    content = 4 + (17 if length <= 16 else 21)
    return content + 1 + content // 4


# Stuffing as an automaton: a state is the last bit and how many alike there are, 0 before the first bit.
_START = 0


def _step(state: int, bit: int) -> tuple[int, int]:
    """Return the state after one bit, and how many bits were stuffed; states are 1 + 5 bit + (run - 1), run 1 to 4."""
    last, run = divmod(state - 1, 5) if state else (1 - bit, 0)
    run = run + 2 if state and last == bit else 1
    if run == 5:
        return 1 + 5 * (1 - bit), 1  # the stuffed bit begins a run of its own
    return 1 + 5 * bit + run - 1, 0


def _byte_steps(state: int, byte: int) -> tuple[int, int]:
    stuffed = 0
    for place in range(7, -1, -1):
        state, more = _step(state, byte >> place & 1)
        stuffed += more
    return state, stuffed


@cache
def _steps() -> list[list[tuple[int, int]]]:
    """Return what each byte does in each state; made where it is asked for, as few that import this count bits."""
    return [[_byte_steps(state, byte) for byte in range(256)] for state in range(11)]


def _stuffed(value: int, count: int) -> int:
    state, stuffed = _START, 0
    whole, rest = divmod(count, 8)
    for place in range(count - 1, count - 1 - rest, -1):
        state, more = _step(state, value >> place & 1)
        stuffed += more
    steps = _steps()
    for byte in (value & (1 << 8 * whole) - 1).to_bytes(whole, "big"):
        state, more = steps[state][byte]
        stuffed += more
    return stuffed


def _run_ends(value: int, count: int) -> int:
    """Return 1 when a bit is stuffed after the last one, else 0."""
    return _stuffed(value, count) - _stuffed(value >> 1, count - 1)


def _crc_byte(byte: int) -> int:
    crc = byte << 7
    for _ in range(8):
        crc = (crc << 1 ^ (_POLYNOMIAL if crc & 0x4000 else 0)) & 0x7FFF
    return crc


_CRC = [_crc_byte(byte) for byte in range(256)]

MOST_WORST, MOST_TYPICAL = 1.0, 0.9  # of a bus
ROUND_RATES = (1000, 800, 500, 400, 250, 200, 125, 100, 50)  # Hz


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
        name: name of the sort of frames.
        cob_ids: identifiers, one frame each.
        length: bytes of one.
        per_second: largest number of each per second.
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
        """Return the share of the bus that all frames of this sort take: unstuffed, typical and worst."""
        return self.each.times(len(self.cob_ids) * self.per_second)


@dataclass(frozen=True)
class BusLoad:
    """Describe the load of one bus.

    Attributes:
        number: of the bus, from 0.
        bus: description of the bus.
        lines: load of its frames, by sort.
    """

    number: int
    bus: CanBus
    lines: tuple[Line, ...]

    @property
    def cycle(self) -> Cost:
        """Return the time on the wire of all frames of one cycle [s]: unstuffed, typical and worst."""
        return sum_of(line.each.times(len(line.cob_ids)) for line in self.lines if line.cyclic)

    @property
    def background(self) -> Cost:
        """Return the share of the bus taken by frames that do not depend on the cycle rate."""
        return sum_of(line.load for line in self.lines if not line.cyclic)

    @property
    def load(self) -> Cost:
        """Return the share of the bus taken by all frames: unstuffed, typical and worst."""
        return sum_of(line.load for line in self.lines)

    @property
    def fits(self) -> bool:
        """Return whether the load is at most `MOST_WORST` in the worst case and `MOST_TYPICAL` in the typical one."""
        return self.load.worst <= MOST_WORST and self.load.typical <= MOST_TYPICAL

    @property
    def highest_rate(self) -> int:
        """Return the highest whole cycle rate [Hz] at which the bus `fits`; 0 where the background alone does not."""
        cycle, background = self.cycle, self.background
        most = min((MOST_WORST - background.worst) / cycle.worst, (MOST_TYPICAL - background.typical) / cycle.typical)
        return max(0, floor(most + 1e-9))


@dataclass(frozen=True)
class Budget:
    """Describe the load of all buses of an arm.

    Attributes:
        rate: cycles per second.
        buses: loads of the buses, in the order of the configuration.
        remedies: changes of which each alone would make the load fit, in words; empty where it fits.
    """

    rate: float
    buses: tuple[BusLoad, ...]
    remedies: tuple[str, ...] = ()

    @property
    def fits(self) -> bool:
        """Return whether every bus `fits`, by its worst and its typical load."""
        return all(bus.fits for bus in self.buses)

    @property
    def highest_rate(self) -> int:
        """Return the highest whole cycle rate [Hz] at which every bus `fits`."""
        return min(bus.highest_rate for bus in self.buses)

    @property
    def reason(self) -> str:
        """Describe in words which buses are over budget; empty where none is."""
        return "; ".join(
            f"bus {bus.number} ({bus.bus.channel}) is over budget at {self.rate:g} Hz: {load_text(bus)}"
            for bus in self.buses
            if not bus.fits
        )

    @property
    def remedy(self) -> str:
        """Return the remedies as one sentence; empty where the load fits, or no remedy is known."""
        return f"Do one of these: {'; '.join(self.remedies)}." if self.remedies else ""


DRAWN = 256  # frames behind one mean


def line_of(
    name: str,
    identifiers: Sequence[int],
    data_length: int,
    per_second: float,
    bus: CanBus,
    mean_bits_of: Callable[[int], tuple[float, float]],
    *,
    cyclic: bool = False,
) -> Line:
    """Return the line of frames of one sort: identifiers, length, rate of each, and the mean cost of one on the bus.

    Args:
        name: name of the sort of frames.
        identifiers: identifiers, one for each frame.
        data_length: bytes of one.
        per_second: largest number of each per second.
        bus: bus that the frames are on.
        mean_bits_of: function that returns the mean bits of a frame by its identifier, at the nominal and at the data
            bit rate.
        cyclic: whether each is sent once a cycle.
    """
    fd, rates = bus.data_bitrate is not None, (bus.bitrate, bus.data_bitrate)
    costs = []
    for identifier in identifiers:
        nominal, data = mean_bits_of(identifier)
        typical = nominal / bus.bitrate + (data / bus.data_bitrate if bus.data_bitrate is not None else 0.0)
        costs.append(
            Cost(
                unstuffed_bits(data_length, fd=fd).seconds(*rates),
                typical,
                most_bits(data_length, fd=fd).seconds(*rates),
            )
        )
    return Line(name, tuple(identifiers), data_length, per_second, cyclic, sum_of(costs).times(1.0 / len(costs)))


def mean_bits(identifier: int, draw_data: Callable[[random.Random], bytes], *, fd: bool = False) -> tuple[float, float]:
    """Return the mean bits of a frame over typical contents, at both bit rates; the same on every call.

    Args:
        identifier: identifier of the frame, which seeds the draws, too.
        draw_data: function that draws the content of one frame.
        fd: whether it is a CAN FD frame.
    """
    source = random.Random(identifier)  # noqa: S311 - values, not secrets
    nominal = data = 0
    for _ in range(DRAWN):
        bits = exact_bits(Frame(identifier, draw_data(source)), fd=fd)
        nominal, data = nominal + bits.nominal, data + bits.data
    return nominal / DRAWN, data / DRAWN


def load_text(bus: BusLoad) -> str:
    """Return the worst and the typical load of a bus in words [%]."""
    return f"{100 * bus.load.worst:.1f} % worst, {100 * bus.load.typical:.1f} % typical"


def sum_of(costs: Iterable[Cost]) -> Cost:
    """Return the sum of costs; zero without any."""
    every = list(costs)
    return Cost(*(sum(column) for column in zip(*every, strict=True))) if every else Cost(0.0, 0.0, 0.0)
