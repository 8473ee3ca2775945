"""Choose between ways to estimate by what predicts parts of the recordings that were held out.

The recordings are cut into thirds; each third's torques are predicted from the other two, as a validation would do it.
Nothing but the recordings that are fitted to is looked at.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

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
        return f"{self.option}: {self.value} was chosen; torque error on held-out thirds of the recordings: {others}"


def chosen(option: str, held_out: Mapping[str, float]) -> Choice:
    """Choose the alternative with the smallest held-out error; the first, unless another is better by a hundredth."""
    usual = next(iter(held_out))
    best = min(held_out, key=lambda name: held_out[name])
    return Choice(option, best if held_out[best] < _WORTH * held_out[usual] else usual, dict(held_out))
