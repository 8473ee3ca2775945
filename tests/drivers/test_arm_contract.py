"""What every Arm keeps to, whatever stands behind it; `contract_bench.py` has the backends."""

from __future__ import annotations

import numpy as np
import pytest
from contract_bench import BACKENDS, PERIOD_NS, canopen, pucks, relative_config
from helpers.forks import fork_processes

from drivers.arm import StopKind
from drivers.axis_status import TRIPPED, AxisStatus
from ident_service.errors import DriverError, PositionUnknown

LIMIT = np.array([10.0, 5.0])
NONE = np.zeros(2)
STATUS_CYCLES = 60  # more than a drive may wait with its status report


@pytest.fixture(autouse=True)
def plants_are_forked(monkeypatch):
    """How a plant is started is tests/sim's; a process of its own it is here, too."""
    fork_processes(monkeypatch)


@pytest.fixture(params=sorted(BACKENDS))
def bench(request):
    bench = BACKENDS[request.param]()
    yield bench
    bench.arm.close()


def told(arm):
    """A sample with a status that is no older than what was done last; drives report theirs when they may."""
    for _ in range(STATUS_CYCLES):
        sample = arm.exchange(None)
    return sample


@pytest.fixture(params=sorted(BACKENDS))
def broken(request):
    """An arm whose first drive has had a fault of its own for ten milliseconds; the cause is mended."""
    fault = {"kind": "drive_fault", "joint": "turn", "cycle": 3, "duration": 0.01}
    bench = BACKENDS[request.param](faults=[fault])
    bench.arm.open()
    bench.arm.enable()
    bench.enabled()
    for _ in range(10):
        bench.arm.exchange(np.array([1.0, 1.0]))
    bench.arm.stop(StopKind.QUICK_STOP)
    told(bench.arm)
    yield bench
    bench.arm.close()


@pytest.fixture
def running(bench):
    bench.arm.open()
    bench.arm.enable()
    return bench


def test_opening_twice_is_refused_and_reopening_is_not(bench):
    bench.arm.open()
    with pytest.raises(DriverError):
        bench.arm.open()
    bench.arm.close()
    bench.arm.open()
    assert bench.arm.exchange(None).cycle == 0


def test_a_closed_arm_does_nothing(bench):
    for act in (bench.arm.describe, bench.arm.enable, bench.arm.reset, lambda: bench.arm.exchange(None)):
        with pytest.raises(DriverError):
            act()


@pytest.mark.slow
def test_describes_itself_in_the_shape_of_its_joints(bench):
    with bench.arm as arm:
        says = arm.describe()
    assert says.joint_names == ("turn", "slide")
    assert says.rate == 1e9 / PERIOD_NS
    assert len(says.identities) == 2
    assert says.software
    np.testing.assert_array_equal(says.torque_limit, LIMIT)
    for vector in (says.torque_resolution, says.position_resolution):
        assert vector.shape == (2,)
        assert (vector >= 0.0).all()


def test_samples_have_the_shape_of_the_joints(running):
    for cycle in range(3):
        sample = running.arm.exchange(NONE)
        assert sample.cycle == cycle
        assert sample.position.shape == sample.torque.shape == sample.valid.shape == sample.age.shape == (2,)
        assert sample.velocity is None or sample.velocity.shape == (2,)
        assert sample.valid.all()
        assert not sample.age.any()
        assert sample.lost == 0


def test_stamps_are_exactly_one_period_apart_and_on_the_clock(running):
    stamps = []
    for _ in range(50):
        stamps.append(running.arm.exchange(NONE).stamp_ns)
        assert stamps[-1] <= running.arm.clock.now_ns() < stamps[-1] + PERIOD_NS
    np.testing.assert_array_equal(np.diff(stamps), PERIOD_NS)


def test_a_cycle_that_begins_late_says_so_in_its_stamp_or_stamps_are_those_of_a_schedule(running):
    before = running.arm.exchange(NONE).stamp_ns
    late_ns = running.arm.clock.now_ns() + PERIOD_NS // 4 + PERIOD_NS
    running.arm.clock.sleep_until_ns(late_ns)
    stamp_ns = running.arm.exchange(NONE).stamp_ns
    if running.arm.describe().scheduled_stamps:
        assert (stamp_ns - before) % PERIOD_NS == 0
    else:
        assert late_ns <= stamp_ns <= late_ns + PERIOD_NS


def test_looking_needs_no_enabling_and_moves_nothing(bench):
    with bench.arm as arm:
        first = arm.exchange(None)
        for _ in range(10):
            sample = arm.exchange(None)
        np.testing.assert_array_equal(sample.torque, 0.0)
        np.testing.assert_array_equal(sample.position, first.position)


def test_a_torque_needs_enabling(bench):
    with bench.arm as arm:
        arm.exchange(None)
        with pytest.raises(DriverError):
            arm.exchange(NONE)
        np.testing.assert_array_equal(arm.exchange(None).torque, 0.0)


@pytest.mark.parametrize(
    "bad",
    [np.array([np.nan, 0.0]), np.array([0.0, np.inf]), np.zeros(3), np.zeros((2, 1)), np.float64(1.0)],
    ids=["nan", "inf", "too long", "matrix", "scalar"],
)
def test_a_torque_that_raises_has_not_been_sent(running, bad):
    before = running.arm.exchange(np.array([1.0, 1.0]))
    with pytest.raises(DriverError):
        running.arm.exchange(bad)
    after = running.arm.exchange(None)
    np.testing.assert_array_equal(after.torque, before.torque)
    assert after.cycle == before.cycle + 1
    assert after.stamp_ns == before.stamp_ns + PERIOD_NS


def test_enabling_starts_from_zero_torque(running):
    running.arm.exchange(np.array([1.0, 1.0]))
    running.arm.enable()
    np.testing.assert_array_equal(running.arm.exchange(None).torque, 0.0)


def test_the_torque_of_a_sample_acts_from_its_stamp_to_the_next(running):
    velocity = []
    for cycle in range(6):
        sample = running.arm.exchange(np.array([2.0, -3.0]) if cycle == 3 else NONE)
        np.testing.assert_array_equal(sample.torque, [2.0, -3.0] if cycle == 3 else 0.0)
        velocity.append(running.velocity())
    seconds = PERIOD_NS * 1e-9
    # At stamps 0 to 3 nothing has acted yet; at 4 the pulse has, for exactly one period, and nothing after it.
    np.testing.assert_array_equal(velocity[:4], np.zeros((4, 2)))
    np.testing.assert_allclose(velocity[4], [2.0 * seconds, -3.0 * seconds], rtol=1e-9)
    np.testing.assert_allclose(velocity[5], velocity[4], rtol=1e-9)


def test_positions_are_those_of_the_stamp(running):
    resolution = running.arm.describe().position_resolution
    for _ in range(20):
        sample = running.arm.exchange(np.array([2.0, -3.0]))
        assert (np.abs(sample.position - running.position()) <= 0.5 * resolution + 1e-12).all()


def test_positions_come_in_whole_encoder_steps(running):
    resolution = running.arm.describe().position_resolution
    for _ in range(20):
        steps = running.arm.exchange(np.array([5.0, -5.0])).position / np.where(resolution > 0.0, resolution, 1.0)
        np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_torques_are_clipped_to_what_the_arm_says(running, side):
    limit = running.arm.describe().torque_limit
    np.testing.assert_allclose(running.arm.exchange(side * 100.0 * limit).torque, side * limit, rtol=1e-12)


def test_torques_come_in_whole_steps_and_a_sample_says_so(running):
    resolution = running.arm.describe().torque_resolution
    asked = np.array([1.1, 1.1])
    given = running.arm.exchange(asked).torque
    assert (np.abs(given - asked) <= 0.5 * resolution + 1e-12).all()
    stepped = resolution > 0.0
    steps = given[stepped] / resolution[stepped]
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-9)


def test_samples_stay_what_they_were(running):
    torque = np.array([1.0, 1.0])
    first = running.arm.exchange(torque)
    kept = [np.array(array) for array in (first.position, first.torque, first.valid, first.age)]
    torque[:] = 4.0
    for _ in range(5):
        running.arm.exchange(torque)
    for array, copy in zip((first.position, first.torque, first.valid, first.age), kept, strict=True):
        np.testing.assert_array_equal(array, copy)


@pytest.mark.parametrize("kind", list(StopKind))
def test_stopping_takes_the_torque_and_the_enabling(running, kind):
    running.arm.exchange(np.array([1.0, 1.0]))
    running.arm.stop(kind)
    np.testing.assert_array_equal(running.arm.exchange(None).torque, 0.0)
    with pytest.raises(DriverError):
        running.arm.exchange(NONE)
    running.arm.enable()
    running.arm.exchange(NONE)


@pytest.mark.parametrize("kind", list(StopKind))
def test_stopping_never_raises(bench, kind):
    def stop_twice():
        bench.arm.stop(kind)
        bench.arm.stop(kind)

    stop_twice()
    bench.arm.open()
    stop_twice()
    bench.arm.enable()
    stop_twice()
    bench.arm.enable()
    bench.arm.exchange(np.ones(2))
    stop_twice()
    bench.arm.close()
    stop_twice()


def test_a_drive_that_latched_a_fault_is_not_enabled_before_it_is_reset(broken):
    assert broken.arm.exchange(None).status[0] & AxisStatus.FAULT
    with pytest.raises(DriverError, match="turn"):
        broken.arm.enable()
    with pytest.raises(DriverError):
        broken.arm.exchange(NONE)
    broken.arm.reset()
    assert not any(word & TRIPPED for word in told(broken.arm).status)
    broken.arm.enable()
    np.testing.assert_array_equal(broken.arm.exchange(np.array([1.0, 1.0])).torque, 1.0)


def test_what_is_latched_outlives_closing(broken):
    broken.arm.close()
    broken.arm.open()
    assert broken.arm.exchange(None).status[0] & AxisStatus.FAULT


def test_a_reset_energises_nothing_and_releases_no_brake(broken):
    before = told(broken.arm)
    broken.arm.reset()
    idle = [broken.arm.exchange(None) for _ in range(STATUS_CYCLES)]
    assert not any(sample.torque.any() for sample in idle)
    assert not any(word & AxisStatus.POWERED for sample in idle for word in sample.status)
    # Braked by the quick stop, as before; CiA 402 has no word for it.
    assert [word & AxisStatus.IDLE for word in idle[-1].status] == [word & AxisStatus.IDLE for word in before.status]
    with pytest.raises(DriverError):
        broken.arm.exchange(NONE)


def test_an_arm_that_only_looks_sees_the_same_and_leaves_everything_as_it_is(broken):
    before = told(broken.arm)
    names, position = broken.arm.describe().joint_names, before.position
    broken.arm.close()
    for _ in range(2):
        with broken.arm.look() as looking:
            says = looking.describe()
            samples = [looking.exchange(None) for _ in range(5)]
        assert says.joint_names == names
        assert 0.0 < says.rate <= 1e9 / PERIOD_NS
        np.testing.assert_allclose(np.diff([sample.stamp_ns for sample in samples]), 1e9 / says.rate, rtol=1e-6)
        for sample in samples:
            assert sample.valid.all()
            np.testing.assert_array_equal(sample.torque, 0.0)
            assert sample.status[0] & AxisStatus.FAULT
            assert not any(word & AxisStatus.POWERED for word in sample.status)
        np.testing.assert_allclose(samples[-1].position, samples[0].position, atol=1e-3)
        np.testing.assert_allclose(samples[-1].position, position, atol=0.05)
    broken.arm.open()
    assert broken.arm.exchange(None).status[0] & AxisStatus.FAULT


def test_a_running_arm_is_not_reset(running):
    running.arm.exchange(np.array([1.0, 1.0]))
    with pytest.raises(DriverError):
        running.arm.reset()
    np.testing.assert_array_equal(running.arm.exchange(None).torque, 1.0)


def test_with_nothing_latched_a_reset_changes_nothing(bench):
    with bench.arm as arm:
        before = arm.exchange(None)
        arm.reset()
        arm.reset()
        after = arm.exchange(None)
        np.testing.assert_array_equal(after.position, before.position)
        assert after.status == before.status


def test_closing_is_safe_from_any_state(bench):
    bench.arm.close()
    bench.arm.open()
    bench.arm.enable()
    bench.arm.exchange(np.ones(2))
    bench.arm.close()
    bench.arm.close()
    with pytest.raises(DriverError):
        bench.arm.exchange(None)


def test_leaving_closes_whatever_happened(bench):
    def fail():
        with bench.arm as arm:
            arm.enable()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    with pytest.raises(DriverError):
        bench.arm.exchange(None)
    bench.arm.open()
    with pytest.raises(DriverError):
        bench.arm.exchange(NONE)


def test_what_zeroing_says_does_not_depend_on_the_arm_being_open(bench, request):
    needs_it = request.node.callspec.params["bench"] in ("relative", "pucks", "old pucks")
    if needs_it:
        assert len(bench.arm.zero()) == 2
    else:
        with pytest.raises(DriverError, match=r"zero|absolute"):
            bench.arm.zero()
    with bench.arm as arm:
        before = arm.exchange(None).position
        with pytest.raises(DriverError):
            arm.zero()
        with pytest.raises(DriverError):
            arm.look().zero()
        after = arm.exchange(None)
        np.testing.assert_array_equal(after.position, before)
        np.testing.assert_array_equal(after.torque, 0.0)


@pytest.mark.parametrize("backend", ["relative", "pucks"])
def test_a_position_is_reported_only_by_an_arm_that_knows_it(backend):
    bench = canopen(config=relative_config()) if backend == "relative" else pucks(zeroed=False)
    for act in (bench.arm.open, bench.arm.look().open):
        with pytest.raises(PositionUnknown):
            act()
    bench.arm.zero()
    with bench.arm as arm:
        np.testing.assert_allclose(arm.exchange(None).position, [0.5, 0.1], atol=2e-4)
