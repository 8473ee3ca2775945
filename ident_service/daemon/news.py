"""Report to viewers what happens to arms and jobs, and their present state, from one poll for all viewers.

An event is a line of the audit trail and has that line's number, so a viewer who reconnects names the last one and
misses nothing, also after a restart of the service. The state of an arm or a job has no number: it is sent to each new
viewer, and whenever it changes.

One poll serves all viewers: fifty cost the registry as much as one, and none costs nothing. Nothing that
acts (a stop, a lease, a job) knows of viewers or waits for them.
"""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from ident_service.errors import IdentError
from ident_service.operations.moving_arms import moving_arms
from ident_service.registry import jobs as rows
from ident_service.registry.database import Database, Row, audit_entries_after, newest_line_id
from ident_service.registry.state_folder import arm_fault_store, known_arms

LOOK: Final = 0.25  # s between polls, however many viewers there are
_PAGE = 500  # lines that are read at a time
_KEPT = 1000  # lines in memory, for viewers who keep up
_GONE = 30.0  # s that the end of a job is kept for those who watch


@dataclass(frozen=True)
class ViewerEvent:
    """One event for viewers.

    Attributes:
        kind: `happened`, `arm` or `job`.
        data: JSON.
        number: number of a `happened` event; None for a state.
    """

    kind: str
    data: str
    number: int | None = None


@dataclass
class ViewerPosition:
    """Position of one viewer in the events.

    Attributes:
        line: number of the last line of the audit trail.
        version: version of the present states of arms and jobs.
    """

    line: int
    version: int = -1


@dataclass(frozen=True)
class _Standing:
    version: int
    data: str
    gone: float | None = None  # when it ended [s]


class EventPoller:
    """Poller of registry and arms for all viewers; may be used from any thread."""

    def __init__(
        self,
        db: Database,
        state: Path,
        shown: Callable[[Row], dict[str, Any]],
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """Create the poller; nothing is read before somebody watches.

        Args:
            db: the registry.
            state: the state folder.
            shown: a job as it is answered.
            now: clock of looks [s].
        """
        self._db, self._state, self._shown, self._now = db, state, shown, now
        self._lock, self._looked, self._version = threading.Lock(), float("-inf"), 0
        self._lines = deque[ViewerEvent](maxlen=_KEPT)
        self._line: int | None = None  # number of the last line that was read
        self._standing = dict[tuple[str, str], _Standing]()
        self._ending = set[str]()  # jobs whose end may not have been seen

    def begin(self, last_seen_line: int | None) -> ViewerPosition:
        """Return where a new viewer begins: behind the audit line `last_seen_line`, or behind the last one if None.

        Args:
            last_seen_line: number of the last line that was seen; only events from now on are reported if None.
        """
        last = newest_line_id(self._db)
        # A number beyond the last line comes from another state folder, or from before a restore.
        return ViewerPosition(last if last_seen_line is None or last_seen_line > last else last_seen_line)

    @property
    def due(self) -> bool:
        """Return whether `LOOK` seconds have passed since the last poll."""
        return self._now() - self._looked >= LOOK

    def poll(self) -> None:
        """Poll the registry and the arms, unless another thread polls now or has just done so."""
        if not self._lock.acquire(blocking=False):
            return
        try:
            if self.due:
                self._looked = self._now()
                self._read_lines()
                self._read_jobs()
                self._read_arms()
        finally:
            self._lock.release()

    def behind(self, position: ViewerPosition) -> bool:
        """Return whether a viewer misses lines that are no longer in memory."""
        return self._line is not None and position.line < self._line and not self._has_buffered_line(position.line)

    def earlier(self, position: ViewerPosition) -> list[ViewerEvent]:
        """Return the next page of audit lines for a viewer who is behind, and move the viewer's position on."""
        found = [_line(row) for row in audit_entries_after(self._db, position.line, _PAGE)]
        # No lines: the registry has been restored to an earlier state.
        position.line = (found[-1].number if found else self._line) or 0
        return found

    def since(self, position: ViewerPosition) -> list[ViewerEvent]:
        """Return the events in memory that are new to a viewer, and move the viewer's position on; never waits."""
        found = [one for one in list(self._lines) if one.number is not None and one.number > position.line]
        if found and found[-1].number is not None:
            position.line = found[-1].number
        version, first = self._version, position.version < 0
        standing = [
            (one.version, ViewerEvent(kind, one.data))
            for (kind, _), one in list(self._standing.items())
            if position.version < one.version <= version and not (first and one.gone is not None)
        ]
        position.version = version
        return found + [one for _, one in sorted(standing, key=lambda pair: pair[0])]

    def _has_buffered_line(self, line: int) -> bool:
        first = next(iter(self._lines), None)
        return first is not None and first.number is not None and first.number <= line + 1

    def _read_lines(self) -> None:
        if self._line is None:
            self._line = newest_line_id(self._db)
        while found := audit_entries_after(self._db, self._line, _PAGE):
            for row in found:
                self._lines.append(_line(row))
                if row["what"].startswith("job "):
                    self._ending.add(row["about"])
            self._line = found[-1]["id"]

    def _read_jobs(self) -> None:
        live = {row["id"]: row for row in rows.jobs(self._db, states=rows.LIVE, most=_PAGE)}
        for job in self._ending - live.keys():
            row = self._db.row("SELECT id FROM jobs WHERE id = ?", job)
            if row is not None:
                self._update_state("job", job, self._shown(rows.known_job(self._db, job)), gone=True)
        for job, row in live.items():
            self._update_state("job", job, self._shown(row))
        self._ending = set(live)
        for key, one in list(self._standing.items()):
            if one.gone is not None and self._now() - one.gone > _GONE:
                del self._standing[key]

    def _read_arms(self) -> None:
        moving, arms = set(moving_arms(self._state)), known_arms(self._state)
        for kind, name in self._standing.keys() - {("arm", arm) for arm in arms}:
            if kind == "arm":  # it was deleted, which is a line of the trail
                del self._standing[kind, name]
        for arm in arms:
            try:
                faults = sorted(arm_fault_store(self._state, arm).latched())
            except IdentError:
                faults = ["unreadable"]  # a damaged file prevents motion like a fault
            self._update_state("arm", arm, {"arm": arm, "moves": arm in moving, "faults": faults})

    def _update_state(self, kind: str, name: str, value: dict[str, Any], *, gone: bool = False) -> None:
        data, before = json.dumps(value, allow_nan=False), self._standing.get((kind, name))
        if before is None or before.data != data:
            self._standing[kind, name] = _Standing(self._version + 1, data, self._now() if gone else None)
            self._version += 1


def _line(row: Row) -> ViewerEvent:
    return ViewerEvent("happened", json.dumps(dict(row), allow_nan=False), row["id"])
