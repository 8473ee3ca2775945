"""Name recordings for a daemon (`--server`): by its ids, or by uploading local files."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ident_service.cli.output import tell
from ident_service.errors import UnknownId, UsageError

if TYPE_CHECKING:
    from ident_service.client import IdentClient


def recording_reference(
    client: IdentClient, arguments: argparse.Namespace, arm: str, path: Path, columns: Path | None = None
) -> dict[str, Any]:
    """Return the fields by which a job names a recording; upload it first if it is a local file, else check its run.

    Args:
        client: of the daemon.
        arguments: of the verb.
        arm: name of the arm that a file is of.
        path: `FILE`, `RUN` or `RUN/NAME`, each with or without `@START:END`.
        columns: file that describes the columns of a CSV file.
    """
    from ident_service.recordings.files import split_range

    file = file_of(path)
    seconds = None if path.is_file() else split_range(str(path))[1]
    given = {"start": seconds[0], "end": seconds[1]} if seconds else {}
    bounded = {key: value for key, value in given.items() if math.isfinite(value)}
    if file.is_file():
        text = "" if columns is None else _text(columns)
        return {**client.upload(arm, file, columns=text, tell=_percent(arguments, file)), **bounded}
    run, _, name = str(file).partition("/")
    require_registered(client, "run", run, path)
    return {"run": run, **({"name": name} if name else {}), **bounded}


def require_registered(client: IdentClient, kind: str, registered_id: str, path: Path) -> None:
    """Raise UnknownId unless the daemon knows a run or motion of the id `registered_id`; local files are not looked at.

    Args:
        client: of the daemon.
        kind: `run` or `motion`.
        registered_id: text that may be its id.
        path: path as the person gave it.

    Raises:
        UnknownId: it is neither.
    """
    plain = re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,119}", registered_id) is not None
    try:
        if plain:
            client.get(f"/api/v1/{kind}s/{registered_id}")
    except UnknownId:
        plain = False
    if not plain:
        raise UnknownId(f"{path}: no such file here, and the daemon at {client.url} has no {kind} {registered_id!r}")


def word_of_address(word: str) -> str:
    """Return the word unchanged if it may stand in a URL's path; raise UsageError for others."""
    if not word or any(letter in word for letter in "/?#% \\") or not word.isprintable() or word.startswith("."):
        raise UsageError(f"{word!r}: with --server, arms, runs and jobs are named by id, not by path")
    return word


def file_of(path: Path) -> Path:
    """Return the file that `FILE@START:END` names, without the range, unless a file has that whole name."""
    from ident_service.recordings.files import split_range

    return path if path.is_file() else Path(split_range(str(path))[0])


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise UsageError(f"{path}: cannot be read: {error}") from None


def _percent(arguments: argparse.Namespace, file: Path) -> Callable[[float], None]:
    """Return a callback that prints at each tenth how much of a file has been uploaded."""
    printed = [-1]

    def share(arrived: float) -> None:
        if int(10 * arrived) > printed[0]:
            printed[0] = int(10 * arrived)
            tell(arguments, f"{file.name}: {100.0 * arrived:.0f} % uploaded")

    return share
