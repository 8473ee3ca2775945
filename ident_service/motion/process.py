"""Run the motion process: the arm and its control loop, started by the process that requests the motion.

It gets one JSON object on its standard input and says in lines of JSON on its standard output which state it enters and
how the run ended; samples and story go through the ring to the recorder's process. It takes the arm's control file and
holds its lock, so that `ident stop` reaches it whatever became of its parent. A parent that is gone has closed the
standard input, and one that hangs lets the lease lapse: either stops the arm. What is to be known
afterwards does not need a parent: faults are latched, and the ending is written into the run folder, from here.

A pipe that the parent does not read must not make the loop wait: lines that do not fit are dropped.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import traceback
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from ident_service.config.arm import ArmConfig
from ident_service.errors import ArmFault, IdentError, MotionRefused, UsageError
from ident_service.excitation.motion_file import excitation_from_json
from ident_service.model.arm_model import arm_model
from ident_service.motion.arm_factory import make_arm
from ident_service.motion.command_channel import ControlFile, SupervisedCommands
from ident_service.motion.control_loop import LOWERS, WAITS
from ident_service.motion.cycle_timing import Histogram
from ident_service.motion.ending import write_ending
from ident_service.motion.fault_store import CONTROLS, FaultStore
from ident_service.motion.faults import ActiveFaults, Severity
from ident_service.motion.last_position import PositionFile
from ident_service.motion.realtime import request_privileges
from ident_service.motion.run import WAITS_FOR, RunReport, follow
from ident_service.motion.run_plan import Destination, ExcitationPlan, Plan, PointToPointPlan
from ident_service.motion.state_machine import State
from ident_service.motion.ticket import subject_of, ticket_from_json
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.ring_sink import RingSink, SinkEnds

FRAMES = "can.log"  # in the run folder, where they were asked for
_STATES = frozenset(state.value for state in State)


class TimedSink:
    """Pass samples and events on to the ring, count lateness and duration of cycles, and tell the parent the states.

    Attributes:
        lateness: histogram of the lateness of waking.
        compute: histogram of the time between waking and the next wait.
    """

    def __init__(self, sink: RingSink) -> None:
        self._sink = sink
        self.lateness, self.compute = Histogram(), Histogram()

    @property
    def error(self) -> str:
        """Return the reason why recording has ended; empty while it goes on, or where the reason is unknown."""
        return self._sink.error

    def put(self, cycle: Cycle) -> bool:
        """Count a cycle's lateness and computing time, and pass it to the sink; False where that lags or has failed."""
        self.lateness.add(cycle.lateness_ns)
        self.compute.add(cycle.compute_ns)
        return self._sink.put(cycle)

    def event(self, stamp_ns: int, level: int, message: str) -> bool:
        """Pass a log message to the sink, and faults, states and holds to the parent; return False if the sink lags."""
        if level >= Severity.ERROR:
            send_line(
                {"fault": message}
            )  # which is latched at the end, and an arm without brakes may be held until then
        elif message in _STATES:
            send_line({"state": message})
        elif message in (WAITS, LOWERS):
            send_line({"held": message})
        elif message.startswith(WAITS_FOR):
            send_line({"state": message})
        return self._sink.event(stamp_ns, level, message)


def send_line(document: dict[str, Any]) -> None:
    """Write one line of JSON to standard output; it is lost where the pipe is closed, or full and non-blocking."""
    with suppress(OSError):
        os.write(sys.stdout.fileno(), json.dumps(document).encode() + b"\n")


def main() -> int:
    """Run the motion that standard input asks for, report on standard output; return 0, 4 after a fault, else 1."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the terminal's Ctrl-C is for the parent, which asks for a stop
    line = sys.stdin.readline()
    if not line.endswith("\n"):
        return 1  # the parent is gone already
    request = json.loads(line)
    os.set_blocking(sys.stdout.fileno(), False)
    code, answer = _ended(request)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # there is nothing left to stop
    with suppress(UsageError):  # the parent will find the same disk full
        write_ending(
            Path(request["folder"]), answer["report"] if "report" in answer else {"error": answer["error"]["message"]}
        )
    os.set_blocking(sys.stdout.fileno(), True)
    send_line(answer)
    return code


def _ended(request: dict[str, Any]) -> tuple[int, dict[str, Any]]:
    """Run the motion with the control file taken; returns the exit code, and the last line for the parent."""
    try:
        place = Path(request["arm_folder"]) / CONTROLS
        with ControlFile.take(place, request["lease"], motion_requested_ns=request["requested_ns"]) as controls:
            signal.signal(signal.SIGTERM, lambda *_: controls.request_stop())
            send_line({"pid": os.getpid()})
            return 0, {"report": _run_with_fault_store(request, controls)}
    except ArmFault as fault:
        return 4, {"error": {"kind": "ArmFault", "code": fault.code, "message": _words(fault)}}
    except IdentError as error:
        return 1, {"error": {"kind": type(error).__name__, "message": _words(error)}}
    except Exception as error:  # noqa: BLE001 - a mistake of the program, too, has a message besides its traceback
        traceback.print_exc()
        return 1, {"error": {"kind": "ArmError", "message": f"the motion process failed: {error!r}"}}


def _words(error: IdentError) -> str:
    """Return the error and its notes in one line."""
    return "; ".join((str(error), *getattr(error, "__notes__", ())))


def _run_with_fault_store(request: dict[str, Any], controls: ControlFile) -> dict[str, Any]:
    """Move the arm; whatever happens to this process or its parent, faults are stored on the disk."""
    faults, latch = FaultStore(Path(request["arm_folder"])), ActiveFaults()
    faults.began(Path(request["folder"]))
    try:
        report = _moved(request, controls, latch)
    except BaseException as error:
        try:
            _remember(faults, latch)
        except UsageError as second:  # the mark stays, so that the arm is not taken for a sound one
            error.add_note(f"it could not be stored: {second}")
        raise
    _remember(faults, latch)
    return report


def _remember(faults: FaultStore, latch: ActiveFaults) -> None:
    """Store the faults on the disk, and only then remove the mark of a moving arm."""
    for fault in latch.faults:
        faults.latch(fault.code, fault.cause)
    faults.ended()


def _moved(request: dict[str, Any], controls: ControlFile, latch: ActiveFaults) -> dict[str, Any]:
    """Move the arm and record it; returns the report as JSON values."""
    config = ArmConfig.model_validate(request["config"])
    motion = None if request["excitation"] is None else excitation_from_json(request["excitation"])
    plan: Plan = (
        PointToPointPlan(Destination(request["destination"]))
        if motion is None
        else ExcitationPlan(motion, request["speed"])
    )
    model = arm_model(config)
    arm = make_arm(config)
    if request["log_frames"]:
        arm.log_frames(Path(request["folder"]) / FRAMES)
    ring = RingSink(SinkEnds(*request["ends"]), request["recording"], lock_step=arm.clock.lock_step)
    sink = TimedSink(ring)
    lifeline = SupervisedCommands(controls, sys.stdin.fileno(), lock_step=arm.clock.lock_step)
    # Last, so that everything it freezes and locks is loaded.
    granted = None if arm.clock.lock_step else request_privileges(settings=config.realtime)
    sentence = "virtual time" if granted is None else granted.sentence()
    positions, moves = PositionFile(Path(request["arm_folder"]), config), False
    try:
        with arm:
            ticket = ticket_from_json(request["ticket"])
            ticket.require_valid_for(subject_of(model, motion, arm.describe()), datetime.now(UTC))
            if not sink.event(arm.clock.now_ns(), 20, sentence):
                raise MotionRefused(f"nothing would be recorded: {sink.error or 'the recorder cannot keep up'}")
            if lifeline.requester_gone:
                raise MotionRefused("the program that started the motion has ended")
            positions.require_no_lost_turns(arm)
            positions.forget()
            moves = True
            report = follow(arm, model, plan, sink, lifeline, active_faults=latch)
    finally:
        if moves:
            positions.keep(arm)
    # A ring that is not closed is one whose writer died: its recording would be called incomplete.
    ring.close()
    return {
        "state": report.state.value,
        "cycles": report.cycles,
        "peak_following_error": np.asarray(report.peak_following_error).tolist(),
        "peak_torque": np.asarray(report.peak_torque).tolist(),
        "warnings": report.warnings,
        **_early(report),
        "real_time": sentence,
        # In virtual time cycles wait for each other, and nothing is late.
        "lateness": None if arm.clock.lock_step else {**sink.lateness.document(), "late_or_lost": report.late},
        "compute": None if arm.clock.lock_step else sink.compute.document(),
        **({"unconfirmed": list(arm.unconfirmed())} if arm.unconfirmed() else {}),
        **({"frames_logged": arm.logged()} if request["log_frames"] else {}),
    }


def _early(report: RunReport) -> dict[str, Any]:
    """Return the report's entries about a run that was finished early, or was to be."""
    if report.finished_at is not None:
        return {"finished": "early", "motion_seconds": report.finished_at}
    return {"not_finished": report.not_finished} if report.not_finished else {}


if __name__ == "__main__":
    sys.exit(main())
