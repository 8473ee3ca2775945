"""Compute how many bits a frame takes on the wire, and how long they last (ISO 11898-1:2015, 10.4 and 10.5).

Classical frame with an 11-bit identifier and n bytes: start, identifier, RTR, IDE, r0, DLC, data and CRC-15 are
34 + 8 n bits, among which a bit of the other value is stuffed after five alike; CRC delimiter, acknowledge, end of
frame and three bits of intermission are 13 more. So there are 47 + 8 n bits without stuffing, and at most
floor((33 + 8 n)/4) stuffed ones: the first after five bits, each further one after four, as it begins the next run.

CAN FD, with the bit rate switched: the first 17 bits (start to BRS) and the last 13 last as long as in a classical
frame; ESI, DLC, data and CRC take data bits. Up to the end of the data bits are stuffed as above, but for a run that
ends there; stuff count and CRC (17 bits up to 16 bytes, 21 above) have a fixed stuff bit in front and after every
four bits, so that their values do not change the length.

Every length includes the three bits of intermission.
"""

from __future__ import annotations

from typing import NamedTuple

from drivers.can.can_frame import Frame

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
        """Return how long the bits last at these bit rates [s]; rates in [bit/s]."""
        return self.nominal / bitrate + (self.data / data_bitrate if data_bitrate is not None else 0.0)


def padded(length: int) -> int:
    """Return the shortest CAN FD length that holds so many bytes; raises ValueError above 64."""
    for longer in FD_LENGTHS:
        if longer >= length:
            return longer
    raise ValueError(f"a frame of CAN FD has at most 64 bytes, not {length}")


def unstuffed(length: int, *, fd: bool = False) -> Bits:
    """Return the bits of a data frame of so many bytes without stuffing; ValueError for a length no frame has."""
    if not fd:
        return Bits(_classical(length) + _TAIL)
    return Bits(_FD_ARBITRATION + _TAIL, _FD_CONTROL + 8 * padded(length) + _fd_checksum(padded(length)))


def worst(length: int, *, fd: bool = False) -> Bits:
    """Return the most bits that a data frame of so many bytes can have; ValueError for a length no frame has."""
    plain = unstuffed(length, fd=fd)
    if not fd:
        return Bits(plain.nominal + (_classical(length) - 1) // 4)
    stuffable = _FD_ARBITRATION + _FD_CONTROL + 8 * padded(length)
    early = (_FD_ARBITRATION - 1) // 4
    return Bits(plain.nominal + early, plain.data + (stuffable - 2) // 4 - early)


def exact(frame: Frame, *, fd: bool = False) -> Bits:
    """Return the bits of one frame with this content; raises ValueError for a length no frame has.

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


def crc15(value: int, count: int) -> int:
    """Return the CRC-15 of the lowest `count` bits, first bit highest (ISO 11898-1:2015, 10.4.2.6)."""
    crc = 0
    # Leading zeros leave a CRC that starts at 0 as it is.
    for byte in value.to_bytes((count + 7) // 8, "big"):
        crc = (crc << 8 & 0x7FFF) ^ _CRC[(crc >> 7) ^ byte]
    return crc


def _exact_fd(frame: Frame) -> Bits:
    length = padded(len(frame.data))
    # Start 0, identifier, RRS 0, IDE 0, FDF 1, res 0, BRS 1, ESI 0, DLC; padding is zeros.
    head = (frame.identifier & 0x7FF) << 10 | 0b101 << 5 | FD_LENGTHS.index(length)
    value = head << 8 * length | int.from_bytes(frame.data, "big") << 8 * (length - len(frame.data))
    count = _FD_ARBITRATION + _FD_CONTROL + 8 * length
    early = _stuffed(value >> count - _FD_ARBITRATION, _FD_ARBITRATION)
    # What would be stuffed after the last bit is the fixed stuff bit before the stuff count.
    every = _stuffed(value, count) - _run_ends(value, count)
    plain = unstuffed(length, fd=True)
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


_STEPS = [[_byte_steps(state, byte) for byte in range(256)] for state in range(11)]


def _stuffed(value: int, count: int) -> int:
    state, stuffed = _START, 0
    whole, rest = divmod(count, 8)
    for place in range(count - 1, count - 1 - rest, -1):
        state, more = _step(state, value >> place & 1)
        stuffed += more
    for byte in (value & (1 << 8 * whole) - 1).to_bytes(whole, "big"):
        state, more = _STEPS[state][byte]
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
