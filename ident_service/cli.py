"""The command `ident`: parses words, calls the same functions as the Python API, prints, and picks an exit code.

Exit codes: 0 done and good; 1 failed; 2 usage or configuration; 3 done, but the verdict is no; 4 stopped by a fault.
Large libraries load only when a verb needs them.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ident_service import __version__
from ident_service.errors import ArmFault, ConfigError, IdentError, MotionRefused, ParameterError, UsageError

DONE, FAILED, USAGE, VERDICT_NO, FAULTED = 0, 1, 2, 3, 4
_EXIT_CODES: tuple[tuple[type[IdentError], int], ...] = (
    (ConfigError, USAGE),
    (UsageError, USAGE),
    (MotionRefused, VERDICT_NO),
    (ArmFault, FAULTED),
    (IdentError, FAILED),
)
_SETS = ("pseudo_inertia", "inertia")

Answer = tuple[int, str, dict[str, Any]]


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb; returns the exit code."""
    arguments = _parser().parse_args(argv)
    try:
        _own_packages_only()
        verb: Callable[[argparse.Namespace], Answer] = arguments.verb
        code, text, document = verb(arguments)
    except IdentError as error:
        code = next(number for kind, number in _EXIT_CODES if isinstance(error, kind))
        sys.stderr.write(f"ident: {error}\n")
        if arguments.json:
            _print_json({"error": {"kind": type(error).__name__, "message": str(error)}, "exit_code": code})
        return code
    if arguments.json:
        _print_json({**document, "exit_code": code})
    else:
        sys.stdout.write(text)
    return code


def _print_json(document: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(document, allow_nan=False) + "\n")


def _own_packages_only() -> None:
    """`drivers` and `sim_backend` are common words: refuse to run somebody else's from the working directory."""
    home = Path(__file__).resolve().parent.parent
    for name in ("drivers", "sim_backend"):
        spec = importlib.util.find_spec(name)
        origin = Path(spec.origin).resolve() if spec and spec.origin else None
        if origin is None or origin.parent.parent != home:
            raise UsageError(
                f"the package {name!r} was found at {origin}, not beside ident_service in {home}; run elsewhere"
            )


def _parser() -> argparse.ArgumentParser:
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--json", action="store_true", help="one JSON object on stdout, nothing else")
    common.add_argument("--state", help="state folder (default: $IDENT_STATE, or the user's XDG state folder)")
    parser = argparse.ArgumentParser(
        prog="ident",
        description="Commission a robot arm: excite it, record it, identify parameters a real body could have.",
    )
    parser.add_argument("--version", action="version", version=f"ident-service {__version__}")
    verbs = parser.add_subparsers(required=True, metavar="VERB")

    def verb(name: str, run: Callable[[argparse.Namespace], Answer], text: str, **rest: Any) -> argparse.ArgumentParser:
        sub: argparse.ArgumentParser = verbs.add_parser(name, parents=[common], help=text, description=text, **rest)
        sub.set_defaults(verb=run)
        return sub

    sub = verb("simulate", _simulate, "the whole job on a simulated arm, scored against the known truth")
    sub.add_argument("arm", nargs="?", default="wam7_sim", metavar="ARM", help="description with a simulated driver")
    sub.add_argument("--out", type=Path, help="run folder; must not exist (default: below the state folder)")
    sub.add_argument("--seed", type=_seed, help="seed of the simulated arm's noise (default: the description's)")
    sub.add_argument("--feasible-set", choices=[*_SETS, "none"])

    sub = verb("identify", _identify, "recordings to parameters.json, URDF and report")
    sub.add_argument(
        "recordings", nargs="+", type=Path, metavar="RECORDING", help="MCAP or CSV; FILE@2:1.5 leaves out 2 s and 1.5 s"
    )
    sub.add_argument("--arm", required=True, metavar="ARM", help="description file, or the name of a shipped one")
    sub.add_argument(
        "--validate", action="append", default=[], type=Path, metavar="RECORDING", help="judge on this one too"
    )
    sub.add_argument("--columns", type=Path, metavar="FILE", help="YAML that says how the recordings are laid out")
    sub.add_argument("--method", choices=["ols", "wls", "huber", "iv"], help="default: the arm's")
    sub.add_argument("--prior", choices=["none", "euclidean", "entropic"], help="draw the estimate to the arm's prior")
    sub.add_argument("--prior-weight", type=_share, metavar="W", help="default: chosen on held-out data")
    sub.add_argument("--delay", type=_delay, metavar="SECONDS", help="of the torque's stamps, or 'estimate'")
    sub.add_argument(
        "--bootstrap", type=_replicates, default=0, metavar="N", help="replicates of the constrained estimate"
    )
    sub.add_argument("--essential", action="store_true", help="also the smallest model that predicts as well")
    sub.add_argument("--sdpa", action="store_true", help="also the problems in SDPA format, for other solvers")
    sub.add_argument("--feasible-set", choices=[*_SETS, "none"], help="default: the arm's; none: unconstrained")
    sub.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="where results go, files of the same name being replaced (default: a new folder below the state folder)",
    )

    sub = verb("base", _base, "base parameters and their expressions")
    sub.add_argument("arm", metavar="ARM")

    sub = verb("feasible", _feasible, "could a real body have these parameters? (exit code 3: no)")
    sub.add_argument("file", type=Path, metavar="FILE")
    sub.add_argument("--feasible-set", choices=_SETS)
    sub.add_argument("--arm", metavar="ARM", help="adds the arm's mass, centre-of-mass and sign conditions")

    sub = verb("correct", _correct, "the nearest feasible parameters")
    sub.add_argument("file", type=Path, metavar="FILE")
    sub.add_argument("--metric", choices=["euclidean", "covariance"], default="euclidean", help="what nearest means")
    sub.add_argument("--out", type=Path, required=True, metavar="FILE")
    sub.add_argument("--feasible-set", choices=_SETS)
    sub.add_argument("--arm", metavar="ARM", help="adds the arm's mass, centre-of-mass and sign conditions")

    sub = verb("verify", _verify, "check a certificate in exact arithmetic (exit code 3: not proven feasible)")
    sub.add_argument("file", type=Path, metavar="FILE")

    config = verbs.add_parser("config", help="arm descriptions").add_subparsers(required=True, metavar="VERB")
    check = config.add_parser("check", parents=[common], help="every mistake with file, line and column")
    check.add_argument("file", metavar="FILE")
    check.set_defaults(verb=_config_check)
    return parser


def _seed(text: str) -> int:
    if not text.isdigit():
        raise argparse.ArgumentTypeError("a seed is a whole number, 0 or more")
    return int(text)


def _replicates(text: str) -> int:
    if not text.isdigit() or int(text) == 1:
        raise argparse.ArgumentTypeError("a number of replicates is 0, or 2 and more")
    return int(text)


def _share(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value < float("inf"):
        raise argparse.ArgumentTypeError("a weight is a number, 0 or more")
    return value


def _delay(text: str) -> float | str:
    if text == "estimate":
        return text
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < 1.0:
        raise argparse.ArgumentTypeError("a delay is a number of seconds below 1, or 'estimate'")
    return value


def _state_folder(arguments: argparse.Namespace) -> Path:
    if arguments.state is not None:
        if not arguments.state:
            raise UsageError("--state needs the name of a folder")
        return Path(arguments.state)
    if given := os.environ.get("IDENT_STATE"):
        return Path(given)
    base = os.environ.get("XDG_STATE_HOME")
    return (Path(base) if base else Path.home() / ".local" / "state") / "ident"


def _simulate(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.load import load_arm
    from ident_service.results.summary import summary
    from ident_service.service.commission import new_run_folder, score_document, simulate

    config = load_arm(arguments.arm)
    if arguments.seed is not None and config.driver is not None:
        config = config.model_copy(update={"driver": config.driver.model_copy(update={"seed": arguments.seed})})
    folder = arguments.out or new_run_folder(_state_folder(arguments), config.name)
    stopping = _StopOnSignal()
    with stopping:
        result = simulate(
            config,
            folder,
            set_name=arguments.feasible_set,
            tell=lambda line: _tell(arguments, line),
            stop_requested=stopping.requested,
        )
    scored, estimate = result.score, result.estimate
    lines = [
        "",
        summary(estimate),
        "score against the truth, which the estimate never saw",
        f"  predicted torque against noise-free torque (validation): {scored.noise_free_percent:.3f} %",
        f"  validation residual over what the true parameters leave: {scored.residual_ratio:.4f}",
        f"  worst identified parameter: {scored.worst_identified:.2f} deviations off, {scored.worst_expression}",
        "",
        f"files: {result.folder}",
        *(f"  {path.name}" for path in sorted(result.folder.iterdir())),
        "",
    ]
    document = {"folder": str(result.folder), "score": score_document(scored), **_estimate_document(estimate)}
    return (DONE if estimate.feasible else VERDICT_NO), "\n".join(lines), document


def _identify(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.load import load_arm
    from ident_service.results.summary import summary
    from ident_service.service.commission import new_run_folder
    from ident_service.service.identification import Request, identify_files

    request = Request(
        arm=arguments.arm,
        recordings=tuple(arguments.recordings),
        validation=tuple(arguments.validate),
        columns=arguments.columns,
        method=arguments.method,
        set_name=arguments.feasible_set,
        prior=arguments.prior,
        prior_weight=arguments.prior_weight,
        delay=arguments.delay,
        replicates=arguments.bootstrap,
        essential=arguments.essential,
        sdpa=arguments.sdpa,
    )
    folder = arguments.out or new_run_folder(_state_folder(arguments), load_arm(arguments.arm).name)
    result = identify_files(request, folder, lambda line: _tell(arguments, line))
    estimate = result.estimate
    sys.stderr.write("".join(f"ident: {line}\n" for line in result.warnings))
    text = summary(estimate) + f"\nfiles: {folder}\n" + "".join(f"  {name}\n" for name in result.files)
    code = DONE if estimate.feasible else VERDICT_NO
    document = {"folder": str(folder), "files": list(result.files), "warnings": list(result.warnings)}
    return code, text, document | _estimate_document(estimate)


def _base(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.load import load_arm
    from ident_service.model.arm_model import arm_model
    from ident_service.model.base import base_parameters

    model = arm_model(load_arm(arguments.arm))
    base = base_parameters(model.chain, model.layout)
    text = "".join(f"{number:4d}  {expression}\n" for number, expression in enumerate(base.expressions, 1))
    text += f"{base.size} base parameters of {len(base.names)} link parameters\n"
    return (
        DONE,
        text,
        {
            "arm": model.config.name,
            "link_parameters": list(base.names),
            "base_parameters": {"expressions": list(base.expressions), "units": list(base.units)},
        },
    )


def _feasible(arguments: argparse.Namespace) -> Answer:
    from ident_service.service.parameters import check_file

    tested = check_file(arguments.file, arguments.feasible_set, arguments.arm)
    result = tested.result
    word = "feasible" if result.feasible else "INFEASIBLE"
    text = f"{arguments.file}: {word} ({tested.kind}), margin {result.margin:.6g}\n"
    if not result.feasible:
        text += "contradicted by:\n" + "".join(f"  {name}\n" for name in result.tight)
    document = {
        "file": str(arguments.file),
        "feasible_set": tested.kind,
        "feasible": result.feasible,
        "margin": result.margin,
        "tight": list(result.tight),
    }
    return (DONE if result.feasible else VERDICT_NO), text, document


def _correct(arguments: argparse.Namespace) -> Answer:
    from ident_service.service.parameters import correct_file

    corrected = correct_file(arguments.file, arguments.out, arguments.feasible_set, arguments.arm, arguments.metric)
    result = corrected.result
    text = (
        f"{arguments.out}: feasible ({corrected.kind}), margin {result.margin:.3g}, "
        f"{result.objective:.6g} away from {arguments.file} in the {arguments.metric} metric\n"
    )
    document = {
        "file": str(arguments.out),
        "feasible_set": corrected.kind,
        "distance": result.objective,
        "margin": result.margin,
        "values": result.beta.tolist(),
    }
    return DONE, text, document


def _verify(arguments: argparse.Namespace) -> Answer:
    from ident_service.service.verify import verify_file

    result = verify_file(arguments.file)
    if result.verdict == "failed" and result.message.startswith("not a parameter file"):
        raise ParameterError(f"{arguments.file}: {result.message}")
    text = f"{arguments.file}: {result.verdict}: {result.message}\n" + "".join(f"  {line}\n" for line in result.checked)
    document = {"file": str(arguments.file), "verdict": result.verdict, "message": result.message}
    return (DONE if result.verdict == "feasible" else VERDICT_NO), text, document | {"checked": list(result.checked)}


def _config_check(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.load import load_arm
    from ident_service.model.arm_model import arm_model

    model = arm_model(load_arm(arguments.file))
    text = f"{arguments.file}: {model.config.name}, {model.chain.joints} joints, {model.layout.size} parameters: good\n"
    return DONE, text, {"file": arguments.file, "arm": model.config.name, "sha256": model.config.sha256, "problems": []}


def _estimate_document(estimate: Any) -> dict[str, Any]:
    own = estimate.candidates[estimate.chosen]
    return {
        "arm": estimate.model.config.name,
        "feasible": estimate.feasible,
        "margin": estimate.margin,
        "relative_error_percent": own.identification.relative_percent,
        "validation": [
            {"recording": score.recording, "relative_error_percent": score.error.relative_percent}
            for score in own.validation
        ],
        "candidates": [
            {
                "name": candidate.name,
                "feasible": candidate.margin > 0.0,
                "margin": candidate.margin,
                "relative_error_percent": candidate.identification.relative_percent,
            }
            for candidate in estimate.candidates
        ],
        "verdicts": {word: estimate.verdicts.count(word) for word in ("identified", "weak", "unidentified")},
    }


def _tell(arguments: argparse.Namespace, line: str) -> None:
    # With --json, stdout belongs to the one object.
    print(line, file=sys.stderr if arguments.json else sys.stdout, flush=True)


class _StopOnSignal:
    """Ctrl-C or a polite kill asks for a controlled stop; a second one ends the process as usual."""

    def __init__(self) -> None:
        self._asked = False

    def requested(self) -> bool:
        return self._asked

    def __enter__(self) -> None:
        self._before = {number: signal.signal(number, self._ask) for number in (signal.SIGINT, signal.SIGTERM)}

    def __exit__(self, *_: object) -> None:
        for number, before in self._before.items():
            signal.signal(number, before)

    def _ask(self, number: int, _: object) -> None:
        self._asked = True
        signal.signal(number, self._before[signal.Signals(number)])


if __name__ == "__main__":
    sys.exit(main())
