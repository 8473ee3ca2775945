"""`ident emulate` as people run it: a process of its own, frames over a multicast bus, a host that dies."""

from __future__ import annotations

import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import can
import pytest
import yaml
from drives_bench import GEARS, drives_config

from ident_service.cli import USAGE, main
from sim_backend.emulator.process import Emulated, emulate

PATIENCE = 20.0  # s, for a busy machine


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])


def multicast(port: int) -> dict[str, object]:
    """A bus that does not leave this machine."""
    options = {"port": port, "hop_limit": 0}
    return {"interface": "udp_multicast", "channel": "239.74.163.2", "options": options}


class Master:
    """Just enough of a host to start two drives and to hear them."""

    def __init__(self, bus: can.BusABC) -> None:
        self.bus = bus

    def send(self, identifier: int, data: bytes = b"") -> None:
        self.bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))

    def until(self, wanted: Callable[[can.Message], bool]) -> can.Message:
        end = time.monotonic() + PATIENCE
        while (left := end - time.monotonic()) > 0:
            message = self.bus.recv(left)
            if message is not None and wanted(message):
                return message
        raise AssertionError("what was waited for did not come")

    def write(self, node: int, index: int, subindex: int, data: bytes) -> None:
        self.send(0x600 + node, struct.pack("<BHB4s", 0x23 | (4 - len(data)) << 2, index, subindex, data))
        answer = self.until(lambda m: m.arbitration_id == 0x580 + node)
        assert answer.data[0] == 0x60, answer

    def start(self, node: int) -> None:
        """Enabled, by SDO alone, with a torque deadline of 50 ms on its own torque frame and a quick stop after it."""
        for index, subindex, data in (
            (0x1402, 1, struct.pack("<I", 0x80000400 + node)),
            (0x1602, 0, b"\0"),
            (0x1602, 1, struct.pack("<I", 0x60710010)),
            (0x1602, 0, b"\x01"),
            (0x1402, 5, struct.pack("<H", 50)),
            (0x1402, 1, struct.pack("<I", 0x400 + node)),
            (0x6007, 0, struct.pack("<h", 3)),
            (0x6072, 0, struct.pack("<H", 5000)),
            (0x6060, 0, b"\x0a"),
        ):
            self.write(node, index, subindex, data)
        self.send(0x000, bytes([1, node]))
        for word in (0x06, 0x07, 0x0F):
            self.write(node, 0x6040, 0, struct.pack("<H", word))


def arm_file(folder: Path, port: int) -> Path:
    drives_config(folder)  # the file with the arm; only the bus is another one
    path = folder / "drives.yaml"
    tree = yaml.safe_load(path.read_text(encoding="utf-8"))
    tree["driver"]["buses"] = [multicast(port)]
    tree["driver"]["emulation"] = {
        "braking": [4.0, 2.0],
        "windings_off": "shorted",
    }  # it sinks to rest in a few seconds
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    return path


@pytest.mark.slow
def test_a_process_of_its_own_outlives_its_host_and_stops_the_arm(tmp_path: Path) -> None:
    port = free_port()
    command = [sys.executable, "-m", "ident_service", "emulate", str(arm_file(tmp_path, port)), "--json"]
    command += ["--fault", "warning joint=elbow at=0"]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, bufsize=1
    ) as process:
        assert process.stdin is not None
        assert process.stderr is not None
        said: list[str] = []
        reader = threading.Thread(target=lambda stream: said.extend(stream), args=(process.stderr,), daemon=True)
        reader.start()

        def hears(text: str) -> None:
            end = time.monotonic() + PATIENCE
            while not any(text in line for line in said):
                assert time.monotonic() < end, said
                time.sleep(0.01)

        try:
            hears("shoulder, node 1: pre operational, switch on disabled")
            options = multicast(port)["options"]
            assert isinstance(options, dict)
            with can.Bus(interface="udp_multicast", channel="239.74.163.2", **options) as bus:
                master = Master(bus)
                for node in (1, 2):
                    master.start(node)
                hears("elbow, node 2: operational, operation enabled")
                for _ in range(20):
                    for node in (1, 2):
                        master.send(0x400 + node, struct.pack("<h", 200))
                    time.sleep(0.005)
                hears("the arm moves")
                master.send(0x080)
                hears("faults: warning of elbow")
                # From here on no torque frame comes, as if the host had been killed.
                late = master.until(lambda m: m.arbitration_id == 0x081)
                assert late.data[:2] == b"\x50\x82"
                process.stdin.write("emergency joint=shoulder size=0x7305\nnonsense\nclear\n")
                master.until(lambda m: m.arbitration_id == 0x081 and m.data[:2] == b"\x05\x73")
                hears("not understood: no fault is called 'nonsense'")
                hears("the arm is at rest")
            process.send_signal(signal.SIGINT)
            document = json.loads(process.stdout.read() if process.stdout else "")
            assert process.wait(PATIENCE) == 0
        finally:
            if process.poll() is None:
                process.kill()
        reader.join()
    assert document["exit_code"] == 0
    assert document["at_rest"] is True
    assert document["unsent"] == 0
    assert document["states"][0].startswith("operational, fault, error 0x")


@pytest.mark.slow
def test_two_interfaces_are_served_at_once(tmp_path: Path) -> None:
    names = [f"drives-{os.getpid()}-{k}" for k in range(2)]
    drives = [{"node": 4, "bus": k, "rated_torque": 1.0, "max_torque": 5.0, "max_speed": 6000.0} for k in range(2)]
    buses = [{"interface": "virtual", "channel": name} for name in names]
    config = drives_config(tmp_path, gears=GEARS, buses=buses, drives=drives)
    end, done, lines = threading.Event(), [], ["state", "quit"]
    said: list[str] = []
    with can.Bus(interface="virtual", channel=names[0]) as one, can.Bus(interface="virtual", channel=names[1]) as two:

        def run() -> None:
            done.append(
                emulate(config, tell=said.append, commands=lambda: lines.pop(0) if end.is_set() and lines else None)
            )

        thread = threading.Thread(target=run)
        thread.start()
        try:
            for bus in (one, two):
                Master(bus).until(lambda m: m.arbitration_id == 0x704)
                Master(bus).start(4)
        finally:
            end.set()
            thread.join()
    (result,) = done
    assert isinstance(result, Emulated)
    assert result.unsent == 0
    assert [line for line in said if "node 4: operational, operation enabled" in line] != []
    assert result.heard > 20


@pytest.mark.slow
def test_a_fault_and_an_interface_are_checked_before_anything_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drives_config(tmp_path)
    path = str(tmp_path / "drives.yaml")
    assert main(["emulate", path]) == USAGE
    assert "name an interface such as socketcan" in capsys.readouterr().err
    assert main(["emulate", str(arm_file(tmp_path, 1)), "--fault", "earthquake"]) == USAGE
    assert "no fault is called 'earthquake'" in capsys.readouterr().err
    assert main(["emulate", "planar2"]) == USAGE
    assert "the driver has no CAN bus" in capsys.readouterr().err
    with pytest.raises(SystemExit) as wrong:
        main(["emulate", path, "--seconds", "0"])
    assert wrong.value.code == USAGE


@pytest.mark.slow
def test_what_to_type_meanwhile_is_stated_at_the_beginning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Pucks answer no `bus scan`, and the drives have gone when the command ends."""
    arm, wire = tmp_path / "my wam.yaml", f"begin-{tmp_path.name}-{os.getpid()}"
    section = f"driver: {{kind: barrett, bus: {{interface: ident_wire, channel: {wire}}}}}\n"
    arm.write_text(f"extends: wam7_pucks\nname: mine\n{section}")
    assert main(["emulate", str(arm), "--seconds", "0.05"]) == 0
    said = capsys.readouterr().out
    assert said.startswith(f"mine: emulated drives; Ctrl-C ends; in another terminal: `ident set-home '{arm}'`\n")
    assert "next:" not in said
