"""Run a motion on an arm: recorder and motion each in a process of their own, supervised from here.

If this process dies, the pipe closes; if it hangs, the lease lapses; either stops the arm. An interrupt while a process
has the arm ends nothing at once: it asks for a controlled stop and waits for its end. An arm without brakes may then be
held until a person confirms that it is supported; the process that holds it is waited for, and never killed.

It may die or be late: then the motion just goes on to its end. Asking is one look at a pipe, so that neither the lease
nor a stop ever waits for it.

The folder exists from the beginning and keeps what was recorded, whether the run ended well or not; only a run that was
refused before anything moved leaves none. The motion process writes how the run ended, or this process if that one
could not. A file that cannot be written never hides why a run ended: it becomes a note of that error.
"""

from __future__ import annotations

import json
import os
import select
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import astuple, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

from drivers.clock import utc_offset_of_recording_ns
from ident_service.config.arm import ArmConfig
from ident_service.errors import (
    ArmError,
    ArmFault,
    DriverError,
    IdentError,
    MotionRefused,
    PositionUnknown,
    RecordingError,
    UsageError,
)
from ident_service.estimation.target import Target
from ident_service.excitation.motion_file import Excitation
from ident_service.excitation.trajectory import FourierPath
from ident_service.model.appearance import visible_bodies
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.base_parameters import base_parameters
from ident_service.model.limited_process import module_command
from ident_service.model.urdf import urdf_text
from ident_service.motion.arm_factory import make_arm
from ident_service.motion.command_channel import LEASE_SECONDS, ControlFile
from ident_service.motion.ending import ENDED, write_ending
from ident_service.motion.fault_store import CONTROLS, UNFINISHED, FaultStore
from ident_service.motion.run_plan import HOMING_SPEED, Destination
from ident_service.motion.ticket import Ticket, subject_of
from ident_service.operations.arm_checks import write_ticket
from ident_service.recordings.files import require_writable
from ident_service.recordings.recorder import RecorderProcess
from ident_service.registry.state_folder import arm_fault_store, arm_folder
from ident_service.results.manifest import require_writable_place, write_atomically, write_manifest

_RENEW_SHARE = 0.25  # of the lease
_LAST_WORDS = 30.0  # s to wait for the result of a process that was told to stop
_KINDS: dict[str, type[IdentError]] = {
    kind.__name__: kind for kind in (MotionRefused, PositionUnknown, DriverError, UsageError, ArmError)
}


@dataclass
class ProcessResult:
    """Result that the motion process reported last.

    Attributes:
        report: report of a run that was done or stopped, else empty.
        error: kind, message, and code of a fault; else empty.
        code: exit code, None while it runs.
        taken: whether the process has had the arm.
    """

    report: dict[str, Any]
    error: dict[str, str]
    code: int | None = None
    taken: bool = False

    @property
    def reported(self) -> bool:
        """Return whether the motion process reported a run or an error before it ended."""
        return bool(self.report or self.error)

    def raise_for(self, faults: FaultStore) -> None:
        """Raise the motion process's error, or how it died, naming faults already latched; return if it reported a run.

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
            error.add_note(f"also active: {code}: {cause}")
        raise error

    def _died(self, latched: dict[str, str]) -> ArmError:
        died = f"the motion process died without a message ({self._how()})"
        if UNFINISHED not in latched:
            return ArmError(f"{died} before it opened the arm; nothing has moved")
        return ArmFault(
            UNFINISHED,
            f"{died}; drives without commands stop by themselves: check the arm before `ident acknowledge`",
        )

    def _how(self) -> str:
        if self.code is not None and self.code < 0:
            return signal.Signals(-self.code).name
        return f"exit code {self.code}"


def supervise_motion_process(
    request: dict[str, Any],
    ring_descriptors: tuple[int, ...],
    lease_seconds: float,
    tell: Callable[[str], None],
    stop_requested: Callable[[], bool],
    finish_requested: Callable[[], bool] = lambda: False,
) -> ProcessResult:
    """Start the motion process, renew its lease until it ends, and return what it reported and its exit code.

    Args:
        request: request to the motion process (`motion/process.py`).
        ring_descriptors: file descriptors of the ring, for a sink.
        lease_seconds: how long the arm moves on when this process is gone [s].
        tell: called with each state that is entered.
        stop_requested: called several times per lease; True stops the motion.
        finish_requested: called several times per lease, without waiting; True finishes the motion early.

    Raises:
        KeyboardInterrupt: it came before the arm was taken, or the motion process did not end after it.
    """
    command, environment = module_command("ident_service.motion.process")
    # A session of its own, so that signals to this process group do not reach it.
    with subprocess.Popen(  # noqa: S603 - our own interpreter and module
        command,
        bufsize=0,  # select does not see a line that waits in a buffer
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        pass_fds=ring_descriptors,
        env=environment,
        start_new_session=True,
    ) as process:
        if process.stdin is None or process.stdout is None:
            raise AssertionError("pipes were asked for")
        with suppress(BrokenPipeError):
            process.stdin.write(json.dumps({**request, "ends": ring_descriptors}).encode() + b"\n")
            process.stdin.flush()
        watch = _Watch(
            process, Path(request["arm_folder"]) / CONTROLS, lease_seconds, tell, stop_requested, finish_requested
        )
        try:
            try:
                watch.hear()
            except KeyboardInterrupt:
                if not watch.wait_for_result():
                    raise
        except BaseException:
            process.stdin.close()  # ends the motion process's input: the motion has no owner any more
            watch.request_stop()
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
        self.ending = ProcessResult({}, {})
        self._process, self._path, self._lease = process, path, lease
        self._tell, self._stop_requested, self._finish_requested = tell, stop_requested, finish_requested
        self._controls: ControlFile | None = None
        self._asked = self._finishing = False
        self._fault = ""
        self.holding = False

    def hear(self, until: float = float("inf")) -> bool:
        """Read the output and renew the lease until the process ends or `until` [s]; return whether it ended."""
        stdout = self._process.stdout
        assert stdout is not None  # noqa: S101 - asked for
        while time.monotonic() < until:
            if self._controls is not None:
                self._controls.renew()
                if not self._asked and self._stop_requested():
                    self.request_stop()
                if not self._finishing and self._finish_requested():
                    self._finishing = True
                    self._controls.request_finish()
            ready, _, _ = select.select([stdout], [], [], _RENEW_SHARE * self._lease)
            if not ready:
                continue
            line = stdout.readline()
            if not line.endswith(b"\n"):  # end of the output, or a line cut off by a kill
                return True
            with suppress(ValueError):  # the rest of a line whose beginning was lost in an interrupt
                self._take(json.loads(line))
        return False

    def wait_for_result(self) -> bool:
        """After an interrupt, wait up to a bound for the end of the stop; return whether a result was reported."""
        if self._controls is None:
            return False  # the motion process has not taken the arm yet
        with _ignoring_interrupts():
            self.request_stop()
            self._tell(f"interrupted: the arm is being stopped under control; waiting {_LAST_WORDS:g} s at most")
            ended = self.hear(time.monotonic() + _LAST_WORDS)
            while self.holding and not ended:
                ended = self.hear(time.monotonic() + _LAST_WORDS)
            return ended and self.ending.reported

    def request_stop(self) -> None:
        """Ask for a controlled stop, if a process has the arm."""
        if self._controls is not None:
            self._asked = True
            self._controls.request_stop()

    def close(self) -> None:
        """Close the control file."""
        if self._controls is not None:
            self._controls.close()

    def _take(self, output: dict[str, Any]) -> None:
        if "pid" in output:
            self.ending.taken = True
            with suppress(UsageError, DriverError):  # it died at once, or its lease lapses, as its output will say
                self._controls = ControlFile.reach(self._path)
        self.ending.report = output.get("report", self.ending.report)
        self.ending.error = output.get("error", self.ending.error)
        if "state" in output:
            self._tell(output["state"])
        if "fault" in output:
            self._fault = self._fault or output["fault"]
            self._tell(f"fault: {output['fault']}")
        if "held" in output:
            self.holding = True
            self._latch()
            self._tell(output["held"])

    def _latch(self) -> None:
        """Let everybody know the fault of an arm that is held: its own process latches it when somebody supports it."""
        code, _, cause = self._fault.partition(": ")
        if code:
            with suppress(UsageError):  # a full disk, perhaps; it is latched at the end
                FaultStore(self._path.parent).latch(code, cause)


@contextmanager
def _ignoring_interrupts() -> Iterator[None]:
    """Ignore SIGINT in the block, after an interrupt was received; the main thread only."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


_MOST = 4096  # bytes that are read at once


def require_target(target: Target, model: ArmModel) -> None:
    """Raise UsageError unless a target's share is between 0 and 1 and its parameters are the arm's.

    Raises:
        UsageError: a share not between 0 and 1, or a parameter that is none of the arm's.
    """
    if not 0.0 < target.share < 1.0:
        raise UsageError(f"a target of {target.share:g} of a parameter; it must be above 0 and below 1")
    target.base_indices(base_parameters(model.chain, model.layout), model.config.name)


def least_seconds(motion: Excitation, speed: float) -> float:
    """Return the time before which the motion is not finished early [s]: its first period; 0 without a period."""
    return motion.path.series.period / speed if isinstance(motion.path, FourierPath) else 0.0


class TargetMonitor:
    """Monitor of a run's accuracy target.

    Attributes:
        output: result once the target is reached, `seconds` of the motion and the largest `share`; None before.
        period: period of the motion [s], zero where it has none.
    """

    def __init__(self, folder: Path, target: Target, least: float, tell: Callable[[str], None]) -> None:
        """Create the monitor; no process is started before the block is entered.

        Args:
            folder: of the run.
            target: accuracy target.
            least: time of the motion before which nothing counts [s]: its period, zero where it has none.
            tell: called once, when the target is reached or when the process has failed.
        """
        self._request = {"folder": str(folder), "share": target.share, "parameters": target.parameters, "least": least}
        self.period = least
        self._tell, self._over, self._heard = tell, False, b""
        self.output: dict[str, Any] | None = None

    def __enter__(self) -> Self:
        """Start the process that follows the recording."""
        command, environment = module_command("ident_service.operations.target_process")
        self._process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
            command,
            bufsize=0,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
            start_new_session=True,
        )
        assert self._process.stdin is not None  # noqa: S101 - asked for
        with suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(self._request).encode() + b"\n")
        return self

    def __exit__(self, *_: object) -> None:
        """Kill the process, which holds nothing that could be lost."""
        self._process.kill()
        with self._process:
            pass

    def reached(self) -> bool:
        """Return whether the target has been reached; never waits."""
        stdout = self._process.stdout
        assert stdout is not None  # noqa: S101 - asked for
        while not self._over and select.select([stdout], [], [], 0.0)[0]:
            self._read_output(os.read(stdout.fileno(), _MOST))
        return self.output is not None

    def _read_output(self, part: bytes) -> None:
        self._heard = (self._heard + part)[:_MOST]
        if part and b"\n" not in self._heard:
            return
        self._over = True
        try:
            output = json.loads(self._heard)
            share, seconds = float(output["share"]), float(output["seconds"])
        except (ValueError, KeyError, TypeError):
            self._tell("the target is no longer monitored; the motion continues to its end")
        else:
            self.output = {"share": share, "seconds": seconds}
            self._tell(f"target reached: largest deviation {share:.2%} after {seconds:.1f} s of the motion")


@dataclass(frozen=True)
class RunResult:
    """Result of a run.

    Attributes:
        folder: folder of the run, with recording, report and manifest.
        report: report of the motion process: state, cycles, peaks, timing.
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
    lease_seconds: float = LEASE_SECONDS,
    log_frames: bool = False,
    on_begin: Callable[[], None] = lambda: None,
    tell: Callable[[str], None] = lambda _: None,
    on_progress: Callable[[float], None] = lambda _: None,
    stop_requested: Callable[[], bool] = lambda: False,
    requested_ns: int | None = None,
    target: Target | None = None,
) -> RunResult:
    """Move an arm along a motion, or to a destination, by a valid ticket, and record it into a new folder.

    Args:
        config: of the arm.
        motion: motion that was made for this arm; or the destination of one slow way, home for example.
        folder: the run folder; it must not exist.
        state: the state folder, where the arm's controls and faults are.
        ticket: ticket of the preflight; the motion process compares it with the open arm.
        speed: share of the motion's own speed; motions to a destination have a fixed speed.
        lease_seconds: how long the arm moves on when this process is gone [s].
        log_frames: whether every frame of the fieldbus is kept in `can.log`, too, in candump's format.
        on_begin: called when all checks that do not need the arm have passed, and the folder exists.
        tell: called with each state that is entered.
        on_progress: called several times a second with how long the arm has been driven, in its own time [s].
        stop_requested: called several times a second; True stops the motion.
        requested_ns: time when a person asked for the motion, on the machine's monotonic clock [ns]; now when None. A
            stop that was asked for since then keeps it from beginning.
        target: accuracy target at which the run is finished early; None for one that goes on to its end.

    Raises:
        UsageError: the run folder exists or cannot be made, the state folder cannot be written, or the target is none;
            nothing has moved.
        MotionRefused: nothing has moved; a fault that nobody has acknowledged is a reason too.
        ArmFault: a fault stopped the motion, the first of those that stay latched until `FaultStore.acknowledge`.
        DriverError: the arm cannot be had.
        RecordingError: the recording failed, which has stopped the arm.
    """
    requested_ns = time.monotonic_ns() if requested_ns is None else requested_ns
    faults = arm_fault_store(state, config.name)
    faults.require_none(faults.latched())
    if folder.exists():
        raise UsageError(f"{folder}: exists already; give a folder that does not")
    model = arm_model(config)
    subject = subject_of(model, motion if isinstance(motion, Excitation) else None, None)
    ticket.require_valid_for(ticket.with_arm(subject), datetime.now(UTC))
    if target is not None:
        require_target(target, model)
    require_writable_place(folder)
    require_writable(arm_folder(state, config.name))
    clock = make_arm(config).clock
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise UsageError(f"{folder}: cannot be made: {error.strerror}") from None
    excitation = motion.to_json() if isinstance(motion, Excitation) else None
    name = motion.name if isinstance(motion, Excitation) else motion.value
    speed = speed if isinstance(motion, Excitation) else HOMING_SPEED
    attachments = {"arm.json": config.model_dump_json(indent=1).encode()}
    if excitation is not None:
        attachments["excitation.json"] = excitation.encode()
    metadata = {"arm": config.name, "arm_sha256": config.sha256, "motion": name, "speed": repr(speed)}
    metadata["clock"] = "virtual" if clock.lock_step else "monotonic"
    metadata["driver"] = "" if config.driver is None else config.driver.kind
    recording = folder / "run.mcap"
    description = urdf_text(model, model.prior, visible_bodies(model))
    recorder = RecorderProcess(
        recording,
        model.chain.names,
        description,
        utc_offset_of_recording_ns(clock),
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
        "lease": lease_seconds,
        "requested_ns": requested_ns,
        "ticket": ticket.to_json(),
        "speed": speed,
        "log_frames": log_frames,
    }
    started, ending = False, None

    def watched() -> bool:
        on_progress(recorder.written / config.control.rate)
        return stop_requested()

    try:
        write_ticket(folder / "ticket.json", ticket)
        for file, content in attachments.items():
            write_atomically(folder / file, content.decode() + "\n")
        on_begin()
        reaching = None
        if target is not None and isinstance(motion, Excitation):
            reaching = TargetMonitor(folder, target, least_seconds(motion, speed), tell)
        with recorder, reaching or nullcontext():
            started = True
            finish = (lambda: False) if reaching is None else reaching.reached
            ending = supervise_motion_process(request, astuple(recorder.ends), lease_seconds, tell, watched, finish)
            ending.raise_for(faults)
    except BaseException as error:
        refused = isinstance(error, MotionRefused) or (ending is not None and ending.reported and not ending.taken)
        if started and not (refused and not faults.latched()):
            _keep(folder, error)
        else:
            shutil.rmtree(folder, ignore_errors=True)
        raise
    write_manifest(folder)
    if reaching is None or target is None:
        return RunResult(folder, ending.report)
    wanted = {"share": target.share, "parameters": list(target.parameters), "reached": reaching.output}
    wanted["missed"] = [] if reaching.output is not None else _missed(folder, target, reaching.period, tell)
    return RunResult(folder, {**ending.report, "until": wanted})


def _missed(folder: Path, until: Target, period: float, tell: Callable[[str], None]) -> list[dict[str, Any]] | None:
    """Return which parameters a completed run did not determine well enough; None if its recording cannot be judged."""
    # Loads the estimator only now, after the motion.
    from ident_service.operations.target_process import missed

    try:
        return missed(folder, until, period)
    except IdentError as error:
        tell(f"parameters that missed the target are unknown: {error}")
        return None


def _keep(folder: Path, error: BaseException) -> None:
    """Write how a run ended, unless the motion process has, and the manifest of its folder."""

    def ending() -> None:
        # A run whose recording could not be finished has failed, even if the motion process ended well.
        if isinstance(error, RecordingError) or not (folder / ENDED).exists():
            cause = "interrupted" if isinstance(error, KeyboardInterrupt) else str(error) or type(error).__name__
            write_ending(folder, {"error": cause})

    for write in (ending, lambda: write_manifest(folder)):
        try:
            write()
        except (UsageError, OSError) as second:
            error.add_note(str(second))
