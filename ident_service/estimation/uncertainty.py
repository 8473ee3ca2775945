"""Estimate parameter uncertainty: covariance from blocks of scores, and a verdict per base parameter.

Eq. 81 takes residuals for independent from sample to sample; smoothing and unmodelled friction make neighbours alike.
Here the variance of the score `W^T (omega - W beta)` is estimated from blocks of about a second (a cluster-robust
"sandwich"), each block weighted as if it had been left out (the jackknife, HC3), which is on the careful side when
blocks are few. What a single block alone tells cannot be left out: nothing says how sure that is.

Blocks that show the same motion are one (`repeats.py`): what repeats with the motion is error of the model and does not
shrink with its periods; only what differs between them is noise (Pintelon and Schoukens 2012, chapter 4).

A variance from few blocks is itself uncertain. How many degrees of freedom it has follows Satterthwaite's approximation
for such estimators (Bell and McCaffrey, 2002). The deviation that people are told is widened by as much as Student's t
is wider than the normal distribution, so that two deviations are 95 % whatever the number of blocks. Blocks of two and
of four times the length are tried, too, and the largest deviation counts: errors of the model last as long as a slow
joint stays where it is (decision 0063).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from ident_service.estimation.least_squares import LeastSquares
from ident_service.model.blas_threads import one_blas_thread
from ident_service.model.chain import Array
from ident_service.model.information import Information

if TYPE_CHECKING:
    from ident_service.estimation.equations import Equations

Verdict = Literal["identified", "weak", "unidentified"]

# Share of a joint's torque over the motion (root mean squares); a parameter with less effect is as good as zero.
NEGLIGIBLE_TORQUE = 0.10
IDENTIFIED_BELOW = 0.10
WEAK_BELOW = 0.50
_ALONE = 1.0 - 1e-4  # leverage above which one block alone determines a direction
_SEEN_ALONE = 1e-3  # share of a parameter's variance along such directions, above which it is unknown
_MOST_DEGREES = 1e6
_LONGER = (2, 4)  # numbers of neighbouring blocks that are also merged into one
_LEAST_CLUSTERS = 5
_NORMAL = 1.959963984540054  # 97.5 % of the normal distribution


@dataclass(frozen=True)
class Uncertainty:
    """Covariance and standard deviations of an unconstrained estimate.

    Attributes:
        covariance: shape (base, base), SI units; infinite on the diagonal for what the data, or more than one block of
            them, do not see. No variance is below that of eq. 81. For tests, which know the degrees of freedom.
        deviations: standard deviations on the careful side, shape (base,), SI units: the largest of several lengths of
            the blocks, widened for its degrees of freedom.
        degrees: degrees of freedom of those deviations before they were widened, shape (base,).
        noise: variances [SI^2] from the differences between repetitions of the motion, shape (base,); None where most
            of the motion is not repeated, so that noise and error of the model cannot be told apart.
        inflation: ratio of the variances to those of eq. 81, the mean over all directions of the largest of several
            lengths of the blocks; at least 1. One number, which few blocks do not spoil.
    """

    covariance: Array
    deviations: Array
    degrees: Array
    noise: Array | None = None
    inflation: float = 1.0


@one_blas_thread()
def uncertainty(equations: Equations, fit: LeastSquares) -> Uncertainty:
    """Return covariance, deviations and degrees of freedom of an estimate, from leaving out blocks of time.

    Args:
        equations: equations in blocks.
        fit: least squares that solves the equations.
    """
    clusters = equations.clusters
    seen = [_Whitened.of(cluster, fit) for cluster in clusters]
    covariance, degrees, blind = _left_out(seen, fit, np.eye(len(fit.beta)))
    deviations = np.sqrt(np.diag(covariance))
    known = ~blind & (deviations > 0.0)
    floor = np.where(known, np.maximum(deviations, np.where(known, fit.standard_deviations, 0.0)), deviations)
    scale = np.where(known, floor / np.where(known, deviations, 1.0), 1.0)
    covariance = covariance * np.outer(scale, scale)
    covariance[blind, blind] = np.inf
    largest = floor * student_factors(degrees)
    # Errors of the model last longer than a block where a joint is slow.
    for count in _LONGER:
        if len(clusters) < _LEAST_CLUSTERS * count:
            break
        longer = [_Whitened.sum(seen[start : start + count]) for start in range(0, len(seen), count)]
        other, fewer, _ = _left_out(longer, fit, np.eye(len(fit.beta)))
        found = np.sqrt(np.diag(other)) * student_factors(fewer)
        degrees = np.where(found > largest, fewer, degrees)
        largest = np.maximum(largest, found)
    inflation = _inflation(seen, _white_variance(equations, fit))
    return Uncertainty(covariance, np.where(blind, np.inf, largest), degrees, _noise(clusters, fit), inflation)


def inflated_covariance(equations: Equations, fit: LeastSquares, doubt: Uncertainty) -> Array:
    """Return the covariance of eq. 81 times `Uncertainty.inflation`, shape (base, base); infinite where unseen.

    Where blocks are few, the ratios of its entries are much surer than those of `Uncertainty.covariance`, which are
    from the blocks alone; its size is of all directions together. For tests that find the size of each themselves.

    Args:
        equations: equations in blocks.
        fit: least squares that solves the equations.
        doubt: uncertainty of that fit.
    """
    covariance = fit.inverse @ fit.inverse.T * (_white_variance(equations, fit) * doubt.inflation)
    unseen = ~np.isfinite(doubt.deviations)
    covariance[unseen, unseen] = np.inf
    return np.asarray(covariance)


def _white_variance(equations: Equations, fit: LeastSquares) -> float:
    total = equations.total
    degrees = max(int(total.rows.sum()) - total.base, 1)
    return (fit.rho2**2 + float(np.sum((fit.rho1 - fit.R1 @ fit.beta) ** 2))) / degrees


def _inflation(seen: Sequence[_Whitened], variance: float) -> float:
    """Return `Uncertainty.inflation`.

    With white residuals of variance v the scores s_b of a block, in coordinates in which all blocks together have the
    identity as information and block b has S_b, have E |s_b|^2 = v tr(S_b - S_b^2) (that of HC2). The sum over blocks
    is one number from blocks times parameters, and so neither biased nor much uncertain where blocks are few.
    """
    found = [1.0]
    for count in (1, *_LONGER):
        if count > 1 and len(seen) < _LEAST_CLUSTERS * count:
            break
        blocks = [_Whitened.sum(seen[start : start + count]) for start in range(0, len(seen), count)]
        expected = sum(float(np.trace(one.share)) - float(np.sum(one.share**2)) for one in blocks)
        if expected > 0.0 and variance > 0.0:
            found.append(sum(float(one.score @ one.score) for one in blocks) / (variance * expected))
    return max(found)


def jackknife(
    clusters: Sequence[Sequence[Information]], fit: LeastSquares, parameter_combinations: Array | None = None
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return covariance, degrees of freedom and a mask of the unseen, leaving out one cluster at a time (HC3).

    Args:
        clusters: clusters of blocks; each cluster counts as one piece of evidence.
        fit: least squares that solves all of them.
        parameter_combinations: combinations of the parameters, shape (base, combinations); each parameter alone when
            None. The covariance of few blocks says nothing about combinations, as it knows most of them far too well:
            their degrees of freedom must be asked for with them.

    Returns:
        The covariance of the combinations, shape (combinations, combinations); degrees of freedom of its variances,
        shape (combinations,); and of which of them the data, or all clusters but one, say nothing.
    """
    combinations = np.eye(len(fit.beta)) if parameter_combinations is None else parameter_combinations
    return _left_out([_Whitened.of(cluster, fit) for cluster in clusters], fit, combinations)


@dataclass(frozen=True)
class _Whitened:
    """Hold what a cluster says, in coordinates in which all clusters together have the identity as information.

    Attributes:
        score: shape (base,).
        share: share of the cluster in the information, symmetric, with its leverages as eigenvalues, from 0 to 1; shape
            (base, base).
    """

    score: Array
    share: Array

    @classmethod
    def of(cls, cluster: Sequence[Information], fit: LeastSquares) -> _Whitened:
        """Return what a cluster says about the parameters of a fit."""
        A = fit.inverse
        rows = [
            (1.0 if fit.weights is None else fit.weights[joint]) * (factor[:, :-1] @ A[support])
            for block in cluster
            for joint, (support, factor) in enumerate(zip(block.supports, block.factors, strict=True))
        ]
        Z = np.vstack(rows)
        scores = np.sum([block.scores(fit.beta, fit.weights) for block in cluster], axis=0)
        return cls(A.T @ scores, Z.T @ Z)

    @classmethod
    def sum(cls, parts: Sequence[_Whitened]) -> _Whitened:
        """Return what clusters say that count as one."""
        return cls(np.sum([one.score for one in parts], axis=0), np.sum([one.share for one in parts], axis=0))

    def of_others(self) -> tuple[Array, Array]:
        """Return (I - share)^-1, shape (base, base), without directions that no other cluster sees, and those.

        The latter are columns times the square roots of their shares, shape (base, directions).
        """
        from scipy.linalg.lapack import dpotrf, dpotri  # loads for 0.2 s; a third of the time of numpy's `inv`

        size = len(self.score)
        L, failed = dpotrf(np.eye(size) - self.share, lower=True)
        if not failed:
            half, _ = dpotri(L, lower=True)  # the lower half of the inverse; above are zeros
            # No eigenvalue of the inverse is above their sum.
            if np.trace(half) < 1.0 / (1.0 - _ALONE):
                inverse = half + half.T
                np.fill_diagonal(inverse, np.diag(half))
                return inverse, np.zeros((size, 0))
        shares, V = np.linalg.eigh(self.share)
        others = shares < _ALONE
        return (V[:, others] / (1.0 - shares[others])) @ V[:, others].T, V[:, ~others] * np.sqrt(shares[~others])


def _left_out(
    clusters: Sequence[_Whitened], fit: LeastSquares, combinations: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return what `jackknife` does, of combinations `combinations`, shape (base, combinations)."""
    along = fit.inverse.T @ combinations
    variances = np.maximum(np.sum(along**2, axis=0), np.finfo(float).tiny)
    alone = np.zeros(len(variances))  # largest share of a white variance along a direction of one cluster alone
    lengths, images = np.zeros((len(clusters), len(alone))), np.zeros((len(clusters), len(along), len(alone)))
    scores = np.zeros((len(clusters), len(along)))
    for number, one in enumerate(clusters):
        # Leave-one-out: the score times (1 - leverage)^-1.
        inverse, directions = one.of_others()
        scores[number] = one.score + one.share @ (inverse @ one.score)
        if directions.shape[1]:
            alone = np.maximum(alone, np.sum((directions.T @ along) ** 2, axis=0) / variances)
        without = inverse @ along
        images[number] = one.share @ without
        lengths[number] = np.sum(without * images[number], axis=0)
    unseen = ~np.isfinite(fit.standard_deviations)
    blind = np.any(combinations[unseen] != 0.0, axis=0) | (alone > _SEEN_ALONE)
    projected = scores @ along
    return projected.T @ projected, _degrees(lengths, images), blind


def _noise(clusters: Sequence[Sequence[Information]], fit: LeastSquares) -> Array | None:
    """Return the variances from differences between blocks of the same motion; None where most blocks have no other."""
    sizes = [(len(cluster), sum(int(block.rows.sum()) for block in cluster)) for cluster in clusters]
    if sum(size for count, size in sizes if count > 1) <= 0.5 * sum(size for _, size in sizes):
        return None
    differing = np.zeros((len(fit.beta), len(fit.beta)))
    for cluster in clusters:
        scores = np.array([block.scores(fit.beta, fit.weights) for block in cluster])
        count = len(cluster)
        apart = scores if count == 1 else np.sqrt(count / (count - 1)) * (scores - scores.mean(axis=0))
        differing += apart.T @ apart
    bread = fit.inverse @ fit.inverse.T
    return np.diag(bread @ differing @ bread).copy()


def student_factors(degrees_of_freedom: Array) -> Array:
    """Return the factor per parameter by which 1.96 deviations become 95 % of Student's t, shape (base,).

    Args:
        degrees_of_freedom: degrees of freedom, shape (base,).
    """
    from scipy.special import stdtrit  # loads for 0.2 s, and a run without a target judges nothing

    return np.asarray(stdtrit(np.maximum(degrees_of_freedom, 1.0), 0.975) / _NORMAL)


def _degrees(lengths: Array, images: Array) -> Array:
    """Return Satterthwaite's degrees of freedom tr(G)^2 / |G|^2 of each variance, the quadratic form G of the errors.

    With white errors, G_bc = [b = c] |g_b|^2 - m_b . m_c for blocks b and c: g_b is what the block's errors are
    multiplied by (squared lengths `lengths`, shape (blocks, asked)), m_b its image under the estimate (`images`, shape
    (blocks, base, asked)). `combinations` are parameters or combinations of them.
    """
    own = np.sum(images**2, axis=1)
    trace = np.sum(lengths - own, axis=0)
    products = np.einsum("bik,bjk->kij", images, images, optimize=True)
    squares = np.sum(lengths**2 - 2.0 * lengths * own, axis=0) + np.sum(products**2, axis=(1, 2))
    found = np.maximum(trace, 0.0) ** 2 / np.maximum(squares, np.finfo(float).tiny)
    return np.asarray(np.minimum(found, _MOST_DEGREES))


def block_covariance(equations: Equations, fit: LeastSquares) -> Array:
    """Return the covariance of an estimate from blocks of time, shape (base, base); infinite where unseen."""
    return uncertainty(equations, fit).covariance


def negligible(information: Information) -> Array:
    """Return the size [SI] below which each parameter makes under a tenth of every joint's torque, shape (base,).

    A parameter of this size makes a tenth of the torque of some joint that feels it, and no more of any other's. So a
    deviation of a tenth of it, with which it is called identified, is a hundredth of the joint's torque.
    """
    size = np.full(information.base, np.inf)
    torques = np.sqrt(information.squared_torques())
    for torque, support, factor in zip(torques, information.supports, information.factors, strict=True):
        columns = np.linalg.norm(factor[:, :-1], axis=0)
        felt = columns > 0.0
        size[support[felt]] = np.minimum(size[support[felt]], NEGLIGIBLE_TORQUE * torque / columns[felt])
    return size


def verdicts(beta: Array, deviations: Array, negligible_sizes: Array) -> tuple[Verdict, ...]:
    """Return per parameter `identified`, `weak` or `unidentified`, by its deviation relative to its size.

    Its size counts as at least what is as good as zero.

    Args:
        beta: parameters, shape (base,).
        deviations: standard deviations of the parameters, shape (base,).
        negligible_sizes: sizes below which parameters are as good as zero, shape (base,), see `negligible`.
    """
    return tuple(
        "identified" if share < IDENTIFIED_BELOW else "weak" if share < WEAK_BELOW else "unidentified"
        for share in relative_deviations(beta, deviations, negligible_sizes)
    )


def relative_deviations(beta: Array, deviations: Array, negligible_sizes: Array) -> Array:
    """Return each deviation over the larger of the parameter's magnitude and negligible size; infinite where unseen."""
    sizes = np.maximum(np.maximum(np.abs(beta), negligible_sizes), np.finfo(float).tiny)
    # Parameters that no joint feels have infinite negligible sizes.
    return np.where(np.isfinite(deviations), deviations, np.inf) / np.where(np.isfinite(sizes), sizes, 1.0)
