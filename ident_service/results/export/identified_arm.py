"""Assemble the input of an export: the arm, its base parameters, and one body that has them where there is one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ident_service.config.arm import ArmConfig
from ident_service.errors import ModelError, ParameterError
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.base_parameters import BaseParameters, base_from_expressions
from ident_service.model.chain import Array
from ident_service.model.regressor import joint_regressor
from ident_service.results.assessment import forbidden_because
from ident_service.results.export.round_trip import AGREEMENT, RecordedMotion, disagreement, random_states
from ident_service.results.parameter_file import (
    ParameterFile,
    information_from,
    named_link_values,
    require_base_values,
    require_consistent,
)
from ident_service.results.run_folder import PARAMETERS, Results, read_results


@dataclass(frozen=True)
class IdentifiedArm:
    """Arm with its identified parameters.

    Attributes:
        model: the arm, with what the recordings said of its friction's shape.
        base: the grouping of the parameters, columns in the order of `model.layout`.
        beta: base parameters [SI], shape (base,).
        delta: link parameters of a body that has them [SI], shape (layout.size,); None where no body has.
        sigma: standard deviations of the base parameters, None where unknown.
        verdicts: one word per base parameter, empty where unknown.
        source: SHA-256 of the parameter file.
        feasible_set: feasible set that the values lie in; `none` where they are not held in any.
        unconstrained: base parameters before they were held in the set [SI], to which `sigma` belongs, shape (base,);
            None where unknown.
        motion: motion that the arm was identified from; None where the file does not have it.
        forbidden: reasons why its values must not be used; empty where nothing says so.
    """

    model: ArmModel
    base: BaseParameters
    beta: Array
    delta: Array | None
    sigma: tuple[float | None, ...]
    verdicts: tuple[str, ...]
    source: str
    feasible_set: str = "none"
    unconstrained: Array | None = None
    motion: RecordedMotion | None = None
    forbidden: tuple[str, ...] = ()

    @property
    def forbidden_note(self) -> str:
        """Return `DO NOT USE: reasons`, which every file of values that must not be used bears; else empty."""
        return f"DO NOT USE: {'; '.join(self.forbidden)}" if self.forbidden else ""

    @property
    def deviations_note(self) -> str:
        """Return a note where the standard deviations are those of other, unconstrained values; else empty."""
        if self.feasible_set == "none" or not any(deviation is not None for deviation in self.sigma):
            return ""
        return (
            f"standard deviations are of the unconstrained fit; values are constrained to the set {self.feasible_set}"
        )

    @cached_property
    def base_delta(self) -> Array:
        """Return link parameters with the arm's torques, zero but in the base columns, shape (layout.size,).

        No body has them, and all torques are theirs (eq. 37).
        """
        delta = np.zeros(self.model.layout.size)
        delta[self.base.base] = np.linalg.solve(self.base.K[:, self.base.base], self.beta)
        return delta

    def body(self) -> Array:
        """Return the arm's link parameters, shape (layout.size,); ModelError where no body has its base parameters.

        Raises:
            ModelError: no body has these base parameters.
        """
        if self.delta is None:
            raise ModelError(
                f"{self.model.config.name}: these parameters are not feasible, so there are no link inertias to export;"
                " csv, json and c take base parameters, and `ident project` gives the nearest feasible ones"
            )
        return self.delta


def identified_arm(
    config: ArmConfig, parameters: ParameterFile, parameters_sha256: str, parameter_path: Path
) -> IdentifiedArm:
    """Check that a parameter file is of an arm and consistent, and combine the two.

    Args:
        config: the arm, its friction's shape as identified.
        parameters: of that arm.
        parameters_sha256: SHA-256 of the parameter file.
        parameter_path: the parameter file, for errors.

    Raises:
        ModelError: the mechanism cannot be represented.
        ParameterError: the parameters are not this arm's, or the link values do not have the base values.
    """
    model = arm_model(config)
    names, table = model.layout.names, parameters.content["base_parameters"]
    try:
        base = base_from_expressions(tuple(table["expressions"]), names)
    except ParameterError as error:
        raise ParameterError(f"{parameter_path}: not parameters of {config.name}: {error}") from None
    base = replace(base, units=tuple(model.layout.units[column] for column in base.base))
    H = joint_regressor(model.chain, model.layout, *random_states(model.chain.joints))
    grouped = np.linalg.solve(base.K[:, base.base], base.K)
    if disagreement(np.einsum("jbs,bp->jps", H[:, base.base], grouped), H) > AGREEMENT:
        raise ParameterError(
            f"{parameter_path}: its expressions do not group the parameters of {config.name} as its motion does"
        )
    require_consistent(parameters, parameter_path)
    sigma, verdicts = table.get("standard_deviations"), table.get("verdicts")
    known = parameters.content.get("information")
    return IdentifiedArm(
        model=model,
        base=base,
        beta=parameters.values,
        delta=_link_values(parameters, base, parameter_path),
        sigma=tuple(sigma or [None] * base.size),
        verdicts=tuple(verdicts or [""] * base.size),
        source=parameters_sha256,
        feasible_set=parameters.feasible_set or "none",
        unconstrained=None if (free := table.get("unconstrained_values")) is None else np.array(free, dtype=float),
        motion=None if known is None else _motion(parameters.content, base, model, parameter_path),
        forbidden=forbidden_because(parameters.content),
    )


def _motion(content: dict[str, Any], base: BaseParameters, model: ArmModel, where: Path) -> RecordedMotion:
    known = content["information"]
    rows = content.get("fit", {}).get("effective_rows", [joint["rows"] for joint in known])
    if not len(known) == len(rows) == model.chain.joints:
        raise ParameterError(f"{where}: its information is of {len(known)} joints, the arm has {model.chain.joints}")
    try:
        return RecordedMotion(base, information_from(known, base.size), np.array(rows, dtype=float))
    except ParameterError as error:
        raise ParameterError(f"{where}: {error}") from None


def read_identified(folder: Path) -> IdentifiedArm:
    """Read the arm of a folder of results, every file verified by its manifest.

    Raises:
        UsageError: no such folder, or nothing was identified in it.
        ParameterError: its files are torn, changed, foreign, or do not belong together.
        ConfigError, ModelError: the arm in it cannot be used.
    """
    results: Results = read_results(folder)
    return identified_arm(results.config, results.parameters, results.sha256[PARAMETERS], folder / PARAMETERS)


def _link_values(parameters: ParameterFile, base: BaseParameters, where: Path) -> Array | None:
    if "link_parameters" not in parameters.content:
        return None
    named = named_link_values(parameters)
    if named is None or set(named) != set(base.names):
        raise ParameterError(f"{where}: its link parameters are not those of the arm")
    delta = np.array([named[name] for name in base.names])
    require_base_values(base, delta, parameters.values, where)
    return delta
