"""Read the sides of a comparison, folders of results or parameter files, with their testable values.

Nothing is judged here; `comparison.py` does that.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ident_service.config.schema import ArmConfig
from ident_service.errors import ParameterError
from ident_service.estimation.drift import Identified, Motion
from ident_service.model.chain import Array
from ident_service.model.expressions import parse_expression
from ident_service.model.information import Information
from ident_service.results.consistency import require_consistent
from ident_service.results.information_document import information_from
from ident_service.results.parameter_file import ParameterFile, read_parameters
from ident_service.results.run_folder import PARAMETERS, read_results

_DECIMALS = 9  # of coefficients; expressions that agree to these are the same parameter
Key = tuple[tuple[str, float], ...]


@dataclass(frozen=True)
class Side:
    """Parameter set that takes part in a comparison.

    Attributes:
        path: folder or file as it was given.
        sha256: of the parameter file.
        file: what is in it.
        config: the arm it was identified for; None for a file alone.
    """

    path: Path
    sha256: str
    file: ParameterFile
    config: ArmConfig | None = None

    @property
    def name(self) -> str:
        """Return a short name: of the folder, or of the file where it is not called as in a folder of results."""
        path = self.path.absolute()
        return path.parent.name if path.name == PARAMETERS else path.name

    @property
    def content(self) -> Mapping[str, Any]:
        """Return everything in the parameter file."""
        return self.file.content

    @cached_property
    def keys(self) -> tuple[Key, ...]:
        """Return each base parameter's expression in a form that does not depend on how it is written."""
        expressions = self.content["base_parameters"]["expressions"]
        return tuple(
            tuple(sorted((name, round(value, _DECIMALS)) for name, value in parse_expression(expression).items()))
            for expression in expressions
        )

    @cached_property
    def leading(self) -> tuple[str, ...]:
        """Return the link parameter that each base parameter is named after."""
        return tuple(self.file.base.names[column] for column in self.file.base.base)

    @cached_property
    def joints(self) -> tuple[str, ...] | None:
        """Return the names of the arm's joints; None where the file does not say."""
        arm = self.content.get("arm")
        return None if arm is None else tuple(arm["joints"])

    @cached_property
    def covariance(self) -> Array | None:
        """Return the covariance of the unconstrained estimate, shape (base, base), infinite where unseen; None without.

        Raises:
            ParameterError: it is none.
        """
        rows = self.content["base_parameters"].get("covariance")
        if rows is None:
            return None
        size = self.file.base.size
        if len(rows) != size or any(len(row) != size for row in rows):
            raise ParameterError(f"{self.path}: covariance is not {size} by {size}")
        # Covariances with an unseen parameter are null in the file, too.
        unseen = np.array([rows[k][k] is None for k in range(size)])
        matrix = np.array([[0.0 if value is None else value for value in row] for row in rows], dtype=float)
        matrix[unseen, :] = matrix[:, unseen] = 0.0
        largest = np.sqrt(np.outer(np.diag(matrix).clip(0.0), np.diag(matrix).clip(0.0)))
        slack = 1e-9 * np.max(largest, initial=0.0)
        if np.any(np.diag(matrix) < 0.0) or np.any(np.abs(matrix - matrix.T) > 1e-6 * largest + slack):
            raise ParameterError(f"{self.path}: covariance is not symmetric, or has negative variances")
        matrix = np.asarray(0.5 * (matrix + matrix.T))
        matrix[unseen, unseen] = np.inf
        return matrix

    @property
    def unconstrained(self) -> Array | None:
        """Return the values before they were held in a feasible set, shape (base,); None where the file has none."""
        values = self.content["base_parameters"].get("unconstrained_values")
        if values is None and self.content.get("feasible_set") == "none":
            return self.file.values
        return None if values is None else np.array(values, dtype=float)

    @cached_property
    def information(self) -> Information | None:
        """Return the information of the recordings that were fitted to; None where the file has none.

        Raises:
            ParameterError: it does not fit the parameters.
        """
        joints = self.content.get("information")
        if joints is None:
            return None
        try:
            return information_from(joints, self.file.base.size)
        except ParameterError as error:
            raise ParameterError(f"{self.path}: {error}") from None

    def identified(self, places: NDArray[np.intp], *, free: bool) -> Identified | None:
        """Return the testable values of some parameters, with their covariance; None without a covariance.

        Args:
            places: which, in the order of the comparison.
            free: whether values are those before they were held in a feasible set.
        """
        covariance = self.covariance
        if covariance is None:
            return None
        values = self.unconstrained if free else None
        values = self.file.values if values is None else values
        fit = self.content.get("fit", {})
        motion = None if self.information is None else Motion.of(self.information, values, places.tolist())
        return Identified(
            tuple(self.leading[place] for place in places),
            values[places],
            covariance[np.ix_(places, places)],
            fit.get("blocks"),
            motion,
        )


def read_side(path: Path) -> Side:
    """Read a folder of results or a parameter file.

    Raises:
        UsageError: neither is there.
        ParameterError: torn, changed or foreign, or values that contradict each other.
        ConfigError: the folder's arm is not one that this version reads.
    """
    if path.is_dir():
        results = read_results(path)
        require_consistent(results.parameters, path / PARAMETERS)
        return Side(path, results.sha256[PARAMETERS], results.parameters, results.config)
    file = read_parameters(path)
    require_consistent(file, path)
    return Side(path, hashlib.sha256(path.read_bytes()).hexdigest(), file)
