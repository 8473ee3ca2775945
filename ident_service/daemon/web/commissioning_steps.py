"""Determine the commissioning steps of an arm: what is done of each, and which comes next.

Read from the registry and the arm's folder at each request, so that it is right after any restart. Steps count from the
last description on: a new description begins them anew. Jobs of a re-identification count for its own step alone. That
step comes next whenever something is due or a drift alarm stands, and it can be done.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, Literal

from ident_service import __version__
from ident_service.config.schema import ArmConfig
from ident_service.daemon.maintenance.reidentification import reidentifications, require_comparable
from ident_service.errors import IdentError
from ident_service.motion.preflight_check import Verdict
from ident_service.motion.ticket import read_ticket
from ident_service.operations.acceptance import Acceptance, acceptances
from ident_service.operations.arm_state import ticket_path
from ident_service.operations.drift_alarms import alarms
from ident_service.operations.maintenance_schedule import dues
from ident_service.registry import jobs as rows
from ident_service.registry.database import Database, Row
from ident_service.registry.motions import motions
from ident_service.registry.runs import EXPORTS, REPORTS

StepState = Literal["done", "skipped", "next", "open", "busy"]
TITLES: Final = {
    "description": "Description",
    "motion": "Motion",
    "check": "Check",
    "rehearse": "Rehearse",
    "run": "Run",
    "identify": "Identify",
    "report": "Report",
    "accept": "Accept",
    "export": "Export",
    "again": "Re-identify",
}


_MAKE_RUNS: Final = ("rehearse", "run", "identify")


@dataclass(frozen=True)
class Step:
    """One step of the commissioning.

    Attributes:
        key: one of `TITLES`.
        title: for people.
        state: `next` for exactly one step, unless a job of a step is under way, which then is `busy`; `skipped` for a
            rehearsal that a run went without.
        words: result so far, in words.
        link: page of the job that is doing it now.
    """

    key: str
    title: str
    state: StepState
    words: str
    link: str | None = None


@dataclass(frozen=True)
class Ladder:
    """All commissioning steps of an arm, and what they are about.

    Attributes:
        steps: in order.
        run: id of the newest run on the arm that came to its end.
        identified: id of the newest identification of that run.
        accepted: the current acceptance.
        exported: id of the job that exported the accepted parameters.
        reported: whether the identification has its report.
        comparable: whether the arm can be re-identified: something is accepted that it can be compared with.
    """

    steps: tuple[Step, ...]
    run: str | None
    identified: str | None
    accepted: Acceptance | None
    exported: str | None
    reported: bool
    comparable: bool


def ladder(db: Database, state: Path, config: ArmConfig) -> Ladder:
    """Return the commissioning steps of an arm with their states.

    Raises:
        ParameterError: the accepted set cannot be read.
    """
    arm = config.name
    row = db.row("SELECT added FROM arms WHERE name = ?", arm)
    since = 0.0 if row is None else float(row["added"])
    again = reidentifications(db, arm, most=500)
    made = {one[key] for one in again for key in ("recorded", "run")} - {None}
    under_way = next((one for one in again if one["state"] == "running"), None)
    there = {one["id"] for one in db.rows("SELECT id FROM runs WHERE arm = ?", arm)}
    jobs = [
        one
        for one in rows.jobs(db, arm=arm, most=500)
        if one["created"] >= since and one["run"] not in made and not _deleted(one, there)
    ]
    run = _newest(jobs, "run")
    identification = next((job for job in jobs if _identifies(job, run)), None)
    run_id, identified = _made(run), _made(identification)
    reported = identified is not None and (state / REPORTS / f"{identified}.html").is_file()
    acts = acceptances(state, arm)
    accepted = acts[-1] if acts else None
    took = identified is not None and any(act.run == identified for act in acts)
    exported = next((job["id"] for job in jobs if accepted and _exports(job, state, accepted.run)), None)
    designed = len(motions(db, arm))
    checked, ticket = _ticket(ticket_path(state, arm), config)
    rehearsed = _newest(jobs, "rehearse")
    comparable, words = _comparable(state, config) if accepted else (False, "first something has to be accepted")
    asks = _asks(db, arm)
    if comparable:
        words = "; ".join(asks) or _last(again)
    done: dict[str, tuple[bool, str]] = {
        "description": (True, f"by its SHA-256 {config.sha256[:12]}"),
        "motion": (True, f"{designed} designed, and the description's own" if designed else "the description's own"),
        "check": (checked or run_id is not None, ticket),
        "rehearse": (
            rehearsed is not None or run_id is not None,
            "done slowly, while a key was held"
            if rehearsed
            else "slowly, while you hold a key; recommended before a run",
        ),
        "run": (run_id is not None, run_id or "nothing recorded yet"),
        "identify": (identified is not None, identified or "no parameters from the newest run yet"),
        "report": (reported, "made" if reported else "not made yet"),
        "accept": (took, _accepted(accepted)),
        "export": (took and exported is not None, "made" if exported else "nothing exported of what is accepted"),
        "again": (False, words),
    }
    live = [job for job in reversed(jobs) if job["state"] in rows.LIVE]
    busy = {_step(job["kind"]): f"/jobs/{job['id']}" for job in live}
    if under_way is not None:
        own = under_way["job"]
        busy = {_step(job["kind"]): f"/jobs/{job['id']}" for job in live if job["id"] != own}
        busy["again"] = f"/reidentifications/{under_way['id']}"
    upcoming = "again" if comparable and asks else next(key for key, (finished, _) in done.items() if not finished)

    def state_of(key: str) -> StepState:
        if key in busy:
            return "busy"
        if done[key][0]:
            return "skipped" if key == "rehearse" and rehearsed is None else "done"
        return "next" if key == upcoming and not busy else "open"

    steps = tuple(Step(key, TITLES[key], state_of(key), words, busy.get(key)) for key, (_, words) in done.items())
    return Ladder(steps, run_id, identified, accepted, exported, reported, comparable)


def _comparable(state: Path, config: ArmConfig) -> tuple[bool, str]:
    """Return whether the arm can be compared with what is accepted, and if not, why."""
    try:
        require_comparable(state, config)
    except IdentError as error:
        return False, str(error).replace(f"{state}/", "")
    return True, ""


def _asks(db: Database, arm: str) -> list[str]:
    """Return the reasons for a re-identification, in words."""
    due = [f"due: {row['cause']}" for row in dues(db, arm)]
    return [*due, *(["a drift alarm stands"] if alarms(db, arm, most=1) else [])]


def _last(again: list[Row]) -> str:
    what = "after maintenance, or when the arm behaves otherwise: check, run, identify, compare with what is accepted"
    if not again:
        return what
    when = datetime.fromtimestamp(again[0]["begun"], UTC).strftime("%Y-%m-%d %H:%M UTC")
    return f"the last one, {when}: {again[0]['state']}; {what}"


def _newest(jobs: list[Row], kind: str) -> Row | None:
    return next((job for job in jobs if job["kind"] == kind and job["state"] == "done"), None)


def _deleted(job: Row, there: set[str]) -> bool:
    """Return whether the run that a job has made is deleted."""
    return job["kind"] in _MAKE_RUNS and job["state"] == "done" and job["run"] not in there


def _made(job: Row | None) -> str | None:
    return None if job is None else str(job["run"])


def _identifies(job: Row, run: Row | None) -> bool:
    if job["kind"] != "identify" or job["state"] != "done" or run is None:
        return False
    return any(one.get("run") == run["run"] for one in job["request"].get("recordings", ()))


def _exports(job: Row, state: Path, run: str) -> bool:
    good = job["kind"] == "export" and job["state"] == "done" and job["request"].get("run") == run
    return bool(good and (state / EXPORTS / str(job["run"])).is_dir())


def _accepted(act: Acceptance | None) -> str:
    if act is None:
        return "nothing accepted yet"
    back = "" if act.origin == act.number else f", a return to {act.origin}"
    return f"number {act.number}{back}, by {act.who}"


def _step(kind: str) -> str:
    return {"design": "motion", "home": "run", "simulate": "again", "judge": "again"}.get(kind, kind)


def _ticket(path: Path, config: ArmConfig) -> tuple[bool, str]:
    """Return whether the last preflight's ticket still looks valid, and words; the run itself checks it again."""
    if not path.is_file():
        return False, "not checked yet"
    try:
        ticket = read_ticket(path)
    except IdentError:
        return False, "its ticket cannot be read; check again"
    until = ticket.expires.strftime("%Y-%m-%d %H:%M UTC")
    if ticket.verdict is not Verdict.PASSED:
        return False, "the last one did not pass"
    if ticket.subject.arm_sha256 != config.sha256 or ticket.subject.software != f"ident-service {__version__}":
        return False, "the description or the software has changed since"
    if datetime.now(UTC) >= ticket.expires:
        return False, f"its ticket ended at {until}"
    return True, f"passed, counts until {until}"
