"""Run the control cycle: exchange, judge, follow, limit, record, react.

exchange -> deadlines -> course -> guard.check_feedback -> control law -> guard.limit_torque -> sink -> reaction
-> controls

Arms whose drives close the position loop (`ArmDescription.streams_position`) are given the reference itself, through
`guard.limit_position`. The control law is computed all the same, and not sent: what it would add for the following
error tells a joint that stands still although it is pushed. No torque can lower such an arm: where the table says
damped lowering, its drives quick-stop.

Reactions that end torque are an `ArmFault` out of `Loop.run`; taking the torque away is `run.py`'s. After a stop the
loop goes on until the arm has been measured at rest and held for a while, see `faults.py`; one without brakes until a
person has confirmed that it is supported, or until it has been lowered (`after_stop.py`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Final, Protocol

import numpy as np

from drivers.arm import Arm, Flags, Sample, Vector
from ident_service.config.motion_limits import MotionLimits
from ident_service.errors import ArmFault, DriverError
from ident_service.motion.after_stop import HOME_AFTER, MEANT, Anchor, Lowering, StopSecuring
from ident_service.motion.command_channel import Controls, Homing
from ident_service.motion.controller import ComputedTorque
from ident_service.motion.cycle_timing import Deadlines
from ident_service.motion.faults import FAULTS, LOWER, LOWER_AFTER, SETTLE, ActiveFaults, Fault, Reaction, Severity
from ident_service.motion.safety_monitor import SafetyMonitor
from ident_service.motion.sequencer import TrajectorySequencer
from ident_service.motion.state_machine import State, StateMachine
from ident_service.motion.trajectory import Setpoint, rest
from ident_service.recordings.cycle import Cycle


class Sink(Protocol):
    """Define a sink of samples and events that keeps the disk away from the loop."""

    @property
    def error(self) -> str:
        """Return the reason why recording has ended; empty while it goes on, or where the reason is unknown."""

    def put(self, cycle: Cycle) -> bool:
        """Take one cycle to be recorded; return False where the sink lags behind or has failed."""

    def event(self, stamp_ns: int, level: int, message: str) -> bool:
        """Take one log message with its severity to be recorded; return False where the sink lags or has failed."""


KEPT_SAMPLES: Final = 100
REST_SPEED: Final = 0.05  # of the velocity limit, below which a joint counts as at rest
REST_CYCLES: Final = 20  # of rest in a row
HOLD_SPEED: Final = 0.25  # of the velocity limit, above which an arm that is held has come loose
WAITS: Final = "held until a person confirms, by `ident supported`, that the arm is supported or home"
LEADS: Final = "moving home slowly, as a person asked; held again at the end"
LOWERS: Final = "lowered under damped control until it rests"


@dataclass
class Peaks:
    """Hold the largest following error [rad or m] and torque [N m or N] so far, each of shape (joints,)."""

    following_error: Vector
    torque: Vector


@dataclass
class Loop:
    """Run the control loop of one motion, cycle by cycle.

    Attributes:
        ended_by: the fault that stopped the arm under control, if one did.
        lowered: whether the arm rests without torque, so that it can be taken away.
        last: the latest samples.
        peaks: peaks of the motion so far.
    """

    arm: Arm
    guard: SafetyMonitor
    control: ComputedTorque
    course: TrajectorySequencer
    states: StateMachine
    deadlines: Deadlines
    controls: Controls
    sink: Sink
    latch: ActiveFaults
    limits: MotionLimits
    hold_seconds: float
    peaks: Peaks
    after_stop: StopSecuring = StopSecuring.BRAKE
    floor_reached: Callable[[Vector], bool] = lambda position: False
    gives_positions: bool = False
    ended_by: Fault | None = None
    lowered: bool = False
    last: deque[Sample] = field(default_factory=lambda: deque(maxlen=KEPT_SAMPLES))

    def __post_init__(self) -> None:
        self._level = Reaction.WARN
        self._rested = 0
        self._needed = np.zeros_like(self.limits.torque)  # beside gravity, to stand: the sum over the cycles of rest
        self._since_ns = 0  # of the hold or the lowering
        self._lowering: Lowering | None = None
        self._anchor: Anchor | None = None  # of an arm that is held for as long as it takes
        self._waiting = self._leading = False  # for a person's confirmation; for a trajectory home
        self._explained: Vector | None = None  # the model's torque, of an arm that is given positions
        self._recorded = False  # all that is recorded of the run
        self._told: set[str] = set()
        self._rest_speed = REST_SPEED * self.limits.velocity
        self._hold_speed = HOLD_SPEED * self.limits.velocity

    def run(self, first_command: Vector, first_sample: Sample | None = None) -> None:
        """Send a torque or position, run cycles until DONE or a stopped arm is secured; ArmFault if torque must end.

        Args:
            first_command: what the first cycle sends, which holds the arm where it stands, shape (joints,): torque
                [N m or N], or position [rad or m] of an arm that is given positions.
            first_sample: sample of the first cycle, where `first_command` was sent already; it is not sent again.

        Raises:
            ArmFault: torque must end now.
        """
        wanted = self._after(self._exchanged(first_command) if first_sample is None else first_sample)
        while wanted is not None:
            wanted = self._after(self._exchanged(wanted))

    def _exchanged(self, target: Vector) -> Sample:
        """Return the sample of a cycle in which the target is sent."""
        try:
            return (self.arm.exchange_position if self.gives_positions else self.arm.exchange)(target)
        except DriverError as error:
            raise self._end(self.guard.findings.count_fault("driver", str(error))) from error

    def _after(self, sample: Sample) -> Vector | None:
        """Run one cycle from its sample on; returns the target of the next cycle, or None at the end."""
        woken_ns, stamp_ns = self.arm.clock.now_ns(), sample.stamp_ns
        self.last.append(sample)
        found = self.deadlines.judge_cycle(stamp_ns, woken_ns, sample.stamp_doubt_ns)
        if found is not None:
            if found.reaction is Reaction.CONTROLLED_STOP and not self.gives_positions:
                self.course.skip_to(stamp_ns)  # under the last torque the arm has gone on, not to the last position
            self._react(found, stamp_ns)
        reference = self.course.at(stamp_ns)
        if self.states.state is State.DONE:
            return None
        free = not self.gives_positions and (self._lowering is not None or self.states.state is State.STOPPED)
        reference = rest(self.control.position) if free else reference  # no position is asked for
        usable, fault = self.guard.check_feedback(
            sample,
            reference,
            self.control.velocity,
            self.control.correction,
            self.control.feedback_acceleration,
            self.deadlines.elapsed,
            self.control.feedforward,
            elapsed_is_exact=self.deadlines.elapsed_is_exact,
            unexplained_torque=sample.torque - self._explained if self._explained is not None else None,
        )
        law = self._law(sample, usable, reference, free)
        if self.gives_positions:
            self._explained = law - self.control.correction
        target, target_fault = (
            self.guard.limit_position(reference.position) if self.gives_positions else self.guard.limit_torque(law)
        )
        compute_ns = self.arm.clock.now_ns() - woken_ns
        kept = sample if fault is None or fault.code != "feedback_not_finite" else self._finite(sample)
        for found in (fault, target_fault, self._record(kept, reference, compute_ns)):
            if found is not None:
                self._react(found, stamp_ns)
        self._remember(sample, usable, reference)
        if self._check_end_of_phase(stamp_ns):
            return None
        self._apply_commands(woken_ns, stamp_ns)
        return target

    def _law(self, sample: Sample, usable: Flags, reference: Setpoint, free: bool) -> Vector:
        """Return the torque that the control law asks for [N m or N], shape (joints,)."""
        elapsed = self.deadlines.elapsed if self.deadlines.elapsed_is_exact else 0.0
        if not free:
            return self.control.torque(sample.position, usable, reference, elapsed)
        needed, lowering = self._needed / REST_CYCLES, self._lowering
        if lowering is None:
            back = self._anchor.displacement_back(self.control.position) if self._anchor is not None else 0.0
            return self.control.damping(
                sample.position, usable, added_torque=needed, elapsed_seconds=elapsed, displacement_back=back
            )
        share, beyond = lowering.share, lowering.displacement_inside(self.control.position)
        return self.control.damping(sample.position, usable, share, share * needed, elapsed, beyond)

    def _react(self, fault: Fault, stamp_ns: int) -> None:
        """React to a fault as the table says, unless a reaction at least as severe is under way.

        Raises:
            ArmFault: torque must end now.
        """
        if fault.reaction is Reaction.WARN:
            if fault.code not in self._told or FAULTS[fault.code].each:  # the report counts the others
                self._told.add(fault.code)
                self.tell(fault.severity, stamp_ns, f"{fault.code}: {fault.message}")
            return
        if fault.reaction <= self._level or (self._lowering is not None and fault.code in MEANT):
            return
        self._level = fault.reaction
        lowers = fault.reaction is Reaction.DAMPED_LOWERING
        if fault.reaction >= Reaction.QUICK_STOP or (lowers and self.gives_positions):
            raise self._end(fault)
        if self.ended_by is None or not self.course.led:  # on the way home the first one stays the reason
            self.ended_by = fault
        self.latch.set(fault.code, fault.message, stamp_ns)
        self.course.stop(stamp_ns)
        self.tell(fault.severity, stamp_ns, f"{fault.code}: {fault.message}")
        if lowers:
            self._needed = np.zeros_like(self._needed)
            self._lower(stamp_ns, LOWER_AFTER)

    def _lower(self, stamp_ns: int, after: float = 0.0) -> None:
        self._lowering, self._since_ns = Lowering(self.limits, stamp_ns, after), stamp_ns

    def _check_end_of_phase(self, stamp_ns: int) -> bool:
        """Check for the ends of stops, pauses, holds and lowerings; returns whether this was the last cycle.

        Raises:
            ArmFault: lowered; not at rest in time; or at rest no more.
        """
        state, since = self.states.state, (stamp_ns - self._since_ns) * 1e-9
        if self._lowering is not None:
            return self._is_lowered(self._lowering, stamp_ns, since)
        if state is State.STOPPED:
            if (np.abs(self.control.velocity) > self._hold_speed).any():
                raise self._end(self._named("hold_lost", "moves at {} while it is held"))
            return self._held(stamp_ns, since)
        if state not in (State.STOPPING, State.PAUSING):
            return False
        overdue = self.course.overdue(stamp_ns)
        if overdue >= 0.0 and (np.abs(self.control.velocity) <= self._rest_speed).all():
            self._rested += 1
            self._needed = self._needed + self.control.correction + self.control.feedforward
        else:
            self._reset_rest_count()
        if self._rested >= REST_CYCLES:
            if state is State.PAUSING:
                self.course.enter_paused()
                self._reset_rest_count()
                return False
            self.states.enter(State.STOPPED)
            self._since_ns = stamp_ns
            return self._held(stamp_ns, 0.0)
        if overdue > SETTLE:
            raise self._end(self._named("not_at_rest", f"moves at {{}} {SETTLE:g} s after it was to rest"))
        return False

    def _held(self, stamp_ns: int, since: float) -> bool:
        """Check for the end of a hold, which for an arm without brakes is the beginning of its lowering."""
        if self.after_stop is StopSecuring.BRAKE:
            return since >= self.hold_seconds
        if self.after_stop is StopSecuring.LOWER:
            if since >= self.hold_seconds:
                self.tell(Severity.WARNING, stamp_ns, LOWERS)
                self._lower(stamp_ns)
            return False
        if not self._waiting:
            self._waiting, self._anchor = True, Anchor(self.limits, self.control.position)
            if self._read_hold_commands(lambda: self.controls.homing is Homing.GOING, stamp_ns):
                self._report_homing(Homing.ENDED, stamp_ns)
            self._read_hold_commands(self.controls.announce_hold, stamp_ns)
            self.tell(Severity.WARNING, stamp_ns, WAITS)
        elif self._read_hold_commands(lambda: self.controls.supported, stamp_ns):
            self.tell(Severity.WARNING, stamp_ns, LOWERS)
            self._lower(stamp_ns)
        elif self._read_hold_commands(lambda: self.controls.homing is Homing.ASKED, stamp_ns):
            self._plan_motion_home(stamp_ns)
        return False

    def _plan_motion_home(self, stamp_ns: int) -> None:
        """Search for a trajectory home of a held arm, a slice in each cycle, and start it when found."""
        refusal = None
        if self.ended_by is not None and self.ended_by.code not in HOME_AFTER:
            refusal = f"it was stopped by {self.ended_by.code}; support it, and confirm that"
        elif not self._leading:
            # From where the stop has left the reference, unless the arm was led away by hand: the torque has no step.
            wanted, here = self.course.reference.position, self.control.position
            near = (np.abs(wanted - here) <= 0.5 * self.limits.following_error).all()
            self.course.plan_homing(wanted if near else here)
            self._leading = True
        else:
            refusal = self.course.search_return()
        if refusal is not None:
            self._leading = False
            self.tell(Severity.WARNING, stamp_ns, f"not moved home: {refusal}")
            self._report_homing(Homing.REFUSED, stamp_ns)
        elif self.course.try_homing(stamp_ns):
            self._leading = self._waiting = False
            self._anchor, self._level = None, Reaction.WARN
            self._reset_rest_count()
            self.tell(Severity.WARNING, stamp_ns, LEADS)
            self._report_homing(Homing.GOING, stamp_ns)

    def _report_homing(self, stage: Homing, stamp_ns: int) -> None:
        self._read_hold_commands(lambda: self.controls.tell_homing(stage), stamp_ns)

    def _read_hold_commands(self, ask: Callable[[], object], stamp_ns: int) -> bool:
        """Ask the controls about a held arm, which must not fall because they fail."""
        try:
            return bool(ask())
        except Exception as error:  # noqa: BLE001 - whatever they died of
            what = f"reading the controls failed ({error!r})"
            self._react(self.guard.findings.count_fault("controls_failed", what), stamp_ns)
            return False

    def _is_lowered(self, lowering: Lowering, stamp_ns: int, since: float) -> bool:
        """Lower the arm for one more cycle; returns whether it rests or has reached its floor.

        Raises:
            ArmFault: the arm was lowered because of a fault.
        """
        self.lowered = lowering.update(stamp_ns, self.control.position, self.control.velocity) or (
            lowering.share < 1.0 and self.floor_reached(self.control.position)
        )
        braked = self.after_stop is StopSecuring.BRAKE and since >= LOWER_AFTER + LOWER
        if not self.lowered and not braked:
            return False
        if self.states.state is State.STOPPED:
            return True
        if self.ended_by is None:
            raise AssertionError("an arm that was not stopped is lowered because of a fault only")
        raise self._end(self.ended_by)

    def _reset_rest_count(self) -> None:
        self._rested, self._needed = 0, np.zeros_like(self._needed)

    def _apply_commands(self, now_ns: int, stamp_ns: int) -> None:
        """Obey the controls; whatever goes wrong while reading them stops the arm, too."""
        try:
            stop, pause, lease = self.controls.stop, self.controls.pause, self.controls.lease_ok(now_ns)
            finish = self.controls.finish
        except Exception as error:  # noqa: BLE001 - whatever reading it died of, the arm must not fall for it
            self._react(
                self.guard.findings.count_fault("controls_failed", f"reading the controls failed ({error!r})"), stamp_ns
            )
            return
        if stop:
            self.course.stop(stamp_ns)
        elif not lease:
            self._react_to_lost_lease(stamp_ns)
        else:
            if pause:
                self.course.pause(stamp_ns)
            if finish:
                self.course.finish(stamp_ns)
        if self.states.state is State.PAUSED:
            refusal = self.course.search_return()
            self._report_finish_refused(stamp_ns)
            if refusal is not None:
                self._react(self.guard.findings.count_fault("no_way_back", refusal), stamp_ns)
            elif not pause:
                self.course.go_on(stamp_ns)

    def _report_finish_refused(self, stamp_ns: int) -> None:
        why = self.course.not_finished
        if why and "finish" not in self._told:
            self._told.add("finish")
            self.tell(Severity.WARNING, stamp_ns, f"not finished early, continues to its end: {why}")

    def _react_to_lost_lease(self, stamp_ns: int) -> None:
        """React to a lost lease; a stop that is under way already does not become a fault by it."""
        if self.states.state not in (State.STOPPING, State.STOPPED):
            self._react(self.guard.findings.count_fault("lease_lost", "the lease has ended"), stamp_ns)

    def _record(self, sample: Sample, reference: Setpoint, compute_ns: int) -> Fault | None:
        if self.states.state is State.STOPPED and self.after_stop is not StopSecuring.BRAKE:
            # No identification uses these samples, and a person may let an arm wait for hours.
            self._recorded = self._recorded or (sample.stamp_ns - self._since_ns) * 1e-9 > self.hold_seconds
        if self._recorded:
            return None
        try:
            kept = self.sink.put(
                Cycle(
                    sample.stamp_ns,
                    sample.position,
                    sample.velocity,
                    sample.torque,
                    reference.position,
                    reference.velocity,
                    sample.cycle,
                    self.deadlines.lateness_ns,
                    compute_ns,
                    sample.valid,
                    sample.age,
                    sample.lost,
                    sample.measured_torque,
                    sample.joint_position,
                )
            )
            why = "" if kept else self.sink.error or "the recorder cannot keep up"
        except Exception as error:  # noqa: BLE001 - whatever a recorder died of, the arm must not fall for it
            why = f"the recorder failed ({error})"
        if not why or self.states.state in (State.STOPPING, State.STOPPED):
            return None
        return self.guard.findings.count_fault("recorder_behind", why)

    def _finite(self, sample: Sample) -> Sample:
        """Return a sample for recordings: a position that is not finite is invalid and replaced by the one before."""
        before = self.last[-2] if len(self.last) > 1 else sample
        position, velocity = sample.position, sample.velocity
        good = np.isfinite(position)
        return replace(
            sample,
            position=np.nan_to_num(np.where(good, position, before.position)),
            velocity=None if velocity is None else np.nan_to_num(velocity),
            torque=np.nan_to_num(sample.torque),
            valid=sample.valid & good,
        )

    def _remember(self, sample: Sample, usable: Flags, reference: Setpoint) -> None:
        error = np.abs(reference.position - sample.position)
        if not all(usable.tolist()):
            error = np.where(usable, error, 0.0)
        np.maximum(self.peaks.following_error, error, out=self.peaks.following_error)
        np.maximum(self.peaks.torque, np.abs(sample.torque), out=self.peaks.torque)

    def _named(self, code: str, what: str) -> Fault:
        """Return a fault of the joint that moves fastest relative to its limit; `{}` stands for its velocity."""
        joint = int(np.argmax(np.abs(self.control.velocity) / self.limits.velocity))
        return self.guard.findings.count_fault(
            code, self.guard.joint_message(joint, what, self.control.velocity[joint])
        )

    def _end(self, fault: Fault) -> ArmFault:
        """Return the error that makes the caller take the torque away."""
        return ArmFault(fault.code, fault.message, self.last)

    def tell(self, level: int, stamp_ns: int, message: str) -> None:
        """Send one log message with its severity to the sink; a sink that raises is ignored."""
        with suppress(Exception):  # a recorder that has failed says so at its next sample
            self.sink.event(stamp_ns, int(level), message)
