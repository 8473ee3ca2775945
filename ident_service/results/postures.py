"""Hold an arm along a motion and its surroundings as points, for a stick figure.

Lengths in m, points in the base frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain

import numpy as np

from ident_service.errors import UsageError
from ident_service.results.drawing import Array, require_drawable


@dataclass(frozen=True)
class Box:
    """Obstacle with eight corners [m], shape (8, 3), in any order."""

    name: str
    corners: Array


@dataclass(frozen=True)
class Plane:
    """Obstacle that fills `normal . x < offset` [m]; `normal` has shape (3,) and points to free space."""

    name: str
    normal: Array
    offset: float


@dataclass(frozen=True)
class Rod:
    """Obstacle of all points within `radius` of the line between `ends` [m], shape (2, 3)."""

    name: str
    ends: Array
    radius: float


@dataclass(frozen=True)
class Closest:
    """Posture and pair of smallest clearance along a motion.

    Attributes:
        posture: number of the posture.
        pair: names of the two things.
        distance: between them [m]; below zero where they overlap.
        points: the nearest point of either [m], shape (2, 3), or None.
    """

    posture: int
    pair: tuple[str, str]
    distance: float
    points: Array | None = None


@dataclass(frozen=True)
class Postures:
    """Arm along a motion, as points in the base frame.

    Attributes:
        frames: origins of links, base and tool among them [m], shape (postures, points, 3).
        times: increasing [s], shape (postures,).
        branches: for every branch of the arm the points from base to tool, two or more.
        obstacles: what does not move.
        workspace: lowest and highest corner of the box that the arm must stay in [m], shape (2, 3); infinite where it
            is open; or None.
        closest: the posture of smallest clearance, or None.
    """

    frames: Array
    times: Array
    branches: tuple[tuple[int, ...], ...]
    obstacles: tuple[Box | Plane | Rod, ...] = ()
    workspace: Array | None = None
    closest: Closest | None = None

    def __post_init__(self) -> None:
        """Refuse postures that cannot be drawn.

        Raises:
            UsageError: no postures, shapes that do not belong together, values that are no numbers, branches or a
                closest posture that do not exist, obstacles without extent.
        """
        if self.frames.ndim != 3:
            raise UsageError(f"cannot draw postures: {self.frames.shape=}, not (postures, points, 3)")
        postures, points = self.frames.shape[:2]
        require_drawable("postures", self.frames, (postures, points, 3))
        require_drawable("times of postures", self.times, (postures,))
        if not (np.diff(self.times) > 0.0).all():
            raise UsageError("cannot draw postures: their times must increase")
        if not self.branches or any(len(branch) < 2 for branch in self.branches):
            raise UsageError(f"cannot draw postures: a branch joins two points or more, unlike one of {self.branches}")
        if not all(0 <= point < points for point in chain(*self.branches)):
            raise UsageError(f"cannot draw postures: the {points} points do not include all of {self.branches}")
        for obstacle in self.obstacles:
            _require_obstacle(obstacle)
        if self.workspace is not None:
            require_drawable("workspace", self.workspace, (2, 3), unlimited=True)
            if not (self.workspace[0] < self.workspace[1]).all():
                raise UsageError("cannot draw a workspace whose lowest corner is not below its highest")
        if self.closest is not None:
            if not 0 <= self.closest.posture < postures:
                raise UsageError(f"cannot draw posture {self.closest.posture}; there are {postures}")
            require_drawable("smallest distance", np.array([self.closest.distance]), (1,))
            if self.closest.points is not None:
                require_drawable("nearest points", self.closest.points, (2, 3))


def _require_obstacle(obstacle: Box | Plane | Rod) -> None:
    if isinstance(obstacle, Box):
        require_drawable(f"obstacle {obstacle.name}", obstacle.corners, (8, 3))
    elif isinstance(obstacle, Plane):
        require_drawable(f"normal of obstacle {obstacle.name}", obstacle.normal, (3,))
        require_drawable(f"offset of obstacle {obstacle.name}", np.array([obstacle.offset]), (1,))
        if not np.abs(obstacle.normal).max() > 1e-9:
            raise UsageError(f"cannot draw obstacle {obstacle.name}: its normal has no direction")
    else:
        require_drawable(f"obstacle {obstacle.name}", obstacle.ends, (2, 3))
        require_drawable(f"radius of obstacle {obstacle.name}", np.array([obstacle.radius]), (1,))
        if not obstacle.radius > 0.0:
            raise UsageError(f"cannot draw obstacle {obstacle.name}: its radius is not above zero")
