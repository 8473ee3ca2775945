"""One rule for all verbs: what was given and cannot be used is exit code 2, with a clear error, and nothing written."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
from cli.conftest import Ident, left_over
from daemon.test_remote_verbs import verbs

INPUT = {
    "no.yaml": "hello",
    "no.json": "hello",
    "other.json": "{}",
    "no.csv": "hello\n",
    "no.columns": "columns: {t: t",
    "no.urdf": '<robot name="a"><link name="b"/>',
    "still.urdf": '<robot name="a"><link name="b"/></robot>',
    "urdf.yaml": "extends: threelink\nname: a\nkinematics: {urdf: no.urdf}\n",
    "no.eds": "hello",
}
ARMS = ("no.yaml", "other.json", "urdf.yaml", "folder", "nowhere.yaml")
UNREAD = ("no.yaml", "other.json", "folder", "nowhere.yaml")  # where the URDF is not needed for what comes first
RECORDINGS = ("no.csv", "other.json", "folder", "nowhere.csv", "no.csv@2:1")
PARAMETERS = ("no.json", "other.json", "folder", "nowhere.json")
FOLDERS = ("folder", "other.json", "nowhere")
MOTIONS = ("no.json", "other.json", "folder", "nowhere.json")
NAMES = ("nobody",)

# Words of each verb, with the place of what cannot be used, and what is tried there.
TABLE: dict[str, tuple[tuple[str, Sequence[str]], ...]] = {
    "accept": (("accept {} --note why", FOLDERS),),
    "acknowledge": (("acknowledge {} lease_lost", NAMES), ("acknowledge planar2 {}", NAMES)),
    "alarms acknowledge": (("alarms acknowledge {} --note why", ("1", "one")),),
    "backup": (("backup {}", ("out/b.tar", "no.csv")),),
    "base-parameters": (("base-parameters {}", ARMS),),
    "bus import": (
        ("bus import {} no.eds --confirm wam7", (*ARMS, "planar2")),
        ("bus import wam7_canopen {} --confirm wam7_canopen", ("nowhere.eds", "folder")),
    ),
    "bus report": (("bus report {} --out out/r.zip", (*ARMS, "planar2")),),
    **{f"bus {word}": ((f"bus {word} {{}} --confirm wam7", (*ARMS, "planar2")),) for word in ("store", "restore")},
    "bus load": (("bus load {}", (*ARMS, "planar2")),),
    "bus probe": (("bus probe {}", (*ARMS, "planar2")),),
    "bus scan": (("bus scan {}", (*ARMS, "planar2")),),
    "preflight": (("preflight {} --confirm planar2", ARMS), ("preflight planar2 {} --confirm planar2", MOTIONS)),
    "compare": (("compare {0} {0}", PARAMETERS),),
    "completion": (("completion {}", ("csh", "''")),),
    "config check": (("config check {}", ARMS),),
    "project": (("project {} --out out/c.json", PARAMETERS),),
    "arms delete": (("arms delete {}", NAMES),),
    "motions delete": (("motions delete {}", NAMES),),
    "runs delete": (("runs delete {}", NAMES),),
    "design": (
        ("design {} --starts 1 --out out", ARMS),
        ("design planar2 --resume {} --starts 1 --out out", MOTIONS),
        ("design planar2 --after {} --starts 1 --out out", RECORDINGS),
        ("design planar2 --model {} --starts 1 --out out", PARAMETERS),
        ("design planar2 --noise {} --starts 1 --out out", PARAMETERS),
    ),
    "doctor": (("doctor {}", UNREAD),),
    "driver test": (("driver test {} --confirm wam7", (*UNREAD, "wam7")),),
    "due dismiss": (("due dismiss {} --note why", ("1", "one")),),
    "emulate": (
        ("emulate {}", (*ARMS, "planar2")),
        ("emulate wam7_canopen --eds {}", ("no.eds", "nowhere.eds")),
    ),
    "export": (("export {} --format urdf --out out", FOLDERS),),
    "feasible": (("feasible {}", PARAMETERS), ("feasible other.json --arm {}", ARMS)),
    "figures": (("figures {} --out out", FOLDERS),),
    "finish": (("finish {}", (*NAMES, "planar2")),),
    "fleet identify": (("fleet identify no.csv --arm {} --out out", ARMS),),
    "fleet status": (("fleet status {} --arm planar2 --store out", ("nowhere.csv",)),),
    "home": (("home {}", UNREAD),),
    "identify": (
        ("identify {} --arm planar2 --out out", RECORDINGS),
        ("identify no.csv --arm {} --out out", ARMS),
        ("identify no.csv --arm planar2 --validate {} --out out", RECORDINGS),
        ("identify no.csv --arm planar2 --columns {} --out out", ("no.columns", "other.json", "folder", "nowhere")),
        ("identify no.csv --arm planar2 --columns no.csv={} --out out", ("no.columns", "folder", "nowhere")),
    ),
    "import": (("import {}", FOLDERS),),
    "jobs cancel": (("jobs cancel {}", NAMES),),
    "jobs show": (("jobs show {}", NAMES),),
    "jobs watch": (("jobs watch {}", NAMES),),
    "maintenance": (("maintenance {} --what oil", NAMES),),
    "new": (("new {} --out out/a.yaml", ("no.urdf", "still.urdf", "no.yaml", "folder", "nowhere.urdf")),),
    "pause": (("pause {}", (*NAMES, "planar2")),),
    "payload": (("payload {} no.csv --out out", FOLDERS),),
    "preview": (("preview {}", ARMS), ("preview planar2 {}", MOTIONS)),
    "prune": (("prune --keep {}", ("few",)),),
    "recover": (("recover {}", ARMS),),
    "rehearse": (("rehearse {} --no-key", ARMS), ("rehearse planar2 {} --no-key", MOTIONS)),
    "reidentify": (("reidentify {} --confirm planar2", (*ARMS, "planar2")),),
    "report": (("report {}", FOLDERS),),
    "restore": (("restore {} --replace", ("no.csv", "folder", "nowhere")),),
    "resume": (("resume {}", (*NAMES, "planar2")),),
    "rollback": (("rollback {} --note why", (*NAMES, "planar2")),),
    "run": (("run {}", ARMS), ("run planar2 {}", MOTIONS)),
    "schedules add": (("schedules add {} --hours 5", NAMES), ("schedules add planar2 --cron {}", ("daily",))),
    **{f"schedules {word}": ((f"schedules {word} {{}}", ("7", "seven")),) for word in ("enable", "disable")},
    "schedules remove": (("schedules remove {}", ("7", "seven")),),
    "schema": (("schema {}", ("arms", "''")),),
    "serve": (("serve --port 0 --tls-cert {0} --tls-key {0}", ("no.json", "nowhere")),),
    "set-home": (("set-home {} --confirm planar2", (*ARMS, "planar2")),),
    "simulate": (("simulate {} --out out", ARMS), ("simulate planar2 --motion {} --out out", MOTIONS)),
    "stop": (("stop {}", NAMES),),
    "supported": (("supported {0} --confirm {0}", (*NAMES, "planar2")),),
    "tokens add": (("tokens add {} --role viewer", ("''",)), ("tokens add ann --role {}", ("king",))),
    "tokens revoke": (("tokens revoke {}", NAMES),),
    "verify": (("verify {}", PARAMETERS), ("verify other.json --arm {}", ARMS)),
    "view": (("view {} --save out/a.rrd", FOLDERS), ("view folder --recording {} --save out/a.rrd", RECORDINGS)),
    "watch": (("watch {}", (*ARMS, "wam7")),),
}
NOTHING_GIVEN = {"alarms", "arms", "due", "jobs", "motions", "runs", "schedules", "tokens"}


def test_the_table_has_every_verb() -> None:
    assert set(TABLE) | NOTHING_GIVEN == set(verbs())


@pytest.mark.slow
@pytest.mark.parametrize("verb", TABLE)
def test_what_cannot_be_used_is_exit_code_2(
    verb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ident: Ident
) -> None:
    place = tmp_path / "place"
    (place / "folder").mkdir(parents=True)
    for name, text in INPUT.items():
        (place / name).write_text(text)
    monkeypatch.chdir(place)
    before = left_over(place)
    for words, tried in TABLE[verb]:
        for one in tried:
            given = ["" if word == "''" else word for word in words.format(one).split()]
            ended = ident(*given)
            assert ended.code == 2, (given, ended)
            assert ended.err.splitlines()[-1], given
            assert "Traceback" not in ended.err, given
            assert verb == "emulate" or ended.out == "", given  # which says what it begins
            assert left_over(place) == before, given


def test_every_error_has_an_exit_code() -> None:
    """Bad input, and nothing else, is 2."""
    from ident_service import errors
    from ident_service.cli import _EXIT_CODES

    kinds = [one for one in vars(errors).values() if isinstance(one, type) and issubclass(one, errors.IdentError)]
    codes = {kind: next(code for of, code in _EXIT_CODES if issubclass(kind, of)) for kind in kinds}
    bad = {kind.__name__ for kind, code in codes.items() if code == 2}
    given = {"UsageError", "ConfigError", "ModelError", "RecordingError", "ParameterError"}
    heirs = {"UnknownId", "AlreadyThere", "InUse", "InvalidRequest", "AccessRefused"}
    assert bad == given | heirs
    assert set(codes.values()) == {1, 2, 3, 4, 5}


_CAUGHT = """
import json

written = json.dumps


def interrupted(*words, **more):
    try:
        exec("raise KeyboardInterrupt")
    except KeyboardInterrupt:
        pass
    return written(*words, **more)


json.dumps = interrupted
"""


def test_an_interrupt_that_was_caught_in_an_import_is_not_how_the_command_ends(tmp_path: Path) -> None:
    """Modules that are loaded late run strings; Python would end by SIGINT although the command has its own answer."""
    (tmp_path / "sitecustomize.py").write_text(_CAUGHT)
    paths = os.pathsep.join((str(tmp_path), *(path or str(Path.cwd()) for path in sys.path)))
    words = [sys.executable, "-X", "utf8", "-m", "ident_service", "arms", "--json", "--state", str(tmp_path / "state")]
    done = subprocess.run(words, env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["exit_code"] == 0
