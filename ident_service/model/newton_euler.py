"""Formulate inverse dynamics, gravity and mass matrix (Newton-Euler recursion) on symbolic values.

Newton-Euler outwards and inwards with the ten parameters of eq. 13 per link: with w, e and a the angular velocity,
angular acceleration and linear acceleration of the link frame's origin (gravity as an upward acceleration of the base),

    f = m a + e x l + w x (w x l)          n = L e + w x (L w) + l x a

(`regressor.py`). Nothing is divided, so that masses may be zero and inertias indefinite: with the base columns at the
values of the base parameters and every other column at zero, `K delta = beta` holds, and so do all torques (eq. 37).
The mass matrix is that of composite bodies, whose ten parameters simply add up.

The formulas are recorded in an `ExpressionGraph` (`symbolic.py`), which other modules run or print.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ident_service.config.arm import JointTerm
from ident_service.model.chain import WORLD, Array, Chain
from ident_service.model.parameter_layout import INERTIAL, NO_STRIBECK, Layout
from ident_service.model.symbolic import ExpressionGraph, Symbol, Value

Vector = list[Value]
Rotation = list[list[Value]]
ZERO: Vector = [0.0, 0.0, 0.0]


def to_vector(values: Array) -> Vector:
    """Return an array of three numbers as a list of floats."""
    return [float(value) for value in values]


def turned(placement: Array, axis: Array, c: Symbol, s: Symbol) -> Rotation:
    """Return the rotation into a joint frame turned by the angle of cosine `c` and sine `s`, as symbolic rows."""
    x, y, z = (float(component) for component in axis)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    still, sine, cosine = placement @ (np.eye(3) + K @ K), placement @ K, -(placement @ (K @ K))
    return [
        [float(still[j, i]) + (float(sine[j, i]) * s + float(cosine[j, i]) * c) for j in range(3)] for i in range(3)
    ]


def dot(a: Vector, b: Vector) -> Value:
    """Return the dot product of two vectors of numbers or symbolic values."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def rotate(rotation: Rotation, vector: Vector) -> Vector:
    """Return the product of a rotation, given by rows, and a vector."""
    return [dot(row, vector) for row in rotation]


def scaled(vector: Vector, factor: Value) -> Vector:
    """Return the vector with every component multiplied by a factor."""
    return [component * factor for component in vector]


def cross(a: Vector, b: Vector) -> Vector:
    """Return the cross product, a x b."""
    return [a[i] * b[j] - a[j] * b[i] for i, j in ((1, 2), (2, 0), (0, 1))]


def add(a: Vector, b: Vector) -> Vector:
    """Return the sum of two vectors."""
    return [a[i] + b[i] for i in range(3)]


Parameters = Mapping[int, Value]
"""Values of columns of delta; columns that are not there are zero."""


@dataclass(frozen=True)
class _Body:
    """Body with L (symmetric, rows), first moment l and m of eq. 13 about the origin of some frame."""

    L: Rotation
    first: Vector
    m: Value


def rigid_torque(
    tape: ExpressionGraph,
    chain: Chain,
    layout: Layout,
    parameters: Parameters,
    q: Sequence[Symbol],
    *rates: Sequence[Value],
) -> list[Value]:
    """Return the links' joint torques as symbolic values: M(q) ddq + c(q, dq) + g(q); without rates only g(q).

    Args:
        tape: graph that the formulas are recorded in.
        chain: the mechanism.
        layout: order of the parameters.
        parameters: of the links.
        q: joint positions.
        rates: dq and ddq; without them those of a standing arm, which leaves gravity.
    """
    n = chain.joints
    dq, ddq = rates or ([0.0] * n, [0.0] * n)
    steps = [_Step(tape, chain, k, q) for k in range(n)]
    motion: list[tuple[Vector, Vector, Vector]] = []
    base: tuple[Vector, Vector, Vector] = (ZERO, ZERO, [-float(g) for g in chain.gravity])
    for k, step in enumerate(steps):
        motion.append(step.outwards(base if step.parent == WORLD else motion[step.parent], dq[k], ddq[k]))
    force, moment = [list(ZERO) for _ in range(n)], [list(ZERO) for _ in range(n)]
    torque: list[Value] = [0.0] * n
    for k in range(n - 1, -1, -1):
        f, m = _link_wrench(chain, k, motion[k], _link_body(layout, parameters, k))
        force[k], moment[k] = add(force[k], f), add(moment[k], m)
        torque[k] = steps[k].felt(force[k], moment[k])
        if (parent := chain.parents[k]) != WORLD:
            f, m = steps[k].inwards(force[k], moment[k])
            force[parent], moment[parent] = add(force[parent], f), add(moment[parent], m)
    return torque


def mass_matrix(
    tape: ExpressionGraph, chain: Chain, layout: Layout, parameters: Parameters, q: Sequence[Symbol]
) -> list[list[Value]]:
    """Return M(q) as symbolic rows, drive inertia included, by the composite-body algorithm."""
    n = chain.joints
    steps = [_Step(tape, chain, k, q) for k in range(n)]
    composite = [
        _moved_to_origin(
            _link_body(layout, parameters, k), _rows(chain.link_rotation[k]), to_vector(chain.link_translation[k])
        )
        for k in range(n)
    ]
    M: list[list[Value]] = [[0.0] * n for _ in range(n)]
    for k in range(n - 1, -1, -1):
        step, body = steps[k], composite[k]
        if step.revolute:
            force, moment = cross(step.axis, body.first), rotate(body.L, step.axis)
        else:
            force, moment = scaled(step.axis, body.m), cross(body.first, step.axis)
        at = k
        M[k][k] = step.felt(force, moment)
        while (parent := chain.parents[at]) != WORLD:
            force, moment = steps[at].inwards(force, moment)
            at = parent
            M[at][k] = M[k][at] = steps[at].felt(force, moment)
        if (parent := chain.parents[k]) != WORLD:
            composite[parent] = _sum(composite[parent], _moved_to_origin(body, _transposed(step.rotation), step.arm))
    for drive, column in enumerate(layout.term_columns("drive_inertia")):
        inertia = parameters.get(int(column), 0.0)
        share = to_vector(chain.coupling[drive])
        for i in range(n):
            for j in range(n):
                M[i][j] = M[i][j] + inertia * (share[i] * share[j])
    return M


def drive_torque(chain: Chain, layout: Layout, parameters: Parameters, ddq: Sequence[Value]) -> list[Value]:
    """Return the torque of each joint that accelerates the drives' own inertia, as symbolic values."""
    torque: list[Value] = [0.0] * chain.joints
    for drive, column in enumerate(layout.term_columns("drive_inertia")):
        share = to_vector(chain.coupling[drive])
        taken = parameters.get(int(column), 0.0) * _weighted(share, ddq)
        torque = [t + s * taken for t, s in zip(torque, share, strict=True)]
    return torque


def friction_torque(
    tape: ExpressionGraph,
    chain: Chain,
    layout: Layout,
    parameters: Parameters,
    dq: Sequence[Symbol],
    direction: Sequence[Symbol] | None = None,
) -> list[Value]:
    """Return the friction torque of each joint; dry friction takes the velocity's sign where `direction` is None."""
    torque: list[Value] = [0.0] * chain.joints
    columns = {term: layout.term_columns(term) for term in layout.terms}
    for drive in range(chain.joints):
        share = to_vector(chain.coupling[drive])
        rate = _weighted(share, dq)
        taken: Value = 0.0
        for term, places in columns.items():
            if term != "drive_inertia" and (column := int(places[drive])) in parameters:
                turned = None if direction is None else direction[drive]
                taken = taken + parameters[column] * _friction_factor(tape, layout, term, drive, rate, turned)
        torque = [t + s * taken for t, s in zip(torque, share, strict=True)]
    return torque


def _friction_factor(
    tape: ExpressionGraph, layout: Layout, term: JointTerm, drive: int, rate: Value, direction: Symbol | None = None
) -> Value:
    """Return the factor of a friction parameter."""
    if not isinstance(rate, Symbol):
        return 1.0 if term == "offset" else 0.0  # a drive that moves no joint
    if term == "offset":
        return 1.0
    if term == "viscous":
        return rate
    if term == "coulomb":
        return tape.apply("sign", rate) if direction is None else direction
    if term == "stribeck" and layout.stribeck_velocity[drive] <= NO_STRIBECK:
        return 0.0
    if term == "stribeck":
        ratio = rate * (1.0 / layout.stribeck_velocity[drive])
        bell = -(ratio * ratio)
        sign = tape.apply("sign", rate) if direction is None else direction
        return sign * (tape.apply("exp", bell) if isinstance(bell, Symbol) else 1.0)
    return rate * tape.apply("abs", rate) if term == "quadratic" else tape.apply("abs", rate)


class _Step:
    """Transform from the parent's joint frame to a joint's: `arm` in the parent's, then `rotation` into the joint's."""

    def __init__(self, tape: ExpressionGraph, chain: Chain, k: int, q: Sequence[Symbol]) -> None:
        self.parent = chain.parents[k]
        self.revolute = chain.revolute[k]
        self.axis = to_vector(chain.axes[k])
        self.arm = to_vector(chain.translation[k])
        if self.revolute:
            cosine, sine = tape.apply("cos", q[k]), tape.apply("sin", q[k])
            self.rotation = turned(chain.rotation[k], chain.axes[k], cosine, sine)
        else:
            self.rotation = _rows(chain.rotation[k].T)
            self.arm = add(self.arm, scaled(to_vector(chain.rotation[k] @ chain.axes[k]), q[k]))

    def outwards(
        self, motion: tuple[Vector, Vector, Vector], rate: Value, acceleration: Value
    ) -> tuple[Vector, Vector, Vector]:
        """Return the motion w, e, a of the joint frame's origin from that of the parent's."""
        w, e, a = motion
        a = rotate(self.rotation, add(a, add(cross(e, self.arm), cross(w, cross(w, self.arm)))))
        w, e = rotate(self.rotation, w), rotate(self.rotation, e)
        speed, along = scaled(self.axis, rate), scaled(self.axis, acceleration)
        if self.revolute:
            return add(w, speed), add(add(e, along), cross(w, speed)), a
        return w, e, add(add(a, along), scaled(cross(w, speed), 2.0))

    def inwards(self, force: Vector, moment: Vector) -> tuple[Vector, Vector]:
        """Return a force and moment about this joint's origin, in the parent's frame about the parent's."""
        back = _transposed(self.rotation)
        force = rotate(back, force)
        return force, add(rotate(back, moment), cross(self.arm, force))

    def felt(self, force: Vector, moment: Vector) -> Value:
        """Return the component of a force and moment along the joint's axis, which its drive must supply."""
        return dot(self.axis, moment if self.revolute else force)


def _link_body(layout: Layout, parameters: Parameters, link: int) -> _Body:
    first = layout.inertial(link).start
    xx, xy, xz, yy, yz, zz, x, y, z, m = (parameters.get(first + k, 0.0) for k in range(len(INERTIAL)))
    return _Body([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], [x, y, z], m)


def _link_wrench(chain: Chain, link: int, motion: tuple[Vector, Vector, Vector], body: _Body) -> tuple[Vector, Vector]:
    """Return the wrench that moves a link: force, and moment about the joint frame's origin, in the joint frame."""
    w, e, a = motion
    arm, out = to_vector(chain.link_translation[link]), _rows(chain.link_rotation[link].T)
    a = rotate(out, add(a, add(cross(e, arm), cross(w, cross(w, arm)))))
    w, e = rotate(out, w), rotate(out, e)
    force = add(scaled(a, body.m), add(cross(e, body.first), cross(w, cross(w, body.first))))
    moment = add(add(rotate(body.L, e), cross(w, rotate(body.L, w))), cross(body.first, a))
    back = _rows(chain.link_rotation[link])
    force = rotate(back, force)
    return force, add(rotate(back, moment), cross(arm, force))


def _moved_to_origin(body: _Body, rotation: Rotation, arm: Vector) -> _Body:
    """Return the body about the origin that its own lies `arm` away from, turned by `rotation` (Steiner, eq. 8)."""
    first = rotate(rotation, body.first)
    half = _transposed([rotate(rotation, row) for row in body.L])  # R L, since L is symmetric
    L = [rotate(rotation, row) for row in half]
    twice = dot(arm, first) * 2.0 + body.m * dot(arm, arm)
    for i in range(3):
        for j in range(i, 3):
            moved = L[i][j] - (arm[i] * first[j] + first[i] * arm[j]) - body.m * (arm[i] * arm[j])
            L[i][j] = L[j][i] = moved + twice if i == j else moved
    return _Body(L, add(first, scaled(arm, body.m)), body.m)


def _rows(matrix: Array) -> Rotation:
    return [to_vector(row) for row in matrix]


def _transposed(rotation: Rotation) -> Rotation:
    return [list(column) for column in zip(*rotation, strict=True)]


def _sum(a: _Body, b: _Body) -> _Body:
    return _Body([add(x, y) for x, y in zip(a.L, b.L, strict=True)], add(a.first, b.first), a.m + b.m)


def _weighted(share: Vector, values: Sequence[Value]) -> Value:
    return sum((c * x for c, x in zip(share, values, strict=True)), 0.0)
