"""Represent the mechanism, a tree of one-degree-of-freedom joints, independently of its file format.

Frames. Joint k's frame sits on its parent's frame by a constant placement (at zero position) and then turns about, or
slides along, its own axis. Link parameters are expressed in the link frame, which is the joint frame for URDF, MJCF
and modified-DH arms and the distal frame for standard-DH arms (conventions), a constant offset further.

Dynamics are in `regressor.py` and `pinocchio_models.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ident_service.config.kinematics import DHTable
from ident_service.errors import ModelError

Array = NDArray[np.float64]
WORLD = -1


@dataclass(frozen=True, eq=False)  # chains are compared and hashed by identity
class Chain:
    """Kinematic tree with joints numbered depth first, as pinocchio needs them: parents, then whole branches.

    Attributes:
        names: joint names.
        parents: index of each joint's parent joint, or WORLD.
        revolute: True where the joint turns, False where it slides.
        axes: unit axis in the joint frame, shape (joints, 3).
        rotation: joint frame to parent joint frame at zero, shape (joints, 3, 3).
        translation: origin of the joint frame in the parent joint frame [m], shape (joints, 3).
        link_rotation: link frame to joint frame, shape (joints, 3, 3).
        link_translation: origin of the link frame in the joint frame [m], shape (joints, 3).
        gravity: gravity in the base frame [m/s^2], shape (3,).
        coupling: drive coordinates per joint coordinates, `d = C q` in the joints' units, shape (joints, joints); the
            identity where every joint has its own drive. Drive inertia and friction live on the drives.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    revolute: tuple[bool, ...]
    axes: Array
    rotation: Array
    translation: Array
    link_rotation: Array
    link_translation: Array
    gravity: Array
    coupling: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def __post_init__(self) -> None:
        if self.coupling.size == 0:
            object.__setattr__(self, "coupling", np.eye(len(self.names)))
        if self.coupling.shape != (len(self.names), len(self.names)):
            raise ModelError(f"{self.coupling.shape=} but there are {len(self.names)} joints")
        for k, parent in enumerate(self.parents):
            if not WORLD <= parent < k:
                raise ModelError(f"joint {k} has parent {parent}; parents must come first")
            if k > 0 and parent != WORLD and parent not in self.ancestors(k - 1):
                raise ModelError(f"joint {k} has parent {parent}; a branch must be finished before another one begins")
        for array in (
            self.axes,
            self.rotation,
            self.translation,
            self.link_rotation,
            self.link_translation,
            self.gravity,
            self.coupling,
        ):
            array.setflags(write=False)

    @property
    def joints(self) -> int:
        """Return the number of joints."""
        return len(self.names)

    def ancestors(self, joint: int) -> tuple[int, ...]:
        """Return the indices of the joints that move `joint`'s link, from the base outwards, `joint` included."""
        path = [joint]
        while (parent := self.parents[path[-1]]) != WORLD:
            path.append(parent)
        return tuple(reversed(path))


def rotation_x(angle: float) -> Array:
    """Return the rotation matrix about x by `angle` [rad], shape (3, 3)."""
    c, s = _clean(np.cos(angle)), _clean(np.sin(angle))
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rotation_z(angle: float) -> Array:
    """Return the rotation matrix about z by `angle` [rad], shape (3, 3)."""
    c, s = _clean(np.cos(angle)), _clean(np.sin(angle))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _clean(value: float) -> float:
    """Round sines and cosines of quarter turns exactly, so that rounding noise does not look like a link offset."""
    return float(np.round(value)) if abs(value - np.round(value)) < 1e-15 else float(value)


def chain_from_dh(table: DHTable, gravity: tuple[float, float, float]) -> Chain:
    """Return the serial chain of a standard or modified DH table, with this gravity [m/s^2].

    Standard: `A_k = Rz(theta) Tz(d) Tx(a) Rx(alpha)`, link frames distal as in the paper (table 2). Modified (Craig):
    `A_k = Rx(alpha) Tx(a) Rz(theta) Tz(d)`, link frames on the joint's own axis. The joint variable adds to theta, or
    to d for prismatic joints.
    """
    rows = list(table.joints.values())
    n = len(rows)
    rotation, translation = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    link_rotation, link_translation = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    parent_rotation, parent_translation = np.eye(3), np.zeros(3)
    for k, row in enumerate(rows):
        along_x, along_z = np.array([row.a, 0.0, 0.0]), np.array([0.0, 0.0, row.d])
        turn_x, turn_z = rotation_x(row.alpha), rotation_z(row.theta)
        if table.convention == "standard":
            # The joint turns (or slides) before the constant rest of A_k, which places the distal frame.
            rotation[k] = parent_rotation @ turn_z
            translation[k] = parent_translation
            link_rotation[k], link_translation[k] = turn_x, along_z + along_x
            parent_rotation, parent_translation = link_rotation[k], link_translation[k]
        else:
            rotation[k] = turn_x @ turn_z
            translation[k] = along_x + turn_x @ along_z
    return Chain(
        names=tuple(table.joints),
        parents=tuple(range(-1, n - 1)),
        revolute=tuple(row.type == "revolute" for row in rows),
        axes=np.tile([0.0, 0.0, 1.0], (n, 1)),
        rotation=rotation,
        translation=translation,
        link_rotation=link_rotation,
        link_translation=link_translation,
        gravity=np.array(gravity, dtype=float),
    )
