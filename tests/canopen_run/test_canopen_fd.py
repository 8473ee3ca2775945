"""An arm on a bus of CAN FD: in virtual time from preflight to the recording, and on real wires, frame by frame."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from canopen_run_bench import (
    MOTION,
    SHORT,
    STALLS,
    Said,
    acknowledge,
    canopen,
    channel,
    checked,
    described,
    emulated,
    write,
)

from drivers.can.bus_load import unstuffed_bits
from drivers.can.can_frame import Frame
from drivers.can.can_link import Link, open_links
from drivers.canopen.pdo_mapping import SDO_REPLY, SDO_REQUEST, SYNC
from ident_service.cli import main
from ident_service.config.load import load_arm
from ident_service.recordings.open import open_recording
from sim_backend.emulator.lock_step import LockStepArm
from sim_backend.emulator.process import Emulated, emulate

RATE, KP, KD = 250.0, 225.0, 30.0
BITRATE, DATA = 500_000, 2_000_000
IDENTITY = bytes([0x40, 0x00, 0x10, 0, 0, 0, 0, 0])


def tree(name: str, bus: dict[str, Any], rate: float = RATE, **driver: Any) -> dict[str, Any]:
    bus = {"bitrate": BITRATE, "data_bitrate": DATA} | bus
    return canopen(described(name, rate, KP, KD), bus, 1, **driver)


@pytest.mark.campaign
@pytest.mark.slow
def test_a_run_in_virtual_time_has_every_answer_in_its_cycle(tmp_path: Path) -> None:
    section = tree("fd", {"interface": "lock_step"})
    section["motions"]["identification"] = MOTION | {"base_frequency": 0.4, "harmonics": 2, "periods": 1}
    path, state, run = write(tmp_path, section), tmp_path / "state", tmp_path / "run"
    assert checked(path, "fd", state)
    assert main(["run", str(path), "--out", str(run), "--state", str(state), "--can-log"]) == 0
    stamps = np.concatenate([b.stamp_ns for b in open_recording(run / "run.mcap", ("shoulder", "elbow")).blocks()])
    np.testing.assert_array_equal(np.diff(stamps), round(1e9 / RATE))
    lines = (run / "can.log").read_text().splitlines()
    assert len(lines) > 4 * len(stamps)
    assert all("##" in line for line in lines)  # frames of CAN FD, sent ones too


@pytest.mark.parametrize("data_bitrate", [None, DATA])
def test_an_answer_in_lock_step_takes_its_bits(tmp_path: Path, data_bitrate: int | None) -> None:
    config = load_arm(write(tmp_path, tree("timed", {"interface": "lock_step", "data_bitrate": data_bitrate})))
    behind = LockStepArm(config)
    link, clock = behind.link(0), behind.clock
    behind.settle(clock.now_ns() + 50_000_000)
    link.drain()
    begin = clock.now_ns()
    link.send(Frame(SDO_REQUEST + 1, IDENTITY))
    answer = link.receive(begin + 10**9)
    assert answer is not None
    assert (answer.identifier, answer.fd) == (SDO_REPLY + 1, data_bitrate is not None)
    frame_s = unstuffed_bits(8, fd=data_bitrate is not None).seconds(BITRATE, data_bitrate)
    assert answer.stamp_ns - begin == pytest.approx(2e9 * frame_s, abs=2)


@contextmanager
def served(config: Any) -> Iterator[list[Emulated]]:
    ended, done = threading.Event(), []
    thread = threading.Thread(target=lambda: done.append(emulate(config, stop_requested=ended.is_set)))
    thread.start()
    try:
        yield done
    finally:
        ended.set()
        thread.join()


def multicast() -> dict[str, Any]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        port = probe.getsockname()[1]
    return {"interface": "udp_multicast", "channel": "239.74.163.3", "options": {"port": port, "hop_limit": 0}}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ident_wire", "paced", "udp_multicast"])
def test_drives_answer_in_frames_of_fd(tmp_path: Path, kind: str) -> None:
    bus = multicast() if kind == "udp_multicast" else {"interface": "ident_wire", "channel": channel()}
    if kind == "paced":
        bus["options"] = {"pace": True}
    config = load_arm(write(tmp_path, tree("served", bus)))
    with served(config) as done:
        link = opened(config)
        answer = asked(link, 1)
        assert (answer.data[:3], answer.fd) == (bytes([0x43, 0x00, 0x10]), True)
        # A PDO too: operational, the drives answer SYNC by the mapping that they have after power-up.
        link.send(Frame(0x000, bytes([1, 0])))
        link.send(Frame(SYNC))
        position = heard(link, 0x181)
        assert position.fd
        link.close()
    assert done[0].unsent == 0


def opened(config: Any) -> Link:
    """The driver's end, as soon as the drives are there."""
    end = time.monotonic() + 60.0
    while True:
        try:
            (link,) = open_links(config)
            return link
        except OSError:
            assert time.monotonic() < end
            time.sleep(0.05)


def heard(link: Link, identifier: int) -> Frame:
    end = time.monotonic_ns() + 30 * 10**9
    while (frame := link.receive(end)) is not None:
        if frame.identifier == identifier:
            return frame
    raise AssertionError(f"no frame {identifier:03X}h")


def asked(link: Link, node: int) -> Frame:
    """An answer of a node, which may still boot."""
    for _ in range(300):
        link.send(Frame(SDO_REQUEST + node, IDENTITY))
        soon = time.monotonic_ns() + 200_000_000
        while (frame := link.receive(soon)) is not None:
            if frame.identifier == SDO_REPLY + node:
                return frame
    raise AssertionError("no answer")


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.campaign  # in virtual time, the test above does the same for every change
@pytest.mark.timeout(600)
def test_a_run_over_a_paced_wire_between_two_processes(tmp_path: Path) -> None:
    bus = {"interface": "ident_wire", "channel": channel(), "options": {"pace": True}}
    section = tree("wired", bus, 50.0, torque_deadline=0.2)
    section["joints"] = {joint: keys | {"kp": 100.0, "kd": 16.0} for joint, keys in section["joints"].items()}
    section["motions"] = {"identification": SHORT, "validation": SHORT}
    path, state = write(tmp_path, section), tmp_path / "state"
    # A machine with much else to do stalls in most motions; a whole one shows what this is about.
    end, number = time.monotonic() + 480.0, 0
    while time.monotonic() < end:
        number += 1
        with emulated(path):
            if not checked(path, "wired", state):
                continue
            with Said("run", path, "--out", tmp_path / f"run{number}", "--state", state) as run:
                if run.code() == 0:
                    return
        assert any(word in run.text for word in STALLS), run.text
        acknowledge(path, "wired", state)
    raise AssertionError(f"the machine stalled in {number} tries")
