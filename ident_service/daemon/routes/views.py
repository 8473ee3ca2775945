"""Serve arms and motions as what viewers in three dimensions need: solids, joints, positions over time, clearance.

The last few documents are kept, since a page is often loaded again; one is computed at a time. What computes them is
imported when the first is asked for, so that the service starts without.
"""

from __future__ import annotations

import json
import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Annotated, Any, Final, Literal

from fastapi import APIRouter, Query, Request, Response
from pydantic import BaseModel

from ident_service.config.load import arm_from_json, load_recording_format
from ident_service.daemon.dependencies import Serving, Viewer
from ident_service.daemon.errors import failures, operation_id
from ident_service.daemon.jobs.requests import ArmName, FileName, Id
from ident_service.daemon.live import ARM
from ident_service.errors import UnknownId, UsageError
from ident_service.registry import arms as known
from ident_service.registry import motions, runs
from ident_service.results.manifest import file_sha256

router = APIRouter(
    prefix="/api/v1", tags=["views"], responses=failures(404, 409), generate_unique_id_function=operation_id
)
_KEPT: Final = 16
_MOST_BYTES: Final = 256 * 2**20  # of a recording: half a minute of reading
OWN: Final = "own"
Numbers = list[float]
Speed = Annotated[float, Query(gt=0.0, le=1.0)]


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


class ViewedFigure(BaseModel):
    """Arm with its surroundings; `up` is the direction against gravity, `home` a position of all joints."""

    arm: str
    joints: list[ViewedJoint]
    bodies: list[ViewedSolid]
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


class Views:
    """Documents that were asked for last, by what they are made of; may be used from any thread."""

    def __init__(self) -> None:
        self._lock, self._kept = threading.Lock(), OrderedDict[tuple[str, ...], str]()

    def document(self, key: tuple[str, ...], make: Callable[[], dict[str, Any]]) -> str:
        """Return the JSON of what `make` returns, made only if the key is new."""
        with self._lock:  # one at a time: distances of bodies are what costs
            if (found := self._kept.get(key)) is None:
                found = self._kept[key] = json.dumps(make(), allow_nan=False)
                while len(self._kept) > _KEPT:
                    self._kept.popitem(last=False)
            self._kept.move_to_end(key)
            return found


@router.get("/arms/{arm}/view", response_model=ViewAnswer)
def view_arm(
    service: Serving, _: Viewer, request: Request, arm: ArmName, motion: Id | None = None, speed: Speed = 1.0
) -> Response:
    """Show an arm along a motion, the description's `own` or one by its id; without any, at home."""
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

    return _answer(request, key, make)


@router.get("/runs/{run}/view", response_model=ViewAnswer)
def view_run(service: Serving, _: Viewer, request: Request, run: Id, name: FileName | None = None) -> Response:
    """Show the arm of a run as it was measured in the run's recording, the first or one by its name."""
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

    return _answer(request, (config.sha256, sha256), make)


def _answer(request: Request, key: tuple[str, ...], make: Callable[[], dict[str, Any]]) -> Response:
    return Response(request.app.state.views.document(key, make), media_type="application/json")
