"""Compute accelerations from torques, `y = M(q)^-1 d`, at many postures, with derivatives of functions of them.

With `lambda = M^-1 s` for seeds s, the gradient of `sum(s y)` is `-lambda' d(M y)/dq` over position and lambda over
torque; `M y` is the torque of the acceleration y from rest without gravity, traced once per arm.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ident_service.errors import ModelError
from ident_service.model.chain import Array, Chain
from ident_service.model.parameter_layout import Layout
from ident_service.model.pinocchio_models import ForwardDynamics
from ident_service.model.regressor import traced_rigid_torque
from ident_service.model.symbolic import Differentiable, ExpressionGraph


class InertiaResponse:
    """Accelerations that torques cause in an arm with known parameters, run forwards and backwards."""

    def __init__(self, chain: Chain, layout: Layout, delta: Array) -> None:
        """Trace the dynamics for link parameters `delta` [SI], shape (layout.size,).

        Raises:
            ModelError: a link without positive mass.
        """
        n = chain.joints
        tape = ExpressionGraph()
        q, y = [tape.input() for _ in range(n)], [tape.input() for _ in range(n)]
        torque = traced_rigid_torque(tape, replace(chain, gravity=np.zeros(3)), layout, delta, q, [0.0] * n, list(y))
        self._torque = Differentiable(tape, q, torque)
        self._dynamics = ForwardDynamics(chain, layout, delta)
        self._position = self._M = self._response = np.zeros((0, n))

    def run(self, position: Array, torque: Array) -> Array:
        """Return the accelerations [rad/s^2 or m/s^2], shape (samples, joints).

        Args:
            position: [rad or m], shape (samples, joints).
            torque: [N m or N], shape (samples, joints).

        Raises:
            ModelError: the mass matrix is singular: no real body has these parameters.
        """
        self._position = position
        self._M = self._dynamics.mass_matrices(position)
        self._response = self._solved(torque)
        return self._response

    def pull(self, seeds: Array) -> tuple[Array, Array]:
        """Return the gradient of `sum(seeds * run(...))` at the last run's states.

        Args:
            seeds: shape (samples, joints).

        Returns:
            Derivatives with respect to position and torque, each of shape (samples, joints).
        """
        multipliers = self._solved(seeds)
        self._torque.run(np.concatenate([self._position.T, self._response.T]))
        return -self._torque.pull(np.ascontiguousarray(multipliers.T)).T, multipliers

    def _solved(self, right: Array) -> Array:
        try:
            return np.asarray(np.linalg.solve(self._M, right[..., None])[..., 0])
        except np.linalg.LinAlgError:
            raise ModelError("the mass matrix is singular: no real body has these parameters") from None
