"""Serve the routes that delete runs, motions and arms; entries in use are deleted only with `anyway`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Annotated

from fastapi import APIRouter, Query

from ident_service.daemon.dependencies import Operator, Serving
from ident_service.daemon.errors import failures, operation_id
from ident_service.daemon.jobs.requests import ArmName, Id
from ident_service.daemon.responses import DeletionAnswer, DependentAnswer
from ident_service.errors import Dependent
from ident_service.operations import deletion

router = APIRouter(prefix="/api/v1", responses=failures(404, 409), generate_unique_id_function=operation_id)
Anyway = Annotated[bool, Query(description="although something refers to it; 409 names what, and what becomes of it")]


@router.delete("/runs/{run}", tags=["runs"])
def delete_run(service: Serving, who: Operator, run: Id, anyway: Anyway = False) -> DeletionAnswer:
    """Delete a run with its recordings and its report."""
    return _answer(run, deletion.delete_run(service.db, service.state, run, who.name, anyway=anyway))


@router.delete("/motions/{motion}", tags=["arms"])
def delete_motion(service: Serving, who: Operator, motion: Id, anyway: Anyway = False) -> DeletionAnswer:
    """Delete a motion; runs keep their copy of it."""
    return _answer(motion, deletion.delete_motion(service.db, service.state, motion, who.name, anyway=anyway))


@router.delete("/arms/{arm}", tags=["arms"])
def delete_arm(service: Serving, who: Operator, arm: ArmName, anyway: Anyway = False) -> DeletionAnswer:
    """Delete an uploaded arm, and with it its motions, runs, schedules and acceptances."""
    return _answer(arm, deletion.delete_arm(service.db, service.state, arm, who.name, anyway=anyway))


def _answer(name: str, found: Sequence[Dependent]) -> DeletionAnswer:
    return DeletionAnswer(deleted=name, dependents=[DependentAnswer(**asdict(one)) for one in found])
