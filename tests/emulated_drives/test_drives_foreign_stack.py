"""An independent CANopen stack, the npm package `canopen`, reads an emulated drive's EDS, configures and moves it.

Nothing of it is ours or the `canopen` library's of Python. It is installed by `make test-foreign` and nothing else, so
that the test is skipped where it is not.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from drives_bench import EDS, GEARS, drives_config

from sim_backend.emulator.process import emulate

STACK = Path(__file__).parents[1] / "foreign_stack"
CHANNEL = "drives-foreign-stack"
NODE = shutil.which("node")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        NODE is None or not (STACK / "node_modules" / "canopen").is_dir(),
        reason="needs node and its package canopen: `make test-foreign` runs it",
    ),
]


@pytest.fixture
def host() -> Iterator[subprocess.Popen[str]]:
    """The stack in its process, ready to hear the first frame."""
    process = subprocess.Popen(
        [str(NODE), str(STACK / "host.js"), str(EDS)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    yield process
    process.kill()
    process.communicate()


def carried(bus: can.BusABC, process: subprocess.Popen[str], end: threading.Event) -> None:
    """What the bus says, to the stack."""
    assert process.stdin is not None
    while not end.is_set():
        if (heard := bus.recv(0.05)) is None:
            continue
        try:
            process.stdin.write(f"{heard.arbitration_id:x}#{bytes(heard.data).hex()}\n")
            process.stdin.flush()
        except OSError:
            return


def conversation(process: subprocess.Popen[str], bus: can.BusABC) -> dict[str, Any]:
    """What the stack says, to the bus; its last words."""
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith("{"):
            last: dict[str, Any] = json.loads(line)
            return last
        identifier, _, data = line.strip().partition("#")
        bus.send(can.Message(arbitration_id=int(identifier, 16), data=bytes.fromhex(data), is_extended_id=False))
    raise AssertionError(f"the stack died with {process.wait()}")


def test_a_foreign_stack_configures_and_moves_an_emulated_drive(tmp_path: Path, host: subprocess.Popen[str]) -> None:
    assert host.stdout is not None
    assert host.stdout.readline() == "ready\n"
    gears = GEARS | {"offsets": [0.3, -0.2]}
    config = drives_config(tmp_path, gears=gears, buses=[{"interface": "virtual", "channel": CHANNEL}])
    end = threading.Event()
    with can.Bus(interface="virtual", channel=CHANNEL) as bus:
        threads = [
            threading.Thread(target=carried, args=(bus, host, end)),
            threading.Thread(target=lambda: emulate(config, stop_requested=end.is_set)),
        ]
        for thread in threads:
            thread.start()
        try:
            found = conversation(host, bus)
        finally:
            end.set()
            for thread in threads:
                thread.join()
    assert "error" not in found, found["error"]
    assert found["sheet"]["product"] == "Emulated torque drive"
    assert found["sheet"]["maxTorque"] is True
    assert found["identity"] == [0, 1, 0x00010000, 0]
    assert found["type"] & 0xFFFF == 402
    assert found["name"].rstrip("\0") == "Emulated torque drive"
    assert found["status"] & 0x4F == 0x40
    assert found["written"] == 5000
    assert found["refused"] == [0x06020000, 0x06090011, 0x06010002, 0x06070012]
    assert found["mode"] == 10
    # Torque -321 acts from the SYNC after its frame; the second drive has no power, so that the arm is still held.
    assert found["heard"]["torques"] == [0, -321, -321]
    # Motor 1 = 20 (q1 - q1_0 - (q2 - q2_0)/2) = -8 rad with both joints at 0; nobody holds it firmly.
    assert found["position"] == pytest.approx(-8.0 * 4096 / (2.0 * np.pi), abs=50)
    assert found["heard"]["positions"] == pytest.approx([found["position"]] * 3, abs=50)
    assert found["quickStop"] == 0x40
    assert [0x81, 0x8130, 0x11] in found["heard"]["emergencies"]
    assert found["fault"] == 0x08
    assert found["history"] & 0xFFFF == 0x8130
