"""A quick stop that is followed by closing, as every fault of a run is: the drives brake, they do not let go."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.emulated_arms import tapped, weightless_config

from drivers.arm import StopKind
from drivers.canopen.arm import CanopenArm
from sim_backend.machine import Truth
from sim_backend.pucks.lock_step import LockStepArm

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


def test_a_quick_stop_that_was_lost_is_told_again() -> None:
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
