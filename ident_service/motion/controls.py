"""What people and programs may ask of a motion while it runs: stop, pause, finish, and that they are still there.

An arm without brakes that has been stopped is held, and waits for a person to say that it is supported.

The loop reads this once per cycle, so it must answer at once: a word of shared memory, an attribute, never a lock.
Stop needs no lease. Hold-to-run is nothing but a short lease.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Protocol

LEASE_SECONDS = 2.0  # ARCHITECTURE.md: renewed every 0.5 s
HOLD_TO_RUN_SECONDS = 0.25


class Homing(IntEnum):
    """Name how far the way home of an arm that is held after a stop has come."""

    NONE = 0
    ASKED = 1
    GOING = 2
    ENDED = 3  # it stands again and is held, at home unless it was stopped
    REFUSED = 4  # it stands where it stood


class Controls(Protocol):
    """Read once per cycle; whatever it raises stops the arm."""

    @property
    def stop(self) -> bool:
        """Whether the arm is to be brought to a controlled stop; the run ends with it."""

    @property
    def pause(self) -> bool:
        """Whether the arm is to stand; it goes on when this is False again."""

    @property
    def finish(self) -> bool:
        """Whether what is left of the motion is to be left out: the arm rests, and goes back to where it stood."""

    @property
    def supported(self) -> bool:
        """Whether a person has confirmed, since the arm began to wait for it, that it is supported or home."""

    def wait_for_support(self) -> None:
        """Say that the arm is held until somebody confirms that; called once for each hold."""

    @property
    def homing(self) -> Homing:
        """Say whether a person wants the arm, which is held, led home, and how far that has come."""

    def tell_homing(self, stage: Homing) -> None:
        """Say how far it has come; whoever asked for it is from `GOING` on the one whose lease counts."""

    def lease_ok(self, now_ns: int) -> bool:
        """Whether whoever asked for motion is still there at this time of the loop's clock [ns]."""


class StopWhen:
    """Controls of a run that nobody pauses or finishes early: stops when a function says so.

    A second function says whether an arm that is held since is supported.
    """

    pause = False
    finish = False
    homing = Homing.NONE

    def __init__(
        self, asked: Callable[[], bool] = lambda: False, supported: Callable[[], bool] = lambda: False
    ) -> None:
        self._asked, self._supported = asked, supported

    @property
    def stop(self) -> bool:
        """What the function says."""
        return self._asked()

    @property
    def supported(self) -> bool:
        """What the second function says."""
        return self._supported()

    def wait_for_support(self) -> None:
        """Nothing more: the function is asked."""

    def tell_homing(self, stage: Homing) -> None:
        """Nobody asks for it."""

    def lease_ok(self, now_ns: int) -> bool:
        """There is no lease to lose."""
        return True


class Switches:
    """Controls in this process, for whoever holds them; each is one attribute, written and read whole.

    Attributes:
        stop: the arm is to stop.
        pause: the arm is to stand.
        finish: the run is to end early.
        supported: the arm, which is held, is supported.
        waiting: whether the arm is held until that is so.
        homing: the arm, which is held, is to be led home.
    """

    def __init__(self, lease_seconds: float | None = None) -> None:
        """Begin with everything off.

        Args:
            lease_seconds: how long the arm may move after `renew` [s]; None for a run that needs no lease.
        """
        self.stop = False
        self.pause = False
        self.finish = False
        self.supported = self.waiting = False
        self.homing = Homing.NONE
        self._length_ns = None if lease_seconds is None else round(lease_seconds * 1e9)
        self._renewed_ns: int | None = None

    def wait_for_support(self) -> None:
        """Wait for the switch `supported`; one that was set before does not count."""
        self.supported, self.waiting = False, True

    def tell_homing(self, stage: Homing) -> None:
        """Remember it; the switch `stop`, which led here, is off while the arm goes home."""
        if stage is Homing.GOING:
            self.stop = self.pause = self.waiting = False
        self.homing = stage

    def renew(self, now_ns: int) -> None:
        """Say at a time of the loop's clock [ns] that somebody is still there."""
        self._renewed_ns = now_ns

    def lease_ok(self, now_ns: int) -> bool:
        """Whether the lease has been renewed in time; until it is for the first time, the first question begins it."""
        if self._length_ns is None:
            return True
        if self._renewed_ns is None:
            self._renewed_ns = now_ns
        return now_ns - self._renewed_ns <= self._length_ns
