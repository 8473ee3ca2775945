"""Compare the values that two sides are used with, which need not be those that are tested.

Tests are made of unconstrained values, to which the covariances belong. Exports, models and torque errors are made of
the values held in a feasible set, so these may differ where the arm has not changed: by another set, another method, or
an edited file. Pure computation, no I/O.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident_service.estimation.drift import Identified, relevant, torque_shares
from ident_service.model.chain import Array
from ident_service.results.comparison.sides import Side


@dataclass(frozen=True)
class InUse:
    """Values in use of the parameters that both sides have.

    Attributes:
        reference: values [SI], shape (shared,).
        side: of the other, shape (shared,).
        apart: whether they are other values than the tested ones, on either side.
        shares: per joint, the root mean square by which their difference changes its torque, over that of the torque
            and over that of the residual, each of shape (joints,); None where no motion is known.
    """

    reference: Array
    side: Array
    apart: bool
    shares: tuple[Array, Array] | None

    @property
    def matters(self) -> bool:
        """Return whether the difference of the values in use changes some joint's torque by a relevant amount."""
        return self.shares is not None and relevant(self.shares)

    def worst(self) -> tuple[int, float] | None:
        """Return the joint, from 0, whose torque the difference changes by the largest share, and that share."""
        if self.shares is None:
            return None
        joint = int(np.argmax(self.shares[0]))
        return joint, float(self.shares[0][joint])


def values_in_use(
    sides: tuple[Side, Side],
    places: Sequence[NDArray[np.intp]],
    compared: tuple[Identified, Identified] | None,
) -> InUse:
    """Return the values in use of the shared parameters of two sides.

    Args:
        sides: the reference and the other.
        places: of the shared parameters in each.
        compared: both as they are tested; None where they are not.
    """
    reference, side = (one.file.values[at] for one, at in zip(sides, places, strict=True))
    if compared is None:
        return InUse(reference, side, False, None)
    first, second = compared
    seen = np.isfinite(np.diag(first.covariance) + np.diag(second.covariance))
    apart = not (np.array_equal(first.values, reference) and np.array_equal(second.values, side))
    return InUse(reference, side, apart, torque_shares(first, second, np.where(seen, side - reference, 0.0)))
