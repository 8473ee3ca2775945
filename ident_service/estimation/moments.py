"""Solve least squares from products of columns, for comparing many trials of the same motion.

Products lose half the digits of orthogonal factors, and cost a tenth. Which trial leaves the smaller residual is the
same; estimates themselves come from factors (`least_squares.py`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident_service.model.chain import Array

_LEAST_COLUMN = 1e-14  # share of the longest column's length; a shorter column is rounding
_RIDGE = 1e-12  # share of a column's squared length: collinear columns then share what they explain
_SETTLED = 1e-6  # relative change of a weight
_MOST_ROUNDS = 100


@dataclass(frozen=True)
class Moments:
    """Products of the equations' columns, from which least squares can be solved.

    Attributes:
        supports: per joint, which base parameters it feels, increasing.
        products: per joint, `[H_b | tau]^T [H_b | tau]` of its support, shape (k + 1, k + 1).
        rows: equations of each joint, shape (joints,).
        base: number of base parameters.
    """

    supports: tuple[NDArray[np.intp], ...]
    products: tuple[Array, ...]
    rows: NDArray[np.int64]
    base: int

    def solved(self, weights: Array) -> Array:
        """Return the least-squares estimate, each joint's equations multiplied by its weight; shape (base,)."""
        return ridge(*self._normal(weights))

    def estimate(self) -> tuple[Array, Array]:
        """Return the least-squares estimate and its deviations (eq. 81), shape (base,) each."""
        total, right = self._normal(np.ones(len(self.products)))
        beta = ridge(total, right)
        variance = float(self.squared_residuals(beta).sum()) / max(int(self.rows.sum()) - self.base, 1)
        inverse = ridge(total, np.eye(self.base))
        variances = np.where(np.diag(inverse) > 0.0, variance * np.diag(inverse), np.inf)
        return beta, np.sqrt(variances)

    def _normal(self, weights: Array) -> tuple[Array, Array]:
        total, right = np.zeros((self.base, self.base)), np.zeros(self.base)
        for support, product, weight in zip(self.supports, self.products, weights, strict=True):
            total[support[:, None], support] += weight**2 * product[:-1, :-1]
            right[support] += weight**2 * product[:-1, -1]
        return total, right

    def weights(self) -> Array:
        """Return the factors of the joints' equations that make their residuals alike, shape (joints,)."""
        torques = np.array([product[-1, -1] for product in self.products])
        floor = 1e-9 * np.sqrt(torques / np.maximum(self.rows, 1))
        weights = np.ones(len(self.products))
        for _ in range(_MOST_ROUNDS):
            left = np.sqrt(self.squared_residuals(self.solved(weights)) / np.maximum(self.rows, 1))
            deviations = np.maximum(left, np.maximum(floor, np.finfo(float).tiny))
            before, weights = weights, np.exp(np.mean(np.log(deviations))) / deviations
            if np.all(np.abs(weights - before) <= _SETTLED * weights):
                break
        return weights

    def squared_residuals(self, beta: Array) -> Array:
        """Return per joint the sum of squared torque errors of `beta` [N^2 m^2 or N^2], shape (joints,)."""
        tried = [np.append(-beta[support], 1.0) for support in self.supports]
        found = [one @ product @ one for one, product in zip(tried, self.products, strict=True)]
        return np.maximum(found, 0.0)


def ridge(products: Array, right: Array) -> Array:
    """Solve normal equations by ridge regression: columns may be alike, unseen ones get zero.

    Args:
        products: of the columns, shape (columns, columns).
        right: their products with what is to be explained, shape (columns,) or (columns, cases).
    """
    sizes = np.diag(products)
    seen = sizes > _LEAST_COLUMN**2 * sizes.max(initial=0.0)
    unit = np.sqrt(np.where(seen, sizes, np.inf))
    scaled = products / np.outer(unit, unit)
    np.fill_diagonal(scaled, 1.0 + _RIDGE)
    return np.asarray((np.linalg.solve(scaled, (right.T / unit).T).T / unit).T)
