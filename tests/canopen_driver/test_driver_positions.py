"""Drives that are given positions (CSP): where they are held from, how they follow, and what they tell of torque."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.emulated_arms import weightless_config
from helpers.makers import SHEETS, Bench, arm_of

from drivers.arm import StopKind
from drivers.axis_status import AxisStatus
from drivers.canopen.bus_load import budget
from ident_service.config.arm import ArmConfig
from ident_service.errors import DriverError

MS = 1_000_000
DRIVE = {"counts": 65536, "rated_torque": 1.0, "max_torque": 5.0, "max_speed": 6000.0}


def positions_config(**driver: Any) -> ArmConfig:
    """The small weightless arm, whose drives are given positions at 500 Hz."""
    drives = [DRIVE | {"node": number} for number in (1, 2)]
    return weightless_config(drives=drives, **{"streams": "position", "torque_frames": "single"} | driver)


def targets(bench: Bench) -> list[int]:
    return [face.objects.number(0x607A) for face in bench.behind.emulator.faces]  # type: ignore[attr-defined]


def actual(bench: Bench) -> list[int]:
    now_ns = bench.behind.clock.now_ns()
    return [face.motor.encoder(now_ns) for face in bench.behind.emulator.faces]  # type: ignore[attr-defined]


def test_drives_are_held_where_they_are_and_follow_what_they_are_given() -> None:
    bench = Bench(positions_config())
    with bench.arm as arm:
        assert arm.describe().streams_position
        assert [face.objects.number(0x6061) for face in bench.behind.emulator.faces] == [8, 8]  # type: ignore[attr-defined]
        # 2 ms, as 2 x 10^-3 s.
        assert [face.objects.number(0x60C2, 1) for face in bench.behind.emulator.faces] == [2, 2]  # type: ignore[attr-defined]
        arm.enable()
        assert bench.states == ["operation enabled"] * 2
        np.testing.assert_allclose(targets(bench), actual(bench), atol=2)
        start = arm.exchange(None).position
        steps = np.concatenate([np.linspace(0.0, 1.0, 300), np.ones(300)])
        seen = []
        for share in steps:
            sample = arm.exchange_position(start + share * np.array([0.06, -0.04]))
            seen.append(sample.position - start)
            assert sample.valid.all()
        np.testing.assert_allclose(seen[-1], [0.06, -0.04], atol=2e-4)
        # And on the way no farther off than the loop's lag.
        np.testing.assert_allclose(np.array(seen)[100:290, 0], 0.06 * steps[100:290], atol=6e-3)


def test_the_torque_of_a_sample_is_the_one_that_was_measured() -> None:
    bench = Bench(positions_config())
    with bench.arm as arm:
        arm.enable()
        start = arm.exchange(None).position
        torque, truths = [], []
        bench.behind.emulator.observer = lambda truth: truths.append(truth.torque)
        for number in range(200):
            sample = arm.exchange_position(start + 0.02 * (1.0 - np.cos(0.05 * number)) * np.array([1.0, -1.0]))
            assert sample.measured_torque is not None
            np.testing.assert_array_equal(sample.torque, sample.measured_torque)
            assert sample.torque_difference is None
            torque.append(sample.torque)
        assert np.abs(torque).max() > 0.05
        # What was measured at a SYNC acted a moment before.
        assert np.abs(np.array(torque)[50:]).max() == pytest.approx(np.abs(np.array(truths)[50:]).max(), rel=0.1)


def test_positions_are_tracked_until_the_drives_are_enabled_and_held_from_then_on() -> None:
    """Led by hand while the drives are off, the arm must not jump back when they are enabled."""
    bench = Bench(positions_config())
    with bench.arm as arm:
        arm.enable()
        arm.stop(StopKind.TORQUE_OFF)
        for _ in range(20):
            arm.exchange(None)
        assert bench.states == ["switch on disabled"] * 2
        now_ns = bench.behind.clock.now_ns()
        bench.behind.emulator.body.support(now_ns)
        bench.behind.emulator.body.lead(bench.behind.emulator.body.plant.position + np.array([0.3, 0.1]), now_ns)
        for _ in range(3):
            arm.exchange(None)
        np.testing.assert_allclose(targets(bench), actual(bench), atol=2)
        arm.enable()
        before = arm.exchange(None).position
        for _ in range(100):
            sample = arm.exchange_position(before)
        np.testing.assert_allclose(sample.position, before, atol=1e-4)


@pytest.mark.parametrize("scale", [1.0, 1.5, 0.8])
def test_the_drive_alone_can_keep_the_joints_torque_limits_so_they_are_written_to_it(scale: float) -> None:
    """A motor that gives more than it is asked for is asked for less."""
    config = positions_config()
    drives = [drive.model_copy(update={"torque_scale": scale}) for drive in config.driver.drives]
    config = config.model_copy(update={"driver": config.driver.model_copy(update={"drives": tuple(drives)})})
    joints = {name: joint.model_copy(update={"torque": 2.0}) for name, joint in config.joints.items()}
    bench = Bench(config.model_copy(update={"joints": joints}), config)
    with bench.arm:
        reach = np.abs(bench.arm._coordinates.torque_per_count) @ [
            face.objects.number(0x6072)
            for face in bench.behind.emulator.faces  # type: ignore[attr-defined]
        ]
        assert (reach <= 2.0 + 1e-9).all()
        assert (reach > 1.9).any()


def test_a_lost_host_a_stop_and_a_fault_end_it_as_they_end_torque() -> None:
    bench = Bench(positions_config())
    bench.arm.open()
    bench.arm.enable()
    start = bench.arm.exchange(None).position
    for _ in range(20):
        bench.arm.exchange_position(start)
    died = bench.behind.clock.now_ns()
    bench.behind.settle(died + 200 * MS)
    assert "operation enabled" not in bench.states
    bench.arm.close()

    bench = Bench(positions_config())
    with bench.arm as arm:
        arm.enable()
        start = arm.exchange(None).position
        arm.exchange_position(start)
        arm.stop(StopKind.QUICK_STOP)
        for _ in range(80):
            sample = arm.exchange(None)
        assert "operation enabled" not in bench.states
        assert not any(AxisStatus(word) & AxisStatus.POWERED for word in sample.status)
        with pytest.raises(DriverError, match="a position was given, but the arm is not enabled"):
            arm.exchange_position(start)


def test_what_cannot_be_sent_is_not_sent() -> None:
    bench = Bench(positions_config())
    with bench.arm as arm:
        arm.enable()
        start = arm.exchange(None).position
        arm.exchange_position(start)
        before = targets(bench)
        for wrong in (start * np.nan, start[:1]):
            with pytest.raises(DriverError, match="2 finite positions are needed"):
                arm.exchange_position(wrong)
        with pytest.raises(DriverError, match=r"these drives are given positions \(driver.streams\)"):
            arm.exchange(np.zeros(2))
        assert targets(bench) == before
    plain = Bench(weightless_config())
    with plain.arm as arm:
        arm.enable()
        with pytest.raises(DriverError, match=r"these drives are given torques \(driver.streams\)"):
            arm.exchange_position(start)


def test_the_bus_carries_positions_and_torques_of_each_drive() -> None:
    lines = {line.name: line.length for line in budget(positions_config().driver, 500.0).buses[0].lines}  # type: ignore[arg-type]
    assert lines["target positions, one drive each"] == 4
    assert lines["positions"] == 6  # and the torque that the drive measures


@pytest.mark.slow
@pytest.mark.skipif(not SHEETS.is_dir(), reason="the makers' data sheets are not beside this checkout")
@pytest.mark.parametrize("name", ["maxon_epos4_50-5_0170h.eds", "elmo_gold_V002.dcf", "e35.eds"])
def test_makers_drives_with_that_mode_follow_positions(name: str) -> None:
    bench = Bench(arm_of(name, streams="position"))
    with bench.arm as arm:
        arm.enable()
        start = arm.exchange(None).position
        for number in range(600):
            share = 0.5 - 0.5 * np.cos(np.pi * min(number / 400.0, 1.0))
            sample = arm.exchange_position(start + share * np.array([0.05, 0.02]))
        np.testing.assert_allclose(sample.position - start, [0.05, 0.02], atol=1e-3)
        assert sample.measured_torque is not None


@pytest.mark.skipif(not SHEETS.is_dir(), reason="the makers' data sheets are not beside this checkout")
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("maxon_epos4_50-8_0110h.eds", r"6502h: no cyclic synchronous position mode: 6502h is 225h"),
        ("elmo_simpliq.dcf", r"6502h: no cyclic synchronous position mode: 6502h is 6Dh"),
        ("schunk_prl120_0_63.dcf", r"6502h: no cyclic synchronous position mode: 6502h is 43h"),
    ],
)
def test_drives_without_that_mode_are_refused(name: str, words: str) -> None:
    bench = Bench(arm_of(name, streams="position"))
    with pytest.raises(DriverError, match=words):
        bench.arm.open()
    assert bench.downloads() == []
