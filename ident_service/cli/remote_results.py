"""Run the verbs about results, acceptances, lists, maintenance and tokens on a daemon (`--server`).

Files that a daemon makes stay there, as exports; `--out` fetches them.
"""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from ident_service.cli.archive_commands import (
    arm_line,
    deleted_text,
    deleted_with_anyway,
    motions_text,
    pruned_text,
    runs_text,
)
from ident_service.cli.daemon_commands import token_line
from ident_service.cli.identification_commands import accepted_name, fleet_lines
from ident_service.cli.maintenance_commands import alarm_lines, due_line, dues_text, schedule_line, schedules_text
from ident_service.cli.output import DONE, FAILED, VERDICT_NO, Answer, StopOnSignal, tell, with_answer_lines
from ident_service.cli.recovery_commands import EXIT_CODES
from ident_service.cli.remote import RemoteVerb, carrying, confirmation, job, job_verb, motion_of, word_of_address
from ident_service.cli.remote_recordings import recording
from ident_service.errors import ArmError, UsageError

if TYPE_CHECKING:
    from ident_service.client import IdentClient

_API = "/api/v1"
_LOOK = 0.4  # s between looks, and between renewals of the lease
_PLAIN = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,119}")  # a name that cannot lead out of the folder it is written into


def _run(_: IdentClient, arguments: argparse.Namespace) -> str:
    return word_of_address(str(arguments.run))


def _run_of_file(_: IdentClient, arguments: argparse.Namespace) -> str:
    """Return the run that a daemon has in the place of a parameter file."""
    return word_of_address(str(arguments.file))


def _formats(_: IdentClient, arguments: argparse.Namespace) -> list[str]:
    return [name.strip() for name in arguments.format.split(",")]


def _compare(client: IdentClient, arguments: argparse.Namespace) -> dict[str, Any]:
    if len(arguments.others) != 1:
        raise UsageError("compare --server: compares one run with one other")
    run, other = arguments.reference, arguments.others[0]
    if (arm := accepted_name(run)) is not None:
        acts = client.get(f"{_API}/arms/{word_of_address(arm)}/acceptances")
        if not acts:
            client.get(f"{_API}/arms/{word_of_address(arm)}")  # that it is unknown is told first
            raise UsageError(
                f"{arm}: nothing has been accepted yet; `ident accept RUN` makes a run's parameters its own"
            )
        run = acts[-1]["run"]
    return {"run": word_of_address(str(run)), "other": word_of_address(str(other))}


def _with_payload(client: IdentClient, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    arm = str(client.get(f"{_API}/runs/{_run(client, arguments)}")["arm"])
    return [recording(client, arguments, arm, path) for path in arguments.recordings]


def _of_fleet(client: IdentClient, arguments: argparse.Namespace, answer: Answer) -> Answer:
    """Tell what was found as at the daemon's machine, then download the page, the table and the document."""
    code, text, document = answer
    found = document["answer"]
    if "arms" in found:
        text += "\n".join([*fleet_lines(found), ""])
    return _fetched_files(client, arguments, (code, text, document))


def _fetched(client: IdentClient, arguments: argparse.Namespace, answer: Answer) -> Answer:
    """Download the files of an export, where `--out` was given, after its answer's lines."""
    return _fetched_files(client, arguments, with_answer_lines(client, arguments, answer))


def _fetched_files(client: IdentClient, arguments: argparse.Namespace, answer: Answer) -> Answer:
    from ident_service.results.manifest import atomic_folder

    code, text, document = answer
    if code not in (DONE, VERDICT_NO):
        return code, text, document
    if document["job"]["run"] is None:  # refused before anything was written
        return code, text, document
    export = word_of_address(str(document["job"]["run"]))
    files = client.get(f"{_API}/exports/{export}")["files"]
    if arguments.out is None:
        listed = "".join(f"  {name}\n" for name in files)
        return code, f"{text}files of {export}, fetched with --out:\n{listed}", document | {"export": export}
    if strange := [name for name in files if not _PLAIN.fullmatch(name)]:
        raise ArmError(f"the daemon names a file {strange[0]!r}, which is no plain name; nothing was written")
    with atomic_folder(arguments.out) as folder:
        for name in files:
            (folder / name).write_bytes(client.content(f"{_API}/exports/{export}/files/{name}"))
    listed = "".join(f"  {name}\n" for name in files)
    return code, f"{text}files: {arguments.out}\n{listed}", document | {"export": export, "folder": str(arguments.out)}


def _corrected(client: IdentClient, arguments: argparse.Namespace, answer: Answer) -> Answer:
    """Download the corrected parameters to the file that `--out` names."""
    code, text, document = with_answer_lines(client, arguments, answer)
    if code != DONE:
        return code, text, document
    export = word_of_address(str(document["job"]["run"]))
    _write(arguments.out, client.content(f"{_API}/exports/{export}/files/parameters.json"))
    return code, f"{text}file: {arguments.out}\n", document | {"export": export, "file": str(arguments.out)}


def _reported(client: IdentClient, arguments: argparse.Namespace, answer: Answer) -> Answer:
    code, text, document = answer
    page = f"{_API}/runs/{word_of_address(str(arguments.run))}/report.html"
    if code != DONE or arguments.out is None:
        return code, f"{text}page: {page}\n" if code == DONE else text, document
    _write(arguments.out, client.content(page))
    return code, f"{text}file: {arguments.out}\n", document | {"file": str(arguments.out)}


def _write(path: Path, content: bytes) -> None:
    from ident_service.results.manifest import write_atomically

    try:
        write_atomically(path, content.decode("utf-8"))
    except UnicodeDecodeError:
        raise ArmError(f"{path}: not written: what the daemon sent for it is not text") from None


def _accept(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    run = word_of_address(str(arguments.run))
    arm = word_of_address(client.get(f"{_API}/runs/{run}")["arm"])
    act = client.post(f"{_API}/arms/{arm}/acceptances", {"run": run, "note": arguments.note})
    return DONE, f"{act['arm']}: acceptance {act['number']} is the current one\n", act


def _rollback(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    body = {"note": arguments.note, "to": arguments.to}
    act = client.post(f"{_API}/arms/{word_of_address(arguments.arm)}/rollback", body)
    text = f"{act['arm']}: acceptance {act['number']} is the set of {act['origin']} ({act['run']})\n"
    return DONE, text, act


def _delete(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    kind, name = arguments.kind, word_of_address(arguments.name)
    with deleted_with_anyway(kind, name):
        done = client.delete(f"{_API}/{kind}s/{name}" + ("?anyway=true" if arguments.anyway else ""))
    return DONE, deleted_text(done), done


def _prune(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    found = client.post(f"{_API}/recordings/prune", {"keep": arguments.keep, "yes": arguments.yes})
    return DONE, pruned_text(found), found


def _list(
    path: Callable[[argparse.Namespace], str], text: Callable[[list[dict[str, Any]]], str]
) -> Callable[[IdentClient, argparse.Namespace], Answer]:
    """Return a verb that prints what the daemon lists at an address."""

    def verb(client: IdentClient, arguments: argparse.Namespace) -> Answer:
        rows = client.get(f"{_API}/{path(arguments)}")
        return DONE, text(rows), {str(arguments.word): rows}

    return verb


def _of_all(arguments: argparse.Namespace) -> str:
    return str(arguments.word)


def _newest(arguments: argparse.Namespace) -> str:
    arm = "" if arguments.arm is None else f"&arm={word_of_address(arguments.arm)}"
    return f"{arguments.word}?most={min(arguments.most, 500)}{arm}"


def _revoke(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    row = client.post(f"{_API}/tokens/{word_of_address(arguments.name)}/revoke")
    return DONE, f"{arguments.name}: revoked\n", row


def _of_arm(arguments: argparse.Namespace, path: str = "") -> str:
    return (path or arguments.word) + (f"?arm={quote(arguments.arm, safe='')}" if arguments.arm is not None else "")


def _add_schedule(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    body = {name: getattr(arguments, name) for name in ("arm", "cron", "hours", "maintenance", "motion")}
    row = client.post(f"{_API}/schedules", body)
    return DONE, schedule_line(row), row


def _remove_schedule(client: IdentClient, arguments: argparse.Namespace) -> Answer:
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
    return DONE, dues_text(rows), {"due": rows}


def _pending(client: IdentClient, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    rows = client.get(f"{_API}/{_of_arm(arguments, 'due')}")
    arms = {row["arm"] for row in rows}
    accepted = {arm for arm in arms if client.get(f"{_API}/arms/{word_of_address(arm)}/acceptances")}
    return [{**row, "accepted": row["arm"] in accepted} for row in rows]


def _dismiss(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    client.post(f"{_API}/due/{arguments.number}/dismiss", {"note": arguments.note})
    return DONE, f"due {arguments.number}: dismissed\n", {"id": arguments.number, "dismissed": True}


def _alarms(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    rows = client.get(f"{_API}/{_of_arm(arguments)}")
    return VERDICT_NO if rows else DONE, alarm_lines(rows), {"alarms": rows}


def _acknowledge_alarm(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    row = client.post(f"{_API}/alarms/{arguments.number}/ack", {"note": arguments.note})
    return DONE, f"alarm {row['id']} of {row['arm']}: acknowledged\n", row


def _reidentify(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    """Begin a re-identification, renew its lease until it ends, and report it; Ctrl-C stops the arm."""
    body = {
        "arm": arguments.arm,
        "motion": motion_of(client, arguments),
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


_DELETES = ("runs delete", "motions delete", "arms delete")
# The audit trail has the token's name there, so that `--by` is not sent.
VERBS: dict[str, RemoteVerb] = {
    "report": job("", more="out run", run=_run, ended=_reported),
    "export": job("", more="format out run", run=_run, formats=_formats, ended=_fetched),
    "fleet identify": job(
        "arm",
        "fleet",
        more="out patterns settle_again",
        arms=lambda _, arguments: arguments.patterns,
        settle_again=lambda _, arguments: arguments.settle_again or None,
        ended=_of_fleet,
    ),
    "figures": job("format", more="out run", run=_run, ended=_fetched),
    "payload": job("refit_offsets", more="out recordings run", run=_run, recordings=_with_payload, ended=_fetched),
    "compare": carrying("others reference", job_verb(_compare)),
    "verify": job("arm", more="file", run=_run_of_file),
    "feasible": job("arm feasible_set", more="file", run=_run_of_file),
    "project": job("arm feasible_set metric", "correct", more="file out", run=_run_of_file, ended=_corrected),
    "accept": carrying("note run", _accept),
    "rollback": carrying("arm note to", _rollback),
    "prune": carrying("keep yes", _prune),
    **dict.fromkeys(_DELETES, carrying("anyway name", _delete)),
    "arms": carrying("", _list(_of_all, lambda rows: "".join(map(arm_line, rows)))),
    "runs": carrying("arm most", _list(_newest, runs_text)),
    "motions": carrying("arm most", _list(_newest, motions_text)),
    "tokens": carrying("", _list(_of_all, lambda rows: "".join(map(token_line, rows)))),
    "tokens revoke": carrying("name", _revoke),
    "schedules add": carrying("arm cron hours maintenance motion", _add_schedule),
    "schedules": carrying("arm", _list(_of_arm, schedules_text)),
    "schedules remove": carrying("number", _remove_schedule),
    "schedules enable": carrying("number", _enabled(True)),
    "schedules disable": carrying("number", _enabled(False)),
    "maintenance": carrying("arm note what", _maintenance),
    "due": carrying("arm", _due),
    "due dismiss": carrying("note number", _dismiss),
    "alarms": carrying("arm", _alarms),
    "alarms acknowledge": carrying("note number", _acknowledge_alarm),
    "reidentify": carrying("arm confirm motion", _reidentify),
}
