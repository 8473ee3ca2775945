"""The command itself: help, version, its state folder, a process of its own, and what it may load."""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
from cli.conftest import COARSE, Commissioned, Ident, Samples, left_over, quick_arm

from ident_service import __version__
from ident_service.cli import GROUPS, main, parser
from ident_service.cli.arguments import Parser


@pytest.mark.parametrize("words", [(), ("simulate",), ("identify",), ("config",), ("config", "check"), ("correct",)])
def test_help(ident: Ident, words: tuple[str, ...]) -> None:
    ended = ident(*words, "--help")
    assert ended.code == 0
    assert ended.out.startswith("usage: ident")


FORMER = {
    "check": "preflight",
    "ack": "acknowledge",
    "base": "base-parameters",
    "correct": "project",
    "alarms ack": "alarms acknowledge",
    "alarm": "alarms",
    "schedule": "schedules",
    "schedule add": "schedules add",
    "token revoke": "tokens revoke",
    "delete run": "runs delete",
}
FORMER_LISTS = {
    "jobs list --most 3": "jobs --most 3",
    "schedule list planar2": "schedules --arm planar2",
    "due list planar2": "due --arm planar2",
    "alarm list": "alarms",
    "token list --json": "tokens --json",
}


@pytest.mark.parametrize("former", FORMER)
def test_a_former_name_is_understood_and_not_shown(former: str, ident: Ident) -> None:
    now = FORMER[former]
    assert ident(*former.split(), "--help").out == ident(*now.split(), "--help").out
    shown = ident(*now.split()[:-1], "--help").out
    words = {line.split()[0] for line in shown.splitlines() if re.match(r" {2,4}[a-z]", line)}
    assert now.split()[-1] in words
    assert former == "delete run" or former.split()[-1] not in words - {now.split()[-1]}
    assert not {"rehearse", "--zero", "delete", "list"} & words - {now.split()[-1]}


@pytest.mark.parametrize("former", FORMER_LISTS)
def test_a_list_is_the_bare_noun_and_the_former_words_still_list(former: str) -> None:
    top = parser()
    formerly, now = (vars(top.parse_args(words.split())) for words in (former, FORMER_LISTS[former]))
    kept = ("verb", "word", "arm", "most", "json", "server", "state")
    assert {key: formerly.get(key) for key in kept} == {key: now.get(key) for key in kept}


def test_home_zero_is_set_home() -> None:
    formerly, now = parser().parse_args(["home", "planar2", "--zero"]), parser().parse_args(["set-home", "planar2"])
    assert formerly.verb is now.verb
    assert formerly.zero
    assert now.zero


@pytest.mark.parametrize("group", GROUPS, ids=lambda group: group.__name__)
def test_a_verb_is_parsed_with_its_group_alone_as_with_all(group: ModuleType) -> None:
    alone, every = parser(GROUPS[group][0]), parser()
    assert tuple(alone.shown) == GROUPS[group]
    for verb in GROUPS[group]:
        assert _verbs(alone)[verb].format_help() == _verbs(every)[verb].format_help()
    for words in ("check", "--version", "no-such-verb", "--json"):
        assert _verbs(parser(words)).keys() == _verbs(every).keys()


def _verbs(top: Parser) -> dict[str, Parser]:
    (action,) = (one for one in top._actions if isinstance(one, argparse._SubParsersAction))
    return dict(action.choices)


def test_version(ident: Ident) -> None:
    assert ident("--version").out == f"ident-service {__version__}\n"


@pytest.fixture
def short(samples: Samples, tmp_path: Path) -> Path:
    """A recording of half the samples, where the folder is of interest and not what is found."""
    return Samples(samples.time[::2], samples.position[::2], samples.torque[::2]).write(tmp_path / "short.csv")


@pytest.mark.campaign
@pytest.mark.slow
def test_state_folder_is_the_option_s_then_the_variable_s_then_the_user_s(
    quick: Commissioned, short: Path, ident: Ident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("identify", short, "--arm", quick.arm, "--json")

    def parent(*more: object) -> Path:
        return Path(ident(*words, *more).json["folder"]).parent

    assert parent("--state", tmp_path / "mine") == tmp_path / "mine" / "runs"
    assert parent() == tmp_path / "state" / "runs"
    monkeypatch.delenv("IDENT_STATE")
    assert parent() == tmp_path / "xdg" / "ident" / "runs"
    monkeypatch.delenv("XDG_STATE_HOME")
    assert parent() == tmp_path / "home" / ".local" / "state" / "ident" / "runs"


@pytest.mark.slow
def test_runs_of_the_same_second_get_folders_of_their_own(
    quick: Commissioned, short: Path, ident: Ident, state: Path
) -> None:
    words = ("identify", short, "--arm", quick.arm, "--json")
    folders = {ident(*words).json["folder"] for _ in range(2)}
    assert len(folders) == 2
    assert {str(path) for path in (state / "runs").iterdir()} == folders


@pytest.mark.campaign
@pytest.mark.slow
def test_a_seed_gives_the_same_numbers_again(ident: Ident, tmp_path: Path) -> None:
    arm = quick_arm(tmp_path, *COARSE, ("periods: 2", "periods: 1"))  # whose description says seed 1

    def score(name: str, *seed: object) -> object:
        return ident("simulate", arm, *seed, "--out", tmp_path / name, "--json").json["score"]

    first = score("first")
    assert score("same", "--seed", 1) == first
    assert score("other", "--seed", 2) != first


@pytest.mark.slow
def test_module_runs_as_a_process_of_its_own(tmp_path: Path) -> None:
    def run(*words: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-W", "error", "-m", "ident_service", *map(str, words)]
        return subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False, timeout=60)

    good = run("base", "planar2", "--json")
    assert good.returncode == 0, good.stderr
    assert json.loads(good.stdout)["arm"] == "planar2"
    infeasible = {"expressions": ["m1"], "values": [-1.0]}
    table = tmp_path / "table.json"
    table.write_text(json.dumps({"format": "ident-parameters", "version": 1, "base_parameters": infeasible}))
    no = run("feasible", table)
    assert (no.returncode, no.stderr) == (3, "")
    usage = run("feasible")
    assert usage.returncode == 2
    assert usage.stdout == ""
    assert usage.stderr == (
        "ident feasible: error: the following arguments are required: FILE\nhelp: ident feasible --help\n"
    )
    missing = run("feasible", "none.json")
    assert (missing.returncode, missing.stderr) == (2, "ident: no such file: none.json\n")
    assert left_over(tmp_path) == ["table.json"]


@pytest.mark.parametrize("words", [["--help"], ["simulate", "--help"], ["--version"]])
def test_help_loads_no_large_library(words: list[str]) -> None:
    program = (
        "import sys\n"
        "from ident_service.cli import main\n"
        "try:\n"
        f"    main({words!r})\n"
        "except SystemExit:\n"
        "    pass\n"
        "large = ('numpy', 'scipy', 'pinocchio', 'clarabel', 'ruckig', 'pydantic', 'mcap', 'yaml', 'jsonschema')\n"
        "print([name for name in large if name in sys.modules], file=sys.stderr)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60)
    assert done.stderr == "[]\n"


# What the common case may load: a quarter of its processor time is imports. Every other package waits for who needs it.
IDENTIFY_LOADS = {
    *("ident_service", "numpy", "clarabel", "jsonschema_rs", "threadpoolctl", "yaml"),
    *("pydantic", "pydantic_core", "annotated_types", "typing_extensions", "typing_inspection"),  # configurations
    *("jinja2", "markupsafe"),  # the report
    "mcap",  # recordings; of CSV its numbers of records alone
    *("pinocchio", "coal"),  # the URDF that was made is read back
    # Clarabel takes LAPACK from scipy.linalg.
    *("scipy", "scipy._external", "scipy._lib", "scipy.linalg", "scipy.special", "scipy.version", "scipy.__config__"),
    *("scipy._cyutility", "scipy._distributor_init", "scipy._distributor_init_local"),
    "cython_runtime",  # scipy's
    *("cmeel_pth", "sitecustomize", "usercustomize", "distutils-precedence"),  # of environments
}
NOT_OF_PYTHON = {"urllib.request", "http.client", "ssl", "xml.sax", "sqlite3", "asyncio", "multiprocessing"}
# Packages load LAPACK and Student's t alone; drivers, their sections and MCAP's formats serve nobody who reads CSV.
NOT_OF_SCIPY = {"scipy._lib._array_api", "scipy.linalg._basic", "scipy.special._support_alternative_backends"}
NOT_FOR_CSV = {
    *("mcap.records", "mcap.writer", "zstandard", "lz4", "drivers.arm", "ident_service.motion.faults"),
    *("ident_service.config.canopen", "ident_service.config.barrett"),
}


@pytest.mark.slow
def test_identification_loads_what_it_needs(quick: Commissioned, samples: Samples, tmp_path: Path) -> None:
    words = [
        "identify",
        str(samples.write(tmp_path / "run.csv")),
        "--arm",
        str(quick.arm),
        "--json",
        "--delay",
        "0.001",
    ]
    program = (
        "import sys\n"
        "from ident_service.cli import main\n"
        f"code = main({[*words, '--out', str(tmp_path / 'result')]!r})\n"
        "print(*sorted(sys.modules), file=sys.stderr)\n"
        "sys.exit(code)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode in (0, 3), done.stderr
    modules = done.stderr.splitlines()[-1].split()
    packages = {name.split(".")[0] for name in modules} - set(sys.stdlib_module_names)
    foreign = {name for name in packages - {"scipy"} if not name.startswith("_")}
    foreign |= {".".join(name.split(".")[:2]) for name in modules if name.split(".")[0] == "scipy"}
    assert foreign <= IDENTIFY_LOADS
    assert not (NOT_OF_PYTHON | NOT_OF_SCIPY | NOT_FOR_CSV) & set(modules)
    assert not {"numpy.f2py", "numpy.testing"} & set(modules)
    assert {"scipy.linalg.lapack", "scipy.special._ufuncs"} <= set(modules)


@pytest.mark.slow
def test_packages_that_load_in_part_give_all_their_names_when_asked() -> None:
    program = (
        "import os, sys\n"
        "from ident_service.cli.identification_commands import quick_imports\n"
        "with quick_imports():\n"
        "    assert os.environ['PYDANTIC_DISABLE_PLUGINS']\n"
        "    from scipy.linalg.lapack import dtrtrs\n"
        "    from scipy.special import stdtrit\n"
        "    import scipy.linalg.cython_lapack\n"
        "    assert not hasattr(scipy.linalg, '_no_such_module') and not hasattr(scipy.linalg, '__wrapped__')\n"
        "    assert not {'scipy.linalg._basic', 'scipy.special._basic'} & set(sys.modules)\n"
        "assert 'PYDANTIC_DISABLE_PLUGINS' not in os.environ\n"
        "import scipy.optimize, scipy.signal\n"
        "assert scipy.special.stdtrit(3.0, 0.975) == stdtrit(3.0, 0.975)\n"
        "assert scipy.special.gamma(5.0) == 24.0 and scipy.linalg.orth([[2.0]]).shape == (1, 1)\n"
        "assert scipy.linalg.lapack.dtrtrs is dtrtrs and 'null_space' in dir(scipy.linalg)\n"
        "assert not hasattr(scipy.linalg, 'no_such_name')\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)


def test_foreign_packages_of_the_same_name_are_refused(
    ident: Ident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "drivers").mkdir()
    (tmp_path / "drivers" / "__init__.py").write_text("")
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in [name for name in sys.modules if name.split(".")[0] == "drivers"]:
        monkeypatch.delitem(sys.modules, name)
    ended = ident("base", "planar2")
    assert ended.code == 2
    assert "the package 'drivers' was found at" in ended.err


def test_main_is_the_console_script() -> None:
    from importlib.metadata import entry_points

    (script,) = entry_points(group="console_scripts", name="ident")
    assert script.load() is main


def test_quick_arm_is_a_good_description(ident: Ident, tmp_path: Path) -> None:
    assert ident("config", "check", quick_arm(tmp_path)).code == 0
