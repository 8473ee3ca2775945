"""`ident emulate` and `ident run` in two processes, by the machine's clock, and either of them killed.

The rate is one that a busy machine keeps; how fast it can be is a benchmark. A run that a stall of the machine ended is
run again.
"""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from canopen_run_bench import (
    STALLS,
    TRIES,
    Said,
    canopen,
    channel,
    checked,
    child,
    described,
    emulated,
    truth,
    wait_for,
    write,
)

from drivers.axis_status import AxisEventCode
from ident_service.cli import main
from ident_service.config.canopen import CanopenDriver
from ident_service.config.load import load_arm
from ident_service.model.arm_model import arm_model
from ident_service.model.base_parameters import base_parameters
from ident_service.motion.arm_factory import make_arm
from ident_service.motion.last_position import FILE, PositionFile
from ident_service.motion.run import keep_host_alive
from ident_service.recordings.open import open_recording
from ident_service.registry.state_folder import arm_fault_store, arm_folder

NAME, RATE, KP, KD = "far", 50.0, 100.0, 16.0
DEADLINE, BRAKING = 0.2, [4.0, 2.0]
STOPPED = "(quick stop active|switch on disabled|fault reaction active|fault)"
NAMES = ("shoulder", "elbow")

pytestmark = [pytest.mark.slow, pytest.mark.realtime, pytest.mark.timeout(600)]


class Bench:
    """An arm's file and state, checked once; its drives are new for each run."""

    def __init__(self, folder: Path, name: str = NAME, rate: float = RATE, **driver: Any) -> None:
        self.folder, self.state, self.name, self.rate = folder, folder / "state", name, rate
        bus = {"interface": "ident_wire", "channel": channel()}
        tree = canopen(described(name, rate, KP, KD), bus, 1, torque_deadline=DEADLINE, **driver)
        tree["driver"]["emulation"]["braking"] = BRAKING  # it sinks to rest in a few seconds
        self.arm = write(folder, tree)
        self.faults = arm_fault_store(self.state, name)
        self._runs = 0
        for _ in range(TRIES):
            with emulated(self.arm):
                if checked(self.arm, name, self.state):
                    return
        raise AssertionError("preflight never passed")

    def started(self) -> tuple[Said, Path]:
        """An `ident run` in the background, and its folder."""
        self._runs += 1
        run = self.folder / f"run{self._runs}"
        return Said("run", self.arm, "--out", run, "--state", self.state), run

    def acknowledge(self) -> None:
        for code in list(self.faults.latched()):
            assert main(["ack", str(self.arm), code, "--state", str(self.state)]) == 0


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    return Bench(tmp_path_factory.mktemp("far"))


@pytest.fixture(autouse=True)
def acknowledged(bench: Bench) -> Iterator[None]:
    yield
    bench.acknowledge()


def moving(bench: Bench, drives: Said) -> tuple[Said, Path]:
    """A run that excites the arm."""
    for _ in range(TRIES):
        run, folder = bench.started()
        try:
            run.says("exciting")
        except AssertionError:
            with run:
                assert any(word in run.text for word in STALLS), run.text
            bench.acknowledge()
            continue
        time.sleep(1.0)
        return run, folder
    raise AssertionError("the machine stalls all the time")


def samples(folder: Path) -> int:
    """That can be read of a run, torn or whole."""
    path = folder / "run.mcap"
    path = path if path.exists() else folder / "run.mcap.partial"
    return sum(len(block.position) for block in open_recording(path, NAMES).blocks())


def completed(bench: Bench) -> Path:
    """The folder of a run that reached its end."""
    for _ in range(TRIES):
        with emulated(bench.arm) as drives:
            run, folder = bench.started()
            with run:
                code = run.code()
            if code == 0:
                drives.says("node 2: pre operational", len(drives.lines) - 4)
                break
        assert any(word in run.text for word in STALLS), run.text
        bench.acknowledge()
    else:
        raise AssertionError("the machine stalls all the time")
    ended = json.loads((folder / "ended.json").read_text())
    assert ended["state"] == "done"
    assert ended["lateness"]["count"] > 9.0 * bench.rate  # the motion lasts 10 s
    stood_where_it_ended(bench, folder)
    return folder


def deviations(bench: Bench, folder: Path, out: Path, torque: str) -> np.ndarray:
    """How many of their deviations the parameters that a run finds are off."""
    assert main(["identify", str(folder / "run.mcap"), "--arm", str(bench.arm), "--out", str(out)]) == 0
    found = json.loads((out / "parameters.json").read_text())
    assert found["torque"] == torque
    document = found["base_parameters"]
    model = arm_model(load_arm(bench.arm))
    base = base_parameters(model.chain, model.layout)
    true = base.K @ np.array([truth().get(name, 0.0) for name in model.layout.names])
    return (np.array(document["values"]) - true) / np.array(document["standard_deviations"])


def test_a_run_against_drives_in_another_process_finds_the_arms_parameters(bench: Bench, tmp_path: Path) -> None:
    z = deviations(bench, completed(bench), tmp_path / "out", "commanded")
    # Coulomb and viscous friction of the shoulder explain each other; each alone is up to 5.4 deviations off.
    assert np.abs(z).max() < 7.0, z


def stood_where_it_ended(bench: Bench, folder: Path) -> None:
    """The position that the motion process kept when it had closed the arm is the last one of its recording."""
    kept = np.array(json.loads((arm_folder(bench.state, bench.name) / FILE).read_text())["position"])
    last = list(open_recording(folder / "run.mcap", NAMES).blocks())[-1].position[-1]
    assert np.abs(kept - last).max() < 0.05


@pytest.mark.campaign
def test_drives_in_another_process_that_are_given_positions_are_checked_and_moved(tmp_path: Path) -> None:
    """Preflight withholds what their watchdogs watch, too; what they measure identifies the arm."""
    bench = Bench(tmp_path, "given_positions", 100.0, streams="position")
    z = deviations(bench, completed(bench), tmp_path / "out", "measured")
    assert np.abs(z).max() < 7.0, z


def test_a_run_is_refused_on_an_arm_whose_motor_stands_a_whole_turn_elsewhere(bench: Bench) -> None:
    config = load_arm(bench.arm)
    assert config.transmission is not None
    coupling, place = np.array(config.transmission.coupling), arm_folder(bench.state, NAME) / FILE
    turn = np.linalg.solve(np.diag(config.transmission.ratios) @ coupling, [2.0 * np.pi, 0.0])
    with emulated(bench.arm):
        PositionFile(place.parent, config).keep(make_arm(config))
        document = json.loads(place.read_text())
        place.write_text(json.dumps(document | {"position": (np.array(document["position"]) + turn).tolist()}))
        run, _ = bench.started()
        with run:
            assert run.code() == 3, run.text
    assert "motor 1 stands 1 whole turn from where it stood" in run.text
    assert place.exists()  # what was refused has not moved
    place.unlink()


def test_drives_stop_by_themselves_when_the_motion_process_is_killed(bench: Bench) -> None:
    with emulated(bench.arm) as drives:
        run, folder = moving(bench, drives)
        with run:
            pid = child(run.process.pid, "motion.process")
            assert pid is not None
            before = len(drives.lines)
            os.kill(pid, signal.SIGKILL)
            for node in (1, 2):
                drives.says(rf"node {node}: operational, {STOPPED}, error 0x8250", before)
            for node in (1, 2):  # and without our heartbeat they leave the network's operational state
                drives.says(rf"node {node}: pre operational, {STOPPED}, error 0x8130", before)
            drives.says("the arm is at rest", before)
            assert run.code() == 4
    assert "motion_process" in bench.faults.latched()
    assert samples(folder) > 0


def test_the_guard_stops_a_run_whose_drives_vanish(bench: Bench) -> None:
    with emulated(bench.arm) as drives:
        run, folder = moving(bench, drives)
        with run:
            os.kill(drives.process.pid, signal.SIGKILL)
            assert run.code() == 4
            assert "ident: " in run.text
    latched = wait_for(bench.faults.latched, "no fault was latched")
    assert set(latched) <= {"driver", "bus_silent", "feedback_gone"}
    assert samples(folder) > 0
    with emulated(bench.arm):  # drives that are there again do not clear it
        again, _ = bench.started()
        with again:
            assert again.code() == 3
            assert "acknowledge" in again.text


def test_a_person_may_think_longer_than_drives_wait_for_their_host(bench: Bench) -> None:
    config = load_arm(bench.arm)
    assert isinstance(config.driver, CanopenDriver)
    with emulated(bench.arm), make_arm(config) as arm:
        with keep_host_alive(arm):
            time.sleep(3.0 * config.driver.heartbeats.timeout)
        sample = arm.exchange(None)
        told = {event.code for event in sample.events}
        assert not told & {AxisEventCode.DRIVE_LEFT, AxisEventCode.EMERGENCY_MESSAGE}
        assert arm.exchange(None).valid.all() or arm.exchange(None).valid.all()
        time.sleep(3.0 * config.driver.heartbeats.timeout)  # alone, they say that they miss us
        told = {event.code for _ in range(20) for event in arm.exchange(None).events}
        assert AxisEventCode.EMERGENCY_MESSAGE in told
