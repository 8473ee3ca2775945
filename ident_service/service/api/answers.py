"""What the API answers with: the shape of every answer, one shape for all that goes wrong.

Times are seconds since 1970 in UTC, durations seconds.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel


class DependentAnswer(BaseModel):
    """Something that refers to what is to be deleted, and what becomes of it then."""

    kind: str
    id: str
    becomes: Literal["deleted", "kept"]


class DeletionAnswer(BaseModel):
    """Name what was deleted, and what referred to it."""

    deleted: str
    dependents: list[DependentAnswer]


class Mistake(BaseModel):
    """What went wrong: the name of an error, and words for a person; for `InUse` what refers to it, too."""

    kind: str
    message: str
    dependents: list[DependentAnswer] | None = None


class Failure(BaseModel):
    """Every answer that is not a success."""

    error: Mistake


class ArmLine(BaseModel):
    """An arm in the list."""

    name: str
    source: Literal["shipped", "uploaded"]
    description: str


class FaultAnswer(BaseModel):
    """A fault that nobody has acknowledged."""

    code: str
    cause: str
    since: float


class AcceptanceAnswer(BaseModel):
    """A set that was accepted."""

    arm: str
    number: int
    run: str
    origin: int
    parameters_sha256: str
    note: str
    at: float
    who: str


class ArmAnswer(ArmLine):
    """An arm.

    `moved_by` is the process that moves it, `resources` what a motion of it has for itself, `simulated` whether it can
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
    """A word that confirms one motion, once."""

    arm: str
    challenge: str
    seconds: float


class MotionAnswer(BaseModel):
    """A motion that was designed or uploaded."""

    id: str
    arm: str
    name: str
    duration: float
    sha256: str
    added: float
    added_by: str


class ProgressAnswer(BaseModel):
    """How far a job that runs is; what nobody can know is null."""

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
    """What the command of a job answered: its one JSON object, empty before it has."""

    job: str
    answer: dict[str, Any]


class LeaseAnswer(BaseModel):
    """A lease that was renewed, and how long it lasts."""

    job: str
    seconds: float


class StopAnswer(BaseModel):
    """Arms whose movers were asked to stop, and jobs that were ended with that."""

    arms: list[str]
    jobs: list[str]


class AskedAnswer(BaseModel):
    """Whether anybody moves the arm, and so was asked."""

    arm: str
    asked: str
    reached: bool


class RecordingAnswer(BaseModel):
    """A recording of a run."""

    name: str
    sha256: str
    bytes: int
    deleted: float | None


class ParametersAnswer(BaseModel):
    """The parameters that a run holds."""

    sha256: str
    method: str
    feasible: bool | None
    relative_error_percent: float | None


class RunLine(BaseModel):
    """A run in the list."""

    id: str
    kind: str
    arm: str
    created: float
    ending: str


class RunAnswer(RunLine):
    """A run: files are those of its manifest, each with its SHA-256."""

    arm_sha256: str | None
    manifest_sha256: str | None
    files: dict[str, str]
    recordings: list[RecordingAnswer]
    parameters: ParametersAnswer | None


class AuditLine(BaseModel):
    """Who did what."""

    id: int
    at: float
    who: str
    what: str
    about: str
    detail: dict[str, Any]


class WhoAnswer(BaseModel):
    """Tell whose token or session asks."""

    name: str
    role: Literal["viewer", "operator"]


class HealthAnswer(BaseModel):
    """Whether the service looks after its queue, and its version."""

    healthy: bool
    version: str
