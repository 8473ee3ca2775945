"""Print a verb's answer or error, name where it may write, and hear interrupts.

Exit codes: 0 done and good; 1 failed; 2 usage or configuration; 3 done, but the verdict is no; 4 stopped by a fault; 5
nothing was judged, because a person is needed first.
"""

from __future__ import annotations

import argparse
import errno
import json
import os
import signal
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

from ident_service.errors import UsageError

DONE, FAILED, USAGE, VERDICT_NO, FAULTED, PERSON_NEEDED = 0, 1, 2, 3, 4, 5

Answer = tuple[int, str, dict[str, Any]]
"""Exit code; text for a person, with its last line break; JSON values for a program."""


_STYLES = {"error": "1;31", "heading": "1", "next": "36"}


def styled(stream: TextIO | None, text: str, style: str) -> str:
    """Return text in the colour of `error`, `heading` or `next` on a terminal that shows colours, else unchanged.

    Colours are left out in pipes and files, in a terminal called `dumb`, and where `NO_COLOR` is set (no-color.org).
    """
    if not is_terminal(stream) or os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return text
    return f"\x1b[{_STYLES[style]}m{text}\x1b[0m"


def print_answer(
    arguments: argparse.Namespace, code: int, text: str, document: dict[str, Any], last_line: str = ""
) -> None:
    """Print a verb's answer as text with a last line, or with `--json` as one JSON object.

    A daemon asks for the text in the object, as its `text`.
    """
    if arguments.json:
        _print_json({**document, **({"text": text} if arguments.with_text else {}), "exit_code": code})
    else:
        write(sys.stdout, text + styled(sys.stdout, last_line, "next") if last_line else text)


def print_error(kind: str, message: str, code: int, more_fields: Mapping[str, object] | None = None) -> None:
    """Print the one JSON object of a command that failed on stdout; `kind` is the name of an error of `errors.py`.

    Where it cannot be written, on a full disk for example, the exit code is left to say it.
    """
    with suppress(OSError):
        _print_json({"error": {"kind": kind, "message": message}, **(more_fields or {}), "exit_code": code})


def print_to_person(text: str) -> None:
    """Write text as it is, with no line break added, to stderr; ignore that it cannot be written."""
    with suppress(OSError):
        write(sys.stderr, text)


def _print_json(document: dict[str, Any]) -> None:
    write(sys.stdout, json.dumps(document, allow_nan=False) + "\n")


def is_terminal(stream: TextIO | None) -> bool:
    """Return whether a standard stream is open and a terminal."""
    return stream is not None and not stream.closed and stream.isatty()


def person_types() -> bool:
    """Return whether standard input is open and a terminal, so that a person can be asked."""
    return is_terminal(sys.stdin)


def tell(arguments: argparse.Namespace, line: str) -> None:
    """Print a progress line above the bar or on stdout (`--json`: stderr); ignore that it cannot be written."""
    bar = getattr(arguments, "progress", None)
    if bar is not None and is_terminal(sys.stdout) and bar.tell(line):
        return
    # With --json, stdout belongs to the one object.
    with suppress(OSError):
        write(sys.stderr if arguments.json else sys.stdout, line + "\n")


def write(stream: TextIO | None, text: str) -> None:
    """Write and flush text; ignore a reader that has gone or a closed terminal, raise OSError for a full disk and such.

    Raises:
        OSError: anything else that keeps text from its place, a full disk for example.
    """
    if stream is None or stream.closed:
        return
    try:
        stream.write(text)
        stream.flush()
    except OSError as error:
        if error.errno not in (errno.EPIPE, errno.EIO):
            _forget_unwritten(stream)
            raise
        discard(stream)


def _forget_unwritten(stream: TextIO) -> None:
    """Drop what a stream could not write, which would fail again with each later line and at exit; later lines count.

    A stream without a file has nothing that could be dropped.
    """
    with suppress(OSError, ValueError):
        kept = os.dup(stream.fileno())
        try:
            discard(stream)
            stream.flush()
            os.dup2(kept, stream.fileno())
        finally:
            os.close(kept)


def discard(stream: TextIO) -> None:
    """Redirect a stream to the null device, so that its unwritten buffer cannot fail at exit with exit code 120."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


def state_folder(arguments: argparse.Namespace) -> Path:
    """Return the state folder, where results go by default: `--state`, `$IDENT_STATE`, or the user's XDG folder.

    Raises:
        UsageError: `--state` without a name; or a file has this name.
    """
    if arguments.state == "":
        raise UsageError("--state needs the name of a folder")
    if given := arguments.state or os.environ.get("IDENT_STATE"):
        state = Path(given)
    else:
        base = os.environ.get("XDG_STATE_HOME")
        state = (Path(base) if base else Path.home() / ".local" / "state") / "ident"
    with suppress(PermissionError):  # what is tried there tells of it
        if state.is_file():
            raise UsageError(f"{state}: is a file, not a folder; --state or $IDENT_STATE names the state folder")
    return state


def writable_state_folder(arguments: argparse.Namespace) -> Path:
    """Return the state folder for a verb that writes there, and set the umask; raise UsageError if others can enter it.

    Raises:
        UsageError: as `state_folder`; or others can enter it.
    """
    from ident_service.registry.state_folder import require_private

    state = state_folder(arguments)
    require_private(state)
    return state


def occupy_standard_streams() -> None:
    """Open the null device as stdin, stdout or stderr where it is closed (`2>&-`), for this process and its children.

    A file of ours would get its number else, and with it what a child prints; the recorder finds its memory by numbers.
    """
    with suppress(OSError):  # a stop goes on without it
        while (fd := os.open(os.devnull, os.O_RDWR)) <= 2:  # the lowest number that is free
            os.set_inheritable(fd, True)
        os.close(fd)


def enable_interrupts() -> None:
    """Make Ctrl-C interrupt this process although its shell had SIGINT ignored, unless hangups are ignored too.

    A shell without job control, that of a script for example, starts `command &` with SIGINT ignored (POSIX.1-2017,
    Shell Command Language, 2.11), and what is started inherits it. Where hangups are ignored too, `nohup` was asked for
    and both stay ignored; `StopOnSignal` and `interrupting` hear Ctrl-C there all the same, because they guard an arm.
    """
    # Handlers can be set in the main thread only, and only there does an interpreter raise KeyboardInterrupt.
    if threading.current_thread() is not threading.main_thread():
        return
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _heard() -> list[signal.Signals]:
    """Return the signals that ask for an end; hangups are not, where they are ignored."""
    hangup = [] if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else [signal.SIGHUP]
    return [signal.SIGINT, signal.SIGTERM, *hangup]


@contextmanager
def interrupting() -> Iterator[None]:
    """Raise KeyboardInterrupt on SIGTERM and SIGHUP too during the block, so that an arm is released first."""
    before = {number: signal.signal(number, signal.default_int_handler) for number in _heard()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class StopOnSignal:
    """Request a controlled stop on Ctrl-C, SIGTERM or a terminal that closes (SIGHUP).

    A second Ctrl-C interrupts and a second kill does what it did before. A second hangup does nothing: shells send it
    besides the kernel. Where hangups are ignored (`nohup`), they stay so; Ctrl-C is heard everywhere.
    """

    def __init__(self) -> None:
        self._asked = False

    def requested(self) -> bool:
        """Return whether a signal has requested a stop since the block was entered."""
        return self._asked

    def __enter__(self) -> None:
        self._before = {number: signal.signal(number, self._ask) for number in _heard()}

    def __exit__(self, *_: object) -> None:
        for number, before in self._before.items():
            signal.signal(number, before)

    def _ask(self, number: int, _: object) -> None:
        self._asked = True
        if number != signal.SIGHUP:
            before = self._before[signal.Signals(number)]
            signal.signal(number, signal.default_int_handler if before is signal.SIG_IGN else before)
