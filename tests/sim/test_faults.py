"""Each injectable fault does what its name says, where and while it lasts, and leaves the truth alone."""

import numpy as np
import pytest
from sim_arms import random_arm

from drivers.arm import StopKind
from drivers.clock import VirtualClock
from ident_service.errors import DriverError
from sim_backend.arm import from_config
from sim_backend.faults import Fault, FaultKind

CYCLES = 8
TORQUES = [np.array([1.0, 70.0, -1.0, 0.5]) * (1 + k) for k in range(CYCLES)]


def run(*faults, clock=None):
    arm = from_config(random_arm(4), clock, faults=faults)
    arm.open()
    arm.enable()
    return [arm.exchange(torque) for torque in TORQUES], arm


@pytest.fixture(scope="module")
def healthy():
    return run()[0]


def shown(samples, joint=1):
    return np.array([sample.position[joint] for sample in samples])


def test_lost_feedback_ages_and_repeats(healthy):
    samples, _ = run(Fault(3, FaultKind.LOST_FEEDBACK, joint=1, duration=2))
    assert [bool(s.valid[1]) for s in samples] == [True, True, True, False, False, True, True, True]
    assert [int(s.age[1]) for s in samples] == [0, 0, 0, 1, 2, 0, 0, 0]
    assert [s.lost for s in samples] == [0, 0, 0, 1, 2, 2, 2, 2]
    np.testing.assert_array_equal(shown(samples)[3:5], shown(healthy)[2])
    np.testing.assert_array_equal(shown(samples)[5:], shown(healthy)[5:])
    np.testing.assert_array_equal(shown(samples, 0), shown(healthy, 0))
    assert all(s.valid[[0, 2, 3]].all() for s in samples)


def test_an_axis_that_never_answered_shows_nothing():
    samples, _ = run(Fault(0, FaultKind.LOST_FEEDBACK))
    assert np.isnan(samples[0].position).all()
    assert not samples[0].valid.any()
    assert samples[0].lost == 4
    assert samples[1].valid.all()


def test_encoder_jump(healthy):
    samples, _ = run(Fault(3, FaultKind.ENCODER_JUMP, joint=1, duration=2, size=0.25))
    np.testing.assert_allclose(shown(samples) - shown(healthy), [0, 0, 0, 0.25, 0.25, 0, 0, 0])
    assert all(s.valid.all() for s in samples)


def test_frozen_encoder_looks_fresh(healthy):
    samples, _ = run(Fault(3, FaultKind.FROZEN_ENCODER, joint=1, duration=3))
    np.testing.assert_array_equal(shown(samples)[3:6], shown(healthy)[2])
    np.testing.assert_array_equal(shown(samples)[6:], shown(healthy)[6:])
    assert all(s.valid.all() and not s.age.any() for s in samples)


def test_nan_position():
    samples, _ = run(Fault(3, FaultKind.NAN_POSITION, joint=1))
    np.testing.assert_array_equal(np.isnan(shown(samples)), np.arange(CYCLES) == 3)
    assert samples[3].valid.all()


def test_stuck_torque_acts_and_the_sample_says_what_acts(healthy):
    samples, arm = run(Fault(3, FaultKind.STUCK_TORQUE, joint=1, duration=2))
    acted = np.array([s.torque[1] for s in samples])
    np.testing.assert_array_equal(acted[:6], [70.0, 140.0, 210.0, 210.0, 210.0, 420.0])
    np.testing.assert_array_equal([s.torque[0] for s in samples], [t[0] for t in TORQUES])
    assert shown(samples)[-1] != shown(healthy)[-1]
    assert arm.exchange(None).cycle == CYCLES


def test_bus_gone_uses_up_the_cycle_and_sends_nothing():
    arm = from_config(random_arm(4), faults=[Fault(2, FaultKind.BUS_GONE, duration=2)])
    arm.open()
    arm.enable()
    before = [arm.exchange(torque) for torque in TORQUES[:2]][-1]
    for _ in range(2):
        with pytest.raises(DriverError, match="bus"):
            arm.exchange(TORQUES[5])
    arm.stop(StopKind.TORQUE_OFF)
    after = arm.exchange(None)
    assert after.cycle == 4
    assert after.stamp_ns == before.stamp_ns + 3_000_000
    np.testing.assert_array_equal(after.torque, 0.0)
    assert not np.array_equal(after.position, before.position)


def test_late_cycle_shows_on_the_clock_only(healthy):
    clock = VirtualClock()
    arm = from_config(random_arm(4), clock, faults=[Fault(3, FaultKind.LATE_CYCLE, size=0.005)])
    arm.open()
    arm.enable()
    returned, samples = [], []
    for torque in TORQUES:
        samples.append(arm.exchange(torque))
        returned.append(clock.now_ns() // 1_000_000)
    assert returned == [0, 1, 2, 8, 8, 9, 10, 11]
    np.testing.assert_array_equal(np.diff([s.stamp_ns for s in samples]), 1_000_000)
    np.testing.assert_array_equal(shown(samples), shown(healthy))


def test_all_axes_at_once():
    samples, _ = run(Fault(3, FaultKind.LOST_FEEDBACK), Fault(3, FaultKind.STUCK_TORQUE))
    assert not samples[3].valid.any()
    np.testing.assert_array_equal(samples[3].torque, samples[2].torque)
