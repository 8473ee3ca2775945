"""Format answers about what the registry keeps, from their JSON values: the same whether a daemon gave them or not."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, Final

from ident_service.cli.output import DONE, Answer

_LINE = 80  # columns of a list
_ASKED: Final = {
    "pause": "pause requested",
    "resume": "resumption requested",
    "finish": "early end requested",
    "supported": "support confirmed",
}

Values = Mapping[str, Any]


def answer_of(arguments: argparse.Namespace, document: dict[str, Any], code: int = DONE) -> Answer:
    """Return a verb's answer: (exit code, text that the verb's formatter makes of the document, document)."""
    return code, _TEXTS[arguments.word](document), document


def stop_text(arm: str | None, reached: Sequence[str], cancelled: Sequence[str] = ()) -> str:
    """Format the line that says which arms a stop reached and which jobs it cancelled, or that nothing moves."""
    parts = [f"stop requested of {', '.join(reached)}"] if reached else []
    parts += [f"cancelled: {', '.join(f'job {job}' for job in cancelled)}"] if cancelled else []
    nobody = "no arm is moving" if arm is None else f"{arm} is not moving"
    return f"{'; '.join(parts) or f'{nobody}; motions requested before now will not begin'}\n"


def asked_text(arm: str, request: str) -> str:
    """Format the line that confirms a request to a moving arm's process: `pause`, `resume`, `finish` or `supported`."""
    return f"{arm}: {_ASKED[request]}\n"


def reidentified_text(comparison: str, verdict_state: str, verdict_words: str) -> str:
    """Join a comparison's text and the verdict's words; if `verdict_state` is `changed`, add that an alarm is open."""
    opened = "a drift alarm is open until `ident alarms acknowledge`, or `ident accept` of another set\n"
    return f"{comparison}{verdict_words}\n{opened if verdict_state == 'changed' else ''}"


def _list(name: str, line: Callable[[Values], str], none: str) -> Callable[[Values], str]:
    return lambda document: "".join(f"{line(row)}\n" for row in document[name]) or f"{none}\n"


def _arm(row: Values) -> str:
    line = f"{row['name']:<20} {row['source']:<9} {row['description']}".rstrip()
    return line if len(line) <= _LINE else f"{line[: _LINE - 3]}..."


def _run(row: Values) -> str:
    return f"{row['id']:<40} {row['arm']:<14} {row['kind']:<12} {row['ending']}".rstrip()


def _runs(document: Values) -> str:
    unlisted = "".join(f"not listed: {line}\n" for line in document.get("not_listed", ()))
    return _list("runs", _run, "no runs yet")(document) + unlisted


def _motion(row: Values) -> str:
    return f"{row['id']:<40} {row['arm']:<14} {row['duration']:.1f} s, by {row['added_by']}"


def _job(row: Values) -> str:
    return f"{row['id']:<44} {row['state']:<12} {row['arm'] or '':<16} by {row['created_by']}"


def _token(row: Values) -> str:
    since = datetime.fromtimestamp(row["created"], UTC).strftime("%Y-%m-%d")
    return f"{row['name']:<24} {row['role']:<9} since {since}{', revoked' if row['revoked'] else ''}"


def _accepted(act: Values) -> str:
    again = "" if act["origin"] == act["number"] else f", the set of {act['origin']}"
    place = f"; current: {act['current']}" if "current" in act else ""
    return f"{act['arm']}: acceptance {act['number']} is the current one{again} ({act['run']}){place}\n"


def _deleted(document: Values) -> str:
    lines = "".join(f"  {one['kind']} {one['id']}: {one['becomes']}\n" for one in document["dependents"])
    return f"{document['deleted']}: deleted\n{lines}"


def _pruned(document: Values) -> str:
    gone, verb = document["recordings"], "deleted" if document["deleted"] else "would be deleted; add --yes"
    text = "".join(f"{one['run']}/{one['name']}  {one['bytes'] / 2**20:.1f} MiB\n" for one in gone)
    text += "".join(f"skipped: {line}\n" for line in document["left_alone"])
    return f"{text}{len(gone)} recordings, {document['bytes'] / 2**20:.1f} MiB, {verb}\n"


def _schedule(row: Values) -> str:
    when = f"cron {row['cron']} (UTC)" if row["cron"] else str(row["trigger"])
    coming = f", next {_minute(row['next'])}" if row["cron"] and row["enabled"] else ""
    return f"{row['id']:>4}  {row['arm']:<16} {when}{coming}{'' if row['enabled'] else ', disabled'}"


def _due(row: Values) -> str:
    """Format one re-identification that is due; it needs an `accepted` set to compare with."""
    line = f"due {row['id']}: {row['arm']} since {_minute(row['at'])}: {row['cause']}"
    if row["accepted"]:
        return f"{line}; `ident reidentify {row['arm']}`"
    return f"{line}; nothing of it has been accepted to compare with: run, identify and accept it first"


def _maintained(row: Values) -> str:
    none = f"nothing is due after it; see `ident schedules add {row['arm']} --maintenance`"
    return f"{row['arm']}: recorded: {row['what']}\n{_list('due', _due, none)(row)}"


def _alarm(row: Values) -> str:
    return f"{row['id']:>4}  {row['arm']:<16} {_minute(row['at'])}  {row['what']}"


def _minute(at: float) -> str:
    return datetime.fromtimestamp(at, UTC).strftime("%Y-%m-%d %H:%M UTC")


_TEXTS: Final[dict[str, Callable[[Values], str]]] = {
    "arms": _list("arms", _arm, "no arms yet"),
    "runs": _runs,
    "motions": _list("motions", _motion, "no motions yet"),
    "jobs": _list("jobs", _job, "no jobs yet"),
    **dict.fromkeys(("arms delete", "runs delete", "motions delete"), _deleted),
    **dict.fromkeys(("accept", "rollback"), _accepted),
    "prune": _pruned,
    "tokens": _list("tokens", _token, "no tokens yet; `ident serve` makes the first"),
    "tokens revoke": lambda row: f"{row['name']}: revoked\n",
    "schedules": _list("schedules", _schedule, "nothing is scheduled"),
    **dict.fromkeys(("schedules add", "schedules enable", "schedules disable"), lambda row: f"{_schedule(row)}\n"),
    "schedules remove": lambda row: f"schedule {row['id']}: removed\n",
    "maintenance": _maintained,
    "due": _list("due", _due, "nothing is due"),
    "due dismiss": lambda row: f"due {row['id']}: dismissed\n",
    "alarms": _list("alarms", _alarm, "no open alarms"),
    "alarms acknowledge": lambda row: f"alarm {row['id']} of {row['arm']}: acknowledged\n",
}
