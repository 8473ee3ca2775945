"""Simulate the arm's body: rigid links, drive inertia, friction that sticks, encoder steps and noise.

Find `v` with `A v + lambda = b` and `lambda_i` in `bound_i Sgn(v_i)`, where Sgn is set-valued: a sliding joint feels
its whole friction against its motion, and a joint at rest whatever keeps it at rest, up to its bound (Moreau 1988,
Stewart & Trinkle 1996). `A` is symmetric positive definite, so `v` is the one minimum of the strictly convex
`v^T A v / 2 - b^T v + sum bound_i |v_i|`.

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

from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from drivers.arm import Flags
from ident_service.errors import DriverError, ModelError
from ident_service.model.chain import Array, Chain
from ident_service.model.parameter_layout import Layout
from ident_service.model.pinocchio_models import InverseDynamics, pinocchio_model

Vector = NDArray[np.float64]

# Rounding must not tell a joint at the very edge of its friction cone to creep.
_EDGE = 1e-14
_PIVOTS = 20
_SWEEPS = 20
_ROUNDS = 500


def stick_slip_velocity(A: Vector, b: Vector, friction_bound: Vector, guess: Vector) -> Vector:
    """Return v of A v + friction = b, friction at most `friction_bound`, from the signs of `guess`; 0 where it sticks.

    Args:
        A: symmetric positive definite, shape (joints, joints).
        b: shape (joints,).
        friction_bound: largest friction in the units of b, not negative, shape (joints,).
        guess: a velocity whose signs are probably right, 0 for joints that probably stick, shape (joints,).

    Returns:
        The velocities, shape (joints,).
    """
    slack = _EDGE * float((np.abs(b) + friction_bound).max())
    v, consistent = _pivot(A, b, friction_bound, np.sign(guess), slack)
    if consistent:
        return v
    # Pivoting several joints at once can go in circles; sweeping over them one by one only ever descends.
    for _ in range(_ROUNDS):
        v = _sweep(A, b, friction_bound, v)
        exact, consistent = _pivot(A, b, friction_bound, np.sign(v), slack, pivots=1)
        if consistent:
            return exact
    return v


def _pivot(
    A: Vector, b: Vector, bound: Vector, mode: Vector, slack: float, pivots: int = _PIVOTS
) -> tuple[Vector, bool]:
    """Solve with each joint's mode (-1, 0, 1) assumed, correct the modes, and repeat.

    Returns:
        The last solution, and whether its modes are the right ones.
    """
    dry, edge = bound > 0.0, bound + slack
    v = np.zeros_like(b)
    for _ in range(pivots):
        sliding = (mode != 0.0) | ~dry
        v = _with_modes(A, b - bound * mode, sliding)
        wrong_way = sliding & dry & (v * mode <= 0.0)
        holding = b - A @ v
        torn_loose = ~sliding & (np.abs(holding) > edge)
        if not (wrong_way | torn_loose).any():
            return v, True
        mode = np.where(torn_loose, np.sign(holding), mode * ~wrong_way)
    return v, False


def _with_modes(A: Vector, b: Vector, sliding: NDArray[np.bool_]) -> Vector:
    if not sliding.any():
        return np.zeros_like(b)
    # Unit rows in place of the sticking joints' are cheaper than cutting the others out.
    held = A * (sliding[:, None] & sliding)
    held.flat[:: len(b) + 1] += ~sliding
    v = np.asarray(np.linalg.solve(held, b * sliding))
    v[~sliding] = 0.0
    return v


def _sweep(A: Vector, b: Vector, bound: Vector, start: Vector) -> Vector:
    """Minimise by projected Gauss-Seidel: each joint in turn to its own minimum, the others held."""
    rows, v = A.tolist(), start.tolist()
    for _ in range(_SWEEPS):
        for i, (row, force, limit) in enumerate(zip(rows, b.tolist(), bound.tolist(), strict=True)):
            pull = force - sum(a * w for a, w in zip(row, v, strict=True)) + row[i] * v[i]
            v[i] = 0.0 if abs(pull) <= limit else (pull - (limit if pull > 0.0 else -limit)) / row[i]
    return np.array(v)


@dataclass(frozen=True)
class Imperfections:
    """Hold the imperfections per joint, all of shape (joints,).

    Attributes:
        encoder_resolution: step of the position [rad or m]; 0 where continuous.
        torque_resolution: step of the torque [N m or N]; 0 where continuous.
        torque_noise: standard deviation per cycle of what acts besides the torque [N m or N].
        torque_limit: clip of the driver [N m or N]; infinite where there is none.
    """

    encoder_resolution: Vector
    torque_resolution: Vector
    torque_noise: Vector
    torque_limit: Vector

    def __post_init__(self) -> None:
        for field in fields(self):
            value = np.array(getattr(self, field.name), dtype=float)
            if value.shape != self.torque_limit.shape or not (value >= 0.0).all():
                raise DriverError(
                    f"{field.name} must be {self.torque_limit.shape[0]} numbers, none negative, is {value}"
                )
            value.setflags(write=False)
            object.__setattr__(self, field.name, value)

    @classmethod
    def none(cls, joints: int) -> Imperfections:
        """Return the imperfections of a perfect arm: continuous, without noise, unlimited."""
        return cls(np.zeros(joints), np.zeros(joints), np.zeros(joints), np.full(joints, np.inf))

    def quantize_position(self, position: Vector) -> Vector:
        """Return the position in whole encoder steps, a new array of shape (joints,)."""
        return _in_steps(position, self._encoder_steps)

    def quantize_torque(self, torque: Vector) -> Vector:
        """Return the torque in the drives' steps, within their limits, a new array of shape (joints,)."""
        least, most = self._range
        return np.asarray(np.minimum(np.maximum(_in_steps(torque, self._torque_steps), least), most))

    @cached_property
    def _encoder_steps(self) -> _Steps:
        return _steps(self.encoder_resolution)

    @cached_property
    def _torque_steps(self) -> _Steps:
        return _steps(self.torque_resolution)

    @cached_property
    def _range(self) -> tuple[Vector, Vector]:
        """Return the largest whole steps inside the limits, because rounding could lead out of them again."""
        step, limit = self.torque_resolution, self.torque_limit
        whole = np.where(step > 0.0, step, 1.0)
        # A limit that is a whole number of steps must stay one when their quotient is rounded down.
        reach = np.where(step > 0.0, np.floor(limit / whole * (1.0 + 1e-12)) * whole, limit)
        return -reach, reach


# Which values have steps, None where all have; and the steps, 1 where a value is continuous.
_Steps = tuple[Flags | None, Vector]


def _steps(step: Vector) -> _Steps:
    stepped = step > 0.0
    return None if stepped.all() else stepped, np.where(stepped, step, 1.0)


def _in_steps(value: Vector, steps: _Steps) -> Vector:
    stepped, step = steps
    whole: Vector = np.rint(value / step) * step
    return whole if stepped is None else np.where(stepped, whole, value)


Load = tuple[float, tuple[float, float, float]]
# Position, velocity and acceleration of the joints, and the drives' velocities.
PlantState = tuple[Array, Array, Array, Array]

_ROUNDING = 1e-12  # of the largest number in an inverse


class Plant:
    """Simulate a chain with true parameters, moved one period at a time by constant torques."""

    def __init__(self, chain: Chain, layout: Layout, delta: Array, position: Array, period: float) -> None:
        """Place the arm at rest at a position.

        Args:
            chain: the mechanism, gravity included.
            layout: order of the parameters.
            delta: true parameters [SI], shape (layout.size,).
            position: initial position [rad or m], shape (joints,).
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
        """Return the velocity [rad/s or m/s], shape (joints,); exactly 0 where a joint sticks with all its drives."""
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

    @property
    def conditions(self) -> tuple[object, ...]:
        """Return the objects that a step depends on besides torque and period, to be compared by identity."""
        return self._position, self._velocity, self._acceleration, self._braking, self._loads

    def set_braking(self, damping: Array) -> None:
        """Set the damping that brakes every step from now on: one per joint, or a symmetric matrix over the joints.

        Args:
            damping: [N m s/rad or N s/m], shape (joints,), none negative; or, where drives move several joints each,
                a symmetric matrix that is nowhere negative, shape (joints, joints).
        """
        if damping is not self._braking:
            self._braking = damping
            self._damp()

    def rest(self) -> None:
        """Set velocity and acceleration to 0 where the arm is, as if somebody had stopped it; the next step goes on."""
        self.place(self._position)

    def place(self, position: Array) -> None:
        """Place the arm at rest at a position, as if somebody had led it there.

        Args:
            position: [rad or m], shape (joints,).
        """
        still = np.zeros(self._chain.joints)
        self.set_state(_read_only(np.array(position, dtype=float), still, still, still))

    def attach_loads(self, point_masses: tuple[Load, ...]) -> None:
        """Attach point masses to the last link, in place of those attached before.

        Args:
            point_masses: mass [kg] and offset in the frame of the last link [m] of each.
        """
        if point_masses == self._loads:
            return
        delta = self._delta.copy()
        inertial = delta[self._layout.inertial(self._chain.joints - 1)]  # a view
        for mass, offset in point_masses:
            x, y, z = offset
            inertial[:6] += mass * np.array([y * y + z * z, -x * y, -x * z, x * x + z * z, -y * z, x * x + y * y])
            inertial[6:9] += mass * np.array(offset)
            inertial[9] += mass
        self._loads = point_masses
        self._build(delta)

    def step(self, torque: Array, period: float | None = None) -> None:
        """Advance the state by one period, or `period` [s], under a constant torque; DriverError if it diverges.

        Args:
            torque: [N m or N], shape (joints,).
            period: time to advance [s]; None for `period`, to which the error of a step belongs: keep near or below it.

        Raises:
            DriverError: the state is no longer finite; it stays what it was before the step.
        """
        self.set_state(self.state_after(torque, period))

    def set_state(self, state: PlantState) -> None:
        """Set the plant to a state that `state_after` has returned."""
        self._position, self._velocity, self._acceleration, self._rate = state

    def state_after(self, torque: Array, period: float | None = None) -> PlantState:
        """Return the state to which `step` would lead, plant unmoved; DriverError if the arm runs away."""
        h = self._period if period is None else period
        if h != self._stepped:
            self._stepped, self._half = h, 0.5 * h
            self._damp_steps()
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
        return _read_only(self._position + self._half * (v + v_next), v_next, (v_next - v) / h, rate)

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
        """Compute what depends on drives, friction and braking."""
        coupling = self._chain.coupling
        whole = coupling.T @ (self._viscous[:, None] * coupling)
        whole = whole + (self._braking if self._braking.ndim == 2 else np.diag(self._braking))
        self._damping = np.diag(whole).copy()
        self._armature = np.diag(self._drive_matrix)
        damping = whole - np.diag(self._damping)
        self._coupled: Array | None = damping if damping.any() else None
        self._drive_coupling = self._drive_matrix - np.diag(self._armature)
        self._couples = bool(damping.any() or self._drive_coupling.any())
        self._damp_steps()

    def _damp_steps(self) -> None:
        """Compute what depends on the length of a step, too."""
        # Implicit viscous friction acts like more drive inertia, so that it costs nothing to solve for. Between joints
        # it does not, nor does drive inertia: pinocchio has an armature per joint only.
        self._model.armature = self._armature + self._half * self._damping
        self._matrix: Array | None = None
        if self._couples:
            damping = 0.0 if self._coupled is None else self._coupled
            self._matrix = self._drive_coupling + self._half * damping

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


def _read_only(*arrays: Array) -> PlantState:
    """Return the state of these arrays, which are replaced, never written into: whoever holds an old state keeps it."""
    for array in arrays:
        array.setflags(write=False)
    position, velocity, acceleration, rate = arrays
    return position, velocity, acceleration, rate
