"""Mark jobs as interrupted after the service died, with what their files show.

A restart begins no motion: a person asked for it at another moment. Queued computations stay queued.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from ident_service.daemon.jobs.child_process import PROCESS, alive, end_orphan
from ident_service.daemon.jobs.commands import JOBS
from ident_service.daemon.jobs.outcome import interrupted, said
from ident_service.daemon.jobs.registration import folder_of, keep
from ident_service.errors import IdentError
from ident_service.motion.control_file import in_use
from ident_service.operations.arm_state import control_path
from ident_service.registry import jobs as rows
from ident_service.registry.audit import note
from ident_service.registry.database import Database, Row

UNTOLD = "the service died while it ran; its process is being looked for"
_WAIT = 40.0  # s for a process of the previous service: a controlled stop and its recording take less


def mark_interrupted(db: Database, state: Path) -> None:
    """Mark running jobs and waiting motions as interrupted; quick, before any request is answered."""
    with db.transaction():
        for row in rows.jobs(db, states=rows.LIVE, most=1_000_000):
            if row["state"] == "running":
                detail = UNTOLD
            elif row["motion"]:
                detail = "the service ended before it began; nothing has moved, ask for it again"
            else:
                continue
            rows.ended(db, row["id"], "interrupted", detail)
            note(db, "service", "job interrupted", row["id"])


def explain_interrupted(db: Database, state: Path, cut_short: Callable[[], bool] = lambda: False) -> None:
    """Wait until processes of the previous service have ended, and enter what their files show."""
    for row in rows.jobs(db, states=("interrupted",), most=1_000_000):
        if row["detail"] != UNTOLD or cut_short():
            continue
        process = _process(state, row)
        # A motion has seen the end of its input and stops its arm; a computation is of no use to anybody.
        if not end_orphan(process, _WAIT):
            rows.explain(db, row["id"], f"the service died while it ran; its process lives on ({process.split()[0]})")
            continue
        if row["motion"]:
            _wait_for_rest(control_path(state, row["arm"]))
        folder = folder_of(state, row)
        detail = interrupted(said(state / JOBS / row["id"]), folder, moves=bool(row["motion"]))
        try:
            keep(db, state, row, row["created_by"])
        except (IdentError, OSError) as error:
            detail = f"{detail}; its folder could not be entered: {error}"
        rows.explain(db, row["id"], detail)


def orphans(db: Database, state: Path) -> list[str]:
    """Return the ids of interrupted jobs whose process is still alive."""
    found = rows.jobs(db, states=("interrupted",), most=1000)
    return [row["id"] for row in found if alive(_process(state, row))]


def _wait_for_rest(controls: Path) -> None:
    """Wait for the motion process, which may outlive its parent for as long as its stop takes."""
    until = time.monotonic() + _WAIT
    while in_use(controls) and time.monotonic() < until:
        time.sleep(0.05)


def _process(state: Path, row: Row) -> str:
    if row["process"]:
        return str(row["process"])
    try:
        return (state / JOBS / str(row["id"]) / PROCESS).read_text(encoding="ascii").strip()
    except (OSError, ValueError):
        return ""
