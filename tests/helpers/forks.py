"""Processes that are this one as it stands, where starting an interpreter is not what a test is about."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import time
import warnings
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest


def fork() -> int:
    """Fork; 0 in the child, which must end by `os._exit`."""
    with warnings.catch_warnings():
        # Python 3.12 warns of the threads of a test runner; no child here takes their locks.
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        gc.freeze()  # what the parent has made is not looked through again, nor copied for that
    return child


class ForkedPlant:
    """Stand in for `subprocess.Popen` of a plant process: the same program with its modules already imported."""

    def __init__(self, command: Sequence[str], *, pass_fds: Sequence[int], **options: Any) -> None:
        from sim_backend import plant_process

        assert command[-1] == plant_process.__name__
        assert options["start_new_session"]
        hears, tells = os.pipe(), os.pipe()
        self.pid = fork()
        if self.pid == 0:
            code = 1
            try:
                os.setsid()
                os.dup2(hears[0], 0)
                os.dup2(tells[1], 1)
                kept = sorted(pass_fds)
                for first, last in zip([3, *(fd + 1 for fd in kept)], [*kept, os.sysconf("SC_OPEN_MAX")], strict=True):
                    os.closerange(first, last)  # a connection of the parent's must not outlive it
                code = plant_process.main()
            finally:
                os._exit(code)
        os.close(hears[0])
        os.close(tells[1])
        self.stdin, self.stdout = os.fdopen(hears[1], "wb"), os.fdopen(tells[0], "rb")

    def wait(self, timeout: float) -> None:
        """Wait for its end; TimeoutExpired where it does not come."""
        end = time.monotonic() + timeout
        while os.waitpid(self.pid, os.WNOHANG) == (0, 0):
            if time.monotonic() > end:
                raise subprocess.TimeoutExpired("plant", timeout)
            time.sleep(0.001)

    def kill(self) -> None:
        """Kill it."""
        os.kill(self.pid, signal.SIGKILL)


def fork_plants(patch: pytest.MonkeyPatch) -> None:
    """Have plants of their own process forked from this one."""
    processes = SimpleNamespace(Popen=ForkedPlant, PIPE=subprocess.PIPE, TimeoutExpired=subprocess.TimeoutExpired)
    patch.setattr("sim_backend.remote_arm.subprocess", processes)
