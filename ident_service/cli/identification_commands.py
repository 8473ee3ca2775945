"""Commands that make or judge parameters, from `simulate` and `identify` to `compare`, `export` and `report`."""

from __future__ import annotations

import argparse
import gc
import importlib.util
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from ident_service.cli.arguments import (
    FEASIBLE_SETS,
    VerbList,
    add_repeatable,
    columns_files,
    did_you_mean,
    parse_delay,
    payload_files_of,
    replicates,
    seed,
    weight,
    workers,
)
from ident_service.cli.output import (
    DONE,
    VERDICT_NO,
    Answer,
    StopOnSignal,
    print_to_person,
    state_folder,
    tell,
    writable_state_folder,
)
from ident_service.cli.progress import step_of
from ident_service.errors import ParameterError, UsageError
from ident_service.model.notation import NOTATIONS

if TYPE_CHECKING:
    from ident_service.estimation.identify import Estimate
    from ident_service.estimation.plausibility import Objections

_COLLECT_AFTER = 200_000  # objects more than before; Python's own 700 are for programs that make few that stay
_NO_PLUGINS = {"PYDANTIC_DISABLE_PLUGINS": "__all__"}  # pydantic reads what every installed package says to find them
# These load all of their modules, a tenth of the time of `ident identify`, which takes LAPACK of the one (as Clarabel
# does) and Student's t of the other.
_PARTLY = ("scipy.linalg", "scipy.special")
OF_ARMS = "arms/*/parameters.json"
"""Those of a fleet, in folders that a daemon does not send."""


def _add_commission(verbs: VerbList) -> None:
    """Register `simulate` and `identify`."""
    sub = verbs.add(
        "simulate",
        _simulate,
        "commission a simulated arm, and score the result",
        more="It moves, is identified, and is compared with its true parameters; no hardware and no file is needed.",
        examples=("", "planar2 --seed 3", "planar2 --out trial"),
    )
    sub.add_argument("arm", nargs="?", default="wam7_sim", metavar="ARM", help="description with a simulated driver")
    sub.add_argument("--out", type=Path, help="run folder; must not exist (default: below the state folder)")
    sub.add_argument("--motion", type=Path, metavar="MOTION", help="motion.json to identify from (default: the arm's)")
    sub.add_argument("--seed", type=seed, help="seed of the simulated arm's noise (default: the description's)")
    sub.add_argument("--feasible-set", choices=[*FEASIBLE_SETS, "none"])

    sub = verbs.add(
        "identify",
        _identify,
        "identify parameters from recordings",
        more="Writes parameters.json, a URDF and a report (exit code 3: infeasible, or not to be used).",
        examples=(
            "run.mcap --arm my_arm.yaml",
            "first.mcap second.mcap@5:60 --arm wam7 --validate third.mcap",
            "log.csv --arm planar2 --columns columns.yaml --out result",
        ),
    )
    sub.add_argument(
        "recordings", nargs="+", type=Path, metavar="RECORDING", help="MCAP or CSV; FILE@41:60 reads 41 s to 60 s of it"
    )
    sub.add_argument("--arm", required=True, metavar="ARM", help="description file, or the name of a shipped one")
    add_repeatable(sub, "--validate", "RECORDING", "validate on this recording; may be repeated", Path)
    columns = "YAML file with column names and units, for all recordings or one; may be repeated"
    add_repeatable(sub, "--columns", "[RECORDING=]FILE", columns)
    payload = "YAML file with mass and center_of_mass of the known load in a recording; may be repeated"
    add_repeatable(sub, "--payload", "RECORDING=FILE", payload)
    sub.add_argument(
        "--torque-constants",
        action="store_true",
        help="also identify every motor's torque constant; needs a recording with a known load (--payload)",
    )
    sub.add_argument(
        "--cut-standstill", action="store_true", help="leave out standstill at the start and end of recordings"
    )
    sub.add_argument("--method", choices=["ols", "wls", "huber", "iv"], help="default: the arm's")
    sub.add_argument("--prior", choices=["none", "euclidean", "entropic"], help="regularise towards the arm's prior")
    sub.add_argument("--prior-weight", type=weight, metavar="W", help="default: chosen on held-out data")
    sub.add_argument(
        "--delay", type=parse_delay, metavar="SECONDS", help="delay of the torque stamps [s], 'estimate' or 'choose'"
    )
    sub.add_argument(
        "--bootstrap",
        type=replicates,
        default=0,
        metavar="N",
        help="number of bootstrap replicates of the constrained estimate",
    )
    sub.add_argument("--essential", action="store_true", help="also identify the smallest model that predicts as well")
    sub.add_argument("--sdpa", action="store_true", help="also write the problems in SDPA format, for other solvers")
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
        help="result folder; replaces an earlier result (default: a new folder below the state folder)",
    )


def _simulate(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.load import load_arm
    from ident_service.excitation.motion_file import read_excitation
    from ident_service.operations.commissioning import score_document, simulate
    from ident_service.operations.identification import custom_of
    from ident_service.registry.state_folder import new_run_folder
    from ident_service.results.summary import summary

    config = described = load_arm(arguments.arm)
    if arguments.seed is not None and config.driver is not None:
        config = config.model_copy(update={"driver": config.driver.model_copy(update={"seed": arguments.seed})})
    folder = arguments.out or new_run_folder(writable_state_folder(arguments), config.name)
    stopping = StopOnSignal()
    with stopping:
        result = simulate(
            config,
            folder,
            motion=None if arguments.motion is None else read_excitation(arguments.motion),
            set_name=arguments.feasible_set,
            config_as_read=described,
            custom=custom_of(arguments.arm, described),
            tell=lambda line: tell(arguments, line),
            step=step_of(arguments),
            stop_requested=stopping.requested,
        )
    scored, estimate = result.score, result.estimate
    lines = [
        "",
        summary(estimate, result.objections.reasons, warnings=result.warnings),
        "comparison with the true parameters",
        f"  predicted torque against noise-free torque (validation): {scored.noise_free_percent:.3f} %",
        f"  validation residual over that of the true parameters: {scored.residual_ratio:.4f}",
        f"  worst identified parameter: {scored.worst_identified:.2f} deviations off, {scored.worst_expression}",
        "",
        f"files: {result.folder}",
        *(f"  {path.name}" for path in sorted(result.folder.iterdir())),
        "",
    ]
    document = {"folder": str(result.folder), "score": score_document(scored)}
    document |= _estimate_document(estimate, result.objections, result.warnings)
    return _exit_code(document), "\n".join(lines), document


class _Package(ModuleType):
    """Package whose modules load by their whole names, and whose own program runs when another name is asked for."""

    def __getattr__(self, name: str) -> Any:
        """Return a compiled function of scipy.special, or else load the package as usual."""
        if name.startswith("_") and name != "__all__":
            # `from package import _module` then loads that module, alone.
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}", name=name, obj=self)
        if self.__name__ == "scipy.special":
            from scipy.special import _ufuncs

            if name in vars(_ufuncs):
                return vars(_ufuncs)[name]
        self.__class__ = ModuleType  # type: ignore[assignment]  # from here on as any other
        if self.__spec__ is not None and self.__spec__.loader is not None:
            self.__spec__.loader.exec_module(self)
        return getattr(self, name)


@contextmanager
def quick_imports() -> Iterator[None]:
    """Put off large packages' own code until needed; in the block, collect garbage rarely and load no pydantic plugins.

    Modules make objects that stay, and looks at them are a twentieth of the time.
    """
    for name in _PARTLY:
        if name not in sys.modules and (spec := importlib.util.find_spec(name)) is not None:
            package = importlib.util.module_from_spec(spec)
            package.__class__ = _Package
            sys.modules[name] = package
            parent, _, last = name.rpartition(".")
            setattr(sys.modules[parent], last, package)
    plugins = {name: os.environ.get(name) for name in _NO_PLUGINS}
    os.environ.update(_NO_PLUGINS)
    gc.unfreeze()
    usual = gc.get_threshold()
    gc.set_threshold(_COLLECT_AFTER, *usual[1:])
    try:
        yield
    finally:
        gc.freeze()  # or all of these objects would be looked at now, and again when the process ends
        gc.set_threshold(*usual)
        for name, value in plugins.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@quick_imports()
def _identify(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.load import load_arm
    from ident_service.operations.identification import Request, identify_files
    from ident_service.registry.state_folder import new_run_folder
    from ident_service.results.summary import summary

    columns, columns_of = columns_files(arguments.columns)
    request = Request(
        arm=arguments.arm,
        recordings=tuple(arguments.recordings),
        validation=tuple(arguments.validate),
        columns=columns,
        columns_of=columns_of,
        payloads=payload_files_of(arguments.payload),
        torque_constants=arguments.torque_constants,
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
    folder = arguments.out or new_run_folder(writable_state_folder(arguments), load_arm(arguments.arm).name)
    result = identify_files(request, folder, lambda line: tell(arguments, line), step_of(arguments))
    estimate = result.estimate
    print_to_person("".join(f"ident: {line}\n" for line in result.warnings))
    text = summary(estimate, result.objections.reasons, result.torque, result.warnings)
    text += f"\nfiles: {folder}\n" + "".join(f"  {name}\n" for name in result.files)
    document = {"folder": str(folder), "files": list(result.files), "warnings": list(result.warnings)}
    document["torque"] = result.torque
    document |= _estimate_document(estimate, result.objections, result.warnings)
    return _exit_code(document), text, document


def _exit_code(document: dict[str, Any]) -> int:
    return DONE if document["usable"] else VERDICT_NO


def _estimate_document(estimate: Estimate, objections: Objections, warnings: Sequence[str]) -> dict[str, Any]:
    from ident_service.results.assessment import assess_estimate
    from ident_service.results.parameter_file import convex_document
    from ident_service.results.summary import how_fitted, implausible_links, torque_constants_document

    own = estimate.candidates[estimate.chosen]
    found = assess_estimate(estimate, objections.reasons, warnings)
    return {
        "arm": estimate.model.config.name,
        "assessment": found.document(),
        "usable": found.word != "do not use",
        "unusable": list(objections.reasons),
        "another_motion_mends": objections.motion_mends,
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
        **torque_constants_document(estimate),
        **convex_document(estimate),
    }


def _add_fleet(verbs: VerbList) -> None:
    """Register `fleet identify` and `fleet status`."""
    fleet = verbs.group(
        "fleet",
        "identify many arms from many recordings",
        more="On several processes of this machine, or on a Dask cluster.",
    )
    sub = fleet.add(
        "identify",
        _fleet_identify,
        "identify each arm, what is common, and trends",
        more="Writes one page with all of it (exit code 3: recordings left out, or an arm changed).",
        examples=("'recordings/*/*.mcap' --arm wam7", "s3://lab/wam/ --arm wam7 --scheduler tcp://node1:8786"),
    )
    sub.add_argument(
        "patterns",
        nargs="+",
        metavar="PATTERN",
        help="files, folders, globs, or such URLs: s3://, gs://, sftp://; with --server: names of its arms",
    )
    _fleet_options(sub)
    sub.add_argument(
        "--scheduler", metavar="ADDRESS", help="of a Dask cluster, tcp://HOST:8786 (default: this machine)"
    )
    sub.add_argument("--workers", type=workers, metavar="N", help="processes on this machine (default: one per core)")
    sub.add_argument("--memory", default="500MiB", metavar="SIZE", help="limit of each of them (default: 500MiB)")
    sub.add_argument(
        "--settle-again", action="store_true", help="choose filter, delay and friction's shape anew; factors follow"
    )
    sub.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="where results go, in the place of an earlier result (default: a new folder below the state folder)",
    )
    sub = fleet.add(
        "status",
        _fleet_status,
        "show what the store has of these recordings",
        more="Nothing is computed.",
        examples=("--arm wam7", "'recordings/*/*.mcap' --arm wam7 --store factors"),
    )
    sub.add_argument("patterns", nargs="*", metavar="PATTERN", help="as for identify")
    _fleet_options(sub)


def _fleet_options(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--arm", required=True, metavar="ARM", help="description of every arm: file, or shipped name")
    sub.add_argument(
        "--names",
        metavar="REGEX",
        help="finds (?P<arm>...), and (?P<date>...) if any, in a recording's URL (default: the arm is its folder)",
    )
    sub.add_argument(
        "--store", metavar="URL", help="where factors are kept, a folder or URL (default: below the state folder)"
    )


def _fleet_request(arguments: argparse.Namespace, **more: Any) -> Any:
    missing = [name for name in ("distributed", "fsspec", "pyarrow") if importlib.util.find_spec(name) is None]
    if missing:
        raise UsageError(f"{', '.join(missing)} is not installed; pip install 'ident-service[fleet]'")
    from ident_service.fleet.reduction import FleetRequest

    store = arguments.store or str(writable_state_folder(arguments) / "fleet" / "store")
    return FleetRequest(
        arm=arguments.arm, patterns=tuple(arguments.patterns), store=store, names=arguments.names, **more
    )


def _fleet_identify(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.load import load_arm
    from ident_service.model.arm_model import arm_model
    from ident_service.registry.state_folder import new_run_folder

    request = _fleet_request(
        arguments,
        scheduler=arguments.scheduler,
        workers=arguments.workers,
        memory=arguments.memory,
        settle_again=arguments.settle_again,
    )
    from ident_service.fleet.identify import identify_fleet
    from ident_service.fleet.results import FLEET, PAGE, TABLE

    config = load_arm(arguments.arm)
    arm_model(config)  # what cannot be used is told before workers start
    folder = arguments.out or new_run_folder(writable_state_folder(arguments), config.name, "fleets")
    result = identify_fleet(request, folder, lambda line: tell(arguments, line), step_of(arguments))
    good = not result.document["left_out"] and not result.changed
    files = [f"files: {folder}", *(f"  {name}" for name in (PAGE, FLEET, TABLE, OF_ARMS)), ""]
    text = "\n".join([*_fleet_lines(result.document), *files])
    return (DONE if good else VERDICT_NO), text, {"folder": str(folder), **result.document}


def _fleet_lines(document: Mapping[str, Any]) -> list[str]:
    lines = [
        f"{document['recordings']} recordings of {len(document['arms'])} arms, {len(document['left_out'])} left out"
    ]
    lines += [f"  left out: {one['url']}{one['piece']}: {one['message']}" for one in document["left_out"]]
    for key, words in (("several_recordings", "as recorded"), ("one_recording", "with one recording each")):
        held = document["held_out"][key]
        if held["arms"]:
            helps = "pooled" if held["pooling_helps"] else "each arm alone"
            lines.append(
                f"torque error on held-out recordings, {words}: {held['alone_percent']:.3g} % alone,"
                f" {held['pooled_percent']:.3g} % pooled ({round(-100.0 * held['gain']):+d} %): {helps}"
            )
    differing = {arm: document["arms"][arm]["differs"] for arm in document["ranking"]}
    lines.append(f"unlike the others: {', '.join(arm for arm, found in differing.items() if found) or 'no arm'}")
    lines += [
        f"  {arm}: {one['what']}, {one['sigma']:.1f} sigma, {one['torque_share']:.1%} of {one['joint']}"
        for arm, found in differing.items()
        for one in found
    ]
    lines.append(f"changed: {', '.join(dict.fromkeys(one['arm'] for one in document['changes'])) or 'no arm'}")
    lines += [
        f"  {one['arm']}: {one['what']}{' drifts' if one['kind'] == 'drift' else ''} between {one['after'][:10]} and "
        f"{one['until'][:10]}, {one['sigma']:.1f} sigma"
        for one in document["changes"]
    ]
    lines += [f"  alarm: {one['arm']}: {one['what']}" for one in document.get("alarms", [])]
    return lines


def _fleet_status(arguments: argparse.Namespace) -> Answer:
    request = _fleet_request(arguments)
    from ident_service.fleet.reduction import status_of

    document = dict(status_of(request))
    lines = [f"{document['factors']} factors, {document['bytes'] / 2**20:.1f} MiB, in {document['store']}"]
    if document["settled"]:
        lines.append(f"filter, delay and friction's shape are settled by {document['settled_by']}")
    for arm, counts in document.get("arms", {}).items():
        lines.append(f"  {arm}: {counts['reduced']} of {counts['recordings']} recordings reduced")
    lines += [f"  new: {url}" for url in document.get("new", [])]
    return DONE, "\n".join(lines) + "\n", document


def _add_comparing(verbs: VerbList) -> None:
    """Register `compare` and `payload`."""
    sub = verbs.add(
        "compare",
        _compare,
        "compare parameter sets: has the arm changed?",
        more="Exit code 3: it has, or that is undecided.",
        examples=("before/parameters.json after", "accepted:wam7 result --out comparison"),
    )
    reference = "the reference: a folder of results, a parameters.json, or accepted:NAME, the accepted set of an arm"
    sub.add_argument("reference", type=Path, metavar="A", help=reference)
    sub.add_argument(
        "others", type=Path, nargs="+", metavar="B", help="folder of results, or parameters.json, to compare"
    )
    out = sub.add_mutually_exclusive_group()
    out.add_argument("--out", type=Path, metavar="PATH", help="FILE.json, or a folder for JSON, text and page")
    out.add_argument("--keep", action="store_true", help="write into folder B and its manifest; one B only")

    sub = verbs.add(
        "payload",
        _payload,
        "identify the payload of an identified arm",
        more="Exit code 3: there is none, or no physical body.",
        examples=("result with_load.mcap", "result with_load.mcap@10:40 --refit-offsets --out load"),
    )
    sub.add_argument("run", type=Path, metavar="RUN", help="folder of results of the arm without the load")
    sub.add_argument(
        "recordings",
        nargs="+",
        type=Path,
        metavar="RECORDING",
        help="with the payload; FILE@41:60 reads 41 s to 60 s of it",
    )
    sub.add_argument("--refit-offsets", action="store_true", help="estimate the torque offsets again")
    sub.add_argument(
        "--out", type=Path, metavar="DIR", help="result folder (default: a new folder below the state folder)"
    )


def accepted_name(path: Path) -> str | None:
    """Return NAME of a path `accepted:NAME`, which means an arm's accepted set; None for a file and other paths."""
    word, _, name = str(path).partition(":")
    return name if word == "accepted" and name and "/" not in name and not path.exists() else None


def _require_arm(arm: str, known: Sequence[str]) -> None:
    """Refuse `accepted:NAME` of an arm of which nothing is known.

    Raises:
        UsageError: with the arms that are.
    """
    if arm not in known:
        there = f"; known are {', '.join(known)}" if known else ""
        raise UsageError(f"accepted:{arm}: no arm of this name has an accepted set{did_you_mean(arm, known) or there}")


def _compare(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.parameter_files import KEPT, compare_files, compare_into
    from ident_service.results.comparison.presentation import comparison_document, comparison_text

    reference = arguments.reference
    if (arm := accepted_name(reference)) is not None:
        from ident_service.operations.acceptance import PARAMETERS, accepted_set
        from ident_service.registry.state_folder import known_arms

        _require_arm(arm, known_arms(state_folder(arguments)))
        reference = accepted_set(state_folder(arguments), arm)[1] / PARAMETERS
    if arguments.keep:
        if len(arguments.others) != 1 or not arguments.others[0].is_dir():
            raise UsageError("--keep is for one folder of results that is compared with the reference")
        folder = arguments.others[0]
        comparison, files = compare_into(reference, folder), tuple(folder / name for name in KEPT)
    else:
        comparison, files = compare_files([reference, *arguments.others], arguments.out)
    text = comparison_text(comparison) + "".join(f"file: {path}\n" for path in files)
    document = comparison_document(comparison) | {"files": [str(path) for path in files]}
    return (DONE if comparison.verdict == "unchanged" else VERDICT_NO), text, document


def _payload(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.parameter_files import payload_files
    from ident_service.registry.state_folder import new_run_folder
    from ident_service.results.comparison.presentation import comparison_text

    folder = arguments.out or new_run_folder(writable_state_folder(arguments), arguments.run.resolve().name, "payloads")
    found = payload_files(arguments.run, arguments.recordings, folder, refit_offsets=arguments.refit_offsets)
    text = found.text
    if found.comparison is not None:
        text += "\n" + comparison_text(found.comparison)
    text += f"files: {folder}\n" + "".join(f"  {name}\n" for name in found.files)
    code = DONE if found.payload.verdict in ("added", "removed") else VERDICT_NO
    return code, text, found.document | {"folder": str(folder), "files": list(found.files)}


def _add_parameters(verbs: VerbList) -> None:
    """Register `base-parameters`, `feasible`, `project` and `verify`."""
    sub = verbs.add(
        "base-parameters",
        _base,
        "list the base parameters and their expressions",
        former="base",
        examples=("wam7", "my_arm.yaml --json"),
    )
    sub.add_argument("arm", metavar="ARM")

    sub = verbs.add(
        "feasible",
        _feasible,
        "test whether parameters are physically feasible",
        more="Exit code 3: they are not.",
        examples=("parameters.json", "table.json --arm wam7 --feasible-set inertia"),
    )
    sub.add_argument("file", type=Path, metavar="FILE")
    sub.add_argument("--feasible-set", choices=FEASIBLE_SETS)
    sub.add_argument("--arm", metavar="ARM", help="adds the arm's constraints on mass, centre of mass and signs")
    sub.add_argument("--notation", choices=NOTATIONS, help="notation of the parameter names in the file")

    sub = verbs.add(
        "project",
        _correct,
        "write the feasible parameters nearest to given ones",
        former="correct",
        examples=(
            "table.json --out feasible.json",
            "table.json --metric covariance --out nearest.json",
        ),
    )
    sub.add_argument("file", type=Path, metavar="FILE")
    sub.add_argument(
        "--metric", choices=["euclidean", "covariance"], default="euclidean", help="metric of the distance"
    )
    sub.add_argument("--out", type=Path, required=True, metavar="FILE")
    sub.add_argument("--feasible-set", choices=FEASIBLE_SETS)
    sub.add_argument("--arm", metavar="ARM", help="adds the arm's constraints on mass, centre of mass and signs")
    sub.add_argument("--notation", choices=NOTATIONS, help="notation of the parameter names in the file")

    sub = verbs.add(
        "verify",
        _verify,
        "check a certificate of feasibility in exact arithmetic",
        more="Exit code 3: infeasible, or not valid.",
        examples=("parameters.json", "result --arm wam7"),
    )
    sub.add_argument("file", type=Path, metavar="FILE", help="parameters.json, or the folder that holds it")
    sub.add_argument(
        "--arm",
        metavar="ARM",
        help="description whose constraints apply; without it, the file's own constraints are used",
    )


def _base(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.load import load_arm
    from ident_service.model.arm_model import arm_model
    from ident_service.model.base_parameters import base_parameters, remarks_on_angles

    model = arm_model(load_arm(arguments.arm))
    base = base_parameters(model.chain, model.layout)
    warnings = remarks_on_angles(base)
    text = "".join(f"{number:4d}  {expression}\n" for number, expression in enumerate(base.expressions, 1))
    text += f"{base.size} base parameters of {len(base.names)} link parameters\n"
    text += "".join(f"WARNING: {line}\n" for line in warnings)
    return (
        DONE,
        text,
        {
            "arm": model.config.name,
            "warnings": list(warnings),
            "link_parameters": list(base.names),
            "base_parameters": {"expressions": list(base.expressions), "units": list(base.units)},
        },
    )


def _feasible(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.parameter_files import check_file

    tested = check_file(arguments.file, arguments.feasible_set, arguments.arm, arguments.notation)
    result = tested.result
    word = "feasible" if result.feasible else "INFEASIBLE"
    text = f"{arguments.file}: {word} ({tested.kind}), margin {result.margin:.6g}\n"
    if not result.feasible:
        text += "violated constraints:\n" + "".join(f"  {name}\n" for name in result.tight)
    text += "".join(f"note: {note}\n" for note in tested.notes)
    document = {
        "file": str(arguments.file),
        "feasible_set": tested.kind,
        "feasible": result.feasible,
        "margin": result.margin,
        "tight": list(result.tight),
        "certified": tested.certified,
        "notes": list(tested.notes),
    }
    return (DONE if result.feasible else VERDICT_NO), text, document


def _correct(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.parameter_files import correct_file

    corrected = correct_file(
        arguments.file, arguments.out, arguments.feasible_set, arguments.arm, arguments.metric, arguments.notation
    )
    result = corrected.result
    text = (
        f"{arguments.out}: feasible ({corrected.kind}), margin {result.margin:.3g}, "
        f"{result.objective:.6g} away from {arguments.file} in the {arguments.metric} metric\n"
    )
    text += "".join(f"note: {note}\n" for note in corrected.notes)
    document = {
        "file": str(arguments.out),
        "feasible_set": corrected.kind,
        "distance": result.objective,
        "margin": result.margin,
        "values": result.beta.tolist(),
        "notes": list(corrected.notes),
    }
    return DONE, text, document


def _verify(arguments: argparse.Namespace) -> Answer:
    from ident_service.certificate_verifier import answer_text
    from ident_service.operations.verify import verify_file

    result = verify_file(arguments.file, arguments.arm)
    if not result.about_parameters:
        raise ParameterError(f"{arguments.file}: {result.message}")
    if result.message == "feasibility: missing or not an object":
        words = "there is no certificate in it; `ident feasible` tests it, `ident project` writes one"
        result = replace(result, message=words)
    document = {
        "file": str(arguments.file),
        "arm": result.arm,
        "verdict": result.verdict,
        "message": result.message,
        "checked": list(result.checked),
        "notes": list(result.notes),
    }
    return (DONE if result.verdict == "feasible" else VERDICT_NO), answer_text(arguments.file, result), document


_FORMATS = "urdf,mjcf,sdf,json,csv,c"


def _add_exports(verbs: VerbList) -> None:
    """Register `export`."""
    sub = verbs.add(
        "export",
        _export,
        "export identified parameters for other tools",
        more="Each file is read back and checked.",
        examples=("result", "result --format urdf,mjcf --out models"),
    )
    sub.add_argument("--anyway", action="store_true", help="also what must not be used; every file is marked then")
    sub.add_argument("run", type=Path, metavar="RUN", help="run folder of `identify` or `simulate`")
    sub.add_argument("--format", default=_FORMATS, metavar="LIST", help=f"comma-separated (default: {_FORMATS})")
    sub.add_argument("--out", type=Path, metavar="DIR", help="default: a new folder below the state folder")


def _export(arguments: argparse.Namespace) -> Answer:
    from ident_service.registry.state_folder import new_run_folder
    from ident_service.results.export.formats import export_run, known_formats

    formats = known_formats(arguments.format)
    folder = arguments.out or new_run_folder(writable_state_folder(arguments), arguments.run.resolve().name, "exports")
    made = export_run(arguments.run, formats, folder, step_of(arguments), anyway=arguments.anyway)
    lines, files = [f"files: {folder}"], []
    for export in made:
        lines.append(f"  {export.name} ({export.format})")
        lines += [f"    not in this format: {what}" for what in export.not_carried]
        lines += [f"    {note}" for note in export.notes]
        entry: dict[str, Any] = {"format": export.format, "file": export.name}
        files.append({**entry, "not_carried": list(export.not_carried), "notes": list(export.notes)})
    return DONE, "\n".join(lines) + "\n", {"folder": str(folder), "files": files}


def _add_results(verbs: VerbList) -> None:
    """Register `report`, `figures` and `view`."""
    sub = verbs.add(
        "report",
        _report,
        "write the report of a result folder as one HTML file",
        examples=("result", "result --out result.html"),
    )
    sub.add_argument("run", type=Path, metavar="RUN", help="run folder of `identify` or `simulate`")
    sub.add_argument("--out", type=Path, metavar="FILE", help="default: report.html in the folder")

    sub = verbs.add(
        "figures",
        _figures,
        "write the figures of a report as files",
        examples=("result --out figures", "result --format png --out figures"),
    )
    sub.add_argument("run", type=Path, metavar="RUN", help="run folder of `identify` or `simulate`")
    sub.add_argument("--format", choices=["svg", "png"], default="svg", help="png needs the extra `figures`")
    sub.add_argument("--out", type=Path, required=True, metavar="DIR", help="files of the same name are replaced")

    sub = verbs.add(
        *("view", _view, "show a run in Rerun: the arm, its joints, its residuals"),
        examples=("result", "result --save result.rrd"),
    )
    sub.add_argument("run", type=Path, metavar="RUN", help="run folder of `run`, `simulate` or `identify`")
    add_repeatable(sub, "--recording", "FILE", "besides those in the folder; may be repeated", Path)
    sub.add_argument("--urdf", type=Path, metavar="FILE", help="draw its meshes, which stand beside it")
    sub.add_argument("--save", type=Path, metavar="FILE.rrd", help="write a file for Rerun instead of opening it")


def _report(arguments: argparse.Namespace) -> Answer:
    from ident_service.results.report_files import make_report
    from ident_service.results.summary import assessment_lines

    page, found = make_report(arguments.run, arguments.out)
    size = page.stat().st_size
    text = "\n".join([*assessment_lines(found), "", f"{page}: {size / 1e6:.2f} MB", ""])
    return DONE, text, {"file": str(page), "bytes": size, "assessment": found.document()}


def _figures(arguments: argparse.Namespace) -> Answer:
    from ident_service.results.report_files import write_figures

    names = write_figures(arguments.run, arguments.out, arguments.format)
    text = f"files: {arguments.out}\n" + "".join(f"  {name}\n" for name in names)
    return DONE, text, {"folder": str(arguments.out), "files": names}


def _view(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.run_view import show_run_in_viewer

    seen = show_run_in_viewer(arguments.run, arguments.recording, arguments.save, arguments.urdf)
    text = f"recordings: {', '.join(seen.recordings)}\n"
    text += f"residuals: {', '.join(seen.residuals) or 'none; identify parameters from the recording first'}\n"
    if seen.saved is not None:
        text += f"{seen.saved}: {seen.saved.stat().st_size / 1e6:.2f} MB; show it with: rerun {seen.saved}\n"
    file = None if seen.saved is None else str(seen.saved)
    return DONE, text, {"recordings": list(seen.recordings), "residuals": list(seen.residuals), "file": file}


def add(verbs: VerbList) -> None:
    """Register the verbs about commissioning, fleets, comparing, parameters, exports and results."""
    for register in (_add_commission, _add_fleet, _add_comparing, _add_parameters, _add_exports, _add_results):
        register(verbs)
