"""The last line of an answer names the command that follows: right for the state, quoted, and one that runs."""

from __future__ import annotations

import argparse
import json
import shlex
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from cli.conftest import COARSE, Commissioned, Ident, quick_arm
from helpers.tickets import write_checked_ticket

from ident_service.cli import parser
from ident_service.cli.next_command import _FOLLOWS, next_after_error, next_line, with_arm
from ident_service.config.load import load_arm
from ident_service.errors import ArmFault, IdentError, MotionRefused, PersonNeeded, PositionUnknown, UsageError

TOP = parser()


def verbs(top: argparse.ArgumentParser) -> set[str]:
    found = set()
    for action in top._actions:
        if isinstance(action, argparse._SubParsersAction):
            for sub in action.choices.values():
                found |= {sub.get_default("word")} | verbs(sub)
    return found - {None}


def test_every_verb_has_a_next_command_or_is_known_to_have_none() -> None:
    # After these no line follows: their output is for a program, or they end when everything does.
    without = {"serve", "emulate", "completion", "schema", "tokens add"}
    assert set(_FOLLOWS) | without == verbs(TOP)
    assert not set(_FOLLOWS) & without


RUN = {"id": "r1", "kind": "motion", "arm": "planar2"}
JOB = {"id": "j1", "kind": "run", "arm": "planar2", "run": "r1", "motion": 1, "state": "done"}
DUE = {"id": 1, "arm": "planar2"}
PROBED = {"drivable": True, "silent": "", "can": {"problems": []}, "moves_by_position": False}
UNLIKE = PROBED | {"drivable": False}
REFUSED = UNLIKE | {"can": {"problems": [{}]}}
NOT_ZEROED = {"checks": [{"verdict": "failed", "reason": "ZERO is 0: then `ident set-home ARM`", "remedy": "Do this."}]}
STALLED = {"checks": [{"verdict": "failed", "reason": "late", "remedy": "see what `ident doctor ARM` says."}]}
RUBS = {"checks": [{"verdict": "passed", "reason": "design the motion again: `ident design ARM`", "remedy": ""}]}
# Words of a verb, its exit code and answer, and the command that follows.
TABLE: list[tuple[str, int, Mapping[str, Any], str]] = [
    ("config check planar2", 0, {}, "simulate planar2"),
    ("config check wam7_canopen", 0, {}, "bus scan wam7_canopen"),
    ("config check wam7", 0, {}, "identify RECORDING --arm wam7"),
    ("config check planar2", 3, {}, "config check planar2"),
    ("preview planar2 m.json", 0, {}, "preflight planar2 m.json"),
    ("preview wam7 m.json", 0, {}, "identify RECORDING --arm wam7"),
    ("preview planar2", 3, {}, "design planar2"),
    ("design planar2", 0, {"folder": "/a b"}, "preview planar2 '/a b/motion.json'"),
    ("design planar2", 3, {"folder": "/a"}, "design planar2 --search-time 300"),
    ("preflight planar2 m.json", 0, {}, "run planar2 m.json"),
    ("preflight planar2 --home", 0, {}, "home planar2"),
    ("preflight 'my arm.yaml' --home", 3, {}, "preflight 'my arm.yaml' --home"),
    ("run planar2", 0, {"folder": "/runs/x"}, "identify /runs/x/run.mcap --arm planar2"),
    ("run planar2", 1, {"folder": "/runs/x"}, "recover planar2"),
    ("run wam7_canopen --dry-run", 0, {}, "run wam7_canopen"),
    ("run planar2 --server http://h:1", 0, {"job": JOB, "answer": {}}, "identify r1 --arm planar2 --server http://h:1"),
    ("stop", 0, {"arms": ["planar2"]}, "recover planar2"),
    ("stop", 0, {"arms": []}, "arms"),
    ("stop my.yaml --state 's t'", 0, {"arm": "my"}, "recover my.yaml --state 's t'"),
    ("recover planar2", 3, {"steps": ["Look.", "`ident acknowledge planar2 x`, when known."]}, "acknowledge planar2 x"),
    ("home planar2", 0, {"asked": "home"}, "supported planar2"),
    ("home planar2", 0, {"folder": "/x"}, "preflight planar2"),
    ("set-home planar2", 0, {}, "watch planar2"),
    ("identify a.mcap --arm planar2", 0, {"folder": "/r"}, "accept /r --note 'identified from a.mcap'"),
    ("identify a.mcap --arm planar2", 3, {"folder": "/r"}, "design planar2"),
    (
        "identify a.csv --arm planar2",
        3,
        {"folder": "/r", "unusable": ["too short"], "another_motion_mends": True},
        "design planar2",
    ),
    (
        "identify a.csv --arm planar2",
        3,
        {"folder": "/r", "unusable": ["wrong after 2 s of motion"], "another_motion_mends": False},
        "report /r",
    ),
    ("compare a b", 3, {"verdict": "changed"}, "report b"),
    ("compare a b", 0, {"verdict": "unchanged"}, "report b"),
    ("feasible t.json", 3, {}, "project t.json --out feasible.json"),
    ("fleet status 'a/*' --arm wam7 --store s", 0, {}, "fleet identify 'a/*' --arm wam7 --store s"),
    ("fleet identify 'a*' --arm wam7 --server http://h:1", 0, {}, "runs --server http://h:1"),
    ("arms", 0, {"arms": [{"name": "planar2"}, {"name": "two"}]}, "config check planar2"),
    ("runs", 0, {"runs": []}, "simulate"),
    ("runs", 0, {"runs": [RUN]}, "identify r1 --arm planar2"),
    ("runs", 0, {"runs": [RUN | {"kind": "identification"}]}, "report r1"),
    ("jobs", 0, {"jobs": [JOB | {"state": "running"}]}, "jobs watch j1"),
    ("jobs show j1", 0, {"job": JOB, "answer": {}}, "identify r1 --arm planar2"),
    ("jobs show j1", 0, {"job": JOB | {"state": "faulted"}, "answer": None}, "recover planar2"),
    ("due", 0, {"due": []}, "schedules"),
    ("due", 0, {"due": [DUE | {"accepted": True}]}, "reidentify planar2"),
    ("due", 0, {"due": [DUE | {"accepted": False}]}, "preflight planar2"),
    ("maintenance planar2 --what oil", 0, {"due": []}, "schedules add planar2 --maintenance"),
    ("alarms", 3, {"alarms": [{"id": 7}]}, "alarms acknowledge 7 --note WHY"),
    ("prune --keep 3", 0, {"deleted": False, "recordings": [{}]}, "prune --keep 3 --yes"),
    ("prune --keep 3 --yes", 0, {"deleted": True, "recordings": [{}]}, "runs"),
    ("backup f.zip --state s", 0, {}, "restore f.zip --state restored"),
    ("preflight wam7_canopen --dry-run", 0, {}, "preflight wam7_canopen"),
    ("preflight wam7_pucks", 3, {"ticket": NOT_ZEROED}, "set-home wam7_pucks"),
    ("preflight a.yaml", 3, {"ticket": STALLED}, "doctor a.yaml"),
    ("preflight a.yaml", 0, {"ticket": RUBS}, "design a.yaml"),
    ("preflight a.yaml m.json", 0, {"ticket": RUBS}, "run a.yaml m.json"),
    ("preflight a.yaml --home", 0, {"ticket": RUBS}, "home a.yaml"),
    ("preflight a.yaml", 3, {"ticket": RUBS}, "preflight a.yaml"),
    ("bus probe a.yaml --eds f", 0, {"drives": [PROBED]}, "config check a.yaml"),
    ("bus probe a.yaml", 0, {"drives": [PROBED]}, "preflight a.yaml --dry-run"),
    ("bus probe a.yaml", 3, {"drives": [PROBED, UNLIKE]}, "config check a.yaml"),
    ("bus probe a.yaml", 3, {"drives": [REFUSED, UNLIKE]}, "bus report a.yaml"),
    ("bus probe a.yaml", 3, {"drives": [REFUSED | {"moves_by_position": True}]}, "config check a.yaml"),
    ("bus probe a.yaml", 3, {"drives": [REFUSED, UNLIKE | {"silent": "no answer"}]}, "bus scan a.yaml"),
]


@pytest.mark.parametrize(("words", "code", "said", "follows"), TABLE, ids=[f"{row[0]}:{row[1]}" for row in TABLE])
def test_the_next_command_fits_the_answer(words: str, code: int, said: Mapping[str, Any], follows: str) -> None:
    line = next_line(TOP.parse_args(shlex.split(words)), code, said)
    assert line == f"next: ident {follows}\n"
    assert TOP.parse_args(shlex.split(line)[2:]).word


ERRORS: list[tuple[str, IdentError, str]] = [
    ("run planar2 m.json", MotionRefused("no preflight ticket"), "next: ident preflight planar2 m.json\n"),
    ("home planar2", MotionRefused("no preflight ticket"), "next: ident preflight planar2 --home\n"),
    ("preflight planar2 --home", MotionRefused("the preflight NEEDS YOU"), "next: ident preflight planar2 --home\n"),
    ("run planar2", MotionRefused("active faults"), "next: ident recover planar2\n"),
    ("run planar2", ArmFault("lease_lost", "x"), "next: ident recover planar2\n"),
    ("run planar2", UsageError("exists"), ""),
    ("run kuka_lwr4", MotionRefused("kuka_lwr4: a motion needs joints.a.kp"), "next: ident config check kuka_lwr4\n"),
    ("design planar2", MotionRefused("the position margin leaves nothing"), ""),
    ("simulate planar2", ArmFault("following_error", "x"), ""),
    ("watch my.yaml", PositionUnknown("not zeroed"), "next: ident set-home my.yaml\n"),
    ("reidentify planar2", UsageError("planar2: nothing has been accepted yet"), "next: ident preflight planar2\n"),
    ("reidentify planar2", PersonNeeded("not allowed to move by its preflight"), "next: ident reidentify planar2\n"),
    ("reidentify planar2", PersonNeeded("unacknowledged faults: overspeed"), "next: ident recover planar2\n"),
]


@pytest.mark.parametrize(("words", "error", "line"), ERRORS)
def test_what_refused_or_stopped_a_motion_is_followed_by_what_clears_it(
    words: str, error: IdentError, line: str
) -> None:
    assert next_after_error(TOP.parse_args(words.split()), type(error), str(error)) == line
    if line:  # a daemon's job ends with the same error, in JSON
        arguments = TOP.parse_args([*words.split(), "--server", "http://pc:8000"])
        answer = {"error": {"kind": type(error).__name__, "message": str(error)}}
        job = JOB | {"state": "failed", "motion": True}
        expected = line.replace("\n", " --server http://pc:8000\n")
        assert next_line(arguments, 1, {"job": job, "answer": answer}) == expected


@pytest.mark.parametrize(
    ("words", "said"), [("stop two", {"arm": "two"}), ("stop", {"arms": ["two"]}), ("acknowledge two late_cycles", {})]
)
def test_an_arm_that_is_known_by_its_name_only_is_in_no_next_command(words: str, said: Mapping[str, Any]) -> None:
    """Commands to a moving arm know its name; its description is a file that only whoever began the motion knows."""
    assert next_line(TOP.parse_args(shlex.split(words)), 0, said) == ""


def test_a_probe_of_files_that_no_command_helps_names_none() -> None:
    arguments = TOP.parse_args(["bus", "probe", "a.yaml", "--eds", "f"])
    assert next_line(arguments, 3, {"drives": [REFUSED]}) == ""
    assert next_line(arguments, 2, {"drives": [UNLIKE | {"can": None}]}) == ""


def test_a_run_in_a_folder_of_the_working_directory_is_named_by_its_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").mkdir()
    arguments = TOP.parse_args(["run", "planar2", "--out", "run"])
    assert next_line(arguments, 0, {"folder": "run"}) == "next: ident identify run/run.mcap --arm planar2\n"


def test_commands_in_a_message_name_the_arm_as_it_was_typed() -> None:
    arguments, text = TOP.parse_args(["watch", "my arm.yaml"]), "ARM: then `ident set-home ARM`; ARMS, `ident stop`"
    assert with_arm(arguments, text) == "ARM: then `ident set-home 'my arm.yaml'`; ARMS, `ident stop`"
    assert with_arm(TOP.parse_args(["runs"]), text) == text


@pytest.mark.slow
def test_the_named_commands_run_one_after_the_other(
    ident: Ident, quick: Commissioned, state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From a result in the state folder, which is named by its id, to what is due; paths have spaces."""
    monkeypatch.chdir(tmp_path)
    folder = state / "runs" / "20260101T000000Z-planar2"
    shutil.copytree(quick.folder, folder)
    state.chmod(0o700)
    ended = ident("runs")
    assert ended.next == ["report", folder.name]
    for words in (["export", folder.name], ["report", folder.name]):
        ended = ident(*ended.next)
        assert (ended.code, ended.next) == (0, words), ended.err
    recording, arm = folder / "identification.mcap", tmp_path / "my arm.yaml"
    shutil.copy(quick.arm, arm)
    assert ident("config", "check", arm).next == ["simulate", str(arm)]
    assert ident("base-parameters", arm).next == ["design", str(arm)]
    ended = ident("identify", recording, "--arm", arm)
    assert ended.next[0] == "accept"
    ended = ident(*ended.next)
    assert (ended.code, ended.next[0]) == (0, "export"), ended.err
    assert "acceptance 1" in ended.out
    assert "typo: no arm of this name has an accepted set" in ident("compare", "accepted:typo", folder.name).err
    assert "did you mean planar2?" in ident("compare", "accepted:planar", folder.name).err
    compared = ident("compare", "accepted:planar2", folder.name)
    assert compared.next[:2] == ["report", folder.name]
    for words in (["verify", folder], ["feasible", folder / "parameters.json"]):
        assert ident(*ident(*words).next).code == 0


@pytest.mark.slow
def test_a_motion_is_followed_by_the_identification_of_its_recording(ident: Ident, state: Path, tmp_path: Path) -> None:
    arm = quick_arm(tmp_path, *COARSE)
    refused = ident("run", arm)
    assert (refused.code, refused.next) == (3, ["preflight", str(arm)])
    state.mkdir(mode=0o700, exist_ok=True)
    write_checked_ticket(load_arm(arm), state)
    ended = ident("run", arm)
    assert ended.code == 0, ended.err
    assert ended.next[0] == "identify"
    assert ended.next[2:] == ["--arm", str(arm)]
    assert (state / "runs" / ended.next[1] / "run.mcap").is_file()
    assert ident(*ended.next).code in (0, 3)


def test_a_table_gets_its_certificate_and_the_commands_then_end(ident: Ident, tmp_path: Path) -> None:
    table = {"expressions": ["m1", "lz1", "Lxx1", "Lyy1", "Lzz1"], "values": [1.0, 0.1, 0.2, 0.2, 0.1]}
    file = tmp_path / "table.json"
    file.write_text(json.dumps({"format": "ident-parameters", "version": 1, "base_parameters": table}))
    ended = ident("feasible", file)
    assert (ended.code, ended.next[0]) == (0, "project")
    ended = ident(*ended.next[:-1], tmp_path / "projected.json")
    assert (ended.code, ended.next) == (0, ["verify", str(tmp_path / "projected.json")])
    assert ident(*ended.next).out.endswith("base parameters\n")  # nothing follows

    forged = json.loads((tmp_path / "projected.json").read_text())
    forged["base_parameters"]["values"][0] += 1.0
    file.write_text(json.dumps(forged))
    ended = ident("verify", file)
    assert ended.code == 3
    assert "next:" not in ended.out + ended.err
