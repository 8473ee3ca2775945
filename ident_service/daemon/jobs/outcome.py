"""Determine the outcome of a job from the files that its process left, also after a crash of the service."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from ident_service.daemon.jobs.child_process import ANSWER, LOG
from ident_service.motion.ending import ENDED
from ident_service.results.manifest import MANIFEST

_MOST = 32 * 2**20
_LAST = 64 * 1024
_STATES: Final = {0: "done", 3: "refused", 4: "faulted"}
STOPPED: Final = "stopped"
_REFUSING: Final = (
    "failed",
    "needs_person",
)  # verdicts of a preflight's check (`ident_service/motion/preflight_check.py`)


@dataclass(frozen=True)
class Outcome:
    """Outcome of a job.

    Attributes:
        state: one of those in `registry/jobs.py`.
        detail: why, in words; empty where there is nothing to say.
        exit_code: of the command, None without one.
    """

    state: str
    detail: str
    exit_code: int | None


@dataclass(frozen=True)
class Said:
    """Output of a job's process, from its files.

    Attributes:
        answer: its one JSON object; empty where it had none.
        log: the end of its output.
    """

    answer: dict[str, Any] = field(default_factory=dict)
    log: str = ""


def said(folder: Path, most: int = _LAST) -> Said:
    """Read the answer and the last `most` bytes of the log of a job's process."""
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
            stream.seek(max(end - most, 0))
            log = stream.read(most).decode("utf-8", "replace")
    except OSError:
        log = ""
    return Said(answer, log)


def outcome(heard: Said, exit_code: int | None, asked_to_end: str) -> Outcome:
    """Return the outcome of a process that has ended.

    Args:
        heard: its output.
        exit_code: as its parent saw it, None where it had another one.
        asked_to_end: why it was asked to, empty if it was not.
    """
    code = heard.answer.get("exit_code")
    if not isinstance(code, int):
        how = "" if exit_code is None else f" (signal {-exit_code})" if exit_code < 0 else f" (exit code {exit_code})"
        last = heard.log.strip().splitlines()[-1:]
        words = "; ".join([f"its process ended without an answer{how}", *last])
        return Outcome("cancelled", asked_to_end, exit_code) if asked_to_end else Outcome("failed", words, exit_code)
    message = _message(heard.answer)
    if _report(heard.answer).get("state") == STOPPED:
        return Outcome("cancelled", asked_to_end or "the arm was brought to rest: somebody asked for a stop", code)
    state = _STATES.get(code, "failed")
    if asked_to_end and state in ("failed", "refused"):
        return Outcome("cancelled", "; ".join(filter(None, (asked_to_end, message))), code)
    return Outcome(state, message, code)


def interrupted(heard: Said, folder: Path | None, *, moves: bool) -> str:
    """Describe a job that was running when the service died, from its output and its folder.

    Args:
        heard: output of its process so far.
        folder: that it made, if any.
        moves: whether it is about a motion.
    """
    words = ["the service died while it ran"]
    code = heard.answer.get("exit_code")
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
        if message := _message(heard.answer):
            words.append(message)
    if folder is not None and folder.is_dir():
        kept = [path.name for path in sorted(folder.iterdir()) if not path.name.startswith(".")]
        words.append(f"kept: {', '.join(kept)}" + ("" if MANIFEST in kept else f"; without a {MANIFEST}"))
    else:
        words.append("nothing was kept")
    return "; ".join(words)


def lateness_of(folder: Path) -> Any:
    """Return the lateness histogram of a run's cycles (`motion/histogram.py`); None where it is not known."""
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
        said = answer.get(key)
        yield from map(str, said if isinstance(said, list) else ())
    if answer.get("feasible") is False:
        yield "no real body can have these parameters"


def _report(answer: dict[str, Any]) -> dict[str, Any]:
    report = answer.get("report")
    return report if isinstance(report, dict) else {}
