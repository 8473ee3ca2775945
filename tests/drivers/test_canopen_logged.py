"""A session's frames in a file, and the same session again with nothing but that file behind the driver."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from contract_bench import bench_config
from helpers.replay import ReplayLink, read_session
from test_canopen_monitoring import Bench

from drivers.arm import Arm, Sample, StopKind
from drivers.axis_status import AxisStatus
from drivers.can.can_frame import Frame
from drivers.can.can_link import Link
from drivers.canopen.driver import CanopenArm
from drivers.clock import VirtualClock
from ident_service.errors import DriverError
from sim_backend.arm import from_config

TORQUES = [np.array([np.sin(0.1 * k), 2.0 * np.cos(0.07 * k)]) for k in range(150)]


def session(arm: Arm, torques: Sequence[np.ndarray], struck: int | None = None, strike: Any = None) -> list[Sample]:
    samples = []
    with arm:
        arm.enable()
        for k, torque in enumerate(torques):
            if k == struck:
                strike()
            samples.append(arm.exchange(torque))
        arm.stop(StopKind.QUICK_STOP)
        samples += [arm.exchange(None) for _ in range(20)]
    return samples


def replayed(bench: Bench, path: Path, buses: int) -> tuple[CanopenArm, list[ReplayLink]]:
    frames, clock = read_session(path), VirtualClock()
    links = [ReplayLink(frames, number, clock) for number in range(buses)]
    opened: list[Link] = list(links)
    return CanopenArm(bench.config, lambda _: opened), links


def assert_same(one: Sequence[Sample], other: Sequence[Sample]) -> None:
    assert len(one) == len(other)
    shift = other[0].stamp_ns - one[0].stamp_ns
    for first, second in zip(one, other, strict=True):
        assert (first.cycle, first.lost, first.status, first.status_age) == (
            second.cycle,
            second.lost,
            second.status,
            second.status_age,
        )
        assert abs(second.stamp_ns - first.stamp_ns - shift) <= 1000  # the format keeps microseconds
        assert first.events == second.events
        for key in ("position", "torque", "valid", "age"):
            np.testing.assert_array_equal(getattr(first, key), getattr(second, key))


def commands(frames: Sequence[Frame]) -> list[tuple[int, bytes]]:
    """All that was sent but our heartbeat, which a microsecond may bring into another cycle."""
    return [(frame.identifier, frame.data) for frame in frames if frame.identifier != 0x77F]


@pytest.mark.slow
@pytest.mark.parametrize("buses", [1, 2])
@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf"])
def test_a_logged_session_gives_the_same_samples_again(tmp_path: Path, suffix: str, buses: int) -> None:
    drive = {"counts": 65536, "rated_torque": 1.0, "max_speed": 6000.0, "max_torque": 5.0}
    wires = [{"interface": "lock_step", "channel": f"{number}"} for number in range(buses)]
    bench = Bench(buses=wires, drives=[drive | {"node": 1}, drive | {"node": 2, "bus": buses - 1}])
    path = tmp_path / f"session{suffix}"
    bench.arm.log_frames(path)

    def strike() -> None:
        bench.inject(kind="lost_feedback", joint="turn", duration=0.006)
        bench.inject(kind="drive_fault", joint="slide", duration=0.01)

    recorded = session(bench.arm, TORQUES, 100, strike)
    assert re.fullmatch(r"\d+ frames", bench.arm.logged())
    assert any(not sample.valid[0] for sample in recorded)
    assert recorded[-1].status[1] & AxisStatus.FAULT
    assert np.ptp([sample.position for sample in recorded], axis=0).min() > 1e-3

    arm, links = replayed(bench, path, buses)
    assert_same(recorded, session(arm, TORQUES))
    for link in links:
        assert link.finished
        assert commands(link.sent) == commands(link.logged)
    # python-can's own reader finds the same frames.
    with can.LogReader(path) as reader:
        assert f"{len(list(reader))} frames" == bench.arm.logged()


def test_a_file_is_of_one_session(tmp_path: Path) -> None:
    bench = Bench()
    bench.arm.log_frames(tmp_path / "one.log")
    assert bench.arm.logged() == ""
    session(bench.arm, TORQUES[:5])
    first = (tmp_path / "one.log").read_bytes()
    session(bench.arm, TORQUES[:5])
    assert bench.arm.logged() == ""
    assert (tmp_path / "one.log").read_bytes() == first


def test_a_file_that_cannot_be_made_keeps_the_arm_closed(tmp_path: Path) -> None:
    bench = Bench()
    with pytest.raises(DriverError, match=r"ends in \.log, \.asc, \.blf"):
        bench.arm.log_frames(tmp_path / "one.txt")
    (tmp_path / "there.log").write_text("precious")
    bench.arm.log_frames(tmp_path / "there.log")
    with pytest.raises(DriverError, match="exists already"):
        bench.arm.open()
    assert (tmp_path / "there.log").read_text() == "precious"
    bench.behind.link(0).close()  # the bus was given back


def test_an_arm_without_a_fieldbus_has_no_frames(tmp_path: Path) -> None:
    arm = from_config(bench_config())
    with pytest.raises(DriverError, match="no fieldbus whose frames"):
        arm.log_frames(tmp_path / "x.log")
    assert arm.logged() == ""


def test_frames_of_drives_that_fail_the_opening_are_in_the_file(tmp_path: Path) -> None:
    bench = Bench()
    bench.inject(kind="node_silent", joint="slide", duration=60.0)
    bench.settle(10)
    bench.arm.log_frames(tmp_path / "silent.log")
    with pytest.raises(DriverError, match="no answer of drives 2"):
        bench.arm.open()
    heard = {logged.frame.identifier for logged in read_session(tmp_path / "silent.log") if not logged.sent}
    assert 0x581 in heard
    assert 0x582 not in heard
