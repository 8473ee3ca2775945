"""Frames as bytes: the kernel's structures, the wire's packets. Round trips, known vectors, and noise."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from link_bench import frames

from drivers.can.can_frame import (
    MAX_PACKET_BYTES,
    Frame,
    check_sendable,
    from_kernel,
    pack_frames,
    to_kernel,
    unpack_frames,
)
from ident_service.errors import DriverError
from sim_backend.can_bus import packets


@given(frames(errors=True))
def test_a_classic_frame_survives_the_kernels_structure(frame: Frame) -> None:
    data = to_kernel(frame)
    assert len(data) == 16
    assert from_kernel(data) == frame


@given(frames(fd=True))
def test_a_data_frame_of_fd_survives_too_and_a_remote_one_stays_classic(frame: Frame) -> None:
    data = to_kernel(frame, fd=True)
    assert len(data) == (16 if frame.remote else 72)
    assert from_kernel(data) == frame._replace(fd=not frame.remote)


def test_the_structure_is_that_of_linux_can_h() -> None:
    assert to_kernel(Frame(0x201, b"\x01\x02\x03")) == struct.pack("=IB3x", 0x201, 3) + b"\x01\x02\x03\0\0\0\0\0"
    assert to_kernel(Frame(0x1234567, extended=True))[:4] == struct.pack("=I", 0x81234567)
    assert to_kernel(Frame(0x701, remote=True))[:4] == struct.pack("=I", 0x40000701)
    assert to_kernel(Frame(0x201, b"\x07"), fd=True)[:8] == struct.pack("=IBBxx", 0x201, 1, 1)  # CANFD_BRS
    bus_off = struct.pack("=IB3x8s", 0x20000040, 8, bytes(8))
    assert from_kernel(bus_off, 7) == Frame(0x40, bytes(8), error=True, stamp_ns=7)


@given(st.binary(max_size=80))
def test_noise_from_a_socket_is_a_frame_or_one_error(data: bytes) -> None:
    try:
        frame = from_kernel(data)
    except DriverError:
        assert len(data) not in (16, 72) or data[4] > len(data) - 8
    else:
        assert len(frame.data) <= 64


@pytest.mark.parametrize(
    ("frame", "fd", "complaint"),
    [
        (Frame(0x800), False, "800h does not fit 11 bits"),
        (Frame(-1), False, "does not fit 11 bits"),
        (Frame(0x2000_0000, extended=True), False, "does not fit 29 bits"),
        (Frame(0x201, bytes(9)), False, "at most 8 bytes, not 9"),
        (Frame(0x201, bytes(9)), True, "a CAN FD frame cannot have 9"),
        (Frame(0x201, bytes(65)), True, "cannot have 65"),
        (Frame(0x201, b"\0", remote=True), False, "a remote frame has no data"),
        (Frame(0x40, bytes(8), error=True), False, "the controller's, not ours"),
    ],
)
def test_a_frame_that_cannot_exist_is_refused(frame: Frame, fd: bool, complaint: str) -> None:
    with pytest.raises(DriverError, match=complaint):
        check_sendable(frame, fd=fd)


@given(frames(fd=True))
def test_every_frame_that_exists_may_be_sent(frame: Frame) -> None:
    check_sendable(frame, fd=True)


@given(st.lists(st.tuples(frames(fd=True, errors=True), st.booleans()), min_size=1, max_size=64), st.integers(0, 2**62))
def test_frames_survive_a_packet(drawn: list[tuple[Frame, bool]], stamp: int) -> None:
    stamped = [(frame._replace(stamp_ns=stamp + k), own) for k, (frame, own) in enumerate(drawn)]
    data = pack_frames(stamped)
    assert len(data) <= MAX_PACKET_BYTES
    assert unpack_frames(data) == stamped


@given(st.lists(frames(fd=True), min_size=1, max_size=5), st.data())
def test_a_torn_packet_is_one_error_or_the_frames_before_the_tear(drawn: list[Frame], choice: st.DataObject) -> None:
    data = pack_frames([(frame, False) for frame in drawn])
    cut = choice.draw(st.integers(0, len(data) - 1))
    try:
        found = [frame for frame, _ in unpack_frames(data[:cut])]
    except DriverError:
        return
    assert found == drawn[: len(found)]
    assert len(found) < len(drawn)


@given(st.binary(max_size=300))
def test_noise_is_frames_that_exist_or_one_error(data: bytes) -> None:
    try:
        found = unpack_frames(data)
    except DriverError:
        return
    for frame, _ in found:
        if not frame.error:
            check_sendable(frame, fd=True)


@pytest.mark.slow
@given(
    st.text(max_size=20),
    st.booleans(),
    st.lists(st.tuples(st.integers(0, 0x7FF), st.integers(0, 0x7FF)), max_size=16),
    st.booleans(),
)
def test_a_greeting_survives(label: str, own: bool, filters: list[tuple[int, int]], fd: bool) -> None:
    found = packets.unpack_hello(packets.pack_hello(packets.Hello(label, own, tuple(filters), fd)))
    assert (found.own, found.filters, found.fd) == (own, tuple(filters), fd)
    assert label.rstrip("\0").startswith(found.label)


@given(st.binary(max_size=100))
def test_noise_is_no_greeting(data: bytes) -> None:
    with pytest.raises(DriverError):
        packets.unpack_hello(data)
    with pytest.raises(DriverError):
        packets.unpack_welcome(data)


@pytest.mark.parametrize("welcome", [packets.Welcome(), packets.Welcome(packets.CROWDED, 1_000_000, True, 5_000_000)])
def test_an_answer_survives(welcome: packets.Welcome) -> None:
    assert packets.unpack_welcome(packets.pack_welcome(welcome)) == welcome


def test_another_version_is_distinguished_from_noise() -> None:
    data = bytearray(packets.pack_hello(packets.Hello("x")))
    data[4] = 99
    with pytest.raises(DriverError, match="version 99"):
        packets.unpack_hello(bytes(data))
