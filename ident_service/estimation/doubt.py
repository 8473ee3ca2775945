"""How sure an estimate is: covariance from blocks of scores, and a verdict per base parameter.

Eq. 81 takes residuals for independent from sample to sample; smoothing and unmodelled friction make neighbours alike.
Here the variance of the score `W^T (omega - W beta)` is estimated from blocks of about a second (a cluster-robust
"sandwich"), each block weighted as if it had been left out (the jackknife, HC3), which is on the careful side when
blocks are few. What a single block alone tells cannot be left out: nothing says how sure that is.

A deviation from few blocks is itself uncertain. How many degrees of freedom it has follows Satterthwaite's
approximation for such estimators (Bell and McCaffrey, 2002), and a verdict takes Student's t for them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from scipy.special import stdtrit

from ident_service.estimation.least_squares import LeastSquares
from ident_service.model.chain import Array
from ident_service.model.threads import one_blas_thread

if TYPE_CHECKING:
    from ident_service.estimation.equations import Equations

Verdict = Literal["identified", "weak", "unidentified"]

# Below a reference a parameter is as good as zero, and its share of itself says nothing; from arms of table size.
REFERENCE = {"kg m^2": 0.01, "kg m": 0.01, "kg": 0.1, "N m s/rad": 0.1, "N m": 0.1, "N s/m": 0.1, "N": 0.1}
REFERENCE |= {"N m s^2/rad^2": 0.1, "N s^2/m^2": 0.1}
IDENTIFIED_BELOW = 0.10
WEAK_BELOW = 0.50
_ALONE = 1.0 - 1e-4  # leverage of a direction that one block alone tells about
_SEEN_ALONE = 1e-3  # share of a parameter's variance along such directions, from which its own is not known
_MOST_DEGREES = 1e6
_NORMAL = 1.959963984540054  # 97.5 % of the normal distribution


@dataclass(frozen=True)
class Uncertainty:
    """How sure an unconstrained estimate is.

    Attributes:
        covariance: shape (base, base), SI units; infinite on the diagonal for what the data, or more than one block of
            them, do not see. No variance is below that of eq. 81.
        degrees: degrees of freedom of each variance, shape (base,).
    """

    covariance: Array
    degrees: Array


@one_blas_thread()
def uncertainty(equations: Equations, fit: LeastSquares) -> Uncertainty:
    """Estimate covariance and degrees of freedom from blocks.

    Args:
        equations: in blocks.
        fit: what solves them.
    """
    size = len(fit.beta)
    meat = np.zeros((size, size))
    bread = fit.inverse @ fit.inverse.T
    alone = np.zeros(size)  # largest share of a parameter's white variance along a direction of one block alone
    lengths, images = np.zeros((len(equations.blocks), size)), np.zeros((len(equations.blocks), size, size))
    for number, block in enumerate(equations.blocks):
        score = block.scores(fit.beta, fit.weights)
        W = block.stacked(fit.weights)[:-1, :-1]
        # Leave-one-block-out: the score times (1 - leverage)^-1, solved in the block's own small space.
        shares, U = np.linalg.eigh(W @ bread @ W.T)
        others = shares < _ALONE
        inverse = (U[:, others] / (1.0 - shares[others])) @ U[:, others].T
        left_out = inverse @ (W @ bread)
        full = score + W.T @ (left_out @ score)
        meat += np.outer(full, full)
        along = bread @ W.T @ U[:, ~others]
        alone = np.maximum(alone, np.sum(along**2, axis=1) / np.maximum(np.diag(bread), np.finfo(float).tiny))
        lengths[number] = np.sum(left_out**2, axis=0)
        images[number] = fit.inverse.T @ (W.T @ left_out)
    covariance = bread @ meat @ bread
    deviations, white = np.sqrt(np.diag(covariance)), fit.standard_deviations
    blind = ~np.isfinite(white) | (alone > _SEEN_ALONE)
    known = ~blind & (deviations > 0.0)
    scale = np.where(known, np.maximum(1.0, np.where(known, white, 0.0) / np.where(known, deviations, 1.0)), 1.0)
    covariance = covariance * np.outer(scale, scale)
    covariance[blind, blind] = np.inf
    return Uncertainty(covariance, _degrees(lengths, images))


def _degrees(lengths: Array, images: Array) -> Array:
    """Satterthwaite's degrees tr(G)^2 / |G|^2 per parameter, of the quadratic form G of errors that its variance is.

    With white errors, G_bc = [b = c] |g_b|^2 - m_b . m_c for blocks b and c: g_b is what the block's errors are
    multiplied by (squared lengths `lengths`, shape (blocks, base)), m_b its image under the estimate (`images`, shape
    (blocks, base, base), the parameter last).
    """
    own = np.sum(images**2, axis=1)
    trace = np.sum(lengths - own, axis=0)
    products = np.einsum("bik,bjk->kij", images, images, optimize=True)
    squares = np.sum(lengths**2 - 2.0 * lengths * own, axis=0) + np.sum(products**2, axis=(1, 2))
    found = np.maximum(trace, 0.0) ** 2 / np.maximum(squares, np.finfo(float).tiny)
    return np.asarray(np.minimum(found, _MOST_DEGREES))


def block_covariance(equations: Equations, fit: LeastSquares) -> Array:
    """Estimate the covariance alone, shape (base, base), see `Uncertainty`."""
    return uncertainty(equations, fit).covariance


def verdicts(
    beta: Array,
    deviations: Array,
    units: tuple[str, ...],
    degrees: Array | None = None,
    as_zero: Array | None = None,
) -> tuple[Verdict, ...]:
    """Give a word per parameter: its deviation against the larger of its size and the reference of its unit.

    Args:
        beta: parameters, shape (base,).
        deviations: of them, shape (base,).
        units: of them.
        degrees: of freedom of the deviations, shape (base,): one from few blocks counts for as much as Student's t at
            95 % is wider than the normal distribution. Known deviations when None.
        as_zero: sizes below which parameters are as good as zero, shape (base,); the references when None.
    """
    wider = np.ones(len(beta)) if degrees is None else stdtrit(np.maximum(degrees, 1.0), 0.975) / _NORMAL
    return tuple(
        "identified" if share < IDENTIFIED_BELOW else "weak" if share < WEAK_BELOW else "unidentified"
        for share in shares(beta, deviations * wider, units, as_zero)
    )


def shares(beta: Array, deviations: Array, units: tuple[str, ...], as_zero: Array | None = None) -> Array:
    """Each deviation as a share of the larger of the parameter's size and the reference of its unit, shape (base,)."""
    least = np.array([REFERENCE.get(unit, 0.0) for unit in units]) if as_zero is None else as_zero
    return np.asarray(deviations / np.maximum(np.maximum(np.abs(beta), least), np.finfo(float).tiny))
