"""Compute the regressor H with H delta = tau (eq. 29) for many samples, and its gradient.

For link k with angular velocity w, angular acceleration e and linear acceleration a of its frame's origin (gravity
taken as an upward acceleration of the base), all in the link frame,

    f = m a + e x l + w x (w x l)          n = L e + w x (L w) + l x a

and joint i feels `u . n + v . f`, where (u, v) is its unit screw seen from the link frame: u the axis (zero for a
sliding joint), v the velocity of the link's origin per unit of joint speed. Both are linear in delta, so each joint's
row is ten products of vectors, computed for whole blocks with the samples along the last, contiguous axis.

The formulas are traced once per chain (`symbolic.py`), which drops everything that the geometry makes zero or one. No
loop over samples runs in Python.

For a scalar function of H, `pull` turns its derivatives with respect to the entries of H into those with respect to
position, velocity, acceleration and direction: what a search for a motion needs. Exact, from the same traced formulas,
for about twice the time of H itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ident_service.config.arm import JointTerm
from ident_service.errors import ModelError
from ident_service.model.chain import WORLD, Array, Chain
from ident_service.model.newton_euler import ZERO, Rotation, Vector, add, cross, dot, rotate, scaled, to_vector, turned
from ident_service.model.parameter_layout import INERTIAL, NO_STRIBECK, Layout
from ident_service.model.symbolic import Differentiable, ExpressionGraph, Program, Symbol, Value

_Screw = tuple[Vector, Vector]
_ENTRIES = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def joint_regressor(
    chain: Chain,
    layout: Layout,
    position: Array,
    velocity: Array,
    acceleration: Array,
    columns: Sequence[int] | NDArray[np.intp] | None = None,
    out: Array | None = None,
    direction: Array | None = None,
) -> Array:
    """Return the regressor H, shape (joints, columns, samples): joint i's torques are `H[i].T @ delta`.

    Args:
        chain: the mechanism.
        layout: order of the parameters.
        position: [rad or m], shape (samples, joints).
        velocity: [rad/s or m/s], shape (samples, joints).
        acceleration: [rad/s^2 or m/s^2], shape (samples, joints).
        columns: indices of the parameters, all when None.
        out: result of an earlier call for the same chain and columns and as many samples or more; it is written over,
            which saves the time of fresh memory.
        direction: direction of Coulomb friction per drive, from -1 to 1, shape (samples, joints); the sign of the
            drive's velocity when None.

    Raises:
        ModelError: the arrays have the wrong shape.
    """
    n = chain.joints
    for name, array in (("position", position), ("velocity", velocity), ("acceleration", acceleration)):
        if array.ndim != 2 or array.shape != (position.shape[0], n):
            raise ModelError(f"{name}.shape={array.shape} but expected ({position.shape[0]}, {n})")
    wanted = tuple(range(layout.size)) if columns is None else tuple(int(column) for column in columns)
    samples = position.shape[0]
    shape = (n, len(wanted), samples)
    H = np.zeros(shape) if out is None else out[:, :, :samples]
    if H.shape != shape:
        raise ModelError(f"{H.shape=} but expected {shape}")
    program, places = _program(chain, layout, wanted)
    if direction is None:
        direction = np.sign(velocity @ chain.coupling.T)
    states = (position, velocity, acceleration, direction)
    inputs = [np.ascontiguousarray(array[:, k], dtype=float) for array in states for k in range(n)]
    program.run(inputs, [H[joint, row] for joint, row in places])
    return H


@lru_cache(maxsize=32)
def _program(chain: Chain, layout: Layout, columns: tuple[int, ...]) -> tuple[Program, list[tuple[int, int]]]:
    """Return the traced formulas, and the (joint, column) that each output belongs to; the others are zero."""
    tape, entries = _traced(chain, layout)
    kept = entries_of(entries, columns)
    return Program(tape, list(kept.values())), list(kept)


@lru_cache(maxsize=4)
def _traced(chain: Chain, layout: Layout) -> tuple[ExpressionGraph, dict[tuple[int, int], Value]]:
    """Return the formulas for all columns, from which programs for some are planned; nobody adds to the tape."""
    return traced_regressor(chain, layout)


def traced_regressor(chain: Chain, layout: Layout) -> tuple[ExpressionGraph, dict[tuple[int, int], Value]]:
    """Return the formulas of H as an expression graph, and its nonzero entries by (joint, column of delta).

    Returns:
        The tape, whose inputs are position, velocity, acceleration and direction of every joint, in this order, and
        the entries of H by (joint, column of delta); those that are not there are zero.
    """
    tape = ExpressionGraph()
    q, dq, ddq, direction = ([tape.input() for _ in range(chain.joints)] for _ in range(4))
    entries = _joint_terms(tape, chain, layout, dq, ddq, direction)
    states = _Forward(tape, chain, q, dq, ddq)
    for link in range(chain.joints):
        for (joint, parameter), value in _link_entries(states, link).items():
            entries[joint, layout.inertial(link).start + parameter] = value
    return tape, entries


def traced_rigid_torque(
    tape: ExpressionGraph,
    chain: Chain,
    layout: Layout,
    delta: Array,
    q: list[Symbol],
    dq: Sequence[Value],
    ddq: Sequence[Value],
) -> list[Value]:
    """Return the links' symbolic joint torques for known link parameters `delta`, without drives and friction."""
    torque: list[Value] = [0.0] * chain.joints
    states = _Forward(tape, chain, q, dq, ddq)
    for link in range(chain.joints):
        start = layout.inertial(link).start
        for (joint, parameter), value in _link_entries(states, link).items():
            if (factor := float(delta[start + parameter])) != 0.0:
                torque[joint] = torque[joint] + value * factor
    return torque


def entries_of(entries: dict[tuple[int, int], Value], columns: Sequence[int]) -> dict[tuple[int, int], Value]:
    """Return the entries of H that are not zero, by (joint, place in `columns`)."""
    chosen = {column: row for row, column in enumerate(columns)}
    return {
        (joint, chosen[column]): value
        for (joint, column), value in entries.items()
        if column in chosen and (isinstance(value, Symbol) or value != 0.0)
    }


def _joint_terms(
    tape: ExpressionGraph, chain: Chain, layout: Layout, dq: list[Symbol], ddq: list[Symbol], direction: list[Symbol]
) -> dict[tuple[int, int], Value]:
    """Return drive inertia and friction: each drive's columns, in the rows of the joints it moves."""
    entries: dict[tuple[int, int], Value] = {}
    for drive in range(chain.joints):
        share = to_vector(chain.coupling[drive])
        rate = sum((c * x for c, x in zip(share, dq, strict=True)), 0.0)
        if not isinstance(rate, Symbol):
            raise ModelError(f"drive {drive + 1} moves no joint")
        values: dict[JointTerm, Value] = {
            "drive_inertia": sum((c * x for c, x in zip(share, ddq, strict=True)), 0.0),
            "viscous": rate,
            "coulomb": direction[drive],
            "offset": 1.0,
            "quadratic": rate * tape.apply("abs", rate),
            "viscous_asymmetry": tape.apply("abs", rate),
        }
        if "stribeck" in layout.terms and layout.stribeck_velocity[drive] <= NO_STRIBECK:
            values["stribeck"] = 0.0  # at rest, too, where its curve is one whatever the velocity
        elif "stribeck" in layout.terms:
            ratio = rate * (1.0 / layout.stribeck_velocity[drive])
            values["stribeck"] = direction[drive] * _exp(tape, -(ratio * ratio))
        for term in layout.terms:
            for joint in range(chain.joints):
                entries[joint, int(layout.term_columns(term)[drive])] = share[joint] * values[term]
    return entries


def _exp(tape: ExpressionGraph, value: Value) -> Value:
    return tape.apply("exp", value) if isinstance(value, Symbol) else float(np.exp(value))


class _Forward:
    """Motion of every link frame, and the unit screws of its ancestors seen from it."""

    def __init__(
        self, tape: ExpressionGraph, chain: Chain, q: list[Symbol], dq: Sequence[Value], ddq: Sequence[Value]
    ) -> None:
        self.screws: list[dict[int, _Screw]] = []
        self.motion: list[tuple[Vector, Vector, Vector]] = []
        base: Vector = [-float(g) for g in chain.gravity]
        in_joint: list[tuple[Vector, Vector, Vector]] = []
        joint_screws: list[dict[int, _Screw]] = []
        for k in range(chain.joints):
            parent = chain.parents[k]
            w, e, a = (ZERO, ZERO, base) if parent == WORLD else in_joint[parent]
            axis = to_vector(chain.axes[k])
            arm = to_vector(chain.translation[k])
            if chain.revolute[k]:
                rotation = turned(chain.rotation[k], chain.axes[k], tape.apply("cos", q[k]), tape.apply("sin", q[k]))
            else:
                rotation = [to_vector(row) for row in chain.rotation[k].T]
                arm = add(arm, scaled(to_vector(chain.rotation[k] @ chain.axes[k]), q[k]))
            # Carried along by the parent to the joint frame's origin, then everything in the joint frame.
            a = rotate(rotation, add(a, add(cross(e, arm), cross(w, cross(w, arm)))))
            screws = _carried({} if parent == WORLD else joint_screws[parent], arm, rotation)
            w, e = rotate(rotation, w), rotate(rotation, e)
            along, rate = scaled(axis, ddq[k]), scaled(axis, dq[k])
            if chain.revolute[k]:
                e = add(add(e, along), cross(w, rate))
                w = add(w, rate)
                screws[k] = (axis, ZERO)
            else:
                a = add(add(a, along), scaled(cross(w, rate), 2.0))
                screws[k] = (ZERO, axis)
            in_joint.append((w, e, a))
            joint_screws.append(screws)
            self._to_link(chain, k, (w, e, a), screws)

    def _to_link(self, chain: Chain, k: int, motion: tuple[Vector, Vector, Vector], screws: dict[int, _Screw]) -> None:
        w, e, a = motion
        arm = to_vector(chain.link_translation[k])
        rotation = [to_vector(row) for row in chain.link_rotation[k].T]
        a = add(a, add(cross(e, arm), cross(w, cross(w, arm))))
        self.motion.append((rotate(rotation, w), rotate(rotation, e), rotate(rotation, a)))
        self.screws.append(_carried(screws, arm, rotation))


def _carried(screws: dict[int, _Screw], arm: Vector, rotation: Rotation) -> dict[int, _Screw]:
    """Return the screws seen from a frame whose origin is `arm` further and which is turned by `rotation`."""
    return {i: (rotate(rotation, u), rotate(rotation, add(v, cross(u, arm)))) for i, (u, v) in screws.items()}


def _link_entries(states: _Forward, link: int) -> dict[tuple[int, int], Value]:
    """Return the ten columns of one link in the rows of all joints that carry it, by (joint, parameter of eq. 13)."""
    w, e, a = states.motion[link]
    entries: dict[tuple[int, int], Value] = {}
    # What only depends on the link is shared by all joints: e~ + w~ w~ of the first moment, and L's factors.
    W = [[w[i] * w[j] for j in range(3)] for i in range(3)]
    spin = [
        [-W[1][1] - W[2][2], W[0][1] - e[2], W[0][2] + e[1]],
        [W[0][1] + e[2], -W[0][0] - W[2][2], W[1][2] - e[0]],
        [W[0][2] - e[1], W[1][2] + e[0], -W[0][0] - W[1][1]],
    ]
    moments = _inertia_columns(W, e)
    for joint, (u, v) in states.screws[link].items():
        lever = cross(a, u)
        for axis in range(3):
            entries[joint, 6 + axis] = dot(v, [spin[i][axis] for i in range(3)]) + lever[axis]
        for parameter in range(6):
            entries[joint, parameter] = dot(u, moments[parameter])
        entries[joint, len(INERTIAL) - 1] = dot(v, a)
    return entries


def _inertia_columns(W: list[list[Value]], e: Vector) -> list[Vector]:
    """Return, per entry of L (eq. 13), the moment `L e + w x (L w)` of a unit entry; W is w w^T."""
    columns: list[Vector] = []
    for i, j in _ENTRIES:
        # L w has w_j at i and w_i at j; w x (L w) multiplies them with w again, which are entries of W.
        product: list[Vector] = [[0.0, 0.0, 0.0] for _ in range(3)]  # rows: component of L w, columns: times w_c
        along: Vector = [0.0, 0.0, 0.0]
        along[i], product[i] = e[j], list(W[j])
        if i != j:
            along[j], product[j] = e[i], list(W[i])
        across: Vector = [product[2][1] - product[1][2], product[0][2] - product[2][0], product[1][0] - product[0][1]]
        columns.append(add(along, across))
    return columns


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
        """Return the regressor H, (joints, columns, samples), overwritten by the next run; keep values for `pull`.

        Args:
            position: [rad or m], shape (samples, joints).
            velocity: [rad/s or m/s], shape (samples, joints).
            acceleration: [rad/s^2 or m/s^2], shape (samples, joints).
            direction: direction of Coulomb friction per drive, from -1 to 1, shape (samples, joints).

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
