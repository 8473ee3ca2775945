"""Translate a request by ids into the arguments of a command: the only place where an id becomes a path."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeAlias

from ident_service.config.load import arm_from_json
from ident_service.daemon.jobs import requests as asked
from ident_service.errors import UsageError
from ident_service.motion.command_channel import HOLD_TO_RUN_SECONDS, LEASE_SECONDS
from ident_service.operations.acceptance import ARM, PARAMETERS, accepted_set
from ident_service.registry.arms import KnownArm, known_arm, resources
from ident_service.registry.database import Database
from ident_service.registry.motions import MOTIONS, motion_path, new_id
from ident_service.registry.runs import (
    COLUMNS,
    DOWNLOADABLE_KINDS,
    EXPORTS,
    REPORTS,
    RUNS,
    known_run,
    recording_name,
    recordings_of,
    run_file,
    run_folder,
)

JOBS = "jobs"
_MOST_OF_FLEET: Final = 10_000  # recordings; more would be too many words for a command
_OF_RUN: Final = r"/runs/[^-/]+-(?P<arm>[^/]+)-[0-9a-f]{6}/"  # the folder of a run, see `new_id`
_WITHOUT_FOLDER: Final = frozenset(  # kinds that make no folder
    ("check", "watch", "recover", "base", "preview", "zero", "bus_load", "bus_scan", "bus_probe", "config_check")
)
READS_BUS: Final = frozenset({"watch", "recover", "bus_scan", "bus_probe"})
_OfARun: TypeAlias = (
    asked.Report
    | asked.Export
    | asked.Verify
    | asked.Compare
    | asked.Feasible
    | asked.Correct
    | asked.Figures
    | asked.Payload
)
_VERBS: Final = {
    "leave_limit": ("recover",),
    "zero": ("home",),
    "bus_load": ("bus", "load"),
    "bus_scan": ("bus", "scan"),
    "bus_probe": ("bus", "probe"),
    "config_check": ("config", "check"),
    "fleet": ("fleet", "identify"),
}
_OPTIONS: Final = frozenset(  # fields of requests that the command has as options of the same names
    (
        *("seconds", "starts", "seed", "criterion", "home", "speed", "rate", "method", "feasible_set", "prior"),
        *("metric", "format", "refit_offsets", "settle_again"),
    )
)
FOLDERS: Final = {"design": MOTIONS, **dict.fromkeys(DOWNLOADABLE_KINDS, EXPORTS)}


@dataclass(frozen=True)
class Command:
    """Command that a job's process runs.

    Attributes:
        words: words of the command after `ident`.
        arm: name, None where it is about none.
        moves: whether an arm may get a torque, or another zero.
        run: id of the folder that is made, or that it is about; None for a preflight.
        resources: resources that it has for itself while it runs; none for a command that only computes.
        lease: how long its motion goes on after a renewal [s].
        waits: whether it may wait for its resources; what a person says of an arm as it stands now may not.
    """

    words: tuple[str, ...]
    arm: str | None
    moves: bool
    run: str | None
    resources: tuple[str, ...]
    lease: float
    waits: bool = True


def command_of_request(db: Database, state: Path, request: asked.AnyJobRequest) -> Command:
    """Make the command that carries out a request: its arguments, arm, folder to make, and resources that it needs.

    Raises:
        UsageError: it names what is not known.
        ConfigError: the arm's description has mistakes.
    """
    if isinstance(request, _OfARun):
        return _about_a_run(db, state, request)
    if isinstance(request, asked.Judge):
        return _judgement(db, state, request)
    arm = known_arm(db, state, request.arm)
    made = None if request.kind in _WITHOUT_FOLDER else new_id(arm.name)
    words = [*_VERBS.get(request.kind, (request.kind,)), *_words(db, state, request, arm)]
    if made is not None:
        words += ["--out", str(state / FOLDERS.get(request.kind, RUNS) / made)]
    moves = request.kind in asked.MOVES
    if moves:
        words.append("--lease-from-stdin")
    return Command(
        (*words, *_common_options(state)),
        arm.name,
        moves,
        made,
        resources(arm.config) if moves or request.kind in READS_BUS else (),
        HOLD_TO_RUN_SECONDS if isinstance(request, asked.Rehearse) else LEASE_SECONDS,
        waits=not isinstance(request, asked.Zero),
    )


def accepted_description(state: Path, arm: str, acceptance_number: int) -> Path:
    """Return the file of the arm description that an acceptance keeps, checked; raise UsageError if it names code.

    Raises:
        UsageError: there is no such acceptance; or its description names code, which only a terminal may run. An upload
            cannot name any, but a folder that was imported can.
        ParameterError: what was accepted was changed on the disk.
    """
    path = accepted_set(state, arm, acceptance_number)[1] / ARM
    if (code := arm_from_json(path).constraints.custom) is not None:
        raise UsageError(
            f"what was accepted for {arm} was identified with code (constraints.custom: {code}), which a daemon does "
            "not run; use `ident reidentify` at a terminal"
        )
    return path


def _words(db: Database, state: Path, request: asked.AnyJobRequest, arm: KnownArm) -> list[str]:
    path = str(arm.path)
    if isinstance(request, asked.Design):
        if request.seconds is None and request.starts is None:
            raise UsageError("a search ends: give seconds, or starts, or both")
        after = [f"--after={one}" for one in _as_described(db, state, request.after)]
        return [path, *after, *_options(request, seconds="search_time", parameters="parameter", motion="motion")]
    if isinstance(request, asked.Identify):
        recordings = _recordings(db, state, request.recordings)
        judged = [f"--validate={one}" for one in _recordings(db, state, request.validate_on)]
        judged += _columns(db, state, (*request.recordings, *request.validate_on))
        if request.as_accepted is not None:
            path = str(accepted_description(state, arm.name, request.as_accepted))
        return [*recordings, "--arm", path, *judged, *_options(request)]
    if isinstance(request, asked.Fleet):
        return [*_fleet(db, state, request, path), *_options(request)]
    motion = getattr(request, "motion", None)
    moved = [] if motion is None else [str(motion_path(db, state, motion))]
    if isinstance(request, asked.Simulate):
        moved = [f"--motion={one}" for one in moved]
    own = {
        "check": ["--confirm", arm.name],
        "zero": ["--zero", "--confirm", arm.name],
        "leave_limit": ["--leave-limit"],
        "watch": ["--tell-samples"],
    }
    until = _until(request) if isinstance(request, asked.Run) else []
    return [path, *moved, *_options(request), *own.get(request.kind, []), *until]


def _fleet(db: Database, state: Path, request: asked.Fleet, described: str) -> list[str]:
    found = recordings_of(db, request.arms)
    if not found:
        raise UsageError(f"{', '.join(request.arms)}: the registry has no recording of such arms; see the list of runs")
    if len(found) > _MOST_OF_FLEET:
        raise UsageError(
            f"{len(found)} recordings, and a job takes {_MOST_OF_FLEET}: name fewer arms, or use `ident fleet "
            "identify` with a pattern at the daemon's machine"
        )
    foreign = [row["run"] for row in found if not re.search(_OF_RUN, f"/runs/{row['run']}/")]
    if foreign:
        raise UsageError(
            f"{', '.join(foreign[:5])}: imported runs whose names do not tell their arm (TIME-ARM-XXXXXX); use `ident "
            "fleet identify --names` at the daemon's machine"
        )
    files = [str(run_file(db, state, row["run"], row["name"])) for row in found]
    return [*files, f"--arm={described}", f"--names={_OF_RUN}", f"--store={state / 'fleet' / 'store'}"]


def _until(request: asked.Run) -> list[str]:
    if request.until is None:
        return []
    return [f"--until={request.until.share!r}", *(f"--parameter={one}" for one in request.until.parameters)]


def _about_a_run(db: Database, state: Path, request: _OfARun) -> Command:
    folder, arm = run_folder(db, state, request.run), str(known_run(db, request.run)["arm"])
    made = new_id(arm) if request.kind in DOWNLOADABLE_KINDS else None
    place = state / (REPORTS if isinstance(request, asked.Report) else EXPORTS)
    more = list[str]()
    if isinstance(request, asked.Verify | asked.Feasible | asked.Correct):
        folder = run_file(db, state, request.run, PARAMETERS)
        more = [] if request.arm is None else [f"--arm={known_arm(db, state, request.arm).path}"]
    elif isinstance(request, asked.Compare):
        more = [str(run_folder(db, state, request.other))]
    elif isinstance(request, asked.Payload):
        more = _as_described(db, state, request.recordings)
    elif isinstance(request, asked.Export):
        more = ["--format", ",".join(request.formats)]
    words = [request.kind, str(folder), *more, *_options(request)]
    if made is not None or isinstance(request, asked.Report):
        # `correct` writes a file, not a folder, so the folder is made here; `keep` removes it if it stays empty.
        (place / str(made) if isinstance(request, asked.Correct) else place).mkdir(parents=True, exist_ok=True)
        names = {"report": f"{request.run}.html", "correct": f"{made}/{PARAMETERS}"}
        words += ["--out", str(place / names.get(request.kind, str(made)))]
    return Command((*words, *_common_options(state)), arm, False, made or request.run, (), LEASE_SECONDS)


def _judgement(db: Database, state: Path, request: asked.Judge) -> Command:
    run = known_run(db, request.run)
    if run["arm"] != request.arm:
        raise UsageError(f"the run {request.run} is about the arm {run['arm']}, not {request.arm}")
    accepted = accepted_set(state, request.arm, request.against)[1] / PARAMETERS
    words = ["compare", str(accepted), str(run_folder(db, state, request.run)), "--keep"]
    return Command((*words, *_common_options(state)), request.arm, False, request.run, (), LEASE_SECONDS)


def _recordings(db: Database, state: Path, references: Sequence[asked.RecordingReference]) -> list[str]:
    return [f"{_recording(db, state, one)}{range_words(one)}" for one in references]


def _recording(db: Database, state: Path, one: asked.RecordingReference) -> Path:
    return run_file(db, state, one.run, one.name or recording_name(db, one.run))


def _as_described(db: Database, state: Path, references: Sequence[asked.RecordingReference]) -> list[str]:
    """Return paths as `_recordings` does, for commands that take no columns file.

    Raises:
        UsageError: a recording came with one.
    """
    if _columns(db, state, references):
        raise UsageError(
            "a recording that came with a columns file can be identified from only; for this, say how its "
            "columns are laid out in the arm's description, and upload it without"
        )
    return _recordings(db, state, references)


def _columns(db: Database, state: Path, references: Sequence[asked.RecordingReference]) -> list[str]:
    """Return `--columns` options for the uploaded recordings that came with a columns file."""
    files = {_recording(db, state, one): run_folder(db, state, one.run) / COLUMNS for one in references}
    return [f"--columns={recording}={columns}" for recording, columns in files.items() if columns.is_file()]


def range_words(reference: asked.RecordingReference) -> str:
    """Format a recording's range as `@START:END` [s], an open side empty; an empty text for a whole recording."""
    if reference.start is None and reference.end is None:
        return ""
    return "@" + ":".join("" if seconds is None else f"{seconds:.9f}" for seconds in (reference.start, reference.end))


def _options(request: asked.AnyJobRequest, **others: str) -> list[str]:
    """Return a request's values as options, each in one word, so that no value can pass for an option.

    Args:
        request: request whose fields named in `_OPTIONS` become options.
        others: options of further fields, or of the same.
    """
    words = list[str]()
    for name, value in request:
        option = others.get(name, name if name in _OPTIONS else "").replace("_", "-")
        if option and value is not None and value is not False:
            each = value if isinstance(value, tuple) else (value,)
            words += [f"--{option}" if one is True else f"--{option}={one}" for one in each]
    return words


def _common_options(state: Path) -> tuple[str, ...]:
    return ("--json", "--with-text", "--state", str(state))
