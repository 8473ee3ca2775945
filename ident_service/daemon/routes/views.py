"""Serve arms and motions as what viewers in three dimensions need: solids, joints, positions over time, clearance.

The last few documents are kept, since a page is often loaded again; one is computed at a time. What computes them is
imported when the first is asked for, so that the service starts without.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Annotated, Any, Final, Literal

from fastapi import Path as PathParameter
from fastapi import Query, Request, Response
from pydantic import BaseModel

from ident_service.config.arm import ArmConfig
from ident_service.config.load import arm_from_json, load_recording_format
from ident_service.daemon.dependencies import Service, Serving, Viewer
from ident_service.daemon.errors import api_router
from ident_service.daemon.jobs.requests import ArmName, FileName, Id
from ident_service.daemon.live import ARM
from ident_service.errors import UnknownId, UsageError
from ident_service.registry import arms as known
from ident_service.registry import motions, runs
from ident_service.results.manifest import file_sha256

router = api_router("views", 404, 409)
_MOST_BYTES: Final = 256 * 2**20  # of a recording: half a minute of reading
OWN: Final = "own"
Numbers = list[float]
Speed = Annotated[float, Query(gt=0.0, le=1.0)]
ShortHash = Annotated[str, PathParameter(pattern=r"^[0-9a-f]{16}$")]
JointNumber = Annotated[int, PathParameter(ge=-1, lt=256)]
_BINARY: Final[dict[int | str, dict[str, Any]]] = {
    200: {"content": {"application/octet-stream": {}}, "description": "The triangles."},
}


class ViewedJoint(BaseModel):
    """Joint in its parent's frame at zero: rotation row by row, translation [m], axis in its own frame.

    `parent` is the number of the joint that carries it, -1 for the base.
    """

    name: str
    parent: int
    revolute: bool
    axis: Numbers
    rotation: Numbers
    translation: Numbers


class ViewedSolid(BaseModel):
    """Solid that stands still in the frame of a joint, or of the base where `joint` is -1; lengths in m.

    A capsule has `start`, `end`, `radius`; a box `center`, `rotation`, `half`; a cylinder, about its own z axis,
    `center`, `rotation`, `radius`, `half_length`; a half space, all x with normal . x < offset, `normal`, `offset`.
    """

    owner: str
    joint: int
    shape: Literal["capsule", "box", "cylinder", "half_space"]
    start: Numbers | None = None
    end: Numbers | None = None
    center: Numbers | None = None
    rotation: Numbers | None = None
    half: Numbers | None = None
    radius: float | None = None
    half_length: float | None = None
    normal: Numbers | None = None
    offset: float | None = None


class ViewedMesh(BaseModel):
    """Triangles to draw instead of the solids of a joint, or of the base where `joint` is -1.

    `source` answers with them, in the frame of the joint [m]: nine 32-bit floats each, little-endian. Distances are
    those of the solids.
    """

    owner: str
    joint: int
    triangles: int
    source: str


class ViewedFigure(BaseModel):
    """Arm with its surroundings; `up` is the direction against gravity, `home` a position of all joints."""

    arm: str
    joints: list[ViewedJoint]
    bodies: list[ViewedSolid]
    meshes: list[ViewedMesh]
    surroundings: list[ViewedSolid]
    up: Numbers
    home: Numbers


class ViewedPhase(BaseModel):
    """Part of a motion, and when it begins [s]."""

    name: str
    begin: float


class ViewedDistance(BaseModel):
    """Smallest distance [m] at each sample, and the number of the pair that has it."""

    distance: Numbers
    pair: list[int]


class ViewedClearance(BaseModel):
    """Smallest distances of bodies that must stay apart, at some of the samples: within the arm, to its surroundings.

    Either is left out where there are no such pairs.
    """

    samples: list[int]
    pairs: list[str]
    itself: ViewedDistance | None = None
    surroundings: ViewedDistance | None = None


class ViewAnswer(BaseModel):
    """Arm along a motion: time [s], and per joint its position [rad or m] at these times."""

    figure: ViewedFigure
    time: Numbers
    position: list[Numbers]
    phases: list[ViewedPhase]
    clearance: ViewedClearance | None
    notes: list[str]


@router.get("/arms/{arm}/view", response_model=ViewAnswer)
def view_arm(
    service: Serving, _: Viewer, request: Request, arm: ArmName, motion: Id | None = None, speed: Speed = 1.0
) -> Response:
    """Return what a viewer draws: an arm along a motion (its id, or `own`: the description's), or just its figure."""
    config = known.known_arm(service.db, service.state, arm).config
    path = None
    if motion is not None and motion != OWN:
        if motions.known_motion(service.db, motion)["arm"] != arm:
            raise UnknownId(f"the motion {motion} is of another arm than {arm}")
        path = motions.motion_path(service.db, service.state, motion)
    key = (config.sha256, str(motion), repr(speed), "" if path is None else file_sha256(path))

    def make() -> dict[str, Any]:
        from ident_service.operations.arm_view import view_at_rest, view_of_motion

        return view_at_rest(config) if motion is None else view_of_motion(config, path, speed)

    return _answer(service, request, config, key, make)


@router.get("/arms/{arm}/meshes/{sha256}/{joint}", response_class=Response, responses=_BINARY)
def get_mesh(service: Serving, _: Viewer, arm: ArmName, sha256: ShortHash, joint: JointNumber) -> Response:
    """Return the triangles of a joint, or of the base (-1), as bytes; a view's `figure.meshes` has the address."""
    triangles = known.mesh_bytes(service.state, arm, sha256, joint)
    return Response(triangles, media_type="application/octet-stream", headers={"Cache-Control": "private, max-age=600"})


@router.get("/runs/{run}/view", response_model=ViewAnswer)
def view_run(service: Serving, _: Viewer, request: Request, run: Id, name: FileName | None = None) -> Response:
    """Return what a viewer draws: the arm of a run as measured in its recording, the first or one by its name."""
    there = [one["name"] for one in runs.recordings(service.db, run) if one["deleted"] is None]
    if name is None and not there:
        raise UnknownId(f"the run {run} has no recording")
    chosen = there[0] if name is None else name
    if chosen not in there:
        raise UnknownId(f"the run {run} has no recording {chosen}")
    path = runs.run_file(service.db, service.state, run, chosen)
    config = arm_from_json(runs.run_file(service.db, service.state, run, ARM))
    if path.stat().st_size > _MOST_BYTES:
        raise UsageError(f"{chosen}: too large to be shown here; download the run and take `ident view`")
    sha256 = runs.run_files(service.db, service.state, run)[chosen]
    columns = path.parent / runs.COLUMNS
    form = load_recording_format(columns) if columns.is_file() else config.recording

    def make() -> dict[str, Any]:
        from ident_service.operations.arm_view import view_of_recording

        return view_of_recording(config, path, form)

    return _answer(service, request, config, (config.sha256, sha256), make)


def _answer(
    service: Service, request: Request, config: ArmConfig, key: tuple[str, ...], make: Callable[[], dict[str, Any]]
) -> Response:
    drawn = known.drawn_meshes(service.state, config)

    def whole() -> dict[str, Any]:
        view = make()
        names = [joint["name"] for joint in view["figure"]["joints"]]
        place = f"/api/v1/arms/{config.name}/meshes/{config.sha256[:16]}"
        view["figure"]["meshes"] = [
            {
                "owner": "base" if joint < 0 else names[joint],
                "joint": joint,
                "triangles": triangles,
                "source": f"{place}/{joint}",
            }
            for joint, triangles in ((int(joint), triangles) for joint, triangles in drawn["joints"].items())
        ]
        view["notes"] = [*view["notes"], *drawn["notes"]]
        return view

    text = request.app.state.views.document((*key, json.dumps(drawn)), whole)
    return Response(text, media_type="application/json")
