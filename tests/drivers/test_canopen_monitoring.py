"""Looking at CANopen drives: what is seen, and that nothing but SDO uploads leaves the host."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from contract_bench import canopen_config

from drivers.arm import Arm, StopKind
from drivers.axis_status import AxisStatus
from drivers.can.can_frame import Frame
from drivers.can.can_link import Link
from drivers.canopen.bus_monitor import RATE, SHARE, look_rate
from drivers.canopen.driver import CanopenArm
from ident_service.config.arm import ArmConfig
from ident_service.config.canopen import CanopenDriver
from ident_service.config.simulation import SimulatedFault
from ident_service.errors import DriverError
from ident_service.motion.read_only_monitor import Watched, watch
from ident_service.operations.arm_checks import watch_document, watch_text
from sim_backend.emulator.faults import configured
from sim_backend.emulator.lock_step import LockStepArm

MS = 1_000_000


class Tap:
    """A link that keeps what is sent through it."""

    def __init__(self, link: Link, sent: list[Frame]) -> None:
        self.clock, self._link, self._sent = link.clock, link, sent

    def send(self, frame: Frame) -> None:
        self._sent.append(frame)
        self._link.send(frame)

    def receive(self, deadline_ns: int) -> Frame | None:
        return self._link.receive(deadline_ns)

    def drain(self) -> Sequence[Frame]:
        return self._link.drain()

    def close(self) -> None:
        self._link.close()


class Bench:
    """Two emulated drives in virtual time, an arm on them, and what it has sent."""

    def __init__(self, **driver: Any) -> None:
        self.config = canopen_config(**driver)
        self.behind = LockStepArm(self.config)
        self.sent: list[Frame] = []
        self.arm = CanopenArm(self.config, self._links)
        self.settle(50)

    def _links(self, config: ArmConfig) -> list[Link]:
        assert isinstance(config.driver, CanopenDriver)
        return [Tap(self.behind.link(number), self.sent) for number in range(len(config.driver.buses))]

    def settle(self, milliseconds: int) -> None:
        self.behind.settle(self.behind.clock.now_ns() + milliseconds * MS)

    def states(self) -> list[str]:
        return [face.state for face in self.behind.emulator.faces]

    def objects(self) -> list[dict[int, Any]]:
        """All that drives hold but what moves by itself: position, velocity, actual torque."""
        moving = (0x606400, 0x606C00, 0x607700)
        return [
            {key: value for key, value in face.objects.values.items() if key not in moving}  # type: ignore[attr-defined]
            for face in self.behind.emulator.faces
        ]

    def inject(self, **fault: Any) -> None:
        wanted = [SimulatedFault.model_validate({"cycle": 0, **fault})]
        self.behind.inject(*configured(wanted, ("turn", "slide"), 0.002))

    def watch(self, seconds: float = 0.5) -> Watched:
        """A look, which is proven to have sent nothing but uploads and to have changed nothing."""
        self.sent.clear()
        states, objects = self.states(), self.objects()
        seen = watch(self.arm, seconds)
        assert self.sent
        for frame in self.sent:
            assert frame.identifier in (0x601, 0x602)
            assert frame.data[0] >> 5 in (2, 3), frame  # initiate upload, upload segment (CiA 301, 7.2.4.3)
        assert self.states() == states
        assert self.objects() == objects
        return seen


def drives_of(seen: Watched) -> list[str]:
    return [words.partition(": ")[2] for words in seen.drives]


def test_drives_that_were_just_powered_are_seen_and_left_alone() -> None:
    bench = Bench()
    seen = bench.watch()
    assert seen.cycles == 0.5 * RATE
    np.testing.assert_allclose(seen.position, [0.5, 0.1], atol=2e-4)
    assert not seen.missing.any()
    assert seen.lost == 0
    assert drives_of(seen) == ["switch on disabled, sends no heartbeat"] * 2
    assert bench.states() == ["pre operational, switch on disabled"] * 2


def test_an_operational_drive_keeps_streaming_state_and_watchdog() -> None:
    bench = Bench(torque_deadline=60.0, heartbeats={"timeout": 60.0})
    bench.arm.open()
    bench.arm.enable()
    # The host dies without a word; the drives have not noticed yet.
    for link in bench.arm._buses._links:  # type: ignore[union-attr]
        link.close()
    bench.arm = CanopenArm(bench.config, bench._links)
    seen = bench.watch()
    assert drives_of(seen) == ["operation enabled, operational"] * 2
    assert all(word & AxisStatus.POWERED for word in seen.status)
    assert "powered" in watch_text(seen)


@pytest.mark.parametrize("cycles", [0, 1, 20, 100])
def test_a_session_that_was_closed_leaves_nothing_to_be_missed(cycles: int) -> None:
    bench = Bench()
    with bench.arm as arm:
        arm.enable()
        for _ in range(cycles):
            arm.exchange(np.zeros(2))
    bench.settle(2000)
    assert bench.states() == ["pre operational, switch on disabled"] * 2
    assert not any(face.objects.number(0x1003) for face in bench.behind.emulator.faces)  # type: ignore[attr-defined]
    seen = bench.watch()
    assert seen.status == (0, 0)
    assert drives_of(seen) == ["switch on disabled, pre-operational"] * 2


def test_what_a_drive_has_latched_is_reported_with_its_cause() -> None:
    bench = Bench()
    with bench.arm as arm:
        arm.enable()
        bench.inject(kind="drive_fault", joint="slide", duration=0.002)
        for _ in range(30):
            arm.exchange(np.zeros(2))
        arm.stop(StopKind.QUICK_STOP)
    seen = bench.watch()
    first, second = drives_of(seen)
    assert first == "switch on disabled, pre-operational"
    assert second.startswith("fault (")
    assert second.endswith("), pre-operational")
    assert seen.status[1] & AxisStatus.FAULT
    assert not seen.status[0]
    assert watch_document(seen)["drives"][1] == seen.drives[1]


def test_a_drive_whose_host_died_says_watchdog() -> None:
    bench = Bench()
    bench.arm.open()
    bench.arm.enable()
    for link in bench.arm._buses._links:  # type: ignore[union-attr]
        link.close()
    bench.settle(1000)
    bench.arm = CanopenArm(bench.config, bench._links)
    seen = bench.watch()
    assert all(word & AxisStatus.WATCHDOG for word in seen.status)
    assert not any(word & AxisStatus.POWERED for word in seen.status)
    assert "8130h life guard or heartbeat" in seen.drives[0]


def test_a_silent_drive_is_shown_beside_the_others() -> None:
    bench = Bench()
    bench.inject(kind="node_silent", joint="slide", duration=60.0)
    bench.settle(10)
    seen = bench.watch()
    assert np.isfinite(seen.position[0])
    assert np.isnan(seen.position[1])
    assert seen.missing.tolist() == [0, seen.cycles]
    assert f"no answer for {seen.cycles} cycles" in seen.drives[1]


def test_without_any_drive_it_says_so() -> None:
    bench = Bench(drives=[{"node": n, "rated_torque": 1.0, "max_torque": 5.0, "max_speed": 100.0} for n in (1, 2)])
    for joint in ("turn", "slide"):
        bench.inject(kind="node_silent", joint=joint, duration=60.0)
    bench.settle(10)
    with pytest.raises(DriverError, match=r"no drive answers within 2 s.*ident bus scan"):
        watch(bench.arm, 0.1)
    watch_again = bench.behind.link(0)  # the bus was given back
    watch_again.close()


def test_another_drive_than_the_configured_one_is_refused() -> None:
    bench = Bench()
    content = bench.config.model_dump(mode="json")
    content["driver"]["drives"][1]["identity"]["serial"] = 77
    other = CanopenArm(ArmConfig.model_validate(content), bench._links)
    with pytest.raises(DriverError, match="node 2: is not the drive that the configuration names: serial"):
        watch(other, 0.1)


def test_where_another_host_streams_nobody_looks() -> None:
    """A second link on the same bus cannot be had in lock step, so that the frame is heard from the script."""
    bench = Bench()

    class Streamed(Tap):
        def receive(self, deadline_ns: int) -> Frame | None:
            return (
                Frame(0x080, stamp_ns=self.clock.now_ns())
                if not heard and not heard.append(1)
                else super().receive(deadline_ns)
            )

    heard: list[int] = []
    arm = CanopenArm(bench.config, lambda _: [Streamed(bench.behind.link(0), bench.sent)])
    with pytest.raises(DriverError, match="another host sends SYNC on bench"):
        watch(arm, 0.1)
    assert bench.sent == []


def test_it_can_do_nothing_else() -> None:
    bench = Bench()
    looking: Arm = bench.arm.look()
    for act in (looking.describe, lambda: looking.exchange(None)):
        with pytest.raises(DriverError, match="not open"):
            act()
    with looking:
        with pytest.raises(DriverError, match="already open"):
            looking.open()
        bench.sent.clear()
        for act in (looking.enable, looking.reset, lambda: looking.exchange(np.zeros(2))):
            with pytest.raises(DriverError, match="read-only arm"):
                act()
        for kind in StopKind:
            looking.stop(kind)
        assert bench.sent == []
    looking.close()


def test_two_buses_are_looked_at_together() -> None:
    drive = {"counts": 65536, "rated_torque": 1.0, "max_speed": 6000.0, "max_torque": 5.0, "node": 1}
    buses = [{"interface": "lock_step", "channel": "a"}, {"interface": "lock_step", "channel": "b"}]
    bench = Bench(buses=buses, drives=[drive, drive | {"bus": 1}])
    seen = bench.watch()
    np.testing.assert_allclose(seen.position, [0.5, 0.1], atol=2e-4)
    assert not seen.missing.any()


@pytest.mark.parametrize(("bitrate", "rate"), [(1_000_000, RATE), (125_000, SHARE * 125_000 / (8 * 7 * 135))])
def test_a_slow_bus_is_queried_more_seldom(bitrate: int, rate: float) -> None:
    drive = {"rated_torque": 1.0, "max_torque": 1.0, "max_speed": 100.0}
    driver = CanopenDriver.model_validate(
        {
            "kind": "canopen",
            "eds": {"name": "emulated_drive.eds", "text": ""},
            "buses": [{"bitrate": bitrate}],
            "drives": [drive | {"node": node} for node in range(1, 8)],
        }
    )
    assert look_rate(driver) == pytest.approx(rate)


def test_a_dead_bus_ends_it() -> None:
    bench = Bench()
    looking = bench.arm.look()
    looking.open()
    looking.exchange(None)
    bench.inject(kind="bus_gone")
    with pytest.raises(DriverError, match="gone"):
        looking.exchange(None)
    looking.close()


def test_a_host_that_begins_to_stream_ends_the_look() -> None:
    bench = Bench()
    begun: list[Frame] = []

    class Later(Tap):
        def drain(self) -> Sequence[Frame]:
            return [*super().drain(), *begun]

    looking = CanopenArm(bench.config, lambda _: [Later(bench.behind.link(0), bench.sent)]).look()
    with looking:
        looking.exchange(None)
        begun.append(Frame(0x080))
        with pytest.raises(DriverError, match="another host sends SYNC"):
            looking.exchange(None)
