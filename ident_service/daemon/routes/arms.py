"""Serve the routes about arms: descriptions, faults, acceptances, pause and resume, challenge, motions, deletion.

Modules that compute with mechanisms are imported only in the request, so that the service starts without them.
"""

from __future__ import annotations

from base64 import b64decode
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field

from ident_service.config.load import load_arm
from ident_service.config.simulation import SimulatedDriver
from ident_service.config.yaml_source import MOST_BYTES
from ident_service.daemon import responses as answers
from ident_service.daemon.authentication import CHALLENGE_SECONDS
from ident_service.daemon.dependencies import Operator, Service, Serving, Viewer
from ident_service.daemon.errors import api_router, failures
from ident_service.daemon.jobs.requests import ArmName, FileName, Id, RequestBody
from ident_service.daemon.routes.jobs import without_paths
from ident_service.errors import DriverError, MotionRefused, UsageError
from ident_service.model.arm_model import arm_model
from ident_service.motion.command_channel import controlling_pid
from ident_service.operations import deletion
from ident_service.operations.acceptance import accept, acceptances, rollback
from ident_service.operations.description_process import describe_apart, draw_apart, judge_apart
from ident_service.operations.moving_arms import Asked, control_problem
from ident_service.registry import arms as known
from ident_service.registry import motions
from ident_service.registry.database import LONGEST_NOTE, note
from ident_service.registry.runs import run_folder
from ident_service.registry.state_folder import arm_fault_store, control_path

router = api_router("arms", 404)
Text = Annotated[str, Field(max_length=known.MOST_BYTES)]
Note = Annotated[str, Field(min_length=1, max_length=LONGEST_NOTE)]


class Description(RequestBody):
    """Description of an arm as YAML, and the files that it names, by name."""

    description: Annotated[str, Field(max_length=MOST_BYTES)]
    files: Annotated[dict[FileName, Text], Field(max_length=16)] = {}  # noqa: RUF012 - pydantic copies it


class Support(RequestBody):
    """Confirmation that the arm is supported or home: its name, typed by a person who sees it."""

    confirm: Annotated[str, Field(max_length=200)]


class NewArm(Description):
    """Description of an arm to be stored.

    `replace` says that it may take the place of another one of its name; without it that is answered 409. `meshes` are
    files that its URDF names, by the last part of their names: STL, OBJ or DAE in base 64, which only viewers draw.
    """

    replace: bool = False
    meshes: Annotated[dict[FileName, str], Field(max_length=64)] = {}  # noqa: RUF012 - pydantic copies it


class MotionUpload(RequestBody):
    """Motion for an arm: the content of a `motion.json`."""

    arm: ArmName
    motion: Annotated[str, Field(max_length=4 * 2**20)]


class Acceptance(RequestBody):
    """Decision of a person that the parameters of a run are the arm's."""

    run: Id
    note: Note


class Rollback(RequestBody):
    """Decision of a person to return to an earlier set; the one before the current set if `to` is left out."""

    note: Note
    to: Annotated[int, Field(ge=1, lt=10_000)] | None = None


class DescriptionAnswer(BaseModel):
    """Description without mistakes.

    `objections` say why the arm cannot be moved, each with line and column; `good` is whether there are none. `stable`
    is of the gains, null where they or limits are missing; `text` is all of it for a person.
    """

    arm: str
    sha256: str
    good: bool
    stable: bool | None
    objections: list[str]
    text: str


class HomeJoint(BaseModel):
    """One joint of the posture in which an arm is zeroed: its position [rad or m], and the unit of that."""

    joint: str
    position: float
    unit: Literal["rad", "m"]


class NewDescription(RequestBody):
    """URDF of an arm, by name, with its meshes: each file's content in base 64. The arm gets `name`."""

    name: ArmName
    urdf: FileName
    files: Annotated[dict[FileName, str], Field(min_length=1, max_length=64)]


class NewDescriptionAnswer(BaseModel):
    """First description of an arm, to be read and corrected: `guessed` says what the URDF did not tell.

    `files` are those that it names; they are sent with it when the arm is added.
    """

    description: str
    files: dict[str, str]
    guessed: list[str]


@router.get("/arms")
def list_arms(service: Serving, _: Viewer) -> list[answers.ArmLine]:
    """List all arms by name."""
    return [answers.ArmLine(**row) for row in known.arm_names(service.db)]


@router.post("/arms", status_code=201, responses=failures(409))
def add_arm(service: Serving, who: Operator, body: NewArm) -> answers.AddedArmAnswer:
    """Add an arm by its description; another one of its name is refused unless `replace`, the same one changes nothing.

    It may be one that can be identified and not moved; `objections` say why it cannot.
    """
    text, files = body.description, body.files
    judged: dict[str, Any] = {}
    with service.checks.slot(), TemporaryDirectory(prefix="ident-meshes-") as place:
        write_files(Path(place), body.meshes)
        added = known.add_arm(
            *(service.db, service.state, text, files, who.name),
            replace=body.replace,
            check_description=lambda path: judged.update(judge_apart(path)),
            make_meshes=(lambda path, out: draw_apart(path, Path(place), out)) if body.meshes else None,
        )
    return answers.AddedArmAnswer(**_arm(service, added.name).model_dump(), objections=judged.get("objections"))


def write_files(folder: Path, files: dict[str, str]) -> None:
    """Write files, given as name to base 64 text, into a folder.

    Raises:
        UsageError: the content of one is not base 64.
    """
    for name, content in files.items():
        try:
            (folder / name).write_bytes(b64decode(content, validate=True))
        except ValueError:
            raise UsageError(f"{name!r}: its content is not base 64") from None


@router.get("/arms/{arm}")
def get_arm(service: Serving, _: Viewer, arm: ArmName) -> answers.ArmAnswer:
    """Show an arm: its description, who moves it, its faults, what was accepted."""
    return _arm(service, arm)


@router.post("/arms/{arm}/challenge", status_code=201)
def challenge(service: Serving, who: Operator, arm: ArmName) -> answers.ChallengeAnswer:
    """Make a challenge: a word that, with the arm's typed name, confirms one motion of the arm, once."""
    name = known.known_arm(service.db, service.state, arm).name
    return answers.ChallengeAnswer(
        arm=name, challenge=service.authenticator.challenge(name, who.name), seconds=CHALLENGE_SECONDS
    )


@router.get("/arms/{arm}/faults")
def list_faults(service: Serving, _: Viewer, arm: ArmName) -> list[answers.FaultAnswer]:
    """List the faults of an arm that nobody has acknowledged, the earliest first."""
    return _faults(service, known.known_arm(service.db, service.state, arm).name)


@router.post("/arms/{arm}/faults/{code}/ack")
def acknowledge(service: Serving, who: Operator, arm: ArmName, code: Id) -> answers.FaultAnswer:
    """Acknowledge a fault by its code; return its cause and when it arose."""
    name = known.known_arm(service.db, service.state, arm).name
    file = arm_fault_store(service.state, name)
    since = {one.code: one.since for one in file.remembered()}
    cause = file.acknowledge(code)
    note(service.db, who.name, "fault acknowledged", name, code=code, cause=cause)
    return answers.FaultAnswer(code=code, cause=cause, since=since[code])


@router.post("/arms/{arm}/pause")
def pause(service: Serving, who: Operator, arm: ArmName) -> answers.AskedAnswer:
    """Pause the motion of an arm, whose lease is to be renewed meanwhile; return whether a process has the arm."""
    return _ask(service, who.name, arm, "pause")


@router.post("/arms/{arm}/resume")
def resume(service: Serving, who: Operator, arm: ArmName) -> answers.AskedAnswer:
    """Resume the paused motion of an arm; return whether a process has the arm."""
    return _ask(service, who.name, arm, "resume")


@router.post("/arms/{arm}/finish")
def finish(service: Serving, who: Operator, arm: ArmName) -> answers.AskedAnswer:
    """Finish a run early: the arm goes straight back if that way is free; return whether a process has the arm."""
    return _ask(service, who.name, arm, "finish")


@router.post("/arms/{arm}/supported")
def supported(service: Serving, who: Operator, arm: ArmName, body: Support) -> answers.AskedAnswer:
    """Confirm that the held arm is supported or home, so that it is let down; return whether a process has the arm."""
    name = known.known_arm(service.db, service.state, arm).name
    if body.confirm != name:
        raise MotionRefused(f"confirm that {name} is supported by its name, typed by a person who sees it")
    return _ask(service, who.name, name, "supported")


@router.get("/arms/{arm}/acceptances")
def list_acceptances(service: Serving, _: Viewer, arm: ArmName) -> list[answers.AcceptanceAnswer]:
    """List the accepted sets of an arm, the earliest first; the last one is current."""
    name = known.known_arm(service.db, service.state, arm).name
    return [answers.AcceptanceAnswer(**asdict(act)) for act in acceptances(service.state, name)]


@router.post("/arms/{arm}/acceptances", status_code=201)
def accept_run(service: Serving, who: Operator, arm: ArmName, body: Acceptance) -> answers.AcceptanceAnswer:
    """Make the parameters of a run of this arm its accepted set."""
    name = known.known_arm(service.db, service.state, arm).name
    folder = run_folder(service.db, service.state, body.run)
    act = accept(service.db, service.state, folder, body.note, who.name, arm=name)
    return answers.AcceptanceAnswer(**asdict(act))


@router.post("/arms/{arm}/rollback", status_code=201)
def roll_back(service: Serving, who: Operator, arm: ArmName, body: Rollback) -> answers.AcceptanceAnswer:
    """Make an earlier accepted set the current one again."""
    name = known.known_arm(service.db, service.state, arm).name
    return answers.AcceptanceAnswer(**asdict(rollback(service.db, service.state, name, body.note, who.name, body.to)))


@router.get("/motions", responses=answers.PAGES)
def list_motions(
    page: answers.Page,
    service: Serving,
    _: Viewer,
    arm: ArmName | None = None,
    before: answers.BeforeId = None,
    most: answers.Most = 500,
) -> list[answers.MotionAnswer]:
    """List motions, or those of an arm, the newest first."""
    found = page(most, lambda n: motions.motions(service.db, arm, before=before, most=n))
    return [answers.MotionAnswer(**row) for row in found]


@router.post("/motions", status_code=201)
def add_motion(service: Serving, who: Operator, body: MotionUpload) -> answers.MotionAnswer:
    """Upload a motion that was designed elsewhere; preflight judges it like any other."""
    arm = known.known_arm(service.db, service.state, body.arm)
    joints = arm_model(arm.config).chain.joints
    return answers.MotionAnswer(
        **motions.add_motion(service.db, service.state, arm.name, body.motion, who.name, joints)
    )


@router.get("/motions/{motion}")
def get_motion(service: Serving, _: Viewer, motion: Id) -> answers.MotionAnswer:
    """Show a motion: its arm, duration and hash."""
    return answers.MotionAnswer(**motions.known_motion(service.db, motion))


@router.delete("/motions/{motion}", responses=failures(404, 409))
def delete_motion(
    service: Serving, who: Operator, motion: Id, anyway: answers.Anyway = False
) -> answers.DeletionAnswer:
    """Delete a motion, if nothing refers to it or with `anyway`; runs keep their copy of it."""
    return answers.deletion_answer(
        motion, deletion.delete_motion(service.db, service.state, motion, who.name, anyway=anyway)
    )


@router.delete("/arms/{arm}", responses=failures(404, 409))
def delete_arm(service: Serving, who: Operator, arm: ArmName, anyway: answers.Anyway = False) -> answers.DeletionAnswer:
    """Delete an uploaded arm; one with motions, runs, schedules or acceptances only with `anyway`, these with it."""
    return answers.deletion_answer(arm, deletion.delete_arm(service.db, service.state, arm, who.name, anyway=anyway))


@router.post("/descriptions/new")
def describe(service: Serving, _: Operator, body: NewDescription) -> NewDescriptionAnswer:
    """Return a first description of an arm, written from its URDF and meshes; nothing is kept."""
    if body.urdf not in body.files:
        raise UsageError(f"{body.urdf!r} is not among the files; send the URDF with its meshes")
    with service.checks.slot(), TemporaryDirectory(prefix="ident-new-") as place:
        write_files(Path(place), body.files)
        return NewDescriptionAnswer(**describe_apart(Path(place) / body.urdf, body.name))


@router.post("/descriptions/check")
def check(service: Serving, _: Operator, body: Description) -> DescriptionAnswer:
    """Check a description without keeping it; its mistakes are answered with line and column."""
    with service.checks.slot(), known.temporary_upload(service.state, body.description, body.files) as path:
        load_arm(path, upload=True)  # finds most mistakes, without a process
        return DescriptionAnswer(**judge_apart(path))


@router.get("/arms/{arm}/home")
def get_home(service: Serving, _: Viewer, arm: ArmName) -> list[HomeJoint]:
    """Show the home position of each joint, in which an arm must stand for set-home; refused where none is needed."""
    from ident_service.operations.recovery import home_posture

    return [HomeJoint(**asdict(one)) for one in home_posture(known.known_arm(service.db, service.state, arm).config)]


def _arm(service: Service, arm: str) -> answers.ArmAnswer:
    found = known.known_arm(service.db, service.state, arm)
    acts = acceptances(service.state, found.name)
    config, problem = found.config, shown_control_problem(service, found.name)
    try:
        faults = _faults(service, found.name)
    except DriverError:
        if problem is None:
            raise
        faults = None
    return answers.ArmAnswer(
        name=found.name,
        source="shipped" if found.source == "shipped" else "uploaded",
        description=config.description,
        sha256=config.sha256,
        joints=list(config.joints) or list(arm_model(config).chain.names),
        simulated=isinstance(config.driver, SimulatedDriver),
        unattended_motion=config.unattended_motion,
        resources=list(known.resources(config)),
        moved_by=controlling_pid(control_path(service.state, found.name)),
        control_problem=problem,
        faults=faults,
        accepted=answers.AcceptanceAnswer(**asdict(acts[-1])) if acts else None,
    )


def _faults(service: Service, arm: str) -> list[answers.FaultAnswer]:
    return [answers.FaultAnswer(**asdict(one)) for one in arm_fault_store(service.state, arm).remembered()]


def shown_control_problem(service: Service, arm: str) -> str | None:
    """Return the `control_problem` of an arm as others may read it, without paths of this machine."""
    problem = control_problem(service.state, arm)
    return None if problem is None else str(without_paths(problem, str(service.state)))


def _ask(service: Service, who: str, arm: str, asked: Asked) -> answers.AskedAnswer:
    name = known.known_arm(service.db, service.state, arm).name
    return answers.AskedAnswer(arm=name, asked=asked, reached=service.engine.ask(name, asked, who))
