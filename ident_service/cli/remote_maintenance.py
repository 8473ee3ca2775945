"""Run `schedule`, `maintenance`, `due`, `alarm` and `reidentify` on a daemon (`--server`)."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from ident_service.cli.maintenance_commands import alarm_lines, due_line, schedule_line
from ident_service.cli.output import DONE, FAILED, VERDICT_NO, Answer, StopOnSignal, tell
from ident_service.cli.recovery_commands import EXIT_CODES
from ident_service.cli.remote import confirmation, motion_id, word_of_address

if TYPE_CHECKING:
    from ident_service.client import IdentClient

_LOOK = 0.4  # s between looks, and between renewals of the lease
_API = "/api/v1"


def _of(arguments: argparse.Namespace, path: str) -> str:
    return f"{_API}/{path}" + (f"?arm={quote(arguments.arm, safe='')}" if arguments.arm is not None else "")


def _add(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    body = {
        "arm": arguments.arm,
        "cron": arguments.cron,
        "hours": arguments.hours,
        "maintenance": arguments.maintenance,
        "motion": arguments.motion,
    }
    row = client.post(f"{_API}/schedules", body)
    return DONE, schedule_line(row), row


def _list(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    rows = client.get(_of(arguments, "schedules"))
    return DONE, "".join(map(schedule_line, rows)) or "nothing is scheduled\n", {"schedules": rows}


def _remove(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    client.ask("DELETE", f"{_API}/schedules/{arguments.number}")
    return DONE, f"schedule {arguments.number}: removed\n", {"id": arguments.number, "removed": True}


def _enabled(enabled: bool) -> Callable[[IdentClient, argparse.Namespace], Answer]:
    def verb(client: IdentClient, arguments: argparse.Namespace) -> Answer:
        row = client.post(f"{_API}/schedules/{arguments.number}/enabled", {"enabled": enabled})
        return DONE, schedule_line(row), row

    return verb


def _maintenance(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    body = {"what": arguments.what, "note": arguments.note}
    row = client.post(f"{_API}/arms/{word_of_address(arguments.arm)}/maintenance", body)
    due = _pending(client, arguments)
    text = f"{arguments.arm}: recorded: {row['what']}\n" + "".join(map(due_line, due))
    return DONE, text, {**row, "due": due}


def _due(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    rows = _pending(client, arguments)
    return DONE, "".join(map(due_line, rows)) or "nothing is due\n", {"due": rows}


def _pending(client: IdentClient, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    rows = client.get(_of(arguments, "due"))
    arms = {row["arm"] for row in rows}
    accepted = {arm for arm in arms if client.get(f"{_API}/arms/{word_of_address(arm)}/acceptances")}
    return [{**row, "accepted": row["arm"] in accepted} for row in rows]


def _dismiss(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    client.post(f"{_API}/due/{arguments.number}/dismiss", {"note": arguments.note})
    return DONE, f"due {arguments.number}: dismissed\n", {"id": arguments.number, "dismissed": True}


def _alarms(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    rows = client.get(_of(arguments, "alarms"))
    return VERDICT_NO if rows else DONE, alarm_lines(rows), {"alarms": rows}


def _ack(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    row = client.post(f"{_API}/alarms/{arguments.number}/ack", {"note": arguments.note})
    return DONE, f"alarm {row['id']} of {row['arm']}: acknowledged\n", row


def _reidentify(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    """Begin a re-identification, renew its lease until it ends, and report it; Ctrl-C stops the arm."""
    body = {
        "arm": arguments.arm,
        "motion": motion_id(client, arguments.arm, arguments.motion),
        "confirm": confirmation(client, arguments),
    }
    row: dict[str, Any] = client.post(f"{_API}/reidentifications", body)
    path, step, stopping, stopped = f"{_API}/reidentifications/{row['id']}", "", StopOnSignal(), False
    with stopping:
        while row["state"] == "running":
            if row["step"] != step:
                step = row["step"]
                tell(arguments, f"-- {step}")
            if stopping.requested():
                if not stopped:
                    client.post(f"{_API}/arms/{word_of_address(arguments.arm)}/stop")
                stopped = True
            else:
                client.post(f"{path}/lease")
            time.sleep(_LOOK)
            row = client.get(path)
    text = f"{row['arm']}: {row['detail'] or row['state']}\n" + (f"run {row['run']}\n" if row["run"] else "")
    return EXIT_CODES.get(row["state"], FAILED), text, row


VERBS: dict[str, Callable[[IdentClient, argparse.Namespace], Answer]] = {
    "schedules add": _add,
    "schedules": _list,
    "schedules remove": _remove,
    "schedules enable": _enabled(True),
    "schedules disable": _enabled(False),
    "maintenance": _maintenance,
    "due": _due,
    "due dismiss": _dismiss,
    "alarms": _alarms,
    "alarms acknowledge": _ack,
    "reidentify": _reidentify,
}
_NUMBER = frozenset({"number"})
CARRIED: dict[str, frozenset[str]] = {
    "schedules add": frozenset({"arm", "cron", "hours", "maintenance", "motion"}),
    **dict.fromkeys(("schedules", "due", "alarms"), frozenset({"arm"})),
    **dict.fromkeys(("schedules remove", "schedules enable", "schedules disable"), _NUMBER),
    "maintenance": frozenset({"arm", "what", "note"}),
    **dict.fromkeys(("due dismiss", "alarms acknowledge"), _NUMBER | {"note"}),
    "reidentify": frozenset({"arm", "motion", "confirm"}),
}
"""Arguments that are sent to a daemon, by verb; the audit trail has the token's name there, and not `--by`."""
