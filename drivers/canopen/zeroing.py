"""Set the zero of drives: a person has led the arm to its described home, and each drive stores its counts there.

Nothing is energised, nothing moves, and of the drives' objects only 1020h is written. All marks are taken away before
the first new one is set, and again when anything fails: drives that were zeroed at different times must never look as
if they had been zeroed together.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drivers.arm import Vector
from drivers.canopen import object_dictionary as od
from drivers.canopen.bus_monitor import MonitoringArm
from drivers.canopen.cia402 import DriveState, drive_words, state_of
from drivers.canopen.sdo import TIMEOUT, Place
from drivers.canopen.stored_zero import Zeros
from drivers.motor_units import unwrapped
from ident_service.errors import DriverError

APART = 0.5  # s between two readings of a standing arm
STILL = 0.005  # rad or m that an arm held by hand may move in between
_OFF = (DriveState.SWITCH_ON_DISABLED, DriveState.FAULT)


class ZeroingArm(MonitoringArm):
    """Observe drives, whether they have a zero or not, until `set_home`."""

    def _find_zero(self) -> None:
        """Do nothing: whatever zero the drives have is about to be replaced."""

    def _require_no_restart(self) -> None:
        """Do nothing before the counts are taken."""

    def set_home(self) -> tuple[str, ...]:
        """Store in every drive, if all are off and at rest, its present counts as home; return drives' states in words.

        Raises:
            DriverError: not open, an arm without `zero: at_home`, a drive that does not answer, is powered, or cannot
                keep its zero, another host, or an arm that moves: nothing has changed. Or a drive failed while zeroes
                were set: then no drive has one, or the message names those that may.
        """
        self._require_open()
        zeros = Zeros(self._config)
        words = self._require_off()
        for number in range(len(self._places)):
            zeros.require_volatile_storage(self._objects(number))
        before = self._counts()
        self._heard.restarted.clear()
        self._pause()
        counts = self._counts()
        self._require_still(before, counts)
        self._require_no_other_host()
        try:
            self._set(zeros, counts)
        except BaseException as error:
            left = self._delete_marks(zeros)
            end = f"; drives {', '.join(left)} could not be cleared: switch their power off and on" if left else ""
            if isinstance(error, DriverError):
                raise DriverError(f"{error}; no drive has a zero now{end}") from None
            error.add_note(f"no drive has a zero now{end}")
            raise
        return words

    def _set(self, zeros: Zeros, counts: Sequence[int]) -> None:
        numbers = range(len(self._places))
        for number in numbers:
            zeros.delete_mark(self._objects(number))
        for number in numbers:
            zeros.store(self._objects(number), number, counts[number])
        if [zeros.stored_counts(self._objects(number), number) for number in numbers] != list(counts):
            raise DriverError("a drive does not hold the zero that it was given")
        self._require_still(counts, self._counts())
        self._heard.drain(self._links)
        if restarted := self._heard.restarted.intersection(self._places):
            raise DriverError(f"drives {_nodes(restarted)} restarted meanwhile")

    def _delete_marks(self, zeros: Zeros) -> list[str]:
        """Delete all marks; returns the nodes in which that failed."""
        left = []
        for number, (_, node) in enumerate(self._places):
            try:
                zeros.delete_mark(self._objects(number))
            except Exception:  # noqa: BLE001 - one drive must not keep the others from it
                left.append(str(node))
        return left

    def _require_off(self) -> tuple[str, ...]:
        """Return the states of all drives in words; raises DriverError unless each of them is off."""
        status, codes = self._all(od.STATUS_WORD), self._all(od.LAST_EMERGENCY, needed=False)
        if on := [place for place, word in status.items() if state_of(word) not in _OFF]:
            states = "; ".join(f"node {node}: {drive_words(status[bus, node])}" for bus, node in on)
            raise DriverError(f"drives must be off while home is set: {states}; stop the program that uses the arm")
        return tuple(f"node {p[1]}: {drive_words(status[p], codes.get(p, 0))}" for p in self._places)

    def _require_still(self, before: Sequence[int], after: Sequence[int]) -> None:
        stirred = [float(unwrapped(was, now) - was) for was, now in zip(before, after, strict=True)]
        way: Vector = np.abs(self._coordinates.joint_per_count @ stirred)
        if moving := [f"{name} {w:.3f}" for name, w in zip(self._config.joints, way, strict=True) if w > STILL]:
            raise DriverError(
                f"the arm moves: {', '.join(moving)} (rad or m) between two looks {APART:g} s apart; "
                f"support it, and keep it still within {STILL:g}"
            )

    def _require_no_other_host(self) -> None:
        self._heard.drain(self._links)
        self._require_alone()
        host = self._driver.heartbeats.node
        if others := [place for place in self._heard.nmt if place[1] == host]:
            bus = self._driver.buses[others[0][0]].channel
            raise DriverError(f"another host (node {host}) sends its heartbeat on {bus}; stop it first")

    def _counts(self) -> list[int]:
        counts = self._all(od.POSITION)
        return [counts[place] for place in self._places]

    def _all(self, entry: od.Entry, *, needed: bool = True) -> dict[Place, int]:
        """Read one entry of all drives; raises DriverError where it is needed and a drive does not answer."""
        answers = self._ask(self._places, entry, self.clock.now_ns() + round(TIMEOUT * 1e9))
        if needed and (missing := set(self._places) - answers.values.keys()):
            raise DriverError(f"no answer of drives {_nodes(missing)}; check power and cable (`ident bus scan`)")
        return answers.values

    def _pause(self) -> None:
        until_ns = self.clock.now_ns() + round(APART * 1e9)
        for bus, link in enumerate(self._links):
            while (frame := link.receive(until_ns)) is not None:
                self._heard.take(bus, frame)


def _nodes(places: set[Place]) -> str:
    return ", ".join(str(node) for _, node in sorted(places))
