"""Reduce a model to essential parameters: the smallest that predicts as well (Pham and Gautier 1991; Gautier 1997).

From all base parameters, the one whose size is the smallest share of its own deviation leaves, the others are fitted
again, and so on, until an F-test says that what is left predicts worse than the whole model did:

    F = (|omega - W_r beta_r|^2 - |omega - W beta|^2) / p  :  |omega - W beta|^2 / (N - n)

with p parameters removed of n. Neighbouring residuals are alike, so N is not the number of rows but as many independent
ones as would leave the same uncertainty: rows times the white variance (eq. 81) over the variance from blocks, the
median over the parameters. Where neighbours are much more alike in some directions than in most, parameters there are
kept that are within their own deviation: the test is on the careful side.

All of it happens in the n coordinates of the triangular factor, `rho_1 = R_1 beta + e` (eqs. 64-70), where the
covariance of e is known from the blocks of the whole model: small matrices only, no look at the data.

A removed parameter is one that this motion cannot tell from zero: what is left predicts motions like this one, and
need not be feasible.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident_service.errors import ModelError
from ident_service.estimation.equations import Equations
from ident_service.estimation.least_squares import LeastSquares, TorqueError, torque_error
from ident_service.estimation.uncertainty import block_covariance
from ident_service.model.blas_threads import one_blas_thread
from ident_service.model.chain import Array


@dataclass(frozen=True)
class Elimination:
    """Removal of one base parameter, with the F-test that judged it.

    Attributes:
        parameter: index of the base parameter, from 0.
        deviations: size of the parameter over its standard deviation at its removal.
        F: F statistic of the model without this parameter and those removed before.
        critical: critical value of F at the level of the test.
    """

    parameter: int
    deviations: float
    F: float
    critical: float


@dataclass(frozen=True)
class Essential:
    """Reduced model: the base parameters that are kept, fitted again.

    Attributes:
        kept: base parameters that stay, increasing.
        beta: all base parameters in SI units, fitted again, 0 where removed, shape (base,).
        standard_deviations: standard deviations from blocks, given that removed parameters are 0; 0 for these, shape
            (base,).
        eliminated: removed parameters, in the order of their removal.
        refused: the elimination that the test refused; None where nothing is left to remove.
        effective_samples: N above.
        level: of the test.
        full: torque error of the whole model on the equations it was fitted to.
        reduced: torque error of the reduced model on the same equations.
    """

    kept: NDArray[np.intp]
    beta: Array
    standard_deviations: Array
    eliminated: tuple[Elimination, ...]
    refused: Elimination | None
    effective_samples: float
    level: float
    full: TorqueError
    reduced: TorqueError

    def __post_init__(self) -> None:
        for array in (self.kept, self.beta, self.standard_deviations):
            array.setflags(write=False)


@one_blas_thread()
def essential_parameters(
    equations: Equations, fit: LeastSquares, *, significance_level: float = 0.05, covariance: Array | None = None
) -> Essential:
    """Remove base parameters that data do not need until an F-test refuses; return the rest; raises if any is unseen.

    Args:
        equations: equations that `fit` solves.
        fit: ordinary or weighted least squares of all base parameters; its weights stay.
        significance_level: probability, between 0 and 1, that chance alone makes the test call a model worse that is
            not.
        covariance: covariance of `fit` from blocks, shape (base, base); computed when None.

    Raises:
        ModelError: directions that the data do not see, which no refit can decide about; or a level outside (0, 1).
    """
    size = len(fit.beta)
    if fit.rank < size:
        raise ModelError(f"the data excite {fit.rank} of {size} directions; record a motion that excites all of them")
    if not 0.0 < significance_level < 1.0:
        raise ModelError(f"level={significance_level!r} is no level of a test")
    covariance = block_covariance(equations, fit) if covariance is None else covariance
    from scipy.special import fdtri  # loads for 0.2 s, and few ask for essential parameters

    # Of the transformed torques; the identity times the residual's variance where residuals are white.
    spread = fit.R1 @ covariance @ fit.R1.T
    total = equations.total
    samples = effective_samples(fit, covariance, int(total.rows.sum()))
    noise = max(fit.rho2**2 / (samples - size), np.finfo(float).tiny)

    kept = np.arange(size)
    values, deviations = _refit(fit, spread, kept)
    done: list[Elimination] = []
    refused: Elimination | None = None
    while len(kept) > 1:
        ratio = np.abs(values) / np.maximum(deviations, np.finfo(float).tiny)
        weakest = int(np.argmin(ratio))
        rest = np.delete(kept, weakest)
        new_values, new_deviations = _refit(fit, spread, rest)
        removed = len(done) + 1
        lost = float(np.sum((fit.rho1 - fit.R1[:, rest] @ new_values) ** 2)) / removed
        F, critical = lost / noise, float(fdtri(removed, samples - size, 1.0 - significance_level))
        step = Elimination(int(kept[weakest]), float(ratio[weakest]), F, critical)
        if critical < F:
            refused = step
            break
        done.append(step)
        kept, values, deviations = rest, new_values, new_deviations
    beta, sigma = np.zeros(size), np.zeros(size)
    beta[kept], sigma[kept] = values, deviations
    return Essential(
        kept=kept,
        beta=beta,
        standard_deviations=sigma,
        eliminated=tuple(done),
        refused=refused,
        effective_samples=samples,
        level=significance_level,
        full=torque_error(total, fit.beta),
        reduced=torque_error(total, beta),
    )


def effective_samples(fit: LeastSquares, covariance: Array, row_count: int) -> float:
    """Return how many independent rows would give the estimate's uncertainty, at least one more than parameters.

    Args:
        fit: the estimate, with its white standard deviations (eq. 81).
        covariance: covariance of the estimate from blocks, shape (base, base).
        row_count: number of rows that the estimate was fitted to.
    """
    white, blocks = fit.standard_deviations**2, np.diag(covariance)
    seen = np.isfinite(white) & np.isfinite(blocks) & (blocks > 0.0)
    ratio = float(np.median(white[seen] / blocks[seen])) if seen.any() else 1.0
    return max(row_count * min(ratio, 1.0), len(fit.beta) + 1.0)


def _refit(fit: LeastSquares, spread: Array, kept: NDArray[np.intp]) -> tuple[Array, Array]:
    """Return the values of the kept parameters and their standard deviations, the others being 0."""
    Q, R = np.linalg.qr(fit.R1[:, kept])
    inverse = np.linalg.solve(R, Q.T)
    variances = np.einsum("ik,kl,il->i", inverse, spread, inverse, optimize=True)
    return np.asarray(inverse @ fit.rho1), np.sqrt(np.maximum(variances, 0.0))
