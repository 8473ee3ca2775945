"""Compute the inertia, damping and friction that a joint's own drive adds, as other programs' models represent them.

A drive whose coordinate is `d = c q` of one joint alone, with inertia Ia, viscous fv and Coulomb friction fc on its own
side, adds to that joint the inertia `c^2 Ia`, the damping `c^2 fv` and the dry friction `|c| fc`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident_service.config.schema import JointTerm
from ident_service.model.chain import Array, Chain
from ident_service.model.layout import Layout

JOINT_TERMS: tuple[JointTerm, ...] = ("drive_inertia", "viscous", "coulomb")


@dataclass(frozen=True)
class JointDrives:
    """Effect of each joint's own drive; zero where a joint shares drives with other joints.

    Attributes:
        own: which joints have a drive that moves no other, and no other drive, shape (joints,).
        armature: [kg m^2 or kg], shape (joints,).
        damping: [N m s/rad or N s/m], shape (joints,).
        friction: dry friction [N m or N], shape (joints,).
    """

    own: NDArray[np.bool_]
    armature: Array
    damping: Array
    friction: Array

    def of(self, term: JointTerm) -> Array:
        """Return the values of one of `JOINT_TERMS`, shape (joints,)."""
        return {"drive_inertia": self.armature, "viscous": self.damping, "coulomb": self.friction}[term]


def own_drives(chain: Chain) -> NDArray[np.bool_]:
    """Return which joints have a drive that moves no other joint, and are moved by no other drive, shape (joints,)."""
    shared = (chain.coupling != 0.0) & ~np.eye(chain.joints, dtype=bool)
    return np.asarray(~(shared.any(axis=0) | shared.any(axis=1)))


def joint_drives(chain: Chain, layout: Layout, delta: Array) -> JointDrives:
    """Return the inertia, damping and dry friction that each joint's own drive adds to it.

    Args:
        chain: the mechanism.
        layout: order of the parameters.
        delta: link parameters, shape (layout.size,).
    """
    own = own_drives(chain)
    gear = np.where(own, np.diag(chain.coupling), 0.0)
    inertia, viscous, coulomb = (layout.term_values(term, delta) for term in JOINT_TERMS)
    return JointDrives(own, gear**2 * inertia, gear**2 * viscous, np.abs(gear) * coulomb)


@dataclass(frozen=True)
class WrittenArm:
    """Arm as read from a file, joints in the file's order.

    Attributes:
        chain: the mechanism; link frames are joint frames.
        bodies: the ten inertial parameters per link (eq. 13), shape (joints, 10).
        armature: [kg m^2 or kg], shape (joints,).
        damping: [N m s/rad or N s/m], shape (joints,).
        friction: dry friction [N m or N], shape (joints,).
    """

    chain: Chain
    bodies: Array
    armature: Array
    damping: Array
    friction: Array
