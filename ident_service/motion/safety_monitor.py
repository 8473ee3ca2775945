"""Judge every sample before the next torque leaves, and every torque before it leaves.

Nearly all cycles are healthy, so a cycle first asks only whether all thresholds are kept. Only when one of them is
violated is each compared by itself and put into words. NaN violates every threshold.

For a handful of joints, `all(flags.tolist())` takes a tenth of the time of `flags.all()`, and floats less than arrays.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import ceil

import numpy as np

from drivers.arm import Counts, Flags, Sample, Vector
from drivers.axis_status import TRIPPED, AxisEvent, AxisStatus
from ident_service.config.motion_limits import MotionLimits
from ident_service.model.collision import Contact
from ident_service.motion.encoder_observer import EncoderCoordinates, FrozenEncoderObserver
from ident_service.motion.faults import Fault, FaultCounter
from ident_service.motion.faults import Reaction as Reaction
from ident_service.motion.trajectory import Setpoint


def fault_from_events(
    events: Sequence[AxisEvent], joint_names: Sequence[str], fault_counter: FaultCounter
) -> Fault | None:
    """Make a fault or a counted warning of each event of a sample; return the most severe one, None without events.

    Args:
        events: of the sample.
        joint_names: of the joints.
        fault_counter: counter that makes the faults and counts every warning.

    Returns:
        The most severe fault, the first of equals; None without events.
    """
    worst: Fault | None = None
    for event in events:
        whose = "" if event.axis is None else f"{joint_names[event.axis]}: "
        found = fault_counter.count_fault(event.code.value, f"{whose}{event.words}")
        if worst is None or found.reaction > worst.reaction:
            worst = found
    return worst


MAX_AGE = 3  # cycles without an axis' feedback before it counts as gone, where its driver does not say (FIELDBUS.md)
VELOCITY_STOP, VELOCITY_OFF = 1.2, 2.0  # times the velocity limit (ODrive stops at 1.2)
JUMP = 4.0  # times what the velocity limit allows in one cycle, away from where the arm should have gone on to
# A position that stays the same to the last bit for `FROZEN_CYCLES`, while the controller asks for more than
# `FROZEN_EFFORT` of the torque limit beyond the model's torque: no free joint stands that long against that much.
FROZEN_CYCLES, FROZEN_EFFORT = 20, 0.2
# Likewise one that moved at more than `SUDDEN_SPEED` of its velocity limit and then stands still to the last bit for
# `SUDDEN_CYCLES`: only a hard stop does that. Behind light joints the push above may never come.
SUDDEN_CYCLES, SUDDEN_SPEED = 10, 0.1
# A position loop in the drive pushes far harder for the same distance: there these are times, of 1 kHz.
_FROZEN_SECONDS, _SUDDEN_SECONDS, _LEAST_UNCHANGED = 0.020, 0.010, 3  # s; cycles
# It also pushes at its limit long before the following error is large. Beside the model's torque no joint needs as much
# as this share of its limit for longer than that: preflight allows the model a tenth, and friction. After a cycle that
# was `_STALLED` periods late it is given what lies cycles ahead, and needs up to twice that time to catch up.
PUSHES, _STALLED = 0.4, 1.5
FOLLOWING_LOST = 2.0  # times the following error allowed
# Towards a position limit no motion within the acceleration limit a is faster than sqrt(2 a d) at a distance d from it
# (FIELDBUS.md). The arm may brake `ENVELOPE` times as hard, and be `ENVELOPE_SLACK` of its velocity limit faster.
ENVELOPE, ENVELOPE_SLACK = 1.5, 0.2
# Share of the torque limit by which the acting torque may differ from the one asked for, and the measured one from
# both. A healthy drive is within its current loop's offset and noise, some hundredths of its largest torque.
NOT_APPLIED = 0.1
_ROUNDING = 1e-9  # rad or m, of a position on a limit


@dataclass(frozen=True)
class Check:
    """Represent the comparison of one quantity with its threshold, for all joints.

    Attributes:
        code: code of the fault that a violation would be.
        hit: mask of the violations, shape (joints,) or (names,).
        what: middle of the sentence; `{}` stands for numbers, `{u}` for the position's unit, `{f}` for the torque's.
        numbers: one array, shaped like `hit`, for each `{}`.
        names: names of the things that `hit` is about, the joints when None.
    """

    code: str
    hit: Flags
    what: str
    numbers: tuple[Vector, ...] = ()
    names: Sequence[str] | None = None


@dataclass(frozen=True)
class MonitoredSample:
    """Hold a sample together with the state known from the samples before it.

    Attributes:
        sample: of this cycle.
        wanted: setpoint position of the cycle [rad or m], shape (joints,).
        position: last usable position of each axis [rad or m], shape (joints,).
        velocity: filtered velocity [rad/s or m/s], shape (joints,).
        usable: mask of the axes with a usable position.
        jumped: mask of the axes whose position has just jumped.
        age: number of cycles since each position was usable.
        jumps: number of jumps of each position in a row.
        frozen: mask of the encoders that stand still although the joint cannot.
        was_powered: mask of the axes whose drives have reported before that they are energised, or would have by now.
        sent: last torque sent [N m or N], shape (joints,), or None.
        max_age: cycles without an axis' feedback before it counts as gone.
        depths: how deep pairs of solids reach into each other [m].
        pairs: names of these pairs.
        most_torque: largest torque that drives which are given positions may measure [N m or N], shape (joints,); None
            for drives that are given torques.
    """

    sample: Sample
    wanted: Vector
    position: Vector
    velocity: Vector
    usable: Flags
    jumped: Flags
    age: Counts
    jumps: Counts
    frozen: Flags
    was_powered: Flags
    sent: Vector | None
    max_age: int
    depths: Vector
    pairs: tuple[str, ...]
    most_torque: Vector | None = None


def checks(monitored: MonitoredSample, limits: MotionLimits) -> Iterator[Check]:
    """Yield all checks of a sample, each with a mask that may be empty; those for untrustworthy data come first."""
    yield from _what_cannot_be_believed(monitored, limits)
    yield from _quick_stop_checks(monitored)
    yield from _what_must_end(monitored, limits)
    yield from _what_can_be_bridged(monitored, limits)


def _what_cannot_be_believed(seen: MonitoredSample, limits: MotionLimits) -> Iterator[Check]:
    """Check for faults that take the torque off: feedback that is not credible, an emergency stop, a runaway."""
    sample, position, speed = seen.sample, seen.position, np.abs(seen.velocity)
    bad = sample.valid & ~np.isfinite(sample.position)
    yield Check("feedback_not_finite", bad, "position is not a number")
    if sample.velocity is not None:
        yield Check("feedback_not_finite", sample.valid & ~np.isfinite(sample.velocity), "velocity is not a number")
    yield Check("feedback_not_finite", ~np.isfinite(sample.torque), "applied torque is not a number")
    yield Check("emergency_stop", _has_status(seen, AxisStatus.EMERGENCY_STOP), "the drive reports an emergency stop")
    what = "position unchanged to the last bit although the joint moved or was pushed"
    yield Check("frozen_encoder", seen.frozen, what)
    beyond, limit = _limit_excess(position, limits)
    what = "at {} {u}, more than a following error beyond the position limit of {} {u}"
    yield Check("far_outside", beyond > limits.following_error, what, (position, limit))
    what = f"moves at {{}} {{u}}/s, more than {VELOCITY_OFF:g} times the limit of {{}} {{u}}/s"
    yield Check("runaway", speed > VELOCITY_OFF * limits.velocity, what, (seen.velocity, limits.velocity))


def _quick_stop_checks(seen: MonitoredSample) -> Iterator[Check]:
    """Check for faults that lead to a quick stop."""
    yield Check("drive_fault", _has_status(seen, AxisStatus.FAULT), "the drive reports a fault")
    yield Check("drive_watchdog", _has_status(seen, AxisStatus.WATCHDOG), "the drive's watchdog has struck")
    unpowered = seen.was_powered & ~_has_status(seen, AxisStatus.POWERED) & bool(seen.sample.status)
    yield Check("drive_fault", unpowered, "the drive is not energised")
    age = seen.age.astype(float)
    # Where the bus or this machine was late, others lack a few cycles less.
    missing = (seen.age > 0) & (seen.age >= seen.max_age).any()
    yield Check("feedback_gone", missing, "no usable feedback for {} cycles", (age,))


def _what_must_end(seen: MonitoredSample, limits: MotionLimits) -> Iterator[Check]:
    """Check for faults that lead to damped lowering, then for those that lead to a controlled stop."""
    position, velocity, speed = seen.position, seen.velocity, np.abs(seen.velocity)
    away, allowed = np.abs(seen.wanted - position), limits.following_error
    what = "{} {u} from where it should be, {} {u} allowed"
    yield Check("following_lost", away > FOLLOWING_LOST * allowed, what, (away, allowed))
    unseen = (seen.age - seen.jumps).astype(float)
    jumps = seen.jumps >= 2
    after = " after {} without feedback" if unseen[jumps].any() else ""
    yield Check("encoder_jumps", jumps, f"position jumped in consecutive cycles{after}", (unseen,))
    beyond, limit = _limit_excess(position, limits)
    yield Check("position_limit", beyond > 0.0, "at {} {u}, beyond the limit of {} {u}", (position, limit))
    towards = np.where(velocity > 0.0, limits.upper - position, position - limits.lower)
    envelope = approach_speed(towards, limits)
    what_near = "moves towards its position limit at {} {u}/s, {} {u}/s allowed so near to it"
    yield Check("position_envelope", speed > envelope, what_near, (velocity, envelope))
    what_fast = f"moves at {{}} {{u}}/s, more than {VELOCITY_STOP:g} times the limit of {{}} {{u}}/s"
    yield Check("over_velocity", speed > VELOCITY_STOP * limits.velocity, what_fast, (velocity, limits.velocity))
    yield Check("following_error", away > allowed, what, (away, allowed))
    yield Check("workspace", seen.depths > 0.0, "touch, {} m deep", (seen.depths,), seen.pairs)


def _what_can_be_bridged(seen: MonitoredSample, limits: MotionLimits) -> Iterator[Check]:
    """Check for warnings."""
    jumped_to = seen.sample.position
    yield Check("encoder_jump", seen.jumped, "position jumped to {} {u} from {} {u}", (jumped_to, seen.position))
    yield Check("lost_feedback", ~seen.usable, "no feedback in this cycle")
    if seen.most_torque is not None:
        exceeds = np.abs(seen.sample.torque) > seen.most_torque
        what = "the drive measures {} {f}, {} allowed"
        yield Check("torque_exceeded", exceeds, what, (seen.sample.torque, seen.most_torque))
    if seen.sent is not None:
        differs = np.abs(seen.sample.torque - seen.sent) > NOT_APPLIED * limits.torque
        what = "the drive gives {} of the {} {f} commanded"
        yield Check("torque_not_applied", differs, what, (seen.sample.torque, seen.sent))
    if (more := seen.sample.torque_difference) is not None:
        what = "the drive measures {} {f} more than commanded, at {} {f}"
        yield Check("torque_not_applied", np.abs(more) > NOT_APPLIED * limits.torque, what, (more, seen.sample.torque))


def approach_speed(distance: Vector, limits: MotionLimits) -> Vector:
    """Return the largest speed allowed towards a position limit [rad/s or m/s], (joints,): sqrt(2 a d) with allowances.

    Args:
        distance: distance from the limit, negative beyond it [rad or m], shape (joints,).
        limits: of the arm.

    Returns:
        sqrt(2 a d) with the allowances `ENVELOPE` and `ENVELOPE_SLACK` [rad/s or m/s], shape (joints,).
    """
    squared = np.maximum(2.0 * ENVELOPE * limits.acceleration * distance, 0.0)
    return np.asarray(np.sqrt(squared + (ENVELOPE_SLACK * limits.velocity) ** 2))


def describe_check(check: Check, joint_names: Sequence[str], joint_units: Sequence[str]) -> str:
    """Describe a violated check in words: the joints concerned, and what was measured.

    Args:
        check: check with at least one hit.
        joint_names: of the joints.
        joint_units: units of the joints' positions.
    """
    hit: list[int] = np.flatnonzero(check.hit).tolist()
    joint_names = check.names or joint_names
    texts = [", ".join(f"{number[k]:.4g}" for k in hit) for number in check.numbers]
    unit = "" if check.names else joint_units[hit[0]]
    force = {"rad": "N m", "m": "N"}.get(unit, "")
    return f"{', '.join(dict.fromkeys(joint_names[k] for k in hit))}: {check.what.format(*texts, u=unit, f=force)}"


def _limit_excess(position: Vector, limits: MotionLimits) -> tuple[Vector, Vector]:
    """Return how far positions [rad or m] are outside their limits, and the limit concerned, shape (joints,) each."""
    above, below = position - limits.upper, limits.lower - position
    return np.maximum(above, below), np.where(above > below, limits.upper, limits.lower)


def _has_status(seen: MonitoredSample, bit: AxisStatus) -> Flags:
    """Return which axes' status words have a bit set, shape (joints,)."""
    status = seen.sample.status or (0,) * len(seen.position)
    return np.array([bool(word & bit) for word in status])


ABSURD = 3.0  # times the torque limit: no controller here asks for that
# Change of torque: libfranka's 1000 N m/s; on small joints, which that would not limit, from none to full in 10 ms.
TORQUE_RATE, TORQUE_RATE_SHARE = 1000.0, 100.0  # N m/s or N/s; times the torque limit per second


class SafetyMonitor:
    """Check every sample and every torque of one motion.

    Attributes:
        findings: counter that makes the faults and counts the warnings, also those of others.
        rate: largest change of torque per cycle [N m or N], shape (joints,).
        jump: largest believed distance of a position from the expected one [rad or m], shape (joints,).
    """

    def __init__(
        self,
        joint_names: tuple[str, ...],
        limits: MotionLimits,
        period: float,
        position: Vector,
        *,
        revolute: tuple[bool, ...] | None = None,
        contact: Contact | None = None,
        encoder_observer: FrozenEncoderObserver | None = None,
        max_age: int = MAX_AGE,
        most_torque: Vector | None = None,
        coupling: Vector | None = None,
        report_delay: float | None = None,
    ) -> None:
        """Start with the arm standing at a position.

        Args:
            joint_names: names of the joints, for the sentences.
            limits: of the arm.
            period: of the loop [s].
            position: present position of the arm [rad or m], shape (joints,).
            revolute: mask of the revolute joints, for the units in the sentences; all when None.
            contact: pairs of solids that may not touch; None for no collision check.
            encoder_observer: estimator of how far joints that stand still would have moved; without it, only hard
                pushes and full motion reveal frozen encoders.
            max_age: cycles without an axis' feedback before it counts as gone (`ArmDescription.lost_cycles`).
            most_torque: torque above which the measured torque of drives that are given positions is a warning [N m or
                N], shape (joints,); None for drives that are given torques.
            coupling: drive coordinates per joint coordinates, shape (joints, joints): a drive that moves several joints
                can stand still, too; each joint's own drive when None.
            report_delay: for an arm that is enabled before the first sample, the delay with which its drives report
                that they are energised [s] (`ArmDescription.report_delay`); they have as many cycles more as feedback
                may be missing. When None, a drive may report it at any time.
        """
        joints = len(position)
        self.findings = FaultCounter()
        self.rate = np.minimum(TORQUE_RATE, TORQUE_RATE_SHARE * limits.torque) * period
        self._names, self._limits, self._period = joint_names, limits, period
        self._elapsed, self._known, self._max_age = period, True, max_age
        self._units = tuple("rad" if turns else "m" for turns in revolute or (True,) * joints)
        self._contact = contact if contact is not None and contact.pairs else None
        self._pairs = contact.pairs if contact is not None else ()
        self._encoder_observer = encoder_observer
        self._position = self._shown = position.copy()
        self._age: Counts = np.zeros(joints, dtype=np.int64)
        self._unseen = np.zeros(joints)  # s since each position was usable
        self._unsure = np.zeros(joints)  # and the longest part of that which may not have passed
        self._jumps: Counts = np.zeros(joints, dtype=np.int64)
        encoders = self._encoders = EncoderCoordinates.of(coupling, joints)
        self._fast = SUDDEN_SPEED * encoders.largest_motions(limits.velocity)
        self._push = FROZEN_EFFORT * encoders.largest_forces(limits.torque)
        self._still: Counts = np.zeros(len(self._push), dtype=np.int64)
        self._unchanged: Counts = np.zeros(len(self._push), dtype=np.int64)
        self._sudden = np.zeros(len(self._push), dtype=bool)
        self._owes: Flags = np.zeros(len(self._push), dtype=bool)
        self._all_fresh = self._none_still = self._all_change = True
        self._depths = np.zeros(len(self._pairs))
        self._sent: Vector | None = None
        self._most_torque = most_torque
        self._pushing: Counts = np.zeros(joints, dtype=np.int64)
        self._catching_up = 0  # cycles in which a drive may push because of a stall
        self._frozen_after = FROZEN_CYCLES, SUDDEN_CYCLES
        if most_torque is not None:
            seconds = _FROZEN_SECONDS, _SUDDEN_SECONDS
            frozen, sudden = (max(_LEAST_UNCHANGED, round(one / period)) for one in seconds)
            self._frozen_after = frozen, sudden
        self._target = self._previous_target = position.copy()
        self._none = np.zeros(joints)
        self._healthy: tuple[int, ...] = ()
        self._powered_by = 0 if report_delay is None else max_age + ceil(report_delay / period) + 1
        self._was_powered = np.zeros(joints, dtype=bool)
        self.jump = JUMP * limits.velocity * period
        self._not_applied = NOT_APPLIED * limits.torque
        together = np.eye(joints, dtype=bool) if limits.motors is None else limits.motors.together
        self._joined = together @ together.T  # which joints share motors
        self._braking = 2.0 * ENVELOPE * limits.acceleration
        slack, fastest = (ENVELOPE_SLACK * limits.velocity) ** 2, VELOCITY_STOP * limits.velocity
        bounds = limits.lower, limits.upper, self._braking, slack, fastest, limits.following_error, self.jump
        self._quiet_bounds = list(zip(*(bound.tolist() for bound in bounds), strict=True))

    @property
    def warnings(self) -> dict[str, int]:
        """Return how often each warning was found, by code."""
        return self.findings.warnings

    def check_feedback(
        self,
        sample: Sample,
        reference: Setpoint,
        velocity: Vector,
        feedback_torque: Vector,
        feedback_acceleration: Vector | None = None,
        elapsed: float | None = None,
        friction_feedforward: Vector | float = 0.0,
        *,
        elapsed_is_exact: bool = True,
        unexplained_torque: Vector | None = None,
    ) -> tuple[Flags, Fault | None]:
        """Check a sample against all thresholds; return a mask of usable positions and the most severe fault or None.

        Args:
            sample: of this cycle.
            reference: setpoint at the sample's stamp.
            velocity: filtered velocity before this sample [rad/s or m/s], shape (joints,).
            feedback_torque: feedback part of the torque before this sample [N m or N], shape (joints,).
            feedback_acceleration: the acceleration in that torque [rad/s^2 or m/s^2], shape (joints,); without it,
                `encoder_observer` is not updated.
            elapsed: time since the sample before [s]; one period when None.
            elapsed_is_exact: whether `elapsed` is the true time; if not, it is the longest that it may be.
            friction_feedforward: friction in the torque before this sample [N m or N], shape (joints,), which pushes a
                joint against its own friction as the feedback torque does.
            unexplained_torque: torque that drives which are given positions measure beside the model's [N m or N],
                shape (joints,), by which they push a joint on their own; None where none is known.

        Returns:
            Which axes' positions may be used, and the most severe fault found, if any.
        """
        self.findings.cycle += 1
        if self.findings.cycle == self._powered_by:
            self._was_powered, self._healthy = np.ones_like(self._was_powered), ()
        self._elapsed, self._known = self._period if elapsed is None else elapsed, elapsed_is_exact
        answered = all(sample.valid.tolist())
        encoders = self._encoders
        steps, valid = encoders.steps(sample.position, self._shown), encoders.valid(sample.valid)
        pushed = np.abs(encoders.forces(feedback_torque + friction_feedforward))
        if unexplained_torque is not None:
            pushed = np.maximum(pushed, np.abs(encoders.forces(unexplained_torque)))
        self._count_stationary_cycles(steps, valid, pushed)
        same = (steps == 0.0) & valid
        if self._most_torque is not None:
            # A drive that has been given no other position brings its joint to a stand.
            same &= encoders.steps(self._target, self._previous_target) != 0.0
            self._previous_target = self._target
        self._count_unchanged(same, velocity)
        if self._encoder_observer is not None and feedback_acceleration is not None:
            seen = np.where(valid, steps, 0.0)
            self._owes = self._encoder_observer.update(
                seen, feedback_torque, feedback_acceleration, self._position, friction_feedforward
            )
        held = answered and self._all_fresh and self._quiet(sample.position, reference.position, velocity)
        if held and self._plain(sample):
            # Copied, in case that a driver fills the same array again.
            self._position = self._shown = sample.position.copy()
            usable, fault = sample.valid, None
        else:
            with np.errstate(all="ignore"):
                usable, fault = self._judged(sample, reference.position, velocity)
        if self._most_torque is not None:
            pushes = self._count_pushes(self._none if unexplained_torque is None else unexplained_torque)
            fault = pushes if pushes is not None and (fault is None or fault.reaction < pushes.reaction) else fault
        if sample.events:
            event = fault_from_events(sample.events, self._names, self.findings)
            # Of equally severe faults, a drive's event tells more than its status word.
            if event is not None and (fault is None or event.reaction >= fault.reaction):
                fault = event
        return usable, fault

    def limit_torque(self, computed_torque: Vector) -> tuple[Vector, Fault | None]:
        """Return the torque limited in size and rate (the first in size only; 0 if refused), and its fault or None.

        Args:
            computed_torque: torque demanded by the controller [N m or N], shape (joints,).

        Returns:
            The torque that may leave: within limits, or zero when the fault takes torque away. The first one is not
            limited in rate, because the support yields to it.
        """
        limit, before, motors = self._limits.torque, self._sent, self._limits.motors
        size = np.abs(computed_torque)
        if (
            all((size <= limit).tolist())
            and (motors is None or all((motors.torque_shares(computed_torque) <= 1.0).tolist()))
            and (before is None or all((np.abs(computed_torque - before) <= self.rate).tolist()))
        ):
            self._sent = computed_torque
            return computed_torque, None
        finite = np.isfinite(computed_torque)
        what = f"a torque of {{}} {{f}} was requested, more than {ABSURD:g} times the limit of {{}}"
        for check in (
            Check("torque_not_finite", ~finite, "the requested torque is not a number"),
            Check("torque_absurd", finite & (size > ABSURD * limit), what, (computed_torque, limit)),
        ):
            if check.hit.any():
                return np.zeros_like(limit), self._found(check)
        leaves = np.clip(computed_torque, -limit, limit)
        over, fault = size > limit, None
        if over.any():
            what = "a torque of {} {f} was requested, the limit is {}"
            fault = self._found(Check("torque_saturated", over, what, (computed_torque, limit)))
        if motors is not None and (over := motors.torque_shares(leaves) > 1.0).any():
            what = "a torque of {} N m was requested, the limit is {}"
            asked = leaves @ motors.to_motors.T
            fault = self._found(Check("torque_saturated", over, what, (asked, motors.torque), motors.names))
            leaves = motors.scaled_within(leaves)
        if before is not None and (fast := np.abs(leaves - before) > self.rate).any():
            change = (leaves - before) / self._period
            what = "the torque was to change by {} {f}/s, {} allowed"
            found = self._found(Check("torque_rate", fast, what, (change, self.rate / self._period)))
            leaves = self._rate_limited(before, leaves)
            fault = found if fault is None or found.reaction > fault.reaction else fault
        self._sent = leaves
        return leaves, fault

    def limit_position(self, reference_position: Vector) -> tuple[Vector, Fault | None]:
        """Return the position limited in step for the drives (the last one if refused), and its fault or None.

        Args:
            reference_position: position demanded by the trajectory [rad or m], shape (joints,).

        Returns:
            The position that may leave: no farther from the last one than the joints move in a cycle at `VELOCITY_STOP`
            times their velocity limit, first from where the arm stands; the last one when the fault ends motion.
        """
        finite = np.isfinite(reference_position)
        if not finite.all():
            return self._target, self._found(
                Check("position_not_finite", ~finite, "the position asked for is no number")
            )
        beyond, limit = _limit_excess(reference_position, self._limits)
        if (outside := beyond > _ROUNDING).any():
            what = "a position of {} {u} was asked for, the limit is {} {u}"
            return self._target, self._found(Check("position_outside", outside, what, (reference_position, limit)))
        step, most = reference_position - self._target, VELOCITY_STOP * self._limits.velocity * self._period
        fast, fault = np.abs(step) > most, None
        if fast.any():
            what = "the position was to change by {} {u} in a cycle, {} {u} allowed"
            fault = self._found(Check("position_rate", fast, what, (step, most)))
            reference_position = self._target + np.clip(step, -most, most)
        self._target = reference_position
        return reference_position, fault

    def _rate_limited(self, before: Vector, wanted: Vector) -> Vector:
        """Return the torque on the way from the last one to the one wanted that the rate allows."""
        if self._limits.motors is None:
            return np.clip(wanted, before - self.rate, before + self.rate)
        # Joints that share motors change by the same share: between two torques that their motors can give lies one
        # that they can give, but not where each joint goes its own share of the way.
        change = np.abs(wanted - before)
        share = np.minimum(1.0, self.rate / np.maximum(change, self.rate))
        return np.asarray(before + np.where(self._joined, share, 1.0).min(axis=1) * (wanted - before))

    def joint_message(self, joint_index: int, template: str, velocity: float) -> str:
        """Return a joint's name, a colon and `template`, its `{}` replaced by the velocity [rad/s or m/s] with unit."""
        return f"{self._names[joint_index]}: {template.format(f'{velocity:.4g} {self._units[joint_index]}/s')}"

    def _quiet(self, position: Vector, wanted: Vector, velocity: Vector) -> bool:
        """Return whether positions that all answered keep every position, velocity, following and jump threshold."""
        rows = zip(
            *(position.tolist(), self._position.tolist(), wanted.tolist(), velocity.tolist()),
            self._quiet_bounds,
            strict=True,
        )
        for here, before, target, speed, (lower, upper, braking, slack, fastest, away, farthest) in rows:
            above, below, signed = here - upper, lower - here, speed * abs(speed)
            kept = (
                above <= 0.0
                and below <= 0.0
                and braking * above + signed <= slack  # v |v| - 2 a d, towards either limit
                and braking * below - signed <= slack
                and abs(speed) <= fastest
                and abs(target - here) <= away
                and abs(here - before - speed * self._elapsed) <= farthest
            )
            if not kept:
                return False
        return True

    def _plain(self, sample: Sample) -> bool:
        """Return whether encoders, status words, torques, velocities and collision distances are all healthy."""
        if not (self._none_still and self._all_change) and any(self._frozen().tolist()):
            return False
        if sample.status is not self._healthy and not self._all_drives_healthy(sample.status):
            return False
        sent, most = self._sent, self._most_torque
        if sent is not None and not all((np.abs(sample.torque - sent) <= self._not_applied).tolist()):
            return False
        if most is not None and not all((np.abs(sample.torque) <= most).tolist()):
            return False
        if sent is None and most is None and not all(np.isfinite(sample.torque).tolist()):
            return False
        more = sample.torque_difference
        if more is not None and not all((np.abs(more) <= self._not_applied).tolist()):
            return False
        if sample.velocity is not None and not all(np.isfinite(sample.velocity).tolist()):
            return False
        if self._contact is None:
            return True
        self._depths = self._contact.depths(sample.position)
        return self._depths is self._contact.clear or all((self._depths <= 0.0).tolist())

    def _all_drives_healthy(self, status: tuple[int, ...]) -> bool:
        """Return whether no drive has tripped or lost its power; remembers healthy status words."""
        if status != self._healthy:
            powered = np.array([bool(word & AxisStatus.POWERED) for word in status])
            if any(word & TRIPPED for word in status) or bool((self._was_powered & ~powered).any()):
                return False
            self._was_powered = powered
        self._healthy = status
        return True

    def _judged(self, sample: Sample, wanted: Vector, velocity: Vector) -> tuple[Flags, Fault | None]:
        """Check a sample that may violate a threshold, threshold by threshold."""
        position = sample.position
        # If the window only grew with the age, the second reading of a wrong position would be accepted.
        unseen, unsure = self._unseen + self._elapsed, np.maximum(self._unsure, 0.0 if self._known else self._elapsed)
        window = self.jump * np.maximum(unsure / self._period, 1.0)
        jumped = sample.valid & (np.abs(position - self._position - velocity * unseen) > window)
        usable = sample.valid & ~jumped
        self._jumps = np.where(jumped, self._jumps + 1, 0)
        self._age = np.where(usable, 0, np.maximum(self._age + 1, sample.age))
        self._unseen = np.where(usable, 0.0, unseen)
        self._unsure = np.where(usable, 0.0, unsure)
        self._position = np.where(usable, position, self._position)
        self._all_fresh = not self._age.any()
        self._shown = np.where(sample.valid, position, self._shown)
        if sample.status:
            self._all_drives_healthy(sample.status)
        if self._contact is not None and bool(np.isfinite(self._position).all()):
            self._depths = self._contact.depths(self._position)
        seen = MonitoredSample(
            sample,
            wanted,
            self._position,
            velocity,
            usable,
            jumped,
            self._age,
            self._jumps,
            self._frozen(),
            self._was_powered,
            self._sent,
            self._max_age,
            self._depths,
            self._pairs,
            self._most_torque,
        )
        for check in checks(seen, self._limits):
            if check.hit.any():
                return usable, self._found(check)
        return usable, None

    def _count_pushes(self, unexplained: Vector) -> Fault | None:
        """Count for how many cycles each drive has pushed beside the model's torque; returns a fault after too many."""
        if self._elapsed > _STALLED * self._period:
            self._catching_up = 2 * self._frozen_after[0]
        hit = (np.abs(unexplained) > PUSHES * self._limits.torque) & (self._catching_up == 0)
        self._catching_up = max(0, self._catching_up - 1)
        self._pushing = np.where(hit, self._pushing + 1, 0)
        if not (long := self._pushing >= self._frozen_after[0]).any():
            return None
        numbers = (unexplained, self._limits.torque)
        return self._found(
            Check("torque_unexplained", long, "the drive measures {} {f} beside the model's, of {}", numbers)
        )

    def _count_stationary_cycles(self, steps: Vector, valid: Flags, pushes: Vector) -> None:
        """Count for how many cycles each position has stood still while the controller, or the drive, pushed."""
        pushed = pushes > self._push
        if any(pushed.tolist()):
            changed = (steps != 0.0) & valid
            self._still = np.where(pushed & ~changed, self._still + 1, 0)
            self._none_still = False
        elif not self._none_still:
            self._still = np.zeros_like(self._still)
            self._none_still = True

    def _count_unchanged(self, same: Flags, velocity: Vector) -> None:
        """Count for how many cycles each position has stood still, and note whether that began in full motion."""
        if any(same.tolist()):
            fast = np.abs(self._encoders.velocities(velocity)) > self._fast
            self._sudden = np.where(self._unchanged == 0, same & fast, self._sudden)
            self._unchanged = np.where(same, self._unchanged + 1, 0)
            self._all_change = False
        elif not self._all_change:
            self._unchanged = np.zeros_like(self._unchanged)
            self._all_change = True

    def _frozen(self) -> Flags:
        """Return the joints of encoders that stand still although their joint, or drive, cannot."""
        frozen, sudden = self._frozen_after
        flags = (self._still >= frozen) | (self._sudden & (self._unchanged >= sudden)) | self._owes
        return self._encoders.at_joints(flags)

    def _found(self, check: Check) -> Fault:
        return self.findings.count_fault(check.code, describe_check(check, self._names, self._units))
