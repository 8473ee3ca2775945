"""Collect what pages show of a re-identification: its steps with their jobs, and the findings of its comparison.

The registry's text is the verdict that was concluded. The comparison in the run's folder has the same content in more
detail; it is shown only if the manifest names it with its hash, and if it leads to that same text.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

from ident_service.errors import IdentError
from ident_service.operations.drift_verdict import verdict_of
from ident_service.registry import runs
from ident_service.registry.database import Database, Row
from ident_service.results.manifest import file_sha256

TITLES: Final = {"check": "Check", "run": "Run", "identify": "Identify", "judge": "Compare"}
WORDS: Final = {
    "check": "preflight; the arm moves a little",
    "run": "the arm moves along the motion and is recorded",
    "identify": "its parameters, by the description that was accepted",
    "judge": "against the accepted set",
}
MOVES: Final = frozenset({"check", "run"})
DOCUMENT, PAGE = "comparison.json", "comparison.html"  # as `ident compare --keep` writes them
_VERDICTS = ("unchanged", "changed", "impossible")
_MOST_BYTES = 16 * 2**20

StepState = Literal["done", "busy", "open", "ended"]


@dataclass(frozen=True)
class Step:
    """One step of a re-identification.

    Attributes:
        key: one of `TITLES`.
        title: for people.
        words: description of the step.
        state: `ended` where the whole ended badly.
        job: id of its job; None where it has none yet, or was done at a terminal.
    """

    key: str
    title: str
    words: str
    state: StepState
    job: str | None


@dataclass(frozen=True)
class Finding:
    """One change that a comparison has found.

    Attributes:
        what: and of which joint or link.
        joint: the one whose torque changes most for its size; may be empty.
        sigma: size of the change in standard deviations.
        size: how much, in words; may be empty.
        meaning: what it may mean.
    """

    what: str
    joint: str
    sigma: float
    size: str
    meaning: str


@dataclass(frozen=True)
class Compared:
    """Comparison that a verdict was concluded from.

    Attributes:
        folder: of the run that keeps it.
        findings: what has changed.
        errors: torque error on the new recording with the accepted parameters and with its own [%]; None if unknown.
    """

    folder: Path
    findings: tuple[Finding, ...]
    errors: tuple[float, float] | None


def steps(db: Database, row: Row) -> tuple[Step, ...]:
    """Return the steps of a re-identification, in order.

    Args:
        db: the registry.
        row: of the re-identification.
    """
    made = _jobs(db, row) if row["job"] is not None else {}
    order = list(TITLES)
    at = order.index(row["step"])
    here: StepState = "busy" if row["state"] == "running" else "done" if row["state"] in _VERDICTS else "ended"
    states: list[StepState] = ["done" if place < at else here if place == at else "open" for place in range(len(order))]
    return tuple(
        Step(key, TITLES[key], WORDS[key], state, made.get(key)) for key, state in zip(order, states, strict=True)
    )


def compared(db: Database, state: Path, run: str | None, words: str) -> Compared | None:
    """Return the comparison that these words were concluded from; None if it is missing or was replaced.

    Args:
        db: the registry.
        state: the state folder.
        run: id of the run with the parameters.
        words: what was concluded, as the registry has it.
    """
    try:
        named = {} if run is None else runs.run_files(db, state, run)
        if run is None or not {DOCUMENT, PAGE} <= set(named):
            return None
        folder = runs.run_folder(db, state, run)
        if (folder / DOCUMENT).stat().st_size > _MOST_BYTES:
            return None
        if any(file_sha256(folder / name) != named[name] for name in (DOCUMENT, PAGE)):
            return None
        document = json.loads((folder / DOCUMENT).read_bytes())
        return _told(folder, document["compared"][0]) if verdict_of(document).words == words else None
    except (IdentError, OSError, ValueError, LookupError, TypeError):
        return None


def _told(folder: Path, pair: dict[str, Any]) -> Compared:
    found = [Finding(one["what"], one["joint"], one["sigma"], one["size"], one["meaning"]) for one in pair["findings"]]
    errors = pair["torque_error_percent"]
    both = None if errors is None else (float(errors["reference"]["whole"]), float(errors["own"]["whole"]))
    return Compared(folder, tuple(found), both)


def _jobs(db: Database, row: Row) -> dict[str, str]:
    """Return the job id of each step that has a job, by the step's key.

    A step's job is found by the run that it made. A check makes none: it is the one whose creation time is nearest to
    the beginning of the re-identification.
    """
    found = {
        key: job["id"]
        for key, made in (("run", row["recorded"]), ("identify", row["run"]), ("judge", row["run"]))
        if made is not None
        and (job := db.row("SELECT id FROM jobs WHERE kind = ? AND run = ? ORDER BY number DESC LIMIT 1", key, made))
    }
    check = db.row(
        "SELECT id FROM jobs WHERE kind = 'check' AND arm = ? AND created_by = ? ORDER BY ABS(created - ?) LIMIT 1",
        *(row["arm"], row["begun_by"], row["begun"]),
    )
    return {**({} if check is None else {"check": check["id"]}), **found, row["step"]: row["job"]}
