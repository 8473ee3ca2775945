"""The CANopen arm: what a cycle costs the driver, and whether cycles come in time with the drives in another process.

`python -m benchmarks.canopen`, about five minutes on a machine that does nothing else; `$IDENT_BENCH_CANOPEN_SECONDS`
(60) is the length of each run. In one process, on python-can's virtual bus, the drives answer between two calls, and
their time is told apart. Across processes the WAM is held by the control law of a run, over our wire in the drives'
process and over multicast, with what the kernel grants on either side.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks.harness import Row, table, write
from drivers.can.can_frame import Frame
from drivers.can.python_can_link import PythonCanLink, open_bus
from drivers.canopen.driver import CanopenArm
from drivers.clock import RealClock
from ident_service.config.arm import ArmConfig
from ident_service.config.can_bus import CanBus
from ident_service.config.load import load_arm, shipped_arms
from ident_service.config.motion_limits import motion_limits
from ident_service.errors import DriverError
from ident_service.model.arm_model import arm_model
from ident_service.model.pinocchio_models import InverseDynamics
from ident_service.motion.arm_factory import make_arm
from ident_service.motion.controller import ComputedTorque
from ident_service.motion.cycle_timing import Histogram
from ident_service.motion.realtime import temporary_privileges
from ident_service.motion.trajectory import rest
from sim_backend.emulator.build import build_emulator

SECONDS = float(os.environ.get("IDENT_BENCH_CANOPEN_SECONDS", "60"))
CYCLES, WARM_UP = 3_000, 300
_SHIPPED = {1000: "wam7_canopen", 500: "wam7_canopen_500hz"}


def described(folder: Path, rate: int, bus: dict[str, Any], **driver: Any) -> Path:
    """The shipped WAM on another bus, with drives that put up with a machine that stalls."""
    patience = {"watchdog_reason": "an emulated arm", "torque_deadline": 0.9, "heartbeats": {"timeout": 1.0}}
    section = {"kind": "canopen", "buses": [bus], **patience, **driver}
    tree = {"extends": str(shipped_arms()[_SHIPPED[rate]]), "name": "bench", "driver": section}
    path = folder / f"bench{time.monotonic_ns()}.yaml"
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    return path


class _Beside:
    """A link to drives in this thread: they do their work when we send or wait, and the time of that is kept."""

    def __init__(self, config: ArmConfig, bus: CanBus) -> None:
        self.clock = RealClock()
        self.drives_ns = 0
        self._emulator = build_emulator(config)
        self._ours, self._theirs = (PythonCanLink(open_bus(bus), bus) for _ in range(2))
        self._emulator.power_up(self.clock.now_ns())

    def send(self, frame: Frame) -> None:
        self._ours.send(frame)
        self._work()

    def receive(self, deadline_ns: int) -> Frame | None:
        while (frame := self._ours.receive(0)) is None and self.clock.now_ns() < deadline_ns:
            time.sleep(50e-6)
            self._work()
        return frame

    def drain(self) -> Sequence[Frame]:
        return self._ours.drain()

    def close(self) -> None:
        self._ours.close()
        self._theirs.close()

    def _work(self) -> None:
        begin = time.thread_time_ns()
        for frame in self._theirs.drain():
            self._answer(self._emulator.receive(0, frame, self.clock.now_ns()))
        self._answer(self._emulator.tick(self.clock.now_ns()))
        self.drives_ns += time.thread_time_ns() - begin

    def _answer(self, sent: Sequence[Any]) -> None:
        for item in sent:
            self._theirs.send(item.frame)


def in_one_process() -> list[Row]:
    """Computing time of this thread for one exchange, and that of the drives."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for frames, count in (("shared", 2), ("single", 7)):
            bus = {"interface": "virtual", "channel": f"bench-{frames}"}
            config = load_arm(described(Path(folder), 500, bus, torque_frames=frames))
            beside = _Beside(config, CanBus(**bus))
            spent = np.zeros((CYCLES, 2))
            with CanopenArm(config, lambda _, beside=beside: [beside]) as arm:
                arm.enable()
                torque = np.zeros(7)
                for cycle in range(CYCLES):
                    begin, drives = time.thread_time_ns(), beside.drives_ns
                    arm.exchange(torque)
                    drives = beside.drives_ns - drives
                    spent[cycle] = time.thread_time_ns() - begin - drives, drives
            ours, theirs = np.median(spent[WARM_UP:], axis=0) * 1e-3
            rows.append(Row(f"driver, {count} torque frames, 7 positions, virtual bus, median", ours, "us", "<= 250"))
            rows.append(Row("the same, 99 %", float(np.quantile(spent[WARM_UP:, 0], 0.99)) * 1e-3, "us"))
            rows.append(Row("seven emulated drives beside it, python-can included, median", theirs, "us"))
    return rows


def across_processes(rate: int, interface: str, seconds: float) -> tuple[list[Row], str]:
    """Hold the WAM for a while; figures, and the histogram of lateness in words."""
    name = f"{rate} Hz over {interface}"
    bus: dict[str, Any] = {"interface": interface, "channel": f"bench-{os.getpid()}"}
    if interface == "udp_multicast":
        bus |= {"channel": "239.74.163.98", "options": {"port": 43312, "hop_limit": 0}}
    with tempfile.TemporaryDirectory() as folder:
        path = described(Path(folder), rate, bus)
        config = load_arm(path)
        with _drives(path), temporary_privileges():
            try:
                stamps, last, valid, lost = _held(config, round(seconds * rate))
            except DriverError as error:
                return [Row(f"{name}: ended by {error}", float("nan"), "")], ""
    gaps, period = np.diff(stamps), 1e9 / rate
    incomplete = ~valid.all(axis=1)
    if (incomplete[1:] != (np.diff(lost) > 0)).any():  # a motor's position may be needed by two joints: counts differ
        raise RuntimeError("a cycle is incomplete, but nothing was counted as lost, or the other way round")
    late = Histogram()
    for gap in gaps.tolist():
        late.add(max(0, round(gap - period)))
    whole = (last - stamps)[~incomplete] * 1e-3
    target = "< 0.2" if rate == 500 else None
    rows = [
        Row(f"{name}: cycles", len(stamps), ""),
        Row(f"{name}: incomplete cycles", 100.0 * float(incomplete.mean()), "%", target),
        Row(f"{name}: periods skipped", float(np.rint(gaps / period - 1.0).clip(0).sum()), ""),
        Row(f"{name}: SYNC to last position, median", float(np.median(whole)), "us"),
        Row(f"{name}: SYNC to last position, 99.9 %", float(np.quantile(whole, 0.999)), "us"),
        Row(f"{name}: lateness, 99.9 %", late.quantile_us(0.999), "us or less"),
        Row(f"{name}: worst lateness", late.worst_ns * 1e-3, "us"),
    ]
    document = late.document()
    bins = zip([*(f"<= {edge}" for edge in document["edges_us"]), "more"], document["counts"], strict=True)
    return rows, f"{name}, lateness in us: " + ", ".join(f"{edge}: {count}" for edge, count in bins if count)


def _held(config: ArmConfig, cycles: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Stamps and times of the last answers [ns], who answered, and positions counted as lost so far."""
    model, limits = arm_model(config), motion_limits(config)
    if model.prior is None:
        raise RuntimeError("the shipped WAM has a prior")
    dynamics = InverseDynamics(model.chain, model.layout, model.prior)
    stamps, last = np.zeros(cycles, np.int64), np.zeros(cycles, np.int64)
    valid, lost = np.zeros((cycles, 7), dtype=bool), np.zeros(cycles, np.int64)
    with make_arm(config) as arm:
        home = arm.exchange(None).position
        still = np.zeros_like(home)
        control = ComputedTorque(dynamics, limits, 1.0 / config.control.rate, config.control.velocity_cutoff, home)
        torque, reference = dynamics.torque(home, still, still), rest(home)
        arm.enable()
        for cycle in range(cycles):
            sample = arm.exchange(torque)
            lost[cycle] = sample.lost
            last[cycle] = arm.clock.now_ns()
            stamps[cycle], valid[cycle] = sample.stamp_ns, sample.valid
            torque = np.clip(control.torque(sample.position, sample.valid, reference), -limits.torque, limits.torque)
        return stamps, last, valid, lost


@contextmanager
def _drives(path: Path) -> Iterator[None]:
    command = [sys.executable, "-m", "ident_service", "emulate", str(path)]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True) as child:
        if child.stdout is None or not any("node 7: pre operational" in line for line in child.stdout):
            raise RuntimeError("the emulated drives did not start")
        yield
        child.kill()


def main() -> None:
    rows = in_one_process()
    for interface in ("ident_wire", "udp_multicast"):
        for rate in (500, 1000):
            found, histogram = across_processes(rate, interface, SECONDS)
            rows += found
            print(histogram)
    load = ", ".join(f"{value:.2f}" for value in os.getloadavg())
    print(f"{platform.platform()}, {os.cpu_count()} cores, load {load}, Python {platform.python_version()}")
    print(table(rows))
    print(f"written to {write(rows, Path(__file__).parent / 'results', 'canopen')}")


if __name__ == "__main__":
    main()
