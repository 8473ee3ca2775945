"""Simulate the arm's body: rigid links, drive inertia, viscous and dry friction, stepped at a fixed period.

`M(q) ddq + c(q, dq) + g(q) + fo + fv dq + lambda = tau` with `lambda_i` in `fc_i Sgn(dq_i)` (eqs. 1, 27). One step
takes a constant torque (zero-order hold) and everything smooth at the predicted midpoint, viscous friction
implicitly, and dry friction at the end of the step (Moreau-Jean time stepping): second order where no joint changes
direction, and unconditionally sticking where one comes to rest::

    q_m = q + h/2 v,  v_m = v + h/2 a_previous
    (M(q_m) + h/2 fv) (v+ - v)/h = tau - c(q_m, v_m) - g(q_m) - fo - fv v - lambda,  lambda_i in fc_i Sgn(v+_i)
    q+ = q + h/2 (v + v+)

Drives that move several joints, `w = C v`, have their friction in their own coordinates, so that it is drives that
stick: `C^T (fo + fv w + lambda)` with `lambda_i` in `fc_i Sgn(w+_i)`, solved for `w+` with `C^-T M C^-1`.

Idle drives brake like more of `fv`, or, where a gear couples joints, like a symmetric damping matrix. A load is a point
mass that moves with the last link, on which it appears without an impact.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin

from ident_service.errors import DriverError, ModelError
from ident_service.model.chain import Array, Chain
from ident_service.model.layout import Layout
from ident_service.model.rigid_body import InverseDynamics, pinocchio_model
from sim_backend.friction import stick_slip_velocity

Load = tuple[float, tuple[float, float, float]]

_ROUNDING = 1e-12  # of the largest number in an inverse


class Plant:
    """Simulate a chain with true parameters, moved one period at a time by constant torques."""

    def __init__(self, chain: Chain, layout: Layout, delta: Array, position: Array, period: float) -> None:
        """Place the arm at rest at a position.

        Args:
            chain: the mechanism, gravity included.
            layout: order of the parameters.
            delta: true parameters [SI], shape (layout.size,).
            position: where it starts [rad or m], shape (joints,).
            period: time that `step` advances [s].

        Raises:
            ModelError: shapes that do not fit, a link without mass, negative friction, or a mass matrix that is not
                positive definite.
        """
        if position.shape != (chain.joints,):
            raise ModelError(f"{position.shape=} but the chain has {chain.joints} joints")
        self._chain, self._layout, self._delta = chain, layout, np.array(delta, dtype=float)
        self._period = self._stepped = period
        self._half = 0.5 * period
        self._viscous = layout.term_values("viscous", delta)
        self._coulomb = layout.term_values("coulomb", delta)
        coupling = chain.coupling
        self._offset = coupling.T @ layout.term_values("offset", delta)
        self._inverse_coupling: Array | None = None
        if not np.array_equal(coupling, np.eye(chain.joints)):
            inverse = np.linalg.inv(coupling)
            # Rounding would let a drive that sticks creep with one that it has nothing to do with.
            self._inverse_coupling = np.where(np.abs(inverse) > _ROUNDING * np.abs(inverse).max(), inverse, 0.0)
        if (self._viscous < 0.0).any() or (self._coulomb < 0.0).any():
            raise ModelError("negative friction would drive the arm; fv and fc must not be negative")
        self._braking = np.zeros(chain.joints)
        self._loads: tuple[Load, ...] = ()
        self._build(self._delta)
        # What a velocity times its old sign must exceed for a joint to go on sliding; frictionless joints always do.
        self._keeps_on = np.where(self._coulomb > 0.0, 0.0, -np.inf)
        self.place(position)
        if not np.linalg.eigvalsh(self._inverse.mass_matrix(self._position)).min() > 0.0:
            raise ModelError("the mass matrix is not positive definite: no real body has these parameters")

    @property
    def chain(self) -> Chain:
        """Return the mechanism."""
        return self._chain

    @property
    def period(self) -> float:
        """Return the time that `step` advances [s]."""
        return self._period

    @property
    def position(self) -> Array:
        """Return the position [rad or m], shape (joints,), read-only."""
        return self._position

    @property
    def velocity(self) -> Array:
        """[rad/s or m/s], shape (joints,), read-only; exactly 0 where a joint sticks with all drives that move it."""
        return self._velocity

    @property
    def acceleration(self) -> Array:
        """Return the mean acceleration over the last step [rad/s^2 or m/s^2], shape (joints,), read-only."""
        return self._acceleration

    @property
    def drive_velocity(self) -> Array:
        """Return the drives' velocities `C dq` [rad/s or m/s], shape (joints,), read-only; 0 where one sticks."""
        return self._rate

    @property
    def inertia(self) -> Array:
        """Return the inertia of each joint, all others held: the diagonal of M(q) [kg m^2 or kg], shape (joints,)."""
        return np.array(np.diag(self._inverse.mass_matrix(self._position)))

    def brake(self, damping: Array) -> None:
        """Add viscous friction to every step from now on.

        Args:
            damping: [N m s/rad or N s/m], shape (joints,), none negative; or, where drives move several joints each,
                a symmetric matrix that is nowhere negative, shape (joints, joints).
        """
        if damping is not self._braking:
            self._braking = damping
            self._damp()

    def rest(self) -> None:
        """Stop the arm where it is, as if somebody held it."""
        self.place(self._position)

    def place(self, position: Array) -> None:
        """Place the arm at rest at a position, as if somebody had led it there.

        Args:
            position: [rad or m], shape (joints,).
        """
        still = np.zeros(self._chain.joints)
        self._set(np.array(position, dtype=float), still, still, still)

    def load(self, loads: tuple[Load, ...]) -> None:
        """Attach point masses to the last link, in place of those attached before.

        Args:
            loads: mass [kg] and offset in the frame of the last link [m] of each.
        """
        if loads == self._loads:
            return
        delta = self._delta.copy()
        inertial = delta[self._layout.inertial(self._chain.joints - 1)]  # a view
        for mass, offset in loads:
            x, y, z = offset
            inertial[:6] += mass * np.array([y * y + z * z, -x * y, -x * z, x * x + z * z, -y * z, x * x + y * y])
            inertial[6:9] += mass * np.array(offset)
            inertial[9] += mass
        self._loads = loads
        self._build(delta)

    def step(self, torque: Array, period: float | None = None) -> None:
        """Advance under a constant torque.

        Args:
            torque: [N m or N], shape (joints,).
            period: time to advance [s]; None for `period`, to which the error of a step belongs: keep near or below it.

        Raises:
            DriverError: the state is no longer finite; it stays what it was before the step.
        """
        h = self._period if period is None else period
        if h != self._stepped:
            self._stepped, self._half = h, 0.5 * h
            self._damp()
        v = self._velocity
        sign = np.sign(v)
        q_m = self._position + self._half * v
        # A joint at rest is predicted to stay there: its last mean acceleration is the impact that stopped it.
        v_m = v + self._half * (self._acceleration * np.abs(sign))
        smooth = torque - self._offset - self._damping * v
        if self._coupled is not None:
            smooth = smooth - self._coupled @ v
        if self._matrix is None and self._inverse_coupling is None:
            a = pin.aba(self._model, self._data, q_m, v_m, smooth - self._coulomb * sign)
            v_next = v + h * a
            rate = v_next
            if not (v_next * sign > self._keeps_on).all():
                v_next, rate = self._stick_or_slip(q_m, v_m, smooth)
        else:
            v_next, rate = self._stick_or_slip(q_m, v_m, smooth)
        self._set(self._position + self._half * (v + v_next), v_next, (v_next - v) / h, rate)

    def inverse_dynamics(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """Return the torque that the true parameters need at one state, without noise: the truth to score against.

        Args:
            position: [rad or m], shape (joints,).
            velocity: [rad/s or m/s], shape (joints,); its sign, or that of the drives' velocity, is dry friction's,
                which counts as 0 at rest.
            acceleration: [rad/s^2 or m/s^2], shape (joints,).

        Returns:
            [N m or N], shape (joints,).
        """
        rate = self._chain.coupling @ velocity
        friction = self._chain.coupling.T @ (self._viscous * rate + self._coulomb * np.sign(rate)) + self._offset
        return np.asarray(self._inverse.torque(position, velocity, acceleration) + friction)

    def _build(self, delta: Array) -> None:
        chain, layout = self._chain, self._layout
        self._inverse = InverseDynamics(chain, layout, delta)
        coupling, drives = chain.coupling, layout.term_values("drive_inertia", delta)
        links = np.array(delta, dtype=float)
        links[layout.term_columns("drive_inertia")] = 0.0
        self._model = pinocchio_model(replace(chain, coupling=np.eye(chain.joints)), layout, links)
        self._data = self._model.createData()
        self._drive_matrix = coupling.T @ (drives[:, None] * coupling)
        self._damp()

    def _damp(self) -> None:
        # Implicit viscous friction acts like more drive inertia, so that it costs nothing to solve for.
        coupling = self._chain.coupling
        whole = coupling.T @ (self._viscous[:, None] * coupling)
        whole = whole + (self._braking if self._braking.ndim == 2 else np.diag(self._braking))
        self._damping = np.diag(whole).copy()
        # Between joints it does not, nor does drive inertia: pinocchio has an armature per joint only.
        damping = whole - np.diag(self._damping)
        inertia = self._drive_matrix - np.diag(np.diag(self._drive_matrix))
        self._coupled: Array | None = damping if damping.any() else None
        self._matrix: Array | None = inertia + self._half * damping if damping.any() or inertia.any() else None
        self._model.armature = np.diag(self._drive_matrix) + self._half * self._damping

    def _stick_or_slip(self, q_m: Array, v_m: Array, smooth: Array) -> tuple[Array, Array]:
        """Return the velocities of joints and drives at the end of the step."""
        A = np.array(pin.crba(self._model, self._data, q_m))
        if self._matrix is not None:
            A += self._matrix
        rest = pin.nonLinearEffects(self._model, self._data, q_m, v_m)
        b = A @ self._velocity + self._stepped * (smooth - rest)
        if not np.isfinite(b).all():
            raise DriverError("the simulated arm ran away: its state is no longer finite")
        bound = self._stepped * self._coulomb
        inverse = self._inverse_coupling
        if inverse is None:
            v = stick_slip_velocity(A, b, bound, self._velocity)
            return v, v
        rate = stick_slip_velocity(inverse.T @ A @ inverse, inverse.T @ b, bound, self._rate)
        return np.asarray(inverse @ rate), rate

    def _set(self, position: Array, velocity: Array, acceleration: Array, rate: Array) -> None:
        # Replaced, never written into, so that whoever holds an old state keeps it.
        for array in (position, velocity, acceleration, rate):
            array.setflags(write=False)
        self._position, self._velocity, self._acceleration, self._rate = position, velocity, acceleration, rate
