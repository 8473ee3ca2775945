"""The plant in its own process: the same samples as in this one, one client at a time, a watchdog of its own."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from itertools import pairwise

import numpy as np
import pytest
from helpers.forks import fork_processes
from remote_bench import listening, remote_config, wait_for

from drivers.arm import StopKind
from drivers.axis_status import AxisStatus
from drivers.clock import RealClock, VirtualClock
from ident_service.config.arm import ArmConfig
from ident_service.config.simulation import FAULT_RULES
from ident_service.errors import DriverError
from ident_service.motion.arm_factory import make_arm
from sim_backend import wire
from sim_backend.arm import SimulatedArm, from_config
from sim_backend.faults import Fault, FaultKind
from sim_backend.plant_status import PlantState
from sim_backend.remote_arm import RemoteArm, connect_to_plant, plant_address

LIMIT = np.array([40.0, 15.0])


def local(config: ArmConfig) -> ArmConfig:
    return config.model_copy(update={"driver": config.driver.model_copy(update={"process": "own"})})


@pytest.fixture(autouse=True)
def plants_are_forked(monkeypatch):
    fork_processes(monkeypatch)


def forgotten(arm):
    """End the plant without waiting for the arm to sink to rest, which `test_plant_killed.py` is about."""
    os.kill(arm.plant_pid, signal.SIGKILL)
    arm.end_plant()


def story(arm, cycles=150, joints=2):
    """Everything an arm brings in some cycles with torques, looks, stops and errors; and the truth."""
    told, truths = [], []
    arm.observer = truths.append
    with arm:
        arm.exchange(None)
        arm.enable()
        for k in range(cycles):
            torque = 5.0 * np.sin(0.05 * k + np.arange(joints))
            try:
                s = arm.exchange(None if k % 17 == 5 else torque)
            except DriverError as error:
                told.append(str(error))
                continue
            arrays = (s.position, s.torque, s.valid, s.age)
            told.append((s.cycle, s.stamp_ns, s.lost, s.status, s.status_age, *(a.tobytes() for a in arrays)))
            assert [(a.dtype, a.shape) for a in arrays] == [(t, (joints,)) for t in (float, float, bool, np.int64)]
            if k == 100:
                arm.stop(StopKind.QUICK_STOP)
                told.append(arm.exchange(None).torque.tobytes())
                try:
                    arm.enable()
                except DriverError as error:
                    told.append(str(error))
                    break
    arm.observer = None
    return told, [
        (t.stamp_ns, *(a.tobytes() for a in (t.position, t.velocity, t.acceleration, t.torque))) for t in truths
    ]


def test_the_configuration_decides_where_the_plant_lives():
    assert isinstance(make_arm(remote_config()), RemoteArm)
    assert isinstance(make_arm(local(remote_config())), SimulatedArm)
    clock = VirtualClock(5)
    assert make_arm(remote_config(time="real"), clock).clock is clock
    assert isinstance(make_arm(remote_config(time="real")).clock, RealClock)


@pytest.mark.parametrize("name", ["planar2", pytest.param("wam7_sim", marks=pytest.mark.slow)])
def test_in_lock_step_samples_are_those_of_a_plant_in_this_process_bit_for_bit(name, monkeypatch):
    monkeypatch.undo()  # started by a new interpreter, as everywhere but here
    config = remote_config(name, delay_cycles=2)
    joints = len(config.joints)
    remote = from_config(config)
    found = story(remote, joints=joints)
    forgotten(remote)
    assert found == story(from_config(local(config)), joints=joints)
    assert len(found[0]) == 151


SIZES = {
    FaultKind.DELAYED_FEEDBACK: 0.004,
    FaultKind.HIDDEN_DELAY: 0.003,
    FaultKind.ENCODER_JUMP: 0.1,
    FaultKind.ENCODER_OFFSET: 0.1,
    FaultKind.TORQUE_SATURATION: 0.05,
    FaultKind.LOAD_ATTACHED: 1.5,
    FaultKind.LATE_CYCLE: 0.005,
    FaultKind.CLOCK_JUMP: -0.5,
}


def the_same_here_and_there(*faults):
    remote = from_config(remote_config(), faults=faults)
    found, ended_at = story(remote), remote.clock.now_ns()
    forgotten(remote)
    here = from_config(local(remote_config()), faults=faults)
    assert found == story(here)
    assert ended_at == here.clock.now_ns()


def fault(kind, at=40):
    joint = 1 if FAULT_RULES[kind].of_joint else None
    offset = (0.0, 0.1, 0.0) if kind is FaultKind.LOAD_ATTACHED else (0.0, 0.0, 0.0)
    return Fault(at, kind, joint, 30, SIZES.get(kind, 0.0), offset)


@pytest.mark.slow
def test_faults_in_turn_are_those_of_a_plant_in_this_process_bit_for_bit():
    last = (FaultKind.NODE_SILENT, FaultKind.DRIVE_FAULT, FaultKind.EMERGENCY_STOP)
    kinds = sorted(FaultKind, key=lambda kind: kind in last)
    the_same_here_and_there(*(fault(kind, 2 + 7 * k) for k, kind in enumerate(kinds)))


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(FaultKind))
def test_each_fault_is_that_of_a_plant_in_this_process_bit_for_bit(kind):
    the_same_here_and_there(fault(kind))


@pytest.mark.slow
def test_faults_from_the_configuration_reach_the_plant():
    config = remote_config(faults=({"kind": "drive_fault", "joint": "elbow", "cycle": 3},))
    arm = from_config(config)
    with arm:
        arm.enable()
        words = [arm.exchange(np.ones(2)).status[1] for _ in range(5)]
    assert words == [AxisStatus.POWERED] * 3 + [AxisStatus.FAULT] * 2
    assert arm.truth.torque[1] == 0.0
    arm.end_plant()


def test_mistakes_are_found_before_anything_starts():
    with pytest.raises(DriverError, match="names no joint"):
        from_config(remote_config(), faults=[Fault(0, FaultKind.TORQUE_SIGN, 9)])
    with pytest.raises(DriverError, match="torque_noise has 3"):
        from_config(remote_config(torque_noise=(1.0, 2.0, 3.0)))
    with pytest.raises(DriverError, match=r"driver\.status"):
        from_config(remote_config(status="/nonexistent/place")).open()


SECOND = """
import sys
from ident_service.config.arm import ArmConfig
from ident_service.errors import DriverError
from sim_backend.arm import from_config
arm = from_config(ArmConfig.model_validate_json(sys.stdin.read()))
try:
    arm.open()
except DriverError as error:
    print(error)
else:
    print("plant", arm.plant_pid)
    arm.close()
"""


def second(config):
    """What another process says that wants the same arm."""
    return subprocess.run(
        [sys.executable, "-c", SECOND], input=config.model_dump_json(), capture_output=True, text=True, check=True
    ).stdout.strip()


@pytest.mark.slow
def test_a_second_client_is_refused_for_as_long_as_the_first_one_has_the_arm():
    config = remote_config(bus=f"test-{os.getpid()}")
    first = from_config(config)
    first.open()
    assert second(config) == f"the arm is in use by pid {os.getpid()}"
    with pytest.raises(DriverError, match=f"in use by pid {os.getpid()}"):
        from_config(config).open()
    assert first.exchange(None).cycle == 0, "the first one does not notice"
    first.close()
    assert second(config) == f"plant {first.plant_pid}", "the plant is still there for the next one"
    first.open()
    other = from_config(config.model_copy(update={"gravity": (0.0, 0.0, -9.81)}))
    first.close()
    with pytest.raises(DriverError, match="another arm"):
        other.open()
    with pytest.raises(DriverError, match="only who has started"):
        other.plant_status()
    first.end_plant()
    assert not listening(config.driver.bus)


def test_the_plant_stays_where_it_was_between_two_clients():
    arm = from_config(remote_config())
    with arm:
        arm.enable()
        for _ in range(200):
            arm.exchange(0.5 * LIMIT)
        there = arm.truth.position
    status = arm.plant_status()
    assert wait_for(lambda: arm.plant_status().came_to_rest)
    with arm:
        sample = arm.exchange(None)
        assert sample.cycle == 0
        assert sample.status == (AxisStatus.IDLE, AxisStatus.IDLE), "silence has made the drives idle"
        np.testing.assert_allclose(sample.position, arm.plant_status().position, atol=1e-4)
        assert not np.allclose(sample.position, there, atol=1e-2), "and the brakes have let it sink"
        assert arm.plant_status().state is PlantState.SERVING
        arm.enable()
        assert arm.exchange(np.zeros(2)).status == (AxisStatus.POWERED, AxisStatus.POWERED)
    assert arm.plant_status().clients == status.clients + 1
    arm.end_plant()


def test_the_watchdog_is_latched_until_the_drives_are_enabled_again():
    arm = from_config(remote_config(watchdog=0.005))
    with arm:
        arm.enable()
        arm.exchange(LIMIT)
        looked = [arm.exchange(None) for _ in range(8)]
        assert [bool(s.torque.any()) for s in looked] == [True] * 4 + [False] * 4
        for _ in range(20):
            sample = arm.exchange(LIMIT)
            assert not sample.torque.any()
            assert sample.status == (AxisStatus.WATCHDOG | AxisStatus.IDLE,) * 2
            assert not arm.truth.torque.any()
        arm.enable()
        np.testing.assert_array_equal(arm.exchange(LIMIT).torque, LIMIT)
    arm.end_plant()


def test_in_lock_step_a_client_may_take_its_time():
    with from_config(remote_config(watchdog=0.001)) as arm:
        arm.enable()
        arm.exchange(LIMIT)
        time.sleep(0.1)
        assert arm.exchange(LIMIT).status[0] == AxisStatus.POWERED
    arm.end_plant()


def test_in_real_time_the_plant_moves_on_without_frames():
    # The watchdog is longer than a machine hesitates as a rule, and far shorter than the wait.
    arm = from_config(remote_config(time="real", watchdog=0.25, torque_noise=0.0, deadline=5.0))
    with arm:
        steps = np.array([10**9])
        while steps.max() >= 200_000_000:  # the machine stood still
            arm.enable()
            samples = [arm.exchange(np.array([20.0, 3.0])) for _ in range(50)]
            steps = np.diff([s.stamp_ns for s in samples])
            assert (steps % 1_000_000 == 0).all()
            assert (steps > 0).all()
        assert all(s.torque.any() for s in samples[1:])
        np.testing.assert_array_equal(np.diff([s.cycle for s in samples]), 1)
        before = time.monotonic_ns()
        time.sleep(0.6)
        late = arm.exchange(np.array([20.0, 3.0]))
        assert late.stamp_ns > before + 500_000_000, (
            "the stamp is when the plant was asked, not when it should have been"
        )
        assert late.cycle == samples[-1].cycle + 1
        assert late.status == (AxisStatus.WATCHDOG | AxisStatus.IDLE,) * 2
        assert not late.torque.any()
        assert not np.allclose(late.position, samples[-1].position, atol=1e-2)
    arm.end_plant()


def test_what_acts_in_real_time_is_what_the_samples_say():
    config = remote_config(time="real", watchdog=1.0, deadline=5.0)
    truths = []
    with from_config(config, observer=truths.append) as arm:
        arm.enable()
        samples = [arm.exchange(np.array([0.3 * (k % 7), -0.1])) for k in range(100)]
    arm.end_plant()
    assert [t.stamp_ns for t in truths] == [s.stamp_ns for s in samples]
    # The same torques for the same periods on a plant in this process lead to the same truth.
    twin = from_config(
        local(config).model_copy(update={"driver": local(config).driver.model_copy(update={"time": "virtual"})})
    )
    with twin:
        twin.enable()
        for one, following in pairwise(samples):
            for _ in range((following.stamp_ns - one.stamp_ns) // 1_000_000):
                twin.exchange(one.torque)
        twin.exchange(samples[-1].torque)
        np.testing.assert_array_equal(twin.plant.position, truths[-1].position)


def stranger(arm):
    sock = connect_to_plant(arm._address)
    assert sock is not None
    sock.settimeout(10.0)
    return sock


@pytest.mark.parametrize(
    "data",
    [b"x", b"IDP\x01", bytes(200), wire.encode(wire.Enable(), 1, 2), wire.encode(wire.Done(), 1, 2)],
    ids=["short", "header", "zeros", "not hello", "reply"],
)
def test_a_stranger_who_makes_no_sense_is_not_spoken_to(remote, data):
    with stranger(remote) as sock:
        sock.send(data)
        assert sock.recv(100) == b""
    assert remote.exchange(None).valid.all()


def test_strangers_who_say_nothing_disturb_nobody(remote):
    socks = [stranger(remote) for _ in range(20)]
    before = remote.exchange(None)
    assert remote.exchange(None).cycle == before.cycle + 1
    for sock in socks:
        sock.close()
    assert remote.exchange(None).cycle == before.cycle + 2


@pytest.fixture(scope="module")
def remote():
    arm = from_config(remote_config(bus=f"strangers-{os.getpid()}"))
    arm.open()
    yield arm
    arm.end_plant()


@pytest.mark.slow
@pytest.mark.parametrize(
    "bad",
    [b"\0", wire.encode(wire.Hello(bytes(32)), 1, 2), wire.encode(wire.Exchange(0, 1, np.array([np.nan, 0.0])), 1, 2)],
    ids=["noise", "hello again", "nan"],
)
def test_a_client_who_stops_making_sense_loses_the_arm(bad):
    arm = from_config(remote_config())
    arm.open()
    arm.enable()
    arm.exchange(LIMIT)
    arm._socket.send(bad)
    with pytest.raises(DriverError, match="gone"):
        arm.exchange(LIMIT)
    assert wait_for(lambda: arm.plant_status().came_to_rest)
    arm.close()
    arm.open()
    assert not arm.exchange(None).torque.any()
    arm.end_plant()


def test_somebody_elses_answers_are_refused(monkeypatch):
    # A listener of this user that is no plant.
    bus = f"liar-{os.getpid()}"
    arm = from_config(remote_config(bus=bus))
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as liar:
        liar.bind("\0" + plant_address(bus))
        liar.listen()
        with connect_to_plant(plant_address(bus)):
            peer, _ = liar.accept()
            peer.close()
        monkeypatch.setattr("sim_backend.remote_arm.START_TIMEOUT", 0.2)
        with pytest.raises(DriverError, match=r"did not answer within 0\.2 s"):
            arm.open()
        with pytest.raises(DriverError, match="not open"):
            arm.exchange(None)
