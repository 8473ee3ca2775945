"""What the fault campaign injects, what the table promises of it, and how one case is run.

Boundary: the simulated arms are here, arms of emulated drives are `campaign_canopen.py`; what a run is held to is
`campaign_checks.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from helpers.local_commands import LocalCommands
from motion_bench import Story, WatchedArm, bench_config

from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm
from ident_service.config.motion_limits import MotionLimits, motion_limits
from ident_service.config.simulation import FAULT_RULES
from ident_service.errors import ArmFault
from ident_service.excitation.described_motion import excitation
from ident_service.excitation.motion_file import Excitation
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.urdf import urdf_text
from ident_service.motion.faults import ActiveFaults
from ident_service.motion.run import Sink, run
from ident_service.motion.safety_monitor import MAX_AGE
from ident_service.motion.state_machine import State
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.mcap_writer import RecordingWriter
from sim_backend.arm import Truth, from_config
from sim_backend.faults import Fault, FaultKind

Array = np.ndarray
HOLD = 0.3  # s
# States that somebody at the controls brings about; the same hands lead through all of a line.
PAUSED = (State.PAUSING, State.PAUSED, State.RESUMING)
STOPPED = (State.STOPPING, State.STOPPED)
PAUSED_FOR = 300  # cycles from the wish to pause to the wish to go on
# What a drive that is stuck, weak, loaded or lies can end in: physics says in which.
UNTRUE = {
    *("following_error", "following_lost", "over_velocity", "runaway", "position_envelope", "position_limit"),
    *("far_outside", "torque_absurd", "frozen_encoder", "not_at_rest", "hold_lost", "repeated_warnings"),
}
READ_WRONGLY = UNTRUE | {"encoder_jumps", "feedback_gone"}


@dataclass(frozen=True)
class Promise:
    """What is injected of a kind, and what must come of it.

    Attributes:
        codes: of the fault that ends the run.
        size: of the fault, see `FAULT_RULES`.
        duration: in cycles; None for what the kind does by itself.
        within: cycles until the fault is found, in every state that is energised; None where the run may also end as if
            nothing had been, because nobody could tell.
        warns: what a run that goes on must have told.
        told_after: cycles that telling it takes; a run may end before.
        words: one of these is in the sentence that a person reads.
    """

    codes: set[str]
    size: float = 0.0
    duration: int | None = None
    within: int | None = None
    warns: str | None = None
    words: tuple[str, ...] = ()
    told_after: int = 0


PROMISES: dict[FaultKind, Promise] = {
    FaultKind.LOST_FEEDBACK: Promise({"feedback_gone"}, duration=50, within=MAX_AGE),
    FaultKind.DELAYED_FEEDBACK: Promise({"feedback_gone"}, size=0.005, within=1),
    FaultKind.HIDDEN_DELAY: Promise(READ_WRONGLY, size=0.02),
    FaultKind.ENCODER_JUMP: Promise({"encoder_jumps"}, size=0.5, duration=2, within=2),
    FaultKind.ENCODER_OFFSET: Promise({"feedback_gone"}, size=0.5, within=MAX_AGE),
    FaultKind.FROZEN_ENCODER: Promise(UNTRUE, duration=10**6),
    FaultKind.NAN_POSITION: Promise({"feedback_not_finite"}, within=1),
    FaultKind.POSITION_SIGN: Promise(READ_WRONGLY),
    FaultKind.STUCK_TORQUE: Promise(UNTRUE, duration=10**6),
    FaultKind.TORQUE_SIGN: Promise(UNTRUE),
    FaultKind.TORQUE_SATURATION: Promise(UNTRUE, size=0.05),
    FaultKind.DRIVE_FAULT: Promise({"drive_fault"}, within=1),
    FaultKind.NODE_SILENT: Promise({"feedback_gone"}, within=MAX_AGE),
    FaultKind.EMERGENCY_STOP: Promise({"emergency_stop"}, within=1),
    FaultKind.LOAD_ATTACHED: Promise(UNTRUE, size=2.0),
    FaultKind.BUS_GONE: Promise({"driver"}, duration=10**6, within=1),
    FaultKind.LATE_CYCLE: Promise({"late_cycles"}, size=12e-3, duration=1, within=1),  # 10 ms are survived
    FaultKind.CLOCK_JUMP: Promise({"clock_jump"}, size=-0.05, within=1),
}
# Late cycles again, as decision 0069 tells them apart: what a motion survives, and what comes too often.
STALLS: dict[str, Promise] = {
    "short_stall": Promise(set(), size=9e-3, duration=1, warns="late_cycle", words=("a cycle came 9 ms late",)),
    "stalls": Promise({"late_cycles"}, size=9e-3, duration=50, within=8, words=("of the 1000 cycles of a second",)),
}


@dataclass(frozen=True)
class Strike:
    """One fault of an arm that counts its faults from when they are handed over.

    Attributes:
        at_cycle: exchange before which it comes.
        kind: its name.
        joint: index of the joint, or of its drive; None for all.
        duration: in cycles; None for what the kind does by itself.
        size: of the fault.
        later: share of a cycle by which it comes later still.
    """

    at_cycle: int
    kind: str
    joint: int | None
    duration: int | None
    size: float
    later: float = 0.0


@dataclass(frozen=True, eq=False)
class Subject:
    """An arm to break.

    Attributes:
        pause: cycle of a script that pauses.
        stop: cycle of a script that stops.
        build: makes the arm, not open, with faults in it and an eye on the truth; None for the simulated arm.
        promises: of every kind, by its name.
        of_joint: which kinds may be one joint's.
        torque_step: by which rounding to the drives' steps may exceed a torque limit [N m or N], shape (joints,).
    """

    config: ArmConfig
    model: ArmModel
    motion: Excitation
    limits: MotionLimits
    pause: int
    stop: int
    build: Callable[[Strike | None, Callable[[Truth], None]], WatchedArm] | None = None
    promises: Mapping[str, Promise] = field(
        default_factory=lambda: {kind.value: promise for kind, promise in PROMISES.items()} | STALLS
    )
    of_joint: Callable[[str], bool] = lambda kind: kind not in STALLS and FAULT_RULES[FaultKind(kind)].of_joint
    torque_step: Array | float = 0.0

    @property
    def period(self) -> float:
        """Return the time between its cycles [s]."""
        return 1.0 / self.config.control.rate


@cache
def subject(name: str) -> Subject:
    """`bench` or `wam`; of emulated drives `bench canopen`, `wam canopen`, `wam two buses`, `bench positions`."""
    if "canopen" in name or "buses" in name or "positions" in name:
        from campaign_canopen import canopen_subject

        return canopen_subject(name)
    if "pucks" in name:
        from campaign_pucks import puck_subject

        return puck_subject(name)
    if name == "bench":
        config, pause = bench_config(), 900
    else:
        config, pause = wam_config("wam7_sim"), 2600
    model = arm_model(config)
    return Subject(config, model, excitation(model, "identification"), motion_limits(config), pause, pause)


def wam_config(name: str, **changes: Any) -> ArmConfig:
    """A shipped WAM with a short motion; `changes` replace top-level sections.

    A floor ends its sinking after 10 s instead of 70; that it also sinks until it rests is seen in
    `test_motion_after_stop.py`.
    """
    motions = {"identification": {"kind": "seeded", "seed": 7, "base_frequency": 0.4, "harmonics": 3, "periods": 1}}
    document = load_arm(name).model_dump(mode="json", by_alias=True)
    document["control"]["floor"] = -0.1
    return ArmConfig.model_validate(document | {"motions": motions} | changes)


@dataclass(frozen=True)
class Case:
    """One fault in one state."""

    arm: str
    kind: str
    state: State
    share: float  # of the state's time at which it strikes
    joint: int | None
    speed: float = 1.0  # of the run
    finish: bool = False  # whether the run is finished early, which leads through other states

    def __str__(self) -> str:
        slow = "" if self.speed == 1.0 else f"-at {self.speed:g}"
        early = "-finished" if self.finish else ""
        return f"{self.arm}-{self.kind}-{self.state.value}-{self.share:.2f}-{self.joint}{slow}{early}"


class Script(LocalCommands):
    """Somebody who pauses and goes on, stops, or finishes the run, at given cycles of the loop."""

    def __init__(
        self, arm: WatchedArm, which: Subject, state: State, speed: float = 1.0, *, finish: bool = False
    ) -> None:
        super().__init__()
        self._arm, self._hold = arm, HOLD / which.period
        self._finish = round(which.pause / speed) if finish else 10**9
        self._pause = round(which.pause / speed) if state in PAUSED and not finish else 10**9
        self._stop = round(which.stop / speed) if state in STOPPED else 10**9
        self._held_since = 10**9

    def lease_ok(self, now_ns: int) -> bool:
        cycle = self._arm.cycle - 1
        self.pause = self._pause <= cycle < self._pause + PAUSED_FOR + 200
        self.stop, self.finish = cycle >= self._stop, cycle >= self._finish
        self.supported = cycle >= self._held_since + self._hold  # counts where the arm waits for it
        return True

    def announce_hold(self) -> None:
        super().announce_hold()
        self._held_since = self._arm.cycle - 1


@dataclass
class Outcome:
    """What came of a run."""

    story: Story
    arm: WatchedArm
    truth: list[Truth]
    latch: ActiveFaults
    fault: ArmFault | None


class _Both:
    """A sink that keeps a story beside a recording."""

    def __init__(self, story: Story, writer: RecordingWriter) -> None:
        self._story, self._writer = story, writer

    error = ""

    def put(self, cycle: Cycle) -> bool:
        self._writer.sample(cycle)
        return self._story.put(cycle)

    def event(self, stamp_ns: int, level: int, message: str) -> bool:
        self._writer.event(stamp_ns, level, message)
        return self._story.event(stamp_ns, level, message)


def built(which: Subject, faults: tuple[Fault | Strike, ...], observer: Callable[[Truth], None]) -> WatchedArm:
    """The arm, not open, with faults in it and an eye on the truth."""
    if which.build is None:
        inner = from_config(which.config, faults=[f for f in faults if isinstance(f, Fault)], observer=observer)
        return WatchedArm(inner)
    (strike,) = [f for f in faults if isinstance(f, Strike)] or [None]
    return which.build(strike, observer)


class _Unrecorded(Exception):
    """An arm without brakes is lowered, and its samples are recorded no more."""


def play(
    which: Subject,
    state: State,
    faults: tuple[Fault | Strike, ...],
    path: Path | None,
    speed: float = 1.0,
    *,
    finish: bool = False,
    lowers: bool = True,
) -> Outcome:
    """One run on a new arm, with what the script of a state does.

    Args:
        which: the arm.
        state: of the script.
        faults: that strike.
        path: of a recording; none is made without.
        speed: of the run.
        finish: whether it is finished early.
        lowers: whether an arm without brakes is followed until it rests, and not only while it is recorded.
    """
    truth: list[Truth] = []
    arm = built(which, faults, truth.append)
    story, latch, fault = Story(), ActiveFaults(), None

    def recorded(cycle: int) -> None:
        if story.samples and cycle > story.samples[-1]["cycle"] + 50:
            raise _Unrecorded

    if not lowers:
        arm.before_exchange = recorded
    options: dict[str, Any] = {"active_faults": latch, "hold_seconds": HOLD, "speed": speed}
    script = Script(arm, which, state, speed, finish=finish)
    try:
        with arm, ExitStack() as stack:
            sink: Sink = story
            if path is not None:
                text = urdf_text(which.model, which.model.prior)
                writer = RecordingWriter(path, which.model.chain.names, text, 0)
                sink = _Both(story, stack.enter_context(writer))
            try:
                run(arm, which.model, which.motion, sink, script, **options)
            finally:
                moments = list(truth)
                arm.left_alone()
    except _Unrecorded:
        pass
    except ArmFault as error:
        fault = error
    return Outcome(story, arm, moments, latch, fault)


def windows(name: str, state: State, speed: float = 1.0, *, finish: bool = False) -> dict[str, tuple[int, int]]:
    """First and last cycle of every state of a healthy run of a script."""
    return _windows(name, State.EXCITING if finish else script_of(state), speed, finish)


def script_of(state: State) -> State:
    """The state that stands for all that one script leads through."""
    return PAUSED[0] if state in PAUSED else STOPPED[0] if state in STOPPED else State.EXCITING


@cache
def _windows(name: str, state: State, speed: float, finish: bool) -> dict[str, tuple[int, int]]:
    healthy = play(subject(name), state, (), None, speed, finish=finish, lowers=False)
    assert healthy.fault is None
    # A run that is left before the arm rests tells that as a fault.
    told = [event for event in healthy.story.events if event[1] == 20 and event[2] != "faulted"]
    first = healthy.story.samples[0]
    # Enabling may take time that has no cycles.
    period = subject(name).period
    since = [max(-1, round((stamp - first["stamp_ns"]) * 1e-9 / period)) for stamp, _, _ in told]
    begins = [(message, first["cycle"] + cycles) for (_, _, message), cycles in zip(told, since, strict=True)]
    ends = [begin for _, begin in begins[1:]] + [healthy.story.samples[-1]["cycle"]]
    return {message: (begin + 1, end) for (message, begin), end in zip(begins, ends, strict=True)}


def injected(case: Case) -> Fault | Strike:
    """The fault of a case, at its time."""
    which = subject(case.arm)
    first, last = windows(case.arm, case.state, case.speed, finish=case.finish)[case.state.value]
    promise = which.promises[case.kind]
    cycle = first + round(case.share * (last - 1 - first))
    if which.build is None:
        kind = FaultKind.LATE_CYCLE if case.kind in STALLS else FaultKind(case.kind)
        return Fault(cycle, kind, case.joint, promise.duration, promise.size)
    return Strike(cycle, case.kind, case.joint, promise.duration, promise.size, case.share)
