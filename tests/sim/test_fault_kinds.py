"""What each kind of fault does to samples, and to the plant: every kind of the table has its test here or beside."""

from __future__ import annotations

import numpy as np
import pytest
from sim_arms import arm_config

from drivers.arm import StopKind
from drivers.axis_status import AxisStatus
from ident_service.config.simulation import FAULT_RULES
from ident_service.errors import DriverError
from sim_backend.arm import from_config
from sim_backend.faults import Fault, FaultKind
from sim_backend.machine import RAMP

MS = 1e-3
AT = 5
CYCLES = 40
IDLE = AxisStatus.IDLE
# Two sliders of 1 kg each at right angles; neither moves the other, nothing weighs, nothing rubs.
ROWS = {"x": {"type": "prismatic", "alpha": np.pi / 2}, "y": {"type": "prismatic"}}
TRUTH = {"m1": 1.0, "m2": 1.0} | {f"L{axis}{link}": 0.1 for axis in ("xx", "yy", "zz") for link in (1, 2)}
JOINTS = {"x": {"torque": 10.0, "velocity": 2.0}, "y": {"torque": 5.0, "velocity": 1.0}}


def sliders(*, brakes=False, **driver):
    joints = {name: {**joint, "brake": brakes} for name, joint in JOINTS.items()}
    return arm_config(ROWS, TRUTH, gravity=(0.0, 0.0, 0.0), joints=joints, **driver)


def run(*faults, cycles=CYCLES, torque=(2.0, 1.0), **driver):
    """Samples and truths of a push with a constant torque."""
    truths = []
    arm = from_config(sliders(**driver), faults=faults, observer=truths.append)
    arm.open()
    arm.enable()
    return [arm.exchange(np.array(torque)) for _ in range(cycles)], truths, arm


def column(items, name, joint=1):
    return np.array([np.asarray(getattr(item, name))[joint] for item in items])


@pytest.fixture(scope="module")
def healthy():
    return run()[:2]


def unharmed(truths, healthy):
    """The plant did not notice."""
    for name in ("position", "velocity", "torque"):
        for joint in (0, 1):
            np.testing.assert_array_equal(column(truths, name, joint), column(healthy[1], name, joint))


def test_every_kind_has_a_rule_and_every_rule_a_kind():
    assert set(FAULT_RULES) == set(FaultKind)
    assert all(rule.does for rule in FAULT_RULES.values())


def test_a_healthy_arm_says_that_it_is_powered(healthy):
    assert {sample.status for sample in healthy[0]} == {(AxisStatus.POWERED, AxisStatus.POWERED)}


def test_delayed_feedback_is_old_and_says_so(healthy):
    samples, truths, _ = run(Fault(AT, FaultKind.DELAYED_FEEDBACK, 1, size=3 * MS, duration=10))
    shown, expected = column(samples, "position"), column(healthy[0], "position")
    np.testing.assert_array_equal(shown[AT : AT + 10], expected[AT - 3 : AT + 7])
    np.testing.assert_array_equal(shown[AT + 10 :], expected[AT + 10 :])
    late = np.zeros(CYCLES, dtype=bool)
    late[AT : AT + 10] = True
    np.testing.assert_array_equal(column(samples, "valid"), ~late)
    np.testing.assert_array_equal(column(samples, "age"), 3 * late)
    assert samples[-1].lost == 0
    np.testing.assert_array_equal(column(samples, "position", 0), column(healthy[0], "position", 0))
    unharmed(truths, healthy)


def test_a_hidden_delay_is_old_and_looks_fresh(healthy):
    samples, truths, _ = run(Fault(AT, FaultKind.HIDDEN_DELAY, size=2 * MS))
    for joint in (0, 1):
        shown, expected = column(samples, "position", joint), column(healthy[0], "position", joint)
        np.testing.assert_array_equal(shown[AT:], expected[AT - 2 : -2])
        assert column(samples, "valid", joint).all()
        assert not column(samples, "age", joint).any()
    unharmed(truths, healthy)


def test_a_delay_before_there_was_anything_shows_the_first_position():
    samples, _, _ = run(Fault(0, FaultKind.HIDDEN_DELAY, size=4 * MS), cycles=8)
    positions = column(samples, "position")
    np.testing.assert_array_equal(positions[:5], positions[0])
    assert positions[6] > positions[0]


def test_an_encoder_offset_stays(healthy):
    samples, truths, _ = run(Fault(AT, FaultKind.ENCODER_OFFSET, 1, size=0.25))
    wrong = column(samples, "position") - column(healthy[0], "position")
    np.testing.assert_allclose(wrong, np.where(np.arange(CYCLES) < AT, 0.0, 0.25), atol=1e-15)
    assert column(samples, "valid").all()
    unharmed(truths, healthy)


def test_a_wrong_sign_of_the_position(healthy):
    samples, truths, _ = run(Fault(AT, FaultKind.POSITION_SIGN, 1, duration=4))
    sign = np.where((np.arange(CYCLES) >= AT) & (np.arange(CYCLES) < AT + 4), -1.0, 1.0)
    np.testing.assert_array_equal(column(samples, "position"), sign * column(healthy[0], "position"))
    unharmed(truths, healthy)


def test_a_wrong_sign_of_the_torque_is_the_plants_secret(healthy):
    samples, truths, _ = run(Fault(AT, FaultKind.TORQUE_SIGN, 1))
    np.testing.assert_array_equal(column(samples, "torque"), 1.0)
    np.testing.assert_array_equal(column(truths, "torque"), np.where(np.arange(CYCLES) < AT, 1.0, -1.0))
    np.testing.assert_allclose(np.diff(column(truths, "velocity"))[AT:], -MS, rtol=1e-9)
    np.testing.assert_array_equal(column(truths, "velocity", 0), column(healthy[1], "velocity", 0))


def test_a_saturated_axis_clips_and_says_what_acts():
    samples, truths, _ = run(Fault(AT, FaultKind.TORQUE_SATURATION, size=0.1, duration=5), torque=(2.0, -1.0))
    struck = (np.arange(CYCLES) >= AT) & (np.arange(CYCLES) < AT + 5)
    for items in (samples, truths):
        np.testing.assert_array_equal(column(items, "torque", 0), np.where(struck, 1.0, 2.0))
        np.testing.assert_array_equal(column(items, "torque", 1), np.where(struck, -0.5, -1.0))
    np.testing.assert_allclose(np.diff(column(truths, "velocity", 1)), np.where(struck, -0.5, -1.0)[:-1] * MS)


def test_a_drive_with_a_fault_coasts_until_reset():
    samples, truths, arm = run(Fault(AT, FaultKind.DRIVE_FAULT, 1, duration=5))
    np.testing.assert_array_equal(column(samples, "torque"), np.where(np.arange(CYCLES) < AT, 1.0, 0.0))
    assert [s.status[1] for s in samples] == [AxisStatus.POWERED] * AT + [AxisStatus.FAULT] * (CYCLES - AT)
    assert {s.status[0] for s in samples} == {AxisStatus.POWERED}
    np.testing.assert_array_equal(column(truths, "velocity")[AT:], column(truths, "velocity")[AT])
    with pytest.raises(DriverError, match="y: a fault or an emergency stop is latched"):
        arm.enable()
    arm.reset()
    arm.enable()
    assert arm.exchange(np.ones(2)).status == (AxisStatus.POWERED, AxisStatus.POWERED)


def test_drives_cannot_be_enabled_while_what_broke_them_lasts():
    for kind, words in ((FaultKind.DRIVE_FAULT, "y: its drive"), (FaultKind.NODE_SILENT, "y: it does not answer")):
        arm = run(Fault(AT, kind, 1))[2]
        with pytest.raises(DriverError, match=words):
            arm.enable()
        with pytest.raises(DriverError, match="not enabled"):
            arm.exchange(np.ones(2))
        np.testing.assert_array_equal(arm.exchange(None).torque, 0.0)


def test_a_silent_node_answers_no_more_and_brakes():
    samples, truths, _ = run(Fault(AT, FaultKind.NODE_SILENT, 1), windings_off="shorted")
    np.testing.assert_array_equal(column(samples, "valid"), np.arange(CYCLES) < AT)
    np.testing.assert_array_equal(column(samples, "age")[AT:], np.arange(1, CYCLES - AT + 1))
    np.testing.assert_array_equal(column(samples, "position")[AT:], samples[AT - 1].position[1])
    assert samples[-1].lost == CYCLES - AT
    assert {s.status[1] for s in samples} == {AxisStatus.POWERED}, "nobody hears that it gave up"
    assert [s.status_age for s in samples][AT:] == list(range(1, CYCLES - AT + 1))
    np.testing.assert_array_equal(column(truths, "torque")[AT:], 0.0)
    braked(column(truths, "velocity")[AT:], 2.5)
    assert (np.diff(column(truths, "velocity", 0)) > 0.0).all()


def braked(velocity, damping, mass=1.0):
    """A mass slows down as `m dv = -b v dt` in the plant's (trapezoidal) steps."""
    step = 0.5 * damping / mass * MS
    ratio = (1.0 - step) / (1.0 + step)
    assert velocity[0] > 0.0
    np.testing.assert_allclose(velocity, velocity[0] * ratio ** np.arange(len(velocity)), rtol=1e-9)


def test_an_emergency_stop_takes_all_torque_and_brakes():
    samples, truths, arm = run(Fault(AT, FaultKind.EMERGENCY_STOP, duration=20), windings_off="shorted")
    for joint, mass in ((0, 2.0), (1, 1.0)):  # the first moves both; damping is half of torque limit / velocity limit
        np.testing.assert_array_equal(column(samples, "torque", joint)[AT:], 0.0)
        braked(column(truths, "velocity", joint)[AT:], 2.5, mass)
    assert {s.status for s in samples[AT:]} == {(AxisStatus.EMERGENCY_STOP | IDLE,) * 2}
    arm.stop(StopKind.TORQUE_OFF)
    arm.reset()
    moving = len(truths)
    assert {arm.exchange(None).status for _ in range(20)} == {(IDLE, IDLE)}
    braked(column(truths, "velocity", 1)[moving:], 2.5)  # a reset lets nothing fall
    arm.enable()
    assert arm.exchange(np.ones(2)).torque.tolist() == [1.0, 1.0]
    arm = run(Fault(AT, FaultKind.EMERGENCY_STOP))[2]
    with pytest.raises(DriverError, match="all axes: the emergency stop"):
        arm.enable()


def test_a_load_makes_the_last_link_heavier():
    load = Fault(AT, FaultKind.LOAD_ATTACHED, size=3.0, offset=(0.1, 0.2, 0.3), duration=10)
    samples, truths, _ = run(load, torque=(2.0, 1.0))
    gained = np.diff(column(truths, "velocity"))
    np.testing.assert_allclose(gained[:AT], MS, rtol=1e-9)
    np.testing.assert_allclose(gained[AT : AT + 10], MS / 4.0, rtol=1e-9)
    np.testing.assert_allclose(gained[AT + 10 :], MS, rtol=1e-9)
    assert column(samples, "valid").all()


def test_stamps_jump_and_time_does_not(healthy):
    samples, truths, arm = run(Fault(AT, FaultKind.CLOCK_JUMP, size=0.5, duration=7))
    jump = np.array([s.stamp_ns for s in samples]) - np.array([s.stamp_ns for s in healthy[0]])
    np.testing.assert_array_equal(jump, np.where((np.arange(CYCLES) >= AT) & (np.arange(CYCLES) < AT + 7), 5e8, 0))
    assert [t.stamp_ns for t in truths] == [t.stamp_ns for t in healthy[1]]
    assert arm.clock.now_ns() == truths[-1].stamp_ns
    unharmed(truths, healthy)


def test_faults_add_up():
    offset, sign = Fault(AT, FaultKind.ENCODER_OFFSET, 1, size=1.0), Fault(AT, FaultKind.TORQUE_SIGN, 1)
    samples, truths, _ = run(offset, sign, Fault(AT, FaultKind.TORQUE_SATURATION, 1, size=0.1))
    np.testing.assert_array_equal(column(samples, "torque")[AT:], 0.5)
    np.testing.assert_array_equal(column(truths, "torque")[AT:], -0.5)
    np.testing.assert_allclose(column(samples, "position") - column(truths, "position"), np.arange(CYCLES) >= AT)


def test_enabled_drives_that_hear_no_torque_go_idle_and_stay_so():
    _, _, arm = run(cycles=10, watchdog=0.004)
    samples = [arm.exchange(None) for _ in range(8)]
    # Three periods without a torque let the last one act on; after the fourth millisecond it is over.
    assert [s.torque[0] for s in samples] == [2.0] * 3 + [0.0] * 5
    assert {s.status for s in samples[3:]} == {(AxisStatus.WATCHDOG | IDLE,) * 2}
    speed = arm.plant.velocity.copy()
    late = [arm.exchange(np.array([2.0, 1.0])) for _ in range(5)]
    assert all(not s.torque.any() and s.status[0] & AxisStatus.WATCHDOG for s in late), "latched"
    assert (arm.plant.velocity < speed).all()
    arm.enable()
    assert arm.exchange(np.array([2.0, 1.0])).torque.tolist() == [2.0, 1.0]


def test_on_a_bus_that_is_gone_the_watchdog_runs():
    arm = from_config(sliders(watchdog=0.005), faults=[Fault(AT, FaultKind.BUS_GONE, duration=20)])
    arm.open()
    arm.enable()
    for cycle in range(AT + 20):
        if cycle < AT:
            arm.exchange(np.ones(2))
        else:
            with pytest.raises(DriverError, match="bus"):
                arm.exchange(np.ones(2))
    assert arm.exchange(np.ones(2)).status[0] == AxisStatus.WATCHDOG | IDLE
    # Until its fifth millisecond without a frame the torque acted on: 5 + 4 periods of 1 N.
    assert 0.0 < arm.plant.velocity[1] < 9.5 * MS


def test_a_quick_stop_brakes_and_taking_the_torque_away_does_not():
    for kind, slows in ((StopKind.QUICK_STOP, True), (StopKind.TORQUE_OFF, False)):
        _, _, arm = run()
        arm.stop(kind)
        arm.exchange(None)
        speed = arm.plant.velocity[1]
        words = {arm.exchange(None).status for _ in range(10)}
        assert bool(arm.plant.velocity[1] < speed) is slows
        assert words == {(IDLE if slows else AxisStatus(0),) * 2}


def test_drives_that_leave_their_windings_open_coast_after_the_ramp_of_a_quick_stop():
    _, truths, arm = run()
    arm.stop(StopKind.QUICK_STOP)
    ramp = round(RAMP / MS)
    for _ in range(ramp + 40):
        arm.exchange(None)
    speed = column(truths, "velocity")[CYCLES + 1 :]
    braked(speed[:ramp], 2.5)
    np.testing.assert_allclose(speed[ramp:], speed[ramp], rtol=1e-12)


@pytest.mark.parametrize("kind", [FaultKind.NODE_SILENT, FaultKind.EMERGENCY_STOP, FaultKind.DRIVE_FAULT])
def test_drives_without_power_coast_at_once(kind):
    _, truths, _ = run(Fault(AT, kind))
    speed = column(truths, "velocity")
    np.testing.assert_allclose(speed[AT:], speed[AT], rtol=1e-12)


@pytest.mark.parametrize("kind", [FaultKind.NODE_SILENT, FaultKind.EMERGENCY_STOP, FaultKind.DRIVE_FAULT])
def test_a_brake_closes_whenever_there_is_no_power(kind):
    _, truths, _ = run(Fault(AT, kind), brakes=True)
    assert np.abs(column(truths, "velocity")[AT + 5 :]).max() < 1e-3 * column(truths, "velocity")[AT]


def test_braking_can_be_given():
    _, truths, _ = run(Fault(AT, FaultKind.EMERGENCY_STOP), braking=(7.0, 20.0), windings_off="shorted")
    braked(column(truths, "velocity", 0)[AT:], 7.0, mass=2.0)
    braked(column(truths, "velocity", 1)[AT:], 20.0)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (Fault(0, FaultKind.HIDDEN_DELAY, size=2.0), "longer than 1000 cycles"),
        (Fault(0, FaultKind.TORQUE_SIGN, joint=2), "names no joint"),
    ],
)
def test_faults_that_cannot_be_are_refused(fault, message):
    with pytest.raises(DriverError, match=message):
        from_config(sliders(), faults=[fault])


def test_a_share_of_no_limit_is_refused():
    config = arm_config(ROWS, TRUTH)
    with pytest.raises(DriverError, match="limit"):
        from_config(config, faults=[Fault(0, FaultKind.TORQUE_SATURATION, size=0.5)])
    with pytest.raises(DriverError, match=r"driver\.braking has 3 values"):
        from_config(sliders(braking=(1.0, 1.0, 1.0)))
