"""Verbs print the same text with `--server` as without, except for places of files and ids."""

from __future__ import annotations

import argparse
import re
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from daemon.conftest import quick_text
from daemon.served import daemon_thread
from daemon.verbs_bench import ON_A_BUS, on_a_bus, unstable_text

import ident_service.cli
from ident_service.cli import main
from ident_service.motion.command_channel import ControlFile
from ident_service.registry.state_folder import arm_fault_store, control_path

RUN, OTHER = "20260101T000000Z-quick", "20260102T000000Z-quick"
PARAMETERS = f"{RUN}/parameters.json"
# What differs: ids and numbers, hours, sizes and hashes of files with either of them, and a file that is here alone.
DIFFERS = (
    (re.compile(r"\b\d{8}T\d{6}Z-(\d{8}T\d{6}Z-)?quick(-[0-9a-f]{6})?\b"), "ID"),
    (re.compile("runs/ID/parameters.json"), "ID"),  # a daemon knows parameters by their run
    (re.compile(r"\d{4}-\d{2}-\d{2}[ T]\d{2}:\d{2}(:\d{2})?"), "NOW"),
    (re.compile(r"\d+\.\d+ M(i?B)"), "SIZE"),
    (re.compile(r"(?<=run\.mcap )[0-9a-f]{12}"), "HASH"),
    (re.compile("; current: .*"), ""),
    (re.compile(r"(?m)^(due|alarm|schedule) \d+|(acceptance|set of) \d+|accepted/\d+|^ *\d+(?=  quick )"), "NUMBER"),
)
Said = Callable[..., str]


@pytest.fixture
def said(
    state: Path, commissioned: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Iterator[Said]:
    """The answer of a verb, which is the same here and over a daemon: `ARM` is a description here, a name there."""
    for run in (RUN, OTHER):
        shutil.copytree(commissioned, state / "runs" / run)
    here, bus, printed = state.parent / "here", on_a_bus(), list[str]()
    here.mkdir()
    texts = {
        "quick": quick_text(),
        "unstable": unstable_text().replace("name: quick", "name: unstable"),
        ON_A_BUS: bus["description"],
    }
    for name, text in {f"{arm}.yaml": text for arm, text in texts.items()}.items() | bus["files"].items():
        (here / name).write_text(text)
    print_answer = ident_service.cli.print_answer

    def record(arguments: argparse.Namespace, code: int, text: str, document: dict[str, Any], last: str = "") -> None:
        printed.append(text + last)
        print_answer(arguments, code, text, document, last)

    monkeypatch.setattr(ident_service.cli, "print_answer", record)
    with daemon_thread(state) as client:
        for arm, text in texts.items():
            client.add_arm(text, bus["files"] if arm == ON_A_BUS else {})
        while len(client.get("/api/v1/runs")) < 2:
            time.sleep(0.05)
        there = ["--server", client.url]

        def plain(text: str) -> str:
            for arm in texts:
                text = text.replace(f"{here / arm}.yaml", arm)
            for words in (f" --server {client.url}", f" --state {state}", f"{state}/"):
                text = text.replace(words, "")
            for pattern, word in DIFFERS:
                text = pattern.sub(word, text)
            return text

        def ask(*words: object, code: int = 0, arm: str = "quick", before: Callable[[], None] = lambda: None) -> str:
            found = []
            for place, more in (("here", []), ("there", there)):
                before()
                out = str(state.parent / f"out-{place}-{len(printed)}")
                named = {"OUT": out, "ARM": arm if more else str(here / f"{arm}.yaml")}
                named |= {PARAMETERS: RUN if more else str(state / "runs" / PARAMETERS)}
                named |= {
                    "RECORDING": f"{RUN}/validation.mcap" if more else str(state / "runs" / RUN / "validation.mcap")
                }
                given = [named.get(str(one), str(one)) for one in words]
                assert main([*given, *more, "--state", str(state)]) == code, (given, capsys.readouterr().err)
                found.append(plain(printed[-1].replace(out, "OUT")))
            assert found[1] == found[0]
            return found[0]

        yield ask


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_answers_of_computations_are_the_same(said: Said) -> None:
    assert "13 base parameters of 28 link parameters" in said("base-parameters", "ARM")
    assert "all limits are kept" in said("preview", "ARM")
    assert "CANNOT MOVE" in said("config", "check", "ARM", arm="unstable", code=3)
    assert "designed motion for quick" in said("design", "ARM", "--starts", 1, "--motion", "postures")
    assert said("verify", PARAMETERS).startswith("ID: consistent")
    assert said("feasible", PARAMETERS, "--arm", "ARM").startswith("ID: feasible (pseudo_inertia)")
    assert said("project", PARAMETERS, "--out", "OUT").startswith("OUT: feasible")
    assert "UNCHANGED" in said("compare", RUN, OTHER)
    assert said("payload", RUN, "RECORDING", "--out", "OUT", code=3).endswith("\nnext: ident export ID\n")
    assert "OUT: SIZE" in said("report", RUN, "--out", "OUT")
    assert "not in this format: gravity" in said("export", RUN, "--format", "urdf,csv", "--out", "OUT")
    assert "  correlation.svg\n" in said("figures", RUN, "--out", "OUT")
    assert "comparison with the true parameters" in said("simulate", "ARM")
    assert "USE WITH CARE" in said("identify", "RECORDING", "--arm", "ARM")


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_answers_at_an_arm_are_the_same(said: Said, state: Path) -> None:
    assert "every configured drive is there" in said("bus", "scan", "ARM", arm=ON_A_BUS)
    assert "fits\n" in said("bus", "load", "ARM", arm=ON_A_BUS)
    assert "every drive can be driven" in said("bus", "probe", "ARM", arm=ON_A_BUS)
    assert "home is set" in said("set-home", "ARM", "--confirm", ON_A_BUS, arm=ON_A_BUS)
    assert "25 cycles, 0 frames lost" in said("watch", "ARM", "--seconds", 0.2)
    assert "NOT ALLOWED TO MOVE" in said("preflight", "ARM", "--confirm", "unstable", arm="unstable", code=3)
    assert "the arm may move until NOW UTC" in said("preflight", "ARM", "--confirm", "quick")
    assert "\nfiles: runs/ID\n  arm.json\n" in said("run", "ARM", "--confirm", "quick")

    def latch() -> None:
        arm_fault_store(state, "quick").latch("late_cycle", "a cycle came late")

    assert "NOT USABLE YET" in said("recover", "ARM", code=3, before=latch)
    assert "quick: acknowledged late_cycle" in said("acknowledge", "ARM", "late_cycle", before=latch)
    assert said("stop", "ARM").startswith("quick is not moving; motions requested before now will not begin\n")
    assert said("stop").startswith("no arm is moving; ")
    with ControlFile.take(control_path(state, "quick"), None):
        assert said("pause", "ARM").startswith("quick: pause requested\n")
        assert said("finish", "ARM").startswith("quick: early end requested\n")
        assert said("stop", "ARM").startswith("stop requested of quick\n")


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_answers_of_the_registry_are_the_same(said: Said, state: Path) -> None:
    for words in ("arms", "runs", "motions", "tokens", "schedules", "due", "alarms"):
        said(words)
    assert said("schedules", "add", "quick", "--cron", "0 6 * * mon").endswith(
        ", next NOW UTC\nnext: ident schedules\n"
    )
    assert "nothing is due after it" in said("maintenance", "quick", "--what", "oil")
    said("schedules", "add", "quick", "--maintenance")
    assert "disabled" in said("schedules", "disable", 1)
    assert "has been accepted" in said("maintenance", "quick", "--what", "oil")
    assert said("prune", "--keep", 1).endswith(", would be deleted; add --yes\nnext: ident prune --keep 1 --yes\n")
    assert said("accept", RUN, "--note", "good").startswith("quick: NUMBER is the current one (ID)\n")
    assert "is the current one, the NUMBER (ID)\n" in said("rollback", "quick", "--to", 1, "--note", "back")
    assert "UNCHANGED" in said("reidentify", "ARM", "--confirm", "quick")
