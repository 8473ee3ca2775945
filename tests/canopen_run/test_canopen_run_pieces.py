"""Pieces of the way between the processes: priority for a while, several wires in one loop, who holds the arm."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from canopen_run_bench import PATIENCE, canopen, channel, described, write

from drivers.can.bus_state import BusError
from drivers.can.can_frame import Frame
from drivers.canopen.driver import CanopenArm
from ident_service.config.load import load_arm
from ident_service.errors import DriverError
from sim_backend.can_bus.link import Connection, WireLink
from sim_backend.can_bus.packets import Hello
from sim_backend.emulator.lock_step import LockStepArm
from sim_backend.emulator.process import Emulated, emulate

IDENTITY = bytes([0x40, 0x00, 0x10, 0, 0, 0, 0, 0])

PUSH = np.array([0.1, 0.1])  # N m, next to nothing, but torque


def behind(folder: Path, *, brakes: bool = True) -> tuple[LockStepArm, CanopenArm]:
    config = load_arm(write(folder, canopen(described("held", 250.0, 225.0, 30.0), {"interface": "lock_step"}, 1)))
    joints = {name: joint.model_copy(update={"brake": brakes}) for name, joint in config.joints.items()}
    config = config.model_copy(update={"joints": joints})
    drives = LockStepArm(config)
    return drives, CanopenArm(config, lambda _: [drives.link(0)])


def test_privileges_of_the_kernel_are_given_back() -> None:
    code = """
import gc, os
from ident_service.motion.realtime import temporary_privileges
def state(): return os.sched_getscheduler(0), os.sched_getaffinity(0), gc.isenabled(), gc.get_freeze_count()
gc.unfreeze()  # what Python 3.12 has frozen itself
before = state()
with temporary_privileges(1) as granted:
    assert not gc.isenabled()
    assert granted.core is None or os.sched_getaffinity(0) == {granted.core}
assert state() == before, (before, state())
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_an_arm_whose_host_leaves_in_order_is_held_where_it_stands(tmp_path: Path) -> None:
    drives, arm = behind(tmp_path)
    body = drives.emulator.body
    with arm:
        arm.enable()
        arm.exchange(PUSH)
        arm.exchange(PUSH)
        assert not body.supported
        for _ in range(20):
            arm.exchange(np.zeros(2))
        assert np.abs(body.plant.velocity).max() > 0.1
    assert body.supported
    stands = body.plant.position
    drives.settle(drives.clock.now_ns() + 2_000_000_000)
    np.testing.assert_array_equal(body.plant.position, stands)
    with arm:  # and is let go when it is given torque again
        arm.enable()
        assert body.supported
        arm.exchange(PUSH)
        arm.exchange(PUSH)
        assert not body.supported


def test_an_arm_without_brakes_whose_host_falls_silent_sinks(tmp_path: Path) -> None:
    drives, arm = behind(tmp_path, brakes=False)
    body = drives.emulator.body
    arm.open()
    arm.enable()
    arm.exchange(PUSH)
    before = body.plant.position
    drives.settle(drives.clock.now_ns() + 2_000_000_000)
    assert all(state.startswith("pre operational") for state in drives.emulator.states)
    assert not any("operation enabled" in state for state in drives.emulator.states)
    assert not body.supported
    assert np.abs(body.plant.position - before).max() > 0.1


def test_the_drives_are_enabled_when_they_can_tell_it_at_once(tmp_path: Path) -> None:
    drives, arm = behind(tmp_path)
    truths: list[np.ndarray] = []
    drives.emulator.observer = lambda truth: truths.append(truth.position)
    with arm:
        arm.enable()
        # A cycle in which the drives were told, and one in which they have told; not the inhibit time of 50 ms.
        moved = [k for k, position in enumerate(truths) if np.abs(position - truths[0]).max() > 0.0]
        assert len(moved) <= 2


@pytest.mark.slow
def test_one_loop_hosts_several_wires(tmp_path: Path) -> None:
    names = [channel() + f"-{k}" for k in range(2)]
    tree = canopen(described("two", 250.0, 225.0, 30.0), {"interface": "ident_wire", "channel": names[0]}, 1)
    tree["driver"]["buses"].append({"interface": "ident_wire", "channel": names[1], "options": {"pace": True}})
    tree["driver"]["drives"][1]["bus"] = 1
    config = load_arm(write(tmp_path, tree))
    done: list[Emulated] = []
    ended = threading.Event()
    thread = threading.Thread(target=lambda: done.append(emulate(config, stop_requested=ended.is_set)))
    thread.start()
    end = time.monotonic() + PATIENCE
    try:
        for node, name in enumerate(names, 1):
            while True:
                try:
                    link = WireLink(Connection(name, Hello("host")))
                    break
                except BusError:
                    assert time.monotonic() < end
                    time.sleep(0.02)
            answered = False
            while not answered:
                assert time.monotonic() < end
                link.send(Frame(0x600 + node, IDENTITY))
                soon = time.monotonic_ns() + 200_000_000
                while not answered and (frame := link.receive(soon)) is not None:
                    answered = frame.identifier == 0x580 + node
            link.close()
    finally:
        ended.set()
        thread.join()
    (result,) = done
    assert result.unsent == 0


@pytest.mark.parametrize("other", ["virtual", "udp_multicast"])
def test_wires_and_other_interfaces_are_not_served_by_one_loop(tmp_path: Path, other: str) -> None:
    tree = canopen(described("mixed", 250.0, 225.0, 30.0), {"interface": "ident_wire", "channel": channel()}, 1)
    tree["driver"]["buses"].append({"interface": other, "channel": "x"})
    tree["driver"]["drives"][1]["bus"] = 1
    with pytest.raises(DriverError, match="either all buses are ident_wire or none"):
        emulate(load_arm(write(tmp_path, tree)))
