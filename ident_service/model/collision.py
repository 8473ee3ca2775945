"""Measure exact signed distances between an arm's bodies and its surroundings, and how fast they can change.

A link is a union of convex solids that stand still in its joint's frame; the base and the obstacles stand still in the
base frame. Two links that a joint connects are no pair, nor are two that the configuration lets touch; a half space
of `workspace.inside` is an obstacle like any other. The distance of a pair is the smallest of any solid of one to any
solid of the other: how far they are apart, or, negative, how far one must be moved to free them (of two capsules, the
distance of their axes less both radii). The search for motions uses `capsule_distances.py`, fast and differentiable.

The signed distance of two convex sets changes no more than their points move against each other, and joint k moves a
point by at most its distance from k's axis per radian (its travel per metre). What hangs on joint k stays, however the
joints behind it stand, inside a cylinder about k's axis and inside a ball about k's origin; both follow from those of
the next joint outwards, since a cylinder about an axis is left where it is by a turn about that axis. Joints that carry
both bodies do not move them against each other and have constant zero.

In motion up to `AT_ONCE` pairs of solids are looked at in every cycle; more of them in turn, so that of up to 400 pairs
each is looked at at least every 10 cycles. Between capsules, and of anything to a plane, a pair takes less than 0.1 us;
of boxes and cylinders a few.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from ident_service.config import motion_design as given
from ident_service.config.motion_design import BASE
from ident_service.errors import ModelError, MotionRefused
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import WORLD, Array, Chain
from ident_service.model.pinocchio_models import link_frame
from ident_service.model.solids import Body, Box, Capsule, Cylinder, HalfSpace, Solid, corners, rotation_rpy
from ident_service.model.urdf import urdf_solids


@dataclass(frozen=True, eq=False)
class Scene:
    """Bodies, and pairs of them that must stay apart.

    Attributes:
        chain: the mechanism that moves the bodies.
        limits: lowest and highest position [rad or m], infinite where unknown, shape (joints, 2).
        bodies: all solids of all pairs.
        pairs: a readable name of each pair, the moving link first.
        contacts: per pair, all pairs of indices of bodies, the moving one first.
    """

    chain: Chain
    limits: Array
    bodies: tuple[Body, ...]
    pairs: tuple[str, ...]
    contacts: tuple[tuple[tuple[int, int], ...], ...]


def link_bodies(model: ArmModel) -> list[Body]:
    """Return the solids of base and links: those under `geometry`, else the URDF's, with ModelError for a mesh.

    Raises:
        ModelError: a link that does not exist, or a mesh where capsules are needed.
    """
    chain, config = model.chain, model.config
    _check_names(model)
    links = [body for name, capsules in config.geometry.items() for body in _link(chain, name, capsules)]
    return links + urdf_solids(config.kinematics, chain, frozenset(config.geometry))


def surroundings(model: ArmModel) -> list[Body]:
    """Return the workspace's obstacles as solids, and half spaces for all outside of the box the arm must stay in."""
    return [*_obstacles(model.config.workspace), *_inside(model.config.workspace)]


def scene(model: ArmModel) -> Scene:
    """Collect bodies of arm and workspace, and pairs that must not touch; MotionRefused if only the workspace has any.

    Raises:
        ModelError: a link that does not exist, or a mesh where capsules are needed.
        MotionRefused: surroundings, but no body that could touch them.
    """
    chain, config = model.chain, model.config
    links, around = link_bodies(model), surroundings(model)
    bodies = (*links, *around)
    if around and not links:
        raise MotionRefused(
            f"{config.name}: workspace names what must not be touched, but no link has a body; give capsules under "
            "geometry, or collision geometry in the URDF"
        )
    indices: dict[str, list[int]] = {}
    for index, body in enumerate(bodies):
        indices.setdefault(body.owner, []).append(index)
    free = {frozenset(pair) for pair in config.workspace.may_touch}
    pairs = {
        f"{first} - {second}": tuple((a, b) for a in indices[first] for b in indices[second])
        for first, second in _pairs(chain, indices)
        if {first, second} not in free
    }
    limits = np.array([[-np.inf, np.inf]] * chain.joints)
    for k, name in enumerate(chain.names):
        if name in config.joints and (position := config.joints[name].position) is not None:
            limits[k] = position
    return Scene(chain, limits, bodies, tuple(pairs), tuple(pairs.values()))


def _check_names(model: ArmModel) -> None:
    mentioned = [*model.config.geometry, *(name for pair in model.config.workspace.may_touch for name in pair)]
    for name in mentioned:
        if name not in (*model.chain.names, BASE):
            raise ModelError(
                f"{model.config.name}: geometry or workspace.may_touch names {name!r}, "
                f"which is neither {BASE!r} nor one of {', '.join(model.chain.names)}"
            )
    if mentioned and BASE in model.chain.names:
        raise ModelError(
            f"{model.config.name}: a joint is called {BASE!r}, which in geometry and workspace.may_touch names what "
            f"does not move; rename the joint in its kinematics, as {BASE + '_joint'!r}"
        )


def _pairs(chain: Chain, owners: dict[str, list[int]]) -> Iterator[tuple[str, str]]:
    """Yield each moving link with what it must stay clear of, links before surroundings."""
    inner = (BASE, *chain.names)
    for k, name in enumerate(chain.names):
        for other in inner[: k + 1]:
            if name in owners and other in owners and other != inner[chain.parents[k] + 1]:
                yield name, other
    for around in (owner for owner in owners if owner not in inner):
        for name in chain.names:
            if name in owners:
                yield name, around


def _link(chain: Chain, name: str, capsules: tuple[given.Capsule, ...]) -> Iterator[Body]:
    joint = WORLD if name == BASE else chain.names.index(name)
    rotation, translation = (
        (np.eye(3), np.zeros(3)) if joint == WORLD else (chain.link_rotation[joint], chain.link_translation[joint])
    )
    for capsule in capsules:
        start, end = (rotation @ np.array(point) + translation for point in (capsule.start, capsule.end))
        yield Body(name, joint, Capsule(start, end, capsule.radius))


def _obstacles(workspace: given.Workspace) -> Iterator[Body]:
    for name, obstacle in workspace.obstacles.items():
        yield Body(f"obstacle {name}", WORLD, obstacle_solid(obstacle))


def obstacle_solid(obstacle: given.Obstacle) -> Solid:
    """Return a configured obstacle as a solid in the frame of the base."""
    if obstacle.box is not None:
        box = obstacle.box
        return Box(rotation_rpy(*box.rpy), np.array(box.center), 0.5 * np.array(box.size))
    if obstacle.capsule is not None:
        capsule = obstacle.capsule
        return Capsule(np.array(capsule.start), np.array(capsule.end), capsule.radius)
    if obstacle.half_space is None:
        raise AssertionError("an obstacle is exactly one solid")
    normal = np.array(obstacle.half_space.normal)
    length = float(np.linalg.norm(normal))
    return HalfSpace(normal / length, obstacle.half_space.offset / length)


def _inside(workspace: given.Workspace) -> Iterator[Body]:
    if workspace.inside is None:
        return
    for axis, name in enumerate("xyz"):
        if (interval := getattr(workspace.inside, name)) is not None:
            direction = np.eye(3)[axis]
            yield Body(f"inside {name} lower", WORLD, HalfSpace(direction, interval[0]))
            yield Body(f"inside {name} upper", WORLD, HalfSpace(-direction, -interval[1]))


@dataclass(frozen=True)
class _Hull:
    """Bounds, about a joint's axis and origin, of where points can be: they lie inside all three.

    Attributes:
        radius: radius of the cylinder about the axis [m].
        low: lower end of the cylinder along the axis [m].
        high: upper end of the cylinder along the axis [m].
        ball: radius of the ball about the origin [m].
    """

    radius: float
    low: float
    high: float
    ball: float


def distance_lipschitz_constants(scene: Scene) -> tuple[Array, ...]:
    """Return per pair constants L, shape (joints,), with `|d(q) - d(p)| <= sum_k L_k |q_k - p_k|`.

    Sliding joints are taken to stay within their position limits; where one has none, the joints that carry it have
    infinite constants.

    Returns:
        Arrays [m/rad or m/m], shape (joints,), in the order of `scene.pairs`.
    """
    alone = {index: _of_body(scene, body) for index, body in enumerate(scene.bodies) if body.joint != WORLD}
    zero = np.zeros(scene.chain.joints)
    constants = []
    for contacts in scene.contacts:
        first, second = (scene.bodies[index].joint for index in contacts[0])
        shared = np.zeros(scene.chain.joints, dtype=bool)
        if first != WORLD and second != WORLD:
            shared[list(set(scene.chain.ancestors(first)) & set(scene.chain.ancestors(second)))] = True
        # A joint moves one of the two only, unless it carries both.
        sums = [alone.get(a, zero) + alone.get(b, zero) for a, b in contacts]
        constants.append(np.where(shared, 0.0, np.max(sums, axis=0)))
    return tuple(constants)


def _of_body(scene: Scene, body: Body) -> Array:
    """Return how far each joint moves any point of a body at most [m/rad or m/m], shape (joints,)."""
    chain = scene.chain
    result = np.zeros(chain.joints)
    hull = _around(body, chain.axes[body.joint])
    for k in reversed(chain.ancestors(body.joint)):
        result[k] = hull.radius if chain.revolute[k] else 1.0
        if chain.parents[k] != WORLD:
            hull = _bounds_in_parent_frame(scene, k, hull)
    return result


def _around(body: Body, axis: Array) -> _Hull:
    points, radius = corners(body.solid)
    return _hull(points, axis, radius, radius, float(np.linalg.norm(points, axis=1).max()) + radius)


def _hull(points: Array, axis: Array, across: float, along: float, ball: float) -> _Hull:
    """Return bounds about an axis of points that are thickened by `across` and `along` it, and lie in a ball."""
    heights = points @ axis
    distances = np.linalg.norm(points - np.outer(heights, axis), axis=1)
    return _Hull(
        radius=min(float(distances.max()) + across, ball),
        low=max(float(heights.min()) - along, -ball),
        high=min(float(heights.max()) + along, ball),
        ball=ball,
    )


def _bounds_in_parent_frame(scene: Scene, joint: int, hull: _Hull) -> _Hull:
    """Return bounds of the points, wherever the joint stands, about the parent joint."""
    chain = scene.chain
    axis = chain.rotation[joint] @ chain.axes[joint]
    low, high, ball = hull.low, hull.high, hull.ball
    origin = chain.translation[joint]
    parent_axis = chain.axes[chain.parents[joint]]
    if chain.revolute[joint]:
        ball += float(np.linalg.norm(origin))
    else:
        lower, upper = scene.limits[joint]
        if not np.isfinite([lower, upper]).all():
            return _Hull(np.inf, -np.inf, np.inf, np.inf)
        low, high = low + lower, high + upper
        ball += max(float(np.linalg.norm(origin + travel * axis)) for travel in (lower, upper))
    if not np.isfinite(ball):
        return _Hull(np.inf, -np.inf, np.inf, np.inf)
    ends = origin + np.outer([low, high], axis)
    # A disc across the child's axis is, along the parent's, as thick as the sine of the angle between them.
    tilt = float(np.linalg.norm(np.cross(parent_axis, axis)))
    ball = min(ball, float(np.linalg.norm(ends, axis=1).max()) + hull.radius)
    return _hull(ends, parent_axis, hull.radius, hull.radius * tilt, ball)


_TOLERANCE = 1e-9  # m, of coal's iterations for boxes and cylinders
_POSTURES, _SEED = 200, 20140101


class CollisionModel:
    """Pairs of an arm's bodies that must stay apart, with their distances.

    Attributes:
        pairs: readable names, such as `j4 - base`, `j4 - obstacle table`, `j4 - inside z lower`.
        reach: per pair, constants L [m/rad or m/m], shape (joints,), such that in all postures (of sliding joints:
            within their limits) `|d(q) - d(p)| <= sum_k L_k |q_k - p_k|`; infinite where a sliding joint without
            limits is carried.
        joints: number of joints.
    """

    def __init__(self, model: ArmModel) -> None:
        """Collect the bodies, and check that no pair is always in contact.

        Raises:
            ModelError: geometry that does not fit the arm.
            MotionRefused: a pair that is never free, so that no motion could be safe.
        """
        around = scene(model)
        self.pairs = around.pairs
        self.reach = distance_lipschitz_constants(around)
        self.joints = around.chain.joints
        self._model = kinematics(around.chain)
        self._data = self._model.createData()
        every = [contact for contacts in around.contacts for contact in contacts]
        self._geometry, self._distances = geometry(around, every)
        counts = [len(contacts) for contacts in around.contacts]
        self._starts = np.concatenate([[0], np.cumsum(counts[:-1])]).astype(int) if counts else np.zeros(0, dtype=int)
        self._require_freedom(around, model.config.name)

    def distances(self, position: Array) -> Array:
        """Return the exact signed distance of each pair [m], negative in overlap, shape (samples, pairs).

        Args:
            position: [rad or m], shape (samples, joints).

        Raises:
            ModelError: positions of another shape.
        """
        if position.ndim != 2 or position.shape[1] != self.joints:
            raise ModelError(f"{position.shape=} but expected (samples, {self.joints})")
        if not self.pairs:
            return np.zeros((len(position), 0))
        model, data, geometry, found = self._model, self._data, self._geometry, self._distances
        values = np.empty((len(position), len(geometry.collisionPairs)))
        for row, posture in zip(values, position, strict=True):
            pin.computeDistances(model, data, geometry, found, posture)
            row[:] = [result.min_distance for result in found.distanceResults]
        return np.asarray(np.minimum.reduceat(values, self._starts, axis=1))

    def _require_freedom(self, around: Scene, name: str) -> None:
        lower, upper = around.limits.T
        within = np.where(around.chain.revolute, np.pi, 1.0)
        lower, upper = np.where(np.isfinite(lower), lower, -within), np.where(np.isfinite(upper), upper, within)
        postures = np.random.default_rng(_SEED).uniform(lower, upper, size=(_POSTURES, self.joints))
        farthest = self.distances(postures).max(axis=0)
        stuck = np.flatnonzero(farthest <= 0.0)
        if not stuck.size:
            return
        others = {around.bodies[around.contacts[pair][0][1]].owner for pair in stuck}
        links, surroundings = others & {BASE, *around.chain.names}, others - {BASE, *around.chain.names}
        advice = "shorten the capsules"
        advice += ", or list the pair under workspace.may_touch" if links else ""
        advice += ", or move the obstacle" if any(not owner.startswith("inside") for owner in surroundings) else ""
        advice += (
            ", or mend workspace.inside, which leaves them no room"
            if any(owner.startswith("inside") for owner in surroundings)
            else ""
        )
        raise MotionRefused(
            f"{name}: in collision in every one of {_POSTURES} random postures: "
            f"{', '.join(self.pairs[pair] for pair in stuck)}; {advice}"
        )


def shares_touching(
    model: ArmModel, touching_distance: float, postures: int, seed: int
) -> dict[tuple[str, str], float]:
    """Return per pair that must not touch the share (0 to 1) of random postures nearer than `touching_distance`.

    Of each pair the moving link comes first.

    Args:
        model: model of an arm, also of one whose bodies always touch.
        touching_distance: nearer than this counts as touching [m].
        postures: number of postures drawn, within the position limits.
        seed: of the draw.

    Raises:
        ModelError: geometry that does not fit the arm.
    """
    around = scene(model)
    every = [contact for contacts in around.contacts for contact in contacts]
    if not every:
        return {}
    mechanism = kinematics(around.chain)
    data, (solids, found) = mechanism.createData(), geometry(around, every)
    lower, upper = around.limits.T
    drawn = np.random.default_rng(seed).uniform(lower, upper, size=(postures, around.chain.joints))
    touching = np.zeros((postures, len(every)), dtype=bool)
    for row, posture in zip(touching, drawn, strict=True):
        pin.computeDistances(mechanism, data, solids, found, posture)
        row[:] = [result.min_distance <= touching_distance for result in found.distanceResults]
    shares, start = {}, 0
    for contacts in around.contacts:
        first, second = contacts[0]
        pair = around.bodies[first].owner, around.bodies[second].owner
        shares[pair] = float(touching[:, start : start + len(contacts)].any(axis=1).mean())
        start += len(contacts)
    return shares


def kinematics(chain: Chain) -> pin.Model:
    """Build a pinocchio model of the joints alone, without masses."""
    model = pin.Model()
    for k in range(chain.joints):
        axis = chain.axes[k]
        joint = pin.JointModelRevoluteUnaligned(axis) if chain.revolute[k] else pin.JointModelPrismaticUnaligned(axis)
        parent = 0 if chain.parents[k] == WORLD else chain.parents[k] + 1
        model.addJoint(parent, joint, pin.SE3(chain.rotation[k], chain.translation[k]), chain.names[k])
    return model


def lowest_point(model: ArmModel) -> Callable[[Array], float]:
    """Create a function from a position [rad or m] to the height [m] over the base of the lowest capsule or link frame.

    Args:
        model: model of the arm, whose links are taken as the capsules of its geometry and the origins of their frames.

    Returns:
        From a position [rad or m], shape (joints,), to the height above the base's origin, against gravity [m].
    """
    gravity = np.array(model.config.gravity)
    up = -gravity / np.linalg.norm(gravity) if gravity.any() else np.array([0.0, 0.0, 1.0])
    mechanism = kinematics(model.chain)
    data, links = mechanism.createData(), []
    for link, name in enumerate(model.chain.names):
        frame = link_frame(model.chain, link)
        points, radii = [np.zeros(3)], [0.0]
        for capsule in model.config.geometry.get(name, ()):
            points += [np.array(capsule.start), np.array(capsule.end)]
            radii += [capsule.radius] * 2
        links.append((link + 1, np.array([frame.act(point) for point in points]), np.array(radii)))

    def height(position: Array) -> float:
        pin.forwardKinematics(mechanism, data, position)
        lowest = []
        for joint, points, radii in links:
            pose = data.oMi[joint]
            lowest.append((points @ (up @ pose.rotation) - radii).min() + up @ pose.translation)
        return float(min(lowest))

    return height


def geometry(bodies: Scene, pairs: Sequence[tuple[int, int]]) -> tuple[pin.GeometryModel, pin.GeometryData]:
    """Build coal geometry of all bodies, and the data object for the distances of `pairs` of their indices.

    Args:
        bodies: the bodies.
        pairs: pairs of their indices.
    """
    solids = pin.GeometryModel()
    for index, body in enumerate(bodies.bodies):
        solids.addGeometryObject(_object(f"{index} {body.owner}", body))
    for first, second in pairs:
        solids.addCollisionPair(pin.CollisionPair(first, second))
    found = pin.GeometryData(solids)
    for request in found.distanceRequests:
        request.gjk_tolerance = request.epa_tolerance = _TOLERANCE
    return solids, found


def _object(name: str, body: Body) -> pin.GeometryObject:
    solid = body.solid
    rotation, center = np.eye(3), np.zeros(3)
    if isinstance(solid, Capsule):
        along = solid.end - solid.start
        length = float(np.linalg.norm(along))
        shape = pin.coal.Capsule(solid.radius, length)
        center = 0.5 * (solid.start + solid.end)
        if length > 0.0:
            rotation = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), along / length).toRotationMatrix()
    elif isinstance(solid, Box):
        shape, rotation, center = pin.coal.Box(*(2.0 * solid.half).tolist()), solid.rotation, solid.center
    elif isinstance(solid, Cylinder):
        shape, rotation, center = pin.coal.Cylinder(solid.radius, 2.0 * solid.half_length), solid.rotation, solid.center
    else:
        shape = pin.coal.Halfspace(solid.normal, solid.offset)
    return pin.GeometryObject(name, 0 if body.joint == WORLD else body.joint + 1, pin.SE3(rotation, center), shape)


AT_ONCE = 40


class Contact:
    """Contact check of the pairs of solids of an arm that must stay apart.

    Attributes:
        pairs: readable names of their owners, one per pair of solids.
        clear: result of `depths` while nothing touches: minus infinity for each pair, shape (len(pairs),).
    """

    def __init__(self, model: ArmModel) -> None:
        """Collect the pairs of solids.

        Args:
            model: model with geometry and workspace; without any, there are no pairs.

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
        self.clear = np.full(len(named), -np.inf)
        self.clear.setflags(write=False)

    def depths(self, position: Array) -> Array:
        """Return depths [m] of the pairs whose turn it is, positive in overlap; -inf for others, or all if none touch.

        Args:
            position: [rad or m], shape (joints,).

        Returns:
            [m], shape (len(pairs),); positive where they overlap, infinite where that cannot be told; minus infinity
            for pairs whose turn it is not, and for all while nothing touches.
        """
        if not self.pairs:
            return self.clear
        solids, found, rows = self._groups[self._turn]
        self._turn = (self._turn + 1) % self._turns
        nearest = pin.computeDistances(self._model, self._data, solids, found, position)
        # If all distances are NaN, there is no nearest pair.
        if nearest < len(solids.collisionPairs) and found.distanceResults[nearest].min_distance >= 0.0:
            return self.clear
        depths = self.clear.copy()
        distances = np.array([result.min_distance for result in found.distanceResults])
        depths[rows] = np.where(np.isnan(distances), np.inf, -distances)
        return depths
