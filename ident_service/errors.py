"""Every error this package raises on purpose.

::

    IdentError
    ├── UsageError (ValueError)        invalid command or call: missing file, contradictory options
    │   ├── UnknownId (LookupError)    an id that the registry does not have
    │   ├── AlreadyThere               a name that is taken, and replacement was not requested
    │   ├── FileCutOff                 a file whose end is missing by what it announces itself
    │   ├── InUse                      something that cannot be deleted because it is in use or referred to
    │   ├── InvalidRequest             a request that the daemon's API rejects
    │   └── AccessRefused              no valid token, or a role without this right
    ├── ConfigError (ValueError)       an arm description with mistakes, all of them, each with file:line:column
    ├── ModelError (ValueError)        a mechanism or array shape that the model cannot represent
    ├── RecordingError (ValueError)    a recording that cannot be used: wrong joints, NaN, too short, torn row
    │   └── RecordingNotWritten        a recording cannot be written, as on a full disk
    ├── ParameterError (ValueError)    a parameter file or expression that does not parse or does not fit
    │   └── MustNotBeUsed              parameters whose own file says that they must not be used
    ├── SolverError (RuntimeError)     the conic solver stopped anywhere but at an optimum
    ├── MotionRefused (ValueError)     a motion that would leave the arm's limits, refused before anything moves
    │   └── PersonNeeded               a re-identification without a verdict: a person must act first
    ├── Unavailable (RuntimeError)     temporarily impossible on this machine or daemon; try again later
    │   ├── RegistryBusy               another process has locked the registry
    │   ├── DiskFull (OSError)         the disk of the state folder has no room
    │   └── StorageError (OSError)     storage of a fleet's recordings or factors is gone, or too slow
    └── ArmError (RuntimeError)        something below the motion loop
        ├── DriverError (OSError)      the arm cannot be opened, enabled or reached
        │   ├── ActionNeeded           a person has to act at the arm first, as the message says
        │   │   └── EmergencyStopped   the emergency stop is pressed, or has been
        │   ├── DriveFaulted           a drive has latched a fault, which only a reset clears
        │   ├── AnotherDrive           a drive answers that the description does not name
        │   ├── UnsuitableDrive        a drive cannot be driven as the description says
        │   ├── NobodyEnabled          a person did not enable the arm in time, or is no longer waited for
        │   └── PositionUnknown        the encoders lost their zero: a person must set the home
        ├── Stopped                    a motion did not come to its end, because a stop was requested
        └── ArmFault                   the safety monitor or a drive stopped a motion; has code and last samples

Each leaf also is the builtin it resembles, so that callers who do not know this package can catch it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal


class IdentError(Exception):
    """Base of all errors raised on purpose; the command line turns it into one message and an exit code.

    Attributes:
        facts: further entries of the JSON object that the command prints; what a run left behind, for example.
    """

    facts: Mapping[str, object] = MappingProxyType({})


class UsageError(IdentError, ValueError):
    """The request is invalid: a file that does not exist, options that contradict each other."""


class UnknownId(UsageError, LookupError):
    """The registry has no arm, motion, run, file or job of this name."""


class AlreadyThere(UsageError):
    """A name is taken, and replacement was not requested."""


class FileCutOff(UsageError):
    """A file can be read, but its end is missing by what it announces itself."""


@dataclass(frozen=True)
class Dependent:
    """Something that refers to what is to be deleted.

    Attributes:
        kind: `run`, `motion`, `schedule`, `acceptance`, `identification`, `alarm` or `re-identification`.
        id: id of the dependent.
        becomes: fate of the dependent when the other is deleted all the same.
    """

    kind: str
    id: str
    becomes: Literal["deleted", "kept"]


class InUse(UsageError):
    """Something was not deleted: it is in use, or `dependents` refer to it and it was not to be deleted anyway."""

    def __init__(self, message: str, dependents: Sequence[Dependent] = ()) -> None:
        self.dependents = tuple(dependents)
        super().__init__(message)


class InvalidRequest(UsageError):
    """The daemon's API rejects a request: an unknown field, a value out of bounds, too many bytes."""


class AccessRefused(UsageError):
    """The daemon refuses access: no valid token, or a role without this right."""


@dataclass(frozen=True)
class Problem:
    """One mistake in a configuration file, with the place to mend it (lines and columns count from 1)."""

    path: Path
    line: int
    column: int
    message: str

    def __str__(self) -> str:
        return f"{self.path}:{self.line}:{self.column}: {self.message}"


# By what begins a pattern: the form that it asks for, in words.
_FORMS: tuple[tuple[str, str], ...] = (
    (
        "^[A-Za-z0-9][A-Za-z0-9_.-]",
        "a name: letters, digits, '_', '.' and '-', of which the first is a letter or digit",
    ),
    (
        "^[a-z0-9][a-z0-9_.-]",
        "a name: small letters, digits, '_', '.' and '-', of which the first is a letter or digit",
    ),
    ("^[A-Za-z0-9_.-]", "a name: letters, digits, '_', '.' and '-'"),
    ("^[A-Za-z0-9*?_", "a name of an arm, or a pattern: letters, digits, '_', '.', '-', '*', '?' and [...]"),
    (r"^[A-Za-z_]\w*", "a module and its function, as in my_constraints:bodies"),
    ("^(t|(q|dq|tau)", "t, or q, dq or tau with the number of a joint, as in q1"),
    ("^[0-9A-F]{4}:", "an object of the drive and its type, as in 6077:0/i16"),
    (r"^[\x21-\x7e]+", "a word of printable ASCII characters"),
    ("^[0-9a-f]{64}", "a SHA-256 of 64 hexadecimal digits"),
    ("^[0-9a-f]{16}", "the first 16 hexadecimal digits of a SHA-256"),
)


# By pydantic's type of a mistake: what a number must be, and the name of the bound.
BOUNDS: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "greater_than": ("greater than", "gt"),
        "greater_than_equal": ("at least", "ge"),
        "less_than": ("less than", "lt"),
        "less_than_equal": ("at most", "le"),
    }
)


def plain_mistake(mistake: Mapping[str, Any]) -> str:
    """Return one mistake found by pydantic as words for a person, without a pattern, which is for programs.

    Args:
        mistake: one item of `ValidationError.errors()`: `type`, `msg`, `input` and `ctx`.
    """
    if mistake["type"] in BOUNDS:
        words, key = BOUNDS[mistake["type"]]
        return f"must be {words} {mistake['ctx'][key]:.10g}, not {str(mistake['input'])[:60]}"
    if mistake["type"] == "string_too_long":
        return f"must have at most {mistake['ctx']['max_length']} characters, not {len(mistake['input'])}"
    if mistake["type"] != "string_pattern_mismatch":
        return str(mistake["msg"]).removeprefix("Value error, ")
    pattern = str(mistake.get("ctx", {}).get("pattern", ""))
    form = next((words for start, words in _FORMS if pattern.startswith(start)), "of the form that is needed here")
    long = f", and at most {most} characters" if (most := _most_characters(pattern)) else ""
    return f"{str(mistake.get('input'))[:60]!r} is not {form}{long}"


def _most_characters(pattern: str) -> int:
    """Return how long a name may be that a pattern of one repeated set of characters describes; 0 for others."""
    repeated = pattern.rpartition("{")[2].removesuffix("}$")
    least, _, most = repeated.partition(",")
    return int(most) + (1 - int(least) if least == "0" else 0) if least.isdigit() and most.isdigit() else 0


class ConfigError(IdentError, ValueError):
    """An arm description has mistakes; `problems` holds all of them."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(str(problem) for problem in self.problems))


class ModelError(IdentError, ValueError):
    """A mechanism the model cannot represent, or an array whose shape does not fit it."""


class RecordingError(IdentError, ValueError):
    """A recording cannot be used; the message says which file, where in it, and what to do."""

    def __init__(self, path: Path | str, message: str) -> None:
        self.path = Path(path)
        super().__init__(f"{path}: {message}")


class RecordingNotWritten(RecordingError):
    """A recording cannot be written, as on a full disk."""


class ParameterError(IdentError, ValueError):
    """A parameter file, a parameter name or an expression does not parse or does not fit the arm."""


class MustNotBeUsed(ParameterError):
    """Parameters were not handed on, because their own file says that they must not be used."""


class SolverError(IdentError, RuntimeError):
    """The conic solver ended without an optimum; `status` is its own word for it."""

    def __init__(self, problem: str, status: str) -> None:
        self.problem = problem
        self.status = status
        super().__init__(f"{problem}: the solver stopped with status {status}")


class MotionRefused(IdentError, ValueError):
    """A motion would leave the arm's limits; nothing has moved."""


class PersonNeeded(MotionRefused):
    """Preflight or the arm refused a re-identification, so it is unknown whether the arm has changed."""


class Unavailable(IdentError, RuntimeError):
    """Something is temporarily impossible; nothing has been changed."""


class RegistryBusy(Unavailable):
    """Another process has locked the registry: a backup, a database browser, another command."""


class DiskFull(Unavailable, OSError):
    """The disk of the state folder has no room."""


class StorageError(Unavailable, OSError):
    """Storage of recordings or factors cannot be reached, or does not give what it lists; the message names the URL."""

    def __init__(self, url: str, message: str) -> None:
        self.url = url
        super().__init__(f"{url}: {message}")

    def __reduce__(self) -> tuple[type[StorageError], tuple[str, str]]:
        return type(self), (self.url, str(self).removeprefix(f"{self.url}: "))


class ArmError(IdentError, RuntimeError):
    """Something below the motion loop failed."""


class DriverError(ArmError, OSError):
    """The arm cannot be opened, enabled or reached."""


class ActionNeeded(DriverError):
    """A person has to act at the arm first; the message says how."""


class EmergencyStopped(ActionNeeded):
    """The emergency stop is pressed, or has been and must be cleared; the message says how."""


class DriveFaulted(DriverError):
    """A drive has latched a fault of its own and cannot be enabled before it is reset; the message says which."""


class AnotherDrive(DriverError):
    """A drive has another identity than the description says."""


class UnsuitableDrive(DriverError):
    """A drive cannot be driven as the description says; the message says what to change, or what it lacks."""


class NobodyEnabled(DriverError):
    """A person who enables the arm, by a pendant for example, did not do so in time, or is not waited for any more."""


class PositionUnknown(DriverError):
    """The encoders have lost their zero; a person moves the arm home by hand and confirms it (`Arm.zero`)."""


class Stopped(ArmError):
    """A motion, or the search for one, did not come to its end: a stop was requested, or a lease was not renewed."""


class ArmFault(ArmError):
    """A motion was stopped; `code` names the fault, `samples` are the last ones before it."""

    def __init__(self, code: str, message: str, samples: Sequence[object] = ()) -> None:
        self.code = code
        self.samples = tuple(samples)
        super().__init__(f"{code}: {message}")
