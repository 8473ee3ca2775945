"""Re-identify an arm in four jobs: preflight, run, identification, comparison with the accepted set.

Its row in the registry names the present step and that step's job. A step that ends badly ends the re-identification.
The confirmation by a person, or the schedule, covers both motions, but only while this process lives and nobody asks
for a stop: after a restart only computations go on.

The identification uses the description that the acceptance kept, so that both sets have the same parameters and the
same friction model.
"""

from __future__ import annotations

import logging
import sqlite3
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from ident_service.config.arm import ArmConfig
from ident_service.config.load import arm_from_json
from ident_service.daemon.jobs.commands import JOBS, accepted_description
from ident_service.daemon.jobs.outcome import is_end_unobserved, process_output
from ident_service.daemon.jobs.queue import Engine
from ident_service.daemon.jobs.requests import AnyJobRequest, Check, Identify, Judge, RecordingReference, Run
from ident_service.errors import IdentError, MotionRefused, UsageError
from ident_service.operations.acceptance import ARM, accepted_set
from ident_service.operations.drift_alarms import Verdict, raise_alarm, verdict_of
from ident_service.operations.maintenance_schedule import close_dues
from ident_service.registry.arms import known_arm
from ident_service.registry.database import Database, Row, note
from ident_service.registry.jobs import LIVE, known_job
from ident_service.registry.motions import new_id
from ident_service.registry.runs import RUNS

SERVICE: Final = "service"
LOG = logging.getLogger("ident.maintenance")
_SAME = ("kinematics", "gravity", "terms", "transmission")  # sections whose change gives the parameters another meaning


def require_comparable(state: Path, config: ArmConfig) -> int:
    """Return the number of an arm's current acceptance; raise if there is none or the mechanism has changed since.

    Raises:
        UsageError: nothing was accepted; or the mechanism in the description is another one since.
        ParameterError: the accepted set was changed on the disk.
    """
    act, folder = accepted_set(state, config.name)
    before = arm_from_json(folder / ARM)
    other = [key for key in _SAME if getattr(before, key) != getattr(config, key)]
    if other:
        raise UsageError(
            f"{config.name}: {', '.join(other)} of its description changed since acceptance {act.number}, so its "
            "parameters are others; identify it and accept the result first"
        )
    return act.number


def known_reidentification(db: Database, reidentification_id: str) -> Row:
    """Return the row of the re-identification of this id; raise UnknownId where there is none.

    Raises:
        UnknownId: there is none.
    """
    return db.known("reidentifications", "re-identification", reidentification_id)


def reidentifications(db: Database, arm: str | None = None, *, before: str | None = None, most: int = 100) -> list[Row]:
    """Return at most `most` re-identifications, of an arm if given, the newest first, older than the id `before`.

    Raises:
        UnknownId: there is none of that id.
    """
    return db.newest("reidentifications", "re-identification", "begun", arm, before, most)


def conclude(db: Database, row: Row, verdict: Verdict, now: float) -> None:
    """If a re-identification runs, enter its verdict; close dues unless `impossible`, raise an alarm if `changed`.

    Args:
        db: the registry.
        row: of the re-identification.
        verdict: verdict of the comparison.
        now: s since 1970 in UTC.
    """
    with db.transaction():
        if not _end(db, row, verdict.state, verdict.words, now):
            return
        if verdict.state != "impossible":
            close_dues(db, row["arm"], row["begun"], f"{verdict.state}: {row['id']}", row["begun_by"], now)
        if verdict.state == "changed":
            raise_alarm(db, row["arm"], row["id"], row["run"], verdict.words, now)


def enter_concluded(
    db: Database,
    arm: str,
    acceptance_number: int,
    recorded_run: str,
    identified_run: str,
    verdict: Verdict,
    begun: float,
    by: str,
    now: float,
) -> str:
    """Enter a re-identification done at a terminal and conclude it by its verdict (`conclude`); return its new id.

    Args:
        db: the registry.
        arm: name.
        acceptance_number: number of the acceptance.
        recorded_run: id of the run with the recording.
        identified_run: id of the run with the parameters.
        verdict: verdict of the comparison.
        begun: s since 1970 in UTC.
        by: name of the person who did it.
        now: s since 1970 in UTC.
    """
    name = new_id(arm)
    with db.transaction():
        db.write(
            "INSERT INTO reidentifications (id, arm, step, state, against, unattended, recorded, run, begun, begun_by) "
            "VALUES (?, ?, 'judge', 'interrupted', ?, 0, ?, ?, ?, ?)",
            *(name, arm, acceptance_number, recorded_run, identified_run, begun, by),
        )
        # `conclude` ends running ones only; nobody sees this state outside of the transaction.
        db.write("UPDATE reidentifications SET state = 'running' WHERE id = ?", name)
        conclude(db, known_reidentification(db, name), verdict, now)
    return name


@dataclass(frozen=True)
class ReidentificationRequest:
    """Request for a re-identification.

    Attributes:
        arm: name.
        motion: id; the description's own if None.
        unattended: whether it begins by itself, under the service's own lease.
    """

    arm: str
    motion: str | None = None
    unattended: bool = False


class Reidentifications:
    """Re-identifications that run in this process."""

    def __init__(self, engine: Engine, now: Callable[[], float] = time.time) -> None:
        """Create the table without re-identifications.

        Args:
            engine: engine that runs the jobs.
            now: s since 1970 in UTC.
        """
        self._engine, self._db, self._state, self._now = engine, engine.db, engine.state, now
        self._stops: dict[str, int] = {}
        self._steps: dict[str, tuple[str, str]] = {}
        self._lock = threading.Lock()

    def present_step(self, reidentification_id: str) -> tuple[str, str] | None:
        """Return (who began a running re-identification, id of its present job); None if not of this process."""
        return self._steps.get(reidentification_id)

    def begin(self, request: ReidentificationRequest, by: str) -> Row:
        """Begin a re-identification by queuing its first step, the preflight; return its row of the registry.

        Args:
            request: the request.
            by: the name of a token, or `service`; it keeps the lease of the motions, unless unattended.

        Raises:
            UsageError: it names what is not known, or nothing can be compared.
            ConfigError: the arm's description has mistakes.
            MotionRefused: unattended, and the description does not allow it; or the arm is being re-identified already.
        """
        config = known_arm(self._db, self._state, request.arm).config
        if request.unattended:
            _require_allowed(config)
        against = require_comparable(self._state, config)
        accepted_description(self._state, config.name, against)  # checked here, before anything moves
        name, stops = new_id(request.arm), self._engine.live.stops(request.arm)

        def enter(job: Row) -> None:
            try:
                self._db.write(
                    "INSERT INTO reidentifications (id, arm, step, state, motion, against, unattended, job, begun, "
                    "begun_by) VALUES (?, ?, 'check', 'running', ?, ?, ?, ?, ?, ?)",
                    *(name, request.arm, request.motion, against, int(request.unattended), job["id"], self._now(), by),
                )
            except sqlite3.IntegrityError:
                raise MotionRefused(f"{request.arm}: is being re-identified already") from None
            note(self._db, by, "re-identification begun", request.arm, id=name, unattended=request.unattended)
            self._steps[name] = by, job["id"]

        with self._lock:
            check = Check(kind="check", arm=request.arm, motion=request.motion)
            self._engine.create(check, by, own_lease=request.unattended, stops_at_begin=stops, also_write=enter)
            self._stops[name] = stops
        return known_reidentification(self._db, name)

    def advance(self) -> None:
        """Begin the next step of each re-identification whose step has ended, or end it."""
        with self._lock:
            for row in self._db.rows("SELECT * FROM reidentifications WHERE state = 'running' ORDER BY begun"):
                try:
                    self._advance(row)
                except IdentError as error:
                    refused = isinstance(error, MotionRefused)
                    self._ended(row, "cancelled" if refused else "failed", f"after {row['step']}: {error}")
                except Exception as error:
                    LOG.exception("a re-identification stumbled")
                    self._ended(row, "failed", f"after {row['step']}: {type(error).__name__}: {error}")

    def _advance(self, row: Row) -> None:
        job = known_job(self._db, row["job"])
        if job["state"] in LIVE or is_end_unobserved(job) or self._engine.closing:
            return
        judged = row["step"] == "judge" and job["state"] in ("done", "refused")
        answer = process_output(self._state / JOBS / job["id"]).answer if judged else {}
        if "verdict" in answer:
            conclude(self._db, row, verdict_of(answer), self._now())
            self._forget(row["id"])
        elif job["state"] != "done":
            state = "failed" if judged else job["state"]
            self._ended(row, state, f"{row['step']}: {job['detail'] or job['state']}{_recording_note(row)}")
        elif row["step"] == "check" and row["id"] not in self._stops:
            why = "the service ended between preflight and run; nothing has moved since, request it again"
            self._ended(row, "interrupted", why)
        else:
            self._begin_next(row)

    def _begin_next(self, row: Row) -> None:
        arm, step = row["arm"], row["step"]
        asked: AnyJobRequest
        if step == "check":
            if row["unattended"]:
                _require_allowed(known_arm(self._db, self._state, arm).config)
            following, asked, column = "run", Run(kind="run", arm=arm, motion=row["motion"]), "recorded"
        elif step == "run":
            recording = RecordingReference(run=row["recorded"])
            following, column = "identify", "run"
            asked = Identify(kind="identify", arm=arm, recordings=(recording,), as_accepted=row["against"])
        else:
            following, column = "judge", "run"
            asked = Judge(kind="judge", arm=arm, run=row["run"], against=row["against"])

        def enter(job: Row) -> None:
            self._db.write(
                f"UPDATE reidentifications SET step = ?, job = ?, {column} = ? WHERE id = ?",  # noqa: S608 - ours
                *(following, job["id"], job["run"], row["id"]),
            )
            self._steps[row["id"]] = row["begun_by"], job["id"]

        stops = self._stops.get(row["id"]) if step == "check" else None
        own = bool(row["unattended"])
        self._engine.create(asked, row["begun_by"], own_lease=own, stops_at_begin=stops, also_write=enter)

    def _ended(self, row: Row, state: str, detail: str) -> None:
        for column in ("recorded", "run"):
            if row[column] is not None and not (self._state / RUNS / row[column]).exists():
                # The step that was to make it made nothing, and its id leads nowhere.
                self._db.write(
                    f"UPDATE reidentifications SET {column} = NULL WHERE id = ?",  # noqa: S608 - ours
                    row["id"],
                )
        _end(self._db, row, state, detail, self._now())
        self._forget(row["id"])

    def _forget(self, name: str) -> None:
        self._stops.pop(name, None)
        self._steps.pop(name, None)


def _end(db: Database, row: Row, state: str, detail: str, now: float) -> bool:
    with db.transaction():
        ended = db.write(
            "UPDATE reidentifications SET state = ?, detail = ?, ended = ? WHERE id = ? AND state = 'running'",
            *(state, detail, now, row["id"]),
        )
        if ended:
            note(db, row["begun_by"], "re-identification ended", row["arm"], id=row["id"], state=state, detail=detail)
    return bool(ended)


def _recording_note(row: Row) -> str:
    return f"; the recording is kept in the run {row['recorded']}" if row["step"] in ("identify", "judge") else ""


def _require_allowed(config: ArmConfig) -> None:
    if config.unattended_motion != "allowed":
        raise MotionRefused(f"{config.name}: its description does not allow motion without a person")
