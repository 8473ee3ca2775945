"""Check that the values in a parameter file agree with each other; after edits by hand they often do not.

Pure computation, no I/O; what the values say of an arm is each reader's business.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ident_service.errors import ParameterError
from ident_service.model.base import BaseParameters
from ident_service.model.chain import Array
from ident_service.results.parameter_file import ParameterFile

AGREEMENT = 1e-9
"""Largest difference between base values and those of the link values, relative to the largest base value."""
_LARGEST = 1e30  # largest value in SI units; far beyond every arm, and its square is still finite


def require_consistent(file: ParameterFile, where: Path) -> None:
    """Check that the values of a parameter file belong together.

    Args:
        file: what was read.
        where: from, for errors.

    Raises:
        ParameterError: a number that no parameter has; base values that the link values do not have; or, without
            constraints, unconstrained values that are not the values.
    """
    table = file.content["base_parameters"]
    rows = {key: table.get(key, []) for key in ("values", "unconstrained_values", "standard_deviations")}
    rows["link values"] = file.content.get("link_parameters", {}).get("values", [])
    rows["covariance"] = [value for row in table.get("covariance", []) for value in row]
    for key, values in rows.items():
        largest = max((abs(float(value)) for value in values if value is not None), default=0.0)
        if not largest <= _LARGEST:
            raise ParameterError(f"{where}: {largest:g} among its {key}; no parameter of an arm is that large")
    scale = AGREEMENT * float(np.abs(file.values).max())
    free = table.get("unconstrained_values")
    unheld = free is not None and file.content.get("feasible_set") == "none"
    if unheld and np.abs(np.array(free, dtype=float) - file.values).max() > scale:
        raise ParameterError(
            f"{where}: was fitted without constraints, but its values are not its unconstrained values; one of them "
            "was changed"
        )
    delta = named_link_values(file)
    if delta is not None and set(file.base.names) <= set(delta):
        require_base_values(file.base, np.array([delta[name] for name in file.base.names]), file.values, where)


def named_link_values(file: ParameterFile) -> dict[str, float] | None:
    """Return link values by name; None where there are none, or names and values are not equally many."""
    table = file.content.get("link_parameters")
    if table is None or len(table["names"]) != len(table["values"]):
        return None
    return {name: float(value) for name, value in zip(table["names"], table["values"], strict=True)}


def require_base_values(base: BaseParameters, delta: Array, values: Array, where: Path) -> None:
    """Check that link values have the base values.

    Args:
        base: the grouping.
        delta: link values in its order, shape (parameters,).
        values: base values, shape (base,).
        where: they come from, for errors.

    Raises:
        ParameterError: they do not.
    """
    if np.abs(base.K @ delta - values).max() > AGREEMENT * np.abs(values).max():
        raise ParameterError(
            f"{where}: its link parameters do not have the values of its base parameters; one of them was changed"
        )
