"""Decide when a run has learned enough: the target of `ident run --until`.

A parameter is reached when its deviation is at most the target's share of the larger of its size and what is as good
as zero, as in its verdict: a parameter that is as good as zero need not be known to a share of itself.
The deviation is the larger of eq. 81 and of what blocks say, as few blocks can err to either side, and nothing counts
before there are some, nor before the motion has lasted for its first period: before, its design has not been made.
Every base parameter counts where none is chosen. Not only the essential ones: early on, what is not known yet cannot
be told from what is not there. Decision 0041.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ident_service.errors import UsageError
from ident_service.estimation.uncertainty import relative_deviations

if TYPE_CHECKING:  # a run whose target another process watches loads no estimator
    from ident_service.estimation.online import ParameterUncertainty
    from ident_service.model.base_parameters import BaseParameters

LEAST_BLOCKS = 10


@dataclass(frozen=True)
class Target:
    """Required accuracy of chosen base parameters.

    Attributes:
        share: largest deviation as a share of the parameter, between 0 and 1.
        parameters: expressions as `ident base-parameters` prints them; all base parameters if empty.
    """

    share: float
    parameters: tuple[str, ...] = ()

    def base_indices(self, base: BaseParameters, arm_name: str) -> NDArray[np.intp]:
        """Return the indices of base parameters that the target names, all if none; raises UsageError for unknown ones.

        Raises:
            UsageError: one is none of the arm's.
        """
        known = {expression.replace(" ", ""): place for place, expression in enumerate(base.expressions)}
        if unknown := [name for name in self.parameters if name.replace(" ", "") not in known]:
            raise UsageError(
                f"{', '.join(unknown)}: not among the base parameters of {arm_name}; "
                "`ident base-parameters` prints them"
            )
        chosen = [known[name.replace(" ", "")] for name in self.parameters] or list(range(base.size))
        return np.array(chosen, dtype=np.intp)


def worst_relative_deviation(uncertainty: ParameterUncertainty, base_indices: NDArray[np.intp]) -> float:
    """Return the largest relative deviation of the chosen parameters; infinite while blocks are under 10."""
    if uncertainty.blocks < LEAST_BLOCKS:
        return np.inf
    worst = float(
        relative_deviations(uncertainty.beta, uncertainty.deviations, uncertainty.negligible)[base_indices].max()
    )
    return worst if np.isfinite(worst) else np.inf
