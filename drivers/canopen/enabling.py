"""Lead all drives of an arm through the states of CiA 402 at once, cycle by cycle.

Ready, switched on, a few cycles with zero torque and every position received, enabled: each step has one deadline for
all drives. Commands go to the drives that have not come so far, and again where one was lost.

The last step is taken when the drives may report it at once: a status report is not sent within the inhibit time of the
one before, and an arm without brakes would sink unnoticed, and without torque, until it is.
"""

from __future__ import annotations

from collections.abc import Sequence

from drivers.canopen.cia402 import (
    DISABLE_VOLTAGE,
    ENABLE,
    RESET_FAULT,
    STAY_IN_QUICK_STOP,
    TOWARDS_ENABLED,
    DriveState,
    emergency_words,
)
from drivers.canopen.pdo_codec import Drive
from ident_service.errors import DriverError

SEEDED = 5  # cycles in a row with zero torque and all positions before anything is enabled
REPEAT = 0.05  # s after which a command that had no effect is sent again
_WAY = (DriveState.READY_TO_SWITCH_ON, DriveState.SWITCHED_ON, DriveState.OPERATION_ENABLED)
_FAULTS = (DriveState.FAULT, DriveState.FAULT_REACTION)


class Enabling:
    """Lead drives from switched off to `operation enabled`."""

    def __init__(
        self,
        drives: Sequence[Drive],
        names: Sequence[str],
        step: float,
        now_ns: int,
        reports: tuple[float, float],
        quick_stop: int,
    ) -> None:
        """Start with drives that are switched off.

        Args:
            drives: of all buses, as their codecs know them.
            names: of the drives, for people.
            step: how long all drives together may take for one step [s].
            now_ns: of the link's clock.
            reports: least and longest time between two status reports of a drive [s].
            quick_stop: 605Ah; drives that stay in quick stop hold the arm, and are enabled out of it with the others.
        """
        self._stays = quick_stop in STAY_IN_QUICK_STOP
        self._drives, self._names = drives, names
        self._inhibit_ns, self._report_ns = (round(seconds * 1e9) for seconds in reports)
        self._reported_ns = [now_ns] * len(drives)
        self._ready_ns: int | None = None
        self._step_ns = round(step * 1e9)
        self._deadline_ns = now_ns + self._step_ns
        self._target = 0
        self._seeded = 0
        self._sent: dict[int, tuple[DriveState, int]] = {}

    @property
    def done(self) -> bool:
        """Return whether all drives are enabled."""
        return self._target == len(_WAY)

    def commands(self, now_ns: int) -> list[tuple[int, int]]:
        """Return the control words to send in this cycle, with the numbers of their drives.

        Raises:
            DriverError: a drive has a fault, or the step's time is over; who, and why as far as it is known.
        """
        if bad := [drive for drive in self._drives if drive.state in _FAULTS]:
            raise DriverError(f"{_told(self._drives, self._names, bad)}; only a reset clears it (`ident recover`)")
        for number, drive in enumerate(self._drives):
            if drive.status_age <= 1:  # came in this cycle, or before it
                self._reported_ns[number] = now_ns
        fresh = all(drive.answered for drive in self._drives)
        self._seeded = self._seeded + 1 if fresh else 0
        while not self.done and self._reached():
            if self._target == 1 and not self._may_enable(now_ns):
                break
            self._target += 1
            self._deadline_ns = now_ns + self._step_ns
        if self.done:
            return []
        if now_ns > self._deadline_ns:
            late = [drive for drive in self._drives if not self._there(drive)] or list(self._drives)
            raise DriverError(
                f"not {_WAY[self._target]} within {self._step_ns * 1e-9:g} s: {_told(self._drives, self._names, late)}"
            )
        words = []
        for number, drive in enumerate(self._drives):
            if self._there(drive):  # and waits for the others, or for the seed
                continue
            stopped = drive.state is DriveState.QUICK_STOP
            if stopped and not self._stays:
                continue  # its ramp ends by itself
            word = ENABLE if stopped else TOWARDS_ENABLED.get(drive.state, DISABLE_VOLTAGE)
            state, sent_ns = self._sent.get(number, (None, 0))
            if state is not drive.state or now_ns - sent_ns > REPEAT * 1e9:
                self._sent[number] = drive.state, now_ns
                words.append((number, word))
        return words

    def _may_enable(self, now_ns: int) -> bool:
        """Check that seed cycles have passed and no drive's next report would be held back; the latter not for ever."""
        if self._seeded < SEEDED:
            return False
        self._ready_ns = now_ns if self._ready_ns is None else self._ready_ns
        ages = [now_ns - reported for reported in self._reported_ns]
        soon = min(ages) > self._inhibit_ns and max(ages) < self._report_ns - self._inhibit_ns // 10
        return soon or now_ns - self._ready_ns > 3 * self._report_ns

    def _reached(self) -> bool:
        return all(self._there(drive) for drive in self._drives)

    def _there(self, drive: Drive) -> bool:
        holds = self._stays and drive.state is DriveState.QUICK_STOP and self._target < len(_WAY) - 1
        return holds or drive.state in _WAY[self._target :]


class Resetting:
    """Lead drives out of the state `fault`: a rising edge of bit 7, nothing else; the drives stay off."""

    def __init__(self, drives: Sequence[Drive], names: Sequence[str], step: float, now_ns: int) -> None:
        """Begin; arguments as for `Enabling`."""
        self._drives, self._names = drives, names
        self._deadline_ns = now_ns + round(step * 1e9)
        self._edge: dict[int, int] = {}

    @property
    def done(self) -> bool:
        """Return whether no drive is in a fault any more, nor in an unknown state."""
        return all(drive.state not in (*_FAULTS, DriveState.UNKNOWN) for drive in self._drives)

    def commands(self, now_ns: int) -> list[tuple[int, int]]:
        """Return the control words to send in this cycle; DriverError when the time is over and a fault persists."""
        if self.done:
            return []
        if now_ns > self._deadline_ns:
            kept = [drive for drive in self._drives if drive.state in (*_FAULTS, DriveState.UNKNOWN)]
            raise DriverError(f"the cause is still there: {_told(self._drives, self._names, kept)}")
        words = []
        for number, drive in enumerate(self._drives):
            if drive.state is DriveState.FAULT:
                # Two cycles low, two high, since some drives read one of two words within a millisecond; then again.
                phase = self._edge.get(number, 0)
                self._edge[number] = phase + 1
                words.append((number, RESET_FAULT if phase // 2 % 2 else DISABLE_VOLTAGE))
        return words


def hold(drives: Sequence[Drive]) -> bool:
    """Return whether some of the drives have reported that they are in quick stop."""
    return any(drive.state is DriveState.QUICK_STOP for drive in drives)


def _told(drives: Sequence[Drive], names: Sequence[str], chosen: Sequence[Drive]) -> str:
    """Describe the states and emergencies of the chosen drives."""
    words = []
    for name, drive in zip(names, drives, strict=True):
        if drive in chosen:
            last = drive.emergency
            why = "" if last is None else f" ({emergency_words(last.code, last.register, last.vendor)})"
            silent = "has told no status word" + (" since it booted" if drive.boots else "")
            says = silent if drive.status is None else f"is in the state {drive.state}{why}"
            words.append(f"{name} {says}")
    return "; ".join(words)
