"""The command `ident`: parses words, calls the same functions as the Python API, prints, and picks an exit code.

One file per group of verbs: `GROUPS` lists them, each registers its verbs with `add(verbs)` and answers them. Boundary:
nothing is computed here, and large libraries load only when a verb needs them.
"""

from __future__ import annotations

import argparse
import errno
import importlib.util
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from ident_service import __version__
from ident_service.cli import (
    arm,
    bus,
    commission,
    comparing,
    configs,
    daemon,
    doctor,
    emulate,
    exports,
    keeping,
    motions,
    parameters,
    recovery,
    reidentify,
    remote,
    results,
    schedule,
)
from ident_service.cli.answer import (
    DONE,
    FAILED,
    FAULTED,
    PERSON_NEEDED,
    USAGE,
    VERDICT_NO,
    Answer,
    discard,
    hear_interrupts,
    print_answer,
    print_error,
    print_to_person,
)
from ident_service.cli.words import Parser, Verbs, WrongWords, asks_for_json
from ident_service.errors import ArmFault, ConfigError, IdentError, MotionRefused, PersonNeeded, UsageError

__all__ = ["DONE", "FAILED", "FAULTED", "PERSON_NEEDED", "USAGE", "VERDICT_NO", "main"]

GROUPS = (
    *(commission, motions, arm, recovery, parameters, results, comparing, exports, keeping),
    *(configs, bus, doctor, emulate, schedule, reidentify, daemon, remote),
)
_EXIT_CODES: tuple[tuple[type[IdentError], int], ...] = (
    (ConfigError, USAGE),
    (UsageError, USAGE),
    (PersonNeeded, PERSON_NEEDED),
    (MotionRefused, VERDICT_NO),
    (ArmFault, FAULTED),
    (IdentError, FAILED),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb.

    Args:
        argv: the words after `ident`; those of the process if None.

    Returns:
        The exit code.

    Raises:
        SystemExit: with 0 after help or version, with 2 after words that no verb understands.
    """
    words = sys.argv[1:] if argv is None else argv
    hear_interrupts()
    try:
        arguments = parser().parse_args(words)
        arguments.asked_ns = time.monotonic_ns()
    except WrongWords as wrong:
        if asks_for_json(words):
            print_error(UsageError.__name__, wrong.message, USAGE)
        raise
    try:
        _own_packages_only()
        verb: Callable[[argparse.Namespace], Answer] = arguments.verb if arguments.server is None else remote.remotely
        code, text, document = _asked(verb, arguments)
    except KeyboardInterrupt:
        # Asked twice, or by somebody who does not want to wait for what could be saved.
        print_to_person("ident: interrupted\n")
        if arguments.json:
            print_error("Interrupted", "interrupted", FAILED)
        return FAILED
    except IdentError as error:
        code = next(number for kind, number in _EXIT_CODES if isinstance(error, kind))
        notes = list(getattr(error, "__notes__", ()))
        print_to_person("\n".join([f"ident: {error}", *notes]) + "\n")
        if arguments.json:
            print_error(type(error).__name__, str(error), code, {**({"notes": notes} if notes else {}), **error.facts})
        return code
    try:
        print_answer(arguments, code, text, document)
    except OSError as error:
        print_to_person(f"ident: done, but the answer cannot be written: {error.strerror}\n")
        discard(sys.stdout)
        return FAILED
    return code


def _asked(verb: Callable[[argparse.Namespace], Answer], arguments: argparse.Namespace) -> Answer:
    """What a verb answers; a name that no file can have is a wrong word, wherever it is noticed."""
    try:
        return verb(arguments)
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:
            raise
        raise UsageError(f"{str(error.filename)[:40]}...: this name is too long for a file") from None


def parser() -> Parser:
    """All verbs and their words."""
    top = Parser(
        prog="ident",
        description="Commission a robot arm: excite it, record it, identify parameters a real body could have.",
    )
    top.add_argument("--version", action="version", version=f"ident-service {__version__}")
    verbs = Verbs.of(top)
    for group in GROUPS:
        group.add(verbs)
    return top


def _own_packages_only() -> None:
    """`drivers` and `sim_backend` are common words: refuse to run somebody else's from the working directory."""
    home = Path(__file__).resolve().parents[2]
    for name in ("drivers", "sim_backend"):
        spec = importlib.util.find_spec(name)
        origin = Path(spec.origin).resolve() if spec and spec.origin else None
        if origin is None or origin.parent.parent != home:
            raise UsageError(
                f"the package {name!r} was found at {origin}, not beside ident_service in {home}; run elsewhere"
            )
