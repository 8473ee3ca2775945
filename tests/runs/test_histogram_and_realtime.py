"""Times in fixed bins, and what the kernel grants."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ident_service.config.control import Realtime
from ident_service.motion import realtime
from ident_service.motion.cycle_timing import Histogram
from ident_service.motion.realtime import LATENCY, STACK, RealtimePrivileges, core_numbers, temporary_privileges

CORES = sorted(os.sched_getaffinity(0))
ASK = "from ident_service.motion.realtime import *; granted = request_privileges(settings=Realtime({}))"


@given(times=st.lists(st.integers(0, 10**9), min_size=1, max_size=200), share=st.sampled_from([0.5, 0.99, 0.999]))
def test_a_share_of_all_times_is_below_what_it_says(times: list[int], share: float) -> None:
    histogram = Histogram()
    for one in times:
        histogram.add(one)
    assert histogram.count == len(times)
    assert histogram.worst_ns == max(times)
    assert np.mean(np.array(times) <= histogram.quantile_us(share) * 1e3 + 1e-6) >= share
    assert sum(histogram.document()["counts"]) == len(times)


def test_nothing_was_counted_yet() -> None:
    assert Histogram().quantile_us(0.999) == 0.0


def test_requests_to_the_kernel_are_answered_in_words_and_nothing_fails() -> None:
    code = (
        "from ident_service.motion.realtime import request_privileges; granted = request_privileges(); "
        "print(granted.sentence()); "
        "import gc; assert not gc.isenabled(); assert granted.collector"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("real time: got ")


def asking(settings: str, rest: str = "") -> str:
    """Ask in a process of its own, as the motion process does, and print what `rest` makes of it."""
    code = (
        "from ident_service.motion.realtime import *; "
        f"granted = request_privileges(settings=Realtime({settings})); {rest or 'pass'}"
    )
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout


@contextmanager
def another_loop(settings: str = "") -> Iterator[str]:
    """Keep another process that has asked; yields what it got."""
    code = f"{ASK.format(settings)}; print(granted.core, flush=True); input()"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        try:
            yield other.stdout.readline().strip()
        finally:
            other.communicate("\n")


@contextmanager
def on_a_core() -> Iterator[RealtimePrivileges]:
    """Hold privileges with a core of its own; tests beside this one have theirs for a moment."""
    deadline = time.monotonic() + 60.0
    while True:
        with temporary_privileges(settings=Realtime(cores=tuple(CORES))) as granted:
            if granted.core is not None:
                yield granted
                return
        if time.monotonic() > deadline:
            pytest.skip("loops outside of this test have every core")
        time.sleep(0.1)


@pytest.mark.slow
@pytest.mark.skipif(len(CORES) < 2, reason="needs two cores")
def test_two_loops_never_share_a_core_of_their_own() -> None:
    with another_loop(f"cores={tuple(CORES)}") as first:
        if first == "None":
            pytest.skip("loops outside of this test have every core")
        both = f"cores=({first}, {next(core for core in CORES if core != int(first))})"
        other = asking(both, "print(granted.core)").strip()  # or none, where a loop outside has that one
        assert other != first
        alone = asking(f"cores=({first},)", "print(granted.core, sorted(os.sched_getaffinity(0)), granted.sentence())")
    assert alone.startswith(f"None {CORES} ")  # left to the kernel, beside nobody
    assert f"no core of its own: other loops have core {first}" in alone


def test_a_core_that_is_not_there_is_stated() -> None:
    assert "core 8191 refused" in asking("cores=(8191,)", "print(granted.core, granted.sentence())")


def test_the_priority_is_the_described_one() -> None:
    said = asking("priority=7", "print(granted.scheduling, os.sched_getparam(0).sched_priority)").split()
    assert said in (["True", "7"], ["False", "0"])


@pytest.mark.slow
def test_cores_are_kept_awake_for_as_long_as_the_loop_runs() -> None:
    if not os.access(LATENCY, os.W_OK):
        assert f"{LATENCY} refused" in asking("", "print(granted.sentence())")
        return
    here = Path(f"/proc/{os.getpid()}/fd")

    def held() -> bool:
        return LATENCY in [file.readlink() for file in here.iterdir() if file.is_symlink()]

    with temporary_privileges() as granted:
        assert granted.awake
        assert held()
    assert not held()


def test_a_core_is_kept_from_halting_where_the_kernel_cannot_and_no_longer_than_the_loop_runs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    driver = tmp_path / "current_driver"
    monkeypatch.setattr(realtime, "IDLE_DRIVER", driver)

    def spinners() -> list[int]:
        children = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
        return [int(one) for one in children if b"pthread_spin_lock" in Path("/proc", one, "cmdline").read_bytes()]

    for text, spins in (("intel_idle\n", False), ("none\n", True)):
        driver.write_text(text)
        with on_a_core() as granted:
            assert granted.core is not None
            assert granted.spinning is spins
            deadline = time.monotonic() + 30.0
            while spins and not spinners() and time.monotonic() < deadline:
                time.sleep(0.001)  # it has a name only once it has had the core
            assert len(spinners()) == spins
            for pid in spinners():
                assert os.sched_getscheduler(pid) == os.SCHED_IDLE
                assert os.sched_getaffinity(pid) == {granted.core}
        assert not spinners()
    assert not realtime.idle_cores_halt(tmp_path / "none")


def test_what_cannot_be_put_on_its_core_is_not_left_running_and_nothing_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(realtime, "idle_cores_halt", lambda driver: True)
    refusals = list[str]()
    with ExitStack() as held:
        assert not realtime._keep_from_halting(8191, held, refusals)
        children = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
        assert not [one for one in children if b"pthread_spin_lock" in Path("/proc", one, "cmdline").read_bytes()]
    assert refusals == ["nothing keeps core 8191 from halting (Invalid argument)"]


def test_what_keeps_a_core_from_halting_ends_with_a_loop_that_is_killed() -> None:
    code = (
        "import os, sys, contextlib; from pathlib import Path; from ident_service.motion import realtime\n"
        "realtime.idle_cores_halt = lambda driver: True\n"
        f"held = contextlib.ExitStack(); print(realtime._keep_from_halting({CORES[0]}, held, []))\n"
        "print(*Path(f'/proc/self/task/{os.getpid()}/children').read_text().split(), flush=True)\n"
        "os.kill(os.getpid(), 9)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    spins, pid = done.stdout.split()
    assert spins == "True"
    deadline = time.monotonic() + 30.0
    while Path("/proc", pid).exists() and time.monotonic() < deadline:
        if Path("/proc", pid, "stat").read_text().rpartition(")")[2].split()[0] == "Z":
            return
        time.sleep(0.01)
    assert not Path("/proc", pid).exists()


def test_heap_and_stack_have_their_pages_before_the_loop_begins() -> None:
    code = (
        "import re, resource, numpy; stack = re.search('VmStk:[ ]*(.*) kB', open('/proc/self/status').read()"
        ".replace(chr(9), ' ')); before = resource.getrusage(0).ru_minflt; "
        "[numpy.ones(1 << 18).sum() for _ in range(50)]; "
        "print(granted.prefaulted, stack.group(1), resource.getrusage(0).ru_minflt - before)"
    )
    done, stack, faults = asking("", code).split()
    assert done == "True"
    assert 1024 * int(stack) >= STACK
    assert int(faults) < 100  # 50 blocks of 2 MiB have 25,600 pages


@pytest.mark.slow
def test_temporary_privileges_are_given_back() -> None:
    before = os.sched_getscheduler(0), os.sched_getaffinity(0)
    for _ in range(2):  # its core is free again
        with on_a_core() as granted:
            assert os.sched_getaffinity(0) == {granted.core}
        assert (os.sched_getscheduler(0), os.sched_getaffinity(0)) == before


def test_lists_of_cores_are_read_as_the_kernel_writes_them() -> None:
    assert core_numbers("\n") == []
    assert core_numbers("1,4-6,9\n") == [1, 4, 5, 6, 9]
