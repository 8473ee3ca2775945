"""The regressor H(q, dq, ddq) with H delta = tau (eq. 29), for many samples at once.

For link k with angular velocity w, angular acceleration e and linear acceleration a of its frame's origin (gravity
taken as an upward acceleration of the base), all in the link frame,

    f = m a + e x l + w x (w x l)          n = L e + w x (L w) + l x a

and joint i feels `u . n + v . f`, where (u, v) is its unit screw seen from the link frame: u the axis (zero for a
sliding joint), v the velocity of the link's origin per unit of joint speed. Both are linear in delta, so each joint's
row is ten products of vectors, computed here for whole blocks with the samples along the last, contiguous axis.

Boundary: numpy only; no samples are looped over in Python.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ident_service.errors import ModelError
from ident_service.model.chain import WORLD, Array, Chain
from ident_service.model.layout import INERTIAL, Layout

_Vectors = list[NDArray[np.float64]]  # three components, each of shape (samples,)


def joint_regressor(
    chain: Chain,
    layout: Layout,
    position: Array,
    velocity: Array,
    acceleration: Array,
    columns: Sequence[int] | NDArray[np.intp] | None = None,
) -> Array:
    """The rows of H for every joint and sample.

    Args:
        chain: the mechanism.
        layout: order of the parameters.
        position: [rad or m], shape (samples, joints).
        velocity: [rad/s or m/s], shape (samples, joints); its sign is the friction's.
        acceleration: [rad/s^2 or m/s^2], shape (samples, joints).
        columns: which parameters, all when None.

    Returns:
        H, shape (joints, columns, samples): joint i's equations are `H[i].T @ delta`.

    Raises:
        ModelError: the arrays have the wrong shape.
    """
    n = chain.joints
    for name, array in (("position", position), ("velocity", velocity), ("acceleration", acceleration)):
        if array.ndim != 2 or array.shape != (position.shape[0], n):
            raise ModelError(f"{name}.shape={array.shape} but expected ({position.shape[0]}, {n})")
    wanted = np.arange(layout.size) if columns is None else np.asarray(columns, dtype=np.intp)
    place = {int(column): row for row, column in enumerate(wanted)}
    q, dq, ddq = (np.ascontiguousarray(array.T, dtype=float) for array in (position, velocity, acceleration))
    H = np.zeros((n, len(wanted), q.shape[1]))
    _joint_terms(H, layout, place, dq, ddq)
    states = _Forward(chain, q, dq, ddq)
    for link in range(n):
        offset = layout.inertial(link).start
        rows = [(place[offset + p], p) for p in range(len(INERTIAL)) if offset + p in place]
        if rows:
            _link_rows(H, states, link, rows)
    return H


def _joint_terms(H: Array, layout: Layout, place: dict[int, int], dq: Array, ddq: Array) -> None:
    """Drive inertia and eq. 27: each joint's own column in its own row."""
    values = {"drive_inertia": ddq, "viscous": dq, "coulomb": np.sign(dq), "offset": np.ones_like(dq)}
    for term in layout.terms:
        for joint, column in enumerate(layout.term_columns(term)):
            if int(column) in place:
                H[joint, place[int(column)]] = values[term][joint]


class _Forward:
    """Motion of every link frame, and the unit screws of its ancestors seen from it."""

    def __init__(self, chain: Chain, q: Array, dq: Array, ddq: Array) -> None:
        self.screws: list[dict[int, tuple[_Vectors | None, _Vectors]]] = []
        self.motion: list[tuple[_Vectors, _Vectors, _Vectors]] = []
        samples = q.shape[1]
        zero, one = np.zeros(samples), np.ones(samples)
        base = [-float(g) * one for g in chain.gravity]
        in_joint: list[tuple[_Vectors, _Vectors, _Vectors]] = []
        joint_screws: list[dict[int, tuple[_Vectors | None, _Vectors]]] = []
        for k in range(chain.joints):
            parent = chain.parents[k]
            w, e, a = ([zero] * 3, [zero] * 3, base) if parent == WORLD else in_joint[parent]
            axis = chain.axes[k]
            turn = chain.rotation[k]
            shift = chain.translation[k]
            rotation: list[list[NDArray[np.float64]]] | Array = turn.T
            if chain.revolute[k]:
                rotation = _turned(turn, axis, q[k])
                arm: _Vectors = [float(shift[i]) * one for i in range(3)]
            else:
                slide = turn @ axis
                arm = [float(shift[i]) + float(slide[i]) * q[k] for i in range(3)]
            # Acceleration of the joint frame's origin carried along by the parent, then everything in the joint frame.
            a = _add(a, _add(_cross(e, arm), _cross(w, _cross(w, arm))))
            screws = {
                i: (
                    None if u is None else _rotate(rotation, u),
                    _rotate(rotation, v if u is None else _add(v, _cross(u, arm))),
                )
                for i, (u, v) in ({} if parent == WORLD else joint_screws[parent]).items()
            }
            w, e, a = _rotate(rotation, w), _rotate(rotation, e), _rotate(rotation, a)
            z = [float(axis[i]) * one for i in range(3)]
            zdq, zddq = [c * dq[k] for c in z], [c * ddq[k] for c in z]
            if chain.revolute[k]:
                e = _add(_add(e, zddq), _cross(w, zdq))
                w = _add(w, zdq)
                screws[k] = (z, [zero] * 3)
            else:
                coriolis = _cross(w, zdq)
                a = _add(_add(a, zddq), [2.0 * c for c in coriolis])
                screws[k] = (None, z)
            in_joint.append((w, e, a))
            joint_screws.append(screws)
            self._to_link(chain, k, w, e, a, screws)

    def _to_link(
        self,
        chain: Chain,
        k: int,
        w: _Vectors,
        e: _Vectors,
        a: _Vectors,
        screws: dict[int, tuple[_Vectors | None, _Vectors]],
    ) -> None:
        offset, rotation = chain.link_translation[k], chain.link_rotation[k].T
        if offset.any():
            arm = [np.full_like(w[0], float(c)) for c in offset]
            a = _add(a, _add(_cross(e, arm), _cross(w, _cross(w, arm))))
            screws = {i: (u, v if u is None else _add(v, _cross(u, arm))) for i, (u, v) in screws.items()}
        if not np.array_equal(rotation, np.eye(3)):
            w, e, a = _rotate(rotation, w), _rotate(rotation, e), _rotate(rotation, a)
            screws = {
                i: (None if u is None else _rotate(rotation, u), _rotate(rotation, v)) for i, (u, v) in screws.items()
            }
        self.motion.append((w, e, a))
        self.screws.append(screws)


def _link_rows(H: Array, states: _Forward, link: int, rows: list[tuple[int, int]]) -> None:
    """The ten columns of one link in the rows of all joints that carry it."""
    w, e, a = states.motion[link]
    for joint, (u, v) in states.screws[link].items():
        first: _Vectors = []
        inertia: _Vectors = []
        kinds = {p for _, p in rows}
        if kinds & {6, 7, 8}:
            first = _add(_cross(v, e), _cross(_cross(v, w), w))
            if u is not None:
                first = _add(first, _cross(a, u))
        if kinds & {0, 1, 2, 3, 4, 5} and u is not None:
            p = _cross(u, w)
            inertia = [
                u[0] * e[0] + p[0] * w[0],
                u[0] * e[1] + u[1] * e[0] + p[0] * w[1] + p[1] * w[0],
                u[0] * e[2] + u[2] * e[0] + p[0] * w[2] + p[2] * w[0],
                u[1] * e[1] + p[1] * w[1],
                u[1] * e[2] + u[2] * e[1] + p[1] * w[2] + p[2] * w[1],
                u[2] * e[2] + p[2] * w[2],
            ]
        for row, parameter in rows:
            if parameter == 9:
                H[joint, row] = v[0] * a[0] + v[1] * a[1] + v[2] * a[2]
            elif parameter >= 6:
                H[joint, row] = first[parameter - 6]
            elif u is not None:
                H[joint, row] = inertia[parameter]


def _turned(placement: Array, axis: Array, angle: NDArray[np.float64]) -> list[list[NDArray[np.float64]]]:
    """Rows of the rotation from the parent's frame into the turned joint frame (Rodrigues' formula, transposed)."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = (float(component) for component in axis)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    constant, sine, cosine = placement @ (np.eye(3) + K @ K), placement @ K, -(placement @ (K @ K))
    return [[constant[j, i] + sine[j, i] * s + cosine[j, i] * c for j in range(3)] for i in range(3)]


def _rotate(rotation: list[list[NDArray[np.float64]]] | Array, vector: _Vectors) -> _Vectors:
    return [rotation[i][0] * vector[0] + rotation[i][1] * vector[1] + rotation[i][2] * vector[2] for i in range(3)]


def _cross(a: _Vectors, b: _Vectors) -> _Vectors:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _add(a: _Vectors, b: _Vectors) -> _Vectors:
    return [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
