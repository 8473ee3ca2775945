"""From a request by ids to the words of a command: the only place where an id becomes a path."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from ident_service.errors import UsageError
from ident_service.motion.controls import HOLD_TO_RUN_SECONDS, LEASE_SECONDS
from ident_service.service.acceptance import ARM, PARAMETERS, accepted_set
from ident_service.service.jobs.asked import (
    MOVES,
    Asked,
    Base,
    Check,
    Compare,
    Design,
    Export,
    Home,
    Identify,
    Judge,
    LeaveLimit,
    Preview,
    RecordingOf,
    Recover,
    Rehearse,
    Report,
    Run,
    Simulate,
    Verify,
    Watch,
)
from ident_service.service.registry.arms import KnownArm, known_arm, resources
from ident_service.service.registry.database import Database
from ident_service.service.registry.motions import MOTIONS, motion_path, new_id
from ident_service.service.registry.runs import RUNS, known_run, run_file, run_folder

JOBS, REPORTS, EXPORTS = "jobs", "reports", "exports"
_LOOKS = (Check, Watch, Recover, Base, Preview)  # that make no folder
_VERBS: Final = {"leave_limit": "recover"}
FOLDERS: Final = {"design": MOTIONS, "export": EXPORTS}


@dataclass(frozen=True)
class Command:
    """What a job's process is to do.

    Attributes:
        words: after `ident`.
        arm: name, None where it is about none.
        moves: whether an arm may get a torque.
        run: id of the folder that is made, or that it is about; None for a preflight.
        resources: that it has for itself while it runs; none for one that only computes.
        lease: how long its motion goes on after a renewal [s].
    """

    words: tuple[str, ...]
    arm: str | None
    moves: bool
    run: str | None
    resources: tuple[str, ...]
    lease: float


def command(db: Database, state: Path, asked: Asked) -> Command:
    """The command of a request.

    Raises:
        UsageError: it names what is not known.
        ConfigError: the arm's description has mistakes.
    """
    if isinstance(asked, Report | Export | Verify | Compare):
        return _about_a_run(db, state, asked)
    if isinstance(asked, Judge):
        return _judgement(db, state, asked)
    arm = known_arm(db, state, asked.arm)
    made = None if isinstance(asked, _LOOKS) else new_id(arm.name)
    words = [_VERBS.get(asked.kind, asked.kind), *_words(db, state, asked, arm)]
    if made is not None:
        words += ["--out", str(state / FOLDERS.get(asked.kind, RUNS) / made)]
    moves = asked.kind in MOVES
    if moves:
        words.append("--lease-from-stdin")
    return Command(
        (*words, *_always(state)),
        arm.name,
        moves,
        made,
        resources(arm.config) if moves or isinstance(asked, Watch | Recover) else (),
        HOLD_TO_RUN_SECONDS if isinstance(asked, Rehearse) else LEASE_SECONDS,
    )


def _words(db: Database, state: Path, asked: Asked, arm: KnownArm) -> list[str]:
    path = str(arm.path)
    if isinstance(asked, Design):
        return [path, *_design(db, state, asked)]
    if isinstance(asked, Identify):
        recordings = _recordings(db, state, asked.recordings)
        judged = [f"--validate={one}" for one in _recordings(db, state, asked.validate_on)]
        chosen = {"method": asked.method, "feasible-set": asked.feasible_set, "prior": asked.prior}
        if asked.as_accepted is not None:
            path = str(accepted_set(state, arm.name, asked.as_accepted)[1] / ARM)
        return [*recordings, "--arm", path, *judged, *_given(chosen)]
    if isinstance(asked, Simulate):
        motion = [] if asked.motion is None else [f"--motion={motion_path(db, state, asked.motion)}"]
        return [path, *motion, *_given({"seed": asked.seed, "feasible-set": asked.feasible_set})]
    if isinstance(asked, Home | Base | Recover):
        return [path]
    if isinstance(asked, LeaveLimit):
        return [path, "--leave-limit"]
    if isinstance(asked, Watch):
        return [path, f"--seconds={asked.seconds!r}"]
    if isinstance(asked, Check | Run | Rehearse | Preview):
        motion = [] if asked.motion is None else [str(motion_path(db, state, asked.motion))]
        if isinstance(asked, Check):
            return [path, *motion, *(["--home"] if asked.home else []), "--confirm", arm.name]
        speed = [] if isinstance(asked, Preview) else [f"--speed={asked.speed!r}"]
        return [path, *motion, *speed, *(_until(asked) if isinstance(asked, Run) else [])]
    raise AssertionError(asked)


def _until(asked: Run) -> list[str]:
    if asked.until is None:
        return []
    return [f"--until={asked.until.share!r}", *(f"--parameter={one}" for one in asked.until.parameters)]


def _design(db: Database, state: Path, asked: Design) -> list[str]:
    if asked.seconds is None and asked.starts is None:
        raise UsageError("a search ends: give seconds, or starts, or both")
    after = [f"--after={path}" for path in _recordings(db, state, asked.after)]
    chosen = {"seconds": asked.seconds, "starts": asked.starts, "seed": asked.seed, "criterion": asked.criterion}
    parameters = [f"--parameter={expression}" for expression in asked.parameters]
    return [*after, *parameters, *_given({**chosen, "motion": asked.motion})]


def _about_a_run(db: Database, state: Path, asked: Report | Export | Verify | Compare) -> Command:
    folder, arm = run_folder(db, state, asked.run), str(known_run(db, asked.run)["arm"])
    if isinstance(asked, Verify):
        words = ["verify", str(run_file(db, state, asked.run, PARAMETERS))]
        return Command((*words, *_always(state)), arm, False, asked.run, (), LEASE_SECONDS)
    if isinstance(asked, Compare):
        words = ["compare", str(folder), str(run_folder(db, state, asked.other))]
        return Command((*words, *_always(state)), arm, False, asked.run, (), LEASE_SECONDS)
    if isinstance(asked, Report):
        made: str | None = None
        place = state / REPORTS
        words = ["report", str(folder), "--out", str(place / f"{asked.run}.html")]
    else:
        made, place = new_id(arm), state / EXPORTS
        words = ["export", str(folder), "--format", ",".join(asked.formats), "--out", str(place / made)]
    place.mkdir(parents=True, exist_ok=True)
    return Command((*words, *_always(state)), arm, False, made or asked.run, (), LEASE_SECONDS)


def _judgement(db: Database, state: Path, asked: Judge) -> Command:
    run = known_run(db, asked.run)
    if run["arm"] != asked.arm:
        raise UsageError(f"the run {asked.run} is about the arm {run['arm']}, not {asked.arm}")
    accepted = accepted_set(state, asked.arm, asked.against)[1] / PARAMETERS
    words = ["compare", str(accepted), str(run_folder(db, state, asked.run)), "--keep"]
    return Command((*words, *_always(state)), asked.arm, False, asked.run, (), LEASE_SECONDS)


def _recordings(db: Database, state: Path, asked: Sequence[RecordingOf]) -> list[str]:
    return [str(run_file(db, state, one.run, one.name)) for one in asked]


def _given(options: Mapping[str, object]) -> list[str]:
    """Options that have a value, each in one word, so that no value can pass for an option."""
    return [f"--{name}={value}" for name, value in options.items() if value is not None]


def _always(state: Path) -> tuple[str, ...]:
    return ("--json", "--state", str(state))
