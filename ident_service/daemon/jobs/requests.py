"""Define the requests for jobs: ids and plain values, never a path."""

from __future__ import annotations

from typing import Annotated, Final, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, model_validator

Id = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,119}$")]
ArmName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
FileName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,119}$")]
Speed = Annotated[float, Field(gt=0, le=1)]
Second = Annotated[float, Field(ge=0, le=1e9)]
Seed = Annotated[int, Field(ge=0, lt=2**31)]
FeasibleSet = Literal["pseudo_inertia", "inertia", "none"]


class RequestBody(BaseModel):
    """Body of a request, which refuses unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class RecordingReference(RequestBody):
    """Recording, named by its run; whole, or from `start` to `end` [s].

    `name` is that of the file in the run's manifest; left out, it is the run's only recording, or `run.mcap`.
    """

    run: Id
    name: FileName | None = None
    start: Second | None = None
    end: Second | None = None


class ArmJob(RequestBody):
    """Job about an arm."""

    arm: ArmName


class RunJob(RequestBody):
    """Job about a run."""

    run: Id


class Design(ArmJob):
    """Search for a motion; options left out are as the arm's description says."""

    kind: Literal["design"]
    seconds: Annotated[float, Field(gt=0, le=24 * 3600)] | None = None
    starts: Annotated[int, Field(ge=1, le=100_000)] | None = None
    seed: Seed = 0
    criterion: Literal["d_optimal", "condition_number", "a_optimal"] | None = None
    parameters: Annotated[tuple[Annotated[str, Field(min_length=1, max_length=200)], ...], Field(max_length=100)] = ()
    motion: Literal["fourier", "postures"] | None = None
    after: Annotated[tuple[RecordingReference, ...], Field(max_length=16)] = ()


class Check(ArmJob):
    """Do the preflight for a motion, the description's own without one, or for the motion home."""

    kind: Literal["check"]
    motion: Id | None = None
    home: bool = False

    @model_validator(mode="after")
    def _one(self) -> Check:
        if self.home and self.motion is not None:
            raise ValueError("give a motion or home, not both")
        return self


class Rehearse(ArmJob):
    """Run the motion slowly, while the lease is renewed as fast as a held key repeats."""

    kind: Literal["rehearse"]
    motion: Id | None = None
    speed: Speed = 0.2


class Until(RequestBody):
    """Accuracy at which a run ends early: standard deviations of at most this share of their parameters."""

    share: Annotated[float, Field(gt=0, lt=1)]
    parameters: Annotated[tuple[Annotated[str, Field(min_length=1, max_length=200)], ...], Field(max_length=100)] = ()


class Run(ArmJob):
    """Move the arm along a motion and record it."""

    kind: Literal["run"]
    motion: Id | None = None
    speed: Speed = 1.0
    until: Until | None = None


class Home(ArmJob):
    """Move the arm to its home position, slowly."""

    kind: Literal["home"]


class Zero(ArmJob):
    """Set the encoders' zero: a person confirms that the arm stands at home; nothing moves, and it never waits."""

    kind: Literal["zero"]


class LeaveLimit(ArmJob):
    """Move an arm that stands outside its position limits back inside, slowly."""

    kind: Literal["leave_limit"]


class Recover(ArmJob):
    """Report after a fault or a stop what prevents motion, and what to do; nothing moves."""

    kind: Literal["recover"]


class Watch(ArmJob):
    """Read the arm's positions and drive status without torque and without changing its state."""

    kind: Literal["watch"]
    seconds: Annotated[float, Field(gt=0, le=600)] = 2.0


class BusLoad(ArmJob):
    """Compute the load of every frame on the arm's buses, and whether all of them fit."""

    kind: Literal["bus_load"]
    rate: Annotated[float, Field(gt=0, le=1e6)] | None = None


class BusScan(ArmJob):
    """List the nodes on the arm's buses; reads only."""

    kind: Literal["bus_scan"]


class BusProbe(ArmJob):
    """Read the capabilities of the arm's drives, and what they lack; reads only."""

    kind: Literal["bus_probe"]


class ConfigCheck(ArmJob):
    """Check the arm's description: bus budget, and whether its gains are stable."""

    kind: Literal["config_check"]


class Base(ArmJob):
    """List the base parameters and their expressions."""

    kind: Literal["base"]


class Preview(ArmJob):
    """Predict the demands of a motion on the arm, and the accuracy that it will give."""

    kind: Literal["preview"]
    motion: Id | None = None


class Identify(ArmJob):
    """Identify parameters from recordings."""

    kind: Literal["identify"]
    recordings: Annotated[tuple[RecordingReference, ...], Field(min_length=1, max_length=16)]
    validate_on: Annotated[tuple[RecordingReference, ...], Field(max_length=16)] = ()
    method: Literal["ols", "wls", "huber", "iv"] | None = None
    feasible_set: FeasibleSet | None = None
    prior: Literal["none", "euclidean", "entropic"] | None = None
    as_accepted: Annotated[int, Field(ge=1, lt=10_000)] | None = None
    """Number of an acceptance whose stored description is used instead of today's, for comparison with its set."""


class Simulate(RequestBody):
    """Commission a simulated arm, and score the result against the known truth."""

    kind: Literal["simulate"]
    arm: ArmName = "wam7_sim"
    motion: Id | None = None
    seed: Seed | None = None
    feasible_set: FeasibleSet | None = None


class Report(RunJob):
    """Write the report of a run as one page."""

    kind: Literal["report"]


class Export(RunJob):
    """Write the parameters of a run for other tools."""

    kind: Literal["export"]
    formats: Annotated[tuple[Literal["urdf", "mjcf", "sdf", "json", "csv", "c"], ...], Field(min_length=1)] = ("urdf",)


class Verify(RunJob):
    """Check the certificate in a run's parameters against its own conditions, or those of an arm's description."""

    kind: Literal["verify"]
    arm: ArmName | None = None


class Feasible(RunJob):
    """Check whether a real body could have a run's parameters; `arm` adds the conditions of its description."""

    kind: Literal["feasible"]
    feasible_set: Literal["pseudo_inertia", "inertia"] | None = None
    arm: ArmName | None = None


class Correct(RunJob):
    """Find the feasible parameters nearest to a run's, as a file of their own; the run is unchanged."""

    kind: Literal["correct"]
    metric: Literal["euclidean", "covariance"] = "euclidean"
    feasible_set: Literal["pseudo_inertia", "inertia"] | None = None
    arm: ArmName | None = None


class Figures(RunJob):
    """Write the drawings of a run's report as files."""

    kind: Literal["figures"]
    format: Literal["svg", "png"] = "svg"


class Payload(RunJob):
    """Identify the payload that the arm of a run carries in recordings of other runs."""

    kind: Literal["payload"]
    recordings: Annotated[tuple[RecordingReference, ...], Field(min_length=1, max_length=16)]
    refit_offsets: bool = False


class Compare(RunJob):
    """Compare two runs: what changed, and by how many standard deviations."""

    kind: Literal["compare"]
    other: Id


class Judge(ArmJob):
    """Compare a run's parameters with those of an acceptance of its arm; the comparison is stored in the run."""

    kind: Literal["judge"]
    run: Id
    against: Annotated[int, Field(ge=1, lt=10_000)]


ArmPattern = Annotated[str, Field(pattern=r"^[A-Za-z0-9*?_.\-\[\]]{1,64}$")]


class Fleet(ArmJob):
    """Identify arms of one kind together, from every recording that the registry has of them.

    `arm` describes each of them; `arms` are their names, or patterns of names such as `cell*`.
    """

    kind: Literal["fleet"]
    arms: Annotated[tuple[ArmPattern, ...], Field(min_length=1, max_length=1000)]
    settle_again: bool = False


AnyJobRequest = Annotated[
    Base
    | Preview
    | Design
    | Watch
    | Recover
    | Check
    | Rehearse
    | Run
    | Home
    | Zero
    | LeaveLimit
    | BusLoad
    | BusScan
    | BusProbe
    | ConfigCheck
    | Identify
    | Simulate
    | Report
    | Export
    | Verify
    | Feasible
    | Correct
    | Figures
    | Payload
    | Compare
    | Judge
    | Fleet,
    Field(discriminator="kind"),
]
"""Any request for a job; `kind` tells which."""

KINDS: Final[dict[str, type[RequestBody]]] = {
    get_args(model.model_fields["kind"].annotation)[0]: model for model in get_args(get_args(AnyJobRequest)[0])
}
"""The requests by their kinds."""

MOVES = frozenset({"check", "rehearse", "run", "home", "leave_limit", "zero"})
"""Kinds of jobs that may command torque or set the encoders' zero: they need a lease and a person's confirmation."""
