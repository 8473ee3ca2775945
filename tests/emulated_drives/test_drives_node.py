"""States of the network, heartbeats, emergencies, and the SDO server of an emulated node (CiA 301)."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from drives_bench import HOST, MS, Host, drives_config
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.can.can_frame import Frame
from drivers.can.can_link import open_links


def beat(host: Host) -> None:
    host.send(0x700 + HOST, b"\x05")


def test_nodes_say_once_that_they_have_booted(tmp_path: Path) -> None:
    (link,) = open_links(drives_config(tmp_path))
    frames = []
    while (frame := link.receive(500 * MS)) is not None:
        frames.append((frame.identifier, frame.data))
    assert frames == [(0x701, b"\0"), (0x702, b"\0")]


@pytest.mark.parametrize(
    ("command", "state", "reboots"),
    [(0x01, 0x05, False), (0x02, 0x04, False), (0x80, 0x7F, False), (0x81, 0x7F, True), (0x82, 0x7F, True)],
)
def test_network_commands(host: Host, command: int, state: int, reboots: bool) -> None:
    host.listen(10)
    assert host.write(1, 0x1017, 0, "H", 30) == 0
    assert host.write(1, 0x6072, 0, "H", 77) == 0
    host.listen(1)
    host.send(0x000, bytes([command, 1]))
    beats = [f.data[0] for f in host.listen(100) if f.identifier == 0x701]
    if reboots:
        # A reset forgets the heartbeat, as every object from 1000h on; the whole node forgets the drive's, too.
        assert beats == [0]
        assert host.read(1, 0x1017, 0, "H") == 0
        assert host.read(1, 0x6072, 0, "H") == (1000 if command == 0x81 else 77)
    else:
        assert set(beats) == {state}
        assert len(beats) == 3


def test_commands_for_others_and_of_wrong_length_do_nothing(host: Host) -> None:
    for data in (b"\x01\x02", b"\x01", b"", b"\x01\x01\x00", b"\x55\x01"):
        host.send(0x000, data)
    assert host.arm.emulator.states[0] == "pre operational, switch on disabled"


def test_a_stopped_node_does_not_serve(host: Host) -> None:
    host.send(0x000, b"\x02\x00")
    host.listen(10)
    host.send(0x601, struct.pack("<BHB4x", 0x40, 0x1000, 0))
    assert host.listen(10) == []


def test_a_lost_heartbeat_is_reported_acted_on_and_forgiven(enabled: Host) -> None:
    for node in (1, 2):
        assert enabled.write(node, 0x1016, 1, "I", HOST << 16 | 50) == 0
    # Awaiting begins with the first one heard; what does not move has nothing to stop.
    for _ in range(100):
        enabled.cycle(20, 20)
    assert enabled.emergencies() == []
    beat(enabled)
    begun = enabled.now
    while not enabled.emergencies():
        enabled.cycle(20, 20)
    assert enabled.emergencies()[0] == (1, 0x8130)
    assert 50 * MS <= enabled.now - begun <= 52 * MS
    assert enabled.arm.emulator.states[1].startswith("pre operational, quick stop active, error 0x8130")
    enabled.listen(500)
    assert enabled.arm.emulator.states[0] == "pre operational, switch on disabled, error 0x8130"
    enabled.heard.clear()
    beat(enabled)
    enabled.heard += enabled.listen(5)
    assert enabled.emergencies() == [(1, 0), (2, 0)]


def test_error_register_history_and_their_end(host: Host) -> None:
    host.send(0x080, b"\x01")
    assert host.read(1, 0x1001, 0, "B") == 0x11
    assert [host.read(1, 0x1003, k, "I") for k in (0, 1)] == [1, 0x8240]
    assert host.write(1, 0x1003, 0, "B", 1) == 0x06090030
    assert host.write(1, 0x1003, 0, "B", 0) == 0
    assert [host.read(1, 0x1003, k, "I") for k in (0, 1)] == [0, 0]


def test_emergencies_keep_their_inhibit_time(host: Host) -> None:
    assert host.write(1, 0x1015, 0, "H", 200) == 0  # 20 ms
    host.configure()
    host.listen(5)
    begun = host.now
    host.send(0x080, b"\x01")
    host.send(0x201, b"\x01")
    frames = [f for f in host.listen(100) if f.identifier == 0x081]
    assert [struct.unpack_from("<H", f.data)[0] for f in frames] == [0x8240, 0x8210]
    assert frames[0].stamp_ns - begun < 2 * MS
    assert 20 * MS <= frames[1].stamp_ns - begun < 22 * MS


def test_identity_is_what_the_configuration_expects(tmp_path: Path) -> None:
    drives = [
        {
            "node": n,
            "rated_torque": 1.0,
            "max_torque": 30.0,
            "max_speed": 6000.0,
            "identity": {"vendor": 7, "serial": n},
        }
        for n in (3, 9)
    ]
    (link,) = open_links(drives_config(tmp_path, drives=drives))
    host = Host(link, (3, 9))
    assert [host.read(n, 0x1018, k, "I") for n in (3, 9) for k in (1, 2, 4)] == [7, 1, 3, 7, 1, 9]


def test_segments_and_their_toggle(host: Host) -> None:
    first = host.ask(1, struct.pack("<BHB4x", 0x40, 0x1008, 0))
    assert first[0] == 0x41
    size, text, toggle = struct.unpack_from("<I", first, 4)[0], b"", 0
    while True:
        answer = host.ask(1, bytes([0x60 | toggle]) + bytes(7))
        assert answer[0] & 0x10 == toggle
        text += answer[1 : 8 - (answer[0] >> 1 & 7)]
        toggle ^= 0x10
        if answer[0] & 1:
            break
    assert text == b"Emulated torque drive"
    assert size == len(text)
    host.ask(1, struct.pack("<BHB4x", 0x40, 0x1008, 0))
    assert host.ask(1, bytes([0x70]) + bytes(7))[4:] == struct.pack("<I", 0x05030000)


def test_block_transfers_and_stray_segments_are_refused(host: Host) -> None:
    for request in (bytes([0xA0, 0, 0x10, 0]) + bytes(4), bytes([0x60]) + bytes(7), bytes(8)):
        assert host.ask(1, request)[4:] == struct.pack("<I", 0x05040001)


def test_a_segmented_download_of_the_wrong_length_changes_nothing(host: Host) -> None:
    two_bytes = bytes([0x01 | 5 << 1, 9, 0]) + bytes(5)
    for announced, code in ((3, 0x06070013), (1, 0x06070012)):
        assert host.ask(1, struct.pack("<BHBI", 0x21, 0x6072, 0, announced))[0] == 0x60
        assert host.ask(1, two_bytes)[4:] == struct.pack("<I", code)
    assert host.ask(1, struct.pack("<BHBI", 0x21, 0x6072, 0, 1 << 30))[4:] == struct.pack("<I", 0x06070012)
    assert host.read(1, 0x6072, 0, "H") == 1000
    host.ask(1, struct.pack("<BHBI", 0x21, 0x6072, 0, 2))
    assert host.ask(1, two_bytes)[0] == 0x20
    assert host.read(1, 0x6072, 0, "H") == 9


frames = st.builds(
    Frame,
    st.integers(0, 0x7FF).filter(lambda i: i != 0),
    st.binary(max_size=8),
    remote=st.booleans(),
    error=st.booleans(),
    extended=st.booleans(),
)


@pytest.mark.slow
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(
    st.lists(
        frames | st.builds(Frame, st.sampled_from([0x601, 0x602, 0x201, 0x80]), st.binary(max_size=8)), max_size=20
    )
)
def test_no_frame_breaks_a_node(enabled: Host, sent: list[Frame]) -> None:
    """Whatever comes, every node answers afterwards."""
    for frame in sent:
        enabled.link.send(frame)
    enabled.listen(10)  # what they still had to say
    for node in enabled.nodes:
        assert enabled.read(node, 0x1000, 0, "I") == 0x00020192


@pytest.mark.slow
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(st.lists(frames, max_size=20))
def test_no_frame_for_others_moves_a_motor(enabled: Host, sent: list[Frame]) -> None:
    enabled.cycle(70, -30)
    meant = {0x080, 0x201, 0x301, 0x302, 0x601, 0x602}
    for frame in sent:
        if frame.identifier not in meant or frame.error or frame.remote or frame.extended:
            enabled.link.send(frame)
    assert [motor.torque for motor in enabled.arm.emulator.body.motors] == pytest.approx([0.07, -0.03])
    enabled.listen(10)
    enabled.send(0x000, b"\x81\x00")
    enabled.listen(30)
    enabled.configure()
    enabled.enable()
