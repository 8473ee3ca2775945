"""Run the verbs at an arm, its bus and description on a daemon (`--server`), and the hold-to-run rehearsal.

The key is held at this terminal and the arm is elsewhere: every look at the key that finds it held renews the lease,
one that finds it released asks for the stop. Whatever dies between the two, the lease lapses and the arm stops.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ident_service.cli.motion_commands import SLOW, HeldKey, require_held, require_no_target, require_terminal
from ident_service.cli.output import DONE, VERDICT_NO, Answer, StopOnSignal, tell
from ident_service.cli.remote import (
    RemoteVerb,
    confirmation,
    follow,
    job_answer,
    job_verb,
    motion_id,
    motion_of,
    remote_job,
    remote_verb,
    run_job,
    telling_of_arm,
    typed_name,
    word_of_address,
)
from ident_service.errors import ConfigError, UsageError

if TYPE_CHECKING:
    from ident_service.client import IdentClient

_API = "/api/v1"
_RENEW = 0.05  # s between looks at the key, each of which renews the lease; a rehearsal's lasts 0.25 s
_MOST_FILE = 8 * 2**20  # bytes of all files that a daemon takes


def _recover(_: IdentClient, arguments: argparse.Namespace) -> dict[str, Any]:
    return {"arm": arguments.arm, "kind": "leave_limit" if arguments.leave_limit else None}


def _known(_: IdentClient, arguments: argparse.Namespace) -> dict[str, Any]:
    return {"kind": "config_check", "arm": word_of_address(arguments.file)}


def named_files(path: Path) -> dict[str, str]:
    """Read the text files beside a description that it names, and those that its YAML files name; map name to content.

    Args:
        path: of the description.

    Returns:
        Name to content; what cannot be read as text is left out, and the daemon says that it is not there.
    """
    from ident_service.config.yaml_source import read_without_base

    found: dict[str, str] = {}
    waiting = [path]
    while waiting:
        for word in _words(read_without_base(waiting.pop()).value):
            beside = path.parent / word
            if word in found or word == path.name or not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,119}", word):
                continue
            with suppress(OSError, UnicodeDecodeError):
                if beside.is_file() and beside.stat().st_size <= _MOST_FILE:
                    found[word] = beside.read_text(encoding="utf-8")
                    waiting += [beside] if beside.suffix in (".yaml", ".yml") else []
    return found


def _words(value: Any) -> Iterator[str]:
    """Yield every text among values of a description."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | tuple):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _words(part)


def _config_check(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    """Send a description file to be checked; any other word is the name of an arm that the daemon knows."""
    from ident_service.registry.arms import ARM_FILE

    path = Path(arguments.file)
    if not path.is_file():
        return job_verb(_known)(client, arguments)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: cannot be read as text: {error}") from None
    try:
        found = client.post(f"{_API}/descriptions/check", {"description": text, "files": named_files(path)})
    except ConfigError as error:  # the daemon has a name of its own for it
        problems = [replace(one, path=path) if str(one.path) == ARM_FILE else one for one in error.problems]
        raise ConfigError(problems) from None
    told = re.sub(rf"(?m)^( *){re.escape(ARM_FILE)}(?=:)", lambda at: f"{at[1]}{path}", found["text"])
    return DONE if found["good"] else VERDICT_NO, told, found


def _run(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    if not arguments.hold_to_run:
        return job_verb(run_job)(client, arguments)
    require_no_target(arguments)
    return _hold_to_run(client, arguments, require_terminal(arguments))


def _rehearse(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    return _hold_to_run(client, arguments, None if arguments.no_key else require_terminal(arguments))


def _hold_to_run(client: IdentClient, arguments: argparse.Namespace, terminal: int | None) -> Answer:
    name, motion = typed_name(arguments), motion_id(client, arguments.arm, arguments.motion)
    job = {"kind": "rehearse", "arm": arguments.arm, "speed": SLOW if arguments.speed is None else arguments.speed}
    job |= {} if motion is None else {"motion": motion}
    stopping = StopOnSignal()
    with stopping, nullcontext() if terminal is None else HeldKey(terminal) as key:
        if key is not None:
            require_held(arguments, arguments.arm, key, stopping)
        # Asked for only now, so that the challenge is fresh however long it took until the key was held.
        body = {"job": job, "confirm": confirmation(client, arguments, name)}
        made = client.post(f"{_API}/jobs", body)
        tell(arguments, f"job {made['id']}")
        over = stopping.requested if key is None else lambda: stopping.requested() or key.released()
        with telling_of_arm(arguments.arm, made["id"]):
            return job_answer(client, follow(client, arguments, made, over, moves=True, poll_seconds=_RENEW))


VERBS: dict[str, RemoteVerb] = {
    "watch": remote_job("arm seconds"),
    "recover": remote_verb("arm confirm leave_limit", job_verb(_recover)),
    "base-parameters": remote_job("arm", "base"),
    "preview": remote_job("arm", further_arguments="motion", motion=motion_of),
    "bus load": remote_job("arm rate", "bus_load"),
    "bus scan": remote_job("arm", "bus_scan"),
    "bus probe": remote_job("arm", "bus_probe"),
    "config check": remote_verb("file", _config_check),
    "run": remote_verb("arm chosen confirm hold_to_run motion speed until", _run),
    "rehearse": remote_verb("arm confirm motion no_key speed", _rehearse),
}
