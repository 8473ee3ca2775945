"""Detect contacts of the arm in one posture, within a control cycle: with itself, obstacles, the allowed box.

The exact distances of `collision.py`, of which all is computed but only the smallest is read while nothing touches.
Up to `AT_ONCE` pairs of solids are looked at in every cycle; more of them in turn, so that of up to 400 pairs each is
looked at at least every 10 cycles. Between capsules, and of anything to a plane, a pair takes less than 0.1 us; of
boxes and cylinders a few.

`scene.py` defines the pairs.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import Array
from ident_service.model.collision import geometry, kinematics
from ident_service.model.scene import scene

AT_ONCE = 40


class Contact:
    """Contact check of the pairs of solids of an arm that must stay apart.

    Attributes:
        pairs: readable names of their owners, one per pair of solids.
    """

    def __init__(self, model: ArmModel) -> None:
        """Collect the pairs of solids.

        Args:
            model: with geometry and workspace; without any, there are no pairs.

        Raises:
            ModelError: geometry that does not fit the arm.
            MotionRefused: surroundings, but no body that could touch them.
        """
        around = scene(model)
        named = [(name, pair) for name, pairs in zip(around.pairs, around.contacts, strict=True) for pair in pairs]
        self.pairs = tuple(name for name, _ in named)
        self._model = kinematics(around.chain)
        self._data = self._model.createData()
        self._turns = max(1, -(-len(named) // AT_ONCE))
        self._groups = []
        for turn in range(self._turns):
            solids, found = geometry(around, [pair for _, pair in named[turn :: self._turns]])
            self._groups.append((solids, found, slice(turn, None, self._turns)))
        self._turn = 0
        self._clear = np.full(len(named), -np.inf)
        self._clear.setflags(write=False)

    def depths(self, position: Array) -> Array:
        """Return the penetration depth of each pair of solids that is checked in this call.

        Args:
            position: [rad or m], shape (joints,).

        Returns:
            [m], shape (len(pairs),); positive where they overlap, infinite where that cannot be told; minus infinity
            for pairs whose turn it is not, and for all while nothing touches.
        """
        if not self.pairs:
            return self._clear
        solids, found, rows = self._groups[self._turn]
        self._turn = (self._turn + 1) % self._turns
        nearest = pin.computeDistances(self._model, self._data, solids, found, position)
        # If all distances are NaN, there is no nearest pair.
        if nearest < len(solids.collisionPairs) and found.distanceResults[nearest].min_distance >= 0.0:
            return self._clear
        depths = self._clear.copy()
        distances = np.array([result.min_distance for result in found.distanceResults])
        depths[rows] = np.where(np.isnan(distances), np.inf, -distances)
        return depths
