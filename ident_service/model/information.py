"""Accumulate the information of equations on the base parameters: per joint, the R of `[H_b | tau]` (eqs. 64-70).

Two factors merge by a QR of the two stacked, so information of blocks, logs and arms adds up in any order, and joints
can be weighted afterwards. Columns that a joint cannot feel (links nearer the base) are left out of its factor.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident_service.errors import ModelError
from ident_service.model.chain import Array, Chain
from ident_service.model.parameter_layout import INERTIAL, Layout

_PANEL = 8  # columns that are eliminated at once


@dataclass(frozen=True)
class Information:
    """Information of equations: one triangular factor per joint.

    Attributes:
        supports: per joint, which base parameters it feels, increasing.
        factors: per joint, upper triangular R of `[H_b[:, support] | tau]`, shape (rows <= k + 1, k + 1).
        rows: equations that went into each factor, shape (joints,).
        base: number of base parameters.
    """

    supports: tuple[NDArray[np.intp], ...]
    factors: tuple[Array, ...]
    rows: NDArray[np.int64]
    base: int

    def __post_init__(self) -> None:
        for array in (*self.factors, self.rows):
            array.setflags(write=False)

    @property
    def joints(self) -> int:
        """Return the number of joints."""
        return len(self.factors)

    def merged(self, other: Information) -> Information:
        """Return the information of both sets of equations together; raises ModelError if their sizes differ.

        Raises:
            ModelError: they have other numbers of base parameters or joints.
        """
        self.require_same(other)
        factors = tuple(_stacked(pair) for pair in zip(self.factors, other.factors, strict=True))
        return Information(self.supports, factors, self.rows + other.rows, self.base)

    @staticmethod
    def sum(parts: Iterable[Information]) -> Information:
        """Merge any number of sets of equations, at least one, into one; raises ModelError if their sizes differ.

        Raises:
            ModelError: they have other numbers of base parameters or joints.
        """
        every = tuple(parts)
        first = every[0]
        if len(every) == 1:
            return first
        for other in every[1:]:
            first.require_same(other)
        factors = tuple(_stacked([part.factors[joint] for part in every]) for joint in range(first.joints))
        rows = np.sum([part.rows for part in every], axis=0)
        return Information(first.supports, factors, rows, first.base)

    def require_same(self, other: Information) -> None:
        """Raise ModelError unless the other has as many base parameters and joints.

        Raises:
            ModelError: it has other numbers of them.
        """
        if self.base != other.base or self.joints != other.joints:
            raise ModelError(
                f"{self.base} base parameters of {self.joints} joints against {other.base} of {other.joints}"
            )

    def stacked(self, weights: Array | None = None) -> Array:
        """Return the triangular factor of all joints' equations together, `[R1 rho1; 0 |rho2|]` of eqs. 64-70.

        Args:
            weights: per joint, what its equations are multiplied by, shape (joints,); ones when None.

        Returns:
            Upper triangular, shape (base + 1, base + 1); rows and columns of parameters that nothing sees are zero.
        """
        rows = []
        for joint, (support, factor) in enumerate(zip(self.supports, self.factors, strict=True)):
            full = np.zeros((factor.shape[0], self.base + 1))
            full[:, support] = factor[:, :-1]
            full[:, -1] = factor[:, -1]
            rows.append(full if weights is None else weights[joint] * full)
        every = np.vstack(rows)
        # A column of zeros would leave it to rounding which rows are mixed.
        seen = np.append(np.flatnonzero(every[:, :-1].any(axis=0)), self.base)
        R = triangle(every[:, seen])
        whole = np.zeros((self.base + 1, self.base + 1))
        whole[seen[: len(R), None], seen] = R
        return whole

    def squared_residuals(self, beta: Array) -> Array:
        """Return per joint the sum of squared torque errors of base parameters `beta` [N^2 m^2 or N^2], (joints,)."""
        errors = [
            factor[:, -1] - factor[:, :-1] @ beta[support]
            for support, factor in zip(self.supports, self.factors, strict=True)
        ]
        return np.array([float(error @ error) for error in errors])

    def times(self, weights: Array) -> Information:
        """Return a copy with each joint's equations multiplied by `weights`, shape (joints,)."""
        factors = tuple(weight * factor for weight, factor in zip(weights, self.factors, strict=True))
        return Information(self.supports, factors, self.rows.copy(), self.base)

    def with_torques_times(self, factors: Array) -> Information:
        """Return a copy with each joint's torque multiplied by `factors`, shape (joints,)."""
        triangles = []
        for factor, triangle_of_joint in zip(factors, self.factors, strict=True):
            scaled = triangle_of_joint.copy()
            scaled[:, -1] *= factor
            triangles.append(scaled)
        return Information(self.supports, tuple(triangles), self.rows.copy(), self.base)

    def squared_torques(self) -> Array:
        """Return per joint the sum of squared torques [N^2 m^2 or N^2], shape (joints,)."""
        return np.array([float(factor[:, -1] @ factor[:, -1]) for factor in self.factors])

    def scores(self, beta: Array, weights: Array | None = None) -> Array:
        """Return the negative gradient of half the squared residual at base parameters `beta`, `W^T (omega - W beta)`.

        Args:
            beta: base parameters, shape (base,).
            weights: per joint, what its equations are multiplied by, shape (joints,); ones when None.
        """
        total = np.zeros(self.base)
        for joint, (support, factor) in enumerate(zip(self.supports, self.factors, strict=True)):
            score = factor[:, :-1].T @ (factor[:, -1] - factor[:, :-1] @ beta[support])
            total[support] += score if weights is None else weights[joint] ** 2 * score
        return total


def _stacked(factors: Sequence[Array]) -> Array:
    """R of triangular factors together; most stretches have no rows near standstill, and none cost nothing."""
    some = [factor for factor in factors if len(factor)] or factors[:1]
    return some[0] if len(some) == 1 else triangle(np.vstack(some))


def triangle(rows: Array) -> Array:
    """Return the triangular factor R of a QR decomposition of `rows`; its rows have arbitrary signs."""
    count, size = rows.shape
    if count < size:
        return np.asarray(np.linalg.qr(rows, mode="r"))
    from scipy.linalg.lapack import dtpqrt  # loads for 0.2 s, as in `zero_phase.py`

    # Rows are merged into a triangle of zeros: unlike LAPACK's plain QR, it works in blocks on narrow matrices, too,
    # which takes a quarter of the time for thousands of rows.
    R, *_ = dtpqrt(0, min(_PANEL, size), np.zeros((size, size), order="F"), rows)
    return np.asarray(R)


def sparsity(chain: Chain, layout: Layout, base_columns: NDArray[np.intp]) -> tuple[NDArray[np.intp], ...]:
    """Return per joint the indices of the base parameters that its torque can depend on, increasing.

    They are those of the links that it carries, and the joint terms of the drives that move it.
    """
    links = base_columns // layout.per_link
    own_term = base_columns % layout.per_link >= len(INERTIAL)
    felt = []
    for joint in range(chain.joints):
        carried = np.array([joint in chain.ancestors(int(link)) for link in links])
        felt.append(np.flatnonzero(np.where(own_term, chain.coupling[links, joint] != 0.0, carried)))
    return tuple(felt)


def empty_information(joint_supports: tuple[NDArray[np.intp], ...], base_count: int) -> Information:
    """Return information of `base_count` base parameters that holds no equations, to merge others into."""
    factors = tuple(np.zeros((0, len(support) + 1)) for support in joint_supports)
    return Information(joint_supports, factors, np.zeros(len(joint_supports), dtype=np.int64), base_count)


def information_of(
    H_b: Array,
    torque: Array,
    equation_mask: NDArray[np.bool_],
    joint_supports: tuple[NDArray[np.intp], ...],
    row_weights: Array | None = None,
) -> Information:
    """Compress the equations of a block of samples into a triangle per joint.

    Args:
        H_b: base regressor, shape (joints, base, samples).
        torque: [N m or N], shape (samples, joints).
        equation_mask: mask of the equations that count, shape (samples, joints).
        joint_supports: result of `sparsity`.
        row_weights: factors of the equations, shape (samples, joints); ones when None.
    """
    factors = []
    for joint, support in enumerate(joint_supports):
        mask = equation_mask[:, joint]
        rows = np.empty((int(mask.sum()), len(support) + 1), order="F")
        rows[:, :-1] = H_b[joint, support].T[mask]
        rows[:, -1] = torque[mask, joint]
        if row_weights is not None:
            rows *= row_weights[mask, joint][:, None]
        factors.append(triangle(rows) if len(rows) else rows)
    return Information(joint_supports, tuple(factors), equation_mask.sum(axis=0).astype(np.int64), H_b.shape[1])
