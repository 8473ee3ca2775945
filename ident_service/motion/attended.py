"""Exchange cycles without torque while the caller blocks, so that drives do not report a lost host.

Drives treat a host that falls silent as dead and disable themselves or stop. So code that plans, checks or asks a
person while an arm is open lets cycles without torque go on meanwhile. In virtual time no drive waits, and the block
just runs. With torque on nothing else is done at all: the loop's thread would have to share the interpreter.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from drivers.arm import Arm

_SWITCH = 2e-4  # s after which the cycles get the interpreter from the other thread, instead of 5 ms
_FIRST_COME = (os.SCHED_FIFO, os.SCHED_RR)  # threads of one priority let each other run only when they wait
_FIRST = -20  # of the nice values


@contextmanager
def attended(arm: Arm) -> Iterator[None]:
    """Exchange cycles without torque in a background thread for as long as the block lasts, which must not use the arm.

    Args:
        arm: open, not enabled.

    Raises:
        ArmError: a cycle failed, told when the block has ended; likewise whatever else a driver may raise.
    """
    if arm.clock.lock_step:
        yield
        return
    ended, over = threading.Event(), threading.Event()
    failures: list[Exception] = []

    def cycles() -> None:
        try:
            while not ended.is_set():
                arm.exchange(None)
        except Exception as error:  # noqa: BLE001 - whatever it is, no cycles are exchanged from here on
            failures.append(error)
        finally:
            over.set()

    thread = threading.Thread(target=cycles, name="attended")
    before = sys.getswitchinterval()
    sys.setswitchinterval(min(before, _SWITCH))
    try:
        thread.start()
        with unhurried():
            yield
    finally:
        ended.set()
        sys.setswitchinterval(before)
        if thread.ident is not None:
            _wait_for(over)
    if failures:
        raise failures[0]


def _wait_for(over: threading.Event) -> None:
    """Wait until the background thread has ended, however often the wait is interrupted: the caller needs the arm."""
    interrupted: KeyboardInterrupt | None = None
    while not over.is_set():
        try:
            over.wait()
        except KeyboardInterrupt as error:
            interrupted = error
    if interrupted is not None:
        raise interrupted


@contextmanager
def unhurried() -> Iterator[None]:
    """Work at no real-time priority, but before all that has none, where real time was granted (`realtime.py`).

    Cycles in a thread that was started before go first. What works for seconds at a real-time priority starves all else
    on its core, for which the kernel stops every real-time process there for up to 50 ms of a second
    (sched_rt_runtime_us, or the fair server of Linux 6.12): in the middle of the motion that follows.
    """
    policy, granted = os.sched_getscheduler(0), os.sched_getparam(0)
    if policy not in _FIRST_COME:
        yield
        return
    thread = threading.get_native_id()
    nice = os.getpriority(os.PRIO_PROCESS, thread)
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.setpriority(os.PRIO_PROCESS, thread, _FIRST)
    try:
        yield
    finally:
        with suppress(OSError):
            os.sched_setscheduler(0, policy, granted)
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, thread, nice)
