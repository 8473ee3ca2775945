"""The link in virtual time: order and times on the wire, two buses with one arm, runs that repeat, and its contract."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from drives_bench import MS, Host, drives_config

from drivers.can.can_frame import Frame
from drivers.can.can_link import open_links
from drivers.clock import VirtualClock
from ident_service.errors import DriverError
from sim_backend.emulator.lock_step import hold_emulated_arm

TWO = [{"interface": "lock_step"}, {"interface": "lock_step"}]
SPREAD = [{"node": 1, "bus": bus, "rated_torque": 1.0, "max_torque": 30.0, "max_speed": 6000.0} for bus in range(2)]


def bits(size: int) -> int:
    return 47 + 8 * size


def test_the_answers_to_a_sync_come_in_order_and_take_their_time(enabled: Host) -> None:
    begun = enabled.now
    enabled.torques(0, 0)
    enabled.send(0x080)
    frames = [enabled.link.receive(begun + MS) for _ in range(2)]
    assert [f.identifier for f in frames if f] == [0x181, 0x182]
    # One microsecond a bit: the host's two frames first, which have acted when they were sent.
    expected = 1000 * (bits(4) + bits(0))
    for frame in frames:
        expected += 1000 * bits(4)
        assert frame is not None
        assert frame.stamp_ns - begun == expected
    assert enabled.now == begun + expected
    assert enabled.link.receive(begun + MS) is None
    assert enabled.now == begun + MS


def test_the_lowest_identifier_wins_whoever_was_first(enabled: Host) -> None:
    # An answer of node 2 and an answer of node 1 wait while the host's own frame is on the wire.
    for node in (2, 1):
        enabled.send(0x600 + node, struct.pack("<BHB4x", 0x40, 0x1000, 0))
    enabled.send(0x080)
    order = [f.identifier for f in enabled.listen(2)]
    assert order == [0x181, 0x182, 0x581, 0x582]


def test_a_slower_bus_is_slower(tmp_path: Path) -> None:
    host = Host.on(drives_config(tmp_path, buses=[{"interface": "lock_step", "bitrate": 500_000}]))
    begun = host.now
    host.read(1, 0x1000, 0, "I")
    assert host.now - begun == 2 * 2000 * bits(8)


def test_drain_takes_what_has_come_and_does_not_wait(enabled: Host) -> None:
    enabled.send(0x080)
    assert enabled.link.drain() == []
    enabled.link.clock.sleep_until_ns(enabled.now + MS)
    assert [f.identifier for f in enabled.link.drain()] == [0x181, 0x182]
    assert enabled.link.drain() == []


def test_what_was_due_while_the_clock_was_moved_has_happened_in_its_time(enabled: Host) -> None:
    for _ in range(3):
        enabled.cycle(100, 100)
    last = enabled.now - MS
    enabled.link.clock.sleep_until_ns(enabled.now + 100 * MS)
    late = [f for f in enabled.link.drain() if f.identifier == 0x081]
    assert [f.data[:2] for f in late] == [b"\x50\x82"]
    assert last + 10 * MS < late[0].stamp_ns < last + 11 * MS


def test_the_torque_of_a_cycle_acts_from_its_sync_to_the_next(enabled: Host) -> None:
    truths, random = enabled.truths(), np.random.default_rng(2)
    asked = random.integers(-300, 300, (200, 2))
    for values in asked.tolist():
        enabled.cycle(*values)
    body = enabled.arm.emulator.body
    for values, before, after in zip(asked[3:], truths[3:], truths[4:], strict=False):
        assert after.stamp_ns - before.stamp_ns == MS
        assert before.torque == pytest.approx(body.gears.joint_torque(values * 1e-3), abs=1e-12)
        middle = (before.position + after.position) / 2, (before.velocity + after.velocity) / 2
        needed = body.plant.inverse_dynamics(*middle, after.acceleration)
        assert needed == pytest.approx(before.torque, abs=0.05)
    assert np.abs(asked @ np.eye(2)).max() > 250


def test_positions_are_those_of_the_sync(enabled: Host) -> None:
    truths = enabled.truths()
    gears = enabled.arm.emulator.body.gears
    for _ in range(100):
        shown = enabled.cycle(300, 100)
        expected = gears.motor_position(truths[-1].position) * 4096 / (2 * np.pi)
        assert [shown[1], shown[2]] == np.rint(expected).astype(int).tolist()


def test_runs_repeat_to_the_bit(tmp_path: Path) -> None:
    runs = []
    for _ in range(2):
        host = Host.on(drives_config(tmp_path, emulation={"torque_noise": 0.2, "seed": 4}))
        host.configure(deadline=10)
        host.enable()
        runs.append([(host.cycle(200, -100), host.now) for _ in range(100)])
    assert runs[0] == runs[1]
    other = Host.on(drives_config(tmp_path, emulation={"torque_noise": 0.2, "seed": 5}))
    other.configure(deadline=10)
    other.enable()
    assert [(other.cycle(200, -100), other.now) for _ in range(100)] != runs[0]


def test_two_buses_have_one_arm_and_one_clock(tmp_path: Path) -> None:
    links = open_links(drives_config(tmp_path, buses=TWO, drives=SPREAD))
    hosts = [Host(link, (1,)) for link in links]
    assert hosts[0].arm is hosts[1].arm
    assert links[0].clock is links[1].clock
    for host in hosts:
        host.configure()
    for host in hosts:
        host.enable()
    truths = hosts[0].truths()
    for _ in range(50):
        for host, torque in zip(hosts, (300, 100), strict=True):
            host.torques(torque)
        for host in hosts:
            host.send(0x080)
        heard = [host.listen(1 if host is hosts[0] else 0.0) for host in hosts]
        assert [[f.identifier for f in frames if f.identifier < 0x200] for frames in heard] == [[0x181], [0x181]]
        # On two buses, frames do not wait for each other.
        assert heard[0][0].stamp_ns == heard[1][0].stamp_ns
    assert len(truths) == 50
    assert truths[-1].torque == pytest.approx(hosts[0].arm.emulator.body.gears.joint_torque(np.array([0.3, 0.1])))
    assert np.ptp(np.diff([t.stamp_ns for t in truths])) == 0


def test_each_opening_builds_the_arm_anew_unless_it_stands(tmp_path: Path) -> None:
    config = drives_config(tmp_path)
    first, second = open_links(config)[0], open_links(config)[0]
    assert Host(first).arm is not Host(second).arm
    clock = VirtualClock(5 * MS)
    with hold_emulated_arm(config, clock=clock) as arm:
        link = open_links(config)[0]
        assert Host(link).arm is arm
        assert link.clock is clock
        with pytest.raises(DriverError, match="open already"):
            open_links(config)
        link.close()
        link.close()
        with pytest.raises(DriverError, match="bus 0 is closed"):
            link.send(Frame(0x080))
        assert Host(open_links(config)[0]).arm is arm
        with pytest.raises(DriverError, match="there already"), hold_emulated_arm(config):
            pass
    assert Host(open_links(config)[0]).arm is not arm


def test_interfaces_do_not_mix(tmp_path: Path) -> None:
    buses = [{"interface": "lock_step"}, {"interface": "virtual"}]
    with pytest.raises(DriverError, match="either all buses are 'lock_step' or none"):
        open_links(drives_config(tmp_path, buses=buses, drives=SPREAD))


def test_a_bus_of_another_arm_cannot_be_joined(tmp_path: Path) -> None:
    from sim_backend.emulator.lock_step import from_config

    with pytest.raises(DriverError, match="bus 1 was opened before bus 0"):
        from_config(drives_config(tmp_path, buses=TWO, drives=SPREAD), 1)


def test_a_data_sheet_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    broken = tmp_path / "broken.eds"
    broken.write_text("[DeviceInfo]\n[DummyUsage]\nDummy0003=1\n", encoding="utf-8")
    with pytest.raises(DriverError, match="not an EDS"):
        open_links(drives_config(tmp_path, eds=str(broken)))
