"""Run a motion on an arm: recorder and motion in processes of their own, supervised, all kept in a folder.

The folder exists from the beginning and keeps what was recorded, whether the run ended well or not; only a run that was
refused before anything moved leaves none. The motion process writes how the run ended, or this process if that one
could not. A file that cannot be written never hides why a run ended: it becomes a note of that error.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import astuple, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ident_service.config.schema import ArmConfig
from ident_service.errors import IdentError, MotionRefused, RecordingError, UsageError
from ident_service.estimation.target import Target
from ident_service.excitation.excitation import Excitation
from ident_service.model.arm_model import arm_model
from ident_service.model.urdf import urdf_text
from ident_service.motion.controls import LEASE_SECONDS
from ident_service.motion.ending import ENDED, write_ending
from ident_service.motion.factory import make_arm
from ident_service.motion.plans import HOMING_SPEED, Destination
from ident_service.motion.ticket import Ticket, subject_of
from ident_service.operations.arm_state import arm_folder, fault_file
from ident_service.operations.preflight import write_ticket
from ident_service.operations.reaching import Reaching, least_seconds, require_target
from ident_service.operations.watching import watched
from ident_service.recordings.files import require_writable
from ident_service.recordings.recorder_process import RecorderProcess
from ident_service.results.files import require_place, write_atomically
from ident_service.results.manifest import write_manifest


@dataclass(frozen=True)
class Ran:
    """Result of a run.

    Attributes:
        folder: of the run, with recording, report and manifest.
        report: of the motion process: state, cycles, peaks, timing.
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
    begin: Callable[[], None] = lambda: None,
    tell: Callable[[str], None] = lambda _: None,
    stop_requested: Callable[[], bool] = lambda: False,
    asked_ns: int | None = None,
    until: Target | None = None,
) -> Ran:
    """Move an arm along a motion, or to a destination, and record it.

    Args:
        config: of the arm.
        motion: made for it; or where one slow way is to lead, home for example.
        folder: the run folder; it must not exist.
        state: the state folder, where the arm's controls and faults are.
        ticket: of the preflight; the motion process compares it with the open arm.
        speed: share of the motion's own speed; motions to a destination have a fixed speed.
        lease: how long the arm moves on when this process is gone [s].
        log_frames: whether every frame of the fieldbus is kept in `can.log`, too, in candump's format.
        begin: called when all checks that do not need the arm have passed, and the folder exists.
        tell: called with each state that is entered.
        stop_requested: asked several times a second.
        asked_ns: when a person asked for the motion, on the machine's monotonic clock [ns]; now when None. A stop that
            was asked for since then keeps it from beginning.
        until: accuracy target at which the run is finished early; None for one that goes on to its end.

    Raises:
        UsageError: the run folder exists or cannot be made, the state folder cannot be written, or the target is none;
            nothing has moved.
        MotionRefused: nothing has moved; a fault that nobody has acknowledged is a reason too.
        ArmFault: a fault stopped the motion, the first of those that stay latched until `FaultFile.acknowledge`.
        DriverError: the arm cannot be had.
        RecordingError: the recording failed, which has stopped the arm.
    """
    asked_ns = time.monotonic_ns() if asked_ns is None else asked_ns
    faults = fault_file(state, config.name)
    faults.require_none(faults.latched())
    if folder.exists():
        raise UsageError(f"{folder}: exists already; give a folder that does not")
    model = arm_model(config)
    subject = subject_of(model, motion if isinstance(motion, Excitation) else None, None)
    ticket.require_valid_for(ticket.with_arm(subject), datetime.now(UTC))
    if until is not None:
        require_target(until, model)
    require_place(folder)
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
        "asked_ns": asked_ns,
        "ticket": ticket.to_json(),
        "speed": speed,
        "log_frames": log_frames,
    }
    started = False
    try:
        write_ticket(folder / "ticket.json", ticket)
        for file, content in attachments.items():
            write_atomically(folder / file, content.decode() + "\n")
        begin()
        reaching = None
        if until is not None and isinstance(motion, Excitation):
            reaching = Reaching(folder, until, least_seconds(motion, speed), tell)
        with recorder, reaching or nullcontext():
            started = True
            finish = (lambda: False) if reaching is None else reaching.reached
            ending = watched(request, astuple(recorder.ends), lease, tell, stop_requested, finish)
            ending.raise_for(faults)
    except BaseException as error:
        if started and not (isinstance(error, MotionRefused) and not faults.latched()):
            _keep(folder, error)
        else:
            shutil.rmtree(folder, ignore_errors=True)
        raise
    write_manifest(folder)
    if reaching is None or until is None:
        return Ran(folder, ending.report)
    wanted = {"share": until.share, "parameters": list(until.parameters), "reached": reaching.said}
    wanted["missed"] = [] if reaching.said is not None else _missed(folder, until, reaching.period, tell)
    return Ran(folder, {**ending.report, "until": wanted})


def _missed(folder: Path, until: Target, period: float, tell: Callable[[str], None]) -> list[dict[str, Any]] | None:
    """Return which parameters a completed run did not determine well enough; None if its recording cannot be judged."""
    # Loads the estimator only now, after the motion.
    from ident_service.operations.target_process import missed

    try:
        return missed(folder, until, period)
    except IdentError as error:
        tell(f"which parameters missed the target is not known: {error}")
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
