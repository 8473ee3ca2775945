"""Follow the trajectory of each state: approach, motion, pause, resume, return and stop.

The way back leads from standstill to the motion's own moving state, so that position, velocity and acceleration have
no step anywhere.

A run that is finished early pauses, and goes straight back to where it stood instead of on. Where that way is not free
it goes on as planned, which is proven and ends regularly, too.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence

from ident_service.config.motion_limits import MotionLimits, Vector
from ident_service.errors import MotionRefused
from ident_service.motion.clearance import ClearanceChecker
from ident_service.motion.run_plan import HOMING_SPEED
from ident_service.motion.speed_scaling import slowed_limits
from ident_service.motion.state_machine import MOVING, STOPPABLE, State, StateMachine
from ident_service.motion.stop_trajectory import plan_stop
from ident_service.motion.trajectory import (
    Reference,
    RuckigReference,
    Setpoint,
    hold,
    plan_reduced_trajectory_in_slices,
    plan_trajectory_in_slices,
    rest,
    run_to_end,
)

_SEARCH_STEP = 0.1  # s
_SEARCH = 20  # steps to either side


class Paused:
    """Represent a motion that is brought to a controlled stop, and then stands.

    Attributes:
        duration: time until the arm stands [s].
        time: time on the motion at which it was left [s].
    """

    def __init__(self, motion: Reference, time: float, limits: MotionLimits, start: Setpoint | None = None) -> None:
        """Plan the stop out of a motion.

        Args:
            motion: motion within the limits.
            time: time on the motion at which the pause begins, and the motion is to go on [s].
            limits: of the arm.
            start: setpoint at which the pause begins, if it is not on the motion but on a way back onto it.
        """
        self._motion = motion
        self._limits = limits
        self._stop = plan_stop(motion.at(time) if start is None else start, limits)
        self.time = min(time, motion.duration)
        self.duration = self._stop.duration

    def at(self, time: float) -> Setpoint:
        """Return the setpoint at `time` [s] since the pause began."""
        return self._stop.at(time)

    def resume(self, limits: MotionLimits | None = None) -> Resumed:
        """Plan a way from rest onto the motion, best where it was left; return both, joined; MotionRefused if none.

        It joins the motion where it was left. Where no way leads there within the limits, it joins a little earlier and
        repeats that little; else a little later; else it begins the motion again. This takes a millisecond or few where
        the motion was left, but up to some tenths of a second when it must search: too long for a cycle.

        Args:
            limits: limits of the way, by default the arm's; `slowed_limits` for one as slow as a rehearsal.

        Raises:
            MotionRefused: not even the motion's beginning can be reached from here.
        """
        return run_to_end(self.resume_in_slices(limits))

    def resume_in_slices(
        self, limits: MotionLimits | None = None, surroundings: ClearanceChecker | None = None
    ) -> Generator[None, None, Resumed]:
        """Plan in slices a way from rest back onto the motion, clear of `surroundings`; the generator returns both.

        Args:
            limits: as for `resume`.
            surroundings: surroundings that trajectories back must avoid; after a trajectory that does not, the search
                goes on.

        Raises:
            MotionRefused: as `resume`, from any of its steps.
        """
        here, limits = rest(self._stop.end), limits or self._limits
        for time in _joining_times(self.time, self._motion.duration):
            try:
                back = yield from plan_trajectory_in_slices(here, self._motion.at(time), limits)
                if surroundings is not None:
                    yield from surroundings.require_clear(back, limits)
                return Resumed(back, self._motion, time)
            except MotionRefused as error:
                refusal = error
        raise MotionRefused(f"no trajectory leads from here back to the motion: {refusal}") from refusal

    def leave_in_slices(
        self, end: Setpoint, limits: MotionLimits, surroundings: ClearanceChecker | None = None
    ) -> Generator[None, None, RuckigReference]:
        """Plan in slices a straight trajectory to rest at `end` at half of `limits`; the generator returns it.

        Args:
            end: setpoint at rest.
            limits: limits of the way, as for `resume`.
            surroundings: surroundings that the trajectory must avoid.

        Raises:
            MotionRefused: the straight way is not free; from any of the steps.
        """
        away = yield from plan_reduced_trajectory_in_slices(rest(self._stop.end), end, limits)
        if surroundings is not None:
            yield from surroundings.require_clear(away, limits)
        return away


class Resumed:
    """Represent a trajectory back onto a motion, and the motion from there on.

    Attributes:
        duration: duration of the way back and the rest of the motion [s].
        back: length of the way back [s].
        joined: time of the motion at which the way back ends [s].
        motion: the motion that it joins.
    """

    def __init__(self, back: RuckigReference, motion: Reference, joined: float) -> None:
        self._way = back
        self.motion = motion
        self.back = back.duration
        self.joined = joined
        self.duration = back.duration + motion.duration - joined

    def at(self, time: float) -> Setpoint:
        """Return the setpoint at `time` [s] since the trajectory back began."""
        return self._way.at(time) if time < self.back else self.motion.at(self.joined + time - self.back)


def _joining_times(left: float, duration: float) -> Iterator[float]:
    yield left
    steps = [_SEARCH_STEP * count for count in range(1, _SEARCH + 1)]
    yield from (left - step for step in steps if step < left)
    yield from (left + step for step in steps if left + step < duration)
    yield 0.0


_UNDER_WAY = (*MOVING, State.PAUSING, State.PAUSED, State.RESUMING)


class TrajectorySequencer:
    """Sequence the reference trajectories of a run, state by state.

    Attributes:
        reference: setpoint of the last cycle.
        first: the state of the first way.
        complete: whether the last way has been followed to its end.
        finished_at: time on the excitation at which a run was finished early [s]; None for any other.
        not_finished: reason why a run that was to be finished early goes on; empty for any other.
        led: whether the arm was led home out of a stop, by which a run is not complete.
    """

    def __init__(
        self,
        states: StateMachine,
        legs: Sequence[tuple[State, Reference]],
        start: Setpoint,
        limits: MotionLimits,
        resuming: MotionLimits,
        surroundings: ClearanceChecker | None = None,
        *,
        held: bool = False,
    ) -> None:
        """Prepare to follow the given references in order.

        Args:
            states: state machine, armed when the first cycle comes.
            legs: states and the trajectories followed in them, in order, the first one after ARMED. Where there are
                several, the last one leads back to `start`.
            start: setpoint where the arm stands.
            limits: limits of the arm, for stops and pauses.
            resuming: limits of trajectories out of pauses.
            surroundings: surroundings that trajectories out of pauses must avoid.
            held: whether the end of the last way is held like the end of a stop, instead of being done at once.
        """
        self.reference = start
        self.complete = False
        self.finished_at: float | None = None
        self.not_finished = ""
        self._start = rest(start.position)
        self._states = states
        self._limits, self._resuming, self._surroundings = limits, resuming, surroundings
        self._held = held
        (self.first, self._way), *self._later = legs
        self._begin_ns: int | None = None
        self._left = self.first  # what a pause interrupts
        self._paused: Paused | None = None
        self._search: Generator[None, None, Resumed | RuckigReference] | None = None
        self._back: Resumed | None = None
        self._finishing = False  # asked for, which counts once
        self._away: RuckigReference | None = None  # the way back of a run that is finished early, or home
        self.led = False

    def at(self, stamp_ns: int) -> Setpoint:
        """Return the setpoint of the cycle with this stamp [ns]; enters the next state where a reference has ended."""
        states = self._states
        if self._begin_ns is None:  # not before: enabling takes as long as it takes
            self._begin_ns = stamp_ns
        elapsed = (stamp_ns - self._begin_ns) * 1e-9
        if states.state is State.RESUMING and self._back is not None and elapsed >= self._back.back:
            states.enter(self._left)
        while states.state in MOVING and elapsed >= self._way.duration:
            self._begin_ns += round(self._way.duration * 1e9)
            elapsed = (stamp_ns - self._begin_ns) * 1e-9
            if self._later:
                (state, self._way), self._back = self._later.pop(0), None
                states.enter(state)
                continue
            self.complete = not self.led
            states.enter(State.STOPPING if self._held else State.DONE)
            self._way = hold(self._way.at(self._way.duration).position, 0.0)
        self.reference = self._way.at(elapsed)
        return self.reference

    def overdue(self, stamp_ns: int) -> float:
        """Return how long ago the present reference ended [s]; negative before its end."""
        return self._elapsed(stamp_ns) - self._way.duration

    def skip_to(self, stamp_ns: int) -> None:
        """Set the reference to that of this stamp [ns], after missed cycles, at most to its end; no state changes."""
        self.reference = self._way.at(self._elapsed(stamp_ns))

    def stop(self, stamp_ns: int) -> None:
        """Enter STOPPING and follow a controlled stop from the reference; do nothing in states that allow none."""
        if self._states.state in STOPPABLE:
            self._states.enter(State.STOPPING)
            self._begin_ns, self._way = stamp_ns, plan_stop(self.reference, self._limits)

    def pause(self, stamp_ns: int) -> None:
        """Enter PAUSING and follow a stop from which the motion can resume; do nothing where the arm does not move."""
        state, elapsed, back = self._states.state, self._elapsed(stamp_ns), self._back
        if state is State.RESUMING and back is not None:
            paused = Paused(back.motion, back.joined, self._limits, self.reference)
        elif state in MOVING and back is not None:
            paused = Paused(back.motion, back.joined + elapsed - back.back, self._limits)
        elif state in MOVING:
            paused = Paused(self._way, elapsed, self._limits)
        else:
            return
        self._left = state if state in MOVING else self._left
        self._states.enter(State.PAUSING)
        self._begin_ns, self._way, self._paused, self._back = stamp_ns, paused, paused, None

    def enter_paused(self) -> None:
        """Enter PAUSED, as the arm rests, and begin the search for a trajectory out; `search_return` continues it."""
        self._states.enter(State.PAUSED)
        if self._paused is not None:
            self._search = self._plan_out_of_pause(self._paused)

    def finish(self, stamp_ns: int) -> None:
        """Pause to end the run early by a straight return, if free; nothing a second time or on the last reference."""
        if self._finishing or not self._later or self._states.state not in _UNDER_WAY:
            return
        self._finishing = True
        self.pause(stamp_ns)
        if self._states.state is State.PAUSED and self._paused is not None:
            self._back, self._search = None, self._plan_out_of_pause(self._paused)

    def _plan_out_of_pause(self, paused: Paused) -> Generator[None, None, Resumed | RuckigReference]:
        """Search for a trajectory out of a pause: straight back to the start where the run is to be finished early."""
        if self._finishing and self._later and not self.not_finished:
            try:
                return (yield from paused.leave_in_slices(self._start, self._resuming, self._surroundings))
            except MotionRefused as refusal:
                self.not_finished = str(refusal)
        return (yield from paused.resume_in_slices(self._resuming, self._surroundings))

    def search_return(self) -> str | None:
        """Do one slice of the search for a trajectory out of a pause or home; return why none exists, else None."""
        if self._search is None:
            return None
        try:
            next(self._search)
        except StopIteration as found:
            self._search = None
            if isinstance(found.value, RuckigReference):
                self._away = found.value
            else:
                self._back = found.value
        except MotionRefused as refusal:
            self._search = None
            return str(refusal)
        return None

    def go_on(self, stamp_ns: int) -> None:
        """Enter RESUMING or RETURNING along the trajectory found out of the pause; do nothing while there is none."""
        if self._away is not None and self._paused is not None:
            self.finished_at = self._paused.time if self._left is State.EXCITING else 0.0
            self._states.enter(State.RETURNING)
            self._later, self._begin_ns, self._way, self._away = [], stamp_ns, self._away, None
        elif self._back is not None:
            self._states.enter(State.RESUMING)
            self._begin_ns, self._way = stamp_ns, self._back

    def plan_homing(self, start: Vector) -> None:
        """Begin to search for a slow, straight trajectory home of a stopped arm; `search_return` continues.

        Args:
            start: position from which the arm goes home [rad or m], shape (joints,).
        """
        limits = slowed_limits(self._limits, HOMING_SPEED)

        def search() -> Generator[None, None, Resumed | RuckigReference]:
            home = yield from plan_reduced_trajectory_in_slices(rest(start), rest(self._limits.home), limits)
            if self._surroundings is not None:
                yield from self._surroundings.require_clear(home, limits)
            return home

        self._away, self._search = None, search()

    def try_homing(self, stamp_ns: int) -> bool:
        """Enter RETURNING along the trajectory home as soon as one is found; return whether this call did."""
        if self._away is None:
            return False
        self._states.enter(State.RETURNING)
        self.led = self._held = True
        self._later, self._back, self._begin_ns, self._way, self._away = [], None, stamp_ns, self._away, None
        return True

    def _elapsed(self, stamp_ns: int) -> float:
        return 0.0 if self._begin_ns is None else (stamp_ns - self._begin_ns) * 1e-9
