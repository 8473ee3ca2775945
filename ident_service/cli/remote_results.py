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

from ident_service.cli.answer_texts import answer_of, reidentified_text
from ident_service.cli.archive_commands import hint_at_anyway
from ident_service.cli.identification_commands import OF_ARMS, accepted_name
from ident_service.cli.output import DONE, FAILED, VERDICT_NO, Answer, StopOnSignal, tell
from ident_service.cli.recovery_commands import EXIT_CODES
from ident_service.cli.remote import (
    RemoteVerb,
    confirmation,
    job_answer,
    job_verb,
    motion_of,
    remote_job,
    remote_verb,
    word_of_address,
)
from ident_service.cli.remote_recordings import recording_reference
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
    return [recording_reference(client, arguments, arm, path) for path in arguments.recordings]


def _fetched(client: IdentClient, arguments: argparse.Namespace, answer: Answer) -> Answer:
    """Download the files of an export into the folder `--out`, where it was given."""
    from ident_service.results.manifest import atomic_folder

    code, text, document = answer
    if code not in (DONE, VERDICT_NO) or document["job"]["run"] is None:  # refused before anything was written
        return answer
    export = word_of_address(str(document["job"]["run"]))
    document |= {"export": export}
    if arguments.out is None:
        return code, f"{text}--out DIR fetches these files\n", document
    files = client.get(f"{_API}/exports/{export}")["files"]
    if strange := [name for name in files if not _PLAIN.fullmatch(name)]:
        raise ArmError(f"the daemon names a file {strange[0]!r}, which is no plain name; nothing was written")
    with atomic_folder(arguments.out) as folder:
        for name in files:
            (folder / name).write_bytes(client.content(f"{_API}/exports/{export}/files/{name}"))
    return code, text.replace(f"exports/{export}", str(arguments.out)), document | {"folder": str(arguments.out)}


def _fleet(client: IdentClient, arguments: argparse.Namespace, answer: Answer) -> Answer:
    code, text, document = _fetched(client, arguments, answer)
    return code, text if arguments.out is None else text.replace(f"  {OF_ARMS}\n", ""), document


def _corrected(client: IdentClient, arguments: argparse.Namespace, answer: Answer) -> Answer:
    """Download the corrected parameters to the file that `--out` names."""
    code, text, document = answer
    if code != DONE:
        return answer
    export = word_of_address(str(document["job"]["run"]))
    _write(arguments.out, client.content(f"{_API}/exports/{export}/files/parameters.json"))
    text = text.replace(f"exports/{export}/parameters.json", str(arguments.out))
    return code, text, document | {"export": export, "file": str(arguments.out)}


def _reported(client: IdentClient, arguments: argparse.Namespace, answer: Answer) -> Answer:
    """Download the page to the file `--out`, where it was given."""
    code, text, document = answer
    if code != DONE:
        return answer
    run = word_of_address(str(arguments.run))
    page = f"{_API}/runs/{run}/report.html"
    if arguments.out is not None:
        _write(arguments.out, client.content(page))
        document |= {"file": str(arguments.out)}
    return code, text.replace(f"reports/{run}.html", str(arguments.out or f"{client.url}{page}")), document


def _write(path: Path, content: bytes) -> None:
    from ident_service.results.manifest import write_atomically

    try:
        write_atomically(path, content.decode("utf-8"))
    except UnicodeDecodeError:
        raise ArmError(f"{path}: not written: what the daemon sent for it is not text") from None


def _answered(words: str, values: Callable[[IdentClient, argparse.Namespace], dict[str, Any]]) -> RemoteVerb:
    """Return a verb that prints what the daemon answers as if it had been done here.

    Args:
        words: names of the arguments that `values` sends.
        values: function that asks the daemon for the values.
    """
    return remote_verb(words, lambda client, arguments: answer_of(arguments, values(client, arguments)))


def _posted(words: str, path: str, also: str = "") -> RemoteVerb:
    """Return a verb whose arguments are posted, by their names, in the address or else in the body.

    Args:
        words: names of the arguments.
        path: path below that of the API, with names in braces.
        also: further names, of values that the verb itself says.
    """

    def post(client: IdentClient, arguments: argparse.Namespace) -> dict[str, Any]:
        body = {name: getattr(arguments, name) for name in f"{words} {also}".split()}
        place = {name: word_of_address(str(body.pop(name))) for name in tuple(body) if f"{{{name}}}" in path}
        return dict(client.post(f"{_API}/{path.format(**place)}", body))

    return _answered(words, post)


def _accept(client: IdentClient, arguments: argparse.Namespace) -> dict[str, Any]:
    run = word_of_address(str(arguments.run))
    arm = word_of_address(client.get(f"{_API}/runs/{run}")["arm"])
    return dict(client.post(f"{_API}/arms/{arm}/acceptances", {"run": run, "note": arguments.note}))


def _delete(client: IdentClient, arguments: argparse.Namespace) -> dict[str, Any]:
    kind, name = arguments.kind, word_of_address(arguments.name)
    with hint_at_anyway(kind, name):
        return dict(client.delete(f"{_API}/{kind}s/{name}" + ("?anyway=true" if arguments.anyway else "")))


def _list(words: str, path: Callable[[argparse.Namespace], str]) -> RemoteVerb:
    """Return a verb that prints what the daemon lists at an address."""
    return _answered(words, lambda client, arguments: {arguments.word: client.get(f"{_API}/{path(arguments)}")})


def _of_all(arguments: argparse.Namespace) -> str:
    return str(arguments.word)


def _newest(arguments: argparse.Namespace) -> str:
    arm = "" if arguments.arm is None else f"&arm={word_of_address(arguments.arm)}"
    return f"{arguments.word}?most={min(arguments.most, 500)}{arm}"


def _of_arm(arguments: argparse.Namespace, path: str = "") -> str:
    return (path or arguments.word) + (f"?arm={quote(arguments.arm, safe='')}" if arguments.arm is not None else "")


def _remove_schedule(client: IdentClient, arguments: argparse.Namespace) -> dict[str, Any]:
    client.ask("DELETE", f"{_API}/schedules/{arguments.number}")
    return {"id": arguments.number, "removed": True}


def _maintenance(client: IdentClient, arguments: argparse.Namespace) -> dict[str, Any]:
    body = {"what": arguments.what, "note": arguments.note}
    row = client.post(f"{_API}/arms/{word_of_address(arguments.arm)}/maintenance", body)
    return {**row, "due": client.get(f"{_API}/{_of_arm(arguments, 'due')}")}


def _dismiss(client: IdentClient, arguments: argparse.Namespace) -> dict[str, Any]:
    client.post(f"{_API}/due/{arguments.number}/dismiss", {"note": arguments.note})
    return {"id": arguments.number, "dismissed": True}


def _alarms(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    rows = client.get(f"{_API}/{_of_arm(arguments)}")
    return answer_of(arguments, {"alarms": rows}, VERDICT_NO if rows else DONE)


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
    if row["state"] in ("unchanged", "changed", "impossible"):
        comparison = job_answer(client, client.get(f"{_API}/jobs/{row['job']}"))[1]
        return EXIT_CODES[row["state"]], reidentified_text(comparison, row["state"], row["detail"]), row
    text = f"{row['arm']}: {row['detail'] or row['state']}\n" + (f"run {row['run']}\n" if row["run"] else "")
    return EXIT_CODES.get(row["state"], FAILED), text, row


_DELETES = ("runs delete", "motions delete", "arms delete")
# The audit trail has the token's name there, so that `--by` is not sent.
VERBS: dict[str, RemoteVerb] = {
    "report": remote_job("", further_arguments="out run", run=_run, ended=_reported),
    "export": remote_job("", further_arguments="format out run", run=_run, formats=_formats, ended=_fetched),
    "fleet identify": remote_job(
        "arm",
        "fleet",
        further_arguments="out patterns settle_again",
        arms=lambda _, arguments: arguments.patterns,
        settle_again=lambda _, arguments: arguments.settle_again or None,
        ended=_fleet,
    ),
    "figures": remote_job("format", further_arguments="out run", run=_run, ended=_fetched),
    "payload": remote_job(
        "refit_offsets", further_arguments="out recordings run", run=_run, recordings=_with_payload, ended=_fetched
    ),
    "compare": remote_verb("others reference", job_verb(_compare)),
    "verify": remote_job("arm", further_arguments="file", run=_run_of_file),
    "feasible": remote_job("arm feasible_set", further_arguments="file", run=_run_of_file),
    "project": remote_job(
        "arm feasible_set metric", "correct", further_arguments="file out", run=_run_of_file, ended=_corrected
    ),
    "accept": _answered("note run", _accept),
    "rollback": _posted("arm note to", "arms/{arm}/rollback"),
    "prune": _posted("keep yes", "recordings/prune"),
    **dict.fromkeys(_DELETES, _answered("anyway name", _delete)),
    **dict.fromkeys(("arms", "tokens"), _list("", _of_all)),
    **dict.fromkeys(("runs", "motions"), _list("arm most", _newest)),
    "tokens revoke": _posted("name", "tokens/{name}/revoke"),
    "schedules add": _posted("arm cron hours maintenance motion", "schedules"),
    **dict.fromkeys(("schedules", "due"), _list("arm", _of_arm)),
    "schedules remove": _answered("number", _remove_schedule),
    **dict.fromkeys(
        ("schedules enable", "schedules disable"), _posted("number", "schedules/{number}/enabled", also="enabled")
    ),
    "maintenance": _answered("arm note what", _maintenance),
    "due dismiss": _answered("note number", _dismiss),
    "alarms": remote_verb("arm", _alarms),
    "alarms acknowledge": _posted("note number", "alarms/{number}/ack"),
    "reidentify": remote_verb("arm confirm motion", _reidentify),
}
