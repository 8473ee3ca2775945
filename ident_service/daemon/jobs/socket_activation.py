"""Run in the unit for motions: take one request from the socket and become the requested command.

The socket is standard input, and stays it: its end stops the arm. Only verbs that move an arm under a lease are taken,
and those that look at it or its bus without a torque, because the bus is here. The service is believed no more than
that: it can ask for nothing here but looks, and motions, which preflight and guard judge.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

from ident_service.daemon.jobs.child_process import ANSWER, LOG, PROCESS, name_of

_MOST = 64 * 1024
_VERBS = frozenset({"check", "rehearse", "run", "home", "recover"})
_LOOKS = (("watch",), ("recover",), ("bus", "scan"), ("bus", "probe"))
_OPTIONS_OF_LOOKS = ("--json", "--with-text", "--state", "--tell-samples")


def main() -> int:
    """Become the command requested on stdin, output into files; return 1 if stdin ends first, 2 if refused."""
    line = bytearray()
    # Byte by byte: the input after the line belongs to the command.
    while not line.endswith(b"\n") and len(line) < _MOST:
        if not (part := os.read(0, 1)):
            return 1
        line += part
    try:
        request = json.loads(line)
        words, folder = [str(word) for word in request["words"]], Path(request["folder"])
    except (ValueError, KeyError, TypeError):
        return refuse("not a request")
    if not is_allowed(words):
        return refuse("only motions under a lease, and read-only commands, are accepted here")
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW
    try:
        process, answer, log = (os.open(folder / name, flags, 0o600) for name in (PROCESS, ANSWER, LOG))
    except OSError as error:
        return refuse(f"{folder}: {error.strerror}")
    os.write(process, name_of(os.getpid()).encode("ascii") + b"\n")
    os.close(process)
    os.dup2(answer, 1)
    os.dup2(log, 2)
    return os.execv(sys.executable, [sys.executable, "-P", "-m", "ident_service", *words])  # noqa: S606 - our own interpreter


def is_allowed(arguments: list[str]) -> bool:
    """Return whether the arguments are a motion under a lease, or a read-only command with known options."""
    if arguments and arguments[0] in _VERBS and "--lease-from-stdin" in arguments:
        return True
    # A list of allowed options: argparse accepts a prefix of an option, such as `--leave`, for the whole.
    options = [word for word in arguments if word.startswith("-")]
    good = all(word.startswith("--seconds=") or word in _OPTIONS_OF_LOOKS for word in options)
    return good and any(tuple(arguments[: len(look)]) == look for look in _LOOKS)


def refuse(reason: str) -> int:
    """Print the reason on stderr, which goes to the journal, and return exit code 2."""
    os.write(2, f"ident: {reason}\n".encode())
    return 2


if __name__ == "__main__":
    sys.exit(main())
