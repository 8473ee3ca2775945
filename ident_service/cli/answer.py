"""What a verb answers, where it may write, and how it is interrupted; shared by all groups of verbs.

Exit codes: 0 done and good; 1 failed; 2 usage or configuration; 3 done, but the verdict is no; 4 stopped by a fault.
Boundary: nothing here knows a single verb.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

from ident_service.errors import UsageError

DONE, FAILED, USAGE, VERDICT_NO, FAULTED = 0, 1, 2, 3, 4

Answer = tuple[int, str, dict[str, Any]]
"""Exit code; what a person reads, with its last line break; what a program reads."""


def print_answer(arguments: argparse.Namespace, code: int, text: str, document: dict[str, Any]) -> None:
    """Print a verb's answer as it was asked for: words, or one JSON object."""
    if arguments.json:
        _print_json({**document, "exit_code": code})
    else:
        sys.stdout.write(text)


def print_error(kind: str, message: str, code: int) -> None:
    """Print the one JSON object of a command that failed; `kind` is the name of an error of `errors.py`."""
    _print_json({"error": {"kind": kind, "message": message}, "exit_code": code})


def _print_json(document: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(document, allow_nan=False) + "\n")


def tell(arguments: argparse.Namespace, line: str) -> None:
    """Say what is going on while a verb works."""
    # With --json, stdout belongs to the one object.
    print(line, file=sys.stderr if arguments.json else sys.stdout, flush=True)


def state_folder(arguments: argparse.Namespace) -> Path:
    """Where results go that were given no folder: `--state`, `$IDENT_STATE`, or the user's XDG state folder.

    Raises:
        UsageError: `--state` without a name.
    """
    if arguments.state is not None:
        if not arguments.state:
            raise UsageError("--state needs the name of a folder")
        return Path(arguments.state)
    if given := os.environ.get("IDENT_STATE"):
        return Path(given)
    base = os.environ.get("XDG_STATE_HOME")
    return (Path(base) if base else Path.home() / ".local" / "state") / "ident"


class StopOnSignal:
    """Ctrl-C or a polite kill asks for a controlled stop; a second one ends the process as usual."""

    def __init__(self) -> None:
        self._asked = False

    def requested(self) -> bool:
        """Has a stop been asked for?"""
        return self._asked

    def __enter__(self) -> None:
        self._before = {number: signal.signal(number, self._ask) for number in (signal.SIGINT, signal.SIGTERM)}

    def __exit__(self, *_: object) -> None:
        for number, before in self._before.items():
            signal.signal(number, before)

    def _ask(self, number: int, _: object) -> None:
        self._asked = True
        signal.signal(number, self._before[signal.Signals(number)])
