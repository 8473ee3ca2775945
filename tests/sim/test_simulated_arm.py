"""What the simulated arm adds to the contract: delay, noise, seeds, truth, clocks, and where it starts."""

import numpy as np
import pytest
from sim_arms import arm_config, pendulum, slider

from drivers.arm import StopKind
from drivers.clock import VirtualClock
from ident_service.config.arm import Joint
from ident_service.config.load import load_arm
from ident_service.errors import DriverError, ParameterError
from sim_backend.arm import SimulatedArm, from_config
from sim_backend.faults import Fault, FaultKind
from sim_backend.plant import Imperfections

MS = 1_000_000


def free_slider(**driver):
    """1 kg, no weight, no friction, no brake."""
    config = slider(1.0, gravity=(0.0, 0.0, 0.0))
    driver = config.driver.model_copy(update=driver)
    return config.model_copy(update={"driver": driver, "joints": {"s1": Joint(brake=False)}})


def running(config, **options):
    arm = from_config(config, **options)
    arm.open()
    arm.enable()
    return arm


def wam_run(cycles=200):
    truths = []
    arm = running(load_arm("wam7_sim"), observer=truths.append)
    samples = [arm.exchange(np.full(7, 0.5) * np.sin(0.05 * k)) for k in range(cycles)]
    return samples, truths


def test_the_same_seed_gives_the_same_samples_bit_for_bit():
    (first, first_truth), (second, second_truth) = wam_run(), wam_run()
    for a, b in zip(first, second, strict=True):
        assert a.stamp_ns == b.stamp_ns
        assert a.position.tobytes() == b.position.tobytes()
        assert a.torque.tobytes() == b.torque.tobytes()
    assert first_truth[-1].velocity.tobytes() == second_truth[-1].velocity.tobytes()


def test_another_seed_gives_another_motion():
    ends = []
    for seed in (1, 2):
        arm = running(free_slider(torque_noise=1.0, seed=seed))
        for _ in range(10):
            arm.exchange(np.zeros(1))
        ends.append(arm.plant.position[0])
    assert ends[0] != ends[1]


def test_noise_is_white_has_its_size_and_is_not_in_the_sample():
    truths = []
    arm = running(free_slider(torque_noise=0.3), observer=truths.append)
    n = 5_000
    samples = [arm.exchange(np.array([2.0])) for _ in range(n)]
    assert all(sample.torque[0] == 2.0 for sample in samples)
    acted = np.array([truth.acceleration[0] for truth in truths[1:]]) - 2.0
    assert abs(acted.mean()) < 4.0 * 0.3 / np.sqrt(n)
    assert acted.std() == pytest.approx(0.3, rel=4.0 / np.sqrt(2.0 * n))
    assert abs(np.corrcoef(acted[1:], acted[:-1])[0, 1]) < 4.0 / np.sqrt(n)


def test_drives_that_are_off_make_no_noise():
    arm = from_config(free_slider(torque_noise=1.0))
    arm.open()
    for _ in range(10):
        arm.exchange(None)
    assert arm.plant.velocity[0] == 0.0


@pytest.mark.parametrize("delay", [1, 2, 5])
def test_delay_counts_from_the_sample_to_the_first_stamp_its_torque_can_act(delay):
    arm = running(free_slider(delay_cycles=delay))
    torques, velocities = [], []
    for cycle in range(12):
        sample = arm.exchange(np.array([1.0 if cycle == 4 else 0.0]))
        torques.append(sample.torque[0])
        velocities.append(arm.plant.velocity[0])
    acts = 4 + delay - 1
    np.testing.assert_array_equal(np.flatnonzero(torques), [acts])
    assert np.flatnonzero(velocities)[0] == acts + 1


def test_stopping_empties_the_queue():
    arm = running(free_slider(delay_cycles=4))
    for _ in range(3):
        arm.exchange(np.ones(1))
    arm.stop(StopKind.TORQUE_OFF)
    for _ in range(6):
        assert arm.exchange(None).torque[0] == 0.0
    assert arm.plant.velocity[0] == 0.0


def test_the_last_sample_stays_true_when_stopped():
    arm = running(free_slider())
    arm.exchange(np.ones(1))
    arm.stop(StopKind.TORQUE_OFF)
    arm.exchange(None)
    assert arm.plant.velocity[0] == pytest.approx(1e-3)
    arm.exchange(None)
    assert arm.plant.velocity[0] == pytest.approx(1e-3)


def test_a_brake_closes_when_the_torque_is_taken_off():
    free = free_slider()
    arm = running(free.model_copy(update={"joints": {}}))  # nothing is said, so that there is one
    arm.exchange(np.ones(1))
    arm.stop(StopKind.TORQUE_OFF)
    for _ in range(100):
        arm.exchange(None)
    assert abs(arm.plant.velocity[0]) < 1e-9


def test_truth_is_the_plants_at_the_stamp():
    truths = []
    arm = running(free_slider(encoder_resolution=0.1), observer=truths.append)
    for _ in range(50):
        sample = arm.exchange(np.array([3.0]))
        truth = truths[-1]
        assert truth.stamp_ns == sample.stamp_ns
        assert truth.position is arm.plant.position
        assert truth.torque is sample.torque
    assert truths[-1].position[0] == pytest.approx(0.5 * 3.0 * 0.049**2)
    assert truths[-1].velocity[0] == pytest.approx(3.0 * 0.049)
    assert truths[-1].acceleration[0] == pytest.approx(3.0)
    assert sample.position[0] == 0.0


def test_a_late_caller_moves_the_schedule_instead_of_causing_a_burst():
    clock = VirtualClock(start_ns=7)
    arm = running(free_slider(), clock=clock)
    first = arm.exchange(np.ones(1))
    clock.sleep_until_ns(7 + 10 * MS)
    second = arm.exchange(None)
    assert clock.now_ns() == 7 + 10 * MS
    third = arm.exchange(None)
    assert clock.now_ns() == 7 + 11 * MS
    assert [s.stamp_ns - 7 for s in (first, second, third)] == [0, MS, 2 * MS]
    assert arm.plant.velocity[0] == pytest.approx(2e-3)


def test_the_first_stamp_is_when_the_first_cycle_begins():
    clock = VirtualClock()
    arm = running(free_slider(), clock=clock)
    clock.sleep_until_ns(5 * MS)
    assert arm.exchange(None).stamp_ns == 5 * MS
    assert arm.exchange(None).stamp_ns == 6 * MS
    assert clock.now_ns() == 6 * MS


def test_rates_that_are_no_whole_nanoseconds_keep_plant_and_stamps_together():
    config = free_slider()
    config = config.model_copy(update={"control": config.control.model_copy(update={"rate": 300.0})})
    arm = running(config)
    stamps = [arm.exchange(np.ones(1)).stamp_ns for _ in range(301)]
    assert arm.plant.velocity[0] == pytest.approx((stamps[-1] - stamps[0]) * 1e-9, rel=1e-12)
    assert arm.describe().rate == pytest.approx(300.0, rel=1e-6)


def test_starts_at_home_or_at_zero_as_far_as_limits_allow():
    joints = {"a": {"home": 0.7}, "b": {"position": (0.2, 1.0)}, "c": {"position": (-2.0, -0.3)}, "d": {}}
    truth = {f"m{k}": 1.0 for k in range(1, 5)} | {f"Lzz{k}": 1.0 for k in range(1, 5)}
    arm = from_config(arm_config({name: {"a": 0.1, "alpha": 0.5} for name in "abcd"}, truth, joints=joints))
    np.testing.assert_array_equal(arm.plant.position, [0.7, 0.2, -0.3, 0.0])
    assert np.isinf(arm.imperfections.torque_limit).all()


def test_takes_the_prior_for_the_truth_when_nothing_else_is_known():
    wam = load_arm("wam7_sim")
    config = wam.model_copy(update={"driver": wam.driver.model_copy(update={"truth": None})})
    q = np.full(7, 0.3)
    assert from_config(config).plant.inverse_dynamics(q, q, q)[0] != from_config(wam).plant.inverse_dynamics(q, q, q)[0]
    with pytest.raises(DriverError, match="truth"):
        from_config(config.model_copy(update={"prior": None}))


def test_configurations_that_do_not_fit_are_refused():
    with pytest.raises(DriverError, match="simulated"):
        from_config(load_arm("wam7"))
    with pytest.raises(DriverError, match="torque_noise"):
        from_config(free_slider(torque_noise=(1.0, 2.0)))
    with pytest.raises(ParameterError, match="m9"):
        from_config(arm_config({"j1": {}}, {"m9": 1.0}))


def test_pieces_that_do_not_fit_are_refused():
    plant = from_config(pendulum()).plant
    perfect, clock = Imperfections.none(1), VirtualClock()
    with pytest.raises(DriverError, match="joints"):
        SimulatedArm(plant, Imperfections.none(2), clock)
    with pytest.raises(DriverError, match="delay"):
        SimulatedArm(plant, perfect, clock, delay_cycles=0)
    with pytest.raises(DriverError, match="joint"):
        SimulatedArm(plant, perfect, clock, faults=[Fault(0, FaultKind.FROZEN_ENCODER, joint=1)])
    with pytest.raises(DriverError, match="torque_noise"):
        Imperfections(np.zeros(1), np.zeros(1), -np.ones(1), np.ones(1))


def test_a_clip_that_is_no_whole_step_rounds_inwards():
    drives = Imperfections(np.zeros(2), np.array([0.3, 0.0]), np.zeros(2), np.array([1.0, 1.0]))
    np.testing.assert_allclose(drives.quantize_torque(np.array([5.0, -5.0])), [0.9, -1.0])


@pytest.mark.parametrize("time", ["virtual", "real"])
def test_the_driver_says_which_clock(time):
    assert from_config(free_slider(time=time)).clock.lock_step is (time == "virtual")


def test_real_time_runs_on_the_machines_clock():
    arm = running(free_slider(time="real"))
    stamps = []
    for _ in range(5):
        stamps.append(arm.exchange(np.ones(1)).stamp_ns)
        assert arm.clock.now_ns() >= stamps[-1]
    np.testing.assert_array_equal(np.diff(stamps), MS)
    assert arm.plant.velocity[0] == pytest.approx(4e-3)


@pytest.mark.parametrize(("push", "rests"), [(0.0, True), (6.0, False)])
def test_an_arm_without_power_sinks_onto_its_stand_unless_it_has_moved_away(push, rests):
    config = slider(1.0)
    driver = config.driver.model_copy(update={"stand": 0.02, "windings_off": "shorted", "braking": 20.0})
    arm = running(config.model_copy(update={"driver": driver, "joints": {"s1": Joint(brake=False)}}))
    begun = arm.plant.position[0]
    for _ in range(200):
        arm.exchange(np.array([9.81 + push]))
    for _ in range(200):
        arm.exchange(np.array([9.81 - push]))
    away = abs(arm.plant.position[0] - begun)
    assert (away < 0.02) == rests
    arm.stop(StopKind.TORQUE_OFF)
    for _ in range(3000):
        arm.exchange(None)
    assert (abs(arm.plant.velocity[0]) < 2e-3) == rests
    if rests:
        assert 0.02 <= abs(arm.plant.position[0] - begun) < 0.03
