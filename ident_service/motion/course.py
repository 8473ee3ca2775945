"""Sequence the references of a run: approach, motion, return, pauses in any of them, and the stop.

A run that is finished early pauses, and goes straight back to where it stood instead of on. Where that way is not free
it goes on as planned, which is proven and ends regularly, too.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence

from ident_service.config.limits import MotionLimits, Vector
from ident_service.errors import MotionRefused
from ident_service.motion.pause import Paused, Resumed
from ident_service.motion.plans import HOMING_SPEED
from ident_service.motion.reference import Reference, Setpoint, hold, rest
from ident_service.motion.speed import slowed_limits
from ident_service.motion.states import MOVING, STOPPABLE, State, States
from ident_service.motion.stop import stop
from ident_service.motion.surroundings import Surroundings
from ident_service.motion.way import RuckigReference, calm_way_in_slices

_UNDER_WAY = (*MOVING, State.PAUSING, State.PAUSED, State.RESUMING)


class Course:
    """Sequence the reference trajectories of a run, state by state.

    Attributes:
        reference: of the last cycle.
        first: the state of the first way.
        complete: whether the last way has been followed to its end.
        finished_at: of a run that was finished early, how much of its excitation was made [s]; None for any other.
        not_finished: why a run that was to be finished early goes on; empty for any other.
        led: whether the arm was led home out of a stop: what was to be done is not done by that.
    """

    def __init__(
        self,
        states: States,
        legs: Sequence[tuple[State, Reference]],
        start: Setpoint,
        limits: MotionLimits,
        resuming: MotionLimits,
        surroundings: Surroundings | None = None,
        *,
        held: bool = False,
    ) -> None:
        """Prepare to follow the given references in order.

        Args:
            states: armed when the first cycle comes.
            legs: ways and the states in which they are followed, in order; states is armed, the first comes next. Where
                there are several, the last one leads back to `start`.
            start: where the arm stands.
            limits: of the arm, for stops and pauses.
            resuming: of ways out of pauses.
            surroundings: that trajectories out of pauses must avoid.
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
        """Return the reference of the cycle with this stamp [ns]; states follow each other as their references end."""
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
        """Return for how long the present reference has rested at its end [s]; negative before."""
        return self._elapsed(stamp_ns) - self._way.duration

    def stop(self, stamp_ns: int) -> None:
        """Begin a controlled stop, in states that allow one."""
        if self._states.state in STOPPABLE:
            self._states.enter(State.STOPPING)
            self._begin_ns, self._way = stamp_ns, stop(self.reference, self._limits)

    def pause(self, stamp_ns: int) -> None:
        """Begin a stop from which the motion can be resumed, where the arm moves."""
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

    def stood(self) -> None:
        """Enter PAUSED, when the arm has come to rest, and begin to search for a trajectory back to the motion."""
        self._states.enter(State.PAUSED)
        if self._paused is not None:
            self._search = self._way_out(self._paused)

    def finish(self, stamp_ns: int) -> None:
        """End the run early by way of a pause and a straight return; once, and only before the last reference."""
        if self._finishing or not self._later or self._states.state not in _UNDER_WAY:
            return
        self._finishing = True
        self.pause(stamp_ns)
        if self._states.state is State.PAUSED and self._paused is not None:
            self._back, self._search = None, self._way_out(self._paused)

    def _way_out(self, paused: Paused) -> Generator[None, None, Resumed | RuckigReference]:
        """Search for a trajectory out of a pause: straight back to the start where the run is to be finished early."""
        if self._finishing and self._later and not self.not_finished:
            try:
                return (yield from paused.leave_in_slices(self._start, self._resuming, self._surroundings))
            except MotionRefused as refusal:
                self.not_finished = str(refusal)
        return (yield from paused.resume_in_slices(self._resuming, self._surroundings))

    def look_for_way_back(self) -> str | None:
        """Do one slice of the search for a trajectory back; returns the reason where there is none, else None."""
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
        """Leave a pause, as soon as a trajectory out of it is found."""
        if self._away is not None and self._paused is not None:
            self.finished_at = self._paused.time if self._left is State.EXCITING else 0.0
            self._states.enter(State.RETURNING)
            self._later, self._begin_ns, self._way, self._away = [], stamp_ns, self._away, None
        elif self._back is not None:
            self._states.enter(State.RESUMING)
            self._begin_ns, self._way = stamp_ns, self._back

    def lead_home(self, start: Vector) -> None:
        """Begin to search for a slow, straight trajectory home of a stopped arm; `look_for_way_back` continues.

        Args:
            start: from where [rad or m], shape (joints,).
        """
        limits = slowed_limits(self._limits, HOMING_SPEED)

        def search() -> Generator[None, None, Resumed | RuckigReference]:
            home = yield from calm_way_in_slices(rest(start), rest(self._limits.home), limits)
            if self._surroundings is not None:
                yield from self._surroundings.require_clear(home, limits)
            return home

        self._away, self._search = None, search()

    def leads_home(self, stamp_ns: int) -> bool:
        """Begin to go home as soon as a trajectory is found; returns whether that is in this cycle."""
        if self._away is None:
            return False
        self._states.enter(State.RETURNING)
        self.led = self._held = True
        self._later, self._back, self._begin_ns, self._way, self._away = [], None, stamp_ns, self._away, None
        return True

    def _elapsed(self, stamp_ns: int) -> float:
        return 0.0 if self._begin_ns is None else (stamp_ns - self._begin_ns) * 1e-9
