"""Words that no verb understands, under `--json`: one JSON object on stdout, the usual text on stderr."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest
from cli.conftest import Ident

from ident_service.cli import GROUPS, main, parser
from ident_service.cli.arguments import Parser, VerbList, asks_for_json

WRONG = [
    ((), "a verb is needed"),
    (("fly",), "unknown verb 'fly'"),
    (("simulate", "--seed", "-1"), "argument --seed: a seed is a whole number, 0 or more"),
    (
        ("simulate", "--feasible-set", "magic"),
        "argument --feasible-set: 'magic' is none of pseudo_inertia, inertia, none",
    ),
    (("simulate", "planar2", "wam7_sim"), "unexpected argument 'wam7_sim'"),
    (("identify", "a.mcap"), "the following arguments are required: --arm"),
    (("identify", "a.mcap", "--arm", "x", "--bootstrap", "1"), "a number of replicates is 0, or 2 and more"),
    (("identify", "a.mcap", "--arm", "x", "--prior-weight", "inf"), "a weight is a number, 0 or more"),
    (("identify", "a.mcap", "--arm", "x", "--delay", "nan"), "a number of seconds below 1, 'estimate' or 'choose'"),
    (("correct", "ä\u2028.json"), "the following arguments are required: --out"),
    (("config",), "a verb is needed: check"),
    (("config", "mend", "a.yaml"), "unknown verb 'mend'; it is one of check"),
]


@pytest.mark.parametrize(("words", "message"), WRONG)
def test_the_reason_is_printed_as_json_too(ident: Ident, words: tuple[str, ...], message: str) -> None:
    plain, as_json = ident(*words), ident(*words, "--json")
    assert plain.code == as_json.code == 2
    assert plain.out == ""
    assert as_json.json.keys() == {"error", "exit_code"}
    error = as_json.json["error"]
    assert error["kind"] == "UsageError"
    assert message in error["message"]
    assert as_json.out.count("\n") == 1
    said, help_line = as_json.err.splitlines()[-2:]
    assert said.endswith(f": error: {error['message']}")
    assert re.fullmatch(r"help: ident.* --help", help_line)


@pytest.mark.parametrize("stderr", ["closed", "full"])
@pytest.mark.parametrize("words", [("fly",), (), ("design", "planar2", "--seed", "-1")])
def test_wrong_words_are_exit_code_2_although_nobody_reads_why(
    monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], stderr: str
) -> None:
    with open("/dev/full", "w") as full:  # noqa: PTH123 - a device
        monkeypatch.setattr(sys, "stderr", full if stderr == "full" else None)
        with pytest.raises(SystemExit) as ended:
            main(words)
    assert ended.value.code == 2


def test_json_among_the_words_counts_wherever_it_stands(ident: Ident) -> None:
    assert ident("--json", "base", "planar2").json["error"]["kind"] == "UsageError"
    assert ident("base", "--js").json["error"]["message"] == "the following arguments are required: ARM"
    # After two dashes there are names only.
    ended = ident("base", "--", "planar2", "--json")
    assert (ended.code, ended.out) == (2, "")


@pytest.mark.parametrize("word", ["--j", "--js", "--json"])
def test_argparse_s_own_abbreviations_of_json(word: str) -> None:
    assert asks_for_json([word])
    assert parser().parse_args(["base", "planar2", word]).json


@pytest.mark.slow
@pytest.mark.parametrize("words", [(), ("--",), ("-",), ("json",), ("--jsonl",), ("--state=--json",), ("--", "--json")])
def test_what_does_not_ask_for_json(words: tuple[str, ...]) -> None:
    assert not asks_for_json(words)


def test_a_process_of_its_own_says_it_too() -> None:
    command = [sys.executable, "-W", "error", "-m", "ident_service", "feasible", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 2
    message = "the following arguments are required: FILE"
    assert done.stdout == f'{{"error": {{"kind": "UsageError", "message": "{message}"}}, "exit_code": 2}}\n'
    assert done.stderr == f"ident feasible: error: {message}\nhelp: ident feasible --help\n"


def test_wrong_words_end_the_command_as_argparse_does() -> None:
    with pytest.raises(SystemExit) as end:
        main(["fly"])
    assert end.value.code == 2


def test_every_group_adds_verbs_of_its_own() -> None:
    top = parser()
    for group in GROUPS:
        # A second registration of the same words must collide: each group really adds to the list it is given.
        alone = VerbList.of(Parser(prog="ident"))
        group.add(alone)
        assert alone.parser.shown
        assert set(alone.parser.shown) <= set(top.shown)
