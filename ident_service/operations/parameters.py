"""Test the feasibility of parameter files and correct them, with or without an arm."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ident_service.config.load import load_arm
from ident_service.config.schema import Constraints, FeasibleSetName
from ident_service.errors import ParameterError
from ident_service.estimation.certificate import certify
from ident_service.estimation.feasible.feasibility import (
    FeasibilityTest,
    FeasibleEstimate,
    feasibility_correction,
    feasibility_test,
)
from ident_service.estimation.feasible.feasible_set import FeasibleSet, feasible_set
from ident_service.model.arm_model import arm_model
from ident_service.model.notation import Notation
from ident_service.operations.verify import custom_note
from ident_service.results.parameter_file import ParameterFile, read_parameters, write_parameters


@dataclass(frozen=True)
class CheckedFile:
    """Result of a feasibility test of a parameter file."""

    kind: FeasibleSetName
    result: FeasibilityTest
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class CorrectedFile:
    """Feasible parameters nearest to those of a file."""

    kind: FeasibleSetName
    result: FeasibleEstimate
    notes: tuple[str, ...] = ()


def check_file(
    path: Path, kind: FeasibleSetName | None = None, arm: str | None = None, notation: Notation | None = None
) -> CheckedFile:
    """Test the feasibility of a parameter file (BPFT, eq. 51).

    Args:
        path: the file.
        kind: feasible set; the file's own when None, or else `pseudo_inertia`.
        arm: a description whose physical constraints are added; without one, drive inertia, viscous and Coulomb
            friction are positive.
        notation: of the file's names, where it is not ours.

    Raises:
        UsageError, ConfigError, ParameterError: the file or the arm cannot be used.
        SolverError: the solver stopped without an optimum.
    """
    file, conditions, notes = _read(path, kind, arm, notation)
    return CheckedFile(conditions.kind, feasibility_test(file.values, file.base, conditions), notes)


def correct_file(
    path: Path,
    out: Path,
    kind: FeasibleSetName | None = None,
    arm: str | None = None,
    metric: Literal["euclidean", "covariance"] = "euclidean",
    notation: Notation | None = None,
) -> CorrectedFile:
    """Write the feasible parameters nearest to a file's (BPFC, eq. 55) to another file; other content is copied.

    What no longer holds for the new values is left out: covariances, verdicts, fit and validation.

    Args:
        path: the file.
        out: where the corrected one goes.
        kind: feasible set; the file's own when None, or else `pseudo_inertia`.
        arm: a description whose physical constraints are added, as for `check_file`.
        metric: what nearest means: the paper's, in the units of the parameters, or that of the file's covariance, which
            does not depend on the choice of base columns.
        notation: of the file's names, where it is not ours; the corrected file has ours.

    Raises:
        UsageError, ConfigError, ParameterError: the file or the arm cannot be used, or `out` not written.
        SolverError: the solver stopped without an optimum.
    """
    file, conditions, notes = _read(path, kind, arm, notation)
    result = feasibility_correction(
        file.values, file.base, conditions, _covariance(path, file) if metric == "covariance" else None
    ).centred(file.base, conditions)
    content = deepcopy(file.content)
    for stale in ("fit", "information", "validation", "custom", "second_opinion"):
        content.pop(stale, None)
    table = content["base_parameters"]
    for stale in (
        "unconstrained_values",
        "standard_deviations",
        "white_standard_deviations",
        "degrees_of_freedom",
        "covariance",
        "verdicts",
    ):
        table.pop(stale, None)
    table["values"] = result.beta.tolist()
    content["method"] = "correction"
    content["feasible_set"] = conditions.kind
    content["link_parameters"] = {"names": list(file.base.names), "values": result.delta.tolist()}
    proof = certify(result.beta, file.base, conditions, result.delta, expressions=table["expressions"])
    content["feasibility"] = {
        "feasible": proof.verdict == "feasible",
        "margin": result.margin,
        "certificate": proof.document,
    }
    write_parameters(out, content)
    return CorrectedFile(conditions.kind, result, notes)


def _covariance(path: Path, file: ParameterFile) -> NDArray[np.float64]:
    rows = file.content["base_parameters"].get("covariance")
    if rows is None or any(len(row) != file.base.size for row in rows):
        raise ParameterError(
            f"{path}: has no covariance of its {file.base.size} base parameters to measure distance with"
        )
    return np.array([[np.inf if value is None else value for value in row] for row in rows], dtype=float)


def _read(
    path: Path, kind: FeasibleSetName | None, arm: str | None, notation: Notation | None
) -> tuple[ParameterFile, FeasibleSet, tuple[str, ...]]:
    config, names = None, None
    if arm is not None:
        model = arm_model(load_arm(arm))
        config, names = model.config, model.layout.names
    file = read_parameters(path, names, notation)
    if config is not None and (claimed := file.content.get("arm")) is not None and claimed["name"] != config.name:
        joints = list(model.chain.names)
        if claimed["joints"] != joints:
            raise ParameterError(f"{path}: is about the arm {claimed['name']} with other joints than {config.name}")
    claimed_set: FeasibleSetName = "inertia" if file.feasible_set == "inertia" else "pseudo_inertia"
    conditions = feasible_set(kind or claimed_set, file.base.names, config, positive=Constraints().positive)
    custom = () if config is None or config.constraints.custom is None else (custom_note(config.constraints.custom),)
    return file, conditions, (*file.notes, *custom)
