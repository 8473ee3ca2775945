"""Which reference is followed, from state to state: approach, motion, return, pauses in any of them, the stop.

Boundary: references and states. Whether the arm itself follows, and rests when its reference does, is `loop.py`'s.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence

from ident_service.config.limits import MotionLimits
from ident_service.errors import MotionRefused
from ident_service.motion.pause import Paused, Resumed
from ident_service.motion.reference import Reference, Setpoint, hold
from ident_service.motion.states import MOVING, STOPPABLE, State, States
from ident_service.motion.stop import stop
from ident_service.motion.surroundings import Surroundings


class Course:
    """Where the arm should be.

    Attributes:
        reference: of the last cycle.
        first: the state of the first way.
        complete: whether the last way has been followed to its end.
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
        """Plan to move.

        Args:
            states: armed when the first cycle comes.
            legs: ways and the states in which they are followed, in order; states is armed, the first comes next.
            start: where the arm stands.
            limits: of the arm, for stops and pauses.
            resuming: of ways out of pauses.
            surroundings: what ways out of pauses must keep clear of.
            held: whether the end of the last way is held like the end of a stop, instead of being done at once.
        """
        self.reference = start
        self.complete = False
        self._states = states
        self._limits, self._resuming, self._surroundings = limits, resuming, surroundings
        self._held = held
        (self.first, self._way), *self._later = legs
        self._begin_ns: int | None = None
        self._left = self.first  # what a pause interrupts
        self._paused: Paused | None = None
        self._search: Generator[None, None, Resumed] | None = None
        self._back: Resumed | None = None

    def at(self, stamp_ns: int) -> Setpoint:
        """The reference of the cycle with this stamp [ns]; states follow each other as their references end."""
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
            self.complete = True
            states.enter(State.STOPPING if self._held else State.DONE)
            self._way = hold(self._way.at(self._way.duration).position, 0.0)
        self.reference = self._way.at(elapsed)
        return self.reference

    def overdue(self, stamp_ns: int) -> float:
        """For how long the present reference has rested at its end [s]; negative before."""
        return self._elapsed(stamp_ns) - self._way.duration

    def stop(self, stamp_ns: int) -> None:
        """Turn to a controlled stop, where that is lawful."""
        if self._states.state in STOPPABLE:
            self._states.enter(State.STOPPING)
            self._begin_ns, self._way = stamp_ns, stop(self.reference, self._limits)

    def pause(self, stamp_ns: int) -> None:
        """Turn to a stop that can be gone on from, where something moves."""
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
        """The arm rests at the end of a pause's stop: it is paused, and the way back can be looked for."""
        self._states.enter(State.PAUSED)
        if self._paused is not None:
            self._search = self._paused.resume_in_slices(self._resuming, self._surroundings)

    def look_for_way_back(self) -> str | None:
        """While paused, one slice of the search for the way back; why there is none, when that turns out."""
        if self._search is None:
            return None
        try:
            next(self._search)
        except StopIteration as found:
            self._back, self._search = found.value, None
        except MotionRefused as refusal:
            self._search = None
            return str(refusal)
        return None

    def go_on(self, stamp_ns: int) -> None:
        """Leave a pause, as soon as the way back is found."""
        if self._back is not None:
            self._states.enter(State.RESUMING)
            self._begin_ns, self._way = stamp_ns, self._back

    def _elapsed(self, stamp_ns: int) -> float:
        return 0.0 if self._begin_ns is None else (stamp_ns - self._begin_ns) * 1e-9
