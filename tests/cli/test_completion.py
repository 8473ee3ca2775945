"""Completion at a prompt: what a shell is told when the tabulator key is pressed."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from cli.conftest import Ident

from ident_service.motion.fault_store import FaultStore
from ident_service.registry.arms import register_shipped_arms
from ident_service.registry.database import Database
from ident_service.registry.jobs import add_job

COMMAND = Path(sys.executable).parent / "ident"


# One process with the command loaded answers each line in a child of its own, as argcomplete ends it.
PROGRAM = """
import json, os, sys
from ident_service.cli import parser
from ident_service.cli.completion import complete
for number, (line, shell) in enumerate(json.load(sys.stdin)):
    if os.fork() == 0:
        os.environ |= {"COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE_SHELL": shell}
        os.environ["_ARGCOMPLETE_STDOUT_FILENAME"] = str(number)
        open(str(number), "w").close()
        complete(parser())
    os.wait()
"""
ASKING = {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": "\n", "COMP_TYPE": "9"}


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A state folder with a run, a motion, a job and an active fault."""
    state = tmp_path_factory.mktemp("kept")
    state.chmod(0o700)
    for place in ("runs/20260101T000000Z-planar2", "motions/20260102T000000Z-planar2-abc", "arms/planar2"):
        (state / place).mkdir(parents=True)
    FaultStore(state / "arms" / "planar2").latch("following_error", "j1 lags")
    with Database(state) as db:
        register_shipped_arms(db)
        add_job(db, "20260103T000000Z-planar2-def", "run", "planar2", {}, [], "ann", motion=True, run_id=None)
    return state


CASES = [
    ("ident sto", {"stop"}),
    ("ident c", {"config", "compare", "completion"}),  # neither `check` nor `correct`, the former names
    ("ident config ", {"check"}),
    ("ident design planar2 --se", {"--search-time", "--seed", "--server"}),  # not `--seconds`, a former name
    ("ident simulate --feasible-set ", {"pseudo_inertia", "inertia", "none"}),
    ("ident stop plan", {"planar2"}),
    ("ident acknowledge planar2 ", {"following_error"}),
    ("ident report 2026", {"20260101T000000Z-planar2"}),
    ("ident runs delete ", {"20260101T000000Z-planar2"}),
    ("ident preview planar2 2026", {"20260102T000000Z-planar2-abc"}),
    ("ident jobs show ", {"20260103T000000Z-planar2-def"}),
    ("ident accept x --note ", set()),
    ("ident jobs show --server http://127.0.0.1:9 ", set()),
]


SHELLS = [("bash", "complete -o"), ("zsh", "compdef"), ("fish", "complete --command")]


@pytest.fixture(scope="module")
def offered(kept: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], list[str]]:
    """The words that each shell is offered for each line."""
    folder = tmp_path_factory.mktemp("offered")
    asked = [*((line, "bash") for line, _ in CASES), *(("ident sto", shell) for shell, _ in SHELLS)]
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env={**os.environ, **ASKING, "IDENT_STATE": str(kept)},
        input=json.dumps(asked).encode(),
        capture_output=True,
        timeout=100,
        cwd=folder,
        check=True,
    )
    assert done.stdout == done.stderr == b""
    return {key: (folder / str(number)).read_text().splitlines() for number, key in enumerate(asked)}


@pytest.mark.slow
@pytest.mark.parametrize(("line", "words"), CASES, ids=[line for line, _ in CASES])
def test_words_that_can_follow_are_offered(
    line: str, words: set[str], offered: dict[tuple[str, str], list[str]]
) -> None:
    found = {word.strip() for word in offered[line, "bash"]}
    assert {word for word in found if not word.startswith("-") or line.split()[-1].startswith("-")} == words


def test_bash_completes_by_the_printed_script(ident: Ident, kept: Path) -> None:
    script = ident("completion", "bash").out
    line = "ident acknowledge planar2 fol"
    words = shlex.split(line)
    asking = (
        f"COMP_LINE={shlex.quote(line)}; COMP_POINT={len(line)}; COMP_TYPE=9; COMP_CWORD={len(words) - 1}\n"
        f"COMP_WORDS=({line}); _python_argcomplete ident {words[-1]} {words[-2]}; echo ${{COMPREPLY[@]}}"
    )
    environment = {**os.environ, "IDENT_STATE": str(kept), "PATH": f"{COMMAND.parent}:{os.environ['PATH']}"}
    done = subprocess.run(
        ["bash", "-c", f"{script}\n{asking}"], env=environment, capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout.split() == ["following_error"]


@pytest.mark.parametrize(("shell", "mark"), SHELLS)
def test_each_shell_has_its_script(
    ident: Ident, shell: str, mark: str, offered: dict[tuple[str, str], list[str]]
) -> None:
    assert mark in ident("completion", shell).out
    (word,) = offered["ident sto", shell]
    assert re.split(r"[:\t ]", word)[0] == "stop"


def test_completion_is_installed_where_the_shell_looks(
    ident: Ident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("XDG_DATA_HOME", raising=False)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    assert ident("completion", "bash", "--install").code == 0
    assert "ident" in (tmp_path / "home/.local/share/bash-completion/completions/ident").read_text()
    assert ident("completion", "fish", "--install").code == 0
    assert (tmp_path / "config/fish/completions/ident.fish").is_file()
    refused = ident("completion", "zsh", "--install")
    assert (refused.code, refused.out) == (2, "")
    assert "~/.zshrc" in refused.err
