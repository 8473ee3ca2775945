"""Pause and resume a motion: a controlled stop, and a jerk-limited trajectory back onto the motion or away from it.

The way back leads from standstill to the motion's own moving state, so that position, velocity and acceleration have
no step anywhere.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator

from ident_service.config.limits import MotionLimits
from ident_service.errors import MotionRefused
from ident_service.motion.reference import Reference, Setpoint, rest
from ident_service.motion.stop import stop
from ident_service.motion.surroundings import Surroundings
from ident_service.motion.way import RuckigReference, at_once, calm_way_in_slices, way_in_slices

_SEARCH_STEP = 0.1  # s
_SEARCH = 20  # steps to either side


class Paused:
    """Represent a motion that is brought to a controlled stop, and then stands.

    Attributes:
        duration: until the arm stands [s].
        time: of the motion at which it was left [s].
    """

    def __init__(self, motion: Reference, time: float, limits: MotionLimits, start: Setpoint | None = None) -> None:
        """Plan the stop out of a motion.

        Args:
            motion: within the limits.
            time: of the motion [s], at which the pause begins and is to end.
            limits: of the arm.
            start: where the pause begins, if not on the motion but on a way back onto it.
        """
        self._motion = motion
        self._limits = limits
        self._stop = stop(motion.at(time) if start is None else start, limits)
        self.time = min(time, motion.duration)
        self.duration = self._stop.duration

    def at(self, time: float) -> Setpoint:
        """Return the setpoint at `time` [s] since the pause began."""
        return self._stop.at(time)

    def resume(self, limits: MotionLimits | None = None) -> Resumed:
        """Plan a trajectory back onto the motion and the rest of the motion, to be followed once the arm stands.

        It joins the motion where it was left. Where no way leads there within the limits, it joins a little earlier and
        repeats that little; else a little later; else it begins the motion again. This takes a millisecond or few where
        the motion was left, but up to some tenths of a second when it must search: too long for a cycle.

        Args:
            limits: of the way, by default the arm's; `slowed_limits` for one as slow as a rehearsal.

        Raises:
            MotionRefused: not even the motion's beginning can be reached from here.
        """
        return at_once(self.resume_in_slices(limits))

    def resume_in_slices(
        self, limits: MotionLimits | None = None, surroundings: Surroundings | None = None
    ) -> Generator[None, None, Resumed]:
        """Plan as `resume` does, in slices short enough for a control cycle; the generator returns the resumed motion.

        Args:
            limits: as for `resume`.
            surroundings: that trajectories back must avoid; after one that does not, the search goes on.

        Raises:
            MotionRefused: as `resume`, from any of its steps.
        """
        here, limits = rest(self._stop.end), limits or self._limits
        for time in _joining_times(self.time, self._motion.duration):
            try:
                back = yield from way_in_slices(here, self._motion.at(time), limits)
                if surroundings is not None:
                    yield from surroundings.require_clear(back, limits)
                return Resumed(back, self._motion, time)
            except MotionRefused as error:
                refusal = error
        raise MotionRefused(f"no way leads from here back onto the motion: {refusal}") from refusal

    def leave_in_slices(
        self, end: Setpoint, limits: MotionLimits, surroundings: Surroundings | None = None
    ) -> Generator[None, None, RuckigReference]:
        """Plan a straight trajectory at reduced speed to another setpoint at rest, to be followed after the pause.

        Args:
            end: at rest.
            limits: of the way, as for `resume`.
            surroundings: that the trajectory must avoid.

        Raises:
            MotionRefused: the straight way is not free; from any of the steps.
        """
        away = yield from calm_way_in_slices(rest(self._stop.end), end, limits)
        if surroundings is not None:
            yield from surroundings.require_clear(away, limits)
        return away


class Resumed:
    """Represent a trajectory back onto a motion, and the motion from there on.

    Attributes:
        duration: of both [s].
        back: length of the way back [s].
        joined: time of the motion at which the way back ends [s].
        motion: the one it joins.
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
