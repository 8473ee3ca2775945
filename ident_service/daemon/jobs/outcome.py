"""Tell what became of a job from the files it left, and enter what it made in the registry.

A restart begins no motion: a person asked for it at another moment. Queued computations stay queued.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from ident_service.daemon.jobs.child_process import ANSWER, LOG, PROCESS, alive, ask_to_end
from ident_service.daemon.jobs.commands import FOLDERS, JOBS
from ident_service.errors import IdentError
from ident_service.motion.command_channel import controlling_pid
from ident_service.motion.ending import ENDED
from ident_service.operations.drift_alarms import FLEET, raise_fleet_alarms
from ident_service.operations.moving_arms import is_held
from ident_service.registry import jobs as rows
from ident_service.registry.database import Database, Row, note
from ident_service.registry.motions import MOTION_FILE, MOTIONS, index_motion
from ident_service.registry.runs import EXPORTS, RUNS, index_run
from ident_service.registry.state_folder import control_path
from ident_service.results.manifest import MANIFEST, write_manifest

_MOST = 32 * 2**20
_LAST = 64 * 1024
_STATES: Final = {0: "done", 3: "refused", 4: "faulted"}
STOPPED: Final = "stopped"
_REFUSING: Final = (
    "failed",
    "needs_person",
)  # verdicts of a preflight's check (`ident_service/motion/ticket.py`)


@dataclass(frozen=True)
class Outcome:
    """Outcome of a job.

    Attributes:
        state: one of those in `registry/jobs.py`.
        detail: reason for the state, in words; empty where there is nothing to say.
        exit_code: exit code of the command, None without one.
    """

    state: str
    detail: str
    exit_code: int | None


@dataclass(frozen=True)
class ProcessOutput:
    """Output of a job's process, from its files.

    Attributes:
        answer: the one JSON object of its output; empty where it had none.
        text: text that a person would have read at its terminal.
        log: the end of its output, without samples (`printed_samples`).
    """

    answer: dict[str, Any] = field(default_factory=dict)
    log: str = ""
    text: str = ""


def process_output(folder: Path, most_log_bytes: int = _LAST) -> ProcessOutput:
    """Read the JSON answer of a job's process and the last `most_log_bytes` of its log; empty where there is none."""
    answer: dict[str, Any] = {}
    try:
        with (folder / ANSWER).open("rb") as stream:
            content = json.loads(stream.read(_MOST))
        answer = content if isinstance(content, dict) else {}
    except (OSError, ValueError, RecursionError):
        pass  # there is none yet, or it was cut off when its process was killed
    try:
        with (folder / LOG).open("rb") as stream:
            end = stream.seek(0, 2)
            stream.seek(max(end - most_log_bytes, 0))
            log = stream.read(most_log_bytes).decode("utf-8", "replace")
    except OSError:
        log = ""
    # Not by `splitlines`, which takes the mark of samples for the end of a line.
    lines = [line for line in log.split("\n") if not line.startswith(rows.SAMPLES)]
    return ProcessOutput(answer, "\n".join(lines), str(answer.pop("text", "")))


def printed_samples(folder: Path, log_offset: int) -> tuple[list[dict[str, Any]], int]:
    """Return the samples that a job's process has printed since an offset in its log, and the offset to go on from.

    Each has `joints`, `time` [s] and `position` [rad or m] as the samples of a run have (`live.Thinned`).
    """
    try:
        with (folder / LOG).open("rb") as stream:
            stream.seek(log_offset)
            piece = stream.read(_LAST)
    except OSError:
        return [], log_offset
    whole = piece[: piece.rfind(b"\n") + 1]
    marked = (line for line in whole.decode("utf-8", "replace").split("\n") if line.startswith(rows.SAMPLES))
    return [json.loads(line.removeprefix(rows.SAMPLES)) for line in marked], log_offset + len(whole)


def outcome(output: ProcessOutput, exit_code: int | None, end_reason: str) -> Outcome:
    """Decide an ended job's state, detail and exit code: by its answer, else its exit code, and why it was to end.

    Args:
        output: of the process.
        exit_code: exit code that the process's parent saw; None where the process had another parent.
        end_reason: reason why the process was asked to end; empty if it was not.
    """
    code = output.answer.get("exit_code")
    if not isinstance(code, int):
        how = "" if exit_code is None else f" (signal {-exit_code})" if exit_code < 0 else f" (exit code {exit_code})"
        last = output.log.strip().splitlines()[-1:]
        words = "; ".join([f"its process ended without a result{how}", *last])
        # A full disk takes the answer, and leaves the exit code.
        state = "faulted" if exit_code == 4 else "cancelled" if end_reason else "failed"
        return Outcome(state, end_reason if state == "cancelled" else words, exit_code)
    message = _message(output.answer)
    if _report(output.answer).get("state") == STOPPED:
        return Outcome("cancelled", end_reason or "the arm was stopped: a stop was requested", code)
    state = _STATES.get(code, "failed")
    if end_reason and state in ("failed", "refused"):
        return Outcome("cancelled", "; ".join(filter(None, (end_reason, message))), code)
    return Outcome(state, message, code)


def interrupted(output: ProcessOutput, folder: Path | None, *, moves: bool) -> str:
    """Return words on a job that was running when the service died: how its motion and process ended, what was kept.

    Args:
        output: output of its process so far.
        folder: folder of the job's output, if it has made one.
        moves: whether it is about a motion.
    """
    words = ["the service died while it ran"]
    code = output.answer.get("exit_code")
    if folder is not None and (folder / ENDED).is_file():
        try:
            ended = json.loads((folder / ENDED).read_text(encoding="utf-8"))
            words.append(f"the motion ended: {ended.get('error') or ended.get('state')}")
        except (OSError, ValueError, AttributeError):
            words.append(f"{ENDED} of its folder cannot be read")
    elif moves and folder is not None and folder.is_dir():
        words.append(f"its folder has no {ENDED}: the motion process was killed")
    if isinstance(code, int):
        words.append(f"its process went on and answered with exit code {code}")
        if message := _message(output.answer):
            words.append(message)
    if folder is not None and folder.is_dir():
        kept = [path.name for path in sorted(folder.iterdir()) if not path.name.startswith(".")]
        words.append(f"kept: {', '.join(kept)}" + ("" if MANIFEST in kept else f"; without a {MANIFEST}"))
    else:
        words.append("nothing was kept")
    return "; ".join(words)


def lateness_of(folder: Path) -> Any:
    """Return the lateness histogram of a run's cycles (`motion/cycle_timing.py`); None where it is not known."""
    try:
        return json.loads((folder / ENDED).read_text(encoding="utf-8"))["lateness"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None


def _message(answer: dict[str, Any]) -> str:
    """Say why a command ended so: in the words of its error, or by what its answer objects to."""
    error = answer.get("error")
    return str(error.get("message", "")) if isinstance(error, dict) else "; ".join(_objections(answer))


def _objections(answer: dict[str, Any]) -> Iterator[str]:
    ticket = answer.get("ticket")
    checks = ticket.get("checks") if isinstance(ticket, dict) else None
    for check in checks if isinstance(checks, list) else ():
        if isinstance(check, dict) and check.get("verdict") in _REFUSING:
            yield f"{check.get('code')}: {check.get('reason')}" + (
                f" ({remedy})" if (remedy := check.get("remedy")) else ""
            )
    for key in ("unusable", "objections"):
        reasons = answer.get(key)
        yield from map(str, reasons if isinstance(reasons, list) else ())
    if answer.get("feasible") is False:
        yield "these parameters are not feasible"


def _report(answer: dict[str, Any]) -> dict[str, Any]:
    report = answer.get("report")
    return report if isinstance(report, dict) else {}


_MAKES_A_RUN = frozenset({"run", "rehearse", "home", "leave_limit", "identify", "simulate", "judge"})

_ABOUT_A_RUN = frozenset({"report", "verify", "compare", "judge", "feasible"})


def register_outputs(db: Database, state: Path, row: Row, by: str) -> None:
    """Register the run or motion folder that a job left, adding a lacking manifest, or raise the alarms of its fleet.

    Args:
        db: the registry.
        state: the state folder.
        row: of the job.
        by: name of the requester.

    Raises:
        IdentError: the folder is not what its manifest names, or not one of a run.
    """
    made = row["run"]
    if made is None:
        return
    if row["kind"] in _MAKES_A_RUN and (folder := state / RUNS / made).is_dir():
        # A killed process leaves no manifest. Nothing writes there any more, so the present files are final.
        if not (folder / MANIFEST).is_file():
            write_manifest(folder)
        index_run(db, state, made)
    elif row["kind"] == "design" and (state / MOTIONS / made / MOTION_FILE).is_file():
        index_motion(db, state, made, row["arm"], by)
    elif row["kind"] == "fleet" and (found := state / EXPORTS / made / FLEET).is_file():
        raise_fleet_alarms(db, json.loads(found.read_text(encoding="utf-8")), made, time.time())
    elif row["kind"] == "correct":
        with suppress(OSError):  # not empty, or removed already
            (state / EXPORTS / made).rmdir()


def folder_of(state: Path, row: Row) -> Path | None:
    """Return the folder that a job makes, whether it exists or not; None for a job that makes none."""
    if row["run"] is None or row["kind"] in _ABOUT_A_RUN:
        return None
    return state / FOLDERS.get(row["kind"], RUNS) / str(row["run"])


def forget_unmade(db: Database, state: Path, row: Row) -> None:
    """Clear the folder's id in an ended job's row if the folder was never made: after a refusal, for example."""
    folder = folder_of(state, row)
    if folder is not None and not folder.exists():
        rows.clear_folder_id(db, row["id"])


END_UNOBSERVED: Final = "the service died while it ran, and its process"
"""Beginning of the detail of an interrupted job whose process has not been seen to end."""
_LOOK = 0.1  # s between looks at processes of the previous service
_WAIT = 40.0  # s for one of them to end; a controlled stop and its recording take less


def is_end_unobserved(row: Row) -> bool:
    """Return whether a job was interrupted and its process has not been seen to end."""
    return row["state"] == "interrupted" and str(row["detail"]).startswith(END_UNOBSERVED)


def mark_interrupted(db: Database, state: Path) -> None:
    """Mark running jobs and waiting motions as interrupted; quick, before any request is answered."""
    with db.transaction():
        for row in rows.jobs(db, states=rows.LIVE, most=1_000_000):
            running = row["state"] == "running"
            if running:
                detail = f"{END_UNOBSERVED} is being looked for"
            elif row["motion"]:
                detail = "the service ended before it began; nothing has moved, request it again"
            else:
                continue
            rows.mark_ended(db, row["id"], "interrupted", detail)
            if not running:
                forget_unmade(db, state, row)
            note(db, "service", "job interrupted", row["id"])


@dataclass
class Orphan:
    """Process of the previous service, and the motion process that it has started.

    Attributes:
        row: of its job.
        process: name of the process, as `child_process.alive` takes it.
        controlling_pid: id of the process that has the arm; None before one was seen.
        since: time when the process was first seen [s].
    """

    row: Row
    process: str
    controlling_pid: int | None
    since: float

    def standing(self, state: Path) -> str:
        """Return words on what the process still does, to follow `END_UNOBSERVED`; empty once it has ended."""
        row, moves = self.row, bool(self.row["motion"])
        lives = alive(self.process)
        has = controlling_pid(control_path(state, row["arm"])) if moves else None
        if lives and self.controlling_pid is None:
            self.controlling_pid = has
        if not lives and (has is None or has != self.controlling_pid):
            return ""
        if has is not None and is_held(state, row["arm"]):
            return f" {has} holds {held_until(row['arm'])}"
        if time.monotonic() - self.since < _WAIT:
            return " is being looked for"
        return f" {self.process.split()[0] if lives else has} has not ended yet"


def held_until(arm: str) -> str:
    """Return the words `the arm NAME until a person confirms that it is supported`, with the command for that."""
    return f"the arm {arm} until a person confirms that it is supported: `ident supported {arm}`"


def orphans(db: Database, state: Path) -> list[Orphan]:
    """Return the processes of the previous service that were not seen to end, whether or not they live."""
    return [
        Orphan(
            row,
            _process(state, row),
            controlling_pid(control_path(state, row["arm"])) if row["motion"] else None,
            time.monotonic(),
        )
        for row in rows.jobs(db, states=("interrupted",), most=1_000_000)
        if is_end_unobserved(row)
    ]


def explain_interrupted(
    db: Database,
    state: Path,
    waited_for: Sequence[Orphan] | None = None,
    on_ended: Callable[[str], None] = lambda _: None,
    closing: threading.Event | None = None,
) -> None:
    """Wait until the previous service's processes have ended, SIGTERM sent unless they hold an arm; record each end.

    One that holds an arm without brakes may live for hours; its job says so meanwhile.

    Args:
        db: the registry.
        state: the state folder.
        waited_for: the processes, as `orphans` returned them; looked for here if None.
        on_ended: called with the id of each job whose process has ended.
        closing: event that ends this early; the next service goes on.
    """
    left = list(orphans(db, state) if waited_for is None else waited_for)
    closing = threading.Event() if closing is None else closing
    recorded: dict[str, str] = {}
    for one in left:
        # A motion has seen the end of its input and stops its arm; a second word would end what holds it.
        if not (one.row["motion"] and is_held(state, one.row["arm"])):
            ask_to_end(one.process)
    while left and not closing.is_set():
        for one in tuple(left):
            job, words = one.row["id"], one.standing(state)
            if not words:
                left.remove(one)
                _explain(db, state, one.row)
                on_ended(job)
            elif words != recorded.setdefault(job, " is being looked for"):
                recorded[job] = words
                rows.set_detail(db, job, f"{END_UNOBSERVED}{words}")
        if left:
            closing.wait(_LOOK)


def _explain(db: Database, state: Path, row: Row) -> None:
    folder = folder_of(state, row)
    detail = interrupted(process_output(state / JOBS / row["id"]), folder, moves=bool(row["motion"]))
    try:
        register_outputs(db, state, row, row["created_by"])
    except (IdentError, OSError) as error:
        detail = f"{detail}; its folder could not be entered: {error}"
    forget_unmade(db, state, row)
    rows.set_detail(db, row["id"], detail)


def _process(state: Path, row: Row) -> str:
    if row["process"]:
        return str(row["process"])
    try:
        return (state / JOBS / str(row["id"]) / PROCESS).read_text(encoding="ascii").strip()
    except (OSError, ValueError):
        return ""
