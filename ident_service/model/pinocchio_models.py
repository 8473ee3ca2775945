"""Convert between our model and pinocchio: chains from what `mechanism.py` reads, models from a chain and delta.

Pinocchio keeps a link's inertia as mass, centre of mass and inertia about the centre of mass in the joint frame; here
stand the conversions from and to delta (eqs. 5, 8), whose inertia is about the link frame's origin.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from ident_service.config.kinematics import Kinematics
from ident_service.config.quantities import TextFile
from ident_service.errors import ModelError
from ident_service.model.chain import WORLD, Array, Chain
from ident_service.model.mechanism import Mechanism, read_mechanism
from ident_service.model.parameter_layout import TERM_SYMBOLS, Layout


def read_urdf(
    file: TextFile, gravity: tuple[float, float, float], kinematics: Kinematics | None = None
) -> tuple[Chain, Array]:
    """Read chain and link inertias from a URDF; fixed joints, and those held still, are merged into their parents.

    Args:
        file: the URDF.
        gravity: gravity in the base frame [m/s^2].
        kinematics: part of the file that is the arm; all of it when None.

    Returns:
        The chain, and the ten inertial parameters per link (eq. 13) in SI units, shape (joints, 10).

    Raises:
        ModelError: as `read_mechanism`.
    """
    return chain_of(read_mechanism(file, "urdf", kinematics), gravity)


def read_mjcf(
    file: TextFile, gravity: tuple[float, float, float], kinematics: Kinematics | None = None
) -> tuple[Chain, Array]:
    """Read chain and link inertias (joints, 10) from an MJCF; fixed joints, and held ones, are merged."""
    return chain_of(read_mechanism(file, "mjcf", kinematics), gravity)


def chain_of(mechanism: Mechanism, gravity: tuple[float, float, float]) -> tuple[Chain, Array]:
    """Return the chain of a mechanism with this gravity, and its link inertias, shape (joints, 10)."""
    n = len(mechanism.names)
    chain = Chain(
        names=mechanism.names,
        parents=mechanism.parents,
        revolute=mechanism.revolute,
        axes=mechanism.axes.copy(),
        rotation=mechanism.rotation.copy(),
        translation=mechanism.translation.copy(),
        link_rotation=np.tile(np.eye(3), (n, 1, 1)),
        link_translation=np.zeros((n, 3)),
        gravity=np.array(gravity, dtype=float),
    )
    return chain, mechanism.bodies.copy()


def inertia_from_delta(parameters: Array) -> pin.Inertia:
    """Return the pinocchio inertia of ten parameters (eq. 13); raises ModelError where mass is not positive.

    Raises:
        ModelError: the mass is not positive, so that no centre of mass exists.
    """
    xx, xy, xz, yy, yz, zz, mx, my, mz, m = (float(value) for value in parameters)
    if not m > 0.0:
        raise ModelError(f"a link of mass {m:g} kg has no centre of mass; give the constrained estimate instead")
    return pin.Inertia.FromDynamicParameters(np.array([m, mx, my, mz, xx, xy, yy, xz, yz, zz]))


def quaternion(rotation: Array) -> Array:
    """Return the unit quaternion (w, x, y, z) of a rotation matrix, with w >= 0, shape (4,)."""
    x, y, z, w = pin.Quaternion(rotation).coeffs()
    return np.array([w, x, y, z]) if w >= 0.0 else -np.array([w, x, y, z])


def link_frame(chain: Chain, link: int) -> pin.SE3:
    """Return the placement of the link frame in the joint frame."""
    return pin.SE3(chain.link_rotation[link], chain.link_translation[link])


def pinocchio_model(chain: Chain, layout: Layout, delta: Array) -> pin.Model:
    """Build a pinocchio model of link parameters `delta`, frictionless; ModelError for coupled drives or no mass.

    Every joint has one position coordinate, continuous joints too. Friction stays with whoever integrates, because
    pinocchio's has no sticking.

    Raises:
        ModelError: `delta` does not fit the layout, a link has no positive mass, or a drive moves several joints.
    """
    if delta.shape != (layout.size,):
        raise ModelError(f"{delta.shape=} but the layout has {layout.size} parameters")
    model = pin.Model()
    model.gravity = pin.Motion(chain.gravity, np.zeros(3))
    for k in range(chain.joints):
        axis = chain.axes[k]
        joint = pin.JointModelRevoluteUnaligned(axis) if chain.revolute[k] else pin.JointModelPrismaticUnaligned(axis)
        placement = pin.SE3(chain.rotation[k], chain.translation[k])
        parent = 0 if chain.parents[k] == WORLD else chain.parents[k] + 1
        index = model.addJoint(parent, joint, placement, chain.names[k])
        inertia = inertia_from_delta(delta[layout.inertial(k)])
        model.appendBodyToJoint(index, inertia, link_frame(chain, k))
    if not np.array_equal(chain.coupling, np.diag(np.diag(chain.coupling))):
        raise ModelError("drives that move several joints have no armature per joint; pinocchio cannot represent them")
    model.armature = np.diag(chain.coupling) ** 2 * layout.term_values("drive_inertia", delta)
    return model


class InverseDynamics:
    """Inverse dynamics of a chain with known parameters at one state, fast enough for a control loop; no friction."""

    def __init__(self, chain: Chain, layout: Layout, delta: Array) -> None:
        """Build the pinocchio model of the parameters.

        Raises:
            ModelError: `delta` does not fit the layout, or a link has no positive mass.
        """
        coupling = chain.coupling
        self._drives: Array | None = None
        if not np.array_equal(coupling, np.diag(np.diag(coupling))):
            # Pinocchio has an armature per joint only; drives that move several joints add their own matrix.
            self._drives = coupling.T @ (layout.term_values("drive_inertia", delta)[:, None] * coupling)
            chain, delta = replace(chain, coupling=np.eye(chain.joints)), delta.copy()
            delta[layout.term_columns("drive_inertia")] = 0.0
        self._model = pinocchio_model(chain, layout, delta)
        self._data = self._model.createData()

    def torque(self, position: Array, velocity: Array, acceleration: Array) -> NDArray[np.float64]:
        """Return `M(q) ddq + c(q, dq) + g(q)` [N m or N], shape (joints,), drive inertia included, no friction."""
        rigid = np.asarray(pin.rnea(self._model, self._data, position, velocity, acceleration))
        return rigid if self._drives is None else np.asarray(rigid + self._drives @ acceleration)

    def mass_matrix(self, position: Array) -> NDArray[np.float64]:
        """Return M(q), shape (joints, joints), drive inertia included."""
        upper = pin.crba(self._model, self._data, position)
        rigid = np.asarray(np.triu(upper) + np.triu(upper, 1).T)
        return rigid if self._drives is None else np.asarray(rigid + self._drives)


class ForwardDynamics:
    """Forward dynamics of a chain with known parameters, drives and friction, in steps stable at any speed.

    Friction is a secant through its present value, `f = D(v) v` with `D = fv + (fc + fs exp(-(v/v_s)^2)) / max(|v|,
    1 mrad/s) + fq |v| + fa sign(v)`, and taken at the end of the step, so that a joint creeps where it ought to stick:
    the accuracy of an instrument's motion, not of a simulated arm's.
    """

    _CREEP = 1e-3  # rad/s or m/s

    def __init__(self, chain: Chain, layout: Layout, delta: Array, friction: tuple[Array, Array] | None = None) -> None:
        """Build the pinocchio model of the parameters.

        Args:
            chain: the mechanism.
            layout: of `delta`.
            delta: parameters [SI], shape (layout.size,).
            friction: Coulomb and viscous friction of the drives instead of those of `delta`, each of shape (joints,).

        Raises:
            ModelError: `delta` does not fit the layout, or a link has no positive mass.
        """
        drive_free = np.array(delta, dtype=float)
        drive_free[layout.term_columns("drive_inertia")] = 0.0
        # Drives that move several joints have no armature; what drives add is added here, by their own coordinates.
        self._model = pinocchio_model(replace(chain, coupling=np.eye(chain.joints)), layout, drive_free)
        self._data = self._model.createData()
        self._coupling = chain.coupling
        self._terms = {term: layout.term_values(term, delta) for term in TERM_SYMBOLS}
        if friction is not None:
            self._terms["coulomb"], self._terms["viscous"] = friction
        self._stribeck_velocity = np.array(layout.stribeck_velocity or np.ones(chain.joints))
        inertia = self._terms["drive_inertia"]
        self._drive_matrix = chain.coupling.T @ (inertia[:, None] * chain.coupling)
        self._offset = chain.coupling.T @ self._terms["offset"]
        from scipy.linalg.lapack import dposv  # loads for 0.2 s, and no process that moves an arm needs it

        self._solve_upper = dposv
        # Left out where they are zero: a motion takes ten thousands of steps.
        self._couples = not np.array_equal(chain.coupling, np.eye(chain.joints))
        self._bends = any(self._terms[term].any() for term in ("stribeck", "quadratic", "viscous_asymmetry"))

    def torque(self, position: Array, velocity: Array, acceleration: Array) -> NDArray[np.float64]:
        """Return `M(q) ddq + c(q, dq) + g(q)` [N m or N], shape (joints,), drive inertia included, no friction."""
        rigid = pin.rnea(self._model, self._data, position, velocity, acceleration)
        return np.asarray(rigid + self._drive_matrix @ acceleration)

    def mass_matrices(self, position: Array) -> NDArray[np.float64]:
        """Return M(q) at postures [rad or m] of shape (samples, joints), as (samples, joints, joints), with drives."""
        n = self._model.nv
        M = np.empty((len(position), n, n))
        for k, posture in enumerate(position):
            M[k] = pin.crba(self._model, self._data, posture)
        rows, columns = np.triu_indices(n)  # the only entries that are filled
        M[:, columns, rows] = M[:, rows, columns]
        return np.asarray(M + self._drive_matrix)

    def friction(self, velocity: Array) -> NDArray[np.float64]:
        """Return the friction torque [N m or N], offsets included, shape (joints,), of a joint velocity."""
        rate = self._coupling @ velocity
        return np.asarray(self._coupling.T @ (self._secant(rate) * rate) + self._offset)

    def next_velocity(self, position: Array, velocity: Array, torque: Array, period: float) -> NDArray[np.float64]:
        """Return the joint velocity after one step of constant torque, implicit in friction, explicit in the rest.

        Args:
            position: [rad or m], shape (joints,).
            velocity: [rad/s or m/s], shape (joints,).
            torque: [N m or N], shape (joints,).
            period: of the step [s].

        Raises:
            ModelError: the mass matrix is not positive definite.
        """
        force = torque - pin.nonLinearEffects(self._model, self._data, position, velocity) - self._offset
        # Of a mass matrix only the upper triangle is filled, and read by this solver.
        implicit = pin.crba(self._model, self._data, position) + self._drive_matrix
        if self._couples:
            damping = self._secant(self._coupling @ velocity)
            resistance = self._coupling.T @ (damping[:, None] * self._coupling)
            implicit += period * resistance
            force -= resistance @ velocity
        else:
            damping = self._secant(velocity)
            implicit.flat[:: len(velocity) + 1] += period * damping
            force -= damping * velocity
        _, acceleration, status = self._solve_upper(implicit, force)
        if status != 0:
            raise ModelError("the mass matrix is not positive definite: no real body has these parameters")
        return np.asarray(velocity + period * acceleration)

    def _secant(self, rate: Array) -> Array:
        """Return D of every drive at its velocity, shape (joints,)."""
        terms, speed = self._terms, np.abs(rate)
        if not self._bends:
            return np.asarray(np.maximum(terms["viscous"] + terms["coulomb"] / np.maximum(speed, self._CREEP), 0.0))
        dry = terms["coulomb"] + terms["stribeck"] * np.exp(-((rate / self._stribeck_velocity) ** 2))
        damping = terms["viscous"] + dry / np.maximum(speed, self._CREEP) + terms["quadratic"] * speed
        damping += terms["viscous_asymmetry"] * np.sign(rate)
        return np.asarray(np.maximum(damping, 0.0))
