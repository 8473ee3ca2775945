"""Define convex solids, and bodies made of them: capsules, boxes, cylinders and half spaces, in some joint's frame.

`collision.py` assigns them to links and surroundings, and says which pairs must stay apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from ident_service.model.chain import Array, rotation_x, rotation_z


@dataclass(frozen=True, eq=False)
class Capsule:
    """Capsule: all points within `radius` of the line from `start` to `end` [m], shape (3,) each."""

    start: Array
    end: Array
    radius: float


@dataclass(frozen=True, eq=False)
class Box:
    """Box about `center` with half edges `half` [m], its own frame turned by `rotation`."""

    rotation: Array
    center: Array
    half: Array


@dataclass(frozen=True, eq=False)
class Cylinder:
    """Cylinder about the z axis of its own frame, which sits at its `center` [m]."""

    rotation: Array
    center: Array
    radius: float
    half_length: float


@dataclass(frozen=True, eq=False)
class HalfSpace:
    """Half space: points x with `normal . x < offset` [m]; the normal has length one."""

    normal: Array
    offset: float


Solid = Capsule | Box | Cylinder | HalfSpace
SIGNS = np.array(list(product((-1.0, 1.0), repeat=3)))  # of the corners of a box


def corners(solid: Solid) -> tuple[Array, float]:
    """Return points and a radius: the points' convex hull, thicker by the radius, contains the solid.

    Returns:
        Points in the solid's frame [m], shape (points, 3), and the radius [m].
    """
    if isinstance(solid, Capsule):
        return np.array([solid.start, solid.end]), solid.radius
    if isinstance(solid, HalfSpace):
        raise AssertionError("a half space has no corners")
    half = solid.half if isinstance(solid, Box) else np.array([solid.radius, solid.radius, solid.half_length])
    return solid.center + SIGNS * half @ solid.rotation.T, 0.0


@dataclass(frozen=True, eq=False)
class Body:
    """One solid of a link, of the base or of the surroundings.

    Attributes:
        owner: joint name of the link, `base`, `obstacle <name>` or `inside <axis> <side>`.
        joint: index of the joint whose frame the solid stands still in, or WORLD.
        solid: the solid in that frame.
    """

    owner: str
    joint: int
    solid: Solid


def rotation_rpy(roll: float, pitch: float, yaw: float) -> Array:
    """Return the rotation by roll, pitch and yaw about fixed axes [rad], `Rz(yaw) Ry(pitch) Rx(roll)`, shape (3, 3)."""
    # About y as about x, with the axes renamed: x -> y -> z -> x.
    rename = np.eye(3)[[1, 2, 0]]
    return np.asarray(rotation_z(yaw) @ (rename.T @ rotation_x(pitch) @ rename) @ rotation_x(roll))
