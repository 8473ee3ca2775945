"""Parse command-line arguments: the parser, the list of verbs with their help, and converters for numbers."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from ident_service.cli.output import USAGE, Answer, print_to_person, styled
from ident_service.errors import UsageError

FEASIBLE_SETS = ("pseudo_inertia", "inertia")
_WIDEST = 100  # columns of help, on a terminal however wide
_EXAMPLES = "examples:\n"
N = TypeVar("N", int, float)

# Verbs and nouns in the order of use, as `ident --help` lists them; a test keeps it complete.
HELP_GROUPS: dict[str, tuple[str, ...]] = {
    "Describe": ("new", "config", "schema", "base-parameters", "arms", "bus", "driver", "doctor", "emulate"),
    "Move": (
        *("design", "preview", "motions", "watch", "preflight", "run", "stop", "pause", "resume", "finish"),
        *("supported", "acknowledge", "recover", "home", "set-home"),
    ),
    "Identify": (
        *("simulate", "identify", "report", "figures", "view", "export", "compare", "payload", "verify", "feasible"),
        *("project", "fleet"),
    ),
    "Operate": (
        *("serve", "jobs", "runs", "accept", "rollback", "reidentify", "schedules", "maintenance", "due", "alarms"),
        *("tokens", "import", "prune", "backup", "restore", "completion"),
    ),
}

LOCAL_ONLY: dict[str, str] = {
    "serve": "it is the daemon",
    "schema": "it is the same for every machine of this version",
    "completion": "it is for the shell that it is typed into",
    "doctor": "it looks at the computer that it runs on; log in where the daemon runs",
    "fleet status": "its store is in the daemon's state folder; log in where the daemon runs",
    "emulate": "it is drives on a bus of this machine, until they are switched off",
    "driver test": "it may energise an arm that you must stand beside; log in where the daemon runs",
    "new": "it writes files beside yours; `ident config check --server` sends what it wrote",
    "import": "a run with its recordings is larger than a request may be; copy its folder to the daemon's machine",
    **dict.fromkeys(
        ("bus import", "bus store", "bus restore"), "it changes what drives keep; it is an act at the arm's computer"
    ),
    "view": "a viewer opens where you sit; copy the run's folder from the daemon's machine",
    "bus report": "it writes a file beside you; log in where the daemon runs",
    **dict.fromkeys(("backup", "restore"), "it is done at the daemon's machine, in its state folder"),
    "tokens add": "whoever got hold of an operator's token could make others that outlive it; "
    "it is done at the daemon's machine, in its state folder",
}
"""Verbs that no daemon does, each with the reason; they have no option `--server`."""


class ArgumentsError(SystemExit):
    """Exit after arguments that no verb understands; the reason is on stderr already."""

    def __init__(self, message: str) -> None:
        self.message = message
        super().__init__(USAGE)


class _Help(argparse.HelpFormatter):
    """Help of one verb: examples keep their lines, all else is filled to the width of the terminal."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=28)
        self._width = min(self._width, _WIDEST)

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return text if text.startswith(_EXAMPLES) else super()._fill_text(text, width, indent)


class Parser(argparse.ArgumentParser):
    """Argument parser that answers mistakes with the nearest word that exists, and never with hidden ones.

    Attributes:
        shown: verbs that help and messages name, each with its line of help; former names are understood besides.
        absent: options that this verb does not have and others do, each with the reason.
    """

    def __init__(self, **rest: Any) -> None:
        super().__init__(formatter_class=_Help, **rest)
        self.shown: dict[str, str] = {}
        self.absent: dict[str, str] = {}
        self._intermixing = False  # while arguments are parsed again, options first

    def error(self, message: str) -> NoReturn:
        """Print the message and where help is to stderr, and raise ArgumentsError.

        Raises:
            ArgumentsError: always.
        """
        if message.endswith("required: VERB"):
            message = f"a verb is needed: {', '.join(self.shown)}" if self.shown else message
        head = styled(sys.stderr, f"{self.prog}: error:", "error")
        print_to_person(f"{head} {message}\nhelp: {self.prog} --help\n")
        raise ArgumentsError(message)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse as argparse does, but raise ArgumentsError, in this verb's name, for unknown arguments.

        Before Python 3.12.7, argparse alone takes a positional argument that may be left out only before options.
        """
        found, rest = super().parse_known_args(args, namespace)
        if self._intermixing:
            return found, rest
        if rest and self._subparsers is None and not any(word.startswith("-") for word in rest):
            self._intermixing = True
            try:
                found, rest = self.parse_known_intermixed_args(args, namespace)
            finally:
                self._intermixing = False
        if rest:
            self.error(self._unknown(rest[0]))
        return found, rest

    def _get_value(self, action: argparse.Action, arg_string: str) -> Any:
        if action.type is Path and not arg_string:
            raise argparse.ArgumentError(action, "a name is needed; an empty one would be the working directory")
        return super()._get_value(action, arg_string)

    def _unknown(self, word: str) -> str:
        option = word.partition("=")[0]
        if option in self.absent:
            return f"{option} is not for `{self.prog}`: {self.absent[option]}"
        if not option.startswith("-") or option == "-":
            return f"unexpected argument {word!r}"
        options = (
            name
            for one in self._actions
            if one.help != argparse.SUPPRESS
            for name in one.option_strings
            if name != "-h"
        )
        return f"unknown option {option}{did_you_mean(option, options)}"

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is None or value in action.choices:
            return
        if isinstance(action, argparse._SubParsersAction):
            near = did_you_mean(value, self.shown)
            known = "" if near or len(self.shown) > 9 else f"; it is one of {', '.join(self.shown)}"
            self.error(f"unknown verb {value!r}{near}{known}")
        choices = [str(one) for one in action.choices]
        raise argparse.ArgumentError(action, f"{value!r} is none of {', '.join(choices)}{did_you_mean(value, choices)}")


class _Verbs(argparse._SubParsersAction):  # type: ignore[type-arg]
    """List of verbs that keeps the options which stand before a verb, as in `ident jobs --json show ID`."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        given = {key: value for key, value in vars(namespace).items() if value != parser.get_default(key)}
        super().__call__(parser, namespace, values, option_string)
        for key, value in given.items():
            if key not in ("json", "server", "state"):
                parser.error(f"--{key.replace('_', '-')} is for `{parser.prog}` without {values[0]!r}")
            setattr(namespace, key, value)


def did_you_mean(word: str, known_words: Iterable[str]) -> str:
    """Return `; did you mean X?` for the nearest of the known words; empty where none is near."""
    from difflib import get_close_matches

    near = get_close_matches(str(word), list(known_words), 1)
    return f"; did you mean {near[0]}?" if near else ""


def asks_for_json(words: Sequence[str]) -> bool:
    """Return whether `--json`, or a prefix that argparse accepts for it, is among unparsed arguments."""
    options = takewhile(lambda word: word != "--", words)
    return any(len(word) > 2 and "--json".startswith(word) for word in options)


class TopParser(Parser):
    """Parser of `ident` itself, whose help lists the verbs in groups."""

    def error(self, message: str) -> NoReturn:
        """Print the message, after the whole help where no verb was given, to stderr, and raise ArgumentsError.

        Raises:
            ArgumentsError: always.
        """
        if message.endswith("required: VERB"):
            print_to_person(self.format_help())
            message = "a verb is needed"
        super().error(message)

    def format_help(self) -> str:
        """Return the help: one short line for each verb and noun."""
        lines = ["usage: ident VERB ...", "", str(self.description)]
        left = set(self.shown)
        for title, names in HELP_GROUPS.items():
            there = [name for name in names if name in left]
            left -= set(there)
            lines += ["", styled(sys.stdout, title, "heading")]
            lines += [f"  {name:<17}{self.shown[name]}" for name in there]
        lines += [f"  {name:<17}{self.shown[name]}" for name in sorted(left)]
        lines += ["", f"{'ident VERB --help':<19}explains a verb, with examples", f"{'ident --version':<19}version"]
        return "\n".join([*lines, ""])


@dataclass(frozen=True)
class VerbList:
    """List of verbs that a group registers its own with.

    Attributes:
        commands: argparse's list of verbs.
        parser: parser that has these verbs.
        prefix: the words before the verb, with a space behind them.
    """

    commands: argparse._SubParsersAction[Parser]
    parser: Parser
    prefix: str = ""

    @classmethod
    def of(cls, parser: Parser) -> VerbList:
        """Add subcommands to a parser and return their list, which is still empty."""
        return cls(parser.add_subparsers(required=True, metavar="VERB", action=_Verbs, parser_class=Parser), parser)

    def add(
        self,
        name: str,
        run: Callable[[argparse.Namespace], Answer] | None,
        text: str,
        *,
        more: str = "",
        examples: Sequence[str] = (),
        former: str | None = None,
        hidden: bool = False,
        stands_for: str | None = None,
    ) -> Parser:
        """Add a verb with its help and the function that runs it; return its parser, to add arguments to.

        Args:
            name: the word.
            run: function that carries out the verb and returns its answer; None for a noun that another verb must
                follow.
            text: one short line of help.
            more: further sentences of its own help.
            examples: arguments after the verb; one string each, as typed.
            former: the verb's earlier name, which is still understood and not listed.
            hidden: leave the verb out of the list of verbs.
            stands_for: the verb that a hidden one stands for; itself when None.
        """
        word = stands_for or f"{self.prefix}{name}"
        if not hidden:
            self.parser.shown[name] = text
        parser = self.commands.add_parser(name) if hidden else self.commands.add_parser(name, help=text)
        _describe(parser, word, text, more, examples)
        if run is not None:
            _answer(parser, word, run)
        if former is not None:
            self.alias(former, parser)
        return parser

    def alias(self, name: str, parser: Parser) -> None:
        """Let a former name stand for a verb; it is understood, and shown nowhere."""
        self.commands.choices[name] = parser

    def group(
        self,
        name: str,
        text: str,
        run: Callable[[argparse.Namespace], Answer] | None = None,
        *,
        more: str = "",
        examples: Sequence[str] = (),
        former: str | None = None,
        hidden: bool = False,
    ) -> VerbList:
        """Add a noun followed by verbs of its own, as in `ident config check`; return the list to add these verbs to.

        Args:
            name: the noun.
            text: one short line of help.
            run: function that answers the bare noun, by a list as a rule; None where a verb must follow.
            more: further sentences of its help.
            examples: as for `add`.
            former: earlier name of the noun.
            hidden: leave it out of the list of verbs.
        """
        parser = self.add(name, run, text, more=more, examples=examples, former=former, hidden=hidden)
        verbs = parser.add_subparsers(required=run is None, metavar="VERB", action=_Verbs, parser_class=Parser)
        return VerbList(verbs, parser, f"{self.prefix}{name} ")


def _describe(parser: Parser, word: str, text: str, more: str, examples: Sequence[str]) -> None:
    sentence = f"{text[:1].upper()}{text[1:]}."
    parser.description = f"{sentence} {more}" if more else sentence
    words = tuple(f"{word} {one}".rstrip() for one in examples)
    if words:
        parser.epilog = _EXAMPLES + "\n".join(f"  ident {one}" for one in words)
    parser.set_defaults(examples=words)


def _answer(parser: Parser, word: str, run: Callable[[argparse.Namespace], Answer]) -> None:
    """Add the options that a verb shares with others, and what is to be run."""
    parser.add_argument("--json", action="store_true", help="print one JSON object on stdout and nothing else")
    parser.add_argument("--with-text", action="store_true", help=argparse.SUPPRESS)  # of a daemon
    if word in LOCAL_ONLY:
        parser.absent["--server"] = LOCAL_ONLY[word]
    else:
        text = "run it on the daemon there; runs, motions and jobs are named by id"
        parser.add_argument("--server", metavar="URL", help=text)
    parser.add_argument(
        "--state", metavar="DIR", help="state folder (default: $IDENT_STATE, or the user's XDG state folder)"
    )
    parser.set_defaults(verb=run, word=word, words=parser, json=False, server=None)


def add_arm(sub: argparse.ArgumentParser, *, optional: bool = False, motion: bool = False) -> None:
    """Add the argument ARM to a verb, and with `motion` an optional argument MOTION, a file."""
    text = "description file, or the name of a shipped one"
    sub.add_argument("arm", nargs="?" if optional else None, metavar="ARM", help=text)
    if motion:
        text = "motion.json; default: the description's"
        sub.add_argument("motion", nargs="?", type=Path, metavar="MOTION", help=text)


def add_repeatable(sub: Parser, option: str, metavar: str, text: str, parse: Callable[[str], Any] = str) -> None:
    """Add an option that may be given several times; its value is the list of what `parse` makes of each text."""
    sub.add_argument(option, action="append", default=[], type=parse, metavar=metavar, help=text)


def columns_files(option_values: Sequence[str]) -> tuple[Path | None, dict[Path, Path]]:
    """Split `--columns` values into (file for all recordings or None, {recording: its own file}).

    Args:
        option_values: values of `--columns`, `FILE` or `RECORDING=FILE`.

    Returns:
        The file of all, if any, and that of each recording that has its own.

    Raises:
        UsageError: two for one recording, or for all.
    """
    of_all: list[Path] = []
    of_one: dict[Path, Path] = {}
    for words in option_values:
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


def payload_files_of(option_values: Sequence[str]) -> dict[Path, Path]:
    """Map each recording to the file of its known payload, from `--payload` values `RECORDING=FILE`.

    Args:
        option_values: values of `--payload`, `RECORDING=FILE`.

    Raises:
        UsageError: no recording or no file in one, or two for one recording.
    """
    found: dict[Path, Path] = {}
    for words in option_values:
        recording, equals, file = words.partition("=")
        if not (recording and equals and file):
            raise UsageError(f"--payload {words}: write RECORDING=FILE, the recording and the file of its known load")
        if Path(recording) in found:
            raise UsageError(f"--payload {words}: {recording} has a payload already")
        found[Path(recording)] = Path(file)
    return found


def _number(refusal: str, accepts: Callable[[float], bool], read: Callable[[str], N]) -> Callable[[str], N]:
    """Return a parser of numbers that argparse calls.

    Args:
        refusal: message about text that is none, or that is not accepted.
        accepts: whether a number is in range; false for what is no number (NaN).
        read: function that converts the text; raises ValueError.
    """

    def parse(text: str) -> N:
        with suppress(ValueError):
            if accepts(value := read(text)):
                return value
        raise argparse.ArgumentTypeError(refusal)

    return parse


def _digits(text: str) -> int:
    if not text.isdigit():
        raise ValueError(text)
    return int(text)


seed = _number("a seed is a whole number, 0 or more", lambda value: value >= 0, _digits)
replicates = _number("a number of replicates is 0, or 2 and more", lambda value: value != 1, _digits)
count = _number("a whole number, 1 or more, is needed", lambda value: value >= 1, _digits)
workers = _number("a number of processes is from 1 to 64", lambda value: 1 <= value <= 64, _digits)
weight = _number("a weight is a number, 0 or more", lambda value: 0.0 <= value < math.inf, float)
frequency = _number("a frequency is a number of Hz above 0", lambda value: 0.0 < value < math.inf, float)
seconds = _number("a number of seconds above 0 is needed", lambda value: 0.0 < value < math.inf, float)
hours = _number("a number of hours above 0 is needed", lambda value: 0.0 < value < math.inf, float)
share = _number("a share is a number from 0 to below 1", lambda value: 0.0 <= value < 1.0, float)
speed = _number("a speed is a share above 0 and at most 1", lambda value: 0.0 < value <= 1.0, float)
_delay = _number("a delay is a number of seconds below 1, 'estimate' or 'choose'", lambda value: abs(value) < 1, float)


def parse_delay(text: str) -> float | str:
    """Parse a delay [s] below 1 s in magnitude to a float; return `estimate` and `choose` as they are."""
    return text if text in ("estimate", "choose") else _delay(text)
