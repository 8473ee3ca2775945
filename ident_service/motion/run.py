"""Run one motion: check, enable, follow the plan, end; keep an open arm served while its host is busy.

Drives treat a host that falls silent as dead and disable themselves or stop. So code that plans, checks or asks a
person while an arm is open lets cycles without torque go on meanwhile. In virtual time no drive waits, and the block
just runs. With torque on nothing else is done at all: the loop's thread would have to share the interpreter.

The loop owns no file: it hands samples to a sink that keeps the disk away, and a sink that fails stops the arm under
control like one that is slow. The stop path is `_halt`: torque away, no condition, nothing that can raise.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Final

import numpy as np

from drivers.arm import Arm, ArmDescription, Sample, StopKind, Vector
from ident_service.config.motion_limits import MotionLimits, motion_limits
from ident_service.errors import (
    ArmFault,
    DriveFaulted,
    DriverError,
    EmergencyStopped,
    MotionRefused,
    NobodyEnabled,
)
from ident_service.excitation.motion_file import Excitation
from ident_service.model.arm_model import ArmModel, control_model
from ident_service.model.collision import Contact, lowest_point
from ident_service.model.expected_friction import friction_feedforward
from ident_service.model.pinocchio_models import InverseDynamics
from ident_service.motion.after_stop import ONLY_BRAKED, StopSecuring, after_stop
from ident_service.motion.clearance import ClearanceChecker
from ident_service.motion.command_channel import Controls, StopCondition
from ident_service.motion.control_loop import REST_CYCLES, REST_SPEED, Loop, Peaks
from ident_service.motion.control_loop import Sink as Sink
from ident_service.motion.controller import ComputedTorque
from ident_service.motion.cycle_timing import Deadlines, longest_stall
from ident_service.motion.encoder_observer import encoder_coupling, frozen_encoder_observer
from ident_service.motion.faults import FAULTS, HOLD, ActiveFaults
from ident_service.motion.run_plan import ExcitationPlan, Plan
from ident_service.motion.safety_monitor import NOT_APPLIED, SafetyMonitor
from ident_service.motion.sequencer import TrajectorySequencer
from ident_service.motion.speed_scaling import require_factor, slowed_limits
from ident_service.motion.state_machine import TRANSITIONS, State, StateMachine
from ident_service.motion.trajectory import rest

_SWITCH = 2e-4  # s after which the cycles get the interpreter from the other thread, instead of 5 ms
_FIRST_COME = (os.SCHED_FIFO, os.SCHED_RR)  # threads of one priority let each other run only when they wait
_FIRST = -20  # of the nice values


@contextmanager
def keep_host_alive(arm: Arm) -> Iterator[None]:
    """During the block, exchange cycles without torque in a thread (none in lock step); the block must not use the arm.

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
    """Run the block at ordinary scheduling with nice -20 where the thread had real-time priority, then restore that.

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


WAITS_FOR: Final = "waiting for a person:"  # begins the line of the story that names what is waited for
# rad or m that an arm may have been moved by while a person is waited for; less where the guard would call that a jump
MOVED: Final = 0.01
_ENABLINGS: Final = 3  # times that a person is asked again because the arm was moved meanwhile
_INFO: Final = 20  # level of rcl_interfaces/msg/Log


@dataclass(frozen=True)
class RunReport:
    """Represent the outcome of a run.

    Attributes:
        state: final state: DONE, or STOPPED after a request to stop.
        cycles: number of cycles exchanged.
        peak_following_error: [rad or m], shape (joints,).
        peak_torque: largest torque sent [N m or N], shape (joints,).
        warnings: number of times that each warning was found, by code.
        finished_at: time on the excitation at which a run was finished early [s]; None for a run that was not, or is
            not DONE.
        not_finished: reason why a run that was to be finished early went on; empty for any other.
        late: cycles that were late or never came.
    """

    state: State
    cycles: int
    peak_following_error: Vector
    peak_torque: Vector
    warnings: dict[str, int]
    finished_at: float | None = None
    not_finished: str = ""
    late: int = 0


def run(
    arm: Arm,
    model: ArmModel,
    excitation: Excitation,
    sink: Sink,
    controls: Controls | None = None,
    *,
    speed: float = 1.0,
    active_faults: ActiveFaults | None = None,
    hold_seconds: float = HOLD,
) -> RunReport:
    """Enable an open arm, move it along an excitation and back to where it stood; return the report, or raise ArmFault.

    Args:
        arm: the arm, open and not enabled.
        model: model with the prior parameters that control needs.
        excitation: motion that was checked against the limits beforehand.
        sink: sink of every sample.
        controls: commands, read every cycle; None for a run without stop, pause or early finish.
        speed: share of the motion's own speed at which all of it is played, approach, return and ways out of pauses
            too; a rehearsal takes 0.2. Stops are never slowed.
        active_faults: the arm's faults, which outlive the run; a new one when None.
        hold_seconds: time for which a stopped arm is held before the drives brake it by themselves, or it is lowered
            [s].

    Returns:
        The report of a run that ended in DONE or, after a request, in STOPPED.

    Raises:
        UsageError: the speed is not above 0 and at most 1; nothing has moved.
        MotionRefused: nothing has moved; the message says why.
        ArmFault: a fault stopped the motion; the arm is without torque, and the fault latched.
        DriverError: the arm refused to be enabled, not because a drive has a fault.
    """
    return follow(
        arm,
        model,
        ExcitationPlan(excitation, speed),
        sink,
        controls,
        active_faults=active_faults,
        hold_seconds=hold_seconds,
    )


def follow(
    arm: Arm,
    model: ArmModel,
    plan: Plan,
    sink: Sink,
    controls: Controls | None = None,
    *,
    active_faults: ActiveFaults | None = None,
    hold_seconds: float = HOLD,
) -> RunReport:
    """Enable an open arm and move it along the references of a plan; return the report, or raise ArmFault.

    Args:
        arm: the arm, open and not enabled.
        model: model with the prior parameters that control needs.
        plan: the references to follow.
        sink: sink that takes every sample.
        controls: as for `run`.
        active_faults: as for `run`.
        hold_seconds: as for `run`; also for the end of a plan that is held.

    Returns:
        As `run`; DONE where the plan was followed to its end, held there or not.

    Raises:
        UsageError, MotionRefused, ArmFault, DriverError: as `run`.
    """
    require_factor(plan.speed)
    return _Run(
        arm, model, plan, sink, controls or StopCondition(), active_faults or ActiveFaults(), hold_seconds
    ).run()


@dataclass
class _Run:
    arm: Arm
    model: ArmModel
    plan: Plan
    sink: Sink
    controls: Controls
    latch: ActiveFaults
    hold_seconds: float

    def run(self) -> RunReport:
        if self.latch.faults:
            waiting = "; ".join(f"{fault.code} ({fault.cause})" for fault in self.latch.faults)
            raise MotionRefused(f"unacknowledged faults: {waiting}")
        self.nobody = ""
        self._first: Sample | None = None
        for _ in range(_ENABLINGS):
            loop, torque = self._prepared()
            if self.controls.stop:  # planning takes a second or more; the arm must not be energised after a stop
                raise MotionRefused("a stop was requested before the arm was energised; nothing has moved")
            if not self.controls.lease_ok(self.arm.clock.now_ns()):
                raise MotionRefused(
                    "the program that started the motion has ended or does not renew its lease; nothing has moved"
                )
            if self._enabled_where_planned(loop, torque):
                break
            if self.nobody:
                raise MotionRefused(f"{self.nobody}; nothing has moved")
        else:
            raise MotionRefused("the arm was moved each time while a person enabled it; it is without torque")
        try:
            self.states.enter(State.ARMED)
            self.states.enter(loop.course.first)
            loop.run(torque, self._first)
            # Done, the arm stands where it stood supported; lowered, it rests; stopped, it may not: drives brake it.
            done = self.states.state is State.DONE
            self.arm.stop(StopKind.TORQUE_OFF if done or loop.lowered else StopKind.QUICK_STOP)
            if loop.course.complete and loop.ended_by is None and not done:
                self.states.enter(State.DONE)
        except BaseException as error:
            self._halt(error, loop)
            _add_earlier_faults(error, loop)
            raise
        if loop.ended_by is not None:
            fault = ArmFault(loop.ended_by.code, loop.ended_by.message, loop.last)
            _add_earlier_faults(fault, loop)
            raise fault
        peaks = loop.peaks
        return RunReport(
            self.states.state,
            loop.last[-1].cycle + 1,
            peaks.following_error,
            peaks.torque,
            dict(loop.guard.findings.warnings),
            loop.course.finished_at if self.states.state is State.DONE else None,
            loop.course.not_finished,
            loop.deadlines.lost,
        )

    def _enabled_where_planned(self, loop: Loop, torque: Vector) -> bool:
        """Enable the arm; return whether it still stands where was planned from.

        Only where a person enables it can it have been moved meanwhile; then it is without torque again.
        """
        try:
            self.states.enter(State.CHECKED)
            action, wanted = self.arm.operator_action, self.arm.still_wanted
            if action:
                loop.tell(_INFO, self._stamp_ns, f"{WAITS_FOR} {action}")
                self.arm.still_wanted = self._still_wanted
            try:
                self.arm.enable()
            except NobodyEnabled as error:
                self.arm.stop(StopKind.QUICK_STOP)
                # A stop is found, and told, where the next attempt begins.
                self.nobody = str(error) if self._still_wanted() else ""
                return False
            except EmergencyStopped as error:
                raise ArmFault("emergency_stop", str(error)) from error
            except DriveFaulted as error:
                raise ArmFault("drive_fault", str(error)) from error
            finally:
                # The arm outlives this run; a motion process, which collects no garbage, would keep all of it at exit.
                self.arm.still_wanted = wanted
            if not action or self.controls.stop:
                return True
            seen = self.arm.exchange(torque)
            if bool((np.abs(seen.position - self._home) <= np.minimum(MOVED, loop.guard.jump)).all()):
                self._first = seen  # to be judged: what it tells of drives and bus is told once
                return True
            self.arm.stop(StopKind.QUICK_STOP)
            loop.tell(_INFO, self._stamp_ns, "the arm was moved while a person was waited for; planned again")
        except BaseException as error:
            self._halt(error, loop)
            raise
        return False

    def _still_wanted(self) -> bool:
        return not self.controls.stop and self.controls.lease_ok(self.arm.clock.now_ns())

    def _prepared(self) -> tuple[Loop, Vector]:
        """Check and assemble the loop; returns it with the target that holds the arm where it stands."""
        model, chain, arm = self.model, self.model.chain, self.arm
        limits, prior = motion_limits(model.config), control_model(model).prior
        if prior is None:
            raise MotionRefused(f"{model.config.name}: computed torque needs prior parameters")
        self.after_stop = after_stop(model, limits)
        described = arm.describe()
        if described.streams_position and self.after_stop is not StopSecuring.BRAKE:
            raise MotionRefused(f"{model.config.name}: {ONLY_BRAKED}")
        if described.joint_names != chain.names:
            raise MotionRefused(
                f"the drives have the joints {', '.join(described.joint_names)}, "
                f"the description {', '.join(chain.names)}"
            )
        with keep_host_alive(arm):  # what is worked out takes longer than drives wait for their host
            self.plan.require_possible(model, limits)
        period = 1.0 / described.rate
        sample = self._look(limits, period)
        with keep_host_alive(arm):
            dynamics = InverseDynamics(chain, model.layout, prior)
            loop, torque = self._planned(dynamics, sample, limits, described)
        self._loop = loop
        self._stamp_ns = sample.stamp_ns
        return loop, torque

    def _planned(
        self, dynamics: InverseDynamics, sample: Sample, limits: MotionLimits, described: ArmDescription
    ) -> tuple[Loop, Vector]:
        model, chain, period = self.model, self.model.chain, 1.0 / described.rate
        home = self._home = sample.position.copy()
        admitted = self.plan.run_limits(model, home, limits)
        legs, limits = self.plan.legs(model, home, limits), admitted
        observer = frozen_encoder_observer(dynamics, model, limits, period, described.position_resolution)
        contact = Contact(model)
        guard = SafetyMonitor(
            chain.names,
            limits,
            period,
            home,
            revolute=chain.revolute,
            contact=contact,
            encoder_observer=observer,
            max_age=described.lost_cycles,
            most_torque=(1.0 + NOT_APPLIED) * limits.torque if described.streams_position else None,
            coupling=encoder_coupling(model.config),
            report_delay=described.report_delay,
        )
        friction = friction_feedforward(model, limits)
        control = ComputedTorque(dynamics, limits, period, model.config.control.velocity_cutoff, home, friction)
        holding = control.torque(home, sample.valid, rest(home))
        if described.streams_position:
            # A guard of its own: what drives are given is not compared with this torque.
            _, cannot_hold = SafetyMonitor(chain.names, limits, period, home).limit_torque(holding)
            target = home
        else:
            target, cannot_hold = guard.limit_torque(holding)
        if cannot_hold is not None:
            raise MotionRefused(f"the arm cannot be held where it stands: {cannot_hold.message}")
        self.states = StateMachine(self.latch, self._entered)
        loop = Loop(
            self.arm,
            guard,
            control,
            TrajectorySequencer(
                self.states,
                legs,
                rest(home),
                limits,
                slowed_limits(limits, self.plan.speed),
                ClearanceChecker(model, limits),
                held=self.plan.held,
            ),
            self.states,
            Deadlines(
                guard.findings,
                period,
                scheduled_stamps=described.scheduled_stamps,
                longest_stall=longest_stall(model.config.control.longest_stall, period, self.arm.watchdogs()),
            ),
            self.controls,
            self.sink,
            self.latch,
            limits,
            self.hold_seconds,
            Peaks(np.zeros_like(home), np.zeros_like(home)),
            self.after_stop,
            self._at_floor(),
            described.streams_position,
        )
        return loop, target

    def _at_floor(self) -> Callable[[Vector], bool]:
        """Create the function that returns whether the arm's lowest point is at the floor of its description."""
        floor = self.model.config.control.floor
        if floor is None:
            return lambda position: False
        height = lowest_point(self.model)
        return lambda position: height(position) <= floor

    def _look(self, limits: MotionLimits, period: float) -> Sample:
        """Exchange some cycles without torque and check that the arm rests; returns the last sample."""
        samples = [self.arm.exchange(None) for _ in range(REST_CYCLES)]
        last = samples[-1]
        if not all(bool(sample.valid.all() and np.isfinite(sample.position).all()) for sample in samples):
            raise MotionRefused("not every axis answers; check the bus before anything moves")
        seen = np.array([sample.position for sample in samples])
        drift = (seen.max(axis=0) - seen.min(axis=0)) / (period * (REST_CYCLES - 1))
        if bool(np.any(drift > REST_SPEED * limits.velocity)):
            raise MotionRefused("the arm is moving; it must be at rest and supported before a run begins")
        return last

    def _entered(self, state: State) -> None:
        stamp_ns = self._loop.last[-1].stamp_ns if self._loop.last else self._stamp_ns
        self._loop.tell(_INFO, stamp_ns, state.value)

    def _halt(self, error: BaseException, loop: Loop) -> None:
        """Take the torque away, whatever happened, and only then report the fault."""
        code = error.code if isinstance(error, ArmFault) else "driver" if isinstance(error, DriverError) else "program"
        # A code that the table lacks must not keep the torque on.
        rule = FAULTS.get(code, FAULTS["program"])
        try:
            self.arm.stop(StopKind.TORQUE_OFF if loop.lowered else rule.reaction.stop_kind)
        except Exception as second:  # noqa: BLE001 - a driver that breaks its promise must not hide why it was stopped
            error.add_note(f"and taking the torque away failed: {second}")
        cause = str(error) or type(error).__name__
        now_ns = self.arm.clock.now_ns()
        self.latch.set(code, cause.removeprefix(f"{code}: "), now_ns)
        if State.FAULTED in TRANSITIONS[self.states.state]:
            self.states.enter(State.FAULTED)
            loop.tell(rule.severity, now_ns, cause)


def _add_earlier_faults(error: BaseException, loop: Loop) -> None:
    """Add the first fault and the warnings before a fault to its error, as notes."""
    first, warnings = loop.ended_by, loop.guard.findings.warnings
    if first is not None and first.message not in str(error):
        error.add_note(f"the first fault was {first.code}: {first.message}")
    if warnings:
        error.add_note("earlier warnings: " + ", ".join(f"{code} {count} times" for code, count in warnings.items()))
