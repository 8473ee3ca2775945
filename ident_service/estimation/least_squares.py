"""Solve least squares from triangular factors, or from products of columns to compare many trials.

Ordinary least squares gives every joint's equations the same weight; weighted least squares divides them by the joint's
own residual (Gautier 1997), which needs no second look at the data, because factors are kept per joint.

Products lose half the digits of orthogonal factors, and cost a tenth. Which trial leaves the smaller residual is the
same; estimates themselves come from factors.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ident_service.errors import ModelError
from ident_service.model.chain import Array
from ident_service.model.information import Information

RANK_TOLERANCE = 1e-10
_SURELY_REGULAR = 1e-2 / RANK_TOLERANCE  # a bound of the condition number below which every direction is seen
_LEAST_COLUMN = 1e-14  # share of the longest column's length; a shorter column is rounding
_SETTLED = 1e-9
_START_DECIMALS = 5  # of the weights' logarithms; products settle to a tenth of that
_MOST_ROUNDS = 500


@dataclass(frozen=True)
class LeastSquares:
    """Unconstrained least-squares estimate with its factors.

    Attributes:
        beta: estimate in SI units, shape (base,); zero along directions that the data do not see.
        R1: triangular factor of W (eq. 64), shape (base, base).
        rho1: transformed torques (eq. 67), shape (base,).
        rho2: norm of what no beta explains, |rho_2| of eq. 70.
        inverse: pseudo-inverse of R1, shape (base, base).
        rank: of W.
        standard_deviations: eq. 81, which takes residuals for white, shape (base,); infinite where W is blind.
        weights: per joint, what its equations were multiplied by, shape (joints,).
    """

    beta: Array
    R1: Array
    rho1: Array
    rho2: float
    inverse: Array
    rank: int
    standard_deviations: Array
    weights: Array

    @cached_property
    def condition_number(self) -> float:
        """Return the condition number of the regressor W (2-norm, SI units); infinite when W has not full rank."""
        return float(np.linalg.cond(self.R1)) if self.rank == len(self.beta) else float("inf")


def weighted_least_squares(information: Information) -> LeastSquares:
    """Solve least squares with each joint divided by its residual's deviation, until weights settle, else ModelError.

    Raises:
        ModelError: the weights do not settle, which means that some joint's residual vanishes.
    """
    products = tuple(factor.T @ factor for factor in information.factors)
    near = Moments(information.supports, products, information.rows, information.base).weights()
    # Rounded, so that rounds begin at the same weights, and end at them, whatever a processor made of the products.
    weights = np.exp(np.round(np.log(near), _START_DECIMALS))
    floor = residual_deviation_floors(information)
    for _ in range(_MOST_ROUNDS):
        beta = _solution(information, weights).beta
        degrees = _degrees(information)
        deviations = np.maximum(np.sqrt(information.squared_residuals(beta) / degrees), floor)
        # Relative to their mean, so that R1, rho1 and the residual keep the size of torques.
        before, weights = weights, np.exp(np.mean(np.log(deviations))) / deviations
        if np.all(np.abs(weights - before) <= _SETTLED * weights):
            return ordinary_least_squares(information, weights)
    raise ModelError(f"the weights of the joints do not converge in {_MOST_ROUNDS} rounds: {weights}")


def _degrees(equations: Information | Moments) -> Array:
    """Return the equations of each joint less its part of the parameters, at least 1, shape (joints,)."""
    return np.asarray(np.maximum(equations.rows - equations.base / len(equations.rows), 1))


def residual_deviation_floors(equations: Information | Moments) -> Array:
    """Return the floor of each joint's residual deviation [N m or N], 1e-9 of its RMS torque, shape (joints,).

    A joint whose torque is always zero has those of the others.
    """
    torques = np.sqrt(equations.squared_torques() / np.maximum(equations.rows, 1))
    return np.asarray(1e-9 * np.where(torques > 0.0, torques, torques.max(initial=0.0) or 1.0))


def ordinary_least_squares(information: Information, weights: Array | None = None) -> LeastSquares:
    """Minimise |omega - W beta| (eq. 60); return the estimate with its triangular factors and standard deviations.

    Args:
        information: the equations.
        weights: per joint, what its equations are multiplied by, shape (joints,); ones when None.
    """
    found = _solution(information, weights)
    R1, rho1, rho2 = found.stacked[:-1, :-1], found.stacked[:-1, -1], abs(float(found.stacked[-1, -1]))
    degrees = max(int(information.rows.sum()) - information.base, 1)
    squared = rho2**2 + float(np.sum((rho1 - R1 @ found.beta) ** 2))
    deviations = np.sqrt(squared / degrees) * np.linalg.norm(found.inverse, axis=1)
    return LeastSquares(
        beta=found.beta,
        R1=R1,
        rho1=rho1,
        rho2=rho2,
        inverse=found.inverse,
        rank=found.rank,
        standard_deviations=np.where(found.unseen, np.inf, deviations),
        weights=np.ones(information.joints) if weights is None else weights,
    )


@dataclass(frozen=True)
class _Solution:
    """Estimate, the stacked factor, its pseudo-inverse and rank, and which parameters no equation sees."""

    beta: Array
    stacked: Array
    inverse: Array
    rank: int
    unseen: NDArray[np.bool_]


def _solution(information: Information, weights: Array | None) -> _Solution:
    from scipy.linalg.lapack import dtrtri  # loads for 0.2 s, and a run without a target solves nothing

    stacked = information.stacked(weights)
    R1 = stacked[:-1, :-1]
    # Columns differ by orders of magnitude in SI units; rank is judged on unit columns.
    scale, seen = unit_columns(R1)
    unit = np.where(seen, R1, 0.0) / scale
    # A triangle's inverse takes a tenth of the time of singular values, and its norm bounds the condition number.
    inverse, singular = dtrtri(unit)
    if not singular and np.linalg.norm(unit) * np.linalg.norm(inverse) < _SURELY_REGULAR:
        inverse /= scale[:, None]
        return _Solution(inverse @ stacked[:-1, -1], stacked, inverse, len(scale), np.zeros(len(scale), dtype=np.bool_))
    U, s, Vt = np.linalg.svd(unit)
    rank = int(np.sum(s > RANK_TOLERANCE * s[0])) if s[0] > 0.0 else 0
    inverse = ((Vt[:rank].T / s[:rank]) @ U[:, :rank].T) / scale[:, None]
    unseen = np.linalg.norm(Vt[rank:], axis=0) > 1e-6
    return _Solution(inverse @ stacked[:-1, -1], stacked, inverse, rank, unseen)


def unit_columns(matrix: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the columns' lengths, 1 for columns that are only rounding, and a mask of the other columns.

    The Stribeck column of rows that are all fast underflows; divided by its length it would be rounding of unit length.
    """
    norms = np.linalg.norm(matrix, axis=0)
    seen = norms > _LEAST_COLUMN * norms.max(initial=0.0)
    return np.where(seen, norms, 1.0), seen


@dataclass(frozen=True)
class TorqueError:
    """Torque prediction error: eq. 84 in percent, and root mean square [N m or N]; whole and per joint."""

    relative_percent: float
    rms: float
    joint_relative_percent: Array
    joint_rms: Array


def torque_error(information: Information, beta: Array) -> TorqueError:
    """Return relative [percent] and RMS torque errors of `beta` on these equations, for all joints and for each."""
    errors, torques = information.squared_residuals(beta), information.squared_torques()
    rows = np.maximum(information.rows, 1)
    return TorqueError(
        relative_percent=100.0 * float(np.sqrt(errors.sum() / torques.sum())),
        rms=float(np.sqrt(errors.sum() / rows.sum())),
        joint_relative_percent=100.0 * np.sqrt(errors / np.where(torques > 0.0, torques, np.inf)),
        joint_rms=np.sqrt(errors / rows),
    )


_RIDGE = 1e-12  # share of a column's squared length: collinear columns then share what they explain
_STEP_SETTLED = 1e-6  # relative change of a weight
_MOST_STEPS = 100


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
        """Return the least-squares base parameters, each joint's equations multiplied by its weight; shape (base,)."""
        return solve_with_ridge(*self._normal(weights))

    def estimate(self) -> tuple[Array, Array]:
        """Return the unweighted least-squares estimate and its standard deviations (eq. 81), shape (base,) each."""
        total, right = self._normal(np.ones(len(self.products)))
        beta = solve_with_ridge(total, right)
        variance = float(self.squared_residuals(beta).sum()) / max(int(self.rows.sum()) - self.base, 1)
        inverse = solve_with_ridge(total, np.eye(self.base))
        variances = np.where(np.diag(inverse) > 0.0, variance * np.diag(inverse), np.inf)
        return beta, np.sqrt(variances)

    @cached_property
    def _spread(self) -> Array:
        """Place the products among all parameters, once for many weights; shape (joints, base, base + 1)."""
        found = np.zeros((len(self.products), self.base, self.base + 1))
        for whole, support, product in zip(found, self.supports, self.products, strict=True):
            whole[support[:, None], np.append(support, self.base)] = product[:-1]
        return found

    def _normal(self, weights: Array) -> tuple[Array, Array]:
        total = np.zeros((self.base, self.base + 1))
        for whole, weight in zip(self._spread, weights, strict=True):
            total += weight**2 * whole
        return total[:, :-1], total[:, -1]

    def weights(self, start_weights: Array | None = None) -> Array:
        """Return the factors of the joints' equations that make their residuals equally large, shape (joints,).

        Args:
            start_weights: factors to begin with, such as those of other columns; ones when None.
        """
        floor = residual_deviation_floors(self)
        weights = np.ones(len(self.products)) if start_weights is None else start_weights
        for _ in range(_MOST_STEPS):
            left = np.sqrt(self.squared_residuals(self.solved(weights)) / _degrees(self))
            deviations = np.maximum(left, floor)
            before, weights = weights, np.exp(np.mean(np.log(deviations))) / deviations
            if np.all(np.abs(weights - before) <= _STEP_SETTLED * weights):
                break
        return weights

    def squared_torques(self) -> Array:
        """Return per joint the sum of squared torques [N^2 m^2 or N^2], shape (joints,)."""
        return np.array([float(product[-1, -1]) for product in self.products])

    def squared_residuals(self, beta: Array) -> Array:
        """Return per joint the sum of squared torque errors of `beta` [N^2 m^2 or N^2], shape (joints,)."""
        tried = [np.append(-beta[support], 1.0) for support in self.supports]
        found = [one @ product @ one for one, product in zip(tried, self.products, strict=True)]
        return np.maximum(found, 0.0)


def solve_with_ridge(products: Array, right_side: Array) -> Array:
    """Solve normal equations with a tiny ridge, so that equal columns share; columns of zeros get zero.

    Args:
        products: products of the columns with each other, shape (columns, columns).
        right_side: products of the columns with the right-hand sides, shape (columns,) or (columns, cases).
    """
    sizes = np.diag(products)
    seen = sizes > _LEAST_COLUMN**2 * sizes.max(initial=0.0)
    unit = np.sqrt(np.where(seen, sizes, np.inf))
    scaled = products / np.outer(unit, unit)
    np.fill_diagonal(scaled, 1.0 + _RIDGE)
    return np.asarray((np.linalg.solve(scaled, (right_side.T / unit).T).T / unit).T)
