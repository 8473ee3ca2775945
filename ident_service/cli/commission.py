"""Register and run the verbs that estimate parameters: `simulate` the whole job, `identify` recordings."""

from __future__ import annotations

import argparse
import atexit
import gc
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ident_service.cli.answer import DONE, VERDICT_NO, Answer, StopOnSignal, own_state_folder, tell
from ident_service.cli.words import FEASIBLE_SETS, Verbs, columns_files, delay, replicates, seed, weight

if TYPE_CHECKING:
    from ident_service.estimation.identify import Estimate


_COLLECT_AFTER = 200_000  # objects more than before; Python's own 700 are for programs that make few that stay


def add(verbs: Verbs) -> None:
    """Register `simulate` and `identify`."""
    sub = verbs.add("simulate", _simulate, "the whole job on a simulated arm, scored against the known truth")
    sub.add_argument("arm", nargs="?", default="wam7_sim", metavar="ARM", help="description with a simulated driver")
    sub.add_argument("--out", type=Path, help="run folder; must not exist (default: below the state folder)")
    sub.add_argument("--motion", type=Path, metavar="MOTION", help="motion.json to identify from (default: the arm's)")
    sub.add_argument("--seed", type=seed, help="seed of the simulated arm's noise (default: the description's)")
    sub.add_argument("--feasible-set", choices=[*FEASIBLE_SETS, "none"])

    sub = verbs.add("identify", _identify, "recordings to parameters.json, URDF and report")
    sub.add_argument(
        "recordings", nargs="+", type=Path, metavar="RECORDING", help="MCAP or CSV; FILE@41:60 reads 41 s to 60 s of it"
    )
    sub.add_argument("--arm", required=True, metavar="ARM", help="description file, or the name of a shipped one")
    sub.add_argument(
        "--validate", action="append", default=[], type=Path, metavar="RECORDING", help="judge on this one too"
    )
    sub.add_argument(
        "--columns",
        action="append",
        default=[],
        metavar="[RECORDING=]FILE",
        help="YAML that says how the recordings are laid out, or RECORDING alone; may be repeated",
    )
    sub.add_argument(
        "--cut-standstill", action="store_true", help="leave out standstill at the start and end of recordings"
    )
    sub.add_argument("--method", choices=["ols", "wls", "huber", "iv"], help="default: the arm's")
    sub.add_argument("--prior", choices=["none", "euclidean", "entropic"], help="draw the estimate to the arm's prior")
    sub.add_argument("--prior-weight", type=weight, metavar="W", help="default: chosen on held-out data")
    sub.add_argument("--delay", type=delay, metavar="SECONDS", help="of the torque's stamps, 'estimate' or 'choose'")
    sub.add_argument(
        "--bootstrap", type=replicates, default=0, metavar="N", help="replicates of the constrained estimate"
    )
    sub.add_argument("--essential", action="store_true", help="also the smallest model that predicts as well")
    sub.add_argument("--sdpa", action="store_true", help="also the problems in SDPA format, for other solvers")
    sub.add_argument("--feasible-set", choices=[*FEASIBLE_SETS, "none"], help="default: the arm's; none: unconstrained")
    sub.add_argument(
        "--second-opinion", action="store_true", help="solve the constrained problem again, in cvxpy, and compare"
    )
    sub.add_argument(
        "--solver", metavar="NAME", help="of cvxpy, for constraints.custom and the second opinion (default: clarabel)"
    )
    sub.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="where results go, in the place of an earlier result (default: a new folder below the state folder)",
    )


def _simulate(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.load import load_arm
    from ident_service.excitation.excitation import read_excitation
    from ident_service.operations.commission import score_document, simulate
    from ident_service.operations.folders import new_run_folder
    from ident_service.operations.identification import custom_of
    from ident_service.results.summary import summary

    config = described = load_arm(arguments.arm)
    if arguments.seed is not None and config.driver is not None:
        config = config.model_copy(update={"driver": config.driver.model_copy(update={"seed": arguments.seed})})
    folder = arguments.out or new_run_folder(own_state_folder(arguments), config.name)
    stopping = StopOnSignal()
    with stopping:
        result = simulate(
            config,
            folder,
            motion=None if arguments.motion is None else read_excitation(arguments.motion),
            set_name=arguments.feasible_set,
            described=described,
            custom=custom_of(arguments.arm, described),
            tell=lambda line: tell(arguments, line),
            stop_requested=stopping.requested,
        )
    scored, estimate = result.score, result.estimate
    lines = [
        "",
        summary(estimate, result.unusable),
        "score against the truth, which the estimate never saw",
        f"  predicted torque against noise-free torque (validation): {scored.noise_free_percent:.3f} %",
        f"  validation residual over what the true parameters leave: {scored.residual_ratio:.4f}",
        f"  worst identified parameter: {scored.worst_identified:.2f} deviations off, {scored.worst_expression}",
        "",
        f"files: {result.folder}",
        *(f"  {path.name}" for path in sorted(result.folder.iterdir())),
        "",
    ]
    document = {"folder": str(result.folder), "score": score_document(scored)}
    document |= _estimate_document(estimate, result.unusable)
    return _exit_code(estimate, result.unusable), "\n".join(lines), document


@contextmanager
def _few_collections() -> Iterator[None]:
    """Look for garbage hardly ever: modules make objects that stay, and looks at them are a twentieth of the time."""
    atexit.register(gc.freeze)  # nor when the process ends
    usual = gc.get_threshold()
    gc.set_threshold(_COLLECT_AFTER, *usual[1:])
    try:
        yield
    finally:
        gc.set_threshold(*usual)


@_few_collections()
def _identify(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.load import load_arm
    from ident_service.operations.folders import new_run_folder
    from ident_service.operations.identification import Request, identify_files
    from ident_service.results.summary import summary

    columns, columns_of = columns_files(arguments.columns)
    request = Request(
        arm=arguments.arm,
        recordings=tuple(arguments.recordings),
        validation=tuple(arguments.validate),
        columns=columns,
        columns_of=columns_of,
        cut_standstill=arguments.cut_standstill,
        method=arguments.method,
        set_name=arguments.feasible_set,
        prior=arguments.prior,
        prior_weight=arguments.prior_weight,
        delay=arguments.delay,
        replicates=arguments.bootstrap,
        essential=arguments.essential,
        sdpa=arguments.sdpa,
        solver=arguments.solver,
        second_opinion=arguments.second_opinion,
    )
    folder = arguments.out or new_run_folder(own_state_folder(arguments), load_arm(arguments.arm).name)
    result = identify_files(request, folder, lambda line: tell(arguments, line))
    estimate = result.estimate
    sys.stderr.write("".join(f"ident: {line}\n" for line in result.warnings))
    text = summary(estimate, result.unusable, result.torque)
    text += f"\nfiles: {folder}\n" + "".join(f"  {name}\n" for name in result.files)
    document = {"folder": str(folder), "files": list(result.files), "warnings": list(result.warnings)}
    document["torque"] = result.torque
    document |= _estimate_document(estimate, result.unusable)
    return _exit_code(estimate, result.unusable), text, document


def _exit_code(estimate: Estimate, unusable: Sequence[str]) -> int:
    return DONE if estimate.feasible and not unusable else VERDICT_NO


def _estimate_document(estimate: Estimate, unusable: Sequence[str]) -> dict[str, Any]:
    from ident_service.results.link_values import implausible_links
    from ident_service.results.parameter_file import convex_document
    from ident_service.results.rows_and_filter import how_fitted

    own = estimate.candidates[estimate.chosen]
    return {
        "arm": estimate.model.config.name,
        "usable": estimate.feasible and not unusable,
        "unusable": list(unusable),
        "feasible": estimate.feasible,
        "margin": estimate.margin,
        "relative_error_percent": own.identification.relative_percent,
        "implausible_links": list(implausible_links(estimate)),
        "rows_and_filter": list(how_fitted(estimate)),
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
        **convex_document(estimate),
    }
