"""Controls of a motion as attributes, for tests that press them."""

from __future__ import annotations

from ident_service.motion.command_channel import Homing


class LocalCommands:
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

    def announce_hold(self) -> None:
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
