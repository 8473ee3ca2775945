"""Compute the base regressor of many samples together with the derivatives of functions of it.

For a scalar function of H, `pull` turns its derivatives with respect to the entries of H into those with respect to
position, velocity, acceleration and direction: what a search for a motion needs. Exact, from the same traced formulas
as `regressor.py`, for about twice the time of H itself.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ident_service.model.adjoint import Differentiable
from ident_service.model.chain import Array, Chain
from ident_service.model.layout import Layout
from ident_service.model.regressor import entries_of, traced_regressor
from ident_service.model.tape import Symbol


class RegressorGradient:
    """Regressor of chosen columns, run forwards and backwards.

    Attributes:
        joints: number of joints.
        columns: number of chosen columns.
        supports: per joint, the columns that are not always zero, increasing.
    """

    def __init__(self, chain: Chain, layout: Layout, columns: Sequence[int] | NDArray[np.intp]) -> None:
        """Trace the formulas of `columns` of delta."""
        tape, entries = traced_regressor(chain, layout)
        kept = entries_of(entries, [int(column) for column in columns])
        inputs = [Symbol(tape, at) for at in range(4 * chain.joints)]
        self._program = Differentiable(tape, inputs, list(kept.values()))
        places = np.array(list(kept), dtype=np.intp).reshape(-1, 2)
        self._joint, self._column = places[:, 0], places[:, 1]
        self.joints, self.columns = chain.joints, len(columns)
        # Which columns each joint feels at all; the rest of its rows is zero.
        self.supports = [np.unique(self._column[self._joint == joint]) for joint in range(chain.joints)]
        self._H = np.zeros((0, 0, 0))

    def run(self, position: Array, velocity: Array, acceleration: Array, direction: Array) -> Array:
        """Return the rows of H.

        Args:
            position: [rad or m], shape (samples, joints).
            velocity: [rad/s or m/s], shape (samples, joints).
            acceleration: [rad/s^2 or m/s^2], shape (samples, joints).
            direction: what Coulomb friction is multiplied by, per drive, shape (samples, joints).

        Returns:
            H, shape (joints, columns, samples); the next run writes over it.

        Raises:
            ModelError: the arrays have the wrong shape.
        """
        values = self._program.run(np.concatenate([position.T, velocity.T, acceleration.T, direction.T]))
        shape = (self.joints, self.columns, values.shape[1])
        if self._H.shape != shape:
            self._H = np.zeros(shape)
        self._H[self._joint, self._column] = values
        return self._H

    def pull(self, seeds: Array) -> tuple[Array, Array, Array, Array]:
        """Return the gradient of `sum(seeds * H)` at the states of the last run.

        Args:
            seeds: shape (joints, columns, samples).

        Returns:
            Derivatives with respect to position, velocity, acceleration and direction, each (samples, joints).
        """
        gradient = self._program.pull(seeds[self._joint, self._column]).reshape(4, self.joints, -1)
        return gradient[0].T, gradient[1].T, gradient[2].T, gradient[3].T
