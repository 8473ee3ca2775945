"""Run all preflight checks, in an order in which none endangers the arm for what a later check would have found.

First the checks that need no arm, then those without torque, then those that hold the arm, move it a little, and at
last let the drives stop it. The first failed check that makes touching the arm unsafe ends preflight; the rest are
skipped and name that check. Whatever happens, the arm is without torque and closed afterwards.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta

import numpy as np

from drivers.arm import AT_CLOSING, Arm, ArmDescription, Sample, StopKind
from drivers.axis_status import AxisStatus
from drivers.clock import Clock, RealClock
from ident_service.config.can_bus import WIRE_INTERFACE
from ident_service.config.motion_limits import MotionLimits, Vector, motion_limits
from ident_service.errors import ActionNeeded, ArmError, ArmFault, ModelError, MotionRefused
from ident_service.excitation.motion_file import Excitation
from ident_service.model.arm_model import ArmModel
from ident_service.model.blas_threads import one_blas_thread
from ident_service.model.expected_friction import ExpectedFriction, expected_friction
from ident_service.model.pinocchio_models import InverseDynamics
from ident_service.motion.clearance import recoverable_limits, relaxed_limits
from ident_service.motion.controller import ComputedTorque
from ident_service.motion.last_position import LastPosition
from ident_service.motion.run import keep_host_alive
from ident_service.motion.ticket import (
    ABOUT_THE_MOTION,
    CODES,
    VALID,
    Check,
    Ticket,
    Verdict,
    failed_check,
    new_ticket,
    skipped_check,
    subject_of,
)
from ident_service.motion.trajectory import hold, rest
from ident_service.preflight.active_checks import (
    DWELL,
    HOLD,
    SETTLE,
    TestMotion,
    direction_check,
    expected_displacement,
    follow_stroke,
    gravity_check,
    gravity_differences,
    holding_fault_check,
    holding_torque,
    judge_response,
    moved_against_torque,
    plan_strokes,
    sign_failure,
    swings_to_both_sides,
    too_heavy_check,
)
from ident_service.preflight.delay import hidden_delay
from ident_service.preflight.passive_checks import (
    IdleRecording,
    at_rest_check,
    identities_check,
    loop_rate_check,
    noise_check,
    rate_check,
    record_idle,
    unreachable_check,
)
from ident_service.preflight.session import (
    BROKEN_REMEDY,
    CLOSING_REMEDY,
    EMULATED_REMEDY,
    FARTHEST,
    NO_CABLE,
    SHAKEN_REMEDY,
    TORQUE_WARNINGS,
    Rows,
    Session,
    code_of,
    remedy_of,
    trace_of,
)
from ident_service.preflight.static_checks import (
    configuration_check,
    distance_from_home_text,
    motion_fits_check,
    motion_proven_check,
    path_home_check,
    paths_check,
    stability_check,
)
from ident_service.preflight.watchdog import CODE, Confirm, consent_check, watchdog_check

LOOK = 1.0  # s
RESTS = 3.0  # s that an arm may take to come to rest when its drives have stopped
REST_REMEDY = "Support the arm where every joint has room to move a little, keep hands off, and check again."
_LEAST_CYCLES = 100
_LOOK_AGAIN = 20  # cycles

Tell = Callable[[Check], None]


@one_blas_thread()  # a second one would compete for the other core, and be waited for
def preflight(
    arm: Arm,
    model: ArmModel,
    excitation: Excitation | None,
    *,
    confirm: Confirm = lambda question: "",
    clock: Clock | None = None,
    on_check: Tell = lambda check: None,
    validity: timedelta = VALID,
    idle_seconds: float = LOOK,
    holding_seconds: float = 0.0,
    last_position: LastPosition | None = None,
    tell_operator: Callable[[str], None] = lambda action: None,
) -> Ticket:
    """Open an arm, energise it and move each joint a little, to check it and a motion; return the ticket, good or bad.

    Args:
        arm: the arm, not open; it stands on its support, without torque.
        model: of the arm.
        excitation: motion to be run; None for the path home or out of a limit, which may begin a little outside the
            position limits.
        confirm: function that shows a question and returns what a person typed; called once, before anything is
            energised. Without the arm's name nothing is.
        clock: clock whose UTC stamps the ticket; by default the machine's. The loop has the arm's own.
        on_check: called with every check as soon as it is made.
        validity: how long the ticket counts.
        idle_seconds: how long rate and noise are measured.
        holding_seconds: how long the rate is measured with the torque that holds the arm, at least for `HOLD`.
        last_position: last position before the arm was closed, where that is known.
        tell_operator: called with what a person has to do before the arm can be enabled, and is waited for.

    Returns:
        The ticket, whatever its verdict; what fails is in its checks, and nothing the arm does is raised.
    """
    clock = RealClock() if clock is None else clock
    flight = _Preflight(
        arm, model, excitation, confirm, on_check, idle_seconds, holding_seconds, last_position, tell_operator
    )
    flight.run()
    subject = subject_of(model, excitation, flight.described)
    return new_ticket(subject, flight.all_checks(), clock.now_ns() + clock.utc_offset_ns, validity)


def _felt_friction(model: ArmModel, limits: MotionLimits) -> ExpectedFriction:
    """Return the friction that joints feel, of whichever drives move them."""
    return expected_friction(model, limits, model.config.design.friction_guess).at_joints(model.chain)


@dataclass(frozen=True)
class _Gravity:
    torque: Vector
    limits: MotionLimits
    friction: ExpectedFriction

    def carried_by(self, held: Vector) -> bool:
        """Return whether the torque that holds the arm is near enough to the model's; fast enough between cycles."""
        difference, most = gravity_differences(held, self.torque, self.limits, self.friction)
        return bool((difference <= most).all())


class _Ended(Exception):
    """Signal that the arm is without torque again, with the reason among the checks."""


class _Preflight:
    def __init__(
        self,
        arm: Arm,
        model: ArmModel,
        excitation: Excitation | None,
        confirm: Confirm,
        tell: Tell,
        look_seconds: float,
        rate_seconds: float,
        closed: LastPosition | None,
        announce: Callable[[str], None],
    ) -> None:
        self.announce = announce
        self.arm, self.model, self.excitation = arm, model, excitation
        self.confirm, self.tell = confirm, tell
        self.look_seconds, self.rate_seconds, self.closed = look_seconds, rate_seconds, closed
        self.described: ArmDescription | None = None
        self.away = ""  # from home, in words
        self.checks: dict[str, Check] = {}

    def run(self) -> None:
        """Make every check that can be made safely."""
        if not self._passed(configuration_check(self.model, self.arm.bus_budget())):
            return
        limits = motion_limits(self.model.config)
        motion = self.excitation
        stable = stability_check(self.model, limits, motion)
        # Through a loop that is not stable no arm follows any motion; another motion is no remedy.
        if (
            motion is not None
            and self._passed(motion_fits_check(self.model, motion))
            and stable.verdict is not Verdict.FAILED
        ):
            self._passed(motion_proven_check(self.model, limits, motion))
        self._passed(stable)
        try:
            with self.arm:
                try:
                    self._opened(limits)
                except _Ended:
                    return
                finally:
                    self.arm.stop(StopKind.TORQUE_OFF)
        except ArmError as error:
            self._broken(error)
        finally:
            self.arm.close()  # once more, for an arm that failed while it was opened
            if left := self.arm.unconfirmed():
                self._left_behind(f"{AT_CLOSING} {'; '.join(left)}")

    def all_checks(self) -> list[Check]:
        """Return every check; those that were not made name the one that failed."""
        failures = [code for code, check in self.checks.items() if check.verdict is Verdict.FAILED]
        # What fails of the motion alone lets the checks of the arm go on.
        because = next((code for code in failures if code not in ABOUT_THE_MOTION), None)
        if because is None and any(check.verdict is Verdict.NEEDS_PERSON for check in self.checks.values()):
            why = "because nobody typed the arm's name"
        elif failures:
            why = f"because {because or failures[0]} failed"
        else:
            why = "not reached, although nothing failed before"
        made = dict(self.checks)
        if self.excitation is None:
            made |= {code: skipped_check(code, "no motion was given") for code in ("motion_fits", "motion_proven")}
        return [made.get(code) or skipped_check(code, why) for code in CODES]

    def _opened(self, limits: MotionLimits) -> None:
        self.described = self.arm.describe()
        period = 1.0 / self.described.rate
        first = self.arm.exchange(None)
        cycles = max(_LEAST_CYCLES, round(self.look_seconds / period))
        looked = record_idle(self.arm, cycles, period, self._load(first, limits, period))
        # Drives would take us for dead, above all while a person thinks.
        with keep_host_alive(self.arm):
            agreed = self._agreed(looked, limits)
        if not agreed:
            return
        # A person may have taken minutes to answer, and may have moved the arm meanwhile.
        again = record_idle(self.arm, _LOOK_AGAIN, period)
        if (still := at_rest_check(again, self.model, self._bounds(limits))).verdict is not Verdict.PASSED:
            self._passed(still)
            return
        home = again.samples[-1].position
        with keep_host_alive(self.arm):
            limits = limits if self.excitation is not None else relaxed_limits(home, limits)
            friction = _felt_friction(self.model, limits)
            session = Session(self.arm, self.model, limits, self.described, home, friction)
            planned = self._planned(session)
        self._touched(session, planned, _Gravity(session.gravity, limits, friction))

    def _bounds(self, limits: MotionLimits) -> MotionLimits:
        """Return where the run may begin: inside the limits; for the path home as far outside as `reachable` allows."""
        return limits if self.excitation is not None else recoverable_limits(limits)

    def _agreed(self, looked: IdleRecording, limits: MotionLimits) -> bool:
        """Check the arm at rest; returns whether it may be energised, to which a person has agreed."""
        if self.described is None or not self._passed(
            identities_check(self.described, self.model, limits, looked, self.arm.setup_checks())
        ):
            return False
        if not self._passed(at_rest_check(looked, self.model, self._bounds(limits), self.closed)):
            return False
        home = looked.samples[-1].position.copy()
        if self.excitation is not None:
            self.away = distance_from_home_text(self.model, limits, home)
        if self.excitation is None:
            self._passed(path_home_check(self.model, limits, home))
            limits = relaxed_limits(home, limits)
        elif self.checks["motion_fits"].verdict is Verdict.PASSED:
            self._passed(paths_check(self.model, limits, self.excitation, home), of_place=True)
        self._passed(rate_check(looked, self.arm.clock.lock_step))
        friction = _felt_friction(self.model, limits)
        session = Session(self.arm, self.model, limits, self.described, home, friction)
        self._passed(noise_check(looked, self.described, self.model, limits, session.mass))
        if any(c.verdict is Verdict.FAILED and c.code not in ABOUT_THE_MOTION for c in self.checks.values()):
            return False
        if (impossible := too_heavy_check(session.gravity, self.model, limits)) is not None:
            self._passed(impossible, of_place=True)
            return False
        refused = consent_check(self.model, looked.samples[-1], self.confirm)
        if refused is not None:
            self._passed(refused)
        return refused is None

    def _planned(self, session: Session) -> list[TestMotion]:
        """Plan a small test motion of every joint; none, and a failed check, where a joint has no room."""
        try:
            # Of a joint that stands outside its limits none leads farther out.
            room = relaxed_limits(session.home, motion_limits(self.model.config), 0.0)
            return plan_strokes(session, self.model, room)
        except (ModelError, MotionRefused) as error:
            remedy = "Move the arm by hand to where every joint has room."
            self._passed(failed_check("direction", str(error), remedy), of_place=True)
            return []

    def _touched(self, session: Session, planned: Sequence[TestMotion], gravity: _Gravity) -> None:
        """Hold the arm, move it a little, and fall silent; judge the findings after torque is off."""
        held: Rows = ()
        moved: list[tuple[Rows, Rows]] = []
        silent: Check | None = None
        try:
            self._energise(session)
            held = session.follow(hold(session.home), SETTLE + max(HOLD, self.rate_seconds))
            if planned and gravity.carried_by(holding_torque(held, session.period)):
                moved += (follow_stroke(session, one) for one in planned)
                session.follow(hold(session.home), SETTLE)
                silent = watchdog_check(self.arm, self.model, session, hold(session.home).at)
            if silent is None:
                session.release()
        except ArmError as error:
            self.arm.stop(StopKind.TORQUE_OFF)
            self._judged(session, gravity, held, planned, moved)
            if not isinstance(error, ArmFault):
                raise
            self._faulted(session, gravity, error)
            raise _Ended from error
        with keep_host_alive(self.arm):
            self._judged(session, gravity, held, planned, moved)
        if silent is not None and silent.verdict is Verdict.PASSED:
            silent = self._silent_in_motion(silent)
        if silent is not None:
            self._passed(silent)

    def _energise(self, session: Session) -> None:
        """Enable the arm; where a person does it, say so, and see that the arm still stands where it stood."""
        if action := self.arm.operator_action:
            self.announce(action)
        session.energise()

    def _silent_in_motion(self, at_rest: Check) -> Check:
        """Fall silent again, in the middle of a small motion of one joint; returns both watchdog checks in one."""
        try:
            self.arm.close()  # what the silence has left behind in drives ends with the session
            self.arm.open()
            limits, described = motion_limits(self.model.config), self.arm.describe()
            period = 1.0 / described.rate
            for _ in range(max(1, round(RESTS / (_LOOK_AGAIN * period)))):
                looked = record_idle(self.arm, _LOOK_AGAIN, period)
                if at_rest_check(looked, self.model, recoverable_limits(limits)).verdict is Verdict.PASSED:
                    break
            else:
                return failed_check(CODE, "the arm does not come to rest after its drives stopped", REST_REMEDY)
            home = looked.samples[-1].position
            if any(AxisStatus(word) & AxisStatus.FAULT for word in looked.samples[-1].status):
                self.arm.reset()  # the host's own silence was the fault
            with keep_host_alive(self.arm):
                limits = relaxed_limits(home, limits)
                friction = _felt_friction(self.model, limits)
                session = Session(self.arm, self.model, limits, described, home, friction)
                room = relaxed_limits(home, motion_limits(self.model.config), 0.0)
                stroke = plan_strokes(session, self.model, room, only_joint=0)[0]
            self._energise(session)
            session.follow(hold(home), SETTLE)
            half = DWELL + 0.5 * stroke.there.duration
            session.follow(stroke, half)
            moving = watchdog_check(self.arm, self.model, session, lambda time: stroke.at(half + time), stroke.joint)
            if moving.verdict is Verdict.PASSED:
                self._end_own_fault()
        except (MotionRefused, ArmFault) as error:
            self.arm.stop(StopKind.TORQUE_OFF)
            return failed_check(CODE, f"in motion: {error}", REST_REMEDY, at_rest.measures)
        return replace(moving, measures=(*at_rest.measures, *moving.measures))

    def _end_own_fault(self) -> None:
        """Reset drives to which the host's silence was a fault: a run would find them in it."""
        words = self.arm.drive_status() or self.arm.exchange(None).status
        if any(AxisStatus(word) & AxisStatus.FAULT for word in words):
            self.arm.close()  # drives that miss their host may hear no frames but those of another session
            self.arm.open()
            self.arm.reset()

    def _judged(
        self,
        session: Session,
        gravity: _Gravity,
        held: Rows,
        planned: Sequence[TestMotion],
        moved: Sequence[tuple[Rows, Rows]],
    ) -> None:
        if held:
            stamps = np.array([sample.stamp_ns for sample, _ in held], dtype=float)
            before = self.checks["rate"]
            rate = loop_rate_check(stamps, session.period, self.arm.clock.lock_step, before)
            if rate is not before:
                self._passed(rate)
            torque = holding_torque(held, session.period)
            self._passed(gravity_check(torque, gravity.torque, self.model, gravity.limits, gravity.friction))
        if planned and len(moved) == len(planned):
            answers = [
                judge_response(trace_of(rows, session.period), stroke, session)
                for (rows, _), stroke in zip(moved, planned, strict=True)
            ]
            traces = [trace_of(shaken, session.period) for _, shaken in moved]
            # Where drives close the loop nothing can be shaken, and their delay is in no loop of ours.
            delays = [
                hidden_delay(trace, expected_displacement(trace, session), stroke.joint)
                for trace, stroke in zip(traces, planned, strict=True)
                if not session.gives_positions
            ]
            self._passed(direction_check(answers, self.model, session, [one for one in delays if one]))

    def _load(self, first: Sample, limits: MotionLimits, period: float) -> Callable[[Sample], None]:
        """Return a function that computes the control law of a run and discards the result, as load on the rate."""
        prior = np.zeros(self.model.layout.size) if self.model.prior is None else self.model.prior
        if first.position.shape != (self.model.chain.joints,) or not np.isfinite(first.position).all():
            return lambda sample: None
        dynamics = InverseDynamics(self.model.chain, self.model.layout, prior)
        cutoff = self.model.config.control.velocity_cutoff
        control = ComputedTorque(dynamics, limits, period, cutoff, first.position)
        still = rest(first.position)

        def work(sample: Sample) -> None:
            control.torque(np.nan_to_num(sample.position), sample.valid, still)

        return work

    def _faulted(self, session: Session, gravity: _Gravity, error: ArmFault) -> None:
        """Find out what ended the loop: what the fault names, a joint that went the wrong way, or another cause."""
        if "gravity" not in self.checks:
            self._passed(holding_fault_check(session, self.model, gravity.limits, gravity.friction, error))
            return
        if (remedy := remedy_of(error)) is not None:
            self._passed(failed_check("direction", str(error), remedy))
            return
        trace = session.trace()
        astray = int(np.argmax(np.abs(trace.position[-1] - trace.reference[-1])))
        name = self.model.chain.names[astray]
        warned, swinging = code_of(error) in TORQUE_WARNINGS, swings_to_both_sides(trace, astray)
        # A joint that is shaken stays about where it should be; one whose sign is wrong is on its way to the guard.
        left = not warned or abs(trace.position[-1] - trace.reference[-1])[astray] > 0.5 * FARTHEST
        if left and not swinging and moved_against_torque(trace, astray, session):
            self._passed(sign_failure([astray], self.model, str(error)))
        elif warned or swinging:
            reason = str(error) if warned else f"{name} swings about its path: {error}"
            self._passed(failed_check("direction", reason, SHAKEN_REMEDY))
        else:
            remedy = f"Free {name} if something blocks it or a brake holds it; check its encoder and its signs."
            self._passed(failed_check("direction", f"{name} left the path: {error}", remedy))

    def _broken(self, error: ArmError) -> None:
        """Record a failed check for an arm that could not be opened, recorded or energised, or that fell silent."""
        if self.described is None or "identities" not in self.checks:
            self._passed(unreachable_check(error))
        else:
            # None about the motion: the path home may begin although one of them failed. The last where all are made.
            left = (code for code in CODES if code not in self.checks and code not in ABOUT_THE_MOTION)
            code = next(left, CODES[-1])
            remedy = "Do this, then check again." if isinstance(error, ActionNeeded) else BROKEN_REMEDY
            self._passed(failed_check(code, str(error), remedy))

    def _left_behind(self, words: str) -> None:
        """Record which drives have not confirmed that they are off, with what failed last of the arm's own checks.

        Not with a check of the motion, since the path home may begin although that failed.
        """
        failures = (check for check in self.checks.values() if check.verdict is Verdict.FAILED)
        bad = [check for check in failures if check.code not in ABOUT_THE_MOTION]
        if bad:
            self._passed(replace(bad[-1], reason=f"{bad[-1].reason}; {words}"))
        else:
            last = self.checks.get(CODES[-1])
            self._passed(failed_check(CODES[-1], words, CLOSING_REMEDY, () if last is None else last.measures))

    def _passed(self, check: Check, *, of_place: bool = False) -> bool:
        if of_place and check.verdict is Verdict.FAILED and self.away:
            check = replace(check, reason=f"the arm is not at home ({self.away}): `ident home`; {check.reason}")
        if check.remedy in NO_CABLE and any(bus.interface == WIRE_INTERFACE for bus in self.model.config.can_buses):
            check = replace(check, remedy=EMULATED_REMEDY)
        self.checks[check.code] = check
        self.tell(check)
        return check.verdict is Verdict.PASSED
