"""Enforce the layers: who imports whom, one place per large library, a light command line, files of readable length."""

from __future__ import annotations

import ast
import gc
import hashlib
import importlib
import json
import pkgutil
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("ident_service", "drivers", "sim_backend")
MAX_LINES = 850
# Shipped beside results as one file that needs no other.
ONE_FILE = "ident_service/certificate_verifier.py"
MOST_WITH_ONE_IMPORTER = 60

# A package imports itself and packages of earlier layers; those of one layer do not know each other.
LAYERS: tuple[tuple[str, ...], ...] = (
    ("errors",),
    ("certificate_verifier",),
    ("config",),
    ("drivers", "model"),
    ("sim_backend",),
    ("recordings", "excitation"),
    ("estimation",),
    ("motion",),
    ("preflight", "results"),
    ("registry",),
    ("operations",),
    ("fleet",),
    ("client",),
    ("daemon",),
    ("cli",),
)
# Less than their layer would allow: a driver knows nothing of identification, a simulator is an arm like any other and
# is found by its entry point, the daemon starts commands and never touches an arm, a client may be installed alone.
ONLY: dict[str, set[str]] = {
    "certificate_verifier": set(),
    "client": {"errors"},
    "drivers": {"errors", "config"},
}
NOT: dict[str, set[str]] = {
    "daemon": {"drivers", "sim_backend"},
    **{
        package: {"sim_backend"}
        for package in ("recordings", "excitation", "estimation", "motion", "preflight", "results", "registry")
    },
}


def _may_import() -> dict[str, set[str]]:
    allowed: dict[str, set[str]] = {"package": set()}
    below: set[str] = set()
    for layer in LAYERS:
        allowed |= {package: ONLY.get(package, below) - NOT.get(package, set()) for package in layer}
        below = below | set(layer)
    return allowed


MAY_IMPORT = _may_import()

# Large library: the packages, or single files, that may import it.
DOORS: dict[str, set[str]] = {
    "argcomplete": {"cli"},
    "rich": {"cli"},
    "pinocchio": {"model", "sim_backend/plant.py"},
    "ruckig": {"motion"},
    "cvxpy": {"estimation"},
    "clarabel": {"estimation"},
    "mcap": {"recordings"},
    "zstandard": {"recordings"},
    "lz4": {"recordings"},
    "canopen": {"drivers", "sim_backend"},
    "can": {"drivers", "sim_backend"},
    "cronsim": {"operations"},
    "dask": {"fleet"},
    "distributed": {"fleet"},
    "fastapi": {"daemon"},
    "httpx": {"client"},
    "fsspec": {"fleet"},
    "jinja2": {"results", "daemon", "fleet"},
    "prometheus_client": {"daemon"},
    "pyarrow": {"fleet"},
    "rerun": {"operations"},
    "standardwebhooks": {"daemon"},
    "starlette": {"daemon"},
    "uvicorn": {"daemon"},
}
# What may know CANopen: its driver, its emulation, its configuration, and the commands that scan, probe and
# configure its nodes.
CANOPEN_ROOMS = ("drivers/canopen/", "sim_backend/canopen_device/")
CANOPEN_FILES = {
    "ident_service/config/arm.py",
    "ident_service/config/canopen.py",
    "ident_service/config/load.py",
    "ident_service/operations/drive_configuration.py",
    "ident_service/operations/fieldbus.py",
    "sim_backend/emulator/build.py",
}
HEAVY = (
    *("pinocchio", "ruckig", "cvxpy", "clarabel", "mcap", "canopen", "can", "fastapi", "jinja2", "uvicorn"),
    *("distributed", "fsspec", "pyarrow", "rich", "argcomplete"),
)


@dataclass(frozen=True)
class Import:
    """One imported module, and where."""

    module: str
    line: int


def package_of(file: str) -> str:
    """Name the package of a file by its path below the root."""
    parts = Path(file).with_suffix("").parts
    if parts[0] != "ident_service":
        return parts[0]
    if parts[1] == "__init__":
        return "package"
    return "cli" if parts[1] == "__main__" else parts[1]


def package_of_module(module: str) -> str | None:
    """Name the package of a module, None for foreign ones."""
    parts = module.split(".")
    if parts[0] not in PACKAGES:
        return None
    return package_of("/".join([*parts, "__init__.py"]) if len(parts) == 1 else "/".join(parts) + ".py")


@cache
def nodes_of(source: str) -> list[ast.AST]:
    """Return the nodes of a source's syntax tree, of each source once."""
    gc.disable()  # a million nodes stay: looking through them again and again takes twice as long as making them
    try:
        return list(ast.walk(ast.parse(source)))
    finally:
        gc.enable()


def imports_in(source: str, file: str) -> Iterator[Import]:
    """Find everything a file imports, inside functions and under conditions too."""
    package = list(Path(file).parent.parts)
    for node in nodes_of(source):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield Import(alias.name, node.lineno)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            # `from ident_service import x` may bring in a whole package.
            for alias in node.names:
                yield Import(f"{module}.{alias.name}" if module in PACKAGES else module, node.lineno)
        elif isinstance(node, ast.Call) and _is_import_call(node.func) and node.args:
            if isinstance(node.args[0], ast.Constant) and isinstance(node.args[0].value, str):
                yield Import(node.args[0].value, node.lineno)
            else:
                yield Import("?", node.lineno)


def _is_import_call(function: ast.expr) -> bool:
    name = (
        function.id if isinstance(function, ast.Name) else function.attr if isinstance(function, ast.Attribute) else ""
    )
    return name in ("import_module", "__import__")


def violations(source: str, file: str) -> list[str]:
    """List what a file imports that it may not."""
    package = package_of(file)
    if package not in MAY_IMPORT:
        return [f"{file}: no package is called {package!r}"]
    found = []
    for imported in imports_in(source, file):
        place, top = f"{file}:{imported.line}", imported.module.split(".")[0]
        other = package_of_module(imported.module)
        if imported.module == "?":
            found.append(f"{place}: imports a module whose name is computed")
        elif imported.module.removeprefix("ident_service.") in ("__version__", "annotations"):
            continue
        elif other is not None and other not in {package, "package", *MAY_IMPORT[package]}:
            found.append(f"{place}: {package} imports {other}")
        elif top in DOORS and not {package, file} & DOORS[top]:
            found.append(f"{place}: {top} may only be imported in {', '.join(sorted(DOORS[top]))}")
    return found


def python_files() -> list[str]:
    return sorted(path.relative_to(ROOT).as_posix() for package in PACKAGES for path in (ROOT / package).rglob("*.py"))


def test_every_file_imports_only_what_its_layer_may() -> None:
    found = [text for file in python_files() for text in violations((ROOT / file).read_text(encoding="utf-8"), file)]
    assert found == []


def test_canopen_is_known_in_its_own_folder_only() -> None:
    """Everything else reaches drives by the Arm contract, whatever protocol they speak."""
    foreign = []
    for file in python_files():
        if file.startswith(CANOPEN_ROOMS) or file in CANOPEN_FILES:
            continue
        foreign += [
            f"{file}:{found.line}: {found.module}"
            for found in imports_in((ROOT / file).read_text(encoding="utf-8"), file)
            if found.module.startswith(("drivers.canopen", "ident_service.config.canopen", "canopen"))
        ]
    assert foreign == []


def test_the_files_are_where_this_test_looks() -> None:
    files = python_files()
    assert {package_of(file) for file in files} == {package for layer in LAYERS for package in layer} | {"package"}
    assert len(files) > 50


def test_scripts_of_others_stand_in_one_place_with_version_licence_and_checksum() -> None:
    place = ROOT / "ident_service" / "vendored"
    documents = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(place.glob("*.json"))]
    told = {name: digest for one in documents for name, digest in one["sha256"].items()}
    found = {path.name: path for path in place.iterdir() if path.suffix != ".json"}
    assert {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in found.items()} == told
    for one in documents:
        assert one["licence"] == "MIT"
        assert any(name.endswith("LICENSE.txt") for name in one["sha256"])
        heads = [found[name].read_text(encoding="utf-8")[:400] for name in one["sha256"] if name.endswith(".js")]
        # three.js says its revision alone: 185 of 0.185.1.
        assert any(one["version"] in head for head in heads) or one["package"] == "three"
    minified = {path for package in PACKAGES for path in (ROOT / package).rglob("*min.*")}
    assert {path.parent for path in minified} == {place}
    # Other files are read where a package may import from, too.
    foreign = [
        f"{file} reads files of {package or place}"
        for file in python_files()
        for package, place in re.findall(
            r'files\("ident_service\.?(\w*)[\w.]*"\)\.joinpath\("?(\w*)', (ROOT / file).read_text(encoding="utf-8")
        )
        if (package or place) not in {"vendored", package_of(file), *MAY_IMPORT[package_of(file)]}
    ]
    assert foreign == []


@pytest.mark.slow
@pytest.mark.parametrize("folder", ["benchmarks", "tools"])
def test_what_benchmarks_and_tools_import_of_ours_is_there(folder: str) -> None:
    """No other test runs them."""
    ours, missing = {"benchmarks", "drivers", "ident_service", "sim_backend"}, []
    for path in sorted((ROOT / folder).glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in ours:
                module = importlib.import_module(str(node.module))
                inside = {one.name for one in pkgutil.iter_modules(getattr(module, "__path__", ()))}
                names = {one.name for one in node.names if not hasattr(module, one.name)} - inside
                missing += [f"{path.name}: {node.module}.{name}" for name in sorted(names)]
    assert missing == []


def test_every_file_is_short_enough_to_read() -> None:
    files = [file for file in python_files() if file != ONE_FILE]
    lines = {file: len((ROOT / file).read_text(encoding="utf-8").splitlines()) for file in files}
    assert {file: number for file, number in lines.items() if number > MAX_LINES} == {}


def test_few_modules_serve_a_single_other() -> None:
    """A module with one importer and no life of its own belongs into that importer."""
    files = python_files()
    modules = {file.removesuffix(".py").removesuffix("/__init__").replace("/", "."): file for file in files}
    importers: dict[str, set[str]] = {module: set() for module in modules}
    for module, file in modules.items():
        for node in nodes_of((ROOT / file).read_text(encoding="utf-8")):
            if isinstance(node, ast.ImportFrom) and node.module:
                for alias in node.names:
                    name = f"{node.module}.{alias.name}"
                    target = name if name in modules else node.module
                    if target in modules:
                        importers[target].add(module)
    single = [
        module for module, by in importers.items() if len(by) == 1 and not modules[module].endswith("__init__.py")
    ]
    assert len(single) <= MOST_WITH_ONE_IMPORTER, "\n".join(sorted(single))


# First words of a sentence that only its author can finish: a docstring opens with a verb and its object, or a noun.
RIDDLES = {"What", "Who", "Whoever", "Whether", "As", "Of", "That", "How", "Where", "When", "Which"}


def test_no_docstring_opens_like_a_riddle_or_sends_its_reader_in_a_circle() -> None:
    found = []
    for file in python_files():
        for node in nodes_of((ROOT / file).read_text(encoding="utf-8")):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                text = ast.get_docstring(node) or "-"
                words = text.split()
                named = re.findall(rf"`([\w/]*{re.escape(Path(file).name)})`", text)
                if words[0].rstrip(",:") in RIDDLES or any(f"/{file}".endswith(f"/{name}") for name in named):
                    found.append(f"{file}: {' '.join(words[:8])} ...")
    assert found == []


def test_the_verifier_needs_the_standard_library_alone() -> None:
    modules = {found.module for found in imports_in((ROOT / ONE_FILE).read_text(encoding="utf-8"), ONE_FILE)}
    assert {module.split(".")[0] for module in modules} <= sys.stdlib_module_names


def _file_of(module: str) -> Path | None:
    places = [ROOT / f"{base}{module.replace('.', '/')}.py" for base in ("ident_service/", "")]
    return next((place for place in places if place.is_file()), None)


def test_the_architecture_page_names_what_exists() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`((?:[a-z_0-9]+\.)+[A-Za-z_]+)`", text))
    files = {file.removesuffix(".py").removesuffix("/__init__").replace("/", ".") for file in python_files()}
    modules = {module.removeprefix("ident_service.") for module in files}
    missing = set()
    for name in named - {"constraints.custom", "ident_service.drivers"}:
        module, _, member = name.rpartition(".")
        if name in modules or name.endswith((".md", ".json", ".yaml")):
            continue
        path = _file_of(module)
        if path is None or not re.search(
            rf"^(?:class |def )?{member}\b", path.read_text(encoding="utf-8"), flags=re.MULTILINE
        ):
            missing.add(name)
    assert missing == set()
    assert len(named) > 40


@pytest.mark.parametrize(
    ("file", "source", "complaint"),
    [
        ("ident_service/model/x.py", "from ident_service.motion.run import run", "model imports motion"),
        ("ident_service/model/x.py", "import ident_service.recordings.open as o", "model imports recordings"),
        ("ident_service/model/x.py", "from ident_service import estimation", "model imports estimation"),
        ("ident_service/model/x.py", "from ..excitation import plan", "model imports excitation"),
        ("ident_service/model/x.py", "from .. import results", "model imports results"),
        ("ident_service/model/x.py", "import drivers.arm", "model imports drivers"),
        ("ident_service/config/x.py", "def f():\n    from ident_service.model import base", ":2: config imports model"),
        ("ident_service/config/x.py", "if TYPE_CHECKING:\n    import drivers.arm", "config imports drivers"),
        ("ident_service/motion/x.py", "from sim_backend.arm import SimulatedArm", "motion imports sim_backend"),
        ("ident_service/motion/x.py", "importlib.import_module('sim_backend.arm')", "motion imports sim_backend"),
        ("ident_service/motion/x.py", "importlib.import_module(name)", "name is computed"),
        ("ident_service/recordings/x.py", "from ident_service.excitation import x", "recordings imports excitation"),
        ("ident_service/preflight/x.py", "from ident_service.results.plots import x", "preflight imports results"),
        ("ident_service/operations/x.py", "from ident_service.cli import main", "operations imports cli"),
        ("ident_service/operations/x.py", "from ident_service.daemon.app import x", "operations imports daemon"),
        ("ident_service/daemon/x.py", "from drivers.arm import Arm", "daemon imports drivers"),
        ("ident_service/daemon/x.py", "from ident_service.cli import main", "daemon imports cli"),
        ("ident_service/client/x.py", "from ident_service.config.arm import ArmConfig", "client imports config"),
        ("ident_service/results/x.py", "from ident_service.operations.score import x", "results imports operations"),
        ("ident_service/errors.py", "from ident_service.config.arm import ArmConfig", "errors imports config"),
        ("ident_service/__init__.py", "from ident_service.errors import IdentError", "package imports errors"),
        ("drivers/x.py", "from ident_service.model.chain import Chain", "drivers imports model"),
        ("drivers/x.py", "import pinocchio", "pinocchio may only"),
        ("sim_backend/x.py", "import pinocchio as pin", "pinocchio may only"),
        ("sim_backend/x.py", "from ident_service.motion.run import run", "sim_backend imports motion"),
        ("ident_service/model/x.py", "try:\n    import clarabel\nexcept ImportError:\n    pass", "clarabel may only"),
        ("ident_service/estimation/x.py", "from mcap.reader import make_reader", "mcap may only"),
        ("ident_service/cli.py", "import fastapi", "fastapi may only"),
        ("ident_service/motion/x.py", "from can import Bus", "can may only"),
        ("ident_service/operations/x.py", "from distributed import Client", "distributed may only"),
        ("ident_service/results/x.py", "import ident_service.fleet.factor", "results imports fleet"),
        ("ident_service/attic/x.py", "import json", "no package is called 'attic'"),
    ],
)
def test_the_checker_sees_what_is_forbidden(file: str, source: str, complaint: str) -> None:
    (found,) = violations(source, file)
    assert complaint in found
    assert found.startswith(f"{file}:")


@pytest.mark.parametrize(
    ("file", "source"),
    [
        ("ident_service/model/x.py", "import pinocchio as pin\nfrom ident_service.config.arm import ArmConfig"),
        ("ident_service/model/x.py", "from .chain import Chain\nfrom ..errors import ModelError"),
        ("ident_service/results/x.py", "from ident_service import __version__"),
        ("ident_service/preflight/x.py", "from ident_service.motion.controller import x"),
        ("sim_backend/plant.py", "import pinocchio"),
        ("ident_service/recordings/x.py", "import canary, mcap.reader, lz4.frame"),
        ("ident_service/operations/x.py", "import sim_backend.arm\nfrom ident_service.results import manifest"),
        ("ident_service/daemon/x.py", "import fastapi\nfrom ident_service.operations import acceptance"),
        ("ident_service/cli.py", "from ident_service.operations import commissioning"),
        ("ident_service/__main__.py", "from ident_service.cli import main"),
    ],
)
def test_the_checker_lets_pass_what_is_allowed(file: str, source: str) -> None:
    assert violations(source, file) == []


def loaded_after(code: str, watched: tuple[str, ...] = HEAVY) -> set[str]:
    """Large libraries that a fresh interpreter has loaded after some code."""
    script = f"import sys\n{code}\nprint('LOADED', *[name for name in {watched!r} if name in sys.modules])"
    result = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=60, cwd=ROOT
    )
    return set(result.stdout.splitlines()[-1].split()[1:])


def test_the_package_loads_no_large_library() -> None:
    assert loaded_after("import ident_service") == set()


@pytest.mark.slow
def test_the_probe_would_see_a_large_library() -> None:
    assert loaded_after("import ident_service.model.pinocchio_models") == {"pinocchio"}


def test_the_command_line_loads_no_large_library() -> None:
    assert loaded_after("import ident_service.cli") == set()


def test_identification_loads_cvxpy_only_when_it_is_used() -> None:
    loaded = loaded_after("import ident_service.estimation.identify, ident_service.operations.identification")
    assert "clarabel" in loaded
    assert "cvxpy" not in loaded


# Each run of an arm starts the first four of these, and waits for them; scipy alone would take each 0.2 s.
@pytest.mark.parametrize(
    ("program", "needed"),
    [
        ("ident_service.operations.motion_run", {"numpy", "pydantic", "pinocchio", "ruckig", "mcap"}),
        ("ident_service.motion.process", {"numpy", "pydantic", "pinocchio", "ruckig"}),
        ("sim_backend.plant_process", {"numpy", "pydantic", "pinocchio"}),
        ("ident_service.recordings.recorder_main", {"numpy", "mcap"}),
        ("ident_service.operations.target_process", {"numpy", "pydantic", "mcap", "yaml"}),
        ("ident_service.daemon.app", {"numpy", "pydantic", "mcap", "yaml", "fastapi", "jinja2", "uvicorn"}),
    ],
)
def test_what_runs_beside_an_arm_loads_no_more_than_it_needs(program: str, needed: set[str]) -> None:
    watched = (*HEAVY, "numpy", "pydantic", "scipy", "jsonschema_rs", "yaml")
    assert loaded_after(f"import {program}", watched) <= needed


def test_a_run_that_is_refused_has_loaded_no_estimation(tmp_path: Path) -> None:
    words = ["run", "planar2", "--state", str(tmp_path)]
    loaded = loaded_after(f"from ident_service.cli import main\nassert main({words!r}) == 3", (*HEAVY, "scipy"))
    assert loaded <= {"pinocchio", "ruckig", "mcap"}


@pytest.mark.parametrize("arguments", [["--help"], ["base", "--help"]])
def test_asking_for_help_loads_no_large_library(arguments: list[str]) -> None:
    code = (
        "import runpy\n"
        f"sys.argv = ['ident', *{arguments!r}]\n"
        "try:\n"
        "    runpy.run_module('ident_service', run_name='__main__')\n"
        "except SystemExit as end:\n"
        "    assert not end.code, end.code\n"
        "else:\n"
        "    raise AssertionError('help did not end the command')"
    )
    assert loaded_after(code) == set()
