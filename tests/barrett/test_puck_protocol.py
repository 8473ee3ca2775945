"""Frames of pucks by the protocol's vectors, properties by firmware, and a decoder that nothing can upset."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.barrett.protocol import (
    Group,
    Pendant,
    Position,
    Properties,
    Reply,
    Request,
    Role,
    address_of,
    decoded,
    get_frame,
    pendant_of,
    pendant_value,
    position_frame,
    reply_frame,
    request_of,
    set_frame,
    torque_frame,
    torques_of,
)
from drivers.can.can_frame import Frame
from ident_service.errors import DriverError

VALUES_22 = st.integers(-(1 << 21), (1 << 21) - 1)
VALUES_14 = st.integers(-8192, 8191)


@pytest.mark.parametrize(
    ("torques", "data"),
    [((1, -1, 8191, -8192), "AA 00 07 FF F7 FF E0 00"), ((100, -200, 300, -400), "AA 01 93 F3 80 4B 3E 70")],
)
def test_torques_are_packed_as_the_vectors_say(torques: tuple[int, ...], data: str) -> None:
    frame = torque_frame(Group.LOWER, 42, torques)
    assert frame == Frame(0x401, bytes.fromhex(data))
    assert torques_of(frame.data) == (42, torques)


@pytest.mark.parametrize(
    ("counts", "data"),
    [(4096, "00 10 00"), (-1, "3F FF FF"), (-123456, "3E 1D C0"), (2097151, "1F FF FF"), (-2097152, "20 00 00")],
)
def test_positions_are_packed_as_the_vectors_say(counts: int, data: str) -> None:
    frame = position_frame(5, counts)
    assert frame == Frame(0x4A3, bytes.fromhex(data))
    assert decoded(frame) == Position(5, counts)
    # The upper two bits of the first byte are no part of it.
    raised = bytes([frame.data[0] | 0xC0, *frame.data[1:]])
    assert decoded(Frame(0x4A3, raised)) == Position(5, counts)


def test_positions_are_requested_by_one_frame_and_answered_by_every_puck() -> None:
    assert get_frame(Group.ARM, Properties(200, Role.MOTOR).number("P"), group=True) == Frame(0x404, b"\x30")
    answered = [position_frame(node, 0).identifier for node in range(1, 8)]
    assert answered == [0x423, 0x443, 0x463, 0x483, 0x4A3, 0x4C3, 0x4E3]


def test_requests_and_replies_have_the_documented_bytes() -> None:
    assert set_frame(10, 8, 1) == Frame(10, bytes([0x88, 0, 1, 0, 0, 0]))
    assert set_frame(3, 48, -36833).data == bytes([0xB0, 0, *(-36833).to_bytes(4, "little", signed=True)])
    assert reply_frame(3, 86, 2700, wide=False) == Frame(0x406 | 3 << 5, bytes([0xD6, 0, 0x8C, 0x0A]))
    assert decoded(reply_frame(3, 86, -2, wide=False)) == Reply(3, 86, -2)
    assert decoded(reply_frame(3, 68, 1 << 20, wide=True)) == Reply(3, 68, 1 << 20)
    assert request_of(bytes([0x88, 0, 2, 0])) == Request(8, 2)  # the short form, which is accepted as well
    with pytest.raises(DriverError, match="32 bits"):
        set_frame(1, 48, 1 << 31)


def test_torques_out_of_range_are_not_sent() -> None:
    for bad in ((8192,), (-8193,), (0, 0, 0, 0, 0)):
        with pytest.raises(DriverError, match="14 bits"):
            torque_frame(Group.UPPER, 42, bad)


# VERS, and the numbers that PUCK_PROTOCOL.md's history gives then.
TABLE = {
    32: {"T": 10, "P": 26, "MT": 16, "CTS": 30, "MECH": 28, "GRPA": 51, "GRPC": 53, "PIDX": 54, "KP": 65, "SAVE": 87},
    33: {"IPNM": 57, "JIDX": 55, "KP": 67, "TSTOP": 66, "ACCEL": 71, "DEF": 91, "EN": 65},
    36: {"IPNM": 108, "JIDX": 107, "KP": 65, "LOAD": 88},
    44: {"HALLS": 109, "HALLH": 110, "POLES": 112, "ECMAX": 113, "ECMIN": 114},
    50: {"T": 9, "V": 10},
    61: {"T": 42, "P": 48, "MT": 43, "CTS": 65, "MECH": 63, "IPNM": 83, "PIDX": 67, "GRPB": 27, "POLES": 87, "EN": 74},
    64: {"CTS": 66, "MECH": 64, "PIDX": 68, "HALLH": 84, "MOFST": 59, "IOFST": 60},
    65: {"CTS": 68, "MECH": 66, "IPNM": 86, "POLES": 90, "PIDX": 70, "HALLS": 89, "HOLD": 94, "TIE": 95, "MOFST": 61},
    68: {"HALLS": 87, "HALLH": 88},
    114: {"V": 106},
    125: {"JP": 96, "ECMAX": 100},
    132: {"EN": 94, "HOLD": 77, "TIE": 100, "ECMAX": 101, "ECMIN": 102},
    200: {"V": 44, "T": 42, "TEMP": 9, "OTEMP": 11, "THERM": 20, "VBUS": 21, "OT": 54, "IOFST": 62, "DEF": 32},
}


@pytest.mark.parametrize("version", TABLE)
def test_numbers_of_motor_properties_follow_the_firmware(version: int) -> None:
    found = Properties(version, Role.MOTOR)
    assert {name: found.number(name) for name in TABLE[version]} == TABLE[version]
    assert all(found.name(number) == name for name, number in TABLE[version].items())
    assert found.number("STAT") == 5
    assert found.number("MODE") == 8


@pytest.mark.parametrize(
    ("version", "numbers"),
    [
        (32, {"ZERO": 55, "PEN": 85, "VL1": 90, "TL2": 93, "IFAULT": 100, "VNOM": 104, "GRPA": 51}),
        (34, {"ZERO": 56, "PEN": 87, "VL1": 92, "TL2": 95, "IFAULT": 102, "VNOM": 106}),
        (40, {"ZERO": 55, "PEN": 85, "MAXPWR": 98, "PWR": 99}),
        (
            200,
            {"ZERO": 42, "PEN": 43, "VL1": 45, "VL2": 46, "TL1": 47, "TL2": 48, "IFAULT": 55, "VNOM": 56, "GRPA": 26},
        ),
    ],
)
def test_numbers_of_the_safety_pucks_properties_follow_the_firmware(version: int, numbers: dict[str, int]) -> None:
    found = Properties(version, Role.SAFETY | 0x0100)
    assert {name: found.number(name) for name in numbers} == numbers
    assert "T" not in found


def test_what_a_firmware_lacks_is_refused_by_name() -> None:
    assert "IPNM" not in Properties(32, Role.MOTOR)
    with pytest.raises(DriverError, match="firmware 32 in role 0 has no property IPNM"):
        Properties(32, Role.MOTOR).number("IPNM")
    with pytest.raises(DriverError, match="older than 32"):
        Properties(31, Role.MOTOR)


@pytest.mark.parametrize("version", range(32, 201))
@pytest.mark.parametrize("role", [Role.MOTOR, Role.SAFETY])
def test_no_number_has_two_names(version: int, role: Role) -> None:
    found = Properties(version, role)
    numbers = [found.number(name) for name in found.names]
    assert len(set(numbers)) == len(numbers)
    assert max(numbers) < 128


def test_the_pendant_is_read_in_words() -> None:
    # E-stop pressed, lights off, display 0, velocity fault, torque warning, the rest safe, e-stop fault.
    shown = pendant_of(0b00 << 26 | 0x3F << 16 | 4 << 12 | 1 << 9 | 1 << 6 | 2 << 3 | 4)
    assert shown == Pendant(("torque",), ("velocity", "e-stop"), "e-stop", False, False, "0")
    assert str(shown) == "velocity fault, e-stop fault, torque warning"
    assert str(pendant_of(pendant_value(Pendant()))) == "no fault"


@given(st.integers(0, (1 << 32) - 1))
def test_any_value_of_the_pendant_is_read(value: int) -> None:
    assert str(pendant_of(value))


@given(st.integers(0, 0x7FF), st.binary(max_size=8), st.booleans(), st.booleans(), st.booleans())
def test_no_frame_upsets_the_decoder(identifier: int, data: bytes, remote: bool, error: bool, extended: bool) -> None:
    found = decoded(Frame(identifier, data, remote, error, extended))
    request_of(data)
    torques_of(data)
    if found is not None:
        assert True not in (remote, error, extended)
        address = address_of(identifier)
        assert address.group
        assert found.node == address.sender != 0
    if isinstance(found, Position):
        assert position_frame(found.node, found.counts, found.encoder).identifier == identifier
        assert -(1 << 21) <= found.counts < 1 << 21


@given(st.integers(1, 31), VALUES_22, st.none() | VALUES_22)
def test_positions_come_back(node: int, counts: int, encoder: int | None) -> None:
    assert decoded(position_frame(node, counts, encoder)) == Position(node, counts, encoder)


@given(st.integers(0, 127), st.lists(VALUES_14, max_size=4))
def test_torques_come_back(number: int, counts: list[int]) -> None:
    found = torques_of(torque_frame(Group.UPPER, number, counts).data)
    assert found == (number, tuple(counts + [0] * (4 - len(counts))))


@given(st.integers(1, 31), st.integers(0, 127), st.integers(-(1 << 31), (1 << 31) - 1))
def test_properties_come_back(node: int, number: int, value: int) -> None:
    assert decoded(reply_frame(node, number, value, wide=True)) == Reply(node, number, value)
    assert request_of(set_frame(node, number, value).data) == Request(number, value)
    assert request_of(get_frame(node, number).data) == Request(number)
