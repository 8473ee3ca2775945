"""Evaluate criteria of a motion's information matrix, smooth, with their gradients.

All are logarithms and all are to be made small; `G = sum_s H_b' H_b`, rows whitened where the criterion asks for it.

    d_optimal          -log det(G) / n                     the volume of the confidence ellipsoid
    a_optimal          log of the mean of (G^-1)_ii / s_i^2, chosen parameters only: variances in units of s_i^2
    condition_number   log(largest / smallest singular value of the stacked regressor), by power means of the
                       eigenvalues of G, which have gradients where the extremes cross: sharper with a larger exponent
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident_service.config.design import Criterion
from ident_service.model.chain import Array

_FLOOR = 1e-13  # of the largest eigenvalue: below it an eigenvalue is rounding noise
_NOTHING = 1e-100  # a largest eigenvalue that is no information at all, and still has an inverse


@dataclass(frozen=True)
class Value:
    """Value and gradient of a criterion at one information matrix.

    Attributes:
        value: to be made small.
        gradient: symmetric, shape (base, base): the value changes by `sum(gradient * dG)`.
    """

    value: float
    gradient: Array


def criterion(
    kind: Criterion,
    G: Array,
    sharpness: float = 16.0,
    chosen: NDArray[np.intp] | None = None,
    scale: Array | None = None,
) -> Value:
    """Evaluate a criterion and its gradient.

    Args:
        kind: of criterion.
        G: information matrix, shape (base, base).
        sharpness: exponent of the condition number's power means.
        chosen: for `a_optimal`, which parameters; all when None.
        scale: for `a_optimal`, what a deviation of each parameter is measured in, shape (base,).
    """
    eigenvalues, V = np.linalg.eigh(G)
    eigenvalues = np.maximum(eigenvalues, _FLOOR * max(float(eigenvalues[-1]), _NOTHING))
    n = len(eigenvalues)
    if kind == "d_optimal":
        return Value(-float(np.log(eigenvalues).sum()) / n, -(V / (n * eigenvalues)) @ V.T)
    if kind == "a_optimal":
        pick = np.arange(n) if chosen is None else chosen
        weights = np.zeros(n)
        weights[pick] = 1.0 if scale is None else 1.0 / scale[pick] ** 2
        weights /= len(pick)
        inverse = (V / eigenvalues) @ V.T
        mean = float(weights @ np.diag(inverse))
        return Value(float(np.log(mean)), -(inverse * weights) @ inverse / mean)
    top, bottom = eigenvalues[-1], eigenvalues[0]
    high, low = (eigenvalues / top) ** sharpness, (eigenvalues / bottom) ** -sharpness
    value = np.log(high.sum()) / sharpness + np.log(top) + np.log(low.sum()) / sharpness - np.log(bottom)
    slope = (high / high.sum() - low / low.sum()) / eigenvalues
    return Value(0.5 * float(value), 0.5 * (V * slope) @ V.T)


def condition_number(G: Array) -> float:
    """Return the condition number of the stacked regressor with information G; infinite where G is singular."""
    eigenvalues = np.linalg.eigvalsh(G)
    return float(np.sqrt(eigenvalues[-1] / eigenvalues[0])) if eigenvalues[0] > 0.0 else float("inf")
