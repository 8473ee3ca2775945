"""Supervise the motion process from its parent: start it, keep its lease, read its output until it ends.

If this process dies, the pipe closes; if it hangs, the lease lapses; either stops the arm. An interrupt while a process
has the arm ends nothing at once: it asks for a controlled stop and waits for its end. An arm without brakes may then be
held until a person confirms that it is supported; the process that holds it is waited for, and never killed.
"""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ident_service.errors import (
    ArmError,
    ArmFault,
    DriverError,
    IdentError,
    MotionRefused,
    PositionUnknown,
    UsageError,
)
from ident_service.motion.control_file import ControlFile
from ident_service.motion.fault_file import CONTROLS, UNFINISHED, FaultFile

_RENEW_SHARE = 0.25  # of the lease
_LAST_WORDS = 30.0  # s to wait for the result of a process that was told to stop
_KINDS: dict[str, type[IdentError]] = {
    kind.__name__: kind for kind in (MotionRefused, PositionUnknown, DriverError, UsageError, ArmError)
}


@dataclass
class Ending:
    """Result that the motion process reported last.

    Attributes:
        report: of a run that was done or stopped, else empty.
        error: kind, message, and code of a fault; else empty.
        code: exit code, None while it runs.
    """

    report: dict[str, Any]
    error: dict[str, str]
    code: int | None = None

    @property
    def heard(self) -> bool:
        """Return whether the motion process reported a result."""
        return bool(self.report or self.error)

    def raise_for(self, faults: FaultFile) -> None:
        """Raise the error that the motion process reported; faults that followed the first are added as notes.

        Raises:
            ArmFault: the fault that was latched first, which is the cause of the others.
            MotionRefused, DriverError, UsageError, ArmError: as the motion process said.
        """
        if self.report:
            return
        kind, message = self.error.get("kind"), self.error.get("message", "")
        latched = faults.latched()
        if kind is None:
            raise self._died(latched)
        error: IdentError
        if kind == ArmFault.__name__:
            code = self.error["code"]
            # A fault that could not be latched, for example because the disk is full, is still reported.
            first, cause = next(iter(latched.items()), (code, message.removeprefix(f"{code}: ")))
            error = ArmFault(first, cause)
            latched.pop(first, None)
        else:
            error = _KINDS.get(kind, ArmError)(message)
        for code, cause in latched.items():
            error.add_note(f"latched, too: {code}: {cause}")
        raise error

    def _died(self, latched: dict[str, str]) -> ArmError:
        died = f"the motion process died without a word ({self._how()})"
        if UNFINISHED not in latched:
            return ArmError(f"{died} before it took the arm; nothing has moved")
        return ArmFault(
            UNFINISHED, f"{died}; drives that hear nothing stop by themselves: look at the arm before `ident ack`"
        )

    def _how(self) -> str:
        if self.code is not None and self.code < 0:
            return signal.Signals(-self.code).name
        return f"exit code {self.code}"


def watched(
    request: dict[str, Any],
    ends: tuple[int, ...],
    lease: float,
    tell: Callable[[str], None],
    stop_requested: Callable[[], bool],
    finish_requested: Callable[[], bool] = lambda: False,
) -> Ending:
    """Start the motion process, keep its lease, and read its output until it ends.

    Args:
        request: what it is to do (`motion/process.py`).
        ends: file descriptors of the ring, for a sink.
        lease: how long the arm moves on when this process is gone [s].
        tell: called with each state that is entered.
        stop_requested: asked several times per lease.
        finish_requested: likewise; it must not wait.

    Raises:
        KeyboardInterrupt: it came before the arm was taken, or the motion process did not end after it.
    """
    paths = os.pathsep.join(path or str(Path.cwd()) for path in sys.path)
    environment = {**os.environ, "PYTHONPATH": paths, "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-P", "-m", "ident_service.motion.process"]
    # A session of its own, so that signals to this process group do not reach it.
    with subprocess.Popen(  # noqa: S603 - our own interpreter and module
        command,
        bufsize=0,  # select does not see a line that waits in a buffer
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        pass_fds=ends,
        env=environment,
        start_new_session=True,
    ) as process:
        if process.stdin is None or process.stdout is None:
            raise AssertionError("pipes were asked for")
        with suppress(BrokenPipeError):
            process.stdin.write(json.dumps({**request, "ends": ends}).encode() + b"\n")
            process.stdin.flush()
        watch = _Watch(process, Path(request["arm_folder"]) / CONTROLS, lease, tell, stop_requested, finish_requested)
        try:
            try:
                watch.hear()
            except KeyboardInterrupt:
                if not watch.hear_the_end():
                    raise
        except BaseException:
            process.stdin.close()  # ends the motion process's input: the motion has no owner any more
            watch.ask_stop()
            while process.poll() is None and not watch.hear(time.monotonic() + _LAST_WORDS):
                if not watch.holding:
                    process.kill()  # it hangs, and has sent nothing to the drives for as long
            raise
        finally:
            watch.close()
        watch.ending.code = process.wait()
    return watch.ending


class _Watch:
    """Reader of one motion process's output, which also keeps its lease.

    Attributes:
        holding: whether the arm would fall without it.
    """

    def __init__(
        self,
        process: subprocess.Popen[bytes],
        path: Path,
        lease: float,
        tell: Callable[[str], None],
        stop_requested: Callable[[], bool],
        finish_requested: Callable[[], bool],
    ) -> None:
        self.ending = Ending({}, {})
        self._process, self._path, self._lease = process, path, lease
        self._tell, self._stop_requested, self._finish_requested = tell, stop_requested, finish_requested
        self._controls: ControlFile | None = None
        self._asked = self._finishing = False
        self._fault = ""
        self.holding = False

    def hear(self, until: float = float("inf")) -> bool:
        """Read the output and renew the lease until the process ends or `until` [s]; return whether it ended."""
        stdout = self._process.stdout
        assert stdout is not None  # noqa: S101 - asked for by `watched`
        while time.monotonic() < until:
            if self._controls is not None:
                self._controls.renew()
                if not self._asked and self._stop_requested():
                    self.ask_stop()
                if not self._finishing and self._finish_requested():
                    self._finishing = True
                    self._controls.ask_finish()
            ready, _, _ = select.select([stdout], [], [], _RENEW_SHARE * self._lease)
            if not ready:
                continue
            line = stdout.readline()
            if not line.endswith(b"\n"):  # end of the output, or a line cut off by a kill
                return True
            with suppress(ValueError):  # the rest of a line whose beginning was lost in an interrupt
                self._take(json.loads(line))
        return False

    def hear_the_end(self) -> bool:
        """After an interrupt, wait up to a bound for the end of the stop; return whether a result was reported."""
        if self._controls is None:
            return False  # the motion process has not taken the arm yet
        with _deaf():
            self.ask_stop()
            self._tell(f"interrupted: the arm is being stopped under control; waiting {_LAST_WORDS:g} s at most")
            ended = self.hear(time.monotonic() + _LAST_WORDS)
            while self.holding and not ended:
                ended = self.hear(time.monotonic() + _LAST_WORDS)
            return ended and self.ending.heard

    def ask_stop(self) -> None:
        """Ask for a controlled stop, if a process has the arm."""
        if self._controls is not None:
            self._asked = True
            self._controls.ask_stop()

    def close(self) -> None:
        """Close the control file."""
        if self._controls is not None:
            self._controls.close()

    def _take(self, said: dict[str, Any]) -> None:
        if "pid" in said:
            with suppress(UsageError):  # it died at once, as the next read will show
                self._controls = ControlFile.reach(self._path)
        self.ending.report = said.get("report", self.ending.report)
        self.ending.error = said.get("error", self.ending.error)
        if "state" in said:
            self._tell(said["state"])
        if "fault" in said:
            self._fault = self._fault or said["fault"]
            self._tell(f"fault: {said['fault']}")
        if "held" in said:
            self.holding = True
            self._latch()
            self._tell(said["held"])

    def _latch(self) -> None:
        """Let everybody know the fault of an arm that is held: its own process latches it when somebody supports it."""
        code, _, cause = self._fault.partition(": ")
        if code:
            with suppress(UsageError):  # a full disk, perhaps; it is latched at the end
                FaultFile(self._path.parent).latch(code, cause)


@contextmanager
def _deaf() -> Iterator[None]:
    """Ignore SIGINT in the block, after an interrupt was received; the main thread only."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
