"""Killing whoever drives the arm, at any moment: the plant comes to rest by itself and nothing is left behind."""

from __future__ import annotations

import os
import signal
import time

import numpy as np
import pytest
from remote_bench import Client, alive, ended, limits, listening, remote_config, speed_of_held_torque, wait_for

from drivers.arm import StopKind
from ident_service.config.arm import ArmConfig
from ident_service.errors import DriverError
from sim_backend.arm import from_config
from sim_backend.plant_process import PATIENCE, REST_SPEED
from sim_backend.plant_status import PlantState, read_status

WATCHDOG = 0.02


def killed(tmp_path, delay, **driver):
    """As `killed_story`, and the plant came to rest."""
    _, status = killed_story(tmp_path, delay, **driver)
    assert status.state is PlantState.ENDED_AT_REST
    assert status.came_to_rest
    assert (np.abs(status.velocity) <= REST_SPEED).all()
    assert WATCHDOG <= status.silent_time <= PATIENCE


def killed_story(tmp_path, delay, **driver):
    """Kill a client in the middle of a motion; what holds wherever that was, and what the plant said last."""
    path, bus = tmp_path / "status", f"kill-{os.getpid()}-{tmp_path.name}"
    # A machine that stalls may keep the client waiting for its plant; what follows the kill is looked at here.
    config = remote_config(status=str(path), bus=bus, watchdog=WATCHDOG, deadline=10.0, **driver)
    client = Client(config)
    time.sleep(delay)
    running = read_status(path)
    assert running.state is PlantState.SERVING
    assert running.client_pid == client.process.pid
    client.kill()
    status = ended(path)
    assert status.clients == 1
    assert status.silent_time >= WATCHDOG
    # Neither what acts until the watchdog bites nor gravity against the brakes makes the arm too fast.
    speed, torque = limits(config)
    if driver.get("time") == "real":
        # A machine that stalls has had the client command too much, or too late, before it was killed.
        speed = speed + speed_of_held_torque(config, status, WATCHDOG + status.period)
    assert (status.silent_peak_velocity <= speed).all()
    assert (status.peak_torque <= torque).all()
    assert (status.peak_velocity >= status.silent_peak_velocity).all()
    assert (status.peak_torque > 0.0).all()
    assert ((status.lowest <= status.position) & (status.position <= status.highest)).all()
    assert not listening(bus)
    return config, status


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["virtual", "real"])
def test_the_plant_outlives_its_killed_client_until_it_rests(tmp_path, mode):
    killed(tmp_path, 0.1, time=mode)


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "seed"), [("virtual", 0), ("real", 1)])
def test_at_random_times(tmp_path, mode, seed):
    at_a_random_time(tmp_path, mode, seed)


@pytest.mark.campaign
@pytest.mark.parametrize("mode", ["virtual", "real"])
@pytest.mark.parametrize("seed", range(2, 20))
def test_at_many_random_times(tmp_path, mode, seed):
    at_a_random_time(tmp_path, mode, seed)


def at_a_random_time(tmp_path, mode, seed):
    killed(tmp_path, 1.5 * np.random.default_rng(seed).random(), time=mode)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["virtual", pytest.param("real", marks=pytest.mark.campaign)])
def test_the_wam_with_its_client_killed_at_most_creeps(tmp_path, mode):
    # Without brakes a joint near the top of its swing sinks for minutes: j7 does, at a hundredth of its velocity limit.
    config, status = killed_story(tmp_path, 0.5, name="wam7_sim", time=mode)
    assert status.state in (PlantState.ENDED_AT_REST, PlantState.ENDED_MOVING)
    assert (np.abs(status.velocity) <= 0.05 * limits(config)[0]).all()


@pytest.mark.slow
def test_a_client_that_hangs_loses_the_drives_in_real_time(tmp_path):
    path = tmp_path / "status"
    client = Client(remote_config(status=str(path), watchdog=WATCHDOG, time="real"))
    try:
        os.kill(client.process.pid, signal.SIGSTOP)
        assert wait_for(lambda: read_status(path).silent_time > 0.5)
        hung = read_status(path)
        assert hung.state is PlantState.SERVING, "who hangs still has the arm"
        # Nothing but gravity moves it, against the brakes.
        assert (np.abs(hung.velocity) < 2.0).all()
    finally:
        client.kill()
    assert ended(path).pid == hung.pid


def test_a_plant_nobody_moved_ends_at_once(tmp_path):
    path = tmp_path / "status"
    arm = from_config(remote_config(status=str(path)))
    arm.open()
    arm.exchange(None)
    pid = arm.plant_pid
    arm.end_plant()
    assert not alive(pid)
    status = read_status(path)
    assert status.state is PlantState.ENDED_AT_REST
    assert status.silent_time == 0.0
    assert not status.peak_velocity.any()


def test_silence_lasts_as_long_as_the_watchdog_where_the_arm_stands(tmp_path):
    path = tmp_path / "status"
    config = remote_config(status=str(path), watchdog=WATCHDOG)
    # Gravity along the axes, so that nothing moves a joint.
    arm = from_config(ArmConfig.model_validate(config.model_dump() | {"gravity": (0.0, 0.0, -9.81)}))
    arm.open()
    arm.enable()
    arm.exchange(np.zeros(2))
    arm.end_plant()
    status = read_status(path)
    assert status.state is PlantState.ENDED_AT_REST
    assert (status.silent_peak_velocity <= REST_SPEED).all()
    assert WATCHDOG <= status.silent_time <= WATCHDOG + 2 * status.period


def test_an_arm_that_is_forgotten_takes_its_plant_along():
    arm = from_config(remote_config())
    arm.open()
    pid = arm.plant_pid
    arm.close()
    assert alive(pid)
    del arm
    assert not alive(pid)


def swing(arm):
    for _ in range(100):  # an answer may be on its way
        arm.exchange(np.zeros(2))


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["virtual", "real"])
def test_a_killed_plant_is_noticed_within_the_deadline(mode):
    arm = from_config(remote_config(time=mode, deadline=5.0))
    arm.open()
    arm.enable()
    arm.exchange(np.zeros(2))
    os.kill(arm.plant_pid, signal.SIGKILL)
    begin = time.monotonic()
    with pytest.raises(DriverError, match="plant process is gone"):
        swing(arm)
    assert time.monotonic() - begin < 5.0
    with pytest.raises(DriverError, match="gone"):
        arm.exchange(np.zeros(2))
    arm.stop(StopKind.TORQUE_OFF)
    arm.close()
    # Opening again starts another one.
    arm.open()
    assert arm.exchange(None).cycle == 0
    arm.end_plant()


@pytest.mark.slow
def test_a_plant_that_hangs_is_noticed_at_the_deadline():
    arm = from_config(remote_config(deadline=1.0))
    arm.open()
    arm.enable()
    arm.exchange(np.zeros(2))
    os.kill(arm.plant_pid, signal.SIGSTOP)
    try:
        begin = time.monotonic()
        with pytest.raises(DriverError, match="did not answer within 1 s"):
            arm.exchange(np.ones(2))
        assert time.monotonic() - begin >= 1.0
    finally:
        os.kill(arm.plant_pid, signal.SIGCONT)
    # The answer that was given up is passed over, and the cycle it was for is used up.
    after = arm.exchange(np.full(2, 2.0))
    assert after.cycle == 2
    np.testing.assert_allclose(after.torque, 2.0, atol=0.01)
    arm.end_plant()
