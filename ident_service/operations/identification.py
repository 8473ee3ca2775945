"""Identify an arm from recording files and write a folder of results, as `ident identify` does."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ident_service.config.arm import ArmConfig, Method
from ident_service.config.load import config_error, folder_of, load_arm, load_recording_format
from ident_service.config.payload import Payload
from ident_service.errors import RecordingError, SolverError, UsageError
from ident_service.estimation.bootstrap import bootstrap
from ident_service.estimation.custom import CustomError, CustomFunction, load_custom
from ident_service.estimation.feasible.convex import convex_least_squares
from ident_service.estimation.feasible.feasible_set import SetName
from ident_service.estimation.feasible.sdpa import bpfc_sdpa, bpft_sdpa, fbpe_sdpa
from ident_service.estimation.identify import Estimate, identify
from ident_service.estimation.least_squares import LeastSquares
from ident_service.estimation.model_reduction import essential_parameters
from ident_service.estimation.plausibility import (
    Objections,
    reasons_against,
    reasons_in_length,
    reasons_in_recording,
    remarks_on_limits,
    torque_clipped,
    torque_missing,
)
from ident_service.model.arm_model import arm_model
from ident_service.model.chain import Array
from ident_service.operations.recordings import (
    known_payloads,
    open_together,
    own_formats,
    recording_quality,
    removed_standstill,
    torque_in,
)
from ident_service.recordings.quality import Quality
from ident_service.recordings.recording import Recording
from ident_service.results.manifest import replacing_folder, require_replaceable, write_atomically
from ident_service.results.parameter_file import finite_or_none
from ident_service.results.report_files import write_report
from ident_service.results.run_folder import MANIFEST, write_manifest, write_results

Step = Callable[[str, float], None]
"""Is told what is being done, and how much of all is done, from 0 to 1."""


@dataclass(frozen=True)
class Request:
    """Request for an identification: recordings and options.

    Attributes:
        arm: description file or name of a shipped one.
        recordings: recordings to fit to; a path may end in `@START:END`, the seconds of that recording to read.
        validation: recordings to validate on; a path may end in `@START:END`, too.
        columns: a YAML file with the keys of the arm's `recording` section, instead of it.
        columns_of: such a file for some recordings each, of those above.
        payloads: a YAML file with the keys of a description's section `payload` for recordings with a known load.
        torque_constants: whether to identify those of the motors jointly with the parameters.
        cut_standstill: whether to leave out standstill at the ends of every recording.
        method: estimator, the arm's when None.
        set_name: feasible set, the arm's when None.
        prior: `none`, `euclidean` or `entropic`, the arm's when None.
        prior_weight: weight of the prior; the arm's, or one chosen on held-out data, when None.
        delay: delay between position and torque [s], or `estimate`; the arm's when None.
        replicates: number of replicates in the bootstrap of the constrained estimate; 0 for none.
        essential: whether to look for the smallest model that predicts as well.
        sdpa: whether to write the optimisation problems for other solvers, `constraints.custom` left out.
        solver: solver of the problems that are posed in cvxpy; Clarabel when None.
        second_opinion: whether to solve the constrained problem a second time, in cvxpy.
    """

    arm: str
    recordings: tuple[Path, ...]
    validation: tuple[Path, ...] = ()
    columns: Path | None = None
    columns_of: Mapping[Path, Path] = field(default_factory=dict)
    payloads: Mapping[Path, Path] = field(default_factory=dict)
    torque_constants: bool = False
    cut_standstill: bool = False
    method: Method | None = None
    set_name: SetName | None = None
    prior: str | None = None
    prior_weight: float | None = None
    delay: float | str | None = None
    replicates: int = 0
    essential: bool = False
    sdpa: bool = False
    solver: str | None = None
    second_opinion: bool = False


@dataclass(frozen=True)
class IdentificationResult:
    """Result of an identification, and the files written.

    Attributes:
        estimate: estimate with everything known of it.
        files: names of the files in the folder.
        warnings: what is wrong with the recordings, in words.
        objections: reasons why the estimate must not be used; empty where nothing says so.
        torque: kind of torque that the arm was identified from (`OpenedRecordings.torque`).
    """

    estimate: Estimate
    files: tuple[str, ...]
    warnings: tuple[str, ...]
    objections: Objections
    torque: str


def identify_files(
    request: Request,
    folder: Path,
    tell: Callable[[str], None] = lambda _: None,
    step: Step = lambda words, share: None,
) -> IdentificationResult:
    """Identify an arm from recordings, and write the results into a folder, in place of an earlier result there.

    Args:
        request: recordings and options.
        folder: folder of the results; an earlier result there is replaced as a whole.
        tell: called with a line at each step that takes longer.
        step: called with what is being done and how much of all is done, from 0 to 1; shares are those of an arm of
            seven joints on a minute of data.

    Raises:
        UsageError, ConfigError: the request or the arm's description is not valid, or the folder holds anything
            else.
        RecordingError: a recording cannot be used.
        SolverError: a solver stopped without an optimum.
    """
    require_replaceable(folder)
    described = load_arm(request.arm)
    config, paths = _config(described, request), [*request.recordings, *request.validation]
    model = arm_model(config)
    custom = custom_of(request.arm, described)
    forms = own_formats(request.columns_of, paths, model)
    if any(form.trim != config.recording.trim for form in forms.values()):
        # Each is then trimmed when it is opened, and no more afterwards, where all are trimmed alike.
        forms = dict.fromkeys(paths, config.recording) | forms
        untrimmed = config.recording.model_copy(update={"trim": (0.0, 0.0)})
        model = arm_model(config.model_copy(update={"recording": untrimmed}))
    step("reading recordings", 0.0)
    loads = known_payloads(request.payloads, paths, model)
    opened = open_together(paths, model, forms, payloads=loads)
    recordings = opened.recordings[: len(request.recordings)]
    validation = opened.recordings[len(request.recordings) :]
    for recording in (*recordings, *validation):
        start, end = removed_standstill(recording)
        if start or end:
            tell(f"{recording.path.name}: standstill left out, {start:.2f} s at the start and {end:.2f} s at the end")
    found = list[tuple[Recording, Quality]]()
    for count, recording in enumerate(opened.recordings):
        step(f"looking at {recording.path.name}", 0.1 + 0.1 * count / len(opened.recordings))
        found.append((recording, seen := recording_quality(recording, model)))
        _require_measurable(recording, seen)
        if all(joint.torque[0] == joint.torque[1] for joint in seen.joints):
            reason = "the torque of every joint is always the same; were other columns meant, or was it not recorded?"
            raise RecordingError(recording.path, reason)
        # At lower rates the time is in another unit, which `require_motion` tells.
        if seen.rate_hz > _SLOWEST and all(joint.standstill > _AT_REST for joint in seen.joints):
            reason = "no joint moves: each is slower than 0.005 rad/s or m/s over 20 ms; record a motion"
            raise RecordingError(recording.path, reason)
    warnings = opened.remarks
    warnings += tuple(f"{recording.path}: {line}" for recording, seen in found for line in seen.warnings())
    # Replicates take 0.05 s each, reduction a third of the rest; neither is known better before.
    estimated = 0.8 / (1.0 + 0.005 * request.replicates + 0.3 * request.essential)
    try:
        estimate = identify(
            model,
            recordings,
            validation,
            method=request.method,
            set_name=request.set_name,
            custom=custom,
            solver=request.solver,
            ask_second_solver=request.second_opinion,
            step=lambda words, share: step(words, 0.2 + share * (estimated - 0.2)),
            torque_constants=request.torque_constants,
        )
    except CustomError as error:
        raise config_error(request.arm, CUSTOM, str(error)) from error
    except (RecordingError, SolverError) as error:
        # Values too large or small for filter or solver come from the recording; the error then names the reason.
        for recording, seen in found:
            for reason in reasons_in_recording(recording.path.name, seen.joints, model):
                raise RecordingError(recording.path, reason.removeprefix(f"{recording.path.name}: ")) from error
        raise
    for recording, seen in found:
        warnings += remarks_on_limits(recording.path.name, seen.joints, model)
    warnings += estimate.remarks
    objections = unusable_because(estimate, found)
    more: dict[str, Any] = {
        "recording_quality": [_quality_document(recording, seen) for recording, seen in found],
        "warnings": list(warnings),
        **_known_loads(loads),
    }
    if request.replicates:
        step("bootstrap", estimated)
        tell(f"bootstrap of {request.replicates} replicates")
        more["bootstrap"] = _bootstrap(estimate, request.replicates)
    if request.essential:
        step("essential parameters", 0.7)
        tell("essential parameters")
        more["essential"] = _essential(estimate)
    step("writing results and report", 0.8)
    with replacing_folder(folder) as staging:
        files = write_results(staging, estimate, more, objections.reasons, described, opened.torque)
        if request.sdpa:
            files += _write_sdpa(staging, estimate)
        files += write_report(staging, estimate, recordings, validation, warnings)
        write_manifest(staging)
    return IdentificationResult(estimate, (*files, MANIFEST), warnings, objections, opened.torque)


CUSTOM = ("constraints", "custom")
_LARGEST = 1e15  # of a position or torque in any unit; its fourth power is still finite
_SLOWEST = 5.0  # Hz; nobody samples an arm more slowly
_AT_REST = 0.99  # share of the time at standstill of a recording that shows nothing


def custom_of(description: str, config: ArmConfig) -> CustomFunction | None:
    """Load the function that a description, file or shipped name, names as `constraints.custom`; None where none.

    Args:
        description: description file or name of a shipped one.
        config: content of the description.

    Raises:
        ConfigError: it cannot be imported; with the place where the description names it.
    """
    name = config.constraints.custom
    if name is None:
        return None
    try:
        return load_custom(name, folder_of(description, CUSTOM))
    except CustomError as error:
        raise config_error(description, CUSTOM, str(error)) from error


def unusable_because(estimate: Estimate, qualities: Sequence[tuple[Recording, Quality]]) -> Objections:
    """Return the reasons, from its recordings and its errors, why an estimate must not be used."""
    model = estimate.model
    seen = (reasons_in_recording(recording.path.name, one.joints, model) for recording, one in qualities)
    names = set(estimate.recordings)
    fitted = [(recording, one) for recording, one in qualities if (recording.path.name, recording.sha256) in names]
    seconds = sum(one.duration_s for _, one in fitted)
    wrong = (reason for reasons in seen for reason in reasons)
    # Without a joint's torque every reading of the others is as wrong.
    known = not any(torque_missing(joint) for _, one in fitted for joint in one.joints)
    clipped = torque_clipped(estimate, [one.joints for _, one in fitted])
    against = clipped
    if known and not clipped:
        against = reasons_against(estimate, [recording for recording, _ in fitted])
    return Objections((*wrong, *against), reasons_in_length(estimate, seconds))


def _require_measurable(recording: Recording, seen: Quality) -> None:
    for joint in seen.joints:
        for what, (low, high) in (("position", joint.position), ("torque", joint.torque)):
            if (most := max(-low, high)) > _LARGEST:
                reason = f"the {what} of {joint.name} reaches {most:.3g}, which no sensor measures; correct or cut that"
                raise RecordingError(recording.path, reason)


def _config(config: ArmConfig, request: Request) -> ArmConfig:
    if request.columns is not None:
        config = config.model_copy(update={"recording": load_recording_format(request.columns)})
    if request.cut_standstill:
        form = config.recording.model_copy(update={"standstill": "cut"})
        config = config.model_copy(update={"recording": form})
    if request.set_name == "none" and (request.replicates or request.prior not in (None, "none")):
        raise UsageError(
            "a prior and the bootstrap are about the constrained estimate; leave out the feasible set none"
        )
    options = config.identification
    pull = options.prior
    if request.prior is not None:
        pull = pull.model_copy(update={"kind": request.prior})
    if request.prior_weight is not None:
        if pull.kind == "none":
            raise UsageError("a prior weight without a prior; add --prior")
        pull = pull.model_copy(update={"weight": request.prior_weight})
    changes: dict[str, Any] = {"prior": pull}
    if request.delay is not None:
        changes["delay"] = request.delay
    return config.model_copy(update={"identification": options.model_copy(update=changes)})


def _quality_document(recording: Recording, seen: Quality) -> dict[str, Any]:
    return {
        "recording": recording.path.name,
        "samples": seen.samples,
        "seconds": seen.duration_s,
        "rate_hz": seen.rate_hz,
        "jitter_seconds": {"standard_deviation": seen.jitter_std_s, "largest": seen.jitter_max_s},
        "gaps": len(seen.gaps),
        "repeats": seen.repeats,
        "skipped": seen.skipped,
        "torque": torque_in(recording),
        "standstill_left_out_seconds": list(removed_standstill(recording)),
        "torn": seen.torn,
        "per_joint": [
            {"joint": joint.name, "saturated": joint.saturated, "standstill": joint.standstill} for joint in seen.joints
        ],
    }


def _known_loads(loads: Mapping[Path, Payload]) -> dict[str, Any]:
    if not loads:
        return {}
    said = [{"recording": path.name, **load.model_dump(mode="json")} for path, load in loads.items()]
    return {"known_payloads": said}


def _bootstrap(estimate: Estimate, replicates: int) -> dict[str, Any]:
    base, conditions, prior, known = estimate.base, estimate.conditions, estimate.prior, estimate.custom
    solve = None
    if known is not None:

        def solve(fit: LeastSquares) -> Array:
            found = convex_least_squares(fit, base, conditions, prior=prior, custom=known.function, solver=known.solver)
            return found.estimate.beta

    drawn = bootstrap(estimate.fitted, estimate.fit, base, conditions, replicates, solve=solve, prior=prior)
    return {
        "replicates": replicates,
        "blocks_in_a_run": drawn.run,
        "standard_deviations": finite_or_none(drawn.standard_deviations),
    }


def _essential(estimate: Estimate) -> dict[str, Any]:
    found = essential_parameters(estimate.fitted, estimate.fit, covariance=estimate.covariance)
    return {
        "expressions": [estimate.base.expressions[index] for index in found.kept],
        "values": found.beta[found.kept].tolist(),
        "standard_deviations": found.standard_deviations[found.kept].tolist(),
        "relative_error_percent": {
            "all": found.full.relative_percent,
            "essential": found.reduced.relative_percent,
        },
    }


def _write_sdpa(folder: Path, estimate: Estimate) -> list[str]:
    fit, base, conditions = estimate.fit, estimate.base, estimate.conditions
    texts: Sequence[tuple[str, str]] = (
        ("feasibility_test.dat-s", bpft_sdpa(fit.beta, base, conditions)),
        ("correction.dat-s", bpfc_sdpa(fit.beta, base, conditions)),
        ("constrained_least_squares.dat-s", fbpe_sdpa(fit, base, conditions)),
    )
    for name, text in texts:
        write_atomically(folder / name, text)
    return [name for name, _ in texts]
