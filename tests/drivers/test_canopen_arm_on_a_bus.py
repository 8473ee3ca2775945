"""The CANopen arm over an interface of python-can, with emulated drives behind it, in real time."""

from __future__ import annotations

import threading

from contract_bench import canopen_config

from drivers.axis_status import AxisStatus
from drivers.canopen.driver import CanopenArm
from sim_backend.emulator.process import emulate


def test_drives_are_configured_enabled_and_left_over_a_bus_that_filters_frames() -> None:
    bus = {"interface": "virtual", "channel": "arm-on-a-bus"}
    config = canopen_config(buses=[bus], torque_deadline=30.0, bring_up=30.0, heartbeats={"timeout": 30.0})
    end = threading.Event()
    thread = threading.Thread(target=lambda: emulate(config, stop_requested=end.is_set))
    thread.start()
    try:
        with CanopenArm(config) as arm:
            assert [words.split(":")[0] for words in arm.describe().identities] == ["node 1", "node 2"]
            arm.enable()
            status: tuple[int, ...] = (0, 0)
            for _ in range(100):
                status = arm.exchange(None).status
            assert all(word & AxisStatus.POWERED for word in status)
    finally:
        end.set()
        thread.join()
