"""Bound how fast a joint can change the distance of two bodies: Lipschitz constants that hold in every posture.

The signed distance of two convex sets changes no more than their points move against each other, and joint k moves a
point by at most its distance from k's axis per radian (its travel per metre). What hangs on joint k stays, however the
joints behind it stand, inside a cylinder about k's axis and inside a ball about k's origin; both follow from those of
the next joint outwards, since a cylinder about an axis is left where it is by a turn about that axis.

Joints that carry both bodies do not move them against each other and have constant zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident_service.model.chain import WORLD, Array
from ident_service.model.scene import Scene
from ident_service.model.solids import Body, Box, Capsule, HalfSpace


@dataclass(frozen=True)
class _Hull:
    """Bounds, about a joint's axis and origin, of where points can be: they lie inside all three.

    Attributes:
        radius: of the cylinder about the axis [m].
        low: where along the axis it begins [m].
        high: where it ends [m].
        ball: radius of the ball about the origin [m].
    """

    radius: float
    low: float
    high: float
    ball: float


def reach(scene: Scene) -> tuple[Array, ...]:
    """Return per pair constants L with `|d(q) - d(p)| <= sum_k L_k |q_k - p_k|`.

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
            hull = _seen_from_parent(scene, k, hull)
    return result


def corners(body: Body) -> tuple[Array, float]:
    """Return points whose convex hull, made thicker by a radius, contains a solid.

    Returns:
        Points in the joint frame [m], shape (points, 3), and the radius [m].
    """
    solid = body.solid
    if isinstance(solid, Capsule):
        return np.array([solid.start, solid.end]), solid.radius
    if isinstance(solid, HalfSpace):
        raise AssertionError("a half space is no part of a link")
    half = solid.half if isinstance(solid, Box) else np.array([solid.radius, solid.radius, solid.half_length])
    signs = np.array(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0])).reshape(3, -1).T
    return solid.center + (signs * half) @ solid.rotation.T, 0.0


def _around(body: Body, axis: Array) -> _Hull:
    points, radius = corners(body)
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


def _seen_from_parent(scene: Scene, joint: int, hull: _Hull) -> _Hull:
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
