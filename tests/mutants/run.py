"""Change one operator, number or word of the code that guards people at a time: a test must fail for each change.

A fixed sample of such mutants is made by cosmic-ray in a copy of the checkout, so that an interrupted run leaves the
checkout as it was, and each is shown to the tests of its module. One that passes them all must stand in
`survivors.toml` with the reason, else this fails. Results are one line each: module, line, operator, the operator's
occurrence in the module, and `killed`, `survived` or `timeout`; two runs over the same modules compare by `diff`.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from cosmic_ray.commands.init import init
from cosmic_ray.mutating import mutate_and_test
from cosmic_ray.work_db import WorkDB, use_db
from cosmic_ray.work_item import MutationSpec, TestOutcome, WorkerOutcome

ROOT = Path(__file__).resolve().parents[2]
SURVIVORS = Path(__file__).with_name("survivors.toml")
SEED = "ident"
TIMEOUT = 60.0  # s; many times what the slowest group needs without a mutant on an idle machine


@dataclass(frozen=True)
class Group:
    """Modules with the tests that are responsible for them.

    Attributes:
        samples: how many mutants of each module, by its path.
        tests: files, those first that fail soonest.
    """

    samples: dict[str, int]
    tests: tuple[str, ...]


GROUPS = {
    "guard": Group(
        {"ident_service/motion/safety_monitor.py": 150},
        (
            "tests/motion/test_motion_guard_thresholds.py",
            "tests/motion/test_motion_guard_table.py",
            "tests/motion/test_motion_guard.py",
            "tests/motion/test_motion_guard_motors.py",
            "tests/motion/test_motion_guard_positions.py",
            "tests/motion/test_motion_drive_events.py",
            "tests/motion/test_motion_encoder_observer.py",
            "tests/motion/test_motion_encoder_observer_runs.py",
        ),
    ),
    "stop": Group(
        {"ident_service/motion/stop_trajectory.py": 65},
        ("tests/motion/test_motion_stop_bounds.py", "tests/motion/test_motion_stop.py"),
    ),
    "verifier": Group(
        {
            "ident_service/certificate_verifier.py": 125,
            "ident_service/operations/verify.py": 3,
        },
        (
            "tests/certificate/test_verifier_by_hand.py",
            "tests/certificate/test_forgeries.py",
            "tests/certificate/test_forged_files.py",
            "tests/certificate/test_certificate_hostile.py",
            "tests/certificate/test_exact_arithmetic.py",
            "tests/model/test_expressions.py",
            "tests/certificate/test_certificate_tampering.py",
            "tests/certificate/test_verifier_shipped.py",
            "tests/certificate/test_certificates_of_random_arms.py",
        ),
    ),
}
PYTEST = (
    *("-m", "pytest", "-x", "-q", "--no-header", "-p", "no:cacheprovider", "-m", "'not campaign'"),
    # Of the plugins only these, as loading all of them takes longer than most tests here.
    *("-p", "pytest_timeout", "-p", "_hypothesis_pytestplugin", "-p", "repeatable"),
)
# Others only raise TypeError at once (shifts of floats), or change nothing (`&` to `*` between flags).
_OPERATORS = re.compile(
    r"core/("
    r"ReplaceBinaryOperator_(Add|Sub|Mul|Div|FloorDiv|Mod|Pow)_(Add|Sub|Mul|Div|FloorDiv|Mod|Pow)"
    r"|ReplaceBinaryOperator_(BitOr|BitAnd|BitXor)_(BitOr|BitAnd|BitXor)"
    r"|ReplaceComparisonOperator_(Eq|NotEq|Lt|LtE|Gt|GtE)_(Eq|NotEq|Lt|LtE|Gt|GtE)"
    r"|ReplaceComparisonOperator_(Is_IsNot|IsNot_Is)|ReplaceUnaryOperator_Delete_\w+|AddNot"
    r"|ReplaceTrueWithFalse|ReplaceFalseWithTrue|ReplaceAndWithOr|ReplaceOrWithAnd"
    r"|ReplaceBreakWithContinue|ReplaceContinueWithBreak|ExceptionReplacer|NumberReplacer|RemoveDecorator"
    r"|ZeroIterationForLoop)"
)


def main() -> int:
    """Run the sample, write its results and tell about survivors without a reason; 1 where there are any."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--group", choices=GROUPS, action="append", help="only these modules")
    parser.add_argument("--results", type=Path, default=ROOT / "build" / "mutants.txt")
    parser.add_argument("--survivors", type=Path, metavar="RESULTS", help="only those that survived an earlier run")
    arguments = parser.parse_args()
    results = arguments.results.resolve()
    again = arguments.survivors and set(arguments.survivors.read_text(encoding="utf-8").splitlines())
    begin, lines, unexplained = time.monotonic(), [], 0
    reasons = _reasons()
    unused = set(reasons)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the copy goes away
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        os.chdir(_copied(Path(folder)))
        for name in arguments.group or GROUPS:
            for line, change, lives in _results(GROUPS[name], again):
                lines.append(line)
                mutant = (line.split(":")[0], *change)
                reason = reasons.get(mutant) if lives else None
                unexplained += lives and reason is None
                unused -= {mutant} if lives else set()
                print(line, flush=True)
                if lives:
                    print(f"    {change[0]}\n    {change[1]}\n    {reason or 'NO TEST FAILS, AND NO REASON IS GIVEN'}")
    results.parent.mkdir(parents=True, exist_ok=True)
    results.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
    if not arguments.group and not again:
        for module, _, mutant in sorted(unused):
            print(f"listed, but killed or not in the sample any more: {module}: {mutant}")
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    counts = Counter(line.split()[-1] for line in lines)
    print(
        f"{len(lines)} mutants: {counts['killed']} killed, {counts['timeout']} ran too long, {counts['survived']} "
        f"survived, {unexplained} of these without a reason; {(used.ru_utime + used.ru_stime) / 60:.1f} minutes of "
        f"CPU, {(time.monotonic() - begin) / 60:.1f} of time; {results}"
    )
    return 1 if unexplained else 0


def _reasons() -> dict[tuple[str, str, str], str]:
    """Read why mutants may survive, by module, line and changed line."""
    listed = tomllib.loads(SURVIVORS.read_text(encoding="utf-8")).get("survivor", [])
    return {(entry["module"], entry["line"], entry["mutant"]): entry["why"] for entry in listed}


def _copied(folder: Path) -> Path:
    """Copy what git knows or would add, with the published data beside it as the tests expect them."""
    tree = folder / "checkout"
    command = ["git", "-C", str(ROOT), "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in filter(None, subprocess.run(command, capture_output=True, text=True, check=True).stdout.split("\0")):
        if (ROOT / name).is_file():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, tree / name)
    if (shared := ROOT.parent / "shared").is_dir():
        (folder / "shared").symlink_to(shared)
    # Before the installed package, which is the checkout itself.
    os.environ["PYTHONPATH"] = os.pathsep.join([str(tree), str(tree / "tests" / "mutants")])
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    return tree


def _results(group: Group, again: set[str] | None) -> Iterator[tuple[str, tuple[str, str], bool]]:
    """Give per mutant its line of the results, the code line before and after, and True where it survived.

    Args:
        group: the modules and their tests.
        again: lines of an earlier run's results, of which only the survivors are looked at; all mutants when None.
    """
    command = [sys.executable, *PYTEST, *group.tests]
    # Without a mutant all must pass; it also compiles the tests once for all mutants.
    subprocess.run([word.strip("'") for word in command], check=True)
    for module in group.samples:
        for compiled in Path(module).parent.glob(f"__pycache__/{Path(module).stem}.*.pyc"):
            compiled.unlink()
    for module, size in group.samples.items():
        for mutation in sorted(_sample(module, size), key=lambda m: (m.start_pos, m.operator_name, m.occurrence)):
            operator = mutation.operator_name.removeprefix("core/")
            which = f"{module}:{mutation.start_pos[0]} {operator} {mutation.occurrence}"
            if again is not None and f"{which} survived" not in again:
                continue
            result = mutate_and_test([mutation], " ".join(command), TIMEOUT)
            if result.worker_outcome is not WorkerOutcome.NORMAL or result.test_outcome is TestOutcome.INCOMPETENT:
                raise SystemExit(f"{module}: {mutation}: {result.output}")
            lives = result.test_outcome is TestOutcome.SURVIVED
            outcome = "survived" if lives else "timeout" if result.output == "timeout" else "killed"
            yield f"{which} {outcome}", _change(result.diff), lives


def _sample(module: str, size: int) -> list[MutationSpec]:
    """Choose mutants by a hash of seed, code line and operator, so that a change elsewhere leaves the choice.

    No place has two mutants before every place has one.
    """
    source = Path(module).read_text(encoding="utf-8")
    lines, typed = source.splitlines(), _annotations(source)
    places: dict[tuple[int, int], list[tuple[str, MutationSpec]]] = defaultdict(list)
    with use_db(":memory:", WorkDB.Mode.create) as database:
        init([Path(module)], database, {})
        for item in database.work_items:
            mutation = item.mutations[0]
            place = mutation.start_pos
            if not _OPERATORS.fullmatch(mutation.operator_name) or any(a <= place < b for a, b in typed):
                continue
            number = sum(other.operator_name == mutation.operator_name for _, other in places[place])
            text = f"{SEED} {module} {lines[place[0] - 1]} {place[1]} {mutation.operator_name} {number}"
            places[place].append((hashlib.sha256(text.encode()).hexdigest(), mutation))
    ranked = [(rank, *one) for place in places.values() for rank, one in enumerate(sorted(place, key=lambda p: p[0]))]
    return [mutation for _, _, mutation in sorted(ranked, key=lambda one: one[:2])[:size]]


def _annotations(source: str) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Find where types are written, which nothing evaluates."""
    nodes = [
        part
        for node in ast.walk(ast.parse(source))
        for part in (getattr(node, "annotation", None), getattr(node, "returns", None))
        if isinstance(part, ast.expr)
    ]
    return [((n.lineno, n.col_offset), (n.end_lineno or n.lineno, n.end_col_offset or 0)) for n in nodes]


def _change(diff: str | None) -> tuple[str, str]:
    """Read the lines taken away and put in from a unified diff."""
    lines = [line for line in (diff or "").splitlines() if not line.startswith(("---", "+++"))]
    before, after = (" ".join(line[1:].strip() for line in lines if line.startswith(sign)).strip() for sign in "-+")
    return before, after


if __name__ == "__main__":
    sys.exit(main())
