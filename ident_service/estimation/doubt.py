"""How sure an estimate is: covariance from blocks of scores, and a verdict per base parameter.

Eq. 81 takes residuals for independent from sample to sample; smoothing and unmodelled friction make neighbours alike.
Here the variance of the score `W^T (omega - W beta)` is estimated from blocks of about a second (a cluster-robust
"sandwich"), each block weighted as if it had been left out (the jackknife, HC3), which is on the careful side when
blocks are few.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from ident_service.estimation.least_squares import LeastSquares
from ident_service.model.chain import Array
from ident_service.model.threads import one_blas_thread

if TYPE_CHECKING:
    from ident_service.estimation.equations import Equations

Verdict = Literal["identified", "weak", "unidentified"]

# Below a reference a parameter is as good as zero, and its share of itself says nothing; from arms of table size.
REFERENCE = {"kg m^2": 0.01, "kg m": 0.01, "kg": 0.1, "N m s/rad": 0.1, "N m": 0.1, "N s/m": 0.1, "N": 0.1}
IDENTIFIED_BELOW = 0.10
WEAK_BELOW = 0.50


@one_blas_thread()
def block_covariance(equations: Equations, fit: LeastSquares) -> Array:
    """Covariance of the unconstrained estimate, shape (base, base), SI units.

    Directions the data do not see have infinite variance on the diagonal.
    """
    size = len(fit.beta)
    meat = np.zeros((size, size))
    bread = fit.inverse @ fit.inverse.T
    for block in equations.blocks:
        score = block.scores(fit.beta, fit.weights)
        W = block.stacked(fit.weights)[:-1, :-1]
        # Leave-one-block-out: the score times (1 - leverage)^-1, solved in the block's own small space.
        leverage = W @ bread @ W.T
        correction = np.linalg.lstsq(np.eye(size) - leverage, W @ (bread @ score), rcond=None)[0]
        full = score + W.T @ correction
        meat += np.outer(full, full)
    covariance = bread @ meat @ bread
    blind = ~np.isfinite(fit.standard_deviations)
    covariance[blind, blind] = np.inf
    return covariance


def verdicts(beta: Array, deviations: Array, units: tuple[str, ...]) -> tuple[Verdict, ...]:
    """A word per parameter: its deviation against the larger of its size and the reference of its unit."""
    return tuple(
        "identified" if share < IDENTIFIED_BELOW else "weak" if share < WEAK_BELOW else "unidentified"
        for share in shares(beta, deviations, units)
    )


def shares(beta: Array, deviations: Array, units: tuple[str, ...]) -> Array:
    """Each deviation as a share of the larger of the parameter's size and the reference of its unit, shape (base,)."""
    sizes = [max(abs(beta[k]), REFERENCE.get(unit, 0.0), np.finfo(float).tiny) for k, unit in enumerate(units)]
    return np.asarray(deviations / np.array(sizes))
