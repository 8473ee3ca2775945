"""Shape the API's answers, and lists in pages with cursors.

Times are seconds since 1970 in UTC, durations seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Annotated, Any, Final, Literal
from urllib.parse import urlencode

from fastapi import Depends, Query, Request, Response
from pydantic import BaseModel

from ident_service.daemon.jobs.requests import Id
from ident_service.errors import Dependent
from ident_service.registry.database import Row


class DependentAnswer(BaseModel):
    """Entry that refers to what is to be deleted, and what becomes of it then."""

    kind: str
    id: str
    becomes: Literal["deleted", "kept"]


class DeletionAnswer(BaseModel):
    """Deleted entry, and the entries that referred to it."""

    deleted: str
    dependents: list[DependentAnswer]


def deletion_answer(name: str, dependents: Sequence[Dependent]) -> DeletionAnswer:
    """Return the API's answer to a deletion: the name of what was deleted, and what had referred to it."""
    return DeletionAnswer(deleted=name, dependents=[DependentAnswer(**asdict(one)) for one in dependents])


class Mistake(BaseModel):
    """Error of a failed request: its kind, a message for a person, and for `InUse` the entries that refer to it."""

    kind: str
    message: str
    dependents: list[DependentAnswer] | None = None


class Failure(BaseModel):
    """Answer of every request that fails."""

    error: Mistake


FAILURE_SCHEMA: Final = "#/components/schemas/Failure"
"""Its place in the OpenAPI description."""


class ArmLine(BaseModel):
    """One arm in the list of arms."""

    name: str
    source: Literal["shipped", "uploaded"]
    description: str


class FaultAnswer(BaseModel):
    """Fault that nobody has acknowledged."""

    code: str
    cause: str
    since: float


class AcceptanceAnswer(BaseModel):
    """Accepted set of parameters."""

    arm: str
    number: int
    run: str
    origin: int
    parameters_sha256: str
    note: str
    at: float
    who: str


class ArmAnswer(ArmLine):
    """Arm with its state.

    `moved_by` is the process that moves it, `control_problem` why that cannot be told (null if it can); `faults` are
    null if they cannot be told either. `resources` is what a motion of it reserves, `simulated` whether it can be
    commissioned by `simulate`, `unattended_motion` whether what is due may begin by itself.
    """

    sha256: str
    joints: list[str]
    simulated: bool
    unattended_motion: Literal["refused", "allowed"]
    resources: list[str]
    moved_by: int | None
    control_problem: str | None
    faults: list[FaultAnswer] | None
    accepted: AcceptanceAnswer | None


class AddedArmAnswer(ArmAnswer):
    """Arm that was added; `objections` say why it cannot be moved, each with line and column of the description.

    They are null where the same description was known already: it is judged once (`POST /descriptions/check`).
    """

    objections: list[str] | None


class ChallengeAnswer(BaseModel):
    """Challenge that confirms one motion, once."""

    arm: str
    challenge: str
    seconds: float


class MotionAnswer(BaseModel):
    """Motion that was designed or uploaded."""

    id: str
    arm: str
    name: str
    duration: float
    sha256: str
    added: float
    added_by: str


class ProgressAnswer(BaseModel):
    """Progress of a running job; what cannot be known is null."""

    phase: str
    fraction: float | None
    remaining: float | None


class JobAnswer(BaseModel):
    """A job; `run` is the id of the run, motion or export that it makes or is about, null where it ended and made none.

    `detail` says why it ended so, and of a queued job what it waits for. Of a running job it is empty, unless its
    process has ended and the registry cannot take that yet, on a full disk for example: then it says how, and why.

    `held` says that its motion has stopped, and that the arm, which has no brakes, is held until a person confirms that
    it is supported. Until then the job runs; after a kill of the daemon it is `interrupted`, and the arm held all the
    same.
    """

    number: int
    id: str
    kind: str
    arm: str | None
    state: str
    motion: bool
    request: dict[str, Any]
    run: str | None
    created: float
    created_by: str
    started: float | None
    ended: float | None
    exit_code: int | None
    detail: str
    progress: ProgressAnswer | None
    held: bool = False


class JobResult(BaseModel):
    """Answer of a job's command: its one JSON object, empty before there is one, and its text for a person."""

    job: str
    answer: dict[str, Any]
    text: str = ""


class LeaseAnswer(BaseModel):
    """Renewed lease, and how long it lasts [s]."""

    job: str
    seconds: float


class StopAnswer(BaseModel):
    """Arms whose motion processes were asked to stop, and jobs that were ended with that."""

    arms: list[str]
    jobs: list[str]


class AskedAnswer(BaseModel):
    """Request to the process that moves the arm, and whether there was one."""

    arm: str
    asked: str
    reached: bool


class RecordingAnswer(BaseModel):
    """Recording of a run."""

    name: str
    sha256: str
    bytes: int
    deleted: float | None


class ParametersAnswer(BaseModel):
    """Parameters that a run holds."""

    sha256: str
    method: str
    feasible: bool | None
    relative_error_percent: float | None


class RunLine(BaseModel):
    """One run in the list of runs, with the tags and the note that people gave it."""

    id: str
    kind: str
    arm: str
    created: float
    ending: str
    tags: list[str] = []
    note: str = ""


class RunAnswer(RunLine):
    """Run; files are those of its manifest, each with its SHA-256."""

    arm_sha256: str | None
    manifest_sha256: str | None
    files: dict[str, str]
    recordings: list[RecordingAnswer]
    parameters: ParametersAnswer | None


class SeriesEvent(BaseModel):
    """Line that was logged while a run was recorded: a `state`, a `warning`, or a `fault` that stopped the arm."""

    time: float
    kind: Literal["state", "warning", "fault"]
    message: str


class SeriesAnswer(BaseModel):
    """Recording of a run, thinned for display: times [s] after its first sample, a list per joint of each quantity.

    `position` and `reference` (commanded) are in rad or m; `torque`, which was commanded, and `measured` in N m or N;
    `error` is the largest following error near each time. Quantities that were not recorded are null. `begins` is when
    the motion itself began, `start` the stamp of the first sample [s].
    """

    joints: list[str]
    time: list[float]
    position: list[list[float | None]]
    torque: list[list[float | None]]
    reference: list[list[float | None]] | None = None
    error: list[list[float | None]] | None = None
    measured: list[list[float | None]] | None = None
    start: float
    begins: float | None
    events: list[SeriesEvent]


class AuditLine(BaseModel):
    """One line of the audit trail: who did what, when, and about which object."""

    id: int
    at: float
    who: str
    what: str
    about: str
    detail: dict[str, Any]


class WhoAnswer(BaseModel):
    """Name and role of the token or session that asks."""

    name: str
    role: Literal["viewer", "operator"]


class HealthAnswer(BaseModel):
    """Health of the service (its queue and schedule are looked after), and its version."""

    healthy: bool
    version: str


Anyway = Annotated[bool, Query(description="although something refers to it; 409 names what, and what becomes of it")]
Most = Annotated[int, Query(ge=1, le=500, description="lines of one page")]
BeforeNumber = Annotated[
    int | None, Query(ge=0, lt=2**62, description="go on after the line of this number; `Link` names the next page")
]
BeforeId = Annotated[Id | None, Query(description="go on after the line of this id; `Link` names the next page")]
PAGES: Final[dict[int | str, dict[str, Any]]] = {
    200: {
        "headers": {
            "Link": {
                "description": 'The next page, as `<path?query>; rel="next"`; not there after the last one.',
                "schema": {"type": "string"},
            }
        }
    }
}
"""Description of the `Link` header, for `responses` of a route."""


class Pager:
    """Reader of one page of a list for a request."""

    def __init__(self, request: Request, response: Response) -> None:
        """Take the request, which names the page, and the response, which gets the `Link` header."""
        self._request, self._response = request, response

    def __call__(self, most: int, read: Callable[[int], Sequence[Row]], key: str = "id") -> list[Row]:
        """Return the lines of one page, and name the next page in the header.

        Args:
            most: largest number of lines on a page.
            read: function that returns so many lines.
            key: column of the lines that `before` takes.
        """
        found = read(most + 1)
        if len(found) > most:
            query = [(name, value) for name, value in self._request.query_params.multi_items() if name != "before"]
            query.append(("before", str(found[most - 1][key])))
            self._response.headers["Link"] = f'<{self._request.url.path}?{urlencode(query)}>; rel="next"'
        return list(found[:most])


Page = Annotated[Pager, Depends()]
