"""Serve the routes that check or begin a description without storing it, and show an arm's home posture.

Modules that compute with mechanisms are imported only in the request, so that the service starts without them.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Literal

from fastapi import APIRouter
from pydantic import BaseModel, ConfigDict, Field

from ident_service.config.load import load_arm
from ident_service.daemon.dependencies import Operator, Serving, Viewer
from ident_service.daemon.errors import failures, operation_id
from ident_service.daemon.jobs.requests import ArmName, FileName
from ident_service.daemon.routes.arms import Description, write_files
from ident_service.errors import UsageError
from ident_service.operations.description_process import describe_apart, judge_apart
from ident_service.registry.arms import known_arm, uploaded

router = APIRouter(prefix="/api/v1", tags=["arms"], responses=failures(404), generate_unique_id_function=operation_id)


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


class NewDescription(BaseModel):
    """URDF of an arm, by name, with its meshes: each file's content in base 64. The arm gets `name`."""

    model_config = ConfigDict(extra="forbid")
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


@router.post("/descriptions/new")
def describe(service: Serving, _: Operator, body: NewDescription) -> NewDescriptionAnswer:
    """Write a first description of an arm from its URDF and meshes; nothing is kept."""
    if body.urdf not in body.files:
        raise UsageError(f"{body.urdf!r} is not among the files; send the URDF with its meshes")
    with service.checks.place(), TemporaryDirectory(prefix="ident-new-") as place:
        write_files(Path(place), body.files)
        return NewDescriptionAnswer(**describe_apart(Path(place) / body.urdf, body.name))


@router.post("/descriptions/check")
def check(service: Serving, _: Operator, body: Description) -> DescriptionAnswer:
    """Check a description without keeping it; its mistakes are answered with line and column."""
    with service.checks.place(), uploaded(service.state, body.description, body.files) as path:
        load_arm(path, upload=True)  # finds most mistakes, without a process
        return DescriptionAnswer(**judge_apart(path))


@router.get("/arms/{arm}/home")
def get_home(service: Serving, _: Viewer, arm: ArmName) -> list[HomeJoint]:
    """Show the posture in which an arm must stand when it is zeroed; refused for other arms."""
    from ident_service.operations.recovery import home_posture

    return [HomeJoint(**asdict(one)) for one in home_posture(known_arm(service.db, service.state, arm).config)]
