"""Choose between ways to estimate by what predicts parts of the recordings that were held out.

The recordings are cut into thirds; each third's torques are predicted from the other two, as a validation would do it.
Nothing but the recordings that are fitted to is looked at.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ident_service.estimation.least_squares import ordinary_least_squares
from ident_service.model.chain import Array
from ident_service.model.information import Information

_PARTS = 3

# A choice is left at its usual value for less: held-out errors of so few parts differ by as much from chance.
_WORTH = 0.99


@dataclass(frozen=True)
class Choice:
    """Record what was chosen for the estimate, and what the alternatives predict.

    Attributes:
        option: key in the configuration's section `identification`.
        value: that was chosen.
        held_out: relative torque error [percent] on held-out parts, per alternative.
    """

    option: str
    value: str
    held_out: Mapping[str, float]

    def __str__(self) -> str:
        others = ", ".join(f"{name} {error:.3g} %" for name, error in self.held_out.items())
        return f"{self.option} {self.value}; torque error on held-out thirds of the recordings: {others}"


def chosen(option: str, held_out: Mapping[str, float]) -> Choice:
    """Choose the alternative with the smallest held-out error; the first, unless another is better by a hundredth."""
    usual = next(iter(held_out))
    best = min(held_out, key=lambda name: held_out[name])
    return Choice(option, best if held_out[best] < _WORTH * held_out[usual] else usual, dict(held_out))


def held_out_error(blocks: Sequence[Information], weights: Array) -> float:
    """Predict the torques of each third of the recordings from the other two.

    Args:
        blocks: equations of consecutive stretches of time.
        weights: per joint, what its equations are multiplied by, shape (joints,).

    Returns:
        Relative torque error [percent], the joints weighed by `weights`; infinite where there are too few stretches.
    """
    if len(blocks) < _PARTS:
        return np.inf
    parts = np.array_split(np.arange(len(blocks)), _PARTS)
    errors = torques = 0.0
    for number, part in enumerate(parts):
        rest = [blocks[index] for other, indices in enumerate(parts) if other != number for index in indices]
        beta = ordinary_least_squares(Information.sum(rest), weights).beta
        unseen = Information.sum([blocks[index] for index in part])
        errors += float(np.sum(weights**2 * unseen.squared_residuals(beta)))
        torques += float(np.sum(weights**2 * unseen.squared_torques()))
    return 100.0 * float(np.sqrt(errors / torques)) if torques > 0.0 else np.inf
