"""Compute fast, differentiable distances for the search, with every moving solid in a capsule that contains it.

Capsules are exact, other solids of moving links are replaced by a capsule around them, so that while two bodies are
apart no distance here is larger than the exact one of `collision.py`. Boxes and half spaces that do not move stay what
they are. Overlap of a capsule with a box is measured by the deepest point of the capsule's axis and pushes through the
nearest face.

With end points e(q) and closest points held fast, the gradient of a distance is that of its direction times the
points' motion; forward kinematics is traced once per arm (`tape.py`) and run backwards for it (`adjoint.py`).

`scene.py` defines the pairs.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident_service.errors import ModelError
from ident_service.model.adjoint import Differentiable
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import WORLD, Array, Chain
from ident_service.model.scene import scene
from ident_service.model.segments import between_segments, to_boxes, to_half_spaces
from ident_service.model.solids import Body, Box, Capsule, Cylinder, HalfSpace
from ident_service.model.tape import Symbol, Tape, Value

_Vector = list[Value]


class CapsuleModel:
    """Pairs of `CollisionModel`, in the same order, with distances for whole blocks of postures at once.

    Attributes:
        pairs: readable names.
        joints: number of joints.
    """

    def __init__(self, model: ArmModel) -> None:
        """Trace the arm's forward kinematics and collect the pairs.

        Raises:
            ModelError: geometry that does not fit the arm.
        """
        around = scene(model)
        self.pairs = around.pairs
        self.joints = around.chain.joints
        rows = [contact for contacts in around.contacts for contact in contacts]
        counts = [len(contacts) for contacts in around.contacts]
        self._starts = np.concatenate([[0], np.cumsum(counts[:-1])]).astype(int) if counts else np.zeros(0, dtype=int)
        self._pair_of = np.repeat(np.arange(len(counts)), counts)
        used = sorted({index for contact in rows for index in contact})
        round_bodies = [index for index in used if not _stays(around.bodies[index])]
        place = {index: number for number, index in enumerate(round_bodies)}
        capsules = [containing_capsule(around.bodies[index]) for index in round_bodies]
        tape = Tape()
        q = [tape.input() for _ in range(self.joints)]
        frames = _frames(tape, around.chain, q)
        ends: list[list[_Vector]] = [
            [_placed(frames, around.bodies[index].joint, point) for point in (capsule.start, capsule.end)]
            for index, capsule in zip(round_bodies, capsules, strict=True)
        ]
        # Rows by end, component, capsule.
        outputs = [points[end][axis] for end in range(2) for axis in range(3) for points in ends]
        self._ways = Differentiable(tape, q, outputs) if rows else None
        by_kind: dict[type, list[int]] = {Capsule: [], Box: [], HalfSpace: []}
        for row, (_, second) in enumerate(rows):
            other = around.bodies[second]
            by_kind[type(other.solid) if _stays(other) else Capsule].append(row)
        self._families: list[_Family] = []
        for kind, family in ((Capsule, _RoundPairs), (HalfSpace, _PlanePairs), (Box, _BoxPairs)):
            if chosen := by_kind[kind]:
                first = [place[rows[row][0]] for row in chosen]
                others = [place.get(rows[row][1], rows[row][1]) for row in chosen]
                self._families.append(family(chosen, first, others, capsules, around.bodies))
        self._rows = len(rows)
        self._values: Array | None = None
        self._smallest: Array | None = None

    def distances(self, position: Array) -> Array:
        """Return a lower bound of the distance of each pair.

        Args:
            position: [rad or m], shape (samples, joints).

        Returns:
            Signed distances [m], negative where the pair overlaps, shape (pairs, samples).

        Raises:
            ModelError: positions of another shape.
        """
        if position.ndim != 2 or position.shape[1] != self.joints:
            raise ModelError(f"{position.shape=} but expected (samples, {self.joints})")
        samples = len(position)
        values = np.empty((self._rows, samples))
        if self._ways is not None:
            start, end = self._ways.run(np.ascontiguousarray(position.T)).reshape(2, 3, -1, samples)
            along = end - start
            for family in self._families:
                values[family.rows] = family.distances(start, along)
        self._values = values
        several = self._rows > len(self.pairs)
        self._smallest = np.minimum.reduceat(values, self._starts, axis=0) if several else values
        return self._smallest.copy()

    def pull(self, seeds: Array) -> Array:
        """Return the gradient of `sum(seeds * distances)` at the positions of the last call of `distances`.

        Args:
            seeds: shape (pairs, samples).

        Returns:
            Shape (samples, joints).

        Raises:
            ModelError: no distances yet, or seeds of another shape.
        """
        if self._values is None or self._smallest is None or seeds.shape != self._smallest.shape:
            raise ModelError(f"{seeds.shape=} does not belong to the last distances")
        samples = seeds.shape[1]
        if self._ways is None:
            return np.zeros((samples, self.joints))
        if self._rows > len(self.pairs):
            # Capsules of a link that share an end can be equally near; each then gets its part.
            nearest = (self._values == self._smallest[self._pair_of]).astype(float)
            seeds = (seeds / np.add.reduceat(nearest, self._starts, axis=0))[self._pair_of] * nearest
        forces: Array = np.zeros((2, 3, self._families[0].capsules, samples))
        for family in self._families:
            family.pull(seeds[family.rows], forces)
        return np.ascontiguousarray(self._ways.pull(forces.reshape(-1, samples)).T)


def _stays(body: Body) -> bool:
    """Return whether a body needs no capsule: a fixed box or half space."""
    return body.joint == WORLD and isinstance(body.solid, Box | HalfSpace)


def containing_capsule(body: Body) -> Capsule:
    """Return the body's own capsule, or one around it: along a box's longest edge, along a cylinder's axis."""
    solid = body.solid
    if isinstance(solid, Capsule):
        return solid
    if isinstance(solid, HalfSpace):
        raise AssertionError("no capsule contains a half space")
    if isinstance(solid, Cylinder):
        direction, half, radius = solid.rotation[:, 2], solid.half_length, solid.radius
    else:
        longest = int(np.argmax(solid.half))
        direction, half = solid.rotation[:, longest], float(solid.half[longest])
        radius = float(np.linalg.norm(np.delete(solid.half, longest)))
    return Capsule(solid.center - half * direction, solid.center + half * direction, radius)


class _Family:
    """Pairs of a capsule with one kind of solid.

    Attributes:
        rows: their rows among all contacts.
        capsules: number of all capsules.
    """

    def __init__(
        self,
        rows: Sequence[int],
        first: Sequence[int],
        others: Sequence[int],
        capsules: Sequence[Capsule],
        bodies: Sequence[Body],
    ) -> None:
        self.rows = np.array(rows)
        self.capsules = len(capsules)
        self._first = np.array(first)
        self._radius = np.array([capsules[index].radius for index in first])[:, None]
        self._collect = _incidence(first, len(capsules))
        self._direction: Array = np.zeros((3, len(rows), 0))
        self._share: Array = np.zeros((len(rows), 0))
        self._take(others, capsules, [bodies[index].solid for index in others] if self._fixed else [])

    _fixed = True

    def _take(self, others: Sequence[int], capsules: Sequence[Capsule], solids: Sequence[object]) -> None:
        """Store the needed data of the other solids."""
        raise NotImplementedError

    def distances(self, start: Array, along: Array) -> Array:
        """Return signed distances [m], shape (rows, samples), of capsules whose axes have these starts and vectors."""
        raise NotImplementedError

    def pull(self, seeds: Array, forces: Array) -> None:
        """Add the gradient with respect to the capsules' end points, shape (2, 3, capsules, samples)."""
        _push(self._collect, self._direction * seeds, self._share, forces)


def _push(collect: Array, force: Array, share: Array, forces: Array) -> None:
    at_end = force * share
    forces[1] += collect @ at_end
    forces[0] += collect @ (force - at_end)


def _incidence(capsule: Sequence[int], count: int) -> Array:
    return np.asarray(np.arange(count)[:, None] == np.array(capsule), dtype=float)


class _RoundPairs(_Family):
    _fixed = False

    def _take(self, others: Sequence[int], capsules: Sequence[Capsule], solids: Sequence[object]) -> None:
        squares = np.array([[float(np.sum((capsule.end - capsule.start) ** 2))] for capsule in capsules])
        self._second = np.array(others)
        self._squares, self._other_squares = squares[self._first], squares[self._second]
        self._radius = self._radius + np.array([capsules[index].radius for index in others])[:, None]
        self._collect_other = _incidence(others, len(capsules))

    def distances(self, start: Array, along: Array) -> Array:
        first, second = self._first, self._second
        distance, self._direction, self._share, self._other_share = between_segments(
            start[:, first], along[:, first], start[:, second], along[:, second], self._squares, self._other_squares
        )
        return np.asarray(distance - self._radius)

    def pull(self, seeds: Array, forces: Array) -> None:
        force = self._direction * seeds
        _push(self._collect, force, self._share, forces)
        _push(self._collect_other, -force, self._other_share, forces)


class _PlanePairs(_Family):
    def _take(self, others: Sequence[int], capsules: Sequence[Capsule], solids: Sequence[object]) -> None:
        planes = [solid for solid in solids if isinstance(solid, HalfSpace)]
        self._normal = np.array([plane.normal for plane in planes]).T[:, :, None]
        self._offset = np.array([[plane.offset] for plane in planes])

    def distances(self, start: Array, along: Array) -> Array:
        distance, self._share = to_half_spaces(start[:, self._first], along[:, self._first], self._normal, self._offset)
        self._direction = self._normal
        return np.asarray(distance - self._radius)


class _BoxPairs(_Family):
    def _take(self, others: Sequence[int], capsules: Sequence[Capsule], solids: Sequence[object]) -> None:
        boxes = [solid for solid in solids if isinstance(solid, Box)]
        self._rotation = np.array([box.rotation for box in boxes])
        self._center = np.array([box.center for box in boxes]).T[:, :, None]
        self._half = np.array([box.half for box in boxes]).T[:, :, None]

    def distances(self, start: Array, along: Array) -> Array:
        start, along = (
            np.einsum("pij,ips->jps", self._rotation, vectors)
            for vectors in (start[:, self._first] - self._center, along[:, self._first])
        )
        distance, gradient, self._share = to_boxes(start, along, self._half)
        self._direction = np.einsum("pij,jps->ips", self._rotation, gradient)
        return np.asarray(distance - self._radius)


def _frames(tape: Tape, chain: Chain, q: Sequence[Symbol]) -> list[tuple[list[_Vector], _Vector]]:
    """Return rotation (rows) and origin of every joint frame in the base frame."""
    frames: list[tuple[list[_Vector], _Vector]] = []
    for k in range(chain.joints):
        parent = chain.parents[k]
        rotation: list[_Vector] = [list(map(float, row)) for row in np.eye(3)]
        origin: _Vector = [0.0, 0.0, 0.0]
        if parent != WORLD:
            rotation, origin = frames[parent]
        rest = chain.rotation[k]
        if chain.revolute[k]:
            local = _turned(rest, chain.axes[k], tape.apply("cos", q[k]), tape.apply("sin", q[k]))
            offset: _Vector = [float(x) for x in chain.translation[k]]
        else:
            local = [[float(x) for x in row] for row in rest]
            axis = rest @ chain.axes[k]
            offset = [float(x) + float(a) * q[k] for x, a in zip(chain.translation[k], axis, strict=True)]
        columns = list(zip(*local, strict=True))
        frames.append(
            (
                [[_dot(row, column) for column in columns] for row in rotation],
                [o + _dot(row, offset) for o, row in zip(origin, rotation, strict=True)],
            )
        )
    return frames


def _turned(rest: Array, axis: Array, cosine: Symbol, sine: Symbol) -> list[_Vector]:
    """Return the rows of `rest` times the rotation about `axis` (Rodrigues' formula)."""
    x, y, z = (float(component) for component in axis)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    still, with_sine, with_cosine = rest @ (np.eye(3) + K @ K), rest @ K, -(rest @ (K @ K))
    return [
        [float(still[i, j]) + (float(with_sine[i, j]) * sine + float(with_cosine[i, j]) * cosine) for j in range(3)]
        for i in range(3)
    ]


def _placed(frames: Sequence[tuple[list[_Vector], _Vector]], joint: int, point: Array) -> _Vector:
    """Return a point of a joint's frame in the base frame."""
    constant: _Vector = [float(component) for component in point]
    if joint == WORLD:
        return constant
    rotation, origin = frames[joint]
    return [o + _dot(row, constant) for o, row in zip(origin, rotation, strict=True)]


def _dot(a: Sequence[Value], b: Sequence[Value]) -> Value:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
