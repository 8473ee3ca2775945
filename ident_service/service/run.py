"""A run on an arm: recorder and motion each in a process of their own, watched from here, everything kept in a folder.

This process holds the pipe and the lease of the motion process: what ends it closes the pipe, and what makes it hang
lets the lease lapse; either stops the arm. The folder is there from the beginning and keeps what was recorded, whether
the run ended well or not. How it ended is written by the motion process, and from here where that could not.
"""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

from ident_service.config.schema import ArmConfig
from ident_service.errors import ArmError, ArmFault, DriverError, IdentError, MotionRefused, UsageError
from ident_service.excitation.excitation import Excitation
from ident_service.model.arm_model import arm_model
from ident_service.model.urdf import urdf_text
from ident_service.motion.control_file import ControlFile
from ident_service.motion.controls import LEASE_SECONDS
from ident_service.motion.ending import write_ending
from ident_service.motion.factory import make_arm
from ident_service.motion.fault_file import CONTROLS, UNFINISHED, FaultFile
from ident_service.motion.plans import HOMING_SPEED, Destination
from ident_service.motion.preflight_ticket import Ticket
from ident_service.record.recorder_process import RecorderProcess
from ident_service.results.files import write_atomically
from ident_service.results.run_folder import write_manifest
from ident_service.service.arm_state import arm_folder, fault_file
from ident_service.service.preflight import write_ticket

_RENEW_SHARE = 0.25  # of the lease
_LAST_WORDS = 30.0  # s for a process that was told to stop
_KINDS: dict[str, type[IdentError]] = {
    kind.__name__: kind for kind in (MotionRefused, DriverError, UsageError, ArmError)
}


@dataclass(frozen=True)
class Ran:
    """How a run ended.

    Attributes:
        folder: with everything that was kept.
        report: what the motion process said: state, cycles, peaks, timing.
    """

    folder: Path
    report: dict[str, Any]


def run_motion(
    config: ArmConfig,
    motion: Excitation | Destination,
    folder: Path,
    state: Path,
    ticket: Ticket,
    *,
    speed: float = 1.0,
    lease: float = LEASE_SECONDS,
    log_frames: bool = False,
    tell: Callable[[str], None] = lambda _: None,
    stop_requested: Callable[[], bool] = lambda: False,
) -> Ran:
    """Move an arm along a motion, or to a destination, and record it.

    Args:
        config: of the arm.
        motion: made for it; or where one slow way is to lead, home for example.
        folder: the run folder; it must not exist.
        state: the state folder, where the arm's controls and faults are.
        ticket: of the preflight; the motion process holds it against the open arm.
        speed: share of the motion's own speed; ways to a destination have theirs.
        lease: how long the arm moves on when this process is gone [s].
        log_frames: whether every frame of the fieldbus is kept in `can.log`, too, in candump's format.
        tell: called with each state that is entered.
        stop_requested: asked several times a second.

    Raises:
        UsageError: the folder exists.
        MotionRefused: nothing has moved; a fault that nobody has acknowledged is a reason too.
        ArmFault: a fault stopped the motion; it stays latched until `FaultFile.acknowledge`.
        DriverError: the arm cannot be had.
        RecordingError: the recording failed, which has stopped the arm.
    """
    faults = fault_file(state, config.name)
    faults.require_none(faults.latched())
    if folder.exists():
        raise UsageError(f"{folder}: exists already; give a folder that does not")
    model = arm_model(config)
    clock = make_arm(config).clock
    folder.mkdir(parents=True)
    excitation = motion.to_json() if isinstance(motion, Excitation) else None
    name = motion.name if isinstance(motion, Excitation) else motion.value
    speed = speed if isinstance(motion, Excitation) else HOMING_SPEED
    write_ticket(folder / "ticket.json", ticket)
    write_atomically(folder / "arm.json", config.model_dump_json(indent=1) + "\n")
    attachments = {"arm.json": config.model_dump_json(indent=1).encode()}
    if excitation is not None:
        write_atomically(folder / "excitation.json", excitation + "\n")
        attachments["excitation.json"] = excitation.encode()
    metadata = {"arm": config.name, "arm_sha256": config.sha256, "motion": name, "speed": repr(speed)}
    recording = folder / "run.mcap"
    description = urdf_text(model, model.prior)
    recorder = RecorderProcess(
        recording,
        model.chain.names,
        description,
        clock.utc_offset_ns,
        attachments,
        metadata,
        lock_step=clock.lock_step,
        local=False,
    )
    request = {
        "config": json.loads(config.model_dump_json()),
        "excitation": excitation,
        "destination": None if isinstance(motion, Excitation) else motion.value,
        "recording": str(recording),
        "folder": str(folder),
        "arm_folder": str(arm_folder(state, config.name)),
        "lease": lease,
        "ticket": ticket.to_json(),
        "speed": speed,
        "log_frames": log_frames,
    }
    try:
        with recorder:
            ending = _watched(request, astuple(recorder.ends), lease, tell, stop_requested)
            ending.raise_for(faults)
    except BaseException as error:
        write_ending(folder, {"error": str(error) or type(error).__name__})
        raise
    finally:
        write_manifest(folder)
    return Ran(folder, ending.report)


@dataclass
class _Ending:
    """What the motion process said at last."""

    report: dict[str, Any]
    error: dict[str, str]
    code: int | None = None

    def raise_for(self, faults: FaultFile) -> None:
        """Turn what went wrong into the error that it was."""
        if self.report:
            return
        kind, message = self.error.get("kind"), self.error.get("message", "")
        if kind == ArmFault.__name__:
            code = self.error["code"]
            raise ArmFault(code, message.removeprefix(f"{code}: "))
        if kind is not None:
            raise _KINDS.get(kind, ArmError)(message)
        died = f"the motion process died without a word ({self._how()})"
        if UNFINISHED not in faults.latched():
            raise ArmError(f"{died} before it took the arm; nothing has moved")
        raise ArmFault(
            UNFINISHED, f"{died}; drives that hear nothing stop by themselves: look at the arm before `ident ack`"
        )

    def _how(self) -> str:
        if self.code is not None and self.code < 0:
            return signal.Signals(-self.code).name
        return f"exit code {self.code}"


def _watched(
    request: dict[str, Any],
    ends: tuple[int, ...],
    lease: float,
    tell: Callable[[str], None],
    stop_requested: Callable[[], bool],
) -> _Ending:
    """Start the motion process, keep its lease, hear what it says until it ends."""
    paths = os.pathsep.join(path or str(Path.cwd()) for path in sys.path)
    environment = {**os.environ, "PYTHONPATH": paths, "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-P", "-m", "ident_service.motion.process"]
    ending = _Ending({}, {})
    # Another session, so that what a terminal or a service manager sends to our group does not reach it.
    with subprocess.Popen(  # noqa: S603 - our own interpreter and module
        command,
        bufsize=0,  # a line that waits in a buffer is one that select does not see
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
        controls: ControlFile | None = None
        asked = False
        try:
            while True:
                if controls is not None:
                    controls.renew()
                    if stop_requested() and not asked:
                        asked = True
                        controls.ask_stop()
                ready, _, _ = select.select([process.stdout], [], [], _RENEW_SHARE * lease)
                if not ready:
                    continue
                line = process.stdout.readline()
                if not line.endswith(b"\n"):  # the end, or what was killed in the middle of a word
                    break
                said = json.loads(line)
                if "pid" in said:
                    with suppress(UsageError):  # it died at once, which is heard next
                        controls = ControlFile.reach(Path(request["arm_folder"]) / CONTROLS)
                if "state" in said:
                    tell(said["state"])
                ending.report = said.get("report", ending.report)
                ending.error = said.get("error", ending.error)
        except BaseException:
            process.stdin.close()  # nobody asks for this motion any more
            if controls is not None:
                controls.ask_stop()
            try:
                process.wait(_LAST_WORDS)
            except subprocess.TimeoutExpired:
                process.kill()  # it hangs, and the drives have heard nothing for as long
            raise
        finally:
            if controls is not None:
                controls.close()
        ending.code = process.wait()
    return ending
