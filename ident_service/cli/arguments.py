"""Parse command-line arguments: the parser, the list of verbs, and converters for numbers."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any, NoReturn

from ident_service.cli.output import USAGE, Answer
from ident_service.errors import UsageError

FEASIBLE_SETS = ("pseudo_inertia", "inertia")


class ArgumentsError(SystemExit):
    """Exit after arguments that no verb understands; usage and reason are on stderr already."""

    def __init__(self, message: str) -> None:
        self.message = message
        super().__init__(USAGE)


class Parser(argparse.ArgumentParser):
    """Argument parser that raises `ArgumentsError` where argparse only exits, so that JSON can state the reason too."""

    def error(self, message: str) -> NoReturn:
        """Print argparse's usage and message on stderr, and raise.

        Raises:
            WrongWords: always.
        """
        self.print_usage(sys.stderr)
        sys.stderr.write(f"{self.prog}: error: {message}\n")
        raise ArgumentsError(message)


def asks_for_json(words: Sequence[str]) -> bool:
    """Return whether `--json`, or a prefix that argparse accepts for it, is among unparsed arguments."""
    options = takewhile(lambda word: word != "--", words)
    return any(len(word) > 2 and "--json".startswith(word) for word in options)


@dataclass(frozen=True)
class VerbList:
    """List of verbs that a group registers its own with.

    Attributes:
        commands: argparse's list of verbs.
        common: parser of the options that every verb has.
        prefix: the words before the verb, with a space behind them.
    """

    commands: argparse._SubParsersAction[Parser]
    common: Parser
    prefix: str = ""

    @classmethod
    def of(cls, parser: Parser) -> VerbList:
        """Create the list of verbs of a command."""
        common = Parser(add_help=False)
        common.add_argument("--json", action="store_true", help="print one JSON object on stdout and nothing else")
        common.add_argument(
            "--server", metavar="URL", help="run it on the daemon there; runs, motions and jobs are named by id"
        )
        common.add_argument("--state", help="state folder (default: $IDENT_STATE, or the user's XDG state folder)")
        return cls(parser.add_subparsers(required=True, metavar="VERB"), common)

    def add(
        self,
        name: str,
        run: Callable[[argparse.Namespace], Answer],
        text: str,
        *,
        former: str | None = None,
        hidden: bool = False,
        **rest: Any,
    ) -> Parser:
        """Add a verb.

        Args:
            name: the word.
            run: answers it.
            text: one line of help.
            former: the verb's earlier name, which is still understood and not listed.
            hidden: leave the verb out of the list of verbs.
            rest: for `argparse.ArgumentParser`.

        Returns:
            Its parser, to add arguments to.
        """
        if not hidden:
            rest["help"] = text
        parser = self.commands.add_parser(name, parents=[self.common], description=text, **rest)
        parser.set_defaults(verb=run, word=f"{self.prefix}{name}", words=parser)
        if former is not None:
            self.commands.choices[former] = parser
        return parser

    def group(self, name: str, text: str) -> VerbList:
        """Add a word that is followed by verbs of its own, as in `ident config check`."""
        parser = self.commands.add_parser(name, help=text)
        return VerbList(parser.add_subparsers(required=True, metavar="VERB"), self.common, f"{self.prefix}{name} ")


def columns_files(given: Sequence[str]) -> tuple[Path | None, dict[Path, Path]]:
    """Separate the columns file of all recordings from those of single recordings.

    Args:
        given: values of `--columns`, `FILE` or `RECORDING=FILE`.

    Returns:
        The file of all, if any, and that of each recording that has its own.

    Raises:
        UsageError: two for one recording, or for all.
    """
    of_all: list[Path] = []
    of_one: dict[Path, Path] = {}
    for words in given:
        recording, equals, file = words.partition("=")
        if not equals or Path(words).is_file():
            of_all.append(Path(words))
        elif Path(recording) in of_one:
            raise UsageError(f"--columns {words}: {recording} has a columns file already")
        else:
            of_one[Path(recording)] = Path(file)
    if len(of_all) > 1:
        raise UsageError(
            f"--columns {of_all[1]}: one file is for all recordings; write RECORDING=FILE for those that differ"
        )
    return (of_all[0] if of_all else None), of_one


def payload_files_of(given: Sequence[str]) -> dict[Path, Path]:
    """Return the file of the known payload of each recording.

    Args:
        given: values of `--payload`, `RECORDING=FILE`.

    Raises:
        UsageError: no recording or no file in one, or two for one recording.
    """
    found: dict[Path, Path] = {}
    for words in given:
        recording, equals, file = words.partition("=")
        if not (recording and equals and file):
            raise UsageError(f"--payload {words}: write RECORDING=FILE, the recording and the file of its known load")
        if Path(recording) in found:
            raise UsageError(f"--payload {words}: {recording} has a payload already")
        found[Path(recording)] = Path(file)
    return found


def seed(text: str) -> int:
    """Parse a whole number, 0 or more."""
    if not text.isdigit():
        raise argparse.ArgumentTypeError("a seed is a whole number, 0 or more")
    return int(text)


def replicates(text: str) -> int:
    """Parse a number of bootstrap replicates: 0, or at least the 2 that a spread needs."""
    if not text.isdigit() or int(text) == 1:
        raise argparse.ArgumentTypeError("a number of replicates is 0, or 2 and more")
    return int(text)


def weight(text: str) -> float:
    """Parse a finite number, 0 or more."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value < float("inf"):
        raise argparse.ArgumentTypeError("a weight is a number, 0 or more")
    return value


def count(text: str) -> int:
    """Parse a whole number, 1 or more."""
    if not text.isdigit() or int(text) == 0:
        raise argparse.ArgumentTypeError("a whole number, 1 or more, is needed")
    return int(text)


def workers(text: str) -> int:
    """Parse a number of processes, from 1 to 64."""
    if not text.isdigit() or not 1 <= int(text) <= 64:
        raise argparse.ArgumentTypeError("a number of processes is from 1 to 64")
    return int(text)


def frequency(text: str) -> float:
    """Parse a finite number above 0 [Hz]."""
    return _positive(text, "a frequency is a number of Hz above 0")


def seconds(text: str) -> float:
    """Parse a finite number above 0 [s]."""
    return _positive(text, "a number of seconds above 0 is needed")


def share(text: str) -> float:
    """Parse a number from 0 to below 1."""
    value = weight(text)
    if not value < 1.0:
        raise argparse.ArgumentTypeError("a share is a number from 0 to below 1")
    return value


def speed(text: str) -> float:
    """Parse a number above 0 and at most 1."""
    value = _positive(text, "a speed is a share above 0 and at most 1")
    if value > 1.0:
        raise argparse.ArgumentTypeError("a speed is a share above 0 and at most 1")
    return value


def _positive(text: str, otherwise: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(otherwise)
    return value


def delay(text: str) -> float | str:
    """Parse a delay [s] of less than 1 s in magnitude, or `estimate` or `choose`."""
    if text in ("estimate", "choose"):
        return text
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < 1.0:
        raise argparse.ArgumentTypeError("a delay is a number of seconds below 1, 'estimate' or 'choose'")
    return value
