"""How words become arguments: the parser, the list that groups of verbs add theirs to, and the kinds of number.

Boundary: words in, `argparse.Namespace` out; nothing is printed but usage, and no file is looked at.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any, NoReturn

from ident_service.cli.answer import USAGE, Answer
from ident_service.errors import UsageError

FEASIBLE_SETS = ("pseudo_inertia", "inertia")


class WrongWords(SystemExit):
    """No verb understands the words; usage and reason are on stderr already."""

    def __init__(self, message: str) -> None:
        self.message = message
        super().__init__(USAGE)


class Parser(argparse.ArgumentParser):
    """Ends with `WrongWords` where argparse only exits, so that the reason can be printed as JSON too."""

    def error(self, message: str) -> NoReturn:
        """Say on stderr what argparse says, and end.

        Raises:
            WrongWords: always.
        """
        self.print_usage(sys.stderr)
        sys.stderr.write(f"{self.prog}: error: {message}\n")
        raise WrongWords(message)


def asks_for_json(words: Sequence[str]) -> bool:
    """Is `--json`, or what argparse takes for it, among words that could not be parsed?"""
    options = takewhile(lambda word: word != "--", words)
    return any(len(word) > 2 and "--json".startswith(word) for word in options)


@dataclass(frozen=True)
class Verbs:
    """Where a group of verbs adds its own.

    Attributes:
        commands: argparse's list of verbs.
        common: what every verb understands.
        prefix: the words before the verb, with a space behind them.
    """

    commands: argparse._SubParsersAction[Parser]
    common: Parser
    prefix: str = ""

    @classmethod
    def of(cls, parser: Parser) -> Verbs:
        """The list of a command that has verbs and nothing else."""
        common = Parser(add_help=False)
        common.add_argument("--json", action="store_true", help="one JSON object on stdout, nothing else")
        common.add_argument("--server", metavar="URL", help="have a daemon there do it; things are named by its ids")
        common.add_argument("--state", help="state folder (default: $IDENT_STATE, or the user's XDG state folder)")
        return cls(parser.add_subparsers(required=True, metavar="VERB"), common)

    def add(self, name: str, run: Callable[[argparse.Namespace], Answer], text: str, **rest: Any) -> Parser:
        """Add a verb.

        Args:
            name: the word.
            run: answers it.
            text: one line of help.
            rest: for `argparse.ArgumentParser`.

        Returns:
            Its parser, to add arguments to.
        """
        parser = self.commands.add_parser(name, parents=[self.common], help=text, description=text, **rest)
        parser.set_defaults(verb=run, word=f"{self.prefix}{name}", words=parser)
        return parser

    def group(self, name: str, text: str) -> Verbs:
        """Add a word that verbs of its own follow, as in `ident config check`."""
        parser = self.commands.add_parser(name, help=text)
        return Verbs(parser.add_subparsers(required=True, metavar="VERB"), self.common, f"{self.prefix}{name} ")


def columns_files(given: Sequence[str]) -> tuple[Path | None, dict[Path, Path]]:
    """Tell the columns file of all recordings from those of one each.

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


def seed(text: str) -> int:
    """A whole number, 0 or more."""
    if not text.isdigit():
        raise argparse.ArgumentTypeError("a seed is a whole number, 0 or more")
    return int(text)


def replicates(text: str) -> int:
    """A number of replicates of which a spread can be taken, or 0."""
    if not text.isdigit() or int(text) == 1:
        raise argparse.ArgumentTypeError("a number of replicates is 0, or 2 and more")
    return int(text)


def weight(text: str) -> float:
    """A finite number, 0 or more."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value < float("inf"):
        raise argparse.ArgumentTypeError("a weight is a number, 0 or more")
    return value


def count(text: str) -> int:
    """A whole number, 1 or more."""
    if not text.isdigit() or int(text) == 0:
        raise argparse.ArgumentTypeError("a whole number, 1 or more, is needed")
    return int(text)


def workers(text: str) -> int:
    """A number of processes that a machine may bear."""
    if not text.isdigit() or not 1 <= int(text) <= 64:
        raise argparse.ArgumentTypeError("a number of processes is from 1 to 64")
    return int(text)


def frequency(text: str) -> float:
    """A finite number of Hz above 0."""
    return _positive(text, "a frequency is a number of Hz above 0")


def seconds(text: str) -> float:
    """A finite number of seconds above 0."""
    return _positive(text, "a number of seconds above 0 is needed")


def share(text: str) -> float:
    """From 0 to below 1."""
    value = weight(text)
    if not value < 1.0:
        raise argparse.ArgumentTypeError("a share is a number from 0 to below 1")
    return value


def speed(text: str) -> float:
    """Above 0 and at most 1."""
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
    """Seconds, or a word that asks for them to be found."""
    if text in ("estimate", "choose"):
        return text
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < 1.0:
        raise argparse.ArgumentTypeError("a delay is a number of seconds below 1, 'estimate' or 'choose'")
    return value
