"""Help: verbs in groups, one short line each, examples that are commands; mistakes are answered with what was meant."""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
from cli.conftest import Ident

from ident_service.cli import parser
from ident_service.cli.arguments import HELP_GROUPS, LOCAL_ONLY, Parser

COLUMNS = 80
COMING = {"schema", "view"}  # of which this checkout may have neither


def shown(top: Parser, words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Parser]]:
    """Every verb and noun that help names, with its parser."""
    for action in top._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name in top.shown:
                sub = action.choices[name]
                yield (*words, name), sub
                yield from shown(sub, (*words, name))


TOP = parser()
SHOWN = dict(shown(TOP))


def test_help_lists_every_verb_once_in_its_group(ident: Ident) -> None:
    lines = ident("--help").out.splitlines()
    assert max(map(len, lines)) <= COLUMNS
    named, title = dict[str, list[str]](), ""
    for line in lines:
        if line in HELP_GROUPS:
            title = line
        elif title and (found := re.match(r"  ([a-z][a-z-]*)  +(\S.*)", line)):
            named.setdefault(title, []).append(found[1])
    top = {words[0] for words in SHOWN if len(words) == 1}
    assert set(named) == {"Describe", "Move", "Identify", "Operate"}
    assert {title: set(names) for title, names in named.items()} == {
        title: set(names) & top for title, names in HELP_GROUPS.items()
    }
    listed = [name for names in HELP_GROUPS.values() for name in names]
    assert len(listed) == len(set(listed))
    assert top <= set(listed) <= top | COMING


@pytest.mark.parametrize("words", SHOWN, ids=" ".join)
def test_each_verb_is_explained_in_eighty_columns_with_examples_that_are_commands(
    words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(COLUMNS))
    sub = SHOWN[words]
    text = sub.format_help()
    assert max(map(len, text.splitlines())) <= COLUMNS
    if sub.get_default("verb") is None:  # a noun that needs a verb
        assert not sub.get_default("examples")
        return
    examples = re.findall(r"(?m)^  (ident .+)$", text.partition("examples:\n")[2])
    assert 2 <= len(examples) <= 3
    for example in examples:
        assert TOP.parse_args(shlex.split(example)[1:]).word == " ".join(words), example


@pytest.mark.parametrize("words", SHOWN, ids=" ".join)
def test_a_verb_has_the_shared_options_only_where_they_mean_something(words: tuple[str, ...]) -> None:
    sub, word = SHOWN[words], " ".join(words)
    if sub.get_default("verb") is None:
        return
    options = {option for action in sub._actions for option in action.option_strings}
    assert ("--server" in options) == (word not in LOCAL_ONLY)
    assert {"--json", "--state"} <= options


MEANT = [
    (("stopp",), "unknown verb 'stopp'; did you mean stop?"),
    (("schedul",), "unknown verb 'schedul'; did you mean schedules?"),
    (("preflihgt", "planar2"), "unknown verb 'preflihgt'; did you mean preflight?"),
    (("bus", "lod"), "unknown verb 'lod'; did you mean load?"),
    (("bus", "xyzzy"), "it is one of load, scan, probe, import, store, restore, report"),
    (("design", "planar2", "--sede", "3"), "unknown option --sede; did you mean --seed?"),
    (("home", "planar2", "--zerro"), "unknown option --zerro"),
    (("simulate", "--feasible-set", "inertai"), "did you mean inertia?"),
    (("serve", "--server", "http://x"), "--server is not for `ident serve`: it is the daemon"),
    (("jobs", "--most", "3", "show", "x"), "--most is for `ident jobs` without 'show'"),
    (("schedules", "add", "planar2", "--hours", "x"), "a number of hours above 0 is needed"),
]


@pytest.mark.parametrize(("words", "message"), MEANT)
def test_a_mistake_is_answered_with_what_was_meant_and_no_hidden_word(
    ident: Ident, words: tuple[str, ...], message: str
) -> None:
    ended = ident(*words)
    assert (ended.code, ended.out) == (2, "")
    assert message in ended.err
    assert not re.search(r"\b(rehearse|correct|base|check|ack|--zero|list)\b", ended.err)
    assert ended.err.count("\n") == 2


def test_completion_answers_a_program_too(ident: Ident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = ident("completion", "bash").out
    assert ident("completion", "bash", "--json").json == {
        "shell": "bash",
        "script": script,
        "file": None,
        "exit_code": 0,
    }
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    written = ident("completion", "fish", "--install", "--json").json
    assert Path(written["file"]).read_text(encoding="utf-8") == written["script"]


@pytest.mark.parametrize("words", ["run planar2 m.json --speed 0.5", "identify a.mcap b.mcap --arm wam7"])
def test_arguments_may_stand_behind_options(words: str) -> None:
    first, *rest = words.split()
    place = next(i for i, word in enumerate(rest) if word.startswith("--"))
    mixed = [first, *rest[: place - 1], *rest[place:], rest[place - 1]]
    found, meant = vars(TOP.parse_args(mixed)), vars(TOP.parse_args(words.split()))
    assert found == meant


def test_an_argument_too_many_is_refused_wherever_it_stands(ident: Ident) -> None:
    for words in (("run", "planar2", "--speed", "0.5", "m.json", "n.json"), ("stop", "--state", "s", "planar2", "x")):
        ended = ident(*words)
        assert (ended.code, ended.err.splitlines()[0]) == (
            2,
            f"ident {words[0]}: error: unexpected argument '{words[-1]}'",
        )


def test_an_empty_name_is_not_the_working_directory(
    ident: Ident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    ended = ident("preview", "planar2", "--out", "")
    assert ended.code == 2
    assert "argument --out: a name is needed" in ended.err


def test_options_before_the_verb_of_a_noun_count() -> None:
    for words in (["jobs", "--json", "--state", "s", "show", "x"], ["jobs", "show", "x", "--json", "--state", "s"]):
        found = TOP.parse_args(words)
        assert (found.json, found.state, found.job) == (True, "s", "x")


def test_colours_are_for_terminals_that_want_them(monkeypatch: pytest.MonkeyPatch) -> None:
    from io import StringIO

    from ident_service.cli.output import styled

    class Terminal(StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    assert styled(Terminal(), "x", "error") == "\x1b[1;31mx\x1b[0m"
    assert styled(StringIO(), "x", "error") == styled(None, "x", "error") == "x"
    monkeypatch.setenv("NO_COLOR", "1")
    assert styled(Terminal(), "x", "error") == "x"
