"""Whether whoever asked for the motion is still there: its pipe in any kind of time, its lease in real time only."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from ident_service.motion.command_channel import ControlFile, SupervisedCommands

LEASE = 2_000_000_000


class Time:
    """A clock that a test moves."""

    now = 0

    def __call__(self) -> int:
        return self.now


@pytest.fixture
def time() -> Time:
    return Time()


@pytest.fixture
def controls(tmp_path: Path, time: Time) -> Iterator[ControlFile]:
    with ControlFile.take(tmp_path / "control", LEASE * 1e-9, time) as taken:
        yield taken


@pytest.mark.parametrize("lock_step", [False, True])
def test_a_parent_that_is_killed_is_gone_at_once(controls: ControlFile, lock_step: bool) -> None:
    parent = subprocess.Popen(
        [sys.executable, "-c", "import signal; print(flush=True); signal.pause()"], stdout=subprocess.PIPE
    )
    assert parent.stdout is not None
    assert parent.stdout.readline() == b"\n"
    lifeline = SupervisedCommands(controls, parent.stdout.fileno(), lock_step=lock_step)
    assert lifeline.lease_ok(0)
    os.kill(parent.pid, signal.SIGKILL)
    parent.wait()
    assert lifeline.requester_gone
    assert not lifeline.lease_ok(0)
    parent.stdout.close()


def test_what_is_written_into_the_pipe_does_not_end_it(controls: ControlFile) -> None:
    end, other = os.pipe()
    lifeline = SupervisedCommands(controls, end, lock_step=True)
    os.write(other, b"more")
    assert lifeline.lease_ok(0)
    os.close(other)
    assert not lifeline.lease_ok(0)
    os.close(end)


def test_a_lease_lapses_in_real_time_only(controls: ControlFile, time: Time) -> None:
    end, other = os.pipe()
    real, virtual = (SupervisedCommands(controls, end, lock_step=lock_step) for lock_step in (False, True))
    time.now = LEASE + 1
    assert not real.lease_ok(0)
    assert virtual.lease_ok(0)
    controls.renew()
    assert real.lease_ok(0)
    for fd in (end, other):
        os.close(fd)


def test_stop_and_pause_are_those_of_the_control_file(controls: ControlFile) -> None:
    end, other = os.pipe()
    lifeline = SupervisedCommands(controls, end, lock_step=False)
    assert (lifeline.stop, lifeline.pause, lifeline.finish) == (False, False, False)
    controls.request_finish()
    assert (lifeline.stop, lifeline.pause, lifeline.finish) == (False, False, True)
    controls.request_pause(True)
    controls.request_stop()
    assert (lifeline.stop, lifeline.pause) == (True, True)
    lifeline.announce_hold()
    assert controls.waiting
    assert not lifeline.supported
    controls.confirm_support()
    assert lifeline.supported
    for fd in (end, other):
        os.close(fd)
