"""Process data of an emulated node: mapping, dummies, lengths, deadlines, inhibit and event times (CiA 301, 7.5.2)."""

from __future__ import annotations

import struct

import pytest
from drives_bench import MS, Host

from drivers.can.can_frame import Frame
from sim_backend.emulator.faults import Sent

WRONG_STATE, WRONG_VALUE = 0x08000022, 0x06090030


def test_a_shared_frame_gives_each_drive_its_own_torque_at_the_sync(enabled: Host) -> None:
    enabled.torques(111, -222)
    assert [enabled.read(node, 0x6071, 0, "h") for node in (1, 2)] == [0, 0]
    enabled.send(0x080)
    assert [enabled.read(node, 0x6071, 0, "h") for node in (1, 2)] == [111, -222]
    assert [enabled.read(node, 0x6077, 0, "h") for node in (1, 2)] == [111, -222]


def test_a_host_that_waits_has_the_answers_to_a_sync_before_torques_act(enabled: Host) -> None:
    emulator, order = enabled.arm.emulator, list[tuple[int, list[float]]]()
    enabled.torques(111, -222)
    torques = [motor.torque for motor in emulator.body.motors]

    def answer(sent: list[Sent]) -> None:
        order.extend((item.frame.identifier, [motor.torque for motor in emulator.body.motors]) for item in sent)

    rest = emulator.receive(0, Frame(0x080), enabled.now, answer=answer)
    assert order == [(0x181, torques), (0x182, torques)]
    assert [item.frame.identifier for item in rest] == [0x281, 0x282]  # the torque that acts now
    assert [motor.torque != before for motor, before in zip(emulator.body.motors, torques, strict=True)] == [True, True]


@pytest.mark.parametrize(("data", "code", "acts"), [(b"\x01\x00", 0x8210, False), (b"\x05\0\x06\0\0\0", 0x8220, True)])
def test_lengths_of_torque_frames(enabled: Host, data: bytes, code: int, acts: bool) -> None:
    enabled.send(0x201, data)
    enabled.cycle()
    assert enabled.emergencies() == [(1, code), (2, code)]
    assert [enabled.read(node, 0x6077, 0, "h") for node in (1, 2)] == ([5, 6] if acts else [0, 0])
    assert all(word & 0x0080 for word in enabled.statuswords())  # a warning
    enabled.heard.clear()
    enabled.cycle(1, 1)
    assert enabled.emergencies() == [(1, 0), (2, 0)]
    assert not any(word & 0x0080 for word in enabled.statuswords())


def test_the_deadline_of_torque_frames_counts_from_the_last_good_one(enabled: Host) -> None:
    for _ in range(5):
        enabled.cycle(100, 100)
    last = enabled.now - MS
    enabled.send(0x201, b"\x01")  # too short: does not count
    frames = enabled.listen(60)
    late = [f for f in frames if f.identifier in (0x81, 0x82) and f.data[:2] == b"\x50\x82"]
    assert [f.identifier for f in late] == [0x81, 0x82]
    assert 10 * MS <= late[0].stamp_ns - last <= 11 * MS
    # In quick stop active, or past it already: each drive has its own ramp.
    assert {word & 0x6F for word in enabled.statuswords()} <= {0x07, 0x40}
    assert [enabled.read(node, 0x6077, 0, "h") for node in (1, 2)] == [0, 0]


@pytest.mark.parametrize(("option", "state"), [(0, 0x27), (1, 0x0F), (2, 0x40), (3, 0x07)])
def test_what_a_missed_deadline_does_is_the_hosts_choice(host: Host, option: int, state: int) -> None:
    host.configure(deadline=10)
    for node in host.nodes:
        assert host.write(node, 0x6007, 0, "h", option) == 0
        assert host.write(node, 0x6085, 0, "I", 1000) == 0  # a slow ramp, to be seen
    host.enable()
    for _ in range(50):
        host.cycle(300, 100)
    host.listen(10.1)
    assert [word & 0x6F for word in host.statuswords()] == [state] * 2


def test_positions_come_at_every_sync_while_operational(host: Host) -> None:
    assert host.cycle() == {}
    host.configure()
    assert set(host.cycle()) == {1, 2}
    host.send(0x000, b"\x80\x00")
    assert host.cycle() == {}


@pytest.mark.parametrize(("kind", "syncs"), [(1, 6), (2, 3), (3, 2), (0, 1)])
def test_every_so_many_syncs(host: Host, kind: int, syncs: int) -> None:
    host.map_pdo(1, 0x1800, 0x181, kind, [0x60640020])
    host.send(0x000, b"\x01\x01")
    heard = sum(1 in host.cycle() for _ in range(6))
    assert heard == syncs


def test_status_on_change_keeps_its_inhibit_time_and_repeats(host: Host) -> None:
    host.map_pdo(1, 0x1801, 0x281, 255, [0x60410010], inhibit=100, deadline=25)  # 10 ms, 25 ms
    host.send(0x000, b"\x01\x01")
    begun = host.now
    host.send(0x201, struct.pack("<H", 0x06))  # after power-up 201h is its controlword
    frames = [f for f in host.listen(70) if f.identifier == 0x281]
    times = [(f.stamp_ns - begun) // MS for f in frames]
    words = [struct.unpack("<H", f.data)[0] & 0x6F for f in frames]
    assert words == [0x40, 0x21, 0x21, 0x21]
    assert times == [0, 10, 35, 60]


def test_rules_of_parameters(host: Host) -> None:
    assert host.write(1, 0x1400, 1, "I", 0x202) == WRONG_STATE  # exists, with another identifier
    assert host.write(1, 0x1600, 0, "B", 0) == WRONG_STATE
    assert host.write(1, 0x1400, 1, "I", 1 << 31 | 0x201) == 0
    assert host.write(1, 0x1600, 1, "I", 0x60710010) == WRONG_STATE  # has entries
    assert host.write(1, 0x1600, 0, "B", 0) == 0
    assert host.write(1, 0x1600, 1, "I", 0x60710010) == 0
    for entry, code in (
        (0x60710020, 0x06040041),  # another length
        (0x60410010, 0x06040041),  # a host cannot set it
        (0x60720010, 0),
        (0x12340010, 0x06020000),
        (0x00030020, 0x06020000),  # no dummy of this length
        (0x00030010, 0),
    ):
        assert host.write(1, 0x1600, 2, "I", entry) == 0
        assert host.write(1, 0x1600, 0, "B", 2) == code, hex(entry)
        assert host.write(1, 0x1600, 0, "B", 0) == 0
    for subindex in range(1, 6):
        assert host.write(1, 0x1600, subindex, "I", 0x60710010) == 0
    assert host.write(1, 0x1600, 0, "B", 5) == 0x06040042
    assert host.write(1, 0x1600, 0, "B", 9) == 0x06090031
    for identifier in (0x000, 0x07F, 0x080, 0x101, 0x180, 0x581, 0x601, 0x6E0, 0x701, 1 << 29 | 0x201, 0x1201):
        assert host.write(1, 0x1400, 1, "I", identifier) == WRONG_VALUE, hex(identifier)
    assert host.write(1, 0x1400, 2, "B", 241) == WRONG_VALUE
    assert host.write(1, 0x1800, 2, "B", 252) == WRONG_VALUE
    assert host.write(1, 0x1019, 0, "B", 10) == 0x06090031


def test_what_waits_for_a_sync_is_dropped_when_the_node_leaves_operational(enabled: Host) -> None:
    enabled.torques(500, 500)
    enabled.send(0x000, b"\x80\x00")
    enabled.send(0x000, b"\x01\x00")
    enabled.cycle()
    assert [enabled.read(node, 0x6071, 0, "h") for node in (1, 2)] == [0, 0]
