"""A quick stop that is followed by closing, as every fault of a run is: the drives brake, they do not let go."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.emulated_arms import Tapped, tapped, weightless_config

from drivers.arm import StopKind
from drivers.can.bus_state import BusError
from drivers.can.can_frame import Frame
from drivers.canopen.driver import CanopenArm
from ident_service.config.arm import ArmConfig
from ident_service.errors import DriverError
from sim_backend.canopen_device.drive import CanopenDrive, PowerState
from sim_backend.emulator.faults import parse_fault
from sim_backend.emulator.lock_step import LockStepArm
from sim_backend.emulator.motor import Power
from sim_backend.machine import Truth

PUSH = np.array([5.0, 2.0])
CYCLES = 50


def speeds(kind: StopKind) -> tuple[np.ndarray, np.ndarray]:
    """Of the arm when it is stopped in full motion, and at the last SYNC of the driver that closes at once."""
    config = weightless_config()
    behind = LockStepArm(config)
    truths: list[Truth] = []
    behind.emulator.observer = truths.append
    with CanopenArm(config, lambda _: [behind.link(0)]) as arm:
        arm.enable()
        for _ in range(CYCLES):
            arm.exchange(PUSH)
        arm.stop(kind)
        moving = truths[-1].velocity
    return moving, truths[-1].velocity


def test_a_quick_stop_is_not_cut_short_by_closing() -> None:
    moving, after = speeds(StopKind.QUICK_STOP)
    assert (np.abs(moving) > 0.1).all()
    assert (np.abs(after) < 0.7 * np.abs(moving)).all()


def test_a_quick_stop_that_was_lost_is_sent_again() -> None:
    config = weightless_config()
    behind = LockStepArm(config)
    truths: list[Truth] = []
    behind.emulator.observer = truths.append
    taps = tapped(behind, config)
    with CanopenArm(config, lambda _: taps) as arm:
        arm.enable()
        for _ in range(CYCLES):
            arm.exchange(PUSH)
        moving, send = truths[-1].velocity, taps[0].send
        taps[0].send = lambda frame: None  # type: ignore[method-assign]
        arm.stop(StopKind.QUICK_STOP)
        taps[0].send = send  # type: ignore[method-assign]
    assert (np.abs(truths[-1].velocity) < 0.7 * np.abs(moving)).all()


def test_a_torque_off_that_one_drive_did_not_hear_is_sent_again() -> None:
    config = weightless_config(torque_deadline=1.0)
    behind = LockStepArm(config)
    taps = tapped(behind, config)
    with CanopenArm(config, lambda _: taps) as arm:
        arm.enable()
        arm.exchange(PUSH)
        taps[0].loses = lambda frame: frame.identifier == 0x302
        arm.stop(StopKind.TORQUE_OFF)
        taps[0].loses = lambda frame: False
    assert held(behind) == [PowerState.SWITCH_ON_DISABLED] * 2


def test_without_torque_the_arm_coasts() -> None:
    moving, after = speeds(StopKind.TORQUE_OFF)
    np.testing.assert_allclose(after, moving, rtol=0.05)


@pytest.mark.parametrize("kind", list(StopKind))
def test_an_arm_that_was_stopped_and_closed_is_enabled_again(kind: StopKind) -> None:
    config = weightless_config()
    behind = LockStepArm(config)
    for _ in range(2):
        with CanopenArm(config, lambda _: [behind.link(0)]) as arm:
            arm.enable()
            np.testing.assert_array_equal(arm.exchange(np.zeros(2)).torque, 0.0)
            arm.stop(kind)


@pytest.mark.parametrize("full", [0.005, 0.14, 0.5])
@pytest.mark.parametrize("kind", list(StopKind))
def test_a_transmit_queue_that_is_full_for_a_moment_loses_no_stop(kind: StopKind, full: float) -> None:
    """For 5 ms, within the tries of a stop, and for longer than these, so that closing goes on with them."""
    config = weightless_config(torque_deadline=1.0)  # the drives' own watchdog does not help
    behind = LockStepArm(config)
    taps = tapped(behind, config)
    tap = taps[0]
    with CanopenArm(config, lambda _: taps) as arm:
        arm.enable()
        arm.exchange(PUSH)
        tap.sent.clear()
        tap.full_until_ns = arm.clock.now_ns() + round(full * 1e9)
        with pytest.raises(DriverError, match="queue is full"):
            arm.exchange(PUSH)
        arm.stop(kind)
    word = bytes([0x02 if kind is StopKind.QUICK_STOP else 0x00, 0, 10])
    told = [tap.sent.index(Frame(0x300 + node, word)) for node in (1, 2)]
    torques = [number for number, frame in enumerate(tap.sent) if frame.identifier == 0x201]
    assert max(told) < min(torques)  # zero torque alone lets an arm without brakes fall
    assert all(tap.sent[number].data == bytes(4) for number in torques)
    assert not [state for state in behind.emulator.states if "enabled" in state]


def test_a_bus_that_never_recovers_does_not_keep_the_other_from_its_stop() -> None:
    config = weightless_config(
        buses=[{"interface": "lock_step", "channel": channel} for channel in ("one", "two")],
        drives=[
            {"node": 1, "bus": bus, "counts": 65536, "rated_torque": 1.0, "max_speed": 6000.0, "max_torque": 5.0}
            for bus in (0, 1)
        ],
    )
    behind = LockStepArm(config)
    taps = tapped(behind, config)
    with CanopenArm(config, lambda _: taps) as arm:
        arm.enable()
        arm.exchange(PUSH)

        def gone(frame: Frame) -> None:
            raise BusError("gone", "one")

        taps[0].send = gone  # type: ignore[method-assign]
        begun = arm.clock.now_ns()
        arm.stop(StopKind.QUICK_STOP)
        assert Frame(0x301, bytes([0x02, 0, 10])) in taps[1].sent
        assert 0.05e9 <= arm.clock.now_ns() - begun <= 0.1e9


def test_drives_that_stay_in_quick_stop_keep_their_watchdogs() -> None:
    """605Ah = 6: powered after the host has gone, so that nobody may have told them to miss nobody."""
    config = weightless_config(reactions={"quick_stop": 6})
    behind = LockStepArm(config)
    with CanopenArm(config, lambda _: [behind.link(0)]) as arm:
        arm.enable()
        arm.exchange(PUSH)
        arm.stop(StopKind.QUICK_STOP)
    for face in behind.emulator.faces:
        assert isinstance(face, CanopenDrive)
        assert face.power.state is PowerState.QUICK_STOP_ACTIVE
        assert face.objects.number(0x6007) == 3
        assert face.objects.number(0x1016, 1) != 0
    with CanopenArm(config, lambda _: [behind.link(0)]) as arm:  # and they can be had again
        arm.enable()
        arm.stop(StopKind.TORQUE_OFF)
    assert [face.objects.number(0x6007) for face in behind.emulator.faces if isinstance(face, CanopenDrive)] == [0, 0]


def held(behind: LockStepArm) -> list[PowerState]:
    return [face.power.state for face in behind.emulator.faces if isinstance(face, CanopenDrive)]


def in_quick_stop() -> tuple[ArmConfig, LockStepArm]:
    """Drives whose host has left them holding the arm."""
    config = weightless_config(reactions={"quick_stop": 6})
    behind = LockStepArm(config)
    with CanopenArm(config, lambda _: [behind.link(0)]) as arm:
        arm.enable()
        arm.exchange(PUSH)
        arm.stop(StopKind.QUICK_STOP)
    assert held(behind) == [PowerState.QUICK_STOP_ACTIVE] * 2
    return config, behind


def words(tap: Tapped) -> list[int]:
    return [frame.data[0] for frame in tap.sent if 0x300 < frame.identifier < 0x380]


def test_drives_that_hold_the_arm_are_enabled_without_letting_it_go() -> None:
    config, behind = in_quick_stop()
    (tap,) = taps = tapped(behind, config)
    powers = set()
    with CanopenArm(config, lambda _: taps) as arm:
        behind.emulator.observer = lambda truth: powers.update(motor.power for motor in behind.emulator.body.motors)
        arm.enable()
        assert words(tap) == [0x0F, 0x0F]
        assert powers == {Power.HELD, Power.TORQUE}
        np.testing.assert_allclose(arm.exchange(PUSH).torque, PUSH, atol=1e-3)
        arm.stop(StopKind.QUICK_STOP)


def test_who_only_opens_and_closes_leaves_them_holding_it() -> None:
    config, behind = in_quick_stop()
    with CanopenArm(config, lambda _: [behind.link(0)]) as arm:
        for _ in range(5):
            arm.exchange(None)
    assert held(behind) == [PowerState.QUICK_STOP_ACTIVE] * 2
    with CanopenArm(config, lambda _: [behind.link(0)]) as arm:
        arm.stop(StopKind.TORQUE_OFF)  # a person lets it go
    assert held(behind) == [PowerState.SWITCH_ON_DISABLED] * 2


def test_a_drive_with_a_fault_does_not_make_the_others_let_go() -> None:
    config, behind = in_quick_stop()
    behind.inject(parse_fault("drive_fault joint=slide", ("turn", "slide")))
    with CanopenArm(config, lambda _: [behind.link(0)]) as arm, pytest.raises(DriverError, match="drive 2"):
        arm.enable()
    assert held(behind) == [PowerState.QUICK_STOP_ACTIVE, PowerState.FAULT]


@pytest.mark.parametrize(("after_stop", "stays"), [("brake", False), ("hold", True), ("lower", True)])
def test_drives_of_arms_without_brakes_stay_in_quick_stop(after_stop: str, stays: bool) -> None:
    document = weightless_config().model_dump(mode="json", by_alias=True)
    document["control"]["after_stop"] = after_stop
    config = ArmConfig.model_validate(document)
    behind = LockStepArm(config)
    with CanopenArm(config, lambda _: [behind.link(0)]) as arm:
        arm.enable()
        arm.stop(StopKind.QUICK_STOP)
    assert held(behind) == [PowerState.QUICK_STOP_ACTIVE if stays else PowerState.SWITCH_ON_DISABLED] * 2
