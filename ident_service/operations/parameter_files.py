"""Test, correct and compare parameter files, and identify a payload from one."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ident_service.certificate_verifier import INERTIAL, split_name
from ident_service.config.arm import Constraints, FeasibleSetName
from ident_service.config.load import load_arm
from ident_service.errors import ParameterError, UsageError
from ident_service.estimation.certificate import certify
from ident_service.estimation.feasible.feasible_set import FeasibleSet, feasible_set
from ident_service.estimation.feasible.problems import (
    FeasibilityTest,
    FeasibleEstimate,
    feasibility_correction,
    feasibility_test,
)
from ident_service.estimation.fit import gather
from ident_service.estimation.payload import KnownArm, Payload, identify_payload
from ident_service.model.arm_model import arm_model
from ident_service.model.notation import Notation
from ident_service.model.parameter_layout import INERTIAL_UNITS, Layout
from ident_service.operations.recordings import open_together, require_no_fault
from ident_service.operations.verify import custom_note
from ident_service.recordings.adapters import overlap
from ident_service.recordings.recording import Recording
from ident_service.results.comparison.comparison import ComparedSet, Comparison, compare, read_side
from ident_service.results.comparison.presentation import comparison_html, comparison_text, write_comparison
from ident_service.results.export.urdf import write_urdf
from ident_service.results.manifest import (
    atomic_folder,
    replacing_folder,
    require_folder_of,
    require_replaceable,
    require_writable_place,
    write_atomically,
)
from ident_service.results.parameter_file import ParameterFile, read_parameters, write_parameters
from ident_service.results.payload_file import (
    loaded_config,
    loaded_parameters,
    payload_document,
    payload_text,
    write_payload,
)
from ident_service.results.run_folder import ARM, MANIFEST, PARAMETERS, URDF, VERIFIER, write_manifest, write_verifier

# What a file says of values that a correction replaces: keys of the document, and of its base parameters.
_OF_THE_FIT = ("fit", "information", "validation", "bootstrap", "essential", "custom", "second_opinion")
_OF_THE_VALUES = (
    *("unconstrained_values", "standard_deviations", "white_standard_deviations", "noise_standard_deviations"),
    *("degrees_of_freedom", "covariance", "constrained_intervals", "negligible", "verdicts"),
)


@dataclass(frozen=True)
class CheckedFile:
    """Result of a feasibility test of a parameter file, and whether the file has a certificate to verify."""

    kind: FeasibleSetName
    result: FeasibilityTest
    notes: tuple[str, ...] = ()
    certified: bool = False


@dataclass(frozen=True)
class CorrectedFile:
    """Feasible parameters nearest to those of a file."""

    kind: FeasibleSetName
    result: FeasibleEstimate
    notes: tuple[str, ...] = ()


def check_file(
    parameter_file: Path,
    set_name: FeasibleSetName | None = None,
    description: str | None = None,
    notation: Notation | None = None,
) -> CheckedFile:
    """Test if the base values of a parameter file are those of some point of a feasible set (BPFT, eq. 51).

    Args:
        parameter_file: the file.
        set_name: feasible set; the file's own when None, or else `pseudo_inertia`.
        description: a description whose physical constraints are added; without one, drive inertia, viscous and Coulomb
            friction are positive.
        notation: notation of the file's names, where it is not ours.

    Raises:
        UsageError, ConfigError, ParameterError: the file or the arm cannot be used.
        SolverError: the solver stopped without an optimum.
    """
    file, conditions, notes, _ = _read(parameter_file, set_name, description, notation)
    certified = file.content.get("feasibility", {}).get("certificate", {}).get("kind") in ("witness", "dual")
    return CheckedFile(conditions.kind, feasibility_test(file.values, file.base, conditions), notes, certified)


def correct_file(
    parameter_file: Path,
    corrected_file: Path,
    set_name: FeasibleSetName | None = None,
    description: str | None = None,
    metric: Literal["euclidean", "covariance"] = "euclidean",
    notation: Notation | None = None,
) -> CorrectedFile:
    """Write the feasible parameters nearest to a file's (BPFC, eq. 55) to `corrected_file`; other content is copied.

    What no longer holds for the new values is left out: covariances, verdicts, fit and validation.

    Args:
        parameter_file: the file.
        corrected_file: path of the corrected file.
        set_name: feasible set; the file's own when None, or else `pseudo_inertia`.
        description: a description whose physical constraints are added, as for `check_file`.
        metric: metric of the distance: the paper's, in the units of the parameters, or that of the file's covariance,
            which does not depend on the choice of base columns.
        notation: notation of the file's names, where it is not ours; the corrected file has ours.

    Raises:
        UsageError, ConfigError, ParameterError: the file or the arm cannot be used, or `corrected_file` not written.
        SolverError: the solver stopped without an optimum.
    """
    require_folder_of(corrected_file)
    file, conditions, notes, layout = _read(parameter_file, set_name, description, notation)
    result = feasibility_correction(
        file.values, file.base, conditions, _covariance(parameter_file, file) if metric == "covariance" else None
    ).centred(file.base, conditions)
    content = deepcopy(file.content)
    for stale in _OF_THE_FIT:
        content.pop(stale, None)
    table = content["base_parameters"]
    for stale in _OF_THE_VALUES:
        table.pop(stale, None)
    table["values"] = result.beta.tolist()
    content["method"] = "correction"
    content["feasible_set"] = conditions.kind
    units = _link_units(file, layout)
    content["link_parameters"] = {
        "names": list(file.base.names),
        **({"units": [units[name] for name in file.base.names]} if units.keys() >= set(file.base.names) else {}),
        "values": result.delta.tolist(),
    }
    proof = certify(result.beta, file.base, conditions, result.delta, expressions=table["expressions"])
    content["feasibility"] = {
        "feasible": proof.verdict == "feasible",
        "margin": result.margin,
        "certificate": proof.document,
    }
    write_parameters(corrected_file, content)
    return CorrectedFile(conditions.kind, result, notes)


def _link_units(file: ParameterFile, layout: Layout | None) -> dict[str, str]:
    """Return the units of link parameters by name: those of the arm, else of the file, else of all inertial ones."""
    if layout is not None:
        return dict(zip(layout.names, layout.units, strict=True))
    printed = file.content.get("link_parameters", {})
    inertial = {
        name: INERTIAL_UNITS[INERTIAL.index(symbol)]
        for name in file.base.names
        if (symbol := split_name(name)[0]) in INERTIAL
    }
    return inertial | dict(zip(printed.get("names", ()), printed.get("units", ()), strict=False))


def _covariance(path: Path, file: ParameterFile) -> NDArray[np.float64]:
    rows = file.content["base_parameters"].get("covariance")
    if rows is None or any(len(row) != file.base.size for row in rows):
        raise ParameterError(
            f"{path}: has no covariance of its {file.base.size} base parameters to measure distance with"
        )
    return np.array([[np.inf if value is None else value for value in row] for row in rows], dtype=float)


def _read(
    path: Path, kind: FeasibleSetName | None, arm: str | None, notation: Notation | None
) -> tuple[ParameterFile, FeasibleSet, tuple[str, ...], Layout | None]:
    config, layout = None, None
    if arm is not None:
        model = arm_model(load_arm(arm))
        config, layout = model.config, model.layout
    file = read_parameters(path, None if layout is None else layout.names, notation)
    if config is not None and (claimed := file.content.get("arm")) is not None and claimed["name"] != config.name:
        joints = list(model.chain.names)
        if claimed["joints"] != joints:
            raise ParameterError(f"{path}: is about the arm {claimed['name']} with other joints than {config.name}")
    claimed_set: FeasibleSetName = "inertia" if file.feasible_set == "inertia" else "pseudo_inertia"
    conditions = feasible_set(kind or claimed_set, file.base.names, config, positive_terms=Constraints().positive)
    custom = () if config is None or config.constraints.custom is None else (custom_note(config.constraints.custom),)
    return file, conditions, (*file.notes, *custom), layout


DOCUMENT, TEXT, PAGE = "comparison.json", "comparison.txt", "comparison.html"
KEPT = (DOCUMENT, TEXT, PAGE)


def compare_files(results: Sequence[Path], written_to: Path | None = None) -> tuple[Comparison, tuple[Path, ...]]:
    """Compare results with the first; write that to a folder or `.json` if given; return (comparison, files written).

    Args:
        results: parameter files or folders of results, two or more.
        written_to: a file that ends in `.json`, or a folder for everything; nothing is written when None.

    Raises:
        UsageError: fewer than two, one that is not there, or `written_to` cannot be written.
        ParameterError: one is torn, changed or foreign, or they have nothing in common.
        ConfigError: an arm in a folder is not one that this version reads.
    """
    one_file = written_to is not None and written_to.suffix == ".json" and not written_to.is_dir()
    if written_to is not None and one_file:
        require_folder_of(written_to)
    comparison = compare([read_side(path) for path in results])
    if written_to is None:
        return comparison, ()
    if one_file:
        write_comparison(written_to, comparison)
        return comparison, (written_to,)
    with atomic_folder(written_to) as staging:
        names = write_comparison_files(staging, comparison)
    return comparison, tuple(written_to / name for name in names)


def compare_into(reference: Path, folder: Path) -> Comparison:
    """Compare a folder of results with a reference; write that into the folder and its manifest; return the comparison.

    A kill in between leaves files that the manifest does not name, and which are therefore ignored.

    Args:
        reference: folder of results or parameter file.
        folder: folder of the results, verified here.

    Raises:
        UsageError, ParameterError, ConfigError: as `compare_files`.
    """
    comparison = compare([read_side(reference), read_side(folder)])
    write_comparison_files(folder, comparison)
    write_manifest(folder)
    return comparison


def write_comparison_files(folder: Path, comparison: Comparison) -> tuple[str, ...]:
    """Write a comparison as JSON, text and HTML into a folder that exists; return the names."""
    write_comparison(folder / DOCUMENT, comparison)
    write_atomically(folder / TEXT, comparison_text(comparison))
    write_atomically(folder / PAGE, comparison_html(comparison))
    return KEPT


PAYLOAD_DOCUMENT, PAYLOAD_TEXT = "payload.json", "payload.txt"


@dataclass(frozen=True)
class PayloadResult:
    """Result of a payload identification, and the files written.

    Attributes:
        arm: the arm as it was identified.
        payload: payload of the arm.
        document: the content of `payload.json`.
        text: text for a person.
        comparison: the arm against the arm with its load; None where there is no body.
        files: names of the files in the folder.
    """

    arm: KnownArm
    payload: Payload
    document: dict[str, Any]
    text: str
    comparison: Comparison | None
    files: tuple[str, ...]


def payload_files(
    arm_results: Path, recordings: Sequence[Path], payload_results: Path, *, refit_offsets: bool = False
) -> PayloadResult:
    """Identify the payload that an identified arm carries; write its results, in place of earlier ones there.

    Args:
        arm_results: folder of results of the arm.
        recordings: recordings with the load; a path may end in `@START:END`, the seconds to read.
        payload_results: folder of the results; an earlier result there is replaced as a whole.
        refit_offsets: whether torque offsets may differ from those of the arm.

    Raises:
        UsageError, ConfigError, ParameterError: the folder cannot be used, or is no folder of results.
        RecordingError: a recording cannot be used, or ended in a fault.
        SolverError: the solver stopped without an optimum.
    """
    require_writable_place(payload_results)
    if not arm_results.is_dir():
        raise UsageError(f"{arm_results}: not a folder; give the folder of results of the arm without the load")
    if payload_results.exists() and payload_results.samefile(arm_results):
        raise UsageError(f"{payload_results}: would replace the arm's parameters; give another folder")
    require_replaceable(payload_results)
    side = read_side(arm_results)
    arm = known_arm(side)
    known = side.content.get("torque")  # the torque difference is the load's only if both torques are of the same kind
    opened = open_together(
        recordings, arm.model, torque=known if known in ("measured", "commanded") else None
    ).recordings
    _require_new(side, opened)
    for path, recording in zip(recordings, opened, strict=True):
        require_no_fault(path, recording)
    scales = np.array(side.content.get("torque_scales", np.ones(arm.model.chain.joints)), dtype=float)
    recorded = gather(opened, arm.model, arm.base).with_torques_times(scales)
    payload = identify_payload(arm, recorded, refit_offsets=refit_offsets)
    sources = [{"name": one.path.name, "sha256": one.sha256} for one in opened]
    document = payload_document(payload, arm, side.sha256, sources)
    text, comparison = payload_text(payload, arm), None
    with replacing_folder(payload_results) as staging:
        write_payload(staging / PAYLOAD_DOCUMENT, document)
        write_atomically(staging / PAYLOAD_TEXT, text)
        names = [PAYLOAD_DOCUMENT, PAYLOAD_TEXT]
        if payload.body is not None:
            content, delta = loaded_parameters(side.content, arm, payload, recorded, sources)
            write_parameters(staging / PARAMETERS, content)
            write_verifier(staging)
            write_atomically(staging / ARM, loaded_config(arm.model.config).model_dump_json(indent=1) + "\n")
            names += [PARAMETERS, VERIFIER, ARM]
            if delta is not None:
                write_urdf(staging / URDF, arm.model, delta)
                names.append(URDF)
            comparison = _compared(side, staging, payload_results)
            names += write_comparison_files(staging, comparison)
        write_manifest(staging)
    return PayloadResult(arm, payload, document, text, comparison, (*names, MANIFEST))


def known_arm(side: ComparedSet) -> KnownArm:
    """Return model, base parameters and covariance of the arm that was identified in a folder of results.

    Raises:
        ParameterError: the parameters have no covariance, or belong to another mechanism.
    """
    if side.config is None:
        raise ParameterError(f"{side.path}: a payload needs the arm's model; give a folder of results")
    if side.covariance is None:
        raise ParameterError(f"{side.path}: its parameters have no covariance; identify the arm again")
    model = arm_model(side.config)
    file = read_parameters(side.path / PARAMETERS, model.layout.names)
    fit = side.content.get("fit", {})
    residual = np.array([one["rms"] for one in fit.get("per_joint", [])], dtype=float)
    known = residual if residual.shape == (model.chain.joints,) else None
    return KnownArm(model, file.base, file.values, side.covariance, fit.get("blocks"), known)


def _require_new(side: ComparedSet, recordings: Sequence[Recording]) -> None:
    fitted = {one["sha256"] for one in side.content.get("provenance", {}).get("recordings", [])}
    for index, recording in enumerate(recordings):
        if recording.sha256 in fitted:
            raise UsageError(f"{recording.path}: the arm was identified from it; give a recording with the load")
        if any(overlap(recording, other) for other in recordings[:index]):
            raise UsageError(f"{recording.path}: the same recording twice would make the uncertainty too small")


def _compared(side: ComparedSet, staging: Path, out: Path) -> Comparison:
    """Return the comparison of the arm with the arm under load, under the paths of the final folder."""
    loaded = read_side(staging / PARAMETERS)
    config = None if side.config is None else loaded_config(side.config)
    return compare([side, ComparedSet(out / PARAMETERS, loaded.sha256, loaded.file, config)])
