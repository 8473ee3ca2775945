"""Compute fast, differentiable distances for the search: every solid in a capsule.

Arrays have their three components first and the samples last: points are of shape (3, pairs, samples). Where along the
lines the distance is smallest comes back too, because the gradient of a smallest distance is that of the distance
between those points held fast (envelope theorem).

Capsules are exact, other solids of moving links are replaced by a capsule around them, so that while two bodies are
apart no distance here is larger than the exact one of `collision.py`, which defines the pairs. Boxes and half spaces
that do not move stay what they are. Overlap of a capsule with a box is measured by the deepest point of the capsule's
axis and pushes through the nearest face.

With end points e(q) and closest points held fast, the gradient of a distance is that of its direction times the
points' motion; forward kinematics is traced once per arm and run backwards for it (`symbolic.py`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident_service.errors import ModelError
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import WORLD, Array, Chain
from ident_service.model.collision import scene
from ident_service.model.newton_euler import Vector, rotate, to_vector, turned
from ident_service.model.solids import Body, Box, Capsule, Cylinder, HalfSpace
from ident_service.model.symbolic import Differentiable, ExpressionGraph, Symbol

_BISECTIONS = 36
_TOUCH = 1e-9  # m; what comes nearer to a box may as well be inside it


def dot(a: Array, b: Array) -> Array:
    """Return inner products of vectors (x, y, z along the first axis)."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def unit(vectors: Array) -> tuple[Array, Array]:
    """Return lengths and unit vectors (x, y, z along the first axis); a zero vector stays zero."""
    length = np.sqrt(dot(vectors, vectors))
    # Squares of anything shorter underflow.
    return length, vectors * (1.0 / np.maximum(length, 1e-150))


def distances_between_segments(
    start: Array,
    along: Array,
    other_start: Array,
    other_along: Array,
    squared_lengths: Array,
    other_squared_lengths: Array,
) -> tuple[Array, Array, Array, Array]:
    """Return distances [m], directions and nearest places (0 to 1 along) of pairs of segments, also degenerate ones.

    After Ericson, Real-Time Collision Detection, 5.1.9.

    Args:
        start: starting points of the first segments [m], shape (3, pairs, samples).
        along: vectors from start to end of the first segments [m], shape (3, pairs, samples).
        other_start: starting points of the second segments [m], shape (3, pairs, samples).
        other_along: vectors from start to end of the second segments [m], shape (3, pairs, samples).
        squared_lengths: squared lengths of the first ones [m^2], shape (pairs, 1).
        other_squared_lengths: squared lengths of the second ones [m^2], shape (pairs, 1).

    Returns:
        Distances, directions from the second to the first, and the shares along the first and the second segment.
    """
    apart = start - other_start
    b, c, f = dot(along, other_along), dot(along, apart), dot(other_along, apart)
    a, e = squared_lengths, other_squared_lengths
    determinant = a * e - b * b
    # Of parallel lines any point of the first will do.
    skew = determinant > 1e-14 * a * e
    s = np.where(skew, (b * f - c * e) / np.where(skew, determinant, 1.0), 0.0)
    np.clip(s, 0.0, 1.0, out=s)
    t = np.clip((b * s + f) * _inverse(e), 0.0, 1.0)
    s = np.clip((b * t - c) * _inverse(a), 0.0, 1.0)
    distance, direction = unit(apart + along * s - other_along * t)
    return distance, direction, s, t


def _inverse(squares: Array) -> Array:
    return np.where(squares > 0.0, 1.0 / np.where(squares > 0.0, squares, 1.0), 0.0)


def distances_to_half_spaces(start: Array, along: Array, normal: Array, offset: Array) -> tuple[Array, Array]:
    """Return signed distances [m] of segments to half spaces, and which end is nearest: 0 start, 1 end.

    Args:
        start: [m], shape (3, pairs, samples).
        along: vectors from start to end [m], shape (3, pairs, samples).
        normal: unit vectors, shape (3, pairs, 1).
        offset: [m], shape (pairs, 1).

    Returns:
        Signed distances and the share along the segment, 0 or 1.
    """
    slope = dot(normal, along)
    share = np.where(slope < 0.0, 1.0, 0.0)
    return np.asarray(dot(normal, start) - offset + share * slope), share


def distances_to_boxes(start: Array, along: Array, half_edges: Array) -> tuple[Array, Array, Array]:
    """Return signed distances [m] of segments to boxes about the origin, gradients and nearest places (0 to 1 along).

    Outside, half the slope of the squared distance is linear between the places where the line crosses a face's plane.
    Of a line that enters the box the deepest point counts, whose negative distance to the nearest face is convex too.

    Args:
        start: starting points in the box's frame [m], shape (3, pairs, samples).
        along: vectors from start to end [m], shape (3, pairs, samples).
        half_edges: half edges [m], shape (3, pairs, 1).

    Returns:
        Signed distances of the nearest points, their gradients with respect to the point, and their shares.
    """
    share = _nearest(start, along, half_edges)
    distance, gradient = _box_gradient(start + along * share, half_edges)
    enters = distance < _TOUCH
    if enters.any():
        inner, way = start[:, enters], along[:, enters]
        edges = np.broadcast_to(half_edges, start.shape)[:, enters]
        distance[enters], gradient[:, enters], share[enters] = _deepest(inner, way, edges)
    return distance, gradient, share


def _nearest(start: Array, along: Array, half: Array) -> Array:
    """Return the share along a segment at which it is nearest to a box that it does not enter."""
    moves = np.abs(along) > 1e-12
    inverse = np.where(moves, 1.0, 0.0) / np.where(moves, along, 1.0)
    crossings = np.concatenate([(half - start) * inverse, (-half - start) * inverse])
    low, high = np.zeros(start.shape[1:]), np.ones(start.shape[1:])
    slope_low, slope_high = _slope(start, along, half, low), _slope(start, along, half, high)
    at_end = np.where(slope_low >= 0.0, 0.0, np.where(slope_high <= 0.0, 1.0, np.nan))
    for crossing in crossings:
        inside = (crossing > low) & (crossing < high)
        slope = _slope(start, along, half, crossing)
        falls, rises = inside & (slope < 0.0), inside & (slope >= 0.0)
        low, slope_low = np.where(falls, crossing, low), np.where(falls, slope, slope_low)
        high, slope_high = np.where(rises, crossing, high), np.where(rises, slope, slope_high)
    # Between the two nearest crossings the slope is linear.
    change = np.maximum(slope_high - slope_low, 1e-300)
    between = low + (high - low) * np.clip(-slope_low / change, 0.0, 1.0)
    return np.where(np.isnan(at_end), between, at_end)


def _slope(start: Array, along: Array, half: Array, share: Array) -> Array:
    """Return half the derivative of the squared distance to the box along the line."""
    points = start + along * share
    return dot(points - np.clip(points, -half, half), along)


def _deepest(start: Array, along: Array, half: Array) -> tuple[Array, Array, Array]:
    """Return distance, gradient and share, as `distances_to_boxes`, for segments that enter a box, (3, segments)."""
    low, high = np.zeros(start.shape[1:]), np.ones(start.shape[1:])
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        falls = dot(_box_gradient(start + along * middle, half)[1], along) < 0.0
        low, high = np.where(falls, middle, low), np.where(falls, high, middle)
    before, after = (_box_gradient(start + along * share, half)[1] for share in (low, high))
    falling, rising = np.maximum(-dot(before, along), 0.0), np.maximum(dot(after, along), 0.0)
    # A deepest point equally far from two faces: they share the gradient so that it has no part along the line.
    share_before = np.where(falling > 0.0, rising / np.maximum(falling + rising, 1e-300), 0.0)
    share = 0.5 * (low + high)
    distance, _ = _box_gradient(start + along * share, half)
    return distance, before * share_before + after * (1.0 - share_before), share


def _box_gradient(points: Array, half: Array) -> tuple[Array, Array]:
    """Return the signed distance of points to boxes, and its gradient."""
    beyond = np.abs(points) - half
    outside = np.maximum(beyond, 0.0)
    length, direction = unit(outside)
    deepest = np.maximum(np.maximum(beyond[0], beyond[1]), beyond[2])
    within = length == 0.0
    faces = beyond == deepest
    direction = np.where(within, faces / faces.sum(axis=0), direction)
    return np.where(within, deepest, length), direction * np.sign(points)


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
        tape = ExpressionGraph()
        q = [tape.input() for _ in range(self.joints)]
        frames = _frames(tape, around.chain, q)
        ends: list[list[Vector]] = [
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
        """Return a lower bound of the distance of each pair [m], negative in overlap, shape (pairs, samples).

        Args:
            position: [rad or m], shape (samples, joints).

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
        """Return the gradient of `sum(seeds * last distances)`, (samples, joints); seeds (pairs, samples).

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
    """Return the body's own capsule, or one around its box or cylinder; AssertionError for a half space."""
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
        rows: rows of these pairs among all contacts.
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
        distance, self._direction, self._share, self._other_share = distances_between_segments(
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
        distance, self._share = distances_to_half_spaces(
            start[:, self._first], along[:, self._first], self._normal, self._offset
        )
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
        distance, gradient, self._share = distances_to_boxes(start, along, self._half)
        self._direction = np.einsum("pij,jps->ips", self._rotation, gradient)
        return np.asarray(distance - self._radius)


def _frames(tape: ExpressionGraph, chain: Chain, q: Sequence[Symbol]) -> list[tuple[list[Vector], Vector]]:
    """Return rotation (rows) and origin of every joint frame in the base frame."""
    frames: list[tuple[list[Vector], Vector]] = []
    for k in range(chain.joints):
        parent = chain.parents[k]
        rotation: list[Vector] = [list(map(float, row)) for row in np.eye(3)]
        origin: Vector = [0.0, 0.0, 0.0]
        if parent != WORLD:
            rotation, origin = frames[parent]
        rest = chain.rotation[k]
        if chain.revolute[k]:
            columns = turned(rest, chain.axes[k], tape.apply("cos", q[k]), tape.apply("sin", q[k]))
            offset = to_vector(chain.translation[k])
        else:
            columns = [to_vector(column) for column in rest.T]
            axis = rest @ chain.axes[k]
            offset = [float(x) + float(a) * q[k] for x, a in zip(chain.translation[k], axis, strict=True)]
        place = [o + way for o, way in zip(origin, rotate(rotation, offset), strict=True)]
        frames.append(([rotate(columns, row) for row in rotation], place))
    return frames


def _placed(frames: Sequence[tuple[list[Vector], Vector]], joint: int, point: Array) -> Vector:
    """Return a point of a joint's frame in the base frame."""
    constant = to_vector(point)
    if joint == WORLD:
        return constant
    rotation, origin = frames[joint]
    return [o + way for o, way in zip(origin, rotate(rotation, constant), strict=True)]
