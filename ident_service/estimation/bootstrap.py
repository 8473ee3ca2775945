"""Estimate the uncertainty of estimates that are not linear in the torques, by a moving-block bootstrap.

A feasible set bends the estimate where it binds, and no formula as eq. 81 follows it there. So runs of consecutive
blocks of about a second are drawn with replacement (Kunsch 1989; wrapped around the end, Politis and Romano 1992) and
the whole estimate is computed again from each draw. Nothing is read twice: factors add, so a draw is a QR of the
factors of the blocks that it contains, each times the root of how often it was drawn.

Where the true parameters lie on the boundary of the set itself, no bootstrap of this kind converges to their
distribution (Andrews 2000): there it indicates, and intervals by percentiles at least stay inside the set's bounds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ident_service.errors import ModelError, SolverError
from ident_service.estimation.equations import Equations
from ident_service.estimation.feasible.feasible_set import FeasibleSet
from ident_service.estimation.feasible.priors import Prior
from ident_service.estimation.feasible.problems import ENOUGH, constrained_least_squares
from ident_service.estimation.least_squares import LeastSquares, ordinary_least_squares
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.blas_threads import one_blas_thread
from ident_service.model.chain import Array
from ident_service.model.information import Information, triangle

_MANY = 40

Solve = Callable[[LeastSquares], Array]
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Bootstrap:
    """Scatter of an estimate over resampled recordings.

    Attributes:
        betas: the estimate of each replicate in SI units, shape (replicates, base).
        mean: mean of the replicates, shape (base,).
        covariance: covariance of the replicates, shape (base, base); infinite on the diagonal where a replicate's data
            are blind.
        standard_deviations: square roots of the covariance's diagonal, shape (base,).
        intervals: lower and upper percentile, shape (base, 2); infinite where blind.
        level: share of the replicates inside each interval.
        run: number of consecutive blocks drawn together.
        blocks: number of blocks drawn from.
        seed: of the draws.
    """

    betas: Array
    mean: Array
    covariance: Array
    standard_deviations: Array
    intervals: Array
    level: float
    run: int
    blocks: int
    seed: int

    def __post_init__(self) -> None:
        for array in (self.betas, self.mean, self.covariance, self.standard_deviations, self.intervals):
            array.setflags(write=False)


@one_blas_thread()
def bootstrap(
    equations: Equations,
    fit: LeastSquares,
    base: BaseParameters,
    conditions: FeasibleSet,
    replicates: int = 100,
    seed: int = 0,
    solve: Solve | None = None,
    *,
    prior: Prior | None = None,
    blocks_per_run: int | None = None,
    level: float = 0.95,
    progress: Progress = lambda _done, _all: None,
) -> Bootstrap:
    """Repeat the constrained estimate, or `solve`, on resampled blocks; return its covariance and percentile intervals.

    Args:
        equations: equations that `fit` solves, in blocks of time.
        fit: least squares whose weights per joint every replicate uses.
        base: grouping of the parameters.
        conditions: the feasible set.
        replicates: number of resampled recordings; at least 2.
        seed: of the draws; the same seed gives the same replicates.
        solve: function from a replicate's least squares to base parameters of shape (base,); the constrained least
            squares (eq. 74) over `conditions` when None.
        prior: prior that replicates are drawn to without `solve`; None for none.
        blocks_per_run: consecutive blocks drawn together; `run_length` says how many when None.
        level: share of the replicates inside the intervals, between 0 and 1.
        progress: called after each replicate with how many are done, and how many there will be.

    Raises:
        ModelError: fewer than two blocks or replicates, a run longer than the recording, a level outside (0, 1), or a
            `solve` that returns another shape.
        SolverError: the solver stopped without an optimum; its problem names the replicate. None is left out, because
            the hard ones are not like the others.
    """
    count = len(equations.blocks)
    if count < 2 or replicates < 2:
        raise ModelError(f"{count} blocks and {replicates} replicates; a bootstrap needs two of each, and better many")
    length = run_length(equations, fit) if blocks_per_run is None else blocks_per_run
    if not 1 <= length <= count or not 0.0 < level < 1.0:
        raise ModelError(f"runs of {length} blocks out of {count}, intervals at {level:g}: not possible")
    factors = np.array([block.stacked(fit.weights) for block in equations.blocks])
    rows = np.array([block.rows.sum() for block in equations.blocks])
    rng = np.random.default_rng(seed)
    betas = np.empty((replicates, base.size))
    blind = ~np.isfinite(fit.standard_deviations)
    for number in range(replicates):
        times = block_resample_counts(rng, count, length)
        least = _least_squares(factors, rows, times, fit)
        blind |= ~np.isfinite(least.standard_deviations)
        try:
            beta = constrained_least_squares(least, base, conditions, prior).beta if solve is None else solve(least)
        except SolverError as error:
            raise SolverError(f"replicate {number + 1} of {replicates}, {error.problem}", error.status) from error
        if beta.shape != (base.size,):
            raise ModelError(f"{beta.shape=} but there are {base.size} base parameters")
        betas[number] = beta
        progress(number + 1, replicates)
    covariance = np.atleast_2d(np.cov(betas, rowvar=False))
    covariance[blind, blind] = np.inf
    intervals = np.quantile(betas, [0.5 - 0.5 * level, 0.5 + 0.5 * level], axis=0).T
    intervals[blind] = [-np.inf, np.inf]
    deviations = np.sqrt(np.diag(covariance))
    return Bootstrap(betas, betas.mean(axis=0), covariance, deviations, intervals, level, length, count, seed)


@one_blas_thread()
def constrained_intervals(
    fit: LeastSquares,
    covariance: Array,
    beta: Array,
    base: BaseParameters,
    conditions: FeasibleSet,
    prior: Prior | None = None,
) -> Array:
    """Return 95 % intervals of a constrained estimate from a parametric bootstrap, shape (base, 2).

    Unconstrained estimates are drawn around the constrained one with the covariance of the unconstrained, and each is
    constrained again. There are 40 replicates, or 20 where base parameters are many, so that it takes a fraction of a
    second. Each side of an interval is therefore Student's t times the deviation of the replicates on that side: a side
    that a condition cuts off has none.

    Args:
        fit: unconstrained least squares.
        covariance: covariance of `fit.beta`, shape (base, base); infinite on the diagonal for what is not seen.
        beta: the constrained estimate, shape (base,).
        base: grouping of the parameters.
        conditions: the feasible set.
        prior: prior that the estimate is drawn to; None for none.

    Returns:
        Lower and upper end, shape (base, 2); infinite for what is not seen.

    Raises:
        SolverError: the solver stopped without an optimum.
    """
    from scipy.special import stdtrit

    seen = np.isfinite(np.diag(covariance))
    known = np.where(np.outer(seen, seen), covariance, 0.0)
    scale = np.sqrt(np.where(np.diag(known) > 0.0, np.diag(known), 1.0))
    values, V = np.linalg.eigh(known / np.outer(scale, scale))
    root = scale[:, None] * V * np.sqrt(np.maximum(values, 0.0))
    count = 40 if base.size <= _MANY else 20
    rng = np.random.default_rng(0)
    found = np.empty((count, base.size))
    for number in range(count):
        other = beta + root @ rng.normal(size=base.size)
        found[number] = constrained_least_squares(
            replace(fit, beta=other, rho1=fit.R1 @ other), base, conditions, prior, first_tolerance=ENOUGH
        ).beta
    apart = found - beta
    sides = [np.sqrt(2.0 * np.mean(part**2, axis=0)) for part in (np.minimum(apart, 0.0), np.maximum(apart, 0.0))]
    wide = stdtrit(count - 1, 0.975)
    ends = np.column_stack([beta - wide * sides[0], beta + wide * sides[1]])
    return np.where(seen[:, None], ends, [-np.inf, np.inf])


def block_resample_counts(rng: np.random.Generator, block_count: int, blocks_per_run: int) -> NDArray[np.int64]:
    """Draw `block_count` blocks in random runs of `blocks_per_run`; return how often each was drawn, (blocks,)."""
    starts = rng.integers(0, block_count, size=-(-block_count // blocks_per_run))
    chosen = ((starts[:, None] + np.arange(blocks_per_run)) % block_count).ravel()[:block_count]
    return np.bincount(chosen, minlength=block_count)


def _least_squares(
    factors: Array, rows: NDArray[np.int64], times: NDArray[np.int64], fit: LeastSquares
) -> LeastSquares:
    present = np.flatnonzero(times)
    stacked = (np.sqrt(times[present])[:, None, None] * factors[present]).reshape(-1, factors.shape[2])
    size = factors.shape[2] - 1
    # The joints' weights are in the factors already, so that all joints together count as one.
    whole = Information((np.arange(size),), (triangle(stacked),), np.array([rows @ times]), size)
    return replace(ordinary_least_squares(whole), weights=fit.weights)


def run_length(equations: Equations, fit: LeastSquares) -> int:
    """Return how many consecutive blocks to draw together, from their autocorrelation (Politis and White); at least 1.

    The rule of Politis and White (2004, corrected by Patton, Politis and White 2009) for the circular block bootstrap,
    from the autocorrelation of what each block adds to the estimate, pooled over the parameters.

    Args:
        equations: equations that `fit` solves.
        fit: the estimate.
    """
    count = len(equations.blocks)
    bread = fit.inverse @ fit.inverse.T
    influence = np.array([bread @ block.scores(fit.beta, fit.weights) for block in equations.blocks])
    sizes = np.linalg.norm(influence, axis=0)
    influence = influence / np.where(sizes > 0.0, sizes, 1.0)
    spread = float(np.sum(influence**2))
    longest = count // 3
    if longest < 2 or spread == 0.0:
        return 1
    lags = np.arange(1, longest)
    correlation = np.array([np.sum(influence[lag:] * influence[:-lag]) for lag in lags]) / spread
    patience = max(5, int(np.sqrt(np.log10(count))))
    quiet = np.abs(correlation) < 2.0 * np.sqrt(np.log10(count) / count)
    settled = [m for m in range(len(lags)) if quiet[m : m + patience].all()]
    memory = 2 * (settled[0] if settled else len(lags))
    taper = np.clip(2.0 * (1.0 - lags / max(memory, 1)), 0.0, 1.0)
    G = 2.0 * float(np.sum(taper * lags * correlation))
    g0 = 1.0 + 2.0 * float(np.sum(taper * correlation))
    if g0 <= 0.0:
        return 1
    wanted = (1.5 * (G / g0) ** 2 * count) ** (1.0 / 3.0)
    return int(np.clip(np.ceil(wanted), 1, longest))
