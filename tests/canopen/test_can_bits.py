"""Lengths of frames: the published table, an independent count bit by bit, and what no frame can have."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.can.bus_load import FD_LENGTHS, Bits, crc15, exact_bits, most_bits, padded_length, unstuffed_bits
from drivers.can.can_frame import Frame

# FIELDBUS.md 2.1: bytes, without stuffing, worst.
TABLE = [(0, 47, 55), (1, 55, 65), (2, 63, 75), (3, 71, 85), (4, 79, 95), (6, 95, 115), (8, 111, 135)]

frames = st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8)).map(lambda made: Frame(*made))


def bits_of(value: int, count: int) -> list[int]:
    return [value >> place & 1 for place in range(count - 1, -1, -1)]


def remainder(bits: list[int]) -> list[int]:
    """CRC-15 as the standard's shift register, one bit after the other."""
    register = 0
    for bit in bits:
        feedback = bit ^ register >> 14 & 1
        register = register << 1 & 0x7FFF
        if feedback:
            register ^= 0x4599
    return bits_of(register, 15)


def sent(bits: list[int]) -> list[int]:
    """The same bits as they go over the wire: after five alike one of the other value."""
    wire: list[int] = []
    for bit in bits:
        wire.append(bit)
        # A run is never longer than five, as the stuffed bit ends it.
        if wire[-5:] == [bit] * 5:
            wire.append(1 - bit)
    return wire


def content(frame: Frame) -> list[int]:
    head = [0, *bits_of(frame.identifier, 11), int(frame.remote), 0, 0, *bits_of(len(frame.data), 4)]
    bits = head + [bit for byte in frame.data for bit in bits_of(byte, 8)]
    return bits + remainder(bits)


@pytest.mark.parametrize(("length", "least", "most"), TABLE)
def test_the_published_table_holds(length: int, least: int, most: int) -> None:
    assert unstuffed_bits(length) == Bits(least)
    assert most_bits(length) == Bits(most)


@given(frames)
def test_a_length_is_that_of_a_count_bit_by_bit(frame: Frame) -> None:
    on_wire = sent(content(frame))
    assert all(on_wire[k : k + 6] not in ([0] * 6, [1] * 6) for k in range(len(on_wire) - 5))
    assert exact_bits(frame) == Bits(len(on_wire) + 13)


@given(frames)
def test_no_frame_is_longer_than_the_worst_or_shorter_than_without_stuffing(frame: Frame) -> None:
    length = len(frame.data)
    assert unstuffed_bits(length).nominal <= exact_bits(frame).nominal <= most_bits(length).nominal


@given(st.binary(min_size=1, max_size=16))
def test_the_checksum_is_that_of_the_shift_register(data: bytes) -> None:
    bits = [bit for byte in data for bit in bits_of(byte, 8)]
    assert bits_of(crc15(int.from_bytes(data, "big"), len(bits)), 15) == remainder(bits)


def test_stuffing_can_be_nearly_as_bad_as_the_formula_says() -> None:
    # Runs of five, then of four alternating, with the stuffed bit as the first of each: 1111 0000 1111 ...
    data = bytes([0x3C, 0x3C, 0x3C, 0x3C, 0x3C, 0x3C, 0x3C, 0x3C])
    assert exact_bits(Frame(0x078, data)).nominal > unstuffed_bits(8).nominal + 14


def test_sync_and_heartbeat_are_as_published() -> None:
    assert exact_bits(Frame(0x080)) == Bits(51)
    beats = [exact_bits(Frame(0x700 + node, b"\x05")).nominal for node in range(1, 8)]
    assert sum(beats) / len(beats) == pytest.approx(58.3, abs=0.05)


def test_remote_extended_and_error_frames_have_lengths_too() -> None:
    assert 47 <= exact_bits(Frame(0x701, remote=True)).nominal <= 55
    assert 67 <= exact_bits(Frame(0x1234567, extended=True)).nominal <= 80
    assert exact_bits(Frame(0x040, bytes(8), error=True)) == Bits(0)


@pytest.mark.parametrize("length", FD_LENGTHS)
def test_can_fd_keeps_its_order(length: int) -> None:
    least, most = unstuffed_bits(length, fd=True), most_bits(length, fd=True)
    assert least.nominal == 30
    # ESI, DLC, data, stuff count, CRC, one fixed stuff bit in front and after every four bits.
    assert least.data == 5 + 8 * length + (4 + 17 + 6 if length <= 16 else 4 + 21 + 7)
    assert most.nominal == 34
    assert most.data - least.data == (20 + 8 * length) // 4 - 4


@given(st.integers(0, 0x7FF), st.binary(max_size=64))
def test_a_length_with_can_fd_lies_between_least_and_most(identifier: int, data: bytes) -> None:
    bits, length = exact_bits(Frame(identifier, data), fd=True), padded_length(len(data))
    least, most = unstuffed_bits(length, fd=True), most_bits(length, fd=True)
    assert least.nominal <= bits.nominal <= most.nominal
    assert least.data <= bits.data <= most.data
    zeros = length - len(data)
    head = [0, *bits_of(identifier, 11), 0, 0, 1, 0, 1]
    tail = [0, *bits_of(FD_LENGTHS.index(length), 4), *(b for byte in data + bytes(zeros) for b in bits_of(byte, 8))]
    bare = [*head, *tail]
    # A run that ends with the data is followed by the fixed stuff bit instead of one of its own.
    wire = sent(bare[:-1]) + bare[-1:]
    assert bits.nominal + bits.data == least.nominal + least.data + len(wire) - len(bare)


@pytest.mark.parametrize(("length", "fd"), [(9, False), (-1, False), (65, True)])
def test_lengths_that_no_frame_has_are_refused(length: int, fd: bool) -> None:
    with pytest.raises(ValueError, match="bytes"):
        unstuffed_bits(length, fd=fd)
    with pytest.raises(ValueError, match="bytes"):
        exact_bits(Frame(1, bytes(max(length, 9 if not fd else 65))), fd=fd)


def test_bits_become_seconds_at_their_own_rate() -> None:
    assert Bits(95).seconds(1_000_000) == pytest.approx(95e-6)
    assert Bits(30, 40).seconds(500_000, 2_000_000) == pytest.approx(60e-6 + 20e-6)
