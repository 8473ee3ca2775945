"""Define the controls of a running motion: stop, pause, finish early, confirmation of support, the way home, the lease.

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
    """Name the stages of leading home an arm that is held after a stop."""

    NONE = 0
    ASKED = 1
    GOING = 2
    ENDED = 3  # it stands again and is held, at home unless it was stopped
    REFUSED = 4  # it stands where it stood


class Controls(Protocol):
    """Define the controls that the loop reads once per cycle; whatever they raise stops the arm."""

    @property
    def stop(self) -> bool:
        """Return whether the arm is to be brought to a controlled stop; the run ends with it."""

    @property
    def pause(self) -> bool:
        """Return whether the arm is to pause; it goes on when this is False again."""

    @property
    def finish(self) -> bool:
        """Return whether the rest of the motion is to be left out: the arm rests, and goes back to where it stood."""

    @property
    def supported(self) -> bool:
        """Return whether a person has confirmed, since the arm began to wait for it, that it is supported or home."""

    def wait_for_support(self) -> None:
        """Announce that the arm is held until a person confirms that it is supported; called once for each hold."""

    @property
    def homing(self) -> Homing:
        """Return whether a person wants the held arm led home, and the stage of that."""

    def tell_homing(self, stage: Homing) -> None:
        """Set the stage of leading the arm home; from `GOING` on, the lease of its requester counts."""

    def lease_ok(self, now_ns: int) -> bool:
        """Return whether the requester of the motion is still alive, at this time of the loop's clock [ns]."""


class StopWhen:
    """Provide controls that neither pause nor finish early: the arm stops when a function returns true.

    A second function tells whether the arm, held after that stop, is supported.
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
        """Return whether the stop function asks for a stop."""
        return self._asked()

    @property
    def supported(self) -> bool:
        """Return whether the support function says that the arm is supported."""
        return self._supported()

    def wait_for_support(self) -> None:
        """Do nothing: the support function is asked in every cycle."""

    def tell_homing(self, stage: Homing) -> None:
        """Do nothing: these controls never ask for the way home."""

    def lease_ok(self, now_ns: int) -> bool:
        """Return True: there is no lease to lose."""
        return True


class Switches:
    """Hold controls as attributes for use within this process, each written and read whole.

    Attributes:
        stop: the arm is to stop.
        pause: the arm is to stand.
        finish: the run is to end early.
        supported: the arm, which is held, is supported.
        waiting: whether the arm is held until that is so.
        homing: the arm, which is held, is to be led home.
    """

    def __init__(self, lease_seconds: float | None = None) -> None:
        """Start with all controls off.

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
        """Set the stage of leading the arm home; `stop`, which preceded it, is off while the arm goes home."""
        if stage is Homing.GOING:
            self.stop = self.pause = self.waiting = False
        self.homing = stage

    def renew(self, now_ns: int) -> None:
        """Renew the lease at a time of the loop's clock [ns]."""
        self._renewed_ns = now_ns

    def lease_ok(self, now_ns: int) -> bool:
        """Return whether the lease was renewed in time; before any renewal, the first call starts it."""
        if self._length_ns is None:
            return True
        if self._renewed_ns is None:
            self._renewed_ns = now_ns
        return now_ns - self._renewed_ns <= self._length_ns
