"""Run the command `ident`: parse its arguments, call the functions of the Python API, print, return an exit code.

One file per group of commands: `GROUPS` lists them; each registers its commands with `add(verbs)` and runs them. Only
the group of the verb that was typed is registered, as all together take as long as half of a quick command.
"""

from __future__ import annotations

import argparse
import errno
import importlib.util
import os
import sys
import time
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

from ident_service import __version__
from ident_service.cli import (
    archive_commands,
    completion,
    daemon_commands,
    identification_commands,
    maintenance_commands,
    motion_commands,
    planning_commands,
    recovery_commands,
    remote,
)
from ident_service.cli.arguments import ArgumentsError, Parser, TopParser, VerbList, asks_for_json
from ident_service.cli.next_command import next_after_error, next_line, with_arm
from ident_service.cli.output import (
    DONE,
    FAILED,
    FAULTED,
    PERSON_NEEDED,
    USAGE,
    VERDICT_NO,
    Answer,
    discard,
    enable_interrupts,
    occupy_standard_streams,
    print_answer,
    print_error,
    print_to_person,
    state_folder,
    styled,
)
from ident_service.cli.progress import progress_bar
from ident_service.errors import (
    ArmFault,
    ConfigError,
    DiskFull,
    FileCutOff,
    IdentError,
    ModelError,
    MotionRefused,
    MustNotBeUsed,
    ParameterError,
    PersonNeeded,
    RecordingError,
    RecordingNotWritten,
    UsageError,
)

__all__ = ["DONE", "FAILED", "FAULTED", "PERSON_NEEDED", "USAGE", "VERDICT_NO", "main"]

GROUPS = {
    identification_commands: (
        *("simulate", "identify", "fleet", "compare", "payload", "base-parameters", "feasible", "project", "verify"),
        *("export", "report", "figures", "view"),
    ),
    planning_commands: ("design", "preview", "new", "config", "schema", "bus", "driver", "doctor", "emulate"),
    motion_commands: (*("watch", "preflight", "run", "stop", "pause", "resume", "finish", "supported", "acknowledge"),),
    recovery_commands: ("home", "set-home", "recover", "reidentify"),
    archive_commands: ("arms", "runs", "motions", "accept", "rollback", "import", "prune", "backup", "restore"),
    maintenance_commands: ("schedules", "maintenance", "due", "alarms"),
    daemon_commands: ("serve", "tokens", "completion"),
    remote: ("jobs",),
}
"""Modules with the verbs that each registers, former names left out."""
# One rule for all verbs: USAGE when what was given cannot be used, be it words, a description or any other file; FAILED
# when it was understood and came to nothing.
_BAD_INPUT: tuple[type[IdentError], ...] = (UsageError, ConfigError, ModelError, RecordingError, ParameterError)
_EXIT_CODES: tuple[tuple[type[IdentError] | tuple[type[IdentError], ...], int], ...] = (
    (RecordingNotWritten, FAILED),
    ((MustNotBeUsed, FileCutOff), VERDICT_NO),
    (_BAD_INPUT, USAGE),
    (PersonNeeded, PERSON_NEEDED),
    (MotionRefused, VERDICT_NO),
    (ArmFault, FAULTED),
    (IdentError, FAILED),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the verb that `ident` was called with, print its answer or error, and return the exit code.

    Args:
        argv: the words after `ident`; those of the process if None.

    Raises:
        SystemExit: with 0 after help or version, with 2 after words that no verb understands.
    """
    words = sys.argv[1:] if argv is None else argv
    try:
        return _run(words, completes=argv is None)
    except (KeyboardInterrupt, Exception) as error:  # imports wrap an interrupt in errors of their own
        if not _is_interrupt(error):
            raise
        # A second Ctrl-C, where the first one stops: the person does not want to wait for what could be saved.
        print_to_person("ident: interrupted\n")
        if asks_for_json(words):
            print_error("Interrupted", "interrupted", FAILED)
        return FAILED


def _is_interrupt(error: BaseException | None) -> bool:
    # Not `__context__`: what failed while a verb let an arm go after an interrupt is an error of its own.
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__
    return error is not None


def _run(words: Sequence[str], *, completes: bool) -> int:
    """Run one verb, as `main`; complete its words instead where a shell asks for that and `completes`."""
    if completion.VARIABLE in os.environ and completes:
        completion.complete(parser())
    occupy_standard_streams()
    enable_interrupts()
    if "IDENT_ENDS_WITH_INPUT" in os.environ:  # a daemon's computation
        from ident_service.model.limited_process import end_with_input

        end_with_input()
    try:
        arguments = parser(words[0] if words else None).parse_args(words)
        arguments.requested_ns = time.monotonic_ns()
    except ArgumentsError as wrong:
        if asks_for_json(words):
            print_error(UsageError.__name__, wrong.message, USAGE)
        raise
    try:
        _require_own_packages()
        _name_registered(arguments)
        verb: Callable[[argparse.Namespace], Answer] = (
            arguments.verb if arguments.server is None else remote.run_on_daemon
        )
        with progress_bar(arguments):
            code, text, document = _answer_of(verb, arguments)
    except IdentError as error:
        code = next(number for kind, number in _EXIT_CODES if isinstance(error, kind))
        notes = list(getattr(error, "__notes__", ()))
        head = styled(sys.stderr, "ident:", "error")
        said = with_arm(arguments, "\n".join([str(error), *notes]))
        print_to_person(f"{head} {said}\n{next_after_error(arguments, type(error), str(error))}")
        if arguments.json:
            more: dict[str, object] = {"notes": notes} if notes else {}
            more |= {"text": "".join(f"{note}\n" for note in notes)} if arguments.with_text else {}
            print_error(type(error).__name__, str(error), code, {**more, **error.facts})
        return code
    try:
        text = text if arguments.json else with_arm(arguments, text)
        print_answer(arguments, code, text, document, "" if arguments.json else next_line(arguments, code, document))
    except OSError as error:
        print_to_person(f"ident: done, but the output cannot be written: {error.strerror}\n")
        discard(sys.stdout)
        return FAILED if code == DONE else code
    return code


def _answer_of(verb: Callable[[argparse.Namespace], Answer], arguments: argparse.Namespace) -> Answer:
    """Return a verb's answer; turn refusals of the operating system into errors that say so."""
    try:
        return verb(arguments)
    except IdentError as error:  # some of which are errors of the system, too
        cause = error.__context__
        if isinstance(cause, OSError) and cause.errno in (errno.ENOSPC, errno.EDQUOT):
            raise DiskFull(str(error)) from None
        if isinstance(error, ModelError | ParameterError) and (mistakes := _mistakes(arguments)) is not None:
            raise mistakes from None
        motion = getattr(arguments, "motion", None)
        if isinstance(motion, Path) and motion.is_file() and "motion" in str(error) and str(motion) not in str(error):
            error.add_note(f"motion: {motion}")
        raise
    except OSError as error:
        if (refused := _refused(arguments, error)) is None:
            raise
        raise refused from None
    except Exception as error:
        # Named so, for the verbs that need no registry load no SQLite.
        if type(error).__module__ != "sqlite3":
            raise
        from ident_service.registry.database import FILE, registry_error

        raise registry_error(state_folder(arguments) / FILE, error) from None


def _name_registered(arguments: argparse.Namespace) -> None:
    """Replace ids of runs and motions by their paths in the state folder, where no file here has that name."""
    if getattr(arguments, "server", None) is not None:
        return
    for name in ("run", "reference", "others", "motion", "recordings", "validate", "after"):
        value = getattr(arguments, name, None)
        if isinstance(value, Path):
            setattr(arguments, name, _registered(arguments, name, value))
        elif isinstance(value, list):
            setattr(arguments, name, [_registered(arguments, name, path) for path in value])


def _registered(arguments: argparse.Namespace, name: str, path: Path) -> Path:
    if not isinstance(path, Path) or len(path.parts) != 1 or path.exists():
        return path
    state = state_folder(arguments)
    if name == "motion":
        motion = state / "motions" / path / "motion.json"
        return motion if motion.is_file() else path
    if name in ("run", "reference", "others"):
        return state / "runs" / path if (state / "runs" / path).is_dir() else path
    run, at, seconds = path.name.partition("@")
    found = [state / "runs" / run / file for file in ("run.mcap", "identification.mcap")]
    return next((one.with_name(f"{one.name}{at}{seconds}") for one in found if one.is_file()), path)


def _mistakes(arguments: argparse.Namespace) -> ConfigError | None:
    """Return the mistakes of the description that a model could not be made of, with their places; None without any."""
    from ident_service.operations.description_check import check_description

    if not isinstance(arm := getattr(arguments, "arm", None), str) or arguments.server is not None:
        return None
    try:
        check_description(arm)
    except ConfigError as error:
        return error
    except IdentError:
        pass
    return None


def _refused(arguments: argparse.Namespace, error: OSError) -> IdentError | None:
    """Return what it means to a person that the operating system refused; None where it can only be our mistake."""
    place = str(error.filename) if error.filename is not None else "the disk"
    if error.errno == errno.ENAMETOOLONG:
        return UsageError(f"{place[:40]}...: this name is too long for a file")
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return DiskFull(f"{place}: cannot be written: {error.strerror}; free disk space, then try again")
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        from ident_service.registry.state_folder import access_refusal

        hint = access_refusal(state_folder(arguments))
        return UsageError(f"{place}: {error.strerror}" + (f"; {hint}" if hint else ""))
    return None


@cache  # parsing leaves it as it was
def parser(verb: str | None = None) -> Parser:
    """Build the argument parser of `ident`, with all verbs, or only those of the given verb's group; cached.

    Args:
        verb: verb to be parsed, for a parser with the verbs of its group alone; all groups where none has it.
    """
    top = TopParser(
        prog="ident",
        description="Commission a robot arm: describe it, move it, identify its dynamic parameters.",
    )
    top.add_argument("--version", action="version", version=f"ident-service {__version__}")
    verbs = VerbList.of(top)
    for group in [group for group, its in GROUPS.items() if verb in its] or GROUPS:
        group.add(verbs)
    return top


def _require_own_packages() -> None:
    """Refuse to run if `drivers` or `sim_backend`, common names, would come from the working directory."""
    home = Path(__file__).resolve().parents[2]
    for name in ("drivers", "sim_backend"):
        spec = importlib.util.find_spec(name)
        origin = Path(spec.origin).resolve() if spec and spec.origin else None
        if origin is None or origin.parent.parent != home:
            raise UsageError(
                f"the package {name!r} was found at {origin}, not beside ident_service in {home}; run elsewhere"
            )
