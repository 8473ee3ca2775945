"""Serve the pages of runs: table, one run with plots and answers, overlay, comparison, trends; and the audit trail."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from fastapi import APIRouter, Query, Response
from fastapi.responses import HTMLResponse

from ident_service.config.load import arm_from_json
from ident_service.daemon.dependencies import Operator, Service, Serving, Viewer
from ident_service.daemon.jobs.requests import ArmName, Id
from ident_service.daemon.responses import BeforeId
from ident_service.daemon.routes import runs
from ident_service.daemon.routes.about import AUDIT_SECONDS
from ident_service.daemon.web.arm_facts import joint_facts
from ident_service.daemon.web.forms import Form, PageRoute, see_other
from ident_service.daemon.web.render import page
from ident_service.errors import IdentError, UsageError
from ident_service.motion.ending import ENDED
from ident_service.registry import runs as known
from ident_service.registry.arms import known_arm
from ident_service.registry.database import LONGEST_NOTE, Row, audit_log
from ident_service.registry.runs import REPORTS

router = APIRouter(include_in_schema=False, route_class=PageRoute)
# `POLICY` is for a page with an inline style that loads nothing else.
_RUNS: Final = 200  # of one page
_MOST_BYTES: Final = 2**20  # of a run's small documents
_OVERLAID: Final = 4  # runs
_TRENDED: Final = 40  # sets of parameters, the newest
ARM, MOTION, PARAMETERS = "arm.json", "excitation.json", "parameters.json"
POLICY: Final = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'none'; sandbox"


@dataclass(frozen=True)
class IdentifiedSet:
    """Parameters that a run holds, as pages show them.

    Attributes:
        word: verdict on the use of the parameters: `use`, `use with care` or `do not use`.
        line: the verdict in one sentence, after that word.
        reasons: the most important ones.
        further: the others.
        joints: a row per joint, the worst first (`results/assessment.py`).
        expressions: base parameters.
        units: units of the base parameters.
        values: values of the base parameters.
        deviations: standard deviations; None where unknown.
        verdicts: `identified`, `weak` or `unidentified`, of each.
    """

    word: str
    line: str
    reasons: tuple[str, ...]
    further: tuple[str, ...]
    joints: tuple[Any, ...]
    expressions: tuple[str, ...]
    units: tuple[str, ...]
    values: tuple[float, ...]
    deviations: tuple[float | None, ...]
    verdicts: tuple[str, ...]

    @property
    def counts(self) -> dict[str, int]:
        """Return how many base parameters have each verdict."""
        return {word: self.verdicts.count(word) for word in ("identified", "weak", "unidentified")}

    @property
    def rows(self) -> list[tuple[str, str, float, float | None, str]]:
        """Return (expression, unit, value, deviation, verdict) of each base parameter, the least certain first."""

        def certain(row: tuple[str, str, float, float | None, str]) -> tuple[int, float]:
            value, deviation = abs(row[2]), row[3]
            certainty = 0.0 if deviation is None else value / deviation if deviation > 0.0 else math.inf
            return {"unidentified": 0, "weak": 1}.get(row[4], 2), certainty

        return sorted(
            zip(self.expressions, self.units, self.values, self.deviations, self.verdicts, strict=True), key=certain
        )


def identified_set(service: Service, run: str) -> IdentifiedSet | None:
    """Return a run's base parameters with their verdicts; None without a parameter file that can be read."""
    files = known.run_files(service.db, service.state, run)
    if PARAMETERS not in files:
        return None
    try:
        return _identified(known.run_folder(service.db, service.state, run) / PARAMETERS, files[PARAMETERS])
    except IdentError:
        return None  # the job that reads it says why


@lru_cache(maxsize=256)
def _identified(path: Path, sha256: str) -> IdentifiedSet:
    # Imported only when a set is shown, so that the service starts without these modules.
    from ident_service.results.assessment import assess
    from ident_service.results.parameter_file import read_content

    del sha256  # part of the key
    content = read_content(path)
    found, table = assess(content), content["base_parameters"]
    number = len(table["expressions"])
    return IdentifiedSet(
        *(found.word, found.line.partition(": ")[2] or found.line, found.reasons, found.further, found.joints),
        tuple(table["expressions"]),
        tuple(table.get("units", [""] * number)),
        tuple(table["values"]),
        tuple(table.get("standard_deviations", [None] * number)),
        tuple(table.get("verdicts", [""] * number)),
    )


@dataclass(frozen=True)
class RunFacts:
    """Facts of a run that moved an arm, or recorded one.

    Attributes:
        motion: name of the motion; empty where the run does not say.
        length: length of the motion at its own speed [s]; None where unknown.
        speed: share of the motion's own speed; None where unknown.
        driven: how long the control loop drove the arm [s]; None where unknown.
        ended: report of its end (`motion/ending.py`), or `{"error": ...}`; empty for one that was killed or uploaded.
        joints: joints, with units and limits (`JointFacts`) and the peaks of the run: `peak_error` and `peak_torque`.
        recording: name of the recording that can be drawn; None where there is none.
    """

    motion: str
    length: float | None
    speed: float | None
    driven: float | None
    ended: Mapping[str, Any]
    joints: list[dict[str, Any]]
    recording: str | None


def run_facts(service: Service, run: str) -> RunFacts:
    """Return motion, duration, speed, ending, joints and recording of a run, as far as its files tell them."""
    row, folder = known.known_run(service.db, run), known.run_folder(service.db, service.state, run)
    files = known.run_files(service.db, service.state, run)
    ended = _ending(_small(folder / ENDED)) if ENDED in files else {}
    motion, length = "", None
    if MOTION in files:
        from ident_service.excitation.motion_file import read_excitation

        try:
            made = read_excitation(folder / MOTION)
            motion, length = made.name, made.duration
        except IdentError:
            pass  # the manifest names it, so that it can be downloaded and looked at
    job = service.db.row("SELECT request FROM jobs WHERE run = ? AND kind IN ('run', 'rehearse') LIMIT 1", run)
    speed = None if job is None else json.loads(job["request"]).get("speed")
    recordings = [one["name"] for one in known.recordings(service.db, run) if not one["deleted"]]
    return RunFacts(
        motion,
        length,
        speed if isinstance(speed, int | float) else None,
        row["seconds"],
        ended,
        _joints(folder / ARM, ended) if ARM in files else [],
        recordings[0] if recordings and files else None,
    )


def _ending(found: dict[str, Any]) -> dict[str, Any]:
    """Return the parts of a report of a run's end that are what they should be: the run may come from elsewhere."""
    lateness = found.get("lateness")
    parts = {
        "error": str,
        "real_time": str,
        "motion_seconds": float,
        "warnings": dict,
        "peak_following_error": list,
        "peak_torque": list,
    }
    kept = {key: found[key] for key, kind in parts.items() if isinstance(found.get(key), kind)}
    if isinstance(lateness, dict) and all(isinstance(lateness.get(key), int | float) for key in _LATENESS):
        kept["lateness"] = lateness
    return kept


_LATENESS: Final = ("median_below_us", "p999_below_us", "worst_us", "late_or_lost", "count")


def _joints(path: Path, ended: Mapping[str, Any]) -> list[dict[str, Any]]:
    try:
        joints = joint_facts(arm_from_json(path))
    except (IdentError, OSError):
        return []
    for name, key in (("peak_error", "peak_following_error"), ("peak_torque", "peak_torque")):
        peaks = ended.get(key)
        known_peaks = isinstance(peaks, list) and len(peaks) == len(joints)
        for joint, peak in zip(joints, peaks if known_peaks and peaks else [None] * len(joints), strict=True):
            joint[name] = peak if isinstance(peak, int | float) else None
    return joints


def _small(path: Path) -> dict[str, Any]:
    """Read a small JSON object of a run; empty where it is none."""
    try:
        with path.open("rb") as stream:
            found = json.loads(stream.read(_MOST_BYTES))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


@router.get("/runs")
def list_runs(
    service: Serving,
    who: Viewer,
    arm: Annotated[str, Query(max_length=64)] = "",
    kind: Annotated[str, Query(max_length=40)] = "",
    tag: Annotated[str, Query(max_length=40)] = "",
    text: Annotated[str, Query(max_length=200)] = "",
    parameter: Annotated[list[str] | None, Query(max_length=8)] = None,
    before: BeforeId = None,
) -> Response:
    """Show a page of runs, newest first, filtered by arm, kind, tag and text; each base `parameter` is a column."""
    labels = known.run_labels(service.db)
    shown, earlier = list[dict[str, Any]](), before
    while len(shown) < _RUNS:
        found = known.runs(service.db, arm or None, before=earlier, most=_RUNS + 1)
        labelled = ({**row, **known.shown_labels(labels, row["id"])} for row in found[:_RUNS])
        shown += [row for row in labelled if _wanted(row, kind, tag, text)]
        earlier = found[_RUNS - 1]["id"] if len(found) > _RUNS else None
        if earlier is None:
            break
    sets = {row["run"] for row in service.db.rows("SELECT run FROM parameter_sets")}
    for row in shown:
        row["set"] = identified_set(service, row["id"]) if row["id"] in sets else None
    expressions = next((row["set"].expressions for row in shown if row["set"] and arm), ())
    chosen = [one for one in parameter or () if one in expressions]
    for row in shown:
        row["values"] = _values(row["set"], chosen)
    return page(
        "runs",
        who,
        arm=arm,
        runs=shown,
        earlier=earlier,
        arms=[row["arm"] for row in service.db.rows("SELECT DISTINCT arm FROM runs ORDER BY arm")],
        kinds=[row["kind"] for row in service.db.rows("SELECT DISTINCT kind FROM runs ORDER BY kind")],
        tags=sorted({one for row in labels.values() for one in row["tags"]} | ({tag} - {""})),
        filled={"kind": kind, "tag": tag, "text": text},
        expressions=expressions,
        chosen=chosen,
        overlaid=_OVERLAID,
    )


def _wanted(row: Row, kind: str, tag: str, text: str) -> bool:
    words = " ".join((row["id"], row["arm"], row["ending"], row["note"], *row["tags"])).lower()
    return (not kind or row["kind"] == kind) and (not tag or tag in row["tags"]) and text.lower() in words


def _values(found: IdentifiedSet | None, chosen: list[str]) -> list[tuple[float, float | None] | None]:
    """Return value and deviation of the chosen base parameters; None for one that the set does not have."""
    if found is None:
        return [None] * len(chosen)
    places = {expression: k for k, expression in enumerate(found.expressions)}
    return [(found.values[k], found.deviations[k]) if (k := places.get(one)) is not None else None for one in chosen]


@router.get("/runs/{run}")
def show_run(service: Serving, who: Viewer, run: Id) -> Response:
    """Show the page of a run: its facts, parameters, files and report."""
    answer = runs.get_run(service, who, run)
    sets = service.db.rows("SELECT run FROM parameter_sets WHERE arm = ? AND run <> ?", answer.arm, answer.id)
    made = service.db.row("SELECT id FROM jobs WHERE run = ? AND kind <> 'report' ORDER BY number LIMIT 1", answer.id)
    recorded = service.db.rows(
        "SELECT id FROM runs WHERE arm = ? AND id <> ? AND kind IN ('motion', 'recording') "
        "ORDER BY created DESC LIMIT 50",
        *(answer.arm, answer.id),
    )
    return page(
        "run",
        who,
        run=answer,
        facts=run_facts(service, answer.id),
        found=identified_set(service, answer.id),
        job=None if made is None else made["id"],
        reported=_reported(service, answer.id),
        others=[row["run"] for row in sets],
        recorded=recorded,
        longest=LONGEST_NOTE,
    )


def _reported(service: Service, run: str) -> bool:
    """Return whether a run has a report: of a job, or its own."""
    if (service.state / REPORTS / f"{run}.html").is_file():
        return True
    return "report.html" in known.run_files(service.db, service.state, run)


@router.post("/runs/{run}/labels")
def label(service: Serving, who: Operator, run: Id, form: Form) -> Response:
    """Give a run the tags and the note of a form."""
    tags = form.get("tags", "").replace(",", " ").split()
    found = known.label_run(service.db, run, tags, form.get("note", "").replace("\r\n", "\n").strip(), who.name)
    return see_other(f"/runs/{found['run']}#labels")


@router.get("/overlay")
def overlay(service: Serving, who: Viewer, run: Annotated[list[Id] | None, Query(max_length=50)] = None) -> Response:
    """Show the recordings of several runs of the same joints over each other; any other choice is refused."""
    chosen = list(dict.fromkeys(run or ()))
    if not 2 <= len(chosen) <= _OVERLAID:
        raise UsageError(
            f"choose two to {_OVERLAID} runs in the table of runs to overlay them; {len(chosen)} were chosen"
        )
    found = [{**known.known_run(service.db, one), "facts": run_facts(service, one)} for one in chosen]
    if missing := [one["id"] for one in found if one["facts"].recording is None]:
        raise UsageError(f"{missing[0]}: has no recording to be drawn; choose runs that moved or recorded an arm")
    joints = found[0]["facts"].joints
    if any([joint["name"] for joint in one["facts"].joints] != [joint["name"] for joint in joints] for one in found):
        raise UsageError("these runs are of arms with other joints; choose runs of one arm")
    series = [[one["id"], one["facts"].recording] for one in found]
    return page("overlay", who, runs=found, joints=joints, series_runs=series)


@router.get("/arms/{arm}/parameters")
def trend(service: Serving, who: Viewer, arm: ArmName) -> Response:
    """Show the trend of each base parameter of an arm over its identifications."""
    name = known_arm(service.db, service.state, arm).name
    found = service.db.rows(
        "SELECT runs.id, runs.created FROM runs JOIN parameter_sets ON parameter_sets.run = runs.id "
        "WHERE runs.arm = ? ORDER BY runs.created DESC LIMIT ?",
        *(name, _TRENDED),
    )
    sets = [(row, one) for row in reversed(found) if (one := identified_set(service, row["id"])) is not None]
    accepted = service.db.row("SELECT run FROM acceptances WHERE arm = ? ORDER BY number DESC LIMIT 1", name)
    reference = None if accepted is None else str(accepted["run"])
    return page(
        "parameters",
        who,
        arm=name,
        runs=[row for row, _ in sets],
        reference=reference,
        rows=trends(sets, reference),
    )


def trends(sets: list[tuple[Row, IdentifiedSet]], accepted_run: str | None) -> list[dict[str, Any]]:
    """Return a row per base parameter of the newest set with its change since the accepted set, most significant first.

    Args:
        sets: rows of runs and their parameters, the earliest first.
        accepted_run: id of the run of the accepted set; the first set counts where it is not among them.
    """
    if not sets:
        return []
    newest, before = sets[-1][1], next((one for row, one in sets if row["id"] == accepted_run), sets[0][1])
    found = []
    for expression, unit, verdict in zip(newest.expressions, newest.units, newest.verdicts, strict=True):
        series = [_values(one, [expression])[0] for _, one in sets]
        now, then = series[-1], _values(before, [expression])[0]
        found.append(
            {
                "expression": expression,
                "unit": unit,
                "verdict": verdict,
                "value": now[0] if now else None,
                "deviation": now[1] if now else None,
                "change": None if now is None or then is None else now[0] - then[0],
                "sigma": _sigma(now, then),
                "series": [None if one is None else [one[0], one[1]] for one in series],
            }
        )
    return sorted(found, key=lambda row: -abs(row["sigma"] or 0.0))


def _sigma(now: tuple[float, float | None] | None, then: tuple[float, float | None] | None) -> float | None:
    """Return a change in standard deviations of the difference; None where they are unknown."""
    if now is None or then is None or now is then or not now[1] or not then[1]:
        return None
    return float((now[0] - then[0]) / np.hypot(now[1], then[1]))


@router.get("/compare")
def compare(service: Serving, who: Viewer, reference: Id, other: Id) -> Response:
    """Show the comparison of two runs' parameters, as `ident compare` writes it."""
    # Imported only when a comparison is asked for, so that the service starts without these modules.
    from ident_service.operations.parameter_files import compare_files
    from ident_service.results.comparison.presentation import comparison_html

    if reference == other:
        raise UsageError("choose two different runs to compare")
    comparison, _ = compare_files([known.run_folder(service.db, service.state, one) for one in (reference, other)])
    text = comparison_html(comparison).replace(f"{service.state / known.RUNS}/", "")
    return HTMLResponse(text, headers={"Content-Security-Policy": POLICY})


@router.get("/audit")
def audit(service: Serving, who: Viewer, before: Annotated[int, Query(ge=0, lt=2**62)] | None = None) -> Response:
    """List the lines of the audit trail, the newest first."""
    service.engine.audit.flush(AUDIT_SECONDS)
    lines = audit_log(service.db, before_id=before, max_lines=100)
    return page("audit", who, lines=lines, more=len(lines) == 100)
