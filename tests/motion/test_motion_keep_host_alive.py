"""Cycles go on while somebody thinks or computes with an arm open; nothing of it reaches an arm in virtual time."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest

from drivers.clock import Clock, RealClock, VirtualClock
from ident_service.config.load import load_arm
from ident_service.config.motion_limits import motion_limits
from ident_service.errors import DriverError
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import arm_model
from ident_service.motion.realtime import temporary_privileges
from ident_service.motion.run import keep_host_alive
from ident_service.preflight import static_checks as plan


class Looked:
    """The part of an arm that is used: cycles without torque, one of which may fail."""

    def __init__(self, clock: Clock, fails_at: int | None = None, error: Exception | None = None) -> None:
        self.clock, self.fails_at, self.error = clock, fails_at, error or DriverError("the bus is gone")
        self.cycles, self.torques = 0, list[object]()
        self.enough = threading.Event()

    def exchange(self, torque: object) -> None:
        self.torques.append(torque)
        self.cycles += 1
        if self.cycles == self.fails_at:
            raise self.error
        if self.cycles >= 10:
            self.enough.set()
        self.clock.sleep_until_ns(self.clock.now_ns() + 1_000_000)


def during(arm: Looked, work: Callable[[], None]) -> None:
    with keep_host_alive(arm):  # type: ignore[arg-type]
        work()


def test_cycles_without_torque_go_on_until_the_work_is_done() -> None:
    arm, before = Looked(RealClock()), sys.getswitchinterval()
    during(arm, lambda: require(arm.enough.wait(60.0)))
    ended = arm.cycles
    assert ended >= 10
    assert set(arm.torques) == {None}
    assert threading.active_count() == 1 or "attended" not in {one.name for one in threading.enumerate()}
    assert arm.cycles == ended
    assert sys.getswitchinterval() == before


def test_in_virtual_time_nobody_waits() -> None:
    arm = Looked(VirtualClock())
    during(arm, lambda: None)
    assert arm.cycles == 0


def test_a_cycle_that_fails_is_reported_when_the_work_is_done() -> None:
    arm, done = Looked(RealClock(), fails_at=1), list[str]()
    with pytest.raises(DriverError, match="the bus is gone"):
        during(arm, lambda: done.append("work"))
    assert done == ["work"]
    assert arm.cycles == 1


def test_what_a_driver_should_not_raise_is_reported_too() -> None:
    with pytest.raises(ZeroDivisionError):
        during(Looked(RealClock(), fails_at=1, error=ZeroDivisionError()), lambda: None)


@pytest.mark.slow
def test_cycles_go_on_beside_work_that_has_real_time() -> None:
    """Work and cycles share a core there; work at a real-time priority would have the kernel stop both."""
    with temporary_privileges() as granted:
        if not granted.scheduling:
            pytest.skip("this machine grants no real time")
        arm, before = Looked(RealClock()), (os.sched_getscheduler(0), os.sched_getparam(0), os.nice(0))

        def work() -> None:
            assert os.sched_getscheduler(0) == os.SCHED_OTHER
            assert os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) == -20
            end = time.thread_time() + 1.0
            while not arm.enough.is_set() and time.thread_time() < end:
                pass

        during(arm, work)
        assert arm.enough.is_set()
        assert (os.sched_getscheduler(0), os.sched_getparam(0), os.nice(0)) == before


@pytest.mark.slow
def test_preflight_computes_without_a_real_time_priority(monkeypatch: pytest.MonkeyPatch) -> None:
    seen, proof_of = list[int](), plan.proof_of

    def watched(*args: Any) -> Any:
        seen.append(os.sched_getscheduler(0))
        return proof_of(*args)

    monkeypatch.setattr(plan, "proof_of", watched)
    model = arm_model(load_arm("planar2"))
    with temporary_privileges() as granted:
        if not granted.scheduling:
            pytest.skip("this machine grants no real time")
        plan.motion_proven_check(model, motion_limits(model.config), excitation(model, "identification"))
        assert os.sched_getscheduler(0) == os.SCHED_FIFO
    assert seen == [os.SCHED_OTHER]


def test_work_that_fails_ends_the_cycles_and_is_reported_first() -> None:
    arm = Looked(RealClock(), fails_at=1)
    with pytest.raises(KeyboardInterrupt):
        during(arm, interrupted)
    ended = arm.cycles
    assert "attended" not in {one.name for one in threading.enumerate()}
    assert arm.cycles == ended


def test_no_second_interruption_leaves_two_threads_with_the_arm() -> None:
    arm, main = Looked(RealClock()), threading.get_ident()
    inside = threading.Event()

    def exchange(torque: object) -> None:
        inside.set()
        for _ in range(2):  # both come before this cycle is over
            signal.pthread_kill(main, signal.SIGINT)
            time.sleep(0.05)
        inside.clear()

    arm.exchange = exchange  # type: ignore[method-assign]
    left: list[bool] = []

    def until_left() -> None:
        try:
            during(arm, lambda: time.sleep(60.0))
        finally:
            left.append(inside.is_set())

    with pytest.raises(KeyboardInterrupt):
        until_left()
    assert left == [False]


def interrupted() -> None:
    raise KeyboardInterrupt


def require(true: bool) -> None:
    assert true
