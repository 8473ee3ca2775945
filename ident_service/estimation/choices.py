"""Choose between ways to estimate by the prediction error on held-out parts of the recordings.

The recordings are cut into thirds; each third's torques are predicted from the other two, as a validation would do it.
Nothing but the recordings that are fitted to is looked at.

What else the model may contain, a delay or another shape of the friction, is judged by estimates inside the feasible
set. Without its conditions impossible inertias and viscous friction make up for a delay that is not there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ident_service.errors import SolverError
from ident_service.estimation.feasible.feasible_set import FeasibleSet
from ident_service.estimation.feasible.problems import ENOUGH, constrained_least_squares
from ident_service.estimation.least_squares import ordinary_least_squares
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.chain import Array
from ident_service.model.information import Information

_PARTS = 3

# A choice is left at its usual value for less: held-out errors of so few parts differ by as much from chance.
_WORTH = 0.99
_SPREADS = 2.0  # standard deviations between thirds that a gain must exceed


@dataclass(frozen=True)
class Choice:
    """Chosen value of one option, with the held-out errors of all alternatives.

    Attributes:
        option: key in the configuration's section `identification`.
        value: chosen value.
        held_out: relative torque error [percent] on held-out parts, per alternative.
    """

    option: str
    value: str
    held_out: Mapping[str, float]

    def __str__(self) -> str:
        others = ", ".join(f"{name} {error:.3g} %" for name, error in self.held_out.items())
        return f"{self.option} {self.value}; torque error on held-out thirds of the recordings: {others}"


def best_choice(option: str, held_out: Mapping[str, float]) -> Choice:
    """Choose the first alternative, unless another's held-out error is smaller by more than 1 %; then the smallest."""
    usual = next(iter(held_out))
    best = min(held_out, key=lambda name: held_out[name])
    return Choice(option, best if held_out[best] < _WORTH * held_out[usual] else usual, dict(held_out))


def significant_choice(option: str, held_out: Mapping[str, Array]) -> Choice:
    """Choose the first alternative, unless others beat it on all thirds and by far; then the best of them.

    Args:
        option: key in the configuration's section `identification`.
        held_out: torque errors [percent] of each third, per alternative, shape (thirds,).

    Returns:
        The alternative with the smallest error of those that are better than the first on every third, on the average
        by a hundredth and by twice the standard deviation between thirds.
    """
    usual, *others = held_out
    before = held_out[usual]
    together = rms_over_thirds(held_out)

    def clear(name: str) -> bool:
        if not np.all(np.isfinite(held_out[name])):
            return False
        gain = 1.0 - held_out[name] / before
        enough = max(1.0 - _WORTH, _SPREADS * float(np.std(gain, ddof=1)))
        return bool(np.all(gain > 0.0) and np.mean(gain) > enough)

    better = [name for name in others if np.all(np.isfinite(before)) and clear(name)]
    return Choice(option, min(better, key=lambda name: together[name], default=usual), together)


def rms_over_thirds(held_out: Mapping[str, Array]) -> dict[str, float]:
    """Return per alternative the root mean square over the thirds' torque errors [percent]."""
    return {name: float(np.sqrt(np.mean(np.square(errors)))) for name, errors in held_out.items()}


def held_out_thirds(
    parts: Sequence[Information], weights: Array, base: BaseParameters, conditions: FeasibleSet
) -> Array:
    """Return each part's torque error [percent] under the feasible estimate of the others; all inf if one fails.

    Args:
        parts: equations of consecutive stretches of time.
        weights: per joint, what its equations are multiplied by, shape (joints,).
        base: grouping of the parameters.
        conditions: feasible set that constrains the estimates.

    Returns:
        Relative torque errors [percent], the joints weighed by `weights`, shape (parts,); infinite where nothing can
        be estimated.
    """
    errors = []
    for number, unseen in enumerate(parts):
        rest = Information.sum([part for other, part in enumerate(parts) if other != number])
        try:
            fit = ordinary_least_squares(rest, weights)
            beta = constrained_least_squares(fit, base, conditions, first_tolerance=ENOUGH).beta
        except SolverError:
            return np.full(len(parts), np.inf)
        left, torque = (
            np.sum(weights**2 * unseen.squared_residuals(beta)),
            np.sum(weights**2 * unseen.squared_torques()),
        )
        errors.append(100.0 * float(np.sqrt(left / torque)) if torque > 0.0 else np.inf)
    return np.array(errors)


def held_out_error(blocks: Sequence[Information], weights: Array) -> float:
    """Return the torque error [percent] of thirds, each predicted from the others; infinite for under 3 blocks.

    Args:
        blocks: equations of consecutive stretches of time.
        weights: per joint, what its equations are multiplied by, shape (joints,).

    Returns:
        Relative torque error [percent], the joints weighed by `weights`; infinite where there are too few stretches.
    """
    if len(blocks) < _PARTS:
        return np.inf
    parts = [part.tolist() for part in np.array_split(np.arange(len(blocks)), _PARTS)]
    errors = torques = 0.0
    for number, part in enumerate(parts):
        rest = [blocks[index] for other, indices in enumerate(parts) if other != number for index in indices]
        beta = ordinary_least_squares(Information.sum(rest), weights).beta
        unseen = Information.sum([blocks[index] for index in part])
        errors += float(np.sum(weights**2 * unseen.squared_residuals(beta)))
        torques += float(np.sum(weights**2 * unseen.squared_torques()))
    return 100.0 * float(np.sqrt(errors / torques)) if torques > 0.0 else np.inf
