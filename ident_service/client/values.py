"""Represent what a daemon reports: a job, a moment of a run, an event."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

_LIVE: Final = ("queued", "running")


@dataclass(frozen=True)
class Job:
    """A job as it stood when it was asked for.

    Attributes:
        id: which names it.
        kind: `run`, `identify` and so on.
        arm: its arm's name, if it is about one.
        state: `queued`, `running`, and after its end `done`, `refused`, `failed`, `faulted`, `cancelled` or
            `interrupted`.
        run: id of the run, motion or export that it makes or is about.
        detail: why it ended so, in words; empty where there is nothing to say.
        phase: of one that runs.
        held: whether the motion has stopped and its arm, which has no brakes, is held until a person confirms that it
            is supported; until then the job runs.
        document: everything that the daemon tells of it (`JobAnswer` in the OpenAPI description).
    """

    id: str
    kind: str
    arm: str | None
    state: str
    run: str | None
    detail: str
    phase: str | None
    held: bool
    document: Mapping[str, Any] = field(repr=False)

    @property
    def live(self) -> bool:
        """Tell if the job has not ended."""
        return self.state in _LIVE


@dataclass(frozen=True)
class LiveSample:
    """A moment of a run while it is recorded; the daemon sends one every 20 ms.

    Attributes:
        time: since the first sample [s].
        joints: names, in the order of the values.
        position: measured [rad or m]; None for a value that was not valid.
        torque: commanded [N m or N].
        following_error: the largest of those 20 ms [rad or m].
    """

    time: float
    joints: tuple[str, ...]
    position: tuple[float | None, ...]
    torque: tuple[float | None, ...]
    following_error: tuple[float | None, ...]


@dataclass(frozen=True)
class Event:
    """Something that a daemon tells of its arms and jobs.

    Attributes:
        kind: `happened` (a line of the audit trail), `job` or `arm` (how one stands), `samples` or `doubt` of a run.
        number: of what has happened, to go on after it; None for all else.
        value: `AuditLine`, `JobAnswer`, or as the OpenAPI description says of the stream.
    """

    kind: str
    number: int | None
    value: Mapping[str, Any]
