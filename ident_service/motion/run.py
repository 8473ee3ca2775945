"""One run: approach, excite, return, every cycle guarded, every cycle recorded.

The loop owns no file: it hands samples to a sink that keeps the disk away, and a sink that fails stops the arm under
control like one that is slow. The stop path is `_halt`: torque off, no condition, nothing that can raise.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.arm import Arm, Sample, StopKind, Vector
from ident_service.config.limits import MotionLimits, motion_limits
from ident_service.errors import ArmFault, DriverError, MotionRefused
from ident_service.excitation.demands import require_within_limits
from ident_service.excitation.excitation import Excitation
from ident_service.model.arm_model import ArmModel
from ident_service.model.rigid_body import InverseDynamics
from ident_service.motion.control import ComputedTorque
from ident_service.motion.guard import REACTIONS, Fault, Guard, Reaction
from ident_service.motion.reference import PathReference, Reference, Setpoint, rest
from ident_service.motion.speed import Slowed, require_factor
from ident_service.motion.states import LAWFUL, MOVING, State, next_state
from ident_service.motion.stop import require_stops_within_limits, stop
from ident_service.motion.surroundings import require_clear
from ident_service.motion.way import calm_way

_KEPT_SAMPLES = 100
_REST_CYCLES = 20
_LONGEST_GAP = 20  # periods without a cycle, through which nobody guarded the arm (FIELDBUS.md: whole bus silent)
_ERROR, _INFO = 40, 20  # levels of rcl_interfaces/msg/Log


class Sink(Protocol):
    """Where samples go; `record.recorder.Recorder` is one."""

    def put(
        self,
        stamp_ns: int,
        position: Vector,
        velocity: Vector | None,
        torque: Vector,
        reference_position: Vector,
        reference_velocity: Vector,
        cycle: int,
        lateness_ns: int,
        compute_ns: int,
        valid: NDArray[np.bool_],
        age: NDArray[np.int64],
        lost: int,
    ) -> bool:
        """Take one cycle; False when the sink cannot keep up."""

    def event(self, stamp_ns: int, level: int, message: str) -> bool:
        """Take one line of the story."""


@dataclass(frozen=True)
class RunReport:
    """How a run went.

    Attributes:
        state: DONE, or STOPPED where somebody asked for a stop.
        cycles: exchanged.
        peak_following_error: [rad or m], shape (joints,).
        peak_torque: that left [N m or N], shape (joints,).
        warnings: how often each mild fault was seen.
    """

    state: State
    cycles: int
    peak_following_error: Vector
    peak_torque: Vector
    warnings: dict[str, int]


def run(
    arm: Arm,
    model: ArmModel,
    excitation: Excitation,
    sink: Sink,
    stop_requested: Callable[[], bool] = lambda: False,
    *,
    speed: float = 1.0,
) -> RunReport:
    """Move an open arm along an excitation and back to where it stood.

    Args:
        arm: open, not enabled.
        model: with the prior parameters that control needs.
        excitation: checked against the limits beforehand.
        sink: takes every sample.
        stop_requested: asked every cycle; True brings the arm to a controlled stop.
        speed: share of the motion's own speed at which all of it is played, approach and return too; a rehearsal
            takes 0.2. Stops are never slowed.

    Returns:
        The report of a run that ended in DONE or, after a request, in STOPPED.

    Raises:
        UsageError: the speed is not above 0 and at most 1; nothing has moved.
        MotionRefused: nothing has moved; the message says why.
        ArmFault: a fault stopped the motion; the arm is stopped or without torque.
        DriverError: the arm refused to be enabled.
    """
    return _Run(arm, model, excitation, sink, stop_requested, require_factor(speed)).run()


@dataclass
class _Peaks:
    following_error: Vector
    torque: Vector


@dataclass
class _Run:
    arm: Arm
    model: ArmModel
    excitation: Excitation
    sink: Sink
    stop_requested: Callable[[], bool]
    speed: float
    state: State = State.IDLE
    last: deque[Sample] = field(default_factory=lambda: deque(maxlen=_KEPT_SAMPLES))

    def run(self) -> RunReport:
        limits = motion_limits(self.model.config)
        if self.model.prior is None:
            raise MotionRefused(f"{self.model.config.name}: computed torque needs prior parameters")
        described = self.arm.describe()
        if described.joint_names != self.model.chain.names:
            raise MotionRefused(
                f"the arm on the bus has the joints {', '.join(described.joint_names)}, "
                f"the description {', '.join(self.model.chain.names)}"
            )
        if self.excitation.arm_sha256 != self.model.config.motion_sha256:
            raise MotionRefused(f"the {self.excitation.name} motion was made for another description of the arm")
        require_within_limits(self.excitation.path, self.model, limits)
        require_stops_within_limits(self.excitation.path, limits, self.model.chain.names)
        dynamics = InverseDynamics(self.model.chain, self.model.layout, self.model.prior)
        period = 1.0 / described.rate
        sample = self._look(limits, period)
        home = sample.position.copy()
        ways = self._ways(home, limits)
        require_clear(self.model, self.excitation.path, [ways[0], ways[-1]], limits)
        self._guard = Guard(self.model.chain.names, limits, period, home)
        self._control = ComputedTorque(dynamics, limits, period, self.model.config.control.velocity_cutoff, home)
        self._peaks = _Peaks(np.zeros_like(home), np.zeros_like(home))
        self._way = ways.pop(0)
        torque, cannot_hold = self._guard.torque(self._control.torque(home, sample.valid, rest(home)))
        if cannot_hold is not None:
            raise MotionRefused(f"the arm cannot be held where it stands: {cannot_hold.message}")
        try:
            self.arm.enable()
            self._enter(State.APPROACHING, sample.stamp_ns)
            fault = self._loop(torque, ways, limits, period)
            if fault is not None:
                raise ArmFault(fault.code, fault.message, self.last)
            self.arm.stop(StopKind.TORQUE_OFF)
        except BaseException as error:
            self._halt(error)
            raise
        return RunReport(
            self.state,
            self.last[-1].cycle + 1,
            self._peaks.following_error,
            self._peaks.torque,
            dict(self._guard.warnings),
        )

    def _look(self, limits: MotionLimits, period: float) -> Sample:
        """Samples without torque: the arm must be where it may be, and at rest."""
        samples = [self.arm.exchange(None) for _ in range(_REST_CYCLES)]
        first, last = samples[0], samples[-1]
        if not all(bool(sample.valid.all() and np.isfinite(sample.position).all()) for sample in samples):
            raise MotionRefused("not every axis answers; check the bus before anything moves")
        drift = np.abs(last.position - first.position) / (period * (_REST_CYCLES - 1))
        if bool(np.any(drift > 0.05 * limits.velocity)):
            raise MotionRefused("the arm is moving; it must be at rest and supported before a run begins")
        names = self.model.chain.names
        outside = [
            f"{name} at {q:.3f}, limits {low:g}..{high:g}"
            for name, q, low, high in zip(names, last.position, limits.lower, limits.upper, strict=True)
            if not low <= q <= high
        ]
        if outside:
            raise MotionRefused("outside the position limits: " + "; ".join(outside))
        return last

    def _ways(self, home: Vector, limits: MotionLimits) -> list[Reference]:
        exciting = PathReference(self.excitation.path)
        start, end = exciting.at(0.0), exciting.at(exciting.duration)
        ways: list[Reference] = [calm_way(rest(home), start, limits), exciting, calm_way(end, rest(home), limits)]
        return [Slowed(reference, self.speed) for reference in ways]

    def _loop(self, torque: Vector, ways: list[Reference], limits: MotionLimits, period: float) -> Fault | None:
        """Cycle until done, stopped or faulted; the fault that ended the motion, if one did."""
        followers = {State.APPROACHING: State.EXCITING, State.EXCITING: State.RETURNING, State.RETURNING: State.DONE}
        ended_by: Fault | None = None
        expected_ns: int | None = None
        while True:
            try:
                sample = self.arm.exchange(torque)
            except DriverError as error:
                return Fault("driver", REACTIONS["driver"], str(error))
            if not self.last:
                self._begin_ns = sample.stamp_ns  # not before: enabling takes as long as it takes
            elif not 0 < (gap := sample.stamp_ns - self.last[-1].stamp_ns) <= _LONGEST_GAP * period * 1e9:
                return Fault("driver", REACTIONS["driver"], f"consecutive stamps are {gap * 1e-6:g} ms apart")
            woken_ns = self.arm.clock.now_ns()
            lateness_ns = 0 if expected_ns is None else max(0, woken_ns - expected_ns)
            expected_ns = woken_ns - lateness_ns + round(period * 1e9) if lateness_ns < period * 1e9 else None
            self.last.append(sample)
            elapsed = (sample.stamp_ns - self._begin_ns) * 1e-9
            while elapsed >= self._way.duration:
                if self.state is State.STOPPING:
                    self._enter(State.STOPPED, sample.stamp_ns)
                    return ended_by
                self._enter(followers[self.state], sample.stamp_ns)
                if self.state is State.DONE:
                    return None
                self._begin_ns += round(self._way.duration * 1e9)
                self._way = ways.pop(0)
                elapsed = (sample.stamp_ns - self._begin_ns) * 1e-9
            reference = self._way.at(elapsed)
            usable, fault = self._guard.feedback(sample, reference, self._control.velocity, self._control.correction)
            wanted = self._control.torque(sample.position, usable, reference)
            torque, torque_fault = self._guard.torque(wanted)
            compute_ns = self.arm.clock.now_ns() - woken_ns
            unrecorded = self._record(sample, reference, lateness_ns, compute_ns)
            for found in (torque_fault, None if self.state is State.STOPPING else unrecorded):
                if found is not None and (fault is None or found.reaction > fault.reaction):
                    fault = found
            self._remember(sample, usable, reference)
            if fault is not None and fault.reaction is Reaction.TORQUE_OFF:
                return fault
            must_stop = fault is not None and fault.reaction is Reaction.CONTROLLED_STOP
            if fault is not None and must_stop and ended_by is None:
                ended_by = fault
                self._tell(_ERROR, sample.stamp_ns, f"{fault.code}: {fault.message}")
            if self.state in MOVING and (must_stop or self.stop_requested()):
                self._enter(State.STOPPING, sample.stamp_ns)
                self._begin_ns, self._way = sample.stamp_ns, stop(reference, limits)

    def _record(self, sample: Sample, reference: Setpoint, lateness_ns: int, compute_ns: int) -> Fault | None:
        try:
            kept = self.sink.put(
                sample.stamp_ns,
                sample.position,
                sample.velocity,
                sample.torque,
                reference.position,
                reference.velocity,
                sample.cycle,
                lateness_ns,
                compute_ns,
                sample.valid,
                sample.age,
                sample.lost,
            )
        except Exception as error:  # noqa: BLE001 - whatever a recorder died of, the arm must not fall for it
            return Fault("recorder_behind", REACTIONS["recorder_behind"], f"the recorder failed: {error}")
        return None if kept else Fault("recorder_behind", REACTIONS["recorder_behind"], "the recorder cannot keep up")

    def _remember(self, sample: Sample, usable: NDArray[np.bool_], reference: Setpoint) -> None:
        error = np.where(usable, np.abs(reference.position - sample.position), 0.0)
        np.maximum(self._peaks.following_error, error, out=self._peaks.following_error)
        np.maximum(self._peaks.torque, np.abs(sample.torque), out=self._peaks.torque)

    def _enter(self, state: State, stamp_ns: int) -> None:
        self.state = next_state(self.state, state)
        self._tell(_INFO, stamp_ns, state.value)

    def _tell(self, level: int, stamp_ns: int, message: str) -> None:
        with suppress(Exception):  # a recorder that has failed says so at its next sample
            self.sink.event(stamp_ns, level, message)

    def _halt(self, error: BaseException) -> None:
        try:
            self.arm.stop(StopKind.TORQUE_OFF)
        except Exception as second:  # noqa: BLE001 - a driver that breaks its promise must not hide why it was stopped
            error.add_note(f"and taking the torque away failed: {second}")
        if State.FAULTED in LAWFUL[self.state]:
            now_ns = self.arm.clock.now_ns()
            self._enter(State.FAULTED, now_ns)
            self._tell(_ERROR, now_ns, str(error) or type(error).__name__)
