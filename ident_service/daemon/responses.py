"""Define the models of the API's answers, and the one model of all failures.

Times are seconds since 1970 in UTC, durations seconds.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel


class DependentAnswer(BaseModel):
    """Entry that refers to what is to be deleted, and what becomes of it then."""

    kind: str
    id: str
    becomes: Literal["deleted", "kept"]


class DeletionAnswer(BaseModel):
    """Deleted entry, and the entries that referred to it."""

    deleted: str
    dependents: list[DependentAnswer]


class Mistake(BaseModel):
    """Error of a failed request: its kind, a message for a person, and for `InUse` the entries that refer to it."""

    kind: str
    message: str
    dependents: list[DependentAnswer] | None = None


class Failure(BaseModel):
    """Answer of every request that fails."""

    error: Mistake


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

    `moved_by` is the process that moves it, `resources` what a motion of it reserves, `simulated` whether it can
    be commissioned by `simulate`, `unattended_motion` whether what is due may begin by itself.
    """

    sha256: str
    joints: list[str]
    simulated: bool
    unattended_motion: Literal["refused", "allowed"]
    resources: list[str]
    moved_by: int | None
    faults: list[FaultAnswer]
    accepted: AcceptanceAnswer | None


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
    """A job; `run` is the id of the run, motion or export that it makes or is about.

    `held` says that its motion has stopped, and that the arm, which has no brakes, is held until a person confirms that
    it is supported; until then the job runs.
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
    """Answer of a job's command: its one JSON object, empty before there is one."""

    job: str
    answer: dict[str, Any]


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
    """One run in the list of runs."""

    id: str
    kind: str
    arm: str
    created: float
    ending: str


class RunAnswer(RunLine):
    """Run; files are those of its manifest, each with its SHA-256."""

    arm_sha256: str | None
    manifest_sha256: str | None
    files: dict[str, str]
    recordings: list[RecordingAnswer]
    parameters: ParametersAnswer | None


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
